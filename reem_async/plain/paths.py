"""JSONPaths, as far as REEM sends any: `$["a"][0]`, `$['b']`, `$[-3:-2]`, `$["a"][*]`."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any, NamedTuple

Step = str | int | slice
Steps = tuple[Step, ...]

ALL = slice(None)  # every item of a list, every value of a dict
_STEP = re.compile(r"""\["(?P<double>[^"]*)"\]|\['(?P<single>[^']*)'\]|\[(?P<from>-?\d+)(?::(?P<to>-?\d+))?\]|\[\*\]""")


class Refusal(Exception):
    """A command is refused, with the message of the server's error."""


class Place(NamedTuple):
    """A place in a tree: `container[key]`; for the root, the only item of a list."""

    container: Any
    key: Any

    @property
    def value(self) -> Any:
        return self.container[self.key]


@lru_cache(maxsize=4096)
def steps_of(path: str) -> Steps:
    """Return the steps of a path from the root; raises Refusal for paths that REEM never sends."""
    # The root, as commands of RedisJSON 1 name it; `bare` replies belong to it.
    if path == ".":
        return ()
    position, steps = 1, []
    while position < len(path):
        found = _STEP.match(path, position)
        if found is None or path[0] != "$":
            raise Refusal(f"ERR the path {path!r:.80} is none that REEM uses; documents of this server are plain text")
        steps.append(_step(found))
        position = found.end()
    return tuple(steps)


def _step(found: re.Match[str]) -> Step:
    if found["double"] is not None or found["single"] is not None:
        return str(found["single"] if found["double"] is None else found["double"])
    if found["from"] is None:
        return ALL
    return int(found["from"]) if found["to"] is None else slice(int(found["from"]), int(found["to"]))


def places(holder: list[Any], steps: Steps) -> list[Place]:
    """Return the places that `steps` lead to from the only item of `holder`."""
    found = [Place(holder, 0)]
    for step in steps:
        found = [inner for place in found for inner in _inside(place.value, step)]
    return found


def _inside(value: Any, step: Step) -> list[Place]:
    if isinstance(step, str):
        return [Place(value, step)] if type(value) is dict and step in value else []
    if type(value) is dict:
        return [Place(value, key) for key in value] if step is ALL else []
    if type(value) is not list:
        return []
    if isinstance(step, slice):
        return [Place(value, index) for index in range(*step.indices(len(value)))]
    # Strictly: no item for an index that is too negative; the module would name the first.
    index = step if step >= 0 else len(value) + step
    return [Place(value, index)] if 0 <= index < len(value) else []
