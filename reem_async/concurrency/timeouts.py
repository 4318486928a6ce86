"""How long a call may stand still: the interface's limit, or another one for the calls in a `with` block."""

from __future__ import annotations

import array
import asyncio
import fcntl
import socket
import struct
import sys
import termios
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from contextvars import ContextVar

from ..plan.arguments import check_number

LONGEST = 1e6  # seconds that a time limit may have: eleven days, which is as good as none
LOOKS = 160  # per time limit, whether a large value is moving: the limit begins at the last look that saw it move

_DELAYED = 0.04  # seconds after which the other side's kernel confirms the last bytes: TCP's delayed acknowledgement

_TCP_INFO = getattr(socket, "TCP_INFO", None) if sys.platform == "linux" else None
_BYTES_ACKED = 120  # where tcpi_bytes_acked is in Linux's struct tcp_info: 64 bits

_given: ContextVar[float | None] = ContextVar("reem timeout", default=None)


_TURNS = 100  # turns of an event loop that a time limit for the server lasts at least: a handshake takes about thirty


@asynccontextmanager
async def server_timeout(seconds: float) -> AsyncIterator[None]:
    """Raise TimeoutError after `seconds`, of which a turn of the event loop counts a hundredth at most.

    While other tasks compute, no answer can be seen.
    """
    loop = asyncio.get_running_loop()
    timer: asyncio.TimerHandle | None = None

    def count(left: int) -> None:
        nonlocal timer
        if left:
            timer = loop.call_later(seconds / _TURNS, count, left - 1)
        else:
            limit.reschedule(loop.time())

    async with asyncio.timeout(None) as limit:
        count(_TURNS)
        try:
            yield
        finally:
            if timer is not None:
                timer.cancel()


@contextmanager
def timeout(seconds: float) -> Iterator[None]:
    """Give every call of REEM inside the block another time limit than its interface's.

    A call is given up once no byte has moved for that long, in either direction, while its reply is
    due: a large array on a slow link is not cut off. It holds for the calls of this task or thread. `watch.next()` and
    `mirror.wait_until()`, which have no limit of their own, wait for that long. A loop over a watch, and Python's
    `next(watch)`, wait without a limit.

    Args:
        seconds: The limit, above 0.

    Raises:
        BadType, BadValue: Not a number above 0, up to a million.
    """
    token = _given.set(check_timeout(seconds))
    try:
        yield
    finally:
        _given.reset(token)


def waiting_limit(seconds: float | None) -> float | None:
    """Return `seconds`, else the limit of the `with timeout(...)` block around; raises BadType or BadValue."""
    if seconds is None:
        return _given.get()
    check_number("timeout", seconds, "use seconds, 0 or more, or None for no limit")
    return float(min(seconds, LONGEST))


def forget() -> None:
    _given.set(None)


def check_timeout(seconds: float) -> float:
    check_number("timeout", seconds, "use seconds above 0, up to a million", above=0, most=LONGEST)
    return float(seconds)


def time_limit(default: float) -> float:
    given = _given.get()
    return default if given is None else given


def moved_last(last: float, now: float, before: int, left: int, limit: float) -> float:
    """Return when a byte of a large value on its way up moved last.

    It had moved at `last` by the last look, at which `before` bytes were not confirmed. Now `left` are not.
    """
    if left >= before:
        return last
    return now if left else max(last, now - min(_DELAYED, limit / 25))


def unsent(connected: socket.socket | None) -> int:
    """Return how many bytes the other side has not confirmed yet, 0 where the kernel does not say."""
    if connected is None:
        return 0
    count = array.array("i", [0])
    try:
        fcntl.ioctl(connected.fileno(), termios.TIOCOUTQ, count)
    except (OSError, ValueError):
        return 0
    return count[0]


def confirmed(connected: socket.socket | None) -> int:
    """Return how many bytes the other side has confirmed since it was connected, 0 where the kernel does not say.

    For TLS, where what waits to be sent is spread over layers that cannot be asked.
    """
    if connected is None or _TCP_INFO is None:
        return 0
    try:
        info = connected.getsockopt(socket.IPPROTO_TCP, _TCP_INFO, _BYTES_ACKED + 8)
    except OSError:
        return 0
    return int(struct.unpack_from("=Q", info, _BYTES_ACKED)[0]) if len(info) == _BYTES_ACKED + 8 else 0
