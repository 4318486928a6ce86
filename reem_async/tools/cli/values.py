"""`reem get`, `set`, `del` and `pub`: one value, printed, stored, or in a file."""

from __future__ import annotations

import asyncio
import json
import sys
import time
import zipfile
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import suppress
from pathlib import Path
from typing import IO, Annotated, Any, NoReturn

import numpy as np
import typer

from ...connection import RedisInterface
from ...errors import BadKey, MissingKey, ReemError, WrongKind
from ...plan.paths import parse, show
from ...plan.raw import LARGEST, fetched
from ...plan.trees import walk
from ...store.accessor import Accessor
from ...store.catalog import Outline, outline
from ...store.document import DocumentReader
from ...store.store import KeyValueStore, PublishSpace
from ..partfile import PartFile, there_already
from .listing import as_data
from .options import DEFAULT_URL, Force, Namespace, Output, PathArgument, Publish, Text, Url, Value, with_server
from .output import clean, counted, emit, is_terminal, json_text, note, size_text, typed, width
from .raw import raw_at
from .running import NOTHING, USAGE, CommandFailed, guarded, run

_MOST_FOR_PREVIEW = 256_000_000
"""Bytes of an array that is fetched only to show its corners."""

# Hz, with --count and no --rate.
_RATE = 1.0


def get(
    path: PathArgument,
    output: Output = None,
    force: Force = False,
    raw: Annotated[bool, typer.Option("--raw", "-r", help="Print text as it is, without quotes.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="One line: arrays as lists, bytes in base64, NaN by name, times in ISO 8601.")
    ] = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Print a value, or write it to a file.

    Plain values are printed as JSON. An array is shown as its type and range with its first and last
    numbers; inside a dict, arrays are named and not fetched. Keys of programs without REEM are printed as the
    JSON, text or bytes that they hold.

    Exit code 3 if nothing is there.

    Examples:
        reem get foo.bar.subkey
        reem get robot.joints[0]     an element of a list or of an array
        reem get robot.name --raw
        reem get cam.image -o image.png
        reem get pose --json | jq .x
    """
    if raw and (as_json or output):
        raise typer.BadParameter("--raw goes neither with --json nor with -o")
    with guarded("get"):
        check_output(output, force=force)

    async def work(interface: RedisInterface) -> None:
        store = KeyValueStore(interface)
        # First what it is, without arrays: then what is too large to be shown is not fetched.
        try:
            node = await outline(interface, store.at(path).full_path)
        except (MissingKey, WrongKind, BadKey) as missing:
            item = await _item(interface, path, missing)
            if output is not None:
                note(save(item, output, path, replace=force))
            elif as_json:
                emit(json_text(item))
            elif isinstance(item, np.ndarray | bytes):
                emit(preview(item, width() if is_terminal() else 100))
            else:
                emit(_text(item) if raw and isinstance(item, str) else json_text(item, pretty=True))
            return
        if output is not None:
            note(save(await store.get(path), output, path, replace=force))
            return
        if not as_json:
            emit(await _shown(lambda: store.get(path), node, raw=raw))
            return
        emit(json_text(await store.get(path)))

    run("get", work, url, namespace)


async def _item(interface: RedisInterface, text: str, missing: ReemError) -> Any:
    """Return what a path leads to in an array, or in a key of another program; raises `missing` if in none."""
    if (raw := await raw_at(interface, text)) is not None:
        return fetched(text, raw[1], LARGEST)
    if not isinstance(missing, MissingKey):
        raise missing
    path = parse(text)
    for end in range(len(path) - 1, 0, -1):
        if not isinstance(path[end], int):
            break
        with suppress(MissingKey):
            if (await outline(interface, path[:end])).kind != "numpy":
                break
            array = await DocumentReader(interface.session, path[0]).read(path[1:end])
            try:
                return array[path[end:]]
            except IndexError as error:
                raise CommandFailed(f"{show(path)}: {error}", NOTHING) from None
    raise missing


def _text(text: str) -> str:
    return "\n".join(map(clean, text.split("\n"))) if is_terminal() else text


async def _shown(fetch: Callable[[], Awaitable[Any]], node: Outline, *, raw: bool) -> str:
    # For scripts: the text as it is, without quotes. A terminal is not sent what it would obey.
    if raw and node.kind == "str":
        return _text(str(node.value))
    if node.plain or node.kind in ("dict", "list"):
        return json_text(as_data(node), pretty=True)
    if node.size > _MOST_FOR_PREVIEW:
        return f"{clean(node.summary)}, {size_text(node.size)}; too large to fetch only to show it: use -o FILE"
    return preview(await fetch(), width() if is_terminal() else 100)


@with_server("set")
def set_(
    interface: RedisInterface, path: PathArgument, value: Value, is_text: Text = False, publish: Publish = False
) -> Coroutine[Any, Any, None]:
    """Store a value.

    The dict that holds it must be there: for foo.bar there must be a foo. Subscribers are only
    notified at once with --publish.

    Examples:
        reem set speed 0.5
        reem set robot '{"name": "left", "joints": [0, 0.5, 1]}'
        reem set robot.name right --str
        reem set robot.joints[0] -1.5 --publish
        reem set map @map.npy
        jq .config robot.json | reem set config -
    """
    return _place(interface, path, publish).write(parse_value(value, is_text=is_text))


@with_server("del")
async def delete(interface: RedisInterface, path: PathArgument, publish: Publish = False) -> None:
    """Delete a value, with all that is below it.

    Exit code 3 if nothing is there.

    Examples:
        reem del robot.name
        reem del robot.joints[-1] --publish
        reem del robot
    """
    await _place(interface, path, publish).delete()


def _place(interface: RedisInterface, path: str, publish: bool) -> Accessor:
    return (PublishSpace if publish else KeyValueStore)(interface).at(path)


@with_server("pub")
def pub(
    interface: RedisInterface,
    path: PathArgument,
    value: Value,
    rate: Annotated[
        float | None, typer.Option("--rate", "-r", min=0.001, max=100_000, metavar="HZ", help="So often, until Ctrl-C.")
    ] = None,
    count: Annotated[
        int | None, typer.Option("--count", "-n", min=1, metavar="N", help="So many times; at 1 Hz if no --rate.")
    ] = None,
    is_text: Text = False,
) -> Coroutine[Any, Any, None]:
    """Publish a value, once or at a rate.

    Stores it as `reem set` does, and notifies subscribers. At a rate, late updates are not made up for. The last
    line shows how many there were, and the rate that was reached.

    Examples:
        reem pub set_point '{"speed": 0.5}'
        reem pub set_point.speed 0.5 --rate 100
        reem pub beep true --rate 2 --count 10
        reem pub map @map.npy
    """
    place, parsed = PublishSpace(interface).at(path), parse_value(value, is_text=is_text)
    if rate is None and count is None:
        return place.write(parsed)
    until = "" if count else " until Ctrl-C"
    return _repeat(place, parsed, rate or _RATE, count, f"publishing {path} at {rate or _RATE:g} Hz{until}")


async def _repeat(place: Accessor, value: Any, rate: float, count: int | None, said: str) -> None:
    """Publish `count` times, or until Ctrl-C; `said` is printed once the first one was taken."""
    start, done = time.monotonic(), 0
    due = start
    try:
        while done != count:
            await place.write(value)
            done += 1
            if done == 1:
                note(said)
            if done == count:
                break
            # By the plan and not from now on, so that the rate is kept however long each call takes.
            due += 1 / rate
            now = time.monotonic()
            due = now if now > due + 1 / rate else due  # more than one behind: go on from here
            await asyncio.sleep(max(due - now, 0))
    except asyncio.CancelledError:  # Ctrl-C
        pass
    seconds = time.monotonic() - start
    reached = f", {(done - 1) / seconds:.1f} Hz" if done > 1 and seconds > 0 else ""
    note(f"published {done} times in {seconds:.1f} s{reached}")


def parse_value(text: str, *, is_text: bool) -> Any:
    """Return the value that VALUE means: JSON, `@file.json`, `@file.npy`, `-` for the standard input."""
    # Unknown options arrive here as arguments (`takes_minus`), so that -1.5 can be a value: they are refused by hand.
    if text.startswith("-") and text != "-" and not text[1:2].isdigit():
        raise CommandFailed(
            f"there is no option {text.partition('=')[0]}; text that begins with - goes in '\"...\"'", USAGE
        )
    if is_text:
        return _read(sys.stdin, "the standard input").removesuffix("\n") if text == "-" else text
    if text == "-":
        return _json(_read(sys.stdin, "the standard input"), "the standard input")
    if text.startswith("@"):
        return _from_file(Path(text[1:]))
    return _json(text, "VALUE")


def _read(file: IO[str], where: str) -> str:
    try:
        return file.read()
    except UnicodeDecodeError as error:
        raise CommandFailed(f"{where} is not UTF-8 text: {error}", USAGE) from None


def _json(text: str, where: str) -> Any:
    def refuse(constant: str) -> NoReturn:
        raise CommandFailed(f"{where} has {constant}, which is not JSON; arrays in an .npy file may hold it", USAGE)

    try:
        return json.loads(text, parse_constant=refuse)
    except ValueError as error:
        shown = text if len(text) <= 40 else text[:39] + "…"
        raise CommandFailed(f"{where}, {shown!r}, is not JSON ({error}); for text add --str", USAGE) from None
    except RecursionError:
        raise CommandFailed(f"{where} is nested too deep", USAGE) from None


def _from_file(path: Path) -> Any:
    if path.suffix == ".json":
        with path.open(encoding="utf-8") as file:
            return _json(_read(file, str(path)), str(path))
    if path.suffix != ".npy":
        raise CommandFailed(f"{path}: @ takes a .json or .npy file", USAGE)
    try:
        return np.load(path, allow_pickle=False)
    except OSError:
        raise
    except Exception as error:  # anything may come of what stands at the beginning of the file
        raise CommandFailed(f"{path} is not an .npy file of plain data: {error}") from None


def preview(value: Any, columns: int) -> str:
    """Return a few lines that show an array or bytes: what it is, its range, its corners."""
    if isinstance(value, bytes):
        return f"{len(value)} bytes\n{value[:64]!r}{'…' if len(value) > 64 else ''}"
    if not isinstance(value, np.ndarray):
        return clean(repr(value))
    first = f"{value.dtype}[{','.join(map(str, value.shape))}], {size_text(value.nbytes)}"
    if value.size and value.dtype.kind in "biuf":
        first += _range(value)
    body = np.array2string(
        value, threshold=60, edgeitems=3 if value.ndim < 3 else 1, max_line_width=columns, separator=" "
    )
    return "\n".join(map(clean, f"{first}\n{body}".split("\n")))


def _range(array: Any) -> str:
    """Return least, greatest and mean of the finite numbers of an array, and how many others there are."""
    numbers = array
    # Only floats have NaN: for others, the mask would cost a pass and a copy for nothing.
    if array.dtype.kind == "f" and not (fine := np.isfinite(array)).all():
        numbers = array[fine]
    others = array.size - numbers.size
    text = f", {others} of {array.size} are NaN or infinite" if others else ""
    if not numbers.size:
        return text
    return f", min {numbers.min()}, max {numbers.max()}, mean {numbers.mean(dtype=np.float64):.6g}" + text


def check_output(output: Path | None, *, force: bool) -> None:
    """Raise an error if a value cannot be written to a file of this name."""
    if output is not None and output.suffix not in FILES:
        raise CommandFailed(f"{output}: the name of a file ends in one of {', '.join(FILES)}", USAGE)
    if output is not None and output.exists() and not force:
        raise there_already(output)


def save(value: Any, path: Path, where: str, *, replace: bool = False) -> str:
    """Write what was read at `where` to a file, whole or not at all; return what to say of it."""
    write = FILES[path.suffix]
    try:
        with PartFile(path, replace=replace) as part, part.path.open("wb") as file:
            said = write(value, file, where)
    except FileExistsError:
        raise
    except OSError as error:
        raise CommandFailed(f"{path} cannot be written: {error.strerror or error}") from None
    return f"{path}: {said}"


def _write_npy(value: Any, file: IO[bytes], where: str) -> str:
    array = _array(value, where, "npy")
    np.save(file, array, allow_pickle=False)
    return f"{array.dtype}[{','.join(map(str, array.shape))}]"


def _write_npz(value: Any, file: IO[bytes], where: str) -> str:
    # By path, so that two arrays of the same key in different dicts do not collide.
    leaves = [(path, leaf) for path, leaf in walk(value, ()) if not isinstance(leaf, dict | list)]
    arrays = {typed(path) if path else "data": leaf for path, leaf in leaves if isinstance(leaf, np.ndarray)}
    others = len(leaves) - len(arrays)
    if not arrays:
        raise CommandFailed(f"{where} holds no array; use a .json file")
    # Uncompressed, as numpy.savez writes it: arrays hardly shrink.
    with zipfile.ZipFile(file, "w") as archive:  # numpy's own function takes some names for its arguments
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    left = f"; {others} other values left out" if others else ""
    return f"{counted(len(arrays), 'array')}{left}"


def _write_json(value: Any, file: IO[bytes], where: str) -> str:
    text = json_text(value, pretty=True).encode() + b"\n"
    file.write(text)
    return size_text(len(text))


def _write_png(value: Any, file: IO[bytes], where: str) -> str:
    try:
        from PIL import Image
    except ModuleNotFoundError:
        raise CommandFailed("png needs pillow: pip install pillow; or use an .npy file") from None
    array = _array(value, where, "png")
    # Pillow takes grey pictures as two axes only.
    picture = array[:, :, 0] if array.ndim == 3 and array.shape[2] == 1 else array
    try:
        if array.dtype not in (np.uint8, np.uint16, np.bool_):
            raise TypeError
        Image.fromarray(picture).save(file, "PNG")
    except (TypeError, ValueError, OSError, SystemError):
        raise CommandFailed(
            f"{where} is {array.dtype}[{','.join(map(str, array.shape))}]; png takes uint8 with 1, 3 or 4 channels, "
            "uint16 with one, or bool; use an .npy file"
        ) from None
    return f"{picture.shape[1]} x {picture.shape[0]}" + (", taken as RGB" if picture.ndim == 3 else "")


def _write_bytes(value: Any, file: IO[bytes], where: str) -> str:
    if not isinstance(value, bytes):
        raise CommandFailed(f"{where} is of type {type(value).__name__}; .bin takes bytes")
    file.write(value)
    return f"{len(value)} bytes"


def _array(value: Any, where: str, kind: str) -> Any:
    if isinstance(value, np.ndarray):
        return value
    raise CommandFailed(
        f"{where} is of type {type(value).__name__}; {kind} takes an array: give its path, or use .npz or .json"
    )


FILES: dict[str, Callable[[Any, IO[bytes], str], str]] = {
    ".npy": _write_npy,
    ".npz": _write_npz,
    ".json": _write_json,
    ".png": _write_png,
    ".bin": _write_bytes,
}

"""What values can be written to, by the end of the name; each function says what it wrote."""
