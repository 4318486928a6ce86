"""Where a fleet's keys fall: hash slots, the nodes that have them, and moving slots by their weight. Pure functions."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache

import numpy as np
import redis.crc
from numpy.typing import NDArray

from reem_async.plan.keys import keys_of

SLOTS = 16384
Weights = NDArray[np.float64]
Owners = NDArray[np.intp]
Demands = Mapping[str, Mapping[str, float]]

_slot_of: Callable[[bytes], int] = redis.crc.key_slot


@lru_cache(maxsize=200_000)
def slot_of(name: str, namespace: str) -> int:
    """Return the slot of a top-level key and of all that carries its hash tag."""
    return _slot_of(keys_of(name, namespace).tag.encode())


def numbered(robots: int) -> list[str]:
    """Return the namespaces `robots/r1:`, `robots/r2:` and so on."""
    return [f"robots/r{number}:" for number in range(1, robots + 1)]


def serials(robots: int, seed: int) -> list[str]:
    """Return namespaces with eight random hexadecimal digits."""
    draw = random.Random(seed)
    return [f"robots/{draw.getrandbits(32):08x}:" for _ in range(robots)]


def weigh(namespaces: Sequence[str], weights: Mapping[str, float]) -> Weights:
    """Return the weight of each slot if every robot has keys of these weights."""
    found = np.zeros(SLOTS)
    for name, weight in weights.items():
        places = [slot_of(name, namespace) for namespace in namespaces]
        found += weight * np.bincount(places, minlength=SLOTS) if places else 0.0
    return found


def shared_out(nodes: int) -> Owners:
    """Return which node has each slot when they are dealt in equal ranges, as `redis-cli --cluster create` does."""
    owners = np.zeros(SLOTS, np.intp)
    for node in range(nodes):
        owners[round(SLOTS * node / nodes) : round(SLOTS * (node + 1) / nodes)] = node
    return owners


def loads(slots: Weights, owners: Owners, nodes: int) -> Weights:
    """Return the load of each node."""
    return np.bincount(owners, weights=slots, minlength=nodes).astype(np.float64)


def balance(per_node: Weights) -> float:
    """Return how many times the mean the most loaded node has: 1 is even."""
    return float(per_node.max() / per_node.mean())


def reshard(slots: Weights, owners: Owners, nodes: int) -> tuple[Owners, int]:
    """Move slots from the most to the least loaded node, as long as that makes the larger of the two less.

    Of the slots that help, the one is taken that brings the two closest together. What one slot weighs
    cannot be divided: a key that is heavier than the mean stays a hot key.

    Returns:
        Which node has each slot then, and how many were moved.
    """
    owners, per_node = owners.copy(), loads(slots, owners, nodes)
    moved: set[int] = set()
    while True:
        most, least = int(per_node.argmax()), int(per_node.argmin())
        gap = per_node[most] - per_node[least]
        candidates = np.flatnonzero((owners == most) & (slots > 0) & (slots < gap * (1 - 1e-9)))
        if not len(candidates) or gap < 0.01 * per_node.mean():
            return owners, len(moved)
        chosen = int(candidates[np.abs(slots[candidates] - gap / 2).argmin()])
        owners[chosen] = least
        per_node[most] -= slots[chosen]
        per_node[least] += slots[chosen]
        moved.add(chosen)


def dealt(slots: Weights, nodes: int) -> Owners:
    """Deal all slots anew, the heaviest first, each to the node that has least so far."""
    owners, per_node = shared_out(nodes), [(0.0, node) for node in range(nodes)]
    used = np.flatnonzero(slots)
    for slot in used[np.argsort(-slots[used], kind="stable")]:
        load, node = heapq.heappop(per_node)
        owners[slot] = node
        heapq.heappush(per_node, (load + float(slots[slot]), node))
    return owners


def fits(robots: int, demands: Demands, nodes: int, *, moving: bool = False) -> bool:
    """Return whether robots r1, r2, ... fit: no node is asked for more than all of any of its budgets.

    Args:
        robots: How many.
        demands: By budget and key, what part of a node's budget the key takes.
        nodes: Primaries, with equal ranges of slots.
        moving: Slots may be moved, or, if that does not do, all be dealt anew; a key weighs what it takes of
            the budget that it takes most of.
    """
    namespaces, layouts = numbered(robots), [shared_out(nodes)]
    if moving:
        heaviest = {name: max(parts[name] for parts in demands.values()) for name in next(iter(demands.values()))}
        weights = weigh(namespaces, heaviest)
        layouts = [reshard(weights, layouts[0], nodes)[0], dealt(weights, nodes)]
    every = [weigh(namespaces, parts) for parts in demands.values()]
    return any(all(loads(slots, owners, nodes).max() <= 1 for slots in every) for owners in layouts)


def most_robots(demands: Demands, nodes: int, *, moving: bool) -> int:
    """Return how many robots r1, r2, ... fit.

    Without moving slots every robot that is added only adds load, so halving finds the answer. With
    moving that need not be so: the largest count that fits is taken, in steps of half a percent.
    """
    even = int(nodes / max(sum(weights.values()) for weights in demands.values()) + 1e-9)
    if moving:
        counts = range(even, 0, -max(1, even // 200))
        return next((count for count in counts if fits(count, demands, nodes, moving=True)), 0)
    low, high = 0, even + 1  # low fits, high does not
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle, demands, nodes) else (low, middle)
    return low
