"""The documented names: stores, subscribers, and what they are made of."""

from .pubsub.subscribers import CallbackSubscriber, SilentSubscriber, Update
from .store.accessor import Accessor, Reader, Writer
from .store.store import KeyValueStore, Publisher, PublishSpace

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
