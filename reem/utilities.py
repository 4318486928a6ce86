"""Where functions on paths and nested dicts were in REEM 0.0.x and 0.1.x."""

from .legacy import *  # noqa: F403
from .legacy import __all__ as __all__
