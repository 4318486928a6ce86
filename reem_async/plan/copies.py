"""How updates change a local copy of one path, and which updates a read value contains."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol

from .notices import ANNOUNCED, Notice
from .paths import Path, below
from .trees import MISSING, get, removed, replaced


class AnnouncedChange(Protocol):
    @property
    def path(self) -> Path: ...

    @property
    def deleted(self) -> bool: ...


def concerns(notice: AnnouncedChange, followed: Path) -> bool:
    """Return whether an update may change the value at the followed path."""
    for position, (theirs, ours) in enumerate(zip(notice.path, followed, strict=False)):
        if theirs == ours:
            continue
        if not isinstance(theirs, int) or not isinstance(ours, int):
            return False
        # Another item of the same list: it may be the same one if ours counts from the end, and a deletion moves ours.
        return ours < 0 or (notice.deleted and position == len(notice.path) - 1)
    return True


def is_whole(notice: Notice, followed: Path, tree: Any) -> bool:
    """Return whether the notice and the old `tree` suffice to know the new value at the followed path."""
    if notice.path[: len(followed)] != followed[: len(notice.path)]:
        return False
    if notice.deleted:  # deleting an item of a list moves the next one to its place
        return len(notice.path) > len(followed) or not (notice.path and isinstance(notice.path[-1], int))
    if notice.value is ANNOUNCED:
        return False
    # The server may have refused it because the parent is missing; where a value was, there is a parent.
    return not notice.path or len(notice.path) > len(followed) or tree is not MISSING


def applied(tree: Any, notice: Notice, followed: Path) -> Any:
    """Return the local copy after an update; raises CannotApply."""
    if len(notice.path) <= len(followed):
        return MISSING if notice.deleted else get(notice.value, followed[len(notice.path) :])
    inner = notice.path[len(followed) :]
    return removed(tree, inner) if notice.deleted else replaced(tree, inner, notice.value)


# A large update is only announced. A subscriber reads its value a little later, when newer updates may have changed it.
# The transaction that reads also reads `{foo}:last`: publisher and number of the last update that is in the value. All
# updates of a top-level key come in one order, so this note draws a line through them:
#
#       updates, in their order                      read: {image, n: 1, state: "done"}, and the note "p 2"
#     --------------------------------------------------------------------------------------------------------
#       p 1   cam = {image, n: 1, state: "raw"}      announced          |
#       p 2   cam.state = "done"                     with its value     |   all of these are in what was read,
#     . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . .  the line
#       p 3   cam.n = 5                              with its value         and none of these
#
# The value read is that of p 1 only if no update between p 1 and the line touched its place. Here p 2 did: the "raw"
# of p 1 is lost. So p 1 is skipped and counted; it is never delivered with a value that it did not have. What is left
# of p 1 depends on the place that the later update touched:
#
#     the same place, or one that holds it    nothing: the later update has replaced it
#     inside of it, through dicts only        all but that place: {image, n: 1}. With it, and then p 2, a copy equals
#                                             the server's document after p 2
#     inside of a list in it                  items may have moved, and deleting one twice deletes two. The list is
#                                             left out too; the list that was read is that of the last update inside it
#
# Updates behind the line are applied to the value read, as to any copy. If the note names an update that did not
# arrive although all from before the read have arrived, updates were lost: the others are skipped, and the key is read
# again.


class Rest(NamedTuple):
    value: Any  # its value without the places that were touched; MISSING if nothing is left
    # The lists (full paths) to take from the value read, and the position of the later update behind which.
    lists: dict[Path, int]


def is_own(path: Path, later: Iterable[AnnouncedChange]) -> bool:
    """Return whether the value read at `path` is still that of an update, though it has the `later` ones too."""
    return not any(concerns(each, path) for each in later)


def rest_of(value: Any, path: Path, later: Sequence[AnnouncedChange]) -> Rest:
    """Return what is left of an update of `path`, given the `value` read there, which has the `later` ones too."""
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
