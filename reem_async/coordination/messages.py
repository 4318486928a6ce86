"""The messages between the callers and the servers of a service: encode, decode, and check what arrives.

A line of JSON. A small value follows it, as in a notice: the text of the document and the bytes of its attachments. A
large value is in a slot of shared memory, or stored under keys that expire. Messages that arrive are not trusted:
anything unexpected is refused as `BadData`. Which keys are read is never taken from a message, only their ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise
from typing import Any, Final, NamedTuple

import orjson

from ..concurrency.timeouts import LONGEST
from ..errors import BadData, BadKey, BadValue
from ..plan import Command, Plan, Reply, raise_refused
from ..plan.changes import EncodedAttachment
from ..plan.keys import Keys
from ..plan.notices import Slot, View, named, named_parts, sizes_of_parts, starts
from ..plan.paths import Path, escaped, parse_suffix, suffix
from ..ships.registry import Ships

VERSION = 1
LARGEST_INLINE = 1 << 16
"""Bytes of a value up to which the message carries it. A server of Redis cuts off a subscriber that is 32 MB behind."""
MARGIN = 5.0  # seconds for which a stored value outlives the deadline of its call
LONGEST_TEXT = 1 << 14  # characters of a remote traceback, of which the end is sent
_LARGEST = 1 << 18  # bytes of a message: far more than LARGEST_INLINE bytes of value and the names of its arrays
_MOST = 1 << 53  # bytes of a value: every JSON parser has integers up to it
_LONGEST_SUFFIX = 4096  # characters in the end of an attachment's key

CALL: Final = "call"  # of a caller: handle this within so many seconds
CANCEL: Final = "cancel"  # the caller has left
PING: Final = "ping"
UNREAD: Final = "unread"  # of either side: what was sent in shared memory cannot be read there, send it by the server
ANSWER: Final = "answer"  # of a server: the value
FAILED: Final = "failed"  # the function raised
BUSY: Final = "busy"  # too many requests wait; this one was not begun
CLOSED: Final = "closed"  # it stops serving, or cannot; this request was not begun
PONG: Final = "pong"  # how the server is doing

_KINDS = {CALL, CANCEL, PING, UNREAD, ANSWER, FAILED, BUSY, CLOSED, PONG}
_WITH_VALUE = {CALL, ANSWER}
_WORDS = {CALL: 2, ANSWER: 2, FAILED: 3, PONG: 6}  # how many texts a message has
_HERE, _STORED = "here", "stored"

Encoded = tuple[bytes, Sequence[EncodedAttachment]]  # a value: the text of the document, and the attachments
Put = Callable[[Sequence[Any], Sequence[int]], Slot | None]  # copies pieces of these sizes into shared memory


class Content(NamedTuple):
    is_stored: bool  # under keys that expire
    sizes: list[int]  # bytes of each part
    names: list[tuple[str, str]]  # of each attachment the ship's label, and the end of its key
    pieces: list[Any]  # the parts that have arrived: all, the text only, or none

    @property
    def is_missing(self) -> bool:
        """Whether it is in shared memory that cannot be read."""
        return not self.is_stored and not self.pieces


class Message(NamedTuple):
    kind: str
    call: str  # the id of the call or of the ping
    sender: str  # the id of the caller or of the server
    # Of a CALL: seconds that are left; of a PING: for how many seconds calls are to be published, see `services.CALLS`;
    # of a server: requests that wait or are handled there
    number: float = 0.0
    # CALL, ANSWER: the sender's host, for shared memory, and its mailbox, if any; FAILED: type, message, traceback
    words: Sequence[str] = ()
    content: Content | None = None


class Packed(NamedTuple):
    payload: bytes
    commands: list[Command]  # what stores the value; none if the message or shared memory has it
    is_shared: bool = False  # shared memory has it


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
        return f"{self.keys.tag}{suffix(self.path)}{_database(self.keys)}"

    @staticmethod
    def of(channel: str, session_keys: Callable[[str], Keys], namespace: str) -> Names | None:
        """Return the names of the service whose channel of requests this is; None if it is none, or elsewhere."""
        body, _, server = channel.rpartition(":serve@")
        name, _, rest = body.removeprefix("{" + namespace).partition("}")
        try:
            keys = session_keys(name)
            found = Names(keys, parse_suffix(rest.removesuffix(_database(keys))))
        except BadKey:
            return None
        return found if is_id(server) and found.channel(server) == channel else None

    def values(self, kind: str, call: str) -> str:
        """Return the beginning of the keys that hold a large value of a CALL or an ANSWER."""
        return f"{self.keys.tag}:{kind}:{call}"


def _database(keys: Keys) -> str:
    """Return the end of a channel: all databases of a server share the channels."""
    return keys.channel.rpartition("}:notices")[2]


def answers(keys: Keys, caller: str) -> str:
    return f"{keys.tag}:answers@{caller}"


ID = 16  # characters of an id, hexadecimal


def is_id(text: Any) -> bool:
    return type(text) is str and len(text) == ID and not set(text) - set("0123456789abcdef")


def packed(message: Message, value: Encoded, prefix: str, left: float, put: Put | None) -> Packed:
    """Return a message with its value: a small one in the message, a large one in shared memory or stored.

    Args:
        message: What it is.
        value: Encoded for keys that begin with `prefix`.
        prefix: The beginning of the keys.
        left: Seconds until the deadline. What is stored expires some seconds later.
        put: Copies the value into shared memory if there is room; None if the receiver cannot read it there.
    """
    text, attachments = value
    sizes = sizes_of_parts(text, attachments)
    is_bytes = all(each.blob is not None for each in attachments)  # and not what the commands of a user's ship store
    pieces = [text, *(piece for each in attachments for piece in each.blob or ())]
    if is_bytes and sum(sizes) <= LARGEST_INLINE:
        return Packed(b"".join([_header(message, _HERE, sizes, attachments), *pieces]), [])
    if is_bytes and put is not None and (slot := put(pieces, sizes)) is not None:
        return Packed(_header(message, [*slot, sizes[0]], sizes, attachments), [], is_shared=True)
    kept = str(math.ceil((left + MARGIN) * 1000))
    commands: list[Command] = []
    for each in attachments:
        if each.blob is not None:  # each expires by itself: a plain SET may be staged, for a minute
            commands += [(*command, "PX", kept) for command in each.commands]
        else:  # the ship of a user chose the commands
            commands += [*each.commands, ("PEXPIRE", prefix + each.suffix, kept)]
    if len(text) > LARGEST_INLINE:
        commands.append(("SET", _text_key(prefix), text, "PX", kept))
        text = b""
    return Packed(_header(message, _STORED, sizes, attachments) + text, commands)


def check_parts(where: str, value: Encoded) -> None:
    """Raise BadValue if a value has more attachments than a message can name."""
    parts = [[each.label, each.suffix, _MOST] for each in value[1]]
    if len(orjson.dumps(parts)) > _LARGEST - 2 * LARGEST_INLINE:  # a text may travel beside them
        raise BadValue(
            f"{where}: {len(parts)} arrays, or other values of ships, are too many for one call; "
            "put them together into fewer arrays"
        )


def keys_of(prefix: str, value: Encoded) -> list[str]:
    return [_text_key(prefix), *(prefix + each.suffix for each in value[1])]


def _text_key(prefix: str) -> str:
    return f"{prefix}:text"


def bare(message: Message) -> bytes:
    return _header(message, "", [0], ())


def failure(message: Message, error: BaseException, trace: str) -> bytes:
    words = [(type(error).__qualname__, 200), (text_of(error), 4096), (trace, LONGEST_TEXT)]
    return bare(message._replace(kind=FAILED, words=[_shortened(*each) for each in words]))


def text_of(error: BaseException) -> str:
    """Return the text of an error, as JSON can hold it."""
    try:
        return str(error).encode("utf-8", "replace").decode()  # JSON has no halves of surrogate pairs
    except BaseException:  # its __str__ is the user's
        return "(its text cannot be shown)"


def _shortened(text: str, longest: int) -> str:
    text = text.encode("utf-8", "replace").decode()
    return text if len(text) <= longest else f"...{text[3 - longest :]}"


def _header(
    message: Message, place: str | list[Any], sizes: list[int], attachments: Sequence[EncodedAttachment]
) -> bytes:
    parts = named_parts(attachments, sizes)
    kind, call, sender, number, words, _ = message
    return orjson.dumps([VERSION, kind, call, sender, number, [*words], place, sizes[0], parts]) + b"\n"


def decode(payload: bytes, view: View) -> Message:
    """Return the message in `payload`, with a value in shared memory if `view` can read it.

    Raises BadData for what is none of REEM, or of an unknown version.
    """
    if len(payload) > _LARGEST:
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
        and is_id(call)
        and type(number) in (int, float)
        and 0 <= number <= LONGEST
        and type(words) is list
        and len(words) == _WORDS.get(kind, 0)
        and all(type(word) is str for word in words)
    )
    if not sound:
        raise BadData("a message of a service has fields of wrong types or out of range; it was not written by REEM")
    content = _content(place, size, parts, payload[end + 1 :], view) if kind in _WITH_VALUE else None
    return Message(kind, call, sender, float(number), words, content)


def _content(place: Any, size: Any, parts: Any, data: bytes, view: View) -> Content:
    if _is_size(size) and type(parts) is list and all(_is_part(part) for part in parts):
        sizes = [size, *(part[2] for part in parts)]
        names = [(label, tail) for label, tail, _ in parts]
        if place == _HERE and len(data) == sum(sizes):
            return Content(False, sizes, names, [data[a:b] for a, b in pairwise(accumulate(sizes, initial=0))])
        if place == _STORED and len(data) in (0, size):
            return Content(True, sizes, names, [data] if data else [])
        if (found := named(place)) is not None and found[1] == size:
            seen, begins = view(found[0], starts(sizes)[-1]), starts(sizes)[:-1]
            pieces = [] if seen is None else [seen[at : at + length] for at, length in zip(begins, sizes, strict=True)]
            return Content(False, sizes, names, pieces)
    raise BadData("a message of a service has a value that cannot be; it was not written by REEM")


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


def again(content: Content, prefix: str) -> Encoded:
    """Return a value that has arrived, to be stored under keys that begin with `prefix`."""
    text, *blobs = map(bytes, content.pieces)
    return text, [
        EncodedAttachment(tail, label, (("SET", prefix + tail, blob),), (blob,))
        for (label, tail), blob in zip(content.names, blobs, strict=True)
    ]


def fetch(content: Content, prefix: str, ships: Ships, where: str) -> Plan:
    """Plan to take a stored value from the server, where nothing is left of it; the result is its parts.

    Raises:
        BadData: An interface without the ship that wrote a part; and if the value has expired, from the plan.
    """
    keys = [prefix + tail for _, tail in content.names]
    commands = [
        ships.labelled(label, where).read_command(key) for (label, _), key in zip(content.names, keys, strict=True)
    ]
    if not content.pieces:
        keys, commands = [_text_key(prefix), *keys], [("GET", _text_key(prefix)), *commands]
    commands.append(("UNLINK", *keys))

    def decode(replies: Sequence[Reply]) -> list[Any]:
        raise_refused(replies, commands)
        parts: list[Any] = [*content.pieces, *replies[:-1]]
        if parts[0] is None or len(parts[0]) != content.sizes[0]:
            raise BadData(f"{where}: the value is not on the server any more; it was kept until after the deadline")
        return parts

    return Plan(commands, decode, atomic=True, bulk=sum(content.sizes) > LARGEST_INLINE)
