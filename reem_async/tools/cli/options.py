"""Options and arguments that commands share, and the shell completion of paths."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Callable, Coroutine
from contextlib import suppress
from importlib import import_module
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from ...errors import BadType, BadValue, ReemError
from ...plan.paths import parse, shorten
from ...ships.base import SpecialDatatypeShip
from ...ships.registry import default_ships
from ...store.catalog import names
from ...store.store import KeyValueStore
from .output import typed
from .running import NOTHING, complain, guarded, interface_to, run

_SECONDS = 1.0  # longer than this, a completion only disturbs
# Names that are offered: a shell asks before it shows more than about a hundred.
_MOST = 200


def complete_path(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the paths that begin with what was typed, up to the next dot; nothing if the server cannot be asked."""
    url = ctx.params.get("url") or os.environ.get("REEM_URL") or "localhost"
    with suppress(Exception):  # a shell that completes is no place for messages
        return asyncio.run(asyncio.wait_for(_names(url, ctx.params.get("namespace") or "", incomplete), _SECONDS))
    return []


async def _names(url: str, namespace: str, incomplete: str) -> list[str]:
    async with interface_to(url, namespace, _SECONDS) as interface:
        store = KeyValueStore(interface)
        begun, dot, _ = incomplete.rpartition(".")
        outer = parse(begun) if dot else ()
        if outer:  # nothing of the dict is fetched but its keys
            keys = await store.at(begun).keys()
        else:  # the server leaves out the others: it may have a million keys
            keys = [name async for name in names(interface, f"{incomplete}*")]
        shown = [typed((*outer, key)) for key in keys]
        found = [each for each in shown if each.startswith(incomplete)][:_MOST]
        goes_on = False
        if len(found) == 1:
            with suppress(ReemError):  # a list, an array, a number
                goes_on = bool(await store.at(found[0]).keys())
        # A shell puts a blank behind the only choice. With two it waits for more to be typed, such as the next dot.
        return [found[0], f"{found[0]}."] if goes_on else sorted(found)


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
Match = Annotated[
    str,
    typer.Option(
        "--match", metavar="PATTERN", help="Only the top-level keys that match; * and ? stand for other characters."
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
Publish = Annotated[bool, typer.Option("--publish", help="Notify subscribers, as a PublishSpace does.")]
Recording = Annotated[Path, typer.Argument(metavar="FILE", help="The recording.")]
More = Annotated[
    list[Path] | None,
    typer.Option(
        "--with", metavar="FILE", show_default=False, help="Another file, read as one with the first; may be repeated."
    ),
]
Only = Annotated[list[str] | None, typer.Argument(metavar="[PATTERN]...", show_default=False, help="Only these paths.")]
Output = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="FILE", help="Write it to a file: .npy, .npz, .json, .png or .bin."),
]
Force = Annotated[bool, typer.Option("--force", help="Replace the file if it is there already.")]


Given = TypeVar("Given", Path, list[Path], None)


def existing(ctx: typer.Context, given: Given) -> Given:
    """End with exit code 3 if a file that is to be read is not there: a callback of options."""
    files: list[Path] = given if isinstance(given, list) else [] if given is None else [given]
    for file in files:
        if not file.exists():
            raise typer.Exit(
                complain(ctx.command_path.partition(" ")[2], f"{file}: No such file or directory", NOTHING)
            )
    return given


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


def with_server(
    name: str, *, live: bool = False, ships: bool = False
) -> Callable[[Callable[..., Coroutine[Any, Any, int | None]]], Callable[..., None]]:
    """Make a command of a function that takes an interface, and returns what to await once that is connected.

    The command has the options --url and --namespace besides those of the function, and with `ships` also --ship.
    """

    def decorate(work: Callable[..., Coroutine[Any, Any, int | None]]) -> Callable[..., None]:
        def command(url: str, namespace: str, own: list[str] | None = None, **given: Any) -> None:
            with guarded(name):
                known = named_ships(own) if ships else None
            run(name, lambda interface: work(interface, **given), url, namespace, live=live, ships=known)

        added = [("url", Url, DEFAULT_URL), ("namespace", Namespace, ""), *([("own", Ships, None)] if ships else [])]
        parameters = [
            *list(signature(work, eval_str=True).parameters.values())[1:],
            *[Parameter(title, Parameter.KEYWORD_ONLY, default=value, annotation=kind) for title, kind, value in added],
        ]
        command.__name__, command.__doc__ = work.__name__, work.__doc__
        command.__annotations__ = {each.name: each.annotation for each in parameters}
        command.__signature__ = Signature(parameters)  # type: ignore[attr-defined] # typer makes the options of it
        return command

    return decorate


def named_ships(names: list[str] | None) -> list[Any]:
    # The user's own ships first, as in a program: they may take what the default ones would.
    return [*map(ship_named, names or ()), *default_ships()]


def ship_named(text: str) -> SpecialDatatypeShip:
    """Return the ship `MODULE:NAME`, a class that is made without arguments or a ship; imports the module.

    Modules in the current directory are found, as they are by `python -m`.
    """
    module, colon, name = text.partition(":")
    if not (module and colon and name):
        raise BadValue(f"{shorten(text)} does not name a ship; write it like my_ships:PoseShip")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        thing = import_module(module)
        for part in name.split("."):
            thing = getattr(thing, part)
        ship = thing() if isinstance(thing, type) else thing
    except Exception as error:  # whatever the user's module does when it is imported
        raise BadValue(f"the ship {text} cannot be made: {type(error).__name__}: {error}") from error
    if not isinstance(ship, SpecialDatatypeShip):
        raise BadType(f"{text} is {shorten(ship)}, which is no SpecialDatatypeShip")
    return ship
