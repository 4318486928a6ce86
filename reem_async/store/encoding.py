"""Encode the values of calls: the text of the document, and the attachments."""

from __future__ import annotations

import inspect
import secrets
from collections.abc import Sequence
from typing import Any

from ..plan import Command
from ..plan.changes import EncodedAttachment
from ..plan.documents import Attachment, plain, walk
from ..plan.keys import Keys
from ..plan.paths import Path, has_index, show, suffix
from ..plan.sizes import check_sizes, sizes_of
from ..session import Session

HUGE = 256 << 20  # bytes from which the size of a value is checked exactly; a ship may need more than it says

Encoded = tuple[bytes, tuple[EncodedAttachment, ...]]


def unique_tail() -> str:
    """Return a tail for names of attachments: in lists items move while their attachments keep their names."""
    # 40 bits, behind the path: no two arrays in the lists of one top-level key get the same name by chance.
    return secrets.token_hex(5)


class Encoder:
    def __init__(self, session: Session, keys: Keys) -> None:
        self._session = session
        self._keys = keys

    def plain(self, path: Path, value: Any) -> bytes | None:
        """Return the text of a value that is plain JSON; None for any other. Its size is not checked."""
        # A ship may claim types that orjson would write itself: then every value is walked through.
        return None if self._session.ships.asks_first else plain(value, len(path))

    async def encoded(self, path: Path, value: Any, tail: str | None = None) -> Encoded:
        """Encode a value for `path`; raises BadInput.

        `tail` ends the names of attachments; if it is None, one is made if the path leads through a list.
        """
        text = self.plain(path, value)
        if text is None:
            return await self.walked(path, value, tail)
        self.check_sizes(path, [text])
        return text, ()

    async def walked(self, path: Path, value: Any, tail: str | None = None) -> Encoded:
        """Encode a value that is not plain JSON, visiting each part of it."""
        if tail is None:
            tail = unique_tail() if has_index(path) else ""
        ships = self._session.ships
        fits: Any = ships.fits
        if ships.asynchronous:
            await ships.ready()
            # Before the walk, which cannot wait.
            fits = await ships.choices(value)

        def name(inner: Path) -> str:
            return suffix(path + inner) + (f"~{tail}" if tail else "")

        found = walk(value, (self._keys.name, *path), fits, name, ships.claimed)
        # First a quick check by the sizes that ships name, then an exact one near the limits of servers.
        is_huge = len(found.text) + sum([each.size for each in found.attachments]) > HUGE
        # Before packing too, which copies an array that takes no memory (np.broadcast_to) in full.
        if is_huge and (exact := [each for each in found.attachments if each.ship.describes_exactly]):
            check_sizes([(self._where(each.suffix), each.size) for each in exact])
        attachments = [
            self._packed(each) if each.ship.blob is not None else await self._recorded(each)
            for each in found.attachments
        ]
        self.check_sizes(path, [found.text], attachments)
        return found.text, tuple(attachments)

    def check_sizes(self, path: Path, texts: Sequence[bytes], attachments: Sequence[EncodedAttachment] = ()) -> None:
        """Raise BadValue if the server would close the connection because of the size of the call."""
        each_size = [(self._where(each.suffix), sizes_of(each.commands)) for each in attachments]
        if sum(map(len, texts)) + sum([sum(sizes) for _, sizes in each_size]) > HUGE:
            whole = show((self._keys.name, *path))
            check_sizes(
                [(whole, len(text)) for text in texts] + [(where, size) for where, sizes in each_size for size in sizes]
            )

    def _where(self, suffix: str) -> str:
        return self._keys.name + suffix.partition("~")[0]

    def _packed(self, attachment: Attachment) -> EncodedAttachment:
        blob = attachment.ship.blob.pack(attachment.value)
        # Header and data stay apart: the transport sends the pieces as they are, so an array is not copied.
        command = ("SET", self._keys.tag + attachment.suffix, blob[0] if len(blob) == 1 else blob)
        return EncodedAttachment(attachment.suffix, attachment.ship.label, (command,), blob)

    async def _recorded(self, attachment: Attachment) -> EncodedAttachment:
        key, ship = self._keys.tag + attachment.suffix, attachment.ship
        # The client that the ship writes to only records the commands.
        recorder = self._session.ships.new_recorder()
        result = ship.ship.write(key, attachment.value, recorder)
        if inspect.isawaitable(result):
            await result
        commands: tuple[Command, ...] = tuple(recorder.commands)
        return EncodedAttachment(attachment.suffix, ship.label, commands)
