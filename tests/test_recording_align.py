"""Values of several paths of a recording at common instants."""

import numpy as np
import pytest
from conftest import assert_same, sized

from reem_async.errors import BadData, BadInput, BadType, BadValue, MissingKey
from reem_async.plan.trees import MISSING
from reem_async.ships.registry import Ships, default_ships
from reem_async.tools.recording import open_log
from reem_async.tools.recording.format import Role
from reem_async.tools.recording.sink import Sink
from reem_async.tools.recording.writer_thread import Operation, WriterThread
from reem_async.transport.protocol import CommandRecorder

BEGUN = 1_764_000_000
"""Seconds since 1970 at which the recordings of these tests begin."""


def recorded(file, changes, arrived=None):
    """Write a recording of changes: seconds since BEGUN, full path and value, MISSING for a deletion.

    The seconds are when they were published, and when they were received too, unless `arrived` says when that was.
    """
    sink = Sink(file, "none", {}, overwrite=False)
    sink.output.appear()
    thread = WriterThread(sink, Ships(default_ships(), CommandRecorder), 1 << 30)
    thread.start()
    when = arrived or float
    for number, (at, path, value) in enumerate(sorted(changes, key=lambda change: (when(change[0]), change[0])), 1):
        role = Role.DELETE if value is MISSING else Role.UPDATE
        received, published = (BEGUN * 10**9 + round(it * 1e6) * 1000 for it in (when(at), at))
        received += number * 2000 if arrived else 0  # no two have the same
        thread.put(Operation(role, path, value, (received, published, number)), 0)
    thread.stop({})
    assert thread.failure is None
    return open_log(file)


def chosen(changes, instant, method, tolerance):
    """What a row has by the definition of a method: the value and the times of the changes that it is of."""
    near = [each for each in changes if abs(each[0] - instant) <= tolerance and each[1] is not MISSING]
    before = [each for each in changes if each[0] <= instant][-1:]
    after = [each for each in changes if each[0] > instant][:1]
    around = [each for each in before + ([] if method == "previous" else after) if each in near]
    if method == "linear" and before and before[0][0] != instant:
        if len(around) < 2:
            return None, []
        (first, low), (second, high) = around
        return low + (high - low) * ((instant - first) / (second - first)), [first, second]
    if method == "linear":
        around = [each for each in around if each[0] <= instant]
    if not around:
        return None, []
    best = min(around, key=lambda each: abs(each[0] - instant))
    return best[1], [best[0]]


@pytest.mark.parametrize("seed", range(sized(8, 100)))
def test_each_row_has_what_its_method_says_and_the_counts_add_up(seed, file):
    """Compared with the definition, for random times, gaps, deletions, tolerances and spans; times are in ms."""
    random = np.random.default_rng(seed)
    paths = {"a.q": "nearest", "b": "previous", "c.x": "linear"}
    changes = {}
    for path in paths:
        times = np.unique(random.integers(0, 400, random.integers(1, 60))).tolist()
        gone = [path == "b" and n > 0 and random.random() < 0.2 for n in range(len(times))]
        changes[path] = [(at * 10, MISSING if gone[n] else n + 0.25) for n, at in enumerate(times)]
    everything = [(at / 1000, tuple(path.split(".")), value) for path, each in changes.items() for at, value in each]
    tolerance, period = int(random.choice([20, 100, 100_000])), int(random.choice([25, 100, 250]))
    start, end = sorted(random.integers(0, 40, 2).tolist())
    span = {"start": BEGUN + start / 10, "end": BEGUN + end / 10}
    with recorded(file, everything) as log:
        aligned = log.align(list(paths), rate=1000 / period, method=paths, tolerance=tolerance / 1000, **span)
        block = aligned.read()
        on = log.align(["b", "a.q"], on="a.q", method="previous").read()
    assert on["a.q"].tolist() == [value for _, value in changes["a.q"]]
    instants = list(range(start * 100, end * 100 + 1, period))
    assert block.times == pytest.approx(BEGUN + np.array(instants) / 1000, abs=1e-6)
    for path, method in paths.items():
        counts, seen, fresh, interpolated = aligned.counts[path], set(), 0, 0
        for row, instant in enumerate(instants):
            value, times = chosen(changes[path], instant, method, tolerance)
            assert block.missing[path][row] == (value is None)
            assert value is None or block[path][row] == pytest.approx(value)
            fresh += len(times) == 1 and times[0] not in seen
            interpolated += len(times) == 2
            seen.update(times)
        assert (counts.used, counts.interpolated) == (fresh, interpolated)
        assert counts.missing == int(block.missing[path].sum())
        assert counts.used + counts.repeated + counts.interpolated + counts.missing == len(block)
        inside = {at for at, value in changes[path] if instants[0] <= at <= instants[-1] and value is not MISSING}
        assert 0 <= len(inside - seen) - counts.dropped <= 1, "the last one before the end is not passed"


def test_arrays_are_stacked_in_bounded_blocks_and_missing_rows_are_marked(file, monkeypatch):
    """Of what is larger than memory only one block is held, and each value is decoded once."""
    monkeypatch.setattr("reem_async.tools.recording.align._BLOCK_BYTES", 40_000)
    image = np.arange(10_000, dtype=np.uint8).reshape(50, 200)
    changes = [(n / 10, ("cam", "rgb"), image + np.uint8(n)) for n in range(20) if n not in (7, 8)]
    changes += [(n / 100, ("arm",), {"q": [n * 1.0, -n * 1.0], "mode": f"m{n}"}) for n in range(200)]
    with recorded(file, changes) as log:
        aligned = log.align(["cam.rgb", "arm.q", "arm.mode"], rate=10, tolerance={"cam.rgb": 0.05, "arm.q": 0.006})
        blocks = list(aligned)
    assert [len(block) for block in blocks] == [4, 6, 4, 4, 2]
    missing = np.concatenate([block.missing["cam.rgb"] for block in blocks])
    assert np.flatnonzero(missing).tolist() == [7, 8]
    images = np.concatenate([block["cam.rgb"] for block in blocks])
    assert_same(images[[0, 6, 7, 9]], np.stack([image, image + np.uint8(6), image * 0, image + np.uint8(9)]))
    assert blocks[1]["arm.q"].tolist() == [[n * 10.0, -n * 10.0] for n in range(4, 10)]
    assert blocks[-1]["arm.mode"] == ["m180", "m190"]
    counts = aligned.counts
    assert (counts["cam.rgb"].used, counts["cam.rgb"].missing, counts["cam.rgb"].dropped) == (18, 2, 0)
    assert (counts["arm.q"].used, counts["arm.q"].dropped) == (20, 171)


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ({"rate": 10, "paths": "a"}, BadType, "use a list of paths"),
        ({"rate": 10, "paths": []}, BadType, "use a list of paths"),
        ({}, BadValue, "either rate"),
        ({"rate": 10, "on": "a"}, BadValue, "either rate"),
        ({"rate": 0}, BadValue, "rate=0 is out of range"),
        ({"rate": 10, "method": "cubic"}, BadValue, "none of previous, nearest, linear"),
        ({"rate": 10, "method": {"b": "linear"}}, BadValue, "none of the paths: a, t"),
        ({"rate": 10, "tolerance": -1}, BadValue, "tolerance=-1 is out of range"),
        ({"rate": 10, "method": "linear"}, BadType, r"t is 'text' at .* use the method previous or nearest"),
        ({"rate": 10, "clock": "server"}, BadValue, "clock='server' is none of recorder, publisher"),
        ({"rate": 10, "start": "now"}, BadInput, "seconds since 1970"),
    ],
)
def test_what_cannot_be_aligned_is_refused_before_anything_is_read(arguments, error, said, file):
    with recorded(file, [(0, ("a",), 1), (0, ("t",), "text")]) as log:
        with pytest.raises(error, match=said):
            log.align(**({"paths": ["a", "t"]} | arguments))
        with pytest.raises(MissingKey, match="nothing was recorded at 'b'; the recording has a, t"):
            log.align(["b"], rate=1)


def test_numbers_that_change_their_shape_are_not_interpolated(file):
    changes = [(0, ("a",), [1.0]), (1, ("a",), [1.0, 2.0])]
    with recorded(file, changes) as log, pytest.raises(BadType, match=r"a changes from \(1,\) to \(2,\) numbers"):
        log.align(["a"], rate=10, method="linear").read()


def test_a_publisher_whose_clock_was_set_back_is_reported(file):
    """By over a second; two publishers of one path may be received in another order than by their times."""
    received = {100: 100, 100.5: 101, 100.2: 102, 5: 103, 6: 104}
    with recorded(file, [(at, ("a",), at) for at in received], arrived=received.get) as log:
        assert log.align(["a"], on="a").read()["a"].tolist() == list(received)
        with pytest.raises(BadData, match=r'publisher of a was set back by 95.500 s.*use the clock "recorder"'):
            log.align(["a"], rate=10, start=BEGUN + 100, end=BEGUN + 200, clock="publisher").read()


def test_an_episode_is_a_span_in_which_a_path_holds_a_dict(file):
    """Its fields may change; another whole dict is another episode, so that many never become one."""
    writes = [
        ((), {"task": "a", "n": 0}),
        (("steps",), 1),
        ((), {"task": "a", "n": 0, "steps": 1, "outcome": "success"}),
        ((), None),
        ((), {"task": "a", "n": 1}),
        ((), {"task": "a", "n": 2, "discard": True}),
        ((), MISSING),
        ((), {"task": "b", "outcome": "discarded"}),
        ((), {"task": "b"}),
        ((), 5),
        ((), {}),
    ]
    changes = [(place, ("notes", "episode", *inner), value) for place, (inner, value) in enumerate(writes)]
    with recorded(file, [*changes, (12, ("other",), 0)]) as log:
        found = log.episodes("notes.episode")
        assert log.episodes() == log.episodes("other") == []
    spans = [(each.start - BEGUN, each.end - BEGUN, each.ended, each.discarded) for each in found]
    assert spans == [
        (0, 3, True, False), (4, 5, True, False), (5, 6, True, True),
        (7, 8, True, True), (8, 9, True, False), (10, 12, False, False),
    ]  # fmt: skip
    assert found[0].data == {"task": "a", "n": 0, "steps": 1, "outcome": "success"}
    assert found[-1].data == {}
