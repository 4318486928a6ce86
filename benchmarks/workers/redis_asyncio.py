"""Bare redis.asyncio: the one command alone, its text made beforehand and its reply left as it came."""

from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import orjson
import redis
import redis.asyncio


class Contender:
    """One `redis.asyncio.Redis` with its pool, which may grow to as many connections as there are callers."""

    asynchronous = True

    def __init__(self, target: dict[str, Any]) -> None:
        self.client: Any = redis.asyncio.Redis.from_url(target["url"], max_connections=2000)

    async def connect(self) -> None:
        """Connect now."""
        await self.client.ping()

    def version(self) -> str:
        """The installed version."""
        return f"redis-py {redis.__version__}"

    def writing(self, path: list[str], value: Any) -> Callable[[], Awaitable[Any]]:
        """JSON.SET of a document, SET of an array."""
        name = ".".join(path)
        if isinstance(value, np.ndarray):
            return lambda: self.client.set(name, value.tobytes())
        text = orjson.dumps(value)
        return lambda: self.client.execute_command("JSON.SET", name, ".", text)

    def reading(self, path: list[str], value: Any) -> Callable[[], Awaitable[Any]]:
        """JSON.GET of a document, GET of an array."""
        name = ".".join(path)
        if isinstance(value, np.ndarray):
            return lambda: self.client.get(name)
        return lambda: self.client.execute_command("JSON.GET", name, ".")
