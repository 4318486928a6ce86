"""What exists only for programs of REEM 0.0.x and 0.1.x.

`reem.marshalling`, `reem.convenience`, `reem.accessors` and `reem.utilities` re-export from here what stood in the
modules of these names; `reem` and `reem.connection` look here for an old name that they are asked for. Nothing else of
REEM uses this module, and a program that leaves the old names alone never imports it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from reem_async.errors import BadKey, BadType, MissingKey, PathRefused
from reem_async.plan.paths import Path
from reem_async.plan.trees import copied
from reem_async.plan.writes import make_parents
from reem_async.pubsub.subscribers import LocalAccessor
from reem_async.ships import NumpyShip, SpecialDatatypeShip
from reem_async.store.document import DocumentWriter
from reem_async.store.store import _NOTHING
from reem_async.store.store import KeyValueStore as CoreStore

from .accessor import Accessor, PublishAccessor, Publisher
from .store import KeyValueStore

__all__ = [
    "ROOT_PATH", "ROOT_VALUE_SEQUENCE", "SEPARATOR_CHARACTER", "ActiveSubscriberKeyAccessor", "KeyAccessor",
    "NumpyMarshaller", "PublishWriter",
    "SpecialDatatypeMarshaller", "TolerantKVSVar", "TolerantKVSVarSubkey", "TolerantKeyValueStore",
    "WriteOnlyKeyAccessor", "append_to_path", "check_valid_key_name", "check_valid_key_name_ext",
    "copy_dictionary_without_paths", "extract_object", "filter_paths_by_prefix", "insert_into_dictionary",
    "key_sequence_to_path", "key_sequence_to_path_ext", "path_to_key_sequence",
]  # fmt: skip

# --- other names of what there still is

SpecialDatatypeMarshaller = SpecialDatatypeShip  # its `delete` is not needed any more, and ignored
NumpyMarshaller = NumpyShip
KeyAccessor = Accessor
WriteOnlyKeyAccessor = PublishAccessor
ActiveSubscriberKeyAccessor = LocalAccessor
PublishWriter = Publisher

# --- the tolerant store of 0.1.3

Keys = str | Sequence[str | int]
"""A dotted path, or its keys and indexes."""


class _TolerantWriter(DocumentWriter):
    """Creates the parents of what it writes where they are missing."""

    async def set(self, path: Path, value: Any) -> None:
        """Store `value` at `path`; a second try, after making its parents, if they are missing."""
        try:
            await super().set(path, value)
        except PathRefused:
            await self.session.run(make_parents(self.keys, path))
            await super().set(path, value)

    async def put_absent(self, path: Path, value: Any, why: MissingKey) -> None:
        """Store `value` at `path` if nothing is there; a second try, after making its parents, if they are missing."""
        try:
            await super().put_absent(path, value, why)
        except PathRefused:
            await self.session.run(make_parents(self.keys, path))
            await super().put_absent(path, value, why)


class _TolerantCore(CoreStore):
    _writer = _TolerantWriter


class TolerantKeyValueStore(KeyValueStore):
    """A store whose writes create missing parents, and that takes "a.b" or ["a", "b"] as a key.

    Args:
        interface: As for `KeyValueStore`.
        refreshRate: Seconds for which what `var` gives keeps a value that it read; 0 reads each time.
        options: As for `KeyValueStore`.
    """

    _kind = _TolerantCore

    def __init__(self, interface: Any = None, refreshRate: float = 0, **options: Any) -> None:  # noqa: N803
        super().__init__(interface, **options)
        self.defaultVarRefreshRate = refreshRate

    def __getitem__(self, key: Keys) -> Accessor:
        # Dots lead down here, as in 0.1.3; the plain store takes such a text for one key.
        if isinstance(key, str):
            return self.at(key)
        if not isinstance(key, list | tuple):
            raise BadType(f"{key!r} ({type(key).__name__}) is no path; write 'foo.bar' or ['foo', 'bar']")
        if not key:
            raise BadKey(f"{key!r} names no key; give at least a top-level key")
        accessor = super().__getitem__(key[0])  # which refuses an index
        for element in key[1:]:
            accessor = accessor[element]
        return accessor

    def get(self, path: Keys, default: Any = _NOTHING) -> Any:
        """Return the value at a path, or `default` if given and nothing is there.

        Raises:
            MissingKey: Nothing is there, though the top-level key is, and no default was given.
        """
        return self[path].read() if default is _NOTHING else self[path].get(default)

    def set(self, path: Keys, value: Any) -> None:
        """Store `value` at a path, creating the dicts on the way that are missing."""
        self[path].write(value)

    def contains(self, key: Keys) -> bool:
        """Return whether something is at a path; also `path in store`. Costs as `get`."""
        # A default that cannot have been stored.
        return self.get(key, self) is not self

    def pop(self, key: Keys, *default: Any) -> Any:
        """Remove what is at a path and return it; raises and costs as `Accessor.pop`."""
        return self.interface._run(self[key]._core._take(*default))

    def update(self, values: Any = (), /, **more: Any) -> None:
        """Store each of `values`, and of the named ones, at its path, one after the other; all are looked at first."""
        every = [(self[path], value) for path, value in dict(values, **more).items()]
        for accessor, value in every:
            self.interface._run(accessor._core._writer.check(value))
        for accessor, value in every:
            accessor.write(value)

    def setdefault(self, key: Keys, default: Any = None) -> Any:
        """Return what is at a path; where nothing is, store `default` first."""
        return self.interface._run(self[key]._core._read_or_put(default))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.interface, self.defaultVarRefreshRate)

    def var(self, path: Keys, refreshRate: float | None = None) -> TolerantKVSVar:  # noqa: N803
        """Return a variable for one place, which may keep what it reads for `refreshRate` seconds."""
        return TolerantKVSVar(self, path, self.defaultVarRefreshRate if refreshRate is None else refreshRate)


def _changing(change: Callable[..., object]) -> Callable[[Any, Any], TolerantKVSVar]:
    """Return a method of a variable for an augmented assignment."""
    return lambda self, value: self._do(lambda: change(self.node, value))


class TolerantKVSVar:
    """A variable for one place of a store: `get`, `set`, `[]`, `del`, `type`, `len`, `+=` and so on, `append`.

    What it reads it keeps for `refreshRate` seconds, for itself and for all that is made from it by `[]`; a write
    through any of them is sent at once, and the next read asks the server again.

    Args:
        server: The store.
        path: The place.
        refreshRate: Seconds.
    """

    def __init__(self, server: TolerantKeyValueStore, path: Keys, refreshRate: float = 0) -> None:  # noqa: N803
        self.server = server
        self.node: Accessor = server[path]
        self.path: list[str | int] = list(self.node.full_path)
        self.refreshRate = refreshRate
        # The variable that keeps the value, and this place in it.
        self._keeper, self._below = self, list[str | int]()
        # The value, and until when on the monotonic clock it is taken for the server's.
        self._kept: tuple[Any, float] | None = None

    def get(self) -> Any:
        """Return the value, as kept or as the server has it; raises as `Accessor.read`."""
        # A copy: what is kept answers later calls as well, whatever the caller does to its copy.
        return copied(self._current())

    def _current(self) -> Any:
        if not self.refreshRate:
            return self.node.read()
        # The whole variable is read at once, and answers for all its places until its time is over.
        keeper = self._keeper
        if keeper._kept is None or time.monotonic() >= keeper._kept[1]:
            keeper._kept = keeper.node.read(), time.monotonic() + self.refreshRate
        try:
            return extract_object(keeper._kept[0], self._below)
        except (LookupError, TypeError):
            raise MissingKey(f"nothing is stored at {'.'.join(map(str, self.path))}") from None

    def set(self, value: Any) -> None:
        """Store a value, creating the dicts on the way that are missing."""
        if isinstance(value, TolerantKVSVar):
            if value.path == self.path and value.server is self.server:
                return  # the end of `var[key] += n`: Python assigns the variable to itself
            value = value.get()
        self._do(lambda: self.node.write(value))

    def _do(self, change: Callable[[], object]) -> TolerantKVSVar:
        try:
            change()
        # Also when it failed: it may have been applied.
        finally:
            self._keeper._kept = None
        return self

    def __getitem__(self, key: str | int) -> TolerantKVSVar:
        inner = TolerantKVSVar(self.server, [*self.path, key], self.refreshRate)
        inner._keeper, inner._below = self._keeper, [*self._below, key]
        return inner

    def __setitem__(self, key: str | int, value: Any) -> None:
        self[key].set(value)

    def __delitem__(self, key: str | int) -> None:
        self._do(self.node[key].delete)

    # Python would otherwise go through `[0]`, `[1]`, ... as old sequences are, with a round trip for each, without an
    # end.
    __iter__ = None
    __contains__ = None

    def type(self) -> type:
        """Return the type of the value."""
        return type(self._current()) if self.refreshRate else self.node.type()

    def __len__(self) -> int:
        return len(self._current()) if self.refreshRate else len(self.node)

    __iadd__, __isub__ = _changing(Accessor.add), _changing(Accessor.decrement)
    __imul__, __itruediv__ = _changing(Accessor.multiply), _changing(Accessor.divide)

    def append(self, value: Any) -> None:
        """Append to the list that is the value."""
        self._do(lambda: self.node.append(value))

    def __str__(self) -> str:
        return f"{'.'.join(map(str, self.path))}={self.get()}"


TolerantKVSVarSubkey = TolerantKVSVar


# --- paths as text, and nested dicts

SEPARATOR_CHARACTER = "&&&&"
ROOT_VALUE_SEQUENCE = "%%%%"
ROOT_PATH = "."
_NOT_IN_NAMES = ("*", ".", SEPARATOR_CHARACTER)


def path_to_key_sequence(path: str) -> list[str]:
    """Return the keys of a path such as ".a.b"."""
    return path.removeprefix(ROOT_PATH).split(".") if path != ROOT_PATH else []


def key_sequence_to_path(sequence: Iterable[str]) -> str:
    """Return the path of keys."""
    return ROOT_PATH + ".".join(sequence)


def key_sequence_to_path_ext(sequence: Iterable[str | int]) -> str:
    """Return the path of keys and list indexes, such as ".a[2].b"."""
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in sequence) or ROOT_PATH


def append_to_path(existing: str, addition: str) -> str:
    """Return the path of a key below a path."""
    return f"{existing.removesuffix('.')}.{addition}"


def check_valid_key_name(name: object) -> bool:
    """Return whether REEM 0.1 would have taken `name` as a key; this one takes nearly any text."""
    return isinstance(name, str) and not any(part in name for part in _NOT_IN_NAMES)


def check_valid_key_name_ext(name: object) -> bool:
    """Return the same of a key or list index."""
    return isinstance(name, int) or check_valid_key_name(name)


def extract_object(dictionary: Any, key_sequence: Iterable[str | int]) -> Any:
    """Return what is in nested dicts at the place that keys lead to; raises KeyError."""
    for key in key_sequence:
        dictionary = dictionary[key]
    return dictionary


def insert_into_dictionary(dictionary: dict[str, Any], key_sequence: Sequence[str], value: Any) -> None:
    """Put a value into nested dicts, making those that are missing."""
    for key in key_sequence[:-1]:
        dictionary = dictionary.setdefault(key, {})
    dictionary[key_sequence[-1]] = value


def copy_dictionary_without_paths(dictionary: dict[str, Any], key_sequence: Iterable[Sequence[str]]) -> dict[str, Any]:
    """Return a copy of nested dicts without what is at the places that sequences of keys lead to."""
    without = [tuple(keys) for keys in key_sequence]
    return {
        key: copy_dictionary_without_paths(item, [keys[1:] for keys in without if keys[0] == key])
        if isinstance(item, dict)
        else item
        for key, item in dictionary.items()
        if (key,) not in without
    }


def filter_paths_by_prefix(paths: Iterable[str], prefix: str) -> tuple[list[str], list[str]]:
    """Return the paths that begin with `prefix`, and what follows it in each."""
    found = [path for path in paths if prefix == ROOT_PATH or path.startswith(prefix)]
    return found, [path if prefix == ROOT_PATH else path.removeprefix(prefix) for path in found]
