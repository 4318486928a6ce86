"""Trees as JSON messages that viewers can plot, and back, exactly.

What JSON or a viewer in JavaScript cannot hold exactly is shown as well as it can be in its place, and the
exact truth stands beside it, in a text under "$ship" at the root: a JSON list of notes. A viewer shows this
text as text. A root that is not a dict (or that has a "$ship" of its own) is wrapped as {"value": ...}.

    {"joint": [0.1, 0.2], "image": {"$ship": "numpy", "topic": "/arm/image", ...}, "$ship": "[[...], [...]]"}

A note begins with the path below the root, then says what is there:

    [path, "int"]                                                   an int over 2**53, shown as text
    [path, "array", dtype, shape, null or base64]                   a short array, shown as a list
    [path, "stored", label, path, time, size, summary, dtype, shape]    has a message of its own
"""

from __future__ import annotations

import base64
import math
import re
from typing import Any, NamedTuple

import numpy as np
import orjson
from google.protobuf import descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError

from ...errors import BadData
from ...plan.documents import nested_over
from ...plan.paths import Path, related, shorten
from ...plan.trees import MISSING, get
from ...ships.images import EncodedImage
from ...ships.numpy import NumpyShip, flat
from ...ships.registry import Ships
from .format import DamagedRecording
from .stored import Reference

NOTES = "$ship"
WRAPPER = "value"
_DEEPEST = 128
"""Levels of a value. What is written has at most 100."""
_MOST_NOTES = 64
# Larger integers are not exact in JavaScript, in which most viewers are written.
_LARGEST_EXACT = 2**53
# Plain numbers and bools: what a short array in a message may be.
_DTYPE = re.compile(r"[<>|=][biuf]\d{1,2}")


class JsonMessage(NamedTuple):
    tree: dict[str, Any]  # plain JSON values, notes included
    wrapped: bool  # the tree proper is under "value"

    @property
    def text(self) -> bytes:
        return orjson.dumps(self.tree)


def topic_of(path: Path) -> str:
    return "/" + "/".join([str(key) for key in path])


def to_json(tree: Any) -> JsonMessage:
    """Return a tree, arrays already replaced by `Reference` where they are long, as a JSON object with its notes."""
    notes: list[Any] = []
    shown = _shown(tree, (), notes)
    # A root with a "$ship" of its own would be taken for one with notes.
    wrapped = type(shown) is not dict or type(tree) is not dict or NOTES in tree
    root: dict[str, Any] = {WRAPPER: shown} if wrapped else shown
    if notes:
        root[NOTES] = orjson.dumps(notes).decode()
    return JsonMessage(root, wrapped)


def _shown(value: Any, place: Path, notes: list[Any]) -> Any:
    kind = type(value)
    if kind is float or kind is str or kind is bool or value is None:
        return value
    if kind is int:
        if -_LARGEST_EXACT <= value <= _LARGEST_EXACT:
            return value
        # As text in its place: a viewer that reads it as a number would show another one.
        notes.append([place, "int"])
        return str(value)
    if kind is dict:
        return {key: _shown(item, (*place, key), notes) for key, item in value.items()}
    if kind is list:
        return [_shown(item, (*place, index), notes) for index, item in enumerate(value)]
    if kind is Reference:
        return _shown_stored(value, place, notes)
    return _shown_array(value, place, notes)


def _shown_stored(it: Reference, place: Path, notes: list[Any]) -> dict[str, Any]:
    note = [place, "stored", it.label, it.path, it.at, it.size, it.summary, it.dtype, it.shape]
    notes.append(note)
    shape = {} if it.shape is None else {"dtype": it.dtype, "shape": it.shape}
    return {NOTES: it.label, "topic": topic_of(it.path), "size": it.size, **shape}


def _shown_array(array: np.ndarray[Any, Any], place: Path, notes: list[Any]) -> Any:
    exact = array.tolist()
    data = None
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        # JSON has no NaN: null in its place, and the exact bytes in the note.
        objects = array.astype(object)
        objects[~np.isfinite(array)] = None
        shown = objects.tolist()
        data = base64.b64encode(array.tobytes()).decode()
    elif array.dtype.kind in "iu" and array.itemsize == 8 and _is_large(array):
        # Rounded for viewers; the exact bytes are in the note.
        shown = array.astype(float).tolist()
        data = base64.b64encode(array.tobytes()).decode()
    else:
        shown = exact
    notes.append([place, "array", array.dtype.str, array.shape, data])
    return shown


def _is_large(array: np.ndarray[Any, Any]) -> bool:
    return bool(array.size) and (int(array.max()) > _LARGEST_EXACT or int(array.min()) < -_LARGEST_EXACT)


def from_json(text: bytes, *, wrapped: bool) -> Any:
    """Return the tree of a message, long arrays as `Reference`; raises DamagedRecording."""
    try:
        root = orjson.loads(text)
        if type(root) is not dict:
            raise TypeError("not an object")
        notes = orjson.loads(root.pop(NOTES)) if NOTES in root else []
        holder = [root[WRAPPER] if wrapped else root]
        # Everything here may be made up: each wrong step ends as DamagedRecording, below.
        for path, *note in notes:
            container: Any = holder
            keys: list[Any] = [0, *path]
            for key in keys[:-1]:
                container = container[key]
            container[keys[-1]] = _exact(container[keys[-1]], *note)
        if nested_over(text, holder[0], _DEEPEST):
            raise ValueError(f"nested over {_DEEPEST} levels")
    except (AttributeError, IndexError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise DamagedRecording(f"the message {shorten(text)} was not written by REEM: {error!r}") from None
    return holder[0]


class PathReader:
    """Reads what is at one path below the root from many messages of a channel, without making a tree of each."""

    def __init__(self, path: Path, *, wrapped: bool) -> None:
        self._path = path
        self._wrapped = wrapped
        # A step at a time in all messages is quicker. By an index it might lead into a text.
        is_named = all(isinstance(key, str) for key in path)
        self._keys = [*([WRAPPER] if wrapped else []), *path] if is_named else []
        self._notes: dict[str, list[Any]] = {}  # those that concern the path, by the text that was at "$ship"

    def read(self, texts: list[bytes]) -> list[Any] | None:
        """Return the plain values or short arrays of some messages; None if one has something else, or is damaged."""
        together = b"[%b]" % b",".join(texts)
        # Each level takes a bracket, and so does each message.
        if _brackets(together) - len(texts) > _DEEPEST and max(map(_brackets, texts)) > _DEEPEST:
            return None
        try:
            found = orjson.loads(together)
            if any(NOTES in root for root in found) or not self._keys:
                found = [self._value(root) for root in found]
            else:
                for key in self._keys:
                    found = [it[key] for it in found]
        except (LookupError, TypeError, ValueError, OverflowError):
            return None
        return found if len(found) == len(texts) else None

    def _value(self, root: Any) -> Any:
        notes = self._concerning(root[NOTES]) if NOTES in root else ()
        value = get(root[WRAPPER] if self._wrapped else root, self._path)
        if notes:
            place, kind, *note = notes[0]
            if kind != "array" or tuple(place) != self._path:
                raise ValueError(notes)
            return _array(value, *note)
        if value is MISSING:
            raise LookupError
        return value

    def _concerning(self, text: str) -> list[Any]:
        if text not in self._notes:
            if len(self._notes) >= _MOST_NOTES:
                self._notes.clear()
            found = [note for note in orjson.loads(text) if related(tuple(note[0]), self._path)]
            self._notes[text] = found
        return self._notes[text]


def _brackets(text: bytes) -> int:
    return text.count(b"{") + text.count(b"[")


def _exact(shown: Any, kind: str, *note: Any) -> Any:
    if kind == "int":
        return int(shown)
    if kind == "array":
        return _array(shown, *note)
    if kind == "stored":
        label, path, at, size, summary, dtype, shape = note
        is_sound = path and all(type(key) in (str, int) for key in path) and type(path[0]) is str
        if not is_sound or {type(it) for it in (label, summary, dtype)} != {str} or not _are_sizes([at, size]):
            raise ValueError(note)
        if shape is not None and not _are_sizes(shape):
            raise ValueError(shape)
        return Reference(label, tuple(path), at, size, summary, dtype, None if shape is None else tuple(shape))
    raise ValueError(kind)


def _are_sizes(numbers: list[Any]) -> bool:
    return all(type(number) is int and 0 <= number < 2**63 for number in numbers)


def _array(shown: Any, dtype: str, shape: list[int], data: str | None) -> np.ndarray[Any, Any]:
    if not _DTYPE.fullmatch(dtype) or min(shape, default=0) < 0:
        raise ValueError(dtype, shape)
    flat = (
        np.array(shown, np.dtype(dtype))
        if data is None
        else np.frombuffer(base64.b64decode(data, validate=True), np.dtype(dtype))
    )
    array = flat.reshape(shape)
    array.flags.writeable = False
    return array


# Arrays and bytes as protobuf messages, and back, bit for bit.
#
# Pictures become `foxglove.RawImage` and JPEG or PNG bytes `foxglove.CompressedImage`, so that
# viewers show them. Any other array is a `reem.NdArray`, which holds an .npy file and a few figures to plot;
# other bytes are a `reem.Blob`. `frame_id` of a picture is its path.


_SMALLEST_PICTURE = 16
"""Pixels a side from which a 2-D array is taken for a picture and not for a matrix."""

# dtype and channels -> the name of the encoding in foxglove.RawImage. Others have no name there.
_PICTURES = {
    ("|u1", 1): "mono8",
    ("|u1", 3): "rgb8",
    ("|u1", 4): "rgba8",
    ("<u2", 1): "mono16",
    ("<f4", 1): "32FC1",
}
_ENCODINGS = {encoding: form for form, encoding in _PICTURES.items()}

_NUMPY = NumpyShip()


class EncodedMessage(NamedTuple):
    schema: str
    channels: str  # of a picture with three axes, the size of the last one; else ""
    pieces: list[Any]  # that belong one behind the other: a large value is not copied


# Fields with their numbers. Those of Foxglove are its published schemas; a test compares them. They are made here
# because Foxglove's package of generated code needs certain releases of protobuf.
_SCHEMAS = {
    "foxglove.RawImage": "timestamp:1 frame_id:7 width:2 height:3 encoding:4 step:5 data:6",
    "foxglove.CompressedImage": "timestamp:1 frame_id:4 data:2 format:3",
    # npy is the array itself, exactly; the figures behind it are for plots.
    "reem.NdArray": "timestamp:1 dtype:2 shape:3 npy:4 min:5 max:6 mean:7",
    "reem.Blob": "timestamp:1 label:2 size:3 data:4",
}
_KINDS = (
    {"timestamp": FieldDescriptorProto.TYPE_MESSAGE}
    | dict.fromkeys(("shape", "size"), FieldDescriptorProto.TYPE_UINT64)
    | dict.fromkeys(("frame_id", "encoding", "format", "dtype", "label"), FieldDescriptorProto.TYPE_STRING)
    | dict.fromkeys(("width", "height", "step"), FieldDescriptorProto.TYPE_FIXED32)
    | dict.fromkeys(("min", "max", "mean"), FieldDescriptorProto.TYPE_DOUBLE)
    | dict.fromkeys(("data", "npy"), FieldDescriptorProto.TYPE_BYTES)
)


def _classes() -> dict[str, Any]:
    """Make the classes of all messages at run time: no generated code, no compiler."""
    files: dict[str, FileDescriptorProto] = {}
    for schema, fields in _SCHEMAS.items():
        package, name = schema.split(".")
        path = f"{package}/{'recording' if package == 'reem' else name}.proto"
        file = files.setdefault(path, FileDescriptorProto(name=path, package=package, syntax="proto3"))
        file.dependency[:] = ["google/protobuf/timestamp.proto"]
        message = file.message_type.add(name=name)
        for field, number in (each.split(":") for each in fields.split()):
            label = FieldDescriptorProto.LABEL_REPEATED if field == "shape" else FieldDescriptorProto.LABEL_OPTIONAL
            it = message.field.add(name=field, number=int(number), type=_KINDS[field], label=label)
            if field == "timestamp":
                it.type_name = ".google.protobuf.Timestamp"
    # A pool of its own: the default one is shared by all of a program, and may know other messages of these names.
    pool = descriptor_pool.DescriptorPool()
    timestamp = FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp)
    for file in (timestamp, *files.values()):
        pool.Add(file)
    return {schema: message_factory.GetMessageClass(pool.FindMessageTypeByName(schema)) for schema in _SCHEMAS}


_CLASSES = _classes()


def schema_bytes(schema: str) -> bytes:
    """Return the FileDescriptorSet of a schema, dependencies first."""
    files = FileDescriptorSet()
    seen = set()

    def add(file: Any) -> None:
        if file.name not in seen:
            seen.add(file.name)
            for dependency in file.dependencies:
                add(dependency)
            file.CopyToProto(files.file.add())

    add(_CLASSES[schema].DESCRIPTOR.file)
    return files.SerializeToString()


def encode(label: str, value: Any, frame: str, time: int) -> EncodedMessage:
    """Return an array, a picture, or the bytes of any other ship, as a message.

    The label is the ship's, or "list"; viewers show `frame`, the path, with a picture; the time is in ns since 1970.
    """
    if isinstance(value, np.ndarray):
        is_raw = is_picture(label, value.dtype.str, value.shape)
        return _picture(value, frame, time) if is_raw else _array_message(value, time)
    picture = value.label if isinstance(value, EncodedImage) else picture_format(value) if label == "bytes" else ""
    value = value.data if isinstance(value, EncodedImage) else value
    if picture:
        head = _CLASSES["foxglove.CompressedImage"](frame_id=frame, format=picture)
        return _encoded("foxglove.CompressedImage", "", head, time, [value])
    return _encoded("reem.Blob", "", _CLASSES["reem.Blob"](label=label, size=len(value)), time, [value])


def _encoded(schema: str, channels: str, head: Any, time: int, pieces: list[Any]) -> EncodedMessage:
    """Return the message `head` with its data field put behind it, which saves copies of the data."""
    head.timestamp.seconds, head.timestamp.nanos = divmod(time, 1_000_000_000)
    number = head.DESCRIPTOR.fields_by_name["npy" if schema == "reem.NdArray" else "data"].number
    # The wire format of a bytes field: number and type (2) in one varint, the length in another, the bytes. Fields of a
    # message may come in any order, so the data can be last.
    tag = bytes([number << 3 | 2]) + _varint(sum([len(piece) for piece in pieces]))
    return EncodedMessage(schema, channels, [head.SerializeToString() + tag, *pieces])


def _varint(number: int) -> bytes:
    # Seven bits in each byte, the lowest first; the highest bit says that more follow.
    groups = []
    while number > 127:
        groups.append(number & 127 | 128)
        number >>= 7
    return bytes([*groups, number])


def is_picture(label: str, dtype: str, shape: tuple[int, ...]) -> bool:
    return (
        label == "numpy"
        and len(shape) in (2, 3)
        and min(shape[:2]) >= _SMALLEST_PICTURE
        and (dtype, shape[2] if len(shape) == 3 else 1) in _PICTURES
    )


def _picture(array: np.ndarray[Any, Any], frame: str, time: int) -> EncodedMessage:
    height, width, *last = array.shape
    channels = last[0] if last else 1
    head = _CLASSES["foxglove.RawImage"](
        frame_id=frame,
        width=width,
        height=height,
        encoding=_PICTURES[array.dtype.str, channels],
        step=width * channels * array.itemsize,
    )
    return _encoded("foxglove.RawImage", str(channels) if last else "", head, time, [flat(array)])


def _array_message(array: np.ndarray[Any, Any], time: int) -> EncodedMessage:
    head: Any = _CLASSES["reem.NdArray"](dtype=str(array.dtype)[:100], shape=array.shape)
    if array.size and array.dtype.kind in "biuf":
        with np.errstate(all="ignore"):
            head.min, head.max, head.mean = float(array.min()), float(array.max()), float(array.mean(dtype=float))
    return _encoded("reem.NdArray", "", head, time, list(_NUMPY.pack(array)))


_MAGIC = {b"\xff\xd8\xff": "jpeg", b"\x89PNG\r\n\x1a\n": "png"}


def picture_format(data: bytes) -> str:
    """Return the format of a compressed picture, "" for anything else."""
    return next((name for magic, name in _MAGIC.items() if data.startswith(magic)), "")


def decode(schema: str, channels: str, label: str, data: bytes, ships: Ships) -> Any:
    """Return the value of a message; arrays are read-only. Raises DamagedRecording, or BadData without its ship."""
    if schema not in _CLASSES:
        raise DamagedRecording(f"messages of the schema {schema!r} are not REEM's")
    try:
        message = _CLASSES[schema].FromString(data)
    except DecodeError as error:
        raise DamagedRecording(f"a message is not a {schema}: {error}") from None
    if schema == "foxglove.RawImage":
        return _decoded_picture(message, channels)
    if schema == "reem.NdArray":
        array = _NUMPY.unpack(message.npy)
        return array.tolist() if label == "list" else array
    ship = ships.labelled(label, "a value of the recording")
    try:
        return ship.ship.interpret_read([message.data])
    except BadData:
        raise
    except Exception as error:  # a ship may raise anything over bytes that are not its own
        raise DamagedRecording(f"the ship {label!r} could not make a value of what was recorded: {error!r}") from None


def _decoded_picture(message: Any, channels: str) -> np.ndarray[Any, Any]:
    code, count = _ENCODINGS.get(message.encoding, ("", 0))
    shape = (message.height, message.width, *([count] if channels else []))
    dtype = np.dtype(code or "u1")
    # Height and width are numbers of a stranger: the bytes that are there decide.
    if not count or math.prod(shape) * dtype.itemsize * (1 if channels else count) != len(message.data):
        raise DamagedRecording(f"a picture {message.encoding!r} of {shape} has {len(message.data)} bytes")
    array: np.ndarray[Any, Any] = np.frombuffer(message.data, dtype).reshape(shape)
    return array
