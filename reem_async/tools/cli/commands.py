"""Which commands there are, and importing each when it is called: `reem --help` needs none of them."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from itertools import takewhile
from typing import Annotated, Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from ... import __version__

# The headings of `reem --help`, in this order.
SERVER, LOOK, CHANGE, LIVE, LOG = "Server", "Look", "Change", "Live", "Record and browse"


class Entry(NamedTuple):
    """What `reem --help` says of one command, and where the command is."""

    name: str
    module: str  # in this package, or below `reem_async` if it has a dot
    attribute: str  # its function, or its typer application if it has subcommands
    panel: str
    help: str
    takes_minus: bool = False  # values may begin with a minus sign: unknown options are handed to it as arguments

    @property
    def full_module(self) -> str:
        return f"{'reem_async' if '.' in self.module else 'reem_async.tools.cli'}.{self.module}"


COMMANDS = (
    Entry("up", "up", "up", SERVER, "Start a private server and keep it up until Ctrl-C."),
    Entry("demo", "browse", "demo", SERVER, "Start a simulated robot and show it on a page, until Ctrl-C."),
    Entry("doctor", "doctor", "doctor", SERVER, "Check server, connection and installation, and say what to do."),
    Entry("migrate", "legacy.command", "migrate", SERVER, "Convert data of REEM 0.1 or older, in place."),
    Entry("ls", "listing", "ls", LOOK, "List keys with type and size."),
    Entry("tree", "listing", "tree", LOOK, "Show what is below keys; arrays are not fetched."),
    Entry("get", "values", "get", LOOK, "Print a value, or write it to a file."),
    Entry("nodes", "programs", "nodes", LOOK, "List the programs that are connected under a name."),
    Entry("set", "values", "set_", CHANGE, "Store a value.", takes_minus=True),
    Entry("del", "values", "delete", CHANGE, "Delete a value."),
    Entry("pub", "values", "pub", CHANGE, "Publish a value, once or at a rate.", takes_minus=True),
    Entry("param", "param", "app", CHANGE, "List, set, save and load parameters, within their bounds."),
    Entry("services", "programs", "services", LOOK, "List the services, with what each of their servers says."),
    Entry("call", "programs", "call", CHANGE, "Call a service, and print its answer."),
    Entry("echo", "echo", "echo", LIVE, "Print changes as they are published or stored."),
    Entry("top", "top", "top", LIVE, "Show what is published and served: live tables of keys and services."),
    Entry("hz", "top", "hz", LIVE, "Measure how often paths are published or stored."),
    Entry("bw", "top", "bw", LIVE, "Measure how many bytes are published."),
    Entry("delay", "top", "delay", LIVE, "Measure the time from publishing to receiving."),
    Entry("record", "record", "record", LOG, "Record what is published, and samples, into an MCAP file."),
    Entry("play", "log", "play", LOG, "Publish a recording again, at the recorded pace."),
    Entry("log", "log", "app", LOG, "Look into recordings, and export them."),
    Entry("browse", "browse", "browse", LOG, "Show all keys on a page in the web browser, with a slider for the time."),
    Entry("foxglove", "viewers", "foxglove", LOG, "Show keys live in Foxglove, or play a recording there."),
    Entry("rerun", "viewers", "rerun", LOG, "Show keys live in Rerun, or save them for it."),
    Entry("snapshot", "snapshot", "app", LOG, "Save what a server holds to files, list them, restore them."),
)


def group_of(entries: Sequence[Entry]) -> type[TyperGroup]:
    """Return a group class with these commands: placeholders in lists, the real one when it is called."""
    known = {entry.name: entry for entry in entries}

    # Click shows help from the placeholders and calls `resolve_command` only for the command that was typed: so one
    # module is imported, not twenty.
    class Group(TyperGroup):
        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            for entry in entries:
                self.commands[entry.name] = TyperCommand(entry.name, help=entry.help, rich_help_panel=entry.panel)

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            name, command, rest = super().resolve_command(ctx, args)
            return name, command_of(known[name]) if name in known else command, rest

    return Group


def command_of(entry: Entry) -> Any:
    thing = getattr(import_module(entry.full_module), entry.attribute)
    holder = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich")
    if isinstance(thing, typer.Typer):
        holder.add_typer(thing, name=entry.name, no_args_is_help=True)
        group: Any = typer.main.get_command(holder)
        return group.commands[entry.name]
    # Else -1.5 would be taken for an option; real options still come first.
    settings = {"ignore_unknown_options": True} if entry.takes_minus else {}
    kind = MinusCommand if entry.takes_minus else TyperCommand
    holder.command(entry.name, cls=kind, help=help_text(thing.__doc__ or ""), context_settings=settings)(thing)
    return typer.main.get_command(holder)


class MinusCommand(TyperCommand):
    """Takes values such as -1.5. No value begins with two minus signs, unless it stands behind `--`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        known = {name for parameter in self.params for name in (*parameter.opts, *parameter.secondary_opts)}
        for word in takewhile(lambda each: each != "--", args):
            name = word.partition("=")[0]
            if name.startswith("--") and name not in known and name != "--help":
                close = get_close_matches(name, known, 1, 0.7)
                ctx.fail(f"there is no option {name}" + (f"; did you mean {close[0]}?" if close else ""))
        return super().parse_args(ctx, args)


def help_text(docstring: str) -> str:
    """Return a docstring for a terminal of any width: paragraphs in one line each, indented lines as they are."""
    paragraphs = inspect.cleandoc(docstring).split("\n\n")
    texts = [each if "\n " in each else each.replace("\n", " ") for each in paragraphs]
    return "\n\n".join(texts).replace("Examples:\n", "[bold]Examples:[/bold]\n")


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
