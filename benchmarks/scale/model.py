"""The arithmetic: from costs per operation to the robots that a fleet of servers carries. Pure functions.

Units: core microseconds are CPU time of a server's main thread, the only one that runs commands; bytes
are what the server counts (requests in, replies and notices out), without the network's headers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

PACKET_HEADERS = 90
"""Bytes on the line for each packet: 38 of Ethernet with its gap, 20 of IP, 32 of TCP with time stamps."""
PACKET_FULL = 1448
"""Bytes of data in a full packet."""
LEAST_BYTES = 10
"""No command and no notice is shorter."""


@dataclass(frozen=True)
class Cost:
    """What one operation, or one second of something, costs a server.

    Attributes:
        core_us: Microseconds of its main thread.
        bytes_in: Bytes received from clients.
        bytes_out: Bytes sent to clients.
        bytes_replica: Bytes sent to its replicas.
    """

    core_us: float = 0.0
    bytes_in: float = 0.0
    bytes_out: float = 0.0
    bytes_replica: float = 0.0

    def less(self, other: Cost) -> Cost:
        """Return what this costs more than `other`; nothing is cheaper than free."""
        return Cost(*(max(0.0, mine - theirs) for mine, theirs in zip(_row(self), _row(other), strict=True)))

    def times(self, factor: float) -> Cost:
        """Return the cost of `factor` of these."""
        return Cost(*(each * factor for each in _row(self)))


@dataclass(frozen=True)
class Value:
    """What a kind of value costs on a server.

    Attributes:
        measured: What one publish costs, by how many follow, from 0 on; notices and fetches included.
        memory: Bytes of memory for one key.
    """

    measured: tuple[tuple[int, Cost], ...]
    memory: float

    def publish(self, followers: float) -> Cost:
        """Return what one publish costs with so many followers: on the straight line between what was measured.

        Beyond the last, each further follower costs as much as one between the last two.
        """
        if self.measured[0][0] != 0 or len(self.measured) < 2:
            raise ValueError(
                f"costs were measured for {[count for count, _ in self.measured]} followers, not from 0 on"
            )
        pairs = list(zip(self.measured, self.measured[1:], strict=False))
        (low, below), (high, above) = next((pair for pair in pairs if followers <= pair[1][0]), pairs[-1])
        part = (followers - low) / (high - low)
        return Cost(*(one + part * (two - one) for one, two in zip(_row(below), _row(above), strict=True)))

    def following(self, followers: float) -> Cost:
        """Return what each of so many followers adds to one publish; bytes too few for a message are noise."""
        if not followers:
            return Cost()
        more = self.publish(followers).less(self.publish(0)).times(1 / followers)
        sent = (each if each >= LEAST_BYTES else 0.0 for each in (more.bytes_in, more.bytes_out, more.bytes_replica))
        return Cost(more.core_us, *sent)


@dataclass(frozen=True)
class Figures:
    """What was measured in one setting.

    Attributes:
        values: By kind of value.
        heartbeat: One second of one follower while nothing is published.
        connections: Connections of one follower.
        connection_memory: Bytes of the server's memory for one connection.
    """

    values: Mapping[str, Value]
    heartbeat: Cost
    connections: float
    connection_memory: float


@dataclass(frozen=True)
class Topic:
    """One top-level key of a robot: what is published to it, how often, and how many programs follow it."""

    name: str
    value: str
    hertz: float
    followers: float


@dataclass(frozen=True)
class Robot:
    """A kind of robot: its top-level keys."""

    name: str
    topics: tuple[Topic, ...]


@dataclass(frozen=True)
class Load:
    """What something demands of the node that has it.

    Attributes:
        core: Cores of the main thread, 1 is all of it.
        line_in: Bits per second received, headers included.
        line_out: Bits per second sent, to clients and replicas, headers included.
        memory: Bytes.
        connections: Client connections.
    """

    core: float = 0.0
    line_in: float = 0.0
    line_out: float = 0.0
    memory: float = 0.0
    connections: float = 0.0

    def __add__(self, other: Load) -> Load:
        return Load(*(mine + theirs for mine, theirs in zip(_row(self), _row(other), strict=True)))


@dataclass(frozen=True)
class Node:
    """What one server may be asked for, in the units of `Load`: less than all of it, see docs/lab/scale.md."""

    core: float
    line_in: float
    line_out: float
    memory: float
    connections: float


def _row(it: Cost | Load | Node) -> tuple[float, ...]:
    return tuple(getattr(it, field.name) for field in fields(it))


def on_the_line(data: float) -> float:
    """Return the bits that `data` bytes are on the line: full packets and one that is not."""
    return 0.0 if data <= 0 else 8 * (data + PACKET_HEADERS * (data / PACKET_FULL + 1))


def topic_load(topic: Topic, figures: Figures) -> Load:
    """Return what one topic demands of its node."""
    value, beat = figures.values[topic.value], figures.heartbeat
    publish, follower = value.publish(0), value.following(topic.followers)
    fetched = topic.hertz * topic.followers
    core = topic.hertz * publish.core_us + fetched * follower.core_us + topic.followers * beat.core_us
    line_in = (
        topic.hertz * on_the_line(publish.bytes_in)
        + fetched * on_the_line(follower.bytes_in)
        + topic.followers * on_the_line(beat.bytes_in)
    )
    line_out = (
        topic.hertz * (on_the_line(publish.bytes_out) + on_the_line(publish.bytes_replica))
        + fetched * on_the_line(follower.bytes_out)
        + topic.followers * on_the_line(beat.bytes_out)
    )
    # The followers' connections, and one of who publishes.
    connections = topic.followers * figures.connections + 1
    memory = value.memory + connections * figures.connection_memory
    return Load(core / 1e6, line_in, line_out, memory, connections)


def robot_load(robot: Robot, figures: Figures) -> Load:
    """Return what one robot demands, of all nodes together."""
    return sum((topic_load(topic, figures) for topic in robot.topics), Load())


def use(load: Load, node: Node) -> dict[str, float]:
    """Return what part of each of a node's budgets a load takes."""
    return {field.name: mine / most for field, mine, most in zip(fields(load), _row(load), _row(node), strict=True)}


def bottleneck(load: Load, node: Node) -> str:
    """Return which budget is used up first as the load grows."""
    parts = use(load, node)
    return max(parts, key=lambda name: parts[name])


def carried(load: Load, node: Node, primaries: int = 1) -> int:
    """Return how many robots of this load so many primaries carry if the keys were shared out evenly."""
    return math.floor(primaries / max(use(load, node).values()) + 1e-9)


def most_followers(topic: Topic, figures: Figures, node: Node) -> int:
    """Return how many followers one key may have if its node has nothing else to do."""

    def fits(followers: int) -> bool:
        load = topic_load(Topic(topic.name, topic.value, topic.hertz, followers), figures)
        return max(use(load, node).values()) <= 1

    if not fits(1):
        return 0
    low, high = 1, 2
    while fits(high):
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low
