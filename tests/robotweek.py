"""A week of a robot in an hour: its programs, recorder, page and server fail in random order, and all must stay equal.

    python tests/robotweek.py [--events 1000] [--minutes 60] [--seed N]

The programs of the image example, `reem record` and `reem browse` run against a server that keeps its data, most of
them through a proxy. Each event kills, stops, restarts or disconnects one of them, or stores something. At each pause
the mirrors and watchers of this process, the page and the recording must have what the server has, each recording
must be readable, and nothing may have grown. What differs is printed, with the seed.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import random
import re
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from chaos.proxy import Proxy
from chaos.scoreboard import COMPLAINTS
from chaos.servers import PrivateServer
from chaos.tools import descriptors, rss
from hunt.checks import same

import reem
from reem.recording import open_log

KEYS = ["raw_image", "processed_info", "processed_image", "processor", "actuator", "settings"]
SMALL = ["processed_info", "processor", "settings"]
"""Keys that the page shows as JSON without an array."""
REEM = ["-c", "from reem_async.tools.cli import main; main()"]
PATIENCE = 20.0
"""Seconds of rest after which whatever differs is wrong, and in which a program has to end."""
EVERY = 8
"""Events between two pauses."""
MOST_MEGABYTES, MOST_DESCRIPTORS, MOST_KEYS = 700, 80, 60
"""Of the page, and of the server."""
MORE = (80.0, 8, 2)
"""How many megabytes, descriptors and threads this process may have more at the end than at the beginning."""


class Wrong(Exception):
    pass


class Program:
    """One program of the robot, which is started again whenever it has ended."""

    def __init__(self, name: str, command: Callable[[], list[Any]], folder: Path) -> None:
        self.name, self._command, self._output = name, command, folder / f"{name}.txt"
        self.process: Any = None

    @property
    def running(self) -> bool:
        return self.process is not None and self.process.poll() is None

    def start(self) -> None:
        with self._output.open("wb") as file:
            command = [sys.executable, *map(str, self._command())]
            self.process = subprocess.Popen(command, cwd=Path(__file__).resolve().parents[1], stdout=file, stderr=file)

    def said(self) -> str:
        return self._output.read_text(errors="replace") if self._output.exists() else ""

    def send(self, number: int) -> None:
        if self.running:
            self.process.send_signal(number)

    def end(self, number: int) -> int:
        """Send it a signal that ends it; returns its exit code."""
        self.send(signal.SIGCONT)
        self.send(number)
        try:
            return int(self.process.wait(PATIENCE))
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise Wrong(f"the {self.name} does not end after signal {number}:\n{self.said()[-3000:]}") from None

    def check_output(self) -> None:
        """Complain of what a clean program does not print. Errors of REEM are due, and Ctrl-C as it imports modules."""
        # A callback of Python's imports that Ctrl-C ends.
        said = self.said().replace("Exception ignored in: <function _get_module_lock", "")
        found = [line for line in said.splitlines() if any(words in line for words in COMPLAINTS[:3] + COMPLAINTS[4:])]
        for block in said.split("Traceback (most recent call last):\n")[1:]:
            last = next((line for line in block.splitlines() if re.match(r"[\w.]+: |[\w.]+$", line)), "")
            imports = "\nDuring handling of" in block and block.count('File "') == block.count('"<frozen importlib')
            if not imports and not last.startswith(("reem_async.", "reem.", "KeyboardInterrupt", "ImportError")):
                found.append(f"{last} in\n{block[:2000]}")
        if found:
            raise Wrong(f"the {self.name} said: {found[0]}")


class Observers:
    """Mirrors of both kinds and watchers in this process, through the proxy."""

    def __init__(self, url: str) -> None:
        self.interface = reem.RedisInterface(url)
        self.kvs = reem.KeyValueStore(self.interface)
        self.last: dict[str, Any] = dict.fromkeys(KEYS)
        self.numbers: dict[
            tuple[int, float], int
        ] = {}  # of each frame: its publisher's number and time, its own number
        self.twice: list[str] = []
        self.watches = {name: self.kvs[name].watch(reem.Last(1000)) for name in KEYS}
        self.mirrors = {name: self.kvs[name].mirror() for name in KEYS}
        self.subscribers = {name: reem.SilentSubscriber(name, self.interface, stored=True) for name in KEYS}
        for follower in (*self.watches.values(), *self.mirrors.values(), *self.subscribers.values()):
            follower.listen()
        self.threads = [threading.Thread(target=self._follow, args=(name,), daemon=True) for name in KEYS]
        for thread in self.threads:
            thread.start()

    def _follow(self, name: str) -> None:
        seen: dict[str, int] = {}
        with contextlib.suppress(reem.InterfaceClosed):
            for update in self.watches[name]:
                self.last[name] = update.data
                if update.publisher is None or update.sequence is None:
                    continue
                if update.sequence <= seen.get(update.publisher, 0):
                    self.twice.append(f"{name}: number {update.sequence} after {seen[update.publisher]}")
                seen[update.publisher] = update.sequence
                if name == "raw_image" and not update.deleted:
                    self.numbers[update.sequence, update.time] = update.value["images_sent"]

    def wrong(self, truth: dict[str, Any]) -> list[str]:
        found = []
        for name, due in truth.items():
            held = {"watch": lambda name=name: self.last[name], "subscriber": self.subscribers[name].value}
            for kind, read in (held | {"mirror": self.mirrors[name].value}).items():
                try:
                    value = read()
                except reem.ReemError as error:
                    value = error
                if not same(value, due):
                    found.append(f"{kind} of {name}: {value!r:.300} in place of {due!r:.300}")
        return found

    def close(self) -> None:
        self.interface.close()
        for thread in self.threads:
            thread.join(PATIENCE)
        if any(thread.is_alive() for thread in self.threads):
            raise Wrong("a watcher does not end")


class Week:
    def __init__(self, seed: int, folder: Path, server: PrivateServer, proxy: Proxy) -> None:
        self.rng = random.Random(seed)
        self.folder, self.server, self.proxy = folder, server, proxy
        self.counts: Counter[str] = Counter()
        self.happened: deque[str] = deque(maxlen=2 * EVERY)
        self.growth: list[tuple[float, int, int]] = []
        self.recordings: list[Path] = []
        make = {
            "camera": lambda: self._example("camera", "--seconds", self.rng.uniform(1, 6)),
            "processor": lambda: self._example("processor"),
            "actuator": lambda: self._example("actuator"),
            "recorder": lambda: [*REEM, "record", "-o", self._recording(), *self._where()],
            "page": lambda: [*REEM, "browse", "--port", "0", "--no-open", *self._where()],
        }
        self.programs = {name: Program(name, command, folder) for name, command in make.items()}
        self.observers = Observers(proxy.url)
        self.start_all()

    def _example(self, name: str, *options: Any) -> list[Any]:
        front = self.rng.choice(["blocking", "asyncio"])
        return ["-m", f"examples.image_system.{name}", "--url", self.proxy.url, "--front", front, *options]

    def _where(self) -> list[str]:
        return ["--url", self.rng.choice([self.proxy.url, self.proxy.url, self.server.url])]

    def _recording(self) -> Path:
        self.recordings.append(self.folder / f"{self.counts['recordings']}.mcap")
        self.counts["recordings"] += 1
        return self.recordings[-1]

    def event(self) -> None:
        """Let one thing happen, and start again what has ended."""
        running = [program for program in self.programs.values() if program.running]
        one = self.rng.choice(running) if running else self.programs["camera"]
        lost = self.rng.choice([b"raw_image", b"processor", b"settings"])
        name, action = self.rng.choice([
            *[("kill", lambda: one.running and one.end(signal.SIGKILL))] * 2,
            ("stop", lambda: one.send(signal.SIGSTOP)),
            ("end", lambda: one.running and one.end(signal.SIGINT)),
            ("cut", self.proxy.reset),
            ("half close", self.proxy.half_close),
            ("black hole", self.proxy.black_hole),
            ("lost reply", lambda: self.proxy.drop_reply(lost)),
            ("slow link", lambda: setattr(self.proxy, "delay", 0.003)),
            ("server killed", self._restart_server),
            ("server stopped", self.server.pause),
            ("store", self._store),
        ])  # fmt: skip
        self.counts[name] += 1
        self.happened.append(f"{name} {one.name}" if name in ("kill", "stop", "end") else name)
        action()
        time.sleep(self.rng.choice([0.02, 0.3, 1.0, 3.0]))
        self.put_right()
        self.start_all()

    def _restart_server(self) -> None:
        self.server.kill()
        time.sleep(self.rng.choice([0.0, 0.2, 1.5]))
        self.server.start()

    def _store(self) -> None:
        settings = self.observers.kvs["settings"]
        with contextlib.suppress(reem.ReemError):
            settings.write({"n": self.rng.randrange(1000), "array": np.full(self.rng.choice([3, 50_000]), 0.5)})
            del settings["array"]

    def put_right(self) -> None:
        self.server.resume()
        self.proxy.heal()
        for program in self.programs.values():
            program.send(signal.SIGCONT)

    def start_all(self) -> None:
        for program in self.programs.values():
            if not program.running:
                program.check_output()
                program.start()

    def truth(self) -> dict[str, Any]:
        """Return what the server has, once it has had the same for a second."""
        deadline, before, since = time.monotonic() + 3 * PATIENCE, {"": 0}, time.monotonic()
        with reem.RedisInterface(self.server.url, timeout=5, local="off") as interface:
            kvs = reem.KeyValueStore(interface)
            while time.monotonic() - since < 1.0:
                now = {name: kvs[name].read() for name in KEYS}
                if not same(now, before):
                    before, since = now, time.monotonic()
                if time.monotonic() > deadline:
                    raise Wrong("the robot does not come to rest")
                time.sleep(0.1)
        return before

    def pause(self) -> None:
        self.put_right()
        self.programs["camera"].end(signal.SIGKILL)
        truth = self.truth()
        deadline = time.monotonic() + PATIENCE
        while wrong := [*self.observers.wrong(truth), *self._page_wrong(truth)]:
            if time.monotonic() > deadline:
                raise Wrong("\n".join(wrong))
            truth = self.truth()  # a program may have been starting
        if self.observers.twice:
            raise Wrong(f"told twice or backwards: {self.observers.twice[:3]}")
        self._check_recordings(truth)
        self._check_growth()

    def _page_wrong(self, truth: dict[str, Any]) -> list[str]:
        page = self.programs["page"]
        address = re.search(r"http://127\S+", page.said())
        if not page.running or address is None:
            return []  # it has just been started
        found = []
        for name in SMALL:
            if any(isinstance(each, np.ndarray) for each in (truth[name] or {}).values()):
                continue  # an outage came before it was deleted again
            for when in ({}, {"at": time.time() - 0.1}):
                asked = {"path": name, **when}
                answer = httpx.get(f"{address[0]}api/json", params=asked, timeout=PATIENCE, trust_env=False)
                if (answer.json() if answer.status_code == 200 else None) != truth[name]:
                    found.append(f"page of {name} {when}: {answer.text[:300]} in place of {truth[name]!r:.300}")
        return found

    def _check_recordings(self, truth: dict[str, Any]) -> None:
        """End the recorder; what it recorded must end with the truth. Read back all recordings since the last pause."""
        recorder = self.programs["recorder"]
        begun = recorder.running and "recording into" in recorder.said()
        deadline = time.monotonic() + PATIENCE  # the last fault may take it five seconds to notice
        while begun and time.monotonic() < deadline and _lacking(self.recordings[-1], truth):
            time.sleep(0.5)
        code = recorder.end(signal.SIGINT if begun else signal.SIGKILL)
        if begun and code:
            raise Wrong(f"the recorder ended with {code}: {recorder.said()[-2000:]}")
        for path in self.recordings:
            whole = begun and path == self.recordings[-1]
            if path.exists() and (whole or path.stat().st_size > 4096):
                try:
                    self._read_back(path, truth if whole and same(self.truth(), truth) else {})
                except Exception as error:
                    kept = shutil.copy(path, tempfile.gettempdir())
                    told = f"{type(error).__name__}: {error}\nthe recorder said: {recorder.said()[-2000:]}"
                    raise Wrong(f"recording kept as {kept}: {told}") from error
            path.unlink(missing_ok=True)
        self.recordings.clear()

    def _read_back(self, path: Path, truth: dict[str, Any]) -> None:
        with open_log(path) as log:
            seen = set()
            for update in log.updates():
                if update.kind != "pub":
                    continue
                key = (update.path[0], update.sequence, update.published)
                if key in seen:
                    raise Wrong(f"it has {key} twice")
                seen.add(key)
                if update.path == ("raw_image",):
                    number = update.value["images_sent"]
                    due = self.observers.numbers.get(key[1:], number)
                    if number != due:
                        raise Wrong(f"frame {number} in place of {due}")
            self.counts["updates recorded"] += len(seen)
        if lacking := _lacking(path, truth):
            raise Wrong(lacking)

    def _check_growth(self) -> None:
        self.growth.append((rss(), sum(descriptors()), threading.active_count()))
        if self.programs["page"].running:
            folder = Path(f"/proc/{self.programs['page'].process.pid}")
            megabytes = int((folder / "statm").read_text().split()[1]) * 4096 / 1e6
            if (held := len(list((folder / "fd").iterdir()))) > MOST_DESCRIPTORS or megabytes > MOST_MEGABYTES:
                raise Wrong(f"the page has {megabytes:.0f} MB and {held} descriptors")
        with self.server.raw() as raw:
            if raw.dbsize() > MOST_KEYS:
                raise Wrong(f"the server has {raw.dbsize()} keys: {list(raw.scan_iter())[:100]}")
        if len(self.growth) >= 12:
            early, late = (np.median(rows, axis=0) for rows in (self.growth[3:7], self.growth[-4:]))
            if np.any(late > early + MORE):
                raise Wrong(f"this process grew from {early} to {late}: MB, descriptors, threads")

    def close(self) -> None:
        self.put_right()
        for program in filter(lambda it: it.running, self.programs.values()):
            program.end(signal.SIGKILL)
        self.observers.close()


def _lacking(path: Path, truth: dict[str, Any]) -> str:
    """Return where the end of a recording, which may still grow, is not what the server has."""
    try:
        log = open_log(path)
    except (OSError, ValueError) as error:
        return str(error)
    with log:
        for name, due in truth.items():
            try:
                value = log.value_at((name,), log.end)
            except reem.MissingKey:  # a server that was killed may have lost it
                value = None
            if not same(value, due):
                return f"{name} ends with {value!r:.500} in place of {due!r:.500}"
    return ""


def run(seed: int, events: int, seconds: float) -> str:
    """Let so many things happen within so long; returns what differed, or nothing."""
    server = PrivateServer(keep=True)
    server.lines.clear()  # the settings of `EmbeddedServer`: a kill may lose two seconds of what the server had
    wrong, done, begun = "", 0, time.monotonic()
    with tempfile.TemporaryDirectory(prefix="reem-week-") as folder, server, Proxy(server.port) as proxy:
        week = Week(seed, Path(folder), server, proxy)
        try:
            while done < events and time.monotonic() - begun < seconds:
                week.event()
                done += 1
                if done % EVERY == 0 or done == events:
                    week.pause()
                    week.start_all()
                    print(f"{done} events, {time.monotonic() - begun:.0f} s, {week.growth[-1]}", flush=True)
        except Wrong as error:
            wrong = f"{error}\nwhat happened last: {', '.join(week.happened)}"
        finally:
            week.close()
    print(
        f"seed {seed}: {done} events, {len(week.growth)} pauses, {time.monotonic() - begun:.0f} s; {dict(week.counts)}"
    )
    return wrong


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--events", type=int, default=1000)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10**6))
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    print(f"seed {given.seed}", flush=True)
    if wrong := run(given.seed, given.events, given.minutes * 60):
        sys.exit(f"WRONG: {wrong}\nagain: python tests/robotweek.py --seed {given.seed}")
