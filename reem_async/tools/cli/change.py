"""`reem set` and `reem del`."""

from __future__ import annotations

import asyncio
import signal
import sys
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from reem_async.tools.cli.options import DEFAULT_URL, Namespace, PathArgument, Publish, Text, Url, Value
from reem_async.tools.cli.output import clean
from reem_async.tools.cli.running import Refused, prepared, run
from reem_async.tools.cli.values import parse_value

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface
    from reem_async.store.accessor import Accessor

__all__ = ["delete", "set_"]


def set_(
    path: PathArgument,
    value: Value,
    is_text: Text = False,
    publish: Publish = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Store a value.

    The dict that holds it must be there: for foo.bar there must be a foo. Without --publish only
    those see it who read; with it, subscribers are told.

    Examples:
        reem set speed 0.5
        reem set robot '{"name": "left", "joints": [0, 0.5, 1]}'
        reem set robot.name right --str
        reem set robot.joints[0] -1.5 --publish
        reem set map @map.npy
        jq .config robot.json | reem set config -
    """
    parsed = prepared("set", lambda: parse_value(value, is_text=is_text))

    async def work(interface: RedisInterface) -> None:
        await _place(interface, path, publish).write(parsed)

    run("set", work, url, namespace)


def delete(
    path: PathArgument,
    publish: Publish = False,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Do not ask; a terminal asks before all of a top-level key goes.")
    ] = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Delete a value, with all that is below it.

    Exit code 3 if nothing is there.

    Examples:
        reem del robot.name
        reem del robot.joints[-1] --publish
        reem del robot --yes
    """

    async def work(interface: RedisInterface) -> None:
        place = _place(interface, path, publish)
        # Only a whole top-level key, and only if somebody can answer: scripts have no terminal.
        if len(place.full_path) == 1 and not yes and sys.stdin.isatty():
            await _ask(interface, path)
        await place.delete()

    run("del", work, url, namespace)


def _place(interface: RedisInterface, path: str, publish: bool) -> Accessor:
    from reem_async.store.publish import PublishSpace
    from reem_async.store.store import KeyValueStore

    return (PublishSpace if publish else KeyValueStore)(interface).at(path)


async def _ask(interface: RedisInterface, path: str) -> None:
    """Ask before a whole key goes; raises MissingKey, and Refused if the answer is no."""
    from reem_async.store.catalog import outline
    from reem_async.tools.cli.outlines import describe

    what = describe(await outline(interface, path), 60)
    if not _agreed(f"Delete {clean(path)} ({what}) at {interface.hostname}?"):
        raise Refused("nothing was deleted")


def _agreed(question: str) -> bool:
    """Ask; Ctrl-C ends the asking, which the event loop, standing still meanwhile, would not get to know of."""
    pressed = []

    def interrupted(*_: object) -> NoReturn:
        pressed.append(True)
        raise KeyboardInterrupt

    # asyncio's handler would only set a flag for the event loop, which stands still while it is asked.
    before = signal.signal(signal.SIGINT, interrupted)
    try:
        return typer.confirm(question, err=True)
    except typer.Abort:
        if pressed:
            raise asyncio.CancelledError from None
        return False  # the end of the input is no answer
    finally:
        signal.signal(signal.SIGINT, before)
