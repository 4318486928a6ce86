"""Row 18: the recorder, killed, cut short, damaged, and out of space."""

from __future__ import annotations

import concurrent.futures
import contextlib
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

import reem

from .scoreboard import NotBuilt, Run, row, tell
from .servers import PrivateServer
from .tools import program, quantile, said

TOP = "run"


def _value(number: int) -> dict[str, Any]:
    """A value that shows whether it is whole."""
    return {"n": number, "array": np.full(100, number, np.int64), "text": str(number)}


def _is_whole(value: Any) -> bool:
    return isinstance(value, dict) and value["text"] == str(value["n"]) and set(value["array"].tolist()) == {value["n"]}


class _Publisher:
    """Publishes all the time, and knows when what was."""

    def __init__(self, url: str) -> None:
        self._interface = reem.RedisInterface(url)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._publish)
        self.times: list[float] = []

    def _publish(self) -> None:
        space = reem.PublishSpace(self._interface)
        while not self._over.wait(0.004):
            space[TOP] = _value(len(self.times))
            self.times.append(time.monotonic())

    def __enter__(self) -> _Publisher:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._interface.close()


class _Findings:
    """What was wrong with recordings."""

    def __init__(self) -> None:
        self.closed: list[Any] = []
        self.bad: list[Any] = []
        self.holes: list[Any] = []
        self.updates = 0
        self.late: list[float] = []

    def numbers(self, path: Path, what: str) -> list[int] | None:
        """The numbers of the published updates in a file, None if it is no recording; anything else is noted."""
        from reem_async.tools.recording import DamagedRecording, open_log

        try:
            with contextlib.closing(open_log(path)) as log:
                found = []
                for update in log.updates():
                    if not _is_whole(update.value):
                        self.bad.append((what, update.value))
                    elif update.kind == "pub":
                        found.append(update.value["n"])
                self.updates += len(found)
                return found
        except DamagedRecording:
            return None
        except Exception as error:
            self.closed.append((what, error))
            return None


@row(
    18,
    "recorder: kill -9, cut at every byte, damaged bytes, disk full",
    "reopens 100%, loss <= 1 s, 0 bad records accepted, control loop unaffected",
    limit=400,
)
def recorder(run: Run) -> None:
    """100 recorders killed while one publisher goes on; every prefix of a file; a limit on the file's size."""
    try:
        import reem_async.recording  # noqa: F401
    except ImportError as error:
        raise NotBuilt(f"recorder not built yet, or extra `tools` not installed: {error}") from None
    import tempfile

    findings = _Findings()
    with PrivateServer() as server, tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _killed(run, server.url, folder, findings)
        _cut(run, server.url, folder, findings)
        _full(run, server.url, folder, findings)
    run.none("that could not be reopened", findings.closed)
    run.none("bad records accepted", findings.bad)
    run.none("holes", findings.holes)


def _killed(run: Run, url: str, folder: Path, findings: _Findings) -> None:
    times = run.size(100, 4)
    delays = [run.rng.uniform(0.2, 1.6) for _ in range(times)]
    with _Publisher(url) as publisher:

        def one(number: int) -> None:
            path = folder / f"killed{number}.mcap"
            with program("record", url, path) as process:
                said(process)
                time.sleep(delays[number])
                killed = time.monotonic()  # what is published from now on cannot be in the file
                process.kill()
                process.wait()
            found = findings.numbers(path, f"killed {number}")
            if found is None:
                findings.closed.append(f"killed {number}: not a recording")
                return
            last = max(found, default=None)
            began = killed - delays[number] if last is None else publisher.times[min(last, len(publisher.times) - 1)]
            findings.late.append(killed - began)
            if found and found != list(range(found[0], found[-1] + 1)):
                findings.holes.append((number, found[0], found[-1], len(found)))

        with concurrent.futures.ThreadPoolExecutor(4) as pool:
            for number, _ in enumerate(pool.map(one, range(times)), 1):
                if number % 20 == 0:
                    tell(f"{number} kills")
    run.at_least("recorders killed", len(findings.late), times)
    run.at_least("updates found in their files", findings.updates, 20 * times)
    run.at_most("s lost", max(findings.late, default=float("inf")), 1.0)


def _cut(run: Run, url: str, folder: Path, findings: _Findings) -> None:
    """Every prefix of one file that was not ended properly, and that file with single bytes changed."""
    whole = folder / "whole.mcap"
    with _Publisher(url), program("record", url, whole) as process:
        said(process)
        time.sleep(0.8)
        process.kill()
        process.wait()
    data = whole.read_bytes()
    expected = findings.numbers(whole, "whole") or []
    copy = folder / "copy.mcap"
    step, opened, first = run.size(max(1, len(data) // 20_000), max(1, len(data) // 60)), 0, None
    longest = 0
    for size in range(0, len(data), step):
        copy.write_bytes(data[:size])
        found = findings.numbers(copy, f"cut at {size}")
        if found is None and first is not None:
            findings.closed.append(f"cut at {size}, though it opens when cut at {first}")
        if found is not None:
            opened, first = opened + 1, size if first is None else first
            if found != expected[: len(found)] or len(found) < longest:
                findings.bad.append(f"cut at {size}: {len(found)} updates, not the first ones")
            longest = max(longest, len(found))
    flips = run.size(2000, 20)
    for _ in range(flips):
        changed = bytearray(data)
        changed[run.rng.randrange(len(data))] ^= 1 << run.rng.randrange(8)
        copy.write_bytes(changed)
        found = findings.numbers(copy, "a bit changed")
        if found is not None and not set(found) <= set(expected):
            findings.bad.append("a bit changed, and an update that never was")
    run.at_least("updates in the file that is cut", len(expected), 50)
    run.at_least("prefixes reopened", opened, run.size(2000, 50))
    run.at_most("bytes from which on it opens", len(data) if first is None else first, 4096)
    run.at_least("changed bits", flips, flips)


def _full(run: Run, url: str, folder: Path, findings: _Findings) -> None:
    path = folder / "full.mcap"
    with program("record_on_full_disk", url, path, 1_500_000) as process:
        found = said(process)
    run.at_least("errors that say that the file could not grow", int("written any further" in found["failure"]), 1)
    slower = quantile(found["after"], 0.9) / quantile(found["before"], 0.9)
    run.at_most("x the control loop's p90 with the disk full", slower, 2.0)
    from reem_async.tools.recording import open_log

    try:
        with contextlib.closing(open_log(path)) as log:
            run.at_least("updates before the disk was full", sum(1 for _ in log.updates()), 50)
    except Exception as error:
        findings.closed.append(("disk full", error))
