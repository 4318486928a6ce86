"""One nested dictionary: its places, top-level keys, and what writes, reads and publishes them."""

from .accessor import Reader, Writer
from .store import KeyValueStore

__all__ = ["KeyValueStore", "Reader", "Writer"]
