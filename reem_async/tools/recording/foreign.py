"""Recordings of other programs: which key each of their channels is, and their messages as plain dicts.

A topic `/a/b` is the top-level key `a/b`. Only the slash in front is left out, unless another topic has that name.
Messages are decoded where they are self-described: CDR of ROS 2 with a `ros2msg` definition, protobuf, and JSON. Other
channels are named, with the reason, and left out. Numeric arrays become numpy arrays, pictures what REEM's are.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import orjson
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.records import Channel, Schema

from ...errors import BadData
from ...plan.documents import nested_over
from ...plan.paths import Path, check_top_key
from ...plan.trees import MISSING, get
from ...ships.images import EncodedImage, Jpeg, Png
from .cdr import compiled
from .container import Ref
from .format import DamagedRecording
from .joined import Files
from .layout import picture_format
from .stored import LOST, Reference, extract, reference_to

_DEEPEST = 100
"""Levels of a value: as many as one on a server may have."""
_MOST_VALUES = 4_000_000
"""Values of one protobuf message: each takes a hundred bytes of memory, and may take two in the message."""
_KEPT = 4  # decoded messages: the arrays of one are asked for one by one

Decode = Callable[[bytes], Any]


class Foreign:
    """The channels of files that other programs have written."""

    def __init__(self, container: Files, channels: Mapping[int, Channel]) -> None:
        self.keys: dict[int, str] = {}
        self.skipped: dict[int, str] = {}  # why the others are left out
        self._container = container
        self._decoders: dict[int, Decode] = {}
        self._message = lru_cache(_KEPT)(self._decoded)
        known: dict[tuple[str, int], Decode | str] = {}
        topics = {channel.topic for channel in channels.values()}
        for number, channel in channels.items():
            kind = channel.message_encoding, channel.schema_id
            if kind not in known:
                known[kind] = _decoder(channel, container.schemas.get(channel.schema_id))
            decode, key = known[kind], _key(channel.topic, topics)
            if isinstance(decode, str) or isinstance(key, BadData | ValueError):
                self.skipped[number] = decode if isinstance(decode, str) else str(key)
            else:
                self.keys[number], self._decoders[number] = key, decode

    def tree(self, ref: Ref) -> Any:
        """Return the value of a message, with a `Reference` for what is large, or all of it if it cannot be decoded.

        MISSING if its chunk is damaged.
        """
        key = self.keys[ref.channel]

        def store(label: str, path: Path, value: Any) -> Reference:
            # The numbers of a list are not kept: they are in the file.
            return replace(reference_to(label, path, ref.time, value), numbers=None, where=ref)

        try:
            value = self._message(ref)
        except DamagedRecording as error:
            return Reference(LOST, (key,), ref.time, 0, str(error))
        return value if value is MISSING else extract(value, (key,), store)

    def value(self, it: Reference) -> Any:
        """Return what a `Reference` stands for, pictures as `Jpeg` or `Png`; raises DamagedRecording."""
        value = get(self._message(it.where), it.path[1:])
        if value is MISSING:
            raise DamagedRecording(f"{it.shown}: the message of {it.at} ns is damaged")
        if isinstance(value, np.ndarray) and not value.flags.c_contiguous:
            value = np.ascontiguousarray(value)
            value.flags.writeable = False
        return value

    def _decoded(self, ref: Ref) -> Any:
        message = self._container.message(ref)
        if message is None:
            return MISSING
        channel = self._container.channels[ref.channel]
        schema = self._container.schemas.get(channel.schema_id)
        try:
            value = self._decoders[ref.channel](message.data)
            return _with_picture(schema.name, value) if schema and type(value) is dict else value
        except Exception as error:  # whatever libraries raise over bytes that are not what their schema says
            what = f"{channel.message_encoding} {schema.name if schema else ''}".strip()
            raise DamagedRecording(
                f"a message of {channel.topic} is not {what}: {str(error) or repr(error):.200}"
            ) from None


def _key(topic: str, topics: set[str]) -> str | ValueError:
    name = topic.removeprefix("/")
    try:
        return check_top_key(topic if name != topic and (not name or name in topics) else name)
    except ValueError as error:
        return error


def _decoder(channel: Channel, schema: Schema | None) -> Decode | str:
    """Return what decodes the messages of a channel, or why nothing does."""
    encoding, described = channel.message_encoding, schema.encoding if schema else ""
    try:
        if encoding == "json":
            return _json
        if schema is not None and (encoding, described) == ("protobuf", "protobuf"):
            return _protobuf(schema)
        if schema is not None and (encoding, described) == ("cdr", "ros2msg"):
            return compiled(schema.name, schema.data.decode())
    except Exception as error:  # whatever libraries raise over a schema that is none
        name = "" if schema is None else schema.name
        return f"the {described} schema {name!r:.80} cannot be used: {str(error) or repr(error):.200}"
    return f"encoding {encoding!r:.40}" + (f" with a schema in {described!r:.40}" if described else " without a schema")


def _json(data: bytes) -> Any:
    value = orjson.loads(data)
    if nested_over(data, value, _DEEPEST):
        raise ValueError(f"nested over {_DEEPEST} levels")
    return value


# Protobuf: the schema record is a FileDescriptorSet, of which classes are made at run time.

_F = FieldDescriptor
_NUMBERS = {
    _F.CPPTYPE_INT32: np.int32, _F.CPPTYPE_INT64: np.int64, _F.CPPTYPE_UINT32: np.uint32, _F.CPPTYPE_UINT64: np.uint64,
    _F.CPPTYPE_FLOAT: np.float32, _F.CPPTYPE_DOUBLE: np.float64, _F.CPPTYPE_BOOL: np.bool_,
}  # fmt: skip


def _protobuf(schema: Schema) -> Decode:
    files = {file.name: file for file in FileDescriptorSet.FromString(schema.data).file}
    # A pool of its own: other files have other messages of the same names.
    pool = descriptor_pool.DescriptorPool()

    def add(name: str) -> None:
        file = files.pop(name, None)  # none of them is added twice, though they import each other
        if file is not None:
            for other in file.dependency:
                add(other)
            pool.Add(file)

    while files:
        add(next(iter(files)))
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
    return lambda data: _Fields().of(kind.FromString(data))


class _Fields:
    """Makes a dict of a protobuf message. Fields that may be left out, and are, are left out."""

    def __init__(self) -> None:
        self._left = _MOST_VALUES

    def of(self, message: Any) -> dict[str, Any]:
        self._spend(1)
        fields = message.DESCRIPTOR.fields
        return {
            field.name: self._field(field, getattr(message, field.name))
            for field in fields
            if not field.has_presence or message.HasField(field.name)
        }

    def _spend(self, values: int) -> None:
        self._left -= values
        if self._left < 0:
            raise ValueError(f"it holds over {_MOST_VALUES} values")

    def _field(self, field: Any, value: Any) -> Any:
        if field.message_type is not None and field.message_type.GetOptions().map_entry:
            self._spend(len(value))
            item = field.message_type.fields_by_name["value"]
            return {str(key): self._one(item, value[key]) for key in value}
        if not _is_repeated(field):
            return self._one(field, value)
        if field.cpp_type in _NUMBERS:
            array: np.ndarray[Any, Any] = np.array(value, _NUMBERS[field.cpp_type])
            array.flags.writeable = False
            return array
        self._spend(len(value))
        return [self._one(field, item) for item in value]

    def _one(self, field: Any, value: Any) -> Any:
        if field.message_type is not None:
            return self.of(value)
        if field.enum_type is not None:
            known = field.enum_type.values_by_number.get(value)
            return value if known is None else known.name
        return value


def _is_repeated(field: Any) -> bool:
    # Older protobuf has only the label, of which newer ones warn.
    return bool(field.is_repeated if hasattr(field, "is_repeated") else field.label == _F.LABEL_REPEATED)


# Pictures: the field `data` of these messages becomes what the picture is.

# Names of ROS and of Foxglove -> dtype and channels; with bgr, the channels are reversed.
_PICTURES = {
    "mono8": ("u1", 1), "8UC1": ("u1", 1), "rgb8": ("u1", 3), "bgr8": ("u1", 3), "8UC3": ("u1", 3), "rgba8": ("u1", 4),
    "bgra8": ("u1", 4), "8UC4": ("u1", 4), "mono16": ("u2", 1), "16UC1": ("u2", 1), "32FC1": ("f4", 1),
} | {f"bayer_{form}8": ("u1", 1) for form in ("rggb", "bggr", "gbrg", "grbg")}  # fmt: skip
_FILES: dict[str, type[EncodedImage]] = {"jpeg": Jpeg, "png": Png}


def _with_picture(schema: str, message: dict[str, Any]) -> dict[str, Any]:
    name, data = schema.replace(".", "/").rpartition("/")[2], message.get("data")
    if name not in ("Image", "RawImage", "CompressedImage") or data is None:
        return message
    if isinstance(data, str):  # in JSON
        try:
            data = base64.b64decode(data, validate=True)
        except binascii.Error:
            return message
    if isinstance(data, np.ndarray) and data.dtype == np.uint8:
        data = data.data if name != "CompressedImage" else data.tobytes()
    if not isinstance(data, bytes | memoryview):
        return message
    picture = _compressed(bytes(data)) if name == "CompressedImage" else _raw(message, data)
    return message if picture is None else {**message, "data": picture}


def _compressed(data: bytes) -> EncodedImage | bytes:
    kind = _FILES.get(picture_format(data))
    try:
        return data if kind is None else kind.from_file(data)
    except BadData:
        return data


def _raw(message: Mapping[str, Any], data: bytes | memoryview) -> np.ndarray[Any, Any] | None:
    """Return the picture; None if its bytes are not what the other fields say."""
    encoding, order = str(message.get("encoding")), ">" if message.get("is_bigendian") else "<"
    height, width, step = sizes = [message.get(name, 0) for name in ("height", "width", "step")]
    if encoding not in _PICTURES or not all(type(size) is int and size > 0 for size in sizes):
        return None
    form, channels = _PICTURES[encoding]
    dtype = np.dtype(order + form)
    row = width * channels * dtype.itemsize  # behind it, up to `step`, there may be padding
    if step < row or height * step != len(data):
        return None
    shape = (height, width, channels) if channels > 1 else (height, width)
    rows = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(height, step)[:, :row])
    picture: np.ndarray[Any, Any] = rows.view(dtype).reshape(shape).astype(dtype.newbyteorder("="), copy=False)
    if encoding == "bgr8":
        picture = picture[:, :, ::-1]  # a view: most pictures are decoded for what is beside them, and not looked at
    elif encoding == "bgra8":
        picture = picture[:, :, [2, 1, 0, 3]]
    picture.flags.writeable = False
    return picture
