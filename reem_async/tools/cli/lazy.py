"""Commands that are imported when they are called: `reem --help` needs none of them."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from itertools import takewhile
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from reem_async.tools.cli.commands import Entry

__all__ = ["command_of", "group_of", "help_text"]


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
    """Import a command; return what parses and runs it."""
    thing = getattr(import_module(entry.full_module), entry.attribute)
    holder = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich")
    if isinstance(thing, typer.Typer):
        holder.add_typer(thing, name=entry.name, no_args_is_help=True)
        group: Any = typer.main.get_command(holder)
        return group.commands[entry.name]
    # Else -1.5 would be taken for an option; real options still come first.
    settings = {"ignore_unknown_options": True} if entry.takes_minus else {}
    kind = _MinusCommand if entry.takes_minus else TyperCommand
    holder.command(entry.name, cls=kind, help=help_text(thing.__doc__ or ""), context_settings=settings)(thing)
    return typer.main.get_command(holder)


class _MinusCommand(TyperCommand):
    """Takes values such as -1.5. No value begins with two minus signs, unless it stands behind `--`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        known = {name for parameter in self.params for name in (*parameter.opts, *parameter.secondary_opts)}
        for word in takewhile(lambda each: each != "--", args):
            name = word.partition("=")[0]
            if name.startswith("--") and name not in known and name != "--help":
                close = get_close_matches(name, known, 1)
                ctx.fail(f"there is no option {name}" + (f"; did you mean {close[0]}?" if close else ""))
        return super().parse_args(ctx, args)


def help_text(docstring: str) -> str:
    """Return a docstring for a terminal of any width: paragraphs in one line each, indented lines as they are."""
    paragraphs = inspect.cleandoc(docstring).split("\n\n")
    texts = [each if "\n " in each else each.replace("\n", " ") for each in paragraphs]
    return "\n\n".join(texts).replace("Examples:\n", "[bold]Examples:[/bold]\n")
