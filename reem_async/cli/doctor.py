"""`reem doctor`: is everything as it should be, and if not, what to do."""

from __future__ import annotations

import asyncio
import re
import secrets
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping
from importlib import metadata
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reem_async.cli import checks
from reem_async.cli.checks import FAIL, OK, UNKNOWN, WARN, Facts, Finding
from reem_async.cli.options import DEFAULT_URL, AsJson, Namespace, Url
from reem_async.cli.output import clean, emit, emit_json, is_terminal, styled, width
from reem_async.cli.running import CALL_SECONDS, FAILED, address_of, for_users, guarded

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface

__all__ = ["doctor"]

_ROUND_TRIPS = 200
_MOST_SECONDS = 2.0  # for one kind of round trip: over a slow network there are fewer
_CLOCK_READINGS = 20
_ARRAY_BYTES = 1_000_000
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
    as_json: AsJson = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Check server, connection and installation, and say what to do.

    Each line is ok, warn, fail, or unknown where this user may not look. An array of 1 MB is stored
    for a moment, under a name of its own, to see how long it takes.

    Exit code 1 if something fails.

    Examples:
        reem doctor
        reem doctor --url redis://robot.local:6379
        reem doctor --json | jq -r 'select(.status != "ok") | .message'
    """
    failed = False

    async def examine() -> None:
        nonlocal failed
        async for finding in _findings(url, namespace, write=not no_write):
            failed |= finding.status == FAIL
            _show(finding, as_json)

    code = guarded("doctor", lambda: asyncio.run(examine()))
    if code or failed:
        raise typer.Exit(code or FAILED)


def _show(finding: Finding, as_json: bool) -> None:
    if as_json:
        emit_json(finding._asdict())
        return
    check, status, message, remedy = finding.check, finding.status, clean(finding.message), clean(finding.remedy)
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


async def _findings(url: str, namespace: str, *, write: bool) -> Any:
    """Yield what is found: the server, the way to it, the installation."""
    from reem_async.connection import RedisInterface
    from reem_async.errors import NoJsonSupport, RedisError

    interface = RedisInterface(address_of(url), namespace=namespace, timeout=CALL_SECONDS)
    missing = ""
    try:
        try:
            await interface.initialize()
        except NoJsonSupport as error:
            missing = str(error)
        async for finding in _of_server(interface, missing, write=write):
            yield finding
    except RedisError as error:
        yield Finding("server", FAIL, for_users(error))
    finally:
        await interface.close()
    for finding in _of_installation():
        yield finding


async def _of_server(interface: RedisInterface, missing: str, *, write: bool) -> Any:
    session = interface.session
    info, config, user = await session.transport.roundtrip(
        [("INFO",), ("CONFIG", "GET", "client-output-buffer-limit", "save"), ("ACL", "WHOAMI")]
    )
    facts = Facts(_info(info), _config(config))
    yield checks.version(facts, interface.hostname, sharded=session.transport.sharded)
    yield checks.json_support(facts, missing)
    options = session.options
    by_socket = options.socket_path is not None or (options.nearby is not None and options.nearby.way is not None)
    loopback = by_socket or checks.is_loopback(str(options.settings.get("host", "localhost")))
    for finding in checks.who(
        user.decode(errors="replace") if isinstance(user, bytes) else None,
        address=interface.hostname,
        loopback=loopback,
        by_socket=by_socket,
        tls=options.tls,
        password=bool(options.settings.get("password")),
    ):
        yield finding
    if not missing:
        yield await _small_reads(interface)
    yield await _array_reads(interface) if write else Finding("1 MB array", UNKNOWN, "left out by --no-write")
    yield await _clock(interface)
    for check in (checks.memory, checks.eviction, checks.subscribers, checks.persistence):
        yield check(facts)


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


async def _small_reads(interface: RedisInterface) -> Finding:
    command = ("JSON.GET", interface.session.keys(f"reem-doctor-{secrets.token_hex(4)}").document, "$")
    return checks.latency("small read", "a value", await _timed(interface, command), large=False)


async def _array_reads(interface: RedisInterface) -> Finding:
    """Time reading 1 MB, which expires by itself should this program be killed."""
    transport = interface.session.transport
    key = interface.session.keys(f"reem-doctor-{secrets.token_hex(4)}").tag + ".array"
    (stored,) = await transport.roundtrip([("SET", key, bytes(_ARRAY_BYTES), "EX", "60")])
    if isinstance(stored, Exception):
        return Finding("1 MB array", UNKNOWN, f"it cannot be stored: {stored}", "a user who may write can tell")
    try:
        seconds = await _timed(interface, ("GET", key), bulk=True)
    finally:
        await transport.roundtrip([("UNLINK", key)])
    return checks.latency("1 MB array", "an array of 1 MB", seconds, large=True)


async def _timed(interface: RedisInterface, command: tuple[Any, ...], *, bulk: bool = False) -> list[float]:
    """Return how long each round trip took; raises what the server answers in error."""
    seconds: list[float] = []
    end = time.perf_counter() + _MOST_SECONDS
    while len(seconds) < _ROUND_TRIPS and (not seconds or time.perf_counter() < end):
        start = time.perf_counter()
        (reply,) = await interface.session.transport.roundtrip([command], bulk=bulk)
        seconds.append(time.perf_counter() - start)
        if isinstance(reply, Exception):
            raise reply
    return seconds


async def _clock(interface: RedisInterface) -> Finding:
    """Compare clocks: the server read its own in the middle of the shortest round trip, more or less."""
    best: tuple[float, float] | None = None
    for _ in range(_CLOCK_READINGS):
        start = time.time()
        (reply,) = await interface.session.transport.roundtrip([("TIME",)])
        end = time.time()
        if isinstance(reply, Exception):
            return checks.not_allowed("clock", "TIME")
        there = int(reply[0]) + int(reply[1]) / 1e6
        within = (end - start) / 2
        if best is None or within < best[0]:
            best = within, there - (start + end) / 2
    assert best is not None
    return checks.clock(best[1], best[0])


def _of_installation() -> Iterator[Finding]:
    names = ("reem", "redis", "hiredis", "numpy", "orjson", "anyio")
    versions = {name: _version(name) for name in names}
    text = ", ".join([f"{name} {number}" for name, number in versions.items() if number])
    python = ".".join(map(str, sys.version_info[:3]))
    missing = [name for name, number in versions.items() if not number]
    if missing:
        yield Finding("libraries", WARN, f"no version is known of {', '.join(missing)}; {text}", "pip install reem")
    else:
        yield Finding("libraries", OK, f"Python {python}, {text}")
    for extra, what in _EXTRAS.items():
        needed = _needed(extra)
        absent = [name for name in needed if not _version(name)]
        if needed and not absent:
            yield Finding(f"[{extra}]", OK, ", ".join([f"{name} {_version(name)}" for name in needed]))
        elif needed:
            yield Finding(
                f"[{extra}]", OK, f"not installed: {', '.join(absent)}", f"for {what}: pip install 'reem[{extra}]'"
            )


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _needed(extra: str) -> list[str]:
    """Return the packages that one of REEM's extras brings."""
    try:
        lines = metadata.requires("reem") or []
    except metadata.PackageNotFoundError:
        return []
    marked = re.compile(rf"""extra\s*==\s*["']{extra}["']""")
    names = [re.split(r"[^A-Za-z0-9._-]", line, maxsplit=1)[0] for line in lines if marked.search(line)]
    return sorted(name for name in names if name != "reem")
