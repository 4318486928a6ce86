"""Mirrors of the store for plain scripts: the core's follow on the background loop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from reem_async.plan.trees import MISSING
from reem_async.pubsub import mirror as core

from ._twin import documented_by, ends, shares, waits
from .connection import quiet_at_exit
from .following import Following

if TYPE_CHECKING:
    from .connection import RedisInterface


@documented_by(core.Mirror)
class Mirror(Following):
    """A local copy of a place in the store that follows every change by any client, published or only stored."""

    def __init__(self, interface: RedisInterface, mirror: core.Mirror) -> None:
        self._interface = interface
        self._core = mirror
        self.channel, self.max_age, self.stale, self.ttl = mirror.channel, mirror.max_age, mirror.stale, mirror.ttl

    age = shares(core.Mirror.age)
    listen = waits(core.Mirror.listen)
    close = ends(core.Mirror.close)

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
