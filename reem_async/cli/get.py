"""`reem get`: print a value, or write it to a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from reem_async.cli.options import DEFAULT_URL, Namespace, PathArgument, Url
from reem_async.cli.output import clean, emit, is_terminal, json_text, note, size_text, typed, width
from reem_async.cli.running import Refused, run
from reem_async.cli.values import FILES

if TYPE_CHECKING:
    from reem_async.accessor import Accessor
    from reem_async.catalog import Outline
    from reem_async.connection import RedisInterface

__all__ = ["get"]

_MOST_AS_TEXT = 200_000
"""Bytes of arrays that are printed as JSON: one of uint8 is up to four of text."""

_MOST_FOR_PREVIEW = 256_000_000
"""Bytes of an array that is fetched only to show its corners."""


def get(
    path: PathArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Write it to a file: .npy an array, .npz all arrays below, .json all, .png an image, .bin bytes.",
        ),
    ] = None,
    raw: Annotated[bool, typer.Option("--raw", "-r", help="Print text as it is, without quotes.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON in one line, arrays as nested lists, bytes in base64.")
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
        reem get robot.joints[0]
        reem get robot.name --raw
        reem get cam.image -o image.png
        reem get pose --json | jq .x
    """
    if raw and (as_json or output):
        raise typer.BadParameter("--raw goes neither with --json nor with -o")
    if output is not None and output.suffix not in FILES:
        raise typer.BadParameter(f"{output}: the name of a file ends in one of {', '.join(FILES)}")

    async def work(interface: RedisInterface) -> None:
        from reem_async.catalog import outline
        from reem_async.cli.values import save
        from reem_async.store import KeyValueStore

        place = KeyValueStore(interface).at(path)
        if output is not None:
            note(save(await place.read(), output, path))
            return
        node = await outline(interface, place.full_path)
        if not as_json:
            emit(await _shown(place, node, raw=raw))
            return
        _check_size(node)
        emit(json_text(await place.read()))

    run("get", work, url, namespace)


async def _shown(place: Accessor, node: Outline, *, raw: bool) -> str:
    """Return a value for people; fetches it only if it is one array."""
    from reem_async.cli.outlines import as_data, is_plain
    from reem_async.cli.values import preview

    if raw and node.kind == "str":
        text = str(node.value)
        return "\n".join(map(clean, text.split("\n"))) if is_terminal() else text
    if is_plain(node) or node.kind in ("dict", "list"):
        return json_text(as_data(node), pretty=True)
    if node.size > _MOST_FOR_PREVIEW:
        return f"{clean(node.summary)}, {size_text(node.size)}; too large to fetch only to show it: use -o FILE"
    return preview(await place.read(), width() if is_terminal() else 100)


def _check_size(node: Outline) -> None:
    from reem_async.cli.outlines import below_arrays

    size = below_arrays(node)
    if size > _MOST_AS_TEXT:
        raise Refused(
            f"{typed(node.path)} has {size_text(size)} of arrays, too much to print as JSON; write it to a file: "
            f"reem get '{typed(node.path)}' -o FILE.npz, or .json"
        )
