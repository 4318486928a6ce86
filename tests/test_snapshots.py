"""Portable snapshots: what is saved is of one instant, and restored bit for bit."""

import contextlib
import struct
import tracemalloc

import numpy as np
import orjson
import pytest
import redis
import snapshotkit
from conftest import PLAIN, aeventually, assert_no_orphans, assert_same, commands_run, repeated
from snapshotkit import everything, hard_floats, left_in

import reem
import reem.snapshots
import reem_async
import reem_async.snapshots
from reem_async.errors import BadData, BadKey, MissingKey
from reem_async.tools.snapshots import describe, restore, save
from reem_async.tools.snapshots.plans import REDIS_TYPES, settable

servers, raws, here, there = snapshotkit.servers, snapshotkit.raws, snapshotkit.here, snapshotkit.there


# --- there and back -------------------------------------------------


async def test_the_servers_own_text_would_not_do(raws):
    """Given back as it is, it changes floats; `settable` gives the same document, or REEM's form of the float."""
    raw = raws[0]
    raw.execute_command("JSON.SET", "f", "$", orjson.dumps(hard_floats(20000)))
    short = [float(f"{digits}e{power}") for digits in ("2.647", "9.4425", "31597") for power in range(16, 300)]
    raw.execute_command("JSON.SET", "g", "$", orjson.dumps(short))
    inline = 0
    for name in "fg":
        text = raw.execute_command("JSON.GET", name)
        raw.execute_command("JSON.SET", "naive", "$", text)
        assert raw.execute_command("JSON.GET", "naive") != text, "this server reads floats well: settable is not needed"
        raw.execute_command("JSON.SET", "exact", "$", settable(text))
        for value, again in zip(
            orjson.loads(text), orjson.loads(raw.execute_command("JSON.GET", "exact")), strict=True
        ):
            if isinstance(again, str):
                inline += 1
                again = float.fromhex(again.removeprefix("$ship float "))
            assert struct.pack("<d", again) == struct.pack("<d", value)
    assert inline < 400, "those that no text carries are few"


class Stored:
    def __init__(self, kind):
        self.kind = kind


class KindShip(reem_async.SpecialDatatypeShip):
    def check_fit(self, value):
        return isinstance(value, Stored)

    def write(self, key, value, client):
        big, many = b"\x00\xff:" * 40_000, [b"%d" % number for number in range(2500)]
        if value.kind == "hash":
            client.hset(key, mapping={b"a:1": b"1:", b"\x00": big, b"": b""})
        elif value.kind == "list":
            client.rpush(key, *many, big, b"")
        elif value.kind == "set":
            client.sadd(key, *many)
        elif value.kind == "zset":
            client.zadd(key, {b"a": 0.1, b"b": -1e300, b"": 5e-324, b"c": float("inf")})
        elif value.kind == "stream":
            client.xadd(key, {"a": 1})
        elif value.kind == "ReJSON-RL":
            client.execute_command("JSON.SET", key, "$", '{"a":[1,2.25,"é"]}')

    def read(self, key, client):
        client.get(key)

    def interpret_read(self, responses):
        raise AssertionError("a snapshot does not ask ships")

    def get_label(self):
        return "kind"


@pytest.mark.parametrize("kind", [kind for kind in REDIS_TYPES if kind != "string" and not (PLAIN and "JSON" in kind)])
async def test_ships_may_use_other_redis_types(servers, there, raws, tmp_path, kind):
    async with reem_async.RedisInterface(servers[0], ships=[KindShip()]) as writer:
        await reem_async.KeyValueStore(writer)["k"].write({"x": [Stored(kind)]})
    async with reem_async.RedisInterface(servers[0]) as here:
        before = everything(raws[0])
        assert kind.encode() in {each for each, _ in before.values()}
        saved = await save(here, tmp_path / "a.zip")
        assert [each for _, each, _ in saved.keys[0].values] == [kind]
        await restore(there, tmp_path / "a.zip")
        assert everything(raws[1]) == before


async def test_what_cannot_be_saved_is_named_and_all_else_is_saved(servers, there, raws, tmp_path):
    admin = raws[0]
    async with reem_async.RedisInterface(servers[0], ships=[reem.NumpyShip(), KindShip()]) as here:
        kvs = reem_async.KeyValueStore(here)
        for name in ("gone", "overwritten", "private", "right"):
            await kvs[name].write({"image": np.arange(9), "list": [np.arange(2)]})
        await kvs["odd"].write({"x": Stored("stream")})
    admin.delete("{gone}.list[0]")
    admin.set("{overwritten}:ships", "x")
    admin.execute_command("ACL", "SETUSER", "u", "reset", "on", ">pw", "&*", "+@all", "~[^p{]*", "~{[^p]*")
    async with reem_async.RedisInterface(servers[0].url.replace("//", "//u:pw@")) as here:
        saved = await save(here, tmp_path / "a.zip")
        assert set(saved.unsaved) == {"gone.list[0]", "odd", "private"}
        assert "stream" in saved.unsaved["odd"]
        assert "not read" in saved.unsaved["private"]
        assert (await describe(tmp_path / "a.zip")).unsaved == saved.unsaved
        with pytest.raises(BadData, match=r"odd\.x.*stream"):
            await save(here, tmp_path / "b.zip", "odd")
        assert left_in(tmp_path) == ["a.zip"]
        admin.delete("{overwritten}:ships")
        await restore(here, tmp_path / "a.zip", replace=True)
    admin.execute_command("ACL", "DELUSER", "u")
    assert admin.smembers("{overwritten}:ships") == {b".image", b".list[0]"}
    await restore(there, tmp_path / "a.zip")
    got = reem_async.KeyValueStore(there)
    assert await got.keys() == ["gone", "overwritten", "right"]
    for name in ("overwritten", "right"):
        assert_same(await got[name].read(), {"image": np.arange(9), "list": [np.arange(2)]})


async def test_a_key_that_expires_is_restored_with_the_time_it_had_left(here, there, raws, tmp_path):
    store, other = reem_async.KeyValueStore(here), reem_async.KeyValueStore(there)
    for name in ("fades", "stays"):
        await store[name].write({"a": np.arange(3)})
        await other[name].write({"a": np.arange(4)})
    await store["fades"].expire(100)
    await other["stays"].expire(100)
    await save(here, tmp_path / "a.zip")
    await restore(there, tmp_path / "a.zip", replace=True)
    for name in ("fades", "{fades}.a", "{fades}:ships"):
        assert 80_000 < raws[1].pttl(name) <= 100_000
    for name in ("stays", "{stays}.a", "{stays}:ships"):
        assert raws[1].pttl(name) == -1


# --- which keys -------------------------------------------------


async def test_a_namespace_is_saved_alone_and_restored_into_any(servers, raws, tmp_path):
    async with contextlib.AsyncExitStack() as stack:
        spaces = {
            name: await stack.enter_async_context(reem_async.RedisInterface(servers[0], namespace=name))
            for name in ("r*[1]:", "rx1:", "")
        }
        for name, interface in spaces.items():
            await reem_async.KeyValueStore(interface)["foo"].write({"space": name, "x": np.arange(3)})
        raws[0].set("outside", 1)
        saved = await save(spaces["r*[1]:"], tmp_path / "a.zip")
        assert ([key.name for key in saved.keys], saved.namespace) == (["foo"], "r*[1]:")
        other = await stack.enter_async_context(reem_async.RedisInterface(servers[1], namespace="other:"))
        await restore(other, tmp_path / "a.zip")
        assert (await reem_async.KeyValueStore(other)["foo"].read())["space"] == "r*[1]:"
        assert set(everything(raws[1])) == {b"other:foo", b"{other:foo}.x", b"{other:foo}:ships"}
        everywhere = await save(spaces[""], tmp_path / "b.zip")
        assert {key.name for key in everywhere.keys} == {"foo", "rx1:foo", "r*[1]:foo"}


async def test_what_is_not_of_reem_is_left_out(here, there, raws, tmp_path):
    await reem_async.KeyValueStore(here)["foo"].write({"x": np.arange(3)})
    for name in ("plain", "{foo}.stranger", "{gone}.x", "{}", b"\xff\xfe"):
        raws[0].set(name, 1)
    saved = await save(here, tmp_path / "a.zip")
    assert ([key.name for key in saved.keys], saved.unsaved) == (["foo"], {})
    await restore(there, tmp_path / "a.zip")
    assert set(everything(raws[1])) == {b"foo", b"{foo}.x", b"{foo}:ships"}


async def test_only_what_matches(here, there, raws, tmp_path):
    kvs = reem_async.KeyValueStore(here)
    for name in ("arm1", "arm2", "base", "arm.1[x]"):
        await kvs[name].write({"x": np.arange(2)})
    assert [key.name for key in (await save(here, tmp_path / "a.zip", "arm?")).keys] == ["arm1", "arm2"]
    before = commands_run(raws[0])
    assert [key.name for key in (await save(here, tmp_path / "b.zip", "arm.1[x]")).keys] == ["arm.1[x]"]
    assert "scan" not in commands_run(raws[0]).keys() - before.keys()
    assert commands_run(raws[0]).get("scan") == before.get("scan")
    await save(here, tmp_path / "c.zip")
    assert (await restore(there, tmp_path / "c.zip", "*1*")).names == ("arm.1[x]", "arm1")
    for name in ("nothing", "nothing*"):
        with pytest.raises(MissingKey, match="nothing"):
            await save(here, tmp_path / "d.zip", name)
        with pytest.raises(MissingKey, match="nothing"):
            await restore(there, tmp_path / "c.zip", name)
    for call in (lambda: save(here, tmp_path / "d.zip", ""), lambda: restore(there, tmp_path / "c.zip", "")):
        with pytest.raises(BadKey):
            await call()
    assert left_in(tmp_path) == ["a.zip", "b.zip", "c.zip"]


# --- while others write -------------------------------------------------


async def test_no_pair_is_torn_while_others_write(servers, here, there, raws, tmp_path):
    with reem.RedisInterface(servers[0]) as writing:
        pair, written = reem.KeyValueStore(writing), []

        def write(count):
            array = np.full(20_000, count)
            value = {"n": count, "a": array, "l": [array, {"x": array}]}
            pair["pair"] = value if count % 3 else {"n": count, "other": array, "l": [count]}
            written.append(count)

        with repeated(write):
            await aeventually(lambda: len(written) > 3)
            kvs = reem_async.KeyValueStore(there)
            seen = set()
            for number in range(15):
                await save(here, tmp_path / f"{number}.zip", "p*")
                await restore(there, tmp_path / f"{number}.zip", replace=True)
                got = await kvs["pair"].read()
                seen.add(got["n"])
                arrays = [got["a"], got["l"][0], got["l"][1]["x"]] if "a" in got else [got["other"]]
                assert {each.min() for each in arrays} | {each.max() for each in arrays} == {got["n"]}
                assert_no_orphans(redis.Redis.from_url(servers[1].url, decode_responses=True), "pair")
    assert len(seen) > 5


async def test_one_key_at_a_time_is_in_memory(here, there, raws, tmp_path):
    kvs = reem_async.KeyValueStore(here)
    for number in range(40):
        await kvs[f"k{number}"].write(np.full(250_000, number, float))
    tracemalloc.start()
    try:
        await save(here, tmp_path / "a.zip")
        await restore(there, tmp_path / "a.zip")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 30_000_000, "the snapshot has 80 MB, a key 2 MB"
