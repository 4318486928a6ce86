"""The command `reem`. Each subcommand is in a module of its own, imported when it is called."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from ..._installation import CURE, original_reem

if TYPE_CHECKING:
    import typer

__all__ = ["build", "main"]


def main() -> None:
    """Run the command line; exit code 1 and the remedy if what it needs is not installed."""
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr] # shows what the terminal cannot
    if clash := original_reem():
        sys.stderr.write(f"reem: {clash}; run: {CURE}\n")
    try:
        app = build()
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in ("typer", "rich"):
            raise
        sys.stderr.write(
            f"The command `reem` needs {package}: pip install 'reem-async[server]', or 'reem-async[tools]' "
            "to do without a server\n"
        )
        raise SystemExit(1) from None
    try:
        app(prog_name="reem")
    except (AttributeError, ImportError):
        # The original also installs redis-py 3.5, with which nothing here can be imported.
        if not clash:
            raise
        raise SystemExit(1) from None


def build() -> typer.Typer:
    """The command line, put together here so that nothing is imported before it is known to be there."""
    import rich  # noqa: F401 - needed only later, by the command; said at once if it is missing
    import typer

    from .commands import COMMANDS, group_of, root

    # Pretty tracebacks are off: they show the values of variables, and one is a password.
    app = typer.Typer(
        cls=group_of(COMMANDS),
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(root)
    return app
