"""Indexes that count from the end of a list: the item that is meant is the one of the instant when it is used."""

from __future__ import annotations

import contextlib
import json

import numpy as np
import pytest
from conftest import aeventually, assert_no_orphans, assert_same, commands_run

from reem_async import KeyValueStore, PublishSpace, SilentSubscriber
from reem_async.concurrency.queues import Every
from reem_async.errors import MissingKey, PathRefused, WrongType

LISTS = [[], [1], [1, 2], [{"x": 1}, {"x": [2, 3]}, [4]], {"a": 1}, 5]
PATHS = [[-1], [-2], [-3], [-9], [-2, "x"], [-2, "x", -1], [-2, "x", -3], [-3, "y"], [0, -1], [-1, -1]]


def python_read(value, path):
    for element in path:
        if not isinstance(value, dict if isinstance(element, str) else list):
            raise LookupError
        value = value[element]
    return value


@pytest.mark.parametrize("value", LISTS, ids=repr)
@pytest.mark.parametrize("path", PATHS, ids=repr)
def test_they_mean_what_they_mean_in_python(front, key, value, path):
    where = [key(), "l", *path]

    def fresh():
        front.write([key()], {"l": value})
        return json.loads(json.dumps(value))

    plain = fresh()
    try:
        expected = python_read(plain, path)
    except LookupError:
        with pytest.raises(MissingKey):
            front.read(where)
        with pytest.raises(MissingKey):
            front.delete(where)
        with pytest.raises(MissingKey):
            front.increment(where, 1)
    else:
        assert front.read(where) == expected
        assert front.type(where) is type(expected)
        front.delete(where)
        del python_read(plain, path[:-1])[path[-1]]
        assert front.read([key(), "l"]) == plain
    plain = fresh()
    try:
        parent = python_read(plain, path[:-1])
        if not isinstance(parent, dict if isinstance(path[-1], str) else list):
            raise LookupError
        parent[path[-1]] = "new"
    except LookupError:
        with pytest.raises(PathRefused):
            front.write(where, "new")
        plain = value
    else:
        front.write(where, "new")
    assert front.read([key(), "l"]) == plain


def test_arrays_in_lists_are_reached_from_the_end(front, key, raw):
    items = [np.arange(3), {"a": np.arange(4)}, 7]
    front.write([key()], {"l": items})
    assert_same(front.read([key(), "l", -2]), items[1])
    assert_same(front.read([key(), "l", -2]), items[1])
    front.write([key(), "l", -3], np.arange(5.0))
    front.write([key(), "l", -2, "b"], np.ones(2))
    front.delete([key(), "l", -2, "a"])
    front.append([key(), "l"], [np.zeros(1)])
    front.append([key(), "l", -1], np.arange(2))
    assert_same(front.read([key(), "l"]), [np.arange(5.0), {"b": np.ones(2)}, 7, [np.zeros(1), np.arange(2)]])
    assert_no_orphans(raw, key())


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


async def test_an_edit_from_the_end_keeps_to_the_item_it_read(akvs, key, raw):
    await akvs[key()].write([[1], {"a": np.arange(3)}])
    async with akvs[key()][-1].edit() as value:
        value["a"][0] = 9
        value["b"] = 1
    async with akvs[key()][-2].edit() as value:
        value.append(2)
    assert_same(await akvs[key()].read(), [[1, 2], {"a": np.array([9, 1, 2]), "b": 1}])
    assert_no_orphans(raw, key())


@pytest.mark.parametrize("index", [-1, -2, -3])
@pytest.mark.parametrize("value", [5, np.arange(3)], ids=["a number", "an array"])
def test_what_is_not_there_is_put_below_an_index_from_the_end(kvs, key, raw, index, value):
    """A place that is made must have a path without slices; a parent that is no dict is named."""
    kvs[key()] = [{"a": 1}, {"a": np.arange(2)}, {}]
    assert_same(kvs[key()][index].setdefault("n", value), value)
    assert_same(kvs[key()][index + 3]["n"].read(), value)
    with pytest.raises(PathRefused):
        kvs[key()][index]["n"].setdefault("m", value)
    assert_same(kvs[key()][index].pop("n"), value)
    assert_no_orphans(raw, key())
