"""Arrays as tables, lines and histograms: as much of them as a screen has room for."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...errors import BadValue
from .nodes import shown_text

__all__ = ["cell", "histogram", "line", "statistics", "table"]

# Of a table that is sent at once.
MOST_ROWS, MOST_COLUMNS = 200, 64
# Of a line: about as many as a screen has pixels.
_POINTS = 1000
# Curves in one plot: of more columns nobody can tell one from the other.
_MOST_CURVES = 16
# Numbers that histograms and statistics look at; of larger arrays an even selection.
_SAMPLE = 4_000_000


def table(plane: np.ndarray[Any, Any], row: int, column: int, rows: int, columns: int) -> dict[str, Any]:
    """Return some rows and columns of an array of at most two axes, as text."""
    if plane.ndim > 2:
        raise BadValue(f"a table shows two axes, not {plane.ndim}; choose the others with an index")
    grid = plane.reshape(-1, 1) if plane.ndim == 1 else plane.reshape(1, 1) if plane.ndim == 0 else plane
    row, column = _start(row, grid.shape[0]), _start(column, grid.shape[1])
    cut = grid[row : row + min(rows, MOST_ROWS), column : column + min(columns, MOST_COLUMNS)]
    return {
        "shape": list(grid.shape),
        "row": row,
        "column": column,
        "columns": cut.shape[1],
        "cells": [[cell(item) for item in items] for items in cut],
    }


def _start(wanted: int, size: int) -> int:
    return max(0, min(wanted, size - 1))


def cell(item: Any) -> str:
    """Return one item of an array as text: numbers with all their digits, of which the page shows six."""
    if isinstance(item, np.floating):
        return str(item).removesuffix(".0")
    if isinstance(item, np.complexfloating):
        return f"{complex(item):.5g}"
    if isinstance(item, np.integer) and not isinstance(item, np.timedelta64):
        return str(int(item))
    if isinstance(item, np.bool_):
        return "true" if item else "false"
    text = shown_text(str(item), 80)
    return text if isinstance(item, np.str_) else text[1:-1]


def line(plane: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Return an array of one axis, or its columns, as lines: the extremes of each part where there are too many.

    Of complex numbers it is the magnitude, and `magnitude` says so.
    """
    if plane.ndim not in (1, 2) or plane.dtype.kind not in "biufc":
        raise BadValue(f"an array of {plane.dtype} {list(plane.shape)} is no line; choose axes with an index")
    magnitude = plane.dtype.kind == "c"
    if magnitude:
        plane = np.abs(plane)
    columns = plane.reshape(-1, 1) if plane.ndim == 1 else plane
    total = columns.shape[1]
    columns = columns[:, :_MOST_CURVES]
    places, picked = _thinned(columns)
    names = [""] if plane.ndim == 1 else [f"[{index}]" for index in range(columns.shape[1])]
    return {
        "names": names,
        "times": places,
        "lines": [[_finite(item) for item in column] for column in picked.T.tolist()],
        "more": total - columns.shape[1],
        "magnitude": magnitude,
    }


def _thinned(columns: np.ndarray[Any, Any]) -> tuple[list[int], np.ndarray[Any, Any]]:
    """Return the rows to draw, and which they are: of each part those where a line has its extremes."""
    count, curves = columns.shape
    if count <= _POINTS:
        return list(range(count)), columns
    step = -(-count * 2 * curves // _POINTS)
    chosen = {0, count - 1}
    for edge in range(0, count, step):
        piece = columns[edge : edge + step].astype(np.float64)
        for substitute, pick in ((np.inf, np.argmin), (-np.inf, np.argmax)):
            chosen.update((edge + pick(np.where(np.isnan(piece), substitute, piece), axis=0)).tolist())
    places = sorted(chosen)
    return places, columns[places]


def histogram(array: np.ndarray[Any, Any], bins: int = 64) -> dict[str, Any]:
    """Return how many numbers of an array fall into each of `bins` equal parts of their range."""
    if array.dtype.kind not in "biuf":
        raise BadValue(f"an array of {array.dtype} has no histogram; show it as a table")
    flat = _sampled(array).astype(np.float64)
    flat = flat[np.isfinite(flat)]
    if not flat.size:
        return {"low": 0.0, "high": 1.0, "counts": []}
    low, high = float(flat.min()), float(flat.max())
    if array.dtype.kind in "biu" and high - low < 256:
        # Whole numbers: a bar for each, its middle at the number.
        low, high, bins = low - 0.5, high + 0.5, int(high - low) + 1
    with np.errstate(all="ignore"):
        edges = np.linspace(low, high, bins + 1)
    if not (edges[:-1] < edges[1:]).all():  # floats have no room between them for so many parts, or no end of them
        return {"low": low, "high": high, "counts": [int(flat.size)]}
    counts, _ = np.histogram(flat, bins, (low, high))
    return {"low": low, "high": high, "counts": counts.tolist()}


def statistics(array: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Return the smallest and largest number, the mean, and how many are not finite; empty for what has none."""
    if array.dtype.kind not in "biuf" or not array.size:
        return {}
    sample = _sampled(array)
    finite = sample[np.isfinite(sample)] if sample.dtype.kind == "f" else sample
    found: dict[str, Any] = {"bad": int(sample.size - finite.size), "sampled": sample.size < array.size}
    if finite.size:
        with np.errstate(all="ignore"):
            mean = float(finite.mean(dtype=float))
        found |= {
            "low": cell(finite.min()),
            "high": cell(finite.max()),
            "mean": repr(mean).removesuffix(".0"),
        }
    return found


def _sampled(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    flat = array.reshape(-1)
    return flat[:: -(-flat.size // _SAMPLE)] if flat.size > _SAMPLE else flat


def _finite(item: Any) -> float | None:
    number = float(item)
    return number if math.isfinite(number) else None
