"""The examples in bytes of docs/wire.md, captured between REEM and real servers.

python tests/wirekit.py       # write them into the page, after the format was changed on purpose
"""

import contextlib
import re
import socket
import threading
import time
from pathlib import Path

import numpy as np
import redis

import reem
from reem_async.server import EmbeddedServer

PAGE = Path(__file__).resolve().parents[1] / "docs" / "wire.md"
BLOCK = re.compile(r"(?<=^<!-- bytes: )(\S+)( -->\n```text\n)(.*?)(?=^```$)", re.MULTILINE | re.DOTALL)
QUESTION, CALLER = "00000000000000%02x", "cafe00000000cafe"  # the ids of the test's own calls
_FIXED = {
    12: ["7522cc9fb4c2", "90c8b2c6f1de", "4be0a1d7c355"],
    16: ["9f46b89632ab027e", "4d0ad19647d8f50d", "3bddaee7569999f2", "d826ec7fecf9ce9a", "95cf6841525320b1"],
}
"""The ids of the page, in the order in which they are first seen, by their length."""
_LONGEST = 120  # characters of a word of a command that are shown


class Server:
    """A private server with what its clients send to it, and what it sends to subscribers."""

    def __init__(self, stack, *, json=True):
        self.url = stack.enter_context(EmbeddedServer(json=json)).url
        self.raw = stack.enter_context(contextlib.closing(redis.Redis.from_url(self.url)))
        self._listens = stack.enter_context(contextlib.closing(self.raw.pubsub()))
        self._listens.psubscribe("*")
        self._listens.get_message(timeout=5)
        self._monitor = stack.enter_context(
            contextlib.closing(
                socket.create_connection(("127.0.0.1", int(self.url.rpartition(":")[2].partition("/")[0])))
            )
        )
        self._monitor.sendall(b"MONITOR\r\n")
        self._lines = stack.enter_context(contextlib.closing(self._monitor.makefile("rb")))
        assert self._lines.readline() == b"+OK\r\n"

    def interface(self, **options):
        return contextlib.closing(reem.RedisInterface(self.url, **options))

    def message(self, part=b"", timeout=10):
        """The next message to subscribers with these bytes in it."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            found = self._listens.get_message(timeout=0.1)
            if found is not None and part in found["data"]:
                return found["data"]
        raise AssertionError(f"no message with {part}")

    def commands(self):
        """The commands that were sent since the last call, in the words of redis-cli."""
        self.raw.echo("the end")
        lines = []
        while b'"the end"' not in (line := self._lines.readline()):
            lines.append(line.decode().partition("] ")[2].rstrip("\r\n"))
        return lines


class Names:
    """What differs from run to run, replaced by what the page has: ids, times, and process numbers."""

    def __init__(self):
        self._ids = {}

    def fix(self, text):
        text = re.sub(r"\b1\d{9}\.\d+\b", "1795857094.178443", text)
        text = re.sub(r",\d{1,2}\.\d+,(?=\[)", ",9.998,", text)  # seconds that are left
        text = re.sub(r'"PX" "1\d{4}"', '"PX" "15000"', text)
        text = re.sub(r'(?<=["@: ])[0-9a-f]{12}(?:[0-9a-f]{4})?(?=[\\". \]]|$)', lambda found: self._id(found[0]), text)
        return re.sub(r"(\[\"[0-9a-f]{16}\"),\d+,\d+,\d+,(\d+),\d+,", r"\1,14448,22,174,\2,6990700168944915,", text)

    def _id(self, found):
        if found.startswith(("00000", "cafe")):
            return found
        if found not in self._ids:
            known = [each for each in self._ids if len(each) == len(found)]
            self._ids[found] = _FIXED[len(found)][len(known)]
        return self._ids[found]


def _typed(line):
    """A line of MONITOR, with quotes only around words that need them, and long ones cut."""
    words = re.findall(r'"((?:[^"\\]|\\.)*)"', line)
    return " ".join(_word(word) for word in words)


def _word(word):
    if re.fullmatch(r"[\w.:$@{}\-?]+", word):
        return word
    if len(word) <= _LONGEST:
        return f'"{word}"'
    size = len(re.sub(r"\\(x..|.)", "x", word))
    return f'"{word[:_LONGEST].rstrip(" ")}..." ({size} bytes)'


def transaction(lines, names):
    """The commands of REEM, without those of connecting."""
    skipped = ("CLIENT", "HELLO", "INFO", "PUBSUB", "COMMAND", "MODULE")
    kept = [line for line in lines if line.split('"')[1].upper() not in skipped and not re.search("p[io]ng", line)]
    return "".join(_typed(names.fix(line)) + "\n" for line in kept)


def dump(data):
    """Bytes as `hexdump -C` shows them."""
    rows = []
    for at in range(0, len(data), 16):
        row = data[at : at + 16]
        shown = "".join(chr(byte) if 32 <= byte < 127 else "." for byte in row)
        rows.append(f"{at:08x}  {row.hex(' '):<47}  |{shown}|\n")
    return "".join(rows)


def line(payload, names):
    """A message that is text: its line, and what follows it."""
    return names.fix(payload.decode()).removesuffix("\n") + "\n"


def captured():
    """Return the text of each example, by its name in the page."""
    found = {}
    with contextlib.ExitStack() as stack:
        names, server = Names(), Server(stack)
        robot = reem.PublishSpace(stack.enter_context(server.interface(local="off")))
        _writes(found, server, robot, names)
        _leases(found, server, names)
        _services(found, server, names)
        plain = Server(stack, json=False)
        robot = reem.PublishSpace(stack.enter_context(plain.interface(local="off")))
        for name, write in (
            ("plain-write", lambda: robot["arm"].write({"speed": 0.5, "q": np.array([0.0, 0.5, 1.0])})),
            ("plain-part", lambda: robot["arm"]["speed"].write(0.25)),
        ):
            plain.commands()
            write()
            found[name] = transaction(plain.commands(), Names())
        found["plain-document"] = f'"{plain.raw.get("arm").decode()}"\n'
    return found


def _writes(found, server, robot, names):
    robot["warm"] = 0  # what is asked of a server once
    for name, write in (
        ("write", lambda: robot["arm"].write({"speed": 0.5, "q": np.array([0.0, 0.5, 1.0])})),
        ("part", lambda: robot["arm"]["speed"].write(0.25)),
    ):
        server.commands()
        write()
        found[name] = transaction(server.commands(), names)
    found["document"] = server.raw.execute_command("JSON.GET", "arm").decode() + "\n"
    found["array"] = dump(server.raw.get("{arm}.q"))
    found["registry"] = "".join(f"{each.decode()}\n" for each in server.raw.smembers("{arm}:ships"))
    payload = server.message(b'"$ship numpy .q')
    head, _, rest = payload.partition(b"\n")
    found["notice"] = dump(names.fix(head.decode()).encode() + b"\n" + rest)
    robot["arm"]["notes"] = ["$ship is a word", 5.6843418860808015e-13, {"map": np.zeros(2, np.uint8)}, b"\0\xff"]
    found["placeholders"] = server.raw.execute_command("JSON.GET", "arm", "$.notes").decode()[1:-1] + "\n"
    del robot["arm"]["notes"]
    robot["arm"]["image"] = np.zeros(3000)
    messages = [line(server.message(part), names) for part in (b'"delete"', b'"look"')]
    with server.interface() as near:
        reem.PublishSpace(near)["arm"]["image"] = np.zeros(100_000)
        messages.append(line(server.message(b'"look"'), names))
    found["kinds"] = "".join(messages)


def _leases(found, server, names):
    with server.interface(local="off") as interface:
        server.commands()
        with reem.KeyValueStore(interface)["base"].own(ttl=3, name="joystick") as base:
            base.write(1)
        owner = re.compile(r'(joystick\\",\\").*?\\",\d+,([\d.]+),\\".*?\\"')
        lines = [owner.sub(r'\1robot\\",14448,\2,\\"5mGZ0hqS6sQ\\"', each) for each in server.commands()]
        text = transaction(lines, names)
        found["lease"] = text.partition("UNLINK")[0] + "UNLINK {base}:lease\nEXEC\n"


def _services(found, server, names):
    free = threading.Event()

    def plan(start=None, goal=1):
        if goal == 0:
            raise ValueError("too far")
        if goal == 3:
            free.wait(30)
        return {"path": start} if start is not None else {"ok": True}

    with server.interface(local="off") as interface:
        place = reem.KeyValueStore(interface)["arm"]["plan"]
        with place.serve(plan, queue=1):
            place.call(goal=2)
            found["call"] = line(server.message(b'"call"'), names)
            found["answer"] = line(server.message(b'"answer"'), names)
            server.commands()
            place.call(start=np.zeros(10_000))
            commands = transaction(server.commands(), names)
            found["stored"] = "".join(re.findall(r"(?m)^(?!TYPE|PING).*\n", commands))
            _raw_calls(found, server, names)
            free.set()


def _raw_calls(found, server, names):
    """What a server answers to a caller that is not REEM."""
    (channel,) = server.raw.pubsub_channels("{arm}.plan:serve@*")
    number = 0

    def send(kind, words=(), text="", part=b""):
        nonlocal number
        number += 1
        size = f'"here",{len(text)}' if text else '"",0'
        left = 5 if kind == "call" else 0
        said = ",".join(f'"{word}"' for word in words)
        payload = f'[1,"{kind}","{QUESTION % number}","{CALLER}",{left},[{said}],{size},[]]\n{text}'
        assert server.raw.publish(channel, payload) == 2  # the function, and the test
        if not part:
            return payload
        answer = names.fix(server.message(part).decode())
        answer = re.sub(
            r"\[\"[^\"]*\",\"\d+\",\"3\",\"[^\"]*\",\"[^\"]*\",\"1\"\]",
            '["robot","14448","3","0.5","0.001","1"]',
            answer,
        )
        return payload.rstrip("\n") + "\n" + answer.split("\\n  File")[0]

    found["failed"] = send("call", ("", ""), '{"goal":0}', b'"failed"') + '..."],"",0,[]]\n'
    found["ping"] = send("ping", part=b'"pong"')
    send("call", ("", ""), '{"goal":3}')
    send("call", ("", ""), '{"goal":3}')
    found["busy"] = send("call", ("", ""), '{"goal":3}', b'"busy"')
    found["cancel"] = send("cancel")


def page_with(examples):
    """The page with these examples."""
    return BLOCK.sub(lambda block: block[1] + block[2] + examples[block[1]], PAGE.read_text(encoding="utf-8"))


if __name__ == "__main__":
    import sys

    if "--show" in sys.argv:
        for name, text in captured().items():
            print(f"--- {name}\n{text}", end="")
    else:
        PAGE.write_text(page_with(captured()), encoding="utf-8")
