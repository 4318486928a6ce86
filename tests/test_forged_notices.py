"""Anybody who may publish can send anything: one bad message costs at most itself, and what follows is told right."""

import asyncio
import contextlib
import logging
import random
import time
from functools import partial

import orjson
import pytest
import redis
from conftest import EXAMPLES, FRONTS, PATIENCE, RawCluster, aeventually
from fuzz.targets import SHIPS, mutants

import reem
import reem_async
from reem_async.concurrency.queues import Every
from reem_async.errors import BadData, BadKey, BadValue
from reem_async.local.segment import host
from reem_async.monitor import Monitor
from reem_async.plan import notices
from reem_async.plan.changes import EncodedAttachment
from reem_async.plan.notices import Notice
from reem_async.plan.paths import LONGEST_TOP_KEY, fits, names_key
from reem_async.pubsub.division import GapDetector, Numbers
from reem_async.recording import Recorder, open_log
from reem_async.store.catalog import names

SEEDS = 1
MESSAGES = max(60, EXAMPLES // 10)
NAN, HUGE = b"NaN", b"9" * 400


def forged(path=(), value=b"5", *, who="evil", number=1, when=None, kind="set", parts=(), size=None, more=()):
    when = time.time() if when is None else when
    head = [1, who, number, when, list(path), kind, len(value) if size is None else size, list(parts), *more]
    return orjson.dumps(head) + b"\n" + (value if kind == "set" else b"")


UNSOUND = {
    "no number": forged(number=0),
    "a number below zero": forged(number=-5),
    "a number beyond all counters": forged(number=1 << 60),
    "a number of 400 digits": forged().replace(b'"evil",1,', b'"evil",' + HUGE + b","),
    "a number that is none": forged().replace(b'"evil",1,', b'"evil",' + NAN + b","),
    "a number in words": forged().replace(b'"evil",1,', b'"evil","1",'),
    "true for a number": forged().replace(b'"evil",1,', b'"evil",true,'),
    "no publisher": forged(who=""),
    "an endless publisher": forged(who="x" * 100_000),
    "a publisher that is not UTF-8": forged(who="evil").replace(b"evil", b"\xff\xfe"),
    "a time beyond all calendars": forged(when=1e300),
    "a time before all": forged(when=-1e300),
    "an index of a float": forged([1.0]),
    "an index that is true": forged([True]),
    "a key that is none": forged([None]),
    "a key that is a list": forged([["a"]]),
    "a key with a backslash": forged(["a\\"]),
    "a key with both quotes": forged(["a\"'"]),
    "a path without end": forged(["a"] * 5000),
    "a long path": forged(["a" * 5000]),
    "a path and a value that are too deep together": forged(["a"] * 100, b"[" * 60 + b"]" * 60),
    "a value 500 deep": forged(value=b"[" * 500 + b"]" * 500),
    "a value 1000 deep": forged(value=b"[" * 1000 + b"]" * 1000),
    "a value 100,000 deep": forged(value=b"[" * 100_000),
    "dicts 700 deep": forged(value=b'{"a":' * 700 + b"1" + b"}" * 700),
    "a value that is not UTF-8": forged(value=b'"\xff"'),
    "a value that ends too early": forged(value=b'{"a":'),
    "a value that is shorter than it says": forged(value=b"5", size=100),
    "a value that is longer than it says": forged(value=b"55", size=1),
    "no size": forged(size=-1),
    "an array that is not there": forged(value=b"5", parts=[["numpy", ".a", 100]]),
    "an array of less than nothing": forged(value=b"5", parts=[["numpy", ".a", -1]]),
    "a part of two words": forged(value=b"5", parts=[["numpy", ".a"]]),
    "parts that are none": forged().replace(b",[]]", b",5]"),
    "a megabyte": forged(value=b'"' + b"x" * (1 << 20) + b'"'),
    "another kind": forged(kind="drop"),
    "two fields too many": forged(more=[{}, {}]),
    "extras that are none": forged(more=[None]),
    "extras in a list": forged(more=[[["late", 1]]]),
    "late below zero": forged(more=[{"late": -0.1}]),
    "late without end": forged(more=[{"late": 1e300}]),
    "late that is true": forged(more=[{"late": True}]),
    "late in words": forged(more=[{"late": "1"}]),
    "a lease below zero": forged(more=[{"lease": -1}]),
    "a lease of a float": forged(more=[{"lease": 1.0}]),
    "a lease that is true": forged(more=[{"lease": True}]),
    "a lease beyond all counters": forged(more=[{"lease": 1 << 53}]),
    "a lease that is none": forged(more=[{"lease": None}]),
    "another version": forged().replace(b"[1,", b"[2,", 1),
    "nothing": b"",
    "a line end": b"\n",
    "no JSON": b"hello",
}
SOUND = {
    "another value": forged(value=b'{"n":-1}'),
    "a number far ahead": forged(number=(1 << 53) - 1),
    "a deletion": forged(kind="delete", size=0),
    "something large": forged(kind="look", size=10**12),
    "a slot of another host": forged(kind="look", parts=[["a", 1, 2, 3, 4, 5, 2], ["numpy", ".image", 100]]),
    "a slot of another program": forged(kind="look", parts=[[host(), 1, 0, 1, 0, 7, 2], ["numpy", ".image", 100]]),
    "an integer of 25 digits": forged(value=b"1" * 25),
    "a list where a dict is": forged([3, "x"]),
    "a deep path": forged(["a"] * 120, kind="look"),
    "the year 1970": forged(when=0),
    "the year 9999": forged(when=253_402_300_799),
    "an unnamed key": forged([""]),
    "extras of a later version": forged(more=[{"late": 1, "later": {"a": [None]}}]),
    "no extras": forged(more=[{}]),
}
NO_KEYS = [b"{}:notices", b"{a{b}}:notices", b"{" + b"k" * 700 + b"}:notices", b"{\xff\xfe}:notices", b"{a}b}:notices"]


# --- what is refused -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("title", list(UNSOUND))
def test_what_no_publisher_of_reem_writes_is_refused(title):
    notices._sound_path.cache_clear()  # of a path (1,) that another test has published, (1.0,) would be taken for it
    with pytest.raises(BadData):
        notices.decode(UNSOUND[title], SHIPS)


@pytest.mark.parametrize("title", list(SOUND))
def test_what_a_publisher_could_have_written_is_read(title):
    notices.decode(SOUND[title], SHIPS)


@pytest.mark.parametrize("lengths", [(2048,), (2049,), (1024, 1024), (1024, 1025), (1, 2047, 1)])
def test_a_change_is_announced_at_a_place_that_is_read(lengths):
    path = tuple("x" * length for length in lengths)
    place = notices.notify_path(path)
    assert notices.decode(notices.announce("me", 1, 2.0, place), SHIPS).path == place
    assert place == (path if sum(lengths) <= 2048 else path[:-1])


def test_bytes_that_were_cut_off_are_not_taken():
    attachment = EncodedAttachment(".b", "bytes", (), (b"12345",))
    payload = notices.with_value("me", 1, 2.0, (), b'{"b": "$ship bytes .b 5"}', [attachment])
    assert notices.decode(payload, SHIPS).value == {"b": b"12345"}
    with pytest.raises(BadData, match="truncated"):
        notices.decode(payload[:-1], SHIPS)


def test_equal_paths_of_other_types_are_not_taken_for_each_other():
    """Sound paths are remembered, and 1, 1.0 and True are equal."""
    for index in (b"7", b"7.0"):
        with contextlib.suppress(BadData):
            (found,) = notices.decode(forged([7]).replace(b"[7]", b"[" + index + b"]"), SHIPS).path
            assert type(found) is int


def test_extras_come_back_and_are_sent_only_if_there_are_any():
    """Earlier versions of REEM refuse a ninth field, so a notice that has nothing to say there has none."""
    slot, each = notices.Slot("host", 1, 2, 3, 4, 5), ("me", 1, 2.0, ("a",))
    builders = [
        partial(notices.announce, *each),
        partial(notices.announce, *each, deleted=True),
        partial(notices.with_value, *each, b"5", ()),
        partial(notices.with_value, *each, b'"' + b"x" * notices.LARGEST_INLINE + b'"', ()),
        partial(notices.in_slot, *each, slot, b"5", ()),
        partial(notices.in_slot, *each, slot, b"5", [EncodedAttachment(f".{n}", "bytes", ()) for n in range(2000)]),
    ]
    for build in builders:
        assert build() == build(extras=notices.Extras())
        assert len(orjson.loads(build().partition(b"\n")[0])) == 8
        for late, lease in ((1.5, 0), (0.0, 7), (0.25, (1 << 53) - 1)):
            found = notices.decode(build(extras=notices.Extras(late, lease)), SHIPS)
            assert found == notices.decode(build(), SHIPS)._replace(late=late, lease=lease)


@pytest.mark.parametrize("name", NO_KEYS)
def test_channels_of_keys_that_cannot_be_are_told_from_others(name):
    assert not names_key(name)
    assert names_key(b"{a}:notices")
    assert names_key(b"{a}:notices@3")
    assert names_key(b"{" + b"k" * LONGEST_TOP_KEY + b"}:notices@12")


def test_patterns_fit_what_the_server_says_they_fit(server_url, key):
    """Byte by byte: a letter with an accent is two. Which subscription a monitor listens to depends on it."""
    dice = random.Random(5)
    if server_url.startswith("redis+cluster"):
        pytest.skip("a cluster has no patterns of sharded channels")
    with redis.Redis.from_url(server_url) as raw, contextlib.closing(raw.pubsub()) as heard:
        for _ in range(60):
            glob = b"".join(dice.choices([b"a", "é".encode(), b"*", b"?", b"\\*", b"\\[", b"\\?", b"."], k=4))
            names = [b"".join(dice.choices([b"a", "é".encode(), b"*", b"[", b"?", b"."], k=4)) for _ in range(8)]
            heard.psubscribe(key().encode() + glob)
            assert heard.get_message(timeout=PATIENCE)["type"] == "psubscribe"
            for name in names:
                expected = fits(key().encode() + glob, key().encode() + name)
                assert raw.publish(key().encode() + name, b"") == int(expected), (glob, name)
                if expected:
                    assert heard.get_message(timeout=PATIENCE)["type"] == "pmessage"
            heard.punsubscribe()
            assert heard.get_message(timeout=PATIENCE)["type"] == "punsubscribe"


# --- numbers -----------------------------------------------------------------------------------------------


def test_a_number_that_is_made_up_hides_none_of_those_that_follow():
    numbers = Numbers()
    assert [numbers.take("p", number) for number in (1, 2, 10**15, 3, 4)] == [0, 0, 10**15 - 3, 0, 0]
    assert [numbers.take("p", number) for number in (1, 5, 6)] == [-1, 0, 0]
    assert [numbers.take("p", number) for number in (10**9, 10**12, 7, 8, 11)] == [
        10**9 - 7,
        10**12 - 10**9 - 1,
        -1,
        0,
        2,
    ]


def update(publisher, number, time=1.0):
    return Notice(publisher, number, time, (), False, 1)


def test_a_note_that_was_not_the_last_that_was_heard_shows_what_was_made_up():
    """Whoever publishes as REEM does notes it too."""
    heard = GapDetector()
    heard.snapshot(b"p 4")
    assert heard.count(update("p", 5)) == 0
    assert heard.compare(b"p 5") == 0
    assert heard.compare(b"p 5") == 0
    assert heard.count(update("evil", 1)) == 0
    assert heard.compare(b"p 5") is None
    assert heard.compare(b"p 5") == 0
    assert heard.count(update("p", 10**9)) == 10**9 - 6
    assert heard.compare(b"p 5") is None
    assert heard.count(update("p", 6)) == 0
    assert heard.compare(b"p 6") == 0
    assert heard.compare(b"p 9") == 3


def test_an_update_that_comes_twice_is_known_again():
    heard = GapDetector()
    assert [heard.count(update("p", number)) for number in (1, 2, 2, 1, 3, 2)] == [0, 0, None, None, 0, None]
    assert heard.compare(b"p 3") == 0
    assert heard.count(update("p", 2, time=2.0)) == -1


# --- everybody who listens ------------------------------------------------------------------------------------


class Crowd:
    """A publisher, all kinds of listeners, and a client that publishes what it likes."""

    def __init__(self, stack, url, prefix, tmp_path):
        self.stack, self.url, self.prefix, self.file = stack, url, prefix, tmp_path / "run.mcap"
        self.callbacks, self.events, self.both, self.sent = [], [], [], 0

    async def gather(self):
        enter = self.stack.enter_async_context
        namespace = f"{self.prefix}:"
        self.publisher = await enter(reem_async.RedisInterface(self.url, namespace=namespace))
        self.listener = await enter(reem_async.RedisInterface(self.url, namespace=namespace))
        self.space, self.store = (kind(self.publisher) for kind in (reem_async.PublishSpace, reem_async.KeyValueStore))
        for name in ("foo", "bar"):
            await self.space[name].write({"n": 0})
        self.mirror = await enter(reem_async.SilentSubscriber("foo", self.listener))
        self.caller = await enter(
            reem_async.CallbackSubscriber("bar", self.listener, lambda data, path: self.callbacks.append(data))
        )
        for found, patterns in ((self.events, ["*"]), (self.both, ["f*", "*o", "ba?"])):
            monitor = await enter(Monitor(self.listener, patterns, Every(1_000_000)))
            task = asyncio.create_task(self._take(monitor, found))
            self.stack.callback(task.cancel)
        self.states = []
        self.listener.on_state(lambda change: self.states.append(change.state))
        self.recorder = await enter(Recorder(self.listener, ["*"], self.file))
        node = self.url.split(",")[0].replace("redis+cluster", "redis")
        self.raw = self.stack.enter_context(contextlib.closing(redis.Redis.from_url(node)))
        sharded = self.url.startswith("redis+cluster")
        self.owner = self.stack.enter_context(contextlib.closing(RawCluster.from_url(node))) if sharded else None

    async def _take(self, monitor, found):
        async for event in monitor:
            found.append(event)

    @property
    def id(self):
        return self.publisher.session.publisher

    def forge(self, payload, name=b"foo"):
        """Publish as one who is not REEM: on a cluster to all nodes, and at the key's own."""
        channel = b"{" + self.prefix.encode() + b":" + name + b"}:notices"
        self.raw.publish(channel, payload)
        if self.owner is not None and name.isascii():  # redis-py looks for the slot of text
            self.owner.spublish(channel, payload)

    async def tell(self):
        self.sent += 1
        for name in ("foo", "bar"):
            await self.space[name].write({"n": self.sent})

    async def settled(self, since=0):
        """All that was told since is here, in its order, once, over each way."""
        values = [{"n": number} for number in range(since + 1, self.sent + 1)]

        def heard(events, name):
            return [
                event.value
                for event in events
                if event.name == name and event.publisher == self.id and event.value in values
            ]

        await aeventually(lambda: self.callbacks and self.callbacks[-1] == values[-1])
        for events in (self.events, self.both):
            for name in ("foo", "bar"):
                await aeventually(lambda events=events, name=name: heard(events, name)[-1:] == values[-1:])
                assert heard(events, name) == values
        told = [data["n"] for data in self.callbacks if data in values]  # what a read after a bad message has is one
        assert told == sorted(told)
        await aeventually(lambda: self.mirror.value() == {"n": self.sent})
        assert [state for state in self.states if state != "connected"] == []


@contextlib.asynccontextmanager
async def crowd(url, key, tmp_path):
    async with contextlib.AsyncExitStack() as stack:
        made = Crowd(stack, url, key(), tmp_path)
        await made.gather()
        yield made
    with open_log(made.file) as log:
        for name in ("foo", "bar"):
            assert log[f"{name}.n"].at(log.end) == made.sent


@pytest.fixture
def quiet(caplog):
    """What is logged is not printed; what the event loop complains of fails."""
    caplog.set_level(logging.CRITICAL, "reem.subscribe")
    yield
    assert [record for record in caplog.records if record.name == "asyncio"] == []


@pytest.mark.parametrize("which", ["one", "cluster"])
async def test_whatever_is_published_nobody_is_ended_or_silenced(which, server_url, cluster, key, tmp_path, quiet):
    """Each of the messages above on the channel of a key, then mutants of what REEM writes, true updates between."""
    dice = random.Random(3)
    mutations = mutants("notice", MESSAGES, seed=SEEDS)
    async with crowd(cluster.url if which == "cluster" else server_url, key, tmp_path) as here:
        for payload in [*UNSOUND.values(), *SOUND.values()]:
            here.forge(payload)
            await here.tell()
        await here.settled()
        since = here.sent
        for number, payload in enumerate(mutations):
            here.forge(payload.replace(b"abc123", here.id.encode()), dice.choice([b"foo", b"bar", b"new", b"\xff"]))
            if number % 10 == 0:
                await here.tell()
        for name in NO_KEYS:
            here.raw.publish(name, forged())
        await here.tell()
        await here.settled(since)


@pytest.mark.parametrize("which", ["one", "cluster"])
async def test_another_publishers_id_and_any_numbers_silence_nobody(which, server_url, cluster, key, tmp_path, quiet):
    """Before the publisher's own first updates are heard at the key's node, and later."""
    async with crowd(cluster.url if which == "cluster" else server_url, key, tmp_path) as here:
        for numbers in ([10**15], [10**15, 10**15 + 1], [1], [1, 2, 3], [10**9, 10**12, 5]) * 2:
            for number in numbers:
                here.forge(forged(["n"], b"-1", who=here.id, number=number))
            for _ in range(5):
                await here.tell()
            await here.settled(here.sent - 5)


async def test_a_value_that_nobody_wrote_does_not_stay_in_a_mirror(server_url, key, tmp_path, quiet):
    """The server's note of the last update is of another one: within seconds the key is read anew."""
    async with crowd(server_url, key, tmp_path) as here:
        await here.tell()
        await here.settled()
        here.forge(forged(["n"], b"-1"))
        await aeventually(lambda: here.mirror.value() == {"n": -1})
        await aeventually(lambda: here.mirror.value() == {"n": 1})


async def test_bad_messages_are_counted_and_said_once_for_each_key(server_url, ainterface, akvs, key, caplog):
    """Told with the reason; those of one key say nothing of another's updates."""
    name = key("foo")
    async with reem_async.SilentSubscriber(name, ainterface):
        with redis.Redis.from_url(server_url.split(",")[0].replace("redis+cluster", "redis")) as raw:
            if server_url.startswith("redis+cluster"):
                pytest.skip("what is told to all nodes is not told to those who follow a key")
            for _ in range(20):
                raw.publish("{" + name + "}:notices", b"nonsense")
        await aeventually(lambda: ainterface.unreadable == 20)
    (told,) = [record.message for record in caplog.records if record.name == "reem.subscribe"]
    assert name in told
    assert "interface.unreadable" in told


async def test_a_message_that_cannot_be_read_is_a_gap_of_its_key_alone(server_url, ainterface, key):
    if server_url.startswith("redis+cluster"):
        pytest.skip("what is told to all nodes is not told to those who follow a key")
    space, keys = reem_async.PublishSpace(ainterface), [key("foo"), key("bar")]
    async with Monitor(ainterface, [key("*")]) as monitor:
        with redis.Redis.from_url(server_url) as raw:
            raw.publish("{" + keys[0] + "}:notices", b"nonsense")
        for name in [*keys, *keys]:
            await space[name].write(1)
        events = [await anext(monitor) for _ in range(4)]
    assert [(event.name, event.gap) for event in events] == [
        (keys[0], True), (keys[1], False), (keys[0], False), (keys[1], False),
    ]  # fmt: skip


# --- what is refused when it is written -----------------------------------------------------------------------


@pytest.mark.parametrize("name", list(FRONTS))
def test_a_namespace_and_a_key_that_are_too_long_together_are_refused_when_written(server_url, name):
    """Whoever watches all namespaces would meet a key that cannot be."""
    namespace = "n" * 499 + ":"
    for space in ("KeyValueStore", "PublishSpace"):
        with contextlib.closing(FRONTS[name](server_url, space, namespace=namespace)) as front:
            with pytest.raises(BadKey, match=r"over 12 bytes \(512 with its namespace\)"):
                front.write(["k" * 13], 1)
            front.write(["k" * 12], 1)
            front.delete(["k" * 12])


@pytest.mark.parametrize("module", [reem, reem_async])
@pytest.mark.parametrize("namespace", ["robot1", "robots/r1", "é", "n" * 512 + ":", "\ud800:"])
def test_namespaces_that_would_meet_with_others_are_refused(module, namespace):
    """`robot1` would list and overwrite the keys of `robot10`; what to write is said."""
    with pytest.raises(BadValue, match="namespace") as refused:
        module.RedisInterface("127.0.0.1", namespace=namespace)
    if len(namespace) < 20 and namespace[-1] != ":":
        assert f"write {namespace + ':'!r}" in str(refused.value)


async def test_namespaces_of_which_one_begins_with_the_other_do_not_meet(server_url, key):
    """Neither in what is listed nor in what is watched."""
    async with contextlib.AsyncExitStack() as stack:
        one, ten = [
            await stack.enter_async_context(reem_async.RedisInterface(server_url, namespace=key(name)))
            for name in ("robot1:", "robot10:")
        ]
        office = await stack.enter_async_context(reem_async.RedisInterface(server_url))
        async with Monitor(office, namespaces=key("robot*")) as monitor:
            await reem_async.PublishSpace(ten)["pose"].write(1)
            event = await anext(monitor)
        assert (event.namespace, event.name) == (key("robot10:"), "pose")
        assert [name async for name in names(one)] == []
        assert [name async for name in names(ten)] == ["pose"]
