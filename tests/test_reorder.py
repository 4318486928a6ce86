"""What is heard of a key of a cluster in two ways: in one order, nothing lost, nothing told twice."""

import asyncio
import contextlib
import itertools
import weakref

import hypothesis.strategies as st
import pytest
from clusterkit import on_each_node, raw_of
from conftest import Keys, aeventually
from hypothesis import given, settings

import reem_async
from reem_async.errors import InterfaceClosed
from reem_async.plan.notices import Notice
from reem_async.pubsub import key_watcher
from reem_async.pubsub.key_watcher import ReorderBuffer
from reem_async.pubsub.manager import manager_of
from reem_async.pubsub.monitor import Monitor
from reem_async.tools.recording import Recorder, open_log

CHANNEL = b"{key}:notices"


@pytest.fixture
def key():
    return Keys()


@pytest.fixture
async def pair(cluster):
    async with reem_async.RedisInterface(cluster) as one, reem_async.RedisInterface(cluster) as two:
        yield reem_async.PublishSpace(one), two


def notice(sequence, publisher="p"):
    return Notice(publisher, sequence, 0.0, (), False, sequence)


class Heard:
    def __init__(self):
        self.told = []

    def on_notice(self, it, channel):
        assert channel == CHANNEL
        self.told.append((it.publisher, it.sequence))

    def invalidate(self, channel):
        assert channel == CHANNEL
        self.told.append("doubt")


def handed(listener, *, here=False):
    return ReorderBuffer(weakref.ref(listener), CHANNEL, here=here)


def played(draw, ways):
    """What a listener was told when the two ways, to all nodes and at the key's own, brought these, interleaved."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(key_watcher, "_PATIENCE", 0.001)
        return asyncio.run(_played(draw, ways))


async def _played(draw, ways):
    listener = Heard()
    made = handed(listener)
    left = [list(each) for each in ways]
    while any(left):
        which = draw(st.sampled_from([place for place, each in enumerate(left) if each]))
        publisher, number = left[which].pop(0)
        (made.told_here if which else made.told_to_all)(notice(number, publisher))
    if made.waits:
        await aeventually(lambda: not made.waits)
    return listener.told


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_however_the_two_ways_interleave_each_update_is_told_once_and_in_the_server_s_order(data):
    """All nodes are told the first updates of some publishers, and the key is followed from some instant on."""
    numbers = dict.fromkeys("pqr", 0)
    order = []
    for publisher in data.draw(st.lists(st.sampled_from("pqr"), min_size=1, max_size=30)):
        numbers[publisher] += 1
        order.append((publisher, numbers[publisher]))
    followed = data.draw(st.integers(0, len(order)))
    until = data.draw(st.integers(followed, len(order)))
    assert played(data.draw, [order[:until], order[followed:]]) == order


@pytest.mark.long
@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_what_neither_way_brings_is_a_hole_in_the_numbers_and_all_else_is_told_once(data):
    """Any of those that all nodes are told may be missing: what the receiver did not get must be what was lost."""
    count = data.draw(st.integers(1, 15))
    followed = data.draw(st.integers(2, count + 1))
    heard = sorted({1, *data.draw(st.sets(st.integers(1, count)))})
    ways = [[("p", number) for number in heard], [("p", number) for number in range(followed, count + 1)]]
    numbers = [each[1] for each in played(data.draw, ways) if each != "doubt"]
    assert numbers == sorted({*numbers})
    assert {*numbers} >= {number for number in heard if number < followed}
    assert {*numbers} <= {*heard, *range(followed, count + 1)}
    assert count < followed or numbers[-1] == count


@pytest.mark.parametrize(
    ("publisher", "number", "doubt"), [("p", 4, []), ("q", 7, ["doubt"]), ("q", 1, [])], ids=["known", "new", "first"]
)
async def test_what_does_not_come_is_not_waited_for_for_ever(monkeypatch, publisher, number, doubt):
    """What is missing shows in the numbers; of a publisher nothing is known of, it is said that there may be more."""
    monkeypatch.setattr(key_watcher, "_PATIENCE", 0.01)
    listener = Heard()
    made = handed(listener)
    made.told_to_all(notice(1))
    made.told_here(notice(number, publisher))
    made.told_here(notice(number + 1, publisher))
    assert listener.told == [("p", 1)]
    assert made.waits
    await aeventually(lambda: not made.waits)
    made.told_here(notice(number + 2, publisher))
    made.told_to_all(notice(3))
    assert listener.told == [("p", 1), *doubt, *((publisher, number + more) for more in range(3))]


async def test_of_a_crowd_of_updates_some_are_forgotten(monkeypatch):
    monkeypatch.setattr(key_watcher, "_MOST", 3)
    listener = Heard()
    made = handed(listener)
    for number in range(10):
        made.told_to_all(notice(1, f"p{number}"))
        assert len(made._told) <= 3
    for number in range(10):
        made.told_here(notice(2, f"p{number}"))
        assert len(made._waiting) <= 3
    assert len(listener.told) == 20


@contextlib.asynccontextmanager
async def hearing(interface, pattern):
    """A monitor, and the events it has had, taken as they come."""
    events = []

    async def take(monitor):
        async for event in monitor:
            events.append(event)  # noqa: PERF401

    async with Monitor(interface, [pattern]) as monitor:
        task = asyncio.create_task(take(monitor))
        yield events
        task.cancel()


async def test_a_fast_publisher_of_new_keys_is_heard_from_the_first_update_on_without_a_gap(cluster, pair, key):
    """Nodes pass on up to 50 ms late what all are told, so the ways are far apart."""
    space, other = pair
    names = on_each_node(cluster, key, 3)
    async with hearing(other, key("*")) as events:
        for name in names:
            for number in range(1, 61):
                await space[name].write(number)
                await asyncio.sleep(0.0005)
        await aeventually(lambda: len(events) >= 60 * len(names))
    assert not [event for event in events if event.gap or event.missed]
    for name in names:
        assert [event.sequence for event in events if event.name == name] == list(range(1, 61))


async def test_a_fence_is_behind_all_that_was_published_on_any_node(cluster, pair, key):
    """As a recorder needs it that is told to end."""
    space, other = pair
    names = on_each_node(cluster, key, 1)
    for name in names:
        await space[name].write(0)
    async with Monitor(other, [key("*")]) as monitor:
        for number in range(1, 101):
            for name in names:
                await space[name].write(number)
        await manager_of(other.session).fence()
        waiting = [monitor.queue.take() for _ in range(len(monitor.queue._items))]
    for name in names:
        assert [event.value for event in waiting if event.name == name][-100:] == list(range(1, 101))


def delay(monkeypatch, first, others):
    """Have the notices that all nodes get come late by so many seconds."""
    take, count = key_watcher._NewKeysListener.on_notice, itertools.count()

    def on_notice(self, *arguments):
        asyncio.get_running_loop().call_later(others if next(count) else first, take, self, *arguments)

    monkeypatch.setattr(key_watcher._NewKeysListener, "on_notice", on_notice)


@pytest.mark.parametrize("first", [0.1, 0.4], ids=["of a key that was heard of", "of a key that a search found"])
async def test_what_a_recorder_reads_is_behind_updates_that_come_late_over_other_nodes(
    cluster, pair, key, file, monkeypatch, first
):
    """The value that was read stood in front of the updates that it has."""
    space, other = pair
    delay(monkeypatch, first, 0.4)
    async with Recorder(other, [key("*")], file) as recorder:
        for number in range(1, 21):
            await space[key("n")].write(number)
        if first == 0.4:
            await recorder._search()
        await aeventually(lambda: key("n") in recorder._keys._recorders)
    with open_log(file) as log:
        assert [update.value for update in log.updates(patterns=[key("n")])] == list(range(1, 21))
        assert log.metadata["gaps"] == "0"


@pytest.mark.parametrize("seconds", [0.0, 0.1])
async def test_what_was_published_before_a_monitor_listens_does_not_come_late(cluster, pair, key, monkeypatch, seconds):
    """Whether its notice comes while the keys are looked for or after that."""
    space, other = pair
    delay(monkeypatch, seconds, seconds)
    look = key_watcher.KeyWatcher._look

    async def looking(self, listener, *, late):
        await space[key()].write(0)
        monkeypatch.undo()
        await look(self, listener, late=late)

    monkeypatch.setattr(key_watcher.KeyWatcher, "_look", looking)
    async with hearing(other, key("*")) as events:
        await asyncio.sleep(0.2)
        await space[key()].write(1)
        await aeventually(lambda: events and events[-1].value == 1)
    assert [event.value for event in events] == [1]


@pytest.mark.parametrize("spelled_out", [False, True], ids=["a pattern", "names"])
async def test_a_connection_that_breaks_is_one_gap_however_many_keys_were_followed_over_it(
    cluster, pair, key, spelled_out
):
    space, other = pair
    names = on_each_node(cluster, key, 5)
    for name in names:
        await space[name].write(0)
    losses, manager = [], manager_of(other.session)
    async with Monitor(other, names if spelled_out else [key("*")]) as monitor:
        monitor.resynchronised = lambda: losses.append(1)
        for node in cluster.nodes:
            before, count = {*manager._wires.values()}, len(losses)
            with raw_of(node) as raw:
                raw.client_kill_filter(_type="pubsub")
            await aeventually(lambda before=before: len({*manager._wires.values()} - before) == 1)
            await aeventually(lambda: not manager._missing() and monitor.connected)
            assert len(losses) == count + 1
        assert len(manager._subscribed) == len(names) + (not spelled_out)


async def test_a_connection_that_is_made_while_the_interface_closes_is_closed_too(server_url, key):
    async with reem_async.RedisInterface(server_url) as interface:
        manager = manager_of(interface.session)
        following = asyncio.create_task(reem_async.SilentSubscriber(key(), interface).listen())
        node = await interface.session.transport.owner(key().encode())
        opening = asyncio.create_task(manager._connected(node))
        await asyncio.sleep(0)
        await manager.close()
        for each in (following, opening):
            with pytest.raises(InterfaceClosed):
                await each
        assert not [wire for wire in manager._wires.values() if wire.alive]
