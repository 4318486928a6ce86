"""`reem up`: a private server in the foreground."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Annotated, NoReturn

import typer
from rich.console import Console
from rich.text import Text

from reem_async.errors import BadValue, ServerFailed, ServerMissing
from reem_async.server import EmbeddedServer

PASSWORD_VARIABLE = "REEM_PASSWORD"  # noqa: S105 - the name of a variable
LOOK_SECONDS = 0.5  # between looks whether the server is still there


def up(
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port on 127.0.0.1; 0 takes a free one.")] = 6379,
    directory: Annotated[
        Path | None,
        typer.Option(file_okay=False, help="Keep the data here; without it, it is gone with the server."),
    ] = None,
    password_from_env: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"Environment variable that holds the password; {PASSWORD_VARIABLE} is used if it is set.",
        ),
    ] = None,
) -> None:
    """Start a private server and keep it up until Ctrl-C."""
    variable = _password_variable(password_from_env)
    stop = _stop_event()
    try:
        server = EmbeddedServer(port, directory, os.environ[variable] if variable else None)
        with server:
            _describe(server, directory, variable)
            while not stop.wait(LOOK_SECONDS):
                if not server.running:
                    _fail(f"the server ended by itself; its log ends:\n{_log_end(server)}")
    except (BadValue, ServerFailed, ServerMissing) as error:
        _fail(str(error))
    with suppress(OSError):  # the terminal may have closed
        Console().print(f"Stopped. The data is {'kept' if directory else 'gone'}.")


def _password_variable(name: str | None) -> str | None:
    """The variable to read, None for no password. An empty one is an error, not a server without password."""
    if name is None and PASSWORD_VARIABLE not in os.environ:
        return None
    name = name or PASSWORD_VARIABLE
    if not os.environ.get(name):
        _fail(f"the environment variable {name} is {'empty' if name in os.environ else 'not set'}")
    return name


def _stop_event() -> threading.Event:
    """Set by Ctrl-C, by SIGTERM, and when the terminal closes."""
    stop = threading.Event()

    def handle(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, handle)
    return stop


def _describe(server: EmbeddedServer, directory: Path | None, variable: str | None) -> None:
    password = f', password=os.environ["{variable}"]' if variable else ""
    url = f"redis://127.0.0.1:{server.port}"
    connect = f'KeyValueStore(RedisInterface("{url}"{password}))'
    imports = "import os; from" if variable else "from"
    console = Console()
    console.print(Text("REEM's server is up.", style="bold green"), f"(process {server.pid})")
    for label, value in (
        ("address", url),
        ("socket", f"unix://{server.socket_path}"),
        (
            "password",
            f"the value of {variable}" if variable else "none: any user of this machine can connect",
        ),
        ("data", f"{server.directory}, kept" if directory else "in memory, gone when the server stops"),
        ("blocking", f"{imports} reem import KeyValueStore, RedisInterface; kvs = {connect}"),
        ("asyncio", f"{imports} reem_async import KeyValueStore, RedisInterface; kvs = {connect}"),
        ("to stop", "Ctrl-C"),
    ):
        # soft_wrap: a line to be copied stays one line, however narrow the terminal
        console.print(Text.assemble("  ", (f"{label:10}", "cyan"), value), soft_wrap=True)


def _log_end(server: EmbeddedServer) -> str:
    """The last lines of the log, read now since a temporary directory goes with the server."""
    return "\n".join((server.directory / "server.log").read_text(errors="replace").splitlines()[-5:])


def _fail(message: str) -> NoReturn:
    """Say why on standard error and exit with code 1."""
    Console(stderr=True).print(Text.assemble(("reem up: ", "bold red"), message), soft_wrap=True)
    raise typer.Exit(1)
