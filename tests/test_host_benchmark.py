"""The benchmark of one host: how its control loop counts."""

from benchmarks.workers import control


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
