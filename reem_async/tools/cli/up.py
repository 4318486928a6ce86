"""`reem up`: a private server or cluster in the foreground."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from ...errors import LoginRefused, RedisError, ReemError
from ...server import EmbeddedServer
from ...server.cluster import EmbeddedCluster
from ...server.process import PortTaken
from .options import existing
from .output import emit, facts_lines, styled
from .running import PASSWORD_VARIABLE, CommandFailed, guarded, interface_to

LOOK_SECONDS = 0.1  # between looks whether the server is still there, and whether to end

DEFAULT_PORT = 6379


class Stop:
    """Set by Ctrl-C, by SIGTERM, and when the terminal closes."""

    def __init__(self) -> None:
        self.is_set = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._handle)

    def _handle(self, _number: int, _frame: FrameType | None) -> None:
        self.is_set = True

    def wait(self) -> bool:
        """Wait a moment; return whether the command is to end."""
        time.sleep(LOOK_SECONDS)  # not a `threading.Event`: a handler may wait for its lock, which this thread holds
        return self.is_set


def _up_cluster(*, plain: bool) -> None:
    with EmbeddedCluster(json=not plain) as cluster:
        stop = Stop()
        emit(styled("REEM's cluster is up.", "green"))
        half = len(cluster.nodes) // 2
        nodes = [f"port {node.port}, process {node.pid}" for node in cluster.nodes]
        labels = ["primaries", *[""] * (half - 1), "replicas", *[""] * (half - 1)]
        facts_lines([("address", cluster.url), *zip(labels, nodes, strict=True)])
        facts_lines(_use(cluster.url, json=cluster.json, data="in memory, gone when the cluster stops"))
        while not stop.wait():
            pass
    emit("Stopped. The data is gone.")


def _use(url: str, password: str | None = None, *, json: bool, data: str) -> list[tuple[str, str]]:
    """Return how documents and data are kept, and what a program does to connect."""
    login = f', password=os.environ["{PASSWORD_VARIABLE}"]' if password else ""
    imports = "import os; from" if password else "from"
    connect = f'import KeyValueStore, RedisInterface; kvs = KeyValueStore(RedisInterface("{url}"{login}))'
    return [
        ("documents", "stored as JSON" if json else "stored as text: the server has no JSON module"),
        ("data", data),
        ("blocking", f"{imports} reem {connect}"),
        ("asyncio", f"{imports} reem_async {connect}"),
        ("to stop", "Ctrl-C"),
    ]


def up(
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, show_default="6379, 0 with --from", help="TCP port; 0: a free one.")
    ] = None,
    directory: Annotated[
        Path | None, typer.Option(file_okay=False, help="Keep the data here; else it is gone with the server.")
    ] = None,
    snapshot: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="FILE",
            callback=existing,
            dir_okay=False,
            help="Begin with what this snapshot holds, portable or RDB. A --directory must have no data yet.",
        ),
    ] = None,
    maxmemory: Annotated[
        str | None, typer.Option(metavar="SIZE", help="Refuse writes beyond so much data, such as 2gb.")
    ] = None,
    cluster: Annotated[
        bool, typer.Option("--cluster", help="Three primaries and three replicas, in memory, on free ports; to try it.")
    ] = False,
    plain: Annotated[
        bool, typer.Option("--plain", help="Store documents as text, without the JSON module, as on arm64 and macOS.")
    ] = False,
) -> None:
    """Start a private server and keep it up until Ctrl-C.

    With --from, a past state can be looked at beside the live one, which is not touched.

    The environment variable REEM_PASSWORD gives it a password.

    Examples:
      reem up
      reem up --directory /var/lib/robot --port 6400 --maxmemory 2gb
      reem up --from reem-20260801T120000Z.zip
      reem up --cluster
      reem up --plain
    """
    with guarded("up"):
        if not cluster:
            _up_server(port, directory, snapshot, maxmemory, plain=plain)
        elif any(given is not None for given in (port, directory, snapshot, maxmemory)):
            raise CommandFailed(
                "--cluster takes no other option than --plain: it is in memory, on free ports, without a password"
            )
        else:
            _up_cluster(plain=plain)


def _up_server(
    port: int | None, directory: Path | None, snapshot: Path | None, maxmemory: str | None, *, plain: bool
) -> None:
    password = os.environ.get(PASSWORD_VARIABLE)
    if password == "":
        raise CommandFailed(f"the environment variable {PASSWORD_VARIABLE} is empty; unset it, or give it a password")
    if port is None:
        port = 0 if snapshot else DEFAULT_PORT
    if snapshot is not None and not snapshot.is_file():
        raise CommandFailed(f"{snapshot} is no file; give a snapshot")
    try:
        with EmbeddedServer(port, directory, password, snapshot, json=not plain, maxmemory=maxmemory) as server:
            stop = Stop()  # until now, Ctrl-C ended the loading at once
            _describe(server, directory, password, snapshot)
            while not stop.wait():
                if not server.running:
                    # It has said why in its log, which goes with its directory.
                    log = (server.directory / "server.log").read_text(errors="replace").splitlines()[-5:]
                    raise CommandFailed("\n".join(["the server ended by itself; its log ends:", *log]))
    except PortTaken as error:  # most often by the server that the user wants
        raise CommandFailed(f"{error}{_who_is_there(port)}") from None
    emit(f"Stopped. The data is {'kept' if directory else 'gone'}.")


def _who_is_there(port: int) -> str:
    """Return what to do about a server that answers at the port already, empty if it is no server."""

    async def ask() -> None:
        async with interface_to(f"127.0.0.1:{port}", "", timeout=1.0):
            pass

    try:
        asyncio.run(ask())
    except LoginRefused:
        what = "a server that wants a password"
    except (ReemError, RedisError, OSError):
        return ""
    else:
        what = "a server that REEM can use already"
    return (
        f". It is {what}: connect to redis://localhost:{port}, `reem doctor --url redis://localhost:{port}` looks at it"
    )


def _describe(server: EmbeddedServer, directory: Path | None, password: str | None, snapshot: Path | None) -> None:
    # localhost and not 127.0.0.1: this way clients find the Unix socket, which is quicker.
    url = f"redis://localhost:{server.port}"
    emit(styled("REEM's server is up.", "green") + f" (process {server.pid})")
    facts_lines(
        [
            *((("snapshot", str(snapshot)),) if snapshot else ()),
            ("address", url),
            ("socket", f"unix://{server.socket_path}"),
            (
                "password",
                f"the value of {PASSWORD_VARIABLE}" if password else "none: any user of this machine can connect",
            ),
        ]
    )
    data = f"{server.directory}, kept" if directory else "in memory, gone when the server stops"
    facts_lines(_use(url, password, json=server.json, data=data))
