"""Arrays as PNG: grey, colour, and colour maps for everything else; scaled down to the screen."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from ...errors import BadValue

__all__ = ["LARGEST_SIDE", "MAPS", "Picture", "colours_of", "paint", "range_of", "shrunk"]

# Nine colours each, evenly spaced; what is between is mixed.
_ANCHORS = {
    "grey": ("000000", "ffffff"),
    "viridis": ("440154", "472c7a", "3b518b", "2c718e", "21908d", "27ad81", "5cc863", "aadc32", "fde725"),
    "heat": ("000004", "1f0c48", "550f6d", "88226a", "ba3655", "e35933", "f98c0a", "f9c932", "fcffa4"),
    "turbo": ("30123b", "4662d7", "36aaf9", "1ae4b6", "72fe5e", "c8ef34", "faba39", "f66b19", "7a0403"),
    "signed": ("2166ac", "67a9cf", "d1e5f0", "f7f7f7", "fddbc7", "ef8a62", "b2182b"),
}
MAPS = tuple(_ANCHORS)
"""The names of the colour maps."""

# Magenta: no colour map has it.
_NAN = (255, 0, 255)
# Pixels of a picture that is sent, at most.
LARGEST_SIDE = 4096


@dataclass(frozen=True, slots=True)
class Picture:
    """An array as a picture.

    Attributes:
        png: The file.
        low, high: The numbers that were given the first and the last colour.
        bad: How many numbers are NaN or infinite; they are magenta.
        size: Width and height of the array.
    """

    png: bytes
    low: float
    high: float
    bad: int
    size: tuple[int, int]


def paint(
    plane: np.ndarray[Any, Any],
    colours: str = "grey",
    low: float | None = None,
    high: float | None = None,
    *,
    side: int = 1024,
    bgr: bool = False,
) -> Picture:
    """Return a picture of an array of shape (rows, columns) or (rows, columns, 1, 3 or 4).

    Args:
        plane: Numbers or bools.
        colours: The colour map, one of `MAPS`, where there is one number per pixel.
        low: What is given the first colour; the smallest number if None, 0 for uint8 and bool.
        high: What is given the last colour; the largest number if None, 255 for uint8.
        side: The longer side of the picture is at most so long.
        bgr: The first channel is blue.

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
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(file, "PNG", compress_level=1)
    return Picture(file.getvalue(), low, high, bad, size)


def range_of(plane: np.ndarray[Any, Any], low: float | None, high: float | None) -> tuple[float, float, int]:
    """Return the numbers for the first and the last colour, and how many are not finite."""
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
    """Return numbers from 0 to 255."""
    if plane.dtype == np.uint8 and (low, high) == (0.0, 255.0):
        return plane
    # Halves: the difference of two large floats may be more than the largest float.
    width = (high / 2 - low / 2) or 1.0
    with np.errstate(all="ignore"):
        scaled = (plane.astype(np.float64) / 2 - low / 2) / width * 255.0
    return np.clip(np.nan_to_num(scaled, nan=0.0, posinf=255.0, neginf=0.0) + 0.5, 0, 255).astype(np.uint8)


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
