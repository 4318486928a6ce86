"""This REEM, blocking front, told that the shape of what is written never changes."""

from typing import Any

from . import reem_blocking


class Contender(reem_blocking.Contender):
    """Package `reem` with `track_schema_changes(False)`."""

    def __init__(self, target: dict[str, Any]) -> None:
        super().__init__(target)
        self.store.track_schema_changes(False)
