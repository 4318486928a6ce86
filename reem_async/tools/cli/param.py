"""`reem param`: list parameters, set them within their bounds, save them to a file and load it."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from yaml import AliasToken, SafeLoader, YAMLError, safe_dump, safe_load, scan

from ...connection import RedisInterface
from ...coordination.parameters import StoredParameter, publish, stored_parameters
from ...coordination.specification import Specification, as_json
from ...errors import BadInput
from ...plan.paths import Path as KeyPath
from ...plan.paths import Pattern, parse, parse_patterns, show
from ..partfile import PartFile
from .commands import MinusCommand, help_text
from .options import AsJson, Force, PathArgument, Patterns, existing, with_server
from .output import clean, columns, counted, emit, emit_json, json_text, note, typed
from .running import FAILED, NOTHING, USAGE, CommandFailed

app = typer.Typer(rich_markup_mode="rich", help="List, set, save and load parameters, within their bounds.")

_LARGEST = 1_000_000  # bytes of a file: each parameter takes a line or two

File = Annotated[Path, typer.Argument(metavar="FILE", show_default=False, help="A YAML file.", callback=existing)]


@with_server("param list")
async def list_(interface: RedisInterface, patterns: Patterns = None, as_json: AsJson = False) -> int:
    """List parameters with value, default, range, unit and help.

    Those that programs have declared, also programs that have ended. Where the output is no terminal, tabs separate
    the columns. A stored value that is out of range is ignored by programs: it is named below the table, which has the
    default.

    Exit code 3 if there is none.

    Examples:
        reem param list
        reem param list 'control.*' --json
    """
    found = await _declared(interface, patterns)
    if as_json:
        for it in found:
            emit_json(_facts(it))
    else:
        heads = ("name", "value", "default", "range", "unit", "help") if found else ()
        columns(map(_row, found), ["bold", "cyan", "", "", "", "dim"], shrink=(5, 3, 1, 2, 0), heads=heads)
        for it in found:
            if it.invalid:
                note(it.invalid)
    if not found:
        note("no program has declared a parameter" + (" that is named so" if patterns else ""))
    return 0 if found else NOTHING


@with_server("param get")
async def get(interface: RedisInterface, path: PathArgument) -> None:
    """Print the value of a parameter, the default if none is stored.

    Exit code 3 if no program has declared it, 1 if the stored value is out of range.

    Examples:
        reem param get control.kp
    """
    it = await _one(interface, path)
    if it.invalid:
        raise CommandFailed(f"programs ignore the stored value: {it.invalid}")
    emit(_shown(it.used))


@with_server("param set")
async def set_(
    interface: RedisInterface,
    path: PathArgument,
    value: Annotated[
        str, typer.Argument(metavar="VALUE", help="A number, true, false, a list such as '[1, 2]', or text as it is.")
    ],
) -> None:
    """Publish a value of a parameter.

    A value that is out of range, of another type or not among the choices is refused, and nothing is sent. Exit code 3
    if no program has declared the parameter.

    Examples:
        reem param set control.kp 3.5
        reem param set control.mode track
        reem param set control.offset '[0, -0.5]'
    """
    it = await _one(interface, path)
    checked = it.specification.checked(it.name, _parsed(value, it.specification))
    await publish(interface.session, it.path, checked)


@with_server("param save")
async def save(
    interface: RedisInterface,
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE", show_default=False, help="The file to make; printed without it.")
    ] = None,
    force: Force = False,
) -> int:
    """Save the values of parameters as YAML, with their ranges as comments.

    The default is saved where nothing is stored. Values out of range are left out and named; the exit code is 1 then.

    Examples:
        reem param save tuned.yaml
        reem param save > tuned.yaml
    """
    found = await _declared(interface, None)
    text = "".join(_yaml(it) for it in found if not it.invalid)
    if file is None:
        sys.stdout.write(text)
    else:
        with PartFile(file, replace=force) as part:
            part.path.write_text(text, encoding="utf-8")
    invalid = [it for it in found if it.invalid]
    for it in invalid:
        note(f"not saved: {it.invalid}")
    if file is not None:
        note(f"{file}: {counted(len(found) - len(invalid), 'parameter')}")
    return FAILED if invalid else 0


@with_server("param load")
async def load(
    interface: RedisInterface,
    file: File,
    dry_run: Annotated[bool, typer.Option("--dry-run", "-n", help="Only report what would be changed.")] = False,
) -> None:
    """Publish the values of parameters that a YAML file has.

    All values are checked before the first one is sent: if one of them is not allowed, or names a parameter that no
    program has declared, nothing is changed and the exit code is 2. Each change is printed. Parameters that have the
    value already are left alone.

    Examples:
        reem param load tuned.yaml --dry-run
        reem param load tuned.yaml
    """
    known, _ = await stored_parameters(interface.session)
    changes = [(it, value) for it, value in _checked(_read(file), known, file) if it.value != value]
    for it, value in changes:
        if not dry_run:
            await publish(interface.session, it.path, value)
        before = "(out of range)" if it.invalid else "(none)" if it.value is None else _shown(it.value)
        emit(f"{typed(it.path)}: {before} -> {_shown(value)}")
    note(f"{'would change' if dry_run else 'changed'} {counted(len(changes), 'parameter')}")


async def _declared(interface: RedisInterface, patterns: Sequence[str] | None) -> list[StoredParameter]:
    """Return the parameters that some patterns name, all without one; note entries that are left out."""
    wanted: list[Pattern] = parse_patterns(list(patterns or ["*"]))
    found, refused = await stored_parameters(interface.session)
    for each in refused:
        note(f"left out: {each}")
    return [it for it in found.values() if any(pattern.concerns(it.path) for pattern in wanted)]


async def _one(interface: RedisInterface, text: str) -> StoredParameter:
    path = parse(text)
    found, _ = await stored_parameters(interface.session)
    if path not in found:
        raise CommandFailed(f"no program has declared {show(path)}; list them with: reem param list", NOTHING)
    return found[path]


def _row(it: StoredParameter) -> list[str]:
    value = "" if it.value is None else _shown(it.value)
    specification = it.specification
    texts = (specification.range_text(), specification.unit, specification.help)
    return [typed(it.path), value, _shown(specification.default), *map(clean, texts)]


def _facts(it: StoredParameter) -> dict[str, Any]:
    return {"path": it.name, "value": as_json(it.value), "invalid": it.invalid or None, **it.specification.stored()}


def _shown(value: Any) -> str:
    return clean(value) if isinstance(value, str) else json_text(as_json(value))


def _parsed(text: str, specification: Specification) -> Any:
    """Return what was typed: text as it is for a parameter of that type, else JSON."""
    if specification.type == "str":
        return text
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text  # which is refused, by name and type


def _yaml(it: StoredParameter) -> str:
    specification = it.specification
    about = " ".join(filter(None, [specification.type, specification.range_text(), specification.unit]))
    comment = clean(": ".join(filter(None, [about, specification.help])))
    # A vector in one line. In this style, a mapping with a scalar alone would be in braces.
    flow = None if isinstance(it.used, tuple) else False
    line = safe_dump({it.name: as_json(it.used)}, default_flow_style=flow, allow_unicode=True, width=math.inf)
    return f"# {comment}\n{line}"


def _read(file: Path) -> dict[Any, Any]:
    """Return what a YAML file has, by name; raises CommandFailed."""
    try:
        text = file.read_text(encoding="utf-8") if file.stat().st_size <= _LARGEST else ""
        # An alias can stand for itself many times over: a short file would fill the memory.
        if any(isinstance(token, AliasToken) for token in scan(text, Loader=SafeLoader)):
            raise CommandFailed(f"{file} has aliases (*name); write each value out", USAGE)
        values = safe_load(text)
    except (YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise CommandFailed(f"{file} is not YAML: {error}", USAGE) from None
    if not isinstance(values, dict) or not values:
        raise CommandFailed(f"{file} has no lines such as `control.kp: 2.0`, or over {_LARGEST} bytes", USAGE)
    return values


def _checked(
    values: dict[Any, Any], known: dict[KeyPath, StoredParameter], file: Path
) -> list[tuple[StoredParameter, Any]]:
    """Return the values of a file with their parameters; raises CommandFailed with all that is wrong."""
    checked, wrong = [], []
    for name, value in values.items():
        try:
            it = known.get(parse(name))
            if it is None:
                wrong.append(f"no program has declared {show(parse(name))}")
            else:
                checked.append((it, it.specification.checked(it.name, value)))
        except BadInput as error:
            wrong.append(str(error))
    if wrong:
        raise CommandFailed(f"{file}: nothing was changed: {'; '.join(wrong)}", USAGE)
    return checked


for _name, _command in (("list", list_), ("get", get), ("save", save), ("load", load)):
    app.command(_name, help=help_text(_command.__doc__ or ""))(_command)
_minus: Any = {"cls": MinusCommand, "context_settings": {"ignore_unknown_options": True}}  # for values such as -1.5
app.command("set", help=help_text(set_.__doc__ or ""), **_minus)(set_)
