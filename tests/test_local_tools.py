"""What users see of the local path: `reem doctor`, `reem top`, the page. Looking on costs publishers nothing."""

import asyncio
import json
import os
import sys
import time

import numpy as np
import pytest
from clikit import CommandLine
from conftest import PATIENCE, aeventually, assert_same

import reem
import reem_async
from reem_async.local.segment import reason_against
from reem_async.pubsub.monitor import Event, Monitor
from reem_async.tools.cli import doctor
from reem_async.tools.cli.checks import OK, WARN
from reem_async.tools.cli.following import follow
from reem_async.tools.cli.top import ALL, Window
from reem_async.tools.recording import Recorder, open_log

IMAGE = np.arange(30_000, dtype=np.float64)
only_where_there_is = pytest.mark.skipif(bool(reason_against()), reason=f"no shared memory: {reason_against()}")


@pytest.fixture
def beside(server_url, key):
    """A subscriber in another interface, for whom publishers put frames into shared memory."""
    with reem.RedisInterface(server_url) as interface:
        subscriber = reem.SilentSubscriber(key("cam"), interface)
        subscriber.listen()
        yield subscriber


def local_finding(url, *words, namespace=""):
    run = CommandLine(url, namespace)("doctor", "--json", *words)
    assert run.returncode == 0, run.stdout + run.stderr
    (row,) = [row for row in map(json.loads, run.stdout.splitlines()) if row["check"] == "local"]
    return row


async def followed_here(apspace, name):
    """Publish until it is known that a program of this host listens: in a cluster a new key is found in a moment."""
    session = apspace.interface.session
    deadline = time.monotonic() + PATIENCE
    while not session.local.audience(session.keys(name)):
        assert time.monotonic() < deadline
        await asyncio.sleep(0.1)
        await apspace[name].write(IMAGE)


@only_where_there_is
async def test_a_recorder_takes_frames_from_memory_which_the_server_has_lost_by_then(key, apspace, binterface, file):
    """Frames that come so fast that each is replaced before a read of it could be sent."""
    frames = [IMAGE + number for number in range(4)]
    async with Recorder(binterface, [key("*")], file) as recorder:
        await apspace[key("cam")].write(IMAGE)  # asks for subscribers on this host
        await aeventually(lambda: recorder.status.messages > 0)
        await followed_here(apspace, key("cam"))
        await asyncio.gather(*[apspace[key("cam")].write(frame) for frame in frames])
        await recorder.fence()
        assert recorder.status.skipped == 0
    with open_log(file) as log:
        found = [value for _, value in log[key("cam")].values()]
    assert_same(found[-4:], frames)


@pytest.mark.long
@only_where_there_is
def test_doctor_has_another_process_look_into_memory(server_url):
    row = local_finding(server_url)
    assert row["status"] == OK
    assert f"between programs of user {os.geteuid()}" in row["message"]
    assert ("in this container" in row["message"]) == doctor.is_contained()


@only_where_there_is
async def test_doctor_notices_that_others_cannot_look(monkeypatch):
    """Whatever the reason: here it is given a process that looks at another file."""
    monkeypatch.setattr(doctor, "_LOOK", doctor._LOOK.replace("sys.argv[1:]", "[*sys.argv[1:3], 1, 0, 1]"))
    assert "cannot open the memory" in await doctor.unseen_by_another()
    monkeypatch.setattr(doctor, "_LOOK", "raise SystemExit(7)")
    assert "ended with 7" in await doctor.unseen_by_another()


def test_doctor_says_why_there_is_none(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    found = doctor.shared_memory("no shared memory is to be had here: [Errno 1] Operation not permitted")
    assert found.status == WARN
    assert "not permitted; large values go through the server" in found.message
    monkeypatch.setattr(sys, "platform", "darwin")
    assert doctor.shared_memory("only Linux has what it takes").status == OK


def test_top_says_of_late_and_not_for_ever():
    window = Window()
    for moment, local, expected in [(100, False, "-"), (101, True, "yes"), (105, False, "yes"), (112, False, "-")]:
        window.add(Event(("cam",), 1, False, 1, moment, moment, "a", 1, local=local))
        assert ALL.cells(window)[-1] == expected
        assert ALL.data(window)["local"] is (expected == "yes")


@only_where_there_is
async def test_an_event_says_whether_its_value_is_in_shared_memory(server_url, key, beside):
    async with (
        reem_async.RedisInterface(server_url) as interface,
        reem_async.RedisInterface(server_url) as other,
        Monitor(other, [key("cam")]) as monitor,
    ):
        space = reem_async.PublishSpace(interface)
        for value, local in [({"n": 1}, False), ({"n": 2, "image": IMAGE}, True), ({"n": 3}, False)]:
            await space[key("cam")].write(value)
            assert (await anext(monitor)).local is local


@only_where_there_is
@pytest.mark.parametrize("stored", [False, True], ids=["top", "hz and echo"])
async def test_commands_that_measure_have_nothing_copied_and_fetch_nothing(stored, server_url, key, raw):
    """Beside them alone, a publisher takes no shared memory, and no array is read."""

    def sent():
        return raw.info("stats")["total_net_output_bytes"]

    async with reem_async.RedisInterface(server_url) as interface, reem_async.RedisInterface(server_url) as other:
        space, heard, begun = reem_async.PublishSpace(interface), [], asyncio.Event()
        await space[key("cam")].write({"n": 0})
        following = asyncio.ensure_future(
            follow(
                other,
                [key("cam")],
                lambda event, _: heard.append(event),
                count=5,
                seconds=PATIENCE,
                every=0.1,
                tick=lambda _: begun.set(),
                stored=stored,
            )
        )
        await begun.wait()
        before = sent()
        for number in range(1, 6):
            await space[key("cam")].write({"n": number, "image": IMAGE})
        await following
        assert not any(event.local for event in heard)
        assert not interface.session.local._segments
        assert sent() - before < IMAGE.nbytes
