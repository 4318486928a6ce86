"""`reem --version`, and what `reem --help` says first."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed_version
from typing import Annotated

import typer


def _show(wanted: bool) -> None:
    if not wanted:
        return
    try:
        typer.echo(f"reem {installed_version('reem')}")
    # Not installed, as in a clone that was never set up.
    except PackageNotFoundError:
        typer.echo("reem, run from its sources")
    raise typer.Exit


def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_show, is_eager=True, help="Show the version of REEM.")
    ] = False,
) -> None:
    """REEM: one nested dictionary, shared by all the programs of a robot."""
