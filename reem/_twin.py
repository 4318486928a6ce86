"""The documentation of the facade is that of the core."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

Class = TypeVar("Class", bound=type)


def for_plain_code(text: str) -> str:
    """Return a docstring of the core in the words of plain code: its loops and blocks wait by themselves."""
    words = (("an async iterator", "an iterator"), ("async ", ""), ("await ", ""), ("reem_async", "reem"))
    for of_asyncio, plain in words:
        text = text.replace(of_asyncio, plain)
    return text


def documented_by(core: type) -> Callable[[Class], Class]:
    """Give each method of a class the docstring of the method of the same name of `core`.

    The class gets what its own docstring lacks: all of a text of which it is the beginning, or the arguments.
    """

    def decorate(facade: Class) -> Class:
        own, whole = facade.__doc__ or "", for_plain_code(core.__doc__ or "")
        if whole.startswith(own):
            facade.__doc__ = whole
        elif "Args:" in whole and "Args:" not in own:
            before = whole[: whole.index("Args:")]
            facade.__doc__ = own.rstrip() + whole[len(before.rstrip()) :]
        for name, member in vars(facade).items():
            twin = getattr(core, name, None)
            # Properties keep their own text: theirs is one line, and has no word of asyncio.
            if callable(member) and not name.startswith("_") and twin is not None and twin.__doc__:
                member.__doc__ = for_plain_code(twin.__doc__)
        return facade

    return decorate
