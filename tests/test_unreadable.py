"""One value that cannot be read costs nothing beside it: kinds of damage, kinds of followers, both kinds of servers."""

import contextlib
import copy
import logging
import operator
import pickle
import time

import numpy as np
import pytest
from conftest import LONG, aeventually, same_bits

import reem_async
from reem_async import Unreadable
from reem_async.errors import BadData, BadType
from reem_async.plain.documents import MARK
from reem_async.plan.trees import MISSING
from reem_async.server import EmbeddedServer
from reem_async.ships import BlobShip
from reem_async.tools.browser import LiveSource
from reem_async.tools.browser.trees import thawed
from reem_async.tools.cli.browse import _source
from reem_async.tools.cli.options import named_ships
from reem_async.tools.recording import Recorder, Replayer, open_log

IMAGES = {"small": np.arange(100), "large": np.arange(100_000)}


class Pose(BlobShip):
    def check_fit(self, value):
        return isinstance(value, complex)

    def pack(self, value):
        return [str(value).encode()]

    def unpack(self, data):
        return complex(bytes(data).decode())

    def get_label(self):
        return "pose"


async def _evict(client, kvs):
    await client.delete("{b}.image")


async def _garble(client, kvs):
    await client.set("{b}.image", b"garbage")


async def _cut(client, kvs):
    (content,) = await kvs.interface.session.transport.roundtrip([("GET", "{b}.image")])
    await client.set("{b}.image", bytes(content[:-1]))


async def _replace(client, kvs):
    await client.delete("{b}.image")
    await client.rpush("{b}.image", "x")


async def _forge(client, kvs):
    text = b'{"s":1,"image":"$ship numpy"}'
    kind = await client.type("b")
    await (client.set("b", MARK + text) if kind == "string" else client.execute_command("JSON.SET", "b", "$", text))


async def _unknown(client, kvs):
    await kvs["b"]["image"].write(1 + 2j)


async def _forbid(client, kvs):
    """Already done as the followers' user was made."""


DAMAGES = {
    "evicted": (_evict, "gone from the server"),
    "garbage": (_garble, "REEM did not write it"),
    "cut": (_cut, ""),
    "another type": (_replace, "not what the ship wrote"),
    "no placeholder": (_forge, "looks like a placeholder of REEM but is none"),
    "no ship": (_unknown, "was written by the ship 'pose', which this interface lacks"),
    "no right": (_forbid, "the user may not do this"),
}
DAMAGED_NOW = {"no right"}


PAIRS = [(damage, size) for damage in DAMAGES for size in IMAGES]


class Followers:
    """One of each kind, of the key b, and what each of them has."""

    def __init__(self, interface, url, file):
        kvs = reem_async.KeyValueStore(interface)
        self.watch, self.pattern = kvs["b"].watch(reem_async.Every(1000)), kvs.watch("b", policy=reem_async.Every(1000))
        self.subscriber, self.mirror = reem_async.SilentSubscriber("b", interface, stored=True), kvs["b"].mirror()
        self.recorder = Recorder(interface, ["*"], file, keyframe=0.2)
        self.page = LiveSource(reem_async.RedisInterface(url), 60.0, 64 << 20)
        self.updates = {"watch": [], "pattern": []}

    async def start(self):
        for each in (self.watch, self.pattern, self.subscriber, self.mirror):
            await each.listen()
        await self.recorder.start()
        await self.page.start()
        await aeventually(lambda: not self.page._follower.unread)  # of those it reads no arrays

    def seen(self):
        for name, updates in self.updates.items():
            queue = getattr(self, name).queue
            updates += iter(queue.take, reem_async.concurrency.queues.EMPTY)
        trees = self.recorder.writer_thread._trees
        return {
            "watch": self.updates["watch"][-1].data,
            "pattern": self.updates["pattern"][-1].data,
            "subscriber": self.subscriber.value(),
            "mirror": self.mirror.value(),
            "page": thawed(self.page.history.tree(("b",), time.time())),
            "recorder": trees.get("b", MISSING),
        }

    async def close(self):
        for each in (self.watch, self.pattern, self.subscriber, self.mirror, self.page):
            await each.close()
        await self.recorder.stop()


def beside(tree):
    return {key: value for key, value in tree.items() if key != "image"} if isinstance(tree, dict) else tree


@pytest.fixture(params=["json", "plain"], scope="module")
def server(request, server_url):  # the shared one must have started: it would be of this kind, too
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "plain":
            patch.setenv("REEM_SERVER_PLAIN", "1")
        with EmbeddedServer() as server:
            yield server


@pytest.mark.parametrize(("damage", "size"), [pair for pair in PAIRS if LONG or PAIRS.index(pair) % 4 in (0, 3)])
async def test_what_is_beside_a_damaged_value_goes_on(server, tmp_path, caplog, damage, size):
    """It is delivered and recorded; the damaged place is an Unreadable, never the old value, until it is mended."""
    caplog.set_level(logging.WARNING)
    spoil, why = DAMAGES[damage]
    async with reem_async.RedisInterface(server, ships=named_ships([f"{__name__}:Pose"])) as other:
        kvs, space = reem_async.KeyValueStore(other), reem_async.PublishSpace(other)
        rights = ["~b", "~{b}:*", "~*&&&&metadata"] if damage in DAMAGED_NOW else ["~*"]
        await other.client.execute_command("ACL", "SETUSER", "u", "reset", "on", ">pw", *rights, "&*", "+@all")
        await kvs["b"].write({"s": 1, "image": IMAGES[size]})
        url = f"redis://u:pw@127.0.0.1:{server.port}"
        async with reem_async.RedisInterface(url) as interface:
            followers = Followers(interface, url, tmp_path / "run.mcap")
            await followers.start()
            try:
                await spoil(other.client, kvs)
                await kvs["b"]["s"].write(2)
                for number in range(3, 8):
                    await space["b"]["s"].write(number)
                await kvs["b"]["new"].write("field")

                def differing():
                    return {
                        name: tree
                        for name, tree in followers.seen().items()
                        if beside(tree) != {"s": 7, "new": "field"} or is_old(tree["image"])
                    }

                def is_old(value):
                    return type(value) is not Unreadable and getattr(value, "label", "") not in ("lost", "pose")

                with contextlib.suppress(AssertionError):
                    await aeventually(lambda: not differing(), 10)
                assert differing() == {}
                for name, tree in followers.seen().items():
                    # The page does not fetch what is of a ship that it lacks, and says what is there.
                    if name != "page" or damage != "no ship":
                        assert why in (tree["image"].summary if name == "recorder" else tree["image"].reason), name
                for name, updates in followers.updates.items():
                    numbers = [each.value for each in updates if each.path == "b.s" and each.origin == "published"]
                    assert numbers == [3, 4, 5, 6, 7], name
                assert caplog.text.count("b.image cannot be read") <= 2  # the page has an interface of its own
                assert interface.unreadable == 1
                assert followers.recorder.status.lost >= 1
                damaged_until = time.time()
                if damage not in DAMAGED_NOW:
                    await kvs["b"]["image"].write(IMAGES[size])
                    await aeventually(
                        lambda: all(
                            getattr(tree["image"], "label", "numpy") == "numpy" for tree in followers.seen().values()
                        )
                    )
                    assert same_bits(followers.mirror["image"].read(), IMAGES[size])
            finally:
                await followers.close()
        with open_log(tmp_path / "run.mcap") as log:
            found = log["b"].at(damaged_until)
            assert beside(found) == {"s": 7, "new": "field"}
            assert isinstance(found["image"], Unreadable)
            assert why in found["image"].reason
            assert log.metadata["lost"] != "0"
            assert any(name.startswith("not recorded: b") for name in log.metadata)
        with open_log(tmp_path / "run.mcap") as log:
            replayer = Replayer(other, log, rate=1000, end=damaged_until, remap={"b": "again"})
            await replayer.play()
            assert replayer.status.unreadable
            assert beside(await kvs["again"].read()) == {"s": 7, "new": "field"}
        await kvs["again"].delete()
        await kvs["b"].delete()


async def test_a_document_that_is_no_document_any_more_is_not_what_it_was(server, tmp_path):
    """Another program has put a list under its name: all of it is unreadable, and recorded as it is."""
    async with reem_async.RedisInterface(server) as other:
        kvs = reem_async.KeyValueStore(other)
        await kvs["b"].write({"s": 1})
        async with reem_async.RedisInterface(server) as interface:
            followers = Followers(interface, server.url, tmp_path / "run.mcap")
            await followers.start()
            try:
                await other.client.delete("b")
                await other.client.rpush("b", "x")

                def differing():
                    return {
                        name: tree
                        for name, tree in followers.seen().items()
                        if (tree != ["x"] if name == "recorder" else type(tree) is not Unreadable)
                        and getattr(tree, "label", "") != "lost"
                        and name != "page"
                    }

                await aeventually(lambda: followers.seen()["page"] != {"s": 1})
                with contextlib.suppress(AssertionError):
                    await aeventually(lambda: not differing(), 10)
                assert differing() == {}
                with pytest.raises(BadData, match="not a document"):
                    followers.mirror["s"].read() + 1
                damaged_until = time.time()
                await other.client.delete("b")
                await kvs["b"].write({"s": 2})
                await aeventually(lambda: all(tree == {"s": 2} for tree in followers.seen().values()))
            finally:
                await followers.close()
        with open_log(tmp_path / "run.mcap") as log:
            assert log["b"].at(damaged_until) == ["x"]
            assert log["b"].at(log.end) == {"s": 2}
        await kvs["b"].delete()


async def test_the_page_and_its_recordings_are_read_with_ships_of_the_users_own(server, tmp_path):
    """As `reem browse --ship` gives them."""
    ships = named_ships([f"{__name__}:Pose"])
    async with reem_async.RedisInterface(server, ships=ships) as interface:
        await reem_async.KeyValueStore(interface)["b"].write({"pose": 1 + 2j})
        async with Recorder(interface, ["*"], tmp_path / "run.mcap"):
            pass
    for log in (None, tmp_path / "run.mcap"):
        source = _source(server.url, "", log, 60, 8, ships)
        await source.start()
        at = None if log is None else source.status().end
        assert (await source.value(("b", "pose"), at)).value == 1 + 2j
        await source.close()


USES = {
    "attribute": lambda it: it.shape,
    "item": lambda it: it[0],
    "truth": bool,
    "length": len,
    "iteration": list,
    "array": np.asarray,
    "sum": lambda it: it + 1,
    "product with an array": lambda it: np.arange(3) * it,
    "float": float,
    "order": lambda it: it < 1,
    "call": lambda it: it(),
}


@pytest.mark.parametrize("use", USES)
def test_an_unreadable_value_raises_when_it_is_used(use):
    with pytest.raises(BadData, match=r"b\.image: gone"):
        USES[use](Unreadable("b.image", "b.image: gone"))


async def test_an_unreadable_value_is_refused_where_a_copy_of_what_was_followed_is_stored(ainterface, key):
    with pytest.raises(BadType, match="could not be read; leave it out"):
        await reem_async.KeyValueStore(ainterface)[key()].write({"image": Unreadable("b.image", "gone")})


@pytest.mark.parametrize("same", [copy.copy, copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))])
def test_an_unreadable_value_can_be_kept(same):
    it = Unreadable("b.image", "gone")
    assert operator.eq(same(it), it)
    assert it != Unreadable("b.image", "forbidden")
    assert it != np.arange(3).tolist()
    assert repr(same(it)) == "<unreadable b.image: gone>"
