"""Updates told before the server has them, against the model of a server of test_replica.py: no server, no clock."""

from __future__ import annotations

import collections
import os
import random
from dataclasses import dataclass, field

import pytest
from test_replica import PATHS, PUBLISHERS, Faults, Made, World, has_bytes, value_at

from reem_async.plan.notices import ANNOUNCED, Notice, Slot, note_of
from reem_async.plan.trees import MISSING, concerns
from reem_async.pubsub.replica import Read, Skipped, Snapshot, State, Stored, Updated

SEEDS = int(os.environ.get("REEM_TEST_SCHEDULES", "60"))
UPDATES = 12


@dataclass
class Fates:
    """How often what becomes of an update that was told early, and how they come.

    Attributes:
        refused: It is not sent after all: its number is the next update's.
        dies: Its publisher is gone.
        taken: Its slot was written again before the notice was read: that says nothing but where it was.
        late: It waits for other things to happen.
        plain: An update is not told early.
        waits: A publisher waits for the server before its next update; else several are on their way.
        quick: An early update arrives before anything else happens.
        publishers: Who publishes.
        paths: Where.
    """

    refused: float = 0.0
    dies: float = 0.0
    taken: float = 0.0
    late: float = 0.7
    plain: float = 0.3
    waits: float = 1.0
    quick: float = 0.5
    publishers: str = PUBLISHERS
    paths: list = field(default_factory=lambda: PATHS)


class EarlyWorld(World):
    """A world whose publishers tell of updates before they send them."""

    beats = 5  # three until one that is not confirmed is given up

    def __init__(self, seed, path, fates, faults, *, tracked=False):
        self.fates, self.stamps, self.dead = fates, 0, 0
        self.pending = {}  # what each publisher has not sent to the server yet, oldest first
        self.direct = collections.deque()  # early updates on their way, beside the server's connection
        self.reads = []
        self.begun_with = faults
        super().__init__(seed, path, faults, tracked)

    @property
    def ends(self):
        return self.faults is not self.begun_with

    def step(self):
        if self.pending and self.rng.random() >= self.fates.late:
            self.end_one()
            return True
        if self.direct and self.rng.random() < self.fates.quick:
            self.deliver_early()
            return True
        return super().step() or bool(self.direct and self.deliver_early()) or bool(self.pending and self.end_one())

    def publish(self, publisher=None, path=None):
        rng, fates = self.rng, self.fates
        publisher = publisher or rng.choice(fates.publishers)
        path = rng.choice(fates.paths) if path is None else path
        while publisher in self.pending and (self.ends or rng.random() < fates.waits):
            self.end(publisher)
        if self.ends or (publisher not in self.pending and rng.random() < fates.plain):
            self.send(self.prepared(publisher, path, deleted=rng.random() < 0.2 and path != ("z",)))
            return
        if rng.random() < fates.dies and publisher not in self.pending:
            self.dead += 1
            publisher = f"dead {self.dead}"
        made = self.prepared(publisher, path, deleted=False, early=True)
        self.pending.setdefault(publisher, collections.deque()).append(made)
        self.direct.append(made)

    def prepared(self, publisher, path, *, deleted, early=False):
        self.stamps += 1
        number = self.model.numbers[publisher] + len(self.pending.get(publisher, ())) + 1
        large = self.rng.random() < 0.4
        slot = Slot("here", 1, 2, 3, self.stamps % 6, self.stamps) if early and large else None
        value = None if deleted else value_at(path, 10 + self.stamps + 1000 * len(self.model.made), large=large)
        told = None if deleted else ANNOUNCED if slot is None and large and has_bytes(value) else value
        return Made(Notice(publisher, number, float(self.stamps), path, deleted, told, 0, slot), value, None, False)

    def end_one(self):
        self.end(self.rng.choice([*self.pending]))
        return True

    def end(self, publisher):
        waiting = self.pending[publisher]
        made = waiting.popleft()
        if not waiting:
            del self.pending[publisher]
        if publisher.startswith("dead"):
            return
        if self.rng.random() < self.fates.refused:
            if waiting:  # only the newest number can be taken back
                self.model.numbers[publisher] = made.notice.sequence
            return
        if made.notice.slot and self.rng.random() < self.fates.taken:
            made.notice = made.notice._replace(value=ANNOUNCED)
        self.send(made)

    def send(self, made):
        """The server gets an update; one that it refuses is told of again, for all to look."""
        notice, model = made.notice, self.model
        model.numbers[notice.publisher] = notice.sequence
        made.refused = not model.change(notice.path, MISSING if notice.deleted else made.value)
        made.tree = model.tree
        self.tell_of(made)
        if made.refused:
            number = notice.sequence + 1 + len(self.pending.pop(notice.publisher, ()))
            again = notice._replace(sequence=number, value=ANNOUNCED, slot=None, deleted=False)
            model.numbers[notice.publisher] = again.sequence
            self.tell_of(Made(again, None, model.tree, True))

    def tell_of(self, made):
        notice, model = made.notice, self.model
        model.note = note_of(notice.publisher, notice.sequence).encode()
        model.made.append(made)
        self.tell_changes()
        if self.up:
            self.stream.append(("notice", made))

    def deliver_early(self):
        made = self.direct.popleft()
        if self.rng.random() >= self.faults.loses:
            for _ in range(2 if self.rng.random() < self.faults.repeats else 1):
                self.replica.on_early(made.notice._replace(early=True))
                self.drain()
        return True

    def drain(self):
        before = len(self.events)
        reads = [output for output in self.replica.outputs if isinstance(output, Read)]
        super().drain()
        if reads:
            self.reads.append(before)

    def live(self, updates):
        """Publish, deliver and break at random; where nothing is lost all is settled without another update."""
        while updates:
            if self.rng.random() < 0.3:
                self.publish()
                updates -= 1
            elif self.rng.random() < 0.05:
                self.beat()
            else:
                self.step()
        self.rest()
        if self.faults in (Faults(), Faults(slow=self.faults.slow)):
            self.check()
        super().live(0)

    # --- what must be true

    def gaps_after(self, place):
        return any(isinstance(event, Updated | Snapshot) and event.missed != 0 for event in self.events[place + 1 :])

    def check(self):
        assert self.replica.state is State.CURRENT
        assert self.replica.at() == self.followed(self.model.tree)
        assert not self.replica._early
        told = not self.begun_with.loses and not self.begun_with.garbles
        if told and not any(made.refused or made.notice.deleted for made in self.model.made):
            # Nobody only stores anything, and what was read never takes back what was told early.
            assert not any(isinstance(event, Stored) for event in self.events)
        self.check_told_last()
        sent = {self.name(made.notice) for made in self.model.made}
        places = {}
        for place, event in enumerate(self.events):
            if not isinstance(event, Updated | Skipped):
                continue
            name = self.name(event.notice)
            if event.notice.early and name not in sent:
                assert self.gaps_after(place), f"{event} was never sent, and no gap says so"
            if name in places:
                first = places[name]
                assert self.events[first].notice.early, f"{event} was told twice"
                assert any(first < at <= place for at in self.reads), f"{event} was told twice with no read between"
                assert not event.notice.early
            places[name] = place
        for place, event in enumerate(self.events):
            if isinstance(event, Updated) and event.notice.early and self.is_overtaken(place, event.notice):
                assert self.gaps_after(place), f"{event} came in another order, and no gap says so"

    def is_overtaken(self, place, early):
        """Whether the server had another update of the same place between, which was told later."""
        told = [event.notice for event in self.events[place + 1 :] if isinstance(event, Updated)]
        names = [self.name(made.notice) for made in self.model.made]
        own = names.index(self.name(early)) if self.name(early) in names else len(names)
        return any(
            (concerns(each, early.path) or concerns(early, each.path))
            and each.publisher != early.publisher
            and not each.early
            and self.name(each) in names[:own]
            for each in told
        )

    def check_told_last(self):
        told = [event.data for event in self.events if isinstance(event, Updated | Snapshot)]
        if told:
            assert told[-1] == self.replica.at()

    @staticmethod
    def name(notice):
        return notice.publisher, notice.sequence, notice.time, notice.path


FATES = {
    "confirmed": Fates(),
    "one publisher": Fates(publishers="p", plain=0.0),
    "one place": Fates(paths=[("a",)]),
    "places in each other": Fates(paths=[(), ("a",), ("a", "n"), ("a", "n", "x")]),
    "places beside each other": Fates(paths=[("a", "b"), ("a", "n"), ("z",)]),
    "items": Fates(paths=[("l",), ("l", 0), ("l", 1, "x")]),
    "not sent": Fates(refused=0.3),
    "dead": Fates(dies=0.3, publishers="pq"),
    "slots taken": Fates(taken=0.4),
    "at once": Fates(late=0.0),
    "many on their way": Fates(waits=0.2, plain=0.1),
    "everything": Fates(refused=0.2, dies=0.2, taken=0.2, waits=0.5),
}
FAULTS = {
    "quiet": Faults(),
    "slow ships": Faults(slow=0.8),
    "lost and repeated": Faults(loses=0.2, repeats=0.2),
    "everything": Faults(loses=0.1, repeats=0.1, garbles=0.1, breaks=0.05, fails=0.1, slow=0.5),
}


@pytest.mark.parametrize("faults", FAULTS)
@pytest.mark.parametrize("fates", FATES)
def test_a_copy_that_is_told_early_is_that_of_the_server_whatever_comes_when(fates, faults):
    """At rest they are equal; what was told wrongly is followed by a gap, and nothing told twice without a read."""
    for seed in range(SEEDS):
        for path in [(), ("a",), ("a", "n"), ("l", 0), ("l", -1)]:
            world = EarlyWorld(seed, path, FATES[fates], FAULTS[faults], tracked=seed % 2 == 1)
            try:
                world.live(world.rng.randint(1, UPDATES))
                world.check()
            except AssertionError as error:
                raise AssertionError(f"seed {seed}, path {path}: {error}") from error


def test_alone_every_update_is_told_once_early_and_without_a_gap():
    for seed in range(SEEDS):
        world = EarlyWorld(seed, (), Fates(publishers="p", plain=0.0, quick=1.0, paths=[(), ("a",), ("z",)]), Faults())
        world.rest()
        world.send(world.prepared("p", (), deleted=False))
        world.rest()
        world.events.clear()
        reads = len(world.reads)
        for _ in range(random.Random(seed).randint(1, UPDATES)):
            world.publish("p")
        world.rest()
        told = [event for event in world.events if isinstance(event, Updated | Skipped | Snapshot)]
        assert [event.notice.sequence for event in told] == [made.notice.sequence for made in world.model.made][
            -len(told) :
        ]
        assert all(event.notice.early and not event.missed for event in told)
        assert len(world.reads) == reads
        world.check()


@pytest.fixture
def world():
    """One that is current, and in which nothing happens by itself."""
    world = EarlyWorld(1, (), Fates(), Faults())
    for publisher in "pq":
        world.send(world.prepared(publisher, (), deleted=False))
    world.rest()
    world.events.clear()
    return world


def early(world, publisher, path, stamp):
    made = world.prepared(publisher, path, deleted=False, early=True)
    world.replica.on_early(made.notice._replace(early=True))
    world.drain()
    return made


def test_what_is_never_confirmed_is_told_with_a_gap_though_others_go_on(world):
    early(world, "q", ("a",), 1)
    for stamp in range(2, 6):
        world.send(early(world, "p", ("z",), stamp))
        world.beat()
        while world.step():
            pass
    assert any(isinstance(event, Snapshot) and event.missed is None for event in world.events)
    assert world.replica.at() == world.model.tree


def test_what_is_not_sent_is_told_with_a_gap_though_it_was_read_in_between(world):
    refused = early(world, "q", ("a",), 1)
    announced = world.prepared("p", ("z",), deleted=False)
    announced.notice = announced.notice._replace(value=ANNOUNCED)
    world.send(announced)
    while world.step():
        pass
    assert world.replica.at() == world.model.tree
    assert not world.gaps_after(-1)
    world.send(world.prepared("q", ("l",), deleted=False))  # with the same number
    while world.step():
        pass
    assert world.events[0].notice.publisher == refused.notice.publisher
    assert world.gaps_after(0)


def test_of_many_that_are_not_confirmed_the_first_hundred_are_reported_early_and_all_once(world):
    for stamp in range(150):
        world.pending.setdefault("p", collections.deque()).append(early(world, "p", ("a",), stamp))
    assert len(world.events) == 100
    while world.pending:
        world.end("p")
    while world.step():
        pass
    told = [event.notice.sequence for event in world.events if isinstance(event, Updated)]
    assert told == list(range(told[0], told[0] + 150))
    assert not world.gaps_after(-1)
    assert world.replica.at() == world.model.tree
