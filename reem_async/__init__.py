"""REEM for asyncio: one nested dictionary, shared by all the programs of a robot.

async with RedisInterface("localhost") as interface:
    kvs = KeyValueStore(interface)
    await kvs["foo"].write({"number": 1, "image": np.zeros((480, 640, 3))})
    image = await kvs["foo"]["image"].read()
"""

from .connection import RedisInterface
from .datatypes import (
    CallbackSubscriber,
    KeyValueStore,
    Publisher,
    PublishSpace,
    Reader,
    SilentSubscriber,
    Update,
    Writer,
)
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
from .policy import Every, Last, Newest
from .ships import BlobShip, BytesShip, NumpyShip, SpecialDatatypeShip

__version__ = "1.0.0"

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
    "TooDeep",
    "Update",
    "WriteOnly",
    "Writer",
    "WrongKind",
    "WrongLoop",
]
