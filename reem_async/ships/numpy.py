"""Numpy arrays: the bytes as they are, beside dtype and shape as JSON.

What comes from the server is checked before it is used: the dtype is built from an allow-list of
plain data types, and shape times item size must be exactly the bytes that are there. Nothing is
evaluated or unpickled.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import orjson

from ..errors import BadData, BadType
from .base import FieldShip

__all__ = ["NumpyShip", "flat", "flat_buffer"]

_CODE = re.compile(r"[<>|=][biufcSUVMm]\d{1,9}(\[\d{0,9}[a-zA-Zμ]{1,2}\])?")
_MOST_FIELDS = 1000
_MOST_DIMENSIONS = 64
_LARGEST_ITEM = 1 << 20
_WIDEST = {"f": 8, "c": 16}  # long doubles differ from machine to machine


class NumpyShip(FieldShip):
    """Carries numpy arrays of every dtype that is data: all but object, StringDType and long double.

    Arrays come back C-contiguous, of the same dtype (byte order, field names and time units
    included) and shape, bit for bit, and read-only: they share memory with the reply. Subclasses
    (memmap, matrix, recarray) come back as plain arrays. Masked arrays are refused.
    """

    carries = np.ndarray

    def get_label(self) -> str:
        """Return "numpy"."""
        return "numpy"

    def check_fit(self, value: Any) -> bool:
        """Return whether `value` is an array."""
        return isinstance(value, np.ndarray)

    def describe(self, value: np.ndarray[Any, Any]) -> tuple[int, str]:
        """Return bytes and text such as `float64[640,480,3]`; refuse what cannot be carried."""
        if isinstance(value, np.ma.MaskedArray):
            raise BadType(
                "a masked array would lose its mask; store {'data': a.filled(0), 'mask': np.ma.getmaskarray(a)}"
            )
        _encode_dtype(value.dtype)
        return value.nbytes, f"{_dtype_name(value.dtype)}[{','.join(map(str, value.shape))}]"

    def pack(self, value: np.ndarray[Any, Any]) -> dict[str, Any]:
        """Return the fields arr, dtype and shape. `arr` shares memory with a contiguous array."""
        return {"arr": flat(value), "dtype": _encode_dtype(value.dtype), "shape": orjson.dumps(value.shape)}

    def unpack(self, fields: Mapping[bytes, bytes]) -> np.ndarray[Any, Any]:
        """Return the array, read-only."""
        try:
            data, dtype, shape = (
                fields[b"arr"],
                decode_dtype(fields[b"dtype"]),
                _decode_shape(fields[b"shape"]),
            )
        except (KeyError, TypeError) as error:
            raise BadData(f"a stored array lacks the field {error}") from None
        if math.prod(shape) * dtype.itemsize != len(data):
            raise BadData(f"a stored array of {dtype} {list(shape)} has {len(data)} bytes; it was not written by REEM")
        if not data:
            array = np.zeros(shape, dtype)
            array.flags.writeable = False
            return array
        return np.frombuffer(data, dtype).reshape(shape)


def flat(array: np.ndarray[Any, Any]) -> memoryview | bytes:
    """Return the array's data, in C order, as a flat buffer of bytes; copies only if it must.

    The one place that makes an outgoing buffer: a buffer whose len() is not its size in bytes would
    be announced with a wrong length, and the rest of the data be read as commands.
    """
    if array.nbytes == 0:
        return b""
    view = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
    if len(view) != array.nbytes or view.nbytes != array.nbytes:
        raise BadType(f"{array.dtype} has no flat bytes")
    return view


def flat_buffer(word: Any) -> Any:
    """Return `word` ready to be sent if it is any kind of buffer (a ship's argument), else as it is."""
    if isinstance(word, np.ndarray):
        return flat(word)
    if isinstance(word, memoryview | bytearray):
        view = memoryview(word)
        return view.cast("B") if view.c_contiguous and view.nbytes else view.tobytes()
    return word


@lru_cache(maxsize=256)
def _dtype_name(dtype: np.dtype[Any]) -> str:
    if dtype.names is None:
        return str(dtype)
    text = ",".join(f"{name}:{dtype[name]}" for name in dtype.names)
    return f"struct({text[:60]}{'...' if len(text) > 60 else ''})"


@lru_cache(maxsize=256)
def _encode_dtype(dtype: np.dtype[Any]) -> bytes:
    """Return the dtype as JSON; raise BadType if it is not plain data or would come back different."""
    if dtype.hasobject or dtype.kind not in "biufcSUVMm":
        raise BadType(
            f"an array of dtype {dtype} holds Python objects, not data; use .tolist() or another dtype "
            "(for strings: astype('U'))"
        )
    try:
        code = orjson.dumps(np.lib.format.dtype_to_descr(dtype))
        same = decode_dtype(code) == dtype
    except (BadData, TypeError, ValueError):
        same = False
    if not same:
        raise BadType(f"the dtype {dtype} cannot be stored exactly (long double, overlapping fields, ...); use astype")
    return code


@lru_cache(maxsize=256)
def decode_dtype(code: bytes) -> np.dtype[Any]:
    """Return the dtype that the JSON `code` describes.

    Raises:
        BadData: Not plain data, or not a description of a dtype.
    """
    try:
        dtype = np.lib.format.descr_to_dtype(_checked(orjson.loads(code), [0]))
    except (orjson.JSONDecodeError, TypeError, ValueError, KeyError, IndexError, RecursionError, MemoryError):
        raise BadData(f"a stored array has the dtype {code[:60]!r}, which is not plain data") from None
    if dtype.hasobject or dtype.itemsize > _LARGEST_ITEM or dtype.kind not in "biufcSUVMm":
        raise BadData(f"a stored array has the dtype {code[:60]!r}, which is not plain data")
    return dtype


def _checked(descr: Any, fields: list[int]) -> Any:
    """Rebuild a description from JSON, as numpy wants it, refusing all but plain data."""
    if isinstance(descr, str):
        if not _CODE.fullmatch(descr) or int(re.findall(r"\d+", descr)[0]) > _WIDEST.get(descr[1], _LARGEST_ITEM):
            raise ValueError(descr)
        return descr
    return [_checked_field(field, fields) for field in descr]


def _checked_field(field: Any, fields: list[int]) -> tuple[Any, ...]:
    fields[0] += 1
    if fields[0] > _MOST_FIELDS or len(field) not in (2, 3):
        raise ValueError(field)
    name, descr, *shape = field
    title_and_name = tuple(name) if isinstance(name, list) else (name,)
    if len(title_and_name) > 2 or not all(isinstance(text, str) for text in title_and_name):
        raise ValueError(name)
    checked = (name if isinstance(name, str) else title_and_name, _checked(descr, fields))
    return (*checked, _check_shape(shape[0])) if shape else checked


def _decode_shape(code: bytes) -> tuple[int, ...]:
    try:
        return _check_shape(orjson.loads(code))
    except (orjson.JSONDecodeError, ValueError):
        raise BadData(f"a stored array has the shape {code[:60]!r}, which is none") from None


def _check_shape(shape: Any) -> tuple[int, ...]:
    if (
        not isinstance(shape, list)
        or len(shape) > _MOST_DIMENSIONS
        or not all(type(size) is int and 0 <= size < 2**48 for size in shape)
    ):
        raise ValueError(shape)
    return tuple(shape)
