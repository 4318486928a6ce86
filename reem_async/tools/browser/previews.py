"""Small pictures of arrays: what is kept of them where there is no room for the whole."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from .pictures import Picture, paint, range_of, shrunk
from .slices import Slice, look_at, part

__all__ = ["Preview", "preview_of"]

_SIDE = 320
"""Pixels of the longer side: a quarter of those of a camera's 640 x 480."""

# Of JPEG, 1 to 95: a preview is to be small, and stands for what is not kept.
_QUALITY = 80
_LEVELS = 254
"""Levels of a number; one more, the first, stands for what is not finite."""


@dataclass(frozen=True, slots=True)
class Preview:
    """A small picture of an array.

    Attributes:
        file: A JPEG file of bytes, a PNG file of anything else: its numbers in 254 levels from `low` to `high`.
        dtype, shape: Those of the array.
        chosen: The part of the array that it shows: what a view begins with.
        low, high: The range of the numbers in that part.
        bad: How many of them are NaN or infinite.
    """

    file: bytes
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    chosen: Slice
    low: float
    high: float
    bad: int

    def paint(self, colours: str, low: float | None, high: float | None, *, side: int, bgr: bool) -> Picture:
        """Return the picture, as `pictures.paint` would make it of the array; raises BadValue."""
        low, high = self.low if low is None else low, self.high if high is None else high
        found = paint(self._pixels(), colours, low, high, side=side, bgr=bgr)
        axes = [size for size, index in zip(self.shape, self.chosen, strict=True) if index is None]
        return Picture(found.png, found.low, found.high, self.bad, (axes[1], axes[0]))

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
        Image.fromarray(_levels(shrunk(plane, _SIDE), low, high)).save(file, "PNG", compress_level=3)
    small = file.getvalue()
    # A preview that is not much smaller than its array is no help.
    return Preview(small, array.dtype, array.shape, chosen, low, high, bad) if len(small) < array.nbytes // 2 else None


def _levels(plane: np.ndarray[Any, Any], low: float, high: float) -> np.ndarray[Any, Any]:
    numbers = plane.astype(np.float64)
    with np.errstate(all="ignore"):
        scaled = (numbers / 2 - low / 2) / ((high / 2 - low / 2) or 1.0) * _LEVELS
    levels = np.clip(np.nan_to_num(scaled) + 0.5, 0, _LEVELS).astype(np.uint8) + np.uint8(1)
    return np.ascontiguousarray(np.where(np.isfinite(numbers), levels, np.uint8(0)))
