"""The documented names: stores, subscribers, and what they are made of."""

from .pubsub.subscribers import CallbackSubscriber, SilentSubscriber, Update
from .store import KeyValueStore, Reader, Writer
from .store.accessor import Accessor
from .store.publish import Publisher, PublishSpace

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
