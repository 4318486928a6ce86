"""The benchmark of one host: its cases at tiny sizes, its tables in the page, and how its control loop counts."""

import tempfile

import pytest

from benchmarks import measure_host, page
from benchmarks.measure import Bench
from benchmarks.measure_host import LOOP, ControlLoopCase, HostCase
from benchmarks.process import Workers
from benchmarks.results import Results
from benchmarks.server import private_server
from benchmarks.workers import control

WAYS = ("reem-host-early", "datagram")
"""Two that need nothing installed."""


@pytest.mark.long
def test_a_tiny_run_fills_the_tables_of_the_page(tmp_path, monkeypatch):
    monkeypatch.setattr(measure_host, "SIZES", {"image": (6, 0.001)})
    monkeypatch.setattr(measure_host, "SETTLED", 0.1)
    cases = HostCase("host.5", WAYS, subscribers=5), ControlLoopCase("host.loop", WAYS, ways=LOOP, periods=1000)
    found = Results("quick", "2026-11-26T12:00:00", "a computer")
    with private_server() as server, tempfile.TemporaryDirectory() as folder:
        bench = Bench(Workers(server, folder), quick=True)
        try:
            for identifier, name, entry in (each for case in cases for each in case.measure(bench)):
                found.add(identifier, name, entry)
        finally:
            bench.workers.end()

    assert not found.failures()
    for name in WAYS:
        assert found.cases["host.5.image"][name]["count"] == found.cases["host.5.image"][name]["sent"] == 30
        assert found.cases["host.loop"][name]["periods"] == 100
    place = tmp_path / "page.md"
    place.write_text("before\n<!-- one host -->\nold\n<!-- end of one host -->\nafter\n")
    page.rewrite(found, place)
    text = place.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    assert "| size | subscribers | REEM early | floor, Unix datagram |\n| ---" in text
    assert "| 0.92 MB | 5 | " in text
    assert "| missed deadlines | " in text


class Clock:
    """A clock that goes on when something sleeps."""

    now = 0.0

    def perf_counter(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def test_a_cycle_misses_the_deadline_of_each_period_that_it_takes(monkeypatch):
    clock, published = Clock(), []
    monkeypatch.setattr(control, "time", clock)

    def publish(q):
        published.append(q)
        clock.sleep({3: 0.026, 6: 0.012}.get(len(published), 0.001))

    found = control.control_loop(lambda: {"q": [0.0, 1.0]}, publish, periods=20, rate=100)

    assert found["missed"] == 3
    assert len(found["cycles"]) == len(published) == 19, "the third cycle passes over one period"
    assert [round(cycle, 3) for cycle in found["cycles"][2:8]] == [0.026, 0.007, 0.001, 0.012, 0.003, 0.001]
