"""A recorder's queue against a model of one key: every order of events that can come about, no server, no clock."""

from __future__ import annotations

import collections
import random
import sys
from dataclasses import dataclass

import pytest
from test_layers import ROOT, roots

from reem_async.errors import Conflict, NotConnected
from reem_async.plan.notices import ANNOUNCED, Notice, note_of
from reem_async.plan.trees import MISSING, CannotApply, concerns, get, is_own, removed, replaced, rest_of
from reem_async.pubsub.division import Division, Heard, Numbers, divided_read
from reem_async.tools.recording.key_queue import Item, KeyQueue, settled
from reem_async.tools.recording.stored import New, Unchanged, applied

PUBLISHERS = "p", "q", "r"
STORED = "stored"
"""What nobody publishes."""


class Awaited:
    """What a coroutine waits for, until the world sends it."""

    def __init__(self, what):
        self.what = what

    def __await__(self):
        return (yield self.what)


@dataclass
class Faults:
    """How often what happens to notices and reads."""

    loses: float = 0.0
    repeats: float = 0.0
    breaks: float = 0.0
    fails: float = 0.0
    stores: float = 0.0


class World:
    """A key of a server, the queue of its recorder, and all that is on its way between them."""

    def __init__(self, seed, faults):
        self.rng = rng = random.Random(seed)
        self.faults = faults
        self.made, self.trees = [], [model_value(rng, 0, ())]
        numbers = collections.Counter()
        for role, path, value, tree in published(rng, rng.randint(2, 14)):
            self.add(numbers, rng.choice(PUBLISHERS), path, value, deleted=role == "delete", tree=tree)
        self.random = len(self.made)
        for publisher in PUBLISHERS if faults.loses else ():  # a loss is known with the next update of its publisher
            last = self.trees[-1] | {"n": publisher}
            self.add(numbers, publisher, ("n",), publisher, deleted=False, tree=last)
        self.published = rng.choice([0, 0, 1, 2])  # before it is recorded
        self.begun = self.published
        self.queue = KeyQueue()
        self.numbers = Numbers()
        self.stream = collections.deque()
        self.reading = None  # the coroutine that reads, and what it waits for
        self.waits = None
        self.stored = self.replaced = 0  # how often something was stored, and before the last update of all
        self.delivered, self.lost, self.written = [], [], []
        self.arrived = 0  # the log time of what arrived last
        self.behind = False  # a read has failed, and the key is to be read anew some time
        self.read()

    def add(self, numbers, publisher, path, value, *, deleted, tree):
        numbers[publisher] += 1
        told = None if deleted else value
        self.made.append(Notice(publisher, numbers[publisher], float(len(self.made)), path, deleted, told))
        self.trees.append(tree)

    # --- what a recorder does

    def stamp(self):
        self.arrived += 2000  # a state that is put behind an item has room
        return self.arrived

    def read(self):
        self.queue.doubt()
        if not self.queue.will_read("state"):
            self.queue.items.append(Item("state", ("k",), ANNOUNCED, (self.stamp(), 0, 0), self.queue.order))

    def look(self):
        if not self.queue.will_read("state", "stored"):
            self.queue.items.append(Item("stored", ("k",), ANNOUNCED, (self.stamp(), 0, 0), self.queue.order))

    def gap(self):
        self.queue.order += 1
        self.queue.items.append(Item("gap", ("k",), None, (self.stamp(), 0, 0), self.queue.order))
        self.read()

    def hear(self, notice):
        if self.numbers.take(notice.publisher, notice.sequence) > 0:
            self.gap()
        if self.queue.hear(notice):
            role, stamp = "delete" if notice.deleted else "update", (self.stamp(), 0, int(notice.time))
            self.queue.items.append(Item(role, ("k", *notice.path), notice.value, stamp, self.queue.order))
            self.delivered.append(notice)

    def write(self):
        self.written += self.queue.ready()
        if self.queue.items and self.reading is None:
            path = self.queue.items[0].path[1:]

            async def read():
                self.queue.asked()
                return await Awaited(("read", path))

            async def fence():
                await Awaited(("fence", None))

            self.reading = divided_read(self.queue.division, read, fence)
            self.resume(None)

    def resume(self, outcome):
        """Go on with the read until it waits for something else, or is done."""
        try:
            fails = isinstance(outcome, Exception)
            self.waits = self.reading.throw(outcome) if fails else self.reading.send(outcome)
            if self.waits[0] == "fence":
                self.stream.append("fence")
        except StopIteration as done:
            self.reading = self.waits = None
            if self.queue.settle(done.value, 0):
                self.read()
        except (NotConnected, Conflict):
            self.reading = self.waits = None
            head = self.queue.give_up()
            if head.role == "skip":
                self.written.append(head)
            self.behind = True

    def catch_up(self):
        self.behind = False
        self.read()

    # --- what may happen next

    def step(self):
        choices = []
        if self.stream:
            choices += [self.deliver] * 3
        if self.waits and self.waits[0] == "read":
            choices += [self.reply] * 2
        if self.queue.items and (self.reading is None or self.queue.items[0].value is not ANNOUNCED):
            choices.append(self.write)
        if self.stream and self.rng.random() < self.faults.breaks:
            choices.append(self.reconnect)
        if self.behind:
            choices.append(self.catch_up)
        if not choices:
            return False
        self.rng.choice(choices)()
        return True

    def publish(self):
        if self.faults.stores:  # a published update is a change too
            self.stream.append("changed")
        self.stream.append(self.made[self.published])
        if not self.stream[-1].path:
            self.replaced = self.stored
        self.published += 1

    def store(self):
        """Somebody changes something, beside all that is published."""
        if type(self.trees[self.published]) is dict:
            self.stored += 1
            self.stream.append("changed")

    def there(self):
        tree = self.trees[self.published]
        return tree | {STORED: self.stored} if self.stored > self.replaced and type(tree) is dict else tree

    def deliver(self):
        what = self.stream.popleft()
        if what == "fence":
            self.resume(None)
            return
        if what == "changed":
            self.look()
            return
        is_known = what.publisher in self.numbers.last
        if is_known and what.time < self.random and self.rng.random() < self.faults.loses:
            self.lost.append(what)
            return
        self.hear(what)
        if self.rng.random() < self.faults.repeats:
            self.hear(self.rng.choice(self.delivered[-5:]))

    def reply(self):
        if self.rng.random() < self.faults.fails:
            self.resume(NotConnected("gone"))
            return
        note = None
        if self.published:
            last = self.made[self.published - 1]
            note = note_of(last.publisher, last.sequence).encode()
        self.resume((get(self.there(), self.waits[1]), note))

    def reconnect(self):
        """What was on its way is lost; the recorder reads the key anew."""
        self.lost += [what for what in self.stream if type(what) is Notice]
        self.stream.clear()
        self.gap()
        if self.waits and self.waits[0] == "fence":
            self.resume(NotConnected("gone"))

    def live(self):
        eager = self.rng.choice([0.1, 0.3, 0.6])
        while self.published < len(self.made):
            if self.rng.random() < self.faults.stores:
                self.store()
            elif self.rng.random() < eager:
                self.publish()
            else:
                self.step()
        self.faults = Faults()
        while self.step():
            pass
        if self.lost:  # of a publisher whose last update was lost nothing tells; the next keyframe reads the key
            self.read()
            while self.step():
                pass

    # --- what must be true

    def check(self):
        assert not self.queue.items
        times = [item.stamp[0] for item in self.written]
        assert times == sorted(times)
        news = [item for item in self.written if item.role in ("update", "delete", "skip")]
        assert sorted(item.stamp[2] for item in news) == [int(notice.time) for notice in self.delivered]
        tree, doubt, lacks = MISSING, False, False
        for item in self.written:
            path = item.path[1:]
            if item.role in ("update", "delete"):
                self.check_value(item)
            lacks = (lacks or item.role == "gap") and item.role != "state"
            if item.role == "stored" and not lacks and not self.lost:
                assert bare(item.value) == bare(tree), "what was published is recorded as stored"
            if item.role in ("state", "stored"):
                tree, doubt = item.value, doubt and item.role == "stored"
                self.check_state(item)
            elif item.role == "found":
                tree = applied(tree, path, "delete" if item.value is MISSING else "update", "kvs", item.value)
            elif item.role in ("skip", "gap"):
                doubt = True
            elif tree is not MISSING:
                tree = applied(tree, path, item.role, "pub", item.value)
            if item.role in ("update", "delete") and not doubt and not self.lost and tree is not MISSING:
                assert bare(tree) == self.trees[item.stamp[2] + 1]
        assert tree == self.there()

    def check_value(self, item):
        notice = self.made[item.stamp[2]]
        assert (item.path[1:], item.deleted) == (notice.path, notice.deleted)
        if not item.deleted and not self.is_changed_unseen(notice):
            assert bare(item.value) == get(self.trees[item.stamp[2] + 1], notice.path)

    def is_changed_unseen(self, notice):
        """Whether a lost update may have changed what was announced, and nobody could know of it yet."""
        return notice.value is ANNOUNCED and any(
            each.time > notice.time
            and concerns(each, notice.path)
            and any(later.publisher != each.publisher for later in self.made[int(each.time) + 1 :])
            for each in self.lost
        )

    def check_state(self, item):
        """It is what was there between what is written before it and what is written behind it."""
        if not self.lost:
            place = self.written.index(item)
            before = [each.stamp[2] for each in self.written[:place] if each.role in ("update", "delete", "skip")]
            first = max(before) + 1 if before else self.begun
            behind = [each.stamp[2] for each in self.written[place:] if each.role in ("update", "delete", "skip")]
            assert bare(item.value) in self.trees[first : (min(behind) if behind else len(self.made)) + 1]


SCHEDULES = {
    "quiet": Faults(),
    "repeated": Faults(repeats=0.3),
    "lost": Faults(loses=0.2),
    "lost and repeated": Faults(loses=0.2, repeats=0.2),
    "reconnected": Faults(loses=0.01, breaks=0.1),
    "failing reads": Faults(fails=0.2),
    "stored": Faults(stores=0.3),
    "stored and failing reads": Faults(fails=0.5, stores=0.5),
    "stored and lost": Faults(stores=0.3, loses=0.2),
    "everything": Faults(loses=0.1, repeats=0.1, breaks=0.05, fails=0.1, stores=0.2),
}


def bare(tree):
    """What publishers have made of a tree."""
    return {key: item for key, item in tree.items() if key != STORED} if type(tree) is dict else tree


@pytest.mark.parametrize("faults", SCHEDULES)
def test_what_is_recorded_is_what_was_published_whatever_comes_when(faults):
    """In its order, each once, with its own value or skipped; states are where they belong, the last one is right."""
    for seed in range(300):
        world = World(seed, SCHEDULES[faults])
        try:
            world.live()
            world.check()
        except AssertionError as error:
            raise AssertionError(f"seed {seed}") from error


def test_a_loss_that_a_note_shows_skips_all_that_it_may_have_changed():
    """Not only the value that was being read: one behind it was recorded with what the lost update had made of it."""
    queue = KeyQueue()
    for number, name in ((1, "a"), (2, "b")):
        assert queue.hear(Notice("p", number, 0.0, (name,), False, ANNOUNCED))
        queue.items.append(Item("update", ("k", name), ANNOUNCED, (2000 * number, 0, number), queue.order))
    queue.asked()
    assert not queue.division.answered(b"q 1")
    assert queue.division.divide(b"q 1")
    assert queue.settle(1, 8), "the key has to be read"
    assert [item.role for item in queue.items] == ["skip", "skip"]


def test_a_read_that_takes_the_place_of_another_has_the_arrays_that_only_that_one_brought():
    """The second look was asked for while the first one was on its way, and had to bring no array again."""
    queue, later, array = KeyQueue(), Unchanged(), b"an array"
    for number in (1, 2):
        queue.items.append(Item("stored", ("k",), ANNOUNCED, (2000 * number, 0, 0)))
    for value in ({"l": [New(array, later)], "n": 1}, {"l": [later], "n": 2, "m": Unchanged()}):
        queue.asked()
        assert queue.division.answered(None)
        assert queue.division.divide(None)
        assert not queue.settle(value, 8)
    (item,) = queue.ready()
    assert (item.role, item.value["l"], item.value["n"]) == ("stored", [New(array, later)], 2)
    assert type(item.value["m"]) is Unchanged  # of a read whose place was not taken


def test_who_never_hears_of_what_is_published_gives_up():
    """Somebody's notices never arrive, but his notes do: nobody knows which of the others are in what is read."""
    division, reads = Division(), 0

    async def read():
        nonlocal reads
        reads += 1
        division.asked(in_order=False)
        division.hear(Heard(Notice("p", reads, 0.0, (), False, 1), 0))
        return "value", b"q %d" % reads

    async def fence():
        pass

    with pytest.raises(Conflict, match="never heard of"):
        divided_read(division, read, fence).send(None)
    assert division.take() == ([], [])


def test_the_queue_does_no_input_or_output():
    for name in ("tools/recording/key_queue", "pubsub/division"):
        path = ROOT / "reem_async" / f"{name}.py"
        assert roots(path) <= set(sys.stdlib_module_names) | {"reem_async"}
        assert not roots(path) & {"asyncio", "socket", "time", "threading"}


# --- what a read tells of the updates that were only announced


PLACES = [(), ("a",), ("a", "b"), ("a", "b", "c"), ("d",), ("l",), ("l", 0), ("l", 1), ("l", 0, "x")]


def model_value(rng, number, path):
    """A value that no other update writes, with insides that others may touch."""
    inner = {"b": {"c": number, "e": number}, "n": number}
    whole = {"a": inner, "d": number, "l": [{"x": number}, {"x": -number}, number], "n": number}
    return {0: whole, 1: {"a": inner, "l": whole["l"]}.get(path[-1] if path else "", number)}.get(len(path), number)


def published(rng, count):
    """Updates as a publisher makes them, each with the tree that it leads to; the server refuses none of them."""
    tree = model_value(rng, 0, ())
    made = []
    while len(made) < count:
        path = rng.choice(PLACES)
        number = len(made) + 1
        if rng.random() < 0.3 and path and get(tree, path) is not MISSING:
            tree = removed(tree, path)
            made.append(("delete", path, MISSING, tree))
            continue
        try:
            value = model_value(rng, number, path)
            tree = replaced(tree, path, value)
        except CannotApply:
            continue
        made.append(("update", path, ANNOUNCED if rng.random() < 0.5 else value, tree))
    return made


def test_only_what_was_touched_is_lost():
    later = [Item("update", ("cam", "state"), "done", (0, 0, 2)), Item("update", ("cam", "box", 1), 7, (0, 0, 3))]
    value = {"image": 1, "state": "done", "box": [1, 7]}
    assert not is_own(("cam",), later)
    assert is_own(("cam", "image"), later)
    assert rest_of(value, ("cam",), later) == ({"image": 1}, {("cam", "box"): 1})
    assert rest_of(value, ("cam",), [Item("delete", ("cam",), None, (0, 0, 2))]).value is MISSING
    assert rest_of([1, 7], ("cam", "box"), later) == (MISSING, {("cam", "box"): 1})


def test_a_list_that_was_written_as_a_whole_again_is_not_taken_from_what_was_read():
    later = [Item("update", ("cam", "box", 1), 7, (0, 0, 2)), Item("update", ("cam",), ANNOUNCED, (0, 0, 3))]
    assert rest_of([1, 7], ("cam", "box"), later) == (MISSING, {})


def test_an_item_that_may_have_moved_is_nobody_s():
    """Deleting the item before it moved another one to its place."""
    deletion = Item("delete", ("cam", "box", 0), None, (0, 0, 2))
    assert not is_own(("cam", "box", 1), [deletion])
    assert rest_of(5, ("cam", "box", 1), [deletion]) == (MISSING, {("cam", "box"): 0})


def test_a_gap_may_have_touched_anything():
    large = Item("update", ("k", "a"), ANNOUNCED, (2000, 1, 1), 1)
    gap = Item("gap", ("k",), 3, (4000, 0, 0), 2)
    items, _ = settled([large, gap], 5, 0, line=2)
    assert [item.role for item in items] == ["skip", "gap"]
    items, _ = settled([large, gap], 5, 0, line=1)
    assert [(item.role, item.value) for item in items] == [("update", 5), ("gap", 3)]


def test_a_state_comes_behind_all_that_it_holds_and_brings_the_values_of_those_announced():
    state = Item("state", ("k",), ANNOUNCED, (1000, 0, 0), 0)
    large = Item("update", ("k", "a"), ANNOUNCED, (2000, 1, 1), 1)
    small = Item("update", ("k", "x"), 1, (4000, 2, 2), 2)
    keyframe = Item("keyframe", ("k",), None, (6000, 0, 1), 2)
    newer = Item("update", ("k", "x"), 2, (8000, 3, 3), 3)
    items, _ = settled([state, large, small, keyframe, newer], {"a": 5, "x": 1}, 0, line=2)
    assert [item.role for item in items] == ["update", "update", "keyframe", "state", "update"]
    assert [item.stamp[0] for item in items] == [2000, 4000, 6000, 7000, 8000]
    assert items[0].value == 5


def test_what_nobody_published_is_no_deletion():
    """The server refused an announced update, or somebody only stored: nothing is there, and nobody deleted it."""
    items, _ = settled([Item("update", ("k", "a"), ANNOUNCED, (2000, 1, 1), 1)], MISSING, 0, line=1)
    assert [(item.role, item.value) for item in items] == [("skip", None), ("found", MISSING)]
