"""Batches of commands, and what is known of the documents they are about: what both ways of a translation use."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence

from ..plan import Command, Reply
from ..plan.keys import DOCUMENT
from .documents import READS, WRITES, Document, is_document
from .paths import Refusal

MakeError = Callable[[str], Exception]
"""Makes the error that an error reply of the server stands for."""

Steps = Generator[list[Command], list[Reply], list[Reply] | None]
"""What a translation is; it returns None if nothing was applied because somebody else was first."""

ASKING: Command = ("ASKING",)
MULTI: Command = ("MULTI",)
EXEC: Command = ("EXEC",)
UNWATCH: Command = ("UNWATCH",)
_WRONG_TYPE = "Existing key has wrong Redis type"
OTHER_TYPE = ("WRONGTYPE", "Operation against a key")
"""How an error begins that says that something else is under a key than a string."""
_NAMES = READS | WRITES
_FRESH = 10.0
"""Seconds for which a key is taken for a document's after it was seen to be one."""
# Keys, so that a program that goes through ever new ones does not fill its memory.
_MOST = 4096


class Known:
    """The keys that were seen to hold documents, and when."""

    def __init__(self) -> None:
        self._seen: dict[bytes, float] = {}

    def __contains__(self, key: bytes) -> bool:
        seen = self._seen.get(key)
        return seen is not None and time.monotonic() - seen < _FRESH

    def saw(self, key: bytes, there: bool) -> None:
        """Note whether a document was seen under a key."""
        if not there:
            self._seen.pop(key, None)
            return
        # Forgotten as a whole: the next write of each key looks first, which costs it one round trip.
        if len(self._seen) >= _MOST:
            self._seen = {}
        self._seen[key] = time.monotonic()


class Watched:
    """What a connection has watched since its last transaction.

    Attributes:
        keys: The keys.
        texts: What was found under those that were read since.
    """

    def __init__(self) -> None:
        self.keys: set[bytes] = set()
        self.texts: dict[bytes, bytes | bytearray | None] = {}

    def clear(self) -> None:
        """Note that nothing is watched any more."""
        self.keys.clear()
        self.texts.clear()


def concerns(commands: Sequence[Command]) -> bool:
    """Return whether any command knows of documents."""
    return any(is_json(command) or is_look(command) for command in commands)


def has_json(commands: Sequence[Command]) -> bool:
    """Return whether there is a JSON command among them."""
    return any(map(is_json, commands))


def is_json(command: Command) -> bool:
    """Return whether it is a JSON command about a key."""
    return command[0] in _NAMES and len(command) > 1


def is_look(command: Command) -> bool:
    """Return whether it asks, or looks, for the type of keys."""
    if command[0] == "TYPE":
        # What carries a tag is a ship's key, a registry or a note: never a document, so its TYPE needs no second
        # question.
        return b"{" not in key_of(command)  # others belong to a document, and are none
    return bool(command[0] == "SCAN" and command[-1] == DOCUMENT)


def key_of(command: Command) -> bytes:
    """Return the key of a command."""
    word = command[1]
    return word if type(word) is bytes else str(word).encode()


def is_whole(command: Command) -> bool:
    """Return whether it sets or deletes a document as a whole."""
    return replaces(command) or (command[0] == "JSON.DEL" and (len(command) < 3 or command[2] in ("$", ".")))


def replaces(command: Command) -> bool:
    """Return whether it sets a document as a whole."""
    return bool(command[0] == "JSON.SET" and command[2] in ("$", "."))


def asks(commands: Sequence[Command]) -> bool:
    """Return whether a batch is sent with ASKING, to the node that a slot is moving to."""
    return bool(commands[0][0] == "ASKING")


def body_of(commands: Sequence[Command]) -> slice:
    """Return where the commands of a transaction are."""
    return slice(2 if asks(commands) else 1, -1)


def framed(commands: Sequence[Command], found: list[Reply]) -> list[Reply]:
    """Return one reply for each command: those of a transaction are in the one to EXEC."""
    if commands[-1][0] != "EXEC":
        return found
    # As the module's server answers: OK to MULTI, QUEUED to each command, and all replies in the one to EXEC.
    body = body_of(commands)
    return [*([b"OK"] * body.start), *([b"QUEUED"] * (len(commands) - body.start - 1)), found[body]]


def kind_told(begins: Reply) -> bytes:
    """Return what TYPE says of a string, given what that begins with."""
    return DOCUMENT.encode() if isinstance(begins, bytes) and is_document(begins) else b"string"


def text_told(reply: Reply, key: bytes, known: Known, error: MakeError) -> Reply:
    """Return the text in a reply to GET, or the error of the module about what is under the key."""
    if isinstance(reply, Exception):
        # GET of a list or a hash; the plans above know the words of the module only.
        return error(_WRONG_TYPE) if str(reply).startswith(OTHER_TYPE) else reply
    known.saw(key, reply is not None and is_document(reply))
    return reply if reply is None or is_document(reply) else error(_WRONG_TYPE)


def run(document: Document, command: Command, error: MakeError) -> Reply:
    """Carry out a command on a document; return its reply, an error too."""
    try:
        return document.run(command)
    except Refusal as refusal:
        return error(str(refusal))
