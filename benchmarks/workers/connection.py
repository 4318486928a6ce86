"""The floor for arrays: one blocking connection that sends the header and then the array's own buffer."""

from collections.abc import Callable
from typing import Any

import numpy as np
import redis


class Contender:
    """One `redis.Connection`, no client, no pool."""

    asynchronous = False

    def __init__(self, target: dict[str, Any]) -> None:
        make: Any = redis.Connection
        self.connection = make(host=target["host"], port=target["port"])
        self.connection.connect()

    def version(self) -> str:
        """The installed version."""
        return f"redis-py {redis.__version__}"

    def writing(self, path: list[str], value: Any) -> Callable[[], Any]:
        """SET of an array, header and buffer as they are. Documents are not its business."""
        name = ".".join(path).encode()
        if not isinstance(value, np.ndarray):
            return lambda: None
        flat = value.reshape(-1).view(np.uint8).data

        def call() -> Any:
            head = b"*3\r\n$3\r\nSET\r\n$%d\r\n%b\r\n$%d\r\n" % (len(name), name, len(flat))
            self.connection.send_packed_command([head, flat, b"\r\n"], check_health=False)
            return self.connection.read_response()

        return call

    def reading(self, path: list[str], value: Any) -> Callable[[], Any]:
        """GET of an array."""
        name = ".".join(path)

        def call() -> Any:
            self.connection.send_command("GET", name, check_health=False)
            return self.connection.read_response(disable_decoding=True)

        return call
