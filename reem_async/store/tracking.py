"""Where the arrays of what was written are, and whether that may change: `track_schema_changes`."""

from __future__ import annotations

from ..errors import BadType
from ..plan.changes import EncodedAttachment
from ..plan.keys import Keys
from ..plan.olddata import is_new
from ..plan.orphans import left_behind
from ..plan.paths import Path, has_index
from ..plan.shapes import ShapeCache

__all__ = ["ALWAYS_TRACKED", "Tracking", "saw_shape"]

_NO_ARRAYS: frozenset[str] = frozenset()


class Tracking:
    """Whether the shapes of what one store writes never change.

    Attributes:
        static: They do not, but
        by_key: for keys for which it was said in particular.
    """

    def __init__(self) -> None:
        self.static = False
        self.by_key: dict[str, bool] = {}

    def looks(self, cache: ShapeCache, keys: Keys, path: Path, attachments: tuple[EncodedAttachment, ...]) -> bool:
        """Return whether a write is to look for arrays that it replaces; raises BadType for a new shape if static."""
        # In lists names tell nothing about places, so it is looked whatever the user has said.
        if not self.by_key.get(keys.name, self.static) or has_index(path):
            return True
        # The first write of a place looks, and what it has stored there is the shape that must not change.
        known = cache.shape(keys.document, path)
        if known is None:
            return True
        suffixes = frozenset([each.suffix for each in attachments])
        if known != suffixes:
            raise _new_shape(keys.name, min(known ^ suffixes))
        # Another write, of what is above or below, may have put arrays here since.
        written = {suffix.encode() for suffix in suffixes}
        return cache.is_unsure(keys.document) or bool(left_behind(cache.members(keys.document), path, written))


ALWAYS_TRACKED = Tracking()


def _new_shape(name: str, suffix: str) -> BadType:
    return BadType(
        f"{name}{suffix}: an array (or other shipped value) where none was, or none where one was, but "
        "track_schema_changes(False) says that the shape never changes; switch it back on for this write"
    )


def saw_shape(cache: ShapeCache, keys: Keys, path: Path, attachments: tuple[EncodedAttachment, ...]) -> None:
    """Note where the arrays of a value are that was set."""
    if has_index(path):
        return
    suffixes = frozenset([each.suffix for each in attachments]) if attachments else _NO_ARRAYS
    cache.saw_shape(keys.document, path, suffixes)
    if not path and not is_new(keys, path, cache):
        cache.saw_new(keys.document)  # nothing that an old version stored is left in it
