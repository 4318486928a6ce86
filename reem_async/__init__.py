"""REEM for asyncio: one nested dictionary, shared by all the programs of a robot.

async with RedisInterface("localhost") as interface:
    kvs = KeyValueStore(interface)
    await kvs["foo"].write({"number": 1, "image": np.zeros((480, 640, 3))})
    image = await kvs["foo"]["image"].read()
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ._moved import keep_old_names

__version__ = "1.0.0rc1"

keep_old_names(__name__)

if TYPE_CHECKING:
    from .concurrency.queues import Every, Last, Newest
    from .concurrency.timeouts import timeout
    from .connection import RedisInterface
    from .errors import *
    from .plan.placeholders import Unreadable
    from .pubsub.events import Origin, Update
    from .pubsub.subscribers import CallbackSubscriber, SilentSubscriber
    from .ships import BlobShip, BytesShip, NumpyShip, SpecialDatatypeShip
    from .store import KeyValueStore, Reader, Writer
    from .store.publish import Publisher, PublishSpace
    from .transport.state import StateChange

__all__ = [
    "BadData", "BadInput", "BadKey", "BadType", "BadValue", "BlobShip", "BytesShip", "CallbackSubscriber",
    "ClusterNode", "Conflict", "ConnectionLost", "Every", "InsecureConnection", "InterfaceClosed", "KeyValueStore",
    "Last", "LoginRefused", "MissingKey", "Misuse", "Newest", "NoJsonSupport", "NotAllowed", "NotConnected",
    "NotFinite", "NumpyShip", "Origin", "Overflow", "PartialWrite", "PathRefused", "PublishSpace", "Publisher",
    "QueueFull", "ReadOnly", "Reader", "RedisInterface", "ReemError", "Refused", "ServerFailed", "ServerFull",
    "ServerMissing", "ServerNotReady", "ServerReadOnly", "SilentSubscriber", "SpecialDatatypeShip", "Stale",
    "StateChange", "TlsRefused", "TooDeep", "Unreadable", "Update", "WriteOnly", "Writer", "WrongKind", "WrongLoop",
    "WrongType",
    "timeout",
]  # fmt: skip

_HOMES = {
    "BlobShip": ".ships",
    "BytesShip": ".ships",
    "CallbackSubscriber": ".pubsub.subscribers",
    "Every": ".concurrency.queues",
    "KeyValueStore": ".store",
    "Last": ".concurrency.queues",
    "Newest": ".concurrency.queues",
    "NumpyShip": ".ships",
    "Origin": ".pubsub.events",
    "PublishSpace": ".store.publish",
    "Publisher": ".store.publish",
    "Reader": ".store",
    "RedisInterface": ".connection",
    "SilentSubscriber": ".pubsub.subscribers",
    "SpecialDatatypeShip": ".ships",
    "StateChange": ".transport.state",
    "Unreadable": ".plan.placeholders",
    "Update": ".pubsub.events",
    "Writer": ".store",
    "timeout": ".concurrency.timeouts",
}
"""Where each name is that is no error. Imported when first used: `reem --help` starts sooner."""


def load_ipython_extension(shell: Any) -> None:
    """`%load_ext reem_async` in IPython and Jupyter: arrays that were read are shown as pictures, where they can be."""
    import_module("reem_async.tools.notebook").load_ipython_extension(shell)


def unload_ipython_extension(shell: Any) -> None:
    """`%unload_ext reem_async`: arrays are shown as numbers again."""
    import_module("reem_async.tools.notebook").unload_ipython_extension(shell)


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOMES.get(name, ".errors"), __name__), name)
    return value
