"""Topics of Foxglove: one for each key, as JSON, and one for each array or picture in it.

The messages are those of recordings. What no client has subscribed to is not encoded.
"""

from __future__ import annotations

import logging
import re
import time
from collections import Counter
from typing import Any

import numpy as np
import orjson

from ...plan.paths import Path, show
from ...plan.placeholders import Unfetched, Unreadable
from ...plan.trees import MISSING
from ...ships.images import EncodedImage
from ..recording.layout import JsonMessage, encode, is_picture, schema_bytes, to_json, topic_of
from ..recording.log import ArrayHandle
from ..recording.sink import OPEN, Schema, schema_of
from ..recording.stored import Reference, extract, reference_to

logger = logging.getLogger("reem.foxglove")

_JOINING = 0.1  # seconds from a client's subscription until its messages arrive: foxglove-sdk adds it a moment later
_DTYPE_AND_SHAPE = re.compile(r"(\w+)\[([\d,]+)\]")


class Topic:
    """One path that clients can subscribe to."""

    def __init__(self, foxglove: Any, context: Any, path: Path) -> None:
        self._foxglove, self._context, self.path = foxglove, context, path
        self.channel: Any = None
        self.is_array = False
        self.shown: Any = MISSING  # the array that was sent last
        self.waiting: tuple[str, Any, int] | None = None  # a newer one, which waits for its turn
        self.due = 0.0  # when the next one may be sent, on the monotonic clock
        self._schema: Schema | None = None
        self.joined: float | None = None  # when a client has subscribed that waits for what is there
        self.sent = 0  # messages since a client wanted it first
        self.known = False  # a client wanted it at the last tick
        self.had_clients = False  # others wanted it when the last one subscribed

    @property
    def wanted(self) -> bool:
        return self.channel is not None and bool(self.channel.has_sinks())

    def advertise(self, name: str, encoding: str, data: bytes, **metadata: str) -> None:
        """Offer the topic with a schema, in place of the one it had."""
        self.close()
        schema = self._foxglove.Schema(name=name, encoding=encoding, data=data)
        self.channel = self._foxglove.Channel(
            topic_of(self.path),
            schema=schema,
            message_encoding="json" if encoding == "jsonschema" else encoding,
            context=self._context,
            metadata={"reem.path": orjson.dumps(self.path).decode(), **metadata},
        )

    def advertise_array(self, schema: str) -> None:
        if self.channel is None or self.channel.schema_name() != schema:
            self.advertise(schema, "protobuf", schema_bytes(schema))
            self.is_array = True

    def advertise_json(self, message: JsonMessage) -> None:
        """Offer the topic with the fields of a message. Clients of the topic keep what they have: it is JSON anyway."""
        if self.channel is not None and not self.is_array and self.wanted:
            return
        found = schema_of(message.tree) or OPEN
        if self.is_array or found != self._schema:
            self._schema, title = found, f"reem.{show(self.path)}"
            extra = {"reem.wrapped": "1"} if message.wrapped else {}
            self.advertise(title, "jsonschema", orjson.dumps({"title": title, **found}), **extra)
            self.is_array = False

    def send(self, data: bytes, at: int) -> None:
        self.sent += 1
        self.channel.log(data, log_time=at)

    def forget(self) -> None:
        """Let go of what was sent: no client wants it, so it is out of date when the next one does."""
        self.shown, self.waiting, self.sent, self.known = MISSING, None, 0, False

    def lacks(self, now: float) -> bool:
        """Return whether a new client must be sent what others have had already."""
        if self.joined is None or now - self.joined <= _JOINING:
            return False
        self.joined = None
        return self.had_clients or not self.sent

    def close(self) -> None:
        if self.channel is not None:
            self.channel.close()
        self.channel = None
        self.forget()


class Topics:
    """The topics of a server, and messages to those that clients have subscribed to. Belongs to one thread.

    Args:
        rate: How many messages a second an array's topic has at most; the newest is always sent.
        skipped: Counts those that were not, by key.
    """

    def __init__(self, foxglove: Any, rate: float, skipped: Counter[str]) -> None:
        self.context = foxglove.Context()
        self._foxglove, self._gap, self._skipped = foxglove, 1 / rate, skipped
        self._topics: dict[str, dict[Path, Topic]] = {}
        self._states: dict[str, tuple[Any, int]] = {}  # what was shown last of keys that clients want
        self._subscribed: list[int] = []  # channels; another thread adds them

    def wants(self, name: str) -> bool | None:
        wanted = [topic for topic in self._topics.get(name, {}).values() if topic.wanted]
        return any(topic.is_array for topic in wanted) if wanted else None

    def show(self, name: str, tree: Any, at: int, only: Topic | None = None) -> None:
        """Offer what is in a tree, and send what clients want of it, or one topic; `at` is in ns since 1970."""
        self._states[name] = tree, at
        shown = extract(tree, (name,), lambda label, path, value: self._array(label, path, value, at, only))
        if type(shown) is Reference:  # all of it is an array
            return
        message = to_json(shown)
        topic = self._topic((name,))
        topic.advertise_json(message)
        if topic.wanted and only in (None, topic):
            topic.send(message.text, at)

    def _topic(self, path: Path) -> Topic:
        topics = self._topics.setdefault(str(path[0]), {})
        if path not in topics:
            topics[path] = Topic(self._foxglove, self.context, path)
        return topics[path]

    def _array(self, label: str, path: Path, value: Any, at: int, only: Topic | None) -> Any:
        """Send an array or bytes; return what is in its place in JSON."""
        if isinstance(value, Unreadable):
            return f"<unreadable: {value.reason}>"
        topic = self._topic(path)
        if isinstance(value, Unfetched | ArrayHandle):
            reference = _described(path, value, at)
            topic.advertise_array(_schema_of_array(reference))
            fetched = isinstance(value, ArrayHandle)
        elif isinstance(value, np.ndarray | bytes | EncodedImage):
            reference, fetched = reference_to(label, path, at, value), True
            if topic.channel is None:
                topic.advertise_array(encode(label, value, "", at).schema)
        else:  # of a ship of the user's own
            return f"<{type(value).__name__}>"
        is_new = value is not topic.shown and not (isinstance(value, ArrayHandle) and value == topic.shown)
        if fetched and is_new and topic.wanted and only in (None, topic):
            if topic.waiting is not None:
                self._skipped[str(path[0])] += 1
            topic.shown, topic.waiting = value, (reference.label, value, at)
            self._send_waiting(topic)
        return reference

    def _send_waiting(self, topic: Topic) -> None:
        now = time.monotonic()
        if topic.waiting is None or now < topic.due:
            return
        (label, value, at), topic.waiting = topic.waiting, None
        # Two may come at once, as those of a camera of just this rate do that were taken in one turn.
        topic.due = max(topic.due, now - 2 * self._gap) + self._gap
        try:
            value = value.read() if isinstance(value, ArrayHandle) else value
        except ValueError as error:  # damaged
            logger.warning("%s: %s", show(topic.path), error)
            return
        encoded = encode(label, np.array(value) if label == "list" else value, show(topic.path), at)
        topic.advertise_array(encoded.schema)
        topic.send(b"".join(encoded.pieces), at)

    def tick(self) -> None:
        """Send the arrays whose turn has come, and to a new client what is there."""
        now = time.monotonic()
        joined = set()
        while self._subscribed:
            joined.add(self._subscribed.pop())
        for name, topics in self._topics.items():
            offered = [topic for topic in topics.values() if topic.channel is not None]
            for topic in offered:
                if topic.channel.id() in joined:
                    topic.joined, topic.had_clients = now, topic.known
                if not topic.wanted:
                    topic.forget()
                    continue
                topic.known = True
                self._send_waiting(topic)
                if topic.lacks(now) and name in self._states:
                    topic.shown = MISSING
                    self.show(name, *self._states[name], only=topic)
            if not any(topic.wanted for topic in offered):
                self._states.pop(name, None)

    def subscribed(self, channel: int) -> None:
        """Take note of a client's subscription. Any thread may."""
        self._subscribed.append(channel)

    def gone(self, name: str) -> None:
        self._states.pop(name, None)
        for topic in self._topics.pop(name, {}).values():
            topic.close()


def _described(path: Path, value: Unfetched | ArrayHandle, at: int) -> Reference:
    if isinstance(value, ArrayHandle):
        return Reference(value.label, path, at, value.size, value.summary, value.dtype, value.shape)
    match = _DTYPE_AND_SHAPE.fullmatch(value.summary)
    shape = tuple(map(int, match[2].split(","))) if match else None
    return Reference(value.label, path, at, value.size, value.summary, match[1] if match else "", shape)


def _schema_of_array(it: Reference) -> str:
    """Return the schema of what is not there yet; what is then sent may turn out to have another one."""
    if it.label in ("jpeg", "png"):
        return "foxglove.CompressedImage"
    if it.shape is None:
        return "reem.Blob"
    try:
        dtype = np.dtype(it.dtype).str
    except TypeError:  # of a structured array
        return "reem.NdArray"
    return "foxglove.RawImage" if is_picture(it.label, dtype, it.shape) else "reem.NdArray"
