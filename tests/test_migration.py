"""What REEM 0.0.11, 0.1.2 and 0.1.3 have stored: never read wrong, converted in place, whatever happens meanwhile."""

import contextlib
import json
import re
import shlex

import numpy as np
import oldkit
import pytest
import redis
from chaos.proxy import Proxy
from clikit import CommandLine
from conftest import assert_same, eventually, sized
from oldkit import A, Pose, PoseShip, everything, replay, ships, stored

import reem
import reem_async
from reem.migration import migrate
from reem_async import migration
from reem_async.errors import BadData, BadType, NotAllowed
from reem_async.legacy.convert import array_of
from reem_async.server import EmbeddedServer
from reem_async.tools.cli.options import ship_named


@pytest.fixture(scope="module")
def own():
    with EmbeddedServer() as started:
        yield started


@pytest.fixture
def raw(own):
    with redis.Redis.from_url(own.url, decode_responses=True) as client:
        client.flushall()
        yield client


@pytest.fixture
def kvs(own, raw):
    with reem.RedisInterface(own, ships=ships()) as interface:
        yield reem.KeyValueStore(interface)


def check(kvs, version, only=None):
    for name, value in stored(version).items():
        if only is None or name in only:
            assert_same(kvs[name].read(), value, name)


def old_array(raw, name, place, array):
    """As REEM 0.1 stored an array: a hash named after document and place, which the second document names."""
    raw.hset(name + place, mapping={"arr": array.tobytes(), "dtype": str(array.dtype), "shape": str(array.shape)})
    raw.execute_command("JSON.SET", f"{name}&&&&metadata", "$", '{"special_paths":{}}', "NX")
    path = f"$.special_paths[{json.dumps(place)}]"
    raw.execute_command("JSON.SET", f"{name}&&&&metadata", path, '"default_numpy_handler"')


def old_keys(raw):
    """What only old versions have: second documents, and hashes named after the document without its tag."""
    return [key for key in raw.scan_iter() if "&&&&" in key or (raw.type(key) == "hash" and not key.startswith("{"))]


# --- never read wrong -------------------------------------------------


@pytest.mark.parametrize("version", oldkit.VERSIONS)
def test_old_data_is_not_read(kvs, raw, version):
    replay(raw, version)
    for name, value in stored(version).items():
        if name in oldkit.NOT_OLD[version]:
            assert_same(kvs[name].read(), value)
            continue
        if name == "replaced":
            with pytest.raises(BadData, match=r"reem migrate"), kvs[name] as value:
                value["n"] = 2
        for read in (
            kvs[name].read,
            kvs[name]["x"].read,
            kvs[name].get,
            lambda name=name: kvs.get(name),
            kvs[name].read,
        ):
            with pytest.raises(BadData, match=rf"^{name} was written by REEM 0\.1 or older.*reem migrate"):
                read()


async def test_nor_a_number_in_a_cluster(cluster):
    """Which shows in the reply itself; `foo&&&&metadata` may be on another node."""
    async with reem_async.RedisInterface(cluster, namespace="old:") as interface:
        store = reem_async.KeyValueStore(interface)
        for command in oldkit.recorded("reem_0_1_2", {"number"}, "old:"):
            await interface.session.transport.roundtrip([command])
        for place in (store["number"], store["number"]["absent"]):
            with pytest.raises(BadData, match="reem migrate"):
                await place.read()
        await store["number"].delete()


def test_nor_do_subscribers_begin_with_it(kvs, raw):
    replay(raw, "reem_0_1_2", {"mixed"})
    subscriber = reem.SilentSubscriber("mixed", kvs.interface)
    with pytest.raises(BadData, match="reem migrate"):
        subscriber.listen()
    migrate(kvs.interface)
    with reem.SilentSubscriber("mixed", kvs.interface) as again:
        assert_same(again.value(), oldkit.STORED["mixed"])


def test_subscribers_are_told_of_the_conversion(kvs, raw):
    with reem.SilentSubscriber("mixed", kvs.interface) as subscriber:
        replay(raw, "reem_0_1_2", {"mixed"})
        migrate(kvs.interface)
        eventually(lambda: subscriber.value() is not None)
        assert_same(subscriber.value(), oldkit.STORED["mixed"])


def test_new_data_is_looked_at_once(own, kvs, raw):
    """In the round trip of the first read; not at all once a key is known, as it is to whoever has written it."""
    kvs["new"] = {"a": 1}
    with reem.RedisInterface(own) as other:
        for store, asked in ((kvs, 10), (reem.KeyValueStore(other), 11)):
            raw.config_resetstat()
            for _ in range(10):
                assert store["new"]["a"].read() == 1
            counted = {name.lower(): row["calls"] for name, row in raw.info("commandstats").items()}
            assert counted["cmdstat_json.get"] == asked


def test_only_where_the_reply_leaves_it_open_is_asked_for_the_old_entry(own, kvs, raw):
    """Its name in the value, or nothing at the place that was read: once, and then not again."""
    kvs["new"] = {"a": {"n": 1}, "text": "%%%%ROOT%%%%", "%%%%ROOT%%%%": {"image": A}}
    raw.execute_command("JSON.DEL", "new", '$["%%%%ROOT%%%%"]')
    value = {"a": {"n": 1}, "text": "%%%%ROOT%%%%"}

    def asked():
        return raw.info("commandstats").get("cmdstat_json.type", {"calls": 0})["calls"]

    for path, read, expected in (
        (("a",), {"n": 1}, 0),
        (("a", "n"), 1, 0),
        ((), value, 1),
        (("text",), "%%%%ROOT%%%%", 1),
        (("absent",), None, 1),
        (("a", "absent"), None, 1),
    ):
        with reem.RedisInterface(own) as interface:
            place = reem.KeyValueStore(interface)["new"]
            for key in path:
                place = place[key]
            raw.config_resetstat()
            for _ in range(3):
                assert place.get(None) == read
            assert asked() == expected, path


def test_old_values_are_found_beside_what_is_newer(own, kvs, raw):
    """A number of old, to which a program of today has added an array without reading it."""
    replay(raw, "reem_0_1_2", {"number"})
    kvs["number"]["image"] = A
    with reem.RedisInterface(own) as interface:
        place = reem.KeyValueStore(interface)["number"]
        assert_same(place["image"].read(), A)  # which is where it says that it is
        with pytest.raises(BadData, match="reem migrate"):
            place.read()
    with reem.RedisInterface(own) as interface, pytest.raises(BadData, match="reem migrate"):
        reem.KeyValueStore(interface)["number"]["absent"].read()


def test_a_user_who_may_not_look_can_read(own, kvs, raw):
    kvs["foo"] = {"a": A}
    raw.execute_command("ACL", "SETUSER", "narrow", "reset", "on", ">x", "+@all", "~foo", "~{foo}*")
    with reem.RedisInterface(own.url, username="narrow", password="x") as interface:
        assert_same(reem.KeyValueStore(interface)["foo"].read(), {"a": A})
    raw.acl_deluser("narrow")


def test_keys_with_names_like_those_of_old_data_are_new(own, kvs, raw):
    kvs["foo"] = {"a": 1}
    for value in ({"special_paths": {}}, {"special_paths": {"a": 1}}, {"special": {".a": "x"}}, [1], "text"):
        kvs["foo&&&&metadata"] = value
        with reem.RedisInterface(own) as interface:
            fresh = reem.KeyValueStore(interface)
            assert fresh["foo"].read() == {"a": 1}
            assert fresh["foo&&&&metadata"].read() == value
    kvs["foo&&&&metadata"] = {"mine": 1}
    raw.json().set("foo", "$", {"%%%%ROOT%%%%": 5})
    (done,) = migrate(kvs.interface).keys
    assert (done.rooted, done.removed) == (True, ())
    assert kvs["foo&&&&metadata"].read() == {"mine": 1}
    assert kvs["foo"].read() == 5


# --- converted -------------------------------------------------


@pytest.mark.parametrize("version", oldkit.VERSIONS)
def test_it_reads_as_it_did_and_nothing_old_is_left(kvs, raw, version):
    replay(raw, version)
    before = everything(raw)
    plan = migrate(kvs.interface, dry_run=True)
    assert everything(raw) == before
    assert plan.problems == ()
    told = []
    done = migrate(kvs.interface, progress=lambda *how: told.append(how))
    assert done.keys == plan.keys
    assert told == [(number, len(done.keys)) for number in range(len(done.keys) + 1)]
    assert {key.name for key in done.keys} - {"gone"} == stored(version).keys() - oldkit.NOT_OLD[version]
    by_name = {key.name: key for key in done.keys}
    assert by_name["mixed"] == ("mixed", (".image",), False, ("mixed.image", "mixed&&&&metadata"), "", False)
    assert set(by_name["replaced"].removed) > {"replaced.arr", "replaced.x.y", "replaced.x.z"}
    assert by_name["back"][1:3] == ((), True)
    check(kvs, version)
    assert old_keys(raw) == ["cam.image2"]  # it may have been meant to stay
    after = everything(raw)
    assert migrate(kvs.interface).keys == ()
    assert everything(raw) == after
    for name in stored(version):  # as any key of today
        kvs[name] = {"a": A}
        kvs[name] = 1
    assert raw.keys("{*}.*") == []


@pytest.mark.parametrize(
    ("version", "only"),
    [
        ("reem_0_0_11", {"mixed", "number", "writer"}),
        ("reem_0_1_2", {"whole pose", "replaced", "beside"}),
        ("reem_0_1_3", {"whole array", "tolerant", "dropped"}),
    ],
)
def test_broken_off_at_any_command_and_run_again(own, raw, version, only):
    sent, cut_short = 1, True
    while cut_short:
        raw.flushall()
        replay(raw, version, only)
        with Proxy(own.port) as proxy:
            proxy.left = sent
            try:
                with reem.RedisInterface(proxy.url, ships=ships()) as interface:
                    cut_short = bool(migrate(interface).problems)
            except redis.exceptions.RedisError:
                cut_short = True
            assert proxy.settled()
        with reem.RedisInterface(own, ships=ships()) as interface:
            store = reem.KeyValueStore(interface)
            for name in only:
                with contextlib.suppress(BadData):
                    assert_same(store[name].read(), stored(version)[name], name)
            assert migrate(interface).problems == ()
            check(store, version, only)
        assert old_keys(raw) == []
        sent += sized(700, 30)
    assert sent > 3000


async def test_broken_off_at_any_step_in_a_cluster(cluster):
    """There is no transaction over several nodes: what is old is removed after it, in an order that can be resumed."""
    only = {"mixed", "number", "whole pose", "replaced", "deep"}
    async with reem_async.RedisInterface(cluster, ships=ships(), namespace="old:") as interface:
        session, store = interface.session, reem_async.KeyValueStore(interface)
        run, left = session.run, 0

        def counting(*arguments):
            nonlocal left
            if not left:
                raise ConnectionAbortedError
            left -= 1
            return run(*arguments)

        steps, broken = 0, True
        while broken:
            for command in oldkit.recorded("reem_0_1_2", only, "old:"):
                await session.transport.roundtrip([command])
            session.run, left, broken = counting, steps, False
            try:
                await migration.migrate(interface)
            except ConnectionAbortedError:
                broken = True
            session.run = run
            assert (await migration.migrate(interface)).problems == ()
            for name in only:
                assert_same(await store[name].read(), stored("reem_0_1_2")[name], name)
                await store[name].delete()
            with contextlib.closing(redis.RedisCluster("127.0.0.1", cluster.nodes[0].port)) as raw:
                assert list(raw.scan_iter("old:*")) == []
            steps += sized(3, 1)
        assert steps > 30


def test_what_is_newer_stays(kvs, raw):
    replay(raw, "reem_0_1_2", {"mixed"})
    kvs["mixed"]["image"] = A * 3
    kvs["mixed"]["more"] = [A]
    (done,) = migrate(kvs.interface).keys
    assert (done.places, done.problem) == ((), "")
    assert_same(kvs["mixed"].read(), {"image": A * 3, "more": [A], "id": 3})
    assert old_keys(raw) == []


def test_a_key_written_to_meanwhile_stays_until_the_next_run(kvs, raw):
    replay(raw, "reem_0_1_2", {"mixed"})
    session = kvs.interface._followers.session
    run, before = session.run, everything(raw)

    def racing(plan, *where):
        if plan.held:
            raw.execute_command("JSON.SET", "mixed", "$.id", 4)
        return run(plan, *where)

    session.run = racing
    (key,) = migrate(kvs.interface).problems
    assert "changed by another client" in key.problem
    assert everything(raw) == {**before, "mixed": {"id": 4}}
    session.run = run
    assert migrate(kvs.interface).problems == ()
    assert_same(kvs["mixed"].read(), {"image": A.astype("uint8"), "id": 4})


def test_namespace_pattern_and_database(own, raw):
    other = redis.Redis.from_url(f"{own.url.rstrip('/0')}/2", decode_responses=True)
    with contextlib.closing(other):
        replay(other, "reem_0_1_2", {"mixed", "deep"}, "r1:")
        replay(other, "reem_0_1_2", {"mixed"})
        replay(raw, "reem_0_1_2", {"mixed"})
        before = everything(raw)
        with reem.RedisInterface(own.url, db=2, namespace="r1:") as interface:
            assert [key.name for key in migrate(interface, "m*").keys] == ["mixed"]
            assert_same(reem.KeyValueStore(interface)["mixed"].read(), oldkit.STORED["mixed"])
            assert [key.name for key in migrate(interface).keys] == ["deep"]
            assert_same(reem.KeyValueStore(interface)["deep"].read(), oldkit.STORED["deep"])
        assert sorted(other.keys("*&&&&*")) == ["mixed&&&&metadata"]
        assert everything(raw) == before


# --- what cannot be converted -------------------------------------------------


def test_a_key_that_cannot_be_converted_is_named_and_left(own, kvs, raw):
    replay(raw, "reem_0_1_2", {"mixed", "deep", "pose", "over", "number"})
    raw.delete("mixed.image")
    raw.hset("deep.one", "dtype", "object")
    raw.json().set("over", "$", {"a": 5})
    raw.json().set("over&&&&metadata", "$", {"special_paths": {".a.b": "default_numpy_handler"}})
    raw.hset("over.a.b", mapping={"arr": b"\0" * 8, "dtype": "float64", "shape": "(1,)"})
    raw.json().set("number", "$.x", 1)
    raw.json().set("a{b}", "$", {"%%%%ROOT%%%%": 1})
    replay(raw, "reem_0_1_2", {"text"})
    before = everything(raw)
    with reem.RedisInterface(own) as interface:  # without the ship for poses
        done = migrate(interface)
        problems = {key.name: key.problem for key in done.problems}
        assert reem.KeyValueStore(interface)["text"].read() == "hello"
    assert problems.keys() == {"mixed", "deep", "pose", "over", "number", "a{b}"}
    assert "mixed.image: what the ship 'default_numpy_handler' stored is gone" in problems["mixed"]
    assert "deep.one" in problems["deep"]
    assert "'object'" in problems["deep"]
    assert "pose.where was written by the ship 'pose'" in problems["pose"]
    assert "--ship" in problems["pose"]
    assert ".a.b is inside of a value of type int" in problems["over"]
    assert "beside it, 'x'" in problems["number"]
    assert "brace" in problems["a{b}"]
    assert everything(raw) == {**before, "text": "hello"}
    # The cure that is named.
    raw.execute_command("JSON.DEL", "mixed&&&&metadata", '$.special_paths[".image"]')
    raw.execute_command("JSON.DEL", "number", '$["%%%%ROOT%%%%"]')
    assert {key.name for key in migrate(kvs.interface).problems} == {"deep", "over", "a{b}"}
    assert kvs["mixed"].read() == {"id": 3}
    assert kvs["number"].read() == {"x": 1}


def test_a_user_without_the_rights_changes_nothing(own, raw):
    replay(raw, "reem_0_1_2", {"replaced", "number"})
    before = everything(raw)
    for right in ("-hgetall", "-hkeys", "-@write"):
        raw.execute_command("ACL", "SETUSER", "narrow", "reset", "on", ">x", "~*", "&*", "+@all", right)
        with reem.RedisInterface(own.url, username="narrow", password="x") as interface, pytest.raises(NotAllowed):
            migrate(interface, "replaced")
        assert everything(raw) == before
    raw.execute_command("ACL", "DELUSER", "narrow")


HOSTILE = [
    {"dtype": b"float64, __import__('os').system('true')"},
    {"dtype": b"ndarray"},
    {"dtype": b"[('a', 'O')]"},
    {"dtype": b"float128"},
    {"dtype": b"<f8', 'descr': '<i8"},
    {"dtype": b"\xff"},
    {"shape": b"(2, 3), 1)"},
    {"shape": b"(-1,)"},
    {"shape": b"(999999999999999,)"},
    {"shape": b"[6]"},
    {"shape": b"(7,)"},
    {"arr": b"\0" * 47},
]


@pytest.mark.parametrize("change", HOSTILE, ids=repr)
def test_nothing_that_was_stored_is_believed(change):
    good = {b"arr": A.tobytes(), b"dtype": b"float64", b"shape": b"(2, 3)", b"strides": b"(24, 8)"}
    assert_same(array_of(good), A)
    with pytest.raises(BadData):
        array_of({**good, **{name.encode(): value for name, value in change.items()}})


@pytest.mark.parametrize(
    "array",
    [
        np.array([1, 2], dtype=">u2"),
        np.array([b"ab", b"c"]),
        np.array([(1, 2.5)], dtype=[("a", "<i4"), ("b", ">f8")]),
        np.array(["2026-01-01"], dtype="datetime64[ns]"),
        np.array([5], dtype="timedelta64[ms]"),
        np.zeros((2, 0, 3), dtype="float16"),
        np.array(3 + 4j, dtype="complex64"),
        np.array([["é"]]),
    ],
    ids=lambda array: str(array.dtype),
)
def test_arrays_of_every_kind(array):
    fields = {b"arr": array.tobytes(), b"dtype": str(array.dtype).encode(), b"shape": str(array.shape).encode()}
    assert_same(array_of(fields), array)
    assert_same(array_of({**fields, b"shape": fields[b"shape"].replace(b",", b"L,")}), array)


# --- the command -------------------------------------------------


def test_the_command_shows_first_and_converts_with_yes(own, raw, monkeypatch):
    monkeypatch.syspath_prepend(str(oldkit.ROOT / "tests"))
    replay(raw, "reem_0_1_2")
    before, cli = everything(raw), CommandLine(own.url, "")
    shown = cli("migrate", "--ship", "oldkit:PoseShip")
    assert (shown.returncode, everything(raw)) == (0, before)
    assert "`reem migrate --yes` does it" in shown.stdout
    assert "mixed\t.image\t2 old Redis keys removed" in shown.stdout.replace("  ", "\t")
    without = cli("migrate")
    assert (without.returncode, everything(raw)) == (1, before)
    assert "pose is left as it is" in without.stderr
    rows = [
        json.loads(line) for line in cli("migrate", "--json", "--yes", "--ship", "oldkit:PoseShip").stdout.splitlines()
    ]
    assert {row["name"]: row["problem"] for row in rows}["pose"] == ""
    assert not any(row["dry_run"] for row in rows)
    again = cli("migrate", "--yes")
    assert (again.returncode, again.stdout) == (0, "Nothing to do: no key was written by REEM 0.1 or older.\n")
    with reem.RedisInterface(own, ships=ships()) as interface:
        check(reem.KeyValueStore(interface), "reem_0_1_2")


@pytest.mark.parametrize("name", ["oldkit", "oldkit:", "no_such_module:Ship", "oldkit:NoShip", "oldkit:A"])
def test_a_ship_that_is_none_is_wrong_usage(own, raw, name, monkeypatch):
    monkeypatch.syspath_prepend(str(oldkit.ROOT / "tests"))
    run = CommandLine(own.url, "")("migrate", "--ship", name)
    assert run.returncode == 2
    assert name in run.stderr


def test_a_ship_may_be_a_class_or_made_already(monkeypatch):
    monkeypatch.syspath_prepend(str(oldkit.ROOT / "tests"))
    assert type(ship_named("oldkit:PoseShip")) is PoseShip
    monkeypatch.setattr(oldkit, "SHIP", PoseShip(), raising=False)
    assert ship_named("oldkit:SHIP") is oldkit.SHIP
    with pytest.raises(BadType):
        ship_named("oldkit:Pose.__name__")
    assert Pose(1, 2) == Pose(1, 2)


@pytest.mark.long
def test_the_doctor_counts_old_keys(own, raw):
    cli = CommandLine(own.url, "")

    def finding():
        run = cli("doctor", "--json")
        return run.returncode, next(
            row for row in map(json.loads, run.stdout.splitlines()) if row["check"] == "old data"
        )

    assert finding()[1]["status"] == "ok"
    replay(raw, "reem_0_1_2", {"mixed", "number", "plain", "gone"})
    code, found = finding()
    assert (code, found["status"]) == (1, "fail")
    assert found["message"] == "2 keys were written by REEM 0.1 or older and cannot be read: mixed, number"
    assert "reem migrate" in found["remedy"]


@pytest.mark.parametrize("entry", ["x1", "it's", "x[0]"])
@pytest.mark.parametrize("arrays", ["", "r", "e", "re", "n"])
@pytest.mark.parametrize("which", ["value", "entry"])
def test_a_value_with_an_entry_beside_it_is_converted_after_what_the_message_says(kvs, raw, entry, arrays, which):
    """Value and entry are plain or arrays (`n`: an array inside the entry); the command deletes just the one."""
    root, beside = np.arange(4) if "r" in arrays else 5, np.arange(3) if "e" in arrays else 7
    beside = {"deep": np.arange(2), "n": 1} if "n" in arrays else beside
    document = {} if "r" in arrays else {"%%%%ROOT%%%%": root}
    document |= {} if "e" in arrays else {entry: {"n": 1} if "n" in arrays else beside}
    raw.execute_command("JSON.SET", "foo", "$", json.dumps(document))
    for place, value in ((".%%%%ROOT%%%%", root), (f".{entry}", beside), (f".{entry}.deep", np.arange(2))):
        if isinstance(value, np.ndarray) and ("n" in arrays or not place.endswith("deep")):
            old_array(raw, "foo", place, value)
    (key,) = migrate(kvs.interface).problems
    commands = re.findall(r"with `([^`]*)`", key.problem)[which == "entry"]
    for command in commands.split(" && "):
        program, *words = shlex.split(command)
        assert program == "redis-cli"
        assert raw.execute_command(*words) == 1, command
    assert migrate(kvs.interface).problems == ()
    assert_same(kvs["foo"].read(), root if which == "entry" else {entry: beside})
    assert old_keys(raw) == []
