"""`reem demo`: a simulated robot, and the page that shows it."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reem_async.tools.cli.running import Refused, guarded

if TYPE_CHECKING:
    from reem_async.server.embedded import EmbeddedServer

__all__ = ["demo"]

_PROGRAMS = ("arm", "camera", "controller")
_SERVER_PORT, _PAGE_PORT = 6379, 8080
_END_SECONDS = 5.0


def demo(
    port: Annotated[
        int | None,
        typer.Option(
            min=0, max=65535, show_default="6379, or a free one if it is taken", help="TCP port of the server."
        ),
    ] = None,
    page_port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, show_default="8080, or a free one if it is taken", help="TCP port of the page."),
    ] = None,
    open_: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a web browser.")] = True,
) -> None:
    """Start a simulated robot and show it on a page in the web browser, until Ctrl-C.

    Three programs share one server: an arm, a camera that sees it, and a controller that finds a ball in the
    camera's picture and carries it to a goal. The command prints three lines of Python that move the goal from
    another terminal. The server is private and in memory; its data is gone when the command ends.

    Examples:
        reem demo
        reem demo --no-open     on a machine without a screen
    """
    code = guarded("demo", lambda: _run(port, page_port, open_), live=True)
    if code:
        raise typer.Exit(code)


def _run(port: int | None, page_port: int | None, open_: bool) -> None:
    from reem_async.tools.cli.browse import check_packages

    check_packages(None)
    # localhost and not 127.0.0.1: this way clients find the Unix socket, which is quicker.
    with (
        _first_of(port, _SERVER_PORT, _server) as server,
        _programs(f"redis://localhost:{server.port}") as running,
    ):
        asyncio.run(_show(server.port, page_port, open_, running))


def _server(port: int) -> EmbeddedServer:
    from reem_async.server.embedded import EmbeddedServer

    server = EmbeddedServer(port)
    server.start()  # the `with` block stops it
    return server


def _first_of(wanted: int | None, usual: int, start: Any) -> Any:
    """Start at the port that was asked for; if none was, at the usual one, or at a free one if that is taken."""
    from reem_async.errors import ServerFailed

    if wanted is not None:
        return start(wanted)
    try:
        return start(usual)
    except ServerFailed:
        return start(0)


@contextmanager
def _programs(url: str) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Run the robot's programs; they end when their standard input does."""
    command = [sys.executable, "-m", "reem_async.tools.demo.robot"]
    # In a session of their own: Ctrl-C is for this command, which then ends them.
    running = [
        subprocess.Popen([*command, name, url], stdin=subprocess.PIPE, start_new_session=True)  # noqa: S603 - our own
        for name in _PROGRAMS
    ]
    try:
        yield running
    finally:
        for process in running:
            with suppress(OSError):
                process.stdin.close()  # type: ignore[union-attr]
        for process in running:
            try:
                process.wait(_END_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


async def _show(server_port: int, page_port: int | None, open_: bool, running: list[subprocess.Popen[bytes]]) -> None:
    from reem_async.connection import RedisInterface
    from reem_async.tools.browser import LiveSource, PageServer, create_app, listen
    from reem_async.tools.cli.browse import open_page

    source = LiveSource(RedisInterface(f"redis://localhost:{server_port}", timeout=5.0))
    sock = _first_of(page_port, _PAGE_PORT, lambda number: listen("127.0.0.1", number))
    page = PageServer(create_app(source, allow_write=True), sock)
    watch = asyncio.create_task(_ended(running, page))
    try:
        await source.start()
        address = f"http://127.0.0.1:{sock.getsockname()[1]}/"
        _describe(server_port, address)
        if open_:
            open_page(address)
        await page.run_until_stopped()
        if watch.done():
            raise Refused(f"the program `{watch.result()}` of the robot has ended by itself")
    finally:
        watch.cancel()
        sock.close()
        await source.close()


async def _ended(running: list[subprocess.Popen[bytes]], page: Any) -> str:
    """Stop the page as soon as one of the programs has ended; return its name."""
    while True:
        for name, process in zip(_PROGRAMS, running, strict=True):
            if process.poll() is not None:
                page.stop()
                return name
        await asyncio.sleep(0.5)


def _describe(port: int, address: str) -> None:
    from rich.console import Console
    from rich.text import Text

    python = shutil.which("python")
    is_ours = python is not None and os.path.samefile(os.path.dirname(python), os.path.dirname(sys.executable))
    where = "localhost" if port == _SERVER_PORT else f"localhost:{port}"
    url = "" if port == _SERVER_PORT else f" --url localhost:{port}"
    console = Console(highlight=False, markup=False, soft_wrap=True)
    console.print(Text("The demo is up", "bold green") + ": an arm, its camera and its controller, in three programs.")
    for label, value in (("page", address), ("server", f"redis://localhost:{port}"), ("to stop", "Ctrl-C")):
        console.print(Text.assemble("  ", (f"{label:10}", "cyan"), value))
    console.print(f"\nMove the goal: in another terminal, start {'python' if is_ours else sys.executable} and paste")
    for line in (
        "from reem import KeyValueStore, RedisInterface",
        f'kvs = KeyValueStore(RedisInterface("{where}"))',
        'kvs["goal"] = {"x": -0.1, "y": -0.4}  # metres; the arm brings the ball there',
    ):
        console.print(Text(f"  {line}", style="bold"))
    console.print(f"\nOr look on: reem top{url}, reem echo controller{url}, reem record{url} -o run.mcap")
