"""Defects that a review found, one test for each: the store, connections, and ships."""

import asyncio
import enum
import operator
import secrets
import socket
import threading
import time
import zlib

import numpy as np
import pytest
from conftest import assert_no_orphans, assert_same, nothing_sent, url_of_user
from test_ships import Pose, PoseShip

import reem
import reem_async
from reem_async.errors import BadData, BadKey, BadType, ConnectionLost, NotConnected, WrongLoop

A = np.arange(3.0)


# --- rights, numbers, keys ------------------------------------------------------------------------


def test_a_client_that_may_not_read_the_document_removes_no_array_of_it(server_url, kvs, key, raw):
    """Without JSON.GET it cannot know which arrays are still referred to."""
    name = f"u{secrets.token_hex(4)}"
    commands = (
        "json.set json.type set sadd srem smembers unlink multi exec watch unwatch hello auth select ping cluster|slots"
    )
    rules = ["on", ">pw", "~*", "&*", "-@all", "+client|setinfo", *(f"+{word}" for word in commands.split())]
    raw.execute_command("ACL", "SETUSER", name, *rules)
    try:
        kvs[key()] = {"t": [A, A + 1]}
        with reem.RedisInterface(url_of_user(server_url, name, "pw")) as limited:
            reem.KeyValueStore(limited)[key()]["t"][0] = 5
        assert_same(kvs[key()].read(), {"t": [5, A + 1]})
        kvs[key()]["t"][0] = 6  # whoever may read cleans up
        assert_no_orphans(raw, key())
    finally:
        raw.execute_command("ACL", "DELUSER", name)


@pytest.mark.parametrize("number", [np.uint8(1), np.uint64(1), np.int16(1), np.float32(1)])
async def test_an_unsigned_number_can_be_subtracted(kvs, akvs, key, number):
    """numpy has no negative of it."""
    kvs[key()] = {"n": 10}
    kvs[key()]["n"] -= number
    assert await akvs[key()]["n"].read() == 9
    assert await akvs[key()]["n"].decrement(number) == 8


@pytest.mark.parametrize("stored", [0.0, -0.0, 0, 5, -5.0])
async def test_zeros_keep_their_signs_in_arithmetic(akvs, key, stored):
    """The integer 0 has no negative: -0.0 - 0 is -0.0, and -0.0 + 0 is 0.0."""
    place = akvs[key()]
    ways = (place.increment, operator.add), (place.decrement, operator.sub), (place.multiply, operator.mul)
    for call, operation in ways:
        for operand in (0, 0.0, -0.0, -3, 2.5):
            for server_calculates in (False, True):
                await place.write(stored)
                if server_calculates:  # it does where this interface has just seen a small result
                    await place.multiply(1)
                assert repr(await call(operand)) == repr(operation(stored, operand))
                assert repr(await place.read()) == repr(operation(stored, operand))


def test_an_accessor_of_another_place_is_refused_and_not_taken_for_the_end_of_an_augmented_assignment(
    server_url, interface, kvs, pspace, key, raw
):
    """Another namespace, another kind of space, another interface, another path."""
    kvs[key()] = {"x": 1}
    with (
        reem.RedisInterface(server_url, namespace=key("other:")) as elsewhere,
        reem.RedisInterface(server_url) as twin,
        nothing_sent(raw),
    ):
        for space in (reem.KeyValueStore(elsewhere), reem.KeyValueStore(twin), pspace):
            with pytest.raises(BadType, match=r"read\(\)"):
                space[key()] = kvs[key()]
            with pytest.raises(BadType, match=r"read\(\)"):
                space[key()]["x"] = kvs[key()]["x"]
        with pytest.raises(BadType, match=r"read\(\)"):
            kvs[key()]["y"] = kvs[key()]["x"]
    kvs[key()]["x"] += 1
    kvs[key()]["x"] *= 3
    pspace[key()]["x"] += 1
    same = reem.KeyValueStore(interface)
    same[key()]["x"] = kvs[key()]["x"]
    assert kvs[key()].read() == {"x": 7}


class Name(str, enum.Enum):  # noqa: UP042 - the older way is what people have
    """Its str() is "Name.A", what it holds is "aa"."""

    A = "aa"


@pytest.mark.parametrize("space", ["KeyValueStore", "PublishSpace"])
def test_a_str_enum_is_refused_as_a_key(open_front, key, raw, space):
    front = open_front(space)
    front.write([key()], {"aa": 0})
    with nothing_sent(raw):
        for path in ([Name.A], [key(), Name.A]):
            with pytest.raises(BadKey, match="Name"):
                front.write(path, 1)
        with pytest.raises(BadKey, match="Name"):
            front.write([key()], {Name.A: 1})


class Tag(str):
    __slots__ = ()

    def __str__(self):
        return f"<{self[:]}>"


def test_a_str_subclass_is_stored_as_what_it_holds(front, key):
    """Not as what its own __str__ says: as a value, as a key, and in paths."""
    front.write([Tag(key())], {Tag("k"): Tag("x"), "l": [Tag("y")]})
    front.write([key(), Tag("m")], Tag("z"))
    assert_same(front.read([key()]), {"k": "x", "l": ["y"], "m": "z"})
    assert front.read([Tag(key()), Tag("k")]) == "x"


def test_the_empty_path_is_refused_as_a_bad_key(front):
    for path in ("", "."):
        with pytest.raises(BadKey, match="empty"):
            front.get(path)
        with pytest.raises(BadKey, match="empty"):
            front.set(path, 1)


# --- connections ----------------------------------------------------------------------------------


@pytest.mark.alone
async def test_a_server_that_accepts_and_never_answers_is_given_up():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        start = time.monotonic()
        direct, followers = reem.RedisInterface("127.0.0.1", port=port), reem.RedisInterface("127.0.0.1", port=port)
        core = reem_async.RedisInterface("127.0.0.1", port=port)
        outcomes = await asyncio.wait_for(
            asyncio.gather(
                asyncio.to_thread(reem.KeyValueStore(direct)["a"].read),
                asyncio.to_thread(reem.SilentSubscriber("a", followers).listen),
                reem_async.KeyValueStore(core)["a"].read(),
                reem_async.SilentSubscriber("a", core).listen(),
                return_exceptions=True,
            ),
            8.0,
        )
        assert time.monotonic() - start < 3.0
        assert all(isinstance(outcome, NotConnected | ConnectionLost) for outcome in outcomes), outcomes
        direct.close()
        followers.close()
        await core.close()


def connections(raw):
    return {row["id"] for row in raw.client_list()} - {str(raw.client_id())}


async def test_an_edit_works_after_its_connection_was_killed_while_it_lay_idle(server_url, key, raw):
    """Edits have a connection of their own, which is kept for the next one."""
    others = connections(raw)
    async with reem_async.RedisInterface(server_url) as interface:
        kvs = reem_async.KeyValueStore(interface)
        await kvs[key()].write({"n": 0})
        for n in range(1, 4):
            async with kvs[key()].edit() as value:
                value["n"] += 1
            killed = connections(raw) - others
            for connection in killed:
                raw.client_kill_filter(_id=connection)
            await asyncio.sleep(0.05)
            assert killed, "nothing was kept"
            assert await kvs[key()]["n"].read() == n


# --- ships ----------------------------------------------------------------------------------------


class Slow(reem_async.SpecialDatatypeShip):
    def __init__(self, kind, label):
        self.kind, self.label = kind, label

    async def check_fit(self, value):
        await asyncio.sleep(0.001)
        return isinstance(value, self.kind)

    async def write(self, key, value, client):
        await asyncio.sleep(0.001)
        client.set(key, str(value))

    async def read(self, key, client):
        await asyncio.sleep(0.001)
        client.get(key)

    async def interpret_read(self, responses):
        return self.kind(responses[0].decode())

    async def get_label(self):
        await asyncio.sleep(0.001)
        return self.label


async def test_ships_that_must_be_awaited_may_be_used_by_many_tasks_at_once_from_the_start(server_url, key):
    """Each is asked for its label while others use it already."""

    class Text(str):
        __slots__ = ()

    class Other(complex):
        pass

    ships = [Slow(Other, "other"), Slow(Text, "tag"), Slow(complex, "complex")]
    interface = reem_async.RedisInterface(server_url, ships=ships)
    kvs = reem_async.KeyValueStore(interface)

    async def use(number):
        await asyncio.sleep(number * 0.0007)
        await kvs[key(str(number))].write([1j * number, 2j])
        return await kvs[key(str(number))].read()

    try:
        assert await asyncio.gather(*map(use, range(12))) == [[1j * number, 2j] for number in range(12)]
    finally:
        await interface.close()


class Zipped(reem.NumpyShip):
    """Overrides how a NumpyShip writes and reads, not what it packs."""

    def get_label(self):
        return "zip"

    def write(self, key, value, client):
        client.set(key, zlib.compress(b"".join(self.pack(value))))

    def interpret_read(self, responses):
        return self.unpack(zlib.decompress(responses[0]))


def test_a_subclass_of_a_blob_ship_may_override_how_it_writes_and_reads(open_front, key, raw):
    """What it wrote is there, and what its methods raise is BadData with the path."""
    front = open_front(ships=[Zipped()])
    front.write([key()], {"img": A, "l": [A + 1]})
    assert_same(front.read([key()]), {"img": A, "l": [A + 1]})
    assert_no_orphans(raw, key())
    raw.set("{" + key() + "}.img", "no zip")
    with pytest.raises(BadData, match=rf"{key()}\.img.*zip"):
        front.read([key()])


@pytest.mark.parametrize("ship", [None, Zipped(), PoseShip()])
def test_a_foreign_type_under_a_ships_key_is_bad_data_with_the_path(open_front, key, raw, ship):
    """It is not a wrong kind of the document, which is fine."""
    front = open_front(ships=[ship] if ship else None)
    front.write([key()], {"d": {"v": Pose(1, 2) if isinstance(ship, PoseShip) else A}})
    raw.unlink("{" + key() + "}.d.v")
    raw.rpush("{" + key() + "}.d.v", "x")
    with pytest.raises(BadData, match=rf"{key()}\.d\.v"):
        front.read([key()])
    front.write([key(), "d", "v"], 5)
    assert_no_orphans(raw, key())


def test_a_publish_from_another_event_loop_is_refused_though_one_is_under_way(server_url, key):
    pspace = reem_async.PublishSpace(reem_async.RedisInterface(server_url))
    refused, begun, enough = [], threading.Event(), threading.Event()

    async def own():
        while not enough.is_set():
            await asyncio.gather(*[pspace[key()].write(number) for number in range(20)])
            begun.set()
        await pspace.interface.close()

    async def strange():
        await asyncio.wait_for(pspace[key()].write(-1), 5)

    def elsewhere():
        begun.wait()
        for _ in range(30):
            with pytest.raises(WrongLoop):
                asyncio.run(strange())
            refused.append(1)
        enough.set()

    thread = threading.Thread(target=elsewhere)
    thread.start()
    try:
        asyncio.run(asyncio.wait_for(own(), 30))
    finally:
        enough.set()
        thread.join()
    assert len(refused) == 30
