"""Past trees as outlines: what is where, without reading arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...plan.paths import Path
from ...ships.numpy import NumpyShip
from ...store.catalog import Outline
from .stored import Stored

__all__ = ["outlined"]


def outlined(tree: Any, path: Path) -> Outline:
    """Return the outline of a tree at the full `path`."""
    kind = type(tree)
    if kind is dict or kind is list:
        pairs = tree.items() if kind is dict else enumerate(tree)
        children = tuple([outlined(item, (*path, key)) for key, item in pairs])
        return Outline(path, kind.__name__, "", None, sum([child.size for child in children]), children)
    if kind is Stored:
        return Outline(path, tree.label, tree.summary, None, tree.size)
    if kind is np.ndarray:
        size, summary = NumpyShip().describe(tree)
        return Outline(path, "numpy", summary, None, size)
    size = len(tree.encode()) if kind is str else 8
    return Outline(path, kind.__name__, "", tree, size)
