"""REEM: one nested dictionary, shared by all the programs of a robot.

interface = RedisInterface("localhost")
kvs = KeyValueStore(interface)
kvs["foo"] = {"number": 1, "image": np.zeros((480, 640, 3))}
image = kvs["foo"]["image"].read()
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from reem_async import StateChange, timeout
from reem_async import __version__ as __version__

from .connection import RedisInterface
from .errors import (
    BadData,
    BadInput,
    BadKey,
    BadType,
    BadValue,
    ClusterNode,
    Conflict,
    ConnectionLost,
    InsecureConnection,
    InterfaceClosed,
    LoginRefused,
    MissingKey,
    Misuse,
    NoJsonSupport,
    NotAllowed,
    NotConnected,
    Overflow,
    PartialWrite,
    PathRefused,
    QueueFull,
    ReadOnly,
    ReemError,
    Refused,
    ServerFailed,
    ServerFull,
    ServerMissing,
    ServerNotReady,
    ServerReadOnly,
    TlsRefused,
    TooDeep,
    WriteOnly,
    WrongKind,
    WrongLoop,
)
from .ships import BlobShip, BytesShip, NumpyShip, SpecialDatatypeShip
from .store import KeyValueStore, Reader, Writer

if TYPE_CHECKING:
    from reem_async.follow import Update
    from reem_async.policy import Every, Last, Newest

    from .publish import Publisher, PublishSpace
    from .subscribe import CallbackSubscriber, SilentSubscriber

_LATER = {
    "CallbackSubscriber": "reem.subscribe",
    "Every": "reem_async.policy",
    "Last": "reem_async.policy",
    "Newest": "reem_async.policy",
    "PublishSpace": "reem.publish",
    "Publisher": "reem.publish",
    "SilentSubscriber": "reem.subscribe",
    "Update": "reem_async.follow",
}
"""Imported when first used: a program that only reads and writes starts sooner."""


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LATER[name]), name)


__all__ = [
    "BadData",
    "BadInput",
    "BadKey",
    "BadType",
    "BadValue",
    "BlobShip",
    "BytesShip",
    "CallbackSubscriber",
    "ClusterNode",
    "Conflict",
    "ConnectionLost",
    "Every",
    "InsecureConnection",
    "InterfaceClosed",
    "KeyValueStore",
    "Last",
    "LoginRefused",
    "MissingKey",
    "Misuse",
    "Newest",
    "NoJsonSupport",
    "NotAllowed",
    "NotConnected",
    "NumpyShip",
    "Overflow",
    "PartialWrite",
    "PathRefused",
    "PublishSpace",
    "Publisher",
    "QueueFull",
    "ReadOnly",
    "Reader",
    "RedisInterface",
    "ReemError",
    "Refused",
    "ServerFailed",
    "ServerFull",
    "ServerMissing",
    "ServerNotReady",
    "ServerReadOnly",
    "SilentSubscriber",
    "SpecialDatatypeShip",
    "StateChange",
    "TlsRefused",
    "TooDeep",
    "Update",
    "WriteOnly",
    "Writer",
    "WrongKind",
    "WrongLoop",
    "timeout",
]
