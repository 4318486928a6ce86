"""What a large array on an event loop does for those who share the loop."""

from __future__ import annotations

import asyncio
import itertools

import numpy as np
from conftest import assert_same


async def test_a_large_array_waits_for_small_calls_that_are_under_way(ainterface, akvs, key, monkeypatch):
    """Encoding, copying and sending it keep the event loop for a millisecond, and their replies with it."""
    transport, name, busy = ainterface.session.transport, key(), []
    upload = type(transport).upload

    def watched(self, wire, commands):
        busy.append(self._lanes[False].busy)
        return upload(self, wire, commands)

    monkeypatch.setattr(type(transport), "upload", watched)
    for first in (True, False):  # whoever is woken first
        large = akvs[name].write({"image": np.zeros(100_000)})
        small = [akvs[key("other")].write(number) for number in range(300)]
        await asyncio.gather(*((large, *small) if first else (*small, large)))
    assert busy == [False, False]


async def test_it_does_not_wait_for_ever(akvs, key):
    """Where calls never end."""
    name, others, over, calls = key(), key("others"), asyncio.Event(), itertools.count()

    async def call():
        while not over.is_set():
            await akvs[others].write(next(calls))

    async with asyncio.TaskGroup() as group:
        for _ in range(10):
            group.create_task(call())
        await akvs[name].write(np.arange(100_000))
        over.set()
    assert next(calls) < 1000  # each time it waits, ten or twenty come first
    assert_same(await akvs[name].read(), np.arange(100_000))


async def test_what_is_stored_is_of_one_instant_though_another_task_comes_first(akvs, key):
    """The array is changed in place, and what is said of it too, while the write waits."""
    name, value = key(), {"stamp": 0, "image": np.zeros(100_000)}

    async def change():
        for stamp in range(1, 50):
            value["stamp"] = stamp
            value["image"][:] = stamp
            await asyncio.sleep(0)

    await akvs[name].write(value)  # so that there are connections
    await asyncio.gather(akvs[name].write(value), akvs[key("other")].write(1), change())
    stored = await akvs[name].read()
    assert set(stored["image"].tolist()) == {stored["stamp"]}
    assert stored["stamp"] > 0  # the write has waited
