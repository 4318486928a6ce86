"""Publish to callback, between processes: the age of each message when the callback has its data."""

import contextlib
import dataclasses
import itertools
import time
from typing import Any

from .measure import Bench, Case, Found, fresh_key, rotated
from .process import ContenderError, Worker
from .results import failure, summary

SETTLED = 10.0  # seconds within which every subscriber must have heard something
FEWEST = 6  # messages in a round


class Audience:
    """One subscriber, or a herd of them, as one thing to ask."""

    def __init__(self, worker: Worker, herd: bool) -> None:
        self.worker, self.herd = worker, herd

    def ask(self, do: str, **keywords: Any) -> list[Any]:
        """One reply per process."""
        if self.herd:
            return list(self.worker.ask("all", request={"do": do, **keywords}))
        return [self.worker.ask(do, **keywords)]


Pairs = dict[str, tuple[Worker, Audience]]


@dataclasses.dataclass
class Channel:
    """A publisher and its audience on one channel."""

    publisher: Worker
    audience: Audience
    payload: str
    name: str = dataclasses.field(default_factory=fresh_key)

    def open(self, subscribers: int) -> None:
        """Subscribe, and publish until every process has heard something."""
        self.publish(1, 0.0)
        self.audience.ask("listen", channel=self.name, payload=self.payload, subscribers=subscribers)
        waiting = SETTLED
        heard = [0] * len(self.audience.ask("heard"))
        while not all(heard):
            if waiting <= 0:
                raise ContenderError(f"{heard.count(0)} of {len(heard)} subscribers heard nothing")
            self.publish(2, 0.05)
            time.sleep(0.2)
            waiting -= 0.3
            heard = [before + len(ages) for before, ages in zip(heard, self.audience.ask("heard"), strict=True)]
        self.drain()

    def drain(self) -> None:
        """Wait until nothing more arrives, and forget it."""
        quiet = 0
        while quiet < 2:
            time.sleep(0.1)
            quiet = 0 if any(self.audience.ask("heard")) else quiet + 1

    def publish(self, count: int, gap: float) -> list[float]:
        """Publish; the reply is what each call took."""
        patience = 60 + count * gap
        return list(
            self.publisher.ask("publish", patience, channel=self.name, payload=self.payload, count=count, gap=gap)
        )

    def collect(self, expected: int, patience: float = 20.0) -> list[float]:
        """All ages, once `expected` are there or no more come."""
        ages: list[float] = []
        end = time.monotonic() + patience
        while time.monotonic() < end:
            time.sleep(0.1 if len(ages) < expected else 0.02)
            more = list(itertools.chain.from_iterable(self.audience.ask("heard")))
            ages += more
            if len(ages) >= expected or not more:
                break
        return ages


@dataclasses.dataclass(frozen=True)
class PublishCase(Case):
    """One publisher, one subscriber or more, each in a process of its own; contenders in turn."""

    payload: str = "small"
    count: int = 300
    gap: float = 0.004
    rounds: int = 3
    subscribers: int = 1

    def measure(self, bench: Bench) -> Found:
        """Start all publishers and subscribers, which stay alive, and have them take turns."""
        with contextlib.ExitStack() as stack:
            pairs: Pairs = {}
            for name in self.contenders:
                try:
                    members = self.subscribers if self.subscribers > 1 else 0
                    publisher, subscriber = stack.enter_context(bench.workers.pair(name, members))
                    pairs[name] = publisher, Audience(subscriber, herd=members > 0)
                except ContenderError as error:
                    for part in self.parts():
                        yield part.identifier, name, failure(error)
            for part in self.parts():
                yield from part.measure_pairs(bench, pairs)

    def parts(self) -> list["PublishCase"]:
        """What the same processes measure, one after the other."""
        return [self]

    def measure_pairs(self, bench: Bench, pairs: Pairs) -> Found:
        """Measure processes that run already; each round begins with another contender."""
        rounds = int(bench.scaled(self.rounds, 1))
        count = max(FEWEST, int(bench.scaled(self.count, self.count / 5) / rounds))
        ages: dict[str, list[float]] = {}
        calls: dict[str, list[float]] = {}
        servers: dict[str, list[float]] = {}
        channels: dict[str, Channel] = {}
        for name, (publisher, audience) in pairs.items():
            try:
                channel = Channel(publisher, audience, self.payload)
                channel.open(1)
                channels[name], ages[name], calls[name], servers[name] = channel, [], [], []
            except ContenderError as error:
                yield self.identifier, name, failure(error)
        for number in range(rounds):
            for name in rotated(list(channels), number):
                try:
                    before = bench.workers.server.seconds()
                    calls[name] += channels[name].publish(count, self.gap)
                    ages[name] += channels[name].collect(count * self.subscribers)
                    servers[name].append((bench.workers.server.seconds() - before) / count)
                except ContenderError as error:
                    del channels[name]
                    yield self.identifier, name, failure(error)
        for name in channels:
            yield self.identifier, name, summary(ages[name], sent=count * rounds * self.subscribers)
            yield f"{self.identifier}.call", name, summary(calls[name])
            # What the server does for one message, with the heartbeats of all pairs in it.
            yield f"{self.identifier}.server", name, summary(servers[name])


@dataclasses.dataclass(frozen=True)
class SubscribersCase(Case):
    """One publisher, many subscribers. One contender's processes at a time, two turns each."""

    processes: int = 1
    each: int = 1
    messages: int = 200
    gap: float = 0.02
    turns: int = 2

    def measure(self, bench: Bench) -> Found:
        """Half of the messages per turn."""
        messages = max(5, int(bench.scaled(self.messages, self.messages / 10)))
        turns = int(bench.scaled(self.turns, 1))
        ages: dict[str, list[float]] = {name: [] for name in self.contenders}
        failed: set[str] = set()
        for _ in range(turns):
            for name in self.contenders:
                if name in failed:
                    continue
                try:
                    ages[name] += self._turn(bench, name, messages // turns)
                except ContenderError as error:
                    failed.add(name)
                    yield self.identifier, name, failure(error)
        sent = messages // turns * turns * self.processes * self.each
        for name in self.contenders:
            if name not in failed:
                yield self.identifier, name, summary(ages[name], sent=sent)

    def _turn(self, bench: Bench, name: str, messages: int) -> list[float]:
        with bench.workers.pair(name, self.processes) as (publisher, herd):
            channel = Channel(publisher, Audience(herd, herd=True), "small")
            channel.open(self.each)
            channel.publish(messages, self.gap)
            return channel.collect(messages * self.processes * self.each)
