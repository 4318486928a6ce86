"""What was recorded of each key, and what it held at an instant, arrays left where they are."""

from __future__ import annotations

import contextlib
import itertools
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import orjson
from mcap.records import Channel, Metadata

from ...errors import BadData
from ...plan.past import Past
from ...plan.paths import Path, Pattern, below, related
from ...plan.trees import MISSING, get, same
from ...ships.images import EncodedImage
from ...ships.registry import Ships
from .container import Container, Message, Ref
from .foreign import Foreign
from .format import NEWS, DamagedRecording, Kind, Role
from .joined import Files
from .layout import EncodedMessage, PathReader, decode, from_json
from .places import Timeline, messages_in
from .sink import CHANNELS
from .stored import LOST, Reference, applied, opened, reference_to
from .times import LATEST


@dataclass(frozen=True, slots=True)
class RecordedStream:
    """What was recorded of one path in one role; several channels if its type changed."""

    path: Path
    role: Role
    kind: Kind
    channels: list[int] = field(compare=False)


class _FoundDamage(Exception):
    """A part of the file turned out to be damaged and was left out: what needs it is to be found again."""


_UNKNOWN = object()
"""In the place of what was at a path before."""
_TOGETHER = 64
"""Changes that `batches` yields at once where each is made of the one before."""
_DAMAGED = object()
"""In the place of a value that cannot be read."""


class RecordedPast(Past[tuple[Ref, RecordedStream]]):
    """The contents of a recording. Positions of changes are log times, in ns."""

    def __init__(self, container: Files, ships: Ships) -> None:
        self._container = container
        self._ships = ships
        self.timeline = Timeline(cast("Container", container))  # or what has its methods
        self.unreadable = 0  # values that were left out, since they are damaged or were not recorded
        self._has_skipped = False
        by_place: dict[tuple[Path, str, str], RecordedStream] = {}
        self.of_channel: dict[int, RecordedStream] = {}
        # A path has several channels in one role if its type changed: for users they are one stream.
        others: dict[int, Channel] = {}  # of files that another program has written
        for file, channels in container.parts():
            places = {number: _place(channel.metadata) for number, channel in channels.items()}
            is_described = any(record.name == "reem" for record in file.metadata)
            if not is_described and not any(places.values()):
                others |= channels
                if not channels:
                    why = "what it holds is damaged" if file.damaged else "it holds nothing"
                    raise DamagedRecording(f"{file.path} is an MCAP file without a channel: {why}")
                file.damaged += any(info.end >= LATEST for info in file.every_chunk)  # a time of centuries ahead
                continue
            file.damaged += _missing(file, is_described)
            for number, place in places.items():
                if place is not None and number not in self.of_channel:
                    self.of_channel[number] = by_place.setdefault(place, RecordedStream(*place, []))
                    self.of_channel[number].channels.append(number)
        self.foreign = Foreign(container, others)
        for number, key in self.foreign.keys.items():
            place = (key,), Role.UPDATE, Kind.PUBLISHED
            self.of_channel[number] = by_place.setdefault(place, RecordedStream(*place, []))
            self.of_channel[number].channels.append(number)
        self.streams = list(by_place.values())
        self.names: dict[str, list[RecordedStream]] = {}
        self._parts: dict[Path, list[int]] = {}
        for stream in self.streams:
            # These say what is missing, not what was there.
            if stream.role not in (Role.GAP, Role.SKIP):
                self.names.setdefault(str(stream.path[0]), []).append(stream)
            if stream.role in (Role.PART, Role.UPDATE):
                self._parts.setdefault(stream.path, []).extend(stream.channels)

    def tree(self, path: Path, until: int) -> Any:
        """Return what was at a full path at an instant (ns), long arrays as `Reference`; or MISSING."""
        while True:
            # Each try that fails has taken a damaged chunk out, so this ends.
            with contextlib.suppress(_FoundDamage):
                return self.at(path, until)

    def _path(self, change: tuple[Ref, RecordedStream]) -> Path:
        return change[1].path

    def _value(self, change: tuple[Ref, RecordedStream]) -> Any:
        """Return the value of a message; a `Reference` for one that cannot be read, so that the rest can be.

        Raises _FoundDamage if it turned out to be damaged, and BadData if it is unreadable and had parts of its own.
        """
        ref, stream = change
        try:
            return self._load(ref, stream)
        except BadData:
            label = self._container.channels[ref.channel].metadata.get("reem.ship", "")
            if label in ("", "list"):  # it has places of its own: whether something was there is unknown
                raise
            return Reference(label, stream.path, ref.time, 0, label)

    def _anchor(self, path: Path) -> Path:
        return _anchor(path, self._streams_of(path))

    def _streams_of(self, path: Path) -> list[RecordedStream]:
        return self.names.get(str(path[0]), []) if path else []

    def _newest_whole(self, path: Path, until: int) -> tuple[int, tuple[Ref, RecordedStream]] | None:
        roles = (*NEWS, Role.KEYFRAME)
        bases = [it for it in self._streams_of(path) if it.role in roles and below(path, it.path)]
        newest = self.newest(bases, until, -1)
        return None if newest is None else (newest[0].time, newest)

    def _streams_inside(self, path: Path) -> list[RecordedStream]:
        # Roles that only repeat are left out here: they say nothing that is not in the updates.
        streams = self._streams_of(path)
        return [it for it in streams if it.role in NEWS and len(it.path) > len(path) and below(it.path, path)]

    def _has_moves(self, path: Path, after: int, until: int) -> bool:
        return any(it.role == Role.DELETE and isinstance(it.path[-1], int) for it in self._streams_inside(path))

    def _inner(self, path: Path, after: int, until: int) -> Iterable[tuple[Ref, RecordedStream]]:
        channels = [channel for stream in self._streams_inside(path) for channel in stream.channels]
        refs = itertools.chain.from_iterable(self._instants(channels, after, until))
        return [(ref, self.of_channel[ref.channel]) for ref in refs]

    def _inner_lasts(self, path: Path, after: int, until: int) -> Iterable[tuple[int, tuple[Ref, RecordedStream]]]:
        lasts = [self.newest([stream], until, after) for stream in self._streams_inside(path)]
        return [(it[0].time, it) for it in lasts if it is not None]

    def _applied(self, tree: Any, path: Path, change: tuple[Ref, RecordedStream], value: Any) -> Any:
        stream = change[1]
        return applied(opened(tree, path, self._list), path, stream.role, stream.kind, value)

    def _inside(self, tree: Any, path: Path) -> Any:
        return get(opened(tree, path, self._list), path)

    def _list(self, it: Reference) -> Any:
        """Return a long list; what stands for it, if it is damaged."""
        try:
            return self.value(it)
        except BadData:
            return it

    def newest(self, streams: Iterable[RecordedStream], until: int, after: int) -> tuple[Ref, RecordedStream] | None:
        best: tuple[Ref, RecordedStream] | None = None
        for stream in streams:
            # What is older than the best one so far is not even looked for.
            for channel in stream.channels:
                ref = self.timeline.latest(channel, until, best[0].time if best else after)
                if ref is not None:
                    best = ref, stream
        return best

    def _instants(self, channels: Iterable[int], after: int, until: int) -> Iterator[list[Ref]]:
        """Yield the messages of each instant: what was published comes before what a read found behind it."""
        for _, refs in itertools.groupby(self.timeline.between(channels, after, until), key=lambda ref: ref.time):
            yield sorted(refs, key=lambda ref: self.of_channel[ref.channel].kind != Kind.PUBLISHED)

    def _load(self, ref: Ref, stream: RecordedStream) -> Any:
        """Return the value of a message, MISSING for a deletion; raises _FoundDamage, BadData."""
        if stream.role == Role.DELETE:
            return MISSING
        if ref.channel in self.foreign.keys:
            found = self.foreign.tree(ref)
            if found is MISSING:
                raise _FoundDamage
            return found
        message = self._container.message(ref)
        if message is None:
            raise _FoundDamage
        channel = self._container.channels[ref.channel]
        if channel.message_encoding == "json":
            return from_json(message.data, wrapped="reem.wrapped" in channel.metadata)
        return self._stored(channel, ref.time, stream.path, message.data)

    def _readable(self, ref: Ref, stream: RecordedStream) -> Any:
        """Return the value of a message; _DAMAGED, and it is counted, if it cannot be read."""
        try:
            value = self._load(ref, stream)
        except (_FoundDamage, BadData):
            value = _DAMAGED
        # What another program has recorded, and cannot be decoded, is no part of any update.
        if value is _DAMAGED or (ref.channel in self.foreign.keys and type(value) is Reference and value.label == LOST):
            self.unreadable += 1
            self._has_skipped = True
            return _DAMAGED
        return value

    def _stored(self, channel: Channel, at: int, path: Path, data: bytes) -> Reference:
        """Return what stands for a value that is a message of its own and not a part of another."""
        label = channel.metadata.get("reem.ship", "")
        value = self._decoded(channel, data, self._ships.raw)
        known = label == "numpy" or isinstance(value, bytes | EncodedImage)
        return reference_to(label, path, at, value if known else data)

    def _decoded(self, channel: Channel, data: bytes, ships: Ships) -> Any:
        schema = self._container.schemas.get(channel.schema_id)
        label, channels = channel.metadata.get("reem.ship", ""), channel.metadata.get("reem.channels", "")
        return decode(schema.name if schema else "", channels, label, data, ships)

    def raw_value(self, it: Reference) -> Any:
        """Return what `value` does, but pictures as `Jpeg` and `Png`."""
        return self.value(it, self._ships.raw)

    def value(self, it: Reference, ships: Ships | None = None) -> Any:
        """Return the value that something stands for; raises DamagedRecording."""
        if it.label == LOST:
            raise DamagedRecording(f"{it.shown}: {it.summary}")
        if it.where is not None:
            value = self.foreign.value(it)
            if not isinstance(value, EncodedImage):
                return value
            return (ships or self._ships).labelled(it.label, it.shown).ship.interpret_read([value.data])
        found = self._message_of(it)
        if found is not None:
            return self._decoded(found[0], found[1].data, ships or self._ships)
        raise DamagedRecording(f"{it.shown}: {it.summary or it.label}, recorded at {it.at} ns, is damaged or missing")

    def _message_of(self, it: Reference) -> tuple[Channel, Message] | None:
        for number in self._parts.get(it.path, ()):
            ref = self.timeline.latest(number, it.at, it.at - 1)
            message, channel = None if ref is None else self._container.message(ref), self._container.channels[number]
            if message is not None and channel.message_encoding == "protobuf":
                return channel, message
        return None

    def encoded(self, it: Reference) -> EncodedMessage | None:
        """Return the message of a value as it is in the file; None if it is damaged."""
        found = self._message_of(it)
        if found is None:
            return None
        channel, message = found
        schema = self._container.schemas.get(channel.schema_id)
        return EncodedMessage(schema.name if schema else "", channel.metadata.get("reem.channels", ""), [message.data])

    def changed(self, name: str, until: int) -> int:
        """Return the log time of the last message on a key until an instant, -1 if there is none."""
        newest = self.newest(self.names.get(name, []), until, -1)
        return -1 if newest is None else newest[0].time

    def concerning(self, path: Path) -> list[RecordedStream]:
        """Return the streams with news on what is at, above or below a path."""
        streams = self.names.get(str(path[0]), []) if path else self.streams
        return [it for it in streams if it.role in NEWS and related(it.path, path)]

    def news_channels(self, path: Path) -> list[int]:
        return [channel for stream in self.concerning(path) for channel in stream.channels]

    def updates(self, after: int, until: int, patterns: Sequence[Pattern]) -> Iterator[tuple[Ref, RecordedStream, Any]]:
        """Yield all news that patterns name between two instants; what is damaged is skipped."""
        streams = [
            it for it in self.streams if it.role in NEWS and any(pattern.concerns(it.path) for pattern in patterns)
        ]
        channels = [channel for stream in streams for channel in stream.channels]
        for ref in itertools.chain.from_iterable(self._instants(channels, after, until)):
            stream = self.of_channel[ref.channel]
            value = self._readable(ref, stream)
            if value is not _DAMAGED:
                yield ref, stream, value

    def following(
        self, path: Path, after: int, until: int, last: Any = _UNKNOWN
    ) -> Iterator[tuple[list[Ref], bool, Any]]:
        """Yield the news on a full path of each instant, whether it only repeats, and what was there after it.

        `last` is what was there at first, if that is known. If a part of the file is damaged, keyframes are news too.
        """
        anchor, streams = self._anchor(path), self._streams_of(path)
        roles = (*NEWS, Role.KEYFRAME)
        chosen = [it for it in streams if it.role in roles and related(it.path, anchor)]
        tree = last
        if last is _UNKNOWN:
            tree, last = self.tree(anchor, after) if chosen and after >= 0 else MISSING, MISSING
        for refs in self._instants([each for it in chosen for each in it.channels], after, until):
            is_read, is_whole = False, True
            for ref in refs:
                stream = self.of_channel[ref.channel]
                # Keyframes repeat what is known, unless something is damaged: then they bring what is missing.
                if stream.role == Role.KEYFRAME and not (self._container.damaged or self._has_skipped):
                    continue
                value = self._readable(ref, stream)
                if value is _DAMAGED:
                    continue
                is_read, is_whole = True, is_whole and stream.role in (Role.STATE, Role.KEYFRAME)
                tree = self.after(tree, anchor, (ref, stream), value)
            if is_read:
                value = self._inside(tree, path[len(anchor) :])
                repeats = is_whole and value is not MISSING and last is not MISSING and same(value, last)
                last = value
                yield refs, repeats, value

    def changes(self, path: Path, after: int, until: int = 2**63 - 1) -> Iterator[tuple[int, Any]]:
        """Yield the instants (ns) of news on a full path, and what was there, MISSING if nothing was."""
        for ns, tree, _ in self.values(path, after, until):
            yield ns, tree

    def values(self, path: Path, after: int, until: int) -> Iterator[tuple[int, Any, bool]]:
        """Yield what `changes` does, and whether it is a plain value, without any `Reference`."""
        for times, trees, is_plain in self.batches(path, after, until):
            yield from zip(times, trees, itertools.repeat(is_plain))

    def batches(self, path: Path, after: int, until: int) -> Iterator[tuple[list[int], list[Any], bool]]:
        """Yield what `values` does, many at a time."""
        stopped = yield from self._written_whole(path, after, until)
        if stopped is None:
            return
        times: list[int] = []
        trees: list[Any] = []
        for refs, repeats, tree in self.following(path, stopped[0], until, stopped[1]):
            if not repeats:
                times.append(refs[0].time)
                trees.append(tree)
            if len(times) >= _TOGETHER:
                yield times, trees, False
                times, trees = [], []
        if times:
            yield times, trees, False

    def _written_whole(
        self, path: Path, after: int, until: int
    ) -> Generator[tuple[list[int], list[Any], bool], None, tuple[int, Any] | None]:
        """Yield what `batches` does, as long as each message has all that is at the path, and is sound.

        Most numbers are recorded so. A chunk is read at a time, and only what is at the path is made of a message.
        Returns the last instant, and what was there then, if something else follows; else None.
        """
        roles = (*NEWS, Role.KEYFRAME) if self._container.damaged or self._has_skipped else NEWS
        streams = [it for it in self._streams_of(path) if it.role in roles and related(it.path, path)]
        at, last = after, MISSING
        is_whole = self._anchor(path) == path and all(len(it.path) <= len(path) for it in streams)
        if not is_whole or any(channel in self.foreign.keys for it in streams for channel in it.channels):
            return after, _UNKNOWN
        readers = {channel: self._reader(channel, path) for it in streams for channel in it.channels}
        for batch in self.timeline.batches(readers, after, until):
            content = None if batch is None else self._container.content(batch.chunk)
            if batch is None or content is None:
                return at, last
            channel = int(batch.channels[0])
            reader, stream = readers[channel], self.of_channel[channel]
            if reader is not None and stream.role == Role.UPDATE and (batch.channels == channel).all():
                texts = messages_in(content, batch, self._container.numbers_in(batch.chunk, batch.channels))
                trees = None if texts is None else reader.read(texts)
                if trees is not None:
                    times = batch.times.tolist()
                    at, last = times[-1], trees[-1]
                    yield times, trees, True
                    continue
            rows = zip(batch.times.tolist(), batch.channels.tolist(), batch.offsets.tolist(), strict=True)
            is_sound, times, found = True, [], []
            for at, channel, offset in rows:
                stream = self.of_channel[channel]
                whole = self._readable(Ref(at, batch.chunk, offset, channel), stream)
                if whole is _DAMAGED:
                    is_sound = False
                    continue
                tree = self._inside(whole, path[len(stream.path) :])
                # See `following`.
                repeats = stream.role in (Role.STATE, Role.KEYFRAME) and tree is not MISSING and last is not MISSING
                repeats = repeats and same(tree, last)
                last = tree
                if not repeats:
                    times.append(at)
                    found.append(tree)
            if times:
                yield times, found, False
            if not is_sound:  # keyframes are news from now on
                return at, last
        return None

    def _reader(self, channel: int, path: Path) -> PathReader | None:
        """Return what reads a path in the messages of a channel; None if they are no JSON, or deletions."""
        stream, it = self.of_channel[channel], self._container.channels[channel]
        if it.message_encoding != "json" or stream.role == Role.DELETE:
            return None
        return PathReader(path[len(stream.path) :], wrapped="reem.wrapped" in it.metadata)

    def published_at(self, path: Path, ns: int) -> int:
        """Return when the news on a path of an instant was published (ns), or that instant if it was not."""
        streams = [it for it in self.concerning(path) if it.kind == Kind.PUBLISHED]
        newest = self.newest(streams, ns, ns - 1)
        return ns if newest is None else self.stamp(newest[0])[0] or ns

    def missed(self, ref: Ref) -> int | None:
        """Return how many updates were lost in a gap, None if their publisher's numbers did not tell."""
        message, missed = self._container.message(ref), None
        with contextlib.suppress(ValueError, TypeError, KeyError):
            missed = orjson.loads(message.data)["missed"] if message is not None else None
        return missed if type(missed) is int else None

    def of_role(self, role: Role) -> Iterator[tuple[Ref, RecordedStream]]:
        channels = [channel for channel, stream in self.of_channel.items() if stream.role == role]
        for ref in self.timeline.between(channels, -1, 2**63 - 1):
            yield ref, self.of_channel[ref.channel]

    def published(self, refs: Iterable[Ref]) -> int | None:
        """Return when the news of one instant was published (ns), on its publisher's clock; None if it was not."""
        published = (ref for ref in refs if self.of_channel[ref.channel].kind == Kind.PUBLISHED)
        return next((self.stamp(ref)[0] for ref in published), None)

    def stamp(self, ref: Ref) -> tuple[int, int]:
        """Return when a message was published (ns), and its number."""
        message = self._container.message(ref)
        return (message.publish_time, message.sequence) if message is not None else (0, 0)


def _listed(metadata: Iterable[Metadata], names: set[str | int]) -> Iterator[str]:
    """Yield the metadata of the channels that the recorder has listed for some top-level keys, as text.

    Other tools copy these lists as they are. So they say which channels there were, and nothing else.
    """
    for record in metadata:
        with contextlib.suppress(ValueError, KeyError, TypeError, IndexError):
            for row in orjson.loads(record.metadata["channels"]) if record.name == CHANNELS else ():
                place = _place(row[4])
                if place is not None and place[0][0] in names:
                    yield str(sorted(row[4].items()))


def _missing(file: Container, is_described: bool) -> int:
    """Return how many channels another tool has left out of keys that are still there.

    Without the channel of its deletions, for example, a key would seem to hold what was deleted.
    """
    channels = file.channels.values()
    if not is_described:  # nor are the notes on channels there; but each recording has topics of its own
        return int(not any(channel.topic.startswith("/_reem/") for channel in channels))
    places = [_place(channel.metadata) for channel in channels]
    listed = Counter(_listed(file.metadata, {place[0][0] for place in places if place is not None}))
    listed.subtract(str(sorted(channel.metadata.items())) for channel in channels)
    return sum(count for count in listed.values() if count > 0)


def _place(metadata: Mapping[str, str]) -> tuple[Path, Role, Kind] | None:
    """Return path, role and kind of a channel by its metadata; None if it is none of REEM's."""
    try:
        path = orjson.loads(metadata["reem.path"])
        role, kind = Role(metadata["reem.role"]), Kind(metadata["reem.kind"])
    except (KeyError, ValueError, TypeError):  # also what orjson raises, and a role of a later REEM
        return None
    if (
        type(path) is not list
        or not path
        or type(path[0]) is not str
        or not all(type(key) in (str, int) for key in path)
    ):
        return None
    return tuple(path), role, kind


def _anchor(path: Path, streams: Iterable[RecordedStream]) -> Path:
    """Return the part of `path` that never moves: up to an index from the end, or a list that lost an item."""
    lists = [it.path[:-1] for it in streams if it.role == Role.DELETE and isinstance(it.path[-1], int)]
    lists += [path[:place] for place, key in enumerate(path) if isinstance(key, int) and key < 0]
    return min([place for place in lists if len(place) < len(path) and below(path, place)], key=len, default=path)
