"""The documentation of the facade is that of the core."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

__all__ = ["documented_by"]

Class = TypeVar("Class", bound=type)


def documented_by(core: type) -> Callable[[Class], Class]:
    """Give each method of a class the docstring of the method of the same name of `core`."""

    def decorate(facade: Class) -> Class:
        for name, member in vars(facade).items():
            twin = getattr(core, name, None)
            if callable(member) and not name.startswith("_") and twin is not None and twin.__doc__:
                member.__doc__ = twin.__doc__
        return facade

    return decorate
