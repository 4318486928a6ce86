"""What the page reads into its past goes between the updates where it belongs."""

import contextlib
import time
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import aeventually, subscribed

from reem_async.errors import ConnectionLost
from reem_async.pubsub import finder
from reem_async.pubsub.monitor import Monitor
from reem_async.tools.browser import follower as follower_module
from reem_async.tools.browser.follower import Follower
from reem_async.tools.browser.history import History

LARGE = np.zeros((300, 300))


def followed(interface, name, fence):
    """A key of the page that hears only what the test hands on."""
    history = History(1000.0, 1 << 24)
    history.begin(name, b"{}")
    follower = Follower(interface, history)
    follower.fence = fence
    return follower.key(name), history


async def test_each_update_is_in_what_is_shown_once_though_it_is_heard_of_late(key, apspace, binterface):
    """The second deletion is in what is read, the third is not: that of an item done twice would be seen."""
    monitor = Monitor(binterface, [key()])
    await monitor.listen()
    await apspace[key()].write({"l": [0, 1, 2, 3], "image": LARGE})
    await apspace[key()]["l"][0].delete()

    async def fence(channel):
        await apspace[key()]["l"][0].delete()
        for _ in range(3):
            page.hear(await anext(monitor))

    page, history = followed(binterface, key(), fence)
    await page.read()
    assert history.tree((key(),), time.time())["l"] == [2, 3]
    await monitor.close()


async def test_what_cannot_be_told_from_the_rest_is_not_shown(key, apspace, binterface):
    await apspace[key()].write({"n": 1, "image": LARGE})

    async def fence(channel):
        raise ConnectionLost("gone")

    page, history = followed(binterface, key(), fence)
    page.announced.add((key(),))
    with pytest.raises(ConnectionLost):
        await page.read()
    assert page.announced == {(key(),)}
    assert history.tree((key(),), time.time()) == {}


@contextlib.asynccontextmanager
async def followed_all(interface, name, akvs):
    """A follower of all keys that has read one, and its history."""
    await akvs[name].write({"n": 1})
    follower = Follower(interface, history := History(1000.0, 1 << 24))
    await follower.start()
    try:
        await aeventually(lambda: follower.is_settled(name))
        yield follower, history
    finally:
        await follower.close()


async def test_after_a_connection_that_nobody_missed_all_is_read_again(key, akvs, binterface, raw, monkeypatch):
    """It broke before it was followed, but keys were touched over it: the server reports nothing of them any more.

    The next search for keys is far, as after one that had no answer.
    """
    monkeypatch.setattr(finder, "_PERIOD", 600.0)
    async with followed_all(binterface, key(), akvs) as (follower, history):
        follower._monitor.broken = lambda: None
        for connection in subscribed(raw):
            raw.client_kill_filter(_id=connection)
        await akvs[key()].write({"n": 2})
        await aeventually(lambda: history.tree((key(),), time.time()) == {"n": 2})


async def test_calls_that_waited_long_for_a_dead_link_delay_no_later_ones(key, akvs, binterface, monkeypatch):
    """Neither reads nor searches rest for a multiple of it: they spare a server at work."""
    waited = 0.0

    def lost(*args, **options):
        nonlocal waited
        waited += 1000.0
        raise ConnectionLost("gone")

    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + waited, time=time.time)
    monkeypatch.setattr(follower_module, "time", clock)
    monkeypatch.setattr(finder, "time", clock)
    async with followed_all(binterface, key(), akvs) as (follower, history):
        with monkeypatch.context() as patched:
            patched.setattr(binterface.session.transport, "roundtrip", lost)
            patched.setattr(follower_module, "present_keys", lost)
            await akvs[key()].write({"n": 2})
            await aeventually(lambda: follower.lost and waited >= 2000.0)
        await aeventually(lambda: history.tree((key(),), time.time()) == {"n": 2} and not follower.lost)
