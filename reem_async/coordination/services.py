"""Services: a function that answers calls of other programs.

Each function that serves has a channel of its own, so the Redis server forgets it when its program ends. A request is
published there and so reaches one server. It waits for its turn, is handled, and the answer is published to the caller.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import functools
import inspect
import logging
import os
import queue
import socket
import statistics
import threading
import time
import traceback
from collections.abc import Callable
from types import TracebackType
from typing import Any, NamedTuple, Self

from ..concurrency.scheduling import take_short_turns
from ..concurrency.tasks import is_being_cancelled
from ..errors import (
    BadData,
    BadType,
    InterfaceClosed,
    NotAllowed,
    RedisError,
    ReemError,
    Refused,
    ServerNotReady,
    WrongLoop,
)
from ..plan import Command
from ..plan.arguments import whole
from ..plan.keys import Keys
from ..plan.notices import Slot
from ..plan.paths import Path, shorten, show
from ..pubsub.listeners import Listener, Topic
from ..pubsub.manager import SubscriptionManager, manager_of
from ..session import Session
from ..store.encoding import Encoder
from . import messages
from .calls import explained, new_id, publish
from .messages import Encoded, Message, Names

logger = logging.getLogger("reem.services")

QUEUE = 100  # requests that wait at most, unless another number is given
_LEFT = 1000  # calls that are remembered as left before their request came: it may be large and on its way
_RETRY = 0.1  # seconds between tries to send an answer while the connection is down
_PAUSE = 0.5  # seconds between tries to begin
_PERIOD, _STALE = 0.25, 0.75  # seconds between looks at whether messages arrive in time, and after which they do not
_SHARED = 2
"""Answers in shared memory that a caller has not taken yet: of the six slots, the caller may look into three."""
_RECENT = 200  # calls whose time is remembered


class _Workers:
    """The threads that call a plain function: as many as calls at a time, and daemons, so no program waits for them."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._jobs: queue.SimpleQueue[tuple[Any, ...] | None] = queue.SimpleQueue()
        self._threads = 0
        self._busy = 0

    async def run(self, function: Callable[..., Any], arguments: dict[str, Any]) -> Any:
        """Call a function on a thread and return what it returns. The call cannot be cancelled."""
        loop = asyncio.get_running_loop()
        done: asyncio.Future[tuple[Any, BaseException | None]] = loop.create_future()
        if self._busy == self._threads:
            threading.Thread(target=_work, args=(self._jobs,), name=self._name, daemon=True).start()
            self._threads += 1
        self._busy += 1
        self._jobs.put((loop, done, function, arguments))
        result, error = await _to_the_end(done)
        self._busy -= 1
        if error is not None:
            raise error
        return result

    def close(self) -> None:
        for _ in range(self._threads):
            self._jobs.put(None)


async def _to_the_end(done: asyncio.Future[Any]) -> Any:
    """Wait for what cannot be cancelled; a task that is cancelled meanwhile ends after it."""
    while not done.done():
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.shield(done)
    return done.result()


def _work(jobs: queue.SimpleQueue[tuple[Any, ...] | None]) -> None:
    take_short_turns()  # it shares the processor with the event loop, which waits for it
    while (job := jobs.get()) is not None:
        loop, done, function, arguments = job
        result, error = None, None
        try:
            result = function(**arguments)
        except BaseException as raised:  # `sys.exit()` cannot end the program from here
            error = raised
        with contextlib.suppress(RuntimeError):  # the event loop has ended
            loop.call_soon_threadsafe(_hand_over, done, (result, error))
        del job, function, arguments, result, error, done  # arrays may be large, and the next call may be hours away


def _hand_over(done: asyncio.Future[Any], outcome: Any) -> None:
    if not done.done():
        done.set_result(outcome)


class _Freshness:
    """Whether messages arrive when they are sent, or wait somewhere first.

    A stopped process, a busy event loop or a link that stood still gets old requests, with the message behind them that
    their callers have left. So after a pause nothing is begun before all that waits has arrived.
    """

    def __init__(self, manager: SubscriptionManager) -> None:
        self._manager = manager
        self._proved = time.monotonic()
        manager.tasks.start(self._keep(), "reem services")

    async def _keep(self) -> None:
        while True:
            with contextlib.suppress(ReemError, RedisError):
                await self.prove()
            await asyncio.sleep(_PERIOD)

    @property
    def is_stale(self) -> bool:
        return time.monotonic() - self._proved > _STALE

    async def prove(self) -> None:
        """Return when all that was published before now has arrived. Raises ConnectionLost."""
        asked = time.monotonic()  # not when the reply was read: this program may have been stopped in between
        await self._manager.fence(())
        self._proved = asked


class _Request:
    """One request, until it is answered or left."""

    def __init__(self, message: Message, now: float) -> None:
        self.message = message
        # The caller says how many seconds are left, since its clock is another one.
        self.deadline = now + message.number
        self.is_left = False  # nothing waits for the answer any more
        self.cancel: Callable[[], object] | None = None  # ends an asynchronous function

    def leave(self) -> None:
        self.is_left = True
        if self.cancel is not None:
            self.cancel()


class _Shared(NamedTuple):
    """An answer in shared memory, until its caller has taken it."""

    request: _Request
    payload: bytes
    memory: object  # keeps the memory from being given back


class Served(Listener):
    """One function that serves in one event loop: its channel, the requests that wait, and those being handled."""

    def __init__(
        self, session: Session, names: Names, function: Callable[..., Any], concurrency: int, bound: int
    ) -> None:
        self.id = new_id()
        super().__init__(Topic(names.channel(self.id).encode()))
        self.takes_messages = True
        self.where = show((names.keys.name, *names.path))
        self._session = session
        self._names = names
        self._function = function
        self._is_async = is_async(function)
        self._concurrency = concurrency
        self._bound = bound
        self._manager = manager_of(session)
        self._workers = _Workers(f"reem serve {self.where}")
        self._requests: dict[str, _Request] = {}  # waiting or being handled, by the id of the call
        self._waiting: collections.deque[_Request] = collections.deque()
        self._running = 0
        self._left: collections.OrderedDict[str, str] = collections.OrderedDict()  # calls and their callers
        self._shared: dict[str, _Shared] = {}  # answers in shared memory that callers have not taken, by call
        self.closed = asyncio.Event()
        self._began = time.monotonic()
        self.calls = self.errors = 0  # how many were answered, and with an exception
        self.times: collections.deque[float] = collections.deque(maxlen=_RECENT)  # seconds that calls took

    async def follow(self) -> None:
        """Begin to serve: when this returns, callers find this server."""
        kept = self._manager.kept
        self._fresh = kept.get(_Freshness) or kept.setdefault(_Freshness, _Freshness(self._manager))
        try:
            await self._manager.follow_here(self)
        except NotAllowed as error:
            raise explained(error) from None
        kept[self.id] = self
        self._session.activities.add_service(self.where)

    async def close(self) -> None:
        """Stop serving. Requests that wait go to other servers, and those being handled are given up."""
        if self.closed.is_set():
            return
        self._end()
        self._manager.kept.pop(self.id, None)
        try:
            await self._manager.unfollow_here(self)
            waiting = {*self._waiting}
            for request in [*self._requests.values()]:
                if not request.is_left:
                    request.leave()
                    kind = messages.CLOSED if request in waiting else messages.DROPPED
                    await self._reply(request.message, self._bare(kind, request.message))
        finally:
            self._waiting.clear()
            self._workers.close()

    def _end(self) -> None:
        self.closed.set()
        self._session.activities.remove_service(self.where)

    def lost(self, reason: Exception) -> None:
        """Go on after a lost connection, which comes back; end with the interface."""
        super().lost(reason)
        if isinstance(reason, InterfaceClosed) and self.ready is None and not self.closed.is_set():
            self._end()
            for request in self._requests.values():
                request.leave()
            self._waiting.clear()
            self._workers.close()

    # Messages.

    def on_message(self, payload: bytes) -> None:
        """Take a message of a caller."""
        message = messages.decode(payload)
        match message.kind:
            case messages.CALL:
                self._take(message)
            case messages.CANCEL:
                request = self._requests.get(message.call)
                if request is None:
                    self._left[message.call] = message.sender
                    if len(self._left) > _LEFT:
                        self._left.popitem(last=False)
                elif request.message.sender == message.sender:
                    request.leave()
                    self._drop_left()
            case messages.PING:
                self._send_soon(message, self._bare(messages.PONG, message))
            case messages.ASKED:
                self._send_soon(message, self._stated(message))
            case messages.RECEIVED | messages.UNREAD:
                sent = self._shared.get(message.call)
                if sent is not None and sent.request.message.sender == message.sender:
                    del self._shared[message.call]
                    if message.kind == messages.UNREAD:
                        self._manager.tasks.start(self._send_again(sent), "reem answer")

    def _take(self, message: Message) -> None:
        if self.closed.is_set():
            self._send_soon(message, self._bare(messages.CLOSED, message))
        elif self._left.pop(message.call, "") != message.sender and message.call not in self._requests:
            if len(self._waiting) >= self._bound:
                self._drop_left()
            if len(self._waiting) >= self._bound and self._running >= self._concurrency:
                self._send_soon(message, self._bare(messages.BUSY, message))
                return
            assert message.content is not None  # the message was checked
            content = message.content.seen(self._session.local.view)  # now: the caller may soon use the memory again
            if content.is_missing:
                self._send_soon(message, self._bare(messages.UNREAD, message))
                return
            message = message._replace(content=content)
            request = self._requests[message.call] = _Request(message, asyncio.get_running_loop().time())
            self._waiting.append(request)
            self._begin_next()

    def _drop_left(self) -> None:
        """Forget requests that wait in vain: their callers have left, or their time is over."""
        now = asyncio.get_running_loop().time()
        for request in [each for each in self._waiting if each.is_left or each.deadline <= now]:
            self._waiting.remove(request)
            self._requests.pop(request.message.call, None)

    def _bare(self, kind: str, message: Message) -> bytes:
        return messages.bare(Message(kind, message.call, self.id, self._busy))

    def _stated(self, message: Message) -> bytes:
        median = f"{statistics.median(self.times):.6f}" if self.times else ""
        age = f"{time.monotonic() - self._began:.1f}"
        words = [socket.gethostname(), str(os.getpid()), str(self.calls), str(self.errors), median, age]
        return messages.bare(Message(messages.STATED, message.call, self.id, self._busy, words))

    @property
    def _busy(self) -> int:
        """How many requests wait or are being handled."""
        return len(self._waiting) + self._running

    def _send_soon(self, message: Message, payload: bytes) -> None:
        self._manager.tasks.start(self._reply(message, payload), "reem answer")

    async def _reply(self, message: Message, payload: bytes) -> None:
        with contextlib.suppress(ReemError, RedisError, OSError):  # the caller's pings find out
            await publish(self._session, self._names.keys, self._channel_to(message), payload)

    def _channel_to(self, message: Message) -> str:
        return messages.answers(self._names.keys, message.sender)

    # Requests.

    def _begin_next(self) -> None:
        while self._running < self._concurrency and self._waiting:
            request = self._waiting.popleft()
            self._running += 1
            self._manager.tasks.start(self._handle(request), f"reem serve {self.where}")

    async def _handle(self, request: _Request) -> None:
        loop = asyncio.get_running_loop()
        timer = loop.call_at(request.deadline, request.leave)
        began = loop.time()
        try:
            if self._fresh.is_stale:
                await self._fresh.prove()
            if not request.is_left and loop.time() < request.deadline:
                await self._answer(request)
                self.times.append(loop.time() - began)
        except (ReemError, RedisError) as error:
            logger.warning("a request of %s was given up: %s", self.where, error)
            self._send_soon(request.message, self._bare(messages.DROPPED, request.message))
        except asyncio.CancelledError:
            if not request.is_left:
                raise
        finally:
            timer.cancel()
            self._requests.pop(request.message.call, None)
            self._running -= 1
            self._begin_next()

    async def _answer(self, request: _Request) -> None:
        message = request.message
        prefix = self._names.answer(message.call)
        encoder = Encoder(self._session, self._names.keys._replace(tag=prefix))
        try:
            arguments = await self._arguments(message)
            if request.is_left:
                return
            result = await self._called(request, arguments)
            del arguments
            if request.is_left:
                return
            value = await encoder.encoded(self._names.path, result)
        except BaseException as error:
            # The function may also raise CancelledError by itself. Ctrl-C ends the program, where it comes at all.
            was_cancelled = isinstance(error, asyncio.CancelledError) and (request.is_left or is_being_cancelled())
            if was_cancelled or (isinstance(error, KeyboardInterrupt) and self._is_async):
                raise
            self._count(failed=True)
            await self._send(request, self._failure(message, error))
        else:
            self._count()
            await self._send_value(request, value, prefix)

    def _count(self, *, failed: bool = False) -> None:
        self.calls += 1
        self.errors += failed

    async def _arguments(self, message: Message) -> dict[str, Any]:
        content, ships = message.content, self._session.ships
        assert content is not None  # the message was checked
        if content.is_stored:
            plan = messages.fetch(content, self._names.request(message.call), ships, self.where)
            pieces = await self._session.run(plan) if plan.commands else [content.data]
        else:
            pieces = messages.pieces_of(content)
        arguments = await messages.opened(content, pieces, ships, self.where)
        if type(arguments) is not dict:
            raise BadData(f"{self.where}: the arguments are {shorten(arguments)}, and not a dict")
        return arguments

    async def _called(self, request: _Request, arguments: dict[str, Any]) -> Any:
        if not self._is_async:
            result = await self._workers.run(self._function, arguments)
            if not inspect.isawaitable(result):
                return result
            waits = result
        else:
            waits = self._function(**arguments)
        task = asyncio.current_task()
        request.cancel = None if task is None else task.cancel
        try:
            return await waits
        finally:
            request.cancel = None

    def _failure(self, message: Message, error: BaseException) -> bytes:
        trace = "".join(traceback.format_exception(type(error), error, _below_ours(error.__traceback__)))
        return messages.failure(message.call, self.id, self._busy - 1, error, trace)

    async def _send_value(self, request: _Request, value: Encoded, prefix: str) -> None:
        answer = Message(messages.ANSWER, request.message.call, self.id, self._busy - 1, [self._session.local.host])
        if messages.is_small(value):
            await self._send(request, messages.inline(answer, value))
            return
        if (slot := self._slot(request, value)) is not None:
            payload = messages.in_slot(answer, value, slot)
            self._shared[answer.call] = _Shared(request, payload, self._session.local.kept(self._answers(request)))
            await self._send(request, payload)
            return
        await self._send_stored(request, answer, value, prefix)

    def _slot(self, request: _Request, value: Encoded) -> Slot | None:
        """Put an answer into shared memory; None if the caller is elsewhere, or has others to take out first."""
        message, local = request.message, self._session.local
        if not local.host or message.words[0] != local.host:
            return None
        now = asyncio.get_running_loop().time()
        for call in [call for call, sent in self._shared.items() if sent.request.deadline < now]:
            del self._shared[call]
        if sum(sent.request.message.sender == message.sender for sent in self._shared.values()) >= _SHARED:
            return None
        return messages.put(local, self._names.keys, self._answers(request), value)

    def _answers(self, request: _Request) -> str:
        return self._channel_to(request.message)

    async def _send_again(self, sent: _Shared) -> None:
        """Send an answer through the server that its caller could not read in shared memory."""
        answer = messages.decode(sent.payload)
        assert answer.content is not None
        content = answer.content.seen(self._session.local.view)
        prefix = self._names.answer(answer.call)
        if content.is_missing:  # the memory is this program's own
            error = BadData(f"{self.where}: the answer is not in shared memory any more")
            await self._send(sent.request, self._failure(sent.request.message, error))
            return
        await self._send_stored(sent.request, answer, messages.again(content, prefix), prefix)

    async def _send_stored(self, request: _Request, answer: Message, value: Encoded, prefix: str) -> None:
        left = max(request.deadline - asyncio.get_running_loop().time(), 0.0)
        payload, commands = messages.stored(answer, value, prefix, left)
        try:
            received = await self._send(request, payload, commands)
        except Refused as error:  # the memory of the Redis server is full, or its user may not write
            await self._send(request, self._failure(request.message, error))
            received = 0
        if not received:
            with contextlib.suppress(ReemError, RedisError, OSError):
                await self._session.transport.roundtrip([("UNLINK", *messages.keys_of(prefix, value))])

    async def _send(self, request: _Request, payload: bytes, commands: list[Command] | None = None) -> int:
        """Publish an answer; while the connection is down, try again until nothing waits for it any more."""
        channel = self._channel_to(request.message)
        while not request.is_left:
            try:
                return await publish(self._session, self._names.keys, channel, payload, commands or ())
            except (ServerNotReady, OSError):
                await asyncio.sleep(_RETRY)
            except Refused:
                raise
            except (ReemError, RedisError) as error:
                if isinstance(error, InterfaceClosed):
                    raise
                await asyncio.sleep(_RETRY)
        return 0


def _below_ours(trace: TracebackType | None) -> TracebackType | None:
    """Return the part of a traceback that begins with the function of the user."""
    while trace is not None and trace.tb_frame.f_globals.get("__name__", "").startswith("reem_async."):
        trace = trace.tb_next
    return trace


def is_async(function: Any) -> bool:
    """Return whether calling it makes a coroutine."""
    return inspect.iscoroutinefunction(function) or inspect.iscoroutinefunction(getattr(function, "__call__", None))  # noqa: B004


class Service:
    """A function that answers the calls of a service; `serve` of an accessor returns it.

    It serves from `listen()` on, or from the next turn of the event loop, until `close()` or the end of the interface;
    `async with` does both. Called like the function, it calls the function.

    Args:
        session: The server.
        keys: The top-level key.
        path: The path below it.
        function: What answers: called with the arguments of a call, by name.
        concurrency: How many calls are handled at a time.
        queue: How many more requests may wait.

    Raises:
        BadType, BadValue: `function` cannot be called, or the others are no whole numbers of at least 1.
    """

    def __init__(
        self,
        session: Session,
        keys: Keys,
        path: Path,
        function: Callable[..., Any],
        concurrency: int = 1,
        queue: int = QUEUE,
    ) -> None:
        if not callable(function):
            raise BadType(f"{show((keys.name, *path))}: cannot serve {shorten(function)}; give serve() a function")
        self.function = function
        self._session = session
        self._names = Names(keys, path)
        self._concurrency = whole("concurrency", concurrency, "give a number of calls at a time, at least 1")
        self._queue = whole("queue", queue, "give a number of requests that may wait, at least 1")
        self._served: Served | None = None
        self._is_closed = False
        self._beginning = asyncio.Lock()
        functools.update_wrapper(self, function, updated=())

    def __call__(self, *args: Any, **arguments: Any) -> Any:
        """Call the function here, in this program."""
        return self.function(*args, **arguments)

    def begin(self) -> None:
        """Begin to serve in the background, as soon as the server answers."""
        try:
            self._session.transport.check()
        except RuntimeError as error:
            if isinstance(error, ReemError):
                raise
            raise WrongLoop(
                "serve() of reem_async needs a running event loop: use it inside of a coroutine, or use reem"
            ) from None
        manager_of(self._session).tasks.start(self._begin(), "reem serve")

    async def _begin(self) -> None:
        while not self._is_closed:
            try:
                await self.listen()
                return
            except (NotAllowed, InterfaceClosed) as error:
                logger.error("cannot serve: %s", error)
                return
            except (ReemError, RedisError) as error:
                logger.warning("not serving yet: %s", error)
                await asyncio.sleep(_PAUSE)

    async def listen(self) -> None:
        """Begin to serve; when this returns, calls find it. Idempotent; one round trip.

        Raises:
            NotConnected: No server.
            NotAllowed: The user lacks a right; says which.
        """
        async with self._beginning:
            if self._served is None or self._served.closed.is_set():
                served = Served(self._session, self._names, self.function, self._concurrency, self._queue)
                await served.follow()
                self._served = served

    async def close(self) -> None:
        """Stop serving. Idempotent; one round trip for each request that waits or is being handled.

        Requests that wait go to other servers. Those being handled raise ServiceLost at their callers; an asynchronous
        function is cancelled.
        """
        self._is_closed = True
        if self._served is not None:
            await self._served.close()

    async def wait(self) -> None:
        """Wait until it has stopped serving: `await service.wait()` is the last line of a program that only serves."""
        if self._served is not None:
            await self._served.closed.wait()

    async def __aenter__(self) -> Self:
        try:
            await self.listen()
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
