"""The newest state of each key, in Rerun: numbers, pictures and other arrays, texts."""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence
from pathlib import Path as FilePath
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from ...concurrency.queues import Newest
from ...concurrency.tasks import come_last
from ...connection import RedisInterface
from ...errors import BadValue, ServerFailed
from ...plan.paths import Path
from ...plan.placeholders import Unreadable
from ...plan.trees import MISSING
from ...ships.images import EncodedImage
from ..recording.layout import is_picture, picture_format
from .base import Viewer, extra

_EXAMPLE = "rerun+http://127.0.0.1:9876/proxy"
_PORT = 9876  # of an address without one
_CONNECTED = 5.0  # seconds in which a viewer must answer
_TIMELINE = "publish_time"
_MOST_NUMBERS = 64  # of a list or vector that is drawn as curves
_MOST_ENTITIES = 1000  # of a key: Rerun keeps each for good
_FLUSH = 5.0  # seconds that the end may take to send what waits


class RerunViewer(Viewer):
    """Sends keys to Rerun, as they are a number of times a second.

    Args:
        interface: The server; it is not closed.
        patterns: Globs of top-level keys; all if there is none.
        rate: How often a second the newest state of a key is sent, at most.

    Attributes:
        shown: How many states of keys were sent.
        unknown: How many values of types that Rerun has no view for were left out.
    """

    def __init__(self, interface: RedisInterface, patterns: Sequence[str] = (), *, rate: float = 30.0) -> None:
        super().__init__(interface, patterns, Newest)
        come_last()  # before Rerun begins its threads, which inherit it
        self._rerun: Any = extra("rerun", "rerun-sdk")
        self._recording = self._rerun.RecordingStream("reem")
        # The first entry takes a second, in which Rerun imports most of itself: not while updates wait.
        self._rerun.Scalars(0.0).as_component_batches()
        self._gap = 1 / rate
        self._due: dict[str, float] = {}
        self._waiting: dict[str, tuple[Any, int]] = {}
        self._last: dict[str, dict[Path, Any]] = {}  # what was sent last, by key and path
        self.shown = self.unknown = 0

    def open(self, *, connect: str | None = None, save: FilePath | None = None, force: bool = False) -> None:
        """Send to a viewer that runs at an address, to a file, or else to a viewer that this starts.

        Raises:
            BadValue: The address is none of Rerun's.
            FileExistsError: The file is there, without `force`.
            ServerFailed: No viewer answers there, or none could be started.
        """
        if save is not None:
            if save.exists() and not force:
                raise FileExistsError(f"{save} exists; use --force to replace it")
            self._recording.save(str(save))
        elif connect is not None:
            # Rerun itself would wait for a viewer for ever, with all that is sent to it.
            place = urlsplit(connect)
            try:
                if place.hostname:
                    socket.create_connection((place.hostname, place.port or _PORT), _CONNECTED).close()
            except OSError as error:
                raise ServerFailed(f"no viewer of Rerun answers at {connect}: {error}; start it with: rerun") from None
            try:
                self._recording.connect_grpc(connect)
            except (ValueError, RuntimeError) as error:
                raise BadValue(f"{connect!r} is no address of Rerun, such as {_EXAMPLE}: {error}") from None
        else:
            try:
                self._recording.spawn()
            except (RuntimeError, OSError) as error:
                raise ServerFailed(f"no viewer of Rerun could be started: {error}") from None

    def close(self) -> None:
        """Send what waits, and end; raises ServerFailed if the viewer has gone."""
        try:
            self._send_due(None)
            self._recording.flush(timeout_sec=_FLUSH)
        except RuntimeError as error:
            raise ServerFailed(f"the viewer of Rerun has gone, and what waited for it is lost: {error}") from None
        self._recording.disconnect()

    def wants(self, name: str) -> bool | None:
        return True

    def show(self, name: str, tree: Any, at: int) -> None:
        self._waiting[name] = tree, at

    def gone(self, name: str) -> None:
        self._send_due(name)
        if self._last.pop(name, None) is not None:
            self._recording.log(self._entity((name,)), self._rerun.Clear(recursive=True))

    async def tick(self) -> None:
        now = time.monotonic()
        for name in [name for name in self._waiting if self._due.get(name, 0.0) <= now]:
            self._due[name] = now + self._gap
            self._send_due(name)

    def _send_due(self, name: str | None) -> None:
        for each in list(self._waiting) if name is None else [name]:
            if each in self._waiting:
                tree, at = self._waiting.pop(each)
                self._send(each, tree, at)

    def _send(self, name: str, tree: Any, at: int) -> None:
        """Log what has changed of a key since it was sent last."""
        self._recording.set_time(_TIMELINE, timestamp=np.datetime64(at, "ns"))
        last, now = self._last.get(name, {}), dict(self._leaves(tree, (name,)))
        for path, value in list(now.items())[:_MOST_ENTITIES]:
            before = last.get(path, MISSING)
            if value is before or (_is_plain(value) and type(value) is type(before) and value == before):
                continue
            archetype = self._archetype(value)
            if archetype is None:
                self.unknown += 1
            else:
                self._recording.log(self._entity(path), archetype)
        for path in last.keys() - now.keys():
            self._recording.log(self._entity(path), self._rerun.Clear(recursive=False))
        self._last[name] = now
        self.shown += 1

    @staticmethod
    def _entity(path: Path) -> list[object]:
        return [str(key) for key in path]  # Rerun escapes what its paths do not allow

    def _leaves(self, tree: Any, path: Path) -> list[tuple[Path, Any]]:
        """Return what is at an entity of its own; a short list of numbers is one."""
        if isinstance(tree, dict):
            return [leaf for key, item in tree.items() for leaf in self._leaves(item, (*path, key))]
        if isinstance(tree, list) and not _are_numbers(tree):
            return [leaf for place, item in enumerate(tree) for leaf in self._leaves(item, (*path, place))]
        return [] if tree is None else [(path, tree)]

    def _archetype(self, value: Any) -> Any:
        """Return what Rerun shows for a value; None if it has no view for it."""
        rerun = self._rerun
        if isinstance(value, str | Unreadable):
            return rerun.TextLog(value if isinstance(value, str) else f"unreadable: {value.reason}")
        if isinstance(value, bool | int | float):
            return rerun.Scalars(float(value))
        if isinstance(value, list):
            return _curves(rerun, np.array(value, float))
        if isinstance(value, bytes) and (name := picture_format(value)):
            return rerun.EncodedImage(contents=value, media_type=f"image/{name}")
        if isinstance(value, EncodedImage):
            kind = rerun.EncodedDepthImage if value.dtype == "uint16" else rerun.EncodedImage
            return kind(contents=value.data, media_type=f"image/{value.label}")
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf" or not value.size:
            return None
        if is_picture("numpy", value.dtype.str, value.shape):
            return rerun.Image(value) if value.dtype.str == "|u1" else rerun.DepthImage(value)
        if value.ndim <= 1:
            return _curves(rerun, value.reshape(-1).astype(float))
        return rerun.Tensor(value.astype("u1") if value.dtype.kind == "b" else value)


def _curves(rerun: Any, numbers: np.ndarray[Any, Any]) -> Any:
    """Return a few numbers as curves over time, and many as a tensor: Rerun draws each curve."""
    return rerun.Scalars(numbers) if numbers.size <= _MOST_NUMBERS else rerun.Tensor(numbers)


def _are_numbers(items: list[Any]) -> bool:
    return bool(items) and all(type(item) in (int, float, bool) for item in items)


def _is_plain(value: Any) -> bool:
    return isinstance(value, str | int | float) or (isinstance(value, list) and _are_numbers(value))
