"""Read a value with its arrays, and publish one (docs/wire.md), with the modules that MicroPython has."""

import json
import os
import time

from resp import Failure, check
from values import encoded, filled, placeholders

IN_NOTICE = 1 << 14  # bytes of a value up to which it travels in the notice


def new_id(size):
    return "".join(f"{byte:02x}" for byte in os.urandom(size))


class Place:
    """A place such as `arm.joints.0`: names of letters, digits and the like, and indexes."""

    def __init__(self, text):
        self.text = text
        self.key, *rest = text.split(".")
        check(self.key and "" not in rest, f"{text!r} is not like arm.joints.0")
        check(not [it for it in text if it in "[]{}\"'\\~%*?^ "], f"{text!r}: this client knows plain names only")
        self.path = [int(it) if it.isdigit() else it for it in rest]
        self.suffix = "".join("[%d]" % it if isinstance(it, int) else "." + it for it in self.path)
        self.tag = f"{{{self.key}}}"


def read(server, place):
    """Return a list of the value with its arrays, all of one instant; an empty one if nothing is stored there."""
    for _ in range(100):
        server.send("WATCH", place.key)
        if server.has_json:
            jsonpath = "$" + "".join(f"[{json.dumps(it)}]" for it in place.path)
            text, steps = server.send("JSON.GET", place.key, jsonpath), [0]
        else:
            text, steps = server.send("GET", place.key), place.path
            check(text is None or text[:1] == b" ", f"{place.key} is a key of another program")
        try:
            node = json.loads(text or "[]")
            for step in steps if text is not None else [0]:
                node = node[step]
            holder = [node]
        except (KeyError, IndexError, TypeError):
            holder = []
        found = placeholders(holder, place.text)
        server.send("MULTI")
        for _, _, suffix in found:
            server.send("GET", place.tag + suffix)
        blobs = server.send("EXEC")  # nothing if the document was written since: each write of an array writes it too
        if blobs is not None:
            return [filled(holder, found, blobs, place.key)] if holder else []
    raise Failure(f"{place.text} was written all the time while it was read")


def publish(server, place, words):
    """Replace a top-level key and notify its subscribers, in one transaction. Again if another client was faster."""
    tag, stamp = place.tag, [new_id(6), 1]  # a program that publishes more counts on for each key
    check(not place.path, "publish a whole top-level key, such as arm")
    text, parts, blobs = encoded(words, "")
    line, body = [1] + stamp + [time.time(), [], "set", len(text), parts], text + b"".join(blobs)
    if len(body) > IN_NOTICE:
        line, body = line[:5] + ["look", len(body), []], b""
    for _ in range(100):
        server.send("WATCH", place.key, tag + ":ships", tag + ":lease")
        kind = server.send("TYPE", place.key)
        is_text = not server.has_json and kind == b"string" and server.send("GETRANGE", place.key, "0", "0") == b" "
        is_document = is_text or (server.has_json and kind == b"ReJSON-RL")
        check(kind == b"none" or is_document, f"{place.key} is a key of another program")
        check(server.send("GET", tag + ":lease") is None, f"{place.key} is owned by another program")
        names = [it.decode() for it in server.send("SMEMBERS", tag + ":ships")] + [it[1] for it in parts]
        server.send("MULTI")
        server.send("UNLINK", tag + ":ships", *[tag + it for it in names])
        for (_, suffix, _), blob in zip(parts, blobs):
            server.send("SET", tag + suffix, blob)
            server.send("SADD", tag + ":ships", suffix)
        if server.has_json:
            server.send("JSON.SET", place.key, "$", text)
        else:
            server.send("SET", place.key, b" " + text, "KEEPTTL")
        server.send("SET", tag + ":last", "%s %d" % tuple(stamp), "EX", "60")
        server.send("PUBLISH", tag + ":notices", json.dumps(line).encode() + b"\n" + body)
        replies = server.send("EXEC")
        if replies is not None:
            return [check(not isinstance(it, Failure), f"the server refused a part: {it}") for it in replies]
    raise Failure(f"{place.key} was written all the time by another client")
