"""Checks of arguments, where they are given: a wrong one must not reach what others use too."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np

from ..errors import BadType, BadValue
from .paths import shorten

__all__ = ["check_instance", "check_number", "whole"]


def check_number(name: str, value: Any, cure: str, *, least: float = 0.0, above: float | None = None) -> None:
    """Raise BadType for what is no number, and BadValue for NaN and what is below `least` or not `above`."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise BadType(f"{name}={shorten(value)} is not a number; {cure}")
    if not (value >= least if above is None else value > above):
        raise BadValue(f"{name}={shorten(value)} is out of range; {cure}")


def whole(name: str, value: Any, cure: str) -> int:
    """Return a whole number of at least 1 as an int; raise BadType or BadValue for anything else."""
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool | np.ndarray):
        raise BadType(f"{name}={shorten(value)} is not a whole number; {cure}")
    check_number(name, number, cure, least=1)
    return number


def check_instance(name: str, value: Any, kind: type[Any] | tuple[type[Any], ...], cure: str) -> None:
    """Raise BadType if a value is not of a kind: most often the class is given in place of an instance."""
    if not isinstance(value, kind):
        raise BadType(f"{name}={shorten(value)} cannot be used; {cure}")
