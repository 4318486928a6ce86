"""The documented names: stores, subscribers, and what they are made of."""

from importlib import import_module
from typing import Any

from reem_async.pubsub.subscribers import Update

from .accessor import Accessor, Publisher, Reader, Writer
from .store import KeyValueStore, PublishSpace
from .subscribe import CallbackSubscriber, SilentSubscriber

__all__ = [  # noqa: F822 - the functions stood here in REEM 0.0.x, for `from reem.datatypes import *`
    "ROOT_PATH",
    "ROOT_VALUE_SEQUENCE",
    "SEPARATOR_CHARACTER",
    "Accessor",
    "CallbackSubscriber",
    "KeyValueStore",
    "PublishSpace",
    "Publisher",
    "Reader",
    "SilentSubscriber",
    "Update",
    "Writer",
    "append_to_path",
    "check_valid_key_name",
    "copy_dictionary_without_paths",
    "extract_object",
    "filter_paths_by_prefix",
    "insert_into_dictionary",
    "key_sequence_to_path",
    "path_to_key_sequence",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("reem.legacy"), name)
