"""Arrays as pictures: which part of one is shown, PNG files with colour maps, and the small pictures that are kept."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from ...errors import BadValue

# The part of an array that a view shows: one index or a colon for each axis.


Slice = tuple[int | None, ...]
"""For each axis an index, or None for all of it."""

_INDEX = re.compile(r"-?\d{1,12}")
_SMALL = 16  # rows and columns up to which an array is read as numbers
_MOST_CURVES = 16  # columns up to which an array is drawn as lines


@dataclass(frozen=True, slots=True)
class ArrayViews:
    view: str  # what says most: "image", "line" or "table"; empty for an array without items
    views: dict[str, Slice]  # all that make sense, each with the part of the array it begins with


def look_at(dtype: np.dtype[Any], shape: tuple[int, ...]) -> ArrayViews:
    if 0 in shape:
        return ArrayViews("", {})
    if not shape:
        return ArrayViews("table", {"table": ()})
    numeric = dtype.kind in "biuf"
    views: dict[str, Slice] = {}
    # The order is that of the tabs of the page.
    if numeric and len(shape) >= 2:
        views["image"] = _leading(shape, 3 if _has_channels(shape) else 2)
    if numeric:
        views["line"] = _line_slice(shape)
    views["table"] = _leading(shape, 2) if not _has_channels(shape) else (None, None, 0)[-len(shape) :]
    if _has_channels(shape) and len(shape) > 3:
        views["table"] = (*[0] * (len(shape) - 3), None, None, 0)
    if numeric:
        views["histogram"] = (None,) * len(shape)
    return ArrayViews(_best(shape, views), views)


def _best(shape: tuple[int, ...], views: dict[str, Slice]) -> str:
    size = shape[-3:-1] if _has_channels(shape) else shape[-2:]
    if "image" in views and min(size) >= _SMALL:
        return "image"
    narrow = len(shape) == 1 or (len(shape) == 2 and shape[1] <= _MOST_CURVES)
    return "line" if "line" in views and narrow and shape[0] > _SMALL else "table"


def _has_channels(shape: tuple[int, ...]) -> bool:
    return len(shape) >= 3 and shape[-1] in (1, 3, 4) and min(shape[-3:-1]) > 1


def _line_slice(shape: tuple[int, ...]) -> Slice:
    if _has_channels(shape):  # the channels along the row in the middle
        return (*[0] * (len(shape) - 3), shape[-3] // 2, None, None)
    if len(shape) >= 2 and shape[-1] <= _MOST_CURVES:
        return _leading(shape, 2)
    return (*[size // 2 for size in shape[:-2]], *([shape[-2] // 2] if len(shape) > 1 else []), None)


def _leading(shape: tuple[int, ...], free: int) -> Slice:
    fixed = max(len(shape) - free, 0)
    return (*[0] * fixed, *[None] * (len(shape) - fixed))


def parse_slice(text: str, shape: tuple[int, ...], most_free: int) -> Slice:
    """Return the part that `text` names, such as "0,:,:".

    Raises BadValue unless it has a colon or an index for each axis, within it, and `most_free` colons at most.
    """
    words = [word.strip() for word in text.split(",")] if text.strip() else []
    if len(words) != len(shape):
        raise BadValue(f"the slice {text[:40]!r} has {len(words)} parts, the array has {len(shape)} axes")
    found: list[int | None] = []
    for word, size in zip(words, shape, strict=True):
        if word == ":":
            found.append(None)
        elif _INDEX.fullmatch(word) and -size <= int(word) < size:
            found.append(int(word))
        else:
            raise BadValue(f"the slice has {word[:20]!r} for an axis of {size} items; use : or a number below {size}")
    if found.count(None) > most_free:
        raise BadValue(f"the slice {text[:40]!r} leaves {found.count(None)} axes; this view shows {most_free} at most")
    return tuple(found)


def part(array: np.ndarray[Any, Any], chosen: Slice) -> np.ndarray[Any, Any]:
    view: np.ndarray[Any, Any] = array[tuple([slice(None) if index is None else index for index in chosen])]
    return np.asarray(view)


# PNG: grey, colour, and colour maps for everything else; scaled down to the screen.


# Nine colours each, evenly spaced; what is between is mixed.
_ANCHORS = {
    "grey": ("000000", "ffffff"),
    "viridis": ("440154", "472c7a", "3b518b", "2c718e", "21908d", "27ad81", "5cc863", "aadc32", "fde725"),
    "heat": ("000004", "1f0c48", "550f6d", "88226a", "ba3655", "e35933", "f98c0a", "f9c932", "fcffa4"),
    "turbo": ("30123b", "4662d7", "36aaf9", "1ae4b6", "72fe5e", "c8ef34", "faba39", "f66b19", "7a0403"),
    "signed": ("2166ac", "67a9cf", "d1e5f0", "f7f7f7", "fddbc7", "ef8a62", "b2182b"),
}
MAPS = tuple(_ANCHORS)  # the names of the colour maps
_NAN = (255, 0, 255)  # magenta: no colour map has it
LARGEST_SIDE = 4096  # pixels of a picture that is sent, at most


@dataclass(frozen=True, slots=True)
class RenderedPicture:
    """An array as a picture.

    Attributes:
        low, high: The numbers that were given the first and the last colour.
    """

    file: bytes  # PNG, or JPEG where `coarse` allows that
    low: float
    high: float
    bad: int  # how many numbers are NaN or infinite; they are magenta
    size: tuple[int, int]  # width and height of the array


def paint(
    plane: np.ndarray[Any, Any],
    colours: str = "grey",
    low: float | None = None,
    high: float | None = None,
    *,
    side: int = 1024,
    bgr: bool = False,
    coarse: bool = False,
) -> RenderedPicture:
    """Return a picture of an array of shape (rows, columns) or (rows, columns, 1, 3 or 4).

    Args:
        plane: Numbers or bools.
        colours: The colour map, one of `MAPS`, where there is one number per pixel.
        low: What is given the first colour; the smallest number if None, 0 for uint8 and bool.
        high: What is given the last colour; the largest number if None, 255 for uint8.
        side: The longer side of the picture is at most so long.
        bgr: The first channel is blue.
        coarse: A colour picture that is made smaller may be a JPEG, which takes a fifth of the time of a PNG.

    Raises:
        BadValue: Another shape or dtype, or an unknown colour map.
    """
    lookup = _lookup(colours)
    if plane.ndim == 3 and plane.shape[2] == 1:
        plane = plane[:, :, 0]
    if plane.ndim not in (2, 3) or plane.dtype.kind not in "biuf" or 0 in plane.shape:
        raise BadValue(f"an array of {plane.dtype} {list(plane.shape)} is no picture; show it as a table")
    if plane.ndim == 3 and plane.shape[2] not in (3, 4):
        raise BadValue(f"a picture has 1, 3 or 4 channels, not {plane.shape[2]}; choose one with an index")
    size = plane.shape[1], plane.shape[0]
    # Of the whole array, before it is made smaller: the range must not depend on the size of the window.
    low, high, bad = range_of(plane, low, high)
    small = shrunk(plane, max(1, min(side, LARGEST_SIDE)))
    pixels = _levels(small, low, high)
    if plane.ndim == 2:
        pixels = lookup[pixels]
    elif bgr:
        pixels = np.concatenate([pixels[:, :, 2::-1], pixels[:, :, 3:]], axis=2)
    if small.dtype.kind == "f":
        _mark(pixels, small)
    file, image = io.BytesIO(), Image.fromarray(np.ascontiguousarray(pixels))
    if coarse and plane.ndim == 3 and plane.dtype == np.uint8 and image.mode == "RGB" and small is not plane:
        image.save(file, "JPEG", quality=_COARSE_QUALITY)
    else:
        image.save(file, "PNG", compress_level=1)
    return RenderedPicture(file.getvalue(), low, high, bad, size)


def range_of(plane: np.ndarray[Any, Any], low: float | None, high: float | None) -> tuple[float, float, int]:
    bad = 0
    if plane.dtype == np.uint8 or plane.dtype == np.bool_:
        least, most = 0.0, 255.0 if plane.dtype == np.uint8 else 1.0
    elif plane.dtype.kind == "f":
        finite = np.isfinite(plane)
        bad = plane.size - int(np.count_nonzero(finite))
        least = float(np.min(plane, where=finite, initial=np.inf))
        most = float(np.max(plane, where=finite, initial=-np.inf))
        if bad == plane.size:
            least, most = 0.0, 1.0
    else:
        least, most = float(plane.min()), float(plane.max())
    return least if low is None else low, most if high is None else high, bad


def shrunk(plane: np.ndarray[Any, Any], side: int) -> np.ndarray[Any, Any]:
    """Return the plane with no side longer than `side`: bytes are averaged, all else is sampled."""
    longest = max(plane.shape[:2])
    if longest <= side:
        return plane
    step = -(-longest // side)
    if plane.dtype == np.uint8:
        # Averaging makes small pictures of cameras smooth; averages of other numbers would be numbers that are not
        # there.
        return np.asarray(Image.fromarray(np.ascontiguousarray(plane)).reduce(step))
    return plane[::step, ::step]


def _levels(plane: np.ndarray[Any, Any], low: float, high: float) -> np.ndarray[Any, Any]:
    return plane if plane.dtype == np.uint8 and (low, high) == (0.0, 255.0) else _scaled(plane, low, high, 255)


def _scaled(plane: np.ndarray[Any, Any], low: float, high: float, most: int) -> np.ndarray[Any, Any]:
    """Return numbers from 0 for `low` to `most` for `high`; 0 for NaN."""
    # Halves: the difference of two large floats may be more than the largest float.
    width = (high / 2 - low / 2) or 1.0
    with np.errstate(all="ignore"):
        scaled = (plane.astype(np.float64) / 2 - low / 2) / width * most
    return np.clip(np.nan_to_num(scaled, nan=0.0, posinf=most, neginf=0.0) + 0.5, 0, most).astype(np.uint8)


def _mark(pixels: np.ndarray[Any, Any], plane: np.ndarray[Any, Any]) -> None:
    bad = ~np.isfinite(plane)
    if bad.ndim == 3:
        bad = bad.any(axis=2)
    pixels[bad, :3] = _NAN
    if pixels.shape[2] == 4:
        pixels[bad, 3] = 255


def _lookup(colours: str) -> np.ndarray[Any, Any]:
    """Return the 256 colours of a map; raise BadValue if there is none of that name."""
    if colours not in _ANCHORS:
        raise BadValue(f"there is no colour map {colours[:20]!r}; use one of {', '.join(MAPS)}")
    anchors = np.array([list(bytes.fromhex(text)) for text in _ANCHORS[colours]], np.float64)
    at, places = np.linspace(0, 1, 256), np.linspace(0, 1, len(anchors))
    return (
        np.stack([np.interp(at, places, anchors[:, channel]) for channel in range(3)], axis=1).round().astype(np.uint8)
    )


def colours_of(colours: str) -> list[str]:
    """Return 64 colours of a map, from its low to its high end, as CSS writes them; raises BadValue."""
    return [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in _lookup(colours)[1::4].tolist()]


# Previews: what is kept of an array if there is no room for the whole.

_SIDE = 320  # pixels of the longer side: a quarter of those of a camera's 640 x 480

_COARSE_QUALITY = 90  # of JPEG, of pictures in panes
# Of JPEG, 1 to 95: a preview is to be small, and stands for what is not kept.
_QUALITY = 80
_LEVELS = 254  # levels of a number; one more, the first, stands for what is not finite


@dataclass(frozen=True, slots=True)
class Preview:
    """A small picture of an array.

    Attributes:
        dtype, shape: Those of the array.
        low, high: The range of the numbers in that part.
    """

    file: bytes  # a JPEG file of bytes, a PNG file of anything else: its numbers in 254 levels from `low` to `high`
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    chosen: Slice  # the part of the array that it shows: what a view begins with
    low: float
    high: float
    bad: int  # how many of them are NaN or infinite

    def paint(self, colours: str, low: float | None, high: float | None, *, side: int, bgr: bool) -> RenderedPicture:
        """Return the picture, as `pictures.paint` would make it of the array; raises BadValue."""
        low, high = self.low if low is None else low, self.high if high is None else high
        found = paint(self._pixels(), colours, low, high, side=side, bgr=bgr)
        axes = [size for size, index in zip(self.shape, self.chosen, strict=True) if index is None]
        return RenderedPicture(found.file, found.low, found.high, self.bad, (axes[1], axes[0]))

    def _pixels(self) -> np.ndarray[Any, Any]:
        pixels = np.asarray(Image.open(io.BytesIO(self.file)))
        if self.dtype == np.uint8:
            return pixels
        # Halves: the difference of two large floats may be more than the largest float.
        part = np.maximum(pixels.astype(np.float64) - 1, 0) / _LEVELS
        numbers = 2 * (self.low / 2 + part * (self.high / 2 - self.low / 2))
        return np.where(pixels == 0, np.nan, numbers)


def preview_of(array: np.ndarray[Any, Any]) -> Preview | None:
    """Return a small picture of an array, None of one that is no picture or not larger than its preview."""
    look = look_at(array.dtype, array.shape)
    if look.view != "image":
        return None
    chosen = look.views["image"]
    plane = part(array, chosen)
    if plane.ndim == 3 and plane.shape[2] == 1:
        plane = plane[:, :, 0]
    low, high, bad = range_of(plane, None, None)
    file = io.BytesIO()
    # A camera's picture compresses well as JPEG; numbers must come back as numbers, so they are PNG in levels.
    if plane.dtype == np.uint8:
        image = Image.fromarray(np.ascontiguousarray(shrunk(plane, _SIDE)))
        image.save(file, "PNG" if image.mode == "RGBA" else "JPEG", quality=_QUALITY)  # JPEG has no transparency
    else:
        small = shrunk(plane, _SIDE)
        levels = np.where(np.isfinite(small), _scaled(small, low, high, _LEVELS) + np.uint8(1), np.uint8(0))
        Image.fromarray(np.ascontiguousarray(levels)).save(file, "PNG", compress_level=3)
    found = Preview(file.getvalue(), array.dtype, array.shape, chosen, low, high, bad)
    # A preview that is not much smaller than its array is no help.
    return found if len(found.file) < array.nbytes // 2 else None
