"""Bare redis-py, blocking: the one command, with orjson for documents and plain bytes for arrays."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import orjson
import redis

from ..values import ARRAYS, complete, message, picture
from .control import newest_of


class Contender:
    """One `redis.Redis`."""

    asynchronous = False

    def __init__(self, target: dict[str, Any]) -> None:
        self.client: Any = redis.Redis.from_url(target["url"])
        if target["options"].get("socket"):
            path = redis.Redis.from_url(target["url"], decode_responses=True).config_get("unixsocket")["unixsocket"]
            self.client = redis.Redis(unix_socket_path=path)
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

    def publishing(self, channel: str, payload: str) -> Callable[..., Any]:
        """PUBLISH of a small JSON text; for a frame SET of its bytes and PUBLISH of the text, as one transaction."""
        if payload not in ARRAYS:
            return lambda **fields: self.client.publish(channel, orjson.dumps(message(payload, **fields)))
        image = picture(payload)

        def call() -> None:
            text = orjson.dumps(message(payload))
            self.client.pipeline().set(f"{channel}:frame", image.tobytes()).publish(channel, text).execute()

        return call

    def subscribe(self, channel: str, payload: str, heard: Callable[[int], None]) -> None:
        """A thread in a blocking `listen`, which fetches the frame a message announces."""
        pubsub = self._subscriber(channel)

        def listen() -> None:
            for received in pubsub.listen():
                stamp = int(orjson.loads(received["data"])["timestamp"])
                if payload not in ARRAYS or complete(payload, self.client.get(f"{channel}:frame")):
                    heard(stamp)

        threading.Thread(target=listen, daemon=True).start()

    def following(self, channel: str) -> Callable[[], Any]:
        """What has come is received without waiting."""
        pubsub = self._subscriber(channel)

        def receive() -> Any:
            received = pubsub.get_message()
            return None if received is None else received["data"]

        return newest_of(receive)

    def _subscriber(self, channel: str) -> Any:
        pubsub = self.client.pubsub(ignore_subscribe_messages=True)
        pubsub.subscribe(channel)
        return pubsub
