"""Row 19: what servers refuse, told apart, with nothing half done."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import redis.exceptions
from conftest import FRONTS, assert_no_orphans, assert_same

import reem
from reem_async.errors import ServerNotReady

from .scoreboard import Run, row
from .servers import PrivateServer

TOP = "guarded"
VALUE = {"n": 1, "array": np.arange(100)}


class _Desk:
    """Collects what was refused, how, and what was left."""

    def __init__(self) -> None:
        self.refused = 0
        self.wrong: list[Any] = []
        self.partial: list[Any] = []
        self.seconds: dict[str, float] = {}

    def expect(self, what: str, kind: type[Exception], call: Callable[[], Any], *words: str) -> None:
        """The call must raise `kind`, and its text must have all `words`."""
        begun = time.monotonic()
        try:
            call()
        except kind as error:
            missing = [word for word in words if word.lower() not in str(error).lower()]
            if missing:
                self.wrong.append(f"{what}: {missing} not in {error!s:.200}")
        except Exception as error:
            self.wrong.append(f"{what}: {error!r:.200} in place of {kind.__name__}")
        else:
            self.wrong.append(f"{what}: accepted")
        self.refused += 1
        self.seconds[what] = max(self.seconds.get(what, 0.0), time.monotonic() - begun)

    def unchanged(self, what: str, front: Any, raw: Any) -> None:
        """What was stored before must be all there, and nothing else."""
        try:
            assert_same(front.read([TOP]), VALUE)
            assert_no_orphans(raw, TOP)
        except (AssertionError, reem.ReemError, redis.exceptions.RedisError) as error:
            self.partial.append(f"{what}: {error!r:.300}")


@contextlib.contextmanager
def _front(name: str, url: str, **options: Any) -> Iterator[Any]:
    with contextlib.closing(FRONTS[name](url, **options)) as front:
        yield front


def _connect(name: str, url: str, **options: Any) -> None:
    """Connect and read; an asyncio front that could not be made is still closed."""
    if name == "blocking":
        with contextlib.closing(reem.RedisInterface(url, **options)) as interface:
            reem.KeyValueStore(interface)["x"].get(None)
        return
    import asyncio

    import reem_async

    async def read() -> None:
        interface = reem_async.RedisInterface(url, **options)
        try:
            await reem_async.KeyValueStore(interface)["x"].get(None)
        finally:
            await interface.close()

    asyncio.run(read())


@row(
    19,
    "out of memory, read-only, loading, no login, no right, wrong type",
    "the right class, 0 half done, login <= 0.5 s",
)
def refusals(run: Run) -> None:
    """Each by a real server in that state, through both fronts."""
    desk = _Desk()
    for case in (_memory, _replica, _loading, _login, _rights, _types, _no_json):
        for name in FRONTS:
            case(desk, name)
    run.at_least("refusals", desk.refused, 30)
    run.none("wrong errors", desk.wrong)
    run.none("half done", desk.partial)
    logins = [seconds for what, seconds in desk.seconds.items() if "password" in what]
    run.at_most("s until a wrong password is told", max(logins), 0.5)


def _memory(desk: _Desk, name: str) -> None:
    """A server that is full: a write with an array, a plain one, a publish, an append."""
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(PrivateServer("maxmemory 20mb", "maxmemory-policy noeviction"))
        raw = stack.enter_context(server.raw())
        front, publishing = (
            stack.enter_context(_front(name, server.url, space=space)) for space in ("KeyValueStore", "PublishSpace")
        )
        front.write([TOP], VALUE)
        raw.set("filler", b"x" * 4_000_000)
        while True:
            try:
                raw.append("filler", b"x" * 200_000)
            except redis.exceptions.OutOfMemoryError:
                break
        full = redis.exceptions.OutOfMemoryError
        large = {"n": 2, "array": np.zeros(1000)}
        for who, each in (("store", front), ("publisher", publishing)):
            desk.expect(f"{name} {who} full: array", full, lambda it=each: it.write([TOP], large), TOP)
            desk.expect(f"{name} {who} full: plain", full, lambda it=each: it.write([TOP, "n"], "x" * 500), TOP)
            desk.expect(f"{name} {who} full: new", full, lambda it=each: it.write(["new"], large), "new")
        desk.unchanged(f"{name} full", front, raw)
        raw.delete("filler")
        if left := raw.exists("new", "{new}.array", "{new}:ships"):
            desk.partial.append(f"{name} full: {left} keys of a write that was refused")
        front.write([TOP], VALUE)
        desk.unchanged(f"{name} after being full", front, raw)


def _replica(desk: _Desk, name: str) -> None:
    """A copy that may only be read; then its primary dies and it may not even be read."""
    with contextlib.ExitStack() as stack:
        primary = stack.enter_context(PrivateServer("repl-diskless-sync-delay 0"))
        with _front(name, primary.url) as front:
            front.write([TOP], VALUE)
        lines = f"replicaof 127.0.0.1 {primary.port}", "replica-serve-stale-data no"
        replica = stack.enter_context(PrivateServer(*lines))
        copy = stack.enter_context(replica.raw())
        _until(lambda: copy.info("replication")["master_link_status"] == "up")
        front = stack.enter_context(_front(name, replica.url))
        kind = redis.exceptions.ReadOnlyError
        desk.expect(f"{name} replica", kind, lambda: front.write([TOP, "n"], 2), TOP)
        desk.expect(f"{name} replica: array", kind, lambda: front.write([TOP], VALUE), TOP)
        desk.expect(f"{name} replica: delete", kind, lambda: front.delete([TOP]), TOP)
        desk.unchanged(f"{name} replica", front, copy)
        primary.kill()
        _until(lambda: copy.info("replication")["master_link_status"] != "up")
        desk.expect(f"{name} replica alone", ServerNotReady, lambda: front.read([TOP]))


def _until(condition: Callable[[], Any]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline, "the servers do not get there"
        time.sleep(0.01)


def _loading(desk: _Desk, name: str) -> None:
    """A server that reads its data from disk: a call may wait for it, or say so; then it works."""
    slow = ["key-load-delay 2000", "loading-process-events-interval-bytes 1024"]
    with PrivateServer(keep=True) as server:
        with _front(name, server.url) as front, server.raw() as raw:
            front.write([TOP], VALUE)
            with raw.pipeline(transaction=False) as pipeline:
                for number in range(600):
                    pipeline.set(f"ballast{number}", "x" * 100)
                pipeline.execute()
            raw.bgrewriteaof()
            while raw.info("persistence")["aof_rewrite_in_progress"]:
                time.sleep(0.01)
            server.kill()
            server.lines += slow
            server.start_loading()
            loading = redis.exceptions.BusyLoadingError
            desk.expect(f"{name} loading", loading, lambda: _connect(name, server.url))
            server.wait()
        with _front(name, server.url) as front, server.raw() as raw:
            desk.unchanged(f"{name} after loading", front, raw)


def _login(desk: _Desk, name: str) -> None:
    """No password, a wrong one, a wrong user: at once, with no second try."""
    wrong = redis.exceptions.AuthenticationError
    with PrivateServer(password="right") as server:
        for what, options in (
            ("no password", {}),
            ("wrong password", {"password": "wrong-secret"}),
            ("wrong user and password", {"username": "nobody", "password": "wrong-secret"}),
        ):
            desk.expect(
                f"{name} {what}", wrong, lambda options=options: _connect(name, server.url, **options), "password"
            )
        with server.raw() as raw:
            if (count := raw.info("stats").get("acl_access_denied_auth", 0)) > 4:
                desk.wrong.append(f"{name}: {count} attempts to log in")


def _rights(desk: _Desk, name: str) -> None:
    """A user who may read, and not write; and one who may write other keys only."""
    denied = redis.exceptions.NoPermissionError
    with PrivateServer() as server, server.raw() as raw:
        raw.execute_command(
            "ACL", "SETUSER", "reader", "on", ">p", "~*", "&*", "+@all", "-@write", "-json.set", "-json.del"
        )
        raw.execute_command("ACL", "SETUSER", "other", "on", ">p", "~other*", "~{other*", "&*", "+@all")
        with _front(name, server.url) as front:
            front.write([TOP], VALUE)
            for user in ("reader", "other"):
                with _front(name, server.url, username=user, password="p") as limited:
                    desk.expect(f"{name} {user}: plain", denied, lambda it=limited: it.write([TOP, "n"], 2), TOP)
                    desk.expect(f"{name} {user}: array", denied, lambda it=limited: it.write([TOP], VALUE), TOP)
                    desk.expect(f"{name} {user}: delete", denied, lambda it=limited: it.delete([TOP]), TOP)
                    desk.unchanged(f"{name} {user}", front, raw)


def _types(desk: _Desk, name: str) -> None:
    """A key that another program uses for something else."""
    with PrivateServer() as server, server.raw() as raw, _front(name, server.url) as front:
        raw.hset("foreign", "a", 1)
        for what, call in (
            ("read", lambda: front.read(["foreign"])),
            ("write", lambda: front.write(["foreign"], 1)),
            ("array", lambda: front.write(["foreign"], np.arange(3))),
        ):
            desk.expect(f"{name} wrong type: {what}", reem.WrongKind, call, "foreign", "hash")
        if raw.type("foreign") != "hash" or raw.exists("{foreign}.", "{foreign}:ships"):
            desk.partial.append(f"{name} wrong type")


def _no_json(desk: _Desk, name: str) -> None:
    """A server without RedisJSON: documents are text there, and other programs' strings are left alone."""
    with PrivateServer(json=False) as server, server.raw() as raw, _front(name, server.url) as front:
        raw.set("foreign", '{"a": 1}')
        for what, call in (
            ("read", lambda: front.read(["foreign"])),
            ("write", lambda: front.write(["foreign"], 1)),
            ("array", lambda: front.write(["foreign"], np.arange(3))),
        ):
            desk.expect(f"{name} without JSON: {what}", reem.WrongKind, call, "foreign", "string")
        if raw.get("foreign") not in (b'{"a": 1}', '{"a": 1}') or raw.exists("{foreign}.", "{foreign}:ships"):
            desk.partial.append(f"{name} without JSON")
