"""Messages of services between programs of one user on one host, by datagrams in place of the server.

A caller with `local="early"` names its mailbox in each request. The server then names its own in the answer, and later
requests and answers go from mailbox to mailbox. What a mailbox cannot take at once goes through the server. So do
pings, and so a program that ends, stops or loses its connection is noticed as before.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..errors import BadData
from ..session import Session

if TYPE_CHECKING or hasattr(os, "memfd_create"):  # Linux
    from ..local.mailbox import SUBSCRIBER, Mailbox, is_address

_MESSAGE = b"M"
_LARGEST = 100_000  # bytes of a message: a mailbox takes a little more
_AT_ONCE = 1000  # messages that are taken at a time: more than the kernel queues


class Post:
    """The mailbox of a caller or of a server, opened when it is first needed.

    Args:
        session: Says whether the direct path is allowed, and counts what cannot be read.
        take: Called with each message. It may raise BadData.
    """

    def __init__(self, session: Session, take: Callable[[bytes], None]) -> None:
        self._session = session
        self._take = take
        self._mailbox: Mailbox | None = None
        self._loop = asyncio.get_running_loop()

    @property
    def address(self) -> str:
        """Where others can send to; empty if that cannot be."""
        mailbox = self._opened()
        return mailbox.address if mailbox is not None else ""

    def _opened(self) -> Mailbox | None:
        if self._mailbox is None and self._session.local.host:
            try:
                self._mailbox = Mailbox(SUBSCRIBER)
            except OSError:  # no descriptor is left, or another user owns the folder
                return None
            self._loop.add_reader(self._mailbox.descriptor, self.read)
        return self._mailbox

    def send(self, address: str, payload: bytes) -> bool:
        """Send a message without waiting; return False if its receiver is gone, or has no room for it now."""
        if not address or not is_address(address) or len(payload) > _LARGEST or (mailbox := self._opened()) is None:
            return False
        try:
            mailbox.try_send(address, _MESSAGE, b"", payload)
        except OSError:
            return False
        return True

    def read(self) -> None:
        """Take all that has arrived, at once: the word that a caller has left may wait behind its request."""
        for _ in range(_AT_ONCE):
            it = self._mailbox.receive() if self._mailbox is not None else None
            if it is None:
                return
            try:
                self._take(it.content)
            except BadData:
                self._session.transport.states.unreadable += 1

    def close(self) -> None:
        """Close the mailbox: what is sent to it from now on goes through the server."""
        self.read()
        mailbox, self._mailbox = self._mailbox, None
        if mailbox is not None:
            if not self._loop.is_closed():
                self._loop.remove_reader(mailbox.descriptor)
            mailbox.close()
