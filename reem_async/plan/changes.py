"""A change of one document as a value: the command, its attachments, and its announcement to subscribers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from ..errors import MissingKey
from . import Command, Reply
from .keys import Keys
from .paths import Path

REFUSED = object()  # result of `DocumentChange.judge`: the server did nothing and gave no reason


class EncodedAttachment(NamedTuple):
    suffix: str  # the key's name after the tag
    label: str
    commands: tuple[Command, ...]  # what stores it
    blob: tuple[Any, ...] | None = None  # its bytes in pieces, if the ship is a `BlobShip`: a notice can carry them


class Announcement:
    """Notifies subscribers of one change, in the transaction that makes it. This one does nothing.

    The number is reserved before the change is planned, so that planning uses up no number.
    """

    __slots__ = ()

    def commands(self, path: Path) -> Sequence[Command]:
        return ()

    def unsent(self) -> None:
        """Note that the last commands were not sent: the next ones use their number."""

    def retract(self, path: Path) -> Sequence[Command]:
        """Return the commands that correct the announcement of a change which the server refused."""
        return ()

    async def share(self, path: Path) -> None:
        """Put a large value that is about to be set into shared memory. Raises NotConnected; then nothing was set."""

    async def share_early(self, path: Path) -> None:
        """Share the value with the subscribers on this host that are known, without a round trip."""

    def release(self) -> None:
        """Give back a number that was not used; the change is over."""

    def not_applied(self) -> None:
        """Note that the change was sent and not applied: its number is free."""

    def again(self) -> None:
        """Note that the change was not applied, and is sent again with its number."""


SILENT = Announcement()


class DocumentChange(NamedTuple):
    keys: Keys
    path: Path  # the place, below the top-level key. Where it counts from the end of a list, the document is watched
    command: Command
    judge: Callable[[Reply], Any]  # turns that command's reply into the result; raises, or returns `REFUSED`
    attachments: tuple[EncodedAttachment, ...] = ()  # the values that ships store
    replaces: bool = True  # whether the old value at `path` is gone afterwards
    # The suffixes of the attachments that it replaces, known since the document is watched: they are removed in the
    # transaction. None: unknown, so those left over are found in the registry and removed afterwards.
    gone: tuple[bytes, ...] | None = None
    announcement: Announcement = SILENT
    absent: type[Exception] = MissingKey  # the error if a list on the path has no such item from its end
