"""Boxes and points that are drawn over a picture: what a hint such as `boxes xywh det.found` names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from ...errors import BadValue
from ...plan.paths import Path, show
from .source import finite, path_of, visible

MOST_HINTS = 8  # in one text
_LONGEST = 500  # characters of a text
_MOST_SHAPES = 500  # that one hint draws
_MOST_ROWS = 10_000  # of an array that are looked at: those with NaN are no shape
_NUMBERS = 5  # of one shape that are used
_LABEL = 40  # characters
_DEEPEST = 4  # lists in lists
_KINDS = ("boxes", "points")
_FORMS = ("xyxy", "xywh", "cxcywh")
_WORD = re.compile(r"(boxes|points|xyxy|xywh|cxcywh|relative)\s+")
_SHAPE = "x, y for a point, or four numbers for a box"

# What detectors call the parts of a box, and the text beside it.
_CORNERS = (("x1", "y1", "x2", "y2"), ("xmin", "ymin", "xmax", "ymax"), ("left", "top", "right", "bottom"))
_SIZES = (("x", "y", "w", "h"), ("x", "y", "width", "height"))
_CENTRES = (("cx", "cy", "w", "h"), ("cx", "cy", "width", "height"))
_BOXES, _POINTS = ("box", "bbox", "boxes"), ("point", "points", "keypoints", "center", "centre")
_LABELS, _SCORES = ("label", "name", "class", "id", "labels"), ("score", "confidence", "scores")


class OverlayHint(NamedTuple):
    path: Path  # where the boxes or points are
    kind: str  # "boxes" or "points"; "" for what fits
    form: str  # what the four numbers of a box are, one of `_FORMS`; "" for what their names say, else "xyxy"
    relative: bool  # they are parts of the picture's width and height, not pixels


def hints_of(text: str) -> list[OverlayHint]:
    """Return what `boxes xywh det.found; points det.corners` says; raises BadValue."""
    parts = [part.strip() for part in text[: _LONGEST + 1].split(";") if part.strip()]
    if len(text) > _LONGEST or len(parts) > MOST_HINTS:
        raise BadValue(f"an overlay has up to {MOST_HINTS} parts and {_LONGEST} characters; shorten it")
    return [_hint(part) for part in parts]


def _hint(part: str) -> OverlayHint:
    words: set[str] = set()
    rest = part
    while (found := _WORD.match(rest)) is not None:
        words.add(found[1])
        rest = rest[found.end() :]
    kinds, forms = words.intersection(_KINDS), words.intersection(_FORMS)
    path = path_of(rest)
    if not path or len(kinds) > 1 or len(forms) > 1:
        raise BadValue(f"{visible(part[:60])!r} is no overlay; write it like: det.boxes, or: boxes xywh det.found")
    return OverlayHint(path, "".join(kinds), "".join(forms), "relative" in words)


def shapes_of(hint: OverlayHint, value: Any) -> list[tuple[list[float], str]]:
    """Return points [x, y] and boxes [left, top, right, bottom], each with its label; raises BadValue."""
    found: list[tuple[list[float], str]] = []
    for numbers, label, form in _items(hint, value):
        if len(found) >= _MOST_SHAPES:
            break
        floats = [finite(number) for number in numbers]
        kept = [number for number in floats if number is not None]
        if len(kept) < len(floats):
            continue  # a detector's way to say that there is none
        wants_box = hint.kind == "boxes" or (hint.kind == "" and len(kept) >= 4)
        if len(kept) < (4 if wants_box else 2):
            raise BadValue(f"{show(hint.path)} has {len(kept)} numbers for a shape; there must be {_SHAPE}")
        extra = f"{kept[4]:.2f}" if wants_box and len(kept) > 4 and not label else ""
        found.append((_box(kept, hint.form or form) if wants_box else kept[:2], label or extra))
    return found


def _items(hint: OverlayHint, value: Any, depth: int = 0) -> Iterator[tuple[list[Any], str, str]]:
    """Yield the numbers of each shape, its label, and what its numbers are."""
    if depth > _DEEPEST:
        raise BadValue(f"{show(hint.path)} is nested too deep for boxes or points; name what is in it")
    plain = _rows(value) if isinstance(value, np.ndarray) and value.dtype.kind in "biuf" else value
    if isinstance(plain, Mapping):
        yield from _named(hint, plain, depth)
    elif isinstance(plain, list) and plain and all(isinstance(it, int | float) for it in plain):
        yield plain[:_NUMBERS], "", "xyxy"
    elif isinstance(plain, list):
        for it in plain:
            yield from _items(hint, it, depth + 1)
    else:
        raise BadValue(f"{show(hint.path)} has no {_SHAPE}; it is of type {type(value).__name__}")


def _rows(array: np.ndarray[Any, Any]) -> Any:
    """Return the beginning of an array as lists: all of an image as lists would take seconds."""
    if array.ndim < 2 or not array.size:
        return array[:_NUMBERS].tolist() if array.ndim else array.item()
    return array.reshape(-1, array.shape[-1])[:_MOST_ROWS, :_NUMBERS].tolist()


def _named(hint: OverlayHint, value: Mapping[str, Any], depth: int) -> Iterator[tuple[list[Any], str, str]]:
    label, score = [_texts(_first(value, names)) for names in (_LABELS, _SCORES)]
    inner = None if hint.kind == "points" else _first(value, _BOXES)
    inner = _first(value, _POINTS) if inner is None else inner
    if inner is not None:
        shapes = list(_items(hint, inner, depth + 1))
        for index, (numbers, own, form) in enumerate(shapes):
            yield numbers, own or _text(_nth(label, index), _nth(score, index)), form
        return
    for form, names in (("xyxy", _CORNERS), ("xywh", _SIZES), ("cxcywh", _CENTRES), ("xyxy", (("x", "y"),))):
        for keys in names:
            if all(key in value for key in keys):
                yield [value[key] for key in keys], _text(label, score), form
                return
    raise BadValue(f"{show(hint.path)} has a dict without box, x1 y1 x2 y2, x y w h, or x y")


def _first(value: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    return next((value[name] for name in names if name in value), None)


def _texts(found: Any) -> Any:
    return found[:_MOST_ROWS].tolist() if isinstance(found, np.ndarray) and found.ndim == 1 else found


def _nth(value: Any, index: int) -> Any:
    return (value[index] if index < len(value) else None) if isinstance(value, list) else value


def _text(label: Any, score: Any) -> str:
    number = finite(score)
    name = visible(str(label))[:_LABEL] if isinstance(label, str | int | float) else ""
    return name + ("" if number is None else f" {number:.2f}")


def _box(numbers: list[float], form: str) -> list[float]:
    x, y, third, fourth = numbers[:4]
    if form == "xywh":
        return [x, y, x + third, y + fourth]
    if form == "cxcywh":
        return [x - third / 2, y - fourth / 2, x + third / 2, y + fourth / 2]
    return [x, y, third, fourth]
