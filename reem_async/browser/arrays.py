"""What the page asks of arrays and bytes: pictures, tables, lines, histograms, files."""

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

from ..errors import BadType
from ..plan.paths import Path, show
from .answers import answered, at_of, integer_of, number_of, reply, told, value_path_in
from .figures import MOST_COLUMNS, MOST_ROWS, histogram, line, statistics, table
from .pictures import LARGEST_SIDE, MAPS, colours_of, paint
from .slices import Slice, look_at, parse_slice, part
from .source import NotKept, Sample, Source
from .trees import Leaf

__all__ = ["Arrays", "picture_type"]

Result = TypeVar("Result")

_SMALL = 1 << 16
_HEX_BYTES = 1024
_MAGIC = ((b"\x89PNG\r\n\x1a\n", "image/png"), (b"\xff\xd8\xff", "image/jpeg"), (b"GIF8", "image/gif"))


class Arrays:
    """Answers about arrays of one source. Large ones are worked on in a thread, one at a time.

    Args:
        source: What is shown.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._turns: anyio.CapacityLimiter | None = None

    def routes(self) -> list[Route]:
        """Return the routes below /api."""
        asked = {
            "image": self.image,
            "table": self.table,
            "line": self.line,
            "histogram": self.histogram,
            "bytes": self.dump,
            "picture": self.picture,
            "colours": self.colours,
        }
        routes = [Route(f"/{name}", answered(handler), methods=["GET"]) for name, handler in asked.items()]
        return [*routes, Route("/array", told(self.array), methods=["GET"])]

    async def _do(self, size: int, work: Callable[[], Result]) -> Result:
        if size <= _SMALL:
            return work()
        if self._turns is None:
            self._turns = anyio.CapacityLimiter(1)
        return await anyio.to_thread.run_sync(work, limiter=self._turns)

    async def _array(self, request: Request) -> tuple[np.ndarray[Any, Any], Sample]:
        path, at = value_path_in(request), at_of(request)
        sample = await self._source.value(path, at)
        value = sample.value
        if isinstance(value, Leaf):
            raise NotKept(f"the array at {show(path)} is not kept for this instant: there was no room for it")
        if isinstance(value, list):
            value = _array_of(value, path)
        if not isinstance(value, np.ndarray):
            raise BadType(f"{show(path)} is of type {type(value).__name__}, not an array")
        return value, sample

    async def array(self, request: Request) -> Response:
        """Return dtype, shape, what is in an array, and how it can be shown."""
        array, sample = await self._array(request)
        look = look_at(array.dtype, array.shape)
        return reply(
            {
                "dtype": str(array.dtype),
                "shape": list(array.shape),
                "bytes": array.nbytes,
                "view": look.view,
                "views": {name: _text(chosen) for name, chosen in look.views.items()},
                "statistics": await self._do(array.nbytes, lambda: statistics(array)),
                "maps": MAPS,
                "late": sample.late,
            }
        )

    async def image(self, request: Request) -> Response:
        """Return a part of an array as PNG; its range of numbers is in the header X-Picture."""
        array, sample = await self._array(request)
        chosen = _slice(request, array, 3)
        low, high = number_of(request, "low"), number_of(request, "high")
        side = integer_of(request, "side", 1024, LARGEST_SIDE)
        colours, bgr = request.query_params.get("map", "grey"), request.query_params.get("bgr") == "1"
        picture = await self._do(
            array.nbytes, lambda: paint(part(array, chosen), colours, low, high, side=side, bgr=bgr)
        )
        told = {"low": picture.low, "high": picture.high, "bad": picture.bad, "size": picture.size, "late": sample.late}
        return Response(picture.png, headers={"x-picture": orjson.dumps(told).decode()}, media_type="image/png")

    async def colours(self, request: Request) -> Response:
        """Return the colours of a map from its low to its high end, for the scale below a picture."""
        return reply(colours_of(request.query_params.get("map", "grey")))

    async def table(self, request: Request) -> Response:
        """Return some rows and columns of a part of an array."""
        array, sample = await self._array(request)
        plane = part(array, _slice(request, array, 2))
        row, column = (integer_of(request, name, 0, 2**48) for name in ("row", "column"))
        rows = integer_of(request, "rows", 50, MOST_ROWS)
        columns = integer_of(request, "columns", 16, MOST_COLUMNS)
        return reply({**table(plane, row, column, rows, columns), "late": sample.late})

    async def line(self, request: Request) -> Response:
        """Return a part of an array as lines."""
        array, sample = await self._array(request)
        plane = part(array, _slice(request, array, 2))
        return reply({**await self._do(plane.nbytes, lambda: line(plane)), "late": sample.late})

    async def histogram(self, request: Request) -> Response:
        """Return how often which numbers are in a part of an array."""
        array, sample = await self._array(request)
        some = part(array, _slice(request, array, array.ndim))
        return reply({**await self._do(some.nbytes, lambda: histogram(some)), "late": sample.late})

    async def dump(self, request: Request) -> Response:
        """Return the beginning of bytes in hexadecimal, and whether they are a picture."""
        value = await self._bytes(request)
        lines = [value[start : start + 16] for start in range(0, min(len(value), _HEX_BYTES), 16)]
        rows = [[f"{16 * number:06x}", row.hex(" "), _printable(row)] for number, row in enumerate(lines)]
        return reply({"rows": rows, "bytes": len(value), "picture": picture_type(value) is not None})

    async def picture(self, request: Request) -> Response:
        """Return bytes that are a PNG, JPEG or GIF file as such."""
        value = await self._bytes(request)
        kind = picture_type(value)
        if kind is None:
            raise BadType("these bytes are no PNG, JPEG or GIF file")
        return Response(value, media_type=kind)

    async def _bytes(self, request: Request) -> Any:
        path = value_path_in(request)
        value = (await self._source.value(path, at_of(request))).value
        if isinstance(value, Leaf):
            raise NotKept(f"the bytes at {show(path)} are not kept for this instant: there was no room for them")
        if not isinstance(value, bytes):
            raise BadType(f"{show(path)} is of type {type(value).__name__}, not bytes")
        return value


def picture_type(value: Any) -> str | None:
    """Return the media type of bytes that are a picture."""
    return next((kind for magic, kind in _MAGIC if value.startswith(magic)), None)


def _array_of(value: list[Any], path: Path) -> np.ndarray[Any, Any]:
    """Return a list of numbers as an array."""
    try:
        array = np.array(value)
    except ValueError:
        array = np.array([], object)
    if array.dtype.kind not in "biuf":
        raise BadType(f"{show(path)} is a list that holds other things than numbers")
    return array


def _slice(request: Request, array: np.ndarray[Any, Any], most_free: int) -> Slice:
    return parse_slice(request.query_params.get("slice", ",".join([":"] * array.ndim)), array.shape, most_free)


def _text(chosen: Slice) -> str:
    return ",".join([":" if index is None else str(index) for index in chosen])


def _printable(row: Any) -> str:
    return "".join([chr(code) if 32 <= code < 127 else "." for code in row])
