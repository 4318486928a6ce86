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
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import Any, Generic, ParamSpec, Self, TypeVar

from ..concurrency.tasks import is_being_cancelled, take_short_turns
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
from ..plan import Command, Reply
from ..plan.arguments import whole
from ..plan.keys import Keys
from ..plan.paths import Path, shorten, show
from ..plan.typed import Signature
from ..pubsub.listeners import Listener, Topic
from ..pubsub.manager import manager_of
from ..session import Session
from ..store.publish import publisher
from . import messages
from .calls import Post, encoded_objects, naming_rights, new_id, opened, publish
from .messages import Encoded, Message, Names, Put

logger = logging.getLogger("reem.services")

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

QUEUE = 100  # requests that wait at most, unless another number is given
_LEFT = 1000  # calls that are remembered as left before their request came: it may be large and on its way
_RETRY = 0.1  # seconds between tries to send an answer while the connection is down
_PAUSE = 0.5  # seconds between tries to begin
_PERIOD, _STALE = 0.25, 0.75  # seconds between probes whether messages arrive in time, and after which they do not
_REMEMBERED = 20  # answers in shared memory that may have to be sent again
_LONGEST_RECORD = 10.0  # seconds for which calls are published unless a recorder asks again
CALLS = "_calls"  # the key under which calls are published while a recorder asks for them, by service
_RECENT = 200  # calls whose time is remembered


class Workers:
    """The threads that call a plain function: as many as calls at a time, and daemons, so no program waits for them."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._jobs: queue.SimpleQueue[tuple[Any, ...] | None] = queue.SimpleQueue()
        self._threads = 0
        self._busy = 0

    async def run(self, function: Callable[..., Any], arguments: dict[str, Any]) -> Any:
        loop = asyncio.get_running_loop()
        done: asyncio.Future[tuple[Any, BaseException | None]] = loop.create_future()
        if self._busy == self._threads:
            threading.Thread(target=_work, args=(self._jobs,), name=self._name, daemon=True).start()
            self._threads += 1
        self._busy += 1
        self._jobs.put((loop, done, function, arguments))
        result, error = await done
        self._busy -= 1
        if error is not None:
            raise error
        return result

    def close(self) -> None:
        """End the threads, each after its call."""
        for _ in range(self._threads):
            self._jobs.put(None)


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
    if not done.done():  # cancelled with the interface
        done.set_result(outcome)


class Request:
    def __init__(self, message: Message, leave: Callable[[Request], None], is_stale: bool) -> None:
        loop = asyncio.get_running_loop()
        self.message = message
        # The caller says how many seconds are left, since its clock is another one.
        self.deadline = loop.time() + message.number
        self.timer = loop.call_at(self.deadline, leave, self)
        self.is_stale = is_stale  # it may have been on its way for long, and its caller may have left
        self.is_left = False  # nothing waits for the answer any more
        self.cancel: Callable[[], object] | None = None  # ends an asynchronous function
        self.record: dict[str, Any] | None = None  # what is published of it for recorders


class Served(Listener):
    """One function that serves in one event loop.

    A request waits, is handled, and is over. It is in `_waiting` or `_handled`, and in neither afterwards.
    """

    def __init__(
        self, session: Session, names: Names, function: Callable[..., Any], concurrency: int, bound: int
    ) -> None:
        self.id = new_id()
        super().__init__(Topic(names.channel(self.id).encode()))
        self.takes_messages = True
        self.heartbeat = _PERIOD
        self.where = show((names.keys.name, *names.path))
        self._session = session
        self._names = names
        self._function = function
        self._signature = Signature(function)
        self._is_async = is_async(function)
        self._concurrency = concurrency
        self._bound = bound
        self._manager = manager_of(session)
        self._workers = Workers(f"reem serve {self.where}")
        self._waiting: collections.OrderedDict[str, Request] = collections.OrderedDict()  # by the id of the call
        self._handled: dict[str, Request] = {}
        self._left: collections.OrderedDict[str, str] = collections.OrderedDict()  # calls and their callers
        self._shared: collections.deque[tuple[Request, bytes]] = collections.deque(maxlen=_REMEMBERED)
        self._post = Post(session, self.on_message)
        self.closed = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        # All that was sent before this had arrived by now; see `_handle`.
        self._proved = self._loop.time()
        self._calls = self._errors = 0  # how many were answered, and with an exception
        self._recorded_until = 0.0  # calls are published until then
        # When the last calls ended, and how many seconds they took
        self._times: collections.deque[tuple[float, float]] = collections.deque(maxlen=_RECENT)

    async def follow(self) -> None:
        """Begin to serve: when this returns, callers find this server."""
        with naming_rights():
            await self._manager.follow_here(self)
        self._manager.kept[self.id] = self
        self._session.activities.add_service(self.where)

    async def close(self) -> None:
        """Stop serving. Requests that wait go to other servers, and those being handled are given up."""
        if not self.closed.is_set():
            self._manager.kept.pop(self.id, None)
            waiting = [each.message for each in self._waiting.values()]
            self._end()
            await self._manager.retire(self)  # what comes until then is answered with CLOSED
            for message in waiting:
                await self._reply(message, messages.CLOSED)

    def _end(self) -> None:
        self.closed.set()
        self._session.activities.remove_service(self.where)
        for request in [*self._waiting.values(), *self._handled.values()]:
            self._leave(request)
        self._workers.close()
        self._post.close()

    # What the subscription manager calls.

    def lost(self, reason: Exception) -> None:
        """Go on after a lost connection, which comes back; end with the interface."""
        super().lost(reason)
        if isinstance(reason, InterfaceClosed) and self.id in self._manager.kept and not self.closed.is_set():
            self._end()

    def probe(self, now: float) -> str:
        """Ask for anything: only the time counts."""
        return self._names.keys.document

    def on_probe(self, kind: Reply, sent: float) -> None:
        """Note that what was sent until then has arrived."""
        self._post.read()
        self._proved = sent

    def on_message(self, payload: bytes) -> None:
        message = messages.decode(payload, self._session.local.view)
        match message.kind:
            case messages.CALL:
                self._take(message)
            case messages.CANCEL:
                request = self._waiting.get(message.call) or self._handled.get(message.call)
                if request is None:
                    self._left[message.call] = message.sender
                    if len(self._left) > _LEFT:
                        self._left.popitem(last=False)
                elif request.message.sender == message.sender:
                    self._leave(request)
            case messages.PING:
                if message.number:
                    self._recorded_until = self._loop.time() + min(message.number, _LONGEST_RECORD)
                self._reply_soon(message, messages.PONG)
            case messages.UNREAD:
                for request, answer in self._shared:
                    if (request.message.call, request.message.sender) == (message.call, message.sender):
                        self._manager.tasks.start(self._send_again(request, answer), "reem answer")

    def _take(self, message: Message) -> None:
        assert message.content is not None  # the message was checked
        call = message.call
        if self._left.pop(call, "") == message.sender or call in self._waiting or call in self._handled:
            return
        if self.closed.is_set():
            self._reply_soon(message, messages.CLOSED)
        elif len(self._waiting) >= self._bound:
            self._reply_soon(message, messages.BUSY)
        elif message.content.is_missing:
            self._reply_soon(message, messages.UNREAD)
        else:
            self._waiting[call] = Request(message, self._leave, self._is_stale)
            self._begin_next()

    @property
    def _is_stale(self) -> bool:
        return self._loop.time() - self._proved > _STALE

    def _leave(self, request: Request) -> None:
        request.is_left = True
        self._waiting.pop(request.message.call, None)
        request.timer.cancel()
        if request.cancel is not None:
            request.cancel()

    # Requests.

    def _begin_next(self) -> None:
        while self._waiting and len(self._handled) < self._concurrency:
            call, request = self._waiting.popitem(last=False)
            self._handled[call] = request
            self._manager.tasks.start(self._handle(request), f"reem serve {self.where}")

    async def _handle(self, request: Request) -> None:
        """Call the function for a request, and send the answer."""
        began = time.monotonic()  # an event loop's clock may count milliseconds
        try:
            # A stopped process, a busy event loop or a link that stood still gets old requests, with the message
            # behind them that their callers have left. So nothing is begun before all that waits has arrived.
            if request.is_stale or self._is_stale:
                try:
                    await self._manager.fence(())
                    self._post.read()
                except (ReemError, RedisError):
                    self._reply_soon(request.message, messages.CLOSED)
                    return
            if not request.is_left:
                await self._answer(request)
                seconds = time.monotonic() - began
                self._times.append((self._loop.time(), seconds))
                if request.record is not None:
                    await self._publish(request.record | {"seconds": seconds})
        except (ReemError, RedisError) as error:
            logger.warning("an answer of %s could not be sent: %s", self.where, error)
        except asyncio.CancelledError:
            if not request.is_left:
                raise
        finally:
            del self._handled[request.message.call]
            request.timer.cancel()
            self._begin_next()

    async def _answer(self, request: Request) -> None:
        message, prefix = request.message, self._names.values(messages.ANSWER, request.message.call)
        try:
            arguments = self._names.values(messages.CALL, message.call)
            given = await opened(self._session, message.content, arguments, self.where)
            if type(given) is not dict:
                raise BadData(f"{self.where}: the arguments are {shorten(given)}, and not a dict")
            request.message = message = message._replace(content=None)  # its memory is the caller's
            if request.is_left:
                return
            if self._loop.time() < self._recorded_until:
                request.record = {"arguments": given}
            place = (self._names.keys.name, *self._names.path)
            result = await self._called(request, self._signature.arguments(given, place))
            del given
            result = self._signature.result(result, place, self._session.ships.carries)
            result, value = await encoded_objects(self._session, self._names, prefix, result)
        except BaseException as error:
            # The function may also raise CancelledError by itself. Ctrl-C ends the program, where it comes at all.
            was_cancelled = isinstance(error, asyncio.CancelledError) and (request.is_left or is_being_cancelled())
            if was_cancelled or (isinstance(error, KeyboardInterrupt) and self._is_async):
                raise
            self._calls += 1
            self._errors += 1
            if request.record is not None:
                request.record["error"] = f"{type(error).__qualname__}: {messages.text_of(error)}"
            await self._send(request, self._failure(message, error))
        else:
            self._calls += 1
            if request.record is not None:
                request.record["answer"] = result
            slots = self._names.keys._replace(channel=messages.answers(self._names.keys, message.sender))
            local = self._session.local
            put = partial(local.put, slots) if local.host and message.words[0] == local.host else None
            await self._send_value(request, value, prefix, put)

    async def _called(self, request: Request, arguments: dict[str, Any]) -> Any:
        if self._is_async:
            result = self._function(**arguments)
        else:
            result = await self._workers.run(self._function, arguments)
            if not inspect.isawaitable(result):
                return result
        task = asyncio.current_task()
        request.cancel = task.cancel if task is not None else None
        try:
            return await result
        finally:
            request.cancel = None

    async def _publish(self, call: dict[str, Any]) -> None:
        """Publish a call for recorders, before the function may use its arrays again."""
        try:
            await publisher(self._session, CALLS, "raise").set_with_parents((self.where,), call)
        except (ReemError, RedisError) as error:
            logger.warning("a call of %s is not in the recording: %s", self.where, error)

    # Answers.

    def _message(self, kind: str, call: str, words: Sequence[str] = ()) -> Message:
        return Message(kind, call, self.id, len(self._waiting) + len(self._handled), words)

    def _failure(self, message: Message, error: BaseException) -> bytes:
        trace = "".join(traceback.format_exception(type(error), error, _below_ours(error.__traceback__)))
        return messages.failure(self._message(messages.FAILED, message.call), error, trace)

    def _reply_soon(self, message: Message, kind: str) -> None:
        self._manager.tasks.start(self._reply(message, kind), "reem answer")

    async def _reply(self, message: Message, kind: str) -> None:
        words: list[str] = []
        if kind == messages.PONG:
            took = [seconds for _, seconds in self._times]
            rate = len(took) / max(self._loop.time() - self._times[0][0], 1.0) if took else 0.0
            median = statistics.median(took) if took else ""
            words = [str(each) for each in (socket.gethostname(), os.getpid(), self._calls, rate, median, self._errors)]
        with contextlib.suppress(ReemError, RedisError, OSError):  # the caller's pings find out
            await self._deliver(message, messages.bare(self._message(kind, message.call, words)))

    async def _deliver(self, request: Message, payload: bytes, commands: Sequence[Command] = ()) -> int:
        """Send a message to a caller, directly where that can be; return how many have received it."""
        is_direct = request.kind == messages.CALL and not commands and not self.closed.is_set()
        if is_direct and self._post.send(request.words[1], payload):
            return 1
        channel = messages.answers(self._names.keys, request.sender)
        return await publish(self._session, self._names.keys, channel, payload, commands)

    async def _send_value(self, request: Request, value: Encoded, prefix: str, put: Put | None) -> None:
        words = [self._session.local.host, self._post.address if request.message.words[1] else ""]
        answer = self._message(messages.ANSWER, request.message.call, words)
        left = max(request.deadline - self._loop.time(), 0.0)
        payload, commands, is_shared = messages.packed(answer, value, prefix, left, put)
        if is_shared:
            self._shared.append((request, payload))
        try:
            received = await self._send(request, payload, commands)
        except Refused as error:  # the memory of the Redis server is full, or its user may not write
            received = await self._send(request, self._failure(request.message, error))
        if commands and not received:
            with contextlib.suppress(ReemError, RedisError, OSError):
                await self._session.transport.roundtrip([("UNLINK", *messages.keys_of(prefix, value))])

    async def _send_again(self, request: Request, payload: bytes) -> None:
        """Send an answer through the server that its caller could not read in shared memory."""
        content = messages.decode(payload, self._session.local.view).content
        prefix = self._names.values(messages.ANSWER, request.message.call)
        if content is None or content.is_missing:  # five newer answers are there
            error = BadData(f"{self.where}: the answer is not in shared memory any more")
            await self._send(request, self._failure(request.message, error))
        else:
            await self._send_value(request, messages.again(content, prefix), prefix, None)

    async def _send(self, request: Request, payload: bytes, commands: Sequence[Command] = ()) -> int:
        """Publish an answer; while the connection is down, try again until nothing waits for it any more."""
        while not request.is_left and self._loop.time() < request.deadline:
            try:
                return await self._deliver(request.message, payload, commands)
            except (ReemError, RedisError, OSError) as error:
                if isinstance(error, InterfaceClosed | Refused) and not isinstance(error, ServerNotReady):
                    raise
                await asyncio.sleep(_RETRY)
        return 0


def _below_ours(trace: TracebackType | None) -> TracebackType | None:
    """Return the part of a traceback that begins with the function of the user."""
    while trace is not None and trace.tb_frame.f_globals.get("__name__", "").startswith("reem_async."):
        trace = trace.tb_next
    return trace


def is_async(function: Any) -> bool:
    return inspect.iscoroutinefunction(function) or inspect.iscoroutinefunction(getattr(function, "__call__", None))  # noqa: B004


class Service(Generic[Arguments, Result]):
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
        function: Callable[Arguments, Result],
        concurrency: int = 1,
        queue: int = QUEUE,
    ) -> None:
        self._where = show((keys.name, *path))
        if not callable(function):
            raise BadType(f"{self._where}: cannot serve {shorten(function)}; give serve() a function")
        self.function = function
        self._session = session
        self._names = Names(keys, path)
        self._concurrency = whole("concurrency", concurrency, "give a number of calls at a time, at least 1")
        self._queue = whole("queue", queue, "give a number of requests that may wait, at least 1")
        self._served: Served | None = None
        self._begun: asyncio.Task[None] | None = None  # what begins in the background
        self._is_closed = False
        self._beginning = asyncio.Lock()
        functools.update_wrapper(self, function, updated=())

    def __call__(self, *args: Arguments.args, **arguments: Arguments.kwargs) -> Result:
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
        self._begun = manager_of(self._session).tasks.start(self._begin(), "reem serve")

    async def _begin(self) -> None:
        while not self._is_closed:
            try:
                await self.listen()
                return
            except (NotAllowed, InterfaceClosed) as error:
                if not self._is_closed:
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
            InterfaceClosed: It was closed before.
        """
        async with self._beginning:
            if self._is_closed:
                raise InterfaceClosed(f"{self._where}: this service is closed; call serve() again")
            if self._served is None or self._served.closed.is_set():
                served = Served(self._session, self._names, self.function, self._concurrency, self._queue)
                await served.follow()
                self._served = served
                if self._is_closed:
                    await served.close()
                    raise InterfaceClosed(f"{self._where}: this service was closed before it began")

    async def close(self) -> None:
        """Stop serving: no later call finds it. Idempotent; one round trip, and one for each request that waits.

        Requests that wait go to other servers. Those being handled raise ServiceLost at their callers; an asynchronous
        function is cancelled.
        """
        self._is_closed = True
        if self._served is not None:
            await self._served.close()

    async def wait(self) -> None:
        """Wait until it has stopped serving: `await service.wait()` is the last line of a program that only serves."""
        if self._begun is not None:
            await asyncio.wait([self._begun])
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
