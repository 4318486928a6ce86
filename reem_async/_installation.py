"""Detect PyPI's `reem`, the original REEM, beside this one: both distributions own the folder `reem`."""

from __future__ import annotations

import os

CURE = "pip uninstall -y reem reem-async && pip install reem-async"


def original_reem(folder: str | None = None) -> str:
    """Return what is wrong if the original is installed in the same folder as this package, else ""."""
    folder = folder or os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    try:
        # A listing takes 0.1 ms. importlib.metadata would add 10 ms to the start of every program.
        names = os.listdir(folder)
    except OSError:  # imported from a zip file
        return ""
    versions = [name[5:].removesuffix(".dist-info") for name in names if name.startswith("reem-") and "-info" in name]
    return f"the original reem {versions[0]} is installed beside reem-async: their files are mixed" if versions else ""
