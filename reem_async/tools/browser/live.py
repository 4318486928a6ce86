"""A live server as a source: what is there is read from the server, what was there comes from the rolling buffer."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from operator import getitem
from typing import Any

from ...connection import RedisInterface
from ...coordination.calls import statistics
from ...coordination.parameters import SPECIFICATIONS, StoredParameter, publish, stored_parameters
from ...errors import BadType, ConnectionLost, MissingKey, NotAllowed, NotConnected, ServerNotReady, WrongKind
from ...plan.paths import Path, show
from ...plan.trees import MISSING
from ...store.catalog import Outline, outline
from ...store.document import DocumentReader
from ...store.store import PublishSpace
from .follower import Follower
from .history import History
from .partial_reads import keys_at, peek
from .raw import RawFollower
from .source import (
    LAYOUTS,
    Loss,
    Node,
    NotKept,
    Page,
    Sample,
    Series,
    Status,
    counted,
    matching,
    node_of,
    numbers_in,
    snippets,
)
from .timeline import UNKNOWN
from .trees import Frame, differing, fitted, leaves_size, thawed

_LARGEST = 1 << 28  # bytes of arrays up to which a value is read for a page
_SHARED_SECONDS = 0.2  # how long one reading of a large value serves all requests
_SIZE_SECONDS, _MOST_SIZES = 5.0, 1000  # how long the size of a dict is taken for known, and of how many
_SHORT = 128  # bytes of a value up to which it is read to be drawn
_UNTOLD = (
    "what is only stored is looked for once a second, and overwritten arrays are not noticed: the server does not tell"
)
"""Said where it is so: the user lacks a right, and a warning has said which."""

_AWAY = ConnectionLost, NotConnected, ServerNotReady, OSError
"""What is raised while the server cannot be asked: its past is known all the same."""


class LiveSource:
    """What a server holds, and what it held in the last seconds.

    Every published update is there, and each stored change a moment after it was made; docs/limits.md says how late.

    Args:
        interface: The server; closed with the source.
        seconds: How long the past is kept.
        budget: Bytes of memory for the past.
    """

    live = True
    writable = True

    def __init__(self, interface: RedisInterface, seconds: float = 60.0, budget: int = 128 << 20) -> None:
        self.interface = interface
        self.title = interface.hostname + (f" · {interface.namespace}" if interface.namespace else "")
        self.history = History(seconds, budget)
        self._follower = Follower(interface, self.history)
        self._raw = RawFollower(interface.session, self.history)
        self._shared: dict[Path, asyncio.Task[Any]] = {}
        self._sizes: dict[Path, tuple[float, int | None]] = {}  # of dicts and lists, and when they had it
        self._space: Any = PublishSpace(interface)

    async def start(self) -> None:
        """Connect and begin to follow. Idempotent; raises NotConnected and the like."""
        await self._follower.start()
        await self._raw.start()

    async def close(self) -> None:
        await self._raw.close()
        await self._follower.close()
        await self.interface.close()

    def status(self) -> Status:
        notes = ["the buffer is full: it reaches back less far than asked for"] if self.history.dropped else []
        if self._follower.monitor.dropped:
            notes.append(f"{self._follower.monitor.dropped} updates came too fast to be kept")
        if not self._follower.hears_of_changes:
            notes.append(_UNTOLD)
        if self._raw.note:
            notes.append(self._raw.note)
        end = self.history.clock.now()
        return Status(
            min(max(self.history.start, end - self.history.seconds), end), end, self._follower.lost, "; ".join(notes)
        )

    async def opened(self) -> None:
        """Return: from when on there is a past is known from the beginning."""

    def shown_on(self, pages: int) -> None:
        self._follower.shown_on(pages)
        self._raw.shown_on(pages)

    def snippets(self, path: Path, at: float | None) -> dict[str, str]:
        return snippets(path, self.interface.session.options.url, self.interface.namespace, raw=self._is_raw(path))

    def _is_raw(self, path: Path) -> bool:
        """Return whether a path leads into a key of another program, all of which the buffer has."""
        return bool(path) and path[0] in self._raw.kinds

    def hint(self, path: Path, text: str) -> None:
        """Say what the bytes at a path of another program are; see `RawFollower.hint`."""
        self._raw.hint(path, text)

    # --- the tree

    async def nodes(self, paths: Sequence[Path], at: float | None) -> list[Node | None]:
        """Return what is at each path: three round trips at most."""
        when = self.history.clock.now() if at is None else at
        # What has not changed since an instant is still there: it is asked of the server, and costs no memory here.
        now = [
            path for path in paths if not self._is_raw(path) and (at is None or self.history.unchanged(path[:1], at))
        ]
        try:
            found = dict(zip(now, await peek(self.interface.session, now), strict=True))
        except _AWAY:
            if at is None:
                raise
            found = {}  # the past is known without a server
        for path in paths:
            if path not in found:
                found[path] = self._past(path, when)
        last = self.history.last(paths, when)
        return [self._stamped(found[path], last, at, when) for path in paths]

    def _past(self, path: Path, at: float) -> Node | None:
        value = self.history.tree(path, at)
        if value is UNKNOWN:
            return Node(path, "unknown", "not kept for this instant")
        return None if value is MISSING else node_of(path, value)

    def _stamped(self, node: Node | None, last: dict[Path, float], at: float | None, when: float) -> Node | None:
        if node is None:
            return None
        name = str(node.path[0])
        raw = self._raw.kinds.get(name, "")
        rate = self.history.rate(name, when) if len(node.path) == 1 else None
        if raw and at is None and len(node.path) == 1:
            rate = self._raw.rate(name)
        size = self._size(node.path, when) if node.size is None and node.count is not None else node.size
        return replace(node, time=last.get(node.path), rate=rate, raw=raw, size=size)

    def _size(self, path: Path, when: float) -> int | None:
        """Return the bytes of all that is in a dict or list, as it was a few seconds ago; None if that is not known."""
        known, size = self._sizes.get(path, (-math.inf, None))
        if not 0 <= when - known < _SIZE_SECONDS:
            if len(self._sizes) >= _MOST_SIZES:
                self._sizes.clear()
            tree = self.history.tree(path, when)
            size = leaves_size(tree) if isinstance(tree, dict | list) else None
            if tree is not UNKNOWN:
                self._sizes[path] = when, size
        return size

    async def children(self, path: Path, start: int, count: int, at: float | None) -> Page:
        """Return some of what is below a path: four round trips at most."""
        keys = self._names(at) if not path else await self._keys(path, at)
        chosen = [(*path, key) for key in keys[start : start + count]]
        nodes = await self.nodes(chosen, at)
        return Page(len(keys), start, [node for node in nodes if node is not None])

    def _names(self, at: float | None) -> Sequence[str]:
        names = self._follower.names | self._raw.kinds.keys()
        if at is None:
            return sorted(names)
        # None: not known, so what is there now is taken to have been there then.
        known = {name: self.history.existed(name, at) for name in self.history.names}
        present = {name for name in names if known.get(name) is not False}
        return sorted(present | {name for name, existed in known.items() if existed})

    async def _keys(self, path: Path, at: float | None) -> Sequence[str | int]:
        if self._is_raw(path):
            at = self.history.clock.now() if at is None else at
        elif at is None or self.history.unchanged(path[:1], at):
            try:
                keys = await keys_at(self.interface.session, path)
                if keys is None:
                    raise MissingKey(f"nothing is stored at {show(path)}, or nothing is below it")
                return range(keys) if isinstance(keys, int) else keys
            except _AWAY:
                if at is None:
                    raise
        value = self.history.tree(path, at)
        if value is UNKNOWN:
            raise NotKept(f"{show(path)} was too large to be kept, so its past cannot be shown")
        if not isinstance(value, dict | list):
            raise MissingKey(f"nothing was below {show(path)} then")
        return list(value) if isinstance(value, dict) else range(len(value))

    # --- values

    async def value(self, path: Path, at: float | None) -> Sample:
        """Return the value at a path, arrays included; readings of the same moment are shared."""
        name = str(path[0])
        # Of arrays that the server does not tell of, the present does not speak for the past.
        if self._is_raw(path):
            at = self.history.clock.now() if at is None else at
        elif at is None or (self.history.unchanged(path, at) and self._follower.is_settled(name)):
            try:
                return Sample(await self._read(path), 0.0, self._age(path, at))
            except WrongKind:
                if not await self._raw.find(name):
                    raise
                at = self.history.clock.now()
            except _AWAY:
                if at is None:
                    raise
        kept = self.history.kept(path, at)
        if kept.value is UNKNOWN:
            raise NotKept(f"{show(path)} is not kept for this instant")
        if kept.value is MISSING:
            raise MissingKey(f"nothing was stored at {show(path)} then")
        if not isinstance(kept.value, Frame):
            return Sample(thawed(kept.value), kept.late)
        frame = kept.value
        # The best that is left of it.
        value = frame.preview if frame.whole is None else frame.whole
        return Sample(frame.described if value is None else value, kept.late, max(at - frame.time, 0.0))

    def _age(self, path: Path, at: float | None) -> float | None:
        """Return for how long what is there now had been there at an instant of the past."""
        since = None if at is None else self.history.last([path], at).get(path)
        return None if at is None or since is None else max(at - since, 0.0)

    async def _read(self, path: Path) -> Any:
        if path not in self._shared:
            # One reading of a camera serves all panes and pages that ask at the same time.
            self._shared[path] = asyncio.create_task(self._read_new(path))
            self._shared[path].add_done_callback(lambda done: self._let_go(path, done))
        # A cancelled request must not end the reading for the others.
        return await asyncio.shield(self._shared[path])

    def _let_go(self, path: Path, done: asyncio.Task[Any]) -> None:
        if not done.cancelled():
            # Retrieved, so that asyncio does not complain if no request waits for it any more.
            done.exception()
        asyncio.get_running_loop().call_later(_SHARED_SECONDS, self._shared.pop, path, None)

    async def _read_new(self, path: Path) -> Any:
        (node,) = await peek(self.interface.session, [path])
        # Before it is fetched: a page must not make this program take all memory.
        if node is not None and (node.size or 0) > _LARGEST:
            raise NotKept(f"{show(path)} has {node.size} bytes, too many for a page; read it with Python")
        return await DocumentReader(self.interface.session.raw, str(path[0])).read(path[1:])

    async def parameters(self, path: Path) -> list[StoredParameter]:
        """Return what programs have declared at and below a path. Two round trips, none without any parameters."""
        if SPECIFICATIONS not in self._follower.names:
            return []
        try:
            found, _ = await stored_parameters(self.interface.session, path)
        except NotAllowed:  # to read `_parameters`: the page shows all the rest
            return []
        return list(found.values())

    async def services(self) -> list[dict[str, Any]]:
        try:
            return await statistics(self.interface.session)
        except NotAllowed:  # the page shows all the rest
            return []

    async def save_layout(self, name: str, layout: dict[str, Any] | None) -> None:
        if layout is None:
            await self._space[LAYOUTS][name].delete()
        else:
            await publish(self.interface.session, (LAYOUTS, name), layout)

    async def write(self, path: Path, value: Any, *, retype: bool = False) -> list[str]:
        """Publish a value in the place of a plain one; subscribers learn of it. Up to six round trips.

        Returns what would have another type; nothing is written then unless `retype`.

        Raises:
            BadType: An array is there, or nothing at all below the top level.
            BadType, BadValue: A program has declared a parameter there, and does not allow the value.
        """
        if self._is_raw(path):
            raise BadType(f"{show(path)} is of another program, and a page only shows it; use kvs.raw in Python")
        # Not `parameters`: a key that was just made is among the names a second later.
        found, _ = await stored_parameters(self.interface.session, path)
        if (it := found.get(path)) is not None:
            await publish(self.interface.session, path, it.specification.checked(it.name, value))
            return []
        (node,) = await peek(self.interface.session, [path])
        if node is None:
            raise MissingKey(f"nothing is stored at {show(path)}; the page changes only what is there")
        if node.count is None and node.kind not in ("str", "int", "float", "bool", "NoneType"):
            raise BadType(f"{show(path)} is of type {node.kind}, which a page cannot write; use Python")
        # A dict that holds arrays would lose them: what the page sends is JSON.
        if node.count is not None and _has_leaves(await outline(self.interface, path)):
            raise BadType(f"{show(path)} holds arrays or bytes, which a page cannot write; edit what is below it")
        value, retyped = fitted(await self._read_new(path), value, path)
        if retyped and not retype:
            return retyped
        accessor: Any = reduce(getitem, path, self._space)
        await accessor.write(value)
        return []

    # --- time

    async def changes(self, since: float, until: float, most: int) -> list[Path]:
        found: dict[Path, None] = {}
        for change in self.history.between(since, until):
            found[change.path] = None
            if len(found) >= most:
                break
        return list(found)

    async def differing(self, since: float, until: float, most: int) -> set[Path]:
        before, after = (lambda name, at=at: self.history.tree((name,), at) for at in (since, until))
        return differing(await self.changes(since, until, most), before, after, most)

    async def activity(self, start: float, end: float, bins: int, path: Path) -> list[int]:
        return counted(self.history.times(path), start, end, bins)

    async def pictures(self, start: float, end: float, bins: int, path: Path) -> list[int]:
        """Return in which parts of a span arrays were kept: 2 whole, 1 as previews, 0 not; from the buffer."""
        found = [0] * bins
        frames = list(self.history.frames.concerning(path))
        for frame in frames:
            place = min(max(int((frame.time - start) / max(end - start, 1e-9) * bins), 0), bins - 1)
            if frame.time <= end:
                found[place] = max(found[place], 1 if frame.whole is None else 2)
        return found if frames else []

    async def series(self, path: Path, start: float, end: float) -> Series:
        samples = list(self.history.values(path, max(start, self.history.start), end))
        if not samples and not self._is_raw(path):
            (node,) = await peek(self.interface.session, [path])
            if node is not None and (node.text if node.size is None else node.size <= _SHORT):
                samples = [(end, await self._read(path))]
        return numbers_in(samples)

    async def losses(self, path: Path, start: float, end: float) -> list[Loss]:
        return self.history.losses.of(str(path[0]), start, end)

    async def search(self, text: str, at: float | None, most: int) -> list[Path]:
        """Return paths with `text` in them: keys first, then what is below those that the buffer knows."""
        needle, when = text.lower(), self.history.clock.now() if at is None else at
        return matching(needle, self._names(at), self.history.trees(when), most)


def _has_leaves(node: Outline) -> bool:
    return any(map(_has_leaves, node.children)) if node.kind in ("dict", "list") else not node.plain
