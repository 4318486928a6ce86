"""What `reem doctor` looks at on the server: facts in, findings out, nothing sent from here."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import NamedTuple

from ...coordination.clock import ClockOffset
from .output import named, size_text

OK, WARN, FAIL, UNKNOWN = "ok", "warn", "fail", "unknown"

# Seconds, of the median. A wired network takes well under a millisecond, a good wireless one 2 to 4.
_SLOW = 0.005
# Seconds: less does not show in time stamps of a camera at 30 Hz.
_CLOCK_APART = 0.01
# Part of the memory.
_NEARLY_FULL = 0.9


class Finding(NamedTuple):
    """One line of the report: what was looked at, how it went, what was found, and what to do."""

    check: str
    status: str
    message: str
    remedy: str = ""


class Facts(NamedTuple):
    """The server's replies to INFO and CONFIG GET; None if this user may not ask."""

    info: Mapping[str, str] | None
    config: Mapping[str, str] | None

    def number(self, name: str) -> int:
        """Return a number from INFO; 0 if it is not there."""
        text = (self.info or {}).get(name, "")
        return int(text) if text.isascii() and text.isdigit() else 0


def not_allowed(check: str, command: str) -> Finding:
    rule = "+" + command.lower().replace(" ", "|")
    return Finding(check, UNKNOWN, f"this user may not run {command}", f"ask as an administrator, or allow {rule}")


def version(facts: Facts, address: str, *, sharded: bool) -> Finding:
    if facts.info is None:
        return Finding("server", OK, f"answers at {address}; this user may not ask for its version")
    name = facts.info.get("server_name", "redis")
    number = facts.info.get(f"{name}_version") or facts.info.get("redis_version", "?")
    # Valkey reports its own version beside the version of Redis that it is compatible with.
    mode = facts.info.get("redis_mode") or facts.info.get("server_mode", "standalone")
    text = f"{name} {number} at {address}, {mode}"
    if mode == "cluster" and not sharded:
        return Finding("server", WARN, text, f"this is one node of several; reach all: redis+cluster://{address}")
    return Finding("server", OK, text)


def json_support(facts: Facts, *, plain: bool) -> Finding:
    if plain:
        return Finding(
            "json", OK, "none: documents are kept as text, and a change below their top takes two round trips"
        )
    for line in (facts.info or {}).get("module", "").split("\n"):
        # One line for each module: name=ReJSON,ver=20803,...
        fields = dict(pair.partition("=")[::2] for pair in line.split(","))
        if fields.get("name") == "ReJSON" and fields.get("ver", "").isdigit():
            number = int(fields["ver"])
            return Finding("json", OK, f"RedisJSON {number // 10000}.{number // 100 % 100}.{number % 100}")
    return Finding("json", OK, "RedisJSON answers; its version is unknown")


def who(
    user: str | None, *, address: str, loopback: bool, by_socket: bool, tls: bool, password: bool
) -> Iterator[Finding]:
    name = f"as user {user}" if user else "as a user whose name it may not ask"
    secrets = f"{'with' if password else 'without'} password, {'with' if tls else 'without'} TLS"
    text = f"connected {name}, {secrets}"
    if loopback:
        way = "reached through its Unix socket" if by_socket else "reached by TCP"
        yield Finding("access", OK, f"{text}; {address} is this machine, {way}")
        return
    if not password:
        yield Finding("access", WARN, f"{text}; {address} is another machine", "set a password on the server")
    if not tls:
        remedy = "use rediss:// with TLS on the server, unless the network is the robot's own"
        yield Finding("access", WARN, f"{text}: what is sent to {address} can be read on the way", remedy)
    elif password:
        yield Finding("access", OK, text)


def is_loopback(host: str) -> bool:
    try:
        found = {entry[4][0] for entry in socket.getaddrinfo(host, None)}
    except OSError:
        return False
    return all(ipaddress.ip_address(str(address).partition("%")[0]).is_loopback for address in found)


def latency(seconds: Sequence[float]) -> Finding:
    ranked = sorted(seconds)
    # With fewer than a hundred readings the 99th percentile is the slowest one.
    middle, late = median(ranked), ranked[min(len(ranked) * 99 // 100, len(ranked) - 1)]
    text = f"a round trip: median {middle * 1000:.2f} ms, p99 {late * 1000:.2f} ms, of {len(ranked)}"
    if middle > _SLOW:
        return Finding(
            "latency", WARN, text, "use a cable, or run the server on the machine that moves the large values"
        )
    return Finding("latency", OK, text)


def clock(found: ClockOffset, where: str = "") -> Finding:
    text = f"{where}the server's clock is {found}"
    # Only what cannot be the uncertainty of the measurement itself.
    if abs(found.offset) - found.bound > _CLOCK_APART:
        remedy = "set both by NTP or chrony; until then `reem delay` and time stamps are off by as much"
        return Finding("clock", WARN, text, remedy)
    return Finding("clock", OK, text)


def memory(facts: Facts) -> Finding:
    if facts.info is None:
        return not_allowed("memory", "INFO")
    used, limit = facts.number("used_memory"), facts.number("maxmemory")
    machine = facts.number("total_system_memory")
    bound = limit or machine
    text = f"{size_text(used)} used"
    if limit:
        text += f" of {size_text(limit)} (maxmemory)"
    elif machine:
        text += f", no maxmemory; the machine has {size_text(machine)}"
    if bound and used > _NEARLY_FULL * bound:
        return Finding("memory", WARN, text, "delete keys (`reem ls` shows sizes), or raise maxmemory")
    return Finding("memory", OK, text)


def eviction(facts: Facts) -> Finding:
    if facts.info is None:
        return not_allowed("eviction", "INFO")
    policy = facts.info.get("maxmemory_policy", "noeviction")
    evicted = facts.number("evicted_keys")
    remedy = "CONFIG SET maxmemory-policy noeviction, as an administrator"
    # What is gone is worse than what may go.
    if evicted:
        return Finding("eviction", FAIL, f"{evicted} keys were thrown away since the server started ({policy})", remedy)
    if policy != "noeviction" and facts.number("maxmemory"):
        return Finding("eviction", WARN, f"{policy}: keys are thrown away when memory is full", remedy)
    return Finding("eviction", OK, f"none ({policy}, maxmemory {facts.number('maxmemory') or 'not set'})")


def old_data(names: Sequence[str]) -> Finding:
    if not names:
        return Finding("old data", OK, "no key was written by REEM 0.1 or older")
    keys = "1 key was" if len(names) == 1 else f"{len(names)} keys were"
    remedy = "`reem migrate` shows what it would convert, `reem migrate --yes` converts it in place"
    return Finding("old data", FAIL, f"{keys} written by REEM 0.1 or older and cannot be read: {named(names)}", remedy)


def orphans(counts: Mapping[str, int], unknown: Mapping[str, str], *, removed: bool) -> Finding:
    total = sum(counts.values())
    text = f"{total} that no document refers to, of {named(list(counts))}" if total else ""
    text = f"removed {text}" if total and removed else text
    if unknown:
        why = f"not known of {named(list(unknown))}: {next(iter(unknown.values()))}"
        return Finding("arrays", UNKNOWN, f"{text}; {why}" if text else why)
    if not total or removed:
        return Finding("arrays", OK, text or "each belongs to a document")
    remedy = "`reem doctor --clean` removes them; they are of keys that expired, or were deleted or renamed by others"
    return Finding("arrays", WARN, text, remedy)


def persistence(facts: Facts) -> Finding:
    if facts.info is None:
        return not_allowed("persistence", "INFO")
    if facts.info.get("rdb_last_bgsave_status", "ok") != "ok" or facts.info.get("aof_last_write_status", "ok") != "ok":
        remedy = "see the server's log; most often the disk is full or the directory is not writable"
        return Finding("persistence", FAIL, "the last save failed, and writes may be refused", remedy)
    if facts.number("aof_enabled"):
        return Finding("persistence", OK, "each write is appended to a file")
    if facts.config is None:
        return not_allowed("persistence", "CONFIG GET")
    if rules := facts.config.get("save", ""):
        return Finding("persistence", OK, f"snapshots to disk (save {rules})")
    remedy = "if it must outlive the server: `reem up --directory DIR`, or appendonly yes"
    return Finding("persistence", WARN, "none: what is stored is gone when the server stops", remedy)
