"""What became of a change: its result, or the next plan, which puts things right and then says so.

Whatever is refused after the document was written is a `PartialWrite`, never an error that means that nothing was.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..errors import MissingKey, PartialWrite, PathRefused
from . import Command, Plan, Reply
from .changes import REFUSED, Change
from .orphans import clean, place_of
from .paths import may_hold, show
from .replies import diagnose, explained, full, registered
from .shapes import ShapeCache

__all__ = ["Outcome"]


class Outcome:
    """What became of a change.

    Args:
        it: The change.
        cache: What is known of the server.
        commands: What was sent for it.
        replies: One for each of them.
        main: The place of the command that changes the document.
    """

    __slots__ = ("cache", "commands", "it", "main", "refusal", "replies")

    def __init__(
        self, it: Change, cache: ShapeCache, commands: Sequence[Command], replies: Sequence[Reply], main: int
    ) -> None:
        self.it = it
        self.cache = cache
        self.commands = commands
        self.replies = replies
        self.main = main
        self.refusal: PathRefused | None = None  # in the server's words

    def next(self) -> Any:
        """Return the result, or the next plan; raise what the replies mean."""
        members = self._members()
        judged = self._judged()
        # The notice went out in the same transaction as the command, before anybody knew that it would be refused.
        refused = judged is REFUSED or isinstance(judged, Exception)
        if refused and (told := self.it.announcement.retract(self.it.path)):
            return Plan(told, lambda _: self._settle(members, judged), atomic=True, unfinished=self._untold)
        return self._settle(members, judged)

    def _members(self) -> frozenset[bytes]:
        """Return what the registry held right after the change, as far as the server tells."""
        # In the order in which `writes._change` sends: the command, SADD if there are attachments, then SMEMBERS.
        reply = self.replies[self.main + (2 if self.it.attachments else 1)]
        if isinstance(reply, Exception):
            self.cache.may_not_look(self.it.keys.document)
            return frozenset()
        members = registered(reply, self.it.keys)
        self.cache.saw_members(self.it.keys.document, members)
        return members

    def _judged(self) -> Any:
        """Return the result, REFUSED, or the error to raise."""
        reply = self.replies[self.main]
        if isinstance(reply, Exception):
            error = explained(reply, self.it.keys, self.it.path)
            # The server says of every item that it cannot set that its index is out of range, also where no list is.
            if type(error) is not PathRefused:
                return error
            self.refusal = error
            return REFUSED
        try:
            judged = self.it.judge(reply)
        except Exception as error:
            return error
        # The command itself went well. Another one of the transaction failed: servers go on with the rest, and undo
        # nothing.
        refused = [pair for pair in zip(self.commands, self.replies, strict=True) if isinstance(pair[1], Exception)]
        return self._partial(*refused[0]) if refused and judged is not REFUSED else judged

    def _settle(self, members: frozenset[bytes], judged: Any) -> Any:
        if self._suspects(members, judged):
            return clean(self.it.keys, self.cache, lambda: self._finish(judged), lambda why: self._left(judged, why))
        return self._finish(judged)

    def _suspects(self, members: frozenset[bytes], judged: Any) -> bool:
        """Return whether a key may exist that the document does not refer to."""
        if members and self.cache.was_broken_off(self.it.keys.document):
            return True
        if judged is REFUSED or isinstance(judged, Exception):
            # Of nothing that was not there to be deleted, or appended to, there can be leftovers of a broken call.
            return bool(self.it.attachments) or (isinstance(judged, MissingKey) and not self.it.path and bool(members))
        if not members or not self.it.replaces or self.it.gone is not None:
            return False
        # A key below the path that this change did not write: another program put it there, and the cache did not know.
        written = {each.suffix.encode() for each in self.it.attachments}
        return any(member not in written and may_hold(self.it.path, place_of(member)) for member in members)

    def _finish(self, judged: Any) -> Any:
        if judged is REFUSED:
            return diagnose(self.it.keys, self.it.path, self.refusal)
        if isinstance(judged, Exception):
            raise judged
        return judged

    @property
    def _where(self) -> str:
        return show(full(self.it.keys, self.it.path))

    def _partial(self, command: Command, error: Exception) -> PartialWrite:
        left = "what this command should have stored cannot be read: write again"
        if command[0] == "SMEMBERS":
            left = "arrays that it may have replaced stay, unseen, until the next write there"
        return PartialWrite(
            f"{self._where}: the document was written, but not {command[0]} {command[1]!s:.60}: {error}; {left}"
        )

    def _left(self, judged: Any, error: Exception) -> PartialWrite:
        what = "the document was written"
        if judged is REFUSED or isinstance(judged, Exception):
            what = (
                f"the document was not written ({judged})" if judged is not REFUSED else "the document was not written"
            )
        return PartialWrite(
            f"{self._where}: {what}, but arrays that nothing refers to could not be removed: {error}; "
            "they stay, unseen, until the next write there"
        )

    def _untold(self, error: Exception) -> PartialWrite:
        return PartialWrite(
            f"{self._where}: it was refused, but subscribers were told of it, and could not be told otherwise: "
            f"{error}; write again"
        )
