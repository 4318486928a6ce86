"""Recordings of what is published; see `reem_async.tools.recording`, whose names these are."""

from .tools.recording import *  # noqa: F403
from .tools.recording import __all__ as __all__
