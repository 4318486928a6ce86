"""A batch of commands -> what a server without the JSON module takes, and its replies -> those of the module.

A translation is a generator: it yields what to send, is given the replies, and returns what the module would have
answered. Whoever owns a connection steps it. There are two ways:

    directly     one round trip: a read is a GET, a whole document is a SET. More than one read of a key is one GET.
    after a look two round trips, on a connection of the caller's own. What is below the top changes with its document:

        WATCH foo; GET foo         ->  the text
        MULTI; SET foo ...; EXEC   the new text, and whatever else was in the batch; nil if somebody else was first

A whole document is written directly only where it was seen, a moment ago, that a document is under the key: a SET would
replace anything else, which the module refuses. That is the only thing here that is remembered; see `Known`. Before one
is deleted, which is rare, there is always a look.
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
    framed,
    is_json,
    is_look,
    key_of,
    kind_told,
    replaces,
    run,
    text_told,
)
from .changes import after_look
from .documents import MARK, READS, WRITES, Document, is_document, stored


def shortcut(commands: Sequence[Command], known: Known) -> list[Command] | None:
    """Return what to send for what programs do most, a small read or a whole small document; None for all else.

    It is what `translated` would send; `finished` makes the answers of the replies.
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
    """Return the answers to commands for which there was a shortcut."""
    first = commands[0]
    if first[0] == "JSON.SET":
        return replies
    text = replies[0]
    if type(text) is bytes and first[2] == "$" and is_document(text):
        known.saw(key_of(first), True)
        return [b"".join((b"[", memoryview(text)[1:], b"]"))]
    text = text_told(text, key_of(first), known, error)
    return [text if isinstance(text, Exception) else run(Document(text), first, error)]


def looked_at(commands: Sequence[Command], known: Known) -> list[bytes]:
    """Return the keys of documents that have to be looked at before commands are sent; none if they go directly."""
    # A change inside of a document needs its text, and a whole one needs to know what is under the key.
    for command in commands:
        if command[0] in WRITES and not (replaces(command) and key_of(command) in known):
            return list({key_of(each): None for each in commands if is_json(each)})
    return []


def translated(commands: Sequence[Command], known: Known, error: MakeError, watched: Watched | None = None) -> Steps:
    """Return the translation of a batch.

    Args:
        commands: What a plan sends, MULTI and EXEC included.
        known: What was seen of keys.
        error: Makes error replies.
        watched: What the connection watches, if it is one caller's own for longer than this batch.
    """
    keys = looked_at(commands, known)
    if keys:
        return after_look(commands, keys, known, error, watched)
    return directly(commands, known, error, watched)


# Directly.


class _Sending:
    """What is sent for a batch, and which of the replies answers which command.

    Args:
        asking: Before each command goes ASKING: then all that is asked is sent.
    """

    def __init__(self, *, asking: bool) -> None:
        self.commands: list[Command] = []
        self.places: list[int] = []
        self._asking = asking
        self._read: dict[bytes, int] = {}

    def add(self, *commands: Command) -> None:
        """Send commands, of which the first answers."""
        self.places.append(len(self.commands))
        self.commands += commands

    def read(self, key: bytes) -> None:
        """Send a GET, unless one before tells the same."""
        if key in self._read and not self._asking:
            self.places.append(self._read[key])
        else:
            self._read[key] = len(self.commands)
            self.add(("GET", key))

    def write(self, command: Command) -> None:
        """Send what sets a whole document."""
        # A read behind it sees what it has written, so it cannot share the GET from before.
        self._read.pop(key_of(command), None)
        self.add(_whole(command))

    def look(self, command: Command) -> None:
        """Send TYPE, and what tells a document from another string."""
        between = [ASKING] if self._asking else []
        self.add(command, *between, ("GETRANGE", key_of(command), "0", "0"))


def directly(commands: Sequence[Command], known: Known, error: MakeError, watched: Watched | None = None) -> Steps:
    """Return the translation of a batch for which there is nothing that has to be `looked_at`.

    That is asked once for a batch: what is `known` of a key is known for a while only, so it may not be any more.
    """
    sending = _Sending(asking=asks(commands))
    for command in commands:
        if is_json(command):
            if command[0] in READS:
                sending.read(key_of(command))
            else:
                sending.write(command)
        elif not is_look(command):
            sending.add(command)
        elif command[0] == "TYPE":
            sending.look(command)
        else:
            # SCAN ... TYPE ReJSON-RL, which this server does not know: of the strings it finds, `_only_documents` keeps
            # some.
            sending.add((*command[:-1], "string"))
    replies = yield sending.commands
    if commands[-1][0] == "EXEC" and not isinstance(replies[-1], list):  # it was given up, or refused
        if watched is not None:
            watched.clear()
        return [replies[place] for place in sending.places]
    answers = _Answers(sending.commands, replies, known, error)
    found = [answers.of(command, place) for command, place in zip(commands, sending.places, strict=True)]
    if watched is not None:
        _follow(watched, commands, sending.places, answers)
    yield from _only_documents(commands, found)
    return framed(commands, found)


def _whole(command: Command) -> Command:
    """Return what sets the string of a document."""
    text = command[3]
    # A large text is not copied only to put one byte before it: the transport sends pieces as they are.
    marked = stored(text) if len(text) < LARGE or isinstance(text, str) else (MARK, text)
    return ("SET", key_of(command), marked, "KEEPTTL", *command[4:])


class _Answers:
    """What the module would have answered, from the replies to what was sent in its place."""

    def __init__(self, sent: Sequence[Command], replies: Sequence[Reply], known: Known, error: MakeError) -> None:
        self._sent, self._known, self._error = sent, known, error
        self._documents: dict[int, Document | Exception] = {}
        self._asking = asks(sent)
        self._replies = list(replies)
        if sent[-1][0] == "EXEC":
            self._replies[body_of(sent)] = replies[-1]

    def of(self, command: Command, place: int) -> Reply:
        """Return the answer to a command, the reply at `place` being for it."""
        reply = self._replies[place]
        if command[0] in READS and len(command) > 1:
            document = self._document(place)
            return document if isinstance(document, Exception) else run(document, command, self._error)
        if command[0] == "TYPE" and is_look(command) and reply == b"string":
            return kind_told(self._replies[place + (2 if self._asking else 1)])
        return reply

    def text(self, place: int) -> Reply:
        """Return the text of the document that the GET at `place` has read, or the error that says why not."""
        return text_told(self._replies[place], key_of(self._sent[place]), self._known, self._error)

    def _document(self, place: int) -> Document | Exception:
        if place not in self._documents:
            text = self.text(place)
            self._documents[place] = text if isinstance(text, Exception) else Document(text)
        return self._documents[place]


def _follow(watched: Watched, commands: Sequence[Command], places: Sequence[int], answers: _Answers) -> None:
    """Note what a connection watches from now on, and what was read of that."""
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
    """Look what strings a SCAN has found, and leave out of its answer what is no document."""
    for place, command in enumerate(commands):
        if command[0] != "SCAN" or not is_look(command) or isinstance(found[place], Exception):
            continue
        cursor, names = found[place]
        # Those of ships are left out before they are asked about: there may be many.
        names = [name for name in names if b"{" not in name]
        if names:
            begins = yield [("GETRANGE", name, "0", "0") for name in names]
            names = [name for name, each in zip(names, begins, strict=True) if kind_told(each) != b"string"]
        found[place] = [cursor, names]
