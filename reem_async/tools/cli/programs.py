"""`reem nodes`, `services` and `call`: which programs are connected, what they serve, and asking for it."""

from __future__ import annotations

import asyncio
import dataclasses
import sys
from collections.abc import Coroutine
from contextlib import aclosing, suppress
from datetime import datetime, timedelta
from typing import Annotated, Any

import numpy as np
import typer

from ...connection import RedisInterface
from ...coordination.calls import statistics
from ...coordination.presence import NodeInfo
from ...errors import CallTimeout, NoService
from ...store.store import KeyValueStore
from .options import AsJson, Force, Output, PathArgument, with_server
from .output import clean, columns, emit, emit_json, is_terminal, json_text, named, note, styled, width
from .running import NOTHING, TIMED_OUT, USAGE, CommandFailed
from .values import check_output, parse_value, preview, save

_HEADERS = ("name", "host", "pid", "since", "publishes", "serves", "owns")


@with_server("nodes")
async def nodes(
    interface: RedisInterface,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Print who joins and leaves, until Ctrl-C.")] = False,
    as_json: AsJson = False,
) -> int:
    """List the programs that are connected under a name: RedisInterface(..., name="planner").

    One line for each: name, host, process id, for how long, and what it publishes, serves and owns. A program that was
    killed, stopped or cut off is missing within a second. Where the output is no terminal, tabs separate the columns.

    Exit code 3 if there is none.

    Examples:
        reem nodes
        reem nodes --watch
        reem nodes --json | jq -r .name
    """
    if watch:
        with suppress(asyncio.CancelledError):  # Ctrl-C
            await _follow(interface, as_json)
        return 0
    found = await interface.nodes()
    if as_json:
        for node in found:
            emit_json(_data(node))
    elif found:
        styles = ("bold", "", "", "green", "cyan", "cyan", "cyan")
        columns(map(_row, found), styles, frozenset({2, 3}), shrink=(4, 5, 6, 1, 0), heads=_HEADERS)
    else:
        where = f"at {interface.hostname}"
        note(f'no program is connected under a name {where}; give it one: RedisInterface(..., name="planner")')
    return 0 if found else NOTHING


async def _follow(interface: RedisInterface, as_json: bool) -> None:
    async with aclosing(interface.watch_nodes()) as events:
        async for event in events:
            node = event.node
            if as_json:
                emit_json({"event": event.kind, "initial": event.initial, **_data(node)})
                continue
            kind = "there" if event.initial else event.kind
            colour = {"there": "cyan", "joined": "green", "left": "yellow"}[kind]
            where = clean(f"{node.name}  {node.host}  pid {node.pid}")
            emit(f"{datetime.now():%H:%M:%S}  {styled(f'{kind:6}', colour)}  {where}  {_duration(node.since)}")
            sys.stdout.flush()


def _data(node: NodeInfo) -> dict[str, Any]:
    return {**dataclasses.asdict(node), "since": round(node.since, 1)}


def _row(node: NodeInfo) -> tuple[str, ...]:
    lists = [
        named(names, 3) if is_terminal() else ",".join(names) for names in (node.publishes, node.serves, node.owns)
    ]
    return (node.name, clean(node.host), str(node.pid), _duration(node.since), *(clean(text) or "-" for text in lists))


def _duration(seconds: float) -> str:
    return str(timedelta(seconds=int(seconds)))


HEADS = ("service", "host", "pid", "calls", "per second", "median", "errors", "waiting")


@with_server("call")
def call(
    interface: RedisInterface,
    path: PathArgument,
    arguments: Annotated[
        str, typer.Argument(metavar="[ARGUMENTS]", help="A JSON object: arguments by name. @file.json, or - for stdin.")
    ] = "{}",
    timeout: Annotated[
        float, typer.Option("--timeout", "-t", min=0.001, max=1e6, metavar="S", help="Seconds to wait for the answer.")
    ] = 10.0,
    output: Output = None,
    force: Force = False,
) -> Coroutine[Any, Any, None]:
    """Call a service, and print its answer as JSON.

    Exit code 3 if no program serves it, 4 if no answer comes in time.

    Examples:
        reem call planner '{"start": [0, 0], "goal": [3, 4]}'
        reem call arm.home --timeout 30
        reem call policy @observation.json -o actions.npz
    """
    parsed = parse_value(arguments, is_text=False)
    if not isinstance(parsed, dict) or "timeout" in parsed:
        raise CommandFailed('arguments are a JSON object without "timeout", such as \'{"x": 1}\'', USAGE)
    check_output(output, force=force)

    async def work() -> None:
        try:
            answer = await KeyValueStore(interface).at(path).call(timeout=timeout, **parsed)
        except NoService as error:
            raise CommandFailed(str(error), NOTHING) from None
        except CallTimeout as error:
            raise CommandFailed(str(error), TIMED_OUT) from None
        if output is not None:
            note(save(answer, output, path, replace=force))
        elif isinstance(answer, np.ndarray):
            emit(preview(answer, width() if is_terminal() else 100))
        else:
            emit(json_text(answer, pretty=True))

    return work()


@with_server("services")
async def services(
    interface: RedisInterface, as_json: Annotated[bool, typer.Option("--json", help="Print JSON in one line.")] = False
) -> None:
    """List the services, with what each of their servers says.

    A line for each server: where it runs, how many calls it has answered since it began, the rate and median time of
    the last 200, the calls that raised an exception, and the requests that wait or are being handled. A server that
    does not answer within a second has none of these.

    Examples:
        reem services
        reem services --json | jq -r '.[].service'
    """
    rows = await statistics(interface.session)
    if as_json:
        emit_json(rows)
        return
    if not rows:
        note("no services")
        return
    columns([HEADS, *map(service_cells, rows)], [""] * len(HEADS), right=frozenset(range(2, 8)))


def service_cells(row: dict[str, Any]) -> list[str]:
    """Return a line of the table; a dash for what a server did not say."""
    said = [
        row["pid"],
        row["calls"],
        row["rate"] and f"{row['rate']:.1f}",
        row["median"] and f"{row['median'] * 1e3:.1f} ms",
        row["errors"],
        row["waiting"],
    ]
    return [clean(row["service"]), clean(row["host"] or "-"), *("-" if each is None else str(each) for each in said)]
