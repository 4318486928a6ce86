"""Notices: the messages that announce one update to the subscribers of a top-level key.

A line of JSON. For small updates the document text and the bytes of attachments follow, as they were sent to the
server: nothing is serialized twice, and a subscriber needs no round trip. Larger updates are only announced. Notices
that arrive are not trusted: anything unexpected is refused as `BadData`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import accumulate
from typing import Any, NamedTuple

import orjson

from ..errors import BadData, BadKey, BadType
from ..ships.registry import Ships
from . import Command
from .changes import EncodedAttachment
from .documents import nested_over
from .keys import Keys
from .paths import Path, check_element
from .placeholders import Unreadable, find, marked

VERSION = 1
LARGEST_INLINE = 1 << 14  # bytes of value up to which the notice carries it
_DEEPEST = 128  # levels of a document that servers accept; path and value together have no more
_LONGEST_PATH = 2048  # characters; paths are cached, and a foreign program may publish any number of them
_LONGEST_PUBLISHER = 64  # characters; publishers are kept in memory too
_MOST = 1 << 53  # no counter gets there, and every JSON parser has integers up to it
_LATEST = 253_402_300_800  # seconds from 1970 to the year 10000, the last that datetime has
_LARGEST = 1 << 18  # bytes of a notice: far more than LARGEST_INLINE bytes of value and the names of its arrays
ANNOUNCED = object()  # in the place of a value that must be fetched


class Notice(NamedTuple):
    publisher: str  # an id that is unique per interface
    sequence: int  # counts this publisher's updates of this top-level key, from 1
    time: float  # seconds since 1970 on the publisher's clock
    path: Path  # the place that was updated, below the top-level key
    deleted: bool
    value: Any  # the value, or ANNOUNCED
    size: int = 0  # bytes of the value, document text and arrays; 0 where only the server knows (arithmetic)
    slot: Slot | None = None  # the place of a large value in the publisher's shared memory, or None
    early: bool = False  # whether it arrived before the server had the update
    late: float = 0.0  # seconds between the publisher's call and its sending, if an outage was between them
    lease: int = 0  # the fencing number of the lease under which it was written; 0 without one
    arrived: float | None = None  # when it arrived, on the receiver's monotonic clock, where that is noted


class Extras(NamedTuple):
    """What only some notices have to say. A program of REEM ignores the extras that it does not know."""

    late: float = 0.0  # as in `Notice`
    lease: int = 0


NO_EXTRAS = Extras()

NOTE_KEPT = 60  # seconds for which the note of a last update is kept

View = Callable[["Slot", int], "memoryview | None"]
"""Returns so many bytes of a slot, read-only; None if the slot cannot be read."""


def published(keys: Keys, publisher: str, sequence: int, payload: bytes, *, everywhere: bool = False) -> list[Command]:
    """Return the commands that publish a notice and store the note that it was the last.

    A value that is read together with the note contains the updates up to this one. The note expires, since it is only
    needed until a reply with it has arrived. In a cluster a notice goes to subscribers of the key; with `everywhere`
    also to all nodes, for clients that find keys by pattern.
    """
    note: Command = ("SET", keys.last, note_of(publisher, sequence), "EX", str(NOTE_KEPT))
    notice: Command = (keys.publish, keys.channel, payload)
    return [note, ("PUBLISH", keys.channel, payload), notice] if everywhere else [note, notice]


def note_of(publisher: str, sequence: int) -> str:
    return f"{publisher} {sequence}"


def parsed_note(note: Any) -> tuple[str, int]:
    """Return publisher and number of a note as the server sent it; the number is 0 if it is none."""
    text = bytes(note).decode(errors="replace") if isinstance(note, bytes | bytearray) else ""
    publisher, _, sequence = text.partition(" ")
    return publisher, int(sequence) if sequence.isascii() and sequence.isdigit() and len(sequence) < 19 else 0


def notify_path(path: Path) -> Path:
    """Return the path to announce a change at: `path`, or its longest beginning that is not too long."""
    room = _LONGEST_PATH
    for depth, key in enumerate(path):
        if isinstance(key, str):
            room -= len(key)
            if room < 0:
                return path[:depth]
    return path


def announce(
    publisher: str,
    sequence: int,
    time: float,
    path: Path,
    *,
    deleted: bool = False,
    size: int = 0,
    extras: Extras = NO_EXTRAS,
) -> bytes:
    return _header(publisher, sequence, time, path, "delete" if deleted else "look", [], size, extras)


def in_slot(
    publisher: str,
    sequence: int,
    time: float,
    path: Path,
    slot: Slot,
    text: bytes,
    attachments: Sequence[EncodedAttachment],
    extras: Extras = NO_EXTRAS,
) -> bytes:
    """Return a notice with the slot of the value, which subscribers on other hosts ignore.

    It has no slot if it would be too long, because of thousands of arrays.
    """
    sizes = sizes_of_parts(text, attachments)
    size = sum(sizes)
    parts = [[*slot, sizes[0]], *named_parts(attachments, sizes)]
    notice = _header(publisher, sequence, time, path, "look", parts, size, extras)
    if len(notice) <= LARGEST_INLINE:
        return notice
    return announce(publisher, sequence, time, path, size=size, extras=extras)


def sizes_of_parts(text: bytes, attachments: Sequence[EncodedAttachment]) -> list[int]:
    """Return the bytes of each part in a slot: the text of the document, then each attachment."""
    if not attachments:  # most updates: without a generator
        return [len(text)]
    return [len(text), *(sum([len(piece) for piece in each.blob or ()]) for each in attachments)]


def named_parts(attachments: Sequence[EncodedAttachment], sizes: Sequence[int]) -> list[list[Any]]:
    """Return what the line of a message says of each attachment, given the sizes of all parts."""
    return [[each.label, each.suffix, size] for each, size in zip(attachments, sizes[1:], strict=True)]


def with_value(
    publisher: str,
    sequence: int,
    time: float,
    path: Path,
    text: bytes,
    attachments: Sequence[EncodedAttachment],
    extras: Extras = NO_EXTRAS,
    *,
    largest: int = LARGEST_INLINE,
) -> bytes:
    """Return a notice that carries the value if it has at most so many bytes and is made of bytes."""
    sizes = sizes_of_parts(text, attachments)
    if sum(sizes) > largest or any(each.blob is None for each in attachments):
        return announce(publisher, sequence, time, path, size=sum(sizes), extras=extras)
    parts = named_parts(attachments, sizes) if attachments else []
    blobs = [piece for each in attachments for piece in each.blob or ()]
    return b"".join([_header(publisher, sequence, time, path, "set", parts, len(text), extras), text, *blobs])


def _header(
    publisher: str,
    sequence: int,
    time: float,
    path: Path,
    kind: str,
    parts: list[Any],
    size: int,
    extras: Extras,
) -> bytes:
    fields: list[Any] = [VERSION, publisher, sequence, time, path, kind, size, parts]
    if extras is not NO_EXTRAS and (said := _said(extras)):
        fields.append(said)  # only then: earlier versions of REEM refuse a ninth field
    return orjson.dumps(fields) + b"\n"


@lru_cache(maxsize=16)
def _said(extras: Extras) -> dict[str, float]:
    return {name: value for name, value in extras._asdict().items() if value}


def decode(payload: bytes, ships: Ships, view: View | None = None) -> Notice:
    """Return the notice in `payload`, with a value in shared memory if there is a `view`.

    Raises BadData for what is not a notice of REEM, or of a version this program does not know.
    """
    if len(payload) > _LARGEST:
        raise BadData(f"a notice has {len(payload)} bytes, REEM's have at most {_LARGEST}; it was not written by REEM")
    end = payload.find(b"\n")
    try:
        version, publisher, sequence, time, path, kind, size, parts, *more = orjson.loads(payload[: max(end, 0)])
    except (orjson.JSONDecodeError, ValueError, TypeError):
        raise BadData(f"a notice begins with {payload[:60]!r}, which is not REEM's") from None
    _check(version, publisher, sequence, time, path, kind, size, parts)
    place, value, slot = _path(path), ANNOUNCED, None
    if kind == "set":
        value = _value(payload, end + 1, size, parts, ships, _DEEPEST - len(place))
        size = len(payload) - end - 1
    elif parts and kind == "look" and (found := named(parts[0])) is not None:
        slot, text_size = found
        if view is not None:
            value = _value_in(slot, text_size, parts[1:], view, ships, _DEEPEST - len(place))
    late, lease = _extras(more) if more else NO_EXTRAS
    return Notice(publisher, sequence, float(time), place, kind == "delete", value, size, slot, False, late, lease)


def _check(version: Any, publisher: Any, sequence: Any, time: Any, path: Any, kind: Any, size: Any, parts: Any) -> None:
    if version != VERSION:
        raise BadData(f"a notice has version {version!r:.40}; this program knows {VERSION}: update reem")
    sound = (
        type(publisher) is str
        and 0 < len(publisher) <= _LONGEST_PUBLISHER
        and type(sequence) is int
        and 0 < sequence < _MOST
        and type(time) in (int, float)
        and 0 <= time < _LATEST
        and type(path) is list
        and kind in ("set", "look", "delete")
        and type(size) is int
        and 0 <= size < _MOST
        and type(parts) is list
    )
    if not sound:
        raise BadData("a notice has fields of wrong types or out of range; it was not written by REEM")


def _extras(more: list[Any]) -> Extras:
    if len(more) == 1 and type(more[0]) is dict:
        late, lease = more[0].get("late", 0.0), more[0].get("lease", 0)
        if type(late) in (int, float) and 0 <= late < _LATEST and type(lease) is int and 0 <= lease < _MOST:
            return Extras(float(late), lease)
    raise BadData(f"a notice has the extra fields {more!r:.60}, which cannot be; it was not written by REEM")


def _path(path: list[Any]) -> Path:
    if not path:
        return ()
    try:
        return _sound_path(tuple(path))
    except (TypeError, BadType, BadKey):
        raise BadData(f"a notice has the path {path!r:.60}, which cannot be; it was not written by REEM") from None


@lru_cache(maxsize=4096)
def _sound_path(path: tuple[Any, ...]) -> Path:
    """Return `path` if a value can be there.

    Of equal paths, such as (1,) and (1.0,), only a sound one is cached, and is returned for the others too.
    """
    if len(path) >= _DEEPEST or sum([len(key) for key in path if type(key) is str]) > _LONGEST_PATH:
        raise BadKey("too long")
    for key in path:
        if type(key) not in (str, int) or check_element(key, ()) != key:
            raise BadType("neither a key nor an index")
    return path


def _value(payload: bytes, start: int, size: int, parts: list[Any], ships: Ships, deepest: int) -> Any:
    position, blobs = start + size, []
    try:
        for _, _, length in parts:
            blobs.append(payload[position : position + length])
            position += len(blobs[-1])
            if len(blobs[-1]) != length:
                raise BadData(f"array truncated: expected {length} bytes, got {len(blobs[-1])}")
        if position != len(payload):
            raise BadData("its parts have other sizes than it says")
        return _rebuilt(payload[start : start + size], parts, blobs, ships, deepest)
    except Exception as error:  # a ship may raise anything over foreign bytes
        raise BadData(f"a notice holds a value that cannot be rebuilt: {error!s:.200}") from None


def _value_in(slot: Slot, size: int, parts: list[Any], view: View, ships: Ships, deepest: int) -> Any:
    try:
        sizes = [size, *(length for _, _, length in parts)]
        if not all(type(length) is int and 0 <= length < _MOST for length in sizes):
            return ANNOUNCED
        begins = starts(sizes)
        content = view(slot, begins[-1])
        if content is None:
            return ANNOUNCED
        blobs = [content[start : start + length] for start, length in zip(begins[1:-1], sizes[1:], strict=True)]
        return _rebuilt(bytes(content[:size]), parts, blobs, ships, deepest)
    except Exception:  # the memory of another program; the server has the true value
        return ANNOUNCED


def _rebuilt(text: bytes, parts: list[Any], blobs: list[Any], ships: Ships, deepest: int) -> Any:
    """Return the tree with its attachments; raises anything over foreign bytes.

    It is ANNOUNCED if a ship has to be awaited, or reads in another way than the publisher's wrote.
    """
    replies: dict[tuple[str, str], Any] = {}
    for (label, suffix, _), blob in zip(parts, blobs, strict=True):
        if not ships.has(label):
            replies[label, suffix] = Unreadable(suffix.partition("~")[0], str(ships.lacks(label, "it")))
            continue
        ship = ships.labelled(label, "an update").blob
        if ship is None:
            return ANNOUNCED
        try:
            replies[label, suffix] = ship.unpack(blob)
        except BadData as error:
            if not ship.tolerated:
                raise
            replies[label, suffix] = Unreadable(suffix.partition("~")[0], str(error))
    return assembled(text, replies, deepest)


def assembled(text: bytes, attachments: Mapping[tuple[str, str], Any], deepest: int) -> Any:
    """Return the tree of a document of at most `deepest` levels, with its attachments, by label and suffix.

    Raises anything over foreign bytes.
    """
    holder = [orjson.loads(text)]
    if nested_over(text, holder[0], deepest):
        raise BadData(f"path and value are nested over {_DEEPEST} levels")
    for slot in find(holder, "a message: ") if marked(text) else ():
        slot.container[slot.key] = attachments[slot.placeholder.label, slot.placeholder.suffix]
    return holder[0]


_ALIGNED = 64
"""Bytes: each part of a slot begins at a multiple, as the data of an .npy file does; numpy is slow on odd addresses."""


class Slot(NamedTuple):
    host: str  # identifies the processes that can reach it: one user on one boot of a host or container
    process: int  # the publisher's process id
    descriptor: int  # its file descriptor of the memory
    inode: int  # the inode of that file: descriptors and process ids are reused
    number: int  # the slot's number, from 0
    stamp: int  # a random number that the slot has as long as it holds these bytes


def starts(sizes: Iterable[int]) -> list[int]:
    """Return the offsets of parts of these sizes in a slot, and the end of the last one."""
    sizes = list(sizes)
    begins = list(accumulate((-(-size // _ALIGNED) * _ALIGNED for size in sizes), initial=0))
    return [*begins[:-1], begins[-2] + sizes[-1]] if sizes else [0]


def named(words: Any) -> tuple[Slot, int] | None:
    """Return the slot that a notice names, and the bytes of the text in it; None if the words are not valid."""
    if type(words) is not list or len(words) != len(Slot._fields) + 1 or type(words[0]) is not str:
        return None
    numbers: Sequence[Any] = words[1:]
    if not all(type(number) is int and 0 <= number < _MOST for number in numbers):
        return None
    return Slot(*words[:-1]), words[-1]
