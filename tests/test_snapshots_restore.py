"""Restoring beside what is there, with few rights; RDB files."""

import json
import math
import shutil
import time
import urllib.parse
from pathlib import Path

import numpy as np
import pytest
import redis
import snapshotkit
from conftest import ROOT, aeventually, assert_same
from snapshotkit import everything, fill, left_in

import reem
import reem.snapshots
import reem_async
import reem_async.snapshots
from reem_async.errors import BadData, Conflict, WrongKind
from reem_async.server import EmbeddedServer
from reem_async.tools.snapshots import RdbUnavailable, describe, rdb, restore, save, save_rdb

servers, raws, here, there = snapshotkit.servers, snapshotkit.raws, snapshotkit.here, snapshotkit.there


# --- restoring -------------------------------------------------


async def test_keys_that_are_there_are_not_replaced_unasked(here, there, raws, tmp_path):
    kvs, copy = reem_async.KeyValueStore(here), reem_async.KeyValueStore(there)
    for name in ("a", "b", "c"):
        await kvs[name].write({"x": np.arange(3), "l": [np.arange(4)]})
    await save(here, tmp_path / "a.zip")
    await copy["b"].write({"old": np.arange(9), "l": [np.zeros(3), np.zeros(3)], "x": 1})
    await copy["mine"].write({"x": np.arange(3)})
    before = everything(raws[1])
    with pytest.raises(Conflict, match=r"'b'.*replace=True"):
        await restore(there, tmp_path / "a.zip")
    assert everything(raws[1]) == before
    assert (await restore(there, tmp_path / "a.zip", "a")).names == ("a",)
    await restore(there, tmp_path / "a.zip", replace=True)
    mine = everything(raws[1], "*mine*")
    assert everything(raws[1]) == everything(raws[0]) | mine
    assert mine == {key: value for key, value in before.items() if b"mine" in key}
    assert_same(await copy["b"].read(), {"x": np.arange(3), "l": [np.arange(4)]})
    await copy["b"].write(1)
    assert everything(raws[1], "{b}*") == {}, "the interface knows what the registry holds"


async def test_a_foreign_key_in_the_way_is_never_replaced(here, there, raws, tmp_path):
    for name in ("a", "b"):
        await reem_async.KeyValueStore(here)[name].write(np.arange(3))
    await save(here, tmp_path / "a.zip")
    raws[1].lpush("b", "precious")
    with pytest.raises(WrongKind, match="list"):
        await restore(there, tmp_path / "a.zip", replace=True)
    assert set(everything(raws[1])) == {b"b"}
    raws[1].delete("b")
    raws[1].lpush("{a}:ships", "precious")
    with pytest.raises(WrongKind, match=r"\{a\}:ships"):
        await restore(there, tmp_path / "a.zip", replace=True)
    assert set(everything(raws[1])) == {b"{a}:ships"}


async def test_subscribers_are_told(here, servers, raws, tmp_path):
    space = reem_async.PublishSpace(here)
    await space["arm"].write({"joint": 1.5, "image": np.arange(3)})
    await save(here, tmp_path / "a.zip")
    async with (
        reem_async.RedisInterface(servers[0]) as other,
        reem_async.SilentSubscriber("arm", other) as mirror,
    ):
        await space["arm"].write({"joint": 2.5, "new": np.zeros(3)})
        await aeventually(lambda: mirror["joint"].read() == 2.5)
        updates = []

        def heard(data, updated_path):
            updates.append((updated_path, data["joint"]))

        async with reem_async.CallbackSubscriber("arm", other, heard):
            await restore(here, tmp_path / "a.zip", replace=True)
            await aeventually(lambda: mirror["joint"].read() == 1.5)
            assert_same(mirror.value(), {"joint": 1.5, "image": np.arange(3)})
            await space["arm"]["joint"].write(3.5)
            await aeventually(lambda: updates == [("arm", 1.5), ("arm.joint", 3.5)])


async def test_progress_of_the_blocking_front(servers, raws, tmp_path):
    with reem.RedisInterface(servers[0]) as here, reem.RedisInterface(servers[1]) as there:
        reem.KeyValueStore(here)["foo"] = {"x": np.arange(3)}
        told = []
        saved = reem.snapshots.save(here, tmp_path / "a.zip", progress=told.append)
        done = reem.snapshots.restore(there, str(tmp_path / "a.zip"), progress=told.append)
        assert reem.snapshots.describe(tmp_path / "a.zip") == saved
        assert_same(reem.KeyValueStore(there)["foo"].read(), {"x": np.arange(3)})
        assert (saved.count, done.names) == (1, ("foo",))
        assert told == [
            *(("save", 0, 1), ("save", 1, 1)),
            *(("restore", 0, 1), ("restore", 1, 1)),
        ]
        assert reem.snapshots.save_rdb(here, tmp_path / "a.rdb").kind == "rdb"


# --- rights -------------------------------------------------


async def test_a_program_with_few_rights_can_save_and_restore(servers, raws, tmp_path):
    admin = raws[0]
    rules = ["reset", "on", ">secret", "~reem:*", "~{reem:*", "&reem:*", "&{reem:*", "-@all", "+scan"]
    sample = (ROOT / "deploy" / "users.acl").read_text().partition("user robot ")[2].partition("\n")[0]
    allowed = [word for word in sample.split() if word.startswith("+") and word != "+info"]
    admin.execute_command("ACL", "SETUSER", "robot", *rules, *allowed)
    admin.set("elsewhere", 1)
    parts = urllib.parse.urlsplit(servers[0].url)
    url = f"redis://robot:secret@{parts.hostname}:{parts.port}"
    async with reem_async.RedisInterface(url, namespace="reem:") as interface:
        kvs = reem_async.KeyValueStore(interface)
        await kvs["foo"].write({"x": np.arange(3), "l": [b"x"]})
        before = everything(admin)
        admin.execute_command("ACL", "LOG", "RESET")
        await save(interface, tmp_path / "a.zip")
        await kvs["foo"].write({"x": 1})
        await restore(interface, tmp_path / "a.zip", replace=True)
        assert everything(admin) == before
        await kvs["foo"].delete()
        await restore(interface, tmp_path / "a.zip")
        assert everything(admin) == before
        denied = {row["object"] for row in admin.acl_log()}
        assert denied <= {"info"}, "new connections ask who the server is, and do without the answer"
        with pytest.raises(RdbUnavailable, match="CONFIG GET"):
            await save_rdb(interface, tmp_path / "a.rdb")
    async with reem_async.RedisInterface(url) as interface:  # it sees the names of keys that it may not look at
        saved = await save(interface, tmp_path / "b.zip")
        assert [key.name for key in saved.keys] == ["reem:foo"]
        assert saved.unsaved == {"elsewhere": "this user may not read it"}
    admin.execute_command("ACL", "SETUSER", "robot", "-scan")
    async with reem_async.RedisInterface(url, namespace="reem:") as interface:
        with pytest.raises(redis.exceptions.NoPermissionError, match="scan"):
            await save(interface, tmp_path / "c.zip")
        assert (await save(interface, tmp_path / "c.zip", "foo")).count == 1
    admin.execute_command("ACL", "DELUSER", "robot")
    assert left_in(tmp_path) == ["a.zip", "b.zip", "c.zip"]


# --- RDB files -------------------------------------------------


async def test_an_rdb_file_is_of_now(here, raws, tmp_path):
    await fill(here)
    raws[0].set("foreign", "x")
    first = await save_rdb(here, tmp_path / "a.rdb")
    assert (first.kind, first.count) == ("rdb", None)
    assert abs(first.time - time.time()) < 60
    await reem_async.KeyValueStore(here)["later"].write(np.arange(3))
    with pytest.raises(FileExistsError):
        await save_rdb(here, tmp_path / "a.rdb")
    assert await save_rdb(here, tmp_path / "a.rdb", overwrite=True) == await describe(tmp_path / "a.rdb") != first
    with pytest.raises(BadData, match="reem up --from"):
        await restore(here, tmp_path / "a.rdb")
    # RedisJSON keeps documents as text there, and reads it as it reads any text: the tree's floats have changed.
    with EmbeddedServer(snapshot=tmp_path / "a.rdb") as server, redis.Redis.from_url(server.url) as past:
        now, then = everything(raws[0]), everything(past)
        assert {key for key in now | then if now.get(key) != then.get(key)} <= {b"tree"}
        kept, read = (json.loads(each[b"tree"][1])["floats"] for each in (now, then))
        numbers = [pair for pair in zip(kept, read, strict=True) if isinstance(pair[0], float)]
        assert len(numbers) > 1900
        assert all(math.isclose(*pair, rel_tol=1e-15, abs_tol=1e-322) for pair in numbers)
    assert left_in(tmp_path) == ["a.rdb"]


async def test_the_rdb_file_of_a_server_elsewhere(here, tmp_path, monkeypatch):
    """Of another machine or container: there is none here, or one that is another server's."""
    source = tmp_path / "dump.rdb"
    source.write_bytes(b"REDIS0011 of another server")
    monkeypatch.setattr(rdb, "_START_SECONDS", 0.5)
    for place, message in ((Path("/no/such/dump.rdb"), r"/no/such/dump\.rdb"), (source, "another server's")):

        async def elsewhere(interface, place=place):
            return place

        monkeypatch.setattr(rdb, "_place", elsewhere)
        with pytest.raises(RdbUnavailable, match=message):
            await save_rdb(here, tmp_path / "b.rdb")
    assert left_in(tmp_path) == ["dump.rdb"]


async def test_a_server_that_cannot_save_says_so(tmp_path):
    """Its directory is gone: no file, and no waiting for ever."""
    with EmbeddedServer(directory=tmp_path / "data") as server:
        async with reem_async.RedisInterface(server) as interface:
            shutil.rmtree(tmp_path / "data")
            with pytest.raises(RdbUnavailable):
                await save_rdb(interface, tmp_path / "a.rdb")
    assert "a.rdb" not in left_in(tmp_path)


def test_the_modules_that_know_the_format_know_no_server():
    for name in ("archive", "files", "plans"):
        text = (ROOT / f"reem_async/tools/snapshots/{name}.py").read_text(encoding="utf-8")
        assert not any(word in text for word in ("asyncio", "anyio", "session", "transport", "import redis")), name
