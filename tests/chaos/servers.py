"""Private servers that may be killed, stopped, starved and started again on the same port and directory."""

from __future__ import annotations

import os
import random
import shutil
import signal
import socket
import tempfile
import time
from pathlib import Path

import redis

from reem_async.server.process import ServerProcess, ServerProgram
from reem_async.server.programs import find_program

# Below the ports that the kernel gives to clients: while the server is down, one of them could be given its port.
PORTS = range(20_000, 32_000)


class _Configured(ServerProcess):
    """A server process with more lines of configuration; the later ones count."""

    def __init__(self, it: PrivateServer, *, patient: bool = True) -> None:
        self._lines, self._patient = it.lines, patient
        program = find_program() if it.json else ServerProgram(find_program().path)
        super().__init__(program, port=it.port, directory=it.directory, password=it.password)

    def _config(self, *given):
        return super()._config(*given) + "".join(f"{line}\n" for line in self._lines)

    def _wait_until_ready(self, *given):
        if self._patient:
            super()._wait_until_ready(*given)
        while not self.ask("PING"):  # until it answers anything at all
            time.sleep(0.002)


class PrivateServer:
    """A server of this row's own; `with` starts and stops it.

    Args:
        lines: More lines of its configuration.
        keep: Keep the data on disk, safely there before a write is answered.
        password: What clients have to give.
        json: Load the JSON module; without, only where the program has JSON in a module.
    """

    def __init__(self, *lines: str, keep: bool = False, password: str | None = None, json: bool = True) -> None:
        self.json = json
        self.lines = [*lines, *(["appendfsync always"] if keep else [])]
        self.port = _free_port()
        self.password = password
        self.directory = Path(tempfile.mkdtemp(prefix="reem-chaos-")) if keep else None
        self._process: _Configured | None = None
        self._stopped = False

    @property
    def url(self) -> str:
        return f"redis://127.0.0.1:{self.port}"

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def raw(self, **options) -> redis.Redis:
        """A plain client that speaks to it directly and knows no retries."""
        return redis.Redis(
            port=self.port, password=self.password, retry=None, socket_timeout=10, decode_responses=True, **options
        )

    def start(self) -> None:
        self._process = _Configured(self)

    def start_loading(self) -> None:
        """Start it; returns when it says anything, be it that it is still loading."""
        self._process = _Configured(self, patient=False)

    def wait(self, seconds: float = 20.0) -> None:
        """Wait until it has loaded its data."""
        deadline = time.monotonic() + seconds
        assert self._process is not None
        while not self._process.ask("PING").startswith(b"+PONG"):
            assert time.monotonic() < deadline, "the server does not get ready"
            time.sleep(0.01)

    def kill(self) -> None:
        """kill -9; returns when it is gone."""
        process = self._process
        assert process is not None
        os.kill(process.pid, signal.SIGKILL)
        deadline = time.monotonic() + 10
        while not process.ended() and time.monotonic() < deadline:
            time.sleep(0.002)
        process.stop()
        self._process = None

    def pause(self) -> None:
        """SIGSTOP: connections stand, nothing is answered."""
        os.kill(self.pid, signal.SIGSTOP)
        self._stopped = True

    def resume(self) -> None:
        """SIGCONT."""
        if self._stopped:
            os.kill(self.pid, signal.SIGCONT)
            self._stopped = False

    def __enter__(self) -> PrivateServer:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self.resume()
            self._process.stop()
        if self.directory is not None:
            shutil.rmtree(self.directory, ignore_errors=True)


def _free_port() -> int:
    for port in random.sample(PORTS, 100):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise OSError(f"no free port in {PORTS}")
