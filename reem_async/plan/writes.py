"""Plans that write: document, attachments and registry change together or not at all.

The key of every attachment is in the registry, so that those that a write replaces can be found and removed. Most are
removed in the write's own transaction: attachments that were known below a path without list indexes can only be
referred to from there. In lists, where names do not tell places, the document is read under WATCH first. Attachments
that another client has stored in between are in the registry, which the same round trip returns; they are removed under
WATCH, after a look at the document.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from ..errors import BadType, Conflict, MissingKey, PathRefused, RedisError, ReemError, WrongKind, WrongType
from . import Command, Plan, Reply
from .attachments import ChangeOutcome, left_behind, permitted, place_of, survey, unreferred, watch
from .changes import REFUSED, SILENT, Announcement, DocumentChange, EncodedAttachment
from .keys import Keys
from .notices import NOTE_KEPT
from .paths import Path, counts_from_end, has_index, may_hold, show, to_jsonpath
from .replies import checked, from_front, full, lengths, missing, registered, settable, type_name
from .shapes import ShapeCache
from .sizes import Staged, are_missing, looks_at, stage

_NO_MEMBERS: frozenset[bytes] = frozenset()
_STORED: list[Reply] = [b"OK", []]
_ANNOUNCED: list[Reply] = [b"OK", [], b"OK"]
_USUAL: dict[int, list[Reply]] = {0: _STORED, 2: _ANNOUNCED, 3: [*_ANNOUNCED, b"OK"]}
"""The usual replies to a write without arrays, by the commands of its announcement: nothing is left to do.

If subscribers are notified, the replies to the note and to the notice follow; the number of subscribers is left out. An
owner renews its lease before them."""


def set_change(
    keys: Keys,
    path: Path,
    text: bytes,
    attachments: tuple[EncodedAttachment, ...],
    announcement: Announcement = SILENT,
) -> DocumentChange:
    """Return the change that puts `text` at `path`; its plan raises PathRefused if the parent is missing."""
    command = ("JSON.SET", keys.document, to_jsonpath(path), text)
    return DocumentChange(keys, path, command, _judged_set, attachments, True, None, announcement, PathRefused)


def _judged_set(reply: Reply) -> Any:
    # JSON.SET answers nil, and not an error, where the parent is missing or cannot hold the element.
    return REFUSED if reply is None else None


def delete_change(keys: Keys, path: Path, **announcement: Any) -> DocumentChange:
    """Return the change that removes the value at `path`; its plan raises MissingKey if there is none."""

    def judge(reply: Reply) -> Any:
        if reply == 0:
            raise MissingKey(f"nothing is stored at {show(full(keys, path))}; nothing was deleted")
        return None

    return DocumentChange(keys, path, ("JSON.DEL", keys.document, to_jsonpath(path)), judge, **announcement)


def append_change(
    keys: Keys, path: Path, texts: Sequence[bytes], attachments: tuple[EncodedAttachment, ...], **announcement: Any
) -> DocumentChange:
    def judge(reply: Reply) -> Any:
        # An empty list: nothing is there. nil in it: it is not a list.
        if reply in ([], [None]):
            raise _no_list(keys, path, nothing=not reply)
        return None

    command = ("JSON.ARRAPPEND", keys.document, to_jsonpath(path), *texts)
    return DocumentChange(keys, path, command, judge, attachments, replaces=False, **announcement)


def _no_list(keys: Keys, path: Path, *, nothing: bool) -> Exception:
    where = show(full(keys, path))
    if nothing:
        return MissingKey(f"nothing is stored at {where}; write a list there first")
    return WrongType(f"{where} is not a list; only lists can be appended to")


def appendable(keys: Keys, path: Path) -> Plan:
    """Plan to check that there is a list at `path`. Its decode raises MissingKey or WrongType.

    Attachments need this: the transaction would store them even if the server refused to append.
    """

    def decode(replies: Sequence[Reply]) -> None:
        kind = type_name(checked(replies[0], keys, path))
        if kind != "array":
            raise _no_list(keys, path, nothing=kind is None)

    return Plan([("JSON.TYPE", keys.document, to_jsonpath(path))], decode)


def takes(keys: Keys, path: Path, attachments: tuple[EncodedAttachment, ...], cache: ShapeCache) -> Plan | None:
    """Plan to check that a value with `attachments` can be set at `path`; None if that is known.

    The transaction would store the attachments even if the server refused to set the document.
    """
    # An array that was seen at just this place shows that the place can hold one.
    known = cache.of(keys.document).sure_members()
    if not path or any(each.suffix.encode() in known for each in attachments):
        return None
    return settable(keys, path)


def change(it: DocumentChange, cache: ShapeCache) -> Plan:
    """Plan one change, in one round trip unless another client has changed the shape.

    Two in lists of arrays, and where the path counts from the end of a list.
    """
    return _WatchedChange(it, cache).plan() if is_watched(it, cache) else _change(it, cache)


def is_watched(it: DocumentChange, cache: ShapeCache) -> bool:
    """Return whether to look first which items of a list the path names, and which attachments they have."""
    return has_index(it.path) and (counts_from_end(it.path) or _moves(it, cache))


def _change(
    it: DocumentChange, cache: ShapeCache, *, held: bool = False, given_up: Callable[[], Plan] | None = None
) -> Plan:
    """Plan the transaction; if keys are watched (`held`), `given_up` makes the next plan if one has changed."""
    known = cache.of(it.keys.document).members
    stale = _stale(it, known) if known or it.gone else []
    commands: list[Command] = []
    after: list[Command] = []
    if it.attachments or stale:
        # The order of the transaction: remove old attachments, store new ones, change the document, add to the
        # registry, read the registry, notify subscribers.
        commands = _clearing(it, stale)
        commands.extend(command for each in it.attachments for command in each.commands)
    if it.attachments:
        after.append(("SADD", it.keys.registry, *(each.suffix for each in it.attachments)))
    after.append(("SMEMBERS", it.keys.registry))
    main = len(commands)
    notices = it.announcement.commands(it.path)
    commands += (it.command, *after, *notices)
    # Most writes are small and without arrays: one comparison recognises their replies.
    usual = None if main else _USUAL.get(len(notices))

    def decode(replies: Sequence[Reply] | None) -> Any:
        if replies is None:  # a watched key has changed
            assert given_up is not None
            it.announcement.unsent()
            return given_up()
        # The write may have replaced the result of a calculation.
        shape = cache.of(it.keys.document)
        shape.forget_numbers()
        if (replies if not notices else replies[:-1]) == usual and (not notices or type(replies[-1]) is int):
            shape.saw_members(_NO_MEMBERS)
            return None
        return ChangeOutcome(it, cache, commands, replies, main).next()

    # Two commands are the change and a look at the registry: only one of them changes anything.
    whole = held or len(commands) > 2 or _is_tried(it, cache)
    return Plan(commands, decode, whole, held)


def _is_tried(it: DocumentChange, cache: ShapeCache) -> bool:
    """Return whether to send it as a transaction because the user may lack the right to read the registry.

    Servers abort a transaction when they deny one of its commands, so nothing is written. It takes time, hence only
    until the registry was read once. Not where a transaction fails for other reasons: deletions, since a Redis that is
    out of memory accepts only single ones, and clusters, where it would wait while its slot moves.
    """
    if cache.of(it.keys.document).may_look:
        return False
    return it.command[0] != "JSON.DEL" and not it.keys.sharded


def _moves(it: DocumentChange, cache: ShapeCache) -> bool:
    known = cache.of(it.keys.document).members
    return it.replaces and any(may_hold(it.path, place_of(member)) for member in known)


@dataclass(slots=True)
class _WatchedChange:
    """A change under WATCH: in lists, or of a value that must be unchanged since it was read."""

    it: DocumentChange
    cache: ShapeCache
    reads: Sequence[Command] | None = None  # their replies must be `before`
    before: tuple[Any, ...] = ()
    coming: list[Staged] = field(default_factory=list)

    def plan(self) -> Plan:
        # First WATCH and look. If staged values have expired, send them again and look again. Then the transaction. If
        # a watched key has changed, stage the large values, once, and look again.
        it = self.it
        surveyed = survey(it.keys, it.path) if self.reads is not None or _moves(it, self.cache) else ()
        looks = [*surveyed, *(self.reads or ()), *looks_at(self.coming), *lengths(it.keys, it.path)]
        return Plan([watch(it.keys, self.coming), *looks], partial(self._looked, 1 + len(surveyed)), held=True)

    def _looked(self, start: int, replies: Sequence[Reply]) -> Plan:
        it = self.it
        permitted(replies[0], it.keys.document, it.keys.registry)
        staged = start + len(self.reads or ())
        counts = staged + len(looks_at(self.coming))
        # Bytes are compared, not values: 1 and 1.0, or another order of keys, count as a change.
        if tuple(replies[start:staged]) != self.before:
            unlink = ("UNLINK", *(each.name for each in self.coming))
            return Plan([unlink], self._refuse, held=True) if self.coming else self._refuse()
        if are_missing(replies[staged:counts]):
            return Plan([("UNWATCH",)], lambda _: self._send(), held=True)
        gone = unreferred(replies[1:start], it.keys) if start > 1 else None
        place = from_front(replies[counts:], it.keys, it.path, it.absent)
        command = (*it.command[:2], to_jsonpath(place), *it.command[3:])
        exact = it._replace(path=place, command=command, gone=gone)
        return _change(exact, self.cache, held=True, given_up=self._again)

    def _refuse(self, _: Sequence[Reply] = ()) -> Plan:
        where = show(full(self.it.keys, self.it.path))
        raise Conflict(f"{where} was changed by another client while it was edited; nothing was written: edit it again")

    def _again(self) -> Plan:
        """Plan the next attempt after another client's write; large values are staged before it, once."""
        if self.coming:
            return self.plan()
        attachments = []
        for each in self.it.attachments:
            commands, staged = stage(each.commands, self.it.keys.tag, each.suffix)
            self.coming += staged
            attachments.append(each._replace(commands=tuple(commands)))
        self.it = self.it._replace(attachments=tuple(attachments))
        return self._send() if self.coming else self.plan()

    def _send(self) -> Plan:
        def decode(replies: Sequence[Reply]) -> Plan:
            for reply in replies:
                checked(reply, self.it.keys, self.it.path)
            return self.plan()

        return Plan([each.upload for each in self.coming], decode)


def _stale(it: DocumentChange, known: frozenset[bytes]) -> list[bytes]:
    if not it.replaces:
        return []
    written = {each.suffix.encode() for each in it.attachments}
    if it.gone is not None:
        return [member for member in it.gone if member not in written]
    # Items move, their attachments keep their names: below a list names do not tell places.
    if has_index(it.path):
        return []
    return left_behind(known, it.path, written)


def _clearing(it: DocumentChange, stale: list[bytes]) -> list[Command]:
    tag = it.keys.tag.encode()
    # New ones are unlinked first: a user's ship may send HSET or RPUSH, which would fail over a foreign type, or add.
    gone = [tag + suffix for suffix in stale] + [tag + each.suffix.encode() for each in it.attachments]
    commands: list[Command] = [("UNLINK", *gone)]
    if stale:
        commands.append(("SREM", it.keys.registry, *stale))
    return commands


def into_new(keys: Keys, it: EncodedAttachment) -> EncodedAttachment:
    """Return the attachment, with a command that makes an empty dict if there is no document."""
    return it._replace(commands=(("JSON.SET", keys.document, "$", b"{}", "NX"), *it.commands))


def make_parents(keys: Keys, path: Path) -> Plan:
    prefixes = [path[:length] for length in range(len(path))]
    # NX: existing values stay.
    commands = [("JSON.SET", keys.document, to_jsonpath(prefix), b"{}", "NX") for prefix in prefixes]

    def decode(replies: Sequence[Reply]) -> None:
        for prefix, reply in zip(prefixes, replies, strict=True):
            checked(reply, keys, prefix)

    return Plan(commands, decode)


def exchange(it: DocumentChange, reads: Sequence[Command], before: tuple[Any, ...], cache: ShapeCache) -> Plan:
    """Plan a change that is made only if the replies to `reads` are still `before`; else its decode raises Conflict."""
    return _WatchedChange(it, cache, reads, before).plan()


def expiry(keys: Keys, milliseconds: int | None) -> Plan:
    """Plan to let a top-level key expire: document, attachments, registry and note, in one transaction.

    With None the expiry is removed. Two round trips under WATCH, again if another client writes to the key in between;
    decode raises MissingKey.
    """

    def look(replies: Sequence[Reply]) -> Plan:
        permitted(replies[0], keys.document, keys.registry)
        if type_name(checked(replies[1], keys, ())) is None:
            raise missing(keys, (), None)
        tag = keys.tag.encode()
        names = [keys.document, keys.registry, *(tag + member for member in sorted(registered(replies[2], keys)))]
        if milliseconds is None:
            return Plan([("PERSIST", name) for name in names], done, atomic=True, held=True)
        # The note expires by itself, and keeps its time if that is shorter.
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


def together(changes: Sequence[DocumentChange], cache: ShapeCache) -> Plan:
    """Plan several changes in one transaction, then the plans that follow from each; the result is each one's error.

    Of entries of one dict all or none are applied: the server refuses one if the dict is missing, and then it refuses
    all. Raises BadType if a change must be watched: such changes cannot share one transaction.
    """
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
    try:
        return plan.decode(replies)
    except (ReemError, RedisError) as error:
        return error


def _each(outcomes: list[Any]) -> Plan | list[Exception | None]:
    """Continue with each outcome that is a plan; then return all."""
    for number, outcome in enumerate(outcomes):
        # One after the other: each may need the connection for itself.
        if isinstance(outcome, Plan):

            def decode(replies: Sequence[Reply] | None, number: int = number, plan: Plan = outcome) -> Any:
                return _each([*outcomes[:number], _decoded(plan, replies), *outcomes[number + 1 :]])  # type: ignore[arg-type]

            return outcome._replace(decode=decode)
    for outcome in outcomes:
        if isinstance(outcome, WrongKind):  # of the document, so all were refused; the error is yet to name the type
            raise outcome
    return outcomes
