"""The MCAP file that a recording is written to: its channels, and chunks that are closed in time.

One channel per path, role and shape of message. A channel's metadata says what it holds:

    reem.path     the path, top-level key first, as a JSON list
    reem.role     what its messages say, see `Role`
    reem.kind     where they came from, see `Kind`
    reem.ship     the label of the ship, for what is not JSON
    reem.wrapped  1: the JSON message is {"value": ...}
    reem.channels the last axis of a picture that has three
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping
from pathlib import Path as FilePath
from typing import Any

import orjson

from ...errors import BadValue
from ...plan.paths import Path, show
from .format import Kind, RecordingFailed, Role
from .layout import EncodedMessage, JsonMessage, schema_bytes, topic_of
from .mcap_writer import COMPRESSIONS, McapWriter
from .output import Output

FORMAT = "1"
FLUSH_SECONDS = 0.25
"""Seconds after which chunks are closed and given to the operating system, however small they are."""

_MOST_CHANNELS = 60_000
"""MCAP numbers them with 16 bits."""
_MOST_SCHEMAS = 8
"""Schemas a path may have before it gets one that fits everything."""

_DRAFT = "https://json-schema.org/draft/2020-12/schema"

KEYFRAMES = "/_reem/keyframe"
OPERATIONS = "/_reem/ops"
CHANNELS = "reem.channels"
"""The name of the metadata records that list channels."""
SPLIT = "split"
"""In the metadata of a file that is a part of a recording: what all parts have, and which of them it is."""
CONTINUED = "reem.continued"
"""In the metadata of a channel: its messages repeat what the part before has ended with."""
_SHARED_TOPICS = {
    **dict.fromkeys((Role.STATE, Role.KEYFRAME), KEYFRAMES),
    **dict.fromkeys((Role.DELETE, Role.GAP, Role.SKIP), OPERATIONS),
}


class FullError(Exception):
    """There are as many channels as MCAP can have."""


class Sink:
    """Writes messages of a recording. Belongs to one thread.

    Raises BadValue if the file is there already or cannot be made, and RecordingFailed if it cannot be written.
    """

    def __init__(
        self, path: FilePath, compression: str, metadata: Mapping[str, str], *, overwrite: bool, whole: bool = False
    ) -> None:
        if compression not in tuple(COMPRESSIONS):  # not hashed: it may be anything
            raise BadValue(f"compression {compression!r:.60} is none of {', '.join(COMPRESSIONS)}")
        self.path = path
        self.output = Output(path, overwrite=overwrite)
        try:
            self._writer = McapWriter(self.output, compression, f"reem/{metadata.get('version', '')}")
            self.describe(metadata)
            self.output.flush()
        except OSError as error:
            raise RecordingFailed(f"{path} cannot be written: {error.strerror}") from error
        self.whole = whole  # it gets its name when it is finished, or never
        self.continues = False  # what is written repeats what the file before has ended with
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._channels: dict[Any, int] = {}
        self._known: dict[Any, list[tuple[Schema, int]]] = {}
        self._count = 0
        self._new: list[Any] = []
        # When the chunks were closed last, and how many messages came since then.
        self._closed_at = time.monotonic()
        self._open = 0

    def describe(self, metadata: Mapping[str, str]) -> None:
        """Say more of the recording as a whole."""
        self._writer.add_metadata("reem", metadata)

    def json(self, path: Path, role: Role, kind: Kind, document: JsonMessage, stamp: tuple[int, int, int]) -> int:
        """Write a JSON message; returns its bytes. `stamp` is log time and publish time in ns, and a number."""
        found = schema_of(document.tree) if role == Role.UPDATE else None
        channel = self._json_channel(path, role, kind, document.wrapped, found or OPEN)
        return self._message(channel, [document.text], stamp)

    def _json_channel(self, path: Path, role: Role, kind: Kind, wrapped: bool, found: Schema) -> int:
        place = path, role, kind, wrapped, self.continues
        known = self._known.get(place, [])
        for types, channel in known:
            if found == types or fits(found, types):
                return channel
        self._check_room()
        # A path that changes its type all the time gets a schema without types.
        if len(known) == _MOST_SCHEMAS:
            found = OPEN
        # All channels of a shared topic have one schema: viewers want that.
        title = f"reem.{show(path)}" if role == Role.UPDATE else "reem.event"
        text = orjson.dumps({"$schema": _DRAFT, "title": title, **found})
        schema = self._schema(title, "jsonschema", text)
        extra = {"reem.wrapped": "1"} if wrapped else {}
        extra |= {CONTINUED: "1"} if self.continues else {}
        channel = self._channel(path, role, kind, "json", schema, **extra)
        self._known[place] = [*known, (found, channel)]
        return channel

    def part(
        self, path: Path, role: Role, kind: Kind, label: str, encoded: EncodedMessage, stamp: tuple[int, int, int]
    ) -> int:
        key = path, role, kind, label, encoded.schema, encoded.channels
        channel = self._channels.get(key)
        if channel is None:
            self._check_room()
            schema = self._schema(encoded.schema, "protobuf", schema_bytes(encoded.schema))
            extra = {"reem.ship": label, **({"reem.channels": encoded.channels} if encoded.channels else {})}
            channel = self._channels[key] = self._channel(path, role, kind, "protobuf", schema, **extra)
        return self._message(channel, encoded.pieces, stamp)

    def _schema(self, name: str, encoding: str, text: bytes) -> tuple[int, str]:
        if (name, text) not in self._schemas:
            self._schemas[name, text] = self._writer.register_schema(name, encoding, text)
        return self._schemas[name, text], name

    def _check_room(self) -> None:
        """Raise FullError if there can be no other channel; before it has a schema, which have 16 bits, too."""
        if self._count >= _MOST_CHANNELS:
            raise FullError

    def _channel(self, path: Path, role: Role, kind: Kind, encoding: str, schema: tuple[int, str], **extra: str) -> int:
        self._count += 1
        metadata = {"reem.path": orjson.dumps(path).decode(), "reem.role": role.value, "reem.kind": kind.value, **extra}
        metadata["reem.version"] = FORMAT
        topic = _SHARED_TOPICS.get(role) or topic_of(path)
        number = self._writer.register_channel(topic, encoding, schema[0], metadata)
        self._new.append([number, topic, encoding, schema[1], metadata])
        return number

    def _message(self, channel: int, pieces: list[Any], stamp: tuple[int, int, int]) -> int:
        log_time, publish_time, number = stamp
        self._open += 1
        return self._writer.add_message(channel, log_time, pieces, max(publish_time, 0), number)

    def tick(self) -> None:
        """Close the chunks if it is time, so that they can be read whatever happens."""
        if time.monotonic() - self._closed_at >= FLUSH_SECONDS:
            self._closed_at = time.monotonic()
            if self._open:
                self._open = 0
                self._writer.flush()
                self._list_channels()

    def _list_channels(self) -> None:
        """List new channels outside of the chunks: readers tell by it whether a filter has left some out."""
        if self._new:
            text = orjson.dumps(self._new)
            self._writer.add_metadata(CHANNELS, {"channels": text.decode(), "crc32": str(zlib.crc32(text))})
            self._new = []
            self.output.flush()

    def finish(self, metadata: Mapping[str, str]) -> None:
        """Write the last chunk, what is said of the recording at its end, and the index; close the file."""
        self._writer.flush()
        self._list_channels()
        self.describe(metadata)
        self._writer.finish()
        if self.whole:
            self.output.appear()
        self.close()

    def close(self) -> None:
        """Close the file as it is. Idempotent."""
        self._writer.close()
        self.output.close()


Schema = dict[str, Any]
"""A JSON schema. An object may have more than it names, so what has no type that viewers take is left out."""

OPEN: Schema = {"type": "object", "properties": {}, "additionalProperties": True}
_NUMBER: Schema = {"type": "number"}
_PLAIN: dict[type, Schema] = {float: _NUMBER, int: _NUMBER, str: {"type": "string"}, bool: {"type": "boolean"}}


def schema_of(value: Any) -> Schema | None:
    """Return the schema of a JSON value; None of null and of an array of mixed items, which any schema lets pass."""
    kind = type(value)
    if kind in _PLAIN:
        return _PLAIN[kind]
    if kind is dict:
        return {**OPEN, "properties": {key: schema for key, item in value.items() if (schema := schema_of(item))}}
    # For JSON, 1 and 1.5 are of one type.
    if kind not in (list, tuple) or len({float if type(item) is int else type(item) for item in value}) != 1:
        return None
    items = schema_of(value[0])
    return {"type": "array", "items": items} if items else {"type": "array"}


def fits(found: Schema | None, known: Schema | None) -> bool:
    """Return whether a message with the schema `found` may go under another one."""
    if found is None or known is None:
        return True
    if found["type"] != known["type"]:
        return False
    if found["type"] == "object":
        types = known["properties"]
        return all(fits(schema, types[key]) for key, schema in found["properties"].items() if key in types)
    return fits(found.get("items"), known.get("items"))
