"""Arrays as pictures in Jupyter and IPython, once `%load_ext reem` asks for it. Nothing is read for that."""

from __future__ import annotations

import sys
from base64 import b64encode
from contextlib import suppress
from html import escape
from importlib import import_module
from importlib.util import find_spec
from pprint import pformat
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from .browser.pictures import RenderedPicture

__all__ = ["complete_below", "load_ipython_extension", "picture_of", "unload_ipython_extension"]

_LEAST_SIDE = 16
"""Rows and columns: smaller arrays, such as matrices of a pose, are read as numbers."""

_MOST_PICTURES = 4
"""Pictures of one dict: a notebook keeps them in its file."""

_SIDE = 640
"""Pixels of the longer side at most: it is a preview, and a notebook keeps it in its file."""


def load_ipython_extension(shell: Any) -> None:
    """Have notebooks show arrays that can be a picture as one; without Pillow, say that this cannot be."""
    if find_spec("PIL") is None:
        sys.stderr.write("arrays stay numbers: to show them as pictures, pip install 'reem-async[tools]'\n")
        return
    html = shell.display_formatter.formatters["text/html"]
    html.for_type(np.ndarray, picture_of)
    html.for_type(dict, pictures_in)


def unload_ipython_extension(shell: Any) -> None:
    """Have IPython show arrays as numbers again: `%unload_ext reem`."""
    for kind in (np.ndarray, dict):
        shell.display_formatter.formatters["text/html"].pop(kind, None)


def complete_below(*kinds: type) -> None:
    """Have IPython look at `x["foo"]` for what completes `x["foo"]["`, where `x` is of one of these classes.

    It calls `__getitem__` only of classes that it knows to have no effect. Those of stores and handles have none:
    they make a path, and send nothing. A version of IPython that has no such list is left as it is.
    """
    with suppress(ImportError, AttributeError, KeyError):
        policies: Any = import_module("IPython.core.guarded_eval").EVALUATION_POLICIES
        policies["limited"].allowed_getitem.update(kinds)


def picture_of(array: np.ndarray[Any, Any]) -> str | None:
    """Return HTML with a picture of an array, and below it what it is; None if it is no picture.

    Pictures are arrays of numbers or bools, of shape (rows, columns) or (rows, columns, 1, 3 or 4), of at least 16
    rows and columns. Numbers other than uint8 are shown in grey, from the least to the greatest; NaN is magenta.
    """
    from .browser.pictures import paint

    flat = array.ndim == 2 or (array.ndim == 3 and array.shape[2] in (1, 3, 4))
    if not flat or array.dtype.kind not in "biuf" or min(array.shape[:2]) < _LEAST_SIDE:
        return None
    found = paint(array, side=_SIDE)
    return (
        f'<img src="data:image/png;base64,{b64encode(found.file).decode()}" style="image-rendering: pixelated">'
        f"<div>{_caption(array, found)}</div>"
    )


def pictures_in(value: dict[Any, Any]) -> str | None:
    """Return HTML with a dict as text, and below it the first pictures in it; None if there is none."""
    pictures: list[str] = []

    def shown(item: Any, path: str) -> Any:
        if isinstance(item, dict):
            return {key: shown(each, f"{path}[{key!r}]") for key, each in item.items()}
        picture = picture_of(item) if isinstance(item, np.ndarray) and len(pictures) < _MOST_PICTURES else None
        if picture is None:
            return item
        pictures.append(f"<div>{escape(path)}</div>{picture}")
        return _Shape(f"<{item.dtype}{list(item.shape)}>")

    text = pformat(shown(value, ""), width=100, sort_dicts=False)
    return f"<pre>{escape(text)}</pre>{''.join(pictures)}" if pictures else None


class _Shape(str):
    """Stands for an array in a dict; printed without quotes."""

    __slots__ = ()
    __repr__ = str.__str__


def _caption(array: np.ndarray[Any, Any], found: RenderedPicture) -> str:
    shape = ",".join(map(str, array.shape))
    bad = f", {found.bad} of {array.size} are NaN or infinite" if found.bad else ""
    return f"{array.dtype}[{shape}], black is {found.low:.6g}, white is {found.high:.6g}{bad}"
