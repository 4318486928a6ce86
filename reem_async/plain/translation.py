"""Translate batches of JSON commands for servers without the JSON module, and the replies back.

A translation is a generator: it yields commands, is sent the replies, and returns the replies of the module. A
transport runs it. There are two kinds:

    directly     one round trip: a read is a GET, a whole document is a SET. Several reads of a key are one GET.
    after a look two round trips, on a connection of the call's own, for changes below the top of a document:

        WATCH foo; GET foo         ->  the text
        MULTI; SET foo ...; EXEC   the new text, and the rest of the batch; nil if another client was first

A whole document is written directly only if its key held a document a moment ago (see `Known`): a SET would replace
anything else, which the module refuses. A document is always looked at before it is deleted, which is rare.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence

from ..errors import PartialWrite, ServerFull
from ..plan import Command, Reply
from ..plan.keys import DOCUMENT
from ..plan.sizes import LARGE
from .documents import MARK, READS, WRITES, Refusal, TextDocument, is_document, stored

MakeError = Callable[[str], Exception]  # makes the error for an error reply of the server

Steps = Generator[list[Command], list[Reply], list[Reply] | None]
"""A translation; it returns None if nothing was applied because another client was first."""

ASKING: Command = ("ASKING",)
MULTI: Command = ("MULTI",)
EXEC: Command = ("EXEC",)
UNWATCH: Command = ("UNWATCH",)
_WRONG_TYPE = "Existing key has wrong Redis type"
OTHER_TYPE = ("WRONGTYPE", "Operation against a key")  # the beginnings of errors about a key that holds no string
_NAMES = READS | WRITES
_FRESH = 10.0  # seconds for which a key that held a document is known to hold one
_MOST = 4096  # known keys, so that a program that uses ever new ones does not fill its memory


class Known:
    """The keys that held documents when they were last seen."""

    def __init__(self) -> None:
        self._seen: dict[bytes, float] = {}

    def __contains__(self, key: bytes) -> bool:
        seen = self._seen.get(key)
        return seen is not None and time.monotonic() - seen < _FRESH

    def saw(self, key: bytes, there: bool) -> None:
        if not there:
            self._seen.pop(key, None)
            return
        # All at once: the next write of each key looks first, which costs one round trip.
        if len(self._seen) >= _MOST:
            self._seen = {}
        self._seen[key] = time.monotonic()


class Watched:
    """The keys that a connection watches, and the texts of those that it has read since."""

    def __init__(self) -> None:
        self.keys: set[bytes] = set()
        self.texts: dict[bytes, bytes | bytearray | None] = {}

    def clear(self) -> None:
        self.keys.clear()
        self.texts.clear()


def concerns(commands: Sequence[Command]) -> bool:
    return any(is_json(command) or is_look(command) for command in commands)


def is_json(command: Command) -> bool:
    return command[0] in _NAMES and len(command) > 1


def is_look(command: Command) -> bool:
    """Return whether it asks, or searches, for the type of keys that may hold documents."""
    if command[0] == "TYPE":
        # Keys with a tag are attachments, registries or notes, never documents.
        return b"{" not in key_of(command)
    return bool(command[0] == "SCAN" and command[-1] == DOCUMENT)


def key_of(command: Command) -> bytes:
    word = command[1]
    return word if type(word) is bytes else str(word).encode()


def is_whole(command: Command) -> bool:
    return replaces(command) or (command[0] == "JSON.DEL" and (len(command) < 3 or command[2] in ("$", ".")))


def replaces(command: Command) -> bool:
    return bool(command[0] == "JSON.SET" and command[2] in ("$", "."))


def asks(commands: Sequence[Command]) -> bool:
    """Return whether a batch begins with ASKING: it goes to the node that a slot is moving to."""
    return bool(commands[0][0] == "ASKING")


def body_of(commands: Sequence[Command]) -> slice:
    return slice(2 if asks(commands) else 1, -1)


def framed(commands: Sequence[Command], found: list[Reply]) -> list[Reply]:
    if commands[-1][0] != "EXEC":
        return found
    body = body_of(commands)
    return [*([b"OK"] * body.start), *([b"QUEUED"] * (len(commands) - body.start - 1)), found[body]]


def string_type(begins: Reply) -> bytes:
    return DOCUMENT.encode() if isinstance(begins, bytes) and is_document(begins) else b"string"


def document_text(reply: Reply, key: bytes, known: Known, error: MakeError) -> Reply:
    """Return the text in a reply to GET, or the module's error if the key holds no document."""
    if isinstance(reply, Exception):
        # GET of a list or a hash; plans know the module's message only.
        return error(_WRONG_TYPE) if str(reply).startswith(OTHER_TYPE) else reply
    known.saw(key, reply is not None and is_document(reply))
    return reply if reply is None or is_document(reply) else error(_WRONG_TYPE)


def run(document: TextDocument, command: Command, error: MakeError) -> Reply:
    try:
        return document.run(command)
    except Refusal as refusal:
        return error(str(refusal))


def shortcut(commands: Sequence[Command], known: Known) -> list[Command] | None:
    """Return the commands for the most frequent batches, a small read or a whole small document; None for others.

    `translated` would send the same, but takes longer; `finished` makes the answers of the replies.
    """
    first = commands[0]
    if first[0] == "JSON.GET":
        return [("GET", first[1])] if len(commands) == 1 and len(first) == 3 else None
    if first[0] != "JSON.SET" or len(first) != 4 or first[2] != "$" or len(first[3]) >= LARGE:
        return None
    # SMEMBERS of the registry goes with nearly every write, see `plan.writes`.
    if len(commands) > 2 or (len(commands) == 2 and commands[1][0] != "SMEMBERS") or key_of(first) not in known:
        return None
    return [("SET", first[1], stored(first[3]), "KEEPTTL"), *commands[1:]]


def finished(commands: Sequence[Command], replies: list[Reply], known: Known, error: MakeError) -> list[Reply]:
    first = commands[0]
    if first[0] == "JSON.SET":
        return replies
    text = replies[0]
    if type(text) is bytes and first[2] == "$" and is_document(text):
        known.saw(key_of(first), True)
        return [b"".join((b"[", memoryview(text)[1:], b"]"))]
    text = document_text(text, key_of(first), known, error)
    return [text if isinstance(text, Exception) else run(TextDocument(text), first, error)]


def looked_at(commands: Sequence[Command], known: Known) -> list[bytes]:
    for command in commands:
        if command[0] in WRITES and not (replaces(command) and key_of(command) in known):
            return list({key_of(each): None for each in commands if is_json(each)})
    return []


def translated(commands: Sequence[Command], known: Known, error: MakeError, watched: Watched | None = None) -> Steps:
    """Return the translation of a batch, MULTI and EXEC included.

    `watched` are the keys that the plan watches, if it keeps the connection for longer than this batch.
    """
    keys = looked_at(commands, known)
    if keys:
        return after_look(commands, keys, known, error, watched)
    return directly(commands, known, error, watched)


def directly(commands: Sequence[Command], known: Known, error: MakeError, watched: Watched | None = None) -> Steps:
    """Return the translation of a batch whose documents need not be `looked_at`."""
    asking = [ASKING] if asks(commands) else []  # precedes each command
    sent: list[Command] = []
    places: list[int] = []  # where in it the reply to each command is
    read: dict[bytes, int] = {}
    for command in commands:
        places.append(len(sent))
        if command[0] in READS and is_json(command):
            key = key_of(command)
            if key in read and not asking:
                places[-1] = read[key]
                continue
            read[key] = len(sent)
            sent.append(("GET", key))
        elif is_json(command):
            # A later read must see the new text, so it cannot share an earlier GET.
            read.pop(key_of(command), None)
            sent.append(_whole(command))
        elif not is_look(command):
            sent.append(command)
        elif command[0] == "TYPE":
            sent += [command, *asking, ("GETRANGE", key_of(command), "0", "0")]
        else:
            # SCAN ... TYPE ReJSON-RL: the server finds strings, of which `_only_documents` keeps the documents.
            sent.append((*command[:-1], "string"))
    replies = yield sent
    if commands[-1][0] == "EXEC" and not isinstance(replies[-1], list):  # a watched key has changed, or refused
        if watched is not None:
            watched.clear()
        return [replies[place] for place in places]
    answers = _Answers(sent, replies, known, error)
    found = [answers.of(command, place) for command, place in zip(commands, places, strict=True)]
    if watched is not None:
        _follow(watched, commands, places, answers)
    yield from _only_documents(commands, found)
    return framed(commands, found)


def _whole(command: Command) -> Command:
    text = command[3]
    # A large text is not copied to put one byte before it: the transport sends pieces as they are.
    marked = stored(text) if len(text) < LARGE or isinstance(text, str) else (MARK, text)
    return ("SET", key_of(command), marked, "KEEPTTL", *command[4:])


class _Answers:
    def __init__(self, sent: Sequence[Command], replies: Sequence[Reply], known: Known, error: MakeError) -> None:
        self._sent, self._known, self._error = sent, known, error
        self._documents: dict[int, TextDocument | Exception] = {}
        self._asking = asks(sent)
        self._replies = list(replies)
        if sent[-1][0] == "EXEC":
            self._replies[body_of(sent)] = replies[-1]

    def of(self, command: Command, place: int) -> Reply:
        reply = self._replies[place]
        if command[0] in READS and len(command) > 1:
            document = self._document(place)
            return document if isinstance(document, Exception) else run(document, command, self._error)
        if command[0] == "TYPE" and is_look(command) and reply == b"string":
            return string_type(self._replies[place + (2 if self._asking else 1)])
        return reply

    def text(self, place: int) -> Reply:
        return document_text(self._replies[place], key_of(self._sent[place]), self._known, self._error)

    def _document(self, place: int) -> TextDocument | Exception:
        if place not in self._documents:
            text = self.text(place)
            self._documents[place] = text if isinstance(text, Exception) else TextDocument(text)
        return self._documents[place]


def _follow(watched: Watched, commands: Sequence[Command], places: Sequence[int], answers: _Answers) -> None:
    """Note the keys that a connection watches from now on, and their texts that were read."""
    for command, place in zip(commands, places, strict=True):
        if command[0] == "WATCH" and not isinstance(answers.of(command, place), Exception):
            watched.keys.update(word if type(word) is bytes else str(word).encode() for word in command[1:])
        elif command[0] in ("EXEC", "UNWATCH"):
            watched.clear()
        elif command[0] in READS and is_json(command) and key_of(command) in watched.keys:
            text = answers.text(place)
            if not isinstance(text, Exception):
                watched.texts[key_of(command)] = text


def _only_documents(commands: Sequence[Command], found: list[Reply]) -> Generator[list[Command], list[Reply], None]:
    """Leave the strings that are no documents out of the reply to a SCAN."""
    for place, command in enumerate(commands):
        if command[0] != "SCAN" or not is_look(command) or isinstance(found[place], Exception):
            continue
        cursor, names = found[place]
        # Attachments first, without asking: there may be many.
        names = [name for name in names if b"{" not in name]
        if names:
            begins = yield [("GETRANGE", name, "0", "0") for name in names]
            names = [name for name, each in zip(names, begins, strict=True) if string_type(each) != b"string"]
        found[place] = [cursor, names]


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
