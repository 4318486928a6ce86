"""`reem snapshot list`, and how the command line writes down what a snapshot is."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reem_async.tools.cli.output import clean, columns, emit, emit_json, is_terminal, note, size_text, styled
from reem_async.tools.cli.running import FAILED, NOTHING, Refused
from reem_async.tools.cli.wording import for_users

if TYPE_CHECKING:
    from reem_async.tools.snapshots import Snapshot

__all__ = ["check_there", "content", "facts", "listed", "number"]


def check_there(path: Path) -> None:
    """Refuse a path at which nothing is."""
    if not path.exists():
        raise Refused(f"{path}: there is no such file", NOTHING)


def listed(path: Path, check: bool, as_json: bool) -> int:
    """Print the snapshots in a directory, or the keys in a file; returns the exit code."""
    check_there(path)
    from reem_async.errors import BadData
    from reem_async.tools.snapshots import described

    if path.is_file():
        _show_keys(described(path, check=check), as_json)
        return 0
    found: list[Snapshot] = []
    damaged: dict[str, str] = {}
    for file in _candidates(path):
        try:
            found.append(described(file, check=check))
        except (BadData, OSError) as error:
            damaged[str(file)] = for_users(error)
    found.sort(key=lambda it: (it.time, it.path.name))
    _show_files(found, damaged, path, as_json)
    return FAILED if damaged else 0


def _candidates(directory: Path) -> Iterator[Path]:
    """Yield the files that are snapshots by name and first bytes, or by a name that only snapshots have."""
    from reem_async.errors import BadData
    from reem_async.tools.snapshots.files import SUFFIXES, dated, sniff

    for file in sorted(directory.iterdir()):
        if file.suffix not in SUFFIXES.values() or not file.is_file():
            continue
        try:
            sniff(file)
        except (BadData, OSError):
            if dated(file) is None:  # somebody else's zip file
                continue
        yield file


def _show_files(found: list[Snapshot], damaged: dict[str, str], directory: Path, as_json: bool) -> None:
    if as_json:
        for it in found:
            emit_json(facts(it))
        for name, error in damaged.items():
            emit_json({"path": name, "damaged": error})
        return
    rows = [[clean(it.path.name), it.kind, _when(it), size_text(it.size), _count(it)] for it in found]
    if rows and is_terminal():
        rows.insert(0, ["name", "kind", "taken", "size", "keys"])
    columns(rows, ["cyan", "", "", "", ""], frozenset({3, 4}))
    if not rows and not damaged:
        note(clean(f"No snapshots in {directory.resolve()}; `reem snapshot save` makes one."))
    for error in damaged.values():
        note(f"damaged: {error}")


def _show_keys(it: Snapshot, as_json: bool) -> None:
    if as_json:
        values = [
            {
                "key": key.name,
                "size": key.size,
                "values": [{"place": place, "type": kind, "size": size} for place, kind, size in key.values],
            }
            for key in it.keys
        ]
        emit_json({**facts(it), "keys": values})
        return
    emit(f"{styled(clean(str(it.path)), 'cyan')}: {content(it)}, taken {_when(it)} at {clean(it.server) or 'unknown'}")
    rows = [[clean(key.name), size_text(key.size), _arrays(len(key.values))] for key in it.keys]
    columns(rows, ["cyan", "", "dim"], frozenset({1}))
    for place, why in it.unsaved.items():
        note(clean(f"not saved: {place}: {why}"))


def _arrays(count: int) -> str:
    return f"{count} array{'s' * (count > 1)} or other values of ships" if count else ""


def facts(it: Snapshot) -> dict[str, Any]:
    """Return what `--json` says of a snapshot."""
    return {
        "path": str(it.path),
        "kind": it.kind,
        "time": it.time,
        "size": it.size,
        "count": it.count,
        "server": it.server,
        "namespace": it.namespace,
        "foreign": it.foreign,
        "foreign_names": it.foreign_names,
        "unsaved": dict(it.unsaved),
    }


def _when(it: Snapshot) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(it.time))


def _count(it: Snapshot) -> str:
    return "" if it.count is None else f"{it.count} of Redis" if it.kind == "rdb" else str(it.count)


def content(it: Snapshot) -> str:
    """Return how many keys a snapshot has, and its size."""
    keys = "" if it.count is None else f"{number(it.count, 'key' if it.kind == 'portable' else 'Redis key')}, "
    return f"{keys}{size_text(it.size)}"


def number(count: int, noun: str) -> str:
    """Return "1 key", "2 keys"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
