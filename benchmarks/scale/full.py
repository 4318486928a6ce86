"""Whole arms at full pace: REEM's own commands, sent and drained over plain sockets by one process.

REEM's clients need more CPU time than the server, so two cores are too few to run a server up to its
budget with them. What the server does is the same here: the commands are made by REEM's plans, and
every follower has its socket. There are no heartbeats.
"""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import itertools
import socket
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from reem_async import RedisInterface
from reem_async.plan import Command, wire_commands
from reem_async.plan.keys import keys_of
from reem_async.plan.reads import read
from reem_async.plan.shapes import ShapeCache
from reem_async.plan.writes import change, set_change
from reem_async.store.publish import DocumentPublisher, PublishTurn
from reem_async.transport.protocol import pack
from reem_async.transport.route import keys_in

from .kinds import ARM
from .measure import VALUES
from .model import Topic
from .servers import Running
from .slots import numbered, slot_of

ARMS = (1, 2, 4)
DRAIN_SECONDS = 0.02
"""How often followers of set points take in what has come: some kilobytes each, so nothing piles up."""
BETWEEN_SECONDS = 0.0003
"""Between the two round trips of a publish in a cluster."""


@dataclass(frozen=True)
class Script:
    """What goes over the wire for one topic.

    Attributes:
        topic: What is published.
        channel: Where followers subscribe.
        watch: What is sent before a publish; empty if nothing is.
        publish: One publish.
        fetch: What a follower sends to fetch the value; empty if the notice has it.
    """

    topic: Topic
    channel: str
    watch: bytes
    publish: bytes
    fetch: bytes


def bytes_of(commands: Sequence[Command]) -> bytes:
    """Return commands as they travel."""
    return b"".join(pack(commands))


async def script(topic: Topic, namespace: str, sharded: bool) -> Script:
    """Return what REEM sends for a topic of one robot."""
    session = RedisInterface("127.0.0.1", namespace=namespace).session  # never connected
    await session.ships.ready()
    writer = DocumentPublisher(session, topic.name)
    text, loaded = await writer.encoder.encoded((), VALUES[topic.value](1))
    keys = keys_of(topic.name, namespace, 0, sharded)
    announcement = PublishTurn(session, keys).reserve(text, loaded)
    commands = wire_commands(change(set_change(keys, (), text, loaded, announcement=announcement), ShapeCache()))
    watch = bytes_of([("WATCH", *keys_in(commands))]) if sharded else b""
    fetch = b""
    if loaded:  # too large for the notice
        look = read(keys, (), session.ships, ShapeCache(), (("GET", keys.last),))
        fetch = bytes_of(wire_commands(look.decode([b"[" + text + b"]"])))
    return Script(topic, keys.channel, watch, bytes_of(commands), fetch)


class Player:
    """One topic of one robot: the socket that publishes, and a socket for each follower."""

    def __init__(self, it: Script, address: tuple[str, int], sharded: bool) -> None:
        self.script = it
        self.published = 0
        self._publisher = _connected(address)
        self._followers = [_connected(address) for _ in range(int(it.topic.followers))]
        self._fetchers = [_connected(address) for _ in self._followers] if it.fetch else []
        self._buffer = bytearray(1 << 20)
        self._length = 0
        for each in self._followers:
            each.sendall(bytes_of([("SSUBSCRIBE" if sharded else "SUBSCRIBE", it.channel)]))
            each.recv(1 << 12)
        self.publish()
        if it.fetch:
            time.sleep(0.1)
            self._drain(self._publisher)
            self._fetchers[0].sendall(it.fetch)
            self._length = self._until_quiet(self._fetchers[0])

    def watch(self) -> None:
        """Begin to publish: the first round trip in a cluster."""
        if self.script.watch:
            self._drain(self._publisher)
            self._publisher.sendall(self.script.watch)

    def publish(self) -> None:
        """Publish, and have all followers fetch what does not fit into the notice."""
        self._drain(self._publisher)
        self._publisher.sendall(self.script.publish)
        self.published += 1
        if self._length:
            self._publisher.recv(1 << 16)
            for each in self._fetchers:
                each.sendall(self.script.fetch)
                self._take(each, self._length)

    def drain(self) -> None:
        """Take in the notices that have come."""
        for each in self._followers:
            self._drain(each)

    def _drain(self, it: socket.socket) -> None:
        with contextlib.suppress(BlockingIOError):
            it.recv_into(self._buffer, 0, socket.MSG_DONTWAIT)

    def _take(self, it: socket.socket, length: int) -> None:
        while length > 0:
            length -= it.recv_into(self._buffer, 0)

    def _until_quiet(self, it: socket.socket) -> int:
        """Return the bytes of a reply, known to be over when nothing comes for a while."""
        it.settimeout(0.3)
        length = 0
        with contextlib.suppress(TimeoutError):
            while True:
                length += it.recv_into(self._buffer, 0)
        it.settimeout(None)
        return length

    def close(self) -> None:
        """Close all sockets."""
        for each in (self._publisher, *self._followers, *self._fetchers):
            each.close()


def _connected(address: tuple[str, int]) -> socket.socket:
    it = socket.create_connection(address, 10.0)
    it.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    it.sendall(bytes_of([("HELLO", "3")]))
    it.recv(1 << 16)
    it.settimeout(None)  # with a limit, Python would wait where it is told not to
    it.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", 10, 0))
    return it


def run_arms(running: Running, arms: int, seconds: float) -> dict[str, Any]:
    """Run so many arms at full pace; returns how often each topic was published, and what it cost the servers."""
    sharded = running.count > 1
    with contextlib.ExitStack() as stack:
        players = []
        for namespace in numbered(arms):
            for topic in ARM.topics:
                address = running.address(slot_of(topic.name, namespace))
                player = Player(asyncio.run(script(topic, namespace, sharded)), address, sharded)
                stack.callback(player.close)
                players.append(player)
        cost = running.primaries.asking()
        _pace(players, 0.5)
        for each in players:
            each.published = 0
        first, begin = running.primaries.sample(), time.monotonic()
        _pace(players, seconds)
        spent, took = running.primaries.sample() - first - cost, time.monotonic() - begin
    counts = {topic.name: sum(each.published for each in players if each.script.topic is topic) for topic in ARM.topics}
    return {
        "robots": arms,
        "seconds": took,
        "published": counts,
        "core": spent.core / took,
        "bytes_out": spent.bytes_out / took,
    }


def _pace(players: Sequence[Player], seconds: float) -> None:
    """Let each topic be published at its pace; what cannot be done in time is done late, and counted as it is."""
    begin = time.monotonic()
    order = itertools.count()
    due: list[tuple[float, int, float, Callable[[], None]]] = []

    def add(moment: float, period: float, action: Callable[[], None]) -> None:
        heapq.heappush(due, (moment, next(order), period, action))

    for number, player in enumerate(players):
        period = 1 / player.script.topic.hertz
        start = begin + number * 0.37e-3  # robots are not in step with each other
        if player.script.watch:
            add(start, period, player.watch)
        add(start + BETWEEN_SECONDS, period, player.publish)
        add(start + DRAIN_SECONDS, DRAIN_SECONDS, player.drain)
    while (now := time.monotonic()) < begin + seconds:
        moment, _, period, action = heapq.heappop(due)
        if moment > now:
            time.sleep(moment - now)
        action()
        add(moment + period, period, action)
