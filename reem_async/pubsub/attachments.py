"""Which attachments of a copy are still those of the server, by what that says was changed. No I/O."""

from __future__ import annotations

from typing import Any

from ..plan import Plan
from ..plan.keys import Keys
from ..plan.placeholders import Unreadable
from ..plan.reads import RawRead

__all__ = ["HeldAttachments"]


class HeldAttachments:
    """The attachments of a copy that need not be read again.

    Attributes:
        values: What ships made of them, by label and suffix.
        asked: The keys that the last plan reads.
    """

    def __init__(self, keys: Keys) -> None:
        self.values: dict[tuple[str, str], Any] = {}
        self.asked: frozenset[str] = frozenset()
        self._keys = keys
        self._stale: set[str] = set()  # suffixes of those that were changed since they were asked for
        self._raw: RawRead | None = None

    def ask(self, plan: Plan) -> None:
        """A plan is sent: its reply has all that was changed until now."""
        self._stale.clear()
        # The note changes with every update, and is no part of the value.
        self.asked = frozenset(str(command[1]) for command in plan.commands) - {self._keys.last}

    def change(self, key: str | None, *, covered: bool) -> bool:
        """Forget what was changed; return whether this copy has it, or reads it.

        Args:
            key: Its name on the server, the document's or an attachment's; None for every key.
            covered: What is being read has the change.
        """
        if key is None:
            self.values.clear()
            if not covered:
                self._stale.update([name.removeprefix(self._keys.tag) for name in self.asked])
            return True
        if key == self._keys.document:
            return True
        suffix = key.removeprefix(self._keys.tag)  # empty for an array that is all of the document
        held = [place for place in self.values if place[1] == suffix]
        for place in held:
            del self.values[place]
        if not held and key not in self.asked:
            return False  # somebody else's on this connection
        # It comes while a read is under way over another connection: what that brings may be older.
        if not covered:
            self._stale.add(suffix)
        return True

    def opening(self, raw_read: RawRead) -> None:
        """Ships are making values of what was read."""
        self._raw = raw_read

    def failed(self) -> None:
        """They could not, or nothing of it is kept."""
        self._raw = None

    def opened(self) -> None:
        """They have: keep those whose keys were not changed since."""
        raw, self._raw = self._raw, None
        if raw is None:
            return
        for slot, ship, _ in raw.slots:
            label, suffix = slot.placeholder.label, slot.placeholder.suffix
            value = slot.container[slot.key]
            if ship.blob is not None and suffix not in self._stale and type(value) is not Unreadable:
                self.values[label, suffix] = value
        self.values.update({place: it for place, it in raw.left.items() if place[1] not in self._stale})
