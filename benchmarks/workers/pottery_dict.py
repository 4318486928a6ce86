"""Pottery 3, used as the manual's listing uses it."""

import warnings
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import redis
from pottery import RedisDict


class Contender:
    """A `RedisDict` whose one entry is the value."""

    asynchronous = False

    def __init__(self, target: dict[str, Any]) -> None:
        warnings.simplefilter("ignore")
        self.client = redis.Redis.from_url(target["url"])

    def version(self) -> str:
        """The installed version."""
        return f"pottery {version('pottery')}"

    def writing(self, path: list[str], value: Any) -> Callable[[], None]:
        """`redis_dict["data"] = value`."""
        entries = RedisDict(redis=self.client, key=path[0])

        def call() -> None:
            entries["data"] = value

        return call

    def reading(self, path: list[str], value: Any) -> Callable[[], Any]:
        """`redis_dict["data"]["sub_0"]...`."""
        entries, keys = RedisDict(redis=self.client, key=path[0]), ["data", *path[1:]]

        def call() -> Any:
            found: Any = entries
            for key in keys:
                found = found[key]
            return found

        return call
