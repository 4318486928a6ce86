"""Which of many changes were of which path: numbers that only grow, forgotten from the front."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator

from ...plan.paths import Path, below

__all__ = ["Places", "concerns"]


def concerns(where: Path, path: Path) -> bool:
    """Return whether a change at one path changes what is at the other."""
    return below(path, where) or below(where, path)


class Places:
    """The numbers of changes by their paths."""

    __slots__ = ("_numbers",)

    def __init__(self) -> None:
        self._numbers: dict[Path, list[int]] = {}

    def add(self, path: Path, number: int) -> None:
        """Note a change; its number is larger than all before."""
        self._numbers.setdefault(path, []).append(number)

    def drop(self, end: int) -> None:
        """Forget all numbers below `end`."""
        # Numbers of changes that are forgotten; a path without any is forgotten too.
        for path in list(self._numbers):
            numbers = self._numbers[path]
            del numbers[: bisect_left(numbers, end)]
            if not numbers:
                del self._numbers[path]

    def last(self, path: Path, end: int) -> int:
        """Return the last number below `end` of a change at just this path, -1 if there is none."""
        numbers = self._numbers.get(path, [])
        index = bisect_left(numbers, end)
        return numbers[index - 1] if index else -1

    def lasts(self, end: int, path: Path = ()) -> Iterator[int]:
        """Yield the last number below `end` of each path that concerns `path`; of all for the root."""
        for where in self._numbers:
            if not path or concerns(where, path):
                number = self.last(where, end)
                if number >= 0:
                    yield number

    def of(self, path: Path) -> list[int]:
        """Return the numbers of all changes that concern `path`, in order."""
        found = [numbers for where, numbers in self._numbers.items() if concerns(where, path)]
        return found[0].copy() if len(found) == 1 else sorted([number for numbers in found for number in numbers])
