"""Every error REEM raises; docs/reference/errors.md lists them with causes and cures.

Those that are also redis-py's ResponseError are what the server itself answered in REEM 0.0 and 0.1, whose programs
catch them by that name. Errors that come from the server or from the connection stay `redis.exceptions.RedisError`.
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
    "Busy",
    "CallTimeout",
    "ClusterNode",
    "Conflict",
    "ConnectionLost",
    "Contended",
    "InsecureConnection",
    "InterfaceClosed",
    "LeaseLost",
    "LoginRefused",
    "MissingDocument",
    "MissingKey",
    "MissingTop",
    "Misuse",
    "NoJsonSupport",
    "NoService",
    "NotAllowed",
    "NotConnected",
    "NotFinite",
    "Overflow",
    "Owned",
    "PartialWrite",
    "PathRefused",
    "QueueFull",
    "ReadOnly",
    "ReemError",
    "Refused",
    "RemoteError",
    "ServerFailed",
    "ServerFull",
    "ServerMissing",
    "ServerNotReady",
    "ServerReadOnly",
    "ServiceError",
    "ServiceLost",
    "Silent",
    "Stale",
    "TlsRefused",
    "TooDeep",
    "TooLarge",
    "WriteOnly",
    "WrongKind",
    "WrongLoop",
    "WrongType",
]


ClusterReply = (
    redis.exceptions.AskError  # MovedError is one of them
    | redis.exceptions.ClusterCrossSlotError
    | redis.exceptions.ClusterDownError
    | redis.exceptions.TryAgainError
)
"""Errors of a cluster's nodes: the transport to a cluster follows them, any other raises `ClusterNode`."""


class ReemError(Exception):
    """Base of all errors of REEM."""

    def __str__(self) -> str:  # KeyError would show the message in quotes
        return str(self.args[0]) if self.args else ""

    def __repr__(self) -> str:  # redis-py's errors leave the message out
        return Exception.__repr__(self)


class BadInput(ReemError):
    """The value or the path given cannot be stored; nothing was sent."""


class BadValue(BadInput, ValueError):
    """A value of a right type that cannot be stored, such as NaN in a document."""


class NotFinite(BadValue, redis.exceptions.ResponseError):
    """NaN or infinity in a document: JSON has no such numbers; arrays keep them."""


class BadType(BadInput, TypeError):
    """A value of a type that cannot be stored and that no ship takes."""


class WrongType(BadType, redis.exceptions.ResponseError):
    """What is stored at the path is of another type than the call works on, such as `append` to a dict."""


class BadKey(BadInput, ValueError):
    """A key that cannot be stored, or that the server's paths cannot address."""


class TooDeep(BadInput, ValueError, redis.exceptions.ResponseError):
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


class MissingKey(ReemError, KeyError, redis.exceptions.ResponseError):
    """Nothing is stored at the path."""


class MissingDocument(MissingKey):
    """Even the top-level key is missing: `read` returns None; other calls raise this as MissingKey."""


class PathRefused(ReemError, KeyError, redis.exceptions.ResponseError):
    """The parent of a written path is missing, or is a scalar, or the index is out of range."""


class MissingTop(PathRefused):
    """There is no top-level key to write into; a single array makes one."""


class Overflow(ReemError, OverflowError, redis.exceptions.ResponseError):
    """Arithmetic on the server left the range of its numbers; the old value is back."""


class Conflict(ReemError):
    """Another client changed the value between reading and writing back; nothing was written.

    Or other clients kept writing to the same top-level key until the call timed out; nothing was applied.
    """


class Contended(Conflict):
    """Other clients kept writing to the same top-level key: an immediate retry will probably fail again."""


class Owned(ReemError):
    """Another program owns the top-level key, so this one cannot own it.

    Attributes:
        name: What the owner calls itself; empty if the lease was not written by REEM.
        host: The owner's host.
        process: Its process id there.
        since: Seconds since it acquired the key, by the server's clock; None if this is not known.
    """

    def __init__(self, message: str, name: str = "", host: str = "", process: int = 0, since: float | None = None):
        super().__init__(message)
        self.name, self.host, self.process, self.since = name, host, process, since


class LeaseLost(ReemError):
    """This program does not own the top-level key any more; nothing was written. Acquire it again to go on."""


class QueueFull(ReemError):
    """A subscriber that asked for every update fell further behind than its bound."""


class Stale(ReemError):
    """A mirror does not answer: its connection is down, or its copy is older than `max_age` allows."""


class Silent(Stale):
    """A mirror does not answer: no published update has arrived for as long as its `ttl` allows."""


class ServiceError(ReemError):
    """A call of a service got no answer."""


class NoService(ServiceError):
    """No program serves it; nothing was begun."""


class Busy(ServiceError):
    """Every server of the service has as many requests waiting as its `queue` allows; nothing was begun."""


class CallTimeout(ServiceError, TimeoutError):
    """No answer came within the timeout; the request may or may not have been handled."""


class ServiceLost(ServiceError):
    """The server that had the request ended, stopped serving, or does not answer any more.

    The request may or may not have been handled. It is not sent to another server.
    """


class RemoteError(ServiceError):
    """The function of the service raised an exception, or returned what cannot be stored.

    Attributes:
        type_name: The name of the exception's class.
        message: Its text.
        traceback: The traceback in the server's program, as text; Python shows it below this error.
    """

    def __init__(self, where: str, type_name: str, message: str, traceback: str) -> None:
        super().__init__(f"{where}: the service raised {type_name}: {message}")
        self.type_name = type_name
        self.message = message
        self.traceback = traceback
        self._where = where
        self.add_note(f"In the server's program:\n{traceback.rstrip()}")

    def __reduce__(self) -> tuple[object, ...]:
        return RemoteError, (self._where, self.type_name, self.message, self.traceback)


class TooLarge(ReemError):
    """The key of another program is larger than a read may fetch; `largest=` says how much that is."""


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


class TlsRefused(NotConnected):
    """TLS failed: the server's certificate, its name, the certificate shown to it, or no TLS there."""


class WrongKind(ReemError, redis.exceptions.ResponseError):
    """The key holds a Redis type that is not REEM's.

    Attributes:
        key: The key on the server.
        where: The path that was meant.
    """

    def __init__(self, key: str, where: str, kind: str = "", *, text: bool = False) -> None:
        what = f"type {kind}" if kind else "another type"
        foreign = (
            f"the Redis key {key!r} holds a value of {what} (a program without REEM wrote it), not a document; "
            f"kvs.raw[{key!r}] reads it"
        )
        moved = (
            f"the document under the Redis key {key!r} is text, as servers without JSON keep it, and this one has "
            "JSON; convert it: reem migrate --yes"
        )
        super().__init__(f"{where}: {moved if text else foreign}")
        self.key = key
        self.where = where


class PartialWrite(ReemError, redis.exceptions.ResponseError):
    """A part of a transaction, or of a restored snapshot, was refused; the message names what was applied."""


class Refused(ReemError):
    """The server turned the call down for a reason that has nothing to do with the value; nothing was applied.

    In a write with arrays, or through a `PublishSpace`, that goes for the whole transaction. Reads and
    writes that come later on the same connection are not disturbed.
    """

    def at(self, place: str) -> Refused:
        """Return this error with its message headed by where it happened."""
        return type(self)(f"{place}: {self}")


class LoginRefused(Refused, redis.exceptions.AuthenticationError):
    """A wrong user or password, or none where one is needed. It is raised at once and never tried again."""


class NotAllowed(Refused, redis.exceptions.NoPermissionError):
    """The user may not run the command, or not on this key or channel; `deploy/users.acl` holds what REEM needs."""


class ServerFull(Refused, redis.exceptions.OutOfMemoryError):
    """The server has reached its `maxmemory`; nothing was written.

    Plain values can still be read and deleted. What has arrays goes in a transaction: Valkey still takes it
    if nothing in it needs memory, Redis takes none.
    """


class ServerReadOnly(Refused, redis.exceptions.ReadOnlyError):
    """The server takes no writes: it is a replica, or it cannot save what it is sent."""


class ServerNotReady(Refused, redis.exceptions.BusyLoadingError):
    """The server is loading its data, is busy with a script, or is a replica that lost its primary."""


class ClusterNode(Refused, redis.exceptions.ResponseError):
    """The server is one node of a Redis Cluster, and the key lives on another.

    Attributes:
        fact: The error without the advice for a connection to this node alone.
    """

    def __init__(self, fact: str, advice: str = "") -> None:
        super().__init__(f"{fact}; {advice}" if advice else fact)
        self.fact = fact
        self._advice = advice

    def at(self, place: str) -> ClusterNode:
        """Return this error with its message headed by where it happened."""
        return ClusterNode(f"{place}: {self.fact}", self._advice)


class NoJsonSupport(Refused, redis.exceptions.ResponseError):
    """The server has JSON, but not this command of RedisJSON. On a server without any JSON, REEM stores text.

    A JSON command of `interface.client` raises it on a server without JSON too.
    """


class InsecureConnection(UserWarning):
    """A connection can be read and changed on its way; the warning comes once for each address."""


SELF_EXPLANATORY = (MissingKey, PathRefused, ConnectionLost, NotConnected)
"""Errors whose message says all: REEM's own frames and causes are left out of their tracebacks."""


ALL_NODES = "connect to redis+cluster://host:port,host:port"
"""What to do when connected to one node of several."""


def is_of_command(error: Exception) -> bool:
    """Return whether the user lacks the right to a command, and not only to a key or channel."""
    return isinstance(error, NotAllowed) and "run the" in str(error)


def turned_down(error: Exception) -> Refused:
    """Return the error for an error reply about the server, on a connection to that server only."""
    if isinstance(error, Refused):
        return error
    fact = "the server is a node of a Redis Cluster and does not hold this key now"
    # Only a client of the whole cluster follows MOVED and ASK.
    if isinstance(error, redis.exceptions.TryAgainError):
        fact = "the key's slot is moving between nodes of a Redis Cluster, and parts of the key are on either"
    elif isinstance(error, redis.exceptions.ClusterDownError):
        fact = "the server is a node of a Redis Cluster that does not serve this key at the moment"
    return ClusterNode(f"{fact} (it says: {error!s:.120})", ALL_NODES)
