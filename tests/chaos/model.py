"""Row 6: hypothesis plays with REEM and with a plain dict, and breaks connections meanwhile; both must stay equal."""

from __future__ import annotations

import contextlib
import itertools
import json
import time
from collections.abc import Callable
from typing import Any

import hypothesis
import hypothesis.strategies as st
import numpy as np
import test_values
from conftest import assert_same, keys_of, placeholders
from hunt.model import ABSENT, Place, as_read, found
from hypothesis import HealthCheck, Phase
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

import reem
from reem_async.plan.placeholders import Placeholder, parse

from .proxy import Proxy
from .scoreboard import Run, row, tell
from .servers import PrivateServer

NAMES = ["a", "ab", "b.c"]

leaves = (
    test_values.scalars
    | st.sampled_from([b"", b"\r\n", np.arange(3), np.zeros((2, 0)), np.array(1.5), np.full(9000, 7, np.uint8)])
    | st.lists(st.integers(0, 9), max_size=3)
)
values = st.recursive(
    leaves,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(NAMES), inner, max_size=3),
    max_leaves=4,
)
elements = st.sampled_from([*NAMES, *NAMES, 0, 1, -1])
paths = st.lists(elements, max_size=3).map(tuple)


def _equal(one: Any, other: Any) -> bool:
    if one is ABSENT or other is ABSENT:
        return one is other
    try:
        assert_same(one, other)
    except AssertionError:
        return False
    return True


class World:
    """The server and the clients, which all runs of the machine share."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        server = stack.enter_context(PrivateServer())
        self.raw = stack.enter_context(server.raw())
        self.proxy = stack.enter_context(Proxy(server.port))
        self.mirrors = stack.enter_context(Proxy(server.port))
        opened = [
            stack.enter_context(contextlib.closing(reem.RedisInterface(url)))
            for url in (self.proxy.url, self.mirrors.url, server.url)
        ]
        self.kvs = reem.KeyValueStore(opened[0])
        self.space = reem.PublishSpace(opened[0])
        self.following = opened[1]
        self.direct = reem.KeyValueStore(opened[2])
        self.tops = itertools.count()
        self.steps = self.unknown = self.faults = self.runs = 0


class Machine(RuleBasedStateMachine):
    """One game: a top-level key of its own, and a mirror of it."""

    world: World

    @initialize(value=values)
    def begin(self, value: Any) -> None:
        it = self.world
        it.runs += 1
        if it.runs % 200 == 0:
            tell(f"{it.runs} runs, {it.steps} steps, {it.faults} faults")
        it.proxy.heal()
        self.top = f"top{next(it.tops)}"
        self._begin_with(value)
        self.model: Any = as_read(value)
        self.mirror = reem.SilentSubscriber(self.top, it.following)
        self._listen()

    def _begin_with(self, value: Any) -> None:
        for _ in range(100):  # its connection, too
            with contextlib.suppress(reem.ConnectionLost, reem.NotConnected):
                self.world.kvs[self.top] = value
                return
            assert self.world.proxy.settled(), "the proxy hangs"
        raise AssertionError("no connection within 100 attempts")

    def _listen(self) -> None:
        for _ in range(100):  # the mirror's connection may have been cut just now
            with contextlib.suppress(reem.ConnectionLost, reem.NotConnected):
                return self.mirror.listen()
        raise AssertionError("no subscription within 100 attempts")

    # What users do.

    @rule(path=paths, value=values)
    def write(self, path: tuple[Any, ...], value: Any) -> None:
        self._change(path, lambda at: at.write(value), lambda place: place.write(as_read(value)))

    @rule(path=paths)
    def delete(self, path: tuple[Any, ...]) -> None:
        self._change(path, lambda at: at.delete(), lambda place: place.delete())

    @rule(path=paths, value=values)
    def append(self, path: tuple[Any, ...], value: Any) -> None:
        self._change(path, lambda at: at.append(value), lambda place: place.append(as_read(value)))

    @rule(path=paths, number=st.integers(-5, 5) | st.sampled_from([2**63 - 1, -(2**63)]))
    def increment(self, path: tuple[Any, ...], number: int) -> None:
        if type(found(self.model, path)) is not float and not _is_unsigned(found(self.model, path)):
            self._change(path, lambda at: at.increment(number), lambda place: place.increment(number))

    @rule(path=paths)
    def read(self, path: tuple[Any, ...]) -> None:
        self.world.steps += 1
        expected = found(self.model, path)
        try:
            value = self._at(self.world.kvs, path).read()
            if value is None and self.model is ABSENT:
                value = ABSENT
        except reem.MissingKey:
            value = ABSENT
        except (reem.ConnectionLost, reem.NotConnected):
            return
        assert _equal(value, expected), f"{path}: {value!r} in place of {expected!r}"

    @rule()
    def mirror_agrees(self) -> None:
        self._await_mirror()

    # What the network does.

    @rule()
    def lose_a_reply(self) -> None:
        self._fault(lambda proxy: proxy.drop_reply(b"JSON."))

    @rule()
    def reset(self) -> None:
        self._fault(lambda proxy: proxy.reset())

    @rule()
    def half_close(self) -> None:
        self._fault(lambda proxy: proxy.half_close())

    @rule(sliced=st.booleans(), delay=st.sampled_from([0.0, 0.001]))
    def slow_down(self, sliced: bool, delay: float) -> None:
        proxy = self.world.proxy
        proxy.sliced, proxy.delay = sliced, delay

    @rule(odds=st.integers(0, 3))
    def cut_the_mirror(self, odds: int) -> None:
        if not odds:  # it takes a while to come back
            self.world.faults += 1
            self.world.mirrors.reset()

    def _fault(self, make: Callable[[Proxy], None]) -> None:
        self.world.faults += 1
        make(self.world.proxy)

    def _at(self, store: Any, path: tuple[Any, ...]) -> Any:
        at = store[self.top]
        for key in path:
            at = at[key]
        return at

    def _change(self, path: tuple[Any, ...], call: Callable[[Any], Any], expect: Callable[[Place], Any]) -> None:
        """Make a change in both worlds. If its outcome is unknown, the server says: all of it, or nothing."""
        self.world.steps += 1
        due = expect(Place(self.model, path))
        after, error = due.after, due.error
        try:
            call(self._at(self.world.space, path))
        except (reem.ConnectionLost, reem.NotConnected) as raised:
            self.world.unknown += 1
            assert self.world.proxy.settled(), "the proxy hangs"
            stored = self.world.direct.get(self.top, ABSENT)
            possible = [self.model] + ([after] if error is None and isinstance(raised, reem.ConnectionLost) else [])
            assert any(_equal(stored, each) for each in possible), f"{stored!r} is none of {possible!r}"
            self.model = next(each for each in reversed(possible) if _equal(stored, each))
        except reem.ReemError as raised:
            if error is None or not isinstance(raised, error):
                raise AssertionError(f"{raised!r} in place of {error}") from raised
        else:
            assert error is None, f"accepted in place of {error.__name__}"
            self.model = after

    def _await_mirror(self) -> None:
        deadline = time.monotonic() + 5
        expected = None if self.model is ABSENT else self.model
        while not _equal(self.mirror.value(), expected):
            assert time.monotonic() < deadline, f"the mirror has {self.mirror.value()!r} in place of {expected!r}"
            time.sleep(0.001)

    def _no_orphans(self) -> None:
        """Arrays and registry name each other; those placeholders that hold their value themselves need neither."""
        raw, tag = self.world.raw, "{" + self.top + "}"
        text = raw.execute_command("JSON.GET", self.top)
        named = {parsed.suffix for parsed in map(parse, placeholders(json.loads(text))) if type(parsed) is Placeholder}
        stored = {key.removeprefix(tag) for key in keys_of(raw, self.top)} - {":ships", ":last"}
        members = set(raw.smembers(f"{tag}:ships"))
        assert named == stored == members, f"placeholders {named}, arrays {stored}, registry {members}"

    def _left_over(self) -> list[str]:
        return [key for key in self.world.raw.scan_iter(match=f"*{self.top}*") if not key.endswith(":last")]

    def teardown(self) -> None:
        if not hasattr(self, "model"):
            return
        self.world.proxy.heal()
        self.world.proxy.settled()
        stored = self.world.direct.get(self.top, ABSENT)
        assert _equal(stored, self.model), f"stored: {stored!r} in place of {self.model!r}"
        self._await_mirror()
        self.mirror.close()
        if self.model is not ABSENT:
            self._no_orphans()
            del self.world.direct[self.top]
        assert not self._left_over(), f"left over: {self._left_over()}"
        self.world.raw.flushdb()


def _is_unsigned(value: Any) -> bool:
    """Whether an integer is beyond the signed ones, where the server's arithmetic is another."""
    return type(value) is int and value >= 2**63


@row(
    6,
    "hypothesis against a dict model, with faults as rules",
    "2,000 runs of <= 50 steps, 0 falsified",
    limit=600,
)
def model(run: Run) -> None:
    """Writes are published, so a mirror must agree too; an unknown outcome is one of two."""
    runs = run.size(2000, 25)
    with contextlib.ExitStack() as stack:
        Machine.world = world = World(stack)
        settings = hypothesis.settings(
            max_examples=runs,
            stateful_step_count=50,
            deadline=None,
            database=None,
            phases=[Phase.generate, Phase.shrink] if run.full else [Phase.generate],
            report_multiple_bugs=False,
            suppress_health_check=list(HealthCheck),
        )
        run_state_machine_as_test(hypothesis.seed(run.seed)(Machine), settings=settings)
    run.at_least("runs agreed with the model", world.runs, runs)
    run.at_least("steps", world.steps, 5 * runs)
    run.at_least("faults", world.faults, runs)
    run.at_least("outcomes unknown", world.unknown, runs // 5)
