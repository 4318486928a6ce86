"""`reem foxglove` and `reem rerun`: what a server holds, in the viewers that robots' programmers have."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import typer

from ...connection import RedisInterface
from .checks import is_loopback
from .options import DEFAULT_URL, Force, Namespace, Ships, Url, existing, named_ships
from .output import clean, counted, emit, facts_lines, note, styled, typed
from .running import USAGE, CommandFailed, guarded, run, run_local

Keys = Annotated[
    list[str] | None,
    typer.Argument(metavar="KEY", show_default=False, help="Only these keys; * and ? stand for other characters."),
]
Rate = Annotated[
    float,
    typer.Option(min=0.1, max=1000, metavar="HZ", help="Messages a second of each array and picture, at most."),
]


def foxglove(
    keys: Keys = None,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
    log: Annotated[
        list[Path] | None,
        typer.Option(
            "--log", metavar="FILE", callback=existing, dir_okay=False, help="Play a recording; several are one."
        ),
    ] = None,
    host: Annotated[str, typer.Option(metavar="ADDRESS", help="Where to listen; there is no password.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 takes a free one.")] = 8765,
    rate: Rate = 30,
    allow_write: Annotated[bool, typer.Option("--allow-write", help="Let Foxglove set parameters.")] = False,
    ships: Ships = None,
) -> None:
    """Show keys live in Foxglove, or play a recording there.

    In Foxglove choose "Open connection" and the address that is printed. Each key is a topic, such as /arm, and each
    array or picture in it another, such as /camera/image. Parameters are in Foxglove's panel for them. Only what
    Foxglove shows is read from the server. Needs the extra foxglove.

    Examples:
        reem foxglove
        reem foxglove arm 'cam_*' --allow-write
        reem foxglove --log run.mcap
    """
    with guarded("foxglove"):
        known = named_ships(ships)
        if log and allow_write:
            raise CommandFailed("a recording is not changed: leave out --allow-write, or --log", USAGE)
    if log:
        run_local("foxglove", lambda: _play(log, keys or [], known, host, port, rate), live=True)
        return

    async def work(interface: RedisInterface) -> None:
        from ..viewers.foxglove import FoxgloveViewer

        viewer = FoxgloveViewer(interface, keys or [], host=host, port=port, rate=rate, allow_write=allow_write)
        _tell(viewer.bridge, interface.hostname, host, "reading, and setting parameters" if allow_write else "reading")
        try:
            await viewer.run()
        finally:
            _report(viewer.losses)

    run("foxglove", work, url, namespace, live=True, ships=known)


def _play(log: list[Path], keys: list[str], ships: list[Any], host: str, port: int, rate: float) -> None:
    from ..recording import open_log
    from ..viewers.player import FoxglovePlayer

    with open_log(log, ships) as opened:
        player = FoxglovePlayer(opened, keys, host=host, port=port, rate=rate)
        _tell(player.bridge, ", ".join(each.name for each in log), host, "reading")
        try:
            player.run()
        finally:
            _report(player.skipped)


def _tell(bridge: Any, title: str, host: str, rights: str) -> None:
    emit(styled("Foxglove can connect", "green") + f" to {clean(title)}")
    users = "programs of this machine" if is_loopback(host) else "every program that reaches this machine"
    rows = [("address", bridge.address), ("or open", bridge.link), ("open to", users), ("allows", rights)]
    facts_lines([*rows, ("to stop", "Ctrl-C")])


def _report(losses: Counter[str]) -> None:
    """Say of which keys updates were left out, the worst first."""
    parts = [f"{typed((name,))} {counted(count, 'update')}" for name, count in losses.most_common(5)]
    note(f"left out or lost: {', '.join(parts)}" if parts else "nothing was left out")


def rerun(
    keys: Keys = None,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
    connect: Annotated[
        str | None, typer.Option("--connect", metavar="ADDRESS", help="Send to a viewer that runs at this address.")
    ] = None,
    spawn: Annotated[bool, typer.Option("--spawn", help="Start a viewer on this machine; the default.")] = False,
    save: Annotated[Path | None, typer.Option("--save", metavar="FILE", help="Write an .rrd file.")] = None,
    rate: Annotated[
        float, typer.Option(min=0.1, max=1000, metavar="HZ", help="How often a second each key is sent, at most.")
    ] = 30,
    force: Force = False,
    ships: Ships = None,
) -> None:
    """Show keys live in Rerun, or save them for it.

    Numbers become scalars, pictures images, other arrays tensors, and texts entries of a log, at entities such as
    /arm/q. Of each key Rerun gets the newest state, --rate times a second at most; what came between is left out, and
    `reem record` keeps all of it. Needs the extra rerun.

    Examples:
        reem rerun
        reem rerun arm 'cam_*' --rate 10
        reem rerun --connect rerun+http://127.0.0.1:9876/proxy
        reem rerun --save run.rrd
    """
    with guarded("rerun"):
        known = named_ships(ships)
        if bool(connect) + spawn + bool(save) > 1:
            raise CommandFailed("use one of --connect, --spawn and --save", USAGE)

    async def work(interface: RedisInterface) -> None:
        from ..viewers.rerun import RerunViewer

        viewer = RerunViewer(interface, keys or [], rate=rate)
        viewer.open(connect=connect, save=save, force=force)
        where = connect or save or "a viewer on this machine"
        emit(f"sending {clean(interface.hostname)} to {clean(str(where))}; Ctrl-C ends it")
        try:
            await viewer.run()
        finally:
            viewer.close()
            note(f"{counted(viewer.shown, 'state')} sent; {counted(viewer.unknown, 'value')} of other types left out")

    run("rerun", work, url, namespace, live=True, ships=known)
