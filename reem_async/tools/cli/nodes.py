"""`reem nodes`: which programs are connected under a name."""

from __future__ import annotations

import dataclasses
import sys
from contextlib import aclosing
from datetime import datetime
from typing import Annotated, Any

import typer

from reem_async.connection import RedisInterface
from reem_async.coordination.presence import NodeInfo
from reem_async.tools.cli.options import DEFAULT_URL, AsJson, Namespace, Url
from reem_async.tools.cli.output import clean, columns, emit, emit_json, is_terminal, named, note, styled
from reem_async.tools.cli.running import NOTHING, run

_HEADERS = ("name", "host", "pid", "since", "publishes", "serves", "owns")


def nodes(
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Print who joins and leaves, until Ctrl-C.")] = False,
    as_json: AsJson = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """List the programs that are connected under a name: RedisInterface(..., name="planner").

    One line for each: name, host, process id, for how long, and what it publishes, serves and owns. A program that was
    killed, stopped or cut off is missing within a second. Where the output is no terminal, tabs separate the columns.

    Exit code 3 if there is none.

    Examples:
        reem nodes
        reem nodes --watch
        reem nodes --json | jq -r .name
    """

    async def work(interface: RedisInterface) -> int:
        if watch:
            await _follow(interface, as_json)
            return 0
        found = await interface.nodes()
        if as_json:
            for node in found:
                emit_json(_data(node))
        elif found:
            header = [_HEADERS] if is_terminal() else []
            rows = header + [_row(node) for node in found]
            columns(rows, ("bold", "", "", "green", "cyan", "cyan", "cyan"), frozenset({2, 3}), shrink=(4, 5, 6, 1, 0))
        else:
            where = f"at {interface.hostname}"
            note(f'no program is connected under a name {where}; give it one: RedisInterface(..., name="planner")')
        return 0 if found else NOTHING

    run("nodes", work, url, namespace, live=watch)


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
    whole = int(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    if whole < 86400:
        return f"{whole // 3600} h {whole % 3600 // 60} min"
    return f"{whole // 86400} d {whole % 86400 // 3600} h"
