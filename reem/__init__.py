"""REEM: one nested dictionary, shared by all the programs of a robot.

interface = RedisInterface("localhost")
kvs = KeyValueStore(interface)
kvs["foo"] = {"number": 1, "image": np.zeros((480, 640, 3))}
image = kvs["foo"]["image"].read()
"""

from reem_async import __version__ as __version__
from reem_async.policy import Every, Last, Newest

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
from .ships import BlobShip, BytesShip, NumpyShip, SpecialDatatypeShip

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
