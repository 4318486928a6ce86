"""`reem call` and `reem services`: ask a service, and list those that are served."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from reem_async.connection import RedisInterface
from reem_async.coordination.calls import statistics
from reem_async.errors import CallTimeout, NoService
from reem_async.store.store import KeyValueStore
from reem_async.tools.cli.options import DEFAULT_URL, Force, Namespace, PathArgument, Url
from reem_async.tools.cli.output import clean, columns, emit, emit_json, is_terminal, json_text, note, width
from reem_async.tools.cli.running import NOTHING, TIMED_OUT, USAGE, CommandFailed, guarded, run
from reem_async.tools.cli.values import FILES, parse_value, preview, save
from reem_async.tools.partfile import there_already

HEADS = ("service", "host", "pid", "calls", "per second", "median", "errors", "waiting")


def call(
    path: PathArgument,
    arguments: Annotated[
        str, typer.Argument(metavar="[ARGUMENTS]", help="A JSON object: arguments by name. @file.json, or - for stdin.")
    ] = "{}",
    timeout: Annotated[
        float, typer.Option("--timeout", "-t", min=0.001, max=1e6, metavar="S", help="Seconds to wait for the answer.")
    ] = 10.0,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Write it to a file: .npy, .npz, .json, .png, .bin."),
    ] = None,
    force: Force = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Call a service, and print its answer as JSON.

    Exit code 3 if no program serves it, 4 if no answer comes in time.

    Examples:
        reem call planner '{"start": [0, 0], "goal": [3, 4]}'
        reem call arm.home --timeout 30
        reem call policy @observation.json -o actions.npz
    """
    with guarded("call"):
        parsed = parse_value(arguments, is_text=False)
        if not isinstance(parsed, dict) or "timeout" in parsed:
            raise CommandFailed('arguments are a JSON object without "timeout", such as \'{"x": 1}\'', USAGE)
        if output is not None and output.suffix not in FILES:
            raise CommandFailed(f"{output}: the name of a file ends in one of {', '.join(FILES)}", USAGE)

    async def work(interface: RedisInterface) -> None:
        if output is not None and output.exists() and not force:
            raise there_already(output)
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

    run("call", work, url, namespace)


def services(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON in one line.")] = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """List the services, with what each of their servers says.

    A line for each server: where it runs, how many calls it has answered since it began, the rate and median time of
    the last 200, the calls that raised an exception, and the requests that wait or are being handled. A server that
    does not answer within a second has none of these.

    Examples:
        reem services
        reem services --json | jq -r '.[].service'
    """

    async def work(interface: RedisInterface) -> None:
        rows = await statistics(interface.session)
        if as_json:
            emit_json(rows)
            return
        if not rows:
            note("no services")
            return
        columns([HEADS, *map(service_cells, rows)], [""] * len(HEADS), right=frozenset(range(2, 8)))

    run("services", work, url, namespace)


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
