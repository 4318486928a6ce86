"""Bare redis-py, blocking: the one command, with orjson for documents and plain bytes for arrays."""

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import orjson
import redis

from ..values import FRAME_SHAPE, PIXELS, picture


class Contender:
    """One `redis.Redis`."""

    asynchronous = False

    def __init__(self, target: dict[str, Any]) -> None:
        self.client: Any = redis.Redis.from_url(target["url"])
        self.client.ping()

    def version(self) -> str:
        """The installed version."""
        return f"redis-py {redis.__version__}"

    def writing(self, path: list[str], value: Any) -> Callable[[], Any]:
        """JSON.SET of a document, SET of an array."""
        name = ".".join(path)
        if isinstance(value, np.ndarray):
            return lambda: self.client.set(name, value.tobytes())
        return lambda: self.client.execute_command("JSON.SET", name, ".", orjson.dumps(value))

    def reading(self, path: list[str], value: Any) -> Callable[[], Any]:
        """JSON.GET of a document, GET of an array."""
        name = ".".join(path)
        if isinstance(value, np.ndarray):
            return lambda: self.client.get(name)
        return lambda: orjson.loads(self.client.execute_command("JSON.GET", name, "."))

    def publishing(self, channel: str, payload: str) -> Callable[[], Any]:
        """PUBLISH of a small JSON text; for a frame SET of its bytes and PUBLISH of the text, as one transaction."""
        if payload == "small":
            return lambda: self.client.publish(channel, orjson.dumps({"timestamp": time.monotonic_ns()}))
        image = picture(payload)

        def call() -> None:
            text = orjson.dumps({"timestamp": time.monotonic_ns()})
            self.client.pipeline().set(f"{channel}:frame", image.tobytes()).publish(channel, text).execute()

        return call

    def subscribe(self, channel: str, payload: str, heard: Callable[[int], None]) -> None:
        """A thread in a blocking `listen`, which fetches the frame a message announces."""
        pubsub = self.client.pubsub(ignore_subscribe_messages=True)
        pubsub.subscribe(channel)

        def listen() -> None:
            for message in pubsub.listen():
                stamp = int(orjson.loads(message["data"])["timestamp"])
                if payload == "small" or self._frame(channel, payload).shape == FRAME_SHAPE:
                    heard(stamp)

        threading.Thread(target=listen, daemon=True).start()

    def _frame(self, channel: str, payload: str) -> np.ndarray[Any, Any]:
        return np.frombuffer(self.client.get(f"{channel}:frame"), PIXELS[payload]).reshape(FRAME_SHAPE)
