"""Who is measured."""

import dataclasses
from typing import Any


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
    options: dict[str, Any] = dataclasses.field(default_factory=dict)  # what it is told besides


CONTENDERS = {
    "reem": Contender("REEM, blocking", "reem_blocking", "#0b5fa5"),
    "async": Contender("REEM, asyncio", "reem_asyncio", "#19a0a0"),
    "reem-local": Contender("REEM, blocking, at localhost", "reem_blocking", "#6fa8dc", host="localhost"),
    "async-local": Contender("REEM, asyncio, at localhost", "reem_asyncio", "#8fd6d6", host="localhost"),
    "reem-off": Contender(
        "REEM, blocking, without shared memory", "reem_blocking", "#9db8d2", options={"local": "off"}
    ),
    "async-off": Contender("REEM, asyncio, without shared memory", "reem_asyncio", "#a9d6d6", options={"local": "off"}),
    "reem-early": Contender("REEM, blocking, early", "reem_blocking", "#073b66", options={"local": "early"}),
    "async-early": Contender("REEM, asyncio, early", "reem_asyncio", "#0b6b6b", options={"local": "early"}),
    "before": Contender("REEM before, blocking", "reem_blocking", "#7f7fbf", environment="before"),
    "async-before": Contender("REEM before, asyncio", "reem_asyncio", "#9f9fdf", environment="before"),
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
    "zenoh": Contender("zenoh (shared memory, its default)", "zenoh_pubsub", "#b5651d"),
    "zenoh-tcp": Contender("zenoh over TCP alone", "zenoh_pubsub", "#d9a066", options={"shares_memory": False}),
    "iceoryx2": Contender("iceoryx2", "iceoryx2_pubsub", "#556b2f", environment="iceoryx2"),
}

HOST = {
    "reem-local": CONTENDERS["reem-local"],
    "reem-host-early": Contender(
        "REEM, early, at localhost", "reem_blocking", "#073b66", host="localhost", options={"local": "early"}
    ),
    "reem-host-queued": Contender(
        "REEM, early without waiting",
        "reem_blocking",
        "#0b6b6b",
        host="localhost",
        options={"local": "early", "publish": {"wait": False}},  # "publish" is for PublishSpace
    ),
    "zenoh": CONTENDERS["zenoh"],
    "pyzmq-ipc": Contender("pyzmq, ipc", "pyzmq_pubsub", "#e0a030", options={"ipc": True}),
    "redis-socket": Contender("redis-py, Unix socket", "redis_blocking", "#5c5c5c", options={"socket": True}),
    "iceoryx2": CONTENDERS["iceoryx2"],
    "datagram": Contender("floor, Unix datagram", "datagram", "#000000"),
}
"""The ways between programs of one host."""

SHOWN = {
    viewer: Contender(f"REEM and {viewer}", "viewed", "#0b5fa5", host="localhost", options={"viewer": viewer})
    for viewer in ("rerun", "foxglove")
}
"""REEM's programs that also log to a viewer."""

CONTENDERS |= HOST | SHOWN

LOCAL = {"reem": "reem-local", "async": "async-local"}
"""Who goes by TCP, as all do in every comparison, and the same at `localhost`: through the server's Unix socket."""

OFF = {"reem": "reem-off", "async": "async-off"}
"""Who shares memory with programs near by, as by default, and the same told not to."""

EARLY = {"reem": "reem-early", "async": "async-early"}
"""The same told to tell programs near by before the server has an update."""

BEFORE = {"reem": "before", "async": "async-before"}
"""The same of an earlier commit; measured only if one is named (`--before`)."""
