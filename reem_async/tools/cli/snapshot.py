"""`reem snapshot`: save what a server holds to files, list them, restore them."""

from __future__ import annotations

import asyncio
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from reem_async.connection import RedisInterface
from reem_async.errors import BadData, RedisError, ReemError
from reem_async.tools import snapshots
from reem_async.tools.cli.commands import help_text
from reem_async.tools.cli.options import DEFAULT_URL, AsJson, Force, Namespace, Url, existing
from reem_async.tools.cli.output import (
    clean,
    columns,
    counted,
    emit,
    emit_json,
    is_terminal,
    note,
    progress_bar,
    size_text,
    styled,
)
from reem_async.tools.cli.running import FAILED, for_users, run, run_local
from reem_async.tools.snapshots import Progress, RdbUnavailable, Snapshot, described
from reem_async.tools.snapshots.files import SUFFIXES, Pruned, is_dated, new_name, prune, sniff

app = typer.Typer(rich_markup_mode="rich", help="Save what a server holds to files, list them, restore them.")

# Seconds of each unit.
_UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}

Match = Annotated[
    str,
    typer.Option(
        "--match", metavar="PATTERN", help="Only the top-level keys that match; * and ? stand for other characters."
    ),
]


def period(text: str) -> float:
    """Return seconds from `90`, `30s`, `10m`, `1.5h` or `1d`; at least one."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smhd]?)", text.strip())
    seconds = float(found[1]) * _UNITS[found[2]] if found else 0.0
    if not 1.0 <= seconds <= 366 * 86400.0:
        raise typer.BadParameter(f"{text!r} is no period of a second to a year; write it like 30s, 10m, 1.5h or 1d")
    return seconds


def save(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", show_default=False, help="The file to make. Without it, one named by time."),
    ] = None,
    directory: Annotated[
        Path | None,
        typer.Option("--directory", "-d", metavar="DIR", show_default="here", help="Where to make one named by time."),
    ] = None,
    match: Match = "*",
    rdb: Annotated[
        bool,
        typer.Option(
            "--rdb",
            help="Have the server save all it holds, foreign keys too, and copy its RDB file; a portable snapshot "
            "where that cannot be had.",
        ),
    ] = False,
    every: Annotated[
        float | None,
        typer.Option(
            "--every", metavar="PERIOD", parser=period, help="Go on until Ctrl-C: one each 30s, 10m, 1.5h or 1d."
        ),
    ] = None,
    keep: Annotated[
        int | None,
        typer.Option(
            "--keep", min=1, metavar="N", help="Leave the newest N, delete older ones that were saved with --keep."
        ),
    ] = None,
    force: Force = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
    as_json: AsJson = False,
) -> None:
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
    saver = _Saver(file, directory or Path(), match, rdb, keep, overwrite, as_json)

    async def work(interface: RedisInterface) -> int:
        return await (saver.once(interface) if every is None else saver.by_period(interface, every))

    run("snapshot save", work, url, namespace, live=every is not None)


@dataclass
class _Saver:
    file: Path | None
    directory: Path
    match: str
    rdb: bool
    keep: int | None
    overwrite: bool
    as_json: bool
    made: list[Path] = field(default_factory=list)
    noted: set[str] = field(default_factory=set)

    async def once(self, interface: RedisInterface, *, bar: bool = True) -> int:
        """Take one, delete what is too old, print a line; return the exit code."""
        started = time.monotonic()
        it = await self._saved(interface, bar)
        # Only when the new one is complete and on the disk are old ones deleted: they may have what it lacks.
        gone, failed = ([], []) if it.unsaved else await asyncio.to_thread(self._pruned, it.path)
        self._tell(it, gone, time.monotonic() - started)
        for error in failed:
            note(f"reem snapshot save: saved, but an older one could not be deleted: {for_users(error)}")
        return FAILED if failed or it.unsaved else 0

    def _tell(self, it: Snapshot, gone: Sequence[Path], seconds: float) -> None:
        if self.as_json:
            done = {"seconds": seconds, "deleted": [str(path) for path in gone]}
            emit_json({**facts(it), "doubt": it.doubt, **done})
            return
        deleted = f", deleted {', '.join(path.name for path in gone)}" if gone else ""
        emit(f"{styled(clean(str(it.path)), 'cyan')}: {content(it)}, {seconds:.2f} s{clean(deleted)}")
        sys.stdout.flush()
        for place, why in it.unsaved.items():
            self._note_once(f"Not saved: {place}: {why}")
        if it.doubt:
            self._note_once(f"The snapshot may not be complete: {it.doubt}.")

    async def by_period(self, interface: RedisInterface, every: float) -> NoReturn:
        """Take one each `every` seconds; what goes wrong after the first is said, and the next is tried."""
        start, turn = time.monotonic(), 0
        try:
            while True:
                try:
                    await self.once(interface, bar=False)
                except BrokenPipeError:  # the reader of the output has ended
                    raise
                except (ReemError, RedisError, OSError) as error:
                    # If the first one fails, the user is still there to mend it; later ones are tried again by
                    # themselves.
                    if not self.made:
                        raise
                    note(f"reem snapshot save: not saved, next try in due time: {for_users(error)}")
                # By the clock of the first one, so that the times do not drift; turns that a long save has missed are
                # left out.
                turn = max(turn + 1, int((time.monotonic() - start) / every))
                await asyncio.sleep(start + turn * every - time.monotonic())
        except asyncio.CancelledError:
            note("Stopped; what is listed above is complete.")
            raise

    async def _saved(self, interface: RedisInterface, bar: bool) -> Snapshot:
        while True:
            try:
                return await self._saved_as(interface, bar)
            except FileExistsError:
                # Of one named by time: another program has begun one in the same second, and this gets the next number.
                if self.file is not None:
                    raise

    async def _saved_as(self, interface: RedisInterface, bar: bool) -> Snapshot:
        if self.rdb:
            try:
                return await snapshots.save_rdb(interface, self._path("rdb"), overwrite=self.overwrite)
            # Said once; the next ones by period try again, since rights may have changed.
            except RdbUnavailable as error:
                self._note_once(
                    f"No RDB file: {for_users(error)}. A portable snapshot, of the keys of REEM, is taken instead."
                )
        with _progress(shown=bar and not self.as_json) as progress:
            return await snapshots.save(
                interface, self._path("portable"), self.match, overwrite=self.overwrite, progress=progress
            )

    def _path(self, kind: str) -> Path:
        return self.file or new_name(self.directory, kind, time.time(), auto=self.keep is not None)

    def _pruned(self, newest: Path) -> Pruned:
        self.made.append(newest)
        # Without --keep nothing is ever deleted, so there is nothing to remember.
        if self.keep is None:
            del self.made[:-1]
            return Pruned([], [])
        done = prune(self.made, self.keep)
        del self.made[: -self.keep]
        return done

    def _note_once(self, text: str) -> None:
        if text not in self.noted:
            self.noted.add(text)
            note(text)


def list_(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="PATH", callback=existing, show_default="here", help="A directory, or one snapshot to look into."
        ),
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


def restore(
    file: Annotated[Path, typer.Argument(metavar="FILE", callback=existing, help="A portable snapshot.")],
    match: Match = "*",
    replace: Annotated[bool, typer.Option("--replace", help="Keys that are there may be replaced.")] = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
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

    async def work(interface: RedisInterface) -> None:
        with _progress(shown=not as_json) as progress:
            done = await snapshots.restore(interface, file, match, replace=replace, progress=progress)
        if as_json:
            emit_json({"path": str(file), "restored": list(done.names), "size": done.size})
            return
        emit(f"{counted(len(done.names), 'key')} restored, {size_text(done.size)}")
        saved = (await snapshots.describe(file)).namespace
        if saved != namespace:
            note(f"They were saved under the namespace {saved!r} and are now under {namespace!r} (--namespace).")

    run("snapshot restore", work, url, namespace)


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
    if rows and is_terminal():
        rows.insert(0, ["name", "kind", "taken", "size", "keys"])
    columns(rows, ["cyan", "", "", "", ""], frozenset({3, 4}))
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
