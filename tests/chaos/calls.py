"""Rows 2 and 3: calls that are cancelled, and whose reply is lost."""

from __future__ import annotations

import asyncio
import collections
import contextlib
from typing import Any

import numpy as np
from conftest import assert_no_orphans, keys_of
from slotkit import shared_in

import reem
import reem_async
from reem_async.concurrency.queues import Last
from reem_async.plan.sizes import KEPT, STAGED

from .proxy import Proxy
from .scoreboard import Run, row, tell
from .servers import PrivateServer
from .tools import Log, background, became, frame

SLOTS = 50
TOP = "storm"


def tagged(number: int, array: Any = None) -> dict[str, Any]:
    return {"id": number, "array": np.full(8, number) if array is None else array, "text": str(number)}


def has_tag(value: Any, number: int) -> bool:
    """Whether a value is all of one slot."""
    return value["id"] == number and value["text"] == str(number) and bool((value["array"] == number).all())


# --- 2: cancelled ----------------------------------------------------------------------------------


class _Storm:
    """Calls of every kind on one interface, half of them cancelled at some moment."""

    def __init__(self, run: Run, interface: reem_async.RedisInterface) -> None:
        self._rng = run.rng
        self._kvs = reem_async.KeyValueStore(interface)
        self._space = reem_async.PublishSpace(interface)
        self.wrong: list[Any] = []
        self.swallowed: list[Any] = []
        self.cancelled = self.finished = self.shared = 0

    def see(self, value: Any, updated_path: str) -> None:
        """What a subscriber near by gets of it: nothing of two slots, whatever was broken off."""
        if value is not None:
            self.shared += shared_in({slot: value[f"s{slot}"]["array"] for slot in range(SLOTS)}) > 0
            self.wrong += [("heard", slot) for slot in range(SLOTS) if not has_tag(value[f"s{slot}"], slot)]

    async def prepare(self) -> None:
        await self._space[TOP].write({f"s{n}": tagged(n) for n in range(SLOTS)} | {"count": 0, "list": []})

    async def call(self, kind: int, slot: int) -> None:
        """One call; what it reads must be its own slot's, whoever was cancelled before it."""
        place = self._kvs[TOP][f"s{slot}"]
        if kind < 4:
            value = await place.read()
            if not has_tag(value, slot):
                self.wrong.append((slot, value))
        elif kind == 4:
            if await self._kvs[TOP][f"s{slot}"]["id"].read() != slot:
                self.wrong.append(slot)
        elif kind == 5:
            await place.write(tagged(slot))
        elif kind == 6:
            await self._space[TOP][f"s{slot}"].write(tagged(slot, frame(slot)))
        elif kind == 7:
            await self._kvs[TOP]["count"].increment()
        elif kind == 8:
            async with place.edit() as value:
                if not has_tag(value, slot):
                    self.wrong.append((slot, value))
        else:
            await self._space[TOP]["list"].append(slot)

    async def one(self, cancel: bool) -> None:
        kind, slot = self._rng.randrange(10), self._rng.randrange(SLOTS)
        task = asyncio.ensure_future(self.call(kind, slot))
        was = False
        if cancel:
            if self._rng.random() < 0.7:
                for _ in range(self._rng.randrange(9)):
                    await asyncio.sleep(0)
            else:
                await asyncio.sleep(self._rng.random() * 0.01)
            was = task.cancel()
            if self._rng.random() < 0.2:
                await asyncio.sleep(0)
                was = task.cancel() or was
        (outcome,) = await asyncio.gather(task, return_exceptions=True)
        if isinstance(outcome, asyncio.CancelledError):
            self.cancelled += 1
        elif was:
            self.swallowed.append((kind, outcome))
        elif isinstance(outcome, reem.Conflict):  # an edit met a write: as promised
            self.finished += 1
        elif outcome is not None:
            self.wrong.append(outcome)
        else:
            self.finished += 1


@row(2, "operations, half of them cancelled", "no wrong reply, no leak, no cancel swallowed, then 1,000 of 1,000 good")
def cancelled(run: Run) -> None:
    """Every cancel that was accepted must end the call; no reply may reach another call."""
    asyncio.run(_cancelled(run))


async def _cancelled(run: Run) -> None:
    count = run.size(20_000, 2_000)
    with PrivateServer() as server, server.raw() as raw:
        mode = run.rng.choice(["auto", "early"])
        async with reem_async.RedisInterface(server.url, local=mode) as interface:
            storm = _Storm(run, interface)
            await storm.prepare()
            before, at_once = len(asyncio.all_tasks()), 50
            async with (
                reem_async.RedisInterface(server.url) as following,
                reem_async.CallbackSubscriber(TOP, following, storm.see),
            ):
                for begun in range(0, count, at_once):
                    await asyncio.gather(*(storm.one(run.rng.random() < 0.5) for _ in range(at_once)))
                    if begun % 5000 == 0:
                        tell(f"{begun} operations")
            await became(lambda: len(asyncio.all_tasks()) <= before, 2)
            run.at_least("operations", count, count)
            run.at_least("of them ended cancelled", storm.cancelled, 0.2 * count)
            run.at_least("of them finished", storm.finished, 0.2 * count)
            run.at_least("updates heard with frames in shared memory", storm.shared, count // 1000)
            run.none("wrong replies or errors", storm.wrong)
            run.none("cancels swallowed", storm.swallowed)
            run.none("tasks left over", len(asyncio.all_tasks()) - before)
            await became(lambda: len(raw.client_list()) - 1 <= 6, 2.0)  # a server takes a moment to notice a close
            run.at_most("connections at the end", len(raw.client_list()) - 1, 6)
            kvs = reem_async.KeyValueStore(interface)
            slots = [n % SLOTS for n in range(1000)]
            values = await asyncio.gather(*(kvs[TOP][f"s{slot}"].read() for slot in slots))
            run.none(
                "wrong among 1,000 at the end", sum(not has_tag(*pair) for pair in zip(values, slots, strict=True))
            )
        _forget_what_was_on_its_way(run, raw)
        assert_no_orphans(raw, TOP)


def _forget_what_was_on_its_way(run: Run, raw: Any) -> None:
    """What was sent ahead by a call that was cancelled then is nowhere in its place, and expires within a minute."""
    ahead = [name for name in keys_of(raw, TOP) if STAGED in name]
    run.none("sent ahead and not to be forgotten", [name for name in ahead if not 0 <= raw.ttl(name) <= KEPT])
    if ahead:
        raw.unlink(*ahead)


# --- 3: lost replies -------------------------------------------------------------------------------


class _Losses:
    """Calls that are not idempotent, and what became of each: applied once, or nobody knows."""

    def __init__(self, proxy: Proxy) -> None:
        self._proxy = proxy
        self.known: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
        self.unknown: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
        self.wrong: list[Any] = []

    def outcome(self, place: str, token: str, error: BaseException | None) -> None:
        if error is None:
            self.known[place][token] += 1
        elif isinstance(error, reem.ConnectionLost):
            self.unknown[place][token] += 1
        elif not isinstance(error, reem.NotConnected | reem.Conflict):  # those two say: nothing was applied
            self.wrong.append(error)

    def lose(self, marker: bytes) -> None:
        self._proxy.drop_reply(marker)

    def unexplained(self, backward: list[Any]) -> list[Any]:
        """Return the updates that came after newer ones, without those whose calls raised ConnectionLost.

        The server may apply those late, see promise 10 in docs/guarantees.md.
        """
        lost = set().union(*self.unknown.values())
        values = [(it, it.value[-1] if isinstance(it.value, list) else it.value) for it in backward]
        return [it for it, item in values if _token(item) not in lost]

    def judge(self, run: Run, value: Any) -> None:
        """Compare what is stored with what the callers were told."""
        twice, lost, wrong_counts = [], [], []
        for place, tokens in value.items():
            if isinstance(tokens, dict):  # the newest frame replaces the one before
                continue
            if isinstance(tokens, int):
                sure, maybe = self.known[place]["n"], self.unknown[place]["n"]
                if not sure <= tokens <= sure + maybe:
                    wrong_counts.append((place, sure, tokens, sure + maybe))
                continue
            found = collections.Counter(_token(item) for item in tokens)
            twice += [(place, token) for token, count in found.items() if count > 1]
            lost += [(place, token) for token in self.known[place] if token not in found]
        run.none("applied twice", twice)
        run.none("acknowledged and not there", lost)
        run.none("counters off", wrong_counts)
        run.none("other errors", self.wrong)


def _token(item: Any) -> str:
    if isinstance(item, dict):
        assert set(item["array"].tolist()) == {len(item["token"])}
        return item["token"]
    return item


def _with_array(token: str) -> dict[str, Any]:
    return {"token": token, "array": np.full(2000, len(token))}


PLACES = {
    "lists": "appended",
    "arrays": "with arrays",
    "counts": "count",
    "told": "published",
    "edits": "edited",
    "frames": "frame",
}


def _call(kind: str, token: str, kvs: Any, space: Any) -> Any:
    """Make a call of the blocking front, or return the coroutine of one; not those of "edits"."""
    place = (space if kind in ("told", "frames") else kvs)[TOP][PLACES[kind]]
    if kind == "counts":
        return place.increment()
    if kind == "frames":
        return place.write({"token": token, "array": frame(len(token))})
    return place.append(_with_array(token) if kind == "arrays" else token)


def _blocking_call(kind: str, token: str, kvs: reem.KeyValueStore, space: reem.PublishSpace) -> None:
    if kind != "edits":
        _call(kind, token, kvs, space)
        return
    with kvs[TOP][PLACES[kind]] as items:
        items.append(token)


async def _async_call(kind: str, token: str, kvs: reem_async.KeyValueStore, space: reem_async.PublishSpace) -> None:
    if kind != "edits":
        await _call(kind, token, kvs, space)
        return
    async with kvs[TOP][PLACES[kind]].edit() as items:
        items.append(token)


MARKERS = {"counts": b"NUMINCRBY", "edits": b"EXEC"}
"""What is in the request whose reply is lost, where that is not the token."""


@row(
    3,
    "lost replies: append, arrays, increment, publish, frame, edit; both fronts",
    "nothing applied twice or told twice, counters in [ok, ok + unknown]",
)
def lost_replies(run: Run) -> None:
    """The request is applied, its reply never comes; the error says that nobody knows, and nobody tries again."""
    asyncio.run(_lost_replies(run))


async def _lost_replies(run: Run) -> None:
    count = run.size(1000, 100)
    with PrivateServer() as server, Proxy(server.port) as proxy, contextlib.ExitStack() as stack:
        losses = _Losses(proxy)
        async with reem_async.RedisInterface(proxy.url) as faulty, reem_async.RedisInterface(server.url) as direct:
            await reem_async.KeyValueStore(direct)[TOP].write(
                {place: {"counts": 0, "frames": {}}.get(kind, []) for kind, place in PLACES.items()}
            )
            log = Log(reem_async.KeyValueStore(direct)[TOP].watch(Last(1_000_000)))
            await log.updates.listen()
            blocking = reem.RedisInterface(proxy.url)
            stack.callback(blocking.close)
            fronts = (reem.KeyValueStore(blocking), reem.PublishSpace(blocking))
            afronts = (reem_async.KeyValueStore(faulty), reem_async.PublishSpace(faulty))
            async with background(log.follow()):
                await asyncio.to_thread(_lose_blocking, run, count // 2, losses, proxy, fronts)
                await _lose_async(run, count, losses, proxy, afronts)
                proxy.heal()
                value = await reem_async.KeyValueStore(direct)[TOP].read()
                for _ in range(3):
                    await reem_async.PublishSpace(direct)[TOP]["end"].write(1)
                await became(lambda: log.updates.queue.take is not None and log.told > count // 10, 2)
        run.at_least("replies lost", proxy.lost, count)
        run.at_least("calls of known outcome", sum(sum(it.values()) for it in losses.known.values()), count // 2)
        losses.judge(run, value)
        run.at_least("updates told", log.told, count // 10)
        run.at_least("of them with frames in shared memory", log.shared, count // 20)
        run.none("updates told again or backwards", log.repeated + losses.unexplained(log.backward))
        run.none("losses not flagged", log.silent)


def _lose_blocking(run: Run, count: int, losses: _Losses, proxy: Proxy, fronts: Any) -> None:
    turn = 0
    while proxy.lost < count:
        turn += 1
        kind, token = run.rng.choice(list(PLACES)), f"b{turn}"
        if turn % 3:
            losses.lose(MARKERS.get(kind, token.encode()))
        error = None
        try:
            _blocking_call(kind, token, *fronts)
        except Exception as raised:
            error = raised
        losses.outcome(PLACES[kind], "n" if kind == "counts" else token, error)


async def _lose_async(run: Run, count: int, losses: _Losses, proxy: Proxy, fronts: Any) -> None:
    """Four calls at once: the connection they share breaks under all of them."""
    turn = 0
    while proxy.lost < count:
        turn += 1
        calls = [(run.rng.choice(list(PLACES)), f"a{turn}.{n}") for n in range(4)]
        if turn % 3:
            kind, token = calls[run.rng.randrange(4)]
            losses.lose(MARKERS.get(kind, token.encode()))
        ended = await asyncio.gather(*(_async_call(*call, *fronts) for call in calls), return_exceptions=True)
        for (kind, token), error in zip(calls, ended, strict=True):
            losses.outcome(PLACES[kind], "n" if kind == "counts" else token, error)
