"""Typed views: dataclasses, structs and models in and out, in both fronts."""

import collections
import dataclasses
import datetime
import decimal
import enum
import functools
import json
import pathlib
import pickle
import subprocess
import sys
import textwrap
import typing
import uuid
import zoneinfo

import msgspec
import numpy as np
import pydantic
import pytest
import typetable
from conftest import ROOT, sized
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import reem
from reem_async.plan.typed import made, stored

Joints = typing.Annotated[np.ndarray, reem.Shape(3), np.float64]


class Mode(enum.Enum):
    IDLE = "idle"
    MOVING = "moving"


class Level(enum.IntEnum):
    LOW = 1
    HIGH = 2


@dataclasses.dataclass
class Point:
    x: float
    y: float = 0.0


class PointStruct(msgspec.Struct):
    x: float
    y: float = 0.0


class PointModel(pydantic.BaseModel):
    x: float
    y: float = 0.0


FIELDS = {
    "flag": bool,
    "count": int,
    "ratio": float,
    "name": str,
    "raw": bytes,
    "maybe": int | None,
    "either": typing.Union[Point, str, None],  # noqa: UP007 - both notations
    "mode": Mode,
    "level": Level,
    "word": typing.Literal["a", 1],
    "when": datetime.datetime,
    "day": datetime.date,
    "clock": datetime.time,
    "span": datetime.timedelta,
    "path": pathlib.Path,
    "id": uuid.UUID,
    "price": decimal.Decimal,
    "numbers": list[float],
    "words": set[str],
    "fixed": frozenset[int],
    "pair": tuple[int, str],
    "row": tuple[int, ...],
    "points": dict[str, Point],
    "tree": list[dict[str, Point | None]],
    "anything": typing.Any,
}
RAW = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=5,
)
FINITE = st.floats(allow_nan=False, allow_infinity=False)


def values_of(annotation):
    """What hypothesis makes for an annotation, as far as a document can hold it."""
    special = {
        float: FINITE,
        int: st.integers(-(2**63), 2**64 - 1),
        typing.Any: RAW,
        decimal.Decimal: st.decimals(allow_nan=False, allow_infinity=False),
        pathlib.Path: st.text("abc/.", min_size=1).map(pathlib.Path),
        str: st.text(),
        datetime.timedelta: st.timedeltas(datetime.timedelta(-9999), datetime.timedelta(9999)),
        datetime.datetime: st.datetimes(timezones=st.none() | st.just(datetime.UTC)),
        Point: st.builds(Point, FINITE, FINITE),
    }
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation in special:
        return special[annotation]
    if origin in (list, set, frozenset):
        inner = values_of(arguments[0])
        return {list: st.lists, set: st.sets, frozenset: st.frozensets}[origin](inner, max_size=4)
    if origin is dict:
        return st.dictionaries(st.text(max_size=4), values_of(arguments[1]), max_size=4)
    if origin is tuple and arguments[-1] is not ...:
        return st.tuples(*map(values_of, arguments))
    if origin is tuple:
        return st.lists(values_of(arguments[0]), max_size=4).map(tuple)
    if origin is typing.Literal:
        return st.sampled_from(arguments)
    if origin is not None:
        return st.one_of(*map(values_of, arguments))
    return st.from_type(annotation)


def slotted(fields):
    return dataclasses.make_dataclass("Frozen", [*fields.items()], frozen=True, slots=True)


KINDS = {
    "dataclass": lambda fields: dataclasses.make_dataclass("All", [*fields.items()]),
    "frozen dataclass with slots": slotted,
    "msgspec.Struct": lambda fields: msgspec.defstruct("All", [*fields.items()]),
    "pydantic.BaseModel": lambda fields: pydantic.create_model("All", **{n: (each, ...) for n, each in fields.items()}),
}


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=sized(20, 100), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.fixed_dictionaries({name: values_of(each) for name, each in FIELDS.items()}))
def test_objects_are_the_same_after_the_way_through_the_server(front, key, kind, values):
    cls = made_class(kind)
    value = cls(**values)
    place = front.at([key("typed")])
    front.wait(place.of(cls).write(value))
    assert_plain(front.wait(place.read()))
    found = front.wait(place.of(cls).read())
    assert type(found) is cls
    for name in FIELDS:
        assert getattr(found, name) == getattr(value, name), name
        assert type(getattr(found, name)) is type(getattr(value, name))


@functools.cache
def made_class(kind):
    return KINDS[kind](FIELDS)


def assert_plain(value):
    """Only what documents hold."""
    assert type(value) in (dict, list, str, int, float, bool, bytes, type(None))
    for each in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        assert_plain(each)


@dataclasses.dataclass
class Arm:
    joints: Joints
    mode: Mode = Mode.IDLE
    points: list[Point] = dataclasses.field(default_factory=list)
    seen: datetime.datetime | None = None


GOOD = {"joints": np.arange(3.0), "mode": "moving", "points": [{"x": 1.5}], "newer": {"field": 1}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joints": np.zeros(4)}, "arm.joints: expected an array of shape (3,), found float64[4] (ndarray)"),
        ({"joints": np.zeros(3, int)}, "arm.joints: expected an array of float64, found int64[3] (ndarray)"),
        ({"joints": [1.0, 2.0, 3.0]}, "arm.joints: expected ndarray, found [1.0, 2.0, 3.0] (list)"),
        ({"mode": "gone"}, "arm.mode: expected a value of Mode: 'idle', 'moving', found 'gone' (str)"),
        ({"points": [{"x": "1"}]}, "arm.points[0].x: expected int or float, found '1' (str)"),
        ({"points": [{"y": 1}]}, "arm.points[0].x: float is missing"),
        ({"seen": "yesterday"}, "arm.seen: expected datetime.datetime | None, found 'yesterday' (str)"),
        ({"points": True}, "arm.points: expected list or tuple, found True (bool)"),
    ],
)
def test_what_is_stored_and_is_not_what_the_class_says_is_named(kvs, key, change, message):
    name = key("arm")
    kvs[name] = {**GOOD, **change}
    view = kvs[name].of(Arm)
    for refused in (view.read, view.watch().next, lambda: view.edit().__enter__()):
        with pytest.raises(reem.BadData) as caught:
            refused()
        assert str(caught.value) == message.replace("arm", name, 1)
    with view.mirror() as mirror, pytest.raises(reem.BadData):
        mirror.value()


@pytest.mark.parametrize("kind", [Point, PointStruct, PointModel])
def test_an_object_that_is_not_what_its_class_says_is_refused_before_it_is_sent(kvs, key, kind):
    name = key("point")
    view = kvs[name].of(kind)
    wrong = kind(x=1.0)
    if kind is PointModel:
        object.__setattr__(wrong, "x", "far")
    else:
        wrong.x = "far"
    with pytest.raises(reem.BadValue, match=rf"{name}.x: expected int or float, found 'far' \(str\)"):
        view.write(wrong)
    with pytest.raises(reem.BadValue, match=f"{name}: expected {kind.__name__}, found"):
        view.write({"x": 1.0})
    with pytest.raises(reem.BadValue, match="exactly"):
        kvs[name].of(datetime.timedelta).write(datetime.timedelta(99421, microseconds=1))
    assert name not in kvs
    with pytest.raises(reem.MissingKey, match=f"{name}: nothing is stored here"):
        view.read()


def test_what_a_class_itself_checks_is_checked_when_it_is_read(kvs, key):
    class Strict(msgspec.Struct):
        speed: typing.Annotated[float, msgspec.Meta(le=1.0)]

    class Model(pydantic.BaseModel):
        speed: float = pydantic.Field(le=1.0)

    name = key("drive")
    kvs[name] = {"speed": 2.0}
    for kind in (Strict, Model):
        with pytest.raises(reem.BadData, match=name):
            kvs[name].of(kind).read()


def test_a_view_reads_writes_edits_and_follows(kvs, pspace, key):
    name = key("arm")
    arm = kvs[name].of(Arm)
    kvs[name] = GOOD
    found = arm.read()
    assert (found.mode, found.points, found.seen) == (Mode.MOVING, [Point(1.5)], None)
    found.points.append(Point(2, 3))
    arm.write(found)
    assert kvs[name]["newer"].read() == {"field": 1}  # what the class does not know stays
    with arm.edit() as value:
        value.mode, value.points = Mode.IDLE, [Point(9)]
    edited = kvs[name].read()
    assert edited.pop("joints").tolist() == [0.0, 1.0, 2.0]
    assert edited == {"newer": {"field": 1}, "mode": "idle", "points": [{"x": 9.0, "y": 0.0}], "seen": None}
    arm.at(lambda it: it.points[0]).write(Point(4, 5))
    assert arm.points[0].x.read() == 4.0
    with arm.mirror() as mirror, arm.watch() as watch:
        assert watch.next(5).data.mode is Mode.IDLE
        pspace[name].of(Arm).write(Arm(np.ones(3), Mode.MOVING))
        update = watch.next(5)
        assert update.data.mode is Mode.MOVING
        assert update.origin == "published"
        assert mirror.wait_until(lambda it: it.mode is Mode.MOVING, 5).points == []
        kvs[name].delete()
        assert watch.next(5).data is None
        mirror._mirror.wait_until(lambda data: data is None, 5)
        assert mirror.value(found) is found
        with pytest.raises(reem.MissingKey):
            mirror.value()
    for wrong in ("speed", 0):
        with pytest.raises(reem.BadType, match=f"{name}: Arm has no {wrong!r}; it has joints, mode, points, seen"):
            arm[wrong]
    assert not hasattr(arm, "speed")
    # A view is no value, and an assignment that would write nothing is refused.
    for mistake in (lambda: arm.mode == "idle", lambda: bool(arm.seen), lambda: setattr(arm, "mode", Mode.IDLE)):
        with pytest.raises(reem.BadType, match=r"a place in the dictionary, not the value|assignment does not write"):
            mistake()
    kvs[name] = GOOD
    arm["mode"] = Mode.IDLE
    assert pickle.loads(pickle.dumps(arm)).mode.read() is Mode.IDLE
    kvs[name]["next"] = {"value": 1, "next": {"value": 2}}
    assert kvs[name]["next"].of(Node).next.value.read() == 2  # of a class or None
    with pytest.raises(reem.BadType, match="lambda"):
        arm.at(lambda it: 3)
    with pytest.raises(reem.BadType, match=f"{name}: of.'Arm'. names no class"):
        kvs[name].of("Arm")


async def test_a_view_in_asyncio(akvs, apspace, key):
    name = key("arm")
    arm = akvs[name].of(Arm)
    await arm.write(Arm(np.zeros(3), seen=datetime.datetime(2026, 11, 26, tzinfo=datetime.UTC)))
    assert (await arm.read()).seen.year == 2026
    async with arm.edit() as value:
        value.points = [Point(1)]
    async with arm.mirror() as mirror, arm.watch() as watch:
        assert (await anext(watch)).data.points == mirror.value().points == [Point(1)]
        await apspace[name].of(Arm).mode.write(Mode.MOVING)
        assert (await watch.next(5)).data.mode is Mode.MOVING
        assert (await mirror.wait_until(lambda it: it.mode is Mode.MOVING, 5)).points == [Point(1)]
        with pytest.raises(TimeoutError):
            await mirror.wait_until(lambda it: it.mode is Mode.IDLE, 0.05)
        with pytest.raises(reem.BadType, match="predicate=3 is not a function"):
            await mirror.wait_until(3)
    assert {"joints", "mode", "read"} <= set(dir(arm))
    async with akvs[name].serve(lambda x: {"x": x}):
        assert await akvs[name].of(Point).call(x=2) == Point(2.0)
        with pytest.raises(reem.BadData, match=r"x: expected int or float, found 'far' \(str\)"):
            await akvs[name].of(Point).call(x="far")
    assert await arm.at(lambda it: it.points[0].x).read() == 1.0


def test_a_service_gets_and_gives_objects(kvs, key, caplog):
    def farthest(points: list[Point], limit: float, mode: Mode = Mode.IDLE) -> Point:
        assert all(type(each) is Point for each in points)
        return max(points, key=lambda each: each.x) if mode is Mode.IDLE else Point("x")

    service = kvs[key("service")]
    with service.serve(farthest):
        assert service.call(points=[{"x": 1}, {"x": 2}], limit=1) == {"x": 2.0, "y": 0.0}
        assert service.of(Point).call(points=[{"x": 1}], limit=1) == Point(1.0)
        with pytest.raises(reem.RemoteError, match=r"points\[0\].x: expected int or float, found 'a'"):
            service.call(points=[{"x": "a"}], limit=1)
        with pytest.raises(reem.RemoteError, match="expected int or float, found 'x'"):
            service.call(points=[], limit=1, mode="moving")

    def mixed(pair: tuple[int, int], points: list[Point], mode: Mode):
        assert (type(pair), mode) == (tuple, Mode.MOVING)
        return [*points, {"mode": mode}]

    class Callable:
        def __call__(self, point: Point) -> Point:
            assert type(point) is Point
            return point

    with service.serve(functools.partial(mixed, (1, 2))), pytest.raises(reem.RemoteError, match="points"):
        service.call(mode=Mode.MOVING)
    with service.serve(mixed):  # objects in lists, and of classes that cannot be stored without a view
        answer = service.call(pair=(1, 2), points=[Point(1)], mode=Mode.MOVING)
        assert answer == [{"x": 1.0, "y": 0.0}, {"mode": "moving"}]
        with pytest.raises(reem.BadValue, match=r"service.points\[0\].x: expected int or float, found 'a'"):
            service.call(pair=(1, 2), points=[Point("a")], mode=Mode.MOVING)
    with service.serve(Callable()):
        assert service.of(Point).call(point=Point(1)) == Point(1.0)

    def norm(point: Point) -> float:
        return point.x + point.y

    with service.serve(norm):
        assert service.call(point=Point(1, 2)) == service.call(point=PointStruct(1, 2)) == 3.0

    def unknown(point: "Hidden") -> float:  # noqa: F821
        return point["x"]

    with service.serve(unknown):
        assert "gets arguments as they are stored: 'Hidden' cannot be found" in caplog.text
        assert service.call(point=Point(1, 2)) == 1.0


@dataclasses.dataclass
class Cloud:
    data: bytes


class CloudShip(reem.BlobShip):
    def get_label(self):
        return "cloud"

    def check_fit(self, value):
        return isinstance(value, Cloud)

    def pack(self, value):
        return (value.data,)

    def unpack(self, blob):
        return Cloud(blob)


@dataclasses.dataclass
class Sensors:
    cloud: Cloud
    picture: np.ndarray | reem.Jpeg
    count: int = 0


def test_what_a_ship_carries_stays_so_in_views_and_calls(server_url, key):
    picture = np.full((4, 4, 3), 9, np.uint8)
    with reem.RedisInterface(server_url, ships=[CloudShip(), reem.NumpyShip(), reem.JpegShip()]) as interface:
        place = reem.KeyValueStore(interface)[key()]
        sensors = place.of(Sensors)
        sensors.write(Sensors(Cloud(b"1"), reem.Jpeg(picture)))
        with sensors.edit() as value:
            value.count = 1
        assert type(place.read(raw=True)["picture"]) is reem.Jpeg
        found = sensors.read()
        assert (found.cloud, found.picture.shape, found.count) == (Cloud(b"1"), (4, 4, 3), 1)

        def same(cloud: Cloud, points: list[Point]) -> Cloud:
            return cloud if type(cloud) is Cloud else Cloud(b"")

        with place.serve(same):
            assert place.call(cloud=Cloud(b"2"), points=[Point(1)]) == Cloud(b"2")


T = typing.TypeVar("T")


@dataclasses.dataclass
class Box(typing.Generic[T]):
    item: T


@dataclasses.dataclass
class PointBox(Box[Point]):
    label: str = ""


@dataclasses.dataclass
class TextBox(PointBox):
    item: str = ""


class BoxStruct(msgspec.Struct, typing.Generic[T]):
    item: T


class BoxModel(pydantic.BaseModel, typing.Generic[T]):
    item: T


@dataclasses.dataclass
class Node:
    value: int
    next: "Node | None" = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Frozen:
    a: int = 1
    state: int = dataclasses.field(init=False, default=4)


@dataclasses.dataclass
class Rectangle:
    width: float
    scale: dataclasses.InitVar[float] = 1.0
    count: int = dataclasses.field(init=False, default=0)
    area: float = dataclasses.field(init=False)

    def __post_init__(self, scale):
        self.area = self.width * scale
        if self.width < 0:
            raise ValueError("width is below 0")


@dataclasses.dataclass
class Point3(Point):
    z: float = 0.0


class Same(pydantic.BaseModel):
    x: float
    y: float = 0.0


class Left(msgspec.Struct, tag=True, rename="camel", kw_only=True):
    in_meters: float = 1.0


class Right(msgspec.Struct, tag=True):
    in_meters: float = 2.0


class Aliased(pydantic.BaseModel):
    speed: float = pydantic.Field(alias="v", le=5)
    name: str = pydantic.Field("x", validation_alias=pydantic.AliasChoices("n", "title"))


class Open(pydantic.BaseModel):
    model_config = {"extra": "allow"}
    a: int


class Pair(typing.NamedTuple):
    number: int
    point: Point


class Word(str, enum.Enum):  # noqa: UP042 - the old way
    YES = "yes"


class Planet(enum.Enum):
    EARTH = (5.9e24, (6.4e6,))


class Bits(enum.Flag):
    A = 1
    B = 2


IN_BERLIN = datetime.datetime(2026, 10, 25, 2, 30, fold=1, tzinfo=zoneinfo.ZoneInfo("Europe/Berlin"))


class Closed(pydantic.BaseModel):
    model_config = {"extra": "forbid"}
    a: int = 1


class ClosedStruct(msgspec.Struct, forbid_unknown_fields=True):
    a: int = 1


class Root(pydantic.RootModel[list[int]]):
    pass


@dataclasses.dataclass
class Radians:
    angle: float

    def __post_init__(self):
        self.angle = self.angle / 57.3


def counted_rectangle():
    value = Rectangle(2.0)
    value.count = 7
    return value


@pytest.mark.parametrize(
    ("annotation", "value", "document"),
    [
        (Box[Point], Box(Point(1)), {"item": {"x": 1.0, "y": 0.0}}),
        (PointBox, PointBox(Point(1)), {"item": {"x": 1.0, "y": 0.0}, "label": ""}),
        (TextBox, TextBox("a"), {"item": "a", "label": ""}),
        (list[BoxStruct[Mode]], [BoxStruct(Mode.IDLE)], [{"item": "idle"}]),
        (BoxModel[Mode], BoxModel[Mode](item=Mode.IDLE), {"item": "idle"}),
        (Node, Node(1, Node(2)), {"value": 1, "next": {"value": 2, "next": None}}),
        (Frozen, Frozen(a=3), {"a": 3, "state": 4}),
        (Rectangle, counted_rectangle(), {"width": 2.0, "count": 7, "area": 2.0}),
        (Point | Point3, Point3(1.0), {"x": 1.0, "y": 0.0, "z": 0.0}),
        (Point3 | Point, Point(1.0), {"x": 1.0, "y": 0.0}),
        (Left | Right, Right(), {"in_meters": 2.0, "type": "Right"}),
        (Left, Left(), {"in_meters": 1.0, "type": "Left"}),
        (Aliased, Aliased(v=1, n="n"), {"speed": 1.0, "name": "n"}),
        (Open, Open(a=1, b=2), {"a": 1, "b": 2}),
        (Pair, Pair(1, Point(2)), [1, {"x": 2.0, "y": 0.0}]),
        (Word, Word.YES, "yes"),
        (Planet, Planet.EARTH, [5.9e24, [6.4e6]]),
        (Bits, Bits.A | Bits.B, 3),
        (typing.Final[bool], np.True_, True),
        (datetime.datetime, IN_BERLIN, "2026-10-25T02:30:00+01:00"),
    ],
    ids=str,
)
def test_classes_of_any_kind_are_read_as_they_were_written(annotation, value, document):
    """Generic, recursive, with fields that the constructor does not take, tags, aliases, and values that are tuples."""
    found = stored(annotation, value, ("k",))
    assert found == document
    again = made(annotation, json.loads(json.dumps(found)), ("k",))
    # Where clocks are put back, Python takes a time in a zone for equal to none in another zone.
    expected = value.astimezone(datetime.UTC) if value is IN_BERLIN else value
    assert (again, type(again)) == (expected, bool if annotation == typing.Final[bool] else type(value))


@pytest.mark.parametrize("kind", [Closed, ClosedStruct])
def test_a_class_that_forbids_other_fields_does(kind):
    with pytest.raises(
        reem.BadData, match=f"k: expected what {kind.__name__} takes .*(?:no field b|\\bb\\b.*not permitted)"
    ):
        made(kind, {"a": 1, "b": 2}, ("k",))


@dataclasses.dataclass
class Sequence:
    child: "Sequence | Fallback | None"
    kind: typing.Literal["sequence"] = "sequence"


@dataclasses.dataclass
class Fallback:
    child: "Sequence | Fallback | None"
    kind: typing.Literal["fallback"] = "fallback"


def test_unions_in_unions_take_no_time_to_read():
    """Each level has two choices: trying all of them again at each level would take 2**60 conversions."""
    tree = None
    for _ in range(60):
        tree = Fallback(tree)
    document = stored(Sequence | Fallback, tree, ("k",))
    assert made(Sequence | Fallback, document, ("k",)) == tree
    inner = document
    while inner["child"] is not None:
        inner = inner["child"]
    inner["child"] = 1
    with pytest.raises(reem.BadData, match=r"child.child: expected .*Sequence \| .*Fallback \| None, found 1"):
        made(Sequence | Fallback, document, ("k",))


def in_a_function():
    @dataclasses.dataclass
    class Local:
        part: "Hidden"  # noqa: F821

    return Local


@dataclasses.dataclass
class Lost:
    scale: dataclasses.InitVar[float]


class TypedDictionary(typing.TypedDict):
    x: int


@pytest.mark.parametrize(
    ("annotation", "value", "message"),
    [
        (dict[int, str], {}, "the keys of a dict are str, not int"),
        (complex, 1j, "complex cannot be the type of what is stored"),
        (collections.deque, collections.deque(), "deque cannot be the type of what is stored"),
        (TypedDictionary, {"x": 1}, "TypedDictionary cannot be the type of what is stored"),
        (Point | Same, Same(x=1), "this Same would be read as Point, since what is stored fits both"),
        (str | pathlib.Path, pathlib.Path("a"), "this Path would be read as str"),
        (Point, Point3(1), "expected Point itself, since z of its subclass would be lost"),
        (in_a_function(), None, "Local: its annotations name 'Hidden', which cannot be found; define or import it"),
        (Lost, None, "Lost: its constructor needs 'scale', which is no field"),
        (Rectangle, dataclasses.replace(Rectangle(1), scale=1), None),
        (
            Aliased,
            Aliased.model_construct(speed=9.0, name=""),
            "k: expected what Aliased takes .*less than or equal to 5",
        ),
        (float, 2**60 + 1, "k: expected a float that holds it exactly"),
        (float, 10**400, "k: expected a float that holds it exactly"),
        (datetime.timedelta, datetime.timedelta.max, "k: expected a timedelta that .* stands for exactly"),
        (
            datetime.time,
            datetime.time(1, tzinfo=IN_BERLIN.tzinfo),
            "k: expected a time that '01:00:00' stands for exactly",
        ),
        (Root, Root([1]), "Root: a RootModel has no fields of its own; use the type of its root"),
        (Radians, Radians(57.3), "k.angle: expected a value that Radians keeps, not one of which it makes 0.017"),
        (typing.Annotated[np.ndarray, reem.Shape(2), float], np.zeros(2, int), "k: expected an array of float, found"),
        (np.typing.NDArray[np.float32 | np.float64], np.zeros(2, int), "k: expected an array of float32 or float64"),
        (
            np.ndarray[tuple[int, typing.Literal[3]], np.dtype[np.float64]],
            np.zeros((2, 4)),
            r"an array of shape \(None, 3\)",
        ),
    ],
    ids=str,
)
def test_what_could_not_be_read_again_is_refused(annotation, value, message):
    if message is None:  # an object that was changed so that its own class refuses it
        value.width, message = -1.0, r"k: expected what Rectangle takes \(width is below 0\), found Rectangle"
    with pytest.raises((reem.BadType, reem.BadValue), match=message):
        stored(annotation, value, ("k",))


@dataclasses.dataclass(frozen=True)
class Limits:
    speed: float = dataclasses.field(default=1.0, metadata={"low": 0.0, "high": 2.0, "unit": "m/s", "help": "speed"})
    joints: typing.Annotated[np.ndarray, reem.Shape(2), np.float32] = dataclasses.field(
        default_factory=lambda: np.zeros(2, np.float32)
    )


@dataclasses.dataclass(frozen=True)
class Gains:
    kp: float = 2.0
    number: typing.Annotated[int, msgspec.Meta(ge=1, le=5, description="count")] = 2
    mode: Mode = Mode.IDLE
    limits: Limits = dataclasses.field(default_factory=Limits)

    def __post_init__(self):
        if self.kp > 5 and self.number > 3:
            raise ValueError("too much")


class GainsStruct(msgspec.Struct):
    kp: typing.Annotated[float, msgspec.Meta(ge=0, le=10, description="gain", extra={"unit": "1/s"})] = 2.0
    word: typing.Literal["a", "b"] = "a"


class GainsModel(pydantic.BaseModel):
    kp: float = pydantic.Field(2.0, ge=0, le=10, description="gain", json_schema_extra={"unit": "1/s"})
    word: typing.Literal["a", "b"] = "a"


def test_a_parameter_that_is_an_object_is_a_parameter_for_each_field(front, key, caplog):
    name, seen = key("control"), []
    place = front.at([name])
    gains = front.wait(place.parameter("gains", Gains(), on_change=seen.append))
    assert gains.value.limits.joints.dtype == np.float32
    assert gains.value is not gains.value
    with pytest.raises(ValueError, match="read-only"):
        gains.value.limits.joints[0] = 9
    described = {
        each: front.wait(front.at(["_parameters", f"{name}.gains.{each}"]).read()) for each in ("mode", "number")
    }
    assert described["mode"] == {"type": "str", "default": "idle", "choices": ["idle", "moving"]}
    assert described["number"] == {"type": "int", "default": 2, "low": 1, "high": 5, "help": "count"}
    # A write keeps what is stored beside the fields.
    front.wait(place["gains"].update({"newer": 7}))
    front.wait(gains.write(Gains(kp=3.0, mode=Mode.MOVING)))
    assert (gains.value.kp, gains.value.mode, gains.invalid) == (3.0, Mode.MOVING, "")
    assert front.wait(place["gains"].read()) == {
        "kp": 3.0,
        "number": 2,
        "mode": "moving",
        "newer": 7,
        "limits": {"speed": 1.0, "joints": [0.0, 0.0]},
    }
    front.until(lambda: seen and seen[-1].kp == 3.0)
    # One field by another program; then fields that are not allowed, by themselves or together.
    front.wait(place["gains"]["limits"].update({"speed": 1.5}))
    front.until(lambda: gains.value.limits.speed == 1.5)
    for change, reason in (({"number": 9, "kp": 4.0}, "9 is out of range"), ({"kp": 6.0, "number": 4}, "too much")):
        front.wait(place["gains"].update(change))
        front.until(lambda reason=reason: reason in gains.invalid)
        assert (gains.value.kp, gains.value.number) == (3.0, 2)
    assert f"the last object stays: {name}.gains: expected what Gains takes (too much)" in caplog.text
    # Two programs in one: equal declarations share what is followed.
    again = front.wait(place.parameter("gains", Gains()))
    front.wait(again.write(Gains(kp=1.0)))
    assert (gains.value.kp, gains.invalid) == (1.0, "")
    front.until(lambda: seen[-1].kp == 1.0)
    assert all(type(each) is Gains and each.kp not in (4.0, 6.0) for each in seen)
    # Gone, as after a restart of the server.
    front.wait(place.delete())
    front.until(lambda: gains.value.kp == 2.0)


@pytest.mark.parametrize("kind", [GainsStruct, GainsModel])
def test_the_bounds_of_structs_and_models_are_those_of_their_parameters(kvs, key, kind):
    name = key("control")
    gains = kvs[name].parameter("gains", kind())
    bounds = {"type": "float", "default": 2.0, "low": 0.0, "high": 10.0}
    assert kvs["_parameters"][f"{name}.gains.kp"].read() == {**bounds, "unit": "1/s", "help": "gain"}
    assert kvs["_parameters"][f"{name}.gains.word"]["choices"].read() == ["a", "b"]
    gains.value = kind(kp=4.0, word="b")
    assert gains.value == kind(kp=4.0, word="b")
    assert gains.default == kind()
    wrong = kind(kp=4.0)
    wrong.kp = 11.0
    with pytest.raises(reem.BadValue, match=f"{name}.gains"):
        gains.value = wrong
    with pytest.raises(reem.BadValue, match="low of an object cannot be given here; each field has its own"):
        kvs[name].parameter("other", kind(), low=1)
    with pytest.raises(reem.BadType, match=f"{name}.nodes.next: the default None is not a bool"):
        kvs[name].parameter("nodes", Node(1))
    assert gains.value.kp == 4.0


def test_the_table_of_types_in_the_documentation_is_what_a_server_does(kvs, key):
    """`python -m tests.typetable` writes it again."""
    page = typetable.PAGE.read_text()
    assert page == typetable.written(page, typetable.table(kvs, key()))


def test_an_object_that_contains_itself_is_refused(kvs, key):
    circular = Node(1)
    circular.next = circular
    with pytest.raises(reem.TooDeep, match="nested too deeply, or an object contains itself"):
        kvs[key()].of(Node).write(circular)


PROGRAM = """
    import dataclasses
    from typing import Any, assert_type
    import numpy as np
    import reem, reem.view, reem_async

    @dataclasses.dataclass
    class Arm:
        speed: float
        names: list[str]

    def plan(goal: Arm, limit: float = 1.0) -> Arm:
        return goal

    def plain(kvs: reem.KeyValueStore) -> None:
        arm = kvs["arm"].of(Arm)
        assert_type(arm.read(), Arm)
        assert_type(arm.at(lambda it: it.names[0]).read(), str)
        arm.speed.write(1.0)
        assert_type(next(arm.watch()).data, Arm)
        assert_type(arm.watch().next(1.0).data, Arm)
        assert_type(arm.mirror().value(), Arm)
        assert_type(arm.mirror().wait_until(lambda it: it.speed > 1), Arm)
        with arm.edit() as value:
            assert_type(value, Arm)
        arm["speed"] = 1.0
        assert_type(kvs["maybe"].of(Arm | None), reem.view.View[Any])
        arm.speed = 1.0  # wrong
        arm.write(3)  # wrong
        assert_type(kvs["plan"].of(Arm).call(goal=Arm(1.0, [])), Arm)
        service = kvs["plan"].serve(plan)
        assert_type(service(Arm(1.0, []), limit=2.0), Arm)
        service(3)  # wrong
        assert_type(kvs["a"].parameter("kp", 2.0).value, float)
        assert_type(kvs["a"].parameter("mode", "hold", on_change=lambda it: print(it.upper())).value, str)
        arm_parameter = kvs["a"].parameter("arm", Arm(1.0, []))
        assert_type(arm_parameter.value, Arm)
        arm_parameter.value = 3  # wrong

    async def asynchronous(kvs: reem_async.KeyValueStore) -> None:
        arm = kvs["arm"].of(Arm)
        assert_type(await arm.read(), Arm)
        await arm.at(lambda it: it.speed).write("fast")  # wrong
        async for update in arm.watch():
            assert_type(update.data, Arm)
        async with arm.mirror() as mirror:
            assert_type(mirror.value(), Arm)
            assert_type(await mirror.wait_until(lambda it: it.speed > 1, 1.0), Arm)
        assert_type(await kvs["plan"].of(Arm).call(goal=Arm(1.0, [])), Arm)

        @kvs["plan"].serve
        async def slow(goal: Arm) -> Arm:
            return goal

        assert_type(await slow(Arm(1.0, [])), Arm)
        gains = await kvs["a"].parameter("arm", Arm(1.0, []))
        assert_type(gains.value, Arm)
        await gains.write("fast")  # wrong
"""


@pytest.mark.parametrize("checker", ["mypy", "basedpyright"])
@pytest.mark.long
def test_type_checkers_know_the_class_of_a_view(checker, tmp_path):
    (tmp_path / "program.py").write_text(textwrap.dedent(PROGRAM))
    (tmp_path / "pyrightconfig.json").write_text(
        json.dumps({"extraPaths": [str(ROOT)], "typeCheckingMode": "standard"})
    )
    command = [sys.executable, "-m", checker, *(["--strict"] if checker == "mypy" else []), "program.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    found = {int(line.split(":")[1]) for line in done.stdout.splitlines() if "error:" in line}
    lines = textwrap.dedent(PROGRAM).splitlines()
    assert found == {number for number, line in enumerate(lines, 1) if "# wrong" in line}, done.stdout
