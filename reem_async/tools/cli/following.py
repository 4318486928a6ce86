"""Live commands: taking the updates of some patterns until Ctrl-C, a count or a time."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ...concurrency.queues import Last
from ...concurrency.streams import Stream
from ...connection import RedisInterface
from ...errors import NotAllowed, ReemError
from ...plan.notices import LARGEST_INLINE
from ...plan.paths import parse_shown
from ...pubsub.monitor import Event, Monitor
from ...pubsub.pattern_watch import PatternWatch
from ...pubsub.raw_watch import RawWatch
from .output import counted, emit_json, note, write_over
from .running import TIMED_OUT

_WAITING = 100_000
"""Updates that wait for a slow terminal before the oldest are skipped."""

_PACE = 0.25  # seconds between two readings of such keys: each may keep a writer waiting for a moment

_NEVER = float("inf")


@dataclass(slots=True)
class Ending:
    """What a live command has received, for its last line."""

    taken: int = 0
    lost: int = 0  # on the way: their publishers counted them
    skipped: int = 0  # came faster than they were taken, and were dropped here
    gaps: int = 0  # the connection broke or a message was unreadable
    seconds: float = 0.0
    timed_out: bool = False
    stored: bool = False  # plain writes are followed, too

    def tell(self) -> int:
        """Say in one line how it went; return the exit code."""
        words = [f"{counted(self.taken, 'update')} in {self.seconds:.1f} s", f"{self.lost} lost"]
        if self.gaps:
            words.append(f"{self.gaps} gaps of unknown length")
        if self.skipped:
            words.append(f"{self.skipped} skipped here, since they came too fast")
        if not self.taken and not self.stored:
            words.append("published updates only: writes of a KeyValueStore do not count")
        if sys.stderr.isatty():
            sys.stderr.write("\r")  # over the ^C that the terminal has shown
        note(", ".join(words))
        return TIMED_OUT if self.timed_out else 0


async def follow(
    interface: RedisInterface,
    patterns: Sequence[str],
    take: Callable[[Event, Ending], Awaitable[None] | None],
    *,
    count: int | None = None,
    seconds: float | None = None,
    every: float | None = None,
    tick: Callable[[Ending], None] = lambda _: None,
    stored: bool = False,
    raw: int | None = None,
) -> Ending:
    """Hand each update to `take` until there were `count`, `seconds` are over, or Ctrl-C; call `tick` in between.

    With `stored`, plain writes are handed on, too; arrays of over 16 KB are not fetched for that. With `raw`, changes
    of keys of other programs are, which are fetched up to so many bytes.
    """
    ending, start = Ending(), time.monotonic()
    end = start + seconds if seconds else _NEVER
    next_tick = start + every if every else _NEVER
    # A bounded queue: a terminal that is slower than the updates skips the oldest, and the last line says how many.
    monitor = Monitor(interface, patterns or ("*",), Last(_WAITING))
    ending.stored = stored
    try:
        async with contextlib.AsyncExitStack() as stack:
            await stack.enter_async_context(monitor)
            if stored:
                await stack.enter_async_context(_stores(interface, patterns, monitor))
            if raw is not None:
                await stack.enter_async_context(_others(interface, monitor, raw))
            while ending.taken != count:
                # Wakes for the next report too, since a table must age while nothing is published.
                event = await _next(monitor, min(end, next_tick))
                ending.seconds, ending.skipped = time.monotonic() - start, monitor.dropped
                if event is not None:
                    ending.taken += 1
                    ending.lost += event.missed
                    # A loss whose number is known is counted as lost, not as a gap as well.
                    ending.gaps += event.gap and not event.missed
                    result = take(event, ending)
                    if result is not None:
                        await result
                now = time.monotonic()
                if end > now >= next_tick and every:  # at the end the caller shows all there is
                    tick(ending)
                    # Reports that a slow terminal has missed are not made up for.
                    next_tick = max(next_tick + every, time.monotonic())
                if now >= end and ending.taken != count:
                    ending.timed_out = count is not None or not ending.taken
                    break
    except asyncio.CancelledError:  # Ctrl-C, which is how such a command is ended
        pass
    ending.seconds = time.monotonic() - start
    return ending


@contextlib.asynccontextmanager
async def _stores(interface: RedisInterface, patterns: Sequence[str], monitor: Monitor) -> AsyncIterator[None]:
    """Have what is only stored come out of a monitor, too."""
    watch = PatternWatch(interface.session, patterns, Last(_WAITING), largest=LARGEST_INLINE)
    try:
        await watch.listen()
    except ReemError as error:
        note(f"plain writes are not shown: {error}")

    async def hand_on() -> None:
        async for update in watch:
            if update.origin == "stored":
                path, now = parse_shown(update.path), time.time()
                monitor.queue.put(Event(path, update.value, update.deleted, 0, now, now, "", 0, stored=True))

    async with _handing_on(hand_on, watch):
        yield


@contextlib.asynccontextmanager
async def _others(interface: RedisInterface, monitor: Monitor, largest: int) -> AsyncIterator[None]:
    """Have changes of keys of other programs come out of a monitor, too, unless there is a namespace."""
    tops = [pattern.top for pattern in monitor.patterns]
    watch = RawWatch(interface.session, tops, Last(_WAITING), largest, pace=_PACE, lazy=True)
    try:
        if interface.namespace:
            await watch.close()
        else:
            await watch.listen()
    except ReemError as error:
        note(f"keys of programs without REEM are not shown: {error}")
        await watch.close()

    async def hand_on() -> None:
        try:
            async for update in watch:
                if update.origin == "stored":
                    path, now = (update.path,), time.time()
                    event = Event(path, update.value, update.deleted, update.size, now, now, "", 0, stored=True)
                    monitor.queue.put(replace(event, raw=update.kind, changes=update.changes))
        except NotAllowed as error:
            note(f"keys of programs without REEM are not shown: {error}")

    async with _handing_on(hand_on, watch):
        yield


@contextlib.asynccontextmanager
async def _handing_on(work: Callable[[], Coroutine[Any, Any, None]], watch: Stream[Any]) -> AsyncIterator[None]:
    task = asyncio.create_task(work())
    try:
        yield
    finally:
        task.cancel()
        await watch.close()


@contextlib.asynccontextmanager
async def progress(
    text: Callable[[], str], data: Callable[[], dict[str, Any]], every: float, *, as_json: bool
) -> AsyncIterator[None]:
    """Show how something is getting on: a line in place of the last one, or for scripts a line of JSON a second."""

    async def show() -> None:
        while True:
            await asyncio.sleep(1.0 if as_json else every)
            if as_json:
                emit_json(data())
            else:
                write_over(text())

    task = asyncio.create_task(show())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        write_over("")


async def _next(monitor: Monitor, when: float) -> Event | None:
    """Return the next update, None if there is none by `when`."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(None if when == _NEVER else max(when - time.monotonic(), 0)):
            return await anext(monitor)
    return None
