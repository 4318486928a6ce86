"""pyzmq, PUB and SUB over TCP. The publisher binds, the subscriber connects."""

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import orjson
import zmq

from ..values import FRAME_SHAPE, PIXELS, picture


class Contender:
    """One context; a frame is a message of two parts, stamp and buffer."""

    asynchronous = False

    def __init__(self, target: dict[str, Any]) -> None:
        self.address = f"tcp://127.0.0.1:{target['peer_port']}"
        self.context = zmq.Context()
        self.sockets: dict[str, Any] = {}

    def version(self) -> str:
        """The installed version."""
        return f"pyzmq {zmq.__version__}"

    def publishing(self, channel: str, payload: str) -> Callable[[], Any]:
        """Small: channel and JSON text; frame: channel, stamp and the array without a copy."""
        if not self.sockets:
            self.sockets["publisher"] = self.context.socket(zmq.PUB)
            self.sockets["publisher"].bind(self.address)
        publisher, topic = self.sockets["publisher"], channel.encode()
        if payload == "small":
            return lambda: publisher.send_multipart([topic, orjson.dumps({"timestamp": time.monotonic_ns()})])
        image = picture(payload)
        return lambda: publisher.send_multipart([topic, time.monotonic_ns().to_bytes(8), image], copy=False)

    def subscribe(self, channel: str, payload: str, heard: Callable[[int], None]) -> None:
        """A thread in a blocking receive."""
        subscriber = self.context.socket(zmq.SUB)
        subscriber.connect(self.address)
        subscriber.subscribe(channel.encode())

        def listen() -> None:
            while True:
                parts = subscriber.recv_multipart(copy=payload == "small")
                if payload == "small":
                    heard(int(orjson.loads(parts[1])["timestamp"]))
                elif np.frombuffer(parts[2].buffer, PIXELS[payload]).reshape(FRAME_SHAPE).shape == FRAME_SHAPE:
                    heard(int.from_bytes(parts[1].bytes))

        threading.Thread(target=listen, daemon=True).start()
