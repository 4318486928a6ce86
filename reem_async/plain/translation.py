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

from collections.abc import Generator, Sequence

from ..plan import Command, Reply
from ..plan.sizes import LARGE
from .batches import (
    ASKING,
    Known,
    MakeError,
    Steps,
    Watched,
    asks,
    body_of,
    document_text,
    framed,
    is_json,
    is_look,
    key_of,
    replaces,
    run,
    string_type,
)
from .changes import after_look
from .documents import MARK, READS, WRITES, TextDocument, is_document, stored


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
    """Return the keys of documents to look at before; none if the batch goes directly."""
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
    """Converts the replies to those of the module."""

    def __init__(self, sent: Sequence[Command], replies: Sequence[Reply], known: Known, error: MakeError) -> None:
        self._sent, self._known, self._error = sent, known, error
        self._documents: dict[int, TextDocument | Exception] = {}
        self._asking = asks(sent)
        self._replies = list(replies)
        if sent[-1][0] == "EXEC":
            self._replies[body_of(sent)] = replies[-1]

    def of(self, command: Command, place: int) -> Reply:
        """Return the module's reply to a command, whose reply is at `place`."""
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
