"""What a notice means to a local copy of one path."""

from __future__ import annotations

from typing import Any, Protocol

from .notices import ANNOUNCED, Notice
from .paths import Path
from .trees import MISSING, get, removed, replaced

__all__ = ["Change", "applied", "concerns", "is_whole"]


class Change(Protocol):
    """As much of an update as tells what it touches."""

    @property
    def path(self) -> Path:
        """Where it was made."""

    @property
    def deleted(self) -> bool:
        """What was there is gone."""


def concerns(notice: Change, followed: Path) -> bool:
    """Return whether an update may change what is at the followed path."""
    for position, (theirs, ours) in enumerate(zip(notice.path, followed, strict=False)):
        if theirs == ours:
            continue
        if not isinstance(theirs, int) or not isinstance(ours, int):
            return False
        # Another item of the same list: the same one if we count from the end, and moved if that one is gone.
        return ours < 0 or (notice.deleted and position == len(notice.path) - 1)
    return True


def is_whole(notice: Notice, followed: Path, tree: Any) -> bool:
    """Return whether the notice alone tells what is now at the followed path, given what was there."""
    if notice.path[: len(followed)] != followed[: len(notice.path)]:
        return False
    if notice.deleted:  # deleting an item moves the next one to its place
        return len(notice.path) > len(followed) or not _deletes_item(notice)
    if notice.value is ANNOUNCED:
        return False
    # The server may have refused it for want of a parent; where there was something, there is a parent.
    return not notice.path or len(notice.path) > len(followed) or tree is not MISSING


def _deletes_item(notice: Notice) -> bool:
    """Return whether an item of a list was deleted, so that those after it have moved."""
    return bool(notice.path) and isinstance(notice.path[-1], int)


def applied(tree: Any, notice: Notice, followed: Path) -> Any:
    """Return the local copy after an update; raises CannotApply."""
    if len(notice.path) <= len(followed):
        return MISSING if notice.deleted else get(notice.value, followed[len(notice.path) :])
    inner = notice.path[len(followed) :]
    return removed(tree, inner) if notice.deleted else replaced(tree, inner, notice.value)
