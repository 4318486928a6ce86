"""What runs beside the calls of an interface that has no event loop: each coroutine on a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Coroutine
from typing import Any

from ._portal import finish

__all__ = ["Threads"]

_LONGEST_END = 1.0
"""Seconds to wait for a thread, which ends at its next look at the interface that is closed."""


class Threads:
    """The background threads of one interface. They are daemons: a program that ends does not wait for them."""

    def __init__(self) -> None:
        self._running: set[threading.Thread] = set()

    def start(self, coroutine: Coroutine[Any, Any, Any], name: str) -> None:
        """Run a coroutine of the core, which does all its waiting in system calls."""
        thread = threading.Thread(target=self._run, args=(coroutine,), name=name, daemon=True)
        self._running.add(thread)
        try:
            thread.start()
        except Exception:  # there are too many threads, or the interpreter is ending: nothing is to wait for this one
            self._running.discard(thread)
            coroutine.close()
            raise

    def _run(self, coroutine: Coroutine[Any, Any, Any]) -> None:
        try:
            finish(coroutine)
        finally:
            self._running.discard(threading.current_thread())

    async def end(self) -> None:
        """Wait until all have ended, but for the one that asks for it; the interface is closed before."""
        for thread in list(self._running):
            if thread is not threading.current_thread():
                thread.join(_LONGEST_END)
