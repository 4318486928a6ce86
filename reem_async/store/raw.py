"""Keys of other programs: `kvs.raw["sai::sensors::q"]`."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

from ..concurrency.queues import Last, Newest, Policy, chosen
from ..errors import BadKey, BadType
from ..plan.arguments import Handle, cannot_wait
from ..plan.paths import Path, Pattern
from ..plan.raw import LARGEST, RawValue, check_raw_name, fetched, kinds_of, raw_name, read, read_field, write
from ..pubsub.follower import checked_largest
from ..pubsub.raw_watch import RawWatch
from ..session import Session
from ..transport import scanned

_MOST_WAITING = 1000  # updates that wait for a loop that is slower, if no policy is given
_WATCHED = 16 << 20  # bytes of a key that a watch fetches unless another number is given


async def raw_kinds(session: Session, pattern: str = "*") -> AsyncIterator[dict[str, str]]:
    """Yield the keys of other programs that a glob names, with their Redis types, about 1000 at a time.

    Two round trips each. A key may come twice.
    """
    async for page in scanned(session.transport, Pattern(pattern).glob):
        if names := [name for name in map(raw_name, page) if name is not None]:
            yield await session.run(kinds_of(names))


class RawKeys:
    """Keys of programs without REEM, as these wrote them: `kvs.raw["sai::sensors::q"].read()`.

    Names are whole keys of the server: the namespace of the interface does not apply. Only the methods `write` change
    anything. A value is read as JSON if it is JSON, else as text, else as bytes.
    """

    def __init__(self, session: Session) -> None:
        self._session = session

    def __getitem__(self, name: str) -> RawKey:
        return RawKey(self._session, check_raw_name(name))

    __setitem__ = cannot_wait("assignment", "await store.raw[{0!r}].write(value)")

    async def keys(self, pattern: str = "*") -> list[str]:
        """Return the keys that a glob names (`*` and `?` stand for others), sorted, without those of REEM.

        Names that are not UTF-8 are left out. Two round trips for about 1000 keys of the server. Not atomic.

        Raises:
            BadKey: Not a pattern.
        """
        found: dict[str, str] = {}
        async for page in raw_kinds(self._session, check_raw_name(pattern, "pattern")):
            found |= page
        return sorted(found)

    def watch(self, *patterns: str, policy: Policy | None = None, largest: int = _WATCHED) -> RawWatch:
        """Return an async iterator over the changes of all keys that some globs name, those that come and go too.

        Example:
            async for update in kvs.raw.watch("sai::sensors::*"):
                print(update.path, update.value)

        The server names the keys that were changed (CLIENT TRACKING), and they are read then: nothing is polled.
        Several changes within a millisecond may be one update, and the last state always arrives. An update has the
        attributes of `Accessor.watch`'s; `path` is the key, `kind` the Redis type and `size` the bytes. What is there
        comes first (`initial`), of 10,000 keys at most, with a warning where there are more.

        Args:
            patterns: Globs of whole keys, such as "sai::*"; all keys if none. Those of REEM are left out.
            policy: What to keep for a loop that is slower than the updates; `Last(1000)` if not given.
            largest: Bytes that a key may take to be fetched, 16 MB if not given; an `Unfetched` is in the place of a
                larger one.

        Raises:
            BadKey, BadType, BadValue: An argument that cannot be used.
        """
        names = [check_raw_name(pattern, "pattern") for pattern in patterns]
        return RawWatch(self._session, names, chosen(policy, Last(_MOST_WAITING)), checked_largest(largest))


class RawKey(Handle):
    """One key of another program, or one field of a hash: `kvs.raw["battery"]["volts"]`."""

    __slots__ = ("_field", "_name", "_session")
    _how_to_read = "await handle.read()"

    def __init__(self, session: Session, name: str, field: str | None = None) -> None:
        self._session, self._name, self._field = session, name, field

    def __getitem__(self, field: str) -> RawKey:
        if self._field is not None:
            raise BadKey(f"{self._name}: a field of a hash has no fields; read it and index what that gives")
        return RawKey(self._session, self._name, check_raw_name(field, "field"))

    __setitem__ = cannot_wait("assignment", "await handle[{0!r}].write(value)")

    @property
    def _place(self) -> tuple[object, Path]:
        return self._session, self._path

    @property
    def _path(self) -> Path:
        return (self._name,) if self._field is None else (self._name, self._field)

    async def read(self, *, largest: int = LARGEST) -> Any:
        """Return the value here, None if nothing is there. Two round trips.

        A string, field, item or member is what JSON it is, else its text, else bytes. A hash is a dict, a list a list,
        a set a sorted list, a sorted set a dict of scores in their order, a stream the fields of its last entry.

        Args:
            largest: Bytes that it may take on the server, 64 MB if not given.

        Raises:
            TooLarge: It takes more; nothing was fetched.
            WrongType: It is a document of REEM, or of a type of a module; or it has no fields.
            NotAllowed: The user may not read it.
        """
        bound = checked_largest(largest)
        if self._field is not None:
            return await self._session.run(read_field(self._name, self._field, bound))
        found: RawValue = await self._session.run(read(self._name, bound))
        return fetched(self._name, found, bound)

    async def write(self, value: Any) -> None:
        """Store a string, or the field of a hash, as any program would: SET or HSET. Two round trips.

        A str and bytes are stored as they are, anything else as JSON text. A time to live of the key ends with SET.

        Raises:
            BadType, BadValue: It is neither JSON, text nor bytes; nothing was sent.
            WrongType: The key is of another type, or a document of REEM; nothing was written.
        """
        await self._session.run(write(self._name, self._field, value))

    def watch(self, policy: Policy | None = None, *, largest: int = _WATCHED) -> RawWatch:
        """Return an async iterator over the value of this key, first as it is, then each time any client changes it.

        As `RawKeys.watch`, of this key alone.

        Args:
            policy: What to keep for a loop that is slower than the updates; `Newest()` if not given.
            largest: Bytes that the key may take to be fetched, 16 MB if not given.

        Raises:
            BadType, BadValue: An argument that cannot be used; or this is a field, whose hash is to be watched.
        """
        if self._field is not None:
            raise BadType(f"{self._name}: a field cannot be watched; watch the hash, kvs.raw[{self._name!r}].watch()")
        bound = checked_largest(largest)
        return RawWatch(self._session, (), chosen(policy, Newest()), bound, name=self._name)
