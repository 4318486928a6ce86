"""Changes below the top of a document: read the text under WATCH, then store the new text in a transaction."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import PartialWrite, ServerFull
from ..plan import Command, Reply
from .batches import (
    ASKING,
    EXEC,
    MULTI,
    OTHER_TYPE,
    UNWATCH,
    Known,
    MakeError,
    Steps,
    Watched,
    asks,
    body_of,
    document_text,
    framed,
    is_json,
    is_whole,
    key_of,
    run,
)
from .documents import TextDocument

_FRAME = frozenset(["ASKING", "MULTI", "EXEC"])
_STORING = frozenset(["SET", "UNLINK"])
_SEEING = frozenset(["GET", "TYPE", "GETRANGE"])


def after_look(
    commands: Sequence[Command], keys: Sequence[bytes], known: Known, error: MakeError, watched: Watched | None
) -> Steps:
    """Return the translation of a batch that changes the documents `keys`, which must be read before.

    `watched` are the keys that the plan itself watches on this connection.
    """
    # First WATCH and read. If that fails, nothing else is sent. Then the transaction. If another client wrote in
    # between, the transport starts again, unless the plan itself watches keys: then the plan does.
    look = _Look(commands, keys, watched or Watched(), known, error)
    replies = (yield look.commands) if look.commands else []
    # A key of another type is an answer: `documents` makes it the module's error.
    errors = [each for each in replies if isinstance(each, Exception) and not str(each).startswith(OTHER_TYPE)]
    if errors:
        if watched is None:
            yield [UNWATCH]
        return _not_looked(commands, errors[0])
    change = _Change(commands, look.documents(replies), error)
    sent = change.commands(watched is not None)
    outcome = (yield sent) if sent else []
    if any(isinstance(reply, ServerFull) for reply in outcome) and change.only_deletes():
        outcome = yield change.alone()
    # EXEC ends the watch in any case.
    if watched is not None and sent:
        watched.clear()
    if change.end and outcome[change.end] is None:  # another client was first
        return None if watched is None or not change.is_whole else [b"QUEUED"] * (len(commands) - 1) + [None]
    return change.answers(outcome, known)


def _not_looked(commands: Sequence[Command], failed: Exception) -> list[Reply]:
    """Return the replies to a batch that was not sent: the error for its JSON commands, and for EXEC."""
    if commands[-1][0] != "EXEC":
        return [failed] * len(commands)
    return [failed if is_json(command) or command[0] == "EXEC" else b"QUEUED" for command in commands]


class _Look:
    """The commands that watch and read documents before a change, and their replies."""

    def __init__(
        self, commands: Sequence[Command], keys: Sequence[bytes], watched: Watched, known: Known, error: MakeError
    ) -> None:
        self._keys, self._watched, self._known, self._error = keys, watched, known, error
        # A text is fetched only if the document is changed inside: one that is replaced may be large.
        self._read = {key_of(each) for each in commands if is_json(each) and not is_whole(each)}
        looks: list[Command] = [("WATCH", key) for key in keys if key not in watched.keys]
        for key in keys:
            if key not in watched.texts:
                looks += [("GET", key)] if key in self._read else [("TYPE", key), ("GETRANGE", key, "0", "0")]
        self.commands = [word for look in looks for word in (ASKING, look)] if asks(commands) else looks

    def documents(self, replies: Sequence[Reply]) -> dict[bytes, TextDocument | Exception]:
        found: dict[bytes, TextDocument | Exception] = {}
        answers = iter([reply for reply, look in zip(replies, self.commands, strict=True) if look[0] in _SEEING])
        for key in self._keys:
            if key in self._watched.texts:
                text: Reply = self._watched.texts[key]
            else:
                text = next(answers)
                if key not in self._read:
                    begins = next(answers)
                    text = None if text == b"none" else begins
            text = document_text(text, key, self._known, self._error)
            found[key] = text if isinstance(text, Exception) else TextDocument(text)
        return found


class _Change:
    """A batch, executed on the texts of its documents, and the commands that store the new texts."""

    def __init__(
        self, commands: Sequence[Command], documents: dict[bytes, TextDocument | Exception], error: MakeError
    ) -> None:
        self._commands, self._documents = commands, documents
        self._asking = [ASKING] if asks(commands) else []
        self._answers: list[Reply] = [b"OK"] * len(commands)
        self._others: list[int] = []
        last: dict[bytes, int] = {}
        for place, command in enumerate(commands):
            if is_json(command):
                key = key_of(command)
                last[key], document = place, documents[key]
                self._answers[place] = document if isinstance(document, Exception) else run(document, command, error)
            elif command[0] not in _FRAME:
                self._others.append(place)
        # Several changes of one document become one SET, in the place of the last of them.
        changed = {
            key for key, document in documents.items() if isinstance(document, TextDocument) and document.changed
        }
        self._last = {place: key for key, place in last.items() if key in changed}
        self._places: dict[int, int] = {}
        self._sent: list[Command] = []
        self.end = 0  # the position of EXEC among what is sent; 0 if it is not
        self.is_whole = bool(commands[-1][0] == "EXEC")  # whether the batch is a transaction

    def commands(self, held: bool) -> list[Command]:
        """Return the commands: a transaction, and behind it those that were not in one."""
        inside = sorted([*self._last, *self._others]) if self.is_whole else list(self._last)
        if inside:
            self._sent = [*self._asking, MULTI]
            self._add(inside)
            self.end = len(self._sent)
            self._sent.append(EXEC)
        # Nothing is changed after all (NX, or nothing to delete), but keys are watched.
        elif not held or self.is_whole:
            self._sent = [UNWATCH]
        if not self.is_whole:
            self._add(self._others, self._asking)
        return self._sent

    def only_deletes(self) -> bool:
        """Return whether it is no transaction and only deletes documents."""
        return (
            self.end > 0
            and not self.is_whole
            and not any(_is_there(self._documents[key]) for key in self._last.values())
            and all(self._commands[place][0] == "SMEMBERS" for place in self._others)
        )

    def alone(self) -> list[Command]:
        """Return the commands without a transaction: a Redis that is out of memory accepts only single deletions."""
        self._sent, self.end = [], 0
        self._add(sorted(self._places), self._asking)
        return self._sent

    def _add(self, places: Sequence[int], asking: Sequence[Command] = ()) -> None:
        for place in places:
            self._sent += asking
            self._places[place] = len(self._sent)
            key = self._last.get(place)
            self._sent.append(self._commands[place] if key is None else _storing(key, self._documents[key]))

    def answers(self, replies: Sequence[Reply], known: Known) -> list[Reply]:
        replies, answers = list(replies), self._answers
        if self.end:
            outcome = replies[self.end]
            if not isinstance(outcome, list):
                return self._refused(replies, outcome)
            # Put each reply at the position of its command, as without a transaction.
            replies[body_of(self._sent).start : self.end] = outcome
        for place, at in self._places.items():
            key = self._last.get(place)
            if key is None or isinstance(replies[at], Exception):
                answers[place] = replies[at]
            else:
                known.saw(key, _is_there(self._documents[key]))
        return framed(self._commands, answers)

    def _refused(self, replies: list[Reply], outcome: Reply) -> list[Reply]:
        """Return the replies if the server refused the transaction."""
        answers: list[Reply] = [b"QUEUED"] * len(self._commands)
        for place, at in self._places.items():
            answers[place] = replies[at]
        if self.is_whole:
            answers[0], answers[-1] = replies[0], outcome
            return answers
        # The plan knows of no transaction: the reason for the refusal is the reply to its commands.
        reason = next((reply for reply in replies if isinstance(reply, Exception)), outcome)
        stored = [reply for place, reply in enumerate(replies) if place < self.end and self._sent[place][0] in _STORING]
        if reason is replies[self._sent.index(MULTI)] and not any(isinstance(reply, Exception) for reply in stored):
            reason = PartialWrite(f"{reason}; MULTI was refused, so a change by another client in between may be lost")
        for place, command in enumerate(self._commands):
            if is_json(command):
                answers[place] = reason
        return answers


def _is_there(document: TextDocument | Exception) -> bool:
    return isinstance(document, TextDocument) and document.exists


def _storing(key: bytes, document: TextDocument | Exception) -> Command:
    assert isinstance(document, TextDocument)
    return ("SET", key, document.string(), "KEEPTTL") if document.exists else ("UNLINK", key)
