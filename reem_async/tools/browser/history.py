"""The rolling buffer: every change of the last seconds, within a number of bytes."""

from __future__ import annotations

import hashlib
import math
import time
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import takewhile
from operator import attrgetter
from typing import Any

from ...plan.paths import Path, related
from ...plan.placeholders import Unfetched
from ...plan.trees import MISSING, difference, walk
from .source import Loss, rate_span
from .timeline import UNKNOWN, BufferedChange, BufferedPast, Kept
from .trees import Frame, same, weight

# One clock for everything in the buffer, which is never set back.


_WAITED = 1.0  # seconds before now that something may have been received, at most: the clock may have been set since


class BufferClock:
    """This machine's clock, but for its being set back: it goes on then, ahead of it by as much.

    A step forward is taken, as the one after a computer has slept.
    """

    def __init__(self) -> None:
        self._ahead = time.time() - time.monotonic()

    def now(self) -> float:
        # In this order: whatever takes a while between the two looks makes the difference less, and is not taken.
        self._ahead = max(self._ahead, time.time() - time.monotonic())
        return time.monotonic() + self._ahead

    def of(self, received: float) -> float:
        """Return when something came that was received a moment ago, at an instant of this machine's clock."""
        return self.now() - min(max(time.time() - received, 0.0), _WAITED)


# The arrays of the past: which there are, and which go when room runs short.

_WHOLE_SHARE = 4
"""Of the bytes of all frames, one in so many is kept for the newest whole ones that have a preview as well."""

_TIME = attrgetter("time")


class Frames:
    """All frames with something in them, by their paths."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds  # how far back the past reaches
        self._lines: dict[Path, list[Frame]] = {}
        self.bytes = 0  # about how much memory their content takes

    def add(self, path: Path, tree: Any, when: float) -> None:
        """Note the frames in a tree, which is at a path since an instant that is after all others."""
        for where, it in walk(tree, path):
            if isinstance(it, Frame) and it.size:
                line = self._lines.setdefault(where, [])
                if line and line[-1] is it:
                    continue
                it = it.moved() if it.time else it  # as an item of a list does
                it.time = max(when, line[-1].time if line else when)  # sorted, though a clock may be set back
                line.append(it)
                self.bytes += it.size

    def before(self, path: Path, at: float, since: float) -> Frame | None:
        """Return the last frame at a path that is not after `at`, nor before `since`."""
        line = self._lines.get(path, [])
        index = bisect_right(line, at, key=_TIME) - 1
        return line[index] if index >= 0 and line[index].time >= since else None

    def concerning(self, path: Path) -> Iterator[Frame]:
        for where, line in self._lines.items():
            if related(where, path):
                yield from line

    def forget(self, start: float, is_there: Callable[[Path], bool]) -> None:
        """Drop what is older than `start`, but for the last frame of each path before it, which is shown."""
        for path in list(self._lines):
            line = self._lines[path]
            # One frame before the start stays: it is what was there at the start.
            count = bisect_right(line, start, key=_TIME) - 1
            if count == len(line) - 1 and not is_there(path):
                count += 1
            for frame in line[: max(count, 0)]:
                self._empty(frame)
            del line[: max(count, 0)]
            if not line:
                del self._lines[path]

    def thin(self, most: int, now: float) -> None:
        # First the whole arrays of which there is a picture, oldest first, down to a quarter of the room.
        spare = sorted([frame for line in self._lines.values() for frame in line if _has_both(frame)], key=_TIME)
        held = sum([frame.described.size for frame in spare])
        for frame in spare:
            if self.bytes <= most or held <= most // _WHOLE_SHARE:
                break
            held -= frame.described.size
            self._drop_whole(frame)
        if self.bytes > most:
            self._thin_evenly(most, now)

    def _thin_evenly(self, most: int, now: float) -> None:
        """Let go of frames that come soon after the one before them, for their bytes, until at most so many are left.

        The gap is weighed with the root of the size: that makes the pictures shown at any instant, of all
        paths, the least old in the sum that the bytes allow.
        """
        shortest = 1e-5 * self._seconds
        while self.bytes > most and any(self._lines.values()):
            shortest *= 1.2
            for path, line in list(self._lines.items()):
                # Without the first there would be nothing at all for a while: it counts for two spans.
                left, kept = now - 3 * self._seconds, []
                for frame in line:
                    is_soon = self.bytes > most and frame.time - left < shortest * frame.size**0.5
                    if is_soon and not _has_both(frame):
                        self._empty(frame)
                        continue
                    if is_soon:
                        self._drop_whole(frame)  # its preview stays
                    kept.append(frame)
                    left = frame.time
                self._lines[path] = kept
        self._lines = {path: line for path, line in self._lines.items() if line}

    def _drop_whole(self, frame: Frame) -> None:
        self.bytes -= frame.size
        frame.whole = None
        self.bytes += frame.size

    def _empty(self, frame: Frame) -> None:
        self.bytes -= frame.size
        frame.whole = frame.preview = None


def _has_both(frame: Frame) -> bool:
    return frame.whole is not None and frame.preview is not None


# What was lost of updates.

_MOST_LOSSES = 5000  # that are kept: the oldest go


class Losses:
    """When updates were lost of a key, or of all while the server could not be reached."""

    def __init__(self) -> None:
        self._all: deque[tuple[str, Loss]] = deque(maxlen=_MOST_LOSSES)  # the key; "" for all
        self._away: float | None = None  # since when nothing is received

    def add(self, name: str, loss: Loss) -> None:
        # After an outage the first update of each key reports a loss: that is known.
        last = next((whose for whose, _ in reversed(self._all) if whose in ("", name)), None)
        if loss.missed is not None or last != "":
            self._all.append((name, loss))

    def begin(self, when: float) -> None:
        if self._away is None:
            self._away = when

    def finish(self, when: float) -> None:
        if self._away is not None:
            self.add("", Loss(self._away, when, None))
            self._away = None

    def forget(self, start: float) -> None:
        while self._all and self._all[0][1].end < start:
            self._all.popleft()

    def of(self, name: str, start: float, end: float) -> list[Loss]:
        found = [loss for whose, loss in self._all if whose in ("", name)]
        if self._away is not None:
            found.append(Loss(self._away, math.inf, None))
        return [loss._replace(end=min(loss.end, end)) for loss in found if loss.end >= start and loss.start <= end]


# The buffer.

Text = bytes
"""A document as the server sends it; History has something else of the name of that type."""

_OVERHEAD = 300  # bytes of memory that a change takes besides its value
_TRIM_SECONDS = 1.0  # seconds between two looks for what is too old
_FILLED = 0.9  # the part of the bytes that is left full when room is made: it is then a while until more must be
LARGEST_TEXT = 1 << 18  # bytes of a document's text up to which it is kept as the state before the first change


class History:
    def __init__(self, seconds: float, budget: int) -> None:
        self.seconds = seconds  # how long a change is kept
        self.budget = budget  # bytes that all of it may take; the oldest goes first
        self.clock = BufferClock()  # the time of all that is in it
        self.start = self.clock.now()  # from when on the past is known, in seconds since 1970
        self.frames = Frames(seconds)  # the arrays that were read
        self.losses = Losses()
        self.dropped = 0  # how many changes had to go before their time
        self._bytes = 0  # of all but the frames
        self._lines: dict[str, BufferedPast] = {}
        # The same changes twice: by key, to know what a key held; all in order, to forget the oldest first.
        self._all: deque[BufferedChange] = deque()
        self._heavy: set[str] = set()  # keys whose base may hold arrays
        self._trimmed = 0.0

    @property
    def bytes(self) -> int:
        return self._bytes + self.frames.bytes

    @property
    def newest(self) -> float:
        """When the last change was noted; 0 if there is none."""
        return self._all[-1].time if self._all else 0.0

    # --- what happened

    def add(self, path: Path, value: Any, size: int, when: float, *, answer: bool = False) -> None:
        """Note a change: `value` is what is at `path` since; MISSING or PENDING stand for what they say.

        It may be the `answer` to one that was PENDING.
        """
        # A change is put into the line of its top-level key: only those can change what was at a path.
        line = self._line(str(path[0]))
        change = BufferedChange(when, path, value, size + _OVERHEAD, answer)
        line.add(change)
        self._all.append(change)
        self._bytes += change.size
        self._trim(when)

    def add_read(self, path: Path, tree: Any, when: float, *, answer: bool = False) -> None:
        """Note what was read at a path, with a `Frame` for each array that is to be kept."""
        self.frames.add(path, tree, when)
        self.add(path, tree, weight(tree), when, answer=answer)

    def begin(self, name: str, text: Text | None) -> None:
        if name in self._lines:
            return
        # Of a long document only a mark is kept: what it held before its first change is unknown.
        base = MISSING if text is None else text if len(text) <= LARGEST_TEXT else UNKNOWN
        line = self._lines[name] = BufferedPast(name, base, None if base is UNKNOWN else text)
        self._bytes += line.base_size + _OVERHEAD

    def difference(self, name: str, tree: Any, text: Text | None, when: float) -> Path | None:
        """Return the deepest place with all that differs from what the changes led to, None if nothing does.

        Of a long document nothing is known at first: it differs from when on it was `remember`ed. The tree was made of
        the text, which is None if there is none, or if the tree is newer.
        """
        line = self._lines.get(name)
        if line is None:
            return None if tree is MISSING else (name,)
        # The same text, or a digest of it: nothing has changed. This is what most reads find.
        if text is not None and line.text == _mark(text):
            return None
        state = line.state(when)
        if state is UNKNOWN and text is not None:
            return (name,) if line.text is not None or len(text) <= LARGEST_TEXT else None
        inner = difference(state, tree, same)
        return None if inner is None else (name, *inner)

    def remember(self, name: str, text: Text | None) -> None:
        """Note what was read last, and is in the changes."""
        line = self._lines.get(name)
        if line is not None:
            line.text = None if text is None else _mark(text)

    def _line(self, name: str) -> BufferedPast:
        if name not in self._lines:
            self._lines[name] = BufferedPast(name, UNKNOWN)
            self._bytes += _OVERHEAD
        return self._lines[name]

    def _trim(self, when: float) -> None:
        if when >= self._trimmed + _TRIM_SECONDS:
            self._trimmed = when
            self._fold(sum(1 for _ in takewhile(lambda change: change.time < when - self.seconds, self._all)))
            self.start = max(self.start, when - self.seconds)
            self.losses.forget(self.start)
            self.frames.forget(self.start, lambda path: isinstance(self.tree(path, when), Frame | Unfetched))
        if self.bytes > self.budget:
            # Pictures go first, thinned evenly; but not below half of all memory for the sake of plain values.
            room = int(_FILLED * self.budget) - self._bytes
            self.frames.thin(max(room, self.budget // 2), when)
        # Then plain changes, a tenth at a time: folding each by itself would copy the state each time.
        while self.bytes > self.budget and self._all:
            while self._heavy:  # first the arrays of states that the slider does not reach any more
                self._bytes -= self._lines[self._heavy.pop()].strip()
            if self.bytes <= self.budget:
                break
            count = max(len(self._all) // 10, 1)
            self.dropped += count
            self._fold(count)

    # The oldest changes become the state that the past begins with.
    def _fold(self, count: int) -> None:
        counts: Counter[str] = Counter()
        for _ in range(count):
            first = self._all.popleft()
            counts[str(first.path[0])] += 1
            self.start = max(self.start, first.time)
        for name, changes in counts.items():
            line = self._lines[name]
            self._bytes -= line.fold(changes)
            if line.is_over:  # programs may publish under ever new names
                del self._lines[name]
                self._bytes -= _OVERHEAD
                self._heavy.discard(name)
            else:
                self._heavy.add(name)

    # --- what there was

    def first_trees(self) -> Iterator[tuple[str, Any]]:
        """Yield what each key held where the past begins, as far as it is known."""
        for name, line in self._lines.items():
            tree = line.state(0.0)
            if tree is not MISSING and tree is not UNKNOWN:
                yield name, tree

    def changes(self) -> Iterable[BufferedChange]:
        """Return all changes since, in order."""
        return self._all

    @property
    def names(self) -> Iterable[str]:
        return self._lines.keys()

    def knows(self, name: str) -> bool:
        return name in self._lines

    def unchanged(self, path: Path, since: float) -> bool:
        """Return whether nothing is known to have changed at a path since an instant: it is as it is now."""
        line, now = self._lines.get(str(path[0])), math.inf
        if line is None or line.upto(since) == len(line.changes):
            return True
        return len(path) > 1 and max(line.newest(path, now), line.moved(path, now)) <= since

    def existed(self, name: str, at: float) -> bool | None:
        line = self._lines.get(name)
        state = UNKNOWN if line is None else line.state(at)
        return None if state is UNKNOWN else state is not MISSING

    def tree(self, path: Path, at: float) -> Any:
        """Return what was at a path: a tree not to be changed, MISSING or UNKNOWN."""
        return self.kept(path, at).value

    def kept(self, path: Path, at: float) -> Kept:
        """Return what was at a path, and how old that is: of an array the last one of which something is kept."""
        line = self._lines.get(str(path[0]))
        if line is None:
            return Kept(UNKNOWN)
        kept = line.kept(path, at)
        # Of an array the line knows only that it changed; which picture of it is still there, the frames know.
        if not isinstance(kept.value, Frame | Unfetched):
            return kept
        frame = self.frames.before(path, at, line.moved(path, at))
        if frame is None:
            return Kept(kept.value.described if isinstance(kept.value, Frame) else kept.value, kept.late)
        newest = line.newest(path, at)
        if frame is kept.value or newest < frame.time:
            return Kept(frame, kept.late)
        # A millisecond at least: the picture is older than the last change, if only just.
        return Kept(frame, max(newest - frame.time, 1e-3))

    def last(self, paths: Sequence[Path], at: float) -> dict[Path, float]:
        groups: dict[str, list[Path]] = {}
        for path in paths:
            if path and path[0] in self._lines:
                groups.setdefault(str(path[0]), []).append(path)
        found: dict[Path, float] = {}
        for name, group in groups.items():
            found |= self._lines[name].last(group, at)
        return found

    def rate(self, name: str, at: float) -> float | None:
        """Return updates per second of a key about `at`; None if there was none, or it is not known yet."""
        line = self._lines.get(name)
        if line is None:
            return None
        span = rate_span(at, self.start, max(self.clock.now(), at))
        if span is None:
            return None
        some = line.changes[line.upto(span[0]) : line.upto(span[1])]
        # An answer belongs to a change that was counted when it was announced.
        count = sum([not change.answer for change in some])
        return count / (span[1] - span[0]) if count else None

    def between(self, since: float, until: float) -> Iterator[BufferedChange]:
        for change in reversed(self._all):
            if change.time <= since:
                return
            if change.time <= until:
                yield change

    def values(self, path: Path, start: float, end: float) -> Iterator[tuple[float, Any]]:
        line = self._lines.get(str(path[0]))
        return iter(()) if line is None else line.values(path, start, end)

    def times(self, path: Path) -> list[float]:
        if not path:
            return [change.time for change in self._all if not change.answer]
        line = self._lines.get(str(path[0]))
        return line.times(path) if line else []

    def trees(self, at: float) -> Iterator[tuple[str, Any]]:
        """Yield the keys, and what they held, as far as it is known."""
        for name, line in list(self._lines.items()):
            tree = line.state(at)
            if tree is not UNKNOWN and tree is not MISSING:
                yield name, tree


def _mark(text: bytes) -> bytes:
    """Return what tells a text from others: itself, or a digest of a long one."""
    return text if len(text) <= LARGEST_TEXT else hashlib.blake2b(text, digest_size=16).digest()
