"""The command `reem`. Each subcommand is a function in a module of its own, listed in `build`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import typer


def main() -> None:
    """Run the command line; exit code 1 and the remedy if what it needs is not installed."""
    try:
        app = build()
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in ("typer", "rich"):
            raise
        sys.stderr.write(f"The command `reem` needs {package}: pip install 'reem[server]'\n")
        raise SystemExit(1) from None
    app(prog_name="reem")


def build() -> typer.Typer:
    """The command line, put together here so that nothing is imported before it is known to be there."""
    import typer

    from reem_async.cli import up, version

    # Pretty tracebacks are off: they show the values of variables, and one is a password.
    app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
    app.callback()(version.root)
    app.command()(up.up)
    return app
