"""A private, real server or cluster inside a program: for scripts, tests, demonstrations and single robots."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ..errors import BadValue, Misuse
from .cluster import EmbeddedCluster
from .process import HOST, ServerProcess, Startable, at_port, find_program, has_data

__all__ = ["EmbeddedCluster", "EmbeddedServer"]


FILL_SECONDS = 30.0  # without a byte moving, while a snapshot is restored
PASSWORD_BYTES = 512  # the server's own limit


class EmbeddedServer(Startable):
    """A Redis-compatible server that belongs to this program and ends with it, however it ends.

        with EmbeddedServer() as server:          # or: async with
            kvs = KeyValueStore(RedisInterface(server))

    It listens on 127.0.0.1 and on a unix socket that only this user can open. Several run side by side.
    One object serves blocking and asyncio programs, and any thread; a forked child may use the server, but
    does not own it: there, `start` and `stop` do nothing.

    The program that runs is the first of: `$REEM_SERVER` (a path); a `redis-server` or `valkey-server` on
    PATH with JSON; the extra `reem-async[server]`; and, without JSON, any of the two on PATH. The extra is Valkey (BSD
    licence) and, on Linux on x86-64, the RedisJSON module, which is under RSALv2/SSPL: free to use, but not to be
    offered to others as a managed service. Elsewhere, and with `json=False`, the server has no JSON module, and REEM
    keeps its documents as text: the same promises, at the cost that docs/decisions.md tells.

    All users of this machine can connect to the port: set a password unless you are the only one.

    Up to 64 MiB of memory that it frees stay with it, for the next large value, if its malloc is glibc's and the
    environment has no GLIBC_TUNABLES.
    """

    def __init__(
        self,
        port: int = 0,
        directory: str | os.PathLike[str] | None = None,
        password: str | None = None,
        snapshot: str | os.PathLike[str] | None = None,
        *,
        json: bool = True,
        maxmemory: str | None = None,
    ) -> None:
        """Prepare a server; `start` or a `with` block starts it.

        Args:
            port: TCP port on 127.0.0.1; 0 takes a free one.
            directory: where the data is kept from one start to the next; made if missing. A server or machine
                that is killed loses the last two seconds at most; what the server's command WAITAOF was answered
                for is kept. None keeps the data in memory, and it is gone with the server.
            password: what every client has to give, on the unix socket too.
            snapshot: a file of either kind (see `reem_async.snapshots`) that the server begins with, under the
                namespace it was taken of. The directory, if there is one, must hold no data yet.
            json: False starts it without loading a JSON module (one that is built into the program stays, and `json`
                says so); so does REEM_SERVER_PLAIN=1.
            maxmemory: how much the data may take, such as "500mb" or "2gb". Writes beyond it raise ServerFull, and
                nothing is lost. None sets no limit.

        Raises:
            BadValue: a port, password or limit that no server takes.
        """
        if not 0 <= port <= 65535:
            raise BadValue(f"port {port} is not in 0..65535")
        if password is not None and not 0 < len(password.encode()) <= PASSWORD_BYTES:
            raise BadValue(f"a password has 1 to {PASSWORD_BYTES} bytes; None means that there is none")
        if password is not None and "\0" in password:
            raise BadValue("a password cannot contain NUL")
        if maxmemory is not None and not re.fullmatch(r"[1-9]\d{0,17}[kmg]?b?", maxmemory, re.IGNORECASE | re.ASCII):
            raise BadValue(f"maxmemory must be a number with kb, mb or gb, such as 2gb, got {maxmemory!r}")
        self._wanted_port = port
        self._wanted_directory = None if directory is None else Path(directory).absolute()
        self._password = password
        self._snapshot = None if snapshot is None else Path(snapshot).absolute()
        self._json = json
        self._maxmemory = maxmemory
        super().__init__()
        self._process: ServerProcess | None = None

    def start(self) -> None:
        """Start the server and wait until it answers; nothing if it runs already.

        Raises:
            ServerMissing: no server program was found; says what to install.
            ServerFailed: the port is taken, the directory is in use or unusable, or the server ended; the
                message holds the last lines of its log.
            BadData: the snapshot is damaged, or no snapshot. No server is left running.
            BadValue: there is a snapshot, and data in the directory.
            FileNotFoundError: the snapshot is not there.
        """
        self._start()

    def _runs(self) -> bool:
        return self.running

    def _begin(self) -> Callable[[], object]:
        self._process = self._begun()
        return self._process.stop

    @property
    def running(self) -> bool:
        """Whether the server is up: started, not stopped, and not ended by itself."""
        process = self._process
        return process is not None and not process.ended()

    @property
    def url(self) -> str:
        """What to connect to: `redis://[:password@]127.0.0.1:PORT`."""
        login = "" if self._password is None else f":{quote(self._password, safe='')}@"
        return f"redis://{login}{HOST}:{self.port}"

    @property
    def port(self) -> int:
        """The TCP port on 127.0.0.1."""
        return self._started().port

    @property
    def socket_path(self) -> str:
        """The unix socket; the shortest way on the same machine."""
        return self._started().socket_path

    @property
    def pid(self) -> int:
        """The process id of the server."""
        return self._started().pid

    @property
    def json(self) -> bool:
        """Whether the server has JSON; without, REEM keeps documents as text there."""
        return self._started().json

    @property
    def directory(self) -> Path:
        """Where the log `server.log` is, and the data if a directory was given; else a temporary one."""
        return self._wanted_directory or self._started().directory

    @property
    def password(self) -> str | None:
        """The password given."""
        return self._password

    def __repr__(self) -> str:
        process = self._process
        state = f"on {HOST}:{process.port}, pid {process.pid}" if process is not None else "not started"
        return f"<EmbeddedServer {state}>"

    def _begun(self) -> ServerProcess:
        if self._snapshot is None:
            return self._run(None)
        from reem_async.tools.snapshots.files import sniff  # only programs that use snapshots load them

        if self._wanted_directory is not None and has_data(self._wanted_directory):
            raise BadValue(
                f"{self._wanted_directory} holds a server's data, and {self._snapshot} would have to replace it: "
                "give a new directory for the snapshot, or go on with that data without the snapshot"
            )
        if sniff(self._snapshot) == "rdb":
            process = self._run(self._snapshot)
        else:
            process = self._run(None)
            try:
                self._fill(process, self._snapshot)
            except BaseException:
                process.stop()
                if self._wanted_directory is not None:  # which was empty before
                    shutil.rmtree(self._wanted_directory / "appendonlydir", ignore_errors=True)
                raise
        if self._wanted_directory is not None:
            self._snapshot = None  # from now on the data is in the directory
        return process

    def _fill(self, process: ServerProcess, snapshot: Path) -> None:
        """Restore a portable snapshot; on another thread, since this one may run an event loop already."""
        import asyncio
        from concurrent.futures import ThreadPoolExecutor

        from reem_async.connection import RedisInterface
        from reem_async.tools.snapshots import described, restore

        async def fill() -> None:
            namespace = described(snapshot).namespace
            login: dict[str, Any] = {} if self._password is None else {"password": self._password}
            url = f"unix://{quote(process.socket_path)}"
            async with RedisInterface(url, namespace=namespace, timeout=FILL_SECONDS, **login) as interface:
                await restore(interface, snapshot)

        with ThreadPoolExecutor(1, "reem-restore") as thread:
            thread.submit(asyncio.run, fill()).result()

    def _run(self, rdb: Path | None) -> ServerProcess:
        program = find_program(json=self._json)

        def start(port: int) -> ServerProcess:
            return ServerProcess(
                program,
                port=port,
                directory=self._wanted_directory,
                password=self._password,
                rdb=rdb,
                maxmemory=self._maxmemory,
            )

        return at_port(self._wanted_port, start)

    def _clear(self) -> None:
        super()._clear()
        self._process = None

    def _started(self) -> ServerProcess:
        if self._process is None:
            raise Misuse("the server is not running: use `with EmbeddedServer() as server:` or call start()")
        return self._process
