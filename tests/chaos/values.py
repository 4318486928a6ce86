"""Rows 7 and 8: every value comes back as it was, and every bad one is refused, with what the tests know of both."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import hypothesis
import hypothesis.strategies as st
import test_values
from conftest import FRONTS, assert_same
from hypothesis import HealthCheck, Phase
from test_bad_input import VALUES

from reem_async.errors import ReemError

from .proxy import Proxy
from .scoreboard import ROOT, Run, row, tell
from .servers import PrivateServer


def _tried(run: Run, times: int, strategy: Any, check: Any) -> None:
    """Try a property with generated values, from the run's seed."""

    def test(value: Any) -> None:
        check(value)

    quick = hypothesis.settings(
        max_examples=times,
        deadline=None,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    hypothesis.seed(run.seed)(quick(hypothesis.given(value=strategy)(test)))()


@row(7, "value fuzz: JSON and arrays of every dtype, both fronts", "0 changes in 100,000 JSON values and 20,000 arrays")
def fuzz(run: Run) -> None:
    """Bit by bit and type by type; most documents are made by chance alone, which is cheap, others by hypothesis."""
    documents, arrays = run.size(100_000, 4_000), run.size(20_000, 400)
    counts = {"documents": 0, "arrays": 0}
    with PrivateServer() as server, contextlib.ExitStack() as stack:
        fronts = [stack.enter_context(contextlib.closing(front(server.url))) for front in FRONTS.values()]

        def comes_back(kind: str, batch: list[Any]) -> None:
            front = fronts[counts[kind] // len(batch) % 2]
            front.write([kind], batch)
            assert_same(front.read([kind]), batch)
            counts[kind] += len(batch)

        for number in range(documents * 4 // 5 // 250):
            comes_back("documents", [test_values._random_value(run.rng) for _ in range(250)])
            if number % 100 == 0:
                tell(f"{counts['documents']} documents")
        size = 20
        times = -(-(documents - counts["documents"]) // size)
        batches = st.lists(test_values.documents, min_size=size, max_size=size)
        _tried(run, times, batches, lambda batch: comes_back("documents", batch))
        tell(f"{counts['documents']} documents")
        batches = st.lists(test_values.arrays, min_size=size, max_size=size)
        _tried(run, arrays // size, batches, lambda batch: comes_back("arrays", batch))
    run.at_least("JSON values came back equal", counts["documents"], documents)
    run.at_least("arrays came back equal", counts["arrays"], arrays)


@row(8, "every bad input of the table, both fronts", "100% the right error, the path in its text, 0 commands sent")
def bad_input(run: Run) -> None:
    """The values over a proxy that counts what is sent; the rest of the table as the tests have it."""
    wrong: list[Any] = []
    refused = 0
    with PrivateServer() as server, Proxy(server.port) as proxy:
        for name, front_of in FRONTS.items():
            for space in ("KeyValueStore", "PublishSpace"):
                with contextlib.closing(front_of(proxy.url, space)) as front:
                    front.write(["top"], {"outer": {"inner": [0]}})
                    sent = proxy.commands
                    for label, (error, value) in VALUES.items():
                        refused += 1
                        wrong += [(name, space, label, problem) for problem in _problems(front, error, value)]
                    run.none(f"commands sent by {name} {space}", proxy.commands - sent)
        run.at_least("bad values refused", refused, 4 * len(VALUES))
        run.none("wrong errors", wrong)
        if run.full:  # else pytest runs them anyway, beside this
            passed, failed = _table(server.url)
            run.at_least("more checks of the table passed", passed, 300)
            run.none("failed", failed)


def _problems(front: Any, error: type[Exception], value: Any) -> list[str]:
    """What is wrong with how a bad value is refused, wherever it stands."""
    problems = []
    for path, call in (
        ("top", lambda: front.write(["top"], value)),
        ("top.outer.new", lambda: front.write(["top", "outer", "new"], value)),
        ("top.outer.inner", lambda: front.append(["top", "outer", "inner"], value)),
        ("top.outer", lambda: front.write(["top", "outer"], {"left": [0, {"right": value}]})),
    ):
        try:
            call()
        except error as raised:
            text = str(raised)
            if path not in text or len(text) > 1000 or not isinstance(raised, ReemError):
                problems.append(f"{path}: {text[:200]}")
        except Exception as raised:
            problems.append(f"{path}: {raised!r:.200} in place of {error.__name__}")
        else:
            problems.append(f"{path}: accepted")
    return problems


def _table(url: str) -> tuple[int, list[str]]:
    """Run tests/test_bad_input.py on a server; returns how many checks passed, and which failed."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-rfE", str(Path("tests/test_bad_input.py"))],
        cwd=ROOT,
        env=os.environ | {"REEM_TEST_URL": url},
        capture_output=True,
        text=True,
        check=False,
    )
    lines = done.stdout.splitlines()
    passed = re.search(r"(\d+) passed", (lines or [""])[-1])
    failed = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    return int(passed[1]) if passed else 0, failed or (
        [] if done.returncode == 0 else [done.stdout[-500:] + done.stderr[-500:]]
    )
