"""The blocking front repeats nothing of the core: signatures, types and documentation are those of the core's methods.

    read = runs(core.Accessor.read)

is `read` as plain code calls it. The object has the core's in `_core` and its interface in `_interface`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Coroutine
from functools import partial
from operator import attrgetter, methodcaller
from typing import Any, Concatenate, ParamSpec, TypeVar

Class = TypeVar("Class", bound=type)
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Method = Callable[Concatenate[Any, Arguments], Result]
Waiting = Callable[Concatenate[Any, Arguments], Coroutine[Any, Any, Result]]


def for_plain_code(text: str) -> str:
    """Return a docstring of the core in the words of plain code: its loops and blocks wait by themselves."""
    words = (("an async iterator", "an iterator"), ("async ", ""), ("await ", ""), ("reem_async", "reem"))
    for of_asyncio, plain in words:
        text = text.replace(of_asyncio, plain)
    return text


def documented_by(core: type) -> Callable[[Class], Class]:
    """Give each method of a class the docstring of the method of the same name of `core`.

    The class gets that of `core` if its own is the beginning of it.
    """

    def decorate(facade: Class) -> Class:
        own, whole = facade.__doc__ or "", for_plain_code(core.__doc__ or "")
        if whole.startswith(own):
            facade.__doc__ = whole
        for name, member in vars(facade).items():
            twin = getattr(core, name, None)
            # Properties keep their own text: theirs is one line, and has no word of asyncio.
            if callable(member) and not name.startswith("_") and twin is not None and twin.__doc__:
                member.__doc__ = for_plain_code(twin.__doc__)
        return facade

    return decorate


_CORE = attrgetter("_core")
FOLLOWER = methodcaller("_follower")
"""Returns the core's object on the background loop, for a class whose `_core` may be on the calling thread."""


def _forwarded(method: Any, finish: Callable[[Any], Any], inner: Callable[[Any], Any]) -> Any:
    """Return a method that calls that of the core's object, and hands the result to what `finish` returns."""
    name = method.__name__

    @functools.wraps(method)
    def forward(self: Any, /, *args: Any, **options: Any) -> Any:
        return finish(self)(getattr(inner(self), name)(*args, **options))

    forward.__doc__ = for_plain_code(method.__doc__ or "")
    return forward


def runs(method: Waiting[Arguments, Result]) -> Method[Arguments, Result]:
    """Return the blocking form of a coroutine method, which runs on the calling thread."""
    name = method.__name__

    # Written out: reads and writes are called so often that each step counts.
    @functools.wraps(method)
    def forward(self: Any, /, *args: Any, **options: Any) -> Any:
        return self._interface._run(getattr(self._core, name)(*args, **options))

    forward.__doc__ = for_plain_code(method.__doc__ or "")
    return forward


def waits(method: Waiting[Arguments, Result], inner: Callable[[Any], Any] = _CORE) -> Method[Arguments, Result]:
    """Return the blocking form of a coroutine method, which runs on the background loop."""
    return _forwarded(method, attrgetter("_interface._wait"), inner)  # type: ignore[no-any-return]


def ends(method: Waiting[Arguments, None]) -> Method[Arguments, None]:
    """Return what `waits` does, for a method that has nothing left to do once the interface is closed."""
    return _forwarded(method, attrgetter("_interface._end"), _CORE)  # type: ignore[no-any-return]


def calls(method: Method[Arguments, Result], inner: Callable[[Any], Any] = _CORE) -> Method[Arguments, Result]:
    """Return a method that calls that of the core, which does not wait."""
    return _forwarded(method, lambda self: lambda result: result, inner)  # type: ignore[no-any-return]


def makes(
    method: Method[Arguments, Any], wrap: Callable[[Any, Any], Result], inner: Callable[[Any], Any] = _CORE
) -> Method[Arguments, Result]:
    """Return a method that wraps what that of the core returns: `wrap(interface, object of the core)`."""
    return _forwarded(method, lambda self: partial(wrap, self._interface), inner)  # type: ignore[no-any-return]


def shares(attribute: Callable[[Any], Result], inner: Callable[[Any], Any] = _CORE) -> Result:
    """Return a property that is that of the core; its type is that of the value, as for a dataclass's field."""
    get: Any = attribute.fget  # type: ignore[attr-defined]
    return property(lambda self: get(inner(self)), doc=get.__doc__)  # type: ignore[return-value]


def takes(method: Method[Arguments, None]) -> Callable[[Callable[..., None]], Method[Arguments, None]]:
    """Return a decorator for an `__init__` that hands its arguments on to that of the core, whose signature it gets."""
    return functools.wraps(method, assigned=())


def takes_interface(
    method: Callable[Concatenate[Any, Any, Arguments], None],
) -> Callable[[Callable[..., None]], Callable[Concatenate[Any, Any, Arguments], None]]:
    """Return what `takes` does, for an `__init__` whose first argument is the interface of either front."""
    return functools.wraps(method, assigned=())
