"""The command `reem`. Each subcommand is in a module of its own, imported when it is called."""

from __future__ import annotations

import atexit
import os
import sys
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import typer

__all__ = ["COMMANDS", "Entry", "build", "main"]

SERVER, LOOK, CHANGE, LIVE, LOG = "Server", "Look", "Change", "Live", "Record and browse"


class Entry(NamedTuple):
    """What `reem --help` says of one command, and where the command is.

    Attributes:
        name: What the user types.
        module: The module in this package that has it.
        attribute: Its function, or its typer application if it has subcommands.
        panel: The heading that it stands under.
        help: One line; the whole text is the docstring.
        takes_minus: Its values may begin with a minus sign: unknown options are handed to it as arguments.
    """

    name: str
    module: str
    attribute: str
    panel: str
    help: str
    takes_minus: bool = False


COMMANDS = (
    Entry("up", "up", "up", SERVER, "Start a private server and keep it up until Ctrl-C."),
    Entry("doctor", "doctor", "doctor", SERVER, "Check server, connection and installation, and say what to do."),
    Entry("ls", "listing", "ls", LOOK, "List keys with type and size."),
    Entry("tree", "listing", "tree", LOOK, "Show what is below keys; arrays are not fetched."),
    Entry("get", "get", "get", LOOK, "Print a value, or write it to a file."),
    Entry("set", "change", "set_", CHANGE, "Store a value.", takes_minus=True),
    Entry("del", "change", "delete", CHANGE, "Delete a value."),
    Entry("pub", "pub", "pub", CHANGE, "Publish a value, once or at a rate.", takes_minus=True),
    Entry("echo", "echo", "echo", LIVE, "Print updates as they are published."),
    Entry("hz", "rates", "hz", LIVE, "Measure how often paths are published."),
    Entry("bw", "rates", "bw", LIVE, "Measure how many bytes are published."),
    Entry("delay", "rates", "delay", LIVE, "Measure the time from publishing to receiving."),
    Entry("record", "record", "record", LOG, "Record what is published, and samples, into an MCAP file."),
    Entry("play", "play", "play", LOG, "Publish a recording again, at the recorded pace."),
    Entry("log", "log", "app", LOG, "Look into recordings, and export them."),
    Entry("browse", "browse", "browse", LOG, "Show all keys on a page in the web browser, with a slider for the time."),
    Entry("snapshot", "snapshot", "app", LOG, "Save what a server holds to files, list them, restore them."),
)


def main() -> None:
    """Run the command line; exit code 1 and the remedy if what it needs is not installed."""
    _mend_streams()
    try:
        app = build()
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in ("typer", "rich"):
            raise
        sys.stderr.write(
            f"The command `reem` needs {package}: pip install 'reem[server]', or 'reem[tools]' to do without a server\n"
        )
        raise SystemExit(1) from None
    app(prog_name="reem")


def _mend_streams() -> None:
    """Have all three streams, whatever the shell has closed; show characters that a terminal does not know as codes."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        stream = getattr(sys, name)
        if stream is None:
            stream = open(os.devnull, mode, encoding="utf-8")  # noqa: SIM115 - until the program ends
            atexit.register(stream.close)
            setattr(sys, name, stream)
        elif mode == "w":
            stream.reconfigure(errors="backslashreplace")


def build() -> typer.Typer:
    """The command line, put together here so that nothing is imported before it is known to be there."""
    import rich  # noqa: F401 - needed only later, by the command; said at once if it is missing
    import typer

    from reem_async.cli import lazy, version

    # Pretty tracebacks are off: they show the values of variables, and one is a password.
    app = typer.Typer(
        cls=lazy.group_of(COMMANDS),
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(version.root)
    return app
