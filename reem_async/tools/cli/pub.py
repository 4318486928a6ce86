"""`reem pub`: publish a value, once or at a rate."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reem_async.tools.cli.options import DEFAULT_URL, Namespace, PathArgument, Text, Url, Value
from reem_async.tools.cli.output import note, write_over
from reem_async.tools.cli.running import prepared, run
from reem_async.tools.cli.values import parse_value

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface
    from reem_async.store.accessor import Accessor

__all__ = ["pub"]

# Hz, with --count and no --rate.
_RATE = 1.0
# Seconds between two looks at how far it is.
_SHOWN_EVERY = 0.5


def pub(
    path: PathArgument,
    value: Value,
    rate: Annotated[
        float | None,
        typer.Option("--rate", "-r", min=0.001, max=100_000, metavar="HZ", help="So often, until Ctrl-C or --count."),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option("--count", "-n", min=1, metavar="N", help="So many times; at 1 Hz if there is no --rate."),
    ] = None,
    is_text: Text = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Publish a value, once or at a rate.

    Stores it as `reem set` does, and tells subscribers. At a rate, an update that is late is not
    made up for. The last line says how many there were, and the rate that was reached.

    Examples:
        reem pub set_point '{"speed": 0.5}'
        reem pub set_point.speed 0.5 --rate 100
        reem pub beep true --rate 2 --count 10
        reem pub map @map.npy
    """
    parsed = prepared("pub", lambda: parse_value(value, is_text=is_text))
    repeated = rate is not None or count is not None

    async def work(interface: RedisInterface) -> None:
        from reem_async.store.publish import PublishSpace

        place = PublishSpace(interface).at(path)
        if repeated:
            until = "" if count else " until Ctrl-C"
            await _repeat(place, parsed, rate or _RATE, count, f"publishing {path} at {rate or _RATE:g} Hz{until}")
        else:
            await place.write(parsed)

    run("pub", work, url, namespace, live=repeated)


async def _repeat(place: Accessor, value: Any, rate: float, count: int | None, said: str) -> None:
    """Publish `count` times, or until Ctrl-C; `said` is printed once the first one was taken."""
    start, done, late = time.monotonic(), 0, 0
    due, shown = start, start
    try:
        while done != count:
            await place.write(value)
            done += 1
            if done == 1:
                note(said)
            if time.monotonic() > shown + _SHOWN_EVERY:
                shown = time.monotonic()
                write_over(f"{done} times in {shown - start:.1f} s, {(done - 1) / (shown - start):.1f} Hz")
            if done == count:
                break
            # By the plan and not from now on, so that the rate is kept however long each call takes.
            due += 1 / rate
            now = time.monotonic()
            if now > due + 1 / rate:  # more than one behind: go on from here
                late, due = late + 1, now
            await asyncio.sleep(max(due - now, 0))
    except asyncio.CancelledError:  # Ctrl-C
        pass
    seconds = time.monotonic() - start
    write_over("")
    reached = f", {(done - 1) / seconds:.1f} Hz" if done > 1 and seconds > 0 else ""
    note(f"published {done} times in {seconds:.1f} s{reached}" + (f", {late} times late" if late else ""))
