"""VALUE on the command line -> what is stored; what was read -> files and previews."""

from __future__ import annotations

import json
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, NoReturn

from reem_async.tools.cli.output import clean, json_text, size_text, typed
from reem_async.tools.cli.running import USAGE, Refused
from reem_async.tools.partfile import PartFile

__all__ = ["FILES", "parse_value", "preview", "save"]


def parse_value(text: str, *, is_text: bool) -> Any:
    """Return the value that VALUE stands for: JSON, `@file.json`, `@file.npy`, `-` for the standard input.

    Raises:
        Refused: It is none of these; exit code 2.
    """
    # Unknown options arrive here as arguments (`takes_minus`), so that -1.5 can be a value: they are refused by hand.
    if text.startswith("-") and text != "-" and not text[1:2].isdigit():
        raise Refused(f"there is no option {text.partition('=')[0]}; text that begins with - goes in '\"...\"'", USAGE)
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
        raise Refused(f"{where} is not UTF-8 text: {error}", USAGE) from None


def _json(text: str, where: str) -> Any:
    def refuse(constant: str) -> NoReturn:
        raise Refused(f"{where} has {constant}, which is not JSON; arrays in an .npy file may hold it", USAGE)

    try:
        return json.loads(text, parse_constant=refuse)
    except ValueError as error:
        shown = text if len(text) <= 40 else text[:39] + "…"
        raise Refused(f"{where}, {shown!r}, is not JSON ({error}); for text add --str", USAGE) from None
    except RecursionError:
        raise Refused(f"{where} is nested too deep", USAGE) from None


def _from_file(path: Path) -> Any:
    if path.suffix == ".json":
        with path.open(encoding="utf-8") as file:
            return _json(_read(file, str(path)), str(path))
    if path.suffix != ".npy":
        raise Refused(f"{path}: @ takes a .json or .npy file", USAGE)
    import numpy as np

    try:
        return np.load(path, allow_pickle=False)
    except OSError:
        raise
    except Exception as error:  # anything may come of what stands at the beginning of the file
        raise Refused(f"{path} is not an .npy file of plain data: {error}") from None


def preview(value: Any, columns: int) -> str:
    """Return a few lines that show an array or bytes: what it is, its range, its corners."""
    import numpy as np

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
    import numpy as np

    numbers = array
    # Only floats have NaN: for others, the mask would cost a pass and a copy for nothing.
    if array.dtype.kind == "f" and not (fine := np.isfinite(array)).all():
        numbers = array[fine]
    others = array.size - numbers.size
    text = f", {others} of {array.size} are NaN or infinite" if others else ""
    if not numbers.size:
        return text
    return f", min {numbers.min()}, max {numbers.max()}, mean {numbers.mean(dtype=np.float64):.6g}" + text


def save(value: Any, path: Path, where: str, *, replace: bool = False) -> str:
    """Write what was read at `where` to a file, whole or not at all; return what to say of it.

    Raises:
        Refused: A file of this kind cannot hold it, or it cannot be written.
        FileExistsError: There is a file of that name, and `replace` is False.
    """
    write = FILES[path.suffix]
    try:
        part = PartFile(path, replace=replace)
        try:
            with part.path.open("wb") as file:
                said = write(value, file, where)
            part.finish()
        finally:
            part.close()
    except FileExistsError:
        raise
    except OSError as error:
        raise Refused(f"{path} cannot be written: {error.strerror or error}") from None
    return f"{path}: {said}"


def _write_npy(value: Any, file: IO[bytes], where: str) -> str:
    import numpy as np

    array = _array(value, where, "npy")
    np.save(file, array, allow_pickle=False)
    return f"{array.dtype}[{','.join(map(str, array.shape))}]"


def _write_npz(value: Any, file: IO[bytes], where: str) -> str:
    import numpy as np

    # By path, so that two arrays of the same key in different dicts do not collide.
    arrays: dict[str, Any] = {}
    others = _collect(value, (), arrays)
    if not arrays:
        raise Refused(f"{where} holds no array; use a .json file")
    # Uncompressed, as numpy.savez writes it: arrays hardly shrink.
    with zipfile.ZipFile(file, "w") as archive:  # numpy's own function takes some names for its arguments
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    left = f"; {others} other values left out" if others else ""
    return f"{len(arrays)} array{'' if len(arrays) == 1 else 's'}{left}"


def _collect(value: Any, path: tuple[str | int, ...], arrays: dict[str, Any]) -> int:
    """Enter the arrays below `value` by their paths; return how many other values there are."""
    import numpy as np

    if isinstance(value, np.ndarray):
        arrays[typed(path) if path else "data"] = value
        return 0
    if isinstance(value, dict):
        return sum([_collect(item, (*path, key), arrays) for key, item in value.items()])
    if isinstance(value, list):
        return sum([_collect(item, (*path, place), arrays) for place, item in enumerate(value)])
    return 1


def _write_json(value: Any, file: IO[bytes], where: str) -> str:
    text = json_text(value, pretty=True).encode() + b"\n"
    file.write(text)
    return size_text(len(text))


def _write_png(value: Any, file: IO[bytes], where: str) -> str:
    import numpy as np

    try:
        from PIL import Image
    except ModuleNotFoundError:
        raise Refused("png needs pillow: pip install pillow; or use an .npy file") from None
    array = _array(value, where, "png")
    # Pillow takes grey pictures as two axes only.
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if array.dtype == bool:
        array = array.astype(np.uint8) * 255
    grey = array.ndim == 2 and array.dtype in (np.uint8, np.uint16)
    colour = array.ndim == 3 and array.shape[2] in (3, 4) and array.dtype == np.uint8
    if not (grey or colour) or not array.size:
        raise Refused(
            f"{where} is {array.dtype}[{','.join(map(str, array.shape))}]; png takes uint8 with 1, 3 or 4 channels, "
            "uint16 with one, or bool; use an .npy file"
        )
    Image.fromarray(array).save(file, "PNG")
    return f"{array.shape[1]} x {array.shape[0]}" + (", taken as RGB" if colour else "")


def _write_bytes(value: Any, file: IO[bytes], where: str) -> str:
    if not isinstance(value, bytes):
        raise Refused(f"{where} is of type {type(value).__name__}; .bin takes bytes")
    file.write(value)
    return f"{len(value)} bytes"


def _array(value: Any, where: str, kind: str) -> Any:
    import numpy as np

    if isinstance(value, np.ndarray):
        return value
    raise Refused(
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
