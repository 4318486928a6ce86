"""How a worker is talked to: one JSON object per line in, one per line out.

`{"do": "prepare", ...}` calls the session's method of that name with the other entries as keywords; the reply
is `{"ok": result}` or `{"error": text}`. A herd is one process that forks many workers and asks them all.
"""

import asyncio
import inspect
import json
import os
import socket
import threading
from typing import Any, TextIO

from .async_session import AsyncSession
from .blocking_session import BlockingSession


def serve(contender: type[Any], requests: int, replies: int) -> None:
    """Answer requests until their end; a contender whose methods are coroutines gets an event loop."""
    lines, answers = os.fdopen(requests), os.fdopen(replies, "w")
    if not contender.asynchronous:
        blocking = BlockingSession(contender)
        for line in lines:
            answer(answers, _blocking_reply(blocking, json.loads(line)))
        return
    first = json.loads(lines.readline())
    with asyncio.Runner(loop_factory=_loop_factory(first)) as runner:
        runner.run(_serve_async(AsyncSession(contender), first, lines, answers))


def _loop_factory(first: dict[str, Any]) -> Any:
    if first.get("target", {}).get("loop") != "uvloop":
        return None
    import uvloop

    return uvloop.new_event_loop


async def _serve_async(session: AsyncSession, request: dict[str, Any], lines: TextIO, answers: TextIO) -> None:
    loop = asyncio.get_running_loop()
    while True:
        answer(answers, await _async_reply(session, request))
        line = await _next_line(loop, lines)
        if not line:
            return
        request = json.loads(line)


async def _next_line(loop: asyncio.AbstractEventLoop, lines: TextIO) -> str:
    """Wait in a daemon thread: the loop goes on, and nothing has to be joined at the end."""
    future: asyncio.Future[str] = loop.create_future()

    def read() -> None:
        line = lines.readline()
        loop.call_soon_threadsafe(future.set_result, line)

    threading.Thread(target=read, daemon=True).start()
    return await future


def answer(answers: TextIO, reply: dict[str, Any]) -> None:
    """Send one reply."""
    answers.write(json.dumps(reply) + "\n")
    answers.flush()


def _split(session: object, request: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    return getattr(session, request["do"]), {key: value for key, value in request.items() if key != "do"}


def _blocking_reply(session: object, request: dict[str, Any]) -> dict[str, Any]:
    try:
        method, keywords = _split(session, request)
        return {"ok": method(**keywords)}
    except Exception as error:  # whatever a contender raises belongs in the report
        return {"error": describe(error)}


async def _async_reply(session: object, request: dict[str, Any]) -> dict[str, Any]:
    try:
        method, keywords = _split(session, request)
        result = method(**keywords)
        return {"ok": await result if inspect.isawaitable(result) else result}
    except Exception as error:  # whatever a contender raises belongs in the report
        return {"error": describe(error)}


def describe(error: BaseException) -> str:
    """Type and first line of an error."""
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[0]}"[:300]


class Herd:
    """Forked workers of one kind. It imports once, so that a hundred processes start in about a second."""

    def __init__(self, contender: type[Any]) -> None:
        self.contender = contender
        self.members: list[tuple[int, TextIO, TextIO]] = []

    def fork(self, count: int) -> int:
        """Start `count` more workers."""
        for _ in range(count):
            mine, theirs = socket.socketpair()
            process = os.fork()
            if process == 0:
                mine.close()
                self._be_a_worker(theirs)
            theirs.close()
            self.members.append((process, mine.makefile("r"), mine.makefile("w")))
            mine.close()
        return len(self.members)

    def _be_a_worker(self, wire: socket.socket) -> None:
        try:
            os.close(0)
            for _, lines, answers in self.members:
                lines.close()
                answers.close()
            serve(self.contender, os.dup(wire.fileno()), wire.detach())
        finally:
            os._exit(0)

    def all(self, request: dict[str, Any]) -> list[Any]:
        """Send one request to every worker, then gather the replies."""
        for _, _, out in self.members:
            answer(out, request)
        replies = [json.loads(lines.readline() or '{"error": "the process ended"}') for _, lines, _ in self.members]
        for reply in replies:
            if "error" in reply:
                raise RuntimeError(reply["error"])
        return [reply["ok"] for reply in replies]

    def disband(self) -> None:
        """End every worker."""
        for _, lines, out in self.members:
            out.close()
            lines.close()
        for process, _, _ in self.members:
            os.waitpid(process, 0)
        self.members.clear()


def serve_herd(contender: type[Any], requests: int, replies: int) -> None:
    """Answer herd requests until their end."""
    preload = getattr(contender, "preload", None)
    if preload:
        preload()
    herd, answers = Herd(contender), os.fdopen(replies, "w")
    for line in os.fdopen(requests):
        answer(answers, _blocking_reply(herd, json.loads(line)))
    herd.disband()
