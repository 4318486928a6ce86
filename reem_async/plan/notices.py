"""Notices: what a publisher tells the subscribers of a top-level key about one update.

A line of JSON, then, for small updates, the document text and the ships' bytes as they were sent to
the server: nothing is serialized twice, and a subscriber needs no trip back. Larger updates are only
announced. What arrives is not trusted: anything unexpected is refused as `BadData`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import orjson

from ..errors import BadData
from ..ships.registry import Ships
from . import Command
from .keys import Keys
from .paths import Path
from .placeholders import find, marked
from .writes import Loaded

__all__ = ["LARGEST_INLINE", "Notice", "announce", "decode", "note_of", "parsed_note", "published", "with_value"]

VERSION = 1
LARGEST_INLINE = 1 << 14
"""Bytes of value up to which it travels in the notice."""

_DEEPEST = 128
_LONGEST_PATH = 2048
"""Characters; paths are kept for speed, and a stranger may publish any number of them."""

ANNOUNCED = object()
"""In place of a value that is to be fetched."""


class Notice(NamedTuple):
    """One update, as a subscriber got to know of it.

    Attributes:
        publisher: Who made it: an id that is unique per interface.
        sequence: Counts this publisher's updates of this top-level key, from 1.
        time: Seconds since 1970 on the publisher's clock.
        path: What was updated, below the top-level key.
        deleted: It was removed.
        value: The value, or ANNOUNCED.
        size: Bytes of the value, document text and arrays; 0 where only the server knows (arithmetic).
    """

    publisher: str
    sequence: int
    time: float
    path: Path
    deleted: bool
    value: Any
    size: int = 0


def published(keys: Keys, publisher: str, sequence: int, payload: bytes, *, everywhere: bool = False) -> list[Command]:
    """Return the commands that publish a notice, and note that it was the last.

    Of a snapshot that holds this note one can tell which notices it has: those up to this one. It
    expires, since it only matters while a snapshot is on its way. In a cluster a notice goes to those who
    know the key; `everywhere` it goes to all nodes besides, for those who look for keys.
    """
    noted: Command = ("SET", keys.last, note_of(publisher, sequence), "EX", "60")
    told: Command = (keys.publish, keys.channel, payload)
    return [noted, ("PUBLISH", keys.channel, payload), told] if everywhere else [noted, told]


def note_of(publisher: str, sequence: int) -> str:
    """Return what is noted of a key's last notice."""
    return f"{publisher} {sequence}"


def parsed_note(note: Any) -> tuple[str, int]:
    """Return publisher and number of a note as the server has it, or a number of 0 if it is none."""
    text = bytes(note).decode(errors="replace") if isinstance(note, bytes | bytearray) else ""
    publisher, _, sequence = text.partition(" ")
    return publisher, int(sequence) if sequence.isascii() and sequence.isdigit() and len(sequence) < 19 else 0


def announce(publisher: str, sequence: int, time: float, path: Path, *, deleted: bool = False, size: int = 0) -> bytes:
    """Return a notice without the value, which has `size` bytes."""
    return _header(publisher, sequence, time, path, "delete" if deleted else "look", [], size)


def with_value(publisher: str, sequence: int, time: float, path: Path, text: bytes, loaded: Sequence[Loaded]) -> bytes:
    """Return a notice with the value if it is small and made of bytes, else without."""
    size, travels = len(text), True
    for each in loaded:
        size += sum([len(piece) for piece in each.blob or ()])
        travels = travels and each.blob is not None
    if size > LARGEST_INLINE or not travels:
        return announce(publisher, sequence, time, path, size=size)
    parts: list[Any] = []
    blobs: list[bytes] = []
    for each in loaded:
        blobs.append(b"".join(each.blob or ()))
        parts.append([each.label, each.suffix, len(blobs[-1])])
    return b"".join([_header(publisher, sequence, time, path, "set", parts, len(text)), text, *blobs])


def _header(publisher: str, sequence: int, time: float, path: Path, kind: str, parts: list[Any], size: int) -> bytes:
    return orjson.dumps([VERSION, publisher, sequence, time, path, kind, size, parts]) + b"\n"


def decode(payload: bytes, ships: Ships) -> Notice:
    """Return the notice in `payload`.

    Raises:
        BadData: Not a notice of REEM, or one of a version this program does not know.
    """
    end = payload.find(b"\n")
    try:
        version, publisher, sequence, time, path, kind, size, parts = orjson.loads(payload[: max(end, 0)])
    except (orjson.JSONDecodeError, ValueError, TypeError):
        raise BadData(f"a notice begins with {payload[:60]!r}, which is not REEM's") from None
    _check(version, publisher, sequence, time, path, kind, size, parts)
    value: Any = ANNOUNCED
    if kind == "set":
        value = _value(payload, end + 1, size, parts, ships)
        size = len(payload) - end - 1
    return Notice(publisher, sequence, float(time), tuple(path), kind == "delete", value, size)


def _check(version: Any, publisher: Any, sequence: Any, time: Any, path: Any, kind: Any, size: Any, parts: Any) -> None:
    if version != VERSION:
        raise BadData(f"a notice has version {version!r}; this program knows {VERSION}: update reem")
    sound = (
        type(publisher) is str
        and type(sequence) is int
        and type(time) in (int, float)
        and type(path) is list
        and (not path or _is_path(path))
        and kind in ("set", "look", "delete")
        and type(size) is int
        and size >= 0
        and type(parts) is list
    )
    if not sound:
        raise BadData("a notice has fields of wrong types; it was not written by REEM")


def _is_path(path: list[Any]) -> bool:
    return (
        len(path) <= _DEEPEST
        and all(type(key) in (str, int) for key in path)
        and sum([len(key) for key in path if type(key) is str]) <= _LONGEST_PATH
    )


def _value(payload: bytes, start: int, size: int, parts: list[Any], ships: Ships) -> Any:
    """Return the value a notice carries: the tree, with what the ships make of their fields."""
    text, position = payload[start : start + size], start + size
    replies: dict[tuple[str, str], Any] = {}
    try:
        for label, suffix, length in parts:
            blob = payload[position : position + length]
            position += length
            replies[label, suffix] = ships.labelled(label, "an update").ship.interpret_read([blob])
        holder = [orjson.loads(text)]
        for crate in find(holder, "a notice: ") if marked(text) else ():
            crate.container[crate.key] = replies[crate.placeholder.label, crate.placeholder.suffix]
    except Exception as error:  # a ship may raise anything over bytes that are not its own
        raise BadData(f"a notice holds a value that cannot be rebuilt: {error}") from None
    return holder[0]
