"""Worker processes as seen from the benchmark: start, ask, end."""

import contextlib
import json
import select
import subprocess
import tempfile
import time
from typing import Any

from . import environment
from .contenders import CONTENDERS, Contender
from .server import Server, free_port

PATIENCE = 60.0  # seconds a request may take beyond what it asks for


class ContenderError(Exception):
    """A contender could not do what it was asked; the text goes into the result."""


class Worker:
    """One process of a contender, or a herd of them."""

    def __init__(self, python: str, module: str, herd: bool = False) -> None:
        command = [python, "-W", "ignore", str(environment.FOLDER / "launch.py"), module]
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 - open as long as the process
        self._process = subprocess.Popen(
            command + ["--herd"] * herd,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            cwd=environment.FOLDER.parent,
        )

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    def ask(self, do: str, patience: float = PATIENCE, **keywords: Any) -> Any:
        """Send one request and wait for its reply."""
        assert self._process.stdin
        if self._process.stdin.closed:
            raise ContenderError("the worker was ended")
        try:
            self._process.stdin.write(json.dumps({"do": do, **keywords}).encode() + b"\n")
            self._process.stdin.flush()
        except OSError:
            raise ContenderError(self._last_words()) from None
        reply = json.loads(self._reply(patience))
        if "error" in reply:
            raise ContenderError(reply["error"])
        return reply["ok"]

    def _reply(self, patience: float) -> bytes:
        assert self._process.stdout
        end = time.monotonic() + patience
        pieces: list[bytes] = []
        while not pieces or not pieces[-1].endswith(b"\n"):
            ready, _, _ = select.select([self._process.stdout], [], [], max(0.0, end - time.monotonic()))
            if not ready:
                self.end()
                raise ContenderError(f"no reply within {patience:.0f} s")
            # read1 takes what is there; readline would wait past our patience.
            piece = self._process.stdout.read1()  # type: ignore[attr-defined]
            if not piece:
                raise ContenderError(self._last_words())
            pieces.append(piece)
        return b"".join(pieces)

    def _last_words(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(2)
        self._errors.seek(0)
        lines = [line for line in self._errors.read().splitlines() if line.strip()]
        return f"the worker ended: {lines[-1] if lines else self._process.returncode}"

    @property
    def alive(self) -> bool:
        """Whether the process still runs."""
        return self._process.poll() is None

    def end(self) -> None:
        """Close its input, which ends it, or else kill it."""
        with contextlib.suppress(OSError):
            if self._process.stdin:
                self._process.stdin.close()
        try:
            self._process.wait(3)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        assert self._process.stdout
        self._process.stdout.close()
        self._errors.close()


class Workers:
    """One measuring process per contender, started when first needed, and others on demand."""

    def __init__(self, server: Server, folder: str) -> None:
        self.server = server
        self.folder = folder  # for Unix sockets; each pair has its own port in the names
        self.versions: dict[str, str] = {}
        self.unavailable: dict[str, str] = {}
        self._running: dict[str, Worker] = {}

    def get(self, name: str) -> Worker:
        """The measuring process of a contender."""
        worker = self._running.get(name)
        if worker is None or not worker.alive:
            self._running[name] = worker = self.start(name)
        return worker

    def target(self, contender: Contender, peer_port: int, hub: bool | None = None) -> dict[str, Any]:
        """What a worker needs to know to connect."""
        server = self.server
        return {
            "url": f"redis://{contender.host}:{server.port}",
            "host": contender.host,
            "port": server.port,
            "loop": contender.loop,
            "peer_port": peer_port,
            "folder": self.folder,
            "hub": hub,
            "options": contender.options,
        }

    def start(self, name: str, peer_port: int = 0, hub: bool | None = None) -> Worker:
        """Start and connect one process; what cannot start once is not tried again.

        Of more than a publisher and a subscriber, one is the `hub`, to which the others connect.
        """
        if name in self.unavailable:
            raise ContenderError(self.unavailable[name])
        contender = CONTENDERS[name]
        worker = None
        try:
            worker = Worker(environment.interpreter(contender.environment), contender.module)
            self.versions[name] = worker.ask("open", target=self.target(contender, peer_port, hub))
        except (environment.VenvError, ContenderError) as error:
            if worker is not None:
                worker.end()
            self.unavailable[name] = str(error)
            raise ContenderError(str(error)) from None
        return worker

    @contextlib.contextmanager
    def herd(self, name: str, count: int, peer_port: int = 0) -> Any:
        """`count` forked and connected processes of a contender."""
        if name in self.unavailable:
            raise ContenderError(self.unavailable[name])
        contender = CONTENDERS[name]
        worker = Worker(environment.interpreter(contender.environment), contender.module, herd=True)
        try:
            worker.ask("fork", count=count)
            worker.ask("all", request={"do": "open", "target": self.target(contender, peer_port)})
            yield worker
        finally:
            with contextlib.suppress(ContenderError):
                worker.ask("disband", patience=10)
            worker.end()

    @contextlib.contextmanager
    def pair(self, name: str, members: int = 0) -> Any:
        """A fresh publisher, and a fresh subscriber or a herd of them."""
        port = free_port()
        publisher = self.start(name, port)
        try:
            if members:
                with self.herd(name, members, port) as herd:
                    yield publisher, herd
            else:
                subscriber = self.start(name, port)
                try:
                    yield publisher, subscriber
                finally:
                    subscriber.end()
        finally:
            publisher.end()

    def end(self) -> None:
        """End every measuring process; new ones are started when needed."""
        for worker in self._running.values():
            worker.end()
        self._running.clear()
