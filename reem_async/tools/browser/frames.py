"""The arrays of the past: which there are, and which go when room runs short."""

from __future__ import annotations

import heapq
from bisect import bisect_right
from collections.abc import Callable, Iterator
from operator import attrgetter
from typing import Any

from ...plan.paths import Path
from .timeline import concerns
from .trees import Frame, walk

__all__ = ["Frames"]

_WHOLE_SHARE = 4
"""Of the bytes of all frames, one in so many is kept for the newest whole ones that have a preview as well."""

_TIME = attrgetter("time")


class Frames:
    """All frames with something in them, by their paths.

    Args:
        seconds: How far back the past reaches.

    Attributes:
        bytes: About how much memory their content takes.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._lines: dict[Path, list[Frame]] = {}
        self.bytes = 0

    def add(self, path: Path, tree: Any, when: float) -> None:
        """Note the frames in a tree, which is at a path since an instant that is after all others."""
        for where, it in walk(tree, path):
            if isinstance(it, Frame):
                line = self._lines.setdefault(where, [])
                it.time = max(when, line[-1].time if line else when)  # sorted, though a clock may be set back
                line.append(it)
                self.bytes += it.size

    def before(self, path: Path, at: float, since: float) -> Frame | None:
        """Return the last frame at a path that is not after `at`, nor before `since`."""
        line = self._lines.get(path, [])
        index = bisect_right(line, at, key=_TIME) - 1
        return line[index] if index >= 0 and line[index].time >= since else None

    def concerning(self, path: Path) -> Iterator[Frame]:
        """Yield the frames at, above and below a path."""
        for where, line in self._lines.items():
            if concerns(where, path):
                yield from line

    def forget(self, start: float, is_there: Callable[[Path], bool]) -> None:
        """Let go of what is older than `start` and what nobody can see: of each path one frame before it is shown."""
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
        """Let go of so much that at most so many bytes are left."""
        # First the whole arrays of which there is a picture, oldest first, down to a quarter of the room.
        spare = sorted([frame for line in self._lines.values() for frame in line if _has_both(frame)], key=_TIME)
        held = sum([frame.leaf.size for frame in spare])
        for frame in spare:
            if self.bytes <= most or held <= most // _WHOLE_SHARE:
                break
            held -= frame.leaf.size
            self._drop_whole(frame)
        if self.bytes > most:
            self._thin_evenly(most, now)

    def _thin_evenly(self, most: int, now: float) -> None:
        """Let go of the frame whose absence makes the shortest gap for its bytes, again and again.

        The gap is weighed with the root of the size: that makes the pictures shown at any instant, of all
        paths, the least old in the sum that the bytes allow.
        """
        before: dict[Frame, Frame | None] = {}
        after: dict[Frame, Frame | None] = {}
        for line in self._lines.values():
            before |= dict(zip(line, [None, *line[:-1]], strict=True))
            after |= dict(zip(line, [*line[1:], None], strict=True))

        def score(frame: Frame) -> float:
            left, right = before[frame], after[frame]
            # Without the first there would be nothing at all for a while: it counts for a whole span more.
            start = now - 2 * self._seconds if left is None else left.time
            gap = (now if right is None else right.time) - start
            return float(max(gap, 0.0) / frame.size**0.5)

        heap = [(score(frame), number, frame) for number, frame in enumerate(before)]
        heapq.heapify(heap)
        gone: set[Frame] = set()
        while heap and self.bytes > most:
            value, number, frame = heapq.heappop(heap)
            # Scores are not updated in the heap but when they come up: its neighbours may have gone since.
            if value != (current := score(frame)):  # what was beside it has gone
                heapq.heappush(heap, (current, number, frame))
            elif _has_both(frame):
                self._drop_whole(frame)
                heapq.heappush(heap, (score(frame), number, frame))
            else:
                self._empty(frame)
                gone.add(frame)
                left, right = before[frame], after[frame]
                if left is not None:
                    after[left] = right
                if right is not None:
                    before[right] = left
        self._lines = {
            path: rest for path, line in self._lines.items() if (rest := [it for it in line if it not in gone])
        }

    def _drop_whole(self, frame: Frame) -> None:
        self.bytes -= frame.size
        frame.whole = None
        self.bytes += frame.size

    def _empty(self, frame: Frame) -> None:
        self.bytes -= frame.size
        frame.whole = frame.preview = None


def _has_both(frame: Frame) -> bool:
    return frame.whole is not None and frame.preview is not None
