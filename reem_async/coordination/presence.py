"""Presence: which programs are connected under a name, where they run, and what they publish, serve and own.

Each named interface keeps a key of its own on the server, which expires unless it is renewed. So a program that was
killed, stopped or cut off is gone within a second. A set lists the keys. No clocks of two hosts are compared.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import os
import re
import secrets
import socket
import time
import weakref
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from ..concurrency.queues import Last
from ..concurrency.streams import Stream
from ..concurrency.timeouts import time_limit, timeout
from ..errors import BadType, BadValue, InterfaceClosed, RedisError, ReemError, Refused
from ..plan import Command, Plan, Reply, raise_refused
from ..plan.keys import PRESENCE, Keys
from ..plan.paths import shorten
from ..session import Session
from .clock import ClockOffset, ServerClock

logger = logging.getLogger("reem.presence")

_GROUP = "_nodes"  # stands in the names of all keys of presence, in place of a top-level key
_RENEWAL, _LIFETIME = 0.25, 0.75
"""Seconds between renewals, and after the last one until a node has left. A program that stands still for half a second
is still there."""
_POLL = 0.2  # seconds between the questions of a watch: with the lifetime, less than a second
_LISTED = 3.0  # seconds that the set of nodes outlives the last renewal of any of them
_CLEANING = 40  # renewals after which a node removes from the set what has left and was not asked for
_REFUSED = 5.0  # seconds between attempts of a node that the server refuses
_FAREWELL = 0.3  # seconds that closing an interface takes at most for removing its key
_RECENT = 60.0  # seconds for which a node is said to publish a key after an update of it
_CLOCK_AGE, _CLOCK_READINGS = 10.0, 3  # seconds after which a node measures its clock again, and round trips for it
_MOST_NODES, _MOST_NAMES, _LONGEST_TEXT = 10_000, 50, 600
_MOST_EVENTS = 1000  # that wait for a loop over events

_NAME = re.compile(r"[^\s\x00-\x1f\x7f-\x9f]{1,64}")
_ID = re.compile(r"[0-9a-f]{12}")


@dataclass(frozen=True, slots=True)
class NodeInfo:
    """A program that is connected under a name.

    Attributes:
        name: What the program calls itself: `RedisInterface(..., name=)`. Several may have the same.
        host: The name of its computer.
        pid: Its process id there.
        id: Different for each interface, also if two programs have one name.
        since: Seconds for which it has been connected, on its own clock, at its last renewal.
        publishes: The top-level keys that it has published in the last minute; 50 at most.
        serves: The services that it offers.
        owns: The top-level keys that it owns.
        clock: By how much the server's clock is ahead of its computer's, measured in the last ten seconds; None if it
            may not ask, or is of an earlier version.
    """

    name: str
    host: str
    pid: int
    id: str
    since: float
    publishes: tuple[str, ...] = ()
    serves: tuple[str, ...] = ()
    owns: tuple[str, ...] = ()
    clock: ClockOffset | None = None


@dataclass(frozen=True, slots=True)
class NodeEvent:
    """A program that has joined or left.

    Attributes:
        kind: "joined" or "left".
        node: The program. If it has left: as it was seen last.
        initial: It was there when watching began.
    """

    kind: Literal["joined", "left"]
    node: NodeInfo
    initial: bool = False


def check_node_name(name: object) -> str:
    if not isinstance(name, str):
        raise BadType(f"name={shorten(name)} is not a str; use a name such as 'planner', or leave it out")
    if not _NAME.fullmatch(name) or not name.isprintable():
        raise BadValue(f"name={shorten(name)} cannot be used; give 1 to 64 printable characters without blanks")
    return name


def _index(keys: Keys) -> str:
    return f"{keys.tag}{PRESENCE}s"


def _key(keys: Keys, node_id: str) -> str:
    return f"{keys.tag}{PRESENCE}:{node_id}"


def _renewal(keys: Keys, node_id: str, said: dict[str, Any]) -> Plan:
    """Plan to announce a node for the next moment; one round trip."""
    text = json.dumps(said, separators=(",", ":"))
    commands: list[Command] = [
        ("SET", _key(keys, node_id), text, "PX", round(_LIFETIME * 1000)),
        ("SADD", _index(keys), node_id),
        ("PEXPIRE", _index(keys), round(_LISTED * 1000)),
    ]
    return Plan(commands, lambda replies: raise_refused(replies, commands))


def _listing(keys: Keys) -> Plan:
    """Plan to read all nodes, by id; two round trips, and a third one if some have left without a word."""
    list_ids: Command = ("SMEMBERS", _index(keys))

    def decode_ids(replies: Sequence[Reply]) -> Any:
        raise_refused(replies, [list_ids])
        texts = [reply.decode("ascii", "replace") for reply in replies[0]][:_MOST_NODES]
        ids = [text for text in texts if _ID.fullmatch(text)]
        gets: list[Command] = [("GET", _key(keys, node_id)) for node_id in ids]
        return Plan(gets, lambda replies: decode_nodes(ids, gets, replies)) if ids else {}

    def decode_nodes(ids: Sequence[str], gets: Sequence[Command], replies: Sequence[Reply]) -> Any:
        raise_refused(replies, gets)
        found = {
            node_id: node
            for node_id, raw in zip(ids, replies, strict=True)
            if (node := _decoded(node_id, raw)) is not None
        }
        gone = [node_id for node_id, raw in zip(ids, replies, strict=True) if raw is None]
        return Plan([("SREM", _index(keys), *gone)], lambda replies: found) if gone else found

    return Plan([list_ids], decode_ids)


def _decoded(node_id: str, raw: Any) -> NodeInfo | None:
    try:
        said = json.loads(raw)
        kinds = "publishes", "serves", "owns"
        publishes, serves, owns = (tuple(_text(each) for each in said[kind][:_MOST_NAMES]) for kind in kinds)
        pid, since = said["pid"], said["since"]
        if type(pid) is not int or not 0 < pid < 1 << 32 or type(since) is not float or not 0 <= since < math.inf:
            return None
        name, host, clock = check_node_name(said["name"]), _text(said["host"]), _clock(said.get("clock"))
        return NodeInfo(name, host, pid, node_id, since, publishes, serves, owns, clock)
    except (ValueError, TypeError, KeyError, RecursionError):
        return None


def _clock(said: Any) -> ClockOffset | None:
    return ClockOffset(*map(float, said)) if said is not None and math.isfinite(sum(said)) else None


def _text(value: object) -> str:
    if not isinstance(value, str) or len(value) > _LONGEST_TEXT:
        raise BadType(f"{shorten(value)} is no text")
    return value


def _group(session: Session) -> Keys:
    return session.keys(_GROUP)


async def listed(session: Session) -> dict[str, NodeInfo]:
    nodes: dict[str, NodeInfo] = await session.run(_listing(_group(session)))
    return nodes


class Presence:
    """Announces one named interface as long as it is open, in each process and event loop that uses it.

    It starts with the first connection. A forked child that uses the interface is another node.
    """

    def __init__(self, session: Session, clock: ServerClock, name: str) -> None:
        self._session = session
        self._clock = clock
        self._name = check_node_name(name)
        _group(session)  # raises BadKey if the namespace leaves no room
        self._host = socket.gethostname()[:_LONGEST_TEXT]
        self._ids: dict[object, str] = {}  # by process and event loop
        self._over = False
        session.transport.states.on_opened = self.begin

    def begin(self) -> None:
        """Announce the interface from now on. Idempotent; any thread may call."""
        place = self._session.tasks.place
        node_id = secrets.token_hex(6)
        if self._over or self._ids.setdefault(place, node_id) is not node_id:
            return
        try:
            self._session.tasks.start(self._announce(place, node_id), "reem presence")
        except RuntimeError:  # no thread can start: Python is ending, or there are too many
            del self._ids[place]

    async def _announce(self, place: object, node_id: str) -> None:
        began, turns, said = time.monotonic(), 0, ""
        try:
            while not self._over:
                now = time.monotonic()
                pause = _RENEWAL
                try:
                    # Not before it is announced, which is not to wait for it.
                    clock = await self._clock.known(_CLOCK_AGE, _CLOCK_READINGS) if turns else None
                    await self._renew(node_id, now - began, clock)
                    if turns % _CLEANING == 0:
                        await listed(self._session)
                    turns += 1
                except InterfaceClosed:
                    return
                except Refused as error:
                    if said != (said := str(error)):
                        logger.warning("other programs do not see the node %s, all else works: %s", self._name, error)
                    pause = _REFUSED
                except (ReemError, RedisError, OSError) as error:  # an outage
                    logger.debug("not announced: %s", error)
                await self._session.tasks.pause(max(now + pause - time.monotonic(), 0.02))
        finally:
            if self._ids.get(place) is node_id:
                del self._ids[place]

    async def _renew(self, node_id: str, since: float, clock: ClockOffset | None) -> None:
        keys, session = _group(self._session), self._session
        # In turn with `leave`, which must not be followed by a renewal.
        async with session.transport.ordered(_index(keys)):
            if not self._over:
                told = session.activities.told(_RECENT, _MOST_NAMES)
                about = {"name": self._name, "host": self._host, "pid": os.getpid(), "since": round(since, 3)}
                if clock is not None:
                    about["clock"] = clock.offset, clock.bound, clock.measured
                await session.run(_renewal(keys, node_id, about | told))

    async def leave(self) -> None:
        """End the announcement, before the interface is closed. Without a connection it ends by itself."""
        self._over = True
        session = self._session
        node_id = self._ids.get(session.tasks.place)
        if node_id is None or session.transport.states.last.state != "connected":
            return
        keys = _group(session)
        with contextlib.suppress(ReemError, RedisError, OSError), timeout(min(_FAREWELL, time_limit(_FAREWELL))):
            async with session.transport.ordered(_index(keys)):
                # What the user may not remove expires.
                commands: list[Command] = [("UNLINK", _key(keys, node_id)), ("SREM", _index(keys), node_id)]
                await session.run(Plan(commands, lambda replies: None))


class NodeWatch(Stream[NodeEvent]):
    """Yields an event for each program that joins or leaves: an async iterator.

    Those that are there come first (`initial`). A program that closes its interface, ends, is killed, stands still or
    loses its network has left within a second. One that comes back joins again, with the same `id` if it is the same
    process. While this program has no connection, nothing is reported. What has changed meanwhile is reported within
    two seconds after it is back. Of more than 1,000 events that wait for a slow loop, the oldest are dropped.
    """

    def __init__(self, session: Session) -> None:
        super().__init__(Last(_MOST_EVENTS))
        self._session = session
        self._nodes: dict[str, NodeInfo] = {}
        self._place: tuple[int, asyncio.AbstractEventLoop] | None = None
        self._task: asyncio.Task[None] | None = None

    @property
    def _following(self) -> bool:
        return self._place is not None and self._place[0] == os.getpid() and not self._place[1].is_closed()

    async def listen(self) -> None:
        """Begin to watch. Idempotent; two round trips.

        Raises:
            NotConnected: No server listens there.
            NotAllowed: The user lacks a right; says which.
            InterfaceClosed: The watch or the interface was closed before.
        """
        if self._closed:
            raise InterfaceClosed("this watch was closed; make a new one")
        if self._following:
            return
        self._nodes = await listed(self._session)
        for node in in_order(self._nodes.values()):
            self.queue.put(NodeEvent("joined", node, initial=True))
        self._place = os.getpid(), asyncio.get_running_loop()
        self._task = self._session.tasks.start(_poll(weakref.ref(self), self._session), "reem watch of nodes")
        # Also where the interface is closed: a loop that waits for an event ends.
        queue = self.queue
        self._task.add_done_callback(lambda _: queue.close())

    async def close(self) -> None:
        """Stop watching and end the loop. Idempotent."""
        await super().close()
        if self._task is not None and self._following:
            self._task.cancel()

    def _compare(self, found: dict[str, NodeInfo], *, keep: bool) -> None:
        """Report the differences; `keep` those that are missing, since they may not have come back yet."""
        before = self._nodes
        left = [] if keep else [before[node_id] for node_id in before.keys() - found.keys()]
        joined = [found[node_id] for node_id in found.keys() - before.keys()]
        self._nodes = {**before, **found} if keep else found
        for kind, nodes in (("left", left), ("joined", joined)):
            for node in in_order(nodes):
                self.queue.put(NodeEvent(kind, node))  # type: ignore[arg-type]


async def _poll(reference: weakref.ref[NodeWatch], session: Session) -> None:
    """Ask again and again which nodes there are, until the watch is dropped or closed."""
    back = -math.inf  # when the server answered for the first time after an outage
    away = False
    while True:
        await asyncio.sleep(_POLL)
        if reference() is None:
            return
        try:
            found = await listed(session)
        except InterfaceClosed:
            return
        except (ReemError, RedisError, OSError) as error:
            logger.debug("nodes are not known: %s", error)
            away = True
            continue
        if away:
            away, back = False, time.monotonic()
        watch = reference()
        if watch is None:
            return
        # A server that was restarted has forgotten all nodes. They need a moment to come back.
        watch._compare(found, keep=time.monotonic() - back < 1.0)
        del watch


def in_order(nodes: Iterable[NodeInfo]) -> list[NodeInfo]:
    return sorted(nodes, key=lambda node: (node.name, node.host, node.pid, node.id))
