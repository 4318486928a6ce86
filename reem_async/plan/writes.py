"""Plans that write: document, ships' keys and registry change together or not at all.

Every key a ship fills is entered in a registry set, so that what a write replaces can be found and
removed. Most of it goes in the write's own transaction: what was known to be there, below a path
without list indexes, can only be referred to from there; in lists, where names tell nothing about
places, a look under WATCH says what is about to be replaced. What nobody here knew of (another client
changed the shape meanwhile) shows in the registry, which the same round trip returns, and is then
removed under WATCH, after a look at what the document refers to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from ..errors import BadType, Conflict, MissingKey, PathRefused, RedisError, ReemError, WrongType
from . import Command, Plan, Reply
from .attachments import Outcome, left_behind, permitted, place_of, survey, unreferred, watch
from .changes import REFUSED, SILENT, Announcement, Change, EncodedAttachment
from .keys import Keys
from .notices import NOTE_KEPT
from .paths import Path, counts_from_end, has_index, may_hold, show, to_jsonpath
from .replies import checked, from_front, full, lengths, missing, registered, settable, type_name
from .shapes import ShapeCache
from .sizes import Staged, are_missing, looks_at, stage

_NO_MEMBERS: frozenset[bytes] = frozenset()
_STORED: list[Reply] = [b"OK", []]
_TOLD: list[Reply] = [b"OK", [], b"OK"]
"""The usual replies to a write without arrays: there is nothing more to do.

Where subscribers are told, behind that are the note of the update and how many they are; the latter is left out."""


def set_change(
    keys: Keys,
    path: Path,
    text: bytes,
    attachments: tuple[EncodedAttachment, ...],
    announcement: Announcement = SILENT,
) -> Change:
    """Return the change that puts `text` at `path`; raises PathRefused if the parent is not there."""
    command = ("JSON.SET", keys.document, to_jsonpath(path), text)
    return Change(keys, path, command, _judged_set, attachments, True, None, announcement, PathRefused)


def _judged_set(reply: Reply) -> Any:
    # JSON.SET answers nil, and not an error, where the parent is missing or cannot hold the element.
    return REFUSED if reply is None else None


def delete_change(keys: Keys, path: Path, **announcement: Any) -> Change:
    """Return the change that removes what is at `path`; raises MissingKey if nothing is there."""

    def judge(reply: Reply) -> Any:
        if reply == 0:
            raise MissingKey(f"nothing is stored at {show(full(keys, path))}; nothing was deleted")
        return None

    return Change(keys, path, ("JSON.DEL", keys.document, to_jsonpath(path)), judge, **announcement)


def append_change(
    keys: Keys, path: Path, texts: Sequence[bytes], attachments: tuple[EncodedAttachment, ...], **announcement: Any
) -> Change:
    """Return the change that appends to the list at `path`; raises MissingKey or WrongType if there is none."""

    def judge(reply: Reply) -> Any:
        # An empty list: nothing is there. nil in it: something else than a list is.
        if reply in ([], [None]):
            raise _no_list(keys, path, nothing=not reply)
        return None

    command = ("JSON.ARRAPPEND", keys.document, to_jsonpath(path), *texts)
    return Change(keys, path, command, judge, attachments, replaces=False, **announcement)


def _no_list(keys: Keys, path: Path, *, nothing: bool) -> Exception:
    where = show(full(keys, path))
    if nothing:
        return MissingKey(f"nothing is stored at {where}; write a list there first")
    return WrongType(f"{where} is not a list; only lists can be appended to")


def appendable(keys: Keys, path: Path) -> Plan:
    """Plan to make sure that there is a list at `path`. Its decode raises MissingKey or WrongType if there is none.

    For what goes by ship: the transaction would store it even if the server refused to append.
    """

    def decode(replies: Sequence[Reply]) -> None:
        kind = type_name(checked(replies[0], keys, path))
        if kind != "array":
            raise _no_list(keys, path, nothing=kind is None)

    return Plan([("JSON.TYPE", keys.document, to_jsonpath(path))], decode)


def takes(keys: Keys, path: Path, attachments: tuple[EncodedAttachment, ...], cache: ShapeCache) -> Plan | None:
    """Plan to make sure that something can be set at `path`, with `attachments` in it; None if that is known.

    The transaction would store what goes by ship even if the server refused to set the rest.
    """
    # An array that was seen at just this place shows that the place can hold one.
    known = cache.sure_members(keys.document)
    if not path or any(each.suffix.encode() in known for each in attachments):
        return None
    return settable(keys, path)


def change(it: Change, cache: ShapeCache) -> Plan:
    """Plan one change, in one round trip unless somebody else changed the shape meanwhile.

    In two in lists of arrays, and where it counts from the end of a list.

    Args:
        it: The change.
        cache: What is known of the server.
    """
    return _change_watched(it, cache) if is_watched(it, cache) else _change(it, cache)


def is_watched(it: Change, cache: ShapeCache) -> bool:
    """Return whether it has to be looked first which items of a list are meant, and what refers to them."""
    return has_index(it.path) and (counts_from_end(it.path) or _moves(it, cache))


def _change(it: Change, cache: ShapeCache, *, held: bool = False, given_up: Callable[[], Plan] | None = None) -> Plan:
    """Plan the transaction; if the connection is `held`, it watches keys, and `given_up` is next if one changed."""
    known = cache.members(it.keys.document)
    stale = _stale(it, known) if known or it.gone else []
    commands: list[Command] = []
    after: list[Command] = []
    if it.attachments or stale:
        # The order within the transaction: room is made, ships' keys are filled, the document names them, the registry
        # has them, the registry is looked at, subscribers are told. Readers see all of it or nothing.
        commands = _clearing(it, stale)
        commands.extend(command for each in it.attachments for command in each.commands)
    if it.attachments:
        after.append(("SADD", it.keys.registry, *(each.suffix for each in it.attachments)))
    after.append(("SMEMBERS", it.keys.registry))
    main = len(commands)
    told = it.announcement.commands(it.path)
    commands += (it.command, *after, *told)
    # Most writes are small, without arrays, and nothing is special about the replies: one comparison tells.
    usual = None if main else _TOLD if told else _STORED

    def decode(replies: Sequence[Reply] | None) -> Any:
        # EXEC was answered with nil: somebody wrote to the document after the look.
        if replies is None:
            assert given_up is not None  # only watched transactions are given up
            it.announcement.unsent()
            return given_up()
        # Any write may have replaced the number that a calculation left.
        cache.forget_numbers(it.keys.document)
        if (replies if not told else replies[:-1]) == usual and (not told or type(replies[-1]) is int):
            cache.saw_members(it.keys.document, _NO_MEMBERS)
            return None
        return Outcome(it, cache, commands, replies, main).next()

    whole = held or len(commands) > 2 or _is_tried(it, cache)
    return Plan(commands, decode, whole, held)


def _is_tried(it: Change, cache: ShapeCache) -> bool:
    """Return whether to send it as a transaction because its look at the registry may be denied.

    Servers abort a transaction when they deny one of its commands: so nothing is written by a user who lacks a
    right. It takes time, hence only until a look was seen to succeed. Not where it would fail for other reasons:
    deletions, which Redis without memory takes alone only, and clusters, where it would wait while its slot moves.
    """
    if cache.may_look(it.keys.document):
        return False
    return it.command[0] != "JSON.DEL" and not it.keys.sharded


def _moves(it: Change, cache: ShapeCache) -> bool:
    """Return whether it, in a list, may replace something that has moved from the place after which it is named."""
    known = cache.members(it.keys.document)
    return it.replaces and any(may_hold(it.path, place_of(member)) for member in known)


def _change_watched(it: Change, cache: ShapeCache, coming: Sequence[Staged] = ()) -> Plan:
    """Plan to look first which items are meant, and what nothing refers to once they are replaced."""
    surveyed = survey(it.keys, it.path) if _moves(it, cache) else ()
    start, end = 1 + len(surveyed), 1 + len(surveyed) + len(looks_at(coming))

    def look(replies: Sequence[Reply]) -> Plan:
        # States of a watched change: WATCH and look -> (what was staged is gone: send it again, and look) ->
        # transaction -> (given up: send what is large ahead, once, and look again) -> done.
        permitted(replies[0], it.keys.document, it.keys.registry)
        if are_missing(replies[start:end]):
            return _unwatched(lambda: _send(it, coming, lambda: attempt(it, coming)))
        # Document and registry are of the instant of the look, and the transaction fails if either is not the same any
        # more.
        gone = unreferred(replies[1:start], it.keys) if surveyed else None
        exact = _from_front(it, replies[end:])._replace(gone=gone)
        return _change(exact, cache, held=True, given_up=lambda: _again(it, coming, attempt))

    def attempt(it: Change, coming: Sequence[Staged]) -> Plan:
        return _change_watched(it, cache, coming)

    commands = [watch(it.keys, coming), *surveyed, *looks_at(coming), *lengths(it.keys, it.path)]
    return Plan(commands, look, held=True)


def _unwatched(then: Callable[[], Plan]) -> Plan:
    return Plan([("UNWATCH",)], lambda _: then(), held=True)


def _again(it: Change, coming: Sequence[Staged], attempt: Callable[[Change, Sequence[Staged]], Plan]) -> Plan:
    """Plan the next attempt, somebody else having written meanwhile; what is large is sent before it, once."""
    if coming:
        return attempt(it, coming)
    attachments = []
    for each in it.attachments:
        commands, sent = stage(each.commands, it.keys.tag, each.suffix)
        coming = [*coming, *sent]
        attachments.append(each._replace(commands=tuple(commands)))
    moved = it._replace(attachments=tuple(attachments))
    return _send(moved, coming, lambda: attempt(moved, coming)) if coming else attempt(it, ())


def _send(it: Change, coming: Sequence[Staged], then: Callable[[], Plan]) -> Plan:
    def decode(replies: Sequence[Reply]) -> Plan:
        for reply in replies:
            checked(reply, it.keys, it.path)
        return then()

    return Plan([each.upload for each in coming], decode)


def _stale(it: Change, known: frozenset[bytes]) -> list[bytes]:
    """Return the known keys that only what is replaced can refer to, and that are not written again."""
    if not it.replaces:
        return []
    written = {each.suffix.encode() for each in it.attachments}
    if it.gone is not None:
        return [member for member in it.gone if member not in written]
    # Items move, their keys keep their names: below a path through a list nothing can be told by names.
    if has_index(it.path):
        return []
    return left_behind(known, it.path, written)


def _clearing(it: Change, stale: list[bytes]) -> list[Command]:
    """Return the commands that make room: no leftovers, and no foreign type under a ship's key."""
    tag = it.keys.tag.encode()
    # What will be filled is unlinked first: a foreign type under that name would have SET fail in mid-transaction.
    gone = [tag + suffix for suffix in stale] + [tag + each.suffix.encode() for each in it.attachments]
    commands: list[Command] = [("UNLINK", *gone)]
    if stale:
        commands.append(("SREM", it.keys.registry, *stale))
    return commands


def into_new(keys: Keys, it: EncodedAttachment) -> EncodedAttachment:
    """Return an attachment that, if there is no document yet, has an empty dict made for it in the same transaction."""
    return it._replace(commands=(("JSON.SET", keys.document, "$", b"{}", "NX"), *it.commands))


def make_parents(keys: Keys, path: Path) -> Plan:
    """Plan to put an empty dict wherever a parent of `path` is missing; leaves everything else alone."""
    prefixes = [path[:length] for length in range(len(path))]
    # NX: what is there already, be it no dict at all, stays.
    commands = [("JSON.SET", keys.document, to_jsonpath(prefix), b"{}", "NX") for prefix in prefixes]

    def decode(replies: Sequence[Reply]) -> None:
        for prefix, reply in zip(prefixes, replies, strict=True):
            checked(reply, keys, prefix)

    return Plan(commands, decode)


def _from_front(it: Change, counts: Sequence[Reply]) -> Change:
    """Return the change at its place counted from the front, given the replies to `lengths`."""
    place = from_front(counts, it.keys, it.path, it.absent)
    return it._replace(path=place, command=(*it.command[:2], to_jsonpath(place), *it.command[3:]))


def exchange(
    it: Change, reads: Sequence[Command], before: tuple[Any, ...], cache: ShapeCache, coming: Sequence[Staged] = ()
) -> Plan:
    """Plan a change that is made only if what `reads` fetch is still `before`.

    Raises (in decode):
        Conflict: It is not; nothing was written.
    """
    where = show(full(it.keys, it.path))
    end = 4 + len(reads)
    counts = end + len(looks_at(coming))

    def refuse(_: Sequence[Reply]) -> Plan:
        raise Conflict(f"{where} was changed by somebody else while it was edited; nothing was written: edit it again")

    def compare(replies: Sequence[Reply]) -> Plan:
        permitted(replies[0], it.keys.document, it.keys.registry)
        # Bytes are compared, not values: 1 and 1.0, or another order of keys, count as a change by somebody else.
        if tuple(replies[4:end]) != before:
            return Plan([("UNLINK", *(each.name for each in coming))], refuse, held=True) if coming else refuse(())
        if are_missing(replies[end:counts]):
            return _unwatched(lambda: _send(it, coming, lambda: attempt(it, coming)))
        exact = _from_front(it, replies[counts:])._replace(gone=unreferred(replies[1:4], it.keys))
        return _change(exact, cache, held=True, given_up=lambda: _again(it, coming, attempt))

    def attempt(it: Change, coming: Sequence[Staged]) -> Plan:
        return exchange(it, reads, before, cache, coming)

    looks = [*survey(it.keys, it.path), *reads, *looks_at(coming), *lengths(it.keys, it.path)]
    commands = [watch(it.keys, coming), *looks]
    return Plan(commands, compare, held=True)


def expiry(keys: Keys, milliseconds: int | None) -> Plan:
    """Plan to have a top-level key expire: document, ships' keys, registry and note, in one transaction.

    Args:
        keys: The top-level key.
        milliseconds: How long it lives from now on; None to end its expiry.

    Two round trips under WATCH, again if another client writes to the key in between.

    Raises (in decode):
        MissingKey: Nothing is stored there.
    """

    def look(replies: Sequence[Reply]) -> Plan:
        permitted(replies[0], keys.document, keys.registry)
        if type_name(checked(replies[1], keys, ())) is None:
            raise missing(keys, (), None)
        tag = keys.tag.encode()
        names = [keys.document, keys.registry, *(tag + member for member in sorted(registered(replies[2], keys)))]
        if milliseconds is None:
            return Plan([("PERSIST", name) for name in names], done, atomic=True, held=True)
        # The note expires by itself, and so it keeps its time if that is shorter.
        names += [keys.last] if milliseconds < NOTE_KEPT * 1000 else []
        return Plan([("PEXPIRE", name, str(milliseconds)) for name in names], done, atomic=True, held=True)

    def done(replies: Sequence[Reply] | None) -> Any:
        if replies is None:
            return expiry(keys, milliseconds)
        for reply in replies:
            checked(reply, keys, ())
        return None

    commands = [watch(keys), ("JSON.TYPE", keys.document, to_jsonpath(())), ("SMEMBERS", keys.registry)]
    return Plan(commands, look, held=True)


# Several changes in one transaction.


def together(changes: Sequence[Change], cache: ShapeCache) -> Plan:
    """Plan changes of entries of one dict in one transaction, and after it what follows from each.

    They are applied all or not at all: what the server refuses one for, the dict that is not there, goes for each.

    Raises:
        BadType: An entry is a list item's, with arrays that may have moved: only one at a time can be watched.
    """
    # A change that is watched begins with a look, and two looks cannot share one transaction.
    for each in changes:
        if is_watched(each, cache):
            raise BadType(
                f"{show(full(each.keys, each.path))}: in a list that holds arrays, or counted from its end, keys "
                "cannot be set together; write them one by one, or use edit()"
            )
    plans = [change(each, cache) for each in changes]

    def decode(replies: Sequence[Reply]) -> Any:
        start, outcomes = 0, []
        for plan in plans:
            mine = replies[start : start + len(plan.commands)]
            start += len(plan.commands)
            outcomes.append(_decoded(plan, mine))
        return _each(outcomes)

    return Plan([command for plan in plans for command in plan.commands], decode, atomic=True)


def _decoded(plan: Plan, replies: Sequence[Reply]) -> Any:
    """Return what a part of a transaction comes to: its result, the next plan, or an error."""
    try:
        return plan.decode(replies)
    except (ReemError, RedisError) as error:
        return error


def _each(outcomes: list[Any]) -> Any:
    """Go on with each outcome that is a plan; raises the first error once all of them have been seen to."""
    for number, outcome in enumerate(outcomes):
        # One after the other: each may need the connection for itself, and the next starts from what this one left.
        if isinstance(outcome, Plan):

            def decode(replies: Sequence[Reply] | None, number: int = number, plan: Plan = outcome) -> Any:
                return _each([*outcomes[:number], _decoded(plan, replies), *outcomes[number + 1 :]])  # type: ignore[arg-type]

            return outcome._replace(decode=decode)
    for outcome in outcomes:
        if isinstance(outcome, Exception):
            raise outcome
    return None
