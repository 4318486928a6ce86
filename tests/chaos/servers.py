"""Private servers that may be killed, stopped, starved and started again on the same port and directory."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import time
from pathlib import Path

import redis
from own_servers import Configured, free_port

from reem_async.server.process import find_program


class PrivateServer:
    """A server of this row's own; `with` starts and stops it.

    Args:
        lines: More lines of its configuration.
        keep: Keep the data on disk, safely there before a write is answered.
    """

    def __init__(self, *lines: str, keep: bool = False) -> None:
        self.lines = [*lines, *(["appendfsync always"] if keep else [])]
        self.port = free_port()
        self.directory = Path(tempfile.mkdtemp(prefix="reem-chaos-")) if keep else None
        self._process: Configured | None = None
        self._stopped = False

    @property
    def url(self) -> str:
        return f"redis://127.0.0.1:{self.port}"

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def raw(self, **options) -> redis.Redis:
        return redis.Redis(port=self.port, retry=None, socket_timeout=10, decode_responses=True, **options)

    def start(self) -> None:
        self._process = Configured(find_program(), self.lines, port=self.port, directory=self.directory)

    def kill(self) -> None:
        process = self._process
        assert process is not None
        os.kill(process.pid, signal.SIGKILL)
        deadline = time.monotonic() + 10
        while not process.ended() and time.monotonic() < deadline:
            time.sleep(0.002)
        process.stop()
        self._process = None

    def pause(self) -> None:
        os.kill(self.pid, signal.SIGSTOP)
        self._stopped = True

    def resume(self) -> None:
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
