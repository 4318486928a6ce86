"""Numpy arrays: each is an .npy file on the server, the format of numpy.save.

So `redis-cli GET '{foo}.image' > image.npy` gives a file that numpy.load opens. One string and not
a hash, since servers copy what goes into and comes out of hashes.

What comes from the server is checked before it is used: the header is parsed as a literal, the
dtype is built from an allow-list of plain data types, and shape times item size must be exactly the
bytes that are there. Nothing is evaluated or unpickled.
"""

from __future__ import annotations

import ast
import contextlib
import math
import re
from functools import lru_cache
from typing import Any

import numpy as np

from ..errors import BadData, BadType
from ..plan.documents import PLAIN_ARRAYS
from .base import BlobShip

# The .npy format, as numpy.lib.format describes it: magic, version (two bytes), length of the header (two bytes in
# version 1, four later, little-endian), the header as a Python literal, the data.
_MAGIC = b"\x93NUMPY"
_KINDS = "biufcSUVMm"
# Byte order, kind, item size, and for dates and durations a unit: "<f8", "|S10", "<M8[10us]".
_CODE = re.compile(r"[<>|=][biufcSUVMm]\d{1,9}(\[\d{0,9}[a-zA-Zμ]{1,2}\])?")
# Limits for foreign arrays: they bound the memory and the recursion that a header can cost.
_MOST_FIELDS = 1000
_MOST_COMMAS = 8 * _MOST_FIELDS  # a name, a type and a shape of five dimensions for each field
_MOST_DIMENSIONS = 64  # numpy's own limit
_DEEPEST = 30  # types in types
_LARGEST_ITEM = 1 << 20  # bytes: a record of many fields, or a long text
_LARGEST_HEADER = 1 << 16  # bytes: enough for a thousand fields
_WIDEST = {"f": 8, "c": 16}  # long doubles differ from machine to machine
_TRIES = 100  # to parse a header in Python 3.11, see `_literal`
_SHORT = 1 << 9  # bytes of a header of which 1024 are cached; of longer ones 16, see below
_SMALL = 1 << 12  # bytes of data up to which copying them costs less than handling two pieces


class NumpyShip(BlobShip):
    """Carries numpy arrays of every dtype that is data: all but object, StringDType and long double.

    Arrays come back C-contiguous, of the same dtype (byte order, field names and time units
    included) and shape, bit for bit, and read-only: they share memory with the reply. memmap, matrix and
    recarray come back as plain arrays. Other subclasses, such as masked arrays and astropy's Quantity, may hold
    more than their items: they are left to a ship of their own, and refused if there is none.
    """

    carries = np.ndarray

    def get_label(self) -> str:
        return "numpy"

    def check_fit(self, value: Any) -> bool:
        return type(value) in PLAIN_ARRAYS

    def describe(self, value: np.ndarray[Any, Any]) -> tuple[int, str]:
        return value.nbytes, _summary(value.dtype, value.shape)

    def pack(self, value: np.ndarray[Any, Any]) -> tuple[Any, ...]:
        # An .npy file: small in one piece, else header and data apart, since joining them would copy all of the data.
        header = _header(value.dtype, value.shape)
        return (header + value.tobytes(),) if value.nbytes <= _SMALL else (header, flat(value))

    def unpack(self, blob: Any) -> np.ndarray[Any, Any]:
        if blob is None:
            raise BadData("the array's bytes are gone from the server (evicted, or removed by a program without REEM)")
        view = memoryview(blob)
        size = _header_size(bytes(view[:12]), len(view))
        dtype, shape = (_parse_short if size <= _SHORT else _parse_long)(bytes(view[:size]))
        # Python's integers do not overflow, unlike numpy's, for a made-up shape.
        if math.prod(shape) * dtype.itemsize != len(view) - size:
            raise BadData(f"an array of {dtype} {list(shape)} has {len(view) - size} bytes; REEM did not write it")
        try:
            array = (
                # frombuffer refuses an empty buffer.
                np.frombuffer(view, dtype, offset=size).reshape(shape) if len(view) > size else np.empty(shape, dtype)
            )
        except ValueError as error:
            raise BadData(f"an array has the shape {list(shape)}, which cannot be: {error}") from None
        # The reply may be in a cache or belong to other arrays too.
        array.flags.writeable = False
        return array


def flat(array: np.ndarray[Any, Any]) -> memoryview | bytes:
    """Return the array's data, in C order, as a flat buffer of bytes; copies only if necessary.

    All outgoing buffers are made here: if len() were not the size in bytes, the server would be sent a wrong length and
    read the rest of the data as commands.
    """
    if array.nbytes == 0:
        return b""
    # As bytes, since numpy exports no buffer of some dtypes (datetime64).
    view = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
    if len(view) != array.nbytes or view.nbytes != array.nbytes:
        raise BadType(f"{array.dtype} has no flat bytes")
    return view


def flat_buffer(word: Any) -> Any:
    """Return `word` ready to be sent if it is a buffer, else as it is."""
    if isinstance(word, np.ndarray):
        return flat(word)
    if isinstance(word, memoryview | bytearray):
        view = memoryview(word)
        return view.cast("B") if view.c_contiguous and view.nbytes else view.tobytes()
    return word


@lru_cache(maxsize=1024)
def _summary(dtype: np.dtype[Any], shape: tuple[int, ...]) -> str:
    """Return text such as `float64[640,480,3]`; raise BadType for what cannot be carried."""
    _header(dtype, shape)
    return f"{_dtype_name(dtype)}[{','.join(map(str, shape))}]"


def _dtype_name(dtype: np.dtype[Any]) -> str:
    if dtype.names is None:
        return str(dtype)
    text = ",".join(f"{name}:{dtype[name]}" for name in dtype.names)
    return f"struct({text[:60]}{'...' if len(text) > 60 else ''})"


@lru_cache(maxsize=1024)
def _header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """Return the header of an .npy file: magic, version, length, a Python literal, blanks up to 64 bytes."""
    text = f"{{'descr': {_descr(dtype)!r}, 'fortran_order': False, 'shape': {shape!r}, }}"
    data = text.encode()
    # Version 1 is what all readers know. Version 3 says that the header is UTF-8 (names of fields), or is a long one.
    version, length_size = (b"\x01\x00", 2) if text.isascii() and len(data) < 60_000 else (b"\x03\x00", 4)
    size = -(-(len(_MAGIC) + 2 + length_size + len(data) + 1) // 64) * 64
    length = size - len(_MAGIC) - 2 - length_size
    if size > _LARGEST_HEADER or text.count(",") > _MOST_COMMAS:
        raise BadType(f"the dtype {str(dtype)[:60]}... is too long to be read back; use fewer fields or shorter names")
    return _MAGIC + version + length.to_bytes(length_size, "little") + data.ljust(length - 1) + b"\n"


def _descr(dtype: np.dtype[Any]) -> Any:
    """Return numpy's description of a dtype; raise BadType if it is not plain data or would come back different."""
    if dtype.hasobject or dtype.kind not in _KINDS:
        raise BadType(
            f"an array of dtype {dtype} holds Python objects, not data; use .tolist() or another dtype "
            "(for strings: astype('U'))"
        )
    try:
        descr = np.lib.format.dtype_to_descr(dtype)
        # Checked by parsing it again: some dtypes lose padding or overlapping fields in their description.
        same = _dtype(descr) == dtype
    except (TypeError, ValueError):
        same = False
    if not same:
        raise BadType(_inexact(dtype))
    return descr


def _inexact(dtype: np.dtype[Any]) -> str:
    if dtype.kind in _WIDEST and dtype.names is None:
        narrower = f"np.{'complex128' if dtype.kind == 'c' else 'float64'}"
        return f"the dtype {dtype} (long double) differs between machines; use np.asarray(x, {narrower})"
    return f"the dtype {dtype} cannot be stored exactly (long double, overlapping fields, ...); use astype"


def _header_size(start: bytes, length: int) -> int:
    """Return how many bytes come before the data, of an .npy file of `length` bytes that begins with `start`."""
    # Byte 6 is the major version, byte 7 the minor one, which is always 0.
    if len(start) < 10 or not start.startswith(_MAGIC) or start[6] not in (1, 2, 3) or start[7] != 0:
        raise BadData(f"an array begins with {start!r}; REEM did not write it")
    before = 10 if start[6] == 1 else 12
    size = before + int.from_bytes(start[8:before], "little")
    if size > length or size > _LARGEST_HEADER:
        raise BadData("an array's header is longer than the array; REEM did not write it")
    return size


def _parse_header(header: bytes) -> tuple[np.dtype[Any], tuple[int, ...]]:
    """Return dtype and shape from the header of an .npy file, checked; raises BadData."""
    try:
        text = header[10 if header[6] == 1 else 12 :].decode("utf-8" if header[6] == 3 else "latin-1")
        fields = _literal(text)
        # Arrays in Fortran order are not written by REEM: reading them would need a copy or strides.
        if set(fields) != {"descr", "fortran_order", "shape"} or fields["fortran_order"] is not False:
            raise ValueError(fields)
        return _dtype(fields["descr"]), _check_shape(fields["shape"])
    except (TypeError, ValueError, KeyError, IndexError, SyntaxError, RecursionError, MemoryError, OverflowError):
        raise BadData(f"an array has the header {header[10:100]!r}, which is not that of plain data") from None


# A structured dtype may take 60 KB to describe: only few of these are cached, or foreign arrays could fill the memory.
_parse_short, _parse_long = lru_cache(maxsize=1024)(_parse_header), lru_cache(maxsize=16)(_parse_header)


def _literal(text: str) -> Any:
    """Return the value of a Python literal.

    Python 3.11 raises SystemError at times when several threads parse (https://github.com/python/cpython/issues/106905).
    """
    if text.count(",") > _MOST_COMMAS:  # 64 KB of numbers would take 90 ms
        raise ValueError(text)
    for _ in range(_TRIES):
        with contextlib.suppress(SystemError):
            return ast.literal_eval(text)
    raise ValueError(text)


def _dtype(descr: Any) -> np.dtype[Any]:
    """Return the dtype of a description, built from an allow-list; raises ValueError or TypeError."""
    dtype: np.dtype[Any] = np.lib.format.descr_to_dtype(_checked(descr, [0], 0))
    # Items of no bytes would let a few bytes claim any number of them.
    if dtype.hasobject or not 0 < dtype.itemsize <= _LARGEST_ITEM or dtype.kind not in _KINDS:
        raise ValueError(descr)
    return dtype


def _checked(descr: Any, fields: list[int], depth: int) -> Any:
    if isinstance(descr, str):
        if not _CODE.fullmatch(descr) or int(re.findall(r"\d+", descr)[0]) > _WIDEST.get(descr[1], _LARGEST_ITEM):
            raise ValueError(descr)
        return descr
    if not isinstance(descr, list) or depth > _DEEPEST:
        raise TypeError(descr)
    return [_checked_field(field, fields, depth + 1) for field in descr]


def _checked_field(field: Any, fields: list[int], depth: int) -> tuple[Any, ...]:
    fields[0] += 1
    if fields[0] > _MOST_FIELDS or not isinstance(field, tuple) or len(field) not in (2, 3):
        raise ValueError(field)
    name, descr, *shape = field
    names = name if isinstance(name, tuple) else (name,)
    if len(names) > 2 or not all(isinstance(text, str) for text in names):
        raise ValueError(name)
    checked = (name, _checked(descr, fields, depth))
    return (*checked, _check_shape(shape[0])) if shape else checked


def _check_shape(shape: Any) -> tuple[int, ...]:
    if (
        not isinstance(shape, tuple)
        or len(shape) > _MOST_DIMENSIONS
        or not all(type(size) is int and 0 <= size < 2**48 for size in shape)
    ):
        raise ValueError(shape)
    return shape
