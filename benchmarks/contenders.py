"""Who is measured."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Contender:
    """A program under `benchmarks.workers`, how to run it and how to draw it."""

    label: str
    module: str
    colour: str
    environment: str | None = None
    host: str = "127.0.0.1"  # what it is told to connect to
    loop: str = "asyncio"
    instead: str | None = None  # who is asked where this one fails


CONTENDERS = {
    "reem": Contender("REEM, blocking", "reem_blocking", "#0b5fa5"),
    "async": Contender("REEM, asyncio", "reem_asyncio", "#19a0a0"),
    "reem-local": Contender("REEM, blocking, at localhost", "reem_blocking", "#6fa8dc", host="localhost"),
    "reem-static": Contender("REEM, blocking, static schema", "reem_static", "#2f3f8f"),
    "async-local": Contender("REEM, asyncio, at localhost", "reem_asyncio", "#8fd6d6", host="localhost"),
    "async-uvloop": Contender("REEM, asyncio on uvloop", "reem_asyncio", "#0e7a5f", loop="uvloop"),
    "original": Contender(
        "original REEM 0.1.2", "original", "#d1495b", environment="reem-0.1.2", instead="original-0.0.11"
    ),
    "original-0.0.11": Contender("original REEM 0.0.11", "original", "#e8909c", environment="reem-0.0.11"),
    "redis-py": Contender("redis-py, blocking", "redis_blocking", "#5c5c5c"),
    "redis-asyncio": Contender("redis.asyncio", "redis_asyncio", "#a0a0a0"),
    "redis-asyncio-uvloop": Contender("redis.asyncio on uvloop", "redis_asyncio", "#c8c8c8", loop="uvloop"),
    "connection": Contender("bare connection, header and buffer", "connection", "#222222"),
    "floor": Contender("bare sockets, bytes made before", "floor", "#000000"),
    "pottery": Contender("pottery", "pottery_dict", "#8a5fbf"),
    "pyzmq": Contender("pyzmq", "pyzmq_pubsub", "#e0a030"),
    "zenoh": Contender("zenoh over TCP", "zenoh_pubsub", "#b5651d"),
}

LOCAL = {"reem": "reem-local", "async": "async-local"}
"""Who goes by TCP, as all do in every comparison, and the same at `localhost`: through the server's Unix socket."""
