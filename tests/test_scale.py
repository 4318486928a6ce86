"""How far it goes: the model's arithmetic, the simulation, the kept page, and a measurement of a real server."""

import asyncio
import contextlib
import dataclasses

import hiredis
import numpy as np
import pytest

from benchmarks.scale import full, kinds, page, results, spread
from benchmarks.scale.measure import QUICK, measure
from benchmarks.scale.model import (
    Cost,
    Figures,
    Load,
    Node,
    Topic,
    Value,
    bottleneck,
    carried,
    most_followers,
    on_the_line,
    topic_load,
    use,
)
from benchmarks.scale.servers import running
from benchmarks.scale.slots import (
    SLOTS,
    balance,
    loads,
    numbered,
    reshard,
    shared_out,
    slot_of,
    weigh,
)


@pytest.fixture(scope="module")
def kept():
    return results.load()


@pytest.mark.parametrize("name", list(page.TABLES))
def test_each_table_of_the_page_is_what_the_kept_figures_give(kept, name):
    assert page.block(name, kept) in page.PAGE.read_text(encoding="utf-8")


def test_the_page_is_of_a_whole_run(kept):
    assert kept["mode"] == "full"
    assert kept["seconds"] < 240


POINT = Value(((0, Cost(20, 800, 60)), (10, Cost(40, 800, 3560)), (50, Cost(140, 800, 17_560))), memory=1000)
FRAME = Value(((0, Cost(250, 900_000, 100, 900_000)), (2, Cost(550, 900_400, 1_800_100, 900_000))), memory=900_000)
FIGURES = Figures({"point": POINT, "frame": FRAME}, Cost(10, 60, 20), connections=2, connection_memory=100)


def test_the_load_of_a_topic_by_hand():
    load = topic_load(Topic("t", "point", 100, 5), FIGURES)
    assert load.core == pytest.approx((100 * 20 + 100 * 5 * 2 + 5 * 10) / 1e6)
    assert load.line_in == pytest.approx(100 * on_the_line(800) + 5 * on_the_line(60))
    assert load.line_out == pytest.approx(100 * on_the_line(60) + 500 * on_the_line(350) + 5 * on_the_line(20))
    assert load.connections == 5 * 2 + 1
    assert load.memory == 1000 + 11 * 100


def test_what_is_used_up_first_decides_how_many_are_carried():
    node = Node(core=0.6, line_in=100, line_out=100, memory=1000, connections=10)
    load = Load(core=0.1, line_in=30, line_out=10, memory=10, connections=1)
    assert use(load, node)["line_in"] == pytest.approx(0.3)
    assert bottleneck(load, node) == "line_in"
    assert carried(load, node) == 3  # 100 / 30
    assert carried(load, node, primaries=3) == 10
    assert carried(dataclasses.replace(load, line_in=20), node) == 5  # 100 / 20 and not one less


def test_the_most_followers_of_one_key_by_hand():
    node = Node(core=0.5, line_in=1e12, line_out=1e12, memory=1e12, connections=1e6)
    # 1000 x (140 us + (n - 50) x 2.5 us) + n x 10 us = 0.5
    assert most_followers(Topic("t", "point", 1000, 0), FIGURES, node) == int((0.5 - 0.140 + 0.125) / 0.00251)
    assert most_followers(Topic("t", "point", 1e6, 0), FIGURES, node) == 0  # not even without followers


def test_slots_are_the_servers(server_url):
    import redis

    with contextlib.closing(redis.Redis.from_url(server_url.replace("redis+cluster", "redis").split(",")[0])) as raw:
        try:
            theirs = raw.execute_command("CLUSTER", "KEYSLOT", "{robots/r7:camera}.image")
        except redis.ResponseError:  # no cluster: the value it gives
            theirs = 13509
    assert slot_of("camera", "robots/r7:") == theirs


def test_balance_by_hand():
    slots = np.zeros(SLOTS)
    slots[0], slots[1], slots[SLOTS - 1] = 4.0, 2.0, 2.0
    owners = shared_out(2)
    assert loads(slots, owners, 2).tolist() == [6.0, 2.0]
    assert balance(loads(slots, owners, 2)) == 1.5
    after, moved = reshard(slots, owners, 2)
    assert loads(slots, after, 2).tolist() == [4.0, 4.0]
    assert moved == 1


def test_moving_slots_by_weight_makes_fleets_even():
    slots, owners = weigh(numbered(1000), {"pose": 1.0, "camera": 2.0}), shared_out(50)
    before = balance(loads(slots, owners, 50))
    after, moved = reshard(slots, owners, 50)
    assert loads(slots, after, 50).sum() == pytest.approx(slots.sum())
    assert balance(loads(slots, after, 50)) < 1.02 < 1.2 < before
    assert moved == np.count_nonzero(after != owners) < 200


def test_a_key_that_all_follow_grows_with_the_fleet(kept):
    given = results.figures(kept, "six")
    base = spread.cores(kinds.BASE, given)
    small, large = (spread.spread(numbered(count), base, 50, spread.shared_core(count, given)) for count in (30, 3000))
    assert large.resharded == pytest.approx(large.hot, rel=0.05)  # nothing is left to gain
    assert small.hot > 1
    assert spread.shared_core(3000, given) > 50 * spread.shared_core(30, given)


EFFORT = dataclasses.replace(QUICK, rounds=2, points=60, frames=3, seconds=0.5, keys=50, buffers=0.0)


@pytest.mark.long
def test_what_is_measured_is_what_was_done():
    with running("one") as servers:
        found = measure({"one": servers}, EFFORT)["one"]
    frame = 480 * 640 * 3
    cases = found["cases"]
    for name in ("frame.write", "frame.publish.0", "frame.publish.10"):
        assert frame < cases[name]["bytes_in"] < frame * 1.02
    assert frame < cases["frame.read"]["bytes_out"] < frame * 1.02
    assert 10 * frame < cases["frame.publish.10"]["bytes_out"] < 10 * frame * 1.02
    inline = (cases["point.publish.50"]["bytes_out"] - cases["point.publish.0"]["bytes_out"]) / 50
    assert 300 < inline < 420  # the notice, with seven floats in it
    for name, case in cases.items():
        assert case["client_us"] > 0, name
    assert cases["point.publish.50"]["core_us"] > cases["point.publish.0"]["core_us"] > 0
    assert cases["frame.publish.10"]["core_us"] > cases["frame.publish.0"]["core_us"] > 0


@pytest.mark.parametrize("sharded", [False, True])
def test_scripts_are_reems_own_commands(sharded):
    it = asyncio.run(full.script(kinds.ARM.topics[1], "robots/r1:", sharded))
    reader = hiredis.Reader()
    reader.feed(it.publish)
    words = [command[0] for command in iter(reader.gets, False)]
    published = b"SPUBLISH" if sharded else b"PUBLISH"
    expected = [b"MULTI", b"UNLINK", b"SET", b"JSON.SET", b"SADD", b"SMEMBERS", b"SET", published, b"EXEC"]
    assert words == expected
    reader.feed(it.fetch)
    assert [command[0] for command in iter(reader.gets, False)] == [b"MULTI", b"JSON.GET", b"GET", b"GET", b"EXEC"]
    assert it.watch.startswith(b"*") == sharded
