"""Mirrors of the store for plain scripts: the core's follow on the background loop."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

from reem_async.errors import InterfaceClosed
from reem_async.plan.paths import Path
from reem_async.plan.trees import MISSING
from reem_async.pubsub import mirror as core

from ._twin import documented_by
from .connection import quiet_at_exit
from .following import Following

if TYPE_CHECKING:
    from .connection import RedisInterface


@documented_by(core.Mirror)
class Mirror(Following):
    """A local copy of a place in the store that follows every change by any client, published or only stored.

    `value()` and `mirror["joint"].read()` answer from memory, without a trip to the server: what they say is usually
    one round trip behind (on a key that is also published, up to 20 ms), and `age` says how old it may be. Where the
    connection is down, or the copy older than `max_age`, they raise Stale rather than return an old value. With
    `stale="keep"` they return the last known value through an outage. With `ttl` they raise Silent once no update has
    been published for that long, whatever the reason.
    Use it with `with`, or `listen()` and `close()`.

    Args:
        interface: The server.
        path: The path, top-level key first.
        max_age: Largest `age` of an answer in seconds, 0.005 at least; None for any, as long as the connection stands.
            The server is probed three times in that time. Use at least three times the round trip.
        largest: Bytes of an array up to which it is fetched. A larger one stays at the server, and an object that says
            what it is (`label`, `size`, `summary`) is in its place, another one when it has changed; None for no limit.
        stale: What answers do while the connection is down: "raise" Stale, or "keep" the last known value. `age` says
            how old that is.
        ttl: Seconds for which answers count, from the arrival of the last published update on this program's clock;
            None for any. A shorter break of the connection is not noticed, unless `max_age` is given too. What is found
            at the beginning or after a break does not count until the next update arrives, nor do plain writes.
    """

    def __init__(
        self,
        interface: RedisInterface,
        path: Path,
        *,
        max_age: float | None = None,
        largest: int | None = None,
        stale: Literal["raise", "keep"] = "raise",
        ttl: float | None = None,
    ) -> None:
        self._interface = interface
        session = interface._followers.session
        self._core = core.Mirror(
            session, session.keys(path[0]), path[1:], max_age=max_age, largest=largest, stale=stale, ttl=ttl
        )
        self.channel, self.max_age, self.stale, self.ttl = self._core.channel, max_age, stale, self._core.ttl

    @property
    def age(self) -> float:
        """Seconds since the server was last asked whether it has what is in the copy, and has answered that it has."""
        return self._core.age

    def listen(self) -> None:
        """Begin to follow. When this returns, the copy is there. Idempotent; two or three round trips."""
        self._interface._wait(self._core.listen())

    def close(self) -> None:
        """Stop following; reading raises Stale from then on. Idempotent."""
        with contextlib.suppress(InterfaceClosed):  # whatever closed the interface has closed this too
            self._interface._wait(self._core.close())

    def value(self, default: Any = MISSING) -> Any:
        """Return a copy of the value, None if nothing is there. No round trip; any thread may call."""
        with quiet_at_exit():
            return self._core.value(default)

    def wait_until(self, predicate: Callable[[Any], Any], timeout: float | None = None) -> Any:
        """Wait until the value is as wanted; returns it. No round trip."""
        timeout = core._limit(predicate, timeout)
        end = math.inf if timeout is None else time.monotonic() + timeout
        with quiet_at_exit(), self._core._wait() as wait:
            # First the states that wait are tried. Then the caller waits for the next one, at most what is left.
            # The predicate is called here, on the caller's thread, since it may block or use REEM; the loop only waits.
            while not (tried := self._core._tried(predicate, wait)).fits:
                left = end - time.monotonic()
                if left <= 0:
                    self._core._give_up(timeout)
                self._interface._wait(self._core._later(wait, min(left, tried.again)))
        return tried.value

    def __getitem__(self, key: str | int) -> core.MirrorAccessor:
        return self._core[key]

    def __setitem__(self, key: str | int, value: Any) -> None:
        self._core[key] = value

    def __delitem__(self, key: str | int) -> None:
        del self._core[key]

    def __repr__(self) -> str:
        return f"<reem.Mirror {self.channel}>"
