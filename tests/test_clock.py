"""Clocks: the offset to the server's, and the publisher's times in recordings."""

import re
import time
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import aeventually, eventually

import reem
from reem_async import BadValue, ClockOffset
from reem_async.coordination import clock
from reem_async.store import publish
from reem_async.tools.recording import Recorder, open_log


def shifted(monkeypatch, module, seconds):
    """Set the clock of one module, once or again."""
    real = SimpleNamespace(time=time.time, monotonic=time.monotonic)
    monkeypatch.setattr(module, "time", SimpleNamespace(time=lambda: real.time() + seconds, monotonic=real.monotonic))


def test_the_offset_to_the_server_is_within_its_bound(front, monkeypatch):
    """The server of the tests has the same clock."""
    interface = front.interface
    found = front.wait(interface.clock())
    assert type(found) is ClockOffset
    assert 0 < found.bound < 1
    assert abs(found.offset) <= found.bound + 1e-3
    assert abs(found.measured - time.time()) < 10
    assert front.wait(interface.clock()) is found
    assert front.wait(interface.clock(max_age=0)) is not found
    for seconds in (-3600.0, 7.5):  # this computer's clock is set: it is measured anew
        shifted(monkeypatch, clock, seconds)
        found = front.wait(interface.clock())
        assert abs(found.offset + seconds) <= found.bound + 1e-3
    with pytest.raises(BadValue, match="max_age"):
        front.wait(interface.clock(max_age=-1))


def test_named_programs_report_their_clocks_and_doctor_shows_them(cli, server_url, key, monkeypatch):
    shifted(monkeypatch, clock, -5.0)
    with reem.RedisInterface(server_url, namespace=f"{key.prefix}:", name="arm") as interface:
        eventually(lambda: [node for node in interface.nodes() if node.clock])
        (node,) = interface.nodes()
        assert abs(node.clock.offset - 5.0) <= node.clock.bound + 1e-3
        lines = [line for line in cli("doctor").stdout.splitlines() if f"on {node.host} " in line]
        assert len(lines) == 1
        assert lines[0].startswith("warn\tclock\t")
        assert "ms ahead, give or take" in lines[0]


async def test_a_recording_has_the_publishers_times_and_counts_where_they_go_back(
    key, akvs, apspace, binterface, file, monkeypatch, caplog
):
    name = key("arm")
    shifts = [0.0, 10.0, 10.0, -3600.0, -3600.0, 0.0]  # set forward, then far back, and right again
    async with Recorder(binterface, [name], file) as recorder:
        for number, shift in enumerate(shifts):
            shifted(monkeypatch, publish, shift)
            await apspace[name].write({"q": number})
        await aeventually(lambda: recorder.status.messages >= len(shifts))
        await akvs[name]["q"].write(99)  # only stored: no publisher
        await aeventually(lambda: recorder.status.messages > len(shifts))
        assert recorder.status.clock_steps == 1
    (warning,) = caplog.messages
    assert re.match(f"{name}: the publisher's time went back by 36(09|10)", warning), warning
    with open_log(file) as log:
        received, all_values = log[name]["q"].history()
        published, values = log[name]["q"].history(clock="publisher")
        assert all_values.tolist() == [*range(len(shifts)), 99]
        assert values.tolist() == [*range(len(shifts))]
        assert (np.diff(received) > 0).all()
        assert [int(step) for step in np.sign(np.diff(published))] == [1, 1, -1, 1, 1]
        assert np.allclose(published - received[:-1], shifts, atol=0.5)
        assert [update.published for update in log.updates() if update.kind == "pub"] == published.tolist()
        assert log.metadata["clock_steps"] == "1"
        assert abs(float(log.metadata["clock offset"])) <= float(log.metadata["clock bound"]) + 1e-3
        with pytest.raises(BadValue, match="'recorder' nor 'publisher'"):
            log[name].history(clock="sensor")
