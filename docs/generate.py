"""The pages of the reference that are made from the program itself: the API, the command line, the errors.

`conf.py` calls `write_all` before each build. The files are not kept in the repository.
"""

from __future__ import annotations

import importlib
import inspect
import re
import textwrap
from pathlib import Path
from typing import Any

from sphinx.ext.napoleon import Config, GoogleDocstring

FOLDER = Path(__file__).parent / "reference" / "generated"

API = {
    "connection": (
        "Connection",
        ("reem:RedisInterface", "reem:StateChange", "reem:NodeInfo", "reem:NodeEvent", "reem:timeout"),
    ),
    "store": ("Store", ("reem:KeyValueStore", "reem.accessor:Accessor")),
    "publish": (
        "Publish and follow",
        (
            "reem:PublishSpace",
            "reem:Update",
            "reem:SilentSubscriber",
            "reem:CallbackSubscriber",
            "reem.mirror:Mirror",
            "reem:Newest",
            "reem:Last",
            "reem:Every",
            "reem:Unreadable",
            "reem_async.monitor:Monitor",
        ),
    ),
    "recording": (
        "Recordings",
        ("reem.recording:Recorder", "reem.recording:open_log", "reem.recording:Log", "reem.recording:Replayer"),
    ),
    "server": (
        "Servers and snapshots",
        ("reem.server:EmbeddedServer", "reem.server:EmbeddedCluster", "reem.snapshots:save", "reem.snapshots:restore"),
    ),
    "ships": ("Custom types", ("reem:SpecialDatatypeShip", "reem:NumpyShip", "reem:BytesShip", "reem:BlobShip")),
}
"""Page: its title, and what is on it, as `module:name` of the blocking front."""

OTHER_FRONT = {
    "reem.accessor:Accessor": "reem_async.store.accessor:Accessor",
    "reem.mirror:Mirror": "reem_async.pubsub.mirror:Mirror",
}
_NAPOLEON = Config(napoleon_use_ivar=True, napoleon_use_rtype=False)


def _find(address: str) -> Any:
    module, _, name = address.partition(":")
    return getattr(importlib.import_module(module), name)


def _other(address: str) -> Any:
    """The same name in the asyncio front, or None."""
    try:
        return _find(OTHER_FRONT.get(address, address.replace("reem", "reem_async", 1)))
    except (AttributeError, ImportError):
        return None


def restructured(docstring: str) -> str:
    """A docstring in Google style, as reStructuredText; what is in backticks is code, all else is plain text."""
    # Sections and their items are Napoleon's. Plain text must not be markup: `*`, `|` and a trailing `_` are escaped.
    parts = re.split(r"(`[^`]+`)", docstring)
    plain = [re.sub(r"[*|\\]|(?<=\w)_\b", r"\\\g<0>", part) for part in parts[::2]]
    code = [f"`{part}`" for part in parts[1::2]]
    text = "".join(one + two for one, two in zip(plain, [*code, ""], strict=True))
    # An indented example below a sentence is a block of code.
    text = re.sub(r"(?m)^(?P<before>\S.*[^:\n])\n\n(?P<block>(?: {4}.+\n?)+)", _literal, text)
    return str(GoogleDocstring(text, _NAPOLEON))


def _literal(found: re.Match[str]) -> str:
    block = re.sub(r"\\([*|_\\])", r"\1", found["block"])
    return f"{found['before']}\n\n.. code-block:: python\n\n{block}\n"


def _arguments(function: Any) -> str:
    """The parameters without types, which the docstring explains."""
    shown = []
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return "()"
    before = None
    for each in parameters:
        if each.name == "self":
            continue
        if before is not None and before.kind is each.POSITIONAL_ONLY and each.kind is not each.POSITIONAL_ONLY:
            shown.append("/")
        if each.kind is each.KEYWORD_ONLY and not any(s.startswith("*") for s in shown):
            shown.append("*")
        name = {each.VAR_POSITIONAL: "*", each.VAR_KEYWORD: "**"}.get(each.kind, "") + each.name
        default = repr(each.default)
        if each.default is not each.empty:
            name += "=..." if default.startswith("<") else f"={default}"
        shown.append(name)
        before = each
    return f"({', '.join(shown)})"


def _members(kind: type) -> list[str]:
    """Public names, in the order of their definition; those of a base class come last."""
    names: dict[str, None] = {}
    for each in kind.__mro__:
        if each.__module__.partition(".")[0] in ("reem", "reem_async"):
            names.update(dict.fromkeys(name for name in vars(each) if not name.startswith("_")))
    return list(names)


def _awaited(function: Any) -> bool:
    return inspect.iscoroutinefunction(inspect.unwrap(function))


def _indented(text: str, by: int = 3) -> str:
    return textwrap.indent(text.rstrip() + "\n", " " * by)


def _entry(address: str) -> str:
    """One class or function, in both fronts."""
    ours, theirs = _find(address), _other(address)
    if not inspect.isclass(ours):
        return _signature("function", ours.__name__, ours, theirs)
    doc = inspect.getdoc(ours) or ""
    start = "" if ours.__init__ is object.__init__ else _arguments(ours.__init__)
    modules = "reem and reem_async" if theirs is not None else ours.__module__
    text = f"{ours.__name__}\n{'-' * len(ours.__name__)}\n\n"
    text += f".. py:class:: {ours.__name__}{start}\n\n   From {modules}.\n\n{_indented(restructured(doc))}\n"
    for name in _members(ours):
        attribute = inspect.getattr_static(ours, name)
        if isinstance(attribute, property):
            text += f"   .. py:property:: {name}\n\n{_indented(restructured(inspect.getdoc(attribute) or ''), 6)}\n"
        elif inspect.isroutine(getattr(ours, name)):  # other attributes are in the docstring of the class
            text += _indented(_signature("method", name, getattr(ours, name), getattr(theirs, name, None)))
    return text


def _signature(kind: str, name: str, ours: Any, theirs: Any) -> str:
    """One function: a line for each front, the docstring once."""
    doc = inspect.getdoc(ours) or inspect.getdoc(theirs) or ""
    awaited = theirs is not None and _awaited(theirs)
    text = f".. py:{kind}:: {name}{_arguments(ours)}\n"
    note = "asyncio: ``await`` the call." if awaited and not inspect.iscoroutinefunction(ours) else ""
    return text + "\n" + _indented(f"{restructured(doc)}\n\n{note}") + "\n"


def api_page(title: str, addresses: tuple[str, ...]) -> str:
    """One page of the API."""
    head = f"{title}\n{'=' * len(title)}\n\n"
    return head + "\n".join(_entry(address) for address in addresses)


def command_page() -> str:
    """The command line, from its own help."""
    import typer

    from reem_async.tools.cli import build

    root = typer.main.get_command(build())
    lines = [
        "# Command line",
        "",
        "This page is written from the help texts of the program. `reem COMMAND --help` prints the same.",
        "",
        "Exit codes: 0 done, 1 failed, 2 usage error (or the file exists; use `--force`), 3 not found, 4 timed out.",
        "",
    ]
    context = root.make_context("reem", [], resilient_parsing=True)
    for name in root.list_commands(context):
        _, command, _ = root.resolve_command(context, [name])
        lines += _command(command, f"reem {name}", context)
    return "\n".join(lines) + "\n"


def _command(command: Any, title: str, parent: Any) -> list[str]:
    context = command.make_context(title, [], parent=parent, resilient_parsing=True)
    usage = " ".join(command.collect_usage_pieces(context))
    lines = [f"## {title}", "", "```text", f"{title} {usage}", "```", ""]
    lines += [*_help_text(command.help or ""), ""]
    rows = [_option(each, context) for each in command.params]
    rows = [row for row in rows if row and row[0] not in ("`-h`, `--help`", "`--help`, `-h`")]
    if rows:
        lines += ["| | |", "|---|---|", *(f"| {name} | {text} |" for name, text in rows), ""]
    if hasattr(command, "list_commands"):
        for name in command.list_commands(context):
            lines += _command(command.get_command(context, name), f"{title} {name}", context)
    return lines


def _help_text(text: str) -> list[str]:
    """Paragraphs as Markdown; indented lines are examples."""
    lines, within = [], False
    for line in inspect.cleandoc(re.sub(r"\[/?bold\]", "", text)).splitlines():
        indented = line.startswith("  ")
        if indented and not within:
            lines += ["", "```text"]
        if within and not indented:
            lines += ["```", ""]
        within = indented
        lines.append(line if indented else re.sub(r"([*_<>\[\]])(?![^`]*`[^`]*$)", r"\\\1", line))
    return [*lines, "```"] if within else lines


def _option(each: Any, context: Any) -> tuple[str, str] | None:
    if getattr(each, "hidden", False):
        return None
    names = (
        each.opts + each.secondary_opts
        if each.param_type_name == "option"
        else [each.metavar or (each.name or "").upper()]
    )
    shown = ", ".join(f"`{name}`" for name in names)
    text = " ".join((getattr(each, "help", "") or "").split()).replace("|", "\\|").replace("*", "\\*")
    default = each.get_default(context, call=False)
    if default not in (None, False, True, (), [], "") and not callable(default):
        text += f" Default: `{default}`."
    return shown, text


def write_all(folder: Path = FOLDER) -> None:
    """Write every generated page."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, (title, addresses) in API.items():
        (folder / f"api-{name}.rst").write_text(api_page(title, addresses), encoding="utf-8")
    (folder / "command-line.md").write_text(command_page(), encoding="utf-8")


if __name__ == "__main__":
    write_all()
