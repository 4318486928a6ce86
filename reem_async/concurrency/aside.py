"""Work that no signal interrupts: it runs on another thread while the caller waits.

Python runs the handlers of signals on the main thread, between any two of its steps. A handler that raises, as
that of Ctrl-C does, ends whatever it has come into: a lock of the import system, of `threading` or of our own may
stay taken for ever. A handler that calls REEM waits for other threads, which may wait for a lock that the main
thread has. So the main thread takes no lock that another thread needs: what takes one (imports, starting a thread,
the handshake of a connection, closing) is done aside, and the main thread waits in one step of C that has no lock.
"""

from __future__ import annotations

import _thread
import threading
from collections.abc import Callable
from contextvars import copy_context
from importlib import import_module
from typing import Any, TypeVar

__all__ = ["aside", "ensure_imported"]

Result = TypeVar("Result")

_imported: set[str] = set()


def aside(function: Callable[[], Result]) -> Result:
    """Run `function` where no handler of signals runs, and return its result or raise what it raises.

    A caller who is interrupted leaves at once; the function goes on to its end, and its result is dropped. Costs
    a thread on the main thread (about 0.1 ms), nothing on others: signals do not come there.
    """
    if _thread.get_ident() != threading.main_thread().ident:
        return function()
    ended = _thread.allocate_lock()
    ended.acquire()
    outcome: list[Any] = []
    context = copy_context()

    def run() -> None:
        try:
            outcome.append((context.run(function), None))
        except BaseException as error:
            outcome.append((None, error))
        finally:
            # Whatever has asked for the current thread has made Python (before 3.13) list this one for good.
            threading._active.pop(_thread.get_ident(), None)  # type: ignore[attr-defined]
            ended.release()

    try:
        _thread.start_new_thread(run, ())  # `Thread.start` would wait for it to begin, and take a lock for that
    except RuntimeError:  # no thread is to be had: too many, or the interpreter is ending
        return function()
    ended.acquire()
    result, error = outcome.pop()
    if error is None:
        return result  # type: ignore[no-any-return]
    try:
        raise error
    finally:
        del error  # it holds this frame


def ensure_imported(name: str) -> None:
    """Import a module that only some programs need, so that an `import` right after it takes no lock."""
    if name not in _imported:
        aside(lambda: import_module(name))
        _imported.add(name)
