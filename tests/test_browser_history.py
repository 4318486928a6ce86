"""The rolling buffer: what was where at which instant, within its bytes."""

import copy
import random

import numpy as np
import pytest

from reem_async.plan.trees import MISSING, get, removed, replaced
from reem_async.tools.browser.history import History
from reem_async.tools.browser.source import numbers_in
from reem_async.tools.browser.timeline import PENDING, UNKNOWN
from reem_async.tools.browser.trees import same, tree_of


@pytest.fixture
def history():
    it = History(1000.0, 1 << 20)
    it.start = 0.0
    return it


def test_what_was_never_seen_is_unknown_and_not_made_up(history):
    history.add(("arm", "q"), 5, 8, 10.0)
    assert history.tree(("arm",), 11.0) is UNKNOWN
    assert history.existed("arm", 11.0) is None
    assert history.tree(("nobody",), 11.0) is UNKNOWN
    history.add(("arm",), {"q": 6}, 8, 12.0)
    assert history.tree(("arm", "q"), 12.5) == 6


def test_an_array_that_was_not_kept_shows_the_one_before_and_how_late_it_is(history):
    frame = np.zeros((4, 4), np.uint8)
    history.begin("cam", b"{}")
    history.add(("cam", "image"), frame, 16, 5.0)
    history.add(("cam", "image"), PENDING, 0, 6.0)
    history.add(("cam", "image"), PENDING, 0, 8.0)
    kept = history.kept(("cam", "image"), 9.0)
    assert kept.value is frame
    assert kept.late == pytest.approx(3.0)
    assert history.kept(("cam", "image"), 5.5).late == 0.0
    assert history.last([("cam",)], 9.0) == {("cam",): 8.0}


def test_an_update_inside_of_what_was_not_kept_does_not_make_it_known(history):
    """The frame of 6.0 is not here: with one number of it, the one of 5.0 is still late."""
    history.begin("cam", b"{}")
    history.add(("cam",), {"image": np.zeros(4), "state": "raw"}, 40, 5.0)
    history.add(("cam",), PENDING, 0, 6.0)
    history.add(("cam", "state"), "done", 8, 6.5)
    assert [history.kept(path, 7.0).late for path in (("cam",), ("cam", "image"))] == [1.0, 1.0]
    assert history.kept(("cam", "state"), 7.0) == ("done", 0.0)
    history.add(("cam",), {"image": np.ones(4), "state": "done"}, 40, 8.0, answer=True)
    assert history.kept(("cam",), 9.0).late == 0.0


def brute(base, changes, at):
    tree = copy.deepcopy(base)
    for when, path, value in changes:
        if when <= at:
            tree = removed(tree, path[1:]) if value is MISSING else replaced(tree, path[1:], value)
    return tree


@pytest.mark.parametrize("seed", range(8))
def test_any_instant_equals_a_replay_of_all_changes_whatever_was_folded(seed):
    chance = random.Random(seed)
    history = History(30.0, 1 << 30)
    history.start = 0.0
    base = {"a": {"x": 0, "y": [0, 1, 2, 3]}, "b": [{"c": 1}, {"c": 2}], "s": 0}
    history.begin("k", b'{"a": {"x": 0, "y": [0, 1, 2, 3]}, "b": [{"c": 1}, {"c": 2}], "s": 0}')
    changes = []
    tree = base
    for number in range(400):
        when = number * 0.25
        path = chance.choice(
            [("a", "x"), ("a", "y"), ("a", "y", 1), ("b", 0, "c"), ("b", 1), ("s",), ("a",), (), ("n",)]
        )
        value = chance.choice([number, [number] * 3, {"c": number, "x": 1, "y": [5, 6, 7]}, MISSING])
        if path == ():
            value = copy.deepcopy(base)
        if path in (("a",), ("b", 1)) and value is not MISSING:
            value = {"x": number, "y": [1, 2, 3], "c": 0}
        if path == ("a", "y", 1) or (value is MISSING and path == ("b", 1)):
            value = MISSING if chance.random() < 0.3 and get(tree, path) is not MISSING else number
        if len(path) > 1 and get(tree, path[:-1]) is MISSING:
            continue
        try:
            tree = removed(tree, path) if value is MISSING else replaced(tree, path, value)
        except Exception:  # does not fit: no server would have done it
            continue
        changes.append((when, ("k", *path), value))
        history.add(("k", *path), value if value is MISSING else copy.deepcopy(value), 8, when)
    assert history.start > 60, "nothing was folded"
    for at in np.linspace(history.start, 101, 50):
        assert same(history.tree(("k",), at), brute(base, changes, at)), at


def test_the_budget_holds_and_the_newest_stays():
    history = History(1000.0, 200_000)
    history.start = 0.0
    for number in range(500):
        history.add(("cam",), np.full(5000, number % 256, np.uint8), 5000, float(number + 1))
        assert history.bytes <= 200_000 + 5500
    assert history.dropped > 300
    assert history.tree(("cam",), 500.0)[0] == 499 % 256
    assert history.start > 400
    counted = sum(change.size for change in history.between(0, 1e9))
    assert counted <= history.bytes


def test_what_is_older_than_the_span_is_forgotten():
    history = History(10.0, 1 << 20)
    history.start = 0.0
    for number in range(100):
        history.add(("n",), number, 8, float(number))
    assert len(list(history.between(0, 1e9))) <= 13
    assert history.start == pytest.approx(89.0, abs=1.5)
    assert history.tree(("n",), 95.0) == 95


def test_nothing_is_kept_of_keys_that_came_and_went():
    """Under ever new names there was a line of each for ever."""
    history = History(10.0, 1 << 20)
    history.start = 0.0
    history.add(("stays",), 1, 8, 0.0)
    for number in range(1, 200):
        name = f"job{number}"
        history.begin(name, None)
        history.add((name,), {"n": number}, 8, number / 2)
        history.add((name,), MISSING, 0, number / 2 + 0.25)
    assert len(list(history.names)) < 30
    assert history.bytes < 30 * 1500
    assert history.tree(("stays",), 99.5) == 1
    assert history.tree(("job195", "n"), 97.6) == 195
    assert history.existed("job195", 98.0) is False
    assert not history.knows("job5")
    history.begin("job5", None)
    history.add(("job5",), 7, 8, 99.6)
    assert (history.existed("job5", 99.5), history.tree(("job5",), 99.7)) == (False, 7)


def differs(history, name, text, when):
    return history.difference(name, MISSING if text is None else tree_of(text, name), text, when) is not None


def test_a_document_that_differs_from_what_was_heard_is_noticed_once(history):
    history.begin("k", b'{"a": 1}')
    assert not differs(history, "k", b'{"a": 1}', 1.0)
    history.add(("k", "a"), 2, 8, 2.0)
    assert not differs(history, "k", b'{"a":2}', 3.0), "the published change explains it"
    assert differs(history, "k", b'{"a":3}', 4.0)
    assert differs(history, "k", None, 5.0)
    assert differs(history, "new", b"1", 5.0)
    assert not differs(history, "never", None, 5.0)
    history.add(("k",), MISSING, 0, 6.0)
    history.remember("k", None)
    assert differs(history, "k", b'{"a":1}', 7.0), "it came back as it was"
    history.begin("j", b'{"a":1}')
    history.add(("j", "a"), 2, 8, 8.0)
    assert differs(history, "j", b'{"a":1}', 9.0), "the text that was there before the published change"


def test_what_is_beside_a_change_is_as_it_was(history):
    history.begin("k", b'{"a": 1, "b": 2, "l": [1, 2]}')
    history.add(("k", "a"), 3, 8, 2.0)
    assert [history.unchanged(path, 1.0) for path in (("k",), ("k", "a"), ("k", "b"))] == [False, False, True]
    history.add(("k", "l", 0), MISSING, 8, 3.0)
    assert not history.unchanged(("k", "l", 1), 2.5)
    assert history.unchanged(("k",), 3.0)


def test_a_dict_beside_a_value_that_changes_often_has_the_right_age(history):
    history.begin("k", b'{"x": 0, "slow": {"a": 1}}')
    history.add(("k", "slow", "a"), 2, 8, 1.0)
    for number in range(3000):
        history.add(("k", "x"), number, 8, 2.0 + number / 1000)
    assert history.last([("k", "slow"), ("k", "never")], 9.0) == {("k", "slow"): 1.0}


def test_series(history):
    history.begin("k", b'{"x": 0, "q": [1, 2]}')
    for when, path, value in ((1, "x", 1.5), (2, "q", [3, 4]), (3, "x", 2.5), (4, "x", "text"), (5, "x", 3)):
        history.add(("k", path), value, 8, float(when))
    history.add(("k", "q", 0), 9, 8, 6.0)
    series = numbers_in(history.values(("k", "x"), 0.0, 9.0))
    assert (series.times, series.lines) == ([0, 1, 3, 4, 5], [[0, 1.5, 2.5, None, 3]])
    series = numbers_in(history.values(("k", "q"), 0.0, 9.0))
    assert (series.names, series.times, series.lines) == (["[0]", "[1]"], [0, 2, 6], [[1, 3, 9], [2, 4, 4]])


def test_of_a_long_text_nothing_is_known_until_it_changes(history):
    texts = [b'"%b"' % (each * 300_000) for each in (b"a", b"b")]
    history.begin("k", texts[0])
    assert history.tree(("k",), 1.0) is UNKNOWN
    assert not differs(history, "k", texts[0], 1.0)
    history.remember("k", texts[0])
    assert not differs(history, "k", texts[0], 2.0)
    assert differs(history, "k", texts[1], 3.0)


def test_what_was_announced_and_then_found_is_one_change(history):
    history.add(("cam",), {}, 0, 9.0)
    for when in (10.0, 10.5):
        history.add(("cam", "image"), PENDING, 0, when)
        history.add(("cam", "image"), when, 8, when + 0.1, answer=True)
    assert history.times(("cam", "image")) == [9.0, 10.0, 10.5]
    assert history.times(()) == [9.0, 10.0, 10.5]
    assert history.rate("cam", 14.5) == pytest.approx(2 / 5)  # two in the last five seconds
