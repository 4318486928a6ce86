"""What a recording says of itself: where, when and by whom it was made, and of what."""

from __future__ import annotations

import getpass
import os
import platform
import time
from collections.abc import Sequence

import numpy as np

from ... import __version__
from ...session import Session
from .sample import Sample

__all__ = ["description"]


def description(
    session: Session, patterns: Sequence[str], samples: Sequence[Sample], keyframe: float
) -> dict[str, str]:
    """Return the metadata of a recording that begins now."""
    return {
        "version": __version__,
        "format": "1",
        "server": session.options.address,
        "namespace": session.namespace,
        "host": platform.node(),
        "user": _user(),
        "process": str(os.getpid()),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "began": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "patterns": ", ".join(patterns),
        "samples": ", ".join([str(each) for each in samples]),
        "keyframe": f"{keyframe:g}",
    }


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # nobody knows the name of this user
        return ""
