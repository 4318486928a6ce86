"""Types of the user's own: ships written for the first REEM, and ships whose methods are coroutines."""

import ast
import asyncio
import gc
import json
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from conftest import aeventually, assert_no_orphans, assert_same, eventually, keys_of, nothing_sent

import reem
import reem_async
from reem_async.errors import BadData, BadType
from reem_async.ships import NumpyShip, SpecialDatatypeShip


class Pose:
    def __init__(self, x, y, frame="map"):
        self.x, self.y, self.frame = x, y, frame

    def __eq__(self, other):
        return isinstance(other, Pose) and vars(self) == vars(other)

    __hash__ = None

    def __repr__(self):
        return f"Pose({self.x}, {self.y}, {self.frame!r})"


class PoseShip(reem.SpecialDatatypeShip):
    """Old style: plain methods, several commands to write, one to read."""

    def check_fit(self, value):
        return isinstance(value, Pose)

    def write(self, key, value, client):
        client.hset(key, "xy", np.array([value.x, value.y], float).tobytes())
        client.hset(key, mapping={"frame": value.frame})

    def read(self, key, client):
        client.hmget(key, ["xy", "frame"])

    def interpret_read(self, responses):
        xy, frame = responses[0]
        return Pose(*np.frombuffer(xy).tolist(), frame.decode())

    def get_label(self):
        return "pose"


class AsyncPoseShip(reem_async.SpecialDatatypeShip):
    """The same with coroutine methods, which may wait."""

    async def check_fit(self, value):
        return isinstance(value, Pose)

    async def write(self, key, value, client):
        await asyncio.sleep(0)
        client.set(key, json.dumps(vars(value)))

    async def read(self, key, client):
        client.get(key)

    async def interpret_read(self, responses):
        await asyncio.sleep(0)
        return Pose(**json.loads(responses[0]))

    async def get_label(self):
        return "async pose"


SHIPS = {"synchronous": PoseShip, "async": AsyncPoseShip}


@pytest.fixture(params=list(SHIPS))
def ship(request):
    return SHIPS[request.param]()


@pytest.fixture
def numpy_ship():
    return reem_async.NumpyShip()


def test_a_ship_carries_its_type_at_any_place(open_front, key, raw, ship, numpy_ship):
    """As the root, in a dict, in a list, beside arrays, by path; nothing is left when it is replaced."""
    front = open_front(ships=[numpy_ship, ship])
    pose = Pose(1.5, 0.9374604873776271, "é")
    front.write([key()], pose)
    assert front.read([key()]) == pose
    assert_no_orphans(raw, key())
    front.write([key()], {"at": pose, "l": [pose, {"p": Pose(2, 3)}], "image": np.arange(3), "n": 1})
    got = front.read([key()])
    assert got["at"] == pose
    assert got["l"] == [pose, {"p": Pose(2.0, 3.0)}]
    assert_same(got["image"], np.arange(3))
    assert front.read([key(), "l", 1, "p"]) == Pose(2.0, 3.0)
    front.write([key(), "at"], Pose(7.0, 8.0))
    front.append([key(), "l"], Pose(9.0, 9.0))
    assert front.read([key(), "at"]) == Pose(7.0, 8.0)
    assert front.read([key(), "l", -1]) == Pose(9.0, 9.0)
    assert front.type([key(), "at"]) is Pose
    assert_no_orphans(raw, key())
    front.write([key()], {"at": 1})
    assert keys_of(raw, key()) == set()


def test_the_list_of_ships_replaces_the_default_one(open_front, key, raw, ship):
    """Without the numpy ship no array is taken; nothing is sent."""
    front = open_front(ships=[ship])
    with nothing_sent(raw), pytest.raises(BadType, match=key()):
        front.write([key()], {"image": np.arange(3)})
    front.write([key()], {"at": Pose(1.0, 2.0)})
    assert front.read([key(), "at"]) == Pose(1.0, 2.0)


def test_a_value_that_no_ship_takes_is_refused_with_its_path(open_front, key, raw, ship):
    for ships in ([], [ship]):
        front = open_front(ships=ships)
        with nothing_sent(raw), pytest.raises(BadType) as caught:
            front.write([key()], {"a": [1, object()]})
        assert key() in str(caught.value)
        assert "ship" in str(caught.value), "the remedy"


def test_the_first_ship_that_fits_takes_the_value(open_front, key, raw):
    greedy = PoseShip()
    greedy.get_label = lambda: "greedy"
    front = open_front(ships=[greedy, PoseShip()])
    front.write([key()], {"at": Pose(1, 2)})
    assert "greedy" in raw.execute_command("JSON.GET", key())


class Fussy(np.ndarray):
    """As astropy's Quantity: not to be made bytes without its unit."""

    def tobytes(self, order="C"):
        raise NotImplementedError("cannot write quantities to bytes")


class Unit(np.ndarray):
    """As unyt's arrays: the unit is an attribute, which views and copies inherit."""

    def __array_finalize__(self, other):
        self.unit = getattr(other, "unit", "km")


class AnyArrayShip(NumpyShip):
    """Claims each subclass of arrays, whose class it leaves out."""

    def check_fit(self, value):
        return isinstance(value, np.ndarray)

    def get_label(self):
        return "any array"


@pytest.mark.parametrize("seed", range(8))
def test_an_array_subclass_is_refused_unless_a_ship_claims_it(open_front, key, raw, seed):
    """Of random subclasses, dtypes, shapes and strides; what the message says to write is stored exactly."""
    print("seed", seed)
    rng = np.random.default_rng(seed)
    front, claiming = open_front(), open_front(ships=[NumpyShip(), AnyArrayShip()])
    for number in range(12):
        base = rng.choice(["f8", ">i2", "M8[ns]", "U3"])
        items = rng.integers(0, 99, rng.choice([0, 3, 900], 2)).astype(base)[:: rng.choice([1, 2])]
        kinds = [
            Fussy,
            Unit,
            type("Random", (rng.choice([Fussy, Unit, np.recarray]),), {}),
            np.ma.MaskedArray,
        ]
        value = items.view(kinds[number % 4])
        with nothing_sent(raw), pytest.raises(BadType, match=rf"{key()}.*(np.asarray\(x\)|getmaskarray\(x\))"):
            front.write([key()], {"pose": [value]})
        front.write([key()], {"pose": [np.asarray(value)]})
        assert_same(front.read([key()]), {"pose": [items]})
        claiming.write([key()], {"pose": value.view(Unit), "plain": items})
        assert raw.smembers("{" + key() + "}:ships") == {".pose", ".plain"}
        assert_same(claiming.read([key()]), {"pose": items, "plain": items})


def test_classes_that_add_nothing_to_their_items_are_stored_as_arrays(front, key, tmp_path):
    mapped = np.memmap(tmp_path / "image", np.uint8, "w+", shape=(50, 100))
    for value in mapped, mapped[3:5], np.eye(2).view(np.matrix), np.rec.array([(1, 2.0)], names="a,b"):
        front.write([key()], value)
        assert_same(
            front.read([key()]),
            np.frombuffer(value.tobytes(), value.dtype.descr if value.dtype.names else value.dtype).reshape(
                value.shape
            ),
        )


def test_an_unknown_label_is_said_with_the_remedy(open_front, key):
    """A program without the ship cannot read what another wrote; the rest of the document is readable."""
    open_front(ships=[PoseShip()]).write([key()], {"at": Pose(1, 2), "n": 5})
    without = open_front()
    for path in ([key()], [key(), "at"]):
        with pytest.raises(BadData) as caught:
            without.read(path)
        assert "pose" in str(caught.value)
        assert "ships=" in str(caught.value)
        assert key() in str(caught.value)
    assert without.read([key(), "n"]) == 5
    without.write([key(), "at"], 1)
    assert without.read([key()]) == {"at": 1, "n": 5}


def test_a_program_without_the_ship_still_cleans_up_after_it(open_front, key, raw):
    open_front(ships=[PoseShip()]).write([key()], {"at": Pose(1, 2), "b": {"at": Pose(1, 2)}})
    without = open_front()
    without.delete([key(), "at"])
    assert_no_orphans(raw, key())
    without.write([key(), "b"], [])
    assert keys_of(raw, key()) == set()


def test_a_ship_that_fails_to_write_sends_nothing(open_front, key, raw):
    class Failing(PoseShip):
        def write(self, key, value, client):
            client.set(key, "half")
            raise ZeroDivisionError("on purpose")

    front = open_front(ships=[Failing()])
    front.write([key()], {"n": 1})
    with nothing_sent(raw), pytest.raises(ZeroDivisionError):
        front.write([key()], {"at": Pose(1, 2)})
    assert front.read([key()]) == {"n": 1}


def test_a_ship_may_return_falsy_values(open_front, key):
    class Nothing(PoseShip):
        def interpret_read(self, responses):
            return None

    front = open_front(ships=[Nothing()])
    front.write([key()], {"at": Pose(1, 2), "l": [Pose(1, 2)]})
    assert front.read([key()]) == {"at": None, "l": [None]}


async def test_an_async_subscriber_sees_ships_too(server_url, key):
    async with reem_async.RedisInterface(server_url, ships=[AsyncPoseShip()]) as interface:
        space = reem_async.PublishSpace(interface)
        await space[key()].write({"at": Pose(0.0, 0.0)})
        updates = reem_async.KeyValueStore(interface)[key()].watch()
        assert (await asyncio.wait_for(anext(updates), 10)).data == {"at": Pose(0.0, 0.0)}
        await space[key()]["at"].write(Pose(1.0, 1.0))
        update = await asyncio.wait_for(anext(updates), 10)
        assert (update.value, update.data) == (Pose(1.0, 1.0), {"at": Pose(1.0, 1.0)})


async def test_calls_of_services_carry_what_ships_make(server_url, key, raw, ship, numpy_ship):
    """Both ways, beside small and large arrays. A side without the ship gets an error that names it."""

    async def turned(pose, **others):
        return {"pose": Pose(pose.y, pose.x), "others": others}

    async with (
        reem_async.RedisInterface(server_url, ships=[numpy_ship, ship]) as one,
        reem_async.RedisInterface(server_url, ships=[numpy_ship, type(ship)()]) as two,
        reem_async.RedisInterface(server_url) as lacking,
    ):
        kvs, others = reem_async.KeyValueStore(one), reem_async.KeyValueStore(lacking)
        async with kvs[key()].serve(turned), others[key()]["plain"].serve(turned):
            place = reem_async.KeyValueStore(two)[key()]
            for size in (3, 100_000, 100_000):
                answer = await place.call(pose=Pose(1.0, 2.0), image=np.arange(size))
                assert answer["pose"] == Pose(2.0, 1.0)
                assert_same(answer["others"], {"image": np.arange(size)})
            assert keys_of(raw, key()) == set()
            with pytest.raises(reem.RemoteError, match=r"BadData: .*pose', which this interface lacks"):
                await place["plain"].call(pose=Pose(1.0, 2.0))
            with pytest.raises(BadType, match=rf"{key()}\.pose: .*Pose.*cannot be stored"):
                await others[key()].call(pose=Pose(1.0, 2.0))
        await aeventually(lambda: keys_of(raw, key()) == set())


class AskingShip(reem_async.SpecialDatatypeShip):
    """Asks for something, which may have been cancelled."""

    carries = bytes

    def __init__(self):
        self.asked, self.asks = None, False

    async def check_fit(self, value):
        return type(value) is bytes

    async def get_label(self):
        return "asking"

    async def write(self, key, value, client):
        client.set(key, value)

    async def read(self, key, client):
        client.get(key)

    async def interpret_read(self, replies):
        if self.asked is not None:
            self.asks = True
            await self.asked
        return replies[0]


async def test_a_ship_that_asks_for_what_was_cancelled_makes_one_value_unreadable(server_url, key, caplog):
    """As with any other error of a ship, what is beside it is told; an end of its own is still one."""
    ship = AskingShip()
    async with reem_async.RedisInterface(server_url, ships=[ship]) as interface:
        space = reem_async.PublishSpace(interface)
        await space[key()].write({"x": b"1", "n": 0})
        mirror = reem_async.SilentSubscriber(key(), interface)
        await mirror.listen()
        ship.asked = asyncio.get_running_loop().create_future()
        ship.asked.cancel()
        await space[key()].write({"x": b"2", "n": 1})
        await aeventually(lambda: mirror.value()["n"] == 1)
        assert "CancelledError" in mirror.value()["x"].reason
        assert "x cannot be read" in caplog.text
        ship.asked = None
        await space[key()].write({"x": b"2", "n": 2})
        await aeventually(lambda: mirror.value() == {"x": b"2", "n": 2})
        caplog.clear()
        ship.asked, ship.asks = asyncio.get_running_loop().create_future(), False
        await space[key()].write({"x": b"3", "n": 3})
        await aeventually(lambda: ship.asks)
        (task,) = [task for task in asyncio.all_tasks() if task.get_name() == f"reem ships {key()}"]
    assert task.cancelled()
    assert not caplog.text


def test_an_array_whose_bytes_are_gone_is_bad_data(front, key, raw):
    """An eviction, or a hand that deleted it: never a wrong value."""
    front.write([key()], {"image": np.arange(8), "n": 1})
    raw.unlink(*(keys_of(raw, key()) - {"{" + key() + "}:ships"}))
    with pytest.raises(BadData, match="image"):
        front.read([key()])
    assert front.read([key(), "n"]) == 1


# --- ships that claim what JSON could hold ---------------------------------------------------------


class TextShip(SpecialDatatypeShip):
    """Carries what is of one type, as text; counts how often it is asked."""

    def __init__(self, fits, label="text_ship"):
        self.fits = fits
        self.label = label
        self.asked = 0

    def check_fit(self, value):
        self.asked += 1
        return self.fits(value)

    def write(self, key, value, client):
        client.set(key, repr(value))

    def read(self, key, client):
        client.get(key)

    def interpret_read(self, responses):
        return ast.literal_eval(responses[0].decode())

    def get_label(self):
        return self.label


class AwaitedTextShip(TextShip):
    async def check_fit(self, value):
        return self.fits(value)


CLAIMS = {
    "list": lambda value: isinstance(value, list),
    "dict": lambda value: isinstance(value, dict) and "custom" in value,
    "str": lambda value: isinstance(value, str) and value.startswith("te"),
    "float": lambda value: isinstance(value, float),
    "tuple": lambda value: isinstance(value, tuple),
}
CLAIMED = {"list": [1, 2.5], "dict": {"custom": [1]}, "str": "text", "float": 0.25, "tuple": (1, "a")}


@pytest.mark.parametrize("ship", [TextShip, AwaitedTextShip])
@pytest.mark.parametrize("kind", CLAIMS)
def test_a_ship_may_claim_a_type_that_json_has(open_front, key, raw, ship, kind):
    """Any type of data, says the manual: it is asked before the value becomes JSON, at any depth."""
    if kind == "dict":
        ship = type(ship.__name__, (ship,), {"claims": (dict,)})  # no short sample has that key
    ships = [reem.ships.NumpyShip(), ship(CLAIMS[kind])]
    front, value = open_front(ships=ships), CLAIMED[kind]
    front.write([key()], {"it": value, "deep": {"a": {"it": value}}, "other": 5, "image": np.arange(3)})
    assert front.read([key(), "it"]) == value
    assert type(front.read([key(), "it"])) is type(value)
    assert front.read([key(), "deep"]) == {"a": {"it": value}}
    assert (front.read([key(), "other"]), front.type([key(), "deep"])) == (5, dict)
    front.write([key(), "it"], value)
    front.write([key("root")], value)
    assert front.read([key("root")]) == value
    assert raw.exists(f"{{{key()}}}.it") == 1
    assert "text_ship" in raw.execute_command("JSON.GET", key("root"))
    front.write([key(), "it"], 7)
    front.delete([key(), "deep"])
    assert front.read([key()])["it"] == 7
    assert_no_orphans(raw, key())


def test_a_claimed_value_is_published_and_appended(interface, server_url, key):
    with reem.RedisInterface(server_url, ships=[TextShip(CLAIMS["str"])]) as own:
        kvs, space = reem.KeyValueStore(own), reem.PublishSpace(own)
        kvs[key()] = {"l": [1], "n": 1}
        kvs[key()]["l"].append("text")
        assert kvs[key()]["l"].read() == [1, "text"]
        with reem.SilentSubscriber(key(), own) as mirror:
            space[key()]["n"] = "text"
            eventually(lambda: mirror.value() == {"l": [1, "text"], "n": "text"})
    with pytest.raises(BadData, match="text_ship"):
        reem.KeyValueStore(interface)[key()].read()


def test_long_lists_of_floats_are_claimed_one_by_one(open_front, key, raw):
    """There is a quick way for such lists, which asks nobody."""
    ship = TextShip(lambda value: type(value) is float and value == 0.25)
    ship.claims = (float,)
    front = open_front(ships=[ship])
    front.write([key()], [0.25, 0.5] * 100)
    assert front.read([key()]) == [0.25, 0.5] * 100
    assert raw.execute_command("JSON.GET", key()).count("text_ship") == 100


def test_where_no_ship_claims_a_type_none_is_asked_for_one(open_front, key):
    """So that plain values cost nothing more."""
    ship = TextShip(lambda value: isinstance(value, set) or value.shape == (1,))  # chokes on other types
    front = open_front(ships=[ship])
    before = ship.asked
    front.write([key()], {"l": [1, 2.5, "text", None], "d": {"x": (1, 2)}, "t": "é"})
    front.write([key(), "l", 0], [0.5] * 100)
    assert ship.asked == before
    front.write([key(), "s"], {1})
    assert front.read([key(), "s"]) == {1}


def test_threads_that_meet_new_shapes_at_once_read_them():
    """A header is parsed without `ast`: in Python 3.11 it fails where a finalizer lets another thread use it."""
    ship = NumpyShip()

    class Finalized:
        def __init__(self):
            self.itself = self

        def __del__(self):
            time.sleep(0)  # lets another thread go on

    def parse(number):
        for count in range(300):
            Finalized()
            shape = (0, number, count)
            array = np.zeros(shape, [("x", "f4"), ("it's", "u1", 3)])
            assert ship.unpack(b"".join(ship.pack(array))).shape == shape

    before = gc.get_threshold()
    gc.set_threshold(10)
    try:
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(parse, range(4)))
    finally:
        gc.set_threshold(*before)


@pytest.mark.parametrize(
    "fields", [[(f"{'x' * 100}{n}", "f4") for n in range(1000)], [(f"f{n}", "u1", (2,) * 9) for n in range(1000)]]
)
def test_a_dtype_that_is_too_long_to_be_read_back_is_refused(kvs, key, fields):
    with pytest.raises(BadType, match="fewer fields or shorter names"):
        kvs[key()] = np.zeros(2, np.dtype(fields))
