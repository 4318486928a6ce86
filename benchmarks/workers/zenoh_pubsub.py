"""eclipse-zenoh, peer to peer over TCP and, unless it is told otherwise, shared memory; scouting off.

The publisher listens, the subscriber connects.
"""

import json
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np
import orjson
import zenoh

from ..values import FRAME_SHAPE, PIXELS, picture


class Contender:
    """One session, opened when it is known which side this process is."""

    asynchronous = False

    def __init__(self, target: dict[str, Any]) -> None:
        self.address = f"tcp/127.0.0.1:{target['peer_port']}"
        self.shares_memory = target["options"].get("shares_memory", True)  # as it does if it is not told otherwise
        self.session: Any = None
        self.kept: list[Any] = []

    def version(self) -> str:
        """The installed version."""
        return f"eclipse-zenoh {version('eclipse-zenoh')}"

    def _open(self, side: str) -> Any:
        if self.session is None:
            config = zenoh.Config()
            config.insert_json5("mode", '"peer"')
            config.insert_json5("scouting/multicast/enabled", "false")
            config.insert_json5("scouting/gossip/enabled", "false")
            config.insert_json5("transport/shared_memory/enabled", json.dumps(self.shares_memory))
            config.insert_json5("listen/endpoints", json.dumps([self.address] if side == "listen" else []))
            config.insert_json5("connect/endpoints", json.dumps([self.address] if side == "connect" else []))
            self.session = zenoh.open(config)
        return self.session

    def publishing(self, channel: str, payload: str) -> Callable[[], Any]:
        """Small: a JSON text; frame: the array's bytes with the stamp as attachment."""
        publisher = self._open("listen").declare_publisher(
            f"bench/{channel}", congestion_control=zenoh.CongestionControl.BLOCK
        )
        self.kept.append(publisher)
        if payload == "small":
            return lambda: publisher.put(orjson.dumps({"timestamp": time.monotonic_ns()}))
        image = picture(payload)

        def call() -> None:
            stamp = time.monotonic_ns().to_bytes(8)
            publisher.put(image.tobytes(), attachment=stamp)

        return call

    def subscribe(self, channel: str, payload: str, heard: Callable[[int], None]) -> None:
        """A callback, called by zenoh's own thread."""

        def callback(sample: Any) -> None:
            data = sample.payload.to_bytes()
            if payload == "small":
                heard(int(orjson.loads(data)["timestamp"]))
            elif np.frombuffer(data, PIXELS[payload]).reshape(FRAME_SHAPE).shape == FRAME_SHAPE:
                heard(int.from_bytes(sample.attachment.to_bytes()))

        self.kept.append(self._open("connect").declare_subscriber(f"bench/{channel}", callback))
