"""Batches of commands, and the keys that are known to hold documents: shared by both kinds of translation."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence

from ..plan import Command, Reply
from ..plan.keys import DOCUMENT
from .documents import READS, WRITES, TextDocument, is_document
from .paths import Refusal

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
    """Return whether any command needs a translation."""
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
    """Return whether it sets or deletes a whole document."""
    return replaces(command) or (command[0] == "JSON.DEL" and (len(command) < 3 or command[2] in ("$", ".")))


def replaces(command: Command) -> bool:
    return bool(command[0] == "JSON.SET" and command[2] in ("$", "."))


def asks(commands: Sequence[Command]) -> bool:
    """Return whether a batch begins with ASKING: it goes to the node that a slot is moving to."""
    return bool(commands[0][0] == "ASKING")


def body_of(commands: Sequence[Command]) -> slice:
    """Return the positions of a transaction's commands."""
    return slice(2 if asks(commands) else 1, -1)


def framed(commands: Sequence[Command], found: list[Reply]) -> list[Reply]:
    """Return the replies as a server with the module would: those of a transaction are in the reply to EXEC."""
    if commands[-1][0] != "EXEC":
        return found
    body = body_of(commands)
    return [*([b"OK"] * body.start), *([b"QUEUED"] * (len(commands) - body.start - 1)), found[body]]


def string_type(begins: Reply) -> bytes:
    """Return the reply of TYPE for a string that begins so."""
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
