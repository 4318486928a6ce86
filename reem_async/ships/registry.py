"""The ships of one interface, in the order in which they are asked."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from typing import Any

from ..errors import BadData, BadType
from ..plan import Command
from ..plan.placeholders import INLINE_LABELS
from .base import BlobShip, BytesShip, SpecialDatatypeShip
from .images import ImageShip, JpegShip, PngShip
from .numpy import NumpyShip

# In the place of the key in the command that a ship records; no real key begins with a zero byte.
_STAND_IN = "\0the key\0"
_METHODS = ("check_fit", "write", "read", "interpret_read", "get_label")
_JSON_TYPES = frozenset({str, int, float, bool, type(None)})
_SAMPLES: tuple[Any, ...] = (
    *("", "text", 0, 1, 0.0, 0.5, False, True, None),
    *([], [0], [0.5] * 100, ["text"], [[0.5]], (), (0,), (0.5,) * 3, {}, {"a": 0}, {"a": {"b": [0.5]}}),
)
"""Values to test whether a ship takes values of JSON's types."""


def default_ships() -> list[SpecialDatatypeShip]:
    return [NumpyShip(), BytesShip(), JpegShip(), PngShip()]


_OWN = (NumpyShip, BytesShip, JpegShip, PngShip)


def _is_plain_blob(ship: BlobShip) -> bool:
    kind = type(ship)
    # A subclass that overrides these has its own commands, and is handled like any other ship.
    plain = all(getattr(kind, name) is getattr(BlobShip, name) for name in ("write", "read", "interpret_read"))
    return plain and not inspect.iscoroutinefunction(kind.unpack)


class Registered:
    """A ship with its label and the command that reads, found out once."""

    __slots__ = ("_read", "blob", "carries", "describes_exactly", "label", "ship")

    def __init__(self, ship: SpecialDatatypeShip, label: str, read: Command) -> None:
        if not isinstance(label, str) or not label or label in INLINE_LABELS:
            raise BadType(
                f"get_label() of {type(ship).__name__} gave {label!r}; return a name other than text and float"
            )
        self.ship = ship
        self.label = label
        self._read = read
        self.carries: type | None = getattr(ship, "carries", None)
        self.blob: BlobShip | None = ship if isinstance(ship, BlobShip) and _is_plain_blob(ship) else None
        # Ships of users may compress, or leave the size out.
        self.describes_exactly = type(ship) in _OWN

    def describe(self, value: Any) -> tuple[int, str]:
        describe = getattr(self.ship, "describe", None)
        return describe(value) if describe else (0, type(value).__name__)

    def read_command(self, key: str) -> Command:
        return tuple([word.replace(_STAND_IN, key) if isinstance(word, str) else word for word in self._read])


class Ships:
    """Chooses ships for values, the first that fits, and finds them by label."""

    def __init__(self, ships: Iterable[SpecialDatatypeShip], new_recorder: Callable[[], Any]) -> None:
        self.given = list(ships)
        self.new_recorder = new_recorder  # makes an object with redis-py's command methods and a list `commands`
        methods = [getattr(ship, name, None) for ship in self.given for name in _METHODS]
        self.asynchronous = any(map(inspect.iscoroutinefunction, methods))
        self._registered: list[Registered] = []
        self._by_label: dict[str, Registered] = {}
        self._raw: Ships | None = None
        self.claimed: frozenset[type] = frozenset()  # JSON types of which a ship takes some values
        self.asks_first = bool(self.given)  # whether there are such types, or the ships were not asked yet
        # Ships that have to be awaited cannot be asked here; `ready` is called before the first call that needs them.
        if not self.asynchronous:
            with suppress(StopIteration):  # which says that it is done: it waits for nothing
                self.ready().send(None)

    @property
    def raw(self) -> Ships:
        """The same ships, but with pictures as `Jpeg` and `Png`, not decoded; itself if it has none for them."""
        if self._raw is None:
            ships = [ship.raw if isinstance(ship, ImageShip) else ship for ship in self.given]
            self._raw = Ships(ships, self.new_recorder) if ships != self.given else self
        return self._raw

    async def ready(self) -> None:
        """Ask the ships for their labels and read commands; does nothing the second time."""
        # Not a flag: several tasks may run this at once, and the list is complete only at the end.
        if len(self._registered) == len(self.given):
            return
        found: list[Registered] = []
        claimed: set[type] = set()
        for ship in self.given:
            claimed.update(await _claims(ship))
            recorder = self.new_recorder()
            await _settled(ship.read(_STAND_IN, recorder))
            found.append(Registered(ship, await _settled(ship.get_label()), _only(recorder.commands, ship)))
        # Another task may have done the same in between: its equal result is replaced.
        self._registered, self._by_label = found, {}
        self.claimed, self.asks_first = frozenset(claimed), bool(claimed)
        for each in found:  # the first ship with a label reads, as it also writes
            self._by_label.setdefault(each.label, each)

    def fits(self, value: Any) -> Registered | None:
        for each in self._registered:
            if each.ship.check_fit(value):
                return each
        return None

    def carries(self, value: Any) -> Registered | None:
        """Return the ship from which readers get an object of the value's class; none if ships have to be awaited."""
        found = None if self.asynchronous else self.fits(value)
        return None if found is None or type(found.ship) in (NumpyShip, BytesShip) else found

    async def choices(self, value: Any) -> Callable[[Any], Registered | None]:
        """Return `fits` for everything inside `value`, with ships that must be awaited."""
        # By id: values need not be hashable, and equal ones may be of different types.
        chosen: dict[int, Registered | None] = {}
        for leaf in _leaves(value, set(), self.claimed):
            chosen[id(leaf)] = await self._first_fit(leaf)
        return lambda leaf: chosen.get(id(leaf))

    async def _first_fit(self, leaf: Any) -> Registered | None:
        for each in self._registered:
            if await _settled(each.ship.check_fit(leaf)):
                return each
        return None

    def has(self, label: str) -> bool:
        return label in self._by_label

    def labelled(self, label: str, where: str) -> Registered:
        try:
            return self._by_label[label]
        except KeyError:
            raise self.lacks(label, where) from None

    def lacks(self, label: str, where: str) -> BadData:
        known = ", ".join(self._by_label) or "none"
        return BadData(
            f"{where} was written by the ship {label!r}, which this interface lacks (it has: {known}); "
            "read it in a program that has this ship: RedisInterface(ships=[...])"
        )


def _only(commands: Sequence[Command], what: Any) -> Command:
    if len(commands) != 1:
        raise BadType(f"{what!r}: read() must record exactly one command on the client, it recorded {len(commands)}")
    return commands[0]


async def _settled(result: Any) -> Any:
    return await result if inspect.isawaitable(result) else result


async def _claims(ship: SpecialDatatypeShip) -> set[type]:
    """Return the JSON types that the ship names, or takes samples of."""
    found: set[type] = set(getattr(ship, "claims", ()))
    # These take none; asking them would cost each new interface 40 calls.
    for sample in () if type(ship) in _OWN else _SAMPLES:
        with suppress(Exception):  # it may expect other types
            if await _settled(ship.check_fit(sample)):
                found.add(type(sample))
    return found


def _leaves(value: Any, seen: set[int], claimed: frozenset[type]) -> Iterator[Any]:
    """Yield the values inside `value` that may need a ship; circles are refused later."""
    kind = type(value)
    if id(value) in seen:
        return
    if kind in claimed or (kind not in _JSON_TYPES and kind not in (dict, list, tuple)):
        yield value
    if isinstance(value, dict | list | tuple):
        seen.add(id(value))
        for item in value.values() if isinstance(value, dict) else value:
            yield from _leaves(item, seen, claimed)
