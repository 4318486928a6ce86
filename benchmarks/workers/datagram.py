"""The floor on one host: Unix datagrams between two processes, arrays in a slot of memory that a datagram announces."""

import array
import itertools
import mmap
import os
import pathlib
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import orjson

from ..values import ARRAYS, complete, message, picture
from .control import newest_of

_SLOTS = 6
_ROOM = 1 << 16


class Contender:
    """Each subscriber has a socket in the folder of its channel; there a publisher finds them. Nothing is checked."""

    asynchronous = False

    def __init__(self, target: dict[str, Any]) -> None:
        self.folder = pathlib.Path(target["folder"], str(target["peer_port"]))
        self.slots: dict[str, _Slots] = {}

    def version(self) -> str:
        """There is nothing installed."""
        return "Python's socket, Linux's memfd"

    def publishing(self, channel: str, payload: str) -> Callable[..., None]:
        """Text: one datagram to each subscriber. Array: one copy into a slot, then a datagram with its number."""
        sender = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        subscribers = [str(path) for path in (self.folder / channel).glob("*")]
        if payload not in ARRAYS:

            def text(**fields: Any) -> None:
                data = orjson.dumps(message(payload, **fields))
                for subscriber in subscribers:
                    sender.sendto(data, subscriber)

            return text
        image = picture(payload)
        if channel not in self.slots:
            self.slots[channel] = _Slots(image)
        slots = self.slots[channel]

        def frame() -> None:
            stamp = time.monotonic_ns()
            data = b"%d %d" % (slots.fill(image), stamp)
            for subscriber in subscribers:
                sender.sendmsg([data], slots.introduction(subscriber), 0, subscriber)

        return frame

    def subscribe(self, channel: str, payload: str, heard: Callable[[int], None]) -> None:
        """A thread in a blocking receive, which maps the memory once and takes a view of each slot."""
        receiver = self._socket(channel)

        def texts() -> None:
            while True:
                heard(int(orjson.loads(receiver.recv(_ROOM))["timestamp"]))

        def frames() -> None:
            size, memory = picture(payload).nbytes, memoryview(b"")
            while True:
                data, ancillary, _, _ = receiver.recvmsg(_ROOM, socket.CMSG_SPACE(4))
                for _, _, descriptor in ancillary:
                    memory = memoryview(mmap.mmap(array.array("i", descriptor)[0], size * _SLOTS, prot=mmap.PROT_READ))
                slot, stamp = map(int, data.split())
                if complete(payload, memory[slot * size : (slot + 1) * size]):
                    heard(stamp)

        threading.Thread(target=frames if payload in ARRAYS else texts, daemon=True).start()

    def following(self, channel: str) -> Callable[[], Any]:
        """What has come is received without waiting."""
        receiver = self._socket(channel)
        receiver.setblocking(False)

        def receive() -> bytes | None:
            try:
                return receiver.recv(_ROOM)
            except BlockingIOError:
                return None

        return newest_of(receive)

    def _socket(self, channel: str) -> socket.socket:
        folder = self.folder / channel
        folder.mkdir(parents=True, exist_ok=True)
        receiver = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        receiver.bind(str(folder / str(os.getpid())))
        return receiver


class _Slots:
    """A publisher's memory for one channel, warm from the start."""

    def __init__(self, image: np.ndarray[Any, Any]) -> None:
        size = image.nbytes * _SLOTS
        self.descriptor = os.memfd_create("bench")
        os.ftruncate(self.descriptor, size)
        self.memory = mmap.mmap(self.descriptor, size)
        self.memory.write(bytes(size))
        self.places = [
            np.frombuffer(self.memory, image.dtype, image.size, slot * image.nbytes).reshape(image.shape)
            for slot in range(_SLOTS)
        ]
        self.turn = itertools.cycle(range(_SLOTS))
        self.introduced: set[str] = set()

    def fill(self, image: np.ndarray[Any, Any]) -> int:
        """Copy the array into the next slot, and return its number."""
        slot = next(self.turn)
        np.copyto(self.places[slot], image)
        return slot

    def introduction(self, subscriber: str) -> list[Any]:
        """The descriptor of the memory, for one who does not have it yet."""
        if subscriber in self.introduced:
            return []
        self.introduced.add(subscriber)
        return [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [self.descriptor]))]
