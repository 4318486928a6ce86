"""A wrong argument is refused where it is given, and what goes wrong in one listener costs no other."""

import logging

import numpy as np
import pytest
from conftest import eventually

import reem
import reem.recording
import reem_async
import reem_async.monitor
import reem_async.recording
from reem.subscribe import Watch
from reem_async.errors import BadInput, Stale

NUMBERS = ["1", b"1", [1], {}, True, float("nan"), -1, None, len, np.arange(2)]
POLICIES = [reem.Newest, reem.Last, "newest", 0, 5, False, object()]
PATHS = [None, 5, b"a", reem.Newest, ["a"], "a..b"]
FUNCTIONS = [None, 5, "f", lambda: 0]


def given(name, values):
    """An argument, and wrong values of it; `name` is what the error must name."""
    return [(name, value) for value in values]


WITHOUT_NONE = [value for value in NUMBERS if value is not None]
CALLS = {
    "SilentSubscriber channel": (lambda it, bad: it.pkg.SilentSubscriber(bad, it.interface), given("path", PATHS)),
    "SilentSubscriber policy": (
        lambda it, bad: it.pkg.SilentSubscriber(it.key, it.interface, bad), given("policy", POLICIES)),
    "SilentSubscriber.watch": (
        lambda it, bad: it.pkg.SilentSubscriber(it.key, it.interface).watch(bad), given("policy", POLICIES)),
    "CallbackSubscriber channel": (
        lambda it, bad: it.pkg.CallbackSubscriber(bad, it.interface, print), given("path", PATHS)),
    "CallbackSubscriber function": (
        lambda it, bad: it.pkg.CallbackSubscriber(it.key, it.interface, bad), given("callback_function", FUNCTIONS)),
    "CallbackSubscriber kwargs": (
        lambda it, bad: it.pkg.CallbackSubscriber(it.key, it.interface, print, bad), given("kwargs", [5, [1], "ab"])),
    "CallbackSubscriber policy": (
        lambda it, bad: it.pkg.CallbackSubscriber(it.key, it.interface, print, None, bad), given("policy", POLICIES)),
    "accessor.watch": (lambda it, bad: it.store[it.key].watch(bad), given("policy", POLICIES)),
    "accessor.mirror max_age": (
        lambda it, bad: it.store[it.key].mirror(max_age=bad), given("max_age", [*WITHOUT_NONE, 0, 0.001])),
    "accessor.mirror largest": (lambda it, bad: it.store[it.key].mirror(largest=bad), given("largest", WITHOUT_NONE)),
    "mirror.wait_until predicate": (
        lambda it, bad: it.run(it.mirror.wait_until(bad)), given("predicate", [None, 5, "f"])),
    "mirror.wait_until timeout": (
        lambda it, bad: it.run(it.mirror.wait_until(lambda value: False, bad)), given("timeout", WITHOUT_NONE)),
    "store.watch patterns": (lambda it, bad: it.store.watch(bad), given("path", PATHS)),
    "store.watch policy": (lambda it, bad: it.store.watch(it.key, policy=bad), given("policy", POLICIES)),
    "store.watch largest": (lambda it, bad: it.store.watch(it.key, largest=bad), given("largest", WITHOUT_NONE)),
    "Last": (lambda it, bad: it.pkg.Last(bad), given("bound", [*NUMBERS, 0, 1.5, 60.0])),
    "Every": (lambda it, bad: it.pkg.Every(bad), given("bound", [*NUMBERS, 0, 1.5])),
    "Recorder patterns": (
        lambda it, bad: it.recorder(patterns=bad), given("pattern", [None, 5, "a", b"a"]) + given("path", [[None]])),
    "Recorder path": (lambda it, bad: it.recorder(path=bad), given("path", [None, 5, ["a"]])),
    "Recorder keyframe": (lambda it, bad: it.recorder(keyframe=bad), given("keyframe", [*NUMBERS, 0])),
    "Recorder compression": (lambda it, bad: it.recorder(compression=bad), given("compression", ["zip", None, []])),
    "Recorder queue_bytes": (lambda it, bad: it.recorder(queue_bytes=bad), given("queue_bytes", [*NUMBERS, 0])),
    "Recorder sample": (lambda it, bad: it.recorder(sample=bad), given("sample", [5, ["a"]])),
    "Recorder period": (lambda it, bad: it.recorder(sample={"a": bad}), given("period", [*NUMBERS, 0, float("inf")])),
    "Recorder.wait": (lambda it, bad: it.run(it.recording.wait(bad)), given("seconds", WITHOUT_NONE)),
    "Monitor patterns": (lambda it, bad: it.monitor(bad), given("pattern", [None, 5, "a", b"a"])),
    "Monitor policy": (lambda it, bad: it.monitor(["*"], bad), given("policy", POLICIES)),
    "Monitor namespaces": (lambda it, bad: it.monitor(namespaces=bad), given("namespaces", [5, b"a", "{a}"])),
    "Monitor patience": (lambda it, bad: it.monitor(patience=bad), given("patience", NUMBERS)),
}  # fmt: skip


class Blocking:
    pkg, recording_module = reem, reem.recording

    def __init__(self, interface, key, file):
        self.interface, self.key, self._file = interface, key, file
        self.store = self.pkg.KeyValueStore(interface)
        self.mirror, self.recording = self.store[key].mirror(), self.recorder()
        self.run(self.mirror.listen())

    def run(self, result):
        return result

    def recorder(self, patterns=("*",), **options):
        options = {"path": self._file.with_name("other.mcap" if hasattr(self, "recording") else "run.mcap")} | options
        return self.recording_module.Recorder(self.interface, patterns, **options)

    def monitor(self, *arguments, **options):
        return reem_async.monitor.Monitor(self.interface._followers, *arguments, **options)

    def close(self):
        self.run(self.mirror.close())


class Async(Blocking):
    """The same in asyncio, on the loop of the blocking front's interface."""

    pkg, recording_module = reem_async, reem_async.recording

    def __init__(self, interface, key, file):
        self._portal = interface
        super().__init__(interface._followers, key, file)

    def run(self, result):
        return self._portal._wait(result)

    def monitor(self, *arguments, **options):
        return reem_async.monitor.Monitor(self.interface, *arguments, **options)


@pytest.mark.parametrize("front_kind", [Blocking, Async])
def test_wrong_arguments_are_refused_where_they_are_given(interface, kvs, pspace, key, tmp_path, front_kind):
    """By an error that names the argument and the value; a neighbour on the same interface misses nothing."""
    kvs[key("arm")] = {"n": -1}
    it = front_kind(interface, key("arm"), tmp_path / "run.mcap")
    neighbour, number = kvs[key("arm")].watch(reem.Every(10_000)), 0
    neighbour.listen()
    accepted = []
    for call, (function, wrong) in CALLS.items():
        for name, value in wrong:
            try:
                function(it, value)
            except BadInput as error:
                if name not in str(error):
                    accepted.append((call, value, f"does not name {name}: {error}"))
            except Exception as error:
                accepted.append((call, value, repr(error)))
            else:
                accepted.append((call, value, "accepted"))
            pspace[key("arm")]["n"] = number
            number += 1
    assert accepted == []
    assert [next(neighbour).data["n"] for _ in range(number + 1)] == list(range(-1, number))
    assert it.mirror.value() == {"n": number - 1}
    it.close()
    assert [each.name for each in tmp_path.iterdir() if "run.mcap" not in each.name] == []


class Failing(reem.Newest):
    """A policy of a user's own that fails in use."""

    def __init__(self):
        super().__init__()
        self.broken = False

    @property
    def bound(self):
        if self.broken:
            raise ZeroDivisionError("broken policy")
        return 1

    @bound.setter
    def bound(self, value):
        pass


HOWS = [(how, publishes) for how in ("watch", "pattern", "subscriber", "callback") for publishes in (True, False)]


@pytest.mark.parametrize(("how", "publishes"), [*HOWS, ("monitor", True)])
def test_an_exception_in_one_listener_costs_that_listener(interface, kvs, pspace, key, caplog, how, publishes):
    """It ends with the error; the connection stands, and a neighbour misses nothing."""
    kvs[key("arm")] = {"n": 0}
    policy, calls = Failing(), []
    if how == "callback":
        bad = reem.CallbackSubscriber(
            key("arm"), interface, lambda **given: calls.append(given), None, policy, stored=True
        )
    elif how == "subscriber":
        bad = reem.SilentSubscriber(key("arm"), interface, policy, stored=True).watch()
    elif how == "monitor":
        bad = Watch(interface, reem_async.monitor.Monitor(interface._followers, [key("arm")], policy))
    else:
        bad = kvs[key("arm")].watch(policy) if how == "watch" else kvs.watch(key("arm"), policy=policy)
    good = kvs[key("arm")].watch(reem.Every(1000))
    mirror = kvs[key("arm")].mirror()
    with good, mirror, caplog.at_level(logging.ERROR, "reem.subscribe"):
        bad.listen()
        policy.broken = True
        for number in range(1, 20):
            (pspace if publishes else kvs)[key("arm")]["n"] = number
            eventually(lambda n=number: mirror.value()["n"] == n)
        seen = [next(good)]
        while seen[-1].data["n"] < 19:
            seen.append(next(good))
        assert not any(update.gap for update in seen)
        assert interface.state == "connected"
        if how == "callback":
            eventually(lambda: "is not called any more" in caplog.text)
            with pytest.raises(Stale, match="broken policy"):
                bad.value()
        else:
            with pytest.raises(ZeroDivisionError):
                list(bad)
    assert caplog.text.count("has ended over an error") == 1
    bad.close()
