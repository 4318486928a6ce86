"""This REEM, blocking front."""

from typing import Any

from .documented import DocumentedContender


class Contender(DocumentedContender):
    """Package `reem`."""

    def __init__(self, target: dict[str, Any]) -> None:
        from reem.connection import RedisInterface
        from reem.datatypes import CallbackSubscriber, KeyValueStore, PublishSpace

        self.interface = RedisInterface(host=target["url"], **target["options"])
        self.interface.initialize()
        self.store = KeyValueStore(self.interface)
        self.space = PublishSpace(self.interface)
        self.callback_subscriber = CallbackSubscriber

    @staticmethod
    def preload() -> None:
        """Import what a forked worker need not import again."""
        import reem  # noqa: F401

    def version(self) -> str:
        """What the package says of itself."""
        import reem

        return f"reem {getattr(reem, '__version__', 'of this folder')}"
