"""The way of one call through a cluster: which node is next, until it is applied or time is over.

While a slot moves, its keys go over one by one, in any order, and a key is where it is or nowhere:

    the slot              source says of keys         target says, after ASKING
    MIGRATING/IMPORTING   all here: served            one key: served, also if it is missing
                          some here: TRYAGAIN         several: TRYAGAIN if one is missing
                          none here: ASK target       a transaction that publishes: served (not looked at)
    NODE at the target    as above                    served
    NODE at the source    MOVED to the target         as above

So the source makes no key, and a key that has left it does not come back. The target must not make one that the source
still has: such a key could not follow its slot. Servers see to that, but not in transactions that publish (Valkey
leaves their keys out), nor in commands of one key, by which keys are watched. Therefore, in this order,

    1. the keys are watched at the target, one by one: whichever arrives from now on makes the transaction fail;
    2. the source is asked for each of them (`Route.left_behind`): one that is there keeps the call waiting;
    3. the transaction is sent to the target.

Whatever is not at the source in step 2 has been at the target since step 1, or is nowhere. At the source one WATCH of
all keys tells as much, for it is refused unless all are there. In between a key may leave, which makes the transaction
fail; and what is nowhere when a slot begins to move is made at the source only if the document, which every
transaction watches, is there: then no client makes it at the target, since the same look finds the document here.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractAsyncContextManager
from functools import lru_cache
from typing import Any

import redis.crc
import redis.exceptions

from ..errors import ConnectionLost, NotConnected, TlsRefused
from ..plan import Command, Reply, blamed
from . import Held, Transport, give_back

key_slot: Callable[[bytes], int] = redis.crc.key_slot  # the number of the slot that a key or channel belongs to

Moved = redis.exceptions.MovedError  # another node has the slot

Ask = redis.exceptions.AskError  # the slot is moving and this key is not here any more, or is nowhere: ask there

Unapplied = (
    redis.exceptions.AskError,  # MovedError is one of them
    redis.exceptions.TryAgainError,  # some keys of the slot are here, others there
    redis.exceptions.ClusterDownError,
    redis.exceptions.MasterDownError,
    redis.exceptions.BusyLoadingError,
)
"""Replies of a node that did nothing. The command may be sent again."""

_KEYLESS = frozenset(
    ["SCAN", "PING", "INFO", "TIME", "CONFIG", "ACL", "CLUSTER", "CLIENT", "COMMAND", "DBSIZE", "MODULE", "UNWATCH"]
)
_NO_KEYS_IN_TRANSACTIONS = _KEYLESS | frozenset(["MULTI", "EXEC", "PUBLISH", "SPUBLISH"])

_ASKING: Command = ("ASKING",)
_UNWATCH: Command = ("UNWATCH",)
_PAUSES = (0.0, 0.0, 0.005, 0.01, 0.02, 0.05)
"""Seconds to wait before each further try; redirections are followed at once, twice."""


def slot_of(commands: Sequence[Command]) -> int | None:
    first = commands[0]
    return _slot(commands[1] if first[0] == "MULTI" else first)


def _slot(command: Command) -> int | None:
    # All commands that REEM sends but one have their key behind their name. All of a plan have the same hash tag.
    if len(command) < 2 or command[0] in _KEYLESS:
        return None
    return _slot_of_word(command[2] if command[0] == "MEMORY" else command[1])


@lru_cache(maxsize=4096)
def _slot_of_word(word: str | bytes) -> int:
    return key_slot(_encoded(word))


def _encoded(word: Any) -> bytes:
    return word if type(word) is bytes else str(word).encode()


def slots_of(commands: Sequence[Command]) -> list[int | None]:
    return [_slot(command) for command in commands]


def publishes(commands: Sequence[Command]) -> bool:
    """Return whether this is a transaction with a notice, which is its last command."""
    return bool(commands[-1][0] == "EXEC" and commands[-2][0] == "SPUBLISH")


def keys_in(commands: Sequence[Command]) -> list[bytes]:
    found: dict[bytes, None] = {}
    for command in commands:
        # The only commands of REEM with more than one key.
        if command[0] in ("UNLINK", "RENAME", "WATCH"):
            found.update(dict.fromkeys(map(_encoded, command[1:])))
        elif command[0] not in _NO_KEYS_IN_TRANSACTIONS and len(command) > 1:
            found[_encoded(command[1])] = None
    return list(found)


def refusal(replies: Sequence[Reply]) -> redis.exceptions.RedisError | None:
    """Return the first reply that means that a command was not applied, None if there is none."""
    for reply in replies:
        if isinstance(reply, Exception) and isinstance(reply, Unapplied):  # the first check is the faster one
            return reply
    return None


def is_unapplied(reply: object) -> bool:
    """Return whether a reply or error means that a node did nothing, and another one, or a later try, may."""
    return isinstance(reply, Unapplied)


class Route:
    def __init__(self, cluster: Any, slot: int | None, asked: Transport | None = None) -> None:
        self._cluster = cluster
        self._slot = slot
        self._node: Any = asked
        self._began = time.monotonic()
        self._deadline = 0.0
        self._tries = 0
        self._source: Transport | None = None

    @property
    def asking(self) -> bool:
        """Whether the node does not have the slot yet, and must be told that this is known."""
        return self._source is not None

    async def node(self) -> Any:
        if self._node is None:
            # The first try believes what is known. Each later one looks again, since what was known has failed.
            if self._slot is not None:
                self._node = await self._cluster.owner_of(self._slot, refresh=self._tries > 0)
            else:
                self._node = random.choice(await self._cluster.nodes())  # noqa: S311
        return self._node

    async def refused(self, problem: Exception) -> None:
        """Note why nothing was applied, and wait if need be; raise NotConnected if time is over."""
        self._check_time(problem)
        asked, self._node, self._source = self._node, None, None
        pause = _PAUSES[min(self._tries, len(_PAUSES) - 1)]
        self._tries += 1
        if isinstance(problem, Ask) and asked is not None:
            self._node = self._cluster.moved(problem, asked)
            self._source = None if isinstance(problem, Moved) else asked
        else:
            pause = max(pause, 0.005)
        if pause:
            await self._cluster.pause(pause)

    async def left_behind(self, keys: Sequence[bytes]) -> Exception | None:
        """Return what keeps the call waiting if the slot is moving and any of `keys` has not gone with it; or None.

        Raises:
            NotConnected: The node that gives the slot away does not answer.
            redis.exceptions.RedisError: This user may not.
        """
        if self._source is None:
            return None
        looks: list[Command] = [("TYPE", key) for key in keys]
        try:
            replies = await self._source.roundtrip(looks)
        except ConnectionLost as error:
            raise _looked_only(error) from error
        for look, reply in zip(looks, replies, strict=True):
            if isinstance(reply, Ask) and self._cluster.moved(reply, self._source) is self._node:
                continue
            if isinstance(reply, Exception) and refusal((reply,)) is None:
                raise blamed(reply, look)
            return redis.exceptions.TryAgainError(f"{look[1].decode(errors='replace')} has not followed its slot yet")
        return None

    def _check_time(self, problem: Exception) -> None:
        now, limit = time.monotonic(), self._cluster.timeout
        if not self._tries:
            # A node that answers has taken as long as it needed; waiting for one that does not is waiting.
            self._deadline = limit + (self._began if isinstance(problem, NotConnected) else now)
        # After the first node that fails there is always a look for another one, else nothing new would be learned.
        looked = self._tries > 0 or self._node is None
        if looked and now > self._deadline:
            # A node that is about to start may refuse TLS too, so there is another try; but it is said which it was.
            kind = TlsRefused if isinstance(problem, TlsRefused) else NotConnected
            raise kind(
                f"the cluster did not take the call within {limit:g} s ({_reason(problem)}); "
                "nothing was applied: call again, or raise the timeout: timeout=, or ?socket_timeout=SECONDS in the URL"
            )


def _reason(problem: Exception) -> str:
    if isinstance(problem, Ask):
        return f"slot {problem.slot_id} is said to be at {problem.host}:{problem.port}, and the nodes may not agree"
    return str(problem)


class HeldAcross:
    def __init__(self, cluster: Any) -> None:
        self._cluster = cluster
        self._node: Transport | None = None
        self._lent: AbstractAsyncContextManager[Held] | None = None
        self._held: Held | None = None
        self._route = Route(cluster, None)
        # The keys that are watched on their node; none while their slot moves. A transaction that publishes need not
        # watch its keys again if all are among them.
        self._watching: set[bytes] = set()
        self._giving_up: Route | None = None

    async def roundtrip(self, commands: Sequence[Command], *, bulk: bool = False) -> list[Reply]:
        if self._held is None or commands[0][0] == "WATCH":
            return await self._begin(commands, bulk)
        if commands[-1][0] == "EXEC":
            return await self._end(commands, bulk)
        if commands[0][0] == "UNWATCH":
            self._watching.clear()
        return await asked_of(self._held, commands, self._route.asking, bulk)

    async def _begin(self, commands: Sequence[Command], bulk: bool) -> list[Reply]:
        route = self._route = Route(self._cluster, slot_of(commands))
        self._watching.clear()
        while True:
            problem: Exception | None
            try:
                held = await self._on(await route.node())
                # Before they are read: what arrives in between would be read as missing.
                problem = await route.left_behind(keys_in(commands))
                if problem is None:
                    replies = await asked_of(held, commands, route.asking, bulk)
                    problem = refusal(replies)
                    if problem is None:
                        if not route.asking:
                            self._watching.update(keys_in([each for each in commands if each[0] == "WATCH"]))
                        return replies
                    await held.roundtrip([_UNWATCH])
            except NotConnected as error:
                problem = error
            await route.refused(problem)

    async def _end(self, commands: Sequence[Command], bulk: bool) -> list[Reply]:
        """Send a transaction. If its keys are moving it is given up, as after a change of what is watched.

        Then the replies to all but EXEC say why.
        """
        assert self._held is not None
        problem, keys = None, keys_in(commands)
        if publishes(commands) and not self._watching.issuperset(keys):
            problem = (await watched(self._held, keys, self._route))[0]
        self._watching.clear()
        if problem is None:
            replies = await asked_of(self._held, commands, self._route.asking, bulk)
            problem = refusal(replies)
            if problem is None:
                return replies
        if self._giving_up is None:
            self._giving_up = Route(self._cluster, slot_of(commands))
        await self._giving_up.refused(problem)
        return [problem] * (len(commands) - 1) + [None]

    async def _on(self, node: Transport) -> Held:
        if self._node is not node or self._held is None:
            await self.leave()
            lent = node.hold()
            self._held = await lent.__aenter__()
            self._node, self._lent = node, lent
        return self._held

    async def leave(self, error: BaseException | None = None) -> None:
        lent, self._lent, self._held = self._lent, None, None
        await give_back(lent, error)


async def asked_of(to: Held, commands: Sequence[Command], asking: bool, bulk: bool) -> list[Reply]:
    """Send `commands`; if `asking`, with ASKING before each: the node then answers for a slot that is moving to it."""
    if not asking:
        return await to.roundtrip(commands, bulk=bulk)
    if commands[-1][0] == "EXEC":  # one ASKING holds for the whole transaction
        return (await to.roundtrip([_ASKING, *commands], bulk=bulk))[1:]
    # A command with several keys is refused (TRYAGAIN) unless all of them have arrived; with one key it never is.
    single = [_one_by_one(command) for command in commands]
    got = await to.roundtrip([word for each in single for command in each for word in (_ASKING, command)], bulk=bulk)
    replies, answers = iter(got[1::2]), []
    for each in single:
        parts = [next(replies) for _ in each]
        answers.append(refusal(parts) or next((part for part in parts if isinstance(part, Exception)), parts[-1]))
    return answers


def _one_by_one(command: Command) -> list[Command]:
    return [(command[0], key) for key in command[1:]] if command[0] == "WATCH" else [command]


async def watched(
    held: Held, keys: Sequence[bytes], route: Route, looks: Sequence[Command] = ()
) -> tuple[Exception | None, list[Reply]]:
    """Watch all keys, so that none can leave unnoticed; return why that does not help, or None, and what `looks` see.

    Raises:
        NotConnected: The connection broke, before anything was sent that matters.
        redis.exceptions.RedisError: This user may not.
    """
    try:
        reply, *seen = replies = await asked_of(held, [("WATCH", *keys), *looks], route.asking, bulk=False)
    except ConnectionLost as error:
        raise _looked_only(error) from error
    problem: Exception | None = refusal(replies)
    if problem is None and isinstance(reply, Exception):
        raise await _unwatchable(held, keys, reply)
    problem = problem or await route.left_behind(keys)
    if problem is not None:
        await held.roundtrip([_UNWATCH])
    return problem, seen


async def _unwatchable(held: Held, keys: Sequence[bytes], error: Exception) -> Exception:
    """Return the error of a WATCH headed by the key that it was about."""
    looks: list[Command] = [("WATCH", key) for key in keys]
    pairs = zip(await held.roundtrip(looks), looks, strict=True)
    return next((blamed(reply, look) for reply, look in pairs if isinstance(reply, Exception)), error)


def _looked_only(error: ConnectionLost) -> NotConnected:
    return NotConnected(f"{error}; nothing was sent but a look at the keys, so nothing was applied")


def places_refused(answers: Sequence[Reply]) -> list[int]:
    return [place for place, reply in enumerate(answers) if refusal((reply,)) is not None]


def looked_early(commands: Sequence[Command], left: Sequence[int]) -> set[int]:
    """Return the places of looks at a registry that were taken before what they come after was applied.

    In between another program may have added arrays, which the write then replaced without anybody knowing.
    """
    first = min(left, default=len(commands))
    return {place for place in range(first, len(commands)) if place not in left and commands[place][0] == "SMEMBERS"}


def without_looks(commands: Sequence[Command], left: Sequence[int]) -> Sequence[int]:
    """Return the places of what is sent, of what is left, to a node that a slot is moving to: no looks at a registry.

    That may not have moved yet, and the node would say that there is none. A look by itself goes its own way.
    """
    return [place for place in left if commands[place][0] != "SMEMBERS"] or left
