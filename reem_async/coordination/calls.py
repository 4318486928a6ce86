"""Calls of services: choose a server, send the request, wait for its answer, and notice when the server is gone.

Only a request that was not sent, or that a server has refused, goes to another server. So none is handled twice.
"""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import os
import random
import secrets
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from enum import Enum
from functools import partial
from typing import TYPE_CHECKING, Any

from ..concurrency.timeouts import check_timeout, time_limit
from ..errors import (
    BadData,
    BadType,
    Busy,
    CallTimeout,
    ConnectionLost,
    InterfaceClosed,
    NoService,
    NotAllowed,
    RedisError,
    ReemError,
    RemoteError,
    ServiceLost,
)
from ..plan import Command, Plan, Reply, raise_refused
from ..plan.keys import Keys
from ..plan.notices import assembled
from ..plan.paths import Path, escaped, show
from ..plan.reads import with_bytes
from ..plan.typed import plain
from ..pubsub.early import LoopMailbox
from ..pubsub.listeners import Listener, Topic
from ..pubsub.manager import SubscriptionManager, manager_of
from ..session import Session
from ..store.encoding import Encoder
from . import messages
from .messages import ID, Content, Encoded, Message, Names

if TYPE_CHECKING or hasattr(os, "memfd_create"):  # Linux
    from ..local.mailbox import Datagram, is_address

DEFAULT_TIMEOUT = 10.0  # seconds for which a call waits if neither it nor `reem.timeout` says
_PERIOD = 0.3  # seconds between pings to the servers from which answers are due
_MISSES = 3  # pings in a row without an answer after which a server is taken for lost
_LOOKS = 1.0  # seconds after which a caller asks again which servers there are, while it calls
_HOLDS = 1.0  # seconds for which it counts how many requests wait at a server, by its last message
_SHARED = 2
"""Calls in progress to one server up to which the answer may be in shared memory: it has six slots for a caller, who
may look into three."""
_DEEPEST = 128  # levels of a document
_MESSAGE = b"M"  # the kind of datagrams that carry messages
_LARGEST = 100_000  # bytes of a message that goes directly: a mailbox takes a little more
_STATED = {"host": str, "pid": int, "calls": int, "rate": float, "median": float, "errors": int}
"""What the words of a PONG are."""


def new_id() -> str:
    return secrets.token_hex(ID // 2)


async def call(session: Session, keys: Keys, path: Path, arguments: dict[str, Any], seconds: float | None) -> Any:
    """Do as `Accessor.call`."""
    limit = time_limit(DEFAULT_TIMEOUT) if seconds is None else check_timeout(seconds)
    return await _caller_of(session, keys).call(path, arguments, limit)


def _caller_of(session: Session, keys: Keys) -> Caller:
    """Return what calls the services under a top-level key in the running event loop; made when first asked for."""
    kept = manager_of(session).kept
    caller: Caller = kept.get((Caller, keys.channel)) or kept.setdefault((Caller, keys.channel), Caller(session, keys))
    return caller


async def statistics(session: Session, record: float = 0.0) -> list[dict[str, Any]]:
    """Return a dict for each server of each service in the namespace, sorted; waits up to a second for what they say.

    It has "service" (the path as text), "host", "pid", "calls" and "errors" since it began, "rate" (calls per second)
    and "median" (seconds) of the last 200, and "waiting"; None in the place of what a server did not say.

    Args:
        session: The server.
        record: For so many seconds from now on the servers publish their calls under the key `services.CALLS`.

    Raises:
        NotAllowed: The user lacks a right; says which.
    """
    found: dict[str, Names] = {}
    for node in await session.transport.nodes():
        pattern = f"{{{escaped(session.namespace)}*:serve@{'?' * ID}"
        for channel in await _channels(node, pattern, sharded=session.transport.sharded):
            if (names := Names.of(channel, session.keys, session.namespace)) is not None:
                found[channel] = names
    asked = [_caller_of(session, names.keys).ask(channel, record) for channel, names in found.items()]
    stated = await asyncio.gather(*asked)
    rows = [
        {"service": show((names.keys.name, *names.path)), **said}
        for names, said in zip(found.values(), stated, strict=True)
    ]
    return sorted(rows, key=lambda row: (row["service"], str(row["host"]), row["pid"] or 0))


async def _channels(node: Any, pattern: str, *, sharded: bool) -> list[str]:
    """Ask a server which channels have a subscriber; one round trip."""
    command: Command = ("PUBSUB", "SHARDCHANNELS" if sharded else "CHANNELS", pattern)
    replies = await node.roundtrip([command])
    with naming_rights():
        raise_refused(replies, [command])
    return [name.decode(errors="replace") for name in replies[0] if type(name) is bytes]


async def publish(session: Session, keys: Keys, channel: str, payload: bytes, store: Iterable[Command] = ()) -> int:
    """Publish a message, and store its value in the same transaction; return how many have received it."""
    commands: list[Command] = [*store, (keys.publish, channel, payload)]

    def receivers(replies: list[Reply]) -> Reply:
        raise_refused(replies, commands)
        return replies[-1]

    with naming_rights():
        count: int = await session.run(Plan(commands, receivers, atomic=len(commands) > 1))
    return count


@contextlib.contextmanager
def naming_rights() -> Iterator[None]:
    """Say in an error about a right what services need."""
    try:
        yield
    except NotAllowed as error:
        raise NotAllowed(
            f"{error}; services need +publish, +subscribe, +pubsub|channels (in a cluster +spublish, +ssubscribe, "
            "+pubsub|shardchannels) and the channels &{robot1:*:serve@* and &{robot1:*:answers@*"
        ) from None


async def encoded(session: Session, names: Names, prefix: str, value: Any) -> Encoded:
    """Return a value for keys that begin with `prefix`; raises BadInput."""
    found = await Encoder(session, names.keys._replace(tag=prefix)).encoded(names.path, value)
    messages.check_parts(show((names.keys.name, *names.path)), found)
    return found


async def encoded_objects(session: Session, names: Names, prefix: str, value: Any) -> tuple[Any, Encoded]:
    """Return a value with what is sent in place of objects that cannot be stored as they are, and it encoded."""
    with contextlib.suppress(BadType):
        return value, await encoded(session, names, prefix, value)
    value = plain(value, (names.keys.name, *names.path), session.ships.carries)
    return value, await encoded(session, names, prefix, value)


async def opened(session: Session, content: Content | None, prefix: str, where: str) -> Any:
    """Return the value of a message; a round trip if it is stored under keys that begin with `prefix`.

    Raises:
        BadData: It has expired, or its parts make no value.
    """
    if content is None:
        raise BadData(f"{where}: the message has no value")
    pieces, ships = content.pieces, session.ships
    if content.is_stored:
        pieces = await session.run(messages.fetch(content, prefix, ships, where))
    await ships.ready()
    values: dict[tuple[str, str], Any] = {}
    try:
        for (label, tail), piece in zip(content.names, pieces[1:], strict=True):
            ship = ships.labelled(label, where)
            if not content.is_stored and ship.blob is None:
                raise BadData(f"{where}: the ship {label!r} of this interface reads in another way than the sender's")
            try:
                value = ship.ship.interpret_read([piece if ship.blob is not None else with_bytes(piece)])
                values[label, tail] = await value if inspect.isawaitable(value) else value
            except BadData as error:  # such as of a damaged picture
                raise BadData(f"{where}: {error}") from error
        return assembled(bytes(pieces[0]), values, _DEEPEST)
    except BadData:
        raise
    except Exception as error:  # a ship may raise anything over foreign bytes
        raise BadData(f"{where}: a value cannot be rebuilt: {error!s:.200}") from error


class Post(LoopMailbox):
    """Messages of services between programs of one user on one host, by datagrams in place of the server.

    A caller with `local="early"` names its mailbox in each request. The server then names its own in the answer, and
    later requests and answers go from mailbox to mailbox. What a mailbox cannot take at once goes through the server.
    So do pings, and so a program that ends, stops or loses its connection is noticed as before.

    Args:
        session: Says whether the direct path is allowed, and counts what cannot be read.
        take: Called with each message. It may raise BadData.
    """

    def __init__(self, session: Session, take: Callable[[bytes], None]) -> None:
        # At once more than the kernel queues: the word that a caller has left may wait behind its request.
        super().__init__(self._take_message, 1000)
        self._session = session
        self._take = take

    @property
    def address(self) -> str:
        mailbox = self._opened()
        return mailbox.address if mailbox is not None else ""

    def _opened(self) -> Any:
        return super()._opened() if self._mailbox is not None or self._session.local.host else None

    def send(self, address: str, payload: bytes) -> bool:
        """Send a message without waiting; return False if its receiver is gone, or has no room for it now."""
        if not address or not is_address(address) or len(payload) > _LARGEST or (mailbox := self._opened()) is None:
            return False
        try:
            mailbox.try_send(address, _MESSAGE, b"", payload)
        except OSError:
            return False
        return True

    def _take_message(self, it: Datagram) -> None:
        try:
            self._take(it.content)
        except BadData:
            self._session.transport.states.unreadable += 1

    def close(self) -> None:
        """Close the mailbox: what is sent to it from now on goes through the server."""
        self.read()
        super().close()


class Instance:
    def __init__(self, channel: str) -> None:
        self.id = channel[-ID:]
        self.channel = channel
        self.calls = 0  # calls from here that wait for its answer
        self.host = ""  # what names its host, for shared memory; empty if not known, or if it cannot read ours
        self.address = ""  # its mailbox on this host; empty if not known, or if it has none for us
        self.misses = 0  # pings since its last message
        self._waiting, self._until = 0.0, 0.0  # requests that it said are waiting there, and when that is too old

    def answered(self, waiting: float, now: float) -> None:
        self.misses = 0
        self._waiting, self._until = waiting, now + _HOLDS

    def load(self, now: float) -> float:
        return self.calls + (self._waiting if now < self._until else 0.0)


class Directory:
    def __init__(self, names: Names) -> None:
        self.names = names
        self.instances: dict[str, Instance] = {}
        self.looked = 0.0  # when the Redis server was asked last

    async def look(self, session: Session) -> None:
        """Ask the Redis server which servers there are. Those that were known keep what is known of them."""
        node = await session.transport.owner(self.names.channel("0" * ID).encode())
        channels = await _channels(node, self.names.pattern, sharded=self.names.keys.sharded)
        found = {name[-ID:]: name for name in channels if messages.is_id(name[-ID:])}
        self.instances = {it: self.instances.get(it) or Instance(channel) for it, channel in found.items()}
        self.looked = asyncio.get_running_loop().time()

    def best(self, refused: Collection[str]) -> Instance | None:
        """Return the server that seems to have the least to do, none of `refused`."""
        now = asyncio.get_running_loop().time()
        left = [each for it, each in self.instances.items() if it not in refused]
        least = min([each.load(now) for each in left], default=0.0)
        fit = [each for each in left if each.load(now) <= least]
        return random.choice(fit) if fit else None  # noqa: S311 - only spreads the load


class State(Enum):
    """What became of a request; the text is what a timeout says of it."""

    UNSENT = "the request was not sent"  # or a server has refused it
    SENT = "the request may or may not have been handled"
    ANSWERED = "the request was handled, and its answer was not fetched in time"


class PendingCall:
    def __init__(self, where: str, directory: Directory, deadline: float) -> None:
        self.id = new_id()
        self.where = where
        self.directory = directory
        self.deadline = deadline  # by the clock of the event loop
        self.instance: Instance | None = None  # the server that has it, or may have it
        self.state = State.UNSENT
        self.stored: list[str] = []  # keys of its arguments that are on the Redis server, or may be
        self.answer: asyncio.Future[Message] = asyncio.get_running_loop().create_future()  # of that server

    def end(self, outcome: Message | Exception) -> None:
        if self.answer.done():
            return
        if isinstance(outcome, Exception):
            self.answer.set_exception(outcome)
            self.answer.exception()  # else asyncio logs it if the caller has just left
        else:
            self.answer.set_result(outcome)


class Caller(Listener):
    """The calls of this event loop to the services under one top-level key, with the channel of their answers."""

    def __init__(self, session: Session, keys: Keys) -> None:
        self.id = new_id()
        super().__init__(Topic(messages.answers(keys, self.id).encode()))
        self.takes_messages = True
        self._session = session
        self._keys = keys
        self._manager: SubscriptionManager = manager_of(session)
        self._directories: dict[Path, Directory] = {}
        self._pending: dict[str, PendingCall] = {}
        self._called: set[Directory] = set()  # since the last look at them
        self._post = Post(session, self.on_message)
        self._following = asyncio.Lock()
        self._follows = False  # the channel of answers is subscribed
        self._watching: asyncio.Task[None] | None = None
        self._asked: dict[str, asyncio.Future[Message]] = {}  # servers that are asked what they have to say

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
        if isinstance(reason, InterfaceClosed):
            self._post.close()

    def on_message(self, payload: bytes) -> None:
        message = messages.decode(payload, self._session.local.view)
        now = asyncio.get_running_loop().time()
        if message.kind == messages.PONG:
            for directory in self._directories.values():
                if (instance := directory.instances.get(message.sender)) is not None:
                    instance.answered(message.number, now)
            if (asked := self._asked.get(message.call)) is not None and not asked.done():
                asked.set_result(message)
            return
        call = self._pending.get(message.call)
        # An answer may come after its caller has left. One by another server than the one asked is no answer.
        if call is None or call.instance is None or call.instance.id != message.sender:
            return
        call.instance.answered(message.number, now)
        if message.content is not None:
            call.instance.host, call.instance.address = message.words
            if message.content.is_missing:
                call.instance.host = ""
                self._manager.tasks.start(self._tell(messages.UNREAD, call), "reem answer unread")
                return
        call.end(message)

    async def _tell(self, kind: str, call: PendingCall) -> None:
        """Send the server of a call a word about it."""
        if call.instance is not None:
            with contextlib.suppress(ReemError, RedisError, OSError):  # the call notices what is the matter
                await self._deliver(call.instance, messages.bare(Message(kind, call.id, self.id)))

    async def _deliver(self, instance: Instance, payload: bytes, commands: Sequence[Command] = ()) -> int:
        """Send a message to a server, directly where that can be; return how many have received it."""
        if not commands and self._post.send(instance.address, payload):
            return 1
        return await publish(self._session, self._keys, instance.channel, payload, commands)

    # One call.

    async def call(self, path: Path, arguments: dict[str, Any], limit: float) -> Any:
        directory = self._directories.get(path)
        if directory is None:
            directory = self._directories[path] = Directory(Names(self._keys, path))
        call = PendingCall(show((self._keys.name, *path)), directory, asyncio.get_running_loop().time() + limit)
        prefix = directory.names.values(messages.CALL, call.id)
        _, value = await encoded_objects(self._session, directory.names, prefix, arguments)
        self._pending[call.id] = call
        try:
            async with asyncio.timeout_at(call.deadline):
                await self._follow()
                message = await self._result(call, value, prefix)
                if message.kind == messages.FAILED:
                    raise RemoteError(call.where, *message.words)
                answer = directory.names.values(messages.ANSWER, call.id)
                result = await opened(self._session, message.content, answer, call.where)
                call.stored = []  # the server has fetched the arguments
                return result
        except TimeoutError:
            raise CallTimeout(f"{call.where}: no answer within {limit:g} s; {call.state.value}") from None
        finally:
            del self._pending[call.id]
            if (call.state is State.SENT or call.stored) and not self._session.closed:
                self._manager.tasks.start(self._give_up(call), "reem leave call")

    async def _follow(self) -> None:
        if not self._follows:
            async with self._following:
                if not self._follows:
                    with naming_rights():
                        await self._manager.follow_here(self)

    async def _result(self, call: PendingCall, value: Encoded, prefix: str) -> Message:
        """Return the answer of a server that has taken the request: a value, or what its function raised."""
        directory = call.directory
        refused: dict[str, str] = {}  # servers that did not begin it, and why
        is_complete = False  # all that are there are known
        while True:
            instance = directory.best(refused)
            if instance is None:
                if is_complete:
                    if busy := [*refused.values()].count(messages.BUSY):
                        raise Busy(
                            f"{call.where}: each of {busy} servers has as many requests waiting as its `queue` allows; "
                            "call again later, or start more servers"
                        )
                    raise NoService(
                        f"{call.where}: no program serves this; start one that calls .serve(function) at this place"
                    )
                await directory.look(self._session)
                is_complete = True
                continue
            message = await self._ask(call, instance, value, prefix)
            if message.kind == messages.UNREAD:
                instance.host = ""  # once more to the same
            elif message.kind in (messages.BUSY, messages.CLOSED):
                refused[instance.id] = message.kind
                if message.kind == messages.CLOSED:
                    directory.instances.pop(instance.id, None)
                    is_complete = False  # another one may have taken its place
            else:
                call.state = State.ANSWERED
                return message
            call.state = State.UNSENT

    async def _ask(self, call: PendingCall, instance: Instance, value: Encoded, prefix: str) -> Message:
        """Send a request to a server, and return its answer: CLOSED too if it never had the request."""
        call.answer = asyncio.get_running_loop().create_future()
        call.instance, call.state = instance, State.SENT
        instance.calls += 1
        try:
            if not await self._send(call, instance, value, prefix):
                return Message(messages.CLOSED, call.id, instance.id)
            self._called.add(call.directory)
            if self._watching is None:
                self._watching = self._manager.tasks.start(self._watch(), "reem watch services")
            return await call.answer
        finally:
            instance.calls -= 1

    async def _send(self, call: PendingCall, instance: Instance, value: Encoded, prefix: str) -> int:
        left = max(call.deadline - asyncio.get_running_loop().time(), 0.0)
        local = self._session.local
        words = [local.host if instance.calls <= _SHARED else "", self._post.address if local.early else ""]
        message = Message(messages.CALL, call.id, self.id, left, words)
        slots = self._keys._replace(channel=call.directory.names.channel(""))
        put = partial(local.put, slots) if local.host and instance.host == local.host else None
        payload, commands, _ = messages.packed(message, value, prefix, left, put)
        if call.stored:  # for a server that has refused it
            commands = []
        elif commands:
            call.stored = messages.keys_of(prefix, value)
        return await self._deliver(instance, payload, commands)

    async def _give_up(self, call: PendingCall) -> None:
        """Have the server give up a call that was left, and remove what it has not fetched."""
        if call.state is State.SENT:
            await self._tell(messages.CANCEL, call)
        if call.stored:
            with contextlib.suppress(ReemError, RedisError, OSError):
                await self._session.transport.settle(self._keys.document)  # they may still be on their way
                await self._session.transport.roundtrip([("UNLINK", *call.stored)])

    # Whether the servers are still there, and whether there are others.

    async def _watch(self) -> None:
        """While there are calls, look for servers, and ping those from which answers are due."""
        try:
            while True:
                await asyncio.sleep(_PERIOD)
                calls = [*self._pending.values()]
                called, self._called = self._called, {call.directory for call in calls}
                if not called:
                    return
                due = {call.instance: call.directory for call in calls if call.instance and not call.answer.done()}
                for directory in called:
                    if asyncio.get_running_loop().time() - directory.looked > _LOOKS:
                        with contextlib.suppress(ReemError, RedisError, OSError):  # the next call notices it
                            await directory.look(self._session)
                await asyncio.gather(*(self._ping(*each) for each in due.items()))
        finally:
            self._watching = None

    async def _ping(self, instance: Instance, directory: Directory) -> None:
        """Send a ping to a server, and end the calls to it if it is gone."""
        # Counted in pings and not in seconds: while this event loop is busy, no answer can be seen.
        why = f"its server has not answered for {_MISSES * _PERIOD:g} s"
        if instance.misses < _MISSES:
            payload = messages.bare(Message(messages.PING, new_id(), self.id))
            try:
                if await publish(self._session, self._keys, instance.channel, payload):
                    instance.misses += 1
                    return
            except (ReemError, RedisError, OSError):
                return  # the Redis server does not answer: that says nothing of this one
            why = "its server has ended, or has lost its connection"
        directory.instances.pop(instance.id, None)
        for call in self._pending.values():
            if call.instance is instance:
                call.end(ServiceLost(f"{call.where}: {why}; the request may or may not have been handled"))

    async def ask(self, channel: str, record: float) -> dict[str, Any]:
        """Return what a server says of itself; None for each if it says nothing within a second."""
        await self._follow()
        ping = Message(messages.PING, new_id(), self.id, record)
        answer = self._asked[ping.call] = asyncio.get_running_loop().create_future()
        said: dict[str, Any] = dict.fromkeys((*_STATED, "waiting"))
        try:
            await publish(self._session, self._keys, channel, messages.bare(ping))
            async with asyncio.timeout(_LOOKS):
                message = await answer
            stated = zip(_STATED.items(), message.words, strict=True)
            said |= {name: read(word) if word else None for (name, read), word in stated}
            return said | {"waiting": int(message.number)}
        except (TimeoutError, ValueError):  # it hangs, or is no server of REEM
            return said
        finally:
            del self._asked[ping.call]
