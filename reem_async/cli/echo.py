"""`reem echo`: updates as they are published."""

from __future__ import annotations

import sys
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reem_async.cli.following import Ending, follow
from reem_async.cli.options import DEFAULT_URL, AsJson, Count, Namespace, Patterns, Timeout, Url
from reem_async.cli.output import clean, cut, emit, emit_json, is_terminal, json_text, size_text, styled, typed, width
from reem_async.cli.running import run

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface
    from reem_async.monitor import Event

__all__ = ["echo"]


def echo(
    patterns: Patterns = None,
    fetch: Annotated[
        bool,
        typer.Option("--fetch", help="Fetch values too large for the notice: what is there now, which may be newer."),
    ] = False,
    full: Annotated[bool, typer.Option("--full", help="Do not cut lines to the width of the terminal.")] = False,
    count: Count = None,
    timeout: Timeout = None,
    as_json: AsJson = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Print updates as they are published, until Ctrl-C (exit code 0).

    The time is that of the publisher's clock. What is written with a PublishSpace is heard, not what
    a KeyValueStore writes. Values over 16 KB do not travel with the notice: their size is printed.
    Updates that were lost or skipped are told in a line that begins with #; in JSON they are
    "missed", "gap" and "skipped".

    Examples:
        reem echo
        reem echo processed_info 'robot.*.battery'
        reem echo set_point --count 1 --timeout 5 --json | jq .value
        reem echo raw_image --fetch
    """

    async def work(interface: RedisInterface) -> int:
        from reem_async.errors import MissingKey
        from reem_async.monitor import ANNOUNCED
        from reem_async.store import KeyValueStore

        store, skipped = KeyValueStore(interface), 0

        async def take(event: Event, ending: Ending) -> None:
            nonlocal skipped
            value, known = event.value, event.value is not ANNOUNCED
            if fetch and not known:
                try:
                    value, known = await _at(store, event).read(), True
                except MissingKey:
                    value, known = "gone already", True
            new, skipped = ending.skipped - skipped, ending.skipped
            if as_json:
                emit_json(_for_programs(event, value if known else None, known, new))
                return
            for line in _for_people(event, value, known, new, cut_lines=is_terminal() and not full):
                emit(line)
            sys.stdout.flush()

        return (await follow(interface, patterns or (), take, count=count, seconds=timeout)).tell()

    run("echo", work, url, namespace, live=True)


def _at(store: Any, event: Event) -> Any:
    place = store[event.name]
    for key in event.path[1:]:
        place = place[key]
    return place


def _for_programs(event: Event, value: Any, known: bool, skipped: int) -> dict[str, Any]:
    entry = {
        "path": typed(event.path),
        "time": event.time,
        "received": event.received,
        "size": event.size,
        "publisher": event.publisher,
        "sequence": event.sequence,
    }
    if event.deleted:
        entry["deleted"] = True
    elif known:
        entry["value"] = value
    return entry | {"missed": event.missed, "gap": event.gap, "skipped": skipped}


def _for_people(event: Event, value: Any, known: bool, skipped: int, *, cut_lines: bool) -> list[str]:
    lines = []
    if event.missed:
        lines.append(styled(f"# {event.missed} updates were lost before the next line", "yellow"))
    elif event.gap:
        lines.append(styled("# a gap: the connection broke, or an update was unreadable", "yellow"))
    if skipped:
        lines.append(styled(f"# {skipped} updates were skipped: they came faster than they could be shown", "yellow"))
    moment, path = _moment(event.time), typed(event.path)
    if event.deleted:
        what = "deleted"
    elif known:
        what = _one_line(value)
    else:
        what = f"<{size_text(event.size)}, not fetched>" if event.size else "<changed, not fetched>"
    if cut_lines:
        room = width() - len(moment) - 4
        path = cut(path, max(room // 2, 8))
        what = cut(what, max(room - len(path), 16))
    colour = "red" if event.deleted else "" if known else "cyan"
    lines.append(f"{styled(moment, 'dim')}  {styled(path, 'bold')}  {styled(what, colour) if colour else what}")
    return lines


def _moment(time: float) -> str:
    try:
        return datetime.fromtimestamp(time).strftime("%H:%M:%S.%f")
    except (ValueError, OverflowError, OSError):  # a publisher's clock may be set to anything
        return f"{time:g} s"


def _one_line(value: Any) -> str:
    """Return a value in one line; arrays as their type and first and last numbers."""
    import numpy as np

    if isinstance(value, np.ndarray):
        body = np.array2string(value, threshold=12, edgeitems=3, max_line_width=10_000, separator=" ")
        return clean(f"{value.dtype}[{','.join(map(str, value.shape))}] {' '.join(body.split())}")
    return json_text(_summarised(value))


def _summarised(value: Any) -> Any:
    """Return a tree with a text in place of each array and of bytes."""
    if isinstance(value, dict):
        return {key: _summarised(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_summarised(item) for item in value]
    if isinstance(value, bytes):
        return f"<bytes, {size_text(len(value))}>"
    return _one_line(value) if hasattr(value, "dtype") else value
