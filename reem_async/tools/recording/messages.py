"""Arrays and bytes as protobuf messages, and back, bit for bit.

Pictures become `foxglove.RawImage` and JPEG, PNG, WebP or AVIF bytes `foxglove.CompressedImage`, so that
viewers show them. Any other array is a `reem.NdArray`, which holds an .npy file and a few figures to plot;
other bytes are a `reem.Blob`. `frame_id` of a picture is its path.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from google.protobuf import descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError

from ...errors import BadData
from ...ships.numpy import NumpyShip, flat
from ...ships.registry import Ships
from .errors import DamagedRecording

__all__ = ["Encoded", "decode", "encode", "schema_bytes"]

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


class Encoded(NamedTuple):
    """One value as a message.

    Attributes:
        schema: The name of its schema: "foxglove.RawImage", ...
        channels: For a picture, the last axis of its shape, or "" if it has only two axes; else "".
        pieces: The message, in pieces that belong one behind the other: a large value is not copied.
    """

    schema: str
    channels: str
    pieces: list[Any]


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
_DATA_FIELD = {
    "foxglove.RawImage": "data",
    "foxglove.CompressedImage": "data",
    "reem.NdArray": "npy",
    "reem.Blob": "data",
}


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


def encode(label: str, value: Any, frame: str, time: int) -> Encoded:
    """Return an array, or the bytes of any other ship, as a message.

    Args:
        label: The ship's label, or "list" for an array that stands for a list.
        value: The array, or the bytes.
        frame: The path, which viewers show as the frame of a picture.
        time: When it was published, in ns since 1970.
    """
    if isinstance(value, np.ndarray):
        return _picture(value, frame, time) if _is_picture(label, value) else _array(value, time)
    picture = _compressed(value)
    if label == "bytes" and picture:
        head = _CLASSES["foxglove.CompressedImage"](frame_id=frame, format=picture)
        return _encoded("foxglove.CompressedImage", "", head, time, [value])
    return _encoded("reem.Blob", "", _CLASSES["reem.Blob"](label=label, size=len(value)), time, [value])


def _encoded(schema: str, channels: str, head: Any, time: int, pieces: list[Any]) -> Encoded:
    """Return the message `head` with its data field put behind it, which saves copies of the data."""
    head.timestamp.seconds, head.timestamp.nanos = divmod(time, 1_000_000_000)
    number = head.DESCRIPTOR.fields_by_name[_DATA_FIELD[schema]].number
    # The wire format of a bytes field: number and type (2) in one varint, the length in another, the bytes. Fields of a
    # message may come in any order, so the data can be last.
    tag = bytes([number << 3 | 2]) + _varint(sum([len(piece) for piece in pieces]))
    return Encoded(schema, channels, [head.SerializeToString() + tag, *pieces])


def _varint(number: int) -> bytes:
    # Seven bits in each byte, the lowest first; the highest bit says that more follow.
    groups = []
    while number > 127:
        groups.append(number & 127 | 128)
        number >>= 7
    return bytes([*groups, number])


def _is_picture(label: str, array: np.ndarray[Any, Any]) -> bool:
    return (
        label == "numpy"
        and array.ndim in (2, 3)
        and min(array.shape[:2]) >= _SMALLEST_PICTURE
        and (array.dtype.str, array.shape[2] if array.ndim == 3 else 1) in _PICTURES
    )


def _picture(array: np.ndarray[Any, Any], frame: str, time: int) -> Encoded:
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


def _array(array: np.ndarray[Any, Any], time: int) -> Encoded:
    head: Any = _CLASSES["reem.NdArray"](dtype=str(array.dtype)[:100], shape=array.shape)
    if array.size and array.dtype.kind in "biuf":
        with np.errstate(all="ignore"):
            head.min, head.max, head.mean = float(array.min()), float(array.max()), float(array.mean(dtype=float))
    return _encoded("reem.NdArray", "", head, time, list(_NUMPY.pack(array)))


_MAGIC = {b"\xff\xd8\xff": "jpeg", b"\x89PNG\r\n\x1a\n": "png"}


def _compressed(data: bytes) -> str:
    """Return the format of a compressed picture, "" for anything else."""
    for magic, name in _MAGIC.items():
        if data.startswith(magic):
            return name
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "webp"
    # After the length of its first box (4 bytes).
    return "avif" if data[4:12] == b"ftypavif" else ""


def decode(schema: str, channels: str, label: str, data: bytes, ships: Ships) -> Any:
    """Return the value of a message; arrays are read-only.

    Raises:
        DamagedRecording: Not a message of this schema, or not one that REEM writes.
        BadData: Written by a ship that is not among `ships`.
    """
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
