"""The port over a cluster: each plan goes to the node that has the slot of its key.

All keys of a plan carry one hash tag, so one node has them all. A node that has not, or not yet,
applies nothing and says so; then, and only then, the commands are sent again, to another node or a
little later, within the call's time limit. A connection that breaks after sending is never a reason.

One transaction is guarded besides: one that publishes. Servers look at a transaction's keys before
they run it, but not if it holds a PUBLISH of any kind: while a slot is moving they would then write
to a key that has left already. So its keys are watched first, which takes one more round trip, and
another where there is something large, which is sent before: see `plan.sizes`.
"""

from __future__ import annotations

import random
import secrets
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any

import redis.exceptions

from ..errors import BadValue, ConnectionLost, InterfaceClosed, NotAllowed, NotConnected, TlsRefused
from ..plan import Command, Reply
from ..plan.sizes import are_missing, as_given, is_large, looks_at, stage
from . import CompositeTransport, Contention, Guard, Held, NewTransport, Transport
from .options import Address, NodeOptions, Options, address_of, listed
from .route import (
    Ask,
    HeldAcross,
    Moved,
    Route,
    asked_of,
    key_slot,
    keys_in,
    looked_early,
    places_refused,
    publishes,
    refusal,
    slot_of,
    slots_of,
    watched,
    without_looks,
)
from .state import States

SLOTS = 16384

_EXAMPLE = "redis+cluster://user:password@host:7000,host:7001"
_LOOK_PAUSE = 0.03  # seconds for which a look at the cluster's layout is not repeated
_PUBLISHING = 64  # how many publish at the same time, each over a connection of its own


class ClusterOptions(Options):
    """How to reach the nodes of a cluster.

    Args:
        url: `redis+cluster://user:password@host:port,host:port`, or `rediss+cluster://`; some of the nodes.
        timeout, options: As for `Options`; the same for all nodes.
    """

    def __init__(self, url: str, timeout: float, options: dict[str, Any]) -> None:
        urls = listed(url, _EXAMPLE)
        self.seeds: list[Address] = [address_of(one, 6379) for one in urls]  # the nodes that the URL names
        super().__init__(urls[0], timeout, options)
        if self.database:
            raise BadValue(
                f"db={self.database}: a cluster has only database 0; "
                "use namespace= (--namespace) to keep programs apart"
            )

    @property
    def address(self) -> str:
        return ",".join(f"{host}:{port}" for host, port in self.seeds)

    @property
    def url(self) -> str:
        return f"{'rediss' if self.tls else 'redis'}+cluster://{self.address}"


class ClusterTransport(CompositeTransport):
    _options: ClusterOptions
    sharded = True

    def __init__(self, options: ClusterOptions, new_transport: NewTransport) -> None:
        self._options = options
        self._new_transport = new_transport
        self._nodes: dict[Address, Transport] = {}
        # By slot; None before the first look, and for slots that no node has.
        self._owners: list[Transport | None] = [None] * SLOTS
        self._primaries: tuple[Address, ...] = ()
        # When a node did not answer last: it is asked for the layout behind all others.
        self._failed: dict[Address, float] = {}
        # Nodes that a connection was lost to, and that no connection has reached since.
        self._gone: set[Address] = set()
        self._looked = 0.0
        # When a look was in vain last, and why.
        self._vain: tuple[float, Exception] | None = None
        self.states = States()
        # Any node will do: it lends its locks and its event loop, and lives as long as this.
        self._root = self._node(options.seeds[0])

    def _node(self, address: Address) -> Transport:
        node = self._nodes.get(address)
        if node is None:
            node = self._new_transport(NodeOptions(self._options, address))
            node.states = _NodeStates(self, address)
            node = self._nodes.setdefault(address, node)  # another thread may have made it meanwhile
        return node

    # The port.

    async def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        self._root.check()
        if len(commands) > 1:
            if commands[-1][0] == "EXEC":
                return await (self._publish(commands, bulk) if publishes(commands) else self._apply(commands, bulk))
            slots = slots_of(commands)
            # Commands of several top-level keys, as listings and migrations send them; a plan that writes has one slot.
            if len(set(slots)) > 1:
                return await self._scattered(commands, slots, bulk)
        slot = slot_of(commands)
        # The hot path: one look into a list, and one round trip if the layout is still what it was.
        owner = None if slot is None else self._owners[slot]
        if owner is None:
            return await self._apply(commands, bulk)
        try:
            replies = await owner.roundtrip(commands, bulk=bulk)
        except NotConnected as error:
            return await self._apply(commands, bulk, error, None, owner)
        problem = refusal(replies)
        return replies if problem is None else await self._apply(commands, bulk, problem, replies, owner)

    @asynccontextmanager
    async def hold(self, guard: Guard | None = None) -> AsyncIterator[Held]:
        held = HeldAcross(self)
        try:
            yield held if guard is None else guard(held)
        except BaseException as error:
            await held.leave(error)
            raise
        await held.leave()

    async def close(self) -> None:
        self.states.closed()
        await super().close()

    def _all(self) -> list[Transport]:
        return list(self._nodes.values())

    async def nodes(self) -> Sequence[Transport]:
        """Return the primaries, which together hold all keys; raises NotConnected if slots have none."""
        await self.look()
        if missing := self._owners.count(None):
            raise NotConnected(
                f"{missing} slots of the cluster at {self._options.address} have no node, so a part of the keys cannot "
                "be reached; `redis-cli --cluster check host:port` tells which, and --cluster fix mends it"
            )
        return [self._node(address) for address in self._primaries]

    async def owner(self, key: str | bytes, *, refresh: bool = False) -> Transport:
        """Return the node that has `key`; `refresh` if what is known is in doubt. Raises NotConnected."""
        return await self.owner_of(key_slot(key if isinstance(key, bytes) else key.encode()), refresh=refresh)

    async def owner_of(self, slot: int, *, refresh: bool = False) -> Transport:
        if refresh or self._owners[slot] is None:
            await self.look()
        found = self._owners[slot]
        if found is None:
            raise NotConnected(f"no node of the cluster at {self._options.address} has slot {slot} at the moment")
        return found

    # The layout.

    async def look(self) -> None:
        """Ask a node for the layout of the slots, unless that was just done.

        Two nodes are asked in any case, more only within the call's time limit: the next look begins with the others.

        Raises:
            NotConnected: No node answers.
            redis.exceptions.RedisError: It is no cluster, or this user may not ask.
        """
        self.check()
        asked = time.monotonic()
        async with self._root.ordered("the layout of the cluster"):
            # Another caller has looked while this one waited for the lock, perhaps in vain.
            if self._looked > asked - _LOOK_PAUSE:
                return
            if self._vain is None or self._vain[0] < asked:
                reason = await self._ask_nodes()
                if reason is None:
                    return
                self._vain = time.monotonic(), reason
            reason = self._vain[1]
        # A certificate that is not trusted needs a person to act; waiting does not mend it.
        kind = TlsRefused if isinstance(reason, TlsRefused) else NotConnected
        raise kind(f"no node of the cluster answers; the last one tried: {reason}") from reason

    async def _ask_nodes(self) -> Exception | None:
        """Ask one node after the other until one tells the layout; return None, or why the last one did not."""
        known = {*self._primaries, *self._nodes, *self._options.seeds}
        order = {each: (self._failed.get(each, 0.0), random.random()) for each in known}  # noqa: S311
        deadline = time.monotonic() + self.timeout
        reason: Exception | None = None
        for number, address in enumerate(sorted(known, key=order.__getitem__)):
            if number >= 2 and time.monotonic() > deadline:
                break
            try:
                (reply,) = await self._node(address).roundtrip([("CLUSTER", "SLOTS")])
            except (NotConnected, ConnectionLost) as error:
                self._failed[address], reason = time.monotonic(), error
                continue
            if isinstance(reply, Exception):
                raise self._no_layout(address, reply)
            self._failed.pop(address, None)
            self._learn(reply, address[0])
            self._looked = time.monotonic()
            return None
        return reason

    def _no_layout(self, address: Address, reply: Exception) -> Exception:
        where = f"{address[0]}:{address[1]}"
        if "cluster support disabled" in str(reply):
            return BadValue(f"the server at {where} is no cluster: connect with redis://{where}")
        if isinstance(reply, redis.exceptions.NoPermissionError):
            return NotAllowed(
                f"{where}: {reply}; a user of a cluster needs +cluster|slots and +asking, see docs/fleet.md"
            )
        return reply

    def _learn(self, ranges: Sequence[Any], asked: str) -> None:
        owners: list[Transport | None] = [None] * SLOTS
        primaries: dict[Address, None] = {}
        for first, last, *rows in ranges:
            host, port, *_ = rows[0]
            address = _address(host, port, asked)
            primaries[address] = None
            owner = self._node(address)
            # CLUSTER SLOTS names ranges, both ends included; of each the primary first.
            owners[first : last + 1] = [owner] * (last + 1 - first)
        self._owners, self._primaries = owners, tuple(primaries)
        if self._gone:
            self._gone.intersection_update(primaries)  # the others are not needed any more
            if not self._gone:
                self.states.opened(self._options.address, None)

    def moved(self, problem: Any, asked: Transport) -> Transport:
        """Note what a redirection says, and return the node it names."""
        host, port = problem.host, problem.port
        if not host:  # the same host, another port
            host = next(
                (address[0] for address, node in self._nodes.items() if node is asked), self._options.seeds[0][0]
            )
        node = self._node((host, port))
        # MOVED is for good. ASK is about one key while its slot moves, so it changes nothing here.
        if isinstance(problem, Moved):
            self._owners[problem.slot_id] = node
        return node

    # Sending.

    async def _apply(
        self,
        commands: Sequence[Command],
        bulk: bool,
        problem: Exception | None = None,
        replies: list[Reply] | None = None,
        asked: Transport | None = None,
    ) -> list[Reply]:
        """Send `commands` until a node has applied them all, each once; what was not in time is answered by an error.

        The `problem` is why they, or some of them, were not applied by the node that was `asked` already, and which
        gave these `replies`. Raises NotConnected if nothing was applied in time.
        """
        route = Route(self, slot_of(commands), asked)
        whole = commands[-1][0] == "EXEC"
        # A place for each command; what stands in it before its reply is never looked at.
        answers: list[Reply] = list(replies or commands)
        left = places_refused(answers) if replies is not None and not whole else list(range(len(commands)))
        early = looked_early(commands, left)
        try:
            if problem is not None:
                await route.refused(problem)
            while True:
                try:
                    node = await route.node()
                    sent = without_looks(commands, left) if route.asking and not whole else left
                    got = await asked_of(node, [commands[place] for place in sent], route.asking, bulk)
                except NotConnected as error:
                    await route.refused(error)
                    continue
                problem = refusal(got)
                for place, reply in zip(sent, got, strict=True):
                    answers[place] = reply
                if problem is None:
                    early.update(place for place in left if place not in sent)
                    break
                # A transaction is applied or not. Of other commands some may be: only those that were not are sent
                # again.
                if not whole:
                    left = places_refused(answers)
                    early |= looked_early(commands, left)
                await route.refused(problem)
            left = sorted(early)
            for place in left:
                answers[place] = (await self._apply([commands[place]], bulk))[0]
        except NotConnected as error:
            if len(left) == len(commands):
                raise
            for place in left:  # the others were applied
                answers[place] = error
        return answers

    async def _scattered(self, commands: Sequence[Command], slots: Sequence[int | None], bulk: bool) -> list[Reply]:
        answers: list[Reply] = list(commands)
        grouped: dict[int | None, list[int]] = {}
        for place, slot in enumerate(slots):
            grouped.setdefault(slot, []).append(place)
        for places in grouped.values():
            replies = await self.roundtrip([commands[place] for place in places], bulk=bulk)
            for place, reply in zip(places, replies, strict=True):
                answers[place] = reply
        return answers

    async def _publish(self, commands: Sequence[Command], bulk: bool) -> list[Reply]:
        """Send a transaction that publishes, over a connection that watches its keys; what is large goes before it."""
        slot = slot_of(commands)
        assert slot is not None  # there is a notice, so there is a key
        route, publication, contention = Route(self, slot), Publication(commands), Contention(self.timeout)
        # Each has a connection of its own, for WATCH; one key's notices keep their order, since it has one slot.
        async with self._root.ordered(f"publishing {slot % _PUBLISHING}"):
            while True:
                try:
                    node = await route.node()
                    problem, replies = await publication.send_ahead(node, route.asking)
                    if problem is None and replies is None:
                        async with node.hold() as held:
                            problem, replies = await publication.publish(held, route, bulk)
                    if replies is not None:
                        return replies
                except NotConnected as error:
                    problem = error
                if problem is None:
                    contention.given_up(commands)
                else:
                    await route.refused(problem)

    def lost(self, address: Address, reason: Exception) -> bool:
        """Note that the connections to a node broke; return whether it is missed."""
        if not isinstance(reason, InterfaceClosed):
            self._gone.add(address)
        self.states.lost(reason)
        return address in self._gone and self.states.last.state != "closed"

    def opened(self, address: Address, server: str | None) -> None:
        """Note a connection to a node; all is well when no node is missed any more."""
        self._gone.discard(address)
        if not self._gone:
            self.states.opened(f"{address[0]}:{address[1]}", server)


def _address(host: bytes | str | None, port: Any, asked: str) -> Address:
    """Return where a node is; one that does not know its own name is on the host that was asked."""
    name = host.decode() if isinstance(host, bytes) else (host or "")
    return (asked if name in ("", "?") else name, int(port))


class _NodeStates(States):
    def __init__(self, cluster: ClusterTransport, address: Address) -> None:
        super().__init__()
        self._cluster = cluster
        self._node = address

    def opened(self, address: str, server: str | None) -> None:
        self._cluster.opened(self._node, server)

    def tell(self) -> None:
        self._cluster.states.tell()

    def lost(self, reason: Exception) -> bool:
        return self._cluster.lost(self._node, reason)


Outcome = tuple[Exception | None, list[Reply] | None]
"""Why nothing was applied, to be tried elsewhere or later; or the replies; or neither: to be tried at once."""


class Publication:
    """One transaction with a notice (MULTI, what it does, the notice, EXEC), on its way to the node with its keys."""

    def __init__(self, commands: Sequence[Command]) -> None:
        multi, *body, execute = commands
        channel: str = body[-1][1]
        tag = channel[: channel.index("}") + 1]
        moving, self._coming = stage(body, tag, secrets.token_hex(5))
        self._document = tag[1:-1].encode()
        self._given = commands
        self._commands: Sequence[Command] = [multi, *moving, execute]
        self._there: Transport | None = None

    async def send_ahead(self, node: Transport, asking: bool) -> Outcome:
        if asking:
            self._keep_together()
        if not self._coming or self._there is node:
            return None, None
        try:
            replies = await asked_of(node, [each.upload for each in self._coming], asking, bulk=True)
        except ConnectionLost as error:
            raise NotConnected(f"{error}; what was sent is not in its place, so nothing was applied") from error
        problem = refusal(replies)
        # The slot moves away. What is large would be staged on one node, and the keys to be changed be on the other.
        if isinstance(problem, Ask) and not isinstance(problem, Moved):
            self._keep_together()
            return None, None
        if problem is None and any(isinstance(reply, Exception) for reply in replies):
            return None, self._refused(replies)
        self._there = node if problem is None else None
        return problem, None

    def _keep_together(self) -> None:
        """Send all as it is given: the slot moves, and what is nowhere yet would not be where the other keys are."""
        self._coming, self._commands = [], self._given

    def _refused(self, replies: list[Reply]) -> list[Reply]:
        """Return what a server says to a transaction one of whose commands it does not take."""
        answers: list[Reply] = [None] * len(self._given)
        for place, reply in zip([at for at, each in enumerate(self._given) if is_large(each)], replies, strict=True):
            answers[place] = reply
        answers[-1] = next(reply for reply in replies if isinstance(reply, Exception))
        return answers

    async def publish(self, held: Held, route: Route, bulk: bool) -> Outcome:
        # Where a slot moves, its document tells where its keys may be made: see `route`.
        keys = list(dict.fromkeys([self._document, *keys_in(self._commands)]))
        problem, looks = await watched(held, keys, route, looks_at(self._coming))
        # Forgotten after a minute, or left behind on another node: it is sent again.
        if problem is None and are_missing(looks):
            self._there = None
            await held.roundtrip([("UNWATCH",)])
            return None, None
        if problem is not None:
            return problem, None
        replies = await asked_of(held, self._commands, route.asking, bulk)
        problem = refusal(replies)
        if problem is not None or replies[-1] is None:
            return problem, None
        return None, as_given(self._commands, self._coming, replies)
