"""The facade's event loop: one named daemon thread per interface, started when first needed.

Plain reads and writes never come here: they run on the caller's thread. The loop serves what has to
wait for others: subscriptions, and ships with `async def` methods.

Ctrl-C may interrupt a caller between any two steps.
So there is no lock between callers and the loop: a call is noted, then handed over, and its caller waits for a
token that the loop gives back once. Whatever is still noted when the loop has ended is ended with it.
"""

from __future__ import annotations

import _thread
import asyncio
import contextlib
import os
import socket
import threading
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any, Generic, TypeVar

from reem_async.concurrency.locks import Inherited
from reem_async.errors import InterfaceClosed, WrongLoop

try:
    import uvloop
except ImportError:
    uvloop = None  # type: ignore[assignment]

Result = TypeVar("Result")

_LONGEST_LAST = 2.0
"""Seconds for what a loop runs before its end: more than the core waits for tasks that are slow to end."""
_LONGEST_END = 1.0  # seconds to wait for a thread, which ends at its next look at the interface that is closed
_LONGEST_STOP = 3.0  # seconds to wait for the loop's thread, in which a ship of a user's own may be at work


def finish(coroutine: Coroutine[Any, Any, Result]) -> Result:
    """Run a coroutine that never suspends, and return its result.

    Over a blocking transport the core's coroutines do all their waiting in system calls, so one step
    takes them to the end.
    """
    try:
        coroutine.send(None)
    except StopIteration as end:
        return end.value  # type: ignore[no-any-return]
    # It waits for something: a ship with `async def` methods that was given to plain code, or a mistake of ours.
    coroutine.close()
    raise WrongLoop("this call has to wait for something that only an event loop can do")


class _Call(Generic[Result]):
    """A coroutine on its way through the loop, and the thread that waits for its end.

    All but `wait` and `drop` is for the loop's thread. The token is a bare lock, given back once, at the end.
    """

    def __init__(self, coroutine: Coroutine[Any, Any, Result], noted: set[_Call[Any]]) -> None:
        self._coroutine: Coroutine[Any, Any, Result] | None = coroutine  # until it begins
        self._noted = noted
        self._task: asyncio.Task[Result] | None = None
        self._error: BaseException | None = None
        self._result: Any = None
        self._token = _thread.allocate_lock()
        # Not an Event: Ctrl-C could leave its lock taken.
        self._token.acquire()
        self.over = False

    def begin(self) -> None:
        """Start the coroutine."""
        if self._coroutine is not None:
            self._task = asyncio.get_running_loop().create_task(self._coroutine)
            self._task.add_done_callback(self._take)
            self._coroutine = None

    def _take(self, task: asyncio.Task[Result]) -> None:
        self._task = None  # asyncio's set of all tasks is to lose it on this thread
        if task.cancelled():
            self.end(_closed_meanwhile())
        elif (error := task.exception()) is not None:
            self.end(error)
        else:
            self._result = task.result()
            self.end(None)

    def give_up(self) -> None:
        """Cancel the coroutine: its caller has left."""
        if self._task is not None:
            self._task.cancel()
        elif not self.over:  # its caller was interrupted before it was handed over
            self.end(_closed_meanwhile())

    def end(self, error: BaseException | None) -> None:
        """Let the caller go on. Idempotent."""
        if self.over:
            return
        self.over, self._error = True, error
        self.drop()
        self._token.release()

    def drop(self) -> None:
        """Forget about it; also on its caller's thread, if there is no loop any more."""
        self._noted.discard(self)
        coroutine, self._coroutine = self._coroutine, None
        if coroutine is not None:
            coroutine.close()

    def wait(self) -> Result:
        """Return the coroutine's result, or raise what it raised."""
        self._token.acquire()
        error, self._error = self._error, None
        if error is None:
            return self._result  # type: ignore[no-any-return]
        try:
            raise error
        finally:
            del error  # it holds this frame


def _closed_meanwhile() -> InterfaceClosed:
    return InterfaceClosed("this RedisInterface was closed during the call")


class Portal:
    """An event loop in a daemon thread, and the way into it."""

    def __init__(self, name: str) -> None:
        self._loop = asyncio.new_event_loop() if uvloop is None else uvloop.new_event_loop()
        self._calls: set[_Call[Any]] = set()
        self._ident: int | None = None
        self._is_ending = False  # for the loop's thread
        self._last: Callable[[], Coroutine[Any, Any, None]] | None = None
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)
        try:
            self._thread.start()
        except BaseException:  # Ctrl-C: the thread may run, and has no owner
            self._hand_over(self._loop.stop)
            raise

    def _serve(self) -> None:
        self._ident = _thread.get_ident()
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_forever()
            # Calls that are under way are cancelled, and their callers told, before the loop is closed.
            self._loop.run_until_complete(self._end())
        finally:
            self._loop.close()
            for call in list(self._calls):  # a call that is not noted by now finds the loop closed
                call.end(_closed_meanwhile())

    async def _end(self) -> None:
        try:
            if self._last is not None:
                # A server that does not answer must not keep a program from ending.
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(_LONGEST_LAST):
                        await self._last()
        finally:
            # One turn of the loop: calls that were handed over but not begun become tasks. Then all are cancelled.
            await asyncio.sleep(0)
            self._is_ending = True
            left = asyncio.all_tasks() - {asyncio.current_task()}
            for task in left:
                task.cancel()
            if left:
                await asyncio.wait(left, timeout=1.0)

    @property
    def inside(self) -> bool:
        """Whether the caller is on the loop's own thread."""
        return _thread.get_ident() == self._ident

    def call(self, coroutine: Coroutine[Any, Any, Result]) -> Result:
        """Run `coroutine` on the loop and wait for its result. Ctrl-C cancels it."""
        if self.inside:
            coroutine.close()
            raise WrongLoop(
                "a blocking call of REEM on REEM's own event loop thread would wait for itself; use reem_async there"
            )
        call = _Call(coroutine, self._calls)
        try:
            self._calls.add(call)  # before it is handed over: see `_serve`
            self._hand_over(partial(self._begin, call))
            return call.wait()
        except BaseException:
            if not call.over:
                self._give_up(call)
            raise

    def _begin(self, call: _Call[Any]) -> None:
        """Start a call, unless the loop is about to be closed: nothing would cancel it any more."""
        if self._is_ending:
            call.end(_closed_meanwhile())
        else:
            call.begin()

    def _give_up(self, call: _Call[Any]) -> None:
        try:
            self._hand_over(call.give_up)
        except InterfaceClosed:
            call.drop()

    def _hand_over(self, step: Callable[[], object]) -> None:
        """Have the loop take a step; raises InterfaceClosed."""
        try:
            self._loop.call_soon_threadsafe(step)
        except RuntimeError:
            # uvloop and asyncio raise the same RuntimeError for other mistakes too.
            if not self._loop.is_closed():
                raise
            raise InterfaceClosed("this RedisInterface is closed; make a new one") from None

    def stop(self, last: Callable[[], Coroutine[Any, Any, None]] | None = None) -> None:
        """End the loop and wait for the thread, unless this is it, or it is busy for long.

        Args:
            last: What the loop runs before its end, however late it comes to that.
        """

        def end() -> None:
            self._last = last
            self._loop.stop()

        with contextlib.suppress(InterfaceClosed):
            self._hand_over(end)
        # A finalizer, or a callback, may run on the loop's own thread, which cannot wait for itself.
        if not self.inside:
            self._thread.join(_LONGEST_STOP)


class _LastLoop(asyncio.SelectorEventLoop):
    """An event loop that needs no threads: asyncio looks names up in some, which cannot start any more."""

    async def getaddrinfo(self, host: Any, port: Any, **how: Any) -> Any:
        return socket.getaddrinfo(host, port, **how)


class LastPortal:
    """What takes the place of a Portal while the interpreter exits, when no thread can start any more."""

    def call(self, coroutine: Coroutine[Any, Any, Result]) -> Result:
        """Run `coroutine` on an event loop of this call."""
        with asyncio.Runner(loop_factory=_LastLoop) as runner:
            return runner.run(coroutine)

    def stop(self, last: Callable[[], Coroutine[Any, Any, None]] | None = None) -> None:
        """Return: the loop has ended with the call."""


class Threads:
    """The background threads of one interface. They are daemons: a program that ends does not wait for them."""

    def __init__(self) -> None:
        self._begin()
        _every.add(self)

    def _begin(self) -> None:
        """Begin without threads; in a forked child too, which does not have those of its parent."""
        self._running: set[threading.Thread] = set()
        self._ended = threading.Event()

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

    @property
    def place(self) -> object:
        """The process that threads run in."""
        return os.getpid()

    async def pause(self, seconds: float) -> None:
        """Wait in one of the threads, until the interface is closed at the latest."""
        self._ended.wait(seconds)

    async def end(self) -> None:
        """Wait until all have ended, but for the one that asks for it; the interface is closed before."""
        self._ended.set()
        for thread in list(self._running):
            if thread is not threading.current_thread():
                thread.join(_LONGEST_END)


_every = Inherited(Threads._begin)
