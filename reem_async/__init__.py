"""REEM for asyncio: one nested dictionary, shared by all the programs of a robot.

async with RedisInterface("localhost") as interface:
    kvs = KeyValueStore(interface)
    await kvs["foo"].write({"number": 1, "image": np.zeros((480, 640, 3))})
    image = await kvs["foo"]["image"].read()
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .connection import RedisInterface
from .errors import (
    BadData,
    BadInput,
    BadKey,
    BadType,
    BadValue,
    Conflict,
    ConnectionLost,
    InterfaceClosed,
    MissingKey,
    Misuse,
    NoJsonSupport,
    NotConnected,
    Overflow,
    PartialWrite,
    PathRefused,
    QueueFull,
    ReadOnly,
    ReemError,
    ServerFailed,
    ServerMissing,
    TooDeep,
    WriteOnly,
    WrongKind,
    WrongLoop,
)
from .ships import BlobShip, BytesShip, NumpyShip, SpecialDatatypeShip
from .state import StateChange
from .store import KeyValueStore, Reader, Writer
from .transport.patience import timeout

__version__ = "1.0.0"

if TYPE_CHECKING:
    from .follow import Update
    from .policy import Every, Last, Newest
    from .publish import Publisher, PublishSpace
    from .subscribe import CallbackSubscriber, SilentSubscriber

_LATER = {
    "CallbackSubscriber": "reem_async.subscribe",
    "Every": "reem_async.policy",
    "Last": "reem_async.policy",
    "Newest": "reem_async.policy",
    "PublishSpace": "reem_async.publish",
    "Publisher": "reem_async.publish",
    "SilentSubscriber": "reem_async.subscribe",
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
    "Conflict",
    "ConnectionLost",
    "Every",
    "InterfaceClosed",
    "KeyValueStore",
    "Last",
    "MissingKey",
    "Misuse",
    "Newest",
    "NoJsonSupport",
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
    "ServerFailed",
    "ServerMissing",
    "SilentSubscriber",
    "SpecialDatatypeShip",
    "StateChange",
    "TooDeep",
    "Update",
    "WriteOnly",
    "Writer",
    "WrongKind",
    "WrongLoop",
    "timeout",
]
