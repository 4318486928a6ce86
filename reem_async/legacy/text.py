"""Convert documents that are text on a server with JSON: an RDB file of a server without JSON has moved there."""

from __future__ import annotations

import secrets
from collections.abc import Sequence

from ..errors import BadData, BadKey
from ..plain.documents import is_document
from ..plan import Command, Plan, Reply
from ..plan.attachments import permitted
from ..plan.changes import Announcement
from ..plan.paths import escaped
from ..plan.sizes import STAGED
from ..session import Session
from ..store.document import Turn
from ..store.publish import DocumentPublisher
from ..tools.snapshots.plans import settable
from ..transport import scanned

_TRIES = 50  # as in `convert.py`


async def texts(session: Session) -> list[str]:
    """Return the top-level keys of a session's namespace whose documents are text.

    On a server without JSON there are none. One round trip for about 1000 keys of the server, and one for the strings.
    """
    found: set[str] = set()
    async for page in scanned(session.transport, escaped(session.namespace) + "*", "string"):
        names = [name for name in page if b"{" not in name]
        looks: list[Command] = [look for name in names for look in (("TYPE", name), ("GETRANGE", name, "0", "0"))]
        replies: Sequence[Reply] = await session.run(Plan(looks, list)) if looks else []
        for name, kind, begins in zip(names, replies[::2], replies[1::2], strict=True):
            # On a server without JSON the transport translates the reply to TYPE, so nothing is found there.
            if kind == b"string" and isinstance(begins, bytes) and is_document(begins):
                found |= _named(session, name)
    return sorted(found)


def _named(session: Session, document: bytes) -> set[str]:
    try:
        return {session.keys(document.decode()[len(session.namespace) :]).name}
    except (UnicodeDecodeError, BadKey):
        return set()


class TextConverter:
    """Converts one text to a document of the server's JSON, floats to the last bit. Attachments stay."""

    def __init__(self, session: Session, name: str) -> None:
        self.session = session
        self._writer = DocumentPublisher(session, name)
        self.keys = self._writer.keys

    async def run(self, *, dry_run: bool) -> None:
        """Convert it in one transaction, two round trips; raises BadData if the server refuses the text."""
        await self._writer.in_turn(self._send, dry_run)

    async def _send(self, turn: Turn, dry_run: bool) -> None:
        await self.session.run(self._look(turn.reserve(), dry_run, _TRIES))

    def _look(self, announcement: Announcement, dry_run: bool, tries: int) -> Plan:
        def decode(replies: Sequence[Reply]) -> Plan:
            permitted(replies[0], self.keys.document)
            text = replies[1] if isinstance(replies[1], bytes | bytearray) else b""  # deleted or replaced in between
            ready = settable(bytes(text[1:])) if is_document(text) else b""
            if dry_run or not ready:
                return Plan([("UNWATCH",)], lambda _: None, held=True)
            return self._change(announcement, ready, tries)

        return Plan([("WATCH", self.keys.document), ("GET", self.keys.document)], decode, held=True)

    def _change(self, announcement: Announcement, text: bytes, tries: int) -> Plan:
        # Under another name first: JSON.SET refuses a key that holds a string, and a DEL before it could not be undone
        # if the text is not JSON, since EXEC continues after an error.
        coming = f"{self.keys.tag}{STAGED}{secrets.token_hex(5)}"
        commands: list[Command] = [
            ("JSON.SET", coming, "$", text),
            ("RENAME", coming, self.keys.document),  # refused if JSON.SET was refused: then nothing changes
            *announcement.commands(()),
        ]

        def decode(replies: Sequence[Reply] | None) -> Plan | None:
            if replies is not None:
                for reply in replies[:2]:
                    if isinstance(reply, Exception):
                        raise BadData(f"{self.keys.name}: the server refused its text as JSON: {reply}")
                return None
            announcement.unsent()
            if not tries:
                raise BadData(
                    f"{self.keys.name}: it changed {_TRIES} times in between; end the programs that write to it"
                )
            return self._look(announcement, False, tries - 1)

        return Plan(commands, decode, atomic=True, held=True)
