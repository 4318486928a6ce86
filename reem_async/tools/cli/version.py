"""`reem --version`, and what `reem --help` says first."""

from __future__ import annotations

from typing import Annotated

import typer

from reem_async import __version__


def _show(wanted: bool) -> None:
    if not wanted:
        return
    typer.echo(f"reem {__version__}")
    raise typer.Exit


def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_show, is_eager=True, help="Show the version of REEM.")
    ] = False,
) -> None:
    """REEM: one nested dictionary, shared by all the programs of a robot."""
