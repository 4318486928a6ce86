"""Large values through shared memory: whatever they are, wherever they go, however they are heard, whatever serves."""

import contextlib

import numpy as np
import pytest
from conftest import FRONTS, aeventually, assert_same, eventually
from slotkit import in_slot

import reem
import reem_async
from reem.server import EmbeddedServer
from reem_async.local.segment import reason_against
from reem_async.ships.registry import default_ships

pytestmark = pytest.mark.skipif(bool(reason_against()), reason=f"no shared memory: {reason_against()}")

BIG = np.arange(30_000, dtype=np.float64)
RECORDS = np.zeros(5000, [("time", ">i8"), ("pose", "<f4", (3,)), ("name", "U3")])
RECORDS["time"] = np.arange(5000)


@contextlib.contextmanager
def heard(url, name, **options):
    updates = []
    with reem.RedisInterface(url, **options) as interface:
        subscriber = reem.CallbackSubscriber(name, interface, lambda data, updated_path: updates.append(data))
        subscriber.listen()
        yield updates


ARRAYS = {
    "image": np.arange(200_000, dtype=np.uint8).reshape(200, 500, 2),
    "columns first": np.asfortranarray(BIG.reshape(100, 300)),
    "every other": BIG[::2],
    "big-endian": BIG.astype(">f8"),
    "dates": BIG.astype("datetime64[us]"),
    "text": BIG.astype("U8"),
    "records": RECORDS,
    "not a number": np.full(30_000, np.nan),
}
SMALL = [np.array(1.5), np.array(RECORDS[7]), np.zeros((0, 3), ">i4"), np.zeros(0, "U5")]
"""Without items or without dimensions: their bytes are in the document."""


def test_values_of_every_kind_come_bit_for_bit_and_read_only(server_url, open_front, key):
    value = ARRAYS | {"small": [*SMALL, {"n": 1}], "file": b"\0\xff" * 50_000, "no bytes": b""}
    with heard(server_url, key("cam")) as updates:
        open_front("PublishSpace").write([key("cam")], value)
        eventually(lambda: updates)
    assert_same(updates[0], value)
    assert all(in_slot(updates[0][what]) for what in ARRAYS)
    assert not any(updates[0][what].flags.writeable for what in ARRAYS)


class Cloud:
    def __init__(self, points):
        self.points = points

    def __eq__(self, other):
        return isinstance(other, Cloud) and self.points == other.points

    __hash__ = None


class CloudShip(reem.BlobShip):
    """Carries clouds, in pieces some of which are empty."""

    carries = Cloud

    def get_label(self):
        return "cloud"

    def check_fit(self, value):
        return isinstance(value, Cloud)

    def pack(self, value):
        return (b"", b"cloud", b"", *(b"%08d" % each for each in value.points), b"")

    def unpack(self, blob):
        assert bytes(blob[:5]) == b"cloud"
        return Cloud([int(bytes(blob[at : at + 8])) for at in range(5, len(blob), 8)])


class PickyShip(CloudShip):
    """One whose author has only ever seen bytes."""

    def unpack(self, blob):
        assert blob.startswith(b"cloud")
        return Cloud([int(blob[at : at + 8]) for at in range(5, len(blob), 8)])


class SlowShip(CloudShip):
    async def unpack(self, blob):
        return CloudShip.unpack(self, blob)


@pytest.mark.parametrize("ship", [CloudShip, PickyShip, SlowShip])
def test_what_a_ship_of_the_users_own_carries_arrives(ship, server_url, open_front, key):
    value = {"cloud": Cloud([*range(20_000)]), "image": BIG, "empty": b""}
    with heard(server_url, key("cam"), ships=[ship(), *default_ships()]) as updates:
        open_front("PublishSpace", ships=[CloudShip(), *default_ships()]).write([key("cam")], value)
        eventually(lambda: updates)
    assert updates[0]["cloud"] == value["cloud"]
    assert_same(updates[0]["image"], BIG)
    assert updates[0]["empty"] == b""


def image(number):
    return BIG + number


PLACES = {
    "inside of a key": (["cam", "image"], image(1), lambda data: data["image"]),
    "deep inside": (["cam", "a", "b", "image"], image(2), lambda data: data["a"]["b"]["image"]),
    "an item of a list": (["cam", "list", 1], image(3), lambda data: data["list"][1]),
    "inside of an item": (["cam", "list", 0, "image"], image(4), lambda data: data["list"][0]["image"]),
    "the last item": (["cam", "list", -1], image(5), lambda data: data["list"][-1]),
}


@pytest.mark.parametrize("what", PLACES)
def test_a_large_value_may_go_anywhere(what, server_url, open_front, key):
    space, (path, value, found) = open_front("PublishSpace"), PLACES[what]
    whole = {"image": BIG, "a": {"b": {"image": BIG}}, "list": [{"image": BIG, "n": 1}, BIG], "n": 1}
    with heard(server_url, key("cam")) as updates:
        space.write([key("cam")], whole)
        eventually(lambda: len(updates) == 1)
        assert_same(updates[0], whole)
        space.write([key("cam"), *path[1:]], value)
        eventually(lambda: len(updates) == 2)
    assert_same(found(updates[1]), value)
    assert updates[1]["n"] == 1


def test_who_follows_a_part_gets_the_part(server_url, open_front, key):
    space = open_front("PublishSpace")
    with reem.RedisInterface(server_url) as interface:
        part = reem.SilentSubscriber(f"{key('cam')}.left", interface)
        part.listen()
        for number in range(3):
            space.write([key("cam")], {"left": image(number), "right": BIG})
            eventually(lambda number=number: part.value() is not None and part.value()[0] == number)
            assert_same(part.value(), image(number))
            assert in_slot(part.value())


@pytest.mark.parametrize("mode", ["auto", "early"])
async def test_every_way_of_hearing(mode, server_url, key):
    async with (
        reem_async.RedisInterface(server_url, local=mode) as one,
        reem_async.RedisInterface(server_url) as other,
    ):
        space, kvs, name = reem_async.PublishSpace(one), reem_async.KeyValueStore(other), key("cam")
        called = []
        await space[name].write({"n": -1})
        async with (
            reem_async.SilentSubscriber(name, other) as subscriber,
            kvs[name].mirror() as mirror,
            reem_async.CallbackSubscriber(name, other, lambda data, updated_path: called.append(data)) as callback,
        ):
            loops = [subscriber.watch(), kvs[name].watch(), kvs.watch(f"{name}*")]
            for loop in loops:
                assert (await anext(loop)).data["n"] == -1
            for number in range(5):
                value = {"image": image(number), "n": number}
                await space[name].write(value)
                for loop in loops:
                    while (update := await anext(loop)).data["n"] != number:
                        pass
                    assert_same(update.data, value)
                await aeventually(lambda number=number: mirror.value()["n"] == number)
                await aeventually(lambda number=number: called and called[-1]["n"] == number)
                assert_same(mirror.value(), value)
                assert_same(called[-1], value)
                assert_same(subscriber.value(), value)
            del callback


@pytest.fixture(scope="module")
def plain():
    with EmbeddedServer(json=False) as server:
        yield server


SERVERS = {
    "plain": lambda request: (request.getfixturevalue("plain").url, {}),
    "cluster": lambda request: (request.getfixturevalue("cluster").url, {}),
    "sentinel": lambda request: (request.getfixturevalue("watched").url, {}),
    "database 3": lambda request: (request.getfixturevalue("plain").url + "/3", {}),
    "namespace": lambda request: (request.getfixturevalue("plain").url, {"namespace": "robot1:"}),
}


@pytest.mark.parametrize("mode", ["auto", "early"])
@pytest.mark.parametrize("front", FRONTS)
@pytest.mark.parametrize("server", SERVERS)
def test_whatever_serves(server, front, mode, request):
    url, options = SERVERS[server](request)
    with contextlib.closing(FRONTS[front](url, "PublishSpace", local=mode, **options)) as space:
        for name in ("one", "two", "three"):
            space.write([name], {"n": -1})
            with heard(url, name, **options) as updates:
                for number in range(3):
                    value = {"image": image(number), "n": number}
                    space.write([name], value)
                    eventually(lambda value=value: updates and updates[-1]["n"] == value["n"])
                    assert_same(updates[-1], value)
                    assert in_slot(updates[-1]["image"])
