"""`reem browse` and `reem demo`: the page in the web browser."""

from __future__ import annotations

import asyncio
import os
import secrets
import shutil
import subprocess
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ...concurrency.tasks import come_last
from ...connection import RedisInterface
from ...errors import ServerFailed
from ...server import EmbeddedServer
from .checks import is_loopback
from .options import DEFAULT_URL, Namespace, Ships, Url, existing, named_ships
from .output import clean, emit, facts_lines, styled
from .running import USAGE, CommandFailed, interface_to, run_local

if TYPE_CHECKING:
    from ..browser import Source

_PACKAGES = {"starlette": "starlette", "uvicorn": "uvicorn", "PIL": "pillow"}
_MEGABYTE = 1 << 20

_PROGRAMS = ("arm", "camera", "controller")
_SERVER_PORT, _PAGE_PORT = 6379, 8080
_END_SECONDS = 5.0


def browse(
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
    log: Annotated[
        list[Path] | None,
        typer.Option(
            "--log",
            metavar="FILE",
            callback=existing,
            dir_okay=False,
            show_default=False,
            help="Show a recording; several are shown as one.",
        ),
    ] = None,
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Where to listen; other machines need a token.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port of the page; 0 takes a free one.")] = 8080,
    buffer: Annotated[
        float, typer.Option(min=1, max=86400, metavar="SECONDS", help="How far back the slider reaches, live.")
    ] = 60,
    memory: Annotated[
        int, typer.Option(min=8, max=65536, metavar="MB", help="How much memory the past may take, live.")
    ] = 128,
    allow_write: Annotated[bool, typer.Option("--allow-write", help="Let the page change values.")] = False,
    ships: Ships = None,
    open_: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a web browser.")] = True,
) -> None:
    """Show all keys on a page in the web browser, with a slider for the time.

    The page is updated as things change. The slider goes back through the last seconds, or through a recording.
    Arrays are shown as images, lines, tables and histograms. It can only look, unless --allow-write is given.

    What programs publish or store is kept for the slider; several stored changes in a moment are one. Arrays are read
    at up to 8 MB a second; older ones are kept as small pictures.

    Examples:
      reem browse
      reem browse --log run.mcap
      reem browse --buffer 300 --memory 512
      reem browse --host 0.0.0.0 --no-open     from another machine: open the address it prints, token and all
    """

    def work() -> int | None:
        check_packages(log)
        if log and allow_write:
            raise CommandFailed("a recording is not changed: leave out --allow-write, or --log", USAGE)
        source = _source(url, namespace, log, buffer, memory, named_ships(ships))
        asyncio.run(_serve(source, host, port, allow_write, open_))
        return None

    run_local("browse", work, live=True)


def check_packages(log: list[Path] | None) -> None:
    # Looked for before anything is imported, so that all that is missing is named at once.
    needed = _PACKAGES | ({"mcap": "mcap"} if log else {})
    absent = [name for module, name in needed.items() if find_spec(module) is None]
    if absent:
        raise CommandFailed(f"needs {', '.join(absent)}: pip install 'reem-async[tools]'")


def _source(url: str, namespace: str, log: list[Path] | None, buffer: float, memory: int, ships: list[Any]) -> Source:
    """Return what to show. Made outside of the event loop, in which it is used."""
    if log:
        from ..browser.logsource import LogSource

        return LogSource(log, ships)
    from ..browser import LiveSource

    interface = interface_to(url, namespace, ships=ships)
    return LiveSource(interface, buffer, memory * _MEGABYTE)


async def _serve(source: Source, host: str, port: int, allow_write: bool, open_: bool) -> None:
    from ..browser import PageServer, create_app, listen
    from ..browser.app import LOOPBACK, own_names

    # Reachable from this machine only: then the name in the request is checked, and no token is needed. From others
    # a token is, and the name may be any of this machine's.
    alone = is_loopback(host)
    token = None if alone else secrets.token_urlsafe(24)
    hosts: Any = LOOPBACK if alone else own_names() | {host.lower()}
    app = create_app(source, allow_write=allow_write, token=token, hosts=hosts, any_address=not alone)
    # Before the source starts: that the port is taken is said at once, whatever the server does.
    sock = listen(host, port)
    try:
        await source.start()
        address = _address(host, sock.getsockname()[1], token)
        _tell(source, address, alone, allow_write)
        if open_:
            open_page(address)
        come_last()  # not before the web browser is opened, which would inherit it
        await PageServer(app, sock).run_until_stopped()
    finally:
        sock.close()
        await source.close()


def open_page(address: str) -> None:
    """Open a page in the web browser, if there is a screen to show it on."""
    # Without one, webbrowser would start a text browser in this very terminal.
    if sys.platform == "darwin" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(address)


def _address(host: str, port: int, token: str | None) -> str:
    from ..browser.app import own_address

    if host in ("0.0.0.0", "::"):  # noqa: S104 - compared, not bound
        host = own_address(host)
    name = f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}/" + (f"?token={token}" if token else "")


def _tell(source: Source, address: str, alone: bool, allow_write: bool) -> None:
    emit(styled("REEM's browser is up", "green") + f", showing {clean(source.title)}")
    who = "programs of this machine" if alone else "every program that has this address: it has a token in it"
    rights = "reading and writing" if allow_write and source.writable else "reading"
    facts_lines([("address", address), ("open to", who), ("allows", rights), ("to stop", "Ctrl-C")])


def demo(
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, show_default="6379, or a free one", help="TCP port of the server.")
    ] = None,
    page_port: Annotated[
        int | None, typer.Option(min=0, max=65535, show_default="8080, or a free one", help="TCP port of the page.")
    ] = None,
    open_: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a web browser.")] = True,
) -> None:
    """Start a simulated robot and show it on a page, until Ctrl-C.

    Three programs share one server: an arm, a camera that sees it, and a controller that finds a ball in the
    camera's picture and carries it to a goal. The command prints three lines of Python that move the goal from
    another terminal. The server is private and in memory; its data is gone when the command ends.

    Examples:
        reem demo
        reem demo --no-open     on a machine without a screen
    """
    run_local("demo", lambda: _run(port, page_port, open_), live=True)


def _run(port: int | None, page_port: int | None, open_: bool) -> None:
    check_packages(None)
    # localhost and not 127.0.0.1: this way clients find the Unix socket, which is quicker.
    with _first_of(port, _SERVER_PORT, _server) as server, _programs(f"redis://localhost:{server.port}"):
        asyncio.run(_show(server.port, page_port, open_))


def _server(port: int) -> EmbeddedServer:
    server = EmbeddedServer(port)
    server.start()  # the `with` block stops it
    return server


def _first_of(wanted: int | None, usual: int, start: Any) -> Any:
    """Start at the port that was asked for; if none was, at the usual one, or at a free one if that is taken."""
    if wanted is not None:
        return start(wanted)
    try:
        return start(usual)
    except ServerFailed:
        return start(0)


@contextmanager
def _programs(url: str) -> Iterator[None]:
    command = [sys.executable, "-m", "reem_async.tools.demo"]
    # In a session of their own: Ctrl-C is for this command, which then ends them.
    running = [
        subprocess.Popen([*command, name, url], stdin=subprocess.PIPE, start_new_session=True)  # noqa: S603 - our own
        for name in _PROGRAMS
    ]
    try:
        yield
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


async def _show(server_port: int, page_port: int | None, open_: bool) -> None:
    from ..browser import LiveSource, PageServer, create_app, listen

    source = LiveSource(RedisInterface(f"redis://localhost:{server_port}", timeout=5.0))
    sock = _first_of(page_port, _PAGE_PORT, lambda number: listen("127.0.0.1", number))
    try:
        await source.start()
        address = f"http://127.0.0.1:{sock.getsockname()[1]}/"
        _describe(server_port, address)
        if open_:
            open_page(address)
        await PageServer(create_app(source, allow_write=True), sock).run_until_stopped()
    finally:
        sock.close()
        await source.close()


def _describe(port: int, address: str) -> None:
    python = shutil.which("python")
    is_ours = python is not None and os.path.samefile(os.path.dirname(python), os.path.dirname(sys.executable))
    where = "localhost" if port == _SERVER_PORT else f"localhost:{port}"
    url = "" if port == _SERVER_PORT else f" --url localhost:{port}"
    emit(f"{styled('The demo is up', 'green')}: an arm, its camera and its controller, in three programs.")
    facts_lines([("page", address), ("server", f"redis://localhost:{port}"), ("to stop", "Ctrl-C")])
    emit(f"\nMove the goal: in another terminal, start {'python' if is_ours else sys.executable} and paste")
    for line in (
        "from reem import KeyValueStore, RedisInterface",
        f'kvs = KeyValueStore(RedisInterface("{where}"))',
        'kvs["goal"] = {"x": -0.1, "y": -0.4}  # metres; the arm brings the ball there',
    ):
        emit(f"  {styled(line, 'bold')}")
    emit(f"\nOr look on: reem top{url}, reem echo controller{url}, reem record{url} -o run.mcap")
    sys.stdout.flush()
