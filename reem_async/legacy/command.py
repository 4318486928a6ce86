"""`reem migrate`: convert data of REEM 0.0 and 0.1."""

from __future__ import annotations

from typing import Annotated

import typer

from reem_async.connection import RedisInterface
from reem_async.legacy import convert
from reem_async.legacy.convert import Migration
from reem_async.tools.cli.options import AsJson, Match, with_server
from reem_async.tools.cli.output import clean, columns, counted, emit, emit_json, named, note, progress_bar
from reem_async.tools.cli.running import FAILED


@with_server("migrate", ships=True)
async def migrate(
    interface: RedisInterface,
    yes: Annotated[bool, typer.Option("--yes", help="Convert. Without it, only show what would be done.")] = False,
    match: Match = "*",
    as_json: AsJson = False,
) -> int:
    """Convert data of REEM 0.1 or older, or of a server without JSON, in place.

    Without --yes everything is read and checked, and nothing is changed. End the programs of old versions
    first. Each key is written in one transaction. This can be interrupted at any time and started again; new data
    is left alone. An old RDB file is loaded by `reem up --from FILE`.

    Exit code 1 if a key cannot be converted; it stays as it is.

    Examples:
        reem migrate
        reem migrate --yes
        reem migrate --yes --ship my_ships:PoseShip --url redis://robot.local:6379
    """
    with progress_bar(after=0.0) as bar:
        tell = None if as_json else bar("convert" if yes else "check")
        done = await convert.migrate(interface, match, dry_run=not yes, progress=tell)
    _show(done, as_json)
    return FAILED if done.problems else 0


def _show(done: Migration, as_json: bool) -> None:
    if as_json:
        for key in done.keys:
            emit_json({**key._asdict(), "dry_run": done.dry_run})
        return
    good = [key for key in done.keys if not key.problem]
    removed = [f"{counted(len(key.removed), 'old Redis key')} removed" if key.removed else "" for key in good]
    rows = [[clean(key.name), clean(named(key.places)), more] for key, more in zip(good, removed, strict=True)]
    columns(rows, ["cyan", "", "dim"])
    for key in done.problems:
        note(f"{key.name} is left as it is: {key.problem}")
    keys = counted(len(good), "key")
    if not done.keys:
        emit("Nothing to do: no key was written by REEM 0.1 or older.")
    elif done.dry_run:
        emit(f"{keys} would be converted. Nothing was changed; `reem migrate --yes` does it.")
    else:
        emit(f"{keys} converted.")
