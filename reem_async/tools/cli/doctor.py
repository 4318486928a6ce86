"""`reem doctor`: is everything as it should be, and if not, what to do."""

from __future__ import annotations

import asyncio
import re
import secrets
import sys
import textwrap
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from importlib import metadata
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reem_async._installation import CURE, original_reem
from reem_async.tools.cli import checks
from reem_async.tools.cli.checks import FAIL, OK, UNKNOWN, WARN, Facts, Finding
from reem_async.tools.cli.options import DEFAULT_URL, AsJson, Namespace, Url
from reem_async.tools.cli.output import clean, emit, emit_json, is_terminal, styled, width
from reem_async.tools.cli.running import FAILED, guarded, interface_to
from reem_async.tools.cli.sharing import local
from reem_async.tools.cli.wording import for_users

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface
    from reem_async.plan.keys import Keys
    from reem_async.session import Session
    from reem_async.transport import Transport

__all__ = ["doctor"]

# Enough for a 99th percentile that is not the slowest one alone.
_ROUND_TRIPS = 200
_MOST_SECONDS = 2.0  # for one kind of round trip: over a slow network there are fewer
# Readings, of which that with the shortest round trip counts.
_CLOCK_READINGS = 20
_NAMES = 10_000  # that are tried to find one in the slots of a node, of a thousand at most
# Large enough for the time that its bytes take to stand out from that of a round trip.
_ARRAY_BYTES = 1_000_000
_LISTENS = 1.0  # seconds: two that publish a key at 2 Hz or more show
_EXTRAS = {
    "server": "a server of its own for `reem up`",
    "fast": "a faster event loop",
    "tools": "recording, replay and the browser",
    "demo": "the demonstration, and .png files",
}
_STYLES = {OK: ("✓", "green"), WARN: ("!", "yellow"), FAIL: ("✗", "red"), UNKNOWN: ("?", "cyan")}


def doctor(
    no_write: Annotated[
        bool, typer.Option("--no-write", help="Store nothing: leaves out how long an array of 1 MB takes.")
    ] = False,
    clean: Annotated[
        bool, typer.Option("--clean", help="Remove arrays that no document refers to, of expired keys for example.")
    ] = False,
    as_json: AsJson = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Check server, connection and installation, and say what to do.

    Each line is ok, warn, fail, or unknown where this user may not look. An array of 1 MB is stored
    for a moment, under a name of its own, to see how long it takes. Of a cluster, all primaries are
    examined, one after the other, and each line names its node, the worst first.

    `--clean` removes the arrays that documents which have expired, or were deleted or renamed by a program without
    REEM, have left behind. What a document refers to is never removed.

    Exit code 1 if something fails.

    Examples:
        reem doctor
        reem doctor --clean
        reem doctor --url redis://robot.local:6379
        reem doctor --json | jq -r 'select(.status != "ok") | .message'
    """
    failed = False

    async def examine() -> None:
        nonlocal failed
        async for node, finding in _findings(url, namespace, write=not no_write, clean=clean):
            failed |= finding.status == FAIL
            _show(node, finding, as_json)

    code = guarded("doctor", lambda: asyncio.run(examine()))
    if code or failed:
        raise typer.Exit(code or FAILED)


def _show(node: str, finding: Finding, as_json: bool) -> None:
    if as_json:
        emit_json({**finding._asdict(), **({"node": node} if node else {})})
        return
    check, status, remedy = finding.check, finding.status, clean(finding.remedy)
    message = clean(f"{node}: {finding.message}" if node else finding.message)
    if not is_terminal():
        emit(f"{status}\t{check}\t{message}" + (f"\t{remedy}" if remedy else ""))
        return
    mark, colour = _STYLES[status]
    room = max(width() - 16, 24)
    first, *others = textwrap.wrap(message, room) or [""]
    emit(f"{styled(mark, colour)} {styled(f'{check:12}', 'bold')}  {first}")
    for line in others:
        emit(" " * 16 + line)
    for line in textwrap.wrap(f"→ {remedy}" if remedy else "", room, subsequent_indent="  "):
        emit(" " * 16 + styled(line, colour))
    sys.stdout.flush()


async def _findings(url: str, namespace: str, *, write: bool, clean: bool) -> AsyncIterator[tuple[str, Finding]]:
    """Yield what is found at the servers, with the node of a cluster that it is about, and of the installation."""
    from reem_async.errors import RedisError

    interface = interface_to(url, namespace)
    transport = interface.session.transport
    try:
        # A cluster's transport connects node by node, below, so that one dead node does not hide the others.
        if not transport.sharded:
            await interface.initialize()
        nodes = await transport.nodes()
        if transport.sharded:
            for found in _worst_first([await _of_node(interface, node, write=write) for node in nodes]):
                yield found
        else:
            async for finding in _of_server(interface, nodes[0], write=write):
                yield "", finding
        yield "", await _old_data(interface)
        yield "", await _orphans(interface, clean=clean)
        yield "", await _publishers(interface)
        yield "", await local(interface)
    except RedisError as error:
        yield "", Finding("server", FAIL, for_users(error))
    finally:
        await interface.close()
    for finding in _of_installation():
        yield "", finding


async def _publishers(interface: RedisInterface) -> Finding:
    """Listen for a moment whether any key is published by two at once."""
    from reem_async.errors import RedisError, ReemError
    from reem_async.tools.cli.following import follow
    from reem_async.tools.cli.top import ALL, Board

    board = Board(ALL)
    try:
        heard = await follow(interface, (), board.take, seconds=_LISTENS)
    except (ReemError, RedisError) as error:
        return Finding("publishers", UNKNOWN, f"the updates that are published cannot be heard: {for_users(error)}")
    doubled = board.warnings()
    if doubled:
        return Finding(
            "publishers", WARN, "; ".join(doubled), "end one of them, or give them other keys; `reem top` shows all"
        )
    what = f"{heard.taken} updates of {len(board.windows)} keys in {_LISTENS:g} s, none of two publishers at once"
    return Finding("publishers", OK, what)


async def _of_node(interface: RedisInterface, node: Transport, *, write: bool) -> list[tuple[str, Finding]]:
    """Return what is found at one node of a cluster; that it does not answer is a finding as well."""
    from reem_async.errors import RedisError

    address, found = node.options.address, list[tuple[str, Finding]]()
    try:
        async for finding in _of_server(interface, node, write=write):
            found.append((address, finding))
    except RedisError as error:
        found.append((address, Finding("server", FAIL, for_users(error))))
    return found


def _worst_first(reports: Sequence[Sequence[tuple[str, Finding]]]) -> list[tuple[str, Finding]]:
    """Return the findings of all nodes check by check, and of each check the worst first."""
    rows = [row for report in reports for row in report]
    checks_in_order = list(dict.fromkeys(finding.check for _, finding in max(reports, key=len, default=())))
    order = {check: place for place, check in enumerate(checks_in_order)}
    # What could not be looked at stands behind what is known to be wrong.
    ranks = {FAIL: 0, WARN: 1, UNKNOWN: 2, OK: 3}
    return sorted(rows, key=lambda row: (order.get(row[1].check, -1), ranks[row[1].status]))


async def _of_server(interface: RedisInterface, server: Transport, *, write: bool) -> AsyncIterator[Finding]:
    """Yield what is found at one server."""
    from reem_async.errors import NoJsonSupport

    session, options = interface.session, server.options
    # Each node of a cluster is timed with a key of its own slots; else it would only say MOVED.
    keys = await _keys_at(session, server)
    # One round trip for all that is asked of the server itself; what the user may not ask is an error in its place.
    info, config, user, kind = await server.roundtrip(
        [
            ("INFO",),
            ("CONFIG", "GET", "client-output-buffer-limit", "save"),
            ("ACL", "WHOAMI"),
            ("JSON.GET",),  # refused, as what it is: that tells whether the server knows it
        ]
    )
    facts = Facts(_info(info), _config(config))
    yield checks.version(facts, options.address, sharded=session.transport.sharded)
    yield checks.json_support(facts, plain=isinstance(kind, NoJsonSupport))
    by_socket = options.socket_path is not None or (options.nearby is not None and options.nearby.way is not None)
    loopback = by_socket or checks.is_loopback(str(options.settings.get("host", "localhost")))
    for finding in checks.who(
        user.decode(errors="replace") if isinstance(user, bytes) else None,
        address=options.address,
        loopback=loopback,
        by_socket=by_socket,
        tls=options.tls,
        password=bool(options.settings.get("password")),
    ):
        yield finding
    seconds = await _timed(server, ("JSON.GET", keys.document, "$"))
    yield checks.latency("small read", "a value", seconds, large=False)
    yield await _array_reads(server, keys) if write else Finding("1 MB array", UNKNOWN, "left out by --no-write")
    yield await _clock(server)
    for check in (checks.memory, checks.eviction, checks.subscribers, checks.persistence):
        yield check(facts)


async def _old_data(interface: RedisInterface) -> Finding:
    """Count the keys of the namespace that are of versions before 1.0, on all servers."""
    from reem_async.errors import RedisError
    from reem_async.legacy.finding import find

    try:
        return checks.old_data([key.name for key in await find(interface.session, stale=False) if key.misread])
    except RedisError as error:
        return Finding("old data", UNKNOWN, f"not all keys can be looked at: {for_users(error)}")


async def _orphans(interface: RedisInterface, *, clean: bool) -> Finding:
    """Count the arrays that no document refers to, on all servers, and `clean` removes them."""
    from reem_async.errors import RedisError
    from reem_async.tools.cli.orphans import find_orphans

    try:
        found = await find_orphans(interface.session, remove=clean)
    except RedisError as error:
        return Finding("arrays", UNKNOWN, f"not all keys can be looked at: {for_users(error)}")
    return checks.orphans(found.counts, {name: for_users(why) for name, why in found.unknown.items()}, removed=clean)


async def _keys_at(session: Session, server: Transport) -> Keys:
    """Return the names of a key that nobody has, and whose slot this server has."""
    for _ in range(_NAMES):
        keys = session.keys(f"reem-doctor-{secrets.token_hex(4)}")
        if await session.transport.owner(keys.document.encode()) is server:
            break
    return keys


def _info(reply: Any) -> Mapping[str, str] | None:
    """Return the fields of INFO; those that come several times (modules) joined by line ends."""
    if not isinstance(reply, bytes | bytearray | str):
        return None
    text = reply if isinstance(reply, str) else bytes(reply).decode(errors="replace")
    fields: dict[str, str] = {}
    for line in text.splitlines():
        name, colon, value = line.partition(":")
        if colon:
            fields[name] = f"{fields[name]}\n{value}" if name in fields else value
    return fields


def _config(reply: Any) -> Mapping[str, str] | None:
    if not isinstance(reply, dict):
        return None
    return {key.decode(): value.decode(errors="replace") for key, value in reply.items()}


async def _array_reads(server: Transport, keys: Keys) -> Finding:
    """Time reading 1 MB, which expires by itself should this program be killed."""
    key = keys.tag + ".array"
    (stored,) = await server.roundtrip([("SET", key, bytes(_ARRAY_BYTES), "EX", "60")])
    if isinstance(stored, Exception):
        return Finding("1 MB array", UNKNOWN, f"it cannot be stored: {stored}", "a user who may write can tell")
    try:
        seconds = await _timed(server, ("GET", key), bulk=True)
    finally:
        await server.roundtrip([("UNLINK", key)])
    return checks.latency("1 MB array", "an array of 1 MB", seconds, large=True)


async def _timed(server: Transport, command: tuple[Any, ...], *, bulk: bool = False) -> list[float]:
    """Return how long each round trip took; raises what the server answers in error."""
    seconds: list[float] = []
    end = time.perf_counter() + _MOST_SECONDS
    while len(seconds) < _ROUND_TRIPS and (not seconds or time.perf_counter() < end):
        start = time.perf_counter()
        (reply,) = await server.roundtrip([command], bulk=bulk)
        seconds.append(time.perf_counter() - start)
        if isinstance(reply, Exception):
            raise reply
    return seconds


async def _clock(server: Transport) -> Finding:
    """Compare clocks: the server read its own in the middle of the shortest round trip, more or less."""
    best: tuple[float, float] | None = None
    for _ in range(_CLOCK_READINGS):
        start = time.time()
        (reply,) = await server.roundtrip([("TIME",)])
        end = time.time()
        if isinstance(reply, Exception):
            return checks.not_allowed("clock", "TIME")
        there = int(reply[0]) + int(reply[1]) / 1e6
        within = (end - start) / 2
        if best is None or within < best[0]:
            # The shorter the round trip, the less the reading can be off: half of it at most.
            best = within, there - (start + end) / 2
    assert best is not None
    return checks.clock(best[1], best[0])


def _of_installation() -> Iterator[Finding]:
    names = ("reem-async", "redis", "hiredis", "numpy", "orjson", "anyio")
    versions = {name: _version(name) for name in names}
    text = ", ".join([f"{name} {number}" for name, number in versions.items() if number])
    python = ".".join(map(str, sys.version_info[:3]))
    missing = [name for name, number in versions.items() if not number]
    if missing:
        yield Finding(
            "libraries", WARN, f"no version is known of {', '.join(missing)}; {text}", "pip install reem-async"
        )
    else:
        yield Finding("libraries", OK, f"Python {python}, {text}")
    if clash := original_reem():
        yield Finding("installation", FAIL, clash, CURE)
    for extra, what in _EXTRAS.items():
        needed = _needed(extra)
        absent = [name for name in needed if not _version(name)]
        if needed and not absent:
            yield Finding(f"[{extra}]", OK, ", ".join([f"{name} {_version(name)}" for name in needed]))
        elif needed:
            yield Finding(
                f"[{extra}]",
                OK,
                f"not installed: {', '.join(absent)}",
                f"for {what}: pip install 'reem-async[{extra}]'",
            )


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _needed(extra: str) -> list[str]:
    """Return the packages that one of REEM's extras brings."""
    try:
        lines = metadata.requires("reem-async") or []
    except metadata.PackageNotFoundError:
        return []
    # A requirement of an extra reads: pillow>=10; extra == 'tools'.
    marked = re.compile(rf"""extra\s*==\s*["']{extra}["']""")
    names = [re.split(r"[^A-Za-z0-9._-]", line, maxsplit=1)[0] for line in lines if marked.search(line)]
    return sorted(name for name in names if name != "reem-async")
