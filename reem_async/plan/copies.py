"""What a notice means to a local copy of one path."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol

from .notices import ANNOUNCED, Notice
from .paths import Path, below
from .trees import MISSING, get, removed, replaced


class AnnouncedChange(Protocol):
    """As much of an update as tells what it touches."""

    @property
    def path(self) -> Path:
        """Where it was made."""

    @property
    def deleted(self) -> bool:
        """What was there is gone."""


def concerns(notice: AnnouncedChange, followed: Path) -> bool:
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


# What a value that was read from the server tells of the updates that announced it.
#
# A large update is only announced. Who wants its value reads it a little later, and finds what is there by then. The
# transaction that reads also reads `{foo}:last`, publisher and number of the last update that is in what was read. All
# updates of a top-level key come in one order, so this note draws a line through them:
#
#       updates, in their order                      read: {image, n: 1, state: "done"}, and the note "p 2"
#     --------------------------------------------------------------------------------------------------------
#       p 1   cam = {image, n: 1, state: "raw"}      announced          |
#       p 2   cam.state = "done"                     with its value     |   all of these are in what was read,
#     . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . .  the line
#       p 3   cam.n = 5                              with its value         and none of these
#
# What was read is the value of p 1 only if no update between p 1 and the line touched its place. Here p 2 did: the
# "raw" that p 1 wrote is nowhere any more. So p 1 is skipped, and counted; it is never told with a value that it did
# not have, nor p 2 before it. What is left of p 1 depends on where it was touched:
#
#     at its place, or at one that holds it    nothing: the later update has replaced it
#     inside of it, on a way through dicts     all but what was touched: {image, n: 1}. With it, and then p 2, a copy
#                                              is what the server had after p 2
#     inside of a list                         items may have moved, and deleting one twice deletes two. The list is
#                                              left out too; as it was read, it is what the last update inside it led to
#
# What comes behind the line is applied to what was read, as to any other copy. If the note names an update that nobody
# here has heard of although all from before the read have been heard, then updates were lost, and nothing is known of
# the others: they are skipped, and the key is read again.


class Rest(NamedTuple):
    """What is left of an update that later ones have touched.

    Attributes:
        value: What it wrote, without what was touched; MISSING if nothing is left.
        lists: Which lists (full paths) have to be taken as they were read, and behind which of the later
            updates, by its place among them.
    """

    value: Any
    lists: dict[Path, int]


def is_own(path: Path, later: Iterable[AnnouncedChange]) -> bool:
    """Return whether what was read at `path` is what an update wrote there, `later` ones being in it too."""
    return not any(concerns(each, path) for each in later)


def rest_of(value: Any, path: Path, later: Sequence[AnnouncedChange]) -> Rest:
    """Return what is left of an update of `path`, given what was read there and the `later` ones that are in it."""
    lists: dict[Path, int] = {}
    for each in later:
        if not concerns(each, path):
            continue
        if below(path, each.path):
            value = MISSING
            continue
        # An item of a list on the way to `path` was deleted, if the other path is not inside of it.
        inside = below(each.path, path)
        start, touched = (len(path), each.path) if inside else (0, path)
        end = next((place for place in range(start, len(touched)) if isinstance(touched[place], int)), None)
        value = removed(value, touched[start:end]) if inside else MISSING
        if end is not None:
            lists[touched[:end]] = -1
    for touched in tuple(lists):
        place = max(place for place, each in enumerate(later) if concerns(each, touched))
        if below(touched, later[place].path):  # it was written as a whole
            del lists[touched]
        else:
            lists[touched] = place
    return Rest(value, lists)
