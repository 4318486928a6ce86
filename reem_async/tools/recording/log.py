"""Recordings, read: what was anywhere at any instant."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path as FilePath
from typing import Any, Literal, Self

import numpy as np

from ...errors import BadType, BadValue, MissingKey
from ...plan.arguments import check_number
from ...plan.paths import Path, Pattern, parse, parse_pattern, shorten, show
from ...plan.placeholders import Unreadable
from ...plan.trees import MISSING
from ...ships.base import SpecialDatatypeShip
from ...ships.registry import Ships, default_ships
from ...transport.protocol import CommandRecorder
from .align import CLOCKS, Alignment, at_rate, by_clock, stacked
from .container import Ref
from .episodes import Episode, episodes_of
from .format import NEWS, Role
from .joined import open_files
from .log_reader import RecordedPast, RecordedStream
from .places import ChannelSummary, Totals
from .stored import LOST, Reference, pruned, resolve
from .times import LATEST, Instant, before, nanoseconds, seconds, up_to

# Whole keys as they were at some instant: a slider, or a walk through time, asks for neighbours again and
# again.
_CACHED_TREES = 256
_END = 2**63 - 1
_NAMED = 10  # top-level keys that an error lists
RecordedClock = Literal["recorder", "publisher"]
"""Whose times of updates are asked for."""


@dataclass(frozen=True, slots=True)
class LogUpdate:
    """One recorded update.

    Attributes:
        time: When it was received, in seconds since 1970 on the recorder's clock.
        path: What was updated, top-level key first.
        value: What is there now; None if it was deleted.
        deleted: What was there is gone.
        published: When it was published, in seconds since 1970 on the publisher's clock; `time`, or 0.0, if it was not.
        sequence: Its number among its publisher's updates of the top-level key; 0 if it was not published.
        kind: "pub" if it was published; "stored" if a client changed what is stored and published nothing: what that
            led to, at the instant at which it was found; "kvs" if it was sampled, or found when the key was read:
            what is left of an update that was changed before it could be read, or what a server that does not tell
            of stored changes had at a keyframe.
    """

    time: float
    path: Path
    value: Any
    deleted: bool
    published: float
    sequence: int
    kind: str

    @property
    def shown(self) -> str:
        """The path as people write it."""
        return show(self.path)


@dataclass(frozen=True, slots=True)
class ArrayHandle:
    """An array (or bytes, a long list, a custom value) of a past tree, not yet read.

    Attributes:
        label: "numpy", "bytes", "list", or the label of a custom ship.
        dtype: The dtype of an array as text, else "".
        shape: The shape of an array, else None.
        size: Its bytes.
        summary: What it is, such as "uint8[480,640,3]".
    """

    label: str
    dtype: str
    shape: tuple[int, ...] | None
    size: int
    summary: str
    _stored: Reference
    _load: Callable[[Reference], Any]

    def read(self) -> Any:
        """Return the value, read-only; raises DamagedRecording if it is."""
        return self._load(self._stored)


def open_log(
    path: str | FilePath | Sequence[str | FilePath],
    ships: Sequence[SpecialDatatypeShip] | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Log:
    """Open a recording; one whose recorder was killed, or that was damaged or rewritten by another tool, opens too.

    So does an MCAP file of another program: a topic `/a/b` is the key `a/b`, and each message an update of it, a plain
    dict at its log time. ROS 2 (CDR with `ros2msg` definitions), protobuf and JSON are decoded. Other channels are left
    out, and `Log.channels` says why.

    What is damaged or missing is left out, and counted in `Log.damaged`. If another program replaces the file while it
    is open, the old one is read on. If it cuts the file short, a read beyond the new end raises OSError.

    Args:
        path: The file, or several that are read as one: the parts of a recording, or recordings of several programs at
            the same time. What was deleted between two recordings seems to be there until the end.
        ships: What makes values of what is not JSON; those of an interface if not given.
        progress: Called with the bytes done and all of them, if the whole file is read: its recorder was killed, or its
            summary is damaged or leaves something out.

    Raises:
        DamagedRecording: Not an MCAP file, or without a channel.
        BadValue: One file is given twice.
        OSError: The file cannot be read.
    """
    return Log(path, ships, progress=progress)


class Log:
    """A recording, as `open_log` opens it. `log["foo.bar"].at(t)` is what was at foo.bar at the instant t.

    `path` is its file, the first one in time if it has several, and `files` are all of them.
    Instants are seconds since 1970 as float, on the clock of the recorder, or numpy datetime64.
    Any thread may use it; nothing here waits for a server.
    """

    def __init__(
        self,
        path: str | FilePath | Sequence[str | FilePath],
        ships: Sequence[SpecialDatatypeShip] | None = None,
        *,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self._container = open_files(path, progress)
        self.files = [file.path for file, _ in self._container.parts()]
        self.path = self.files[0]
        try:
            self._past = past = RecordedPast(
                self._container, Ships(default_ships() if ships is None else ships, CommandRecorder)
            )
        except BaseException:
            self._container.close()
            raise
        self._load: Callable[[Reference], Any] = past.value  # what makes the value of a `Reference`
        keeping = lru_cache(max(_CACHED_TREES, 2 * len(past.names)))
        self._tree = keeping(lambda name, changed: past.tree((name,), changed))

    @property
    def raw(self) -> Log:
        """The same recording, in which pictures are `Jpeg` and `Png`, as they were published, and not decoded.

        For what passes them on, such as players and exports. `log.raw[path].values()` yields them, for example; their
        `data` is the file. It shares the open file with this log.
        """
        it = copy.copy(self)
        it._load = self._past.raw_value
        return it

    @property
    def start(self) -> float:
        """The instant of the first message; 0 if there is none."""
        return seconds(min((info.start for info in self._container.chunks), default=0))

    @property
    def end(self) -> float:
        """The instant of the last message; 0 if there is none."""
        ends = [info.end if info.end < LATEST else info.start for info in self._container.chunks if info.start < LATEST]
        return seconds(max(ends, default=0))

    @property
    def duration(self) -> float:
        """Seconds from the first message to the last."""
        return self.end - self.start

    @property
    def indexed(self) -> bool:
        """Whether the recording was ended properly; if not, its end may be missing."""
        return self._container.indexed

    @property
    def damaged(self) -> int:
        """How many records of the file were found to be damaged, cut off or missing until now; they are left out."""
        return self._container.damaged

    @property
    def unreadable(self) -> int:
        """How many values were left out until now, since they are damaged, or of a type that was not recorded."""
        return max(self._past.unreadable, self._container.damaged)

    @property
    def foreign(self) -> bool:
        """Whether another program has recorded it, or a part of it."""
        return bool(self._past.foreign.keys or self._past.foreign.skipped)

    @property
    def undecoded(self) -> dict[str, str]:
        """The topics of other programs that are left out, and why."""
        return {self._container.channels[number].topic: why for number, why in self._past.foreign.skipped.items()}

    @property
    def metadata(self) -> dict[str, str]:
        """What the recorder says of itself: who, when, versions, patterns, and at the end its counts.

        Of a recording of another program, the profile and the library that the file names.
        """
        said: dict[str, str] = self._container.header() if self.foreign else {}
        for record in self._container.metadata:
            if record.name == "reem":
                said.update(record.metadata)
        return said

    def names(self) -> list[str]:
        """Return the top-level keys of which anything was recorded, sorted."""
        return sorted(self._past.names)

    def paths(self) -> list[Path]:
        """Return the paths that were updated while it was recorded, sorted as text."""
        return sorted({stream.path for stream in self._past.streams if stream.role == Role.UPDATE}, key=show)

    def __getitem__(self, path: str | Path) -> LogPath:
        return LogPath(self, parse(path) if isinstance(path, str) else tuple(path))

    def value_at(self, path: str | Path, instant: Instant) -> Any:
        """Return what was at a path at an instant, arrays included; the root path "" is the whole tree.

        Raises:
            MissingKey: Nothing was there.
            DamagedRecording: What was there cannot be read any more.
        """
        place = parse(path) if isinstance(path, str) else tuple(path)
        if not place:
            trees = self._trees_at(up_to(instant))
            return {name: resolve(tree, self._recorded) for name, tree in trees.items()}
        found = self._past.tree(place, up_to(instant))
        if found is MISSING:
            raise MissingKey(f"nothing was at {show(place)} at {instant!r}; it was recorded from {self.start!r} on")
        return self._load(found) if type(found) is Reference else resolve(found, self._recorded)

    def _recorded(self, it: Reference) -> Any:
        """Return a value, or what stands in a tree for one that could not be recorded; raises DamagedRecording."""
        if it.label != LOST:
            return self._load(it)
        self._past.unreadable += 1
        return Unreadable(it.shown, it.summary)

    def readable_at(self, name: str, instant: Instant, patterns: Sequence[str] = ("*",)) -> Any:
        """Return what patterns name of a top-level key at an instant, without what cannot be read; or MISSING.

        What cannot be read is counted in `unreadable`. An item of a list is None then: the others keep their places.
        """
        try:
            tree = self._past.tree((name,), up_to(instant))
        except ValueError:  # all of it is damaged
            self._past.unreadable += 1
            return MISSING
        return resolve(pruned(tree, (name,), [parse_pattern(text) for text in patterns]), self._whole)

    def _whole(self, tree: Any) -> Any:
        """Return a past tree; MISSING if nothing is there, or, and it is counted, if something in it cannot be read."""
        if tree is MISSING:
            return tree
        try:
            return resolve(tree, self._load)
        except ValueError:  # damaged, or never recorded
            self._past.unreadable += 1
            return MISSING

    def tree_at(self, instant: Instant) -> dict[str, Any]:
        """Return all that there was at an instant: a dict by top-level key; longer arrays as `ArrayHandle`."""
        trees = self._trees_at(up_to(instant))
        return {name: resolve(tree, self._handle) for name, tree in trees.items()}

    def _handle(self, it: Reference) -> ArrayHandle:
        return ArrayHandle(it.label, it.dtype, it.shape, it.size, it.summary, it, self._load)

    def _trees_at(self, ns: int) -> dict[str, Any]:
        found = [(name, self._tree(name, self._past.changed(name, ns))) for name in self.names()]
        return {name: tree for name, tree in found if tree is not MISSING}

    def states(self, name: str, after: Instant) -> Iterator[tuple[float, Any]]:
        """Yield the instants after one at which there was news of a top-level key, and all that was at it then.

        Longer arrays are `ArrayHandle`. What was at a deleted key is MISSING.
        """
        for ns, tree in self._past.changes((name,), up_to(after)):
            yield seconds(ns), resolve(tree, self._handle)

    def changes(self, after: Instant, until: Instant) -> set[Path]:
        """Return the paths that were updated after one instant and not after another."""
        numbers = self._past.timeline.channels_between(up_to(after), up_to(until))
        return {it.path for number, it in self._past.of_channel.items() if number in numbers and it.role in NEWS}

    def news_times(self, path: Path, progress: Callable[[int, int], None] | None = None) -> np.ndarray[Any, Any]:
        """Return when there was an update of a path, or of what is above or below it, in seconds, sorted: float64.

        `progress` is called with the chunks done and all of them.
        """
        found = self._past.timeline.times(self._past.news_channels(path), progress).astype(np.float64)
        times: np.ndarray[Any, Any] = found / 1e9
        return times

    def news_count(self, path: Path, after: Instant, until: Instant) -> int:
        """Return how many such updates there were after one instant and not after another."""
        span = up_to(after), up_to(until)
        return self._past.timeline.count(self._past.news_channels(path), *span)

    def last_news(self, path: Path, instant: Instant) -> float | None:
        """Return when the last such update before an instant was, None if there was none."""
        newest = self._past.newest(self._past.concerning(path), up_to(instant), -1)
        return None if newest is None else seconds(newest[0].time)

    def gaps(self) -> list[tuple[float, str, int | None]]:
        """Return where updates were lost: when this was noticed, of which path, and how many (None: unknown)."""
        return [(seconds(ref.time), show(it.path), self._past.missed(ref)) for ref, it in self._past.of_role(Role.GAP)]

    def skipped(self) -> list[tuple[float, str, int]]:
        """Return which updates could not be recorded: when they came, their paths, and their publishers' numbers.

        Each was so large that it was only announced, and others replaced or changed it before it could be read.
        """
        return [
            (seconds(ref.time), show(it.path), self._past.stamp(ref)[1]) for ref, it in self._past.of_role(Role.SKIP)
        ]

    def updates(
        self,
        start: Instant | None = None,
        end: Instant | None = None,
        patterns: Sequence[str] = ("*",),
        *,
        partial: bool = False,
    ) -> Iterator[LogUpdate]:
        """Yield what was recorded in order, from `start` to `end`, both included.

        Of an update of a whole dict, only what the patterns name is in the value.

        Args:
            start: The first instant; the beginning of the recording if not given.
            end: The last instant; the end of the recording if not given.
            patterns: Which paths.
            partial: An update is left out, and counted in `unreadable`, if anything in its value is damaged or was
                not recorded. With this, only that is left out of the value; an item of a list is None then.
        """
        after, until = _span(start, end)
        for ref, stream, value in self._news(after, until, patterns):
            read = resolve(value, self._whole) if partial else self._whole(value)
            if value is MISSING:
                yield self._update(ref, stream, None, deleted=True)
            elif read is not MISSING:
                yield self._update(ref, stream, read, deleted=False)

    def outlines_of(self, patterns: Sequence[str] = ("*",)) -> Iterator[tuple[float, Path, Any, str]]:
        """Yield time, path, value and kind of each update; arrays that are not short are `Reference`, and not read.

        The value is MISSING where the path was deleted.
        """
        for ref, stream, value in self._news(-1, _END, patterns):
            yield seconds(ref.time), stream.path, value, stream.kind.value

    def _news(self, after: int, until: int, patterns: Sequence[str]) -> Iterator[tuple[Ref, RecordedStream, Any]]:
        """Yield the updates that patterns name, with what they name of the value; MISSING for a deletion."""
        wanted = [parse_pattern(text) for text in patterns]
        for ref, stream, value in self._past.updates(after, until, wanted):
            left = value if value is MISSING else pruned(value, stream.path, wanted)
            if left is not MISSING or value is MISSING:
                yield ref, stream, left

    def _update(self, ref: Ref, stream: RecordedStream, value: Any, *, deleted: bool) -> LogUpdate:
        published, sequence = self._past.stamp(ref)
        return LogUpdate(
            seconds(ref.time), stream.path, value, deleted, seconds(published), sequence, stream.kind.value
        )

    def align(
        self,
        paths: Sequence[str],
        *,
        rate: float | None = None,
        on: str | None = None,
        method: str | Mapping[str, str] = "nearest",
        tolerance: float | Mapping[str, float] | None = None,
        start: Instant | None = None,
        end: Instant | None = None,
        clock: str = "recorder",
    ) -> Alignment:
        """Return the values of several paths at common instants: a loop over it yields blocks of rows.

        Args:
            paths: The paths, such as ["arm.q", "cam.rgb"].
            rate: Rows per second, from `start` on.
            on: A path at each update of which there is a row, in place of `rate`.
            method: For all paths, or a dict by path. "nearest": the value nearest in time. "previous": the last one
                before the row or at it. "linear": between the two around the row; of numbers, lists and arrays of
                numbers only.
            tolerance: Seconds that such a value may be away from the row, for all paths, or a dict by path. A row
                without one has no value. No limit if not given.
            start: The first instant; the beginning of the recording if not given.
            end: The last instant; the end of the recording if not given.
            clock: Whose times count. "recorder": when it received the updates. "publisher": when they were published,
                which is more exact where all publishers run on one host, or have clocks that agree. What was only
                stored has the recorder's time.

        Raises:
            BadType, BadValue: An argument that means nothing, or "linear" for what is no number.
            BadData: In a loop: the clock of a publisher was set back, by over a second.
            MissingKey: Nothing was recorded at a path.
        """
        if isinstance(paths, str) or not paths:
            raise BadType(f'paths={shorten(paths)}: use a list of paths, such as ["arm.q", "cam.rgb"]')
        if (rate is None) == (on is None):
            raise BadValue('give either rate, in rows per second, or on, a path such as "cam.rgb"')
        if rate is not None:
            check_number("rate", rate, "use rows per second, over 0", above=0, most=1e6)
        if clock not in CLOCKS:
            raise BadValue(f"clock={shorten(clock)} is none of {', '.join(CLOCKS)}")
        places = {path: self._known(path) for path in paths}
        begin = self.start if start is None else start
        first, last = nanoseconds(begin), up_to(self.end if end is None else end)
        if rate is not None:
            instants = partial(at_rate, rate, first, last)
        else:
            instants = partial(self._instants, self._known(on or ""), clock, before(begin) + 1, last)
        return Alignment(
            self._past, self._whole, places, instants, first, clock=clock, method=method, tolerance=tolerance
        )

    def _instants(self, path: Path, clock: str, start: int, end: int) -> Iterator[int]:
        """Yield when there was an update of a path, in ns."""
        for ns, tree in by_clock(self._past, path, clock, self._past.changes(path, start - 1, end)):
            if tree is not MISSING:
                yield ns

    def _known(self, text: str) -> Path:
        """Return a path of which something was recorded; raises MissingKey."""
        path = self[text].path
        if not path or not self._past.concerning(path):
            there = ", ".join(self.names()[:_NAMED]) or "nothing"
            raise MissingKey(f"nothing was recorded at {shorten(text)}; the recording has {there}")
        return path

    def episodes(self, path: str = "episode", *, clock: str = "recorder") -> list[Episode]:
        """Return the spans in which a path held a dict, in order; none if it never did.

        An episode begins when a dict is written there, and ends when the dict is deleted, when something else is
        written, such as None, or another whole dict. A whole dict that only adds fields, or changes `outcome` or
        `discard`, belongs to the running episode, and so does every change of a field. `clock` is that of `align`.
        """
        return episodes_of(self._past, self._whole, self[path].path, clock, self.end)

    def channels(self, progress: Callable[[int, int], None] | None = None) -> list[ChannelSummary]:
        """Return what each channel of the file holds, by topic.

        The indexes of all chunks are read: about a second for half an hour of 1,000 keys. `progress` is called with the
        chunks done and all of them.
        """
        totals, found = self._past.timeline.totals(progress), []
        for channel in list(self._container.channels.values()):  # reading an index may find more of them
            stream, schema = self._past.of_channel.get(channel.id), self._container.schemas.get(channel.schema_id)
            place = (show(stream.path), stream.role.value, stream.kind.value) if stream else ("", "", "")
            messages, size, first, last = totals.get(channel.id, Totals())
            title, span = schema.name if schema else "", (seconds(first), seconds(last))
            skipped = self._past.foreign.skipped.get(channel.id, "")
            found.append(ChannelSummary(channel.topic, *place, title, messages, size, *span, skipped))
        return sorted(found, key=lambda it: (it.topic, it.role, it.path))

    def verify(self, progress: Callable[[int, int], None] | None = None) -> int:
        """Read all of the file; return how many records are damaged.

        Checksums, indexes and the count of messages are compared with the data. `progress` is called with the chunks
        done and all of them. Messages of other programs are decoded, and `unreadable` counts those that cannot be.
        """
        self._container.verify(progress)
        for name in set(self._past.foreign.keys.values()):
            for _ in self._past.updates(-1, _END, [Pattern(name)]):
                pass
        return self._container.damaged

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._container.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<reem recording {self.path}, {self.duration:.1f} s>"


def _span(start: Instant | None, end: Instant | None) -> tuple[int, int]:
    return -1 if start is None else before(start), _END if end is None else up_to(end)


class LogPath:
    """One path of a recording."""

    def __init__(self, log: Log, path: Path) -> None:
        self._log = log
        self.path = path

    def __getitem__(self, key: str | int) -> LogPath:
        return LogPath(self._log, (*self.path, key))

    def at(self, instant: Instant) -> Any:
        """Return the value at an instant; raises MissingKey, DamagedRecording. See `Log.value_at`."""
        return self._log.value_at(self.path, instant)

    def history(
        self, start: Instant | None = None, end: Instant | None = None, *, clock: RecordedClock = "recorder"
    ) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any] | list[Any]]:
        """Return when the value was updated and what it was then.

        Args:
            start: The first instant; the beginning of the recording if not given.
            end: The last instant; the end of the recording if not given.
            clock: "recorder": the times at which the recorder received the updates, which only grow. "publisher": the
                times at which they were published, on the publishers' clocks, in the order of receipt. They go back
                where such a clock was set back. What was only stored or sampled has no such time and is left out.

        Returns:
            The times, in seconds since 1970: float64, (N,). The values: one array, the first axis being
            time, if they are all numbers, all arrays of one shape and dtype, or all lists of as many
            numbers; else a list. Instants at which nothing was there are left out, and so are values in
            which anything is damaged or was not recorded, which `Log.unreadable` counts.
        """
        times: list[int] = []
        values: list[Any] = []
        for instants, found in self._read(start, end, clock):
            times += instants
            values += found
        return np.array(times, np.float64) / 1e9, stacked(values)

    def values(
        self, start: Instant | None = None, end: Instant | None = None, *, clock: RecordedClock = "recorder"
    ) -> Iterator[tuple[float, Any]]:
        """Yield what `history` returns one by one, for what is larger than memory."""
        for instants, found in self._read(start, end, clock):
            yield from zip(map(seconds, instants), found, strict=True)

    def outlines(
        self, start: Instant | None = None, end: Instant | None = None
    ) -> Iterator[tuple[list[int], list[Any]]]:
        """Yield instants in ns and values, many at a time; arrays that are not short are `Reference`, and not read."""
        for instants, trees, _ in self._log._past.batches(self.path, *_span(start, end)):
            yield instants, [None if tree is MISSING else tree for tree in trees]

    def _read(
        self, start: Instant | None, end: Instant | None, clock: str
    ) -> Iterator[tuple[Sequence[int], Sequence[Any]]]:
        """Yield instants in ns and values, many at a time."""
        if clock not in ("recorder", "publisher"):
            raise BadValue(f"clock={clock!r:.40} is neither 'recorder' nor 'publisher'")
        after, until = _span(start, end)
        past = self._log._past
        if clock == "recorder":
            for instants, trees, is_plain in past.batches(self.path, after, until):
                if is_plain:
                    yield instants, trees
                    continue
                for ns, tree in zip(instants, trees, strict=True):
                    if (whole := self._log._whole(tree)) is not MISSING:
                        yield [ns], [whole]
            return
        for refs, repeats, tree in past.following(self.path, after, until):
            published = past.published(refs)
            if not repeats and published is not None and (whole := self._log._whole(tree)) is not MISSING:
                yield [published], [whole]

    def __repr__(self) -> str:
        return f"<{show(self.path)} of {self._log!r}>"
