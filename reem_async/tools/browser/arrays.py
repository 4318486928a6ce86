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

from ...errors import BadType
from ...plan.paths import Path, show
from .answers import answered, at_of, integer_of, number_of, reply, told, value_path_in
from .figures import MOST_COLUMNS, MOST_ROWS, histogram, line, statistics, table
from .pictures import LARGEST_SIDE, MAPS, Picture, colours_of, paint
from .previews import Preview
from .slices import Slice, look_at, parse_slice, part
from .source import NotKept, Sample, Source
from .trees import Leaf

__all__ = ["Arrays", "picture_type"]

Result = TypeVar("Result")

# Bytes up to which work is done at once: handing it to a thread takes longer.
_SMALL = 1 << 16
# Bytes that are shown of a value of type bytes.
_HEX_BYTES = 1024
# What is shown as a picture: only what these signatures begin, and never SVG, which may hold scripts.
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
        # Made here, since it belongs to the event loop that runs by now. One at a time: numpy would take all
        # processors.
        if self._turns is None:
            self._turns = anyio.CapacityLimiter(1)
        return await anyio.to_thread.run_sync(work, limiter=self._turns)

    async def _sample(self, request: Request) -> Sample:
        """Return an array, or a preview of one; raises NotKept if there is neither, BadType if it is nothing such."""
        path, at = value_path_in(request), at_of(request)
        sample = await self._source.value(path, at)
        value = sample.value
        if isinstance(value, Leaf):
            raise NotKept(f"the array at {show(path)} is not kept for this instant: there was no room for it")
        if isinstance(value, list):
            value = _array_of(value, path)
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
        """Return dtype, shape, and how an array can be shown."""
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
        """Return a part of an array as PNG; what is said of it is in the header X-Picture."""
        sample = await self._sample(request)
        array = sample.value
        chosen = _slice(request, array, 3)
        low, high = number_of(request, "low"), number_of(request, "high")
        side = integer_of(request, "side", 1024, LARGEST_SIDE)
        colours, bgr = request.query_params.get("map", "grey"), request.query_params.get("bgr") == "1"

        # A preview has its range with it; its statistics would be those of a small picture.
        def work() -> tuple[Picture, dict[str, Any]]:
            if isinstance(array, Preview):
                return array.paint(colours, low, high, side=side, bgr=bgr), {}
            return paint(part(array, chosen), colours, low, high, side=side, bgr=bgr), statistics(array)

        if isinstance(array, Preview) and chosen != array.chosen:
            raise NotKept(f"only a small picture of [{_text(array.chosen)}] is kept for this instant")
        picture, said = await self._do(1 << 20 if isinstance(array, Preview) else array.nbytes, work)
        told = {"low": picture.low, "high": picture.high, "bad": picture.bad, "size": picture.size}
        told |= {"statistics": said, "preview": isinstance(array, Preview), **_when(sample)}
        return Response(picture.png, headers={"x-picture": orjson.dumps(told).decode()}, media_type="image/png")

    async def colours(self, request: Request) -> Response:
        """Return the colours of a map from its low to its high end, for the scale below a picture."""
        return reply(colours_of(request.query_params.get("map", "grey")))

    async def table(self, request: Request) -> Response:
        """Return some rows and columns of a part of an array."""
        array, said = await self._array(request)
        plane = part(array, _slice(request, array, 2))
        row, column = (integer_of(request, name, 0, 2**48) for name in ("row", "column"))
        rows = integer_of(request, "rows", 50, MOST_ROWS)
        columns = integer_of(request, "columns", 16, MOST_COLUMNS)
        return reply({**table(plane, row, column, rows, columns), **said})

    async def line(self, request: Request) -> Response:
        """Return a part of an array as lines."""
        array, said = await self._array(request)
        plane = part(array, _slice(request, array, 2))
        return reply({**await self._do(plane.nbytes, lambda: line(plane)), **said})

    async def histogram(self, request: Request) -> Response:
        """Return how often which numbers are in a part of an array."""
        array, said = await self._array(request)
        some = part(array, _slice(request, array, array.ndim))
        return reply({**await self._do(some.nbytes, lambda: histogram(some)), **said})

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


def _when(sample: Sample) -> dict[str, float | None]:
    """Return how old a sample is."""
    return {"late": sample.late, "age": sample.age}


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


def _slice(request: Request, array: np.ndarray[Any, Any] | Preview, most_free: int) -> Slice:
    return parse_slice(request.query_params.get("slice", ",".join([":"] * len(array.shape))), array.shape, most_free)


def _text(chosen: Slice) -> str:
    return ",".join([":" if index is None else str(index) for index in chosen])


def _printable(row: Any) -> str:
    return "".join([chr(code) if 32 <= code < 127 else "." for code in row])
