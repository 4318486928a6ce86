"""The lease of a top-level key: who owns it, how it is acquired, and which updates a reader takes from whom.

{foo}:lease  what `Claim.text` makes, with an expiry: the server removes it unless the owner renews it
{foo}:fence  the number of the last acquisition, without an expiry: numbers of one key only grow
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import orjson

from ..errors import BadData, BadType, BadValue, NotAllowed, Owned
from . import Command, Plan, Reply, blamed
from .arguments import check_number
from .keys import Keys
from .notices import Extras
from .paths import shorten
from .replies import checked

LONGEST = 3600.0  # seconds that a lease may last: it is to show within moments that its owner is gone
_SHORTEST = 0.001  # seconds: servers count milliseconds
_LONGEST_NAME = 64  # characters
_LAST = 1 << 53  # every JSON parser has integers up to it; a notice carries the number

_RIGHTS = (
    "an owner needs +watch +unwatch +multi +exec +get +set +incr +unlink on {key}:*; "
    "publishing without a lease needs fewer"
)


class Claim(NamedTuple):
    number: int  # the fencing number, from 1; 0 if the lease is not of REEM
    name: str  # what the owner calls itself
    host: str
    process: int
    since: float  # when, by the server's clock; 0 if the owner lacks the right to ask for it
    token: str  # random, so that no two acquisitions have the same text

    def text(self) -> bytes:
        return orjson.dumps(list(self))

    def __str__(self) -> str:
        return f"{self.name!r} (process {self.process} on {self.host})" if self.number else "another program"


UNKNOWN = Claim(0, "", "", 0, 0.0, "")


def claimed(text: Reply) -> Claim:
    """Return the claim in a lease as the server sent it; `UNKNOWN` if it is none of REEM."""
    try:
        claim = Claim(*orjson.loads(text))
        sound = [type(each) for each in claim] == [int, str, str, int, float, str] and 0 < claim.number < _LAST
    except (ValueError, TypeError):
        return UNKNOWN
    texts = claim.name, claim.host
    return claim if sound and max(map(len, texts)) <= 255 and math.isfinite(claim.since) else UNKNOWN


def check_name(name: Any) -> str:
    cure = f"use 1 to {_LONGEST_NAME} printable characters"
    if not isinstance(name, str):
        raise BadType(f"name={shorten(name)} is not a str; {cure}")
    if not name.isprintable() or not 0 < len(name) <= _LONGEST_NAME:
        raise BadValue(f"name={shorten(name)} cannot name an owner; {cure}")
    return name


def check_ttl(ttl: Any) -> int:
    """Return a lease's duration in milliseconds; raises BadType or BadValue."""
    cure = f"a lease lasts {_SHORTEST:g} to {LONGEST:g} seconds after each write"
    check_number("ttl", ttl, cure, least=_SHORTEST, most=LONGEST)
    return round(float(ttl) * 1000)


class HeldLease(NamedTuple):
    claim: Claim
    text: bytes  # what the server holds as long as it is held
    renewal: Command
    removal: Command
    watch: Command
    look: Command
    extras: Extras  # what the owner's notices say: the fencing number


def _held(keys: Keys, claim: Claim, milliseconds: int) -> HeldLease:
    text, name = claim.text(), keys.lease
    renewal = ("SET", name, text, "PX", str(milliseconds))
    extras = Extras(lease=claim.number)
    return HeldLease(claim, text, renewal, ("UNLINK", name), ("WATCH", name), ("GET", name), extras)


def acquisition(keys: Keys, claim: Claim, milliseconds: int, *, take: bool) -> Plan:
    """Plan to acquire the lease; the result is a `HeldLease`. Two round trips, again if another client was faster.

    Number and time of the claim are left open. `take` takes the lease from another owner.

    Raises (in decode):
        Owned: Another owner has it.
        NotAllowed: The user lacks a right.
        BadData: The counter is not of REEM.
    """

    def look(replies: Sequence[Reply]) -> Plan:
        _, standing, counter, clock = replies
        for reply, command in zip(replies[:3], commands[:3], strict=True):
            permitted(keys, reply, command)
        # The time only tells people how long there has been an owner, so a user may lack the right to ask for it.
        now = _seconds(clock)
        if standing is not None and not take:
            raise owned(keys, claimed(standing), now)
        number = _counted(keys, counter) + 1
        held = _held(keys, claim._replace(number=number, since=now), milliseconds)

        def decode(replies: Sequence[Reply] | None) -> Any:
            if replies is None:  # another client acquired it, or it expired
                return acquisition(keys, claim, milliseconds, take=take)
            if [checked(reply, keys, ()) for reply in replies] != [number, b"OK"]:
                raise BadData(f"{keys.name}: the server answered an acquisition with {replies!r:.60}")
            return held

        def denied(replies: Sequence[Reply]) -> None:
            for reply, command in zip(replies, sent, strict=True):
                permitted(keys, reply, command)

        sent = [("INCR", keys.fence), held.renewal]
        return Plan(sent, decode, atomic=True, held=True, without_refused=denied)

    commands = [("WATCH", keys.lease, keys.fence), ("GET", keys.lease), ("GET", keys.fence), ("TIME",)]
    return Plan(commands, look, held=True)


def permitted(keys: Keys, reply: Reply, command: Command) -> None:
    """Raise the error for a reply that is one: a right that an owner lacks, a key of another program, and so on."""
    if isinstance(reply, NotAllowed):
        raise NotAllowed(f"{blamed(reply, command)}; {_RIGHTS.format(key=keys.tag)}")
    if isinstance(reply, Exception) and str(reply).startswith("WRONGTYPE"):
        raise BadData(
            f"the Redis key {command[1]!r} holds a value of another program, no text of REEM; remove that key"
        )
    checked(reply, keys, ())


def owned(keys: Keys, claim: Claim, now: float) -> Owned:
    seconds = max(now - claim.since, 0.0) if now and claim.since else None
    lasting = "" if seconds is None else f" for {seconds:.3g} s"
    return Owned(
        f"{keys.name} has been owned by {claim}{lasting}; wait until it is released, or take it over: own(take=True)",
        claim.name,
        claim.host,
        claim.process,
        seconds,
    )


def _seconds(reply: Reply) -> float:
    try:
        return int(reply[0]) + int(reply[1]) / 1e6
    except (TypeError, ValueError, IndexError):
        return 0.0


def _counted(keys: Keys, reply: Reply) -> int:
    if reply is None:
        return 0
    text = bytes(reply)
    if not text.isdigit() or not 0 < len(text) < len(str(_LAST)):
        raise BadData(f"the Redis key {keys.fence!r} holds {text[:40]!r}, not a number of REEM; remove that key")
    return int(text)


class FenceFilter:
    """Judges by fencing numbers which updates of one key a reader takes, for one reader with a `ttl`.

    While the lease lives, an update with a lower number than the highest so far is of a former owner, and one without a
    number is of a program that does not own the key. It lives for `ttl` seconds after each update that was taken with a
    number, by the reader's own clock. Then all is forgotten: a server that lost its data counts from 1 again.
    """

    def __init__(self, ttl: float) -> None:
        self._ttl = ttl
        self._highest = 0
        self._heard = -math.inf

    def admits(self, lease: int, now: float) -> bool:
        """Return whether to take an update with the fencing number `lease` (0 for none), which arrived at `now`."""
        if now - self._heard < self._ttl and lease < self._highest:
            return False
        if lease:
            self._highest, self._heard = lease, now
        return True
