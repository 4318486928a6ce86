"""What tools cost a robot in C without REEM: `python -m benchmarks.lab`, in turns, under three minutes.

`tests/lab/lab.c` sets a JSON string at 1 kHz, and beside it images, text, a stream and a hash. Shown are p50 and p99 of
that SET, alone and with each tool. "page" is `reem browse` and a client that asks for the tree, a plot and a picture.
"""

import argparse
import contextlib
import signal
import subprocess
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator

import numpy as np
from rich.console import Console
from rich.table import Table

from .environment import FOLDER
from .measure import rotated
from .measure_host import _REEM
from .measure_recorder import SETTLED
from .server import Server, free_port, private_server

ALONE = "no tool"
TOOLS = {
    ALONE: [],
    "echo": ["echo"],
    "top": ["top", "--json"],
    "record": ["record", "-o", "FILE"],
    "browse": ["browse", "--no-open", "--port", "PORT"],
    "page": ["browse", "--no-open", "--port", "PORT"],
}
SHOWN = ("tree?open=200:0:", "series?path=sai::sensors::Panda::joint_positions", "bytes?path=camera::rgb")


def look(address: str, over: threading.Event) -> None:
    """Ask for what a page shows, ten times a second."""
    while not over.wait(0.1):
        for what in SHOWN:
            with contextlib.suppress(OSError), urllib.request.urlopen(f"{address}/api/{what}", timeout=10) as reply:
                reply.read()


@contextlib.contextmanager
def attached(name: str, server: Server, file: str) -> Iterator[None]:
    """One tool, at `localhost` as without an option, so through the server's Unix socket."""
    if name == ALONE:
        yield
        return
    port, over = free_port(), threading.Event()
    words = [{"FILE": file, "PORT": str(port)}.get(word, word) for word in TOOLS[name]]
    process = subprocess.Popen([*_REEM, *words, "--url", f"redis://localhost:{server.port}"], stdout=subprocess.DEVNULL)
    if name == "page":
        threading.Thread(target=look, args=(f"http://127.0.0.1:{port}", over), daemon=True).start()
    try:
        yield
        if process.poll() is not None:
            raise RuntimeError(f"reem {name} has ended: {process.returncode}")
    finally:
        over.set()
        process.send_signal(signal.SIGINT)
        process.wait(30)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.lab", description=__doc__)
    parser.add_argument("--rounds", type=int, default=4, help="turns of each tool")
    parser.add_argument("--seconds", type=float, default=4.0, help="of a turn")
    options = parser.parse_args()
    found: dict[str, list[list[float]]] = {name: [] for name in TOOLS}
    with private_server() as server, tempfile.TemporaryDirectory(prefix="bench-") as folder:
        subprocess.run(["gcc", "-O2", "-o", f"{folder}/lab", FOLDER.parent / "tests/lab/lab.c", "-lm"], check=True)
        lab = [f"{folder}/lab", server.host, str(server.port)]
        subprocess.run([*lab, "1"], check=True, stdout=subprocess.DEVNULL)  # its keys are there before the tools
        for number in range(options.rounds):
            for name in rotated(list(found), number):
                with attached(name, server, f"{folder}/{name}-{number}.mcap"):
                    time.sleep(SETTLED)
                    said = subprocess.check_output([*lab, str(options.seconds)], text=True).split()
                found[name].append([float(said[3]), float(said[5])])
    shown = Table("tool", "p50, µs", "p99, µs", "worst turn", "p99 /", "p99 / of each turn", title="SET at 1 kHz, in C")
    alone = np.array(found[ALONE])
    for name, turns in found.items():
        p50, p99 = np.median(turns, axis=0)
        ratios = np.array(turns)[:, 1] / alone[:, 1]
        each = " ".join(f"{ratio:.2f}" for ratio in ratios)
        shown.add_row(
            name,
            f"{p50:.0f}",
            f"{p99:.0f}",
            f"{max(turn[1] for turn in turns):.0f}",
            f"{p99 / np.median(alone[:, 1]):.2f}",
            each,
        )
    Console(width=120).print(shown)


if __name__ == "__main__":
    main()
