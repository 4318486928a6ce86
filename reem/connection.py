"""RedisInterface for plain scripts: the core's, with blocking calls."""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import sys
import weakref
from collections.abc import Callable, Coroutine, Iterator
from importlib import import_module
from operator import attrgetter
from threading import Thread, current_thread, main_thread
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import reem_async
from reem_async.concurrency.queues import BoundedQueue
from reem_async.concurrency.tasks import take_short_turns
from reem_async.connection import rebuilt
from reem_async.errors import SELF_EXPLANATORY, InterfaceClosed, Stale
from reem_async.pubsub.callbacks import Caller
from reem_async.transport import NewTransport
from reem_async.transport.blocking import BlockingTransport, keep_open_at_exit
from reem_async.transport.client import client

from ._portal import LastPortal, Portal, Threads, finish
from ._twin import calls, documented_by, makes, runs, shares, takes
from .following import NodeWatch, StateIterator

__all__ = [  # noqa: F822 - all but RedisInterface stood here in REEM 0.1.x, and old programs import it from here
    "ROOT_PATH", "ROOT_VALUE_SEQUENCE", "SEPARATOR_CHARACTER", "CallbackSubscriber", "KeyValueStore",
    "NumpyMarshaller", "NumpyShip", "PublishSpace", "PublishWriter", "Publisher", "Reader", "RedisInterface",
    "SilentSubscriber", "SpecialDatatypeMarshaller", "SpecialDatatypeShip", "Writer", "append_to_path",
    "check_valid_key_name", "check_valid_key_name_ext", "copy_dictionary_without_paths", "extract_object",
    "filter_paths_by_prefix", "insert_into_dictionary", "key_sequence_to_path", "key_sequence_to_path_ext",
    "path_to_key_sequence",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # Only when one is asked for, since `reem` imports this module.
    reem = import_module("reem")
    return getattr(reem if hasattr(reem, name) else import_module("reem.legacy"), name)


Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class _OnThread(reem_async.RedisInterface):
    """The core's interface over connections that the caller's own thread drives."""

    _new_transport: NewTransport = BlockingTransport

    def _new_client(self) -> Any:
        return client(self.session.options)

    async def _close_client(self) -> None:
        self._client.close()


class _Background:
    """The event loop of an interface and the core's interface on it, made when first needed.

    Threads do not survive a fork, so each process has its own loop. There is no lock: the second thread finds what the
    first has made, and what is made while the interface is being closed is stopped by the last one to see it.

    While the interpreter exits there is no loop thread: each call runs an event loop of its own on the caller's thread.
    """

    def __init__(self, direct: reem_async.RedisInterface) -> None:
        self._direct = direct
        self._made: dict[int, tuple[Portal | LastPortal, reem_async.RedisInterface]] = {}
        self.callers: weakref.WeakSet[Thread] = weakref.WeakSet()  # the threads that make calls for updates

    def started(self) -> tuple[Portal | LastPortal, reem_async.RedisInterface]:
        """Return both, starting them if need be; raises InterfaceClosed."""
        # First, so that nothing is started for an interface that is closed.
        self._direct.session.transport.check()
        return self._made.get(os.getpid()) or self._begun()

    def _begun(self) -> tuple[Portal | LastPortal, reem_async.RedisInterface]:
        # After a fork it is the parent's: what was made from it goes on here, and ends with the rest.
        before = [*self._made.values()]
        if before:
            interface = before[0][1]
        else:
            host, ships, settings = self._direct._given
            # The other one has the name.
            interface = reem_async.RedisInterface(host, ships, **{**settings, "name": None})
            interface.session.share_with(self._direct.session)
        portal = LastPortal() if _exiting else Portal("reem-loop")
        # One step of C, so of two threads that come here at once the second finds what the first has made.
        made = self._made.setdefault(os.getpid(), (portal, interface))
        if made[0] is not portal:
            portal.stop()
        try:
            # It may have been closed while this was made: then nothing else would stop it.
            self._direct.session.transport.check()
        except InterfaceClosed:
            self.stop()
            raise
        return made

    def close(self) -> None:
        """Close all connections and end the loop. Idempotent; a caller that was interrupted may call it again."""
        # The connections of calling threads go first, so that their calls end while the loop still answers.
        finish(self._direct.close())
        self.stop()

    def stop(self) -> None:
        """End the loop and what it follows. Idempotent."""
        pid = os.getpid()
        if pid in self._made:
            portal, interface = self._made[pid]
            # Loops in other threads end at once: the event loop may be busy, and this may be a callback on its thread.
            if interface.session.subscriptions is not None:
                interface.session.subscriptions.end_loops()
            portal.stop(interface.session.release if _exiting else interface.close)
            # Not before: an interrupted caller tries again.
            if _exiting:
                self._made[pid] = LastPortal(), interface
                # Python deletes no object of a module to which a thread refers, so it would not call `__del__`. These
                # threads have the program's functions.
                for thread in set(self.callers) - {current_thread()}:
                    thread.join(_LONGEST_CALL)
            else:
                self._made.pop(pid, None)


_LONGEST_CALL = 1.0  # seconds to wait at exit for a callback that is being called
_interfaces: weakref.WeakSet[RedisInterface] = weakref.WeakSet()
_exiting = False


@atexit.register
def _end_loops() -> None:
    """End the loop threads before the interpreter freezes them somewhere.

    Connections of calling threads stay open: an exit function that was registered before REEM was imported, a log
    handler that is flushed at exit and `__del__` come later, and may still write. The process closes them.
    """
    global _exiting
    _exiting = True
    for each in list(_interfaces):
        finish(each._direct.session.finish(is_exit=True))
        each._background.stop()
        each._closing.detach()  # it would keep a ship, and with it all that the ship's module has
    keep_open_at_exit()


def _is_left_over() -> bool:
    """Return whether this is a daemon thread that still runs while the interpreter ends."""
    return current_thread().daemon and not main_thread().is_alive()


@contextlib.contextmanager
def quiet_at_exit() -> Iterator[None]:
    """End a daemon thread without a message if what it follows has ended with the program."""
    try:
        yield
    except (InterfaceClosed, Stale):
        if _is_left_over():
            raise SystemExit from None
        raise


_DIRECT = attrgetter("_direct")


@documented_by(reem_async.RedisInterface)
class RedisInterface:
    """A connection to one server; everything else is made from it."""

    @takes(reem_async.RedisInterface.__init__)  # type: ignore[arg-type]  # no option has the name `self`
    def __init__(self, *given: Any, **options: Any) -> None:
        self._direct = _OnThread(*given, **options)
        self._direct.session.tasks = Threads()
        self._background = _Background(self._direct)
        self._closing = weakref.finalize(self, self._background.close)
        self._closing.atexit = False
        _interfaces.add(self)  # see `_end_loops`

    hostname = shares(reem_async.RedisInterface.hostname, _DIRECT)
    namespace = shares(reem_async.RedisInterface.namespace, _DIRECT)
    client = shares(reem_async.RedisInterface.client, _DIRECT)
    state = shares(reem_async.RedisInterface.state, _DIRECT)
    unreadable = shares(reem_async.RedisInterface.unreadable, _DIRECT)
    states = makes(reem_async.RedisInterface.states, StateIterator, _DIRECT)
    on_state = calls(reem_async.RedisInterface.on_state, _DIRECT)
    nodes = runs(reem_async.RedisInterface.nodes)
    clock = runs(reem_async.RedisInterface.clock)
    watch_nodes = makes(reem_async.RedisInterface.watch_nodes, NodeWatch, attrgetter("_followers"))
    initialize = runs(reem_async.RedisInterface.initialize)

    @property
    def _interface(self) -> RedisInterface:
        return self

    @property
    def _core(self) -> reem_async.RedisInterface:
        """The core's interface that stores are made from."""
        return self._followers if self._direct.session.ships.asynchronous else self._direct

    @property
    def _followers(self) -> reem_async.RedisInterface:
        """The core's interface that subscribers are made from: it lives on the background loop."""
        return self._background.started()[1]

    def _run(self, coroutine: Coroutine[Any, Any, Result]) -> Result:
        """Run one of the core's coroutines on a store to its end and return the result."""
        try:
            # Ships with `async def` methods need a loop. Else the loop's own thread may call too, in a log handler or
            # a `__del__`: the call waits for the server alone.
            return self._wait(coroutine) if self._direct.session.ships.asynchronous else finish(coroutine)
        except SELF_EXPLANATORY as error:  # forty lines of ours between the caller's and the message would not help
            self._broken_off()
            raise error.with_traceback(None) from None
        except BaseException:
            self._broken_off()
            raise

    def _broken_off(self) -> None:
        """Give back what this thread holds, unless this call came out of another one, by way of a ship or `__del__`."""
        frame = sys._getframe(1).f_back
        while frame is not None:
            if frame.f_code is RedisInterface._run.__code__ and frame.f_locals.get("self") is self:
                return
            frame = frame.f_back
        self._direct.session.transport.broken_off()

    def _wait(self, coroutine: Coroutine[Any, Any, Result]) -> Result:
        """Run one of the core's coroutines on the background loop and return the result."""
        try:
            portal = self._background.started()[0]
        except BaseException:
            coroutine.close()
            raise
        try:
            return portal.call(coroutine)
        except InterfaceClosed:
            if _is_left_over():
                raise SystemExit from None  # the thread is about to be stopped anyway, without a word
            raise

    def _calling(self, name: str, caller: Caller, queue: BoundedQueue, owner: object = None) -> Thread:
        """Start a thread that calls a function of the program for each update in a queue. It keeps the `owner`."""

        def call_all(_: object) -> None:
            take_short_turns()  # the event loop's thread has had its wake-up before: waiting once in line is enough
            try:
                while True:
                    caller.call_on_thread(queue.take_waiting(), queue.dropped)
            except Exception as reason:
                caller.ended(reason)

        thread = Thread(target=call_all, args=[owner], name=f"reem {name}", daemon=True)
        thread.start()
        self._background.callers.add(thread)
        return thread

    def _end(self, coroutine: Coroutine[Any, Any, None]) -> None:
        """Do what `_wait` does, or nothing: whatever closed the interface has ended this too."""
        with contextlib.suppress(InterfaceClosed):
            self._wait(coroutine)

    def close(self) -> None:
        """End all subscriptions and close all connections."""
        self._background.close()
        self._closing.detach()

    def __enter__(self) -> Self:
        try:
            self.initialize()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt, (type(self), *self._direct._given)

    def __repr__(self) -> str:
        return f"<reem.RedisInterface {self.hostname}>"


def blocking(
    call: Callable[Concatenate[reem_async.RedisInterface, Arguments], Coroutine[Any, Any, Result]],
) -> Callable[Concatenate[RedisInterface, Arguments], Result]:
    """Return the blocking form of a coroutine function of the core, which runs on the background loop."""

    @functools.wraps(call)
    def run(interface: RedisInterface, *args: Arguments.args, **options: Arguments.kwargs) -> Result:
        return interface._wait(call(interface._followers, *args, **options))

    return run  # type: ignore[return-value]  # it also takes the interface by name
