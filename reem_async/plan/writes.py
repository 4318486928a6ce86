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
from typing import Any, NamedTuple

from ..errors import BadKey, BadType, Conflict, MissingKey, PartialWrite
from . import Command, Plan, Reply
from .keys import Keys
from .memory import Memory
from .orphans import clean, survey, unreferred, watch
from .paths import Path, below, has_index, may_hold, parse_suffix, show, to_jsonpath
from .replies import checked, diagnose, explained, full, registered, settable, type_name
from .staging import Staged, are_missing, looks_at, stage

__all__ = [
    "Change",
    "Loaded",
    "append_change",
    "appendable",
    "change",
    "delete_change",
    "exchange",
    "make_parents",
    "set_change",
    "takes",
]


class Loaded(NamedTuple):
    """A parcel ready to go: the commands its ship recorded.

    Attributes:
        suffix: The key's name after the tag.
        label: The ship's label.
        commands: What stores it.
        blob: Its bytes in pieces, where the ship works that way: they can travel in a notice.
    """

    suffix: str
    label: str
    commands: tuple[Command, ...]
    blob: tuple[Any, ...] | None = None


class Change(NamedTuple):
    """One change of a document.

    Attributes:
        keys: The document's names.
        path: What is changed, below the top-level key.
        command: The JSON command that does it.
        judge: Turns that command's reply into the result; raises, or returns `REFUSED`.
        loaded: What goes by ship.
        replaces: Whether what was at `path` is gone afterwards.
        looks: Whether to look for ships' keys that it replaces; if not, somebody vouches for there being none.
        gone: The suffixes of those that it replaces, if this is known for certain: the document is watched.
        notices: What tells subscribers, in the same transaction.
        retraction: Makes what tells them if the server refuses the change after all.
    """

    keys: Keys
    path: Path
    command: Command
    judge: Callable[[Reply], Any]
    loaded: tuple[Loaded, ...] = ()
    replaces: bool = True
    looks: bool = True
    gone: tuple[bytes, ...] | None = None
    notices: Sequence[Command] = ()
    retraction: Callable[[], Sequence[Command]] | None = None


REFUSED = object()
"""The server did nothing and did not say why."""

_NO_MEMBERS: frozenset[bytes] = frozenset()
_STORED: list[Reply] = [b"OK", []]
_STORED_UNSEEN: list[Reply] = [b"OK"]
"""The usual replies to a write without arrays, with a look at the registry and without: there is nothing more to do."""


def set_change(
    keys: Keys,
    path: Path,
    text: bytes,
    loaded: tuple[Loaded, ...],
    looks: bool = True,
    notices: Sequence[Command] = (),
    retraction: Callable[[], Sequence[Command]] | None = None,
) -> Change:
    """Return the change that puts `text` at `path`; raises PathRefused if the parent is not there."""
    command = ("JSON.SET", keys.document, to_jsonpath(path), text)
    return Change(keys, path, command, _judged_set, loaded, True, looks, None, notices, retraction)


def _judged_set(reply: Reply) -> Any:
    return REFUSED if reply is None else None


def delete_change(keys: Keys, path: Path, **notices: Any) -> Change:
    """Return the change that removes what is at `path`; raises MissingKey if nothing is there."""

    def judge(reply: Reply) -> Any:
        if reply == 0:
            raise MissingKey(f"nothing is stored at {show(full(keys, path))}; nothing was deleted")
        return None

    return Change(keys, path, ("JSON.DEL", keys.document, to_jsonpath(path)), judge, **notices)


def append_change(keys: Keys, path: Path, texts: Sequence[bytes], loaded: tuple[Loaded, ...], **notices: Any) -> Change:
    """Return the change that appends to the list at `path`; raises MissingKey or BadType if there is none."""

    def judge(reply: Reply) -> Any:
        if reply in ([], [None]):
            raise _no_list(keys, path, nothing=not reply)
        return None

    command = ("JSON.ARRAPPEND", keys.document, to_jsonpath(path), *texts)
    return Change(keys, path, command, judge, loaded, replaces=False, **notices)


def _no_list(keys: Keys, path: Path, *, nothing: bool) -> Exception:
    where = show(full(keys, path))
    if nothing:
        return MissingKey(f"nothing is stored at {where}; write a list there first")
    return BadType(f"{where} is not a list; only lists can be appended to")


def appendable(keys: Keys, path: Path) -> Plan:
    """Plan to make sure that there is a list at `path`. Its decode raises MissingKey or BadType if there is none.

    For what goes by ship: the transaction would store it even if the server refused to append.
    """

    def decode(replies: Sequence[Reply]) -> None:
        kind = type_name(checked(replies[0], keys, path))
        if kind != "array":
            raise _no_list(keys, path, nothing=kind is None)

    return Plan([("JSON.TYPE", keys.document, to_jsonpath(path))], decode)


def takes(keys: Keys, path: Path, loaded: tuple[Loaded, ...], memory: Memory) -> Plan | None:
    """Plan to make sure that something can be set at `path`, of which `loaded` goes by ship; None if that is known.

    The transaction would store what goes by ship even if the server refused to set the rest.
    """
    known = memory.sure_members(keys.document)
    if not path or any(each.suffix.encode() in known for each in loaded):
        return None
    return settable(keys, path)


def change(it: Change, memory: Memory) -> Plan:
    """Plan one change, in one round trip unless somebody else changed the shape meanwhile, in two in lists of arrays.

    Args:
        it: The change.
        memory: What is known of the server.
    """
    return _change_exactly(it, memory) if has_index(it.path) and _moves(it, memory) else _change(it, memory)


def _change(it: Change, memory: Memory, *, held: bool = False, given_up: Callable[[], Plan] | None = None) -> Plan:
    """Plan the transaction; if the connection is `held`, it watches keys, and `given_up` is next if one changed."""
    memory.forget_numbers(it.keys.document)
    known = memory.members(it.keys.document)
    stale = _stale(it, known) if known or it.gone else []
    commands: list[Command] = []
    after: list[Command] = []
    if it.loaded or stale:
        _expect(it, memory, known, stale)
        commands = _clearing(it, stale)
        commands.extend(command for each in it.loaded for command in each.commands)
    if it.loaded:
        after.append(("SADD", it.keys.registry, *(each.suffix for each in it.loaded)))
    if it.looks:
        after.append(("SMEMBERS", it.keys.registry))
    main = len(commands)
    commands += (it.command, *after, *it.notices)

    def decode(replies: Sequence[Reply] | None) -> Any:
        if replies is None:
            assert given_up is not None  # only watched transactions are given up
            return given_up()
        if it.looks and replies == _STORED and len(commands) == len(_STORED):
            memory.saw_members(it.keys.document, _NO_MEMBERS)
            return None
        if replies == _STORED_UNSEEN:
            return None
        return _Outcome(it, memory, commands, replies, main).next()

    return Plan(commands, decode, len(commands) > (2 if it.looks else 1) or held, held)


def _moves(it: Change, memory: Memory) -> bool:
    """Return whether it, in a list, may replace something that has moved from the place after which it is named."""
    known = memory.members(it.keys.document)
    return it.replaces and it.looks and any(may_hold(it.path, _place(member)) for member in known)


def _change_exactly(it: Change, memory: Memory, coming: Sequence[Staged] = ()) -> Plan:
    """Plan to look first, and then to remove with what is replaced whatever nothing refers to any more."""

    def look(replies: Sequence[Reply]) -> Plan:
        if are_missing(replies[4:]):
            return _unwatched(lambda: _send(it, coming, lambda: _change_exactly(it, memory, coming)))
        gone = unreferred(replies[1:4], it.keys)
        if gone is None:
            return _unwatched(lambda: _change(it, memory))
        exact = it._replace(gone=gone)
        return _change(exact, memory, held=True, given_up=lambda: _again(it, coming, attempt))

    def attempt(it: Change, coming: Sequence[Staged]) -> Plan:
        return _change_exactly(it, memory, coming)

    return Plan([watch(it.keys, coming), *survey(it.keys, it.path), *looks_at(coming)], look, held=True)


def _unwatched(then: Callable[[], Plan]) -> Plan:
    return Plan([("UNWATCH",)], lambda _: then(), held=True)


def _again(it: Change, coming: Sequence[Staged], attempt: Callable[[Change, Sequence[Staged]], Plan]) -> Plan:
    """Plan the next attempt, somebody else having written meanwhile; what is large is sent before it, once."""
    if coming:
        return attempt(it, coming)
    loaded = []
    for each in it.loaded:
        commands, sent = stage(each.commands, it.keys.tag, each.suffix)
        coming = [*coming, *sent]
        loaded.append(each._replace(commands=tuple(commands)))
    moved = it._replace(loaded=tuple(loaded))
    return _send(moved, coming, lambda: attempt(moved, coming)) if coming else attempt(it, ())


def _send(it: Change, coming: Sequence[Staged], then: Callable[[], Plan]) -> Plan:
    def decode(replies: Sequence[Reply]) -> Plan:
        for reply in replies:
            checked(reply, it.keys, it.path)
        return then()

    return Plan([each.upload for each in coming], decode)


def _stale(it: Change, known: frozenset[bytes]) -> list[bytes]:
    """Return the known keys that only what is replaced can refer to, and that are not written again."""
    if not it.replaces or not it.looks:
        return []
    written = {each.suffix.encode() for each in it.loaded}
    if it.gone is not None:
        return [member for member in it.gone if member not in written]
    if has_index(it.path):
        return []
    return [member for member in known if member not in written and below(_place(member), it.path)]


def _expect(it: Change, memory: Memory, known: frozenset[bytes], stale: list[bytes]) -> None:
    """Note what may exist from now on: the reply that tells may be lost."""
    written = frozenset([each.suffix.encode() for each in it.loaded])
    if it.looks and (stale or not written <= known):
        memory.expects_members(it.keys.document, known | written)


def _place(member: bytes) -> Path:
    """Return where a member of the registry belongs; what REEM did not enter there belongs to no place."""
    try:
        return parse_suffix(member.decode())
    except (BadKey, UnicodeDecodeError):
        return ("\0",)


def _clearing(it: Change, stale: list[bytes]) -> list[Command]:
    """Return the commands that make room: no leftovers, and no foreign type under a ship's key."""
    tag = it.keys.tag.encode()
    gone = [tag + suffix for suffix in stale] + [tag + each.suffix.encode() for each in it.loaded]
    commands: list[Command] = [("UNLINK", *gone)]
    if stale:
        commands.append(("SREM", it.keys.registry, *stale))
    return commands


class _Outcome:
    """What became of a change: the result, or the next plan that puts things right and then says so."""

    __slots__ = ("commands", "it", "main", "memory", "replies")

    def __init__(
        self, it: Change, memory: Memory, commands: Sequence[Command], replies: Sequence[Reply], main: int
    ) -> None:
        self.it = it
        self.memory = memory
        self.commands = commands
        self.replies = replies
        self.main = main

    def next(self) -> Any:
        members = self._members()
        judged = self._judged()
        refused = judged is REFUSED or isinstance(judged, Exception)
        if refused and self.it.retraction is not None:
            retraction = self.it.retraction()
            return Plan(retraction, lambda _: self._settle(members, judged), atomic=True)
        return self._settle(members, judged)

    def _members(self) -> frozenset[bytes]:
        """Return what the registry held right after the change."""
        if not self.it.looks:
            return frozenset()
        place = self.main + (2 if self.it.loaded else 1)
        members = registered(self.replies[place], self.it.keys)
        self.memory.saw_members(self.it.keys.document, members)
        return members

    def _judged(self) -> Any:
        """Return the result, REFUSED, or the error to raise."""
        reply = self.replies[self.main]
        if isinstance(reply, Exception):
            return explained(reply, self.it.keys, self.it.path)
        for command, other in zip(self.commands, self.replies, strict=True):
            if isinstance(other, Exception):
                return self._partial(command, other)
        try:
            return self.it.judge(reply)
        except Exception as error:
            return error

    def _partial(self, command: Command, error: Exception) -> PartialWrite:
        where = show(full(self.it.keys, self.it.path))
        return PartialWrite(
            f"{where}: the document was written, but the server refused {command[0]} {command[1]!s:.60}: {error}; "
            "what this command should have stored cannot be read: write again"
        )

    def _settle(self, members: frozenset[bytes], judged: Any) -> Any:
        if self._suspects(members, judged):
            return clean(self.it.keys, self.memory, lambda: self._finish(judged))
        return self._finish(judged)

    def _suspects(self, members: frozenset[bytes], judged: Any) -> bool:
        """Return whether a key may exist that the document does not refer to."""
        if judged is REFUSED or isinstance(judged, Exception):
            # Of nothing that was not there to be deleted, or appended to, there can be leftovers of a broken call.
            return bool(self.it.loaded) or (isinstance(judged, MissingKey) and not self.it.path and bool(members))
        if not members or not self.it.replaces or self.it.gone is not None:
            return False
        written = {each.suffix.encode() for each in self.it.loaded}
        return any(member not in written and may_hold(self.it.path, _place(member)) for member in members)

    def _finish(self, judged: Any) -> Any:
        if judged is REFUSED:
            return diagnose(self.it.keys, self.it.path)
        if isinstance(judged, Exception):
            raise judged
        return judged


def make_parents(keys: Keys, path: Path) -> Plan:
    """Plan to put an empty dict wherever a parent of `path` is missing; leaves everything else alone."""
    prefixes = [path[:length] for length in range(len(path))]
    commands = [("JSON.SET", keys.document, to_jsonpath(prefix), b"{}", "NX") for prefix in prefixes]

    def decode(replies: Sequence[Reply]) -> None:
        for prefix, reply in zip(prefixes, replies, strict=True):
            checked(reply, keys, prefix)

    return Plan(commands, decode)


def exchange(
    it: Change, reads: Sequence[Command], before: tuple[Any, ...], memory: Memory, coming: Sequence[Staged] = ()
) -> Plan:
    """Plan a change that is made only if what `reads` fetch is still `before`.

    Raises (in decode):
        Conflict: It is not; nothing was written.
    """
    where = show(full(it.keys, it.path))
    end = 4 + len(reads)

    def refuse(_: Sequence[Reply]) -> Plan:
        raise Conflict(f"{where} was changed by somebody else while it was edited; nothing was written: edit it again")

    def compare(replies: Sequence[Reply]) -> Plan:
        if tuple(replies[4:end]) != before:
            return Plan([("UNLINK", *(each.name for each in coming))], refuse, held=True) if coming else refuse(())
        if are_missing(replies[end:]):
            return _unwatched(lambda: _send(it, coming, lambda: attempt(it, coming)))
        exact = it._replace(gone=unreferred(replies[1:4], it.keys))
        return _change(exact, memory, held=True, given_up=lambda: _again(it, coming, attempt))

    def attempt(it: Change, coming: Sequence[Staged]) -> Plan:
        return exchange(it, reads, before, memory, coming)

    commands = [watch(it.keys, coming), *survey(it.keys, it.path), *reads, *looks_at(coming)]
    return Plan(commands, compare, held=True)
