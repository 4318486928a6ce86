"""Mailboxes in event loops: updates that publishers on this host send directly, ahead of the server."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..concurrency.locks import Descriptor

if TYPE_CHECKING or hasattr(os, "memfd_create"):  # Linux
    from ..local.mailbox import FOLLOWS, JOINED, SUBSCRIBER, UPDATE, Datagram, Mailbox, is_address, mounted, publishers

# The queue of a publisher often has room for 10 answers. It reads them when it publishes.
_RETRY = 0.03  # seconds until an answer is sent once more
_RETRIES = 10  # of an answer


class LoopMailbox:
    """The mailbox of something in this event loop, opened when it is first needed, and again after `close`.

    Args:
        take: Called with each datagram that arrives.
        at_once: How many are taken in one turn of the event loop.
    """

    def __init__(self, take: Callable[[Datagram], None], at_once: int) -> None:
        self._take_one = take
        self._at_once = at_once
        self._mailbox: Mailbox | None = None
        self._loop = asyncio.get_running_loop()

    def _opened(self) -> Mailbox | None:
        """Return the mailbox; None if no descriptor is left, or another user owns the folder."""
        if self._mailbox is None:
            try:
                self._mailbox = Mailbox(SUBSCRIBER)
            except OSError:
                return None
            self._loop.add_reader(self._mailbox.descriptor, self.read)
        return self._mailbox

    def read(self) -> None:
        """Take what has arrived."""
        for _ in range(self._at_once):
            it = self._mailbox.receive() if self._mailbox is not None else None
            if it is None:
                return
            self._take_one(it)

    def close(self) -> None:
        """Close the mailbox. Idempotent."""
        mailbox, self._mailbox = self._mailbox, None
        if mailbox is not None:
            if not self._loop.is_closed():
                self._loop.remove_reader(mailbox.descriptor)
            mailbox.close()


class EarlyInbox(LoopMailbox):
    """The mailbox of the subscriptions of an event loop; opened when there is an early publisher on this host."""

    def __init__(self, take: Callable[[bytes, bytes, Descriptor | None], None]) -> None:
        super().__init__(self._take_update, 100)
        self._take = take  # called with the channel of an early update, its notice, and the memory of its publisher

    def _opened(self) -> Mailbox | None:
        if self._mailbox is not None and not self._mailbox.is_there:
            self.close()
        return super()._opened()

    def joined(self, channel: bytes) -> None:
        """Notify the early publishers of this host of a new subscriber, so that they ask."""
        addresses = publishers()
        # A publisher of another container finds this one by its mailbox.
        mailbox = self._opened() if addresses or mounted() else None
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

    def _take_update(self, it: Datagram) -> None:
        if it.kind == UPDATE:
            self._take(it.channel, it.content, it.memory)
