"""Calls: every contender in turn, in short blocks, on one server."""

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

from .contenders import CONTENDERS
from .cores import on_one_core
from .process import ContenderError, Worker, Workers
from .results import Entry, failure, summary
from .values import Spec

Found = Iterator[tuple[str, str, Entry]]  # case, contender, entry

_key_numbers = itertools.count(1)


def fresh_key() -> str:
    """A key no contender has seen: what a client remembers of earlier cases can't matter."""
    return f"bench_{next(_key_numbers)}"


def rotated(names: list[str], number: int) -> list[str]:
    """The names in the order of a round: each one begins with another name."""
    shift = number % max(1, len(names))
    return names[shift:] + names[:shift]


@dataclasses.dataclass
class Bench:
    """What a case needs to be measured."""

    workers: Workers
    quick: bool

    def scaled(self, amount: float, quick: float) -> float:
        """The amount for a whole run or for a quick one."""
        return quick if self.quick else amount


def with_stand_in(name: str, attempt: Callable[[str], Any]) -> tuple[str, Any, Entry]:
    """Do it with the contender, or else with the one named to be asked instead; say who did it, and why."""
    try:
        return name, attempt(name), {}
    except ContenderError as error:
        other = CONTENDERS[name].instead
        if other is None:
            raise
        try:
            return other, attempt(other), {"measured_by": other, "because": str(error)}
        except ContenderError as second:
            raise ContenderError(f"{error}; {other}: {second}") from None


@dataclasses.dataclass(frozen=True)
class Case:
    """Something to be measured; the identifier is what `--only` looks at."""

    identifier: str
    contenders: tuple[str, ...]

    def measure(self, bench: Bench) -> Found:
        """Yield every entry found."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class CallCase(Case):
    """One read or write, over and over: `rounds` blocks per contender, in rotating order.

    Many short ones: where a machine is slow for a second, all contenders meet that second alike.
    """

    operation: str = "get"
    value: Spec = dataclasses.field(default_factory=lambda: {"kind": "small"})
    inner: tuple[str, ...] = ()
    tail: tuple[str, ...] = ()
    count: int = 1000
    limit: float = 0.6
    width: int = 0  # callers at once; 0 for one after the other
    one_core: bool = False
    rounds: int = 15

    def measure(self, bench: Bench) -> Found:
        """Prepare all contenders, then go round among those that could."""
        ready: dict[str, str] = {}
        more: dict[str, Entry] = {}
        for name in self.contenders:
            try:
                ready[name], _, more[name] = with_stand_in(name, lambda other: self._prepare(bench.workers.get(other)))
            except ContenderError as error:
                yield self.identifier, name, failure(error)
        samples: dict[str, list[float]] = {name: [] for name in ready}
        pids = [bench.workers.server.pid(), *(bench.workers.get(name).pid for name in ready.values())]
        with on_one_core(pids if self.one_core else []):
            yield from self._rounds(bench, ready, samples)
        for name in ready:
            yield self.identifier, name, summary(samples[name], **more[name])

    def _rounds(self, bench: Bench, ready: dict[str, str], samples: dict[str, list[float]]) -> Found:
        """Blocks of all in turn; whoever fails is left out from then on."""
        for number in range(self.rounds):
            for name in rotated(list(ready), number):
                try:
                    samples[name] += self._block(bench, bench.workers.get(ready[name]))
                except ContenderError as error:
                    del ready[name]
                    yield self.identifier, name, failure(error)

    def _prepare(self, worker: Worker) -> None:
        worker.ask(
            "prepare",
            operation=self.operation,
            key=fresh_key(),
            value=self.value,
            inner=list(self.inner),
            tail=list(self.tail),
        )

    def _block(self, bench: Bench, worker: Worker) -> list[float]:
        count = max(1, int(bench.scaled(self.count, self.count / 10) / self.rounds))
        limit = bench.scaled(self.limit, self.limit / 10) / self.rounds
        if self.width:
            return list(worker.ask("crowd", width=self.width, count=count, limit=limit))
        return list(worker.ask("run", count=count, limit=limit))


@dataclasses.dataclass(frozen=True)
class ClientsCase(Case):
    """Many processes reading at once, each with a connection of its own."""

    processes: int = 1

    def measure(self, bench: Bench) -> Found:
        """One contender's processes at a time."""
        for name in self.contenders:
            try:
                yield self.identifier, name, self._crowd(bench, name)
            except ContenderError as error:
                yield self.identifier, name, failure(error)

    def _crowd(self, bench: Bench, name: str) -> Entry:
        seconds = bench.scaled(1.0, 0.2)
        with bench.workers.herd(name, self.processes) as herd:
            prepare = {"do": "prepare", "operation": "get", "key": fresh_key(), "value": {"kind": "small"}}
            herd.ask("all", request=prepare)
            start = time.perf_counter() + 0.1 + self.processes * 0.005
            run = {"do": "run", "count": 1_000_000, "limit": seconds, "start": start}
            replies = herd.ask("all", request=run)
        samples = list(itertools.chain.from_iterable(replies))
        return summary(samples, rate=len(samples) / seconds)
