"""What the page reads into its past goes between the updates where it belongs."""

from __future__ import annotations

import asyncio
import time

import numpy as np
from conftest import aeventually

from reem_async.errors import ConnectionLost
from reem_async.pubsub.monitor import Monitor
from reem_async.tools.browser.fetcher import Allowance, Fetcher, Readings
from reem_async.tools.browser.history import History

LARGE = np.zeros((300, 300))


async def touch(path, tree):
    """Nobody tells of what is only stored."""


def fetcher_of(interface, name, fence, last_note=""):
    history = History(1000.0, 1 << 24)
    history.begin(name, b"{}")
    readings = Readings()
    readings.notes[name] = last_note
    fetcher = Fetcher(interface.session, history, Allowance(1e9, 1e9), readings, fence, touch)
    return fetcher, history, readings


async def fetched(fetcher, name):
    fetcher.want((name,), time.time())
    task = asyncio.create_task(fetcher.run())
    await aeventually(lambda: not fetcher.behind)
    task.cancel()


async def test_each_update_is_in_what_is_shown_once_though_it_is_heard_of_late(key, apspace, binterface):
    """The second deletion is in what is read, the third is not: that of an item done twice would be seen."""
    monitor = Monitor(binterface, [key()])
    await monitor.listen()
    await apspace[key()].write({"l": [0, 1, 2, 3], "image": LARGE})
    await apspace[key()]["l"][0].delete()

    async def fence():
        await apspace[key()]["l"][0].delete()
        for _ in range(3):
            readings.hear(await anext(monitor))

    fetcher, history, readings = fetcher_of(binterface, key(), fence)
    await fetched(fetcher, key())
    assert history.tree((key(),), time.time())["l"] == [2, 3]
    await monitor.close()


async def test_what_cannot_be_told_from_the_rest_is_not_shown(key, apspace, binterface):
    """The connection of the notices breaks: it stays unknown until it is looked at again."""
    await apspace[key()].write({"n": 1, "image": LARGE})
    asked = asyncio.Event()

    async def fence():
        asked.set()
        raise ConnectionLost("gone")

    fetcher, history, _ = fetcher_of(binterface, key(), fence)
    fetcher.want((key(),), time.time())
    task = asyncio.create_task(fetcher.run())
    await asyncio.wait_for(asked.wait(), 10)
    await asyncio.sleep(0)
    task.cancel()
    assert fetcher.behind == {key()}
    assert history.kept((key(), "n"), time.time()).late > 0
