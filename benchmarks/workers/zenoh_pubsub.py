"""eclipse-zenoh, peer to peer over TCP and, unless it is told otherwise, shared memory; scouting off.

Of a pair the publisher listens and the subscriber connects. Of more processes, one is the hub that the others connect
to, and learn of each other from.
"""

import json
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import orjson
import zenoh

from ..values import ARRAYS, complete, message, picture
from .control import newest_of


class Contender:
    """One session, opened when it is known which side this process is."""

    asynchronous = False

    def __init__(self, target: dict[str, Any]) -> None:
        self.address = f"tcp/127.0.0.1:{target['peer_port']}"
        self.shares_memory = target["options"].get("shares_memory", True)  # as it does if it is not told otherwise
        self.hub: bool | None = target["hub"]  # None for a pair
        self.session: Any = None
        self.kept: list[Any] = []

    def version(self) -> str:
        """The installed version."""
        return f"eclipse-zenoh {version('eclipse-zenoh')}"

    def _open(self, side: str) -> Any:
        if self.session is None:
            listening = []
            if self.hub is not None:
                side, listening = "listen" if self.hub else "connect", ["tcp/127.0.0.1:0"]
            config = zenoh.Config()
            config.insert_json5("mode", '"peer"')
            config.insert_json5("scouting/multicast/enabled", "false")
            config.insert_json5("scouting/gossip/enabled", json.dumps(self.hub is not None))
            config.insert_json5("transport/shared_memory/enabled", json.dumps(self.shares_memory))
            config.insert_json5("listen/endpoints", json.dumps([self.address] if side == "listen" else listening))
            config.insert_json5("connect/endpoints", json.dumps([self.address] if side == "connect" else []))
            self.session = zenoh.open(config)
        return self.session

    def publishing(self, channel: str, payload: str) -> Callable[..., Any]:
        """Small: a JSON text; frame: the array's bytes with the stamp as attachment."""
        publisher = self._open("listen").declare_publisher(
            f"bench/{channel}", congestion_control=zenoh.CongestionControl.BLOCK
        )
        self.kept.append(publisher)
        if payload not in ARRAYS:
            return lambda **fields: publisher.put(orjson.dumps(message(payload, **fields)))
        image = picture(payload)

        def call() -> None:
            stamp = time.monotonic_ns().to_bytes(8)
            publisher.put(image.tobytes(), attachment=stamp)

        return call

    def subscribe(self, channel: str, payload: str, heard: Callable[[int], None]) -> None:
        """A callback, called by zenoh's own thread."""

        def callback(sample: Any) -> None:
            data = sample.payload.to_bytes()
            if payload not in ARRAYS:
                heard(int(orjson.loads(data)["timestamp"]))
            elif complete(payload, data):
                heard(int.from_bytes(sample.attachment.to_bytes()))

        self.kept.append(self._open("connect").declare_subscriber(f"bench/{channel}", callback))

    def following(self, channel: str) -> Callable[[], Any]:
        """zenoh's own ring of one sample, which is taken without waiting."""
        ring = self._open("connect").declare_subscriber(f"bench/{channel}", zenoh.handlers.RingChannel(1))
        self.kept.append(ring)

        def receive() -> bytes | None:
            sample = ring.try_recv()
            return None if sample is None else bytes(sample.payload.to_bytes())

        return newest_of(receive)
