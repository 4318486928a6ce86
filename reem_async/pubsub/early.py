"""Updates that publishers on this host send directly, ahead of the server (`local/mailbox.py`)."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING or hasattr(os, "memfd_create"):  # Linux
    from ..local.mailbox import FOLLOWS, JOINED, SUBSCRIBER, UPDATE, Mailbox, is_address, publishers

_AT_ONCE = 100  # datagrams that are taken in one turn of the event loop
# The queue of a publisher often has room for 10 answers. It reads them when it publishes.
_RETRY = 0.03  # seconds until an answer is sent once more
_RETRIES = 10  # of an answer


class EarlyInbox:
    """The mailbox of the subscriptions of an event loop; opened when there is an early publisher on this host."""

    def __init__(self, take: Callable[[bytes, bytes], None]) -> None:
        self._take = take  # called with the channel of an early update, and its notice
        self._mailbox: Mailbox | None = None
        self._loop = asyncio.get_running_loop()

    def _opened(self) -> Mailbox | None:
        if self._mailbox is not None and not self._mailbox.is_there:
            self.close()
        if self._mailbox is None:
            try:
                self._mailbox = Mailbox(SUBSCRIBER)
            except OSError:  # no descriptor is left: updates arrive through the server
                return None
            self._loop.add_reader(self._mailbox.descriptor, self.read)
        return self._mailbox

    def joined(self, channel: bytes) -> None:
        """Notify the early publishers of this host of a new subscriber, so that they ask."""
        addresses = publishers()
        mailbox = self._opened() if addresses else None
        if mailbox is not None:
            for address in addresses:
                mailbox.send(address, JOINED, channel)

    def answer(self, channel: bytes, publisher: bytes) -> None:
        """Answer a publisher that asks, through the server, for the subscribers of a channel."""
        address = publisher.decode(errors="replace")
        if is_address(address) and self._opened() is not None:
            self._answer(channel, address, _RETRIES)

    def _answer(self, channel: bytes, address: str, retries: int) -> None:
        mailbox = self._mailbox
        if mailbox is None:
            return
        try:
            mailbox.try_send(address, FOLLOWS, channel, mailbox.address.encode())
        except BlockingIOError:  # many subscribers have answered
            if retries:
                self._loop.call_later(_RETRY, self._answer, channel, address, retries - 1)
        except OSError:  # the publisher is gone, or the system has no memory for it now
            pass

    def read(self) -> None:
        """Take what has arrived."""
        mailbox = self._mailbox
        for _ in range(_AT_ONCE if mailbox is not None else 0):
            it = mailbox.receive() if mailbox is not None else None
            if it is None:
                return
            if it.kind == UPDATE:
                self._take(it.channel, it.content)

    def close(self) -> None:
        """Close the mailbox; it opens again for a new subscription."""
        if self._mailbox is not None:
            if not self._loop.is_closed():
                self._loop.remove_reader(self._mailbox.descriptor)
            self._mailbox.close()
            self._mailbox = None
