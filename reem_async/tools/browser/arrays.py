"""Arrays and bytes on the page: tables, lines, histograms, pictures, and files to download."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import anyio
import anyio.to_thread
import numpy as np
import orjson
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from ...errors import BadData, BadInput, BadType, BadValue, MissingKey
from ...plan.paths import show
from ...plan.placeholders import Unfetched
from ...ships.images import EncodedImage
from .api import answered, at_of, integer_of, number_of, reply, told, value_path_in
from .overlays import hints_of, shapes_of
from .pictures import LARGEST_SIDE, MAPS, Preview, RenderedPicture, Slice, colours_of, look_at, paint, parse_slice, part
from .source import NotKept, Sample, Source, finite, shown_text, thinned, visible

# Tables, lines and histograms: as much of an array as a screen has room for.


# Of a table that is sent at once.
MOST_ROWS, MOST_COLUMNS = 200, 64
_POINTS = 1000  # of a line: about as many as a screen has pixels
_MOST_CURVES = 16  # curves in one plot: more of them cannot be told apart
_SAMPLE = 4_000_000  # numbers that histograms and statistics look at; of larger arrays an even selection


def table(plane: np.ndarray[Any, Any], row: int, column: int, rows: int, columns: int) -> dict[str, Any]:
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
    if isinstance(item, np.integer) and not isinstance(item, np.timedelta64):
        return str(int(item))
    if isinstance(item, np.bool_):
        return "true" if item else "false"
    text = shown_text(str(item), 80)
    return text if isinstance(item, np.str_) else text[1:-1]


def line(plane: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Return an array of one axis, or its columns, as lines: the extremes of each part where there are too many."""
    if plane.ndim not in (1, 2) or plane.dtype.kind not in "biuf":
        raise BadValue(f"an array of {plane.dtype} {list(plane.shape)} is no line; choose axes with an index")
    columns = plane.reshape(-1, 1) if plane.ndim == 1 else plane
    total = columns.shape[1]
    columns = columns[:, :_MOST_CURVES]
    places = thinned(columns, _POINTS)
    names = [""] if plane.ndim == 1 else [f"[{index}]" for index in range(columns.shape[1])]
    return {
        "names": names,
        "times": places,
        "lines": [[finite(item) for item in column] for column in columns[places].T.tolist()],
        "more": total - columns.shape[1],
    }


def histogram(array: np.ndarray[Any, Any], bins: int = 64) -> dict[str, Any]:
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


def _numbers(value: list[Any]) -> np.ndarray[Any, Any] | None:
    """Return a list of numbers as an array, None if it holds other things."""
    try:
        array = np.array(value)
    except ValueError:  # lists of different lengths
        return None
    return array if array.dtype.kind in "biuf" else None


# The routes.

Result = TypeVar("Result")

_SMALL = 1 << 16  # bytes up to which work is done at once: handing it to a thread takes longer
_HEX_BYTES = 1024  # bytes that are shown of a value of type bytes
# What is shown as a picture: only what these signatures begin, and never SVG, which may hold scripts.
_MAGIC = ((b"\x89PNG\r\n\x1a\n", "image/png"), (b"\xff\xd8\xff", "image/jpeg"), (b"GIF8", "image/gif"))


class Arrays:
    """Answers about arrays of one source. Large ones are worked on in a thread, one at a time."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._turns = anyio.CapacityLimiter(1)  # one at a time: numpy would take all processors

    def routes(self) -> list[Route]:
        asked = self.image, self.table, self.line, self.histogram, self.bytes, self.picture, self.colours, self.overlay
        routes = [Route(f"/{handler.__name__}", answered(handler), methods=["GET"]) for handler in asked]
        return [*routes, Route("/array", told(self.array), methods=["GET"])]

    async def _do(self, size: int, work: Callable[[], Result]) -> Result:
        if size <= _SMALL:
            return work()
        return await anyio.to_thread.run_sync(work, limiter=self._turns)

    async def _sample(self, request: Request) -> Sample:
        """Return an array, or a preview of one; raises NotKept if there is neither, BadType if it is nothing such."""
        path, at = value_path_in(request), at_of(request)
        sample = await self._source.value(path, at)
        value = sample.value
        if isinstance(value, Unfetched):
            raise NotKept(f"the array at {show(path)} is not kept for this instant: there was no room for it")
        if isinstance(value, EncodedImage):
            value = await self._do(_SMALL + 1, value.decode)
        if isinstance(value, list) and (value := _numbers(value)) is None:
            raise BadType(f"{show(path)} is a list that holds other things than numbers")
        if not isinstance(value, np.ndarray | Preview):
            raise BadType(f"{show(path)} is of type {type(value).__name__}, not an array")
        return sample._replace(value=value)

    async def _array(self, request: Request) -> tuple[np.ndarray[Any, Any], dict[str, Any]]:
        """Return an array, and what is said of it with each view: all that a page shows is of one instant."""
        sample = await self._sample(request)
        array = sample.value
        if isinstance(array, Preview):
            raise NotKept("only a small picture of this array is kept for this instant; choose Image, or a later one")
        # With every view, of the very array that is shown: another request would be of another frame.
        said = await self._do(array.nbytes, lambda: statistics(array))
        return array, {"statistics": said, **_when(sample)}

    async def array(self, request: Request) -> Response:
        array = (await self._sample(request)).value
        look = look_at(array.dtype, array.shape)
        return reply(
            {
                "dtype": str(array.dtype),
                "shape": list(array.shape),
                "view": look.view,
                "views": {name: _text(chosen) for name, chosen in look.views.items()},
                "maps": MAPS,
            }
        )

    async def image(self, request: Request) -> Response:
        """Return a part of an array as PNG, and what is said of it in the header X-Picture.

        `coarse` is for panes: without statistics, and JPEG for colours that are averaged in any case.
        """
        sample = await self._sample(request)
        array = sample.value
        chosen = _slice(request, array, 3)
        low, high = number_of(request, "low"), number_of(request, "high")
        side = integer_of(request, "side", 1024, LARGEST_SIDE)
        colours, bgr = request.query_params.get("map", "grey"), request.query_params.get("bgr") == "1"
        coarse = request.query_params.get("coarse") == "1"

        # A preview has its range with it; its statistics would be those of a small picture.
        def work() -> tuple[RenderedPicture, dict[str, Any]]:
            if isinstance(array, Preview):
                return array.paint(colours, low, high, side=side, bgr=bgr), {}
            picture = paint(part(array, chosen), colours, low, high, side=side, bgr=bgr, coarse=coarse)
            return picture, {} if coarse else statistics(array)

        if isinstance(array, Preview) and chosen != array.chosen:
            raise NotKept(f"only a small picture of [{_text(array.chosen)}] is kept for this instant")
        picture, said = await self._do(1 << 20 if isinstance(array, Preview) else array.nbytes, work)
        told = {"low": picture.low, "high": picture.high, "bad": picture.bad, "size": picture.size}
        told |= {"statistics": said, "preview": isinstance(array, Preview), **_when(sample)}
        kind = next(kind for magic, kind in _MAGIC if picture.file.startswith(magic))
        return Response(picture.file, headers={"x-picture": orjson.dumps(told).decode()}, media_type=kind)

    async def colours(self, request: Request) -> Response:
        return reply(colours_of(request.query_params.get("map", "grey")))

    async def table(self, request: Request) -> Response:
        array, said = await self._array(request)
        plane = part(array, _slice(request, array, 2))
        row, column = (integer_of(request, name, 0, 2**48) for name in ("row", "column"))
        rows = integer_of(request, "rows", 50, MOST_ROWS)
        columns = integer_of(request, "columns", 16, MOST_COLUMNS)
        return reply({**table(plane, row, column, rows, columns), **said})

    async def line(self, request: Request) -> Response:
        array, said = await self._array(request)
        plane = part(array, _slice(request, array, 2))
        return reply({**await self._do(plane.nbytes, lambda: line(plane)), **said})

    async def histogram(self, request: Request) -> Response:
        array, said = await self._array(request)
        some = part(array, _slice(request, array, array.ndim))
        return reply({**await self._do(some.nbytes, lambda: histogram(some)), **said})

    async def overlay(self, request: Request) -> Response:
        """Return the boxes and points that a hint names, each with its label and the number of its part of the hint."""
        shapes: list[Any] = []
        wrong: list[str] = []  # to a page that follows keys, it is no error that one of them is not there
        try:
            hints = hints_of(request.query_params.get("hint", ""))
        except BadInput as error:
            return reply({"shapes": [], "wrong": visible(str(error))})
        for number, hint in enumerate(hints):
            try:
                value = (await self._source.value(hint.path, at_of(request))).value
                shapes += [(*shape, number, hint.relative) for shape in shapes_of(hint, value)]
            except (MissingKey, NotKept, BadData, BadInput) as error:
                wrong.append(visible(str(error)))
        return reply({"shapes": shapes, "wrong": "; ".join(wrong)})

    async def bytes(self, request: Request) -> Response:
        """Return the beginning of bytes in hexadecimal, and whether they are a picture."""
        value = await self._bytes(request)
        lines = [value[start : start + 16] for start in range(0, min(len(value), _HEX_BYTES), 16)]
        rows = [[f"{16 * number:06x}", row.hex(" "), _printable(row)] for number, row in enumerate(lines)]
        return reply({"rows": rows, "bytes": len(value), "picture": picture_type(value) is not None})

    async def picture(self, request: Request) -> Response:
        value = await self._bytes(request)
        kind = picture_type(value)
        if kind is None:
            raise BadType("these bytes are no PNG, JPEG or GIF file")
        return Response(value, media_type=kind)

    async def _bytes(self, request: Request) -> Any:
        path = value_path_in(request)
        value = (await self._source.value(path, at_of(request))).value
        if isinstance(value, Unfetched):
            raise NotKept(f"the bytes at {show(path)} are not kept for this instant: there was no room for them")
        if isinstance(value, EncodedImage):
            return value.data
        if not isinstance(value, bytes):
            raise BadType(f"{show(path)} is of type {type(value).__name__}, not bytes")
        return value


def _when(sample: Sample) -> dict[str, float | None]:
    return {"late": sample.late, "age": sample.age}


def picture_type(value: Any) -> str | None:
    return next((kind for magic, kind in _MAGIC if value.startswith(magic)), None)


def _slice(request: Request, array: np.ndarray[Any, Any] | Preview, most_free: int) -> Slice:
    return parse_slice(request.query_params.get("slice", ",".join([":"] * len(array.shape))), array.shape, most_free)


def _text(chosen: Slice) -> str:
    return ",".join([":" if index is None else str(index) for index in chosen])


def _printable(row: Any) -> str:
    return "".join([chr(code) if 32 <= code < 127 else "." for code in row])
