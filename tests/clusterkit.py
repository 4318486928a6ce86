"""Changing a real cluster under a test: moving slots, killing primaries, looking into one node."""

import contextlib
import itertools
import json
import os
import signal
import time

import redis
import redis.crc

from reem_async.errors import ServerFailed
from reem_async.plan.placeholders import find


def slot_of(key):
    return redis.crc.key_slot(key.encode())


def raw_of(node):
    return redis.Redis(port=node.port, decode_responses=True)


def owner(cluster, key):
    with raw_of(cluster.nodes[-1]) as client:
        for (first, last), row in _ranges(client):
            if first <= slot_of(key) <= last:
                return next(node for node in cluster.nodes if node.port == row)
    raise AssertionError(f"nobody has {key}")


def on_each_node(cluster, key, count=1):
    """So many new names for each node."""
    found = {node.port: [] for node in cluster.nodes}
    numbers = itertools.count()
    while min(map(len, found.values())) < count:
        name = key(f"k{next(numbers)}")
        there = found[owner(cluster, name).port]
        if len(there) < count:
            there.append(name)
    return [name for names in found.values() for name in names]


def _ranges(client):
    return [((first, last), primary[1]) for first, last, primary, *_ in client.execute_command("CLUSTER", "SLOTS")]


def agreed(cluster, timeout=20.0):
    """Wait until all nodes say the same of who has which slots, and since when.

    A node that is given a slot takes the highest epoch that it knows of. If another one has a newer epoch that it
    has not heard of yet, and has not been told either that the slot is given away, it takes the slot back: for good.
    """
    deadline = time.monotonic() + timeout
    while len(views := set(map(_view, cluster.nodes)) - {None}) > 1:
        assert time.monotonic() < deadline, f"the nodes do not agree: {views}"
        time.sleep(0.005)


def _view(node):
    """Who has which slots since which epoch, as a node knows it; None if it does not answer."""
    with contextlib.suppress(ServerFailed):
        rows = [row.split(" ") for row in node.say("CLUSTER", "NODES").splitlines()]
        owned = {
            row[0]: (row[6], *[slots for slots in row[8:] if slots[0] != "["]) for row in rows if "master" in row[2]
        }
        return frozenset(item for item in owned.items() if item[1][1:])
    return None


class Move:
    """A slot on its way from one node to another, key by key."""

    def __init__(self, cluster, key, target=None):
        agreed(cluster)
        self.key = key
        self.slot = slot_of(key)
        self.source = owner(cluster, key)
        self.target = target or next(node for node in cluster.nodes[:3] if node is not self.source)
        with raw_of(self.source) as client:
            primaries = {port for _, port in _ranges(client)}
        self._others = [
            node for node in cluster.nodes if node.port in primaries and node not in (self.source, self.target)
        ]

    def begin(self):
        self._say(self.target, "IMPORTING", self.source.id)
        self._say(self.source, "MIGRATING", self.target.id)
        return self

    def take(self, *keys):
        with raw_of(self.source) as client:
            for key in keys:
                client.execute_command("MIGRATE", "127.0.0.1", self.target.port, key, 0, 5000)

    def all_keys(self):
        with raw_of(self.source) as client:
            return client.execute_command("CLUSTER", "GETKEYSINSLOT", self.slot, 1000)

    def left(self):
        """What of the key is still here; other keys may share the slot."""
        return [each for each in self.all_keys() if self.key in each]

    def finish(self, *, source_first=False):
        """Move what is left, and tell all nodes: the source before the target, if so wanted."""
        while keys := self.all_keys():
            self.take(*keys)
        first = (self.source, self.target) if source_first else (self.target, self.source)
        for node in (*first, *self._others):
            self.tell(node)

    def tell(self, node):
        """Tell one node that the slot belongs to the target now."""
        self._say(node, "NODE", self.target.id)

    def on_both(self):
        """The keys of the slot that are on both nodes: they could not be moved any more."""
        return self._keys_of(self.source) & self._keys_of(self.target)

    def _keys_of(self, node):
        with raw_of(node) as client:
            return set(client.execute_command("CLUSTER", "GETKEYSINSLOT", self.slot, 1000))

    def _say(self, node, *words):
        with raw_of(node) as client:
            client.execute_command("CLUSTER", "SETSLOT", self.slot, *words)


@contextlib.contextmanager
def clients_of(nodes):
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(raw_of(node)) for node in nodes]


def assert_tidy(clients, *keys):
    """Of each key, document, registry and arrays name the same arrays, on one node, and there are no others."""
    found = {}
    for client in clients:
        for name in client.scan_iter(count=1000):
            assert name not in found, f"{name} is on two nodes"
            found[name] = client
    for key in keys:
        tag = "{" + key + "}"
        arrays = {name for name in found if name.startswith(tag) and not name.startswith(tag + ":")}
        registry = found[tag + ":ships"].smembers(tag + ":ships") if tag + ":ships" in found else ()
        text = found[key].execute_command("JSON.GET", key) if key in found else "{}"
        referred = {tag + slot.placeholder.suffix for slot in find([json.loads(text)], key)}
        assert (arrays, {tag + suffix for suffix in registry}) == (referred, referred), key


def kill_primary(cluster, key):
    """Kill -9 the node that has a key; returns it."""
    victim = owner(cluster, key)
    os.kill(victim.pid, signal.SIGKILL)
    return victim


def whole_again(cluster, victim, timeout=20.0):
    """Wait until all other nodes know that a replica has taken the victim's slots."""
    rest = [node for node in cluster.nodes if node is not victim]
    deadline = time.monotonic() + timeout
    while not all(_has_all_slots(node, victim) for node in rest):
        assert time.monotonic() < deadline, "there was no failover"
        time.sleep(0.02)


def _has_all_slots(node, victim):
    with contextlib.suppress(redis.exceptions.RedisError), raw_of(node) as client:
        ranges = _ranges(client)
        return sum(last - first + 1 for (first, last), _ in ranges) == 16384 and victim.port not in [
            port for _, port in ranges
        ]
    return False
