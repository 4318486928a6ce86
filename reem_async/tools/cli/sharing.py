"""Whether programs of this machine can share memory, and if not, why: a line of `reem doctor`."""

from __future__ import annotations

import asyncio
import os
import secrets
import sys
from typing import TYPE_CHECKING, Any, cast

from reem_async.tools.cli.checks import OK, UNKNOWN, WARN, Finding
from reem_async.tools.cli.wording import for_users

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface
    from reem_async.transport.aio import AsyncTransport

__all__ = ["found", "is_contained", "local", "unseen_by_another"]

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


async def local(interface: RedisInterface) -> Finding:
    """Find out how large values get from one program of this machine to another; starts one, for a moment."""
    from reem_async.errors import RedisError
    from reem_async.local.host import reason_against

    reason = reason_against() or await unseen_by_another()
    if reason:
        return found(reason)
    try:
        usual, near = await _subscribed(interface)
    except RedisError as error:
        return Finding("local", UNKNOWN, f"the server cannot be asked: {for_users(error)}")
    if isinstance(usual, Exception):
        return Finding("local", UNKNOWN, "this user may not follow updates, through memory or otherwise")
    refusal = for_users(near) if isinstance(near, Exception) else ""
    return found("", refusal, contained=is_contained())


def found(reason: str, refusal: str = "", *, contained: bool = False) -> Finding:
    """Return what to say of it.

    Args:
        reason: Why memory cannot be shared here, empty if it can.
        refusal: What the server says to who asks for the channel by which such programs find each other.
        contained: This is a container whose processes have numbers of their own.
    """
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
    from reem_async.local.segment import Segment

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
        await wire.close()
    return usual, near
