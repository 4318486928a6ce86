"""The first REEM, 0.1.2 or 0.0.11, in its own virtual environment."""

import functools
import importlib
from importlib.metadata import version
from typing import Any

from .documented import DocumentedContender


class Contender(DocumentedContender):
    """The original. It can't be told a port, so one other than 6379 is put into its client's defaults."""

    def __init__(self, target: dict[str, Any]) -> None:
        import rejson

        if target["port"] != 6379:
            rejson.Client = functools.partial(rejson.Client, port=target["port"])
        connection: Any = importlib.import_module("reem.connection")
        with_classes = "reem.datatypes" if version("reem") == "0.0.11" else "reem.connection"
        datatypes: Any = importlib.import_module(with_classes)
        self.interface = connection.RedisInterface(host="127.0.0.1")
        self.interface.initialize()
        self.store = datatypes.KeyValueStore(self.interface)
        self.space = datatypes.PublishSpace(self.interface)
        self.callback_subscriber = datatypes.CallbackSubscriber

    @staticmethod
    def preload() -> None:
        """Import what a forked worker need not import again."""
        importlib.import_module("reem.connection")

    def version(self) -> str:
        """The installed version."""
        return f"reem {version('reem')}, redis-py {version('redis')}"
