"""Module names of REEM 1.0, before its modules were sorted into folders: old pickles and imports still find them."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any

MOVED = {
    "accessor": "store.accessor",
    "browser": "tools.browser",
    "catalog": "store.catalog",
    "cli": "tools.cli",
    "cluster_server": "server.cluster",
    "document": "store.document",
    "follow": "pubsub.follower",
    "policy": "concurrency.queues",
    "publish": "store.publish",
    "state": "transport.state",
    "subscribe": "pubsub.subscribers",
}
"""Old name -> new name, both below `reem_async`."""


class _OldName(ModuleType):
    """Stands under an old name; the module is imported when something of it is asked for."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # the import system looks for some, and need not import the module for that
            raise AttributeError(name)
        package, old = self.__name__.split(".", 1)
        return getattr(importlib.import_module(f"{package}.{MOVED[old]}"), name)


def keep_old_names(package: str) -> None:
    """Make the old module names importable."""
    for old in MOVED:
        sys.modules.setdefault(f"{package}.{old}", _OldName(f"{package}.{old}"))
