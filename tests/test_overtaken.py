"""What a read tells of the updates that were only announced: every schedule of a small model, no server, no clock."""

import itertools
import random

import pytest

from reem_async.plan.copies import is_own, rest_of
from reem_async.plan.notices import ANNOUNCED
from reem_async.plan.trees import MISSING, CannotApply, get, removed, replaced
from reem_async.tools.recording.key_queue import Item, is_replaced, settled, skipped
from reem_async.tools.recording.stored import applied

PLACES = [(), ("a",), ("a", "b"), ("a", "b", "c"), ("d",), ("l",), ("l", 0), ("l", 1), ("l", 0, "x")]
MODES = ["announced", "with its value"]


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


def queue_of(made):
    name = ("k",)
    return [
        Item(role, (*name, *path), value, (2000 * order, order, order), order)
        for order, (role, path, value, _) in enumerate(made, 1)
    ]


def recorded(made, rng):
    """Settle a queue as a recorder does, each read at any later moment; return what is written, in order."""
    arrived, items, written, unknown = 0, [], [], False
    while items or arrived < len(made):
        more = rng.randint(0, 3) if items else 1
        items += queue_of(made)[arrived : arrived + more]
        arrived = min(arrived + more, len(made))
        while items and items[0].value is not ANNOUNCED:
            written.append(items.pop(0))
        if not items:
            continue
        head = items[0]
        if head.role == "update" and is_replaced(items):
            items[0] = skipped(head)
            continue
        line = rng.randint(max(arrived, head.order), len(made))
        items += queue_of(made)[arrived:line]  # the recorder waits until it has heard of all that is in what was read
        arrived = max(arrived, line)
        value = get(made[line - 1][3], head.path[1:])
        items, lacks = settled(items, value, 0, line)
        unknown = unknown or lacks
    return written, unknown


@pytest.mark.parametrize("batch", range(20))
def test_what_is_written_is_what_was_published_in_its_order(batch):
    """Every update as published or skipped; where the places of the skipped are known again, all is as it was."""
    for seed in range(100):
        rng = random.Random(1000 * batch + seed)
        made = published(rng, rng.randint(2, 9))
        written, unknown = recorded(made, rng)
        news = [item for item in written if item.role in ("update", "delete")]
        lost = [item for item in written if item.role == "skip"]
        assert [item.stamp for item in written] == sorted(
            [item.stamp for item in written], key=lambda stamp: stamp[0]
        ), seed
        assert sorted(item.order for item in [*news, *lost]) == list(range(1, len(made) + 1)), seed
        for item in news:
            role, path, _, tree = made[item.order - 1]
            assert (item.role, item.path[1:]) == (role, path)
            assert item.role == "delete" or item.value == get(tree, path), seed
        if not unknown:
            compare_trees(made, written, seed)


def compare_trees(made, written, seed):
    """The tree after each instant is the publisher's, but at the places of skipped updates until they are known."""
    tree = model_value(None, 0, ())
    doubt = []  # places of which nobody knows what was there
    for stamp, items in itertools.groupby(written, key=lambda item: item.stamp[0]):
        for item in items:
            path = item.path[1:]
            if item.role == "skip":
                doubt.append(path)
            elif item.role == "found":
                role = "delete" if item.value is MISSING else "update"
                tree = applied(tree, path, role, "kvs", item.value)
            else:
                tree = applied(tree, path, item.role, "pub", item.value)
        order = stamp // 2000
        role, path, _, truth = made[order - 1]
        last = next(item for item in written if item.order == order)
        if role == "delete" and isinstance(path[-1], int):  # the items behind it have other places now
            doubt = [path[:-1] if place[: len(path) - 1] == path[:-1] else place for place in doubt]
        if last.role != "skip":
            again = [place for place in doubt if place[: len(path)] == path]
            doubt = [place for place in doubt if place not in again]
        if not doubt:
            assert tree == truth, (seed, order)
    assert tree == made[-1][3], seed


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
