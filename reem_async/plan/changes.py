"""A change of one document as a value: what is done, what goes by ship, and what tells subscribers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from ..errors import MissingKey
from . import Command, Reply
from .keys import Keys
from .paths import Path

REFUSED = object()
"""Judging a reply: the server did nothing and did not say why."""


class EncodedAttachment(NamedTuple):
    """An attachment ready to be stored: the commands its ship recorded.

    Attributes:
        suffix: The key's name after the tag.
        label: The ship's label.
        commands: What stores it.
        blob: Its bytes in pieces, where the ship works that way: they can travel in a notice.
    """

    suffix: str
    label: str
    commands: tuple[Command, ...]
    blob: tuple[Any, ...] | None = None


class Announcement:
    """What notifies subscribers of one change, in the transaction that makes it. This one notifies no one.

    Its number is reserved before the change is planned, so that planning uses up nothing.
    """

    __slots__ = ()

    def commands(self, path: Path) -> Sequence[Command]:
        """Return the commands that announce a change at `path`, under a number of their own."""
        return ()

    def unsent(self) -> None:
        """Note that the last commands were not sent: their number is free for the next ones."""

    def retract(self, path: Path) -> Sequence[Command]:
        """Return what announces that the server has refused the change after all; nothing if that shows by itself."""
        return ()

    async def share(self, path: Path) -> None:
        """Put a large value that is about to be set where subscribers of the same host find it.

        Raises:
            NotConnected: The server is out of reach; nothing was set.
        """

    def release(self) -> None:
        """Give back a number that was not used: nothing is to come any more of the change."""

    def not_applied(self) -> None:
        """Note that the change was sent and not applied: its number is free from now on."""


SILENT = Announcement()


class Change(NamedTuple):
    """One change of a document.

    Attributes:
        keys: The document's names.
        path: What is changed, below the top-level key. Where it counts from the end of a list, that list is watched.
        command: The JSON command that does it.
        judge: Turns that command's reply into the result; raises, or returns `REFUSED`.
        attachments: What goes by ship.
        replaces: Whether what was at `path` is gone afterwards.
        gone: The suffixes of those that it replaces, if this is known for certain: the document is watched.
        announcement: What notifies subscribers.
        absent: What to raise if a list on the way has no such item from its end.
    """

    # What becomes of ships' keys that the change leaves without a placeholder:
    #   gone is None    the registry comes back in the same transaction, and what is too much is removed after it
    #   gone is known   the document is watched, so exactly these are removed in the transaction
    keys: Keys
    path: Path
    command: Command
    judge: Callable[[Reply], Any]
    attachments: tuple[EncodedAttachment, ...] = ()
    replaces: bool = True
    gone: tuple[bytes, ...] | None = None
    announcement: Announcement = SILENT
    absent: type[Exception] = MissingKey
