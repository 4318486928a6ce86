"""This REEM, asyncio front."""

from collections.abc import Awaitable, Callable
from typing import Any

from ..values import ARRAYS, complete
from .documented import message_maker, walk


class Contender:
    """Package `reem_async`."""

    asynchronous = True

    def __init__(self, target: dict[str, Any]) -> None:
        self.target = target
        self.subscribers: list[Any] = []

    @staticmethod
    def preload() -> None:
        """Import what a forked worker need not import again."""
        import reem_async  # noqa: F401

    async def connect(self) -> None:
        """Connect now."""
        from reem_async.connection import RedisInterface
        from reem_async.datatypes import KeyValueStore, PublishSpace

        self.interface = RedisInterface(host=self.target["url"], **self.target["options"])
        await self.interface.initialize()
        self.store: Any = KeyValueStore(self.interface)
        self.space: Any = PublishSpace(self.interface)

    def version(self) -> str:
        """What the package says of itself."""
        import reem_async

        return f"reem {getattr(reem_async, '__version__', 'of this folder')}"

    def writing(self, path: list[str], value: Any) -> Callable[[], Awaitable[Any]]:
        """`await store["a"]["b"].write(value)`."""
        return lambda: walk(self.store, path).write(value)

    def reading(self, path: list[str], value: Any) -> Callable[[], Awaitable[Any]]:
        """`await store["a"]["b"].read()`."""
        return lambda: walk(self.store, path).read()

    def publishing(self, channel: str, payload: str) -> Callable[[], Awaitable[Any]]:
        """`await space["channel"].write({"timestamp": now, ...})`."""
        message = message_maker(payload)
        return lambda: self.space[channel].write(message())

    async def subscribe(self, channel: str, payload: str, heard: Callable[[int], None]) -> None:
        """A `CallbackSubscriber` that hands on the stamp once it has the data."""
        from reem_async.datatypes import CallbackSubscriber

        def callback(data: Any, updated_path: str, **_: Any) -> None:
            if payload not in ARRAYS or complete(payload, data["image"]):
                heard(data["timestamp"])

        subscriber = CallbackSubscriber(channel, self.interface, callback, {})
        await subscriber.listen()
        self.subscribers.append(subscriber)
