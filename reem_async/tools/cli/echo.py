"""`reem echo`: changes as they are published or stored."""

from __future__ import annotations

import asyncio
import dataclasses
import sys
import time
from collections.abc import Sequence
from contextlib import aclosing, suppress
from datetime import datetime
from typing import Annotated, Any

import numpy as np
import typer

from ...connection import RedisInterface
from ...errors import MissingKey, RedisError, ReemError
from ...plan.paths import Path, Pattern, parse_pattern, spelled_out
from ...plan.placeholders import Unfetched
from ...plan.raw import plain_value
from ...plan.trees import MISSING, get, mapped
from ...pubsub.monitor import ANNOUNCED, Event
from ...store.catalog import outline
from .channel import ChannelMessages
from .following import Ending, follow
from .listing import as_data, describe, found_all
from .options import DEFAULT_URL, AsJson, Count, Namespace, Patterns, Timeout, Url
from .output import clean, cut, emit, emit_json, is_terminal, json_text, note, size_text, styled, typed, width
from .running import run

_LARGEST = 1 << 16  # bytes of a key of another program that are fetched to be shown


def echo(
    patterns: Patterns = None,
    count: Count = None,
    timeout: Timeout = None,
    channel: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Print what programs send to this channel with plain PUBLISH, and no keys."),
    ] = None,
    as_json: AsJson = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Print changes as they are published or stored, until Ctrl-C (exit code 0).

    A published update has one line, with the time of the publisher's clock. Plain writes are marked as stored, with
    the time at which they were found; several in a moment may share one line. Of an update of a whole dict, the part
    at the given path is printed. Values over 16 KB do not travel with the notice: size, type and shape are printed.
    Changes of keys of programs without REEM are marked with their Redis type, such as (raw hash). They are read up to
    4 times a second, and up to 64 KB. Lines that begin with # report lost and skipped updates; in JSON they are
    "missed", "gap" and "skipped". A terminal cuts long lines, a pipe does not.

    Examples:
        reem echo
        reem echo processed_info 'robot.*.battery'
        reem echo set_point --count 1 --timeout 5 --json | jq .value
        reem echo raw_image | cat
        reem echo --channel events
    """
    if channel and patterns:
        raise typer.BadParameter("--channel goes with no pattern: it prints what is sent to the channel alone")

    async def work(interface: RedisInterface) -> int:
        skipped = 0

        asked = [parse_pattern(text) for text in patterns or ()]

        async def take(event: Event, ending: Ending) -> None:
            nonlocal skipped
            event = _narrowed(event, asked)
            # How many were skipped since the last line, of a counter that only grows.
            new, skipped = ending.skipped - skipped, ending.skipped
            if as_json:
                emit_json(_for_programs(event, new))
                return
            kind = await _kind(interface, event.path) if event.value is ANNOUNCED and event.size else ""
            for line in _for_people(event, new, kind):
                emit(line)
            sys.stdout.flush()

        await _say_what_is_waited_for(interface, patterns or ())
        if channel:
            return await _messages(interface, channel, count, timeout, as_json=as_json)
        ends: dict[str, Any] = {"count": count, "seconds": timeout}
        return (await follow(interface, patterns or (), take, **ends, stored=True, raw=_LARGEST)).tell()

    run("echo", work, url, namespace, live=True)


async def _messages(
    interface: RedisInterface, channel: str, count: int | None, seconds: float | None, *, as_json: bool
) -> int:
    """Print the messages on a channel until there were `count`, the time is over, or Ctrl-C; return the exit code."""
    ending, start = Ending(stored=True), time.monotonic()
    with suppress(asyncio.CancelledError, TimeoutError):
        async with asyncio.timeout(seconds), ChannelMessages(interface.session, channel) as messages:
            async for payload in messages:
                ending.taken += 1
                value, now = plain_value(payload), time.time()
                if as_json:
                    emit_json({"channel": channel, "received": now, "value": value})
                else:
                    moment, name = styled(_moment(now), "dim"), styled(clean(channel), "bold")
                    emit(f"{moment}  {name}  {_one_line(value)}")
                    sys.stdout.flush()
                if ending.taken == count:
                    break
    ending.seconds = time.monotonic() - start
    ending.timed_out = seconds is not None and ending.taken < (count or 1)
    return ending.tell()


async def _kind(interface: RedisInterface, path: Path) -> str:
    """Return what is at a path now, arrays as type and shape: one round trip, in which none is fetched."""
    try:
        node = await outline(interface, path)
    except (ReemError, RedisError):
        return ""
    text = describe(node, 200)
    if node.kind == "dict" and len(shown := json_text(as_data(node))) <= 1000:
        text = shown
    return f"{text}, "


async def _say_what_is_waited_for(interface: RedisInterface, patterns: Sequence[str]) -> None:
    """Say which of the paths are not there yet: nothing is printed until they are written."""
    for path in patterns:
        with suppress(ReemError, RedisError):
            try:
                async with aclosing(found_all(interface, path)) as places:
                    is_there = await anext(places, None) is not None
            except MissingKey:
                is_there = False
            if not is_there:
                note(f"nothing is stored at {path} yet: waiting for it")


def _narrowed(event: Event, asked: Sequence[Pattern]) -> Event:
    """Return what an update of a whole dict says of the one place in it that was asked for."""
    meant = [pattern for pattern in asked if pattern.concerns(event.path)]
    if len(meant) != 1 or event.value is ANNOUNCED:
        return event
    place = (event.path[0], *spelled_out(meant[0].rest))
    if len(place) <= len(event.path):
        return event
    value = get(event.value, place[len(event.path) :])
    gone = event.deleted or value is MISSING
    return dataclasses.replace(event, path=place, value=None if gone else value, deleted=gone)


def _for_programs(event: Event, skipped: int) -> dict[str, Any]:
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
    elif event.value is not ANNOUNCED:
        entry["value"] = mapped(event.value, _unfetched_as_text) if event.stored else event.value
    if event.stored:
        entry["stored"] = True
    if event.raw:
        entry |= {"raw": event.raw, "changes": event.changes}
    return entry | {"missed": event.missed, "gap": event.gap, "skipped": skipped}


def _for_people(event: Event, skipped: int, kind: str) -> list[str]:
    lines = []
    if event.missed:
        # In the place where they were lost, so that the order of what is printed is the order of what happened.
        lines.append(styled(f"# {event.missed} updates were lost before the next line", "yellow"))
    elif event.gap:
        lines.append(styled("# a gap: the connection broke, or an update was unreadable", "yellow"))
    if skipped:
        lines.append(styled(f"# {skipped} updates were skipped: they came faster than they could be shown", "yellow"))
    moment, path = _moment(event.time), typed(event.path)
    origin = f"raw {event.raw}" if event.raw else "stored" if event.stored else ""
    if event.deleted:
        what = "deleted"
    elif event.value is not ANNOUNCED:
        what = _one_line(event.value)
    else:
        what = f"<{kind}{size_text(event.size)}, not fetched>" if event.size else "<changed, not fetched>"
    # The path has at most half of the line, the value the rest.
    if is_terminal():
        room = width() - len(moment) - 4 - (len(origin) + 4) * bool(origin)
        path = cut(path, max(room // 2, 8))
        what = cut(what, max(room - len(path), 16))
    colour = "red" if event.deleted else "cyan" if event.value is ANNOUNCED else ""
    mark = f"  {styled(f'({origin})', 'dim')}" if origin else ""
    lines.append(f"{styled(moment, 'dim')}  {styled(path, 'bold')}  {styled(what, colour) if colour else what}{mark}")
    return lines


def _moment(when: float) -> str:
    try:
        return datetime.fromtimestamp(when).strftime("%H:%M:%S.%f")
    except (ValueError, OverflowError, OSError):  # a publisher's clock may be set to anything
        return f"{when:g} s"


def _one_line(value: Any) -> str:
    if isinstance(value, np.ndarray):
        body = np.array2string(value, threshold=12, edgeitems=3, max_line_width=10_000, separator=" ")
        return clean(f"{value.dtype}[{','.join(map(str, value.shape))}] {' '.join(body.split())}")
    return json_text(mapped(value, _summarised))


def _unfetched_as_text(leaf: Any) -> Any:
    return f"<{leaf.summary or leaf.label}, {size_text(leaf.size)}>" if isinstance(leaf, Unfetched) else leaf


def _summarised(leaf: Any) -> Any:
    if isinstance(leaf, bytes):
        return f"<bytes, {size_text(len(leaf))}>"
    return _one_line(leaf) if hasattr(leaf, "dtype") else _unfetched_as_text(leaf)
