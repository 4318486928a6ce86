"""The thread that writes: takes what was received from a bounded queue, and keeps the tree as it was recorded.

Nothing waits for it. What does not fit into the queue is dropped and counted, and the key is read again.
"""

from __future__ import annotations

import collections
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
import orjson

from ...concurrency.tasks import give_way
from ...plan.paths import Path, Pattern, show
from ...plan.placeholders import Unreadable
from ...plan.trees import MISSING, CannotApply, difference, get, mapped, replaced, same, walk
from ...ships.images import EncodedImage
from ...ships.numpy import NumpyShip
from ...ships.registry import Ships
from .container import Container
from .format import DamagedRecording, Kind, Role
from .layout import WRAPPER, JsonMessage, encode, to_json
from .log_reader import RecordedPast
from .sink import FullError, Sink
from .stored import (
    LOST,
    Content,
    NotWritten,
    Reference,
    Unchanged,
    extract,
    opened,
    planted,
    pruned,
    reference_to,
    without,
)
from .times import STEP

logger = logging.getLogger("reem.recording")

# For which small operations are collected: waking for each would cost as much as writing it.
_BATCH_SECONDS = 0.04
# Added to the thread's niceness: it may lag behind, the recorded programs may not.
_NICER = 10
LARGE = (Role.UPDATE, Role.DELETE, Role.STATE, Role.STORED)
"""Roles that are dropped if the queue is full; the others hold nothing."""
_HURRY = 1 << 20
"""Bytes in the queue from which the thread is woken at once."""
_MOST_MOVED = 100_000
"""References to values of earlier files for which the reference in this file is kept."""

_NUMPY = NumpyShip()


class Operation(NamedTuple):
    role: Role
    path: Path
    value: Any  # what is there now; for a gap, how many updates were lost, None if unknown
    stamp: tuple[int, int, int]  # log time and publish time in ns, and a number
    kind: Kind = Kind.PUBLISHED

    def loaded(self) -> Operation:
        return self._replace(value=orjson.loads(self.value.text)) if type(self.value) is Packed else self


class Packed(NamedTuple):
    """A plain value as JSON, which takes less memory."""

    text: bytes


class Counts:
    def __init__(self) -> None:
        self.messages = 0
        self.bytes = 0
        self.dropped = 0
        self.skipped = 0
        self.gaps = 0
        self.lost = 0
        self.clock_steps = 0
        self.by_path: collections.Counter[str] = collections.Counter()

    def drop(self, path: Path) -> None:
        self.dropped += 1
        self._name(path)

    def skip(self, path: Path) -> None:
        """Count an update that was announced, and whose value cannot be known any more."""
        self.skipped += 1
        self._name(path)

    def lose(self, path: Path) -> None:
        self.lost += 1
        self._name(path)

    def _name(self, path: Path) -> None:
        # Named are the first thousand; a program may publish under ever new names.
        if len(self.by_path) < 1000 or show(path) in self.by_path:
            self.by_path[show(path)] += 1


class WriterThread:
    """Writes operations to a file on a thread of its own; at most `limit` bytes wait."""

    def __init__(
        self,
        sink: Sink,
        ships: Ships,
        limit: int,
        patterns: Sequence[Pattern] = (),
        first: Iterable[Operation] = (),  # are written before all others, and take no room
        following: Callable[[], Sink] | None = None,  # makes the next file
    ) -> None:
        self.counts = Counts()
        self.failure: Exception | None = None
        self.behind: set[str] = set()  # keys to read again: the tree here is not what the server has
        self.stored: set[str] = set()  # keys of which something was written that was only stored
        self._patterns = patterns
        self._sink = sink
        self._ships = ships
        self._limit = limit
        self._queue = collections.deque((operation, 0) for operation in first)
        self._size = 0
        # Guards the queue and its size. The event loop holds it for a few steps only, never while something is written.
        self._changed = threading.Condition()
        # Keys whose next whole differs in more than what was only stored, since something published is missing in the
        # tree: what was not put in, and what turned out when it was written. Each is known in the order of the queue.
        self._dropped: set[str] = set()
        self._lacking: set[str] = set()
        self._ending = False
        # What each key held after the last operation: keyframes are made of it, and reads are compared with it. Keys
        # that are gone are not in it.
        self._trees: dict[str, Any] = {}
        self._full = False  # there is no channel any more, which was said
        self._following = following
        self._split_at = 0  # the log time of the states that the next file begins with
        self._begun_at = 0  # of those that this file begins with
        self._finished_bytes = 0  # of files that are complete
        # Since the last split: from when on news of each key are in this file, and what stands for older values here.
        self._since: dict[str, int] = {}
        self._moved: dict[tuple[Path, int], Reference] = {}
        self.splitting = False
        self._thread = threading.Thread(target=self._run, name="reem recorder", daemon=True)

    def start(self) -> None:
        self._thread.start()

    @property
    def waiting(self) -> int:
        return self._size

    @property
    def file_bytes(self) -> int:
        """Bytes in the file, and in those that are complete."""
        return self._finished_bytes + self._sink.output.tell()

    @property
    def part_bytes(self) -> int:
        """Bytes in the file that is being written."""
        return self._sink.output.tell()

    def split(self, now: int, waiting: Mapping[str, int]) -> None:
        """Begin the next file, given the log time, and that of the first waiting update of each key that has some.

        The file begins with a state before all news that will be in it. It may be earlier than the last ones in the
        file before, by the time for which news wait.
        """
        self.splitting = True
        # Between two steps of the clock, and not twice the same: each value has a place and a time of its own.
        self._split_at = max(min([now, *[stamp - STEP // 4 for stamp in waiting.values()]]), self._split_at + 1)
        with self._changed:
            value = {"now": now, "waiting": set(waiting)}
            self._queue.append((Operation(Role.SPLIT, ("",), value, (self._split_at, 0, 0), Kind.READ), 0))

    def put(self, operation: Operation, size: int) -> bool:
        """Hand over an operation of about `size` bytes; returns whether there was room. Never waits for the disk."""
        # What an operation costs besides its value: so many small ones are bounded too.
        name, size = str(operation.path[0]), size + 200
        with self._changed:
            if self.failure is not None or self._ending:
                return False
            # Gaps and skips always fit: they matter most when the disk is slow. One
            # operation fits into an empty queue whatever its size.
            if operation.role in LARGE and self._size and self._size + size > self._limit:
                self.counts.drop(operation.path)
                # The tree lacks this update, so the key has to be read again.
                self.behind.add(name)
                self._dropped.add(name)
                return False
            if operation.role in (Role.STATE, Role.STORED):
                self.behind.discard(name)  # it has what was missing
                if name in self._dropped:
                    self._dropped.discard(name)
                    operation = _as_state(operation)
            self._queue.append((operation, size))
            self._size += size
            # Else the thread wakes by itself in a moment, and takes many at once.
            if self._size >= _HURRY:
                self._changed.notify()
        return True

    def stop(self, metadata: Mapping[str, str]) -> None:
        """Write what waits and the index, and end the thread. Blocks; idempotent."""
        with self._changed:
            self._metadata = metadata
            self._ending = True
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join()
        else:
            self._sink.close()  # it was never started

    def _run(self) -> None:
        with suppress(OSError):  # it must never keep the recorded programs waiting
            # On Linux a thread has a nice value of its own.
            mine = threading.get_native_id() if sys.platform == "linux" else 0  # elsewhere no thread has a priority
            if mine:
                os.setpriority(os.PRIO_PROCESS, mine, min(os.getpriority(os.PRIO_PROCESS, mine) + _NICER, 19))
        try:
            # States: taking what waits, until `stop`; then all that is left, the index, and the end. An error ends it
            # at once.
            while not self._take():
                self._sink.tick()
            self._sink.finish({**self._metadata, **self._summary()})
        except Exception as error:
            with self._changed:
                self.failure = error
                self._queue.clear()
                self._size = 0
        finally:
            self._sink.close()

    def _summary(self) -> dict[str, str]:
        counts = self.counts
        names = ("messages", "bytes", "dropped", "skipped", "gaps", "lost", "clock_steps")
        figures = {name: str(getattr(counts, name)) for name in names}
        return figures | {f"not recorded: {path}": str(number) for path, number in counts.by_path.most_common(100)}

    def _take(self) -> bool:
        """Write what waits; return whether that was the end."""
        with self._changed:
            if not self._ending and self._size < _HURRY:
                self._changed.wait(_BATCH_SECONDS)
            ending = self._ending
        while True:
            with self._changed:
                if not self._queue:
                    return ending
                operation, size = self._queue.popleft()
            self._write(operation.loaded())
            # Else a frame would stay in memory while the next one is waited for.
            del operation
            give_way()
            self._sink.tick()
            with self._changed:
                self._size -= size

    def _write(self, it: Operation) -> None:
        try:
            match it.role:
                case Role.UPDATE:
                    self._write_update(it)
                case Role.DELETE:
                    self._write_delete(it)
                case Role.STATE:
                    self._write_state(it)
                case Role.STORED:
                    self._write_stored(it)
                case Role.KEYFRAME:
                    self._write_keyframe(it)
                case Role.SPLIT:
                    self._write_split(it)
                case Role.SKIP:
                    self._event(it)
                case Role.GAP:
                    self.counts.gaps += 1
                    self._event(it, missed=it.value)
        except FullError:  # reading it again would not help
            self._lose_for_good(it.path)
        except NotWritten:
            self._fall_behind(str(it.path[0]))

    def _lose_for_good(self, path: Path) -> None:
        """Count what there is no channel for, and say so once."""
        self.counts.lose(path)
        if not self._full:
            self._full = True
            logger.warning(
                "%s, and what comes at other new paths, is not recorded any more: the file has as many channels as "
                "MCAP can have; begin another one, or record fewer paths",
                show(path),
            )

    def _fall_behind(self, name: str) -> None:
        self.behind.add(name)
        self._lacking.add(name)

    def _keep(self, name: str, tree: Any) -> None:
        if tree is MISSING:
            self._trees.pop(name, None)  # programs may publish under ever new names
        else:
            self._trees[name] = tree

    def _write_update(self, it: Operation) -> None:
        name, rest = str(it.path[0]), it.path[1:]
        tree = self._extracted(it)
        # A long list is a message of its own: to change one of its items, it becomes a list again.
        before = opened(self._trees.get(name, MISSING), rest, _as_list)
        if it.kind == Kind.READ:
            self._keep(name, planted(before, rest, tree))
        else:
            try:
                self._keep(name, replaced(before, rest, tree))
            except CannotApply:  # the server has refused it too, or an update is missing here
                self._fall_behind(name)
        lost = type(tree) is Reference and tree.label == LOST
        # Else its message is the update.
        if type(tree) is not Reference or lost or type(it.value) in (Reference, Unchanged):
            try:
                self._count(self._sink.json(it.path, Role.UPDATE, it.kind, to_json(tree), it.stamp))
            except FullError:
                if not lost:  # else it is counted already
                    raise

    def _write_delete(self, it: Operation) -> None:
        name, rest = str(it.path[0]), it.path[1:]
        before = opened(self._trees.get(name, MISSING), rest, _as_list)
        # A read that finds nothing where nothing was known is no news.
        if it.kind == Kind.READ and get(before, rest) is MISSING:
            return
        self._keep(name, without(before, rest, it.kind))
        self._event(it)

    def _event(self, it: Operation, **more: Any) -> None:
        text = {"op": it.role.value, "path": show(it.path), **more}
        self._count(self._sink.json(it.path, it.role, it.kind, JsonMessage(text, wrapped=False), it.stamp))

    def _write_state(self, it: Operation) -> None:
        name = str(it.path[0])
        before = self._trees.get(name, MISSING)
        if it.value is MISSING:
            if before is not MISSING:
                self._write_delete(it._replace(role=Role.DELETE))
            self._lacking.discard(name)
            return
        before = self._settled(it, before)
        tree = self._extracted(it, before)
        self._lacking.discard(name)
        # A state that is what is known already says nothing: no keyframe.
        if before is MISSING or not same(tree, before):
            self._trees[name] = tree
            self._keyframe(it, tree)

    def _write_stored(self, it: Operation) -> None:
        name = str(it.path[0])
        if name in self._lacking:  # it may differ in what was published
            self._write_state(_as_state(it))
            return
        before = self._settled(it, self._trees.get(name, MISSING))
        tree = it.value if it.value is MISSING else self._extracted(it, before)
        known = pruned(before, it.path, self._patterns)  # without what is sampled
        inner = difference(known, tree)
        if inner is None:
            return
        self.stored.add(name)
        value, place = get(tree, inner), it.path + inner
        if value is MISSING:
            self._write_delete(it._replace(role=Role.DELETE, path=place))
        else:
            self._write_update(it._replace(role=Role.UPDATE, path=place, value=value))

    def _write_keyframe(self, it: Operation) -> None:
        tree = self._settled(it, self._trees.get(str(it.path[0]), MISSING))
        if tree is not MISSING:
            self._trees[str(it.path[0])] = tree
            self._keyframe(it, tree)
            # Bytes that have stayed for so long will stay longer: from now on only a digest of them is kept.
            for _, leaf in walk(tree, ()):
                if type(leaf) is Reference and leaf.content is not None and leaf.numbers is None:
                    leaf.content.digest()

    def _write_split(self, it: Operation) -> None:
        """Complete the file, and begin the next one with all that is there: it can be read without those before."""
        assert self._following is not None
        before = self._sink
        before.finish({"ended": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), **self._summary()})
        self._sink, self._finished_bytes = self._following(), self._finished_bytes + before.output.tell()
        self._sink.continues = True
        self._since, self._begun_at = {}, it.stamp[0]
        moved: dict[tuple[Path, int], Reference] = {}
        file, past = None, None
        try:
            with suppress(OSError, DamagedRecording):  # it was moved away at once
                file = Container(before.path)
                past = RecordedPast(file, self._ships)
            for name in list(self._trees):
                try:
                    self._continue(name, it.stamp[0], past, moved)
                except NotWritten:
                    del self._trees[name]
                    self._fall_behind(name)
                except FullError:
                    del self._trees[name]
                    self._lose_for_good((name,))
                self._since[name] = it.stamp[0] if name in it.value["waiting"] else it.value["now"]
        finally:
            if file is not None:
                file.close()
        self._sink.continues = False
        self._sink.output.appear()
        chained = {key: moved[ref.path, ref.at] for key, ref in self._moved.items() if (ref.path, ref.at) in moved}
        # What stands for a value that was read long ago may be forgotten: the key is read again then.
        self._moved = moved if len(chained) > _MOST_MOVED else chained | moved
        self.splitting = False

    def _continue(
        self, name: str, at: int, past: RecordedPast | None, moved: dict[tuple[Path, int], Reference]
    ) -> None:
        """Write what a key holds to the next file, with the messages that it refers to; NotWritten if one is gone."""

        def move(leaf: Any) -> Any:
            if type(leaf) is not Reference or leaf.label == LOST:
                return leaf
            encoded = None
            with suppress(OSError):
                encoded = None if past is None else past.encoded(leaf)
            if encoded is None:
                raise NotWritten
            self._count(self._sink.part(leaf.path, Role.PART, Kind.READ, leaf.label, encoded, state.stamp))
            moved[leaf.path, leaf.at] = replace(leaf, at=at)
            return moved[leaf.path, leaf.at]

        state = Operation(Role.STATE, (name,), None, (at, 0, 0), Kind.READ)
        self._trees[name] = mapped(self._trees[name], move)
        self._trees[name] = self._settled(state, self._trees[name])
        self._keyframe(state, self._trees[name])
        give_way()

    def _current(self, leaf: Any) -> Any:
        """Return a reference to the copy of a value in this file; it may name the copy in an earlier file."""
        if type(leaf) is not Reference or leaf.at == self._begun_at:
            return leaf
        if leaf.at > self._since.get(str(leaf.path[0]), -1):
            return leaf
        if (leaf.path, leaf.at) not in self._moved:
            raise NotWritten
        return self._moved[leaf.path, leaf.at]

    def _settled(self, it: Operation, tree: Any) -> Any:
        """Return a tree with the long lists in it, of which items were updated, as messages of their own again."""
        return tree if tree is MISSING else self._extracted(it._replace(value=tree, kind=Kind.READ))

    def _keyframe(self, it: Operation, tree: Any) -> None:
        document = to_json(tree)
        if not document.wrapped:
            notes = {key: document.tree.pop(key) for key in ("$ship",) if key in document.tree}
            document = JsonMessage({WRAPPER: document.tree, **notes}, wrapped=True)
        document.tree["key"] = str(it.path[0])
        self._count(self._sink.json(it.path, it.role, Kind.READ, document, it.stamp))

    def _extracted(self, it: Operation, before: Any = None) -> Any:
        """Return the value with everything long written as a message of its own, unless `before` has it unchanged."""

        def store(label: str, path: Path, value: Any) -> Reference:
            data, label = self._packed(label, value)
            # A state that was read again: what has not changed need not be written again.
            old = get(before, path[len(it.path) :]) if it.role in (Role.STATE, Role.STORED) else None
            if data is None:
                why = value.reason if type(value) is Unreadable else f"{type(value).__name__}, not recorded"
                lost = Reference(LOST, path, it.stamp[0], 0, why)
                # Counted once, not at each read.
                if type(old) is Reference and (old.label, old.summary) == (LOST, lost.summary):
                    return old
                self.counts.lose(path)
                return lost
            file = data.data if isinstance(data, EncodedImage) else data
            content = Content(*_NUMPY.pack(data)) if isinstance(data, np.ndarray) else Content(b"", file)
            stored = reference_to(label, path, it.stamp[0], data, content)
            if type(old) is Reference and _is_same(stored, old):
                return old
            # A part belongs to an update or a state; an array that was published by itself is an update.
            role = Role.UPDATE if path == it.path and it.role == Role.UPDATE else Role.PART
            encoded = encode(label, data, show(path), it.stamp[1] or it.stamp[0])
            try:
                self._count(self._sink.part(path, role, it.kind, label, encoded, it.stamp))
            except FullError:
                self._lose_for_good(path)
                return Reference(LOST, path, it.stamp[0], 0, f"{stored.summary}, not recorded: too many paths")
            return stored

        value = extract(it.value, it.path, store)
        return mapped(value, self._current) if self._since else value

    def _packed(self, label: str, value: Any) -> tuple[Any, str]:
        """Return an array or bytes, and the label; None if there is no way to make bytes of the value."""
        if label:
            return value, label
        unasked = self._ships.asynchronous or type(value) is Unreadable
        ship = None if unasked else self._ships.fits(value)
        if ship is None or ship.blob is None:
            return None, LOST
        return b"".join(ship.blob.pack(value)), ship.label

    def _count(self, size: int) -> None:
        self.counts.messages += 1
        self.counts.bytes += size


def write_recording(path: FilePath, operations: Iterable[Operation], ships: Ships, metadata: Mapping[str, str]) -> None:
    """Write operations into a file, which appears when it is whole; raises OSError, BadValue or RecordingFailed."""
    writer = WriterThread(Sink(path, "zstd", metadata, overwrite=False, whole=True), ships, 0, first=operations)
    writer.start()
    writer.stop({})
    if writer.failure is not None:
        raise writer.failure


def _as_state(it: Operation) -> Operation:
    """Return what is there now as read from the server: its writer is unknown."""
    return it._replace(role=Role.STATE, kind=Kind.READ)


def _as_list(it: Reference) -> Any:
    return it if it.numbers is None else it.numbers.tolist()


def _is_same(one: Reference, other: Reference) -> bool:
    if one.content is None or other.content is None or one.label != other.label:
        return False
    return one.content.digest() == other.content.digest()
