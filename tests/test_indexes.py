"""Indexes that count from the end of a list: the item that is meant is the one of the instant when it is used."""

import contextlib

import numpy as np
import pytest
from conftest import aeventually, assert_no_orphans, assert_same, commands_run

from reem_async import KeyValueStore, PublishSpace, SilentSubscriber
from reem_async.concurrency.queues import Every
from reem_async.errors import MissingKey, PathRefused, WrongType


def test_a_read_from_the_end_is_one_command(front, key, raw):
    front.write([key()], [1, [2, 3]])
    for path in ([-1], [-2], [-1, -2]):
        before = commands_run(raw)
        front.read([key(), *path])
        assert sum(commands_run(raw).values()) - sum(before.values()) == 1


@contextlib.contextmanager
def meddling(interface, monkeypatch, meddle):
    """Has `meddle` called between the look at a list and the transaction that changes it, the first time."""
    transport, acts = interface.session.transport, [meddle]
    hold = transport.hold

    class Between:
        def __init__(self, held):
            self._held = held

        async def roundtrip(self, commands, **options):
            if commands[0] == ("MULTI",) and acts:
                acts.pop()()
            return await self._held.roundtrip(commands, **options)

    @contextlib.asynccontextmanager
    async def held():
        async with hold() as inner:
            yield Between(inner)

    with monkeypatch.context() as patch:
        patch.setattr(transport, "hold", held)
        yield
    assert not acts


CHANGES = {
    "write": (lambda place: place.write(7), [7]),
    "write an array": (lambda place: place.write(np.arange(3)), [np.arange(3)]),
    "delete": (lambda place: place.delete(), []),
    "increment": (lambda place: place.increment(2), [12]),
    "divide": (lambda place: place.divide(4), [2.5]),
}


@pytest.mark.parametrize("space", [KeyValueStore, PublishSpace])
@pytest.mark.parametrize("change", CHANGES)
async def test_a_change_meets_the_item_that_is_last_when_it_is_made(ainterface, key, raw, monkeypatch, space, change):
    kvs, call, expected = KeyValueStore(ainterface), *CHANGES[change]
    await kvs[key()].write({"l": [1, 10]})

    def meddle():
        raw.execute_command("JSON.SET", key(), "$.l", "[10]")

    async with SilentSubscriber(key(), ainterface, Every(100)) as mirror:
        updates = mirror.watch()
        await updates.listen()
        with meddling(ainterface, monkeypatch, meddle):
            await call(space(ainterface)[key()]["l"][-1])
        assert_same(await kvs[key()]["l"].read(), expected)
        if space is PublishSpace:
            first = await anext(updates)
            assert first.initial
            assert (await anext(updates)).path == f"{key()}.l[0]"
    assert_no_orphans(raw, key())


@pytest.mark.parametrize("change", CHANGES)
async def test_a_change_that_lost_its_item_meanwhile_counts_as_no_update(ainterface, key, raw, monkeypatch, change):
    kvs, space, call = KeyValueStore(ainterface), PublishSpace(ainterface), CHANGES[change][0]
    await space[key()].write({"l": [10]})

    def meddle():
        raw.execute_command("JSON.SET", key(), "$.l", "[]")

    async with SilentSubscriber(key(), ainterface) as mirror:
        updates = mirror.watch(Every(100))
        assert (await anext(updates)).initial
        with meddling(ainterface, monkeypatch, meddle), pytest.raises((MissingKey, PathRefused)):
            await call(space[key()]["l"][-1])
        assert await kvs[key()]["l"].read() == []
        await space[key()]["n"].write(1)
        update = await anext(updates)
        assert (update.path, update.missed, update.gap) == (f"{key()}.n", 0, False)
        await aeventually(lambda: mirror.value() == {"l": [], "n": 1} or mirror.value() == {"l": [10], "n": 1})
    assert_no_orphans(raw, key())


async def test_an_append_below_an_index_from_the_end_goes_to_one_list(ainterface, key, raw, monkeypatch):
    for space in (KeyValueStore(ainterface), PublishSpace(ainterface)):
        await space[key()].write([[1], [2]])
        with meddling(ainterface, monkeypatch, lambda: raw.execute_command("JSON.SET", key(), "$", "[[2]]")):
            await space[key()][-1].extend([3, 4])
        assert await KeyValueStore(ainterface)[key()].read() == [[2, 3, 4]]
        with pytest.raises(MissingKey):
            await space[key()][-2].append(1)
        with pytest.raises(WrongType):
            await space[key()][-1][-1].append(1)
