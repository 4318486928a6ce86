"""`reem get`: print a value, or write it to a file."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reem_async.tools.cli.options import DEFAULT_URL, Force, Namespace, PathArgument, Url
from reem_async.tools.cli.output import clean, emit, is_terminal, json_text, note, size_text, typed, width
from reem_async.tools.cli.running import NOTHING, Refused, run
from reem_async.tools.cli.values import FILES
from reem_async.tools.partfile import there_already

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface
    from reem_async.errors import MissingKey
    from reem_async.plan.paths import Path
    from reem_async.store.catalog import Outline

__all__ = ["get"]

_MOST_AS_TEXT = 200_000
"""Bytes of arrays that are printed as JSON: one of uint8 is up to four of text."""

_MOST_FOR_PREVIEW = 256_000_000
"""Bytes of an array that is fetched only to show its corners."""


def get(
    path: PathArgument,
    output: Annotated[
        FilePath | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Write it to a file: .npy an array, .npz all arrays below, .json all, .png an image, .bin bytes.",
        ),
    ] = None,
    force: Force = False,
    raw: Annotated[bool, typer.Option("--raw", "-r", help="Print text as it is, without quotes.")] = False,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print JSON in one line: arrays as lists, bytes in base64, NaN by name, times in ISO 8601.",
        ),
    ] = False,
    url: Url = DEFAULT_URL,
    namespace: Namespace = "",
) -> None:
    """Print a value, or write it to a file.

    Plain values are printed as JSON. An array is shown as its type and range with its first and last
    numbers; inside a dict, arrays are named and not fetched.

    Exit code 3 if nothing is there. With --json, not more than 200 kB of arrays; use -o for more.

    Examples:
        reem get foo.bar.subkey
        reem get robot.joints[0]     an element of a list or of an array
        reem get robot.name --raw
        reem get cam.image -o image.png
        reem get pose --json | jq .x
    """
    if raw and (as_json or output):
        raise typer.BadParameter("--raw goes neither with --json nor with -o")
    if output is not None and output.suffix not in FILES:
        raise typer.BadParameter(f"{output}: the name of a file ends in one of {', '.join(FILES)}")

    async def work(interface: RedisInterface) -> None:
        import numpy as np

        from reem_async.errors import MissingKey
        from reem_async.store.catalog import outline
        from reem_async.store.store import KeyValueStore
        from reem_async.tools.cli.values import preview, save

        if output is not None and output.exists() and not force:
            raise there_already(output)
        store = KeyValueStore(interface)
        # First what it is, without arrays: then what is too large to be shown is not fetched.
        try:
            node = await outline(interface, store.at(path).full_path)
        except MissingKey as missing:
            item = await _item(interface, store.at(path).full_path, missing)
            if output is not None:
                note(save(item, output, path, replace=force))
            else:
                shown = isinstance(item, np.ndarray) and not as_json
                emit(preview(item, width() if is_terminal() else 100) if shown else json_text(item))
            return
        if output is not None:
            note(save(await store.get(path), output, path, replace=force))
            return
        if not as_json:
            emit(await _shown(lambda: store.get(path), node, raw=raw))
            return
        _check_size(node)
        emit(json_text(await store.get(path)))

    run("get", work, url, namespace)


async def _item(interface: RedisInterface, path: Path, missing: MissingKey) -> Any:
    """Return the item of an array that a path leads into; raises `missing` if it leads into none."""
    from reem_async.errors import MissingKey
    from reem_async.plan.paths import show
    from reem_async.store.catalog import outline
    from reem_async.store.reader import DocumentReader

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
                raise Refused(f"{show(path)}: {error}", NOTHING) from None
    raise missing


async def _shown(fetch: Callable[[], Awaitable[Any]], node: Outline, *, raw: bool) -> str:
    """Return a value for people; fetches it only if it is one array."""
    from reem_async.tools.cli.outlines import as_data
    from reem_async.tools.cli.values import preview

    # For scripts: the text as it is, without quotes. A terminal is not sent what it would obey.
    if raw and node.kind == "str":
        text = str(node.value)
        return "\n".join(map(clean, text.split("\n"))) if is_terminal() else text
    if node.plain or node.kind in ("dict", "list"):
        return json_text(as_data(node), pretty=True)
    if node.size > _MOST_FOR_PREVIEW:
        return f"{clean(node.summary)}, {size_text(node.size)}; too large to fetch only to show it: use -o FILE"
    return preview(await fetch(), width() if is_terminal() else 100)


def _check_size(node: Outline) -> None:
    from reem_async.tools.cli.outlines import below_arrays

    size = below_arrays(node)
    if size > _MOST_AS_TEXT:
        raise Refused(
            f"{typed(node.path)} has {size_text(size)} of arrays, too much to print as JSON; write it to a file: "
            f"reem get '{typed(node.path)}' -o FILE.npz, or .json"
        )
