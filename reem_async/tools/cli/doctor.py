"""`reem doctor`: is everything as it should be, and if not, what to do."""

from __future__ import annotations

import asyncio
import os
import re
import sys
import textwrap
import time
from collections.abc import AsyncIterator, Iterator, Mapping
from importlib import metadata
from typing import Annotated, Any

import typer

from ..._installation import CURE, original_reem
from ...connection import RedisInterface
from ...coordination.clock import measure
from ...errors import BadKey, NoJsonSupport, NotAllowed, RedisError, ReemError
from ...legacy.convert import find
from ...local.segment import Segment, reason_against
from ...plan.attachments import orphans, remove_orphans
from ...plan.paths import check_top_key, parse_suffix
from ...plan.sizes import STAGED
from ...session import Session
from ...ships.images import codecs
from ...transport import Transport, scanned
from . import checks
from .checks import FAIL, OK, UNKNOWN, WARN, Facts, Finding
from .following import follow
from .options import DEFAULT_URL, AsJson, Namespace, Url
from .output import clean, emit, emit_json, is_terminal, styled, width
from .raw import how_many, raw_listed
from .running import FAILED, for_users, interface_to, run_local
from .top import ALL, Board

_ROUND_TRIPS = 200  # enough for a 99th percentile that is not the slowest one alone
_MOST_SECONDS = 2.0  # over a slow network there are fewer
# Readings, of which that with the shortest round trip counts.
_CLOCK_READINGS = 20
_LISTENS = 1.0  # seconds: two that publish a key at 2 Hz or more show
_LIBRARIES = ("reem-async", "redis", "hiredis", "numpy", "orjson", "anyio")
_STYLES = {OK: ("✓", "green"), WARN: ("!", "yellow"), FAIL: ("✗", "red"), UNKNOWN: ("?", "cyan")}

_FIRST_NAMESPACE = 0xEFFFFFFC
"""The inode of a machine's own process numbers (PROC_PID_INIT_INO of <linux/proc_ns.h>): a container has another."""
_LOOK = """
import sys
from reem_async.local.segment import LocalReader
from reem_async.plan.notices import Slot
view = LocalReader().view(Slot("", *map(int, sys.argv[1:])), 1)
sys.exit(0 if view is not None and bytes(view) == b"R" else 3)
"""
"""What another process runs to look into the memory of this one."""
_UNSEEN = 3
_PATIENCE = 20.0
"""Seconds for a Python that imports numpy on a slow machine."""
# What carries the tag of a top-level key: {foo}:ships, {foo}.bar.image.
_TAGGED = re.compile(r"\{([^{}]*)\}(.*)", re.DOTALL)
_REGISTRY = ":ships"


def doctor(
    clean: Annotated[
        bool, typer.Option("--clean", help="Remove arrays that no document refers to, of expired keys for example.")
    ] = False,
    as_json: AsJson = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Check server, connection and installation, and say what to do.

    Each line is ok, warn, fail, or unknown where this user may not look. Of a cluster, all primaries are
    examined, one after the other, and each line names its node.

    `--clean` removes the arrays that documents which have expired, or were deleted or renamed by a program without
    REEM, have left behind. What a document refers to is never removed.

    Exit code 1 if something fails.

    Examples:
        reem doctor
        reem doctor --clean
        reem doctor --url redis://robot.local:6379
        reem doctor --json | jq -r 'select(.status != "ok") | .message'
    """

    async def examine() -> int:
        code = 0
        async for node, finding in _findings(url, namespace, clean=clean):
            _show(node, finding, as_json)
            code = FAILED if finding.status == FAIL else code
        return code

    run_local("doctor", lambda: asyncio.run(examine()))


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


async def _findings(url: str, namespace: str, *, clean: bool) -> AsyncIterator[tuple[str, Finding]]:
    """Yield what is found at the servers, with the node of a cluster that it is about, and of the installation."""
    interface = interface_to(url, namespace)
    transport = interface.session.transport
    try:
        # A cluster's transport connects node by node, below, so that one dead node does not hide the others.
        if not transport.sharded:
            await interface.initialize()
        for node in await transport.nodes():
            name = node.options.address if transport.sharded else ""
            try:
                async for finding in _of_server(interface, node):
                    yield name, finding
            except RedisError as error:
                yield name, Finding("server", FAIL, for_users(error))
        yield "", await _old_data(interface)
        yield "", await _orphans(interface, clean=clean)
        yield "", await _others(interface)
        yield "", await _publishers(interface)
        async for finding in _clocks(interface):
            yield "", finding
        yield "", await _sharing()
    except RedisError as error:
        yield "", Finding("server", FAIL, for_users(error))
    finally:
        await interface.close()
    for finding in _of_installation():
        yield "", finding


async def _publishers(interface: RedisInterface) -> Finding:
    """Listen for a moment whether any key is published by two at once."""
    board = Board(ALL)
    try:
        ending = await follow(interface, (), board.take, seconds=_LISTENS)
    except (ReemError, RedisError) as error:
        return Finding("publishers", UNKNOWN, f"published updates cannot be received: {for_users(error)}")
    doubled = board.warnings()
    if doubled:
        return Finding(
            "publishers", WARN, "; ".join(doubled), "end one of them, or give them other keys; `reem top` shows all"
        )
    what = f"{ending.taken} updates of {len(board.windows)} keys in {_LISTENS:g} s, none of two publishers at once"
    return Finding("publishers", OK, what)


async def _of_server(interface: RedisInterface, server: Transport) -> AsyncIterator[Finding]:
    session, options = interface.session, server.options
    # One round trip for all that is asked of the server itself; what the user may not ask is an error in its place.
    info, config, user, kind = await server.roundtrip(
        [
            ("INFO",),
            ("CONFIG", "GET", "save"),
            ("ACL", "WHOAMI"),
            ("JSON.GET",),  # an error: it shows whether the server knows the command
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
    yield await _latency(server)
    yield await _clock(server)
    for check in (checks.memory, checks.eviction, checks.persistence):
        yield check(facts)


async def _old_data(interface: RedisInterface) -> Finding:
    try:
        return checks.old_data([key.name for key in await find(interface.session, stale=False) if key.misread])
    except RedisError as error:
        return Finding("old data", UNKNOWN, f"not all keys can be looked at: {for_users(error)}")


async def _orphans(interface: RedisInterface, *, clean: bool) -> Finding:
    """Count the arrays that no document refers to, on all servers, and `clean` removes them.

    One round trip for about 1000 keys, and one for each top-level key with arrays; two more to remove some of them.
    """
    session = interface.session
    counts, unknown = dict[str, int](), dict[str, str]()
    try:
        tagged = await _tagged(session)
    except RedisError as error:
        return Finding("arrays", UNKNOWN, f"not all keys can be looked at: {for_users(error)}")
    for name, suffixes in sorted(tagged.items()):
        keys = session.keys(name)
        try:
            found = await session.run(orphans(keys, suffixes))
            if found and clean:
                found = await session.run(remove_orphans(keys, suffixes, session.cache))
        # Nothing is known of what belongs to a damaged document, or to one that this user may not read.
        except (ReemError, RedisError) as error:
            unknown[name] = for_users(error)
        else:
            counts |= {name: len(found)} if found else {}
    return checks.orphans(counts, unknown, removed=clean)


async def _others(interface: RedisInterface) -> Finding:
    """Count the keys of programs without REEM."""
    try:
        names = await raw_listed(interface.session)
    except RedisError as error:
        return Finding("raw keys", UNKNOWN, f"not all keys can be looked at: {for_users(error)}")
    text = f"{how_many(names)}; kvs.raw and the tools read them" if names else "no program without REEM stores a key"
    return Finding("raw keys", OK, text)


def _info(reply: Any) -> Mapping[str, str] | None:
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


async def _latency(server: Transport) -> Finding:
    seconds: list[float] = []
    end = time.perf_counter() + _MOST_SECONDS
    while len(seconds) < _ROUND_TRIPS and (not seconds or time.perf_counter() < end):
        start = time.perf_counter()
        (reply,) = await server.roundtrip([("PING",)])
        seconds.append(time.perf_counter() - start)
        if isinstance(reply, Exception):
            return checks.not_allowed("latency", "PING")
    return checks.latency(seconds)


async def _clock(server: Transport) -> Finding:
    try:
        return checks.clock(await measure(server, _CLOCK_READINGS))
    except NotAllowed:
        return checks.not_allowed("clock", "TIME")


async def _clocks(interface: RedisInterface) -> AsyncIterator[Finding]:
    """Yield what named programs say of the clocks of their computers, a line for each computer."""
    try:
        nodes = await interface.nodes()
    except RedisError:
        return
    hosts = {node.host: node.clock for node in nodes if node.clock is not None}
    for host, offset in sorted(hosts.items()):
        yield checks.clock(offset, f"on {host} ")


def _of_installation() -> Iterator[Finding]:
    python = ".".join(map(str, sys.version_info[:3]))
    versions = [f"{name} {metadata.version(name)}" for name in _LIBRARIES]
    yield Finding("libraries", OK, f"Python {python}, {', '.join(versions)}")
    by = codecs()
    lacking = [kind for kind, codec in by.items() if not codec]
    text = ", ".join([f"{kind} by {codec}" for kind, codec in by.items() if codec]) or "none can be read or written"
    yield Finding("pictures", WARN if lacking else OK, text, "pip install 'reem-async[images]'" if lacking else "")
    if clash := original_reem():
        yield Finding("installation", FAIL, clash, CURE)


async def _sharing() -> Finding:
    """Find out how large values get from one program of this machine to another; starts one, for a moment."""
    return shared_memory(reason_against() or await unseen_by_another(), contained=is_contained())


def shared_memory(reason: str, *, contained: bool = False) -> Finding:
    if reason:
        # Elsewhere than on Linux there is nothing that anybody could mend.
        status = WARN if sys.platform == "linux" else OK
        remedy = "allow memfd_create, and /proc of the user's own processes" if status == WARN else ""
        return Finding("local", status, f"no shared memory: {reason}; large values go through the server", remedy)
    where = "in this container (start them with one PID namespace to join them)" if contained else "on this machine"
    text = f"large values go through shared memory between programs of user {os.geteuid()} {where}"
    return Finding("local", OK, f"{text}, to all others through the server")


def is_contained() -> bool:
    """Return whether processes have numbers here that they do not have outside, as in most containers."""
    try:
        return os.stat("/proc/self/ns/pid").st_ino != _FIRST_NAMESPACE
    except OSError:
        return False


async def unseen_by_another() -> str:
    """Return why another process of this user cannot look into the memory of this one; empty if it can."""
    segment = Segment(1)
    number, stamp = segment.put([b"R"], [1]) or (0, 0)
    place = os.getpid(), segment.descriptor, segment.inode, number, stamp
    # -P: not what lies in the folder in which the user happens to be.
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-P", "-c", _LOOK, *map(str, place), stderr=asyncio.subprocess.DEVNULL
    )
    try:
        async with asyncio.timeout(_PATIENCE):
            code = await process.wait()
    except TimeoutError:
        process.kill()
        code = await process.wait()
    if code == _UNSEEN:
        return "another process of this user cannot open the memory of this one (hidepid, or a security module?)"
    return f"a process that was to try it ended with {code}" if code else ""


async def _tagged(session: Session) -> dict[str, list[bytes]]:
    """Return the suffixes of the Redis keys that may be ships' keys, by top-level key."""
    found: dict[str, set[bytes]] = {}
    async for page in scanned(session.transport):
        for name, suffix in filter(None, [_parted(bytes(key), session.namespace) for key in page]):
            of_key = found.setdefault(name, set())
            if suffix != _REGISTRY:  # it names ships' keys, but holds none
                of_key.add(suffix.encode())
    return {name: sorted(suffixes) for name, suffixes in found.items()}


def _parted(key: bytes, namespace: str) -> tuple[str, str] | None:
    """Return top-level key and suffix of what may be a ship's key or a registry; None for any other."""
    try:
        tagged = _TAGGED.fullmatch(key.decode())
        if tagged is None or not tagged[1].startswith(namespace) or tagged[2].startswith(STAGED):
            return None
        name, suffix = check_top_key(tagged[1].removeprefix(namespace)), tagged[2]
        if suffix != _REGISTRY:
            parse_suffix(suffix)
    except (BadKey, UnicodeDecodeError):
        return None
    return name, suffix
