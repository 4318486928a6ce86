"""The options and arguments that commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from reem_async.tools.cli.completion import complete_path
from reem_async.tools.cli.running import NOTHING, complain

__all__ = [
    "DEFAULT_URL", "AsJson", "Count", "Force", "Namespace", "PathArgument", "Patterns", "Publish", "Ships", "Text",
    "Timeout", "Url", "Value", "WindowLength", "existing", "named_ships",
]  # fmt: skip

# localhost and not 127.0.0.1: it stands for the server's Unix socket, which is quicker.
DEFAULT_URL = "redis://localhost:6379"

_SERVER = "Server"

Url = Annotated[
    str,
    typer.Option(
        "--url",
        envvar="REEM_URL",
        metavar="URL",
        rich_help_panel=_SERVER,
        help="Where the server is: redis://user:password@host:port/db, rediss://... for TLS, unix://path; "
        "redis+cluster://host:port,host:port; redis+sentinel://host:port,host:port/name. "
        "Other users of this machine can see it in the list of processes, unlike the variable, or a password in "
        "REEM_PASSWORD.",
    ),
]
Namespace = Annotated[
    str,
    typer.Option(
        "--namespace", metavar="TEXT", rich_help_panel=_SERVER, help="What goes before every key, such as robot1:"
    ),
]
Ships = Annotated[
    list[str] | None,
    typer.Option(
        "--ship",
        metavar="MODULE:CLASS",
        show_default=False,
        help="A ship of your own that stored values; may be given several times. It is imported.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON, one object a line, for scripts.")]

PathArgument = Annotated[
    str,
    typer.Argument(
        metavar="PATH",
        autocompletion=complete_path,
        help='Such as foo, foo.bar.subkey, foo.tiles[2]; a key with a dot or blank in it: foo["a.b"].',
    ),
]
Patterns = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="PATTERN",
        show_default=False,
        autocompletion=complete_path,
        help="Paths; * and ? stand for other characters of a key: cam_*, robot.*.battery. All if there is none.",
    ),
]
Value = Annotated[
    str,
    typer.Argument(
        metavar="VALUE",
        help="JSON such as 1.5, true, '{\"a\": [1, 2]}', '\"text\"'; @file.json; @file.npy; - for JSON from the input.",
    ),
]
Text = Annotated[bool, typer.Option("--str", help="VALUE is text, not JSON; - still reads the input.")]
Publish = Annotated[bool, typer.Option("--publish", help="Tell subscribers, as a PublishSpace does.")]
Force = Annotated[bool, typer.Option("--force", help="Replace the file if it is there already.")]


def existing(ctx: typer.Context, file: Path | None) -> Path | None:
    """End with exit code 3 if a file that is to be read is not there: a callback of options."""
    if file is not None and not file.exists():
        raise typer.Exit(complain(ctx.info_name or "", f"{file}: No such file or directory", NOTHING))
    return file


Count = Annotated[int | None, typer.Option("--count", "-n", min=1, metavar="N", help="End after N updates.")]
Timeout = Annotated[
    float | None,
    typer.Option(
        "--timeout",
        min=0.001,
        metavar="SECONDS",
        help="End after so long; exit code 4 if there were fewer than --count updates by then, or none.",
    ),
]
WindowLength = Annotated[
    int, typer.Option("--window", "-w", min=2, max=1_000_000, metavar="N", help="Of how many updates of a path.")
]


def named_ships(names: list[str] | None) -> list[Any]:
    """Return the ships of an interface: those named by `--ship`, then the default ones."""
    from reem_async.ships.registry import default_ships
    from reem_async.tools.cli.naming import ship_named

    # The user's own ships first, as in a program: they may take what the default ones would.
    return [*map(ship_named, names or ()), *default_ships()]
