"""REEM for asyncio: one nested dictionary, shared by all the programs of a robot.

async with RedisInterface("localhost") as interface:
    kvs = KeyValueStore(interface)
    await kvs["foo"].write({"number": 1, "image": np.zeros((480, 640, 3))})
    image = await kvs["foo"]["image"].read()
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "1.0.0rc1"

if TYPE_CHECKING:
    from .concurrency.queues import Every, Last, Newest
    from .concurrency.timeouts import timeout
    from .connection import RedisInterface
    from .coordination.clock import ClockOffset
    from .coordination.parameters import Parameter
    from .coordination.presence import NodeEvent, NodeInfo
    from .errors import *
    from .plan.placeholders import Unreadable
    from .plan.typed import Shape
    from .pubsub.events import Origin, Update
    from .pubsub.subscribers import CallbackSubscriber, SilentSubscriber
    from .ships import BlobShip, BytesShip, Jpeg, JpegShip, NumpyShip, Png, PngShip, SpecialDatatypeShip
    from .store.accessor import Reader, Writer
    from .store.store import KeyValueStore, Publisher, PublishSpace
    from .transport.state import StateChange

__all__ = [
    "BadData", "BadInput", "BadKey", "BadType", "BadValue", "BlobShip", "Busy", "BytesShip", "CallTimeout",
    "CallbackSubscriber", "ClockOffset", "ClusterNode", "Conflict", "ConnectionLost", "Contended", "Every",
    "InsecureConnection", "InterfaceClosed", "Jpeg", "JpegShip", "KeyValueStore", "Last", "LeaseLost", "LoginRefused",
    "MissingDocument", "MissingKey", "MissingTop", "Misuse", "Newest", "NoJsonSupport", "NoService", "NodeEvent",
    "NodeInfo", "NotAllowed", "NotConnected", "NotFinite", "NumpyShip", "Origin", "Overflow", "Owned", "Parameter",
    "PartialWrite", "PathRefused", "Png", "PngShip", "PublishSpace", "Publisher", "QueueFull", "ReadOnly", "Reader",
    "RedisInterface", "ReemError", "Refused", "RemoteError", "ServerFailed", "ServerFull", "ServerMissing",
    "ServerNotReady", "ServerReadOnly", "ServiceError", "ServiceLost", "Shape", "Silent", "SilentSubscriber",
    "SpecialDatatypeShip", "Stale", "StateChange", "TlsRefused", "TooDeep", "TooLarge", "Unreadable", "Update",
    "WriteOnly", "Writer", "WrongKind", "WrongLoop", "WrongType", "timeout",
]  # fmt: skip

_HOMES = {
    ".concurrency.queues": ["Every", "Last", "Newest"],
    ".concurrency.timeouts": ["timeout"],
    ".connection": ["RedisInterface"],
    ".coordination.clock": ["ClockOffset"],
    ".coordination.parameters": ["Parameter"],
    ".coordination.presence": ["NodeEvent", "NodeInfo"],
    ".plan.placeholders": ["Unreadable"],
    ".plan.typed": ["Shape"],
    ".pubsub.events": ["Origin", "Update"],
    ".pubsub.subscribers": ["CallbackSubscriber", "SilentSubscriber"],
    ".ships": ["BlobShip", "BytesShip", "Jpeg", "JpegShip", "NumpyShip", "Png", "PngShip", "SpecialDatatypeShip"],
    ".store.accessor": ["Reader", "Writer"],
    ".store.store": ["KeyValueStore", "PublishSpace", "Publisher"],
    ".transport.state": ["StateChange"],
}
"""Where the names are that are no errors. Imported when first used: `reem --help` starts sooner."""


def load_ipython_extension(shell: Any) -> None:
    """`%load_ext reem_async` in IPython and Jupyter: arrays that were read are shown as pictures, where they can be."""
    import_module("reem_async.tools.notebook").load_ipython_extension(shell)


def unload_ipython_extension(shell: Any) -> None:
    """`%unload_ext reem_async`: arrays are shown as numbers again."""
    import_module("reem_async.tools.notebook").unload_ipython_extension(shell)


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = next((module for module, names in _HOMES.items() if name in names), ".errors")
    value = globals()[name] = getattr(import_module(home, __name__), name)
    return value
