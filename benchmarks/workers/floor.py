"""The floor of a client: ready-made bytes over bare sockets, and replies that are hardly looked at."""

import re
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import orjson

from ..values import picture

_ROOM = 1 << 17
_TEXT = re.compile(rb"\{[^}]*\}")


class Contender:
    """One socket, and another where something is subscribed to; no client, no parser, no errors looked for."""

    asynchronous = False

    def __init__(self, target: dict[str, Any]) -> None:
        self.address = target["host"], target["port"]
        self.line = _Line(self.address)

    def version(self) -> str:
        """There is nothing installed."""
        return "Python's socket"

    def writing(self, path: list[str], value: Any) -> Callable[[], Any]:
        """JSON.SET of a document that was encoded before."""
        command = _command("JSON.SET", ".".join(path), ".", orjson.dumps(value))
        return lambda: self.line.simple(command)

    def reading(self, path: list[str], value: Any) -> Callable[[], Any]:
        """JSON.GET, and what orjson makes of the reply."""
        command = _command("JSON.GET", ".".join(path), ".")
        return lambda: orjson.loads(self.line.text(command))

    def publishing(self, channel: str, payload: str) -> Callable[[], Any]:
        """PUBLISH of a small JSON text; a frame's own memory is SET before, in the same system calls."""
        if payload == "small":
            return lambda: self.line.simple(
                _command("PUBLISH", channel, orjson.dumps({"timestamp": time.monotonic_ns()}))
            )
        image = picture(payload).reshape(-1).view("u1").data
        head = b"*3\r\n$3\r\nSET\r\n$%d\r\n%b\r\n$%d\r\n" % (len(channel) + 6, f"{channel}:frame".encode(), len(image))

        def frame() -> None:
            told = _command("PUBLISH", channel, orjson.dumps({"timestamp": time.monotonic_ns()}))
            self.line.send([head, image, b"\r\n" + told])
            self.line.simple(b"", replies=2)

        return frame

    def subscribe(self, channel: str, payload: str, heard: Callable[[int], None]) -> None:
        """A thread in a blocking read, which fetches the frame a message announces into memory that is there."""
        line, fetch = _Line(self.address), _command("GET", f"{channel}:frame")
        line.simple(_command("SUBSCRIBE", channel), replies=5)  # *3, $9, subscribe, $N and name, less the count
        image = bytearray(0 if payload == "small" else picture(payload).nbytes + 64)

        def listen() -> None:
            while True:
                for text in _TEXT.findall(line.receive()):
                    stamp = int(orjson.loads(text)["timestamp"])
                    if payload != "small":
                        self.line.bulk(fetch, memoryview(image))
                    heard(stamp)

        threading.Thread(target=listen, daemon=True).start()


class _Line:
    """A socket on which one thing is asked at a time."""

    def __init__(self, address: tuple[str, int]) -> None:
        self.socket = socket.create_connection(address)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.room = memoryview(bytearray(_ROOM))

    def send(self, pieces: list[Any]) -> None:
        """Send all, one after the other."""
        for piece in pieces:
            self.socket.sendall(piece)

    def receive(self) -> bytes:
        """Whatever has come."""
        return bytes(self.room[: self.socket.recv_into(self.room)])

    def simple(self, command: bytes, replies: int = 1) -> None:
        """Send, and wait for so many lines."""
        self.socket.sendall(command)
        lines = 0
        while lines < replies:
            lines += self.receive().count(b"\r\n")

    def text(self, command: bytes) -> memoryview:
        """Send, and return the one string that comes."""
        return self.bulk(command, self.room)

    def bulk(self, command: bytes, room: memoryview) -> memoryview:
        """Send, and return the one string that comes, where it was received."""
        self.socket.sendall(command)
        received = self.socket.recv_into(room)
        start = bytes(room[:32]).index(b"\n") + 1
        end = start + int(bytes(room[1 : start - 2]))
        while received < end + 2:
            received += self.socket.recv_into(room[received:])
        return room[start:end]


def _command(*words: str | bytes) -> bytes:
    each = [word if isinstance(word, bytes) else word.encode() for word in words]
    return b"*%d\r\n" % len(each) + b"".join(b"$%d\r\n%b\r\n" % (len(word), word) for word in each)
