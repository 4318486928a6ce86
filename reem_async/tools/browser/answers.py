"""Reading requests and answering them: parameters checked, errors as JSON with the right status."""

from __future__ import annotations

import json
import math
from collections.abc import Awaitable, Callable
from typing import Any

import orjson
from starlette.requests import Request
from starlette.responses import Response

from ...errors import (
    BadData,
    BadInput,
    BadValue,
    MissingKey,
    NotAllowed,
    PartialWrite,
    PathRefused,
    RedisError,
    ReemError,
    ServerFull,
    ServerReadOnly,
    WrongKind,
)
from ...plan.paths import Path
from .addresses import path_of
from .nodes import visible
from .source import NotKept

__all__ = [
    "LARGEST_BODY",
    "Refused",
    "answered",
    "at_of",
    "body_of",
    "integer_of",
    "number_of",
    "path_in",
    "reply",
    "told",
    "value_path_in",
]

# Bytes: what a person edits on a page.
LARGEST_BODY = 1 << 16

# The first that fits counts, so special errors stand before what they are special cases of.
_STATUS: tuple[tuple[type[Exception], int], ...] = (
    (NotKept, 409),
    (MissingKey, 404),
    (BadInput, 400),
    (PathRefused, 409),
    (BadData, 422),
    # The server answers, and refuses this: a page must not take it for lost.
    *((refusal, 409) for refusal in (WrongKind, PartialWrite, NotAllowed, ServerFull, ServerReadOnly)),
    (RedisError, 503),
    (OSError, 503),
    (ReemError, 500),
)


class Refused(Exception):
    """A request is not answered.

    Attributes:
        status: The HTTP status.
    """

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


def reply(content: Any, status: int = 200) -> Response:
    """Return a JSON response."""
    return Response(orjson.dumps(content), status, media_type="application/json")


def answered(handler: Callable[[Request], Awaitable[Response]]) -> Callable[[Request], Awaitable[Response]]:
    """Return a handler whose errors become answers."""

    async def answer(request: Request) -> Response:
        try:
            return await handler(request)
        except Refused as error:
            return reply({"error": str(error)}, error.status)
        except (ReemError, RedisError, OSError) as error:
            status = next(status for kind, status in _STATUS if isinstance(error, kind))
            return reply({"error": visible(str(error))}, status)

    return answer


def path_in(request: Request) -> Path:
    """Return the path asked for."""
    return path_of(request.query_params.get("path", ""))


def value_path_in(request: Request) -> Path:
    """Return the path asked for, which must lead to a value: the root is none.

    Raises:
        BadValue: It is missing or empty.
    """
    path = path_in(request)
    if not path:
        raise BadValue("path= is missing; give a key, such as path=foo.bar")
    return path


def at_of(request: Request) -> float | None:
    """Return the instant asked for, None for now."""
    return number_of(request, "at")


def number_of(request: Request, name: str) -> float | None:
    """Return a finite number, None if there is none."""
    text = request.query_params.get(name, "")
    if not text:
        return None
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise BadValue(f"{name}={text[:20]!r} is not a number")
    return number


def integer_of(request: Request, name: str, default: int, most: int) -> int:
    """Return a number from 0 to `most`."""
    number = number_of(request, name)
    return default if number is None else int(max(0, min(number, most)))


def told(handler: Callable[[Request], Awaitable[Response]]) -> Callable[[Request], Awaitable[Response]]:
    """Return a handler that says in its answer what is not there: to a page that follows a key, that is no error."""

    async def answer(request: Request) -> Response:
        try:
            return await handler(request)
        except (MissingKey, NotKept, BadData) as error:
            return reply({"missing": visible(str(error))})

    return answered(answer)


async def body_of(request: Request) -> Any:
    """Return the JSON a request carries.

    Raises:
        Refused: More than `LARGEST_BODY`, or not JSON.
    """
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise Refused(415, "send application/json")
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > LARGEST_BODY:
            raise Refused(413, f"more than {LARGEST_BODY} bytes; use Python for large values")
    try:
        # The standard library's parser keeps integers of any size, which the store then refuses by name.
        return json.loads(bytes(body), parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise Refused(400, f"this is not JSON: {error}") from None


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is no number in JSON")
