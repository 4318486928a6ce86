"""The documented blocking API, as this REEM and the original both have it."""

from collections.abc import Callable
from typing import Any

from ..values import ARRAYS, complete, message, picture


def walk(store: Any, path: list[str]) -> Any:
    """The accessor at `path`, made anew for every call as a user's program does."""
    for key in path:
        store = store[key]
    return store


def message_maker(payload: str) -> Callable[..., dict[str, Any]]:
    """What makes the next stamped message."""
    image = {"image": picture(payload)} if payload in ARRAYS else {}
    return lambda **fields: message(payload, **image, **fields)


class DocumentedContender:
    """Writes, reads and publishes as the manual shows. Subclasses set `interface` and the three classes."""

    asynchronous = False
    interface: Any
    store: Any
    space: Any
    callback_subscriber: Any

    def writing(self, path: list[str], value: Any) -> Callable[[], None]:
        """`store["a"]["b"] = value`."""
        parents, last = path[:-1], path[-1]

        def call() -> None:
            walk(self.store, parents)[last] = value

        return call

    def reading(self, path: list[str], value: Any) -> Callable[[], Any]:
        """`store["a"]["b"].read()`."""
        return lambda: walk(self.store, path).read()

    def publishing(self, channel: str, payload: str) -> Callable[..., None]:
        """`space["channel"] = {"timestamp": now, ...}`."""
        make = message_maker(payload)

        def call(**fields: Any) -> None:
            self.space[channel] = make(**fields)

        return call

    def subscribe(self, channel: str, payload: str, heard: Callable[[int], None]) -> None:
        """A `CallbackSubscriber` that hands on the stamp once it has the data."""

        def callback(data: Any, updated_path: Any, **_: Any) -> None:
            if payload not in ARRAYS or complete(payload, data["image"]):
                heard(data["timestamp"])

        subscriber = self.callback_subscriber(channel, self.interface, callback, {})
        subscriber.listen()
        # Whoever does not hold a subscriber may lose it.
        self.__dict__.setdefault("subscribers", []).append(subscriber)
