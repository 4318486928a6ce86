"""Probes of subscription connections: they show a dead one, a lost last update, a document that is gone."""

from __future__ import annotations

import asyncio
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

from ..concurrency.tasks import Tasks
from ..plan import Command, Reply
from ..transport.wire import Wire
from .listeners import Listener

__all__ = ["Heartbeats"]

_PERIOD = 1.0
"""Seconds between looks at a connection; one that is dead shows a call's time limit later."""


class Heartbeats:
    """Asks over each connection for the notes of the last updates, every second.

    Asks for the types of documents as often as their listeners need it. This also makes the server notice a key whose
    time to live has passed. Belongs to an event loop.

    Args:
        tasks: Where the looks run.
        listeners: Returns who listens over a connection.
        forget: Called every second: forgets what nobody listens to any more, and returns who is left.
        answered: Called when a connection has answered.
        on_note: Called with a listener and the server's note for it, or an error of the server.
    """

    def __init__(
        self,
        tasks: Tasks,
        listeners: Callable[[Wire], list[Listener]],
        forget: Callable[[], list[Listener]],
        answered: Callable[[], None],
        on_note: Callable[[Listener, Reply], None],
    ) -> None:
        self._tasks = tasks
        self._listeners = listeners
        self._forget = forget
        self._answered = answered
        self._on_note = on_note
        self._period = _PERIOD
        self._beating: dict[Wire, asyncio.Task[Any]] = {}

    def start(self, wire: Wire) -> None:
        """Look at a new connection."""
        self._beating[wire] = self._tasks.start(self._beat(wire), "reem heartbeat")

    def lost(self, wire: Wire) -> None:
        """A connection is gone; its task ends by itself."""
        self._beating.pop(wire, None)

    def hurry(self, seconds: float) -> None:
        """Look that often while a listener needs it, if that is more often than until now."""
        if seconds < self._period:
            self._period = seconds
            for wire, task in list(self._beating.items()):
                task.cancel()
                self.start(wire)

    async def _beat(self, wire: Wire) -> None:
        loop = asyncio.get_running_loop()
        looked = loop.time()
        while True:
            await asyncio.sleep(self._period)
            if not wire.alive:
                return
            notes, answered, now = [], loop.create_future(), loop.time()
            if now - looked > _PERIOD - self._period / 2:
                looked = now
                self._period = self._needed()
                notes = self._notes(wire)
            asked: list[Command] = [("GET", note) for note in notes] or [("PING",)]
            self._probe(wire, now)
            wire.send(asked, partial(self._on_notes, wire, notes, answered))
            await answered  # a connection breaks only if nothing newer waits on it

    # Functions of their own, since a task that held listeners while it waits would keep those that are dropped.

    def _needed(self) -> float:
        """Return the seconds between looks that those who still listen need."""
        return min([_PERIOD, *(listener.heartbeat for listener in self._forget())])

    def _notes(self, wire: Wire) -> list[str]:
        """Return the notes to ask for."""
        return sorted({listener.note for listener in self._listeners(wire) if listener.note is not None})

    def _probe(self, wire: Wire, now: float) -> None:
        """Ask for the types of the documents that are due by the middle of this period."""
        documents: dict[str, list[weakref.ref[Listener]]] = {}
        for listener in self._listeners(wire):
            if (document := listener.probe(now + self._period / 2)) is not None:
                documents.setdefault(document, []).append(weakref.ref(listener))
        if documents:
            asked: list[Command] = [("TYPE", document) for document in documents]
            wire.send(asked, partial(self._on_probes, list(documents.values()), now))

    def _on_probes(self, asked: list[list[weakref.ref[Listener]]], sent: float, kinds: list[Reply] | Exception) -> None:
        if isinstance(kinds, Exception):
            return
        for group, kind in zip(asked, kinds, strict=True):
            for reference in group:
                if (listener := reference()) is not None:
                    listener.on_probe(kind, sent)

    def _on_notes(
        self, wire: Wire, names: list[str], answered: asyncio.Future[None], notes: list[Reply] | Exception
    ) -> None:
        if not answered.done():  # cancelled
            answered.set_result(None)
        if isinstance(notes, Exception):
            return
        self._answered()
        if not names:
            return
        found = dict(zip(names, notes, strict=False))
        for listener in self._listeners(wire):
            if listener.note in found:
                self._on_note(listener, found[listener.note])
