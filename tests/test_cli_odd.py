"""The command line with odd names, files, clocks, encodings, and with Ctrl-C at a question."""

import base64
import json
import os
import shlex
import subprocess
import zipfile

import numpy as np
import orjson
import pytest
from clikit import REEM, finished, invoked
from conftest import assert_same
from snapshotkit import servers  # noqa: F401 - a fixture

import reem as blocking
import reem.snapshots
from reem_async.errors import BadData, ReemError
from reem_async.plan.paths import parse
from reem_async.tools.cli.echo import _moment
from reem_async.tools.cli.output import facts_lines, json_text, typed
from reem_async.tools.cli.running import CommandFailed, complain
from reem_async.tools.cli.snapshot import prune
from reem_async.tools.cli.values import FILES, parse_value, save
from reem_async.tools.snapshots import described
from reem_async.tools.snapshots.archive import Archive, ArchiveWriter, header
from reem_async.tools.snapshots.plans import KeyContent, Value


@pytest.fixture
def kvs(cli):
    with blocking.RedisInterface(cli.url, namespace=cli.namespace) as interface:
        yield blocking.KeyValueStore(interface)


def test_no_name_of_an_array_is_special_to_a_file(tmp_path):
    value = {name: np.arange(3) + place for place, name in enumerate(("file", "allow_pickle", "args", "x"))}
    assert save(value, tmp_path / "a.npz", "a").endswith("4 arrays")
    with np.load(tmp_path / "a.npz") as found:
        assert_same({name: found[name] for name in found.files}, value)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        *[(["--to", kind], f"{kind!r} is none of csv, npz, parquet") for kind in ("a/b", "", "xml")],
        (["-o", "run.txt"], "no format is known by the name run.txt"),
        (["-o", "run.npz", "--to", "csv"], "--to csv does not fit the name run.npz"),
        (["-o", "-", "--to", "npz"], "npz is not text"),
        (["-o", "-", "--json"], "name a file with -o"),
    ],
)
def test_a_format_of_an_export_that_there_is_not(tmp_path, options, said):
    run = invoked("log", "export", tmp_path / "run.mcap", *options)
    assert run.returncode == 2
    assert run.stderr.startswith(f"reem log export: {said}") or said in run.stderr
    assert not list(tmp_path.iterdir())


def test_a_file_that_came_to_be_while_the_value_was_fetched_stays(cli, kvs, tmp_path, monkeypatch):
    kvs["a"] = np.arange(3)
    file, write = tmp_path / "a.npy", FILES[".npy"]

    def meanwhile(*arguments):
        file.write_bytes(b"precious")
        return write(*arguments)

    monkeypatch.setitem(FILES, ".npy", meanwhile)
    assert "there already; choose another name, or replace it with" in cli.error(2, "get", "a", "-o", file)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"precious"]


def made(path, entries=(), index=None, **head):
    writer = ArchiveWriter(path, header("s", "", "*", "1") | head)
    for entry in entries:
        writer.add(entry)
    if index is not None:
        put = writer._put
        writer._put = lambda name, _, *rest: put(name, index, *rest)
    writer.finish({})
    return path


def test_only_snapshots_of_the_same_server_and_namespace_are_deleted(tmp_path):
    names = [tmp_path / f"reem-auto-20260801T1200{second:02}Z.zip" for second in range(6)]
    for place, name in enumerate(names):
        made(name, namespace="one" if place % 2 else "two", match="*" if place else "arm*")
    assert prune(described(names[5]), 1) == [names[1], names[3]]
    assert prune(described(names[4]), 1) == [names[2]]
    assert sorted(tmp_path.iterdir()) == [names[0], names[4], names[5]]


def test_a_restore_that_fails_says_how_far_it_came(servers, tmp_path):  # noqa: F811
    source, target = servers
    with blocking.RedisInterface(source) as one, blocking.RedisInterface(target) as other:
        store = blocking.KeyValueStore(one)
        for number in range(100):
            store[f"k{number:03}"] = {"x": np.random.default_rng(number).random(12_500)}
        blocking.snapshots.save(one, tmp_path / "a.zip")
        import redis

        admin = redis.Redis(unix_socket_path=str(target.socket_path))
        admin.config_set("maxmemory", admin.info("memory")["used_memory"] + 4_000_000)
        try:
            with pytest.raises(ReemError, match=r"Written before that: \d+ keys, from 'k000'") as caught:
                blocking.snapshots.restore(other, tmp_path / "a.zip")
        finally:
            admin.config_set("maxmemory", 0)
        assert "nothing was written" not in str(caught.value)
        assert 0 < len(blocking.KeyValueStore(other).keys()) < 100
        admin.flushall()
        admin.close()


def shell(cli, words, rest):
    line, env = f"{shlex.join(words)} {rest}", cli.environment()
    return subprocess.run(["sh", "-c", line], env=env, capture_output=True, text=True, timeout=20, check=False)


@pytest.mark.long
def test_saving_by_period_ends_with_its_reader(cli, kvs, tmp_path):
    kvs["a"] = 1
    options = ["--namespace", cli.namespace, "--every", "1s", "-d", str(tmp_path), "--keep", "3"]
    run = shell(cli, [REEM, "snapshot", "save", *options], "| head -1")
    assert (run.stdout.count("\n"), run.stderr.replace("Stopped; what is listed above is complete.\n", "")) == (1, "")


NAMES = {"name": "a", "file": "x", "registry": [], "values": []}


@pytest.mark.parametrize(
    "odd",
    [
        {"time": 1e300},
        {"time": -5},
        {"index": orjson.dumps({"keys": [NAMES | {"size": 1e308}], "foreign": 0, "foreign_names": []})},
        {"index": orjson.dumps({"keys": [NAMES | {"size": -1}], "foreign": 0, "foreign_names": []})},
    ],
)
def test_a_snapshot_that_says_what_cannot_be_is_damaged(tmp_path, odd):
    with pytest.raises(BadData, match="damaged"):
        described(made(tmp_path / "a.zip", **odd))


def test_an_index_that_unpacks_to_gigabytes_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr("reem_async.tools.snapshots.archive._LARGEST_INDEX", 1 << 20)
    with pytest.raises(BadData, match="larger than any index"):
        described(made(tmp_path / "a.zip", index=b" " * (1 << 21) + b'{"keys":[],"foreign":0,"foreign_names":[]}'))


@pytest.mark.parametrize(
    ("member", "kind"),
    [
        ("document.json", "string"),
        ("values/1.bin", "string"),
        ("values/1.hash", "hash"),
        ("values/1.json", "ReJSON-RL"),
    ],
)
def test_a_member_that_unpacks_to_more_than_the_index_says_is_not_unpacked(tmp_path, monkeypatch, member, kind):
    """A snapshot of some kilobytes took all memory when it was restored."""
    put, unpacked = ArchiveWriter._put, []

    def bomb(self, name, data, *method):
        put(self, name, *(bytes(1 << 24), zipfile.ZIP_DEFLATED) if name.endswith(member) else (data, *method))

    monkeypatch.setattr(ArchiveWriter, "_put", bomb)
    entry = KeyContent("foo", b'{"a":1}', (".z",), (Value(".z", kind, (b"a", b"1") if kind == "hash" else (b"1",)),))
    file = made(tmp_path / "a.zip", [entry])
    assert file.stat().st_size < 100_000
    read = zipfile.ZipFile.read
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *words: unpacked.append(read(*words)) or unpacked[-1])
    with Archive(file) as archive, pytest.raises(BadData, match=r"damaged.* would unpack to 16777216 bytes"):
        archive.read("foo")
    assert max(map(len, unpacked)) < 1000


@pytest.mark.parametrize(("kind", "pieces"), [("zset", (b"a",)), ("hash", (b"a",)), ("ReJSON-RL", ())])
def test_values_of_the_wrong_number_of_pieces_are_damaged(tmp_path, kind, pieces):
    entry = KeyContent("foo", b'{"a":1}', (".z",), (Value(".z", kind, pieces),))
    with Archive(made(tmp_path / "a.zip", [entry])) as archive, pytest.raises(BadData, match="pieces"):
        archive.read("foo")


def test_what_files_say_does_not_command_the_terminal(capsys):
    facts_lines([("snapshot", "under \x1b]0;pwned\x07")])
    assert "\x1b]0" not in capsys.readouterr().out
    assert complain("up", "a value of \x1b[31mevil\nsecond line", 1) == 1
    errors = capsys.readouterr().err
    assert ("\\u001b[31mevil" in errors, errors.count("\n")) == (True, 2)


def test_json_of_what_orjson_refuses():
    deep = value = {}
    for _ in range(200):
        deep["a"] = deep = {}
    assert json.loads(json_text(value)) == value
    odd = {"half": "a\ud800b", "array": np.array(["\udfff"]), "nan": [np.nan, 1.5], "b": b"x", "pair": np.float64(2)}
    wanted = {"half": "a\ud800b", "array": ["\udfff"], "nan": [None, 1.5], "b": "eA==", "pair": 2.0}
    for text in (json_text(odd), json_text(odd, pretty=True)):
        found = json.loads(text)
        assert np.isnan(found["nan"][0])
        found["nan"][0] = None
        assert found == wanted


def from_json(listed, dtype):
    """The array that nested lists of JSON stand for, as `reem_async/tools/jsontext.py` documents it."""
    if dtype.names is not None:
        fields = [from_json([row[place] for row in listed], dtype[name]) for place, name in enumerate(dtype.names)]
        array = np.empty(len(listed), dtype)
        for name, field in zip(dtype.names, fields, strict=True):
            array[name] = field
        return array
    turned = {
        "c": complex,
        "S": base64.b64decode,
        "V": lambda text: np.void(base64.b64decode(text)),
        "m": lambda text: "NaT" if text == "NaT" else np.timedelta64(int(text.split()[0]), *text.split()[1:]),
    }
    return np.array([turned.get(dtype.kind, lambda item: item)(item) for item in listed], dtype)


PLAIN_TYPES = ["?", "i1", ">u2", "<i8", "u8", "f2", ">f4", "f8", "c8", "c16", "S3", "U2", "V4"]
TIMES = [f"{kind}8[{unit}]" for kind in "mM" for unit in ("Y", "M", "D", "h", "s", "10ms", "us", "ns", "ps", "as")]


@pytest.mark.parametrize("seed", range(6))
def test_json_keeps_every_value_beside_any_other(seed):
    print("seed", seed)
    rng = np.random.default_rng(seed)
    for name in [
        *PLAIN_TYPES,
        *TIMES,
        ">M8[ns]",
        ">m8[ms]",
        [("n", ">i4"), ("t", ">M8[ns]"), ("x", "f4"), ("d", "m8[us]")],
    ]:
        dtype = np.dtype(name)
        bits = rng.integers(0, 2 if name == "?" else 127, 6 * dtype.itemsize, np.uint8)
        array = bits.view(dtype) if dtype.kind != "U" else np.array(["a", "é\n", '"', "", "日本", "𝄞"], dtype)
        if dtype.kind in "mM":
            array = (
                (rng.integers(-(10**18), 10**18, 6) >> rng.integers(0, 60, 6))
                .astype(f"{dtype.str[0]}i8")
                .view(dtype)
                .copy()
            )
            array[0] = "NaT"
        elif dtype.kind in "fc":
            array = np.where(np.isnan(array), 0, array).astype(dtype)
            array[:3] = np.nan, np.inf, -np.inf
        for beside in ({}, {"x": None}, {"x": np.array([np.nan])}):
            text = json_text({"array": array, **beside})
            with np.errstate(all="ignore"):
                assert_same(from_json(json.loads(text)["array"], dtype), array)
    assert json.loads(json_text(np.array("2026-01-01", "M8[D]"))) == "2026-01-01"
    assert json.loads(json_text([np.datetime64("NaT"), np.float32(0.1), np.zeros((2, 0))])) == ["NaT", 0.1, [[], []]]


def test_a_terminal_that_does_not_know_all_characters(cli, kvs):
    kvs["a"] = {"text": "日本"}
    run = cli.process("tree", PYTHONIOENCODING="ascii")
    assert (run.returncode, "\\u65e5" in run.stdout) == (0, True)


@pytest.mark.parametrize("clock", [1e13, 1e300, -1e12, float("nan")])
def test_an_update_of_an_odd_time_is_shown(clock):
    assert _moment(clock) == f"{clock:g} s"
    assert _moment(1.5).endswith("00:01.500000")


def test_values_from_files_that_are_none(tmp_path):
    text, array = tmp_path / "a.json", tmp_path / "a.npy"
    text.write_bytes(b'"\xff"')
    with pytest.raises(CommandFailed, match="not UTF-8"):
        parse_value(f"@{text}", is_text=False)
    for head in (
        "(((((",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (10**30,)}",
        f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({10**30},)}}",
        f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({10**13},)}}",
    ):
        line = head.encode() + b"\n"
        array.write_bytes(b"\x93NUMPY\x01\x00" + len(line).to_bytes(2, "little") + line)
        with pytest.raises(CommandFailed, match=r"not an \.npy file of"):
            parse_value(f"@{array}", is_text=False)


@pytest.mark.parametrize("path", [("foo\x9b",), ("a", "b\u202ec", 2), ("a.b", "c"), ("\x1b",)])
def test_paths_are_shown_as_they_can_be_typed(path):
    shown = typed(path)
    assert shown.isprintable()
    assert parse(shown) == path


def test_a_pipe_is_no_snapshot(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    run = finished("up", "--from", tmp_path / "pipe")
    assert (run.returncode, "is no file" in run.stderr) == (1, True)
