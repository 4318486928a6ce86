"""What a value that was read from the server tells of the updates that announced it.

A large update is only announced. Who wants its value reads it a little later, and finds what is there by then. The
transaction that reads also reads `{foo}:last`, publisher and number of the last update that is in what was read. All
updates of a top-level key come in one order, so this note draws a line through them:

      updates, in their order                      read: {image, n: 1, state: "done"}, and the note "p 2"
    --------------------------------------------------------------------------------------------------------
      p 1   cam = {image, n: 1, state: "raw"}      announced          |
      p 2   cam.state = "done"                     with its value     |   all of these are in what was read,
    . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . . .  the line
      p 3   cam.n = 5                              with its value         and none of these

What was read is the value of p 1 only if no update between p 1 and the line touched its place. Here p 2 did: the
"raw" that p 1 wrote is nowhere any more. So p 1 is skipped, and counted; it is never told with a value that it did
not have, nor p 2 before it. What is left of p 1 depends on where it was touched:

    at its place, or at one that holds it    nothing: the later update has replaced it
    inside of it, on a way through dicts     all but what was touched: {image, n: 1}. With it, and then p 2, a copy
                                             is what the server had after p 2
    inside of a list                         items may have moved, and deleting one twice deletes two. The list is
                                             left out too; as it was read, it is what the last update inside it led to

What comes behind the line is applied to what was read, as to any other copy. If the note names an update that nobody
here has heard of although all from before the read have been heard, then updates were lost, and nothing is known of
the others: they are skipped, and the key is read again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from .copies import Change, concerns
from .paths import Path, below
from .trees import MISSING, removed

__all__ = ["Rest", "is_own", "rest_of"]


class Rest(NamedTuple):
    """What is left of an update that later ones have touched.

    Attributes:
        value: What it wrote, without what was touched; MISSING if nothing is left.
        lists: Which lists (full paths) have to be taken as they were read, and behind which of the later
            updates, by its place among them.
    """

    value: Any
    lists: dict[Path, int]


def is_own(path: Path, later: Iterable[Change]) -> bool:
    """Return whether what was read at `path` is what an update wrote there, `later` ones being in it too."""
    return not any(concerns(each, path) for each in later)


def rest_of(value: Any, path: Path, later: Sequence[Change]) -> Rest:
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
