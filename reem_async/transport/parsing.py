"""Parsers of what the server sends: hiredis for small replies, our own where large ones are due.

hiredis copies every byte twice: into its buffer and into the reply. For an array of 8 MB that takes
longer than the network. `LargeReader` has the socket write a large string straight into the memory
that becomes the reply; for small replies it is several times slower than hiredis.
"""

from __future__ import annotations

from typing import Any, Protocol

import hiredis
import redis.exceptions
from redis._parsers import BaseParser

from ..plan import Reply
from ..plan.replies import refusal

__all__ = ["MORE", "NOT_THE_PROTOCOL", "LargeReader", "Reader", "SmallReader"]

NOT_THE_PROTOCOL = (redis.exceptions.InvalidResponse, MemoryError, OverflowError, TypeError, ValueError)
"""What parsers raise over bytes that no server sends: keys of a map that are lists, counts beyond all memory, ..."""

MORE: Any = object()
"""What a parser says when it needs more bytes; False and None are replies."""

_BUFFER = 1 << 17
_LARGE = 1 << 15
_STEP = 1 << 24
"""How much more memory a string may be given than has arrived of it: its length is only a claim."""
_DEEPEST = 128


def _error(text: str) -> Exception:
    """Return the exception that an error reply stands for."""
    try:
        return refusal(text) or _parse_error(text)
    except Exception:  # redis-py takes some texts apart and trusts them to be whole
        return redis.exceptions.ResponseError(text)


_parse_error: Any = BaseParser.parse_error


class Reader(Protocol):
    """A parser that says where it wants the next bytes."""

    def target(self) -> memoryview:
        """Return where to put received bytes."""
        ...

    def received(self, count: int) -> None:
        """Take note of `count` bytes put there."""
        ...

    def gets(self) -> Reply:
        """Return the next reply, or MORE.

        Raises:
            redis.exceptions.InvalidResponse: The bytes are not the Redis protocol.
        """
        ...


class SmallReader:
    """hiredis, handing out error replies as redis-py's exceptions."""

    def __init__(self) -> None:
        self._parser = hiredis.Reader(
            protocolError=redis.exceptions.InvalidResponse, replyError=_error, notEnoughData=MORE
        )
        self._buffer = bytearray(_BUFFER)
        self._view = memoryview(self._buffer)
        self._feed: Any = self._parser.feed
        self.gets = self._parser.gets

    def target(self) -> memoryview:
        """Return where to put received bytes."""
        return self._view

    def received(self, count: int) -> None:
        """Parse `count` bytes."""
        self._feed(self._buffer, 0, count)


class _Open:
    """An aggregate whose elements are being received."""

    __slots__ = ("items", "kind", "left")

    def __init__(self, kind: int, left: int) -> None:
        self.kind = kind
        self.left = left
        self.items: list[Any] = []


class LargeReader:
    """The Redis protocol, version 3; strings over 32 KB are received in place and come as bytearrays."""

    def __init__(self) -> None:
        self._buffer = bytearray(_BUFFER)
        self._view = memoryview(self._buffer)
        self._start = self._end = 0
        self._open: list[_Open] = []
        self._large: bytearray | None = None
        self._size = 0
        self._filled = 0

    def target(self) -> memoryview:
        """Return where to put received bytes."""
        if self._large is not None and self._filled < self._size:
            if self._filled == len(self._large):
                self._large.extend(bytes(min(self._size - self._filled, max(_STEP, self._filled))))
            return memoryview(self._large)[self._filled :]
        if self._start == self._end:
            self._start = self._end = 0
        elif self._end > _BUFFER - _LARGE - 1024:
            rest = self._end - self._start
            self._view[:rest] = bytes(self._view[self._start : self._end])
            self._start, self._end = 0, rest
        return self._view[self._end :]

    def received(self, count: int) -> None:
        """Take note of `count` bytes put where `target` said."""
        if self._large is not None and self._filled < self._size:
            self._filled += count
        else:
            self._end += count

    def gets(self) -> Reply:
        """Return the next reply, or MORE."""
        while True:
            value = self._element()
            if value is MORE or type(value) is _Open:
                if value is MORE:
                    return MORE
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
                return None if text == b"-1" else _Open(kind, _count(text) * (2 if kind == 0x25 else 1))
            return _SCALARS[kind](text)
        except (KeyError, ValueError) as error:
            raise redis.exceptions.InvalidResponse(f"{bytes([kind])!r}{text[:40]!r}: {error}") from None

    def _string(self, size: int | None, after: int) -> Any:
        if size is None:
            self._start = after
            return None
        here = self._end - after
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


def _count(text: bytes) -> int:
    count = int(text)
    if count < 0:
        raise ValueError("a negative length")
    return count


def _closed(it: _Open) -> Any:
    if it.kind == 0x25:  # a map
        pairs = iter(it.items)
        return dict(zip(pairs, pairs, strict=True))
    return hiredis.PushNotification(it.items) if it.kind == 0x3E else it.items


_SCALARS: dict[int, Any] = {
    ord("+"): bytes,
    ord("-"): lambda text: _error(text.decode(errors="replace")),
    ord(":"): int,
    ord("_"): lambda _: None,
    ord("#"): lambda text: text == b"t",
    ord(","): float,
    ord("("): int,
}
