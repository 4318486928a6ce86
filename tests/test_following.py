"""What subscribers of both fronts do: mirrors, callbacks and loops, each promise written once."""

import asyncio
import logging

import numpy as np
import pytest
from conftest import FRONTS, assert_same, eventually, nothing_sent, subscribed

import reem
import reem_async
from reem_async import Every, Last, Newest
from reem_async.errors import QueueFull, ReadOnly


class Following:
    def __init__(self, front):
        self.front = front
        self.module = reem_async if isinstance(front, FRONTS["asyncio"]) else reem
        self.until, self.take = front.until, front.take

    def mirror(self, channel):
        return self._begun(self.module.SilentSubscriber(channel=channel, interface=self.front.interface))

    def calls(self, channel, function, kwargs=None):
        return self._begun(self.module.CallbackSubscriber(channel, self.front.interface, function, kwargs))

    def _begun(self, subscriber):
        self.front.wait(subscriber.listen())
        return subscriber

    def watch(self, channel, **options):
        return self.front.at((channel,)).watch(**options)


@pytest.fixture
def following(front):
    return Following(front)


def test_reading_a_mirror_is_local_and_gives_copies(following, kvs, key, raw):
    kvs[key()] = {"number": 5, "l": [1]}
    mirror = following.mirror(key())
    with nothing_sent(raw):
        for _ in range(100):
            assert mirror["number"].read() == 5
            mirror.value()["l"].append(2)
            mirror["l"].read().append(3)
    assert mirror.value() == {"number": 5, "l": [1]}
    with pytest.raises(KeyError, match="absent"):
        mirror["absent"].read()


def test_a_mirror_cannot_be_written(following, kvs, key):
    kvs[key()] = {"a": 1}
    mirror = following.mirror(key())
    with pytest.raises(ReadOnly):
        mirror["a"].write(2)
    with pytest.raises(TypeError):
        mirror["a"] = 2
    with pytest.raises(NotImplementedError):
        del mirror["a"]
    assert kvs[key()].read() == {"a": 1}


def test_no_publish_after_listen_is_missed(following, pspace, key):
    for n in range(30):
        mirror = following.mirror(key(f"channel{n}"))
        pspace[key(f"channel{n}")] = {"n": n}
        following.until(lambda mirror=mirror, n=n: mirror.value() == {"n": n})


@pytest.mark.parametrize("local", ["auto", "off"])
def test_large_updates_arrive_whole(following, server_url, key, local):
    """A full camera image, looked at in the publisher's memory or fetched rather than carried in the notice."""
    mirror = following.mirror(key())
    with reem.RedisInterface(server_url, local=local) as publishing:
        pspace = reem.PublishSpace(publishing)
        for n in range(3):
            image = np.full((640, 480, 3), float(n))
            pspace[key()] = {"image": image, "n": n}
            following.until(lambda n=n: (mirror.value() or {}).get("n") == n)
            assert_same(mirror["image"].read(), image)
        pspace[key()]["n"] = 99
        following.until(lambda: mirror["n"].read() == 99)
        assert_same(mirror["image"].read(), image)


def test_foo_does_not_hear_of_foobar(following, pspace, key):
    heard = []
    following.calls(key("foo"), lambda data, updated_path: heard.append(updated_path))
    for name in ("foobar", "fo", "foo bar", "foo:ships", "bar"):
        pspace[key(name)] = {"foo": 1}
        pspace[key(name)]["foo"] = 2
    pspace[key("foo")] = {"bar": {"x": 1}}
    following.until(lambda: heard)
    pspace[key("foo")]["bar"]["x"] = 2
    following.until(lambda: len(heard) == 2)
    assert heard == [key("foo"), key("foo") + ".bar.x"]


def test_foo_dot_bar_hears_of_itself_below_and_of_a_fresh_foo(following, pspace, key):
    calls, expected = [], []
    pspace[key("foo")] = {"bar": {"x": 0}, "other": 0, "barbar": 0}
    following.calls(f"{key('foo')}.bar", lambda data, path: calls.append((data, path.removeprefix(key("foo")))))
    mirror = following.mirror(f"{key('foo')}.bar")
    assert mirror.value() == {"x": 0}
    for path, value, data in [
        (".other", 1, None),
        (".barbar", 1, None),
        (".bar.x", 1, {"x": 1}),
        (".bar", {"y": 2}, {"y": 2}),
        ("", {"bar": {"z": 3}, "other": 2}, {"z": 3}),
    ]:
        pspace.set(key("foo") + path, value)
        if data is not None:
            expected.append((data, path))
            following.until(lambda: len(calls) >= len(expected))
    assert calls == expected
    following.until(lambda: mirror.value() == {"z": 3})


@pytest.fixture(params=["plain", "coroutine"])
def as_callback(request, following):
    """Makes a callback of a function: itself, or, in the asyncio front, a coroutine function."""
    if request.param == "coroutine" and following.module is reem:
        pytest.skip("a thread cannot call a coroutine function")

    def made(function):
        async def coroutine(data, updated_path, *, update, **kwargs):
            assert update.path == updated_path
            await asyncio.sleep(0)
            function(data, updated_path, **kwargs)

        return function if request.param == "plain" else coroutine

    return made


def test_a_callback_gets_data_path_and_its_keyword_arguments(following, as_callback, pspace, key):
    calls = []
    function = as_callback(lambda data, updated_path, foo, scale=1: calls.append((data, updated_path, foo, scale)))
    following.calls(key("c"), function, {"foo": 5})
    pspace[key("c")] = {"number": 5, "string": "REEM"}
    following.until(lambda: len(calls) == 1)
    pspace[key("c")]["number"] = 6
    following.until(lambda: len(calls) == 2)
    assert calls == [
        ({"number": 5, "string": "REEM"}, key("c"), 5, 1),
        ({"number": 6, "string": "REEM"}, f"{key('c')}.number", 5, 1),
    ]
    assert all(type(path) is str for _, path, _, _ in calls)


def test_an_exception_in_a_callback_is_logged_and_ends_nothing(following, as_callback, pspace, key, caplog):
    seen = []

    def fail(data, updated_path):
        seen.append(data)
        if data == 1:
            raise ZeroDivisionError("on purpose")

    with caplog.at_level(logging.ERROR):
        following.calls(key(), as_callback(fail))
        pspace[key()] = 1
        following.until(lambda: seen == [1])
        pspace[key()] = 2
        following.until(lambda: seen == [1, 2])
    assert any(record.exc_info and record.exc_info[0] is ZeroDivisionError for record in caplog.records)


def test_a_loop_begins_with_what_is_there_and_then_tells_every_update(following, kvs, pspace, key):
    """Each with its path, what was written, the whole below the channel, and who published it when."""
    kvs[key()] = {"n": 0, "image": np.arange(3)}
    updates = following.watch(key())
    (first,) = following.take(updates)
    assert (first.initial, first.path) == (True, key())
    assert_same(first.data, {"n": 0, "image": np.arange(3)})
    assert_same(first.value, first.data)
    pspace[key()]["n"] = 7
    (second,) = following.take(updates)
    assert (second.initial, second.path, second.value) == (False, f"{key()}.n", 7)
    assert_same(second.data, {"n": 7, "image": np.arange(3)})
    pspace[key()] = {"n": 8}
    (third,) = following.take(updates)
    assert (third.path, third.value, third.data) == (key(), {"n": 8}, {"n": 8})
    assert second.publisher == third.publisher is not None
    assert second.sequence < third.sequence
    assert second.time is not None
    assert second.time <= third.time
    assert not second.gap
    assert not third.gap
    assert updates.dropped == 0


def test_subscribers_are_iterators(following, pspace, key):
    begin = iter if following.module is reem else aiter
    for subscriber in (following.mirror(key()), following.calls(key(), lambda data, updated_path: None)):
        pspace[key()] = 0
        updates = begin(subscriber)
        assert following.take(updates)[0].initial
        pspace[key()] = 1
        assert following.take(updates)[0].data == 1
        pspace[key()] = 2
        following.until(lambda subscriber=subscriber: subscriber.value() == 2)


def overfilled(following, kvs, pspace, key, **options):
    kvs[key()] = -1
    updates = following.watch(key(), **options)
    assert following.take(updates)[0].initial
    for n in range(20):
        pspace[key()] = n
    return updates


@pytest.mark.parametrize(("policy", "kept"), [(None, 1), (Newest(), 1), (Last(5), 5), (Every(100), 20)], ids=repr)
def test_a_queue_is_bounded_by_a_named_policy_and_counts_what_it_dropped(following, kvs, pspace, key, policy, kept):
    updates = overfilled(following, kvs, pspace, key, **({} if policy is None else {"policy": policy}))
    following.until(lambda: updates.dropped == 20 - kept)
    assert [update.data for update in following.take(updates, kept)] == list(range(20 - kept, 20))
    assert updates.dropped == 20 - kept


def test_every_one_beyond_its_bound_is_an_error(following, kvs, pspace, key):
    updates = overfilled(following, kvs, pspace, key, policy=Every(5))
    following.until(lambda: updates.dropped)
    got = []
    with pytest.raises(QueueFull):  # noqa: PT012
        for _ in range(20):
            got += [update.data for update in following.take(updates)]
    assert got == list(range(5))


def test_all_subscribers_of_an_interface_share_one_connection(following, kvs, pspace, key, raw):
    before = subscribed(raw)
    mirrors = [following.mirror(key(f"c{n % 5}")) for n in range(20)]
    following.calls(key("c1"), lambda data, updated_path: None)
    kvs[key("w")] = 1
    following.take(following.watch(key("w")))
    assert len(subscribed(raw) - before) == 1
    pspace[key("c3")] = 5
    following.until(lambda: [mirror.value() for mirror in mirrors[3::5]] == [5] * 4)
    following.front.wait(following.front.interface.close())
    eventually(lambda: not subscribed(raw) - before)
