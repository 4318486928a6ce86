"""`make demo`: camera, processor and actuator as three processes, watched from a fourth.

    python -m examples.image_system [--front asyncio] [--seconds 6] [--url redis://...] [--out last_frame.png]

Shows how many frames each has handled while they run, then the latency from the camera to the
actuator, and writes the last processed frame as a PNG. Exit code 1 and the reason if anything failed.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from examples.common import parser, server
from examples.image_system.camera import RATE
from reem import KeyValueStore, RedisInterface, ReemError

PATIENCE = 10.0  # seconds for the programs to start, and to end after the camera's last frame
COUNTERS = {"camera": "raw_image.images_sent", "processor": "processor.frames", "actuator": "actuator.frames"}


class Failed(Exception):
    """The demo did not work; the message says why."""


class Program:
    """One of the three, in a process of its own; what it prints is kept for the case that it fails."""

    def __init__(self, name: str, url: str, front: str, *options: str) -> None:
        self.name = name
        self.output: IO[str] = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed in stop()
        warnings = [f"-W{option}" for option in sys.warnoptions]
        command = [sys.executable, *warnings, "-m", f"{__package__}.{name}", "--url", url, "--front", front, *options]
        self.process = subprocess.Popen(command, stdout=self.output, stderr=subprocess.STDOUT)

    def running(self) -> bool:
        """Whether it still runs; raises Failed if it ended with an error."""
        code = self.process.poll()
        if code:
            self.output.seek(0)
            raise Failed(f"the {self.name} ended with exit code {code}:\n{self.output.read().strip()}")
        return code is None

    def stop(self) -> None:
        """End it, if it still runs."""
        with self.output:
            self.process.terminate()
            self.process.wait(PATIENCE)


def wait_until_ready(kvs: KeyValueStore, programs: list[Program]) -> None:
    """Return when all of them follow what they have to."""
    deadline = time.monotonic() + PATIENCE
    while not all(kvs.get(f"{program.name}.ready", False) for program in programs):
        for program in programs:
            if not program.running() or time.monotonic() > deadline:
                raise Failed(f"the {program.name} did not get ready")
        time.sleep(0.02)


@contextlib.contextmanager
def display(console: Console, total: int) -> Iterator[Progress | None]:
    """Three live bars on a terminal, nothing elsewhere."""
    if not console.is_terminal:
        yield None
        return
    columns = TextColumn("{task.description:>10}"), BarColumn(40), MofNCompleteColumn(), TextColumn("frames")
    with Progress(*columns, console=console) as bars:
        for name in COUNTERS:
            bars.add_task(name, total=total)
        yield bars


def follow(kvs: KeyValueStore, programs: list[Program], console: Console, seconds: float) -> list[int]:
    """Show how far the programs are until all have ended; returns the frames each has handled."""
    deadline, said = time.monotonic() + seconds + PATIENCE, time.monotonic()
    with display(console, round(RATE * seconds)) as bars:
        while True:
            running = [program.name for program in programs if program.running()]
            counts = [kvs.get(path, 0) for path in COUNTERS.values()]
            for number, count in enumerate(counts):
                if bars is not None:
                    bars.update(bars.task_ids[number], completed=count)
            if bars is None and (not running or time.monotonic() > said + 1.0):
                said += 1.0
                print(*(f"{name} {count}" for name, count in zip(COUNTERS, counts, strict=True)), sep=", ", flush=True)
            if not running:
                return counts
            if time.monotonic() > deadline:
                raise Failed(f"still running {PATIENCE:.0f} s after the camera's time was up: {', '.join(running)}")
            time.sleep(0.1)


def save(image: np.ndarray, path: Path) -> None:
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def demo(options: Namespace, console: Console) -> None:
    with server(options.url) as host, RedisInterface(host) as interface, contextlib.ExitStack() as stack:
        url = getattr(host, "url", host)
        kvs = KeyValueStore(interface)
        kvs["raw_image"], kvs["processor"], kvs["actuator"] = {"images_sent": 0}, {"ready": False}, {"ready": False}

        def start(name: str, *more: str) -> Program:
            program = Program(name, url, options.front, *more)
            stack.callback(program.stop)
            return program

        console.print(f"Camera, processor and actuator: three processes, {options.front} front")
        programs = [start("processor"), start("actuator")]
        wait_until_ready(kvs, programs)
        programs.append(start("camera", "--seconds", str(options.seconds)))
        sent, processed, acted = follow(kvs, programs, console, options.seconds)
        if not acted:
            raise Failed(f"no frame arrived at the actuator ({sent} sent, {processed} processed)")
        latencies = 1000 * kvs["actuator"]["latencies"].read()
        save(kvs["processed_image"]["image"].read(), options.out)
    console.print(f"[bold]{sent}[/] frames sent, [bold]{processed}[/] processed, [bold]{acted}[/] acted upon")
    median, late = np.percentile(latencies, [50, 99])
    console.print(f"camera to actuator: median [bold]{median:.1f} ms[/], p99 [bold]{late:.1f} ms[/]")
    console.print(f"last processed frame: {options.out}", soft_wrap=True)


if __name__ == "__main__":
    arguments = parser(__doc__)
    arguments.add_argument("--seconds", type=float, default=6.0, help="how long the camera sends; default: %(default)s")
    arguments.add_argument("--out", type=Path, default=Path("out/last_frame.png"), help="default: %(default)s")
    try:
        demo(arguments.parse_args(), Console(highlight=False))
    except (Failed, ReemError) as error:
        sys.exit(f"The demo failed: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
