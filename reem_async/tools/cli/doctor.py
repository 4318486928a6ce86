"""`reem doctor`: is everything as it should be, and if not, what to do."""

from __future__ import annotations

import asyncio
import os
import re
import secrets
import sys
import textwrap
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from importlib import metadata
from typing import Annotated, Any, cast

import typer

from reem_async._installation import CURE, original_reem
from reem_async.connection import RedisInterface
from reem_async.errors import BadKey, NoJsonSupport, RedisError, ReemError
from reem_async.legacy.finding import find
from reem_async.local.host import reason_against
from reem_async.local.segment import Segment
from reem_async.plan.attachments import orphans, remove_orphans
from reem_async.plan.keys import Keys
from reem_async.plan.paths import check_top_key, parse_suffix
from reem_async.plan.sizes import STAGED
from reem_async.session import Session
from reem_async.tools.cli import checks
from reem_async.tools.cli.checks import FAIL, OK, UNKNOWN, WARN, Facts, Finding
from reem_async.tools.cli.following import follow
from reem_async.tools.cli.options import DEFAULT_URL, AsJson, Namespace, Url
from reem_async.tools.cli.output import clean, emit, emit_json, is_terminal, styled, width
from reem_async.tools.cli.running import FAILED, for_users, interface_to, run_local
from reem_async.tools.cli.top import ALL, Board
from reem_async.transport import Transport, scanned
from reem_async.transport.aio import AsyncTransport

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
    "demo": "the picture of `make demo`",
}
_STYLES = {OK: ("✓", "green"), WARN: ("!", "yellow"), FAIL: ("✗", "red"), UNKNOWN: ("?", "cyan")}

_FIRST_NAMESPACE = 0xEFFFFFFC
"""The inode of a machine's own process numbers (PROC_PID_INIT_INO of <linux/proc_ns.h>): a container has another."""
_LOOK = """
import sys
from reem_async.local.reader import LocalReader
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

    async def examine() -> int:
        code = 0
        async for node, finding in _findings(url, namespace, write=not no_write, clean=clean):
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


async def _findings(url: str, namespace: str, *, write: bool, clean: bool) -> AsyncIterator[tuple[str, Finding]]:
    """Yield what is found at the servers, with the node of a cluster that it is about, and of the installation."""
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
        yield "", await _sharing(interface)
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


async def _of_node(interface: RedisInterface, node: Transport, *, write: bool) -> list[tuple[str, Finding]]:
    """Return what is found at one node of a cluster; that it does not answer is a finding as well."""
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
    session, options = interface.session, server.options
    # Each node of a cluster is timed with a key of its own slots; else it would only say MOVED.
    keys = await _keys_at(session, server)
    # One round trip for all that is asked of the server itself; what the user may not ask is an error in its place.
    info, config, user, kind = await server.roundtrip(
        [
            ("INFO",),
            ("CONFIG", "GET", "client-output-buffer-limit", "save"),
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
    seconds = await _timed(server, ("JSON.GET", keys.document, "$"))
    yield checks.latency("small read", "a value", seconds, large=False)
    yield await _array_reads(server, keys) if write else Finding("1 MB array", UNKNOWN, "left out by --no-write")
    yield await _clock(server)
    for check in (checks.memory, checks.eviction, checks.subscribers, checks.persistence):
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


async def _keys_at(session: Session, server: Transport) -> Keys:
    """Return the names of an unused key whose slot this server has."""
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
        return Finding("1 MB array", UNKNOWN, f"it cannot be stored: {stored}", "run it as a user that can write")
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


async def _sharing(interface: RedisInterface) -> Finding:
    """Find out how large values get from one program of this machine to another; starts one, for a moment."""
    reason = reason_against() or await unseen_by_another()
    if reason:
        return shared_memory(reason)
    try:
        usual, near = await _subscribed(interface)
    except RedisError as error:
        return Finding("local", UNKNOWN, f"the server cannot be asked: {for_users(error)}")
    if isinstance(usual, Exception):
        return Finding("local", UNKNOWN, "this user may not follow updates, through memory or otherwise")
    refusal = for_users(near) if isinstance(near, Exception) else ""
    return shared_memory("", refusal, contained=is_contained())


def shared_memory(reason: str, refusal: str = "", *, contained: bool = False) -> Finding:
    otherwise = "large values go through the server"
    if reason:
        # Elsewhere than on Linux there is nothing that anybody could mend.
        status = WARN if sys.platform == "linux" else OK
        remedy = "allow memfd_create, and /proc of the user's own processes" if status == WARN else ""
        return Finding("local", status, f"no shared memory: {reason}; {otherwise}", remedy)
    if refusal:
        remedy = "allow the channels &{...}:notices@* beside &{...}:notices, as deploy/users.acl does"
        return Finding("local", WARN, f"no shared memory: {refusal}; {otherwise}", remedy)
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


async def _subscribed(interface: RedisInterface) -> tuple[Any, Any]:
    """Return what the server replies to a subscription to a key's usual channel, and to that of this machine."""
    session = interface.session
    keys = session.keys(f"reem-doctor-{secrets.token_hex(4)}")
    node = cast("AsyncTransport", await session.transport.owner(keys.channel.encode()))
    subscribe = "SSUBSCRIBE" if session.transport.sharded else "SUBSCRIBE"
    wire = await node.listen(lambda _: None, lambda *_: None)
    try:
        usual, near = await wire.roundtrip([(subscribe, keys.channel), (subscribe, session.local.channel(keys))])
    finally:
        await wire.discard()
    return usual, near


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
