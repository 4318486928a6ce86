"""This REEM, blocking front."""

from collections.abc import Callable
from typing import Any

from .documented import DocumentedContender


class Contender(DocumentedContender):
    """Package `reem`."""

    def __init__(self, target: dict[str, Any]) -> None:
        from reem.connection import RedisInterface
        from reem.datatypes import CallbackSubscriber, KeyValueStore, PublishSpace

        options = dict(target["options"])
        publish = options.pop("publish", {})
        self.interface = RedisInterface(host=target["url"], **options)
        self.interface.initialize()
        self.store = KeyValueStore(self.interface)
        self.space = PublishSpace(self.interface, **publish)
        self.callback_subscriber = CallbackSubscriber

    def following(self, channel: str) -> Callable[[], Any]:
        """A `SilentSubscriber`, whose local copy answers."""
        from reem.datatypes import SilentSubscriber

        mirror = SilentSubscriber(channel=channel, interface=self.interface)
        mirror.listen()
        return mirror.value

    @staticmethod
    def preload() -> None:
        """Import what a forked worker need not import again."""
        import reem  # noqa: F401

    def version(self) -> str:
        """What the package says of itself."""
        import reem

        return f"reem {getattr(reem, '__version__', 'of this folder')}"
