"""How long a call is tried again while others are faster: who writes between its look and its end has it given up."""

from __future__ import annotations

import time
from collections.abc import Sequence

from ..errors import Contended
from ..plan import Command

__all__ = ["Contention", "document_of"]


class Contention:
    """The attempts of one call that were given up, since somebody else had written to the same top-level key.

    Args:
        limit: Seconds for which it is tried again.
    """

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._deadline = 0.0

    def given_up(self, commands: Sequence[Command]) -> None:
        """Note that an attempt to apply `commands` was given up: so there are two at least, however long they take.

        Raises:
            Contended: The first one was given up longer ago than the limit.
        """
        now = time.monotonic()
        if not self._deadline:
            self._deadline = now + self._limit
        elif now > self._deadline:
            raise Contended(
                f"{document_of(commands)}: others kept writing to this top-level key for {self._limit:g} s, each time "
                "between a look at it and the change; nothing was applied: write to it less often, give what is "
                "written often a top-level key of its own, or give it longer with timeout="
            )

    def waited(self, seconds: float) -> None:
        """Leave out of the time for which it is tried again what it has waited for calls of its own interface."""
        self._deadline += seconds if self._deadline else 0.0

    def over(self) -> None:
        """Note that it was applied: what follows from it has a time of its own."""
        self._deadline = 0.0


def document_of(commands: Sequence[Command]) -> str:
    """Return the name on the server of the document that commands are about: all their keys carry it."""
    key = next(command for command in commands if len(command) > 1)[1]
    name: str = key.decode(errors="replace") if isinstance(key, bytes) else str(key)
    return name[1 : name.index("}")] if name.startswith("{") else name
