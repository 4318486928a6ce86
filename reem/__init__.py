"""REEM: one nested dictionary, shared by all the programs of a robot.

interface = RedisInterface("localhost")
kvs = KeyValueStore(interface)
kvs["foo"] = {"number": 1, "image": np.zeros((480, 640, 3))}
image = kvs["foo"]["image"].read()
"""

import warnings
from importlib import import_module
from typing import Any

from reem_async import StateChange, timeout
from reem_async import __version__ as __version__
from reem_async._installation import CURE, original_reem
from reem_async.concurrency.queues import Every, Last, Newest
from reem_async.coordination.clock import ClockOffset
from reem_async.coordination.presence import NodeEvent, NodeInfo
from reem_async.plan.placeholders import Unreadable
from reem_async.plan.typed import Shape
from reem_async.pubsub.events import Origin, Update

from .accessor import Accessor, Publisher, Reader, Writer
from .connection import RedisInterface
from .coordination import Parameter
from .errors import *
from .ships import BlobShip, BytesShip, Jpeg, JpegShip, NumpyShip, Png, PngShip, SpecialDatatypeShip
from .store import KeyValueStore, PublishSpace
from .subscribe import CallbackSubscriber, SilentSubscriber

if clash := original_reem():
    warnings.warn(f"{clash}; run: {CURE}", RuntimeWarning, stacklevel=2)


def load_ipython_extension(shell: Any) -> None:
    """`%load_ext reem` in IPython and Jupyter: keys complete at any depth, and arrays are shown as pictures.

    Pictures are of arrays that were read and can be one; they need pillow. Nothing is read to show it.
    """
    from reem_async.tools.notebook import complete_below, load_ipython_extension

    complete_below(KeyValueStore, Accessor)
    load_ipython_extension(shell)


def unload_ipython_extension(shell: Any) -> None:
    """`%unload_ext reem`: arrays are shown as numbers again."""
    from reem_async.tools.notebook import unload_ipython_extension

    unload_ipython_extension(shell)


def __getattr__(name: str) -> Any:
    if name != "TolerantKeyValueStore":  # of REEM 0.1.3
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module("reem.legacy").TolerantKeyValueStore


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
