"""Reading and writing one top-level key: from replies to values, from values to plans."""

from __future__ import annotations

import inspect
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np

from ..errors import (
    SELF_EXPLANATORY,
    BadKey,
    Conflict,
    ConnectionLost,
    Contended,
    MissingKey,
    MissingTop,
    NotConnected,
    PartialWrite,
    PathRefused,
    ReemError,
    WrongType,
)
from ..plan import Plan
from ..plan.arguments import check_number
from ..plan.arithmetic import Operation, calculate, compute
from ..plan.changes import SILENT, Announcement, DocumentChange, EncodedAttachment
from ..plan.documents import number_text
from ..plan.paths import Path, check_name, has_index, show, suffix
from ..plan.reads import (
    RawRead,
    awaited,
    exists,
    first_read,
    has_key,
    interpreted,
    keys_at,
    length,
    nothing,
    read,
    type_of,
)
from ..plan.sizes import has_large
from ..plan.writes import (
    append_change,
    appendable,
    change,
    delete_change,
    exchange,
    expiry,
    into_new,
    make_parents,
    set_change,
    takes,
    together,
)
from ..session import PublisherIdentity, Session
from .encoding import HUGE, Encoder, unique_tail


class DocumentReader:
    def __init__(self, session: Session, name: object) -> None:
        self.session = session
        self.keys = session.keys(name)
        self.name = self.keys.name

    @property
    def raw(self) -> DocumentReader:
        """A reader that does not decode pictures."""
        return DocumentReader(self.session.raw, self.name)

    async def read(self, path: Path) -> Any:
        raw_read = await self.raw_read(path)
        return await opened(raw_read) if raw_read.slots else raw_read.holder[0]

    async def no_item(self, path: Path) -> MissingKey:
        outer, where = path[:-1], show((self.name, *path))
        try:
            kind = await self.type_at(outer)
        except MissingKey:
            kind = type(None)
        if kind is not np.ndarray:
            return MissingKey(f"nothing is stored at {where}")
        return MissingKey(
            f"{where}: {show((self.name, *outer))} is an array, and arrays are read whole: "
            f"read it, then take [{path[-1]}] of what that gives"
        )

    async def exists(self) -> bool:
        found: bool = await self.session.run(exists(self.keys))
        return found

    async def raw_read(self, path: Path) -> RawRead:
        if self.session.ships.asynchronous:
            await self.session.ships.ready()
        session = self.session
        plan = read(self.keys, path, session.ships, session.cache)
        # Until a key is known not to be of REEM 0.1, its reads check that in the same round trip.
        raw_read: RawRead = await session.run(first_read(plan, self.keys, path, session.cache))
        return raw_read

    async def contains_at(self, path: Path, key: object) -> bool:
        name = check_name(key, (self.name, *path))
        found: bool = await self.session.run(has_key(self.keys, path, name))
        return found

    async def keys_at(self, path: Path) -> list[str]:
        names: list[str] = await self.session.run(keys_at(self.keys, path))
        return names

    async def type_at(self, path: Path) -> type:
        await self.session.ships.ready()
        kind: type | None = await self.session.run(type_of(self.keys, path, self.session.ships))
        return type(await self.read(path)) if kind is None else kind

    async def length_at(self, path: Path) -> int:
        count: int | None = await self.session.run(length(self.keys, path))
        if count is not None:
            return count
        # A text or an array: the server knows only the length of its placeholder.
        value = await self.read(path)
        try:
            return len(value)
        except TypeError:
            where = show((self.name, *path))
            raise WrongType(f"{where} is of type {type(value).__name__} and has no length") from None


async def opened(raw_read: RawRead) -> Any:
    """Return the value of a read, with the ships' values in it; see `RawRead.give_up`."""
    for slot, ship, reply in raw_read.slots:
        value = interpreted(raw_read, slot, ship, reply)
        waits = ship.blob is None and inspect.isawaitable(value)
        slot.container[slot.key] = await awaited(raw_read, slot, value) if waits else value
    return raw_read.holder[0]


Attachments = tuple[EncodedAttachment, ...]


class Assignment(NamedTuple):
    path: Path  # the place, below the top-level key
    text: bytes | None  # the JSON text; None to remove the value
    attachments: Attachments = ()  # the values that ships store
    is_entry: bool = False  # whether the dict above must exist: an array does not make its top-level key


class CallTime(NamedTuple):
    wall: float  # seconds since 1970, for notices
    monotonic: float  # to measure how late it is


class Turn:
    """The turn of one call, and the announcements of its changes. This one has none, so calls need not wait.

    An async context manager: entering waits for the turn of the call, leaving starts the next one.

    Attributes:
        called: When the call was made; None for now.
        announced: The announcements of the next changes, made before this turn.
    """

    called: CallTime | None = None
    announced: Sequence[Announcement] = ()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: Any) -> None:
        return None

    def reserve(
        self, text: bytes | None = None, attachments: Attachments = (), *, deleted: bool = False
    ) -> Announcement:
        """Return the announcement of the next change; text and attachments if it sets a value."""
        return SILENT

    def not_applied(self, count: int) -> None:
        """Note that the last `count` changes were not applied: their numbers are free."""

    def release(self) -> None:
        """Give back the numbers that the changes so far did not use."""


_SILENT_TURN = Turn()

_TRIES = 50  # of a call that reads and then writes

# Seconds, 300 years: servers refuse what leaves 64 bits of milliseconds.
_LONGEST_EXPIRY = 1e10


def _may_have_left(error: BaseException) -> bool:
    """Return whether a change that raised `error` may have left arrays that the document does not refer to."""
    if isinstance(error, PartialWrite):  # the server could not be reached to remove them
        return isinstance(error.__cause__, NotConnected)
    return not isinstance(error, ReemError) or isinstance(error, ConnectionLost)


async def retried(attempt: Callable[[], Awaitable[Any]]) -> Any:
    """Return the result of a call that reads and then writes, which is tried again if what it read was changed."""
    for _ in range(_TRIES - 1):
        try:
            return await attempt()
        except Contended:
            raise
        except Conflict:
            continue
    return await attempt()


class DocumentWriter:
    """Writes one top-level key; in an outage by the policy of an `outage.Outage`, without one its calls raise."""

    # Whether a later call must not overtake an earlier one. A task awaits each of its calls, so they are in order.
    # Those of several tasks need not be.
    keeps_order = False

    def __init__(self, session: Session, name: object, outages: Any = None) -> None:
        self.session = session
        self.keys = session.keys(name)
        self.name = self.keys.name
        self.encoder = Encoder(session, self.keys)
        self._run: Callable[[Plan], Awaitable[Any]] = session.run  # runs a plan and those that follow from it
        self._outages = outages

    def turn(self, identity: PublisherIdentity | None = None) -> Turn:
        """Return the turn of a call; its updates have the numbers of `identity`, if given."""
        return _SILENT_TURN

    def maker(self) -> Callable[[Session, object], DocumentWriter]:
        return type(self)

    async def check(self, value: Any) -> None:
        await self.encoder.encoded((), value)

    async def set(self, path: Path, value: Any) -> None:
        # The hot path: plain JSON needs no ships and no sizes.
        text = self.encoder.plain(path, value)
        if text is None:
            text, attachments = await self.encoder.walked(path, value)
            if attachments and await self._let_pass(attachments):
                # Another task may have changed an array in between; all parts must be of one instant.
                text, attachments = await self.encoder.walked(path, value)
            await self._set(path, text, attachments)
            return
        if len(text) > HUGE:
            self.encoder.check_sizes(path, [text])
        await self._set(path, text, ())

    async def set_with_parents(self, path: Path, value: Any) -> None:
        try:
            await self.set(path, value)
        except PathRefused:
            await self.session.run(make_parents(self.keys, path))
            await self.set(path, value)

    def _store(self, assignments: Sequence[Assignment]) -> Awaitable[Any]:
        return self.in_turn(self.send, assignments) if self._outages is None else self._outages.put(self, assignments)

    def _set(self, path: Path, text: bytes, attachments: Attachments) -> Awaitable[Any]:
        if self._outages is None:  # the hot path
            return self.in_turn(self._put, path, text, attachments)
        return self._store([Assignment(path, text, attachments)])

    def _demand(self, send: Callable[..., Awaitable[Any]], *what: Any) -> Awaitable[Any]:
        return self.in_turn(send, *what) if self._outages is None else self._outages.demand(self, send, what)

    async def _let_pass(self, attachments: Attachments) -> bool:
        """Wait until small calls in progress are answered before a large one; return whether it waited."""
        if self.keeps_order or not any(has_large(each.commands) for each in attachments):
            return False
        return await self.session.transport.let_pass()

    async def update(self, path: Path, values: dict[str, Any]) -> None:
        """Store each of `values` in the dict at `path`: one transaction."""
        tail = unique_tail() if has_index(path) else ""
        encoded = [
            ((*path, check_name(key, (self.name, *path))), await self.encoder.encoded((*path, key), value, tail))
            for key, value in values.items()
        ]
        assignments = [Assignment(place, *it, is_entry=True) for place, it in encoded]
        every = [each for it in assignments for each in it.attachments]
        self.encoder.check_sizes(path, [text for _, (text, _) in encoded], every)
        if assignments:
            await self._store(assignments)

    async def delete(self, path: Path) -> None:
        # Kept in an outage like a value: a deletion is the newest state of its place.
        await self._store([Assignment(path, None)])

    async def extend(self, path: Path, values: Sequence[Any]) -> None:
        tail = unique_tail()
        texts: list[bytes] = []
        attachments: list[EncodedAttachment] = []
        for number, value in enumerate(values):
            text, its = await self.encoder.encoded((*path, -1), value, f"{tail}.{number}")
            texts.append(text)
            attachments.extend(its)
        self.encoder.check_sizes(path, texts, attachments)
        if texts:
            await self._demand(self._append, path, texts, tuple(attachments))

    async def calculate(self, path: Path, command: str, operation: Operation, operand: float) -> Any:
        text = number_text(operand, (self.name, *path))
        if isinstance(operand, np.generic):
            operand = operand.item()
        plan = partial(calculate, self.keys, path, command, operation, operand, text, cache=self.session.cache)
        return await self._demand(self._calculate, plan)

    async def compute(self, path: Path, function: Any) -> Any:
        return await self._demand(
            self._calculate, partial(compute, self.keys, path, function, cache=self.session.cache)
        )

    async def exchange(self, path: Path, value: Any, before: RawRead) -> None:
        """Store `value` at `path` if the stored value is still `before`; raises Conflict."""
        await self._demand(self._put_instead, path, *await self.encoder.encoded(path, value, unique_tail()), before)

    async def put_absent(self, path: Path, value: Any, why: MissingKey) -> None:
        """Store `value` at `path` if still nothing is there, as the error `why` of a read says; raises Conflict."""
        await self.exchange(path, value, nothing(self.keys, path, why))

    async def expire(self, path: Path, seconds: float | None) -> None:
        """Let the whole top-level key expire; None removes the expiry."""
        if path:
            raise BadKey(
                f"{show((self.name, *path))}: only a whole top-level key can expire; use kvs[{self.name!r}], or store "
                "this part under a top-level key of its own"
            )
        if seconds is None:
            await self._demand(self._expire, None)
            return
        cure = f"use a number above 0, up to {_LONGEST_EXPIRY:g}"
        check_number(f"{self.name}: seconds", seconds, cure, above=0, most=_LONGEST_EXPIRY)
        await self._demand(self._expire, max(round(seconds * 1000), 1))

    async def take(self, path: Path, before: RawRead) -> None:
        await self._demand(self._take, path, before)

    async def in_turn(self, send: Callable[..., Awaitable[Any]], *what: Any) -> Any:
        """Return the result of `send`, called with the turn of this call and `what` to send.

        If it is interrupted, the next change of the same key removes what it may have left.
        """
        session, document = self.session, self.keys.document
        async with self.turn() as turn:
            # Commands of cancelled calls may still be on their way over another connection, and must not come after
            # this. There are nearly never any, and a coroutine costs time.
            if not session.transport.is_settled(document):
                await session.transport.settle(document)
            try:
                return await send(turn, *what)
            except BaseException as error:
                # Cancelled, interrupted, or without a reply: it is unknown what was applied. A later change cleans up.
                shape = session.cache.of(document)
                if _may_have_left(error):
                    shape.saw_interrupted()
                else:
                    shape.forget_numbers()
                # The message says all; REEM's own frames would only hide the caller's line.
                if isinstance(error, SELF_EXPLANATORY):
                    raise error.with_traceback(None) from None
                raise

    def send(self, turn: Turn, assignments: Sequence[Assignment]) -> Awaitable[None]:
        """Send the assignments of one call, in its turn: all in one transaction."""
        if len(assignments) > 1 or assignments[0].is_entry:
            return self._put_all(turn, assignments)
        path, text, attachments, _ = assignments[0]
        return self._remove(turn, path) if text is None else self._put(turn, path, text, attachments)

    async def _put(self, turn: Turn, path: Path, text: bytes, attachments: Attachments) -> None:
        """Store a value; a single array just below a top-level key that is not there makes that."""
        try:
            if attachments:
                await self._check_place(path, attachments)
            it = self._setting(turn, path, text, attachments)
            if attachments or self.session.local.early:
                await it.announcement.share(path)
            await self._run(change(it, self.session.cache))
        except MissingTop:
            # Only for `kvs["cam"]["image"] = array`, so that no {} must be written first.
            if not attachments or len(path) != 1 or attachments[0].suffix != suffix(path):
                raise
        else:
            if not path:  # the whole document was written: it is not of REEM 0.1
                self.session.cache.of(self.keys.document).saw_new()
            return
        turn.release()  # the refusal was announced with numbers of its own; the value is not shared again
        it = self._setting(turn, path, text, (into_new(self.keys, attachments[0]),))
        await self._run(change(it, self.session.cache))

    async def _put_all(self, turn: Turn, assignments: Sequence[Assignment]) -> None:
        for error in await self.send_each(turn, assignments):
            if error is not None:
                raise error

    async def send_each(self, turn: Turn, assignments: Sequence[Assignment]) -> list[Exception | None]:
        """Send values in one transaction, in its turn; return why each was refused, or None."""
        shipped = next((each for each in assignments if each.attachments), None)
        if shipped is not None:
            await self._check_place(shipped.path, shipped.attachments)
        changes = [self._setting(turn, path, text or b"", attachments) for path, text, attachments, _ in assignments]
        if shipped is not None or self.session.local.early:
            for each in changes:
                await each.announcement.share(each.path)
        errors: list[Exception | None] = await self._run(together(changes, self.session.cache))
        return errors

    async def _put_instead(
        self, turn: Turn, path: Path, text: bytes, attachments: Attachments, before: RawRead
    ) -> None:
        if attachments and not before.holder:  # nothing was there, so the place must be checked
            await self._check_place(path, attachments)
        await self._if_still(before, set_change(self.keys, path, text, attachments, announcement=turn.reserve()))

    async def _expire(self, turn: Turn, milliseconds: int | None) -> None:
        await self._run(expiry(self.keys, milliseconds))

    async def _take(self, turn: Turn, path: Path, before: RawRead) -> None:
        await self._if_still(before, delete_change(self.keys, path, announcement=turn.reserve(deleted=True)))

    async def _if_still(self, before: RawRead, it: DocumentChange) -> None:
        # The transaction fails if anything has changed, so the arrays that were read are all there are.
        it = it._replace(gone=tuple(slot.placeholder.suffix.encode() for slot, _, _ in before.slots))
        await self._run(exchange(it, before.commands, before.raw, self.session.cache))

    async def _remove(self, turn: Turn, path: Path) -> None:
        it = delete_change(self.keys, path, announcement=turn.reserve(deleted=True))
        await self._run(change(it, self.session.cache))

    async def _append(self, turn: Turn, path: Path, texts: Sequence[bytes], attachments: Attachments) -> None:
        if attachments:  # they would be stored even if there is no list
            await self._run(appendable(self.keys, path))
        it = append_change(self.keys, path, texts, attachments, announcement=turn.reserve())
        await self._run(change(it, self.session.cache))

    async def _calculate(self, turn: Turn, plan: Callable[[Announcement], Plan]) -> Any:
        return await self._run(plan(turn.reserve()))

    async def _check_place(self, path: Path, attachments: Attachments) -> None:
        """Raise PathRefused if nothing can be set at `path`: the attachments would be stored for nothing."""
        plan = takes(self.keys, path, attachments, self.session.cache)
        if plan is not None:
            await self._run(plan)

    def _setting(self, turn: Turn, path: Path, text: bytes, attachments: Attachments) -> DocumentChange:
        return set_change(self.keys, path, text, attachments, turn.reserve(text, attachments))
