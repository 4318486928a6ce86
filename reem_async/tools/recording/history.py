"""Values over time as one array, where they have one shape."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["EXACT", "numbers", "stacked"]

EXACT = 2**53
"""Integers up to this size are floats without loss."""


def stacked(values: list[Any]) -> np.ndarray[Any, Any] | list[Any]:
    """Return values as one array if they are all numbers, arrays of one kind, or lists of as many numbers; else as is.

    Numbers become bool, int64, uint64 or float64, whichever holds them all exactly.
    """
    if not values:
        return np.empty(0)
    kinds = set(map(type, values))
    if kinds == {np.ndarray}:
        forms = {(value.dtype, value.shape) for value in values}
        return np.stack(values) if len(forms) == 1 else values
    if kinds == {list}:
        lengths = {len(value) for value in values}
        if len(lengths) != 1 or lengths == {0}:
            return values
        flat = numbers([item for value in values for item in value])
        return values if flat is None else flat.reshape(len(values), -1)
    flat = numbers(values)
    return values if flat is None else flat


def numbers(values: list[Any]) -> np.ndarray[Any, Any] | None:
    """Return numbers as an array that holds them all exactly, None if there is none."""
    kinds = set(map(type, values))
    if kinds == {bool}:
        return np.array(values, bool)
    if kinds == {int}:
        low, high = min(values), max(values)
        if low >= -(2**63) and high < 2**63:
            return np.array(values, np.int64)
        return np.array(values, np.uint64) if low >= 0 else None
    if kinds == {float}:
        return np.array(values, np.float64)
    if kinds == {int, float} and all(type(value) is float or abs(value) <= EXACT for value in values):
        return np.array(values, np.float64)
    return None
