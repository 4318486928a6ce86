"""The messages between the callers and the servers of a service: encode, decode, and check what arrives.

A line of JSON. A small value follows it, as in a notice: the text of the document and the bytes of its attachments. A
large value is stored under keys that expire, or is in a slot of shared memory. Messages that arrive are not trusted:
anything unexpected is refused as `BadData`. Which keys are read is never taken from a message, only their ends.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import orjson

from ..concurrency.timeouts import LONGEST
from ..errors import BadData, BadKey, RemoteError
from ..local.path import LocalPath
from ..plan import Command, Plan, Reply, blamed
from ..plan.changes import EncodedAttachment
from ..plan.keys import Keys
from ..plan.notices import Slot, View, assembled, named, sizes_of_parts, starts
from ..plan.paths import Path, escaped, parse_suffix, suffix
from ..plan.reads import with_bytes
from ..ships.registry import Ships

VERSION = 1
LARGEST_INLINE = 1 << 16
"""Bytes of a value up to which the message carries it. A server of Redis cuts off a subscriber that is 32 MB behind."""
MARGIN = 5.0  # seconds for which a stored value outlives the deadline of its call
LONGEST_TEXT = 1 << 14  # characters of a remote traceback, of which the end is sent
_LARGEST = 1 << 18  # bytes of a message: far more than LARGEST_INLINE bytes of value and the names of its arrays
_MOST = 1 << 53  # bytes of a value: every JSON parser has integers up to it
_LONGEST_SUFFIX = 4096  # characters in the end of an attachment's key
_DEEPEST = 128  # levels of a document

CALL: Final = "call"  # of a caller: handle this within so many seconds
CANCEL: Final = "cancel"  # the caller has left
PING: Final = "ping"
RECEIVED: Final = "received"  # the answer was taken out of shared memory
ASKED: Final = "asked"  # of a caller: how is the server doing
UNREAD: Final = "unread"  # of either side: what was sent in shared memory cannot be read there, send it by the server
ANSWER: Final = "answer"  # of a server: the value
FAILED: Final = "failed"  # the function raised
BUSY: Final = "busy"  # too many requests wait; this one was not begun
CLOSED: Final = "closed"  # it stops serving; this request was not begun
DROPPED: Final = "dropped"  # it stops serving; this request was begun
PONG: Final = "pong"
STATED: Final = "stated"  # host, process, calls, errors, median seconds of a call, seconds since it began

_KINDS = {CALL, CANCEL, PING, RECEIVED, ASKED, UNREAD, ANSWER, FAILED, BUSY, CLOSED, DROPPED, PONG, STATED}
_WITH_VALUE = {CALL, ANSWER}
_WORDS = {CALL: 1, ANSWER: 1, FAILED: 3, STATED: 6}  # how many texts a message has
_HERE, _STORED = "here", "stored"

Encoded = tuple[bytes, Sequence[EncodedAttachment]]  # a value: the text of the document, and the attachments


class Content(NamedTuple):
    """Where the value of a message is, and what it consists of."""

    place: str | Slot  # in the message, under keys that expire, or in shared memory
    text_size: int
    parts: list[tuple[str, str, int]]  # of each attachment the ship's label, the end of its key, and its bytes
    data: bytes = b""  # what follows the header
    view: memoryview | None = None  # its bytes in shared memory, once they are found there

    @property
    def is_stored(self) -> bool:
        return self.place == _STORED

    def seen(self, view_of: View) -> Content:
        """Return this with its bytes, if it is in shared memory and they are there."""
        if not isinstance(self.place, Slot):
            return self
        return self._replace(view=view_of(self.place, starts(self.sizes)[-1]))

    @property
    def is_missing(self) -> bool:
        """Whether it is in shared memory that cannot be read."""
        return isinstance(self.place, Slot) and self.view is None

    @property
    def sizes(self) -> list[int]:
        return [self.text_size, *(size for _, _, size in self.parts)]


class Message(NamedTuple):
    """One message, as it arrived."""

    kind: str
    call: str  # the id of the call; empty in pings and pongs
    sender: str  # the id of the caller or of the server
    number: float = 0.0  # of a caller: seconds that are left; of a server: requests that wait or are handled there
    words: Sequence[str] = ()  # CALL, ANSWER: the sender's host, for shared memory; FAILED: type, message, traceback
    content: Content | None = None


class Names(NamedTuple):
    """The names on the server of what belongs to one service."""

    keys: Keys  # of the top-level key
    path: Path  # below it

    def channel(self, server: str) -> str:
        """Return the channel of requests to one server; while it has a subscriber, that server is there."""
        return f"{self._tag}:serve@{server}"

    @property
    def pattern(self) -> str:
        """The glob of the channels of all its servers."""
        return f"{escaped(self._tag)}:serve@{'?' * ID}"

    @property
    def _tag(self) -> str:
        database = self.keys.channel.rpartition("}:notices")[2]  # channels are shared by all databases of a server
        return f"{self.keys.tag}{suffix(self.path)}{database}"

    @staticmethod
    def of(channel: str, session_keys: Callable[[str], Keys], namespace: str) -> Names | None:
        """Return the names of the service whose channel of requests this is; None if it is none, or elsewhere."""
        body, _, server = channel.rpartition(":serve@")
        name, _, rest = body.removeprefix("{" + namespace).partition("}")
        if not is_id(server) or not body.startswith("{" + namespace):
            return None
        try:
            keys = session_keys(name)
            database = keys.channel.rpartition("}:notices")[2]
            found = Names(keys, parse_suffix(rest.removesuffix(database)))
        except BadKey:
            return None
        return found if found.channel(server) == channel else None

    def request(self, call: str) -> str:
        """Return the beginning of the keys that hold a large request."""
        return f"{self.keys.tag}:call:{call}"

    def answer(self, call: str) -> str:
        """Return the beginning of the keys that hold a large answer."""
        return f"{self.keys.tag}:answer:{call}"


def answers(keys: Keys, caller: str) -> str:
    """Return the channel of the answers to one caller of the services under a top-level key."""
    return f"{keys.tag}:answers@{caller}"


ID = 16  # characters of an id, hexadecimal


def is_id(text: Any) -> bool:
    return type(text) is str and len(text) == ID and not set(text) - set("0123456789abcdef")


def is_small(value: Encoded) -> bool:
    """Return whether a message can carry a value."""
    return sum(sizes_of_parts(*value)) <= LARGEST_INLINE and is_bytes(value)


def is_bytes(value: Encoded) -> bool:
    """Return whether all of a value is bytes, and not what the commands of a user's ship store."""
    return all(each.blob is not None for each in value[1])


def put(local: LocalPath, keys: Keys, channel: str, value: Encoded) -> Slot | None:
    """Copy a value into shared memory; None if there is no room, or if a ship of a user stores a part of it.

    It holds while none of the five next values of the same channel is put there.
    """
    text, attachments = value
    pieces = [text, *(piece for each in attachments for piece in each.blob or ())]
    return local.put(keys._replace(channel=channel), pieces, sizes_of_parts(*value)) if is_bytes(value) else None


def inline(message: Message, value: Encoded) -> bytes:
    """Return a message that carries its value."""
    text, attachments = value
    blobs = [piece for each in attachments for piece in each.blob or ()]
    return b"".join([_header(message, _HERE, value), text, *blobs])


def in_slot(message: Message, value: Encoded, slot: Slot) -> bytes:
    """Return a message whose value is in shared memory."""
    return _header(message, [*slot, len(value[0])], value)


def stored(message: Message, value: Encoded, prefix: str, left: float) -> tuple[bytes, list[Command]]:
    """Return a message whose value is stored, and the commands that store it until after the deadline.

    Args:
        message: What it is.
        value: Encoded for keys that begin with `prefix`.
        prefix: The beginning of the keys.
        left: Seconds until the deadline.
    """
    text, attachments = value
    kept = str(math.ceil((left + MARGIN) * 1000))
    commands: list[Command] = []
    for each in attachments:
        if each.blob is not None:
            commands += [(*command, "PX", kept) for command in each.commands]
        else:  # the ship of a user chose the commands
            commands += [*each.commands, ("PEXPIRE", prefix + each.suffix, kept)]
    if len(text) > LARGEST_INLINE:
        commands.append(("SET", _text_key(prefix), text, "PX", kept))
        text = b""
    return _header(message, _STORED, value) + text, commands


def keys_of(prefix: str, value: Encoded) -> list[str]:
    """Return the keys that hold a stored value."""
    return [_text_key(prefix), *(prefix + each.suffix for each in value[1])]


def bare(message: Message) -> bytes:
    """Return a message without a value."""
    return _header(message, "", (b"", ()))


def failure(call: str, sender: str, waiting: int, error: BaseException, trace: str) -> bytes:
    """Return the message that a function raised."""
    kind = type(error).__qualname__
    words = [_shortened(kind, 200), _shortened(_text_of(error), 4096), _shortened(trace, LONGEST_TEXT)]
    return bare(Message(FAILED, call, sender, waiting, words))


def _text_of(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:  # its __str__ is the user's
        return "(its text cannot be shown)"


def _shortened(text: str, longest: int) -> str:
    text = text.encode("utf-8", "replace").decode()  # JSON has no halves of surrogate pairs
    return text if len(text) <= longest else f"...{text[3 - longest :]}"


def _header(message: Message, place: str | list[Any], value: Encoded) -> bytes:
    sizes = sizes_of_parts(*value)
    parts = [[each.label, each.suffix, size] for each, size in zip(value[1], sizes[1:], strict=True)]
    kind, call, sender, number, words, _ = message
    return orjson.dumps([VERSION, kind, call, sender, number, [*words], place, sizes[0], parts]) + b"\n"


def decode(payload: Any) -> Message:
    """Return the message in `payload`; raises BadData for what is none of REEM, or of an unknown version."""
    if type(payload) is not bytes or len(payload) > _LARGEST:
        raise BadData(f"a message of {len(payload)} bytes is none of a service; it was not written by REEM")
    end = payload.find(b"\n")
    try:
        version, kind, call, sender, number, words, place, size, parts = orjson.loads(payload[: max(end, 0)])
    except (orjson.JSONDecodeError, ValueError, TypeError):
        raise BadData(f"a message begins with {payload[:60]!r}, which is not REEM's") from None
    if version != VERSION:
        raise BadData(f"a message has version {version!r:.40}; this program knows {VERSION}: update reem")
    sound = (
        type(kind) is str
        and kind in _KINDS
        and is_id(sender)
        and (is_id(call) or (kind in (PING, PONG) and call == ""))
        and type(number) in (int, float)
        and 0 <= number <= LONGEST
        and type(words) is list
        and len(words) == _WORDS.get(kind, 0)
        and all(type(word) is str for word in words)
    )
    if not sound:
        raise BadData("a message of a service has fields of wrong types or out of range; it was not written by REEM")
    content = _content(place, size, parts, payload[end + 1 :]) if kind in _WITH_VALUE else None
    return Message(kind, call, sender, float(number), words, content)


def _content(place: Any, size: Any, parts: Any, data: bytes) -> Content:
    where: str | Slot | None = None
    if type(place) is list:
        found = named(place)
        where = found[0] if found is not None and found[1] == size else None
    elif type(place) is str and place in (_HERE, _STORED):
        where = place
    sound = where is not None and _is_size(size) and type(parts) is list and all(_is_part(part) for part in parts)
    if sound and where == _HERE:
        sound = len(data) == size + sum(part[2] for part in parts)
    elif sound and where == _STORED:
        sound = len(data) in (0, size)
    if not sound or where is None:
        raise BadData("a message of a service has a value that cannot be; it was not written by REEM")
    return Content(where, size, [(label, tail, length) for label, tail, length in parts], data)


def _is_size(size: Any) -> bool:
    return type(size) is int and 0 <= size < _MOST


def _is_part(part: Any) -> bool:
    return (
        type(part) is list
        and len(part) == 3
        and type(part[0]) is str
        and type(part[1]) is str
        and len(part[1]) <= _LONGEST_SUFFIX
        and part[1][:1] in ("", ".", "[")  # else it would be the key of something else
        and _is_size(part[2])
    )


def pieces_of(content: Content) -> list[Any]:
    """Return the parts of a value in its message or in shared memory: the text, then each attachment."""
    if content.view is not None:
        view, begins = content.view, starts(content.sizes)[:-1]
        text, *rest = [view[start : start + size] for start, size in zip(begins, content.sizes, strict=True)]
        return [bytes(text), *rest]
    position, pieces = 0, []
    for size in content.sizes:
        pieces.append(content.data[position : position + size])
        position += size
    return pieces


def again(content: Content, prefix: str) -> Encoded:
    """Return a value in shared memory, to be stored under keys that begin with `prefix`."""
    text, *blobs = pieces_of(content)
    return text, [
        EncodedAttachment(tail, label, (("SET", prefix + tail, bytes(blob)),), (bytes(blob),))
        for (label, tail, _), blob in zip(content.parts, blobs, strict=True)
    ]


def fetch(content: Content, prefix: str, ships: Ships, where: str) -> Plan:
    """Plan to take a stored value from the server, where nothing is left of it; the result is its parts.

    Raises:
        BadData: An interface without the ship that wrote a part; and if the value has expired, from the plan.
    """
    keys = [prefix + tail for _, tail, _ in content.parts]
    reads = [
        ships.labelled(label, where).read_command(key) for (label, _, _), key in zip(content.parts, keys, strict=True)
    ]
    if not content.data:
        keys, reads = [_text_key(prefix), *keys], [("GET", _text_key(prefix)), *reads]
    commands = [*reads, ("UNLINK", *keys)] if keys else []

    def decode(replies: Sequence[Reply]) -> list[Any]:
        for reply, command in zip(replies, commands, strict=True):
            if isinstance(reply, Exception):
                raise blamed(reply, command)
        text = content.data or replies[0]
        if text is None or len(text) != content.text_size:
            raise BadData(f"{where}: the value is not on the server any more; it was kept until after the deadline")
        return [bytes(text), *replies[0 if content.data else 1 : -1]]

    return Plan(commands, decode, atomic=True, bulk=sum(content.sizes) > LARGEST_INLINE)


def _text_key(prefix: str) -> str:
    return f"{prefix}:text"


async def opened(content: Content, pieces: Sequence[Any], ships: Ships, where: str) -> Any:
    """Return the value that is made of its parts; waits only for ships with `async def` methods.

    Raises:
        BadData: They make no value.
    """
    await ships.ready()
    values: dict[tuple[str, str], Any] = {}
    try:
        for (label, tail, _), piece in zip(content.parts, pieces[1:], strict=True):
            ship = ships.labelled(label, where)
            if not content.is_stored and ship.blob is None:
                raise BadData(f"{where}: the ship {label!r} of this interface reads in another way than the sender's")
            value = ship.ship.interpret_read([piece if ship.blob is not None else with_bytes(piece)])
            values[label, tail] = await value if inspect.isawaitable(value) else value
        return assembled(pieces[0], values, _DEEPEST)
    except BadData:
        raise
    except Exception as error:  # a ship may raise anything over foreign bytes
        raise BadData(f"{where}: a value cannot be rebuilt: {error!s:.200}") from error


def remote_error(message: Message, where: str) -> RemoteError:
    """Return the error for a function that raised."""
    kind, text, trace = message.words
    return RemoteError(where, kind, text, trace)
