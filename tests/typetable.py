"""Which Python types can be stored, without and with a typed view: the table of docs/howto/typed.md, from a server.

`python -m tests.typetable` writes it into that page. A test of test_typed.py fails if it is out of date.
"""

import array
import collections
import dataclasses
import datetime
import decimal
import enum
import fractions
import pathlib
import re
import typing
import uuid

import msgspec
import numpy as np
import pandas
import PIL.Image
import pydantic

import reem

PAGE = pathlib.Path(__file__).resolve().parents[1] / "docs/howto/typed.md"
BEGIN, END = "<!-- made by python -m tests.typetable -->", "<!-- end -->"


@dataclasses.dataclass
class Point:
    x: float = 1.0


class PointStruct(msgspec.Struct):
    x: float = 1.0


class PointModel(pydantic.BaseModel):
    x: float = 1.0


class PointTuple(typing.NamedTuple):
    x: float = 1.0


class Mode(enum.Enum):
    IDLE = "idle"


class Word(enum.StrEnum):
    IDLE = "idle"


class Level(enum.IntEnum):
    LOW = 1


# torch is no requirement of the tests, and only its name counts.
Tensor = type("Tensor", (), {"__module__": "torch", "__repr__": lambda self: "tensor([1., 2.])"})

ROWS: list[tuple[str, object, object]] = [
    ("`None`", None, None),
    ("`bool`", True, bool),
    ("`int`", 3, int),
    ("`float`", 2.5, float),
    ("`float('nan')`, infinity", float("nan"), float),
    ("`str`", "text", str),
    ("`bytes`", b"raw", bytes),
    ("`list`", [1, 2], list[int]),
    ("`tuple`", (1, 2), tuple[int, int]),
    ("`dict`", {"a": 1}, dict[str, int]),
    ("`dict` with keys that are no `str`", {1: "a"}, dict[int, str]),
    ("`set`", {1}, set[int]),
    ("`frozenset`", frozenset({1}), frozenset[int]),
    ("`np.ndarray`", np.zeros(3), np.ndarray),
    ("`np.float64`", np.float64(0.5), float),
    ("`np.int64`", np.int64(3), int),
    ("`np.bool_`", np.True_, bool),
    ("dataclass", Point(), Point),
    ("`msgspec.Struct`", PointStruct(), PointStruct),
    ("`pydantic.BaseModel`", PointModel(), PointModel),
    ("`NamedTuple`", PointTuple(), PointTuple),
    ("`Enum`", Mode.IDLE, Mode),
    ("`StrEnum`, `(str, Enum)`", Word.IDLE, Word),
    ("`IntEnum`", Level.LOW, Level),
    ("`datetime`", datetime.datetime(2026, 11, 26, 21, 30, tzinfo=datetime.UTC), datetime.datetime),
    ("`date`", datetime.date(2026, 11, 26), datetime.date),
    ("`time`", datetime.time(21, 30), datetime.time),
    ("`timedelta`", datetime.timedelta(seconds=1.5), datetime.timedelta),
    ("`Path`", pathlib.Path("maps/hall"), pathlib.Path),
    ("`UUID`", uuid.UUID(int=1), uuid.UUID),
    ("`Decimal`", decimal.Decimal("1.10"), decimal.Decimal),
    ("`complex`", 1j, complex),
    ("`Fraction`", fractions.Fraction(1, 3), fractions.Fraction),
    ("`range`", range(3), range),
    ("`deque`", collections.deque([1]), collections.deque),
    ("`OrderedDict`, `defaultdict`", collections.OrderedDict(a=1), collections.OrderedDict),
    ("`bytearray`", bytearray(b"raw"), bytearray),
    ("`array.array`", array.array("d", [1.0]), array.array),
    ("`PIL.Image`", PIL.Image.new("L", (2, 1)), PIL.Image.Image),
    ("`torch.Tensor`", Tensor(), Tensor),
    ("`pandas.DataFrame`", pandas.DataFrame({"a": [1]}), pandas.DataFrame),
    ("`pandas.Series`", pandas.Series([1]), pandas.Series),
]


def table(kvs: reem.KeyValueStore, key: str = "k") -> str:
    """Write each value without and with a typed view, and return what became of it, in Markdown."""
    lines = ["| type | without a view | with a view | what a view stores |", "|---|---|---|---|"]
    for label, value, annotation in ROWS:
        without, _ = tried(lambda value=value: kvs.set(key, value), lambda: kvs[key].read(), value)
        view = kvs[key].of(annotation)
        with_view, is_stored = tried(lambda view=view, value=value: view.write(value), view.read, value)
        lines.append(f"| {label} | {without} | {with_view} | {shown(kvs[key].read()) if is_stored else ''} |")
    return "\n".join(lines)


def tried(write: typing.Callable[[], None], read: typing.Callable[[], object], value: object) -> tuple[str, bool]:
    """What becomes of a value, and whether it is stored."""
    try:
        write()
    except reem.BadInput as error:
        return f"refused: {cure(str(error))}", False
    found = read()
    is_same = type(found) is type(value) and bool(np.all(found == value))
    return ("the same" if is_same else f"read as `{type(found).__name__}`"), True


def cure(message: str) -> str:
    """What an error says to write, with code as such."""
    if "cannot be the type" in message:
        return "not a type of a view"
    text = re.sub(r"; or use kvs.*", "; or a view", re.sub(r"^.*?cannot be stored; |^\S+: ", "", message))
    code = r"(?<![\w`])(?:[\w.]+\([^)]*\)|value\.\w+|\[value[^]]*\]|dict\[str, \.\.\.\])"
    return re.sub(code, r"`\g<0>`", text)


def shown(value: object) -> str:
    return f"array of {value.dtype}" if isinstance(value, np.ndarray) else f"`{value!r}`"


def written(text: str, new: str) -> str:
    """The page with another table."""
    return re.sub(f"(?s)(?<={re.escape(BEGIN)}\n\n).*?(?=\n\n{re.escape(END)})", lambda _: new, text)


if __name__ == "__main__":
    from reem.server import EmbeddedServer

    with EmbeddedServer() as server, reem.RedisInterface(server.url) as interface:
        PAGE.write_text(written(PAGE.read_text(), table(reem.KeyValueStore(interface))))
