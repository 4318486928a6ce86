"""`reem snapshot`: save what a server holds to files, list them, restore them."""

from __future__ import annotations

import asyncio
import re
import sys
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from ...connection import RedisInterface
from ...errors import BadData, RedisError, ReemError
from .. import snapshots
from ..snapshots import Progress, RdbUnavailable, Snapshot, described
from ..snapshots.files import SUFFIXES, is_automatic, is_dated, new_name, sniff
from .commands import help_text
from .options import AsJson, Force, Match, existing, with_server
from .output import clean, columns, counted, emit, emit_json, note, progress_bar, size_text, styled
from .running import FAILED, for_users, run_local

app = typer.Typer(rich_markup_mode="rich", help="Save what a server holds to files, list them, restore them.")

_ORIGIN = ("kind", "server", "namespace", "match")
# Seconds of each unit.
_UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}


def period(text: str) -> float:
    """Return seconds from `90`, `30s`, `10m`, `1.5h` or `1d`; at least one."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smhd]?)", text.strip())
    seconds = float(found[1]) * _UNITS[found[2]] if found else 0.0
    if not 1.0 <= seconds <= 366 * 86400.0:
        raise typer.BadParameter(f"{text!r} is no period of a second to a year; write it like 30s, 10m, 1.5h or 1d")
    return seconds


@with_server("snapshot save")
def save(
    interface: RedisInterface,
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE", show_default=False, help="The file; named by time without it.")
    ] = None,
    directory: Annotated[
        Path | None, typer.Option("--directory", "-d", metavar="DIR", show_default="here", help="Where to make it.")
    ] = None,
    match: Match = "*",
    rdb: Annotated[
        bool, typer.Option("--rdb", help="An RDB file of all that the server holds; a portable file if there is none.")
    ] = False,
    every: Annotated[
        float | None, typer.Option("--every", metavar="PERIOD", parser=period, help="Go on: 30s, 10m, 1.5h or 1d.")
    ] = None,
    keep: Annotated[
        int | None, typer.Option("--keep", min=1, metavar="N", help="Delete all but the newest N saved with --keep.")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> Coroutine[Any, Any, int]:
    """Save the keys of REEM to a file, or all of the server with --rdb.

    A portable snapshot is a zip file of documents and arrays. Each key in it is of one instant. It only needs the
    right to read. Keys and arrays that cannot be read are left out and named, and the exit code is 1.

    Examples:
      reem snapshot save before.zip
      reem snapshot save --match 'arm*' arm.zip
      reem snapshot save -d /var/backups --every 10m --keep 24
      reem snapshot save --rdb -d /var/backups
    """
    if file is not None and (directory is not None or every is not None or keep is not None):
        raise typer.BadParameter(
            "FILE cannot be combined with --directory, --every or --keep, which name files by time"
        )
    if rdb and match != "*":
        raise typer.BadParameter("--rdb saves all of the server: leave out --match")
    # A file that is named by time has a name that is free.
    overwrite = force and file is not None
    saver = _Saver(interface, file, directory or Path(), match, rdb, keep, overwrite, as_json)
    return saver.once() if every is None else saver.by_period(every)


@dataclass
class _Saver:
    interface: RedisInterface
    file: Path | None
    directory: Path
    match: str
    rdb: bool
    keep: int | None
    overwrite: bool
    as_json: bool

    async def once(self) -> int:
        """Take one, delete what is too old, print a line; return the exit code."""
        started = time.monotonic()
        it = await self._saved()
        gone: list[Path] = []
        failure: OSError | None = None
        # Only when the new one is complete and on the disk are old ones deleted: they may have what it lacks.
        if self.keep is not None and not it.unsaved:
            try:
                gone = await asyncio.to_thread(prune, it, self.keep)
            except OSError as error:
                failure = error
        self._tell(it, gone, time.monotonic() - started)
        if failure:
            note(f"reem snapshot save: saved, but an older one could not be deleted: {for_users(failure)}")
        return FAILED if failure or it.unsaved else 0

    def _tell(self, it: Snapshot, gone: Sequence[Path], seconds: float) -> None:
        if self.as_json:
            done = {"seconds": seconds, "deleted": [str(path) for path in gone]}
            emit_json({**facts(it), "doubt": it.doubt, **done})
            return
        deleted = f", deleted {', '.join(path.name for path in gone)}" if gone else ""
        emit(f"{styled(clean(str(it.path)), 'cyan')}: {content(it)}, {seconds:.2f} s{clean(deleted)}")
        sys.stdout.flush()
        for place, why in it.unsaved.items():
            note(f"Not saved: {place}: {why}")
        if it.doubt:
            note(f"The snapshot may not be complete: {it.doubt}.")

    async def by_period(self, every: float) -> int:
        """Take one each `every` seconds; what goes wrong after the first is said, and the next is tried."""
        start, turn = time.monotonic(), 0
        try:
            while True:
                try:
                    await self.once()
                except BrokenPipeError:  # the reader of the output has ended
                    raise
                except (ReemError, RedisError, OSError) as error:
                    # If the first one fails, the user is still there to mend it; later ones are tried again by
                    # themselves.
                    if not turn:
                        raise
                    note(f"reem snapshot save: not saved, next try in due time: {for_users(error)}")
                # By the clock of the first one, so that the times do not drift; turns that a long save has missed are
                # left out.
                turn = max(turn + 1, int((time.monotonic() - start) / every))
                await asyncio.sleep(start + turn * every - time.monotonic())
        except asyncio.CancelledError:
            note("Stopped; what is listed above is complete.")
            return 0

    async def _saved(self) -> Snapshot:
        if self.rdb:
            try:
                return await snapshots.save_rdb(self.interface, self._path("rdb"), overwrite=self.overwrite)
            except RdbUnavailable as error:
                note(f"No RDB file: {for_users(error)}. A portable snapshot, of the keys of REEM, is taken instead.")
        with _progress(shown=not self.as_json) as progress:
            return await snapshots.save(
                self.interface, self._path("portable"), self.match, overwrite=self.overwrite, progress=progress
            )

    def _path(self, kind: str) -> Path:
        return self.file or new_name(self.directory, kind, time.time(), auto=self.keep is not None)


def prune(newest: Snapshot, keep: int) -> list[Path]:
    """Delete the oldest snapshots saved with --keep until so many are left, the newest among them; return them.

    Only files beside the newest, of its kind, server, namespace and pattern. The times of the files tell their age.
    """
    others = [path for path in newest.path.parent.iterdir() if path != newest.path and _is_alike(path, newest)]
    others.sort(key=lambda path: path.stat().st_mtime_ns)
    gone = others[: max(0, len(others) + 1 - keep)]
    for path in gone:
        path.unlink(missing_ok=True)
    return gone


def _is_alike(path: Path, newest: Snapshot) -> bool:
    with suppress(BadData, OSError):  # a file of another program
        it = described(path) if is_automatic(path) else None
        return it is not None and all(getattr(it, name) == getattr(newest, name) for name in _ORIGIN)
    return False


def list_(
    path: Annotated[
        Path, typer.Argument(metavar="PATH", callback=existing, show_default="here", help="A directory, or a snapshot.")
    ] = Path(),
    as_json: AsJson = False,
) -> None:
    """List the snapshots in a directory, oldest first, or the keys in one.

    Exit code 1 if the index of one is damaged. Restoring checks the rest.

    Examples:
      reem snapshot list
      reem snapshot list before.zip
    """
    run_local("snapshot list", lambda: listed(path, as_json))


@with_server("snapshot restore")
async def restore(
    interface: RedisInterface,
    file: Annotated[Path, typer.Argument(metavar="FILE", callback=existing, help="A portable snapshot.")],
    match: Match = "*",
    replace: Annotated[bool, typer.Option("--replace", help="Keys that are there may be replaced.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write the keys of a snapshot to a server, and tell their subscribers.

    The file is checked first, and whether keys are in the way: then nothing is changed. Keys that the
    snapshot does not hold are left alone. An RDB file cannot be restored into a running server; use
    `reem up --from FILE`, which also shows a portable snapshot beside the live server.

    Examples:
      reem snapshot restore before.zip
      reem snapshot restore --replace --match 'arm*' before.zip
      reem snapshot restore --namespace old: before.zip
    """
    with _progress(shown=not as_json) as progress:
        done = await snapshots.restore(interface, file, match, replace=replace, progress=progress)
    if as_json:
        emit_json({"path": str(file), "restored": list(done.names), "size": done.size})
        return
    emit(f"{counted(len(done.names), 'key')} restored, {size_text(done.size)}")
    saved, now = (await snapshots.describe(file)).namespace, interface.namespace
    if saved != now:
        note(f"They were saved under the namespace {saved!r} and are now under {now!r} (--namespace).")


@contextmanager
def _progress(*, shown: bool) -> Iterator[Callable[[Progress], None] | None]:
    with progress_bar(after=0.0) as bar:
        yield (lambda progress: bar(progress.doing)(progress.done, progress.total)) if shown else None


for _name, _command in (("save", save), ("list", list_), ("restore", restore)):
    app.command(_name, help=help_text(_command.__doc__ or ""))(_command)


def listed(path: Path, as_json: bool) -> int:
    if path.is_file():
        _show_keys(described(path), as_json)
        return 0
    found: list[Snapshot] = []
    damaged: dict[str, str] = {}
    for file in _candidates(path):
        try:
            found.append(described(file))
        except (BadData, OSError) as error:
            damaged[str(file)] = for_users(error)
    found.sort(key=lambda it: (it.time, it.path.name))
    _show_files(found, damaged, path, as_json)
    return FAILED if damaged else 0


def _candidates(directory: Path) -> Iterator[Path]:
    """Yield the files that are snapshots by name and first bytes, or by a name that only snapshots have."""
    for file in sorted(directory.iterdir()):
        if file.suffix not in SUFFIXES.values() or not file.is_file():
            continue
        try:
            sniff(file)
        except (BadData, OSError):
            if not is_dated(file):  # a zip file of another program
                continue
        yield file


def _show_files(found: list[Snapshot], damaged: dict[str, str], directory: Path, as_json: bool) -> None:
    if as_json:
        for it in found:
            emit_json(facts(it))
        for name, error in damaged.items():
            emit_json({"path": name, "damaged": error})
        return
    rows = [
        [clean(it.path.name), it.kind, _when(it), size_text(it.size), "" if it.count is None else str(it.count)]
        for it in found
    ]
    heads = ("name", "kind", "taken", "size", "keys") if rows else ()
    columns(rows, ["cyan", "", "", "", ""], frozenset({3, 4}), heads=heads)
    if not rows and not damaged:
        note(clean(f"No snapshots in {directory.resolve()}; `reem snapshot save` makes one."))
    for error in damaged.values():
        note(f"damaged: {error}")


def _show_keys(it: Snapshot, as_json: bool) -> None:
    if as_json:
        names = ("place", "type", "size")
        keys = [
            {"key": key.name, "size": key.size, "values": [dict(zip(names, each, strict=True)) for each in key.values]}
            for key in it.keys
        ]
        emit_json({**facts(it), "keys": keys})
        return
    emit(f"{styled(clean(str(it.path)), 'cyan')}: {content(it)}, taken {_when(it)} at {clean(it.server) or 'unknown'}")
    arrays = [f"{counted(len(key.values), 'array')} or other values of ships" if key.values else "" for key in it.keys]
    rows = [[clean(key.name), size_text(key.size), more] for key, more in zip(it.keys, arrays, strict=True)]
    columns(rows, ["cyan", "", "dim"], frozenset({1}))
    for place, why in it.unsaved.items():
        note(clean(f"not saved: {place}: {why}"))


def facts(it: Snapshot) -> dict[str, Any]:
    names = ("kind", "time", "size", "count", "server", "namespace")
    return {"path": str(it.path), **{name: getattr(it, name) for name in names}, "unsaved": dict(it.unsaved)}


def _when(it: Snapshot) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(it.time))


def content(it: Snapshot) -> str:
    return ("" if it.count is None else f"{counted(it.count, 'key')}, ") + size_text(it.size)
