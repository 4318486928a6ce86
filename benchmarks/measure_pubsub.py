"""Publish to callback, between processes: the age of each message when the callback has its data."""

import contextlib
import dataclasses
import itertools
import time
from typing import Any

from .measure import Bench, Case, Found, fresh_key
from .process import ContenderError, Worker
from .results import failure, summary

SETTLED = 10.0  # seconds within which every subscriber must have heard something


class Audience:
    """One subscriber, or a herd of them, as one thing to ask."""

    def __init__(self, worker: Worker, herd: bool) -> None:
        self.worker, self.herd = worker, herd

    def ask(self, do: str, **keywords: Any) -> list[Any]:
        """One reply per process."""
        if self.herd:
            return list(self.worker.ask("all", request={"do": do, **keywords}))
        return [self.worker.ask(do, **keywords)]


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
    """One publisher, one subscriber, contenders in turn."""

    payload: str = "small"
    count: int = 300
    gap: float = 0.004
    rounds: int = 3

    def measure(self, bench: Bench) -> Found:
        """All pairs stay alive; they take turns."""
        rounds = int(bench.scaled(self.rounds, 1))
        count = max(10, int(bench.scaled(self.count, self.count / 5) / rounds))
        ages: dict[str, list[float]] = {}
        calls: dict[str, list[float]] = {}
        servers: dict[str, list[float]] = {}
        with contextlib.ExitStack() as stack:
            channels: dict[str, Channel] = {}
            for name in self.contenders:
                try:
                    publisher, subscriber = stack.enter_context(bench.workers.pair(name))
                    channels[name] = Channel(publisher, Audience(subscriber, herd=False), self.payload)
                    channels[name].open(1)
                    ages[name], calls[name], servers[name] = [], [], []
                except ContenderError as error:
                    channels.pop(name, None)
                    yield self.identifier, name, failure(error)
            for _ in range(rounds):
                for name, channel in list(channels.items()):
                    try:
                        before = bench.workers.server.seconds()
                        calls[name] += channel.publish(count, self.gap)
                        ages[name] += channel.collect(count)
                        servers[name].append((bench.workers.server.seconds() - before) / count)
                    except ContenderError as error:
                        del channels[name]
                        yield self.identifier, name, failure(error)
        for name in channels:
            yield self.identifier, name, summary(ages[name], sent=count * rounds)
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
