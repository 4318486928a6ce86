"""REEM for asyncio: one nested dictionary, shared by all the programs of a robot.

async with RedisInterface("localhost") as interface:
    kvs = KeyValueStore(interface)
    await kvs["foo"].write({"number": 1, "image": np.zeros((480, 640, 3))})
    image = await kvs["foo"]["image"].read()
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "1.0.0"

if TYPE_CHECKING:
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
    from .follow import Update
    from .policy import Every, Last, Newest
    from .publish import Publisher, PublishSpace
    from .ships import BlobShip, BytesShip, NumpyShip, SpecialDatatypeShip
    from .state import StateChange
    from .store import KeyValueStore, Reader, Writer
    from .subscribe import CallbackSubscriber, SilentSubscriber
    from .transport.patience import timeout

_LATER = {
    "BadData": "reem_async.errors",
    "BadInput": "reem_async.errors",
    "BadKey": "reem_async.errors",
    "BadType": "reem_async.errors",
    "BadValue": "reem_async.errors",
    "BlobShip": "reem_async.ships",
    "BytesShip": "reem_async.ships",
    "CallbackSubscriber": "reem_async.subscribe",
    "ClusterNode": "reem_async.errors",
    "Conflict": "reem_async.errors",
    "ConnectionLost": "reem_async.errors",
    "Every": "reem_async.policy",
    "InsecureConnection": "reem_async.errors",
    "InterfaceClosed": "reem_async.errors",
    "KeyValueStore": "reem_async.store",
    "Last": "reem_async.policy",
    "LoginRefused": "reem_async.errors",
    "MissingKey": "reem_async.errors",
    "Misuse": "reem_async.errors",
    "Newest": "reem_async.policy",
    "NoJsonSupport": "reem_async.errors",
    "NotAllowed": "reem_async.errors",
    "NotConnected": "reem_async.errors",
    "NumpyShip": "reem_async.ships",
    "Overflow": "reem_async.errors",
    "PartialWrite": "reem_async.errors",
    "PathRefused": "reem_async.errors",
    "PublishSpace": "reem_async.publish",
    "Publisher": "reem_async.publish",
    "QueueFull": "reem_async.errors",
    "ReadOnly": "reem_async.errors",
    "Reader": "reem_async.store",
    "RedisInterface": "reem_async.connection",
    "ReemError": "reem_async.errors",
    "Refused": "reem_async.errors",
    "ServerFailed": "reem_async.errors",
    "ServerFull": "reem_async.errors",
    "ServerMissing": "reem_async.errors",
    "ServerNotReady": "reem_async.errors",
    "ServerReadOnly": "reem_async.errors",
    "SilentSubscriber": "reem_async.subscribe",
    "SpecialDatatypeShip": "reem_async.ships",
    "StateChange": "reem_async.state",
    "TlsRefused": "reem_async.errors",
    "TooDeep": "reem_async.errors",
    "Update": "reem_async.follow",
    "WriteOnly": "reem_async.errors",
    "Writer": "reem_async.store",
    "WrongKind": "reem_async.errors",
    "WrongLoop": "reem_async.errors",
    "timeout": "reem_async.transport.patience",
}
"""Imported when first used: `reem --help`, and a program that only reads and writes, start sooner."""


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_LATER[name]), name)
    return value


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
