"""A change of one document as a value: what is done, what goes by ship, and what tells subscribers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

from ..errors import MissingKey
from . import Command, Reply
from .keys import Keys
from .paths import Path

__all__ = ["REFUSED", "SILENT", "Change", "EncodedAttachment", "Telling"]

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


class Telling(Protocol):
    """How subscribers are told of one change, in the same transaction.

    Its number is reserved before the change is planned, so that planning uses up nothing.
    """

    def make(self, path: Path) -> Sequence[Command]:
        """Return the commands that tell of a change at `path`, under a number of their own."""
        ...

    def take_back(self) -> None:
        """Note that what was made last was not sent: its number is free for what is made next."""
        ...

    def retract(self, path: Path) -> Sequence[Command]:
        """Return what tells that the server has refused the change after all; nothing if that shows by itself."""
        ...


class _Silent:
    def make(self, path: Path) -> Sequence[Command]:
        return ()

    def take_back(self) -> None:
        return

    def retract(self, path: Path) -> Sequence[Command]:
        return ()


SILENT: Telling = _Silent()
"""Tells nobody."""


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
        notices: What tells subscribers.
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
    notices: Telling = SILENT
    absent: type[Exception] = MissingKey
