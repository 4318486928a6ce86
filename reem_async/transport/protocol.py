"""The protocol of servers: commands to bytes, bytes to replies.

hiredis packs small commands fastest but copies every argument several times; a large buffer (an array's memory) is
sent as it is, between a header and a line end. A word that is a tuple is one argument in several pieces.

hiredis copies every byte that arrives twice, too. For an array of 8 MB that takes longer than the network. So
`LargeReader` has the socket write a large string straight into the memory that becomes the reply. For small replies it
is several times slower.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import hiredis
import redis.exceptions
from redis._parsers import BaseParser
from redis.commands.core import (
    BasicKeyCommands,
    GeoCommands,
    HashCommands,
    HyperlogCommands,
    ListCommands,
    SetCommands,
    SortedSetCommands,
    StreamCommands,
)
from redis.connection import HiredisRespSerializer

from ..errors import ClusterNode
from ..plan import Command, Reply
from ..plan.replies import refusal
from ..plan.sizes import LARGE, has_large
from ..ships.numpy import flat_buffer

Piece = bytes | memoryview

SLOW = 1 << 13  # bytes that may take longer on a slow link than a call has: as long as they move, it is not given up


def pack(commands: Sequence[Command]) -> list[Piece]:
    """Return the bytes of `commands`, small ones joined, large buffers as they are."""
    # The hot path: one join for all commands of a small call.
    if not has_large(commands):
        return [_joined(commands)]
    pieces: list[Piece] = []
    small: list[bytes] = []
    for command in commands:
        if has_large((command,)):
            _pack_large(command, pieces, small)
        else:
            small.append(_joined((command,)))
    if small:
        pieces.append(b"".join(small))
    return pieces


def as_text(word: Any) -> Any:
    """Return a word as it is sent; numbers as text: hiredis crashes if a signal's handler raises as it formats one."""
    return str(word) if isinstance(word, int | float) else word


class Packer(HiredisRespSerializer):
    """redis-py's way of packing what it sends itself, with numbers as text, such as that of the protocol in HELLO."""

    def pack(self, *words: Any) -> Any:
        return super().pack(*map(as_text, words))


def _joined(commands: Sequence[Command]) -> bytes:
    try:
        return b"".join(map(hiredis.pack_command, commands))
    except TypeError:  # an argument in several pieces
        return b"".join([hiredis.pack_command(tuple(map(_whole, command))) for command in commands])


def _whole(word: Any) -> Any:
    return b"".join(word) if type(word) is tuple else word


def _pack_large(command: Command, pieces: list[Piece], small: list[bytes]) -> None:
    """Append `command`, ending the run of small bytes before each large buffer."""
    small.append(b"*%d\r\n" % len(command))
    for word in command:
        parts = tuple(map(_encoded, word)) if type(word) is tuple else (_encoded(word),)
        small.append(b"$%d\r\n" % sum(map(len, parts)))
        for part in parts:
            if len(part) >= LARGE:
                pieces.append(b"".join(small))
                pieces.append(part)
                small.clear()
            else:
                small.append(bytes(part))
        small.append(b"\r\n")


def _encoded(word: Any) -> Piece:
    if isinstance(word, bytes):
        return word
    if isinstance(word, memoryview):
        # len() of any other view is not its size, and what follows would be read as commands.
        if word.ndim != 1 or word.itemsize != 1 or len(word) != word.nbytes:
            raise TypeError("an outgoing buffer must be flat bytes")
        return word
    return str(word).encode()


class CommandRecorder(
    BasicKeyCommands,
    HashCommands,
    ListCommands,
    SetCommands,
    SortedSetCommands,
    StreamCommands,
    GeoCommands,
    HyperlogCommands,
):
    """Offers redis-py's methods (`hset`, `set`, `rpush`, ...) and keeps their commands in `commands`."""

    def __init__(self) -> None:
        self.commands: list[Command] = []

    def execute_command(self, *words: Any, **_: Any) -> CommandRecorder:
        # Arrays stay views of their memory, not copies: they are sent from there.
        self.commands.append(tuple([flat_buffer(as_text(word)) for word in words]))
        return self


NOT_THE_PROTOCOL = (redis.exceptions.InvalidResponse, MemoryError, OverflowError, TypeError, ValueError)
"""What parsers raise over bytes that no server sends: keys of a map that are lists, counts beyond all memory, ..."""

MORE: Any = object()  # what a parser says when it needs more bytes; False and None are replies
LARGEST = 1 << 29
"""Bytes a string in a reply may have unless a user says otherwise: a server takes no larger ones, as it comes."""
_IN_ALL = 8  # how many times as much a whole reply may have: the arrays of a document come together
# Bytes that are received at once, and from which a string is received in place.
_BUFFER = 1 << 17
_LARGE = 1 << 15
_STEP = 1 << 24  # how much more memory a string may be given than has arrived of it: its length is only a claim
# Levels of lists in lists, and elements of one list. No reply to REEM's commands comes near.
_DEEPEST = 128
_MOST_ELEMENTS = 1 << 24
_LONG, _DIGITS = 8, b"0123456789"
"""A reply such as `$12345678` has a digit at this place if it announces ten million bytes or elements, or more."""
_MUCH = 1 << 24  # bytes after which is asked, again and again, how many of them wait for the end of one string
_BULK = b"$="


def error_of(text: str) -> Exception:
    try:
        return refusal(text) or _parse_error(text)
    except Exception:  # redis-py takes the places in MOVED and ASK apart and trusts them to be whole
        return ClusterNode(f"the server is a node of a Redis Cluster and names none that has this key: {text:.120}")


_parse_error: Any = BaseParser.parse_error


class SmallReader:
    def __init__(self, largest: int = LARGEST) -> None:
        self.fed = 0  # bytes received of the reply that is under way; to be set to 0 when a reply is taken
        self._largest, self._in_all, self._look_at = largest, largest * _IN_ALL, _MUCH
        self._parser = hiredis.Reader(
            protocolError=redis.exceptions.InvalidResponse, replyError=error_of, notEnoughData=MORE
        )
        self._buffer = bytearray(_BUFFER)
        self._view = memoryview(self._buffer)
        # Bound once: they are called for each reply.
        self._feed: Any = self._parser.feed
        self._has_data: Any = self._parser.has_data
        # Returns the next reply, or MORE; raises redis.exceptions.InvalidResponse for what is not the protocol.
        self.gets = self._parser.gets

    def target(self) -> memoryview:
        return self._view

    def received(self, count: int) -> None:
        """Parse `count` bytes put there; raises redis.exceptions.InvalidResponse if the reply is too large."""
        self.fed += count
        if self.fed == count:
            self._look_at = _MUCH
        # A reply may begin here, with a long number: the parser holds no unfinished one.
        if self._buffer[_LONG] in _DIGITS and not self._has_data():
            _check_announced(bytes(self._view[:32]), self._largest)
        self._feed(self._buffer, 0, count)
        if self.fed > self._look_at:  # of a string, hiredis keeps all until it is whole
            self._look_at = self.fed + _MUCH
            _check_size(self._parser.len() - _BUFFER, self._largest)
            _check_size(self.fed - _BUFFER, self._in_all)


def _check_announced(start: bytes, largest: int) -> None:
    """Refuse a reply that says at its start that it is too large. What cannot be read is the parser's to refuse."""
    line, end, _ = start[1:].partition(b"\r\n")
    if not end or not line.isdigit():
        return
    if start[0] in _BULK:
        _check_size(int(line), largest)
    elif start[0] in b"*~>%":
        _check_elements(int(line))


def _check_size(size: int, limit: int) -> None:
    if size > limit:
        raise redis.exceptions.InvalidResponse(
            f"a reply, or a string in it, of {size} bytes or more, where {limit} is the limit "
            "(for a string, the option largest_value sets it; in a URL: ?largest_value=BYTES)"
        )


def _check_elements(count: int) -> None:
    if count > _MOST_ELEMENTS:
        raise redis.exceptions.InvalidResponse(f"a list of {count} elements, where {_MOST_ELEMENTS} is the limit")


class _Open:
    __slots__ = ("items", "kind", "left")

    def __init__(self, kind: int, left: int) -> None:
        self.kind = kind
        self.left = left
        self.items: list[Any] = []


class LargeReader:
    """The Redis protocol, version 3; strings over 32 KB are received in place and come as bytearrays."""

    def __init__(self, largest: int = LARGEST) -> None:
        self.fed = 0
        self._largest, self._in_all = largest, largest * _IN_ALL
        self._buffer = bytearray(_BUFFER)
        self._view = memoryview(self._buffer)
        self._start = self._end = 0
        self._open: list[_Open] = []
        # A large string that is being received: `_filled` of its `_size` bytes are there, the line end behind it is
        # not.
        self._large: bytearray | None = None
        self._size = 0
        self._filled = 0

    def target(self) -> memoryview:
        if self._large is not None and self._filled < self._size:
            # It grows as bytes arrive, doubling, so that a length that is only claimed costs no memory.
            if self._filled == len(self._large):
                self._large.extend(bytes(min(self._size - self._filled, max(_STEP, self._filled))))
            return memoryview(self._large)[self._filled :]
        if self._start == self._end:
            self._start = self._end = 0
        # Little room is left behind what is not parsed yet: that moves to the front.
        elif self._end > _BUFFER - _LARGE - 1024:
            rest = self._end - self._start
            self._view[:rest] = bytes(self._view[self._start : self._end])
            self._start, self._end = 0, rest
        return self._view[self._end :]

    def received(self, count: int) -> None:
        self.fed += count
        if self.fed > self._in_all:
            _check_size(self.fed - _BUFFER, self._in_all)
        if self._large is not None and self._filled < self._size:
            self._filled += count
        else:
            self._end += count

    def gets(self) -> Reply:
        while True:
            value = self._element()
            if value is MORE or type(value) is _Open:
                if value is MORE:
                    return MORE
                # An aggregate with elements to come. An empty one is complete at once.
                if value.left:
                    self._open.append(value)
                    if len(self._open) > _DEEPEST:
                        raise redis.exceptions.InvalidResponse("lists in lists in lists")
                    continue
                value = _closed(value)
            while self._open:
                parent = self._open[-1]
                parent.items.append(value)
                parent.left -= 1
                if parent.left:
                    break
                value = _closed(self._open.pop())
            else:
                return value

    def _element(self) -> Any:
        """Return the next scalar, an aggregate that was opened, or MORE."""
        if self._large is not None:
            return self._end_of_large()
        stop = self._buffer.find(b"\r\n", self._start, self._end)
        if stop < 0:
            if self._end - self._start > _LARGE:
                raise redis.exceptions.InvalidResponse("a line is too long")
            return MORE
        kind, text, after = self._buffer[self._start], bytes(self._view[self._start + 1 : stop]), stop + 2
        try:
            if kind in b"$=":
                return self._string(None if text == b"-1" else _count(text), after)
            self._start = after
            if kind in b"*%~>":
                return None if text == b"-1" else _Open(kind, _elements(text) * (2 if kind == 0x25 else 1))
            return _SCALARS[kind](text)
        except (KeyError, ValueError) as error:
            raise redis.exceptions.InvalidResponse(f"{bytes([kind])!r}{text[:40]!r}: {error}") from None

    def _string(self, size: int | None, after: int) -> Any:
        if size is None:
            self._start = after
            return None
        _check_size(size, self._largest)
        here = self._end - after
        # All of it is in the buffer already: most strings are small.
        if here >= size + 2:
            self._start = after + size + 2
            return bytes(self._view[after : after + size])
        if size < _LARGE:
            return MORE  # the line is parsed again when all of it is there
        self._large, self._size, self._filled = bytearray(min(size, _STEP)), size, min(here, size)
        self._large[: self._filled] = self._view[after : after + self._filled]
        self._start = after + self._filled
        return self._end_of_large()

    def _end_of_large(self) -> Any:
        """Return the large string if it and the line end after it are here."""
        assert self._large is not None
        if self._filled < self._size or self._end - self._start < 2:
            return MORE
        self._start += 2
        value, self._large = self._large, None
        return value


ReplyReader = SmallReader | LargeReader


def _count(text: bytes) -> int:
    count = int(text)
    if count < 0:
        raise ValueError("a negative length")
    return count


def _elements(text: bytes) -> int:
    count = _count(text)
    _check_elements(count)
    return count


def _closed(it: _Open) -> Any:
    if it.kind == 0x25:  # a map
        pairs = iter(it.items)
        return dict(zip(pairs, pairs, strict=True))
    return hiredis.PushNotification(it.items) if it.kind == 0x3E else it.items


_SCALARS: dict[int, Any] = {
    ord("+"): bytes,
    ord("-"): lambda text: error_of(text.decode(errors="replace")),
    ord(":"): int,
    ord("_"): lambda _: None,
    ord("#"): lambda text: text == b"t",
    ord(","): float,
    ord("("): int,
}
