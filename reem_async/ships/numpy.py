"""Numpy arrays: each is an .npy file on the server, the format of numpy.save.

So `redis-cli GET '{foo}.image' > image.npy` gives a file that numpy.load opens. One string and not
a hash, since servers copy what goes into and comes out of hashes.

What comes from the server is checked before it is used: the header is parsed as a literal, the
dtype is built from an allow-list of plain data types, and shape times item size must be exactly the
bytes that are there. Nothing is evaluated or unpickled.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from ..errors import BadData, BadType
from .base import BlobShip

__all__ = ["NumpyShip", "flat", "flat_buffer"]

_MAGIC = b"\x93NUMPY"
_KINDS = "biufcSUVMm"
_CODE = re.compile(r"[<>|=][biufcSUVMm]\d{1,9}(\[\d{0,9}[a-zA-Zμ]{1,2}\])?")
_MOST_FIELDS = 1000
_MOST_DIMENSIONS = 64
_LARGEST_ITEM = 1 << 20
_LARGEST_HEADER = 1 << 16
_WIDEST = {"f": 8, "c": 16}  # long doubles differ from machine to machine
# All that a header is made of: strings, short integers, two words, brackets. No names, operators or f-strings
# reach Python's parser, which may need very long over them.
_HEADER = re.compile(
    r"""(?:'(?:[^'\\\n]|\\.)*'|"(?:[^"\\\n]|\\.)*"|\d{1,15}(?![\w'"])|True|False|[\[\](){},:]|[ ]|\n)++"""
)
_QUOTED = re.compile(r"""'(?:[^'\\\n]|\\.)*'|"(?:[^"\\\n]|\\.)*\"""")
_DEEPEST = 64
_SHORT = 1 << 9
_SMALL = 1 << 12
"""Bytes of data up to which copying them costs less than handling two pieces."""


class NumpyShip(BlobShip):
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
        return value.nbytes, _summary(value.dtype, value.shape)

    def pack(self, value: np.ndarray[Any, Any]) -> tuple[Any, ...]:
        """Return an .npy file: small in one piece, else the header and the data, shared with a contiguous array."""
        header = _header(value.dtype, value.shape)
        return (header + value.tobytes(),) if value.nbytes <= _SMALL else (header, flat(value))

    def unpack(self, blob: Any) -> np.ndarray[Any, Any]:
        """Return the array, read-only, sharing memory with `blob`."""
        if blob is None:
            raise BadData("the array's bytes are gone from the server (evicted, or removed by a program without REEM)")
        view = memoryview(blob)
        size = _header_size(bytes(view[:12]), len(view))
        dtype, shape = _header_parser(size)(bytes(view[:size]))
        if math.prod(shape) * dtype.itemsize != len(view) - size:
            raise BadData(f"an array of {dtype} {list(shape)} has {len(view) - size} bytes; REEM did not write it")
        try:
            array = (
                np.frombuffer(view, dtype, offset=size).reshape(shape) if len(view) > size else np.empty(shape, dtype)
            )
        except ValueError as error:
            raise BadData(f"an array has the shape {list(shape)}, which cannot be: {error}") from None
        array.flags.writeable = False
        return array


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
    version, length_size = (b"\x01\x00", 2) if text.isascii() and len(data) < 60_000 else (b"\x03\x00", 4)
    size = -(-(len(_MAGIC) + 2 + length_size + len(data) + 1) // 64) * 64
    length = size - len(_MAGIC) - 2 - length_size
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
        same = _dtype(descr) == dtype
    except (TypeError, ValueError):
        same = False
    if not same:
        raise BadType(f"the dtype {dtype} cannot be stored exactly (long double, overlapping fields, ...); use astype")
    return descr


def _header_size(start: bytes, length: int) -> int:
    """Return how many bytes come before the data, of an .npy file of `length` bytes that begins with `start`."""
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
        # A field has up to three pairs of round brackets: its own, and those of a title and a shape.
        if text.count("(") > 3 * _MOST_FIELDS + 1 or not _HEADER.fullmatch(text) or _depth(text) > _DEEPEST:
            raise ValueError(text)
        fields = ast.literal_eval(text)
        if set(fields) != {"descr", "fortran_order", "shape"} or fields["fortran_order"] is not False:
            raise ValueError(fields)
        return _dtype(fields["descr"]), _check_shape(fields["shape"])
    except (SyntaxError, TypeError, ValueError, KeyError, IndexError, RecursionError, MemoryError, OverflowError):
        raise BadData(f"an array has the header {header[10:100]!r}, which is not that of plain data") from None


# A structured dtype may take 60 KB to describe: few of these are kept, or a stranger could fill the memory.
_parse_short, _parse_long = lru_cache(maxsize=1024)(_parse_header), lru_cache(maxsize=16)(_parse_header)


def _header_parser(size: int) -> Callable[[bytes], tuple[np.dtype[Any], tuple[int, ...]]]:
    """Return what parses a header of `size` bytes and remembers the outcome."""
    return _parse_short if size <= _SHORT else _parse_long


def _depth(text: str) -> int:
    """Return how deep brackets are nested, text in quotes left aside."""
    depth = deepest = 0
    for character in _QUOTED.sub("", text):
        if character in "([{":
            depth += 1
            deepest = max(deepest, depth)
        elif character in ")]}":
            depth -= 1
    return deepest


def _dtype(descr: Any) -> np.dtype[Any]:
    """Return the dtype of a description, built from an allow-list; raises ValueError or TypeError."""
    dtype: np.dtype[Any] = np.lib.format.descr_to_dtype(_checked(descr, [0]))
    # Items of no bytes would let a few bytes claim any number of them.
    if dtype.hasobject or not 0 < dtype.itemsize <= _LARGEST_ITEM or dtype.kind not in _KINDS:
        raise ValueError(descr)
    return dtype


def _checked(descr: Any, fields: list[int]) -> Any:
    """Return `descr`, refusing all but plain data."""
    if isinstance(descr, str):
        if not _CODE.fullmatch(descr) or int(re.findall(r"\d+", descr)[0]) > _WIDEST.get(descr[1], _LARGEST_ITEM):
            raise ValueError(descr)
        return descr
    if not isinstance(descr, list):
        raise TypeError(descr)
    return [_checked_field(field, fields) for field in descr]


def _checked_field(field: Any, fields: list[int]) -> tuple[Any, ...]:
    fields[0] += 1
    if fields[0] > _MOST_FIELDS or not isinstance(field, tuple) or len(field) not in (2, 3):
        raise ValueError(field)
    name, descr, *shape = field
    names = name if isinstance(name, tuple) else (name,)
    if len(names) > 2 or not all(isinstance(text, str) for text in names):
        raise ValueError(name)
    checked = (name, _checked(descr, fields))
    return (*checked, _check_shape(shape[0])) if shape else checked


def _check_shape(shape: Any) -> tuple[int, ...]:
    if (
        not isinstance(shape, tuple)
        or len(shape) > _MOST_DIMENSIONS
        or not all(type(size) is int and 0 <= size < 2**48 for size in shape)
    ):
        raise ValueError(shape)
    return shape
