"""What notices and the messages of services carry, and calls (docs/wire.md), with the modules that MicroPython has."""

import json
import time

from places import new_id
from resp import Failure, check
from values import encoded, filled, placeholders

LARGEST = 1 << 16  # bytes of arguments that travel in a request
clock = getattr(time, "monotonic", time.time)  # MicroPython has time.time() only


def received(payload, fields, place):
    """Return the line of a notice (8 fields) or of a message (9), and the bytes behind it."""
    head, _, data = payload.partition(b"\n")
    line = json.loads(head)
    check(isinstance(line, list) and len(line) >= fields, f"{place.text}: a message is not of REEM")
    check(line[0] == 1, f"{place.text}: a message has version {line[0]!r}; this client knows 1")
    is_notice = isinstance(line[1], str) and isinstance(line[2], int) and line[2] > 0
    is_notice = is_notice and line[5] in ("set", "look", "delete")
    check(fields == 9 or is_notice, f"{place.text}: a notice has no publisher, number or kind")
    return line, data


def carried(data, size, parts, place):
    """Return the value of a message: a text of so many bytes, and its arrays."""
    blobs, start = {}, size
    for _, suffix, length in parts:
        blobs[suffix] = data[start : start + length]
        start += length
    check(start == len(data), f"{place.text}: a message has another size than it says")
    holder = [json.loads(data[:size])]
    found = placeholders(holder, place.text)
    return filled(holder, found, [blobs.get(suffix) for _, _, suffix in found], place.key)


def call(server, place, words, seconds=10):
    """Return the answer of one server of a service. Only a request that was not begun goes to another server."""
    me, number, end = new_id(8), new_id(8), clock() + seconds
    text, parts, blobs = encoded(words, place.suffix)
    value = b"".join([text] + blobs)
    check(len(value) <= LARGEST, "this client sends up to %d bytes of arguments" % LARGEST)
    server.subscribe(place.tag + ":answers@" + me)
    name = place.tag + place.suffix.replace("[", "\\[").replace("]", "\\]")  # brackets are special in patterns
    for channel in server.send("PUBSUB", "CHANNELS", name + ":serve@" + "?" * 16):
        line = [1, "call", number, me, max(end - clock(), 0), ["", ""], "here", len(text), parts]
        if not server.send("PUBLISH", channel, json.dumps(line).encode() + b"\n" + value):
            continue  # it has ended
        line = [0] * 4
        while line[2] != number or line[3] != channel.decode()[-16:]:
            payload = server.wait(end - clock())
            if payload is None and clock() >= end:
                server.send("PUBLISH", channel, json.dumps([1, "cancel", number, me, 0, [], "", 0, []]) + "\n")
                raise Failure(f"{place.text}: no answer in time; the request may or may not have been handled")
            if payload is not None:
                line, data = received(payload, 9, place)
        if line[1] not in ("busy", "closed"):
            check(line[1] == "answer", f"{place.text}: the service raised {json.dumps(line[5])}")
            check(line[6] == "here", f"{place.text}: the answer has over 64 KB, which this client does not read")
            return carried(data, line[7], line[8], place)
    raise Failure(f"{place.text}: no program serves this, or all are busy")
