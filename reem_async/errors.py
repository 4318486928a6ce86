"""Every error REEM raises, by whose fault it is.

    ReemError
    +-- BadInput                 the value or path given; nothing was sent
    |   +-- BadValue             also ValueError: NaN, an integer out of range, ...
    |   +-- BadType              also TypeError: a set, an object array, ...
    |   +-- BadKey               also ValueError: a key that cannot be stored or addressed
    |   +-- TooDeep              also ValueError: nested over 100 levels, or in a circle
    +-- Misuse                   also RuntimeError: used in a way that cannot work
    |   +-- InterfaceClosed
    |   +-- WrongLoop            an interface used in two event loops, or a blocking call on REEM's own
    |   +-- WriteOnly            also NotImplementedError: reading a PublishSpace
    |   +-- ReadOnly             also NotImplementedError: writing to a subscriber
    +-- MissingKey               also KeyError: nothing is stored there
    +-- PathRefused              also KeyError: the parent is missing or cannot hold the element
    +-- Overflow                 also OverflowError: arithmetic left the range; put back
    +-- Conflict                 somebody else changed what was being edited; nothing written
    +-- QueueFull                a subscriber with the policy Every fell too far behind
    +-- BadData                  what the server sent is not what REEM writes; nothing trusted
    +-- ServerMissing            extra `server` not installed, or no usable server binary
    +-- ServerFailed             an embedded server did not start: port taken, ...

Errors that come from the server or from the connection stay `redis.exceptions.RedisError`:

    redis.exceptions.RedisError
    +-- ConnectionLost           (ReemError, redis ConnectionError) broken before the reply: outcome unknown
    +-- NotConnected             (ReemError, redis ConnectionError) nobody listening: nothing was applied
    +-- NoJsonSupport            (ReemError, redis ResponseError) the server lacks RedisJSON
    +-- WrongKind                (ReemError, redis ResponseError) a foreign Redis type is under that key
    +-- PartialWrite             (ReemError, redis ResponseError) the server refused a part; says which
"""

from __future__ import annotations

import redis.exceptions
from redis.exceptions import RedisError as RedisError

__all__ = [
    "BadData",
    "BadInput",
    "BadKey",
    "BadType",
    "BadValue",
    "Conflict",
    "ConnectionLost",
    "InterfaceClosed",
    "MissingKey",
    "Misuse",
    "NoJsonSupport",
    "NotConnected",
    "Overflow",
    "PartialWrite",
    "PathRefused",
    "QueueFull",
    "ReadOnly",
    "ReemError",
    "ServerFailed",
    "ServerMissing",
    "TooDeep",
    "WriteOnly",
    "WrongKind",
    "WrongLoop",
]


class ReemError(Exception):
    """Root of everything REEM raises by itself."""


class BadInput(ReemError):
    """The value or the path given cannot be stored; nothing was sent."""


class BadValue(BadInput, ValueError):
    """A value of a right type that cannot be stored, such as NaN in a document."""


class BadType(BadInput, TypeError):
    """A value of a type that cannot be stored and that no ship takes."""


class BadKey(BadInput, ValueError):
    """A key that cannot be stored, or that the server's paths cannot address."""


class TooDeep(BadInput, ValueError):
    """A value nested over 100 levels, or one that contains itself."""


class Misuse(ReemError, RuntimeError):
    """A call that cannot work in this place or state."""


class InterfaceClosed(Misuse):
    """The interface or subscriber was closed before this call."""


class WrongLoop(Misuse):
    """One interface in two event loops, or a blocking call on REEM's own loop thread."""


class WriteOnly(Misuse, NotImplementedError):
    """A PublishSpace was read; it can only be written."""


class ReadOnly(Misuse, NotImplementedError, TypeError):
    """A subscriber's local copy was written; it only follows the server."""


class MissingKey(ReemError, KeyError):
    """Nothing is stored at the path."""

    def __str__(self) -> str:  # KeyError would show the message in quotes
        return str(self.args[0]) if self.args else ""


class PathRefused(ReemError, KeyError):
    """The parent of a written path is missing, or is a scalar, or the index is out of range."""

    def __str__(self) -> str:
        return str(self.args[0]) if self.args else ""


class Overflow(ReemError, OverflowError):
    """Arithmetic on the server left the range of its numbers; the old value is back."""


class Conflict(ReemError):
    """Somebody else changed the value between reading and writing back; nothing was written."""


class QueueFull(ReemError):
    """A subscriber that asked for every update fell further behind than its bound."""


class BadData(ReemError, ValueError):
    """The server holds or sent something that REEM does not write; it was not trusted."""


class ServerMissing(ReemError):
    """No usable server program: the extra `server` is not installed and none is on PATH."""


class ServerFailed(ReemError):
    """The embedded server did not come up; the message holds its last words."""


class ConnectionLost(ReemError, redis.exceptions.ConnectionError):
    """The connection broke before the reply came: applied once or not at all, never twice."""


class NotConnected(ReemError, redis.exceptions.ConnectionError):
    """No connection could be made; nothing was applied."""


class NoJsonSupport(ReemError, redis.exceptions.ResponseError):
    """The server answers, but has no RedisJSON."""


class WrongKind(ReemError, redis.exceptions.ResponseError):
    """The key holds a Redis type that is not REEM's.

    Attributes:
        key: The key on the server.
        where: The path that was meant.
    """

    def __init__(self, key: str, where: str, kind: str = "another type") -> None:
        super().__init__(
            f"{where}: the Redis key {key!r} holds a value of type {kind} (a program without REEM wrote it), "
            "not a document; choose another name, or remove that key"
        )
        self.key = key
        self.where = where


class PartialWrite(ReemError, redis.exceptions.ResponseError):
    """The server refused a part of a transaction; the message names what was applied."""
