"""Pictures that travel compressed: JPEG for cameras, PNG for depth and masks.

A publisher encodes in its own call. The bytes of the file are stored and sent as they are, and readers get an array.
simplejpeg encodes and decodes JPEG where it is installed, else Pillow, which is also what PNG needs.
"""

from __future__ import annotations

import io
import struct
from functools import cache
from importlib import import_module
from typing import Any, ClassVar, Self

import numpy as np

from ..errors import BadData, BadType, BadValue
from ..plan.arguments import check_number
from ..plan.documents import PLAIN_ARRAYS
from ..plan.paths import shorten
from .base import BlobShip

# Limits for files of strangers: a few bytes can claim any size, and decoding would take that memory.
_MOST_PIXELS = 1 << 26  # 64 megapixels: fewer than those of which Pillow warns
_MOST_RATIO = 2048  # bytes of an array for each byte of its file: neither format can compress more
_LONGEST_SIDE = 65_500  # pixels: the most that libjpeg takes
_MOST_SEGMENTS = 300  # of a JPEG file before its size is named: texts, previews and colour profiles

_PNG_MAGIC = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
_PNG_HEADER = struct.Struct(">IIBBBBB")  # width, height, bits, colour type; compression, filter, interlace
_PNG_FORMS = {(8, 0): ("uint8", 1), (8, 2): ("uint8", 3), (8, 6): ("uint8", 4), (16, 0): ("uint16", 1)}
"""Bits and colour type -> dtype and channels."""

Form = tuple[str, tuple[int, ...]]
"""The dtype and the shape of the array in a file."""


class EncodedImage:
    """A picture as the bytes of a file: base of `Jpeg` and `Png`.

    Attributes:
        data: The file, as bytes.
        dtype: That of the array: "uint8" or "uint16".
        shape: That of the array: rows, columns, and 3 or 4 channels unless there is one.
    """

    label: ClassVar[str]  # of the ship, and the format in words of Foxglove
    data: bytes
    dtype: str
    shape: tuple[int, ...]

    @classmethod
    def from_file(cls, data: Any) -> Self:
        """Return the picture whose file has these bytes; raises BadData for what is none, or claims too much."""
        it = object.__new__(cls)
        it.data = bytes(data)
        try:
            it.dtype, it.shape = cls._form(it.data)
        except (ValueError, IndexError, struct.error) as error:
            why = error if type(error) is ValueError else "it is cut off"
            raise BadData(f"{len(it.data)} bytes are no {cls.__name__} that can be read: {why}") from None
        return it

    def decode(self) -> np.ndarray[Any, Any]:
        """Return the array, read-only.

        Raises:
            BadData: The file is damaged, or neither simplejpeg nor Pillow is installed.
        """
        try:
            array = self._decoded()
        except BadData:
            raise
        except Exception as error:  # decoders raise anything over bytes that are not what they seem
            raise BadData(f"a {self.__class__.__name__} of {self.summary} is damaged: {error!s:.100}") from None
        if (array.dtype, array.shape) != (np.dtype(self.dtype), self.shape):
            raise BadData(f"a {self.__class__.__name__} of {self.summary} holds {array.dtype}{list(array.shape)}")
        array.flags.writeable = False
        return array

    @property
    def summary(self) -> str:
        """What the array is, such as `uint8[480,640,3]`."""
        return f"{self.dtype}[{','.join(map(str, self.shape))}]"

    @staticmethod
    def _form(data: bytes) -> Form:
        """Return what a file holds by its header; raises ValueError, IndexError or struct.error."""
        raise NotImplementedError

    def _decoded(self) -> np.ndarray[Any, Any]:
        raise NotImplementedError

    def _take(self, image: Any, forms: dict[str, tuple[int, ...]]) -> np.ndarray[Any, Any] | None:
        """Return the array to be encoded, contiguous; None for the bytes of a file, which were taken as they are.

        `forms` are the channels that each dtype may have.
        """
        kind = type(self).__name__
        if isinstance(image, bytes | bytearray | memoryview):
            try:
                found = self.from_file(image)
            except BadData as error:
                raise BadValue(str(error)) from None
            self.data, self.dtype, self.shape = found.data, found.dtype, found.shape
            return None
        if type(image) not in PLAIN_ARRAYS:
            raise BadType(f"{kind} takes an array, or the bytes of a file, not {shorten(image)}; use np.asarray(x)")
        what = f"{kind} of an array {image.dtype}{list(image.shape)}"
        if (allowed := forms.get(image.dtype.newbyteorder("=").name)) is None:
            raise BadType(f"{what}: the dtype is not {' or '.join(forms)}; use .astype, scaled to its range")
        if image.ndim not in (2, 3) or 0 in image.shape:
            raise BadValue(f"{what}: use rows, columns and, if there are several, channels, none of them 0")
        if image.ndim == 3 and image.shape[2] not in allowed:
            channels = ", ".join(map(str, allowed))
            raise BadValue(f"{what}: a {kind} of {image.dtype} has as many channels as one of: {channels}")
        rows, columns = image.shape[:2]
        if rows * columns > _MOST_PIXELS or max(rows, columns) > _LONGEST_SIDE:
            raise BadValue(f"{what}: at most {_MOST_PIXELS} pixels, {_LONGEST_SIDE} a side; send it in parts")
        plane = np.asarray(image[:, :, 0] if image.ndim == 3 and image.shape[2] == 1 else image)
        self.dtype, self.shape = plane.dtype.newbyteorder("=").name, plane.shape
        return np.ascontiguousarray(plane, plane.dtype.newbyteorder("="))

    def __bytes__(self) -> bytes:
        return self.data

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and self.data == other.data

    def __hash__(self) -> int:
        return hash(self.data)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.summary}, {len(self.data)} bytes>"


class Jpeg(EncodedImage):
    """A picture that is stored and sent as JPEG: `robot["camera"] = {"rgb": Jpeg(frame, quality=85), "t": t}`.

    It is encoded at once, on the calling thread, so the frame may change afterwards. Readers get an array of the same
    shape, with the losses of JPEG. `read(raw=True)` returns the `Jpeg` itself.

    Args:
        image: An array of uint8: rows and columns, or these and 1 or 3 channels (red, green, blue; of OpenCV's
            pictures use `frame[:, :, ::-1]`). One channel comes back without its axis. Or the bytes of a JPEG file,
            as cameras give them, which are not encoded again.
        quality: From 1 to 100. 85 is hardly told from the original; colours have half the resolution.

    Raises:
        BadType: Neither an array of uint8 nor bytes, or `quality` is no number.
        BadValue: A shape that JPEG has not, a `quality` out of range, or bytes that are no JPEG file.
        ModuleNotFoundError: Neither simplejpeg nor Pillow is installed: `pip install 'reem-async[images]'`.
    """

    label = "jpeg"

    def __init__(self, image: Any, quality: int = 85) -> None:
        check_number("quality", quality, "use a whole number from 1 to 100", least=1, most=100)
        array = self._take(image, {"uint8": (1, 3)})
        if array is None:
            return
        if (turbo := _module("simplejpeg")) is not None:
            grey = array.ndim == 2
            channels, colours = (array[:, :, np.newaxis], ("GRAY", "Gray")) if grey else (array, ("RGB", "420"))
            self.data = bytes(turbo.encode_jpeg(channels, int(quality), *colours))
        else:
            self.data = _by_pillow(array, "JPEG", quality=int(quality), subsampling="4:2:0")

    @staticmethod
    def _form(data: bytes) -> Form:
        if data[:2] != b"\xff\xd8":
            raise ValueError("it does not begin as a JPEG file")
        place = 2
        for _ in range(_MOST_SEGMENTS):
            if data[place] != 0xFF:
                raise ValueError("its segments are damaged")
            marker = data[place + 1]
            if marker == 0xFF:  # filling
                place += 1
            elif marker == 1 or 0xD0 <= marker <= 0xD7:  # without a length
                place += 2
            elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # the frame: its size
                bits, rows, columns, components = struct.unpack_from(">BHHB", data, place + 4)
                if marker > 0xC2 or bits != 8 or components not in (1, 3):
                    cure = "use baseline or progressive JPEG of 8 bits in grey or RGB, not CMYK"
                    raise ValueError(f"its kind {marker:#x}, of {components} components of {bits} bits; {cure}")
                return _checked("uint8", rows, columns, components, len(data))
            elif marker in (0xD9, 0xDA):
                break
            else:
                place += 2 + max(int.from_bytes(data[place + 2 : place + 4]), 2)
        raise ValueError("it does not say its size")

    def _decoded(self) -> np.ndarray[Any, Any]:
        if (turbo := _module("simplejpeg")) is None:
            return _with_pillow(self.data, "JPEG", "L" if len(self.shape) == 2 else "RGB")
        array: np.ndarray[Any, Any] = turbo.decode_jpeg(self.data, "GRAY" if len(self.shape) == 2 else "RGB")
        return array.reshape(self.shape)


class Png(EncodedImage):
    """A picture that is stored and sent as PNG, exactly: `robot["camera"] = {"depth": Png(depth)}`.

    It is encoded at once, on the calling thread, so the array may change afterwards. Readers get an equal array.
    `read(raw=True)` returns the `Png` itself. Needs Pillow: `pip install 'reem-async[images]'`.

    Args:
        image: An array: uint8 with 1, 3 or 4 channels (red, green, blue, opacity), or uint16 with one. One channel
            comes back without its axis. Or the bytes of such a PNG file, which are not encoded again.
        level: From 0, no compression, to 9; higher is smaller and slower.

    Raises:
        BadType: Neither an array of uint8 or uint16 nor bytes, or `level` is no number.
        BadValue: A shape that PNG has not, a `level` out of range, or bytes that are no such file.
        ModuleNotFoundError: Pillow is not installed.
    """

    label = "png"

    def __init__(self, image: Any, level: int = 1) -> None:
        check_number("level", level, "use a whole number from 0 to 9", most=9)
        array = self._take(image, {"uint8": (1, 3, 4), "uint16": (1,)})
        if array is not None:
            self.data = _by_pillow(array, "PNG", compress_level=int(level))

    @staticmethod
    def _form(data: bytes) -> Form:
        if not data.startswith(_PNG_MAGIC):
            raise ValueError("it does not begin as a PNG file")
        columns, rows, bits, colour, *_ = _PNG_HEADER.unpack_from(data, len(_PNG_MAGIC))
        if (bits, colour) not in _PNG_FORMS:
            kinds = "grey of 8 or 16 bits, RGB or RGBA of 8"
            raise ValueError(f"its pixels are of colour type {colour} and {bits} bits; use {kinds}")
        dtype, channels = _PNG_FORMS[bits, colour]
        return _checked(dtype, rows, columns, channels, len(data))

    def _decoded(self) -> np.ndarray[Any, Any]:
        mode = "" if self.dtype == "uint16" else {2: "L"}.get(len(self.shape), "RGBA"[: self.shape[-1]])
        # Some releases of Pillow read 16 bits as int32.
        return _with_pillow(self.data, "PNG", mode).astype(self.dtype, copy=False)


def _checked(dtype: str, rows: int, columns: int, channels: int, size: int) -> Form:
    pixels = rows * columns
    if not pixels:
        raise ValueError("it has no pixels, or does not say how many")
    if pixels > _MOST_PIXELS or pixels * channels * np.dtype(dtype).itemsize > _MOST_RATIO * size:
        raise ValueError(
            f"it claims {columns}x{rows} pixels; at most {_MOST_PIXELS}, and no more than its bytes can hold"
        )
    return dtype, (rows, columns) if channels == 1 else (rows, columns, channels)


@cache
def _module(name: str) -> Any:
    """Return a module, imported when first needed; None if it is not installed, or not for this numpy."""
    try:
        return import_module(name)
    except ImportError:
        return None


def _by_pillow(array: np.ndarray[Any, Any], kind: str, **options: Any) -> bytes:
    pillow = _module("PIL.Image")
    if pillow is None:
        raise ModuleNotFoundError(_lacking(kind), name="PIL")
    file = io.BytesIO()
    pillow.fromarray(array).save(file, kind, **options)
    return file.getvalue()


def _with_pillow(data: bytes, kind: str, mode: str) -> np.ndarray[Any, Any]:
    pillow = _module("PIL.Image")
    if pillow is None:
        raise BadData(_lacking(kind))
    with pillow.open(io.BytesIO(data), formats=(kind,)) as image:
        return np.array(image.convert(mode) if mode and image.mode != mode else image)


def _lacking(kind: str) -> str:
    needed = "simplejpeg or Pillow" if kind == "JPEG" else "Pillow"
    return f"a picture in {kind} needs {needed}: pip install 'reem-async[images]'"


def codecs() -> dict[str, str]:
    """Return what encodes and decodes each format here: its name and version, "" for nothing."""
    turbo, pillow = _module("simplejpeg"), _module("PIL.Image")
    by_pillow = f"Pillow {pillow.__version__}" if pillow else ""
    return {"JPEG": f"simplejpeg {turbo.__version__}" if turbo else by_pillow, "PNG": by_pillow}


class ImageShip(BlobShip):
    """Base of `JpegShip` and `PngShip`.

    Args:
        raw: Readers get the `Jpeg` or `Png` in place of its array.
    """

    image: ClassVar[type[EncodedImage]]
    carries = np.ndarray
    tolerated = True  # cameras make damaged files, and readers may lack what decodes them

    def __init__(self, raw: bool = False) -> None:
        self._raw = raw

    @property
    def raw(self) -> ImageShip:
        """The same ship for readers that pass pictures on, and do not look into them."""
        return type(self)(raw=True)

    def get_label(self) -> str:
        return self.image.label

    def check_fit(self, value: Any) -> bool:
        return type(value) is self.image

    def describe(self, value: EncodedImage) -> tuple[int, str]:
        return len(value.data), value.summary

    def pack(self, value: EncodedImage) -> tuple[bytes, ...]:
        return (value.data,)

    def unpack(self, blob: Any) -> Any:
        if blob is None:
            raise BadData("the picture is gone from the server (evicted, or removed by a program without REEM)")
        found = self.image.from_file(blob)
        return found if self._raw else found.decode()


class JpegShip(ImageShip):
    """Carries pictures as JPEG, see `Jpeg`."""

    image = Jpeg


class PngShip(ImageShip):
    """Carries pictures as PNG, see `Png`."""

    image = Png
