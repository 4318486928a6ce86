"""iceoryx2: shared memory between two processes, and an event that wakes the subscriber."""

import contextlib
import ctypes
import threading
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import iceoryx2
import numpy as np
import orjson

from ..values import ARRAYS, complete, message, picture

_STAMP = 8  # bytes before a frame's own
_ROOM = 1024  # bytes of a small message
_MOST = 32  # processes of a service; without this it has room for eight subscribers


class Contender:
    """One node; of each channel a service for the data and one for the event that tells of them."""

    asynchronous = False

    def __init__(self, target: dict[str, Any]) -> None:
        iceoryx2.set_log_level(iceoryx2.LogLevel.Error)
        self.node = iceoryx2.NodeBuilder.new().create(iceoryx2.ServiceType.Ipc)
        # Benchmarks that run at the same time must not hear each other; this port is the pair's own.
        self.prefix = f"bench/{target['peer_port']}"
        self.kept: list[Any] = []
        self.publishers: dict[str, tuple[Any, Any]] = {}  # a service has room for two, unless it is told otherwise

    def version(self) -> str:
        """The installed version."""
        return f"iceoryx2 {version('iceoryx2')}"

    def _services(self, channel: str) -> tuple[Any, Any]:
        name = iceoryx2.ServiceName.new(f"{self.prefix}/{channel}")
        data = self.node.service_builder(name).publish_subscribe(iceoryx2.Slice[ctypes.c_uint8])
        data = data.max_subscribers(_MOST).max_nodes(_MOST).open_or_create()
        event = self.node.service_builder(name).event().max_listeners(_MOST).max_nodes(_MOST).open_or_create()
        self.kept += [data, event]
        return data, event

    def publishing(self, channel: str, payload: str) -> Callable[[], Any]:
        """Small: a JSON text; frame: the stamp and the array's bytes, copied once into memory that is lent."""
        image = picture(payload) if payload in ARRAYS else None
        if channel not in self.publishers:
            data, event = self._services(channel)
            room = _ROOM if image is None else _STAMP + image.nbytes
            publisher = data.publisher_builder().initial_max_slice_len(room).create()
            self.publishers[channel] = publisher, event.notifier_builder().create()
        publisher, notifier = self.publishers[channel]

        def send(*pieces: Any) -> None:
            sample = publisher.loan_slice_uninit(sum(len(piece) for piece in pieces))
            lent, place = np.frombuffer(sample.payload().as_memory_view(), np.uint8), 0
            for piece in pieces:
                lent[place : place + len(piece)] = piece
                place += len(piece)
            sample.assume_init().send()
            notifier.notify()

        if image is None:
            return lambda: send(np.frombuffer(orjson.dumps(message(payload)), np.uint8))
        flat = image.reshape(-1).view(np.uint8)
        return lambda: send(np.frombuffer(time.monotonic_ns().to_bytes(_STAMP), np.uint8), flat)

    def subscribe(self, channel: str, payload: str, heard: Callable[[int], None]) -> None:
        """A thread that waits for the event, then takes a view of each sample."""
        data, event = self._services(channel)
        subscriber, listener = data.subscriber_builder().create(), event.listener_builder().create()

        def take(content: memoryview) -> None:
            if payload not in ARRAYS:
                heard(int(orjson.loads(bytes(content))["timestamp"]))
            elif complete(payload, content[_STAMP:]):
                heard(int.from_bytes(content[:_STAMP]))

        def listen() -> None:
            while True:
                listener.blocking_wait()
                while (sample := subscriber.receive()) is not None:
                    take(sample.payload().as_memory_view().cast("B"))
                    with contextlib.suppress(AttributeError):
                        sample.delete()

        threading.Thread(target=listen, daemon=True).start()
