"""A mirror of a place in the store: read at memory speed, with the age of what it says."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import math
import time
import weakref
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Literal, NamedTuple, NoReturn

from ..concurrency.streams import Following
from ..concurrency.timeouts import waiting_limit
from ..errors import BadType, BadValue, InterfaceClosed, MissingKey, Silent, Stale
from ..plan.arguments import check_number
from ..plan.keys import Keys
from ..plan.paths import Path, check_element, shorten, show
from ..plan.trees import MISSING
from ..session import Session
from .follower import Follower, checked_largest, own
from .silence import checked_ttl
from .subscribers import Link, LocalAccessor

_PROBES = 3  # probes in the time of `max_age`
_SHORTEST = 0.005  # seconds that `max_age` has at least: probes are a load too
_RETRY = 0.02  # seconds after which a waiting caller looks again at a copy that was too old
_MOST_STATES = 1000  # states of the copy that wait for a predicate; of more, the oldest are dropped
_NO_STATE: Any = object()


class Tried(NamedTuple):
    """The result of a call of a predicate."""

    fits: bool  # the predicate is fulfilled
    value: Any = None  # the value that it was called with
    again: float = math.inf  # seconds after which to try again even if nothing changes


class Wait:
    """One call of `wait_until`. The event loop adds states, the caller takes them out, perhaps on another thread."""

    def __init__(self) -> None:
        # Trees, the oldest first. They are never changed in place.
        self.states: collections.deque[Any] = collections.deque(maxlen=_MOST_STATES)
        self.seen: Any = _NO_STATE  # the tree that the predicate was called with last
        # Done when there is something to look at; on the event loop only
        self.waiter: asyncio.Future[None] | None = None

    def wake(self) -> None:
        """Let the caller look."""
        waiter = self.waiter
        if waiter is not None and not waiter.done() and not waiter.get_loop().is_closed():
            waiter.set_result(None)


class Mirror(Following):
    """A local copy of a place in the store that follows every change by any client, published or only stored.

    `value()` and `mirror["joint"].read()` answer from memory, without a trip to the server: what they say is usually
    one round trip behind (on a key that is also published, up to 20 ms), and `age` says how old it may be. Where the
    connection is down, or the copy older than `max_age`, they raise Stale rather than return an old value. With
    `stale="keep"` they return the last known value through an outage. With `ttl` they raise Silent once no update has
    been published for that long, whatever the reason.
    Use it with `async with`, or `listen()` and `close()`. `mirror` of an accessor makes one, and explains
    the arguments.
    """

    def __init__(
        self,
        session: Session,
        keys: Keys,
        path: Path,
        *,
        max_age: float | None = None,
        largest: int | None = None,
        stale: Literal["raise", "keep"] = "raise",
        ttl: float | None = None,
    ) -> None:
        if max_age is not None:
            check_number("max_age", max_age, f"use {_SHORTEST} seconds or more, or None", least=_SHORTEST)
        if stale not in ("raise", "keep"):
            raise BadValue(f'stale={shorten(stale)} is unknown; use "raise" or "keep"')
        if stale == "keep" and max_age is not None:
            raise BadValue(f'max_age={max_age:g} refuses old values and stale="keep" returns them; use one of the two')
        if ttl is not None:
            ttl = checked_ttl(ttl, (keys.name, *path))
            if stale == "keep":
                raise BadValue(f'ttl={ttl:g} refuses old values and stale="keep" returns them; use one of the two')
        self.channel = show((keys.name, *path))
        self.max_age = max_age
        self.stale = stale
        self.ttl = ttl
        self._full_path: Path = (keys.name, *path)
        make = partial(
            Follower,
            keys,
            path,
            session.ships,
            session.cache,
            stored=True,
            largest=checked_largest(largest),
            heartbeat=math.inf if max_age is None else max_age / _PROBES,
            ttl=ttl,
        )
        self._link = Link(session, make, [])
        self._link.on_state = _waking(self)
        self._waiting: set[Wait] = set()

    async def listen(self) -> None:
        """Begin to follow. When this returns, the copy is there. Idempotent; two or three round trips.

        Raises:
            NotConnected: No server listens there.
            InterfaceClosed: It was closed before.
        """
        await self._link.follow()

    async def close(self) -> None:
        """Stop following; reading raises Stale from then on. Idempotent."""
        await self._link.unfollow()

    @property
    def age(self) -> float:
        """Seconds since the server was last asked whether it has what is in the copy, and has answered that it has.

        An upper bound on how long the server may have had something else. It measures the link to the server, not when
        the value was written: a value that does not change for an hour has a small age. Probes are sent each second, or
        three times in `max_age`, so the age goes up to the time between two of them and two round trips. Without
        the right to CLIENT TRACKING the server does not report what is only stored, and the age is the time since the
        last read. Infinite before `listen`, in a forked child, and after its event loop was closed.
        """
        follower = self._link.follower
        return follower.age() if follower is not None and self._link.follows else math.inf

    def value(self, default: Any = MISSING) -> Any:
        """Return a copy of the value, None if nothing is there. No round trip; any thread may call.

        Args:
            default: Returned where nothing is there, and in place of Stale and Silent. A mirror that does not follow
                yet, or is closed, raises all the same.

        Raises:
            Stale: The connection is down (unless `stale="keep"` or `ttl`), or the copy is older than `max_age`.
            Silent: No update has arrived for `ttl`; a Stale.
        """
        follower = self._check_open()
        tree = MISSING if follower.failure is not None else follower.at()  # before the check: see `Follower.start`
        refusal = self._refusal(follower)
        if refusal is not None and default is MISSING:
            raise refusal
        found = MISSING if refusal is not None else tree
        return default if found is MISSING and default is not MISSING else own(found)

    def _check_begun(self) -> Follower:
        follower = self._link.follower
        if follower is None:
            raise Stale(f"{self.channel}: this mirror does not follow yet; use it in a `with`, or call listen() first")
        if not self._link.follows:
            raise Stale(
                f"{self.channel}: this mirror has followed in another process, or in an event loop that was closed; "
                "call listen() here"
            )
        return follower

    def _check_open(self) -> Follower:
        if self._link.closed:
            raise Stale(f"{self.channel}: this mirror is closed; make a new one")
        if self._link.interface_closed:
            raise Stale(f"{self.channel}: the RedisInterface of this mirror is closed; make new ones")
        return self._check_begun()

    def _refusal(self, follower: Follower) -> Stale | None:
        if reason := self._silence(follower):
            return Silent(f"{self.channel}: {reason}")
        reason = self._stale(follower)
        return Stale(f"{self.channel}: {reason}") if reason else None

    def _silence(self, follower: Follower) -> str:
        """Return for how long there is silence; nothing if `ttl` allows it, or following has ended."""
        silence = time.monotonic() - follower.live_since
        if self.ttl is None or silence <= self.ttl or follower.failure is not None:
            return ""
        down = "; the connection is down" if follower.down else ""
        if silence == math.inf:
            return f"no update has arrived since following began or was interrupted, and ttl={self.ttl:g}{down}"
        return f"no update has arrived for {silence:.3f} s, and ttl={self.ttl:g}{down}"

    def _stale(self, follower: Follower) -> str:
        """Return why the copy is too old whatever was published; nothing if it is not."""
        age = follower.age()
        # Before the age: these say more than that the copy is old.
        if follower.failure is not None:
            return f"following has ended over an error: {follower.failure!r}; make a new mirror"
        if self.stale == "keep" or (self.ttl is not None and self.max_age is None):
            return ""
        if follower.down:
            return f"the connection is down, and the copy {age:.3f} s old; it is being made again"
        if self.max_age is None or age <= self.max_age:
            return ""
        reason = follower.untrusted
        # Not how old the value is: that the commander has died, for example, `max_age` does not show.
        said = (
            f"the copy is {age:.3f} s old, and max_age={self.max_age:g} (the link to the server; for updates use ttl)"
        )
        return said + (f"; {reason}" if reason else "")

    async def wait_until(self, predicate: Callable[[Any], Any], timeout: float | None = None) -> Any:  # noqa: ASYNC109
        """Wait until the value is as wanted; returns it. No round trip.

        Args:
            predicate: Called with a copy of the value at once, and with each published state after that, also if the
                next one follows at once. States that are only stored may be merged into the last one. Of more
                than 1,000 states that wait for a slow predicate, the oldest are skipped.
            timeout: Seconds after which to give up. None for the limit of a `with reem_async.timeout(...)` block around
                the call; outside of one there is no limit.

        Raises:
            TimeoutError: It did not come true in time.
            Stale: The mirror does not follow yet.
            InterfaceClosed: The mirror was closed, or the interface.
        """
        timeout = _limit(predicate, timeout)
        limit = asyncio.timeout(timeout)
        try:
            async with limit:
                with self._wait() as wait:
                    while not (tried := self._tried(predicate, wait)).fits:
                        await self._later(wait, tried.again)
        except TimeoutError:
            if not limit.expired():  # the predicate's own
                raise
            self._give_up(timeout)
        return tried.value

    @contextlib.contextmanager
    def _wait(self) -> Iterator[Wait]:
        """Keep the states of the copy for a call of `wait_until`. Any thread may."""
        wait = Wait()
        self._waiting.add(wait)
        try:
            yield wait
        finally:
            self._waiting.discard(wait)

    def _tried(self, predicate: Callable[[Any], Any], wait: Wait) -> Tried:
        """Call the predicate with the states that wait, then with the present one unless it is too old."""
        if self._link.closed:
            raise InterfaceClosed(f"{self.channel}: this mirror was closed")
        if self._link.interface_closed:
            raise InterfaceClosed(f"{self.channel}: the RedisInterface of this mirror was closed")
        follower = self._check_begun()
        while wait.states:
            wait.seen = wait.states.popleft()
            if predicate(value := own(wait.seen)):
                return Tried(True, value)
        if self._refusal(follower):
            return Tried(False, again=_RETRY)
        # The first state of all, or one that was too old when it came.
        if (tree := follower.at()) is not wait.seen:
            wait.seen = tree
            if predicate(value := own(tree)):
                return Tried(True, value)
        return Tried(False)

    async def _later(self, wait: Wait, seconds: float) -> None:
        """Return when there may be something to look at, or after some seconds."""
        if wait.states:
            return
        wait.waiter = asyncio.get_running_loop().create_future()
        await asyncio.wait([wait.waiter], timeout=None if seconds == math.inf else seconds)

    def _give_up(self, timeout: float | None) -> NoReturn:
        follower = self._link.follower
        reason = self._silence(follower) or self._stale(follower) if follower else "this mirror does not follow"
        why = f"; {reason}" if reason else ""
        raise TimeoutError(f"{self.channel}: did not come true within {timeout:g} s{why}") from None

    def _take(self, tree: Any) -> None:
        follower = self._link.follower
        for wait in tuple(self._waiting):  # another thread may add one meanwhile
            if (wait.states[-1] if wait.states else wait.seen) is not tree and follower and not self._refusal(follower):
                wait.states.append(tree)
            wait.wake()

    def __getitem__(self, key: str | int) -> MirrorAccessor:
        return MirrorAccessor(self, (check_element(key, self._full_path),))

    def __setitem__(self, key: str | int, value: Any) -> NoReturn:
        self[key].write(value)

    def __delitem__(self, key: str | int) -> NoReturn:
        self[key].write()

    def __repr__(self) -> str:
        return f"<reem_async.Mirror {self.channel}>"


def _limit(predicate: Any, timeout: float | None) -> float | None:
    if not callable(predicate):
        raise BadType(f"predicate={shorten(predicate)} is not a function; use one that is called with the value")
    return waiting_limit(timeout)


def _waking(mirror: Mirror) -> Callable[[Any], None]:
    reference = weakref.ref(mirror)

    def on_state(tree: Any) -> None:
        if (there := reference()) is not None and there._waiting:
            there._take(tree)

    return on_state


class MirrorAccessor(LocalAccessor):
    """One place in a mirror's copy."""

    __slots__ = ()

    def read(self) -> Any:
        """Return a copy of the value here as of now. No round trip.

        Raises:
            MissingKey: Nothing is here.
            Stale: As `Mirror.value`; Silent is one.
        """
        if (refusal := self._subscriber._refusal(self._subscriber._check_open())) is not None:
            raise refusal
        return super().read()

    def get(self, default: Any = None) -> Any:
        """Return the value here, or `default` if nothing is here or there is silence. No round trip."""
        try:
            return self.read()
        except (MissingKey, Silent):
            return default
