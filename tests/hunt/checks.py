"""Compares the server, by a client that knows nothing of REEM, and all that follows it, with the model."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import redis
from conftest import assert_same

import reem
from reem import recording, snapshots
from reem_async.plan.placeholders import Placeholder, parse

from .clients import Asyncio
from .inputs import dotted
from .model import ABSENT, found

PATIENCE = 10.0
NOTE = re.compile(rb"\{[^}]*\}:last")
"""Which notice was the last: it expires by itself."""


def same(read: Any, due: Any) -> bool:
    if read is ABSENT or due is ABSENT:
        return read is due
    try:
        assert_same(read, due)
    except AssertionError:
        return False
    return True


def compare(read: Any, due: Any, what: str) -> None:
    if not same(read, due):
        raise AssertionError(f"{what}: {read!r:.2000}\nin place of {due!r:.2000}")


class Server:
    def __init__(self, url: str, *, json: bool) -> None:
        self.url, self._get = url, "JSON.GET" if json else "GET"
        self.raw = redis.Redis.from_url(url)

    def check(self, documents: dict[str, Any]) -> None:
        due = set()
        for name, document in documents.items():
            due |= self._check_document(name, document)
        there = set(self.raw.scan_iter(count=1000))
        notes = {key for key in there if NOTE.fullmatch(key)}
        there -= notes
        assert there == due, f"left over {_texts(there - due):.1000}, missing {_texts(due - there):.1000}"
        lasting = [key for key in notes if self.raw.ttl(key) not in range(-2, 61) or self.raw.ttl(key) == -1]
        assert not lasting, f"{lasting} do not expire"

    def _check_document(self, name: str, document: Any) -> set[bytes]:
        """Compare one document; returns the keys that belong to it."""
        text = self.raw.execute_command(self._get, name)
        assert text is not None, f"there is no {name!r}"
        suffixes: dict[str, Placeholder] = {}
        _same_json(json.loads(text), document, suffixes, name)
        tag = "{" + name + "}"
        members = {member.decode() for member in self.raw.smembers(f"{tag}:ships")}
        assert members == set(suffixes), f"{name!r}: registered {members}, referred to {set(suffixes)}"
        for suffix in suffixes:
            assert self.raw.type(tag + suffix) == b"string", f"{tag}{suffix} is {self.raw.type(tag + suffix)!r}"
        registry = {f"{tag}:ships".encode()} if suffixes else set()
        return {name.encode(), *registry, *((tag + suffix).encode() for suffix in suffixes)}

    def settle(self) -> None:
        """Wait until the server has taken all that was sent to it before."""
        for _ in range(3):
            self.raw.ping()


def _texts(keys: set[bytes]) -> str:
    return str(sorted(key.decode(errors="replace") for key in keys))


def _same_json(stored: Any, due: Any, suffixes: dict[str, Placeholder], where: str) -> None:
    """Compare what the server holds with what it stands for; collects what goes by ship."""
    meaning = parse(stored) if isinstance(stored, str) and stored.startswith("$ship ") else stored
    if isinstance(meaning, Placeholder):
        assert isinstance(due, np.ndarray | bytes), f"{where}: {stored!r} in place of {due!r:.200}"
        assert meaning.label == ("bytes" if isinstance(due, bytes) else "numpy"), f"{where}: {stored!r}"
        assert meaning.size == (len(due) if isinstance(due, bytes) else due.nbytes), f"{where}: {stored!r}"
        assert meaning.suffix not in suffixes, f"{where}: two refer to {meaning.suffix}"
        suffixes[meaning.suffix] = meaning
    elif isinstance(due, dict):
        alike = isinstance(stored, dict) and stored.keys() == due.keys()
        assert alike, f"{where}: {stored!r:.500}, due {due!r:.500}"
        for key in due:
            _same_json(stored[key], due[key], suffixes, f"{where}[{key!r}]")
    elif isinstance(due, list):
        alike = isinstance(stored, list) and len(stored) == len(due)
        assert alike, f"{where}: {stored!r:.500}, due {due!r:.500}"
        for index, (one, other) in enumerate(zip(stored, due, strict=True)):
            _same_json(one, other, suffixes, f"{where}[{index}]")
    elif isinstance(due, float):
        close = isinstance(meaning, float) and (meaning == due or math.isclose(meaning, due, rel_tol=1e-15))
        assert close, f"{where}: {stored!r} in place of {due!r}"
    else:
        alike = type(meaning) is type(due) and meaning == due
        assert alike, f"{where}: {stored!r} in place of {due!r:.200}"


class Follower:
    """A mirror, a callback and a loop over one path, with both fronts."""

    def __init__(
        self, name: str, path: tuple[Any, ...], document: Any, plain: reem.RedisInterface, other: Asyncio
    ) -> None:
        import reem_async
        from reem_async.concurrency.queues import Last

        self.name, self.path, self.other = name, path, other
        self.begun_with = found(document, path)
        text = dotted((name, *path))
        assert text is not None
        self.mirror = reem.SilentSubscriber(text, plain)
        self.mirror.listen()
        self.called: list[Any] = []
        self.caller = reem.CallbackSubscriber(text, plain, lambda data, updated_path: self.called.append(data))
        self.caller.listen()
        self.updates: list[Any] = []
        place = reem_async.KeyValueStore(other.interface)[name]
        for key in path:
            place = place[key]
        self.watch = place.watch(Last(100_000))
        other.run(self.watch.listen())
        self.loop = other.begin(self._collect())

    async def _collect(self) -> None:
        async for update in self.watch:
            self.updates.append(update)

    def check(self, document: Any, *, exact: bool) -> None:
        due = found(document, self.path)
        bare = None if due is ABSENT else due
        what = f"{(self.name, *self.path)!r}"
        _until(lambda: same(self.mirror.value(), bare), lambda: compare(self.mirror.value(), bare, f"mirror of {what}"))
        for kind, data in (
            ("callback", lambda: self.called[-1] if self.called else self.begun_with),
            ("loop", lambda: self.updates[-1].data if self.updates else None),
        ):

            def now(data: Any = data) -> Any:
                value = data()
                return None if value is ABSENT else value

            _until(lambda now=now: same(now(), bare), lambda n=now, k=kind: compare(n(), bare, f"{k} over {what}"))
        if exact:
            lost = [update for update in self.updates if update.gap or update.missed]
            assert not lost, f"loop over {what}: lost some before {lost[:3]!r:.1000}, with nothing broken off"

    def close(self) -> None:
        self.mirror.close()
        self.caller.close()
        self.other.run(self.watch.close())
        self.loop.result(PATIENCE)


def _until(condition: Callable[[], bool], or_raise: Callable[[], None]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > deadline:
            or_raise()
            return
        time.sleep(0.002)


def check_snapshot(here: Server, there: Server, documents: dict[str, Any]) -> None:
    """Save all, restore it into another server, which then holds the same."""
    there.raw.flushall()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "all.zip"
        with reem.RedisInterface(here.url) as interface:
            saved = snapshots.save(interface, path)
        assert len(saved.keys) == len(documents), f"saved {len(saved.keys)} keys of {len(documents)}"
        with reem.RedisInterface(there.url) as interface:
            snapshots.restore(interface, path)
            _compare_all(interface, documents, "restored")
    there.check(documents)


def check_recording(here: Server, there: Server, documents: dict[str, Any], work: Callable[[], None]) -> None:
    """Record while `work` goes on, and replay it into another server: what is published there is the same."""
    there.raw.flushall()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with reem.RedisInterface(here.url) as interface, recording.Recorder(interface, ["*"], path) as recorder:
            work()
        assert not recorder.status.dropped, recorder.status
        with reem.RedisInterface(there.url) as interface, recording.open_log(path) as log:
            played = recording.Replayer(interface, log, rate=1e9).play()
            try:
                _compare_all(interface, documents, "replayed")
            except AssertionError as error:
                kept = Path(tempfile.gettempdir()) / f"reem hunt {os.getpid()}.mcap"
                shutil.copy(path, kept)
                told = f"the recording is {kept}: {recorder.status}, {played}, of {log.names()}"
                raise AssertionError(f"{error}; {told}; keys there: {there.raw.keys()}") from error
    there.check(documents)


def _compare_all(interface: reem.RedisInterface, documents: dict[str, Any], what: str) -> None:
    kvs = reem.KeyValueStore(interface)
    for name, document in documents.items():
        assert name in kvs, f"{what}: there is no {name!r}"
        compare(kvs[name].read(), document, f"{what} {name!r}")
