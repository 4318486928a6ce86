"""pyzmq, PUB and SUB, over TCP or a Unix socket (`ipc`). The publisher binds, the subscriber connects."""

import threading
import time
from collections.abc import Callable
from typing import Any

import orjson
import zmq

from ..values import ARRAYS, complete, message, picture
from .control import newest_of


class Contender:
    """One context; a frame is a message of two parts, stamp and buffer."""

    asynchronous = False

    def __init__(self, target: dict[str, Any]) -> None:
        tcp, ipc = f"tcp://127.0.0.1:{target['peer_port']}", f"ipc://{target['folder']}/{target['peer_port']}"
        self.address = ipc + "-{}" if target["options"].get("ipc") else tcp  # a Unix socket for each channel
        self.context = zmq.Context()
        self.sockets: dict[str, Any] = {}

    def version(self) -> str:
        """The installed version."""
        return f"pyzmq {zmq.__version__}"

    def publishing(self, channel: str, payload: str) -> Callable[..., Any]:
        """Small: channel and JSON text; frame: channel, stamp and the array without a copy."""
        address, topic = self.address.format(channel), channel.encode()
        if address not in self.sockets:
            self.sockets[address] = self.context.socket(zmq.PUB)
            self.sockets[address].bind(address)
        publisher = self.sockets[address]
        if payload not in ARRAYS:
            return lambda **fields: publisher.send_multipart([topic, orjson.dumps(message(payload, **fields))])
        image = picture(payload)
        return lambda: publisher.send_multipart([topic, time.monotonic_ns().to_bytes(8), image], copy=False)

    def subscribe(self, channel: str, payload: str, heard: Callable[[int], None]) -> None:
        """A thread in a blocking receive."""
        subscriber = self._subscriber(channel)

        def listen() -> None:
            while True:
                parts = subscriber.recv_multipart(copy=payload not in ARRAYS)
                if payload not in ARRAYS:
                    heard(int(orjson.loads(parts[1])["timestamp"]))
                elif complete(payload, parts[2].buffer):
                    heard(int.from_bytes(parts[1].bytes))

        threading.Thread(target=listen, daemon=True).start()

    def following(self, channel: str) -> Callable[[], Any]:
        """What has come is received without waiting (`CONFLATE` would take messages of one part alone)."""
        subscriber = self._subscriber(channel)

        def receive() -> Any:
            try:
                return subscriber.recv_multipart(zmq.NOBLOCK)[1]
            except zmq.Again:
                return None

        return newest_of(receive)

    def _subscriber(self, channel: str) -> Any:
        subscriber = self.context.socket(zmq.SUB)
        subscriber.connect(self.address.format(channel))
        subscriber.subscribe(channel.encode())
        return subscriber
