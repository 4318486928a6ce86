"""The documented names: stores, subscribers, and what they are made of."""

from reem_async.subscribe import Update

from .accessor import Accessor
from .publish import Publisher, PublishSpace
from .store import KeyValueStore, Reader, Writer
from .subscribe import CallbackSubscriber, SilentSubscriber

__all__ = [
    "Accessor",
    "CallbackSubscriber",
    "KeyValueStore",
    "PublishSpace",
    "Publisher",
    "Reader",
    "SilentSubscriber",
    "Update",
    "Writer",
]
