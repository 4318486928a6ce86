"""What the slider holds, as a recording."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path as FilePath
from typing import Any

import anyio
import anyio.to_thread
from starlette.background import BackgroundTask
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from ...plan.placeholders import Unfetched, Unreadable
from ...plan.trees import MISSING, mapped
from ..recording.format import Kind, Role
from ..recording.recorder import description
from ..recording.times import STEP, nanoseconds
from ..recording.writer_thread import Operation, write_recording
from .api import RefusedRequest, answered
from .history import History
from .live import LiveSource
from .source import Source
from .timeline import PENDING, UNKNOWN
from .trees import thawed


class Saving:
    """Answers with a file of all that the slider holds; one at a time."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._turns = anyio.CapacityLimiter(1)

    def routes(self) -> list[Route]:
        return [Route("/recording", answered(self.recording), methods=["GET"])]

    async def recording(self, request: Request) -> Response:
        """Return the past as an MCAP file, of which `log.at` gives what the slider shows."""
        source = self._source
        if not isinstance(source, LiveSource):
            raise RefusedRequest(404, "this is a recording already")
        session = source.interface.session.raw
        operations = list(operations_of(source.history))
        metadata = description(session, ["*"], [], 0.0)
        folder = tempfile.TemporaryDirectory()
        path = FilePath(folder.name) / time.strftime("reem-%Y%m%dT%H%M%SZ.mcap", time.gmtime())
        try:
            await anyio.to_thread.run_sync(
                lambda: write_recording(path, operations, session.ships, metadata), limiter=self._turns
            )
        except BaseException:
            folder.cleanup()
            raise
        return FileResponse(
            path, media_type="application/octet-stream", filename=path.name, background=BackgroundTask(folder.cleanup)
        )


def operations_of(history: History) -> Iterator[Operation]:
    """Yield what makes a recording of the past: what each key held at its beginning, then what changed."""
    at = nanoseconds(history.start)
    for name, tree in history.first_trees():
        yield Operation(Role.STATE, (name,), _whole(tree), (at, 0, 0), Kind.READ)
    for change in history.changes():
        at = max(nanoseconds(change.time), at + STEP)
        if change.value is PENDING:
            continue  # what it was is not known
        role = Role.DELETE if change.value is MISSING else Role.UPDATE
        yield Operation(role, change.path, _whole(change.value), (at, at, 0), Kind.READ)


def _whole(tree: Any) -> Any:
    """Return a tree with its arrays, and what says so in the place of each that is not kept."""
    return tree if tree is MISSING or tree is UNKNOWN else mapped(thawed(tree), _or_unreadable)


def _or_unreadable(it: Any) -> Any:
    return Unreadable("", f"the page has not kept this {it.summary or it.label}") if isinstance(it, Unfetched) else it
