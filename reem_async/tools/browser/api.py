"""What the page asks for as JSON: the tree, values, plots, time, and the stream of what changed."""

from __future__ import annotations

import asyncio
import json
import math
import re
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import numpy as np
import orjson
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from ... import errors
from ...coordination.parameters import StoredParameter
from ...coordination.specification import as_json
from ...errors import BadData, BadKey, BadType, BadValue, MissingKey, RedisError, ReemError
from ...plan.paths import Path, show
from ...plan.placeholders import Unfetched
from ...plan.trees import walk
from ..jsontext import json_text
from .source import LAYOUTS, MOST_POINTS, Node, NotKept, Series, Source, address, path_of, silences, thinned, visible
from .trees import CONTENTS

# Requests: parameters are checked, and errors become answers with the right status.


LARGEST_BODY = 1 << 16  # bytes: what a person edits on a page

# The first that fits counts, so special errors stand before what they are special cases of.
_STATUS: tuple[tuple[type[Exception], int], ...] = (
    (NotKept, 409),
    (MissingKey, 404),
    (errors.BadInput, 400),
    (errors.PathRefused, 409),
    (BadData, 422),
    # The server answers, and refuses this: a page must not take it for lost.
    *((kind, 409) for kind in (errors.WrongKind, errors.PartialWrite, errors.NotAllowed)),
    *((kind, 409) for kind in (errors.ServerFull, errors.ServerReadOnly)),
    (RedisError, 503),
    (OSError, 503),
    (ReemError, 500),
)


class RefusedRequest(Exception):
    """A request is not answered."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status  # the HTTP status


def reply(content: Any, status: int = 200) -> Response:
    return Response(orjson.dumps(content), status, media_type="application/json")


def answered(handler: Callable[[Request], Awaitable[Response]]) -> Callable[[Request], Awaitable[Response]]:
    async def answer(request: Request) -> Response:
        try:
            return await handler(request)
        except RefusedRequest as error:
            return reply({"error": str(error)}, error.status)
        except (ReemError, RedisError, OSError) as error:
            status = next(status for kind, status in _STATUS if isinstance(error, kind))
            return reply({"error": visible(str(error))}, status)

    return answer


def path_in(request: Request) -> Path:
    return path_of(request.query_params.get("path", ""))


def value_path_in(request: Request) -> Path:
    """Return the path asked for, which must lead to a value; raises BadValue for the root."""
    path = path_in(request)
    if not path:
        raise BadValue("path= is missing; give a key, such as path=foo.bar")
    return path


def at_of(request: Request) -> float | None:
    return number_of(request, "at")


def number_of(request: Request, name: str) -> float | None:
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
    """Return the JSON a request carries; raises RefusedRequest for more than `LARGEST_BODY`, or no JSON."""
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise RefusedRequest(415, "send application/json")
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > LARGEST_BODY:
            raise RefusedRequest(413, f"more than {LARGEST_BODY} bytes; use Python for large values")
    try:
        # The standard library's parser keeps integers of any size, which the store then refuses by name.
        return json.loads(bytes(body), parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise RefusedRequest(400, f"this is not JSON: {error}") from None


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is no number in JSON")


def same_origin(headers: Headers) -> bool:
    """Return whether the page that sends a request came from here: both headers are set by the browser."""
    origin, site = headers.get("origin", ""), headers.get("sec-fetch-site", "same-origin")
    return site == "same-origin" and origin.partition("://")[2] == headers.get("host", "") != ""


# The tree, values, plots, and time.


# What one question of a page may ask for, so that no page keeps the program from answering others: open branches of the
# tree, rows of one and of all of them, paths that are marked as changed, points of a curve, losses that
# are marked in it, paths that a search names, and characters of a text.
_MOST_BRANCHES = 100
_MOST_ROWS = 1000
_MOST_ROWS_IN_ALL = 3000
_MOST_MARKS = 5000
_MOST_LOSSES = 500
_MOST_FOUND = 60
_LONGEST_TEXT = 200_000
_MOST_PARAMETERS = 200
_MOST_LAYOUTS = 100
_LARGEST_LAYOUT = 1 << 15  # bytes
_LAYOUT_NAME = re.compile(r"\w[\w -]{0,59}")
_MOST_SERVERS = 200  # of services that the first page lists


class Api:
    """Answers about one source. Values may be changed if `allow_write`."""

    def __init__(self, source: Source, allow_write: bool) -> None:
        self._source = source
        self.allow_write = allow_write and source.writable
        # What a request that changes something must carry: pages from elsewhere do not know it
        self.key = secrets.token_urlsafe(24)

    def routes(self) -> list[Route]:
        asked = self.tree, self.series, self.activity, self.search, self.parameters, self.services, self.layouts
        routes = [Route(f"/{handler.__name__}", answered(handler), methods=["GET"]) for handler in asked]
        routes.append(Route("/node", told(self.node), methods=["GET"]))
        routes.append(Route("/json", answered(self.json), methods=["GET"]))
        return [
            *routes,
            *(Route(f"/{it.__name__}", answered(it), methods=["POST"]) for it in (self.write, self.hint, self.layout)),
        ]

    async def tree(self, request: Request) -> Response:
        """Return the items of all open branches, what changed since an instant marked."""
        await self._source.opened()
        at = at_of(request)
        marks = await self._marks(request, at)
        branches: list[dict[str, Any]] = []
        left = _MOST_ROWS_IN_ALL
        for text in request.query_params.getlist("open")[:_MOST_BRANCHES]:
            count, start, where = _branch(text)
            try:
                page = await self._source.children(path_of(where), start, min(count, max(left, 1)), at)
            except (MissingKey, NotKept, BadKey, BadData) as error:
                branches.append({"address": where, "error": visible(str(error)), "total": 0, "start": 0, "nodes": []})
                continue
            left -= len(page.nodes)
            nodes = [_marked(node, marks) for node in page.nodes]
            branches.append({"address": where, "total": page.total, "start": page.start, "nodes": nodes})
        return reply({"branches": branches, **self._source.status()._asdict()})

    async def _marks(self, request: Request, at: float | None) -> tuple[set[Path], set[Path]]:
        """Return what changed, and what is above it."""
        since = number_of(request, "since")
        if since is None:
            return set(), set()
        until = self._source.status().end if at is None else at
        changed = await self._source.differing(min(since, until), max(since, until), _MOST_MARKS)
        return changed, {path[:end] for path in changed for end in range(1, len(path))}

    async def node(self, request: Request) -> Response:
        path, at = path_in(request), at_of(request)
        (node,) = await self._source.nodes([path], at) if path else [Node((), "dict")]
        if node is None:
            raise MissingKey(f"nothing {'is' if at is None else 'was'} stored at {visible(show(path))}")
        answer = node.as_json() | {
            "shown": visible(show(path)),
            "snippets": self._source.snippets(path, at) if path else {},
        }
        if node.kind == "str":
            text = (await self._source.value(path, at)).value
            answer |= {"full": visible(str(text)[:_LONGEST_TEXT]), "cut": len(str(text)) > _LONGEST_TEXT}
        if self.allow_write and at is None and node.kind in ("dict", "list"):
            answer["editable"] = (node.count or 0) <= _MOST_ROWS
        return reply(answer)

    async def json(self, request: Request) -> Response:
        """Return a value as JSON, for the editor; raises BadType if arrays or bytes are in it."""
        path = value_path_in(request)
        value = (await self._source.value(path, at_of(request))).value
        if not _is_plain(value):
            raise BadType(f"{show(path)} holds arrays or bytes, which a page cannot write; edit what is below it")
        text = json_text(value, pretty=True).encode(errors="backslashreplace")  # half of a surrogate pair
        return Response(text, media_type="application/json")

    async def series(self, request: Request) -> Response:
        await self._source.opened()
        status = self._source.status()
        start, end = number_of(request, "start"), number_of(request, "end")
        start = status.start if start is None else start
        end, path = status.end if end is None else min(end, status.end), value_path_in(request)
        found = await self._source.series(path, start, end)
        losses = await self._source.losses(path, start, end) if found.times else []
        marks = {"losses": [tuple(loss) for loss in losses[-_MOST_LOSSES:]], "quiet": found.quiet}
        if found.quiet is None:
            marks["quiet"] = silences(found.times, end)
        return reply({"start": start, "end": end, **_thinned(found)._asdict(), **marks})

    async def activity(self, request: Request) -> Response:
        await self._source.opened()
        status = self._source.status()
        bins = max(integer_of(request, "bins", 100, 400), 1)
        span, path = (status.start, status.end), path_in(request)
        counts = await self._source.activity(*span, bins, path)
        pictures = await self._source.pictures(*span, bins, path)
        return reply({"start": status.start, "end": status.end, "counts": counts, "pictures": pictures})

    async def search(self, request: Request) -> Response:
        text = request.query_params.get("q", "").strip()[:200]
        at = at_of(request)
        paths = await self._source.search(text, at, _MOST_FOUND) if text else []
        nodes = await self._source.nodes(paths, at)
        found = [node.as_json() | {"shown": visible(show(node.path))} for node in nodes if node is not None]
        return reply({"found": found, "most": _MOST_FOUND})

    async def parameters(self, request: Request) -> Response:
        found = await self._source.parameters(path_in(request))
        return reply({"parameters": [_control(it) for it in found[:_MOST_PARAMETERS]]})

    async def services(self, request: Request) -> Response:
        """Return a row for each server of each service, as `reem services` shows it."""
        rows = await self._source.services()
        return reply({"services": [row | {"service": visible(row["service"])} for row in rows[:_MOST_SERVERS]]})

    async def write(self, request: Request) -> Response:
        """Publish a value, if that is allowed, and asked by a page from here."""
        if not self.allow_write:
            raise RefusedRequest(403, "this page is read-only; start it with: reem browse --allow-write")
        path, value, retype = await self._asked_by_own_page(request)
        retyped = await self._source.write(path, value, retype=retype)
        return reply({"retyped": [visible(text) for text in retyped]} if retyped else {"written": address(path)})

    async def layouts(self, request: Request) -> Response:
        """Return the layouts in the store, by their names."""
        try:
            found = (await self._source.value((LAYOUTS,), None)).value
        except (MissingKey, NotKept, BadData, errors.NotAllowed):
            found = {}
        items = list(found.items())[:_MOST_LAYOUTS] if isinstance(found, dict) else []
        layouts = {name: it for name, it in items if _is_layout(it)}
        # Not by orjson: programs may have stored half of a surrogate pair.
        return Response(json.dumps({"layouts": layouts}), media_type="application/json")

    async def layout(self, request: Request) -> Response:
        """Keep a layout in the store, or remove it with null."""
        if not self.allow_write:
            raise RefusedRequest(403, "this page is read-only; start it with: reem browse --allow-write")
        name, layout, _ = await self._content(request)
        if _LAYOUT_NAME.fullmatch(name) is None:
            raise RefusedRequest(400, f"{name[:60]!r} names no layout; use up to 60 letters, digits, blanks, - and _")
        if layout is not None and not _is_layout(layout):
            raise RefusedRequest(400, f"a layout is an object of up to {_LARGEST_LAYOUT} bytes")
        await self._source.save_layout(name, layout)
        return reply({"saved": name})

    async def hint(self, request: Request) -> Response:
        """Note what the bytes of another program are, for this start of the page; nothing is written."""
        path, text, _ = await self._asked_by_own_page(request)
        if not isinstance(text, str):
            raise RefusedRequest(400, 'the value is text, such as "uint8[480,640,3]"')
        self._source.hint(path, text)
        return reply({"shown as": text})

    async def _asked_by_own_page(self, request: Request) -> tuple[Path, Any, bool]:
        """Return the path and the value that a page from here sends, and whether the type may change."""
        where, value, retype = await self._content(request)
        path = path_of(where)
        if not path:
            raise RefusedRequest(400, "a top-level key is needed")
        return path, value, retype

    async def _content(self, request: Request) -> tuple[str, Any, bool]:
        if not same_origin(request.headers):
            raise RefusedRequest(403, "this did not come from a page of this program")
        offered = request.headers.get("x-reem-key", "")
        # The key of this start of the program, which only its own page has: no other site can make a browser send it.
        if not secrets.compare_digest(offered.encode(), self.key.encode()):
            raise RefusedRequest(403, "the page is older than this program; load it again")
        content = await body_of(request)
        if not isinstance(content, dict) or "value" not in content or not isinstance(content.get("path"), str):
            raise RefusedRequest(400, 'send {"path": ..., "value": ...}')
        return content["path"], content["value"], content.get("retype") is True


def _control(it: StoredParameter) -> dict[str, Any]:
    """Return what a page needs to draw the control of a parameter. Values are texts: JavaScript has no 64-bit ints."""
    specification = it.specification
    return {
        "address": address(it.path),
        "shown": visible(it.name),
        "type": specification.type,
        "low": as_json(specification.low),
        "high": as_json(specification.high),
        "choices": [_value_text(each) for each in specification.choices] or None,
        "range": visible(specification.range_text()),
        "unit": visible(specification.unit),
        "help": visible(specification.help),
        "text": _value_text(it.used),
        "default_text": visible(_value_text(specification.default)),
        "invalid": visible(it.invalid),
    }


def _is_plain(value: Any) -> bool:
    return not any(isinstance(it, (Unfetched, *CONTENTS)) for _, it in walk(value, ()))


def _is_layout(value: Any) -> bool:
    return isinstance(value, dict) and _is_plain(value) and len(json.dumps(value)) <= _LARGEST_LAYOUT


def _value_text(value: Any) -> str:
    return value if isinstance(value, str) else orjson.dumps(as_json(value)).decode()


def _branch(text: str) -> tuple[int, int, str]:
    """Return how many rows of which branch, from which on, are asked for: "100:0:foo.bar"."""
    count, _, rest = text.partition(":")
    start, _, where = rest.partition(":")
    if not (count.isascii() and count.isdigit() and start.isascii() and start.isdigit() and len(count + start) < 20):
        raise BadValue(f"open={text[:40]!r} is not like 100:0:foo.bar")
    return min(int(count), _MOST_ROWS), int(start), where


def _marked(node: Node, marks: tuple[set[Path], set[Path]]) -> dict[str, Any]:
    changed, above = marks
    mark = "changed" if node.path in changed else "inside" if node.path in above else ""
    return node.as_json() | {"mark": mark}


def _thinned(series: Series) -> Series:
    if len(series.times) <= MOST_POINTS:
        return series
    places = thinned(np.array(series.lines, float).T, MOST_POINTS)  # None becomes NaN
    lines = [[values[index] for index in places] for values in series.lines]
    return Series(series.names, [series.times[index] for index in places], lines)


# Server-sent events.


# Seconds between two looks: a page draws no faster.
_PAUSE = 0.1
_QUIET = 1.0  # seconds after which something is sent though nothing changed: the page knows by it that all is well
_MOST_PATHS = 100  # paths that are named; if there are more, the event says only that, and the page reads all it shows
_MOST_CLIENTS = 64  # pages that receive events at the same time, each over a connection that stays open


class Events:
    """Tells pages what changed in a source.

    Each event has the paths that changed since the event before, however long ago that was. A slow page gets fewer
    events, and nothing piles up for it.
    """

    def __init__(self, source: Source, ending: Callable[[], bool]) -> None:
        self._source = source
        self._ending = ending  # whether the program ends
        self._clients = 0

    def routes(self) -> list[Route]:
        return [Route("/events", answered(self.events), methods=["GET"])]

    async def events(self, request: Request) -> Response:
        if self._clients >= _MOST_CLIENTS:
            raise RefusedRequest(503, f"{_MOST_CLIENTS} pages are open already; close some")
        # The second keeps a proxy (nginx) from collecting events before it passes them on.
        headers = {"cache-control": "no-store", "x-accel-buffering": "no"}
        return StreamingResponse(self._stream(request), headers=headers, media_type="text/event-stream")

    async def _stream(self, request: Request) -> AsyncIterator[bytes]:
        self._clients += 1
        self._source.shown_on(self._clients)
        try:
            # Milliseconds until a browser that lost the connection tries again.
            yield b"retry: 1000\n\n"
            told, quiet, before = self._source.status().end, 0.0, ("", 1.0)
            # Not all versions of uvicorn end the response of a page that has gone.
            while not self._ending() and not await request.is_disconnected():
                status = self._source.status()
                paths = await self._source.changes(told, status.end, _MOST_PATHS)
                if paths or (status.lost, status.part) != before or quiet >= _QUIET:
                    content = {
                        **status._asdict(),
                        "paths": [address(path) for path in paths],
                        "more": len(paths) >= _MOST_PATHS,
                    }
                    yield b"data: " + orjson.dumps(content) + b"\n\n"
                    told, quiet, before = status.end, 0.0, (status.lost, status.part)
                await asyncio.sleep(_PAUSE)
                quiet += _PAUSE
        finally:
            self._clients -= 1
            self._source.shown_on(self._clients)
