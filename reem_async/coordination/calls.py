"""Calls of services: choose a server, send the request, wait for its answer, and notice when the server is gone.

A call is in one of three states: not sent, sent (it may or may not have been handled), or refused by a server that did
not begin it. Only what was not sent or was refused goes to another server, so no request is handled twice.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import secrets
from collections.abc import Collection, Iterable
from enum import Enum
from functools import partial
from typing import Any

from ..concurrency.timeouts import check_timeout, time_limit
from ..errors import (
    Busy,
    CallTimeout,
    ConnectionLost,
    InterfaceClosed,
    NoService,
    NotAllowed,
    RedisError,
    ReemError,
    ServiceError,
    ServiceLost,
)
from ..plan import Command, Plan, Reply, blamed
from ..plan.keys import Keys
from ..plan.paths import Path, escaped, show
from ..pubsub.listeners import Listener, Topic
from ..pubsub.manager import SubscriptionManager, manager_of
from ..session import Session
from ..store.encoding import Encoder
from . import messages
from .messages import ID, Encoded, Message, Names

DEFAULT_TIMEOUT = 10.0  # seconds for which a call waits if neither it nor `reem.timeout` says
_PERIOD = 0.3  # seconds between pings to the servers from which answers are due
_MISSES = 3  # pings in a row without an answer after which a server is taken for lost
_LOOKS = 1.0  # seconds after which a caller asks again which servers there are, while it calls
_HOLDS = 1.0  # seconds for which it counts how many requests wait at a server, by its last message


def new_id() -> str:
    return secrets.token_hex(ID // 2)


async def call(session: Session, keys: Keys, path: Path, arguments: dict[str, Any], seconds: float | None) -> Any:
    """Do as `Accessor.call`."""
    limit = time_limit(DEFAULT_TIMEOUT) if seconds is None else check_timeout(seconds)
    return await caller_of(session, keys).call(path, arguments, limit)


def caller_of(session: Session, keys: Keys) -> Caller:
    """Return what calls the services under a top-level key in the running event loop; made when first asked for."""
    manager = manager_of(session)
    caller = manager.kept.get((Caller, keys.channel))
    if not isinstance(caller, Caller):
        caller = manager.kept[Caller, keys.channel] = Caller(session, keys, manager)
    return caller


async def statistics(session: Session) -> list[dict[str, Any]]:
    """Return a dict for each server of each service in the namespace, sorted; waits up to a second for what they say.

    It has "service" (the path as text), "host", "pid", "calls" since it began, "rate" (calls per second), "median" of
    the last 200 in seconds, "errors", and "waiting"; None in the place of what a server did not say.

    Raises:
        NotAllowed: The user lacks a right; says which.
    """
    command: Command = ("PUBSUB", "CHANNELS", f"{{{escaped(session.namespace)}*:serve@{'?' * ID}")
    if session.transport.sharded:
        command = ("PUBSUB", "SHARDCHANNELS", command[2])
    found: dict[str, Names] = {}
    for node in await session.transport.nodes():
        (reply,) = await node.roundtrip([command])
        if isinstance(reply, Exception):
            raise explained(blamed(reply, command))
        for channel in [name.decode(errors="replace") for name in reply]:
            if (names := Names.of(channel, session.keys, session.namespace)) is not None:
                found[channel] = names
    asked = [caller_of(session, names.keys).ask(channel) for channel, names in found.items()]
    stated = await asyncio.gather(*asked)
    rows = [
        {"service": show((names.keys.name, *names.path)), **said}
        for names, said in zip(found.values(), stated, strict=True)
    ]
    return sorted(rows, key=lambda row: (row["service"], str(row["host"]), row["pid"] or 0))


async def publish(session: Session, keys: Keys, channel: str, payload: bytes, store: Iterable[Command] = ()) -> int:
    """Publish a message, and store its value in the same transaction; return how many have received it."""
    commands: list[Command] = [*store, (keys.publish, channel, payload)]
    plan = Plan(commands, partial(_receivers, commands), atomic=len(commands) > 1)
    count: int = await session.run(plan)
    return count


def _receivers(commands: list[Command], replies: list[Reply]) -> Reply:
    for reply, command in zip(replies, commands, strict=True):
        if isinstance(reply, Exception):
            raise explained(blamed(reply, command[:2]))
    return replies[-1]


def explained(error: Exception) -> Exception:
    """Return an error about a right with what services need."""
    if not isinstance(error, NotAllowed):
        return error
    return NotAllowed(
        f"{error}; services need +publish, +subscribe, +pubsub|channels (in a cluster +spublish, +ssubscribe, "
        "+pubsub|shardchannels) and the channels &{robot1:*:serve@* and &{robot1:*:answers@*"
    )


class Instance:
    """One server of a service, as its callers in this event loop see it."""

    def __init__(self, name: str, channel: str) -> None:
        self.id = name
        self.channel = channel
        self.calls = 0  # calls from here that wait for its answer
        self.host = ""  # what names its host, for shared memory; empty if not known, or if it cannot read ours
        self.misses = 0  # pings since its last message
        self._waiting, self._until = 0.0, 0.0  # requests that it said are waiting there, and when that is too old

    def answered(self, waiting: float, now: float) -> None:
        self.misses = 0
        self._waiting, self._until = waiting, now + _HOLDS

    def load(self, now: float) -> float:
        return self.calls + (self._waiting if now < self._until else 0.0)


class Directory:
    """The servers of one service, as far as they are known here."""

    def __init__(self, names: Names) -> None:
        self.names = names
        self.instances: dict[str, Instance] = {}
        self.looked = 0.0  # when the Redis server was asked last
        self.looking: asyncio.Task[None] | None = None

    def found(self, ids: Collection[str], now: float) -> None:
        """Note that these are all; those that were known keep what is known of them."""
        self.instances = {it: self.instances.get(it) or Instance(it, self.names.channel(it)) for it in ids}
        self.looked = now

    def best(self, refused: Collection[str], now: float) -> Instance | None:
        """Return the server that seems to have the least to do, none of `refused`."""
        left = [each for it, each in self.instances.items() if it not in refused]
        least = min([each.load(now) for each in left], default=0.0)
        fit = [each for each in left if each.load(now) <= least]
        return random.choice(fit) if fit else None  # noqa: S311 - only spreads the load


class State(Enum):
    """What became of a request; the text is what a timeout says of it."""

    UNSENT = "the request was not sent"
    SENT = "the request may or may not have been handled"
    ANSWERED = "the request was handled, and its answer was not fetched in time"


class PendingCall:
    """A call that waits for its answer."""

    def __init__(self, where: str, directory: Directory, deadline: float) -> None:
        self.id = new_id()
        self.where = where
        self.directory = directory
        self.deadline = deadline  # by the clock of the event loop
        self.instance: Instance | None = None  # the server that has it, or may have it
        self.state = State.UNSENT
        self.is_delivered = False  # the server has received it
        self.has_stored = False  # its arguments are on the Redis server, or may be
        self.answer: asyncio.Future[Message] | None = None
        self.limit: asyncio.Timeout | None = None

    def end(self, outcome: Message | Exception) -> None:
        if self.answer is None or self.answer.done():
            return
        if isinstance(outcome, Exception):
            self.answer.set_exception(outcome)
            self.answer.exception()  # else asyncio logs it if the caller has just left
        else:
            self.answer.set_result(outcome)


class Caller(Listener):
    """The calls of this event loop to the services under one top-level key, with the channel of their answers."""

    def __init__(self, session: Session, keys: Keys, manager: SubscriptionManager) -> None:
        self.id = new_id()
        super().__init__(Topic(messages.answers(keys, self.id).encode()))
        self.takes_messages = True
        self._session = session
        self._keys = keys
        self._manager = manager
        self._directories: dict[Path, Directory] = {}
        self._pending: dict[str, PendingCall] = {}
        self._following = asyncio.Lock()
        self._follows = False  # the channel of answers is subscribed
        self._pinging: asyncio.Task[None] | None = None
        self._asked: dict[str, asyncio.Future[Message]] = {}  # questions to servers how they are doing

    # What the subscription manager calls.

    def start(self, wire: Any, beginning: Any) -> None:
        super().start(wire, beginning)
        self._follows = True

    def lost(self, reason: Exception) -> None:
        super().lost(reason)
        self._follows = False
        for call in self._pending.values():
            broken = ConnectionLost(
                f"{call.where}: the connection broke before the answer came ({reason}); "
                "the request may or may not have been handled"
            )
            call.end(reason if isinstance(reason, InterfaceClosed) else broken)

    def on_message(self, payload: bytes) -> None:
        message = messages.decode(payload)
        now = asyncio.get_running_loop().time()
        if message.kind == messages.PONG:
            for directory in self._directories.values():
                if (instance := directory.instances.get(message.sender)) is not None:
                    instance.answered(message.number, now)
            return
        if message.kind == messages.STATED:
            if (asked := self._asked.get(message.call)) is not None and not asked.done():
                asked.set_result(message)
            return
        call = self._pending.get(message.call)
        # An answer may come after its caller has left. One by another server than the one asked is no answer.
        if call is None or call.instance is None or call.instance.id != message.sender:
            return
        call.instance.answered(message.number, now)
        if message.content is not None:
            message = self._seen(call.instance, message)
        if message.content is None or not message.content.is_missing:
            call.end(message)

    def _seen(self, instance: Instance, message: Message) -> Message:
        """Return an answer with its bytes in shared memory, and report to the server whether they were there."""
        assert message.content is not None
        instance.host = message.words[0]
        content = message.content.seen(self._session.local.view)
        if content.view is not None or content.is_missing:
            kind = messages.UNREAD if content.is_missing else messages.RECEIVED
            payload = messages.bare(Message(kind, message.call, self.id))
            self._manager.tasks.start(self._report(instance, payload), "reem report answer")
        return message._replace(content=content)

    async def _report(self, instance: Instance, payload: bytes) -> None:
        with contextlib.suppress(ReemError, RedisError, OSError):
            await publish(self._session, self._keys, instance.channel, payload)

    # One call.

    async def call(self, path: Path, arguments: dict[str, Any], limit: float) -> Any:
        directory = self._directories.get(path)
        if directory is None:
            directory = self._directories[path] = Directory(Names(self._keys, path))
        call = PendingCall(show((self._keys.name, *path)), directory, asyncio.get_running_loop().time() + limit)
        prefix = directory.names.request(call.id)
        value = await Encoder(self._session, self._keys._replace(tag=prefix)).encoded(path, arguments)
        self._pending[call.id] = call
        try:
            async with asyncio.timeout_at(call.deadline) as call.limit:
                if not self._follows:
                    await self._follow()
                return await self._result(call, value)
        except TimeoutError:
            raise CallTimeout(f"{call.where}: no answer within {limit:g} s; {call.state.value}") from None
        finally:
            del self._pending[call.id]
            stored = messages.keys_of(prefix, value) if call.has_stored else []
            if (call.state is State.SENT or stored) and not self._session.closed:
                self._manager.tasks.start(self._give_up(call, stored), "reem leave call")

    async def _follow(self) -> None:
        async with self._following:
            if not self._follows:
                try:
                    await self._manager.follow_here(self)
                except NotAllowed as error:
                    raise explained(error) from None

    async def _result(self, call: PendingCall, value: Encoded) -> Any:
        loop, directory = asyncio.get_running_loop(), call.directory
        busy: set[str] = set()
        gone: set[str] = set()
        is_complete = False  # all that are there are known
        while True:
            instance = directory.best(busy | gone, loop.time())
            if instance is None:
                if is_complete:
                    raise _refused(call.where, len(busy))
                await self._look(directory)
                is_complete = True
                continue
            message = await self._ask(call, instance, value)
            if message is not None and message.kind == messages.UNREAD:
                instance.host = ""  # once more to the same, which did not begin it
            elif message is None or message.kind == messages.CLOSED:
                is_complete = False  # another one may have taken its place
                gone.add(instance.id)
                directory.instances.pop(instance.id, None)
            elif message.kind == messages.BUSY:
                busy.add(instance.id)
            elif message.kind == messages.FAILED:
                raise messages.remote_error(message, call.where)
            elif message.kind == messages.DROPPED:
                raise ServiceLost(f"{call.where}: the server stopped serving before it had finished this request")
            else:
                return await self._opened(call, message)

    async def _ask(self, call: PendingCall, instance: Instance, value: Encoded) -> Message | None:
        """Send a request to a server; return its answer, None if the server is gone and never had the request."""
        loop = asyncio.get_running_loop()
        answer = call.answer = loop.create_future()
        call.instance, call.state, call.is_delivered = instance, State.SENT, False
        instance.calls += 1
        try:
            if not await self._send(call, instance, value):
                call.state = State.UNSENT
                return None
            call.is_delivered = True
            self._look_around(call.directory)
            message = await self._wait(call, answer)
        finally:
            instance.calls -= 1
        was_begun = message.kind not in (messages.BUSY, messages.CLOSED, messages.UNREAD)
        call.state = State.ANSWERED if was_begun else State.UNSENT
        return message

    async def _wait(self, call: PendingCall, answer: asyncio.Future[Message]) -> Message:
        """Return the answer; raises TimeoutError at the deadline.

        `asyncio.timeout` would cancel this task though the answer has come while the event loop was busy.
        """
        assert call.limit is not None
        call.limit.reschedule(None)
        timer = asyncio.get_running_loop().call_at(call.deadline, call.end, TimeoutError())
        try:
            return await answer
        finally:
            timer.cancel()
            call.limit.reschedule(call.deadline)

    def _look_around(self, directory: Directory) -> None:
        """Begin to watch the servers that were asked, and ask now and then whether there are others."""
        tasks = self._manager.tasks
        if self._pinging is None:
            self._pinging = tasks.start(self._ping(), "reem ping services")
        if directory.looking is None and asyncio.get_running_loop().time() - directory.looked > _LOOKS:
            directory.looking = tasks.start(self._look_again(directory), "reem look for services")

    async def _send(self, call: PendingCall, instance: Instance, value: Encoded) -> int:
        left = max(call.deadline - asyncio.get_running_loop().time(), 0.0)
        local = self._session.local
        message = Message(messages.CALL, call.id, self.id, left, [local.host])
        if messages.is_small(value):
            return await publish(self._session, self._keys, instance.channel, messages.inline(message, value))
        if instance.host and instance.host == local.host:
            slot = messages.put(local, self._keys, call.directory.names.channel(""), value)
            if slot is not None:
                payload = messages.in_slot(message, value, slot)
                return await publish(self._session, self._keys, instance.channel, payload)
        prefix = call.directory.names.request(call.id)
        payload, commands = messages.stored(message, value, prefix, left)
        if call.has_stored:  # for a server that has refused it
            commands = []
        call.has_stored = True
        return await publish(self._session, self._keys, instance.channel, payload, commands)

    async def _opened(self, call: PendingCall, message: Message) -> Any:
        content = message.content
        if content is None:
            raise ServiceError(f"{call.where}: the server answered with {message.kind!r}, which is no answer")
        ships = self._session.ships
        if content.is_stored:
            plan = messages.fetch(content, call.directory.names.answer(call.id), ships, call.where)
            pieces = await self._session.run(plan) if plan.commands else [content.data]
        else:
            pieces = messages.pieces_of(content)
        call.has_stored = False  # the server has fetched the arguments
        return await messages.opened(content, pieces, ships, call.where)

    async def _give_up(self, call: PendingCall, stored: list[str]) -> None:
        """Have the server give up a call that was left, and remove what it has not fetched."""
        with contextlib.suppress(ReemError, RedisError, OSError):
            if call.state is State.SENT and call.instance is not None:
                payload = messages.bare(Message(messages.CANCEL, call.id, self.id))
                await publish(self._session, self._keys, call.instance.channel, payload)
            if stored:
                await self._session.transport.settle(self._keys.document)  # they may still be on their way
                await self._session.transport.roundtrip([("UNLINK", *stored)])

    # Which servers there are.

    async def _look(self, directory: Directory) -> None:
        """Ask the Redis server which channels of the service have a subscriber; one round trip."""
        channel = directory.names.channel("0" * ID).encode()
        node = await self._session.transport.owner(channel)
        command: Command = ("PUBSUB", "SHARDCHANNELS" if self._keys.sharded else "CHANNELS", directory.names.pattern)
        (reply,) = await node.roundtrip([command])
        if isinstance(reply, Exception):
            raise explained(blamed(reply, command))
        ids = [name[-ID:].decode("ascii", "replace") for name in reply if type(name) is bytes]
        directory.found([it for it in ids if messages.is_id(it)], asyncio.get_running_loop().time())

    async def _look_again(self, directory: Directory) -> None:
        try:
            with contextlib.suppress(ReemError, RedisError, OSError):  # the next call notices what is the matter
                await self._look(directory)
        finally:
            directory.looking = None

    async def ask(self, channel: str) -> dict[str, Any]:
        """Return what a server says of itself; None for each if it says nothing within a second."""
        if not self._follows:
            await self._follow()
        number = new_id()
        answer = self._asked[number] = asyncio.get_running_loop().create_future()
        said = dict.fromkeys(("host", "pid", "calls", "rate", "median", "errors", "waiting"))
        try:
            await publish(self._session, self._keys, channel, messages.bare(Message(messages.ASKED, number, self.id)))
            async with asyncio.timeout(_LOOKS):
                message = await answer
            host, process, calls, errors, median, age = message.words
            rate = int(calls) / max(float(age), 1.0)
            return said | {
                "host": host, "pid": int(process), "calls": int(calls), "rate": rate,
                "median": float(median) if median else None, "errors": int(errors), "waiting": int(message.number),
            }  # fmt: skip
        except (TimeoutError, ValueError):  # it hangs, or is no server of REEM
            return said
        finally:
            del self._asked[number]

    # Whether they are still there.

    async def _ping(self) -> None:
        """Ping the servers from which answers are due, and end the calls to those that are gone."""
        try:
            while True:
                await asyncio.sleep(_PERIOD)
                due = {
                    call.instance: call.directory
                    for call in self._pending.values()
                    if call.is_delivered and call.instance is not None and call.answer and not call.answer.done()
                }
                if not self._pending:
                    return
                await asyncio.gather(*(self._ping_one(*each) for each in due.items()))
        finally:
            self._pinging = None

    async def _ping_one(self, instance: Instance, directory: Directory) -> None:
        # Counted in pings and not in seconds: while this event loop is busy, no answer can be seen.
        if instance.misses >= _MISSES:
            self._lose(instance, directory, f"its server has not answered for {_MISSES * _PERIOD:g} s")
            return
        instance.misses += 1
        payload = messages.bare(Message(messages.PING, "", self.id))
        try:
            count = await publish(self._session, self._keys, instance.channel, payload)
        except (ReemError, RedisError, OSError):
            instance.misses -= 1  # the Redis server does not answer: that says nothing of this one
            return
        if not count:
            self._lose(instance, directory, "its server has ended, or has lost its connection")

    def _lose(self, instance: Instance, directory: Directory, why: str) -> None:
        directory.instances.pop(instance.id, None)
        for call in self._pending.values():
            if call.instance is instance and call.is_delivered:
                call.end(ServiceLost(f"{call.where}: {why}; the request may or may not have been handled"))


def _refused(where: str, busy: int) -> ServiceError:
    if busy:
        return Busy(
            f"{where}: each of {busy} servers has as many requests waiting as its `queue` allows; "
            "call again later, or start more servers"
        )
    return NoService(f"{where}: no program serves this; start one that calls .serve(function) at this place")
