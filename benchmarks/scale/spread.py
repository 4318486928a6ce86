"""The simulation: how evenly fleets load the primaries of a cluster, as the slots fall and after moving some."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from . import kinds
from .model import Figures, Load, Node, Robot, Topic, topic_load, use
from .slots import Demands, balance, loads, most_robots, numbered, reshard, serials, shared_out, slot_of, weigh

SIZES = (1, 3, 10, 30, 100, 300, 1000, 3000, 10_000)
NODES = (3, 50)


@dataclass(frozen=True)
class Spread:
    """How a fleet is spread.

    Attributes:
        fallen: The most loaded node's load by the mean, with equal ranges of slots.
        resharded: The same after moving slots.
        moved: How many slots were moved for that.
        hot: The heaviest key's load by the mean node's: no resharding gets below this.
    """

    fallen: float
    resharded: float
    moved: int
    hot: float


def cores(robot: Robot, figures: Figures) -> dict[str, float]:
    """Return the cores that each of a robot's keys takes."""
    return {topic.name: topic_load(topic, figures).core for topic in robot.topics}


def demands(robot: Robot, figures: Figures, node: Node) -> Demands:
    """Return what part of each of a node's budgets each of a robot's keys takes."""
    parts = {topic.name: use(topic_load(topic, figures), node) for topic in robot.topics}
    return {budget: {name: part[budget] for name, part in parts.items()} for budget in use(Load(), node)}


def shared_core(robots: int, figures: Figures) -> float:
    """Return the cores that the key takes which all robots follow."""
    it = kinds.SHARED
    return topic_load(Topic(it.name, it.value, it.hertz, robots), figures).core


def spread(namespaces: Sequence[str], weights: Mapping[str, float], nodes: int, shared: float = 0.0) -> Spread:
    """Return how robots with keys of these weights, and perhaps one shared key, are spread over nodes."""
    slots, owners = weigh(namespaces, weights), shared_out(nodes)
    slots[slot_of(kinds.SHARED.name, "fleet:")] += shared
    fallen = loads(slots, owners, nodes)
    after, moved = reshard(slots, owners, nodes)
    hot = max(shared, *weights.values()) / fallen.mean()
    return Spread(balance(fallen), balance(loads(slots, after, nodes)), moved, float(hot))


def over_sizes(weights: Mapping[str, float], nodes: int, figures: Figures | None = None) -> list[Spread]:
    """Return the spread for each of SIZES; with figures, every fleet has the shared key besides."""
    return [
        spread(numbered(robots), weights, nodes, 0.0 if figures is None else shared_core(robots, figures))
        for robots in SIZES
    ]


def by_luck(weights: Mapping[str, float], nodes: int, robots: int, fleets: int = 20) -> list[float]:
    """Return the balance, as the slots fall, of fleets whose robots have serial numbers for names; sorted."""
    owners = shared_out(nodes)
    return sorted(balance(loads(weigh(serials(robots, seed), weights), owners, nodes)) for seed in range(fleets))


@lru_cache(maxsize=64)
def _robots(demands_: tuple[tuple[str, tuple[tuple[str, float], ...]], ...], nodes: int, moving: bool) -> int:
    return most_robots({budget: dict(parts) for budget, parts in demands_}, nodes, moving=moving)


def robots_that_fit(robot: Robot, figures: Figures, node: Node, primaries: int, *, moving: bool) -> int:
    """Return how many robots a cluster carries where no node is asked for more than its budgets."""
    wanted = demands(robot, figures, node)
    frozen = tuple((budget, tuple(parts.items())) for budget, parts in wanted.items())
    return _robots(frozen, primaries, moving)
