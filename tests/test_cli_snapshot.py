"""`reem snapshot`, run as a user runs it."""

import errno
import json
import os
import pathlib
import re
import signal

import numpy as np
import pytest
import redis
import typer
from clikit import environment, in_terminal, invoked, running
from conftest import assert_same, line_of

import reem
from reem_async.server import EmbeddedServer
from reem_async.tools.cli.snapshot import period


def snapshot(*arguments, code=0, **changes):
    run = invoked("snapshot", *arguments, **changes)
    assert run.returncode == code, run.stdout + run.stderr
    assert "\x1b" not in run.stdout + run.stderr
    return run.stdout, run.stderr


@pytest.fixture(scope="module")
def server():
    with EmbeddedServer() as started:
        yield started


@pytest.fixture
def kvs(server):
    with redis.Redis.from_url(server.url) as raw:
        raw.flushall()
    with reem.RedisInterface(server) as interface:
        yield reem.KeyValueStore(interface)


@pytest.fixture
def env(server):
    return {"REEM_URL": server.url}


def names(directory):
    return sorted(path.name for path in directory.iterdir())


def test_there_and_back(kvs, env, server, tmp_path):
    kvs["foo"] = {"x": np.arange(3), "n": 1}
    kvs["bar"] = 2
    file = tmp_path / "a.zip"
    said, errors = snapshot("save", file, "--url", server.url)
    assert re.fullmatch(rf"{re.escape(str(file))}: 2 keys, [\d.]+ kB, [\d.]+ s\n", said)
    assert errors == ""
    kvs["foo"]["n"] = 5
    _, errors = snapshot("restore", file, code=1, **env)
    assert "--replace" in errors
    assert kvs["foo"]["n"].read() == 5
    assert snapshot("restore", file, "--replace", "--match", "f*", **env)[0].startswith("1 key restored")
    assert_same(kvs["foo"].read(), {"x": np.arange(3), "n": 1})
    _, errors = snapshot("restore", file, "--namespace", "r1:", **env)
    assert "namespace ''" in errors
    assert "'r1:'" in errors
    snapshot("save", "-d", tmp_path / "by", code=1, **env)
    (tmp_path / "by").mkdir()
    for number in range(2):
        said, _ = snapshot("save", "-d", tmp_path / "by", "--match", "foo", **env)
        assert re.search(r"by/reem-\d{8}T\d{6}Z(-2)?\.zip: 1 key, ", said)
        assert len(names(tmp_path / "by")) == number + 1


def test_json_for_scripts(kvs, env, tmp_path):
    kvs["foo"] = {"x": np.arange(3)}
    said, errors = snapshot("save", tmp_path / "a.zip", "--json", **env)
    saved = json.loads(said)
    assert (saved["kind"], saved["count"]) == ("portable", 1)
    assert errors == ""
    (listed,) = map(json.loads, snapshot("list", tmp_path, "--json")[0].splitlines())
    assert listed == {name: saved[name] for name in listed}
    inside = json.loads(snapshot("list", tmp_path / "a.zip", "--json")[0])
    assert inside["keys"][0]["key"] == "foo"
    assert inside["keys"][0]["values"] == [{"place": ".x", "type": "string", "size": 152}]
    done = json.loads(snapshot("restore", tmp_path / "a.zip", "--replace", "--json", **env)[0])
    assert done["restored"] == ["foo"]


def test_list_shows_both_kinds_and_what_is_damaged(kvs, env, tmp_path):
    kvs["foo"] = {"x": np.arange(3000)}
    snapshot("save", tmp_path / "reem-20260101T000000Z.zip", **env)
    snapshot("save", "--rdb", tmp_path / "b.rdb", **env)
    (tmp_path / "notes.zip").write_text("somebody else's")
    (tmp_path / "readme.txt").write_text("x")
    said, errors = snapshot("list", tmp_path)
    rows = [line.split("\t") for line in said.splitlines()]
    assert {(row[0], row[1], row[4]) for row in rows} == {
        ("reem-20260101T000000Z.zip", "portable", "1"),
        ("b.rdb", "rdb", ""),
    }
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d", row[2]) for row in rows)
    assert all(re.fullmatch(r"[\d.]+ k?B", row[3]) for row in rows)
    assert errors == ""
    said, _ = snapshot("list", tmp_path / "reem-20260101T000000Z.zip")
    assert "foo\t24.2 kB\t1 array" in said
    whole = bytearray((tmp_path / "reem-20260101T000000Z.zip").read_bytes())
    whole[len(whole) // 2] ^= 1
    (tmp_path / "reem-20260101T000000Z.zip").write_bytes(whole)
    snapshot("list", tmp_path)  # a look at its index does not show it
    _, errors = snapshot("restore", tmp_path / "reem-20260101T000000Z.zip", code=1, **env)
    assert "damaged" in errors
    (tmp_path / "reem-20260101T000000Z.zip").write_bytes(whole[:1000])
    _, errors = snapshot("list", tmp_path, code=1)
    assert "damaged or not complete" in errors
    _, errors = snapshot("restore", tmp_path / "reem-20260101T000000Z.zip", code=1, **env)
    assert "damaged or not complete" in errors
    (tmp_path / "empty").mkdir()
    said, errors = snapshot("list", tmp_path / "empty")
    assert said == ""
    assert "reem snapshot save" in errors


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["save", "x.zip", "-d", "."], 2, "FILE"),
        (["save", "x.zip", "--every", "10m"], 2, "FILE"),
        (["save", "x.zip", "--keep", "3"], 2, "FILE"),
        (["save", "--rdb", "--match", "a*", "x.rdb"], 2, "--match"),
        (["save", "--every", "soon"], 2, "10m"),
        (["save", "--keep", "0"], 2, "--keep"),
        (["save", "--match", "", "x.zip"], 2, "empty"),
        (["save", "--match", "nothing*", "x.zip"], 3, "nothing*"),
        (["save", "no/x.zip"], 1, "make it first"),
        (["restore", "no.zip"], 3, "no.zip"),
        (["list", "no"], 3, "no"),
        (["restore"], 2, "FILE"),
    ],
)
def test_what_is_wrong_is_said_with_an_exit_code(kvs, env, tmp_path, monkeypatch, words, code, message):
    monkeypatch.chdir(tmp_path)
    _, errors = snapshot(*words, code=code, **env)
    assert message in " ".join(errors.split())
    assert names(tmp_path) == []


def test_without_the_right_to_an_rdb_file_a_portable_one_is_taken(kvs, server, tmp_path):
    kvs["foo"] = 1
    with redis.Redis.from_url(server.url) as admin:
        admin.execute_command("ACL", "SETUSER", "robot", "reset", "on", ">pw", "~*", "&*", "+@all", "-config")
        url = server.url.replace("redis://", "redis://robot:pw@")
        said, errors = snapshot("save", "--rdb", "-d", tmp_path, "--url", url)
        admin.execute_command("ACL", "DELUSER", "robot")
    assert "CONFIG GET" in errors
    assert "portable" in errors
    assert re.search(r"reem-\w+\.zip: 1 key", said)
    assert len(names(tmp_path)) == 1


def periodic(*words, **changes):
    return running("snapshot", "save", *words, env=environment(**changes))


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_by_period_until_told_to_stop(kvs, env, tmp_path, number):
    kvs["foo"] = {"x": np.arange(3)}
    snapshot("save", "-d", tmp_path, **env)
    (mine,) = names(tmp_path)
    (tmp_path / "reem-auto-20000101T000000Z.zip").write_text("not a snapshot")
    with periodic("-d", tmp_path, "--every", "1s", "--keep", "2", "--json", **env) as process:
        lines = [json.loads(line_of(process.stdout.fileno())) for _ in range(3)]
        process.send_signal(number)
        rest, errors = process.communicate(timeout=20)
    assert process.returncode == 0, errors
    assert "Stopped" in errors
    assert "Traceback" not in errors
    assert [len(line["deleted"]) for line in lines] == [0, 0, 1]
    assert lines[2]["deleted"] == [lines[0]["path"]]
    assert lines[1]["time"] - lines[0]["time"] > 0.5
    lines += map(json.loads, rest.splitlines())
    kept = {os.path.basename(line["path"]) for line in lines[-2:]}
    assert set(names(tmp_path)) == kept | {mine, "reem-auto-20000101T000000Z.zip"}
    assert all(re.fullmatch(r"reem-auto-\d{8}T\d{6}Z(-\d+)?\.zip", name) for name in kept)


def test_what_cannot_be_deleted_does_not_make_it_unsaved(kvs, env, tmp_path, monkeypatch):
    """It said "not saved", and with one snapshot nothing but the error."""
    kvs["foo"] = 1
    snapshot("save", "-d", tmp_path, "--keep", "1", **env)
    (old,) = names(tmp_path)

    def refused(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / old))

    with monkeypatch.context() as patched:
        patched.setattr(pathlib.Path, "unlink", refused)
        for options in ((), ("--json",)):
            said, errors = snapshot("save", "-d", tmp_path, "--keep", "1", *options, code=1, **env)
            assert said.count("\n") == 1
            assert json.loads(said)["deleted"] == [] if options else "1 key" in said
            assert f"saved, but an older one could not be deleted: {tmp_path / old}: Permission denied" in errors
    said, errors = snapshot("save", "-d", tmp_path, "--keep", "1", "--json", **env)
    assert (len(json.loads(said)["deleted"]), len(names(tmp_path)), errors) == (3, 1, "")


@pytest.mark.long
def test_by_period_it_outlives_the_server(tmp_path):
    server = EmbeddedServer()
    with server:
        port = server.port
        with periodic("-d", tmp_path, "--every", "1s", REEM_URL=server.url) as process:
            assert "0 keys" in process.stdout.readline()
            server.stop()
            assert "not saved" in process.stderr.readline()
            with EmbeddedServer(port):
                assert "0 keys" in process.stdout.readline()
                process.send_signal(signal.SIGINT)
                assert "Traceback" not in process.communicate(timeout=20)[1]
            assert process.returncode == 0
    with periodic("-d", tmp_path, "--every", "1s", REEM_URL="redis://127.0.0.1:1") as process:
        assert process.wait(20) == 1, "what has never worked is an error"


def test_in_a_terminal(kvs, env, tmp_path):
    for number in range(20):
        kvs[f"k{number}"] = np.zeros(100_000)
    said = ""
    for words in (["save", tmp_path / "a.zip"], ["list", tmp_path], ["restore", "--replace", tmp_path / "a.zip"]):
        shown, code = in_terminal("snapshot", *words, **env, COLUMNS="80")
        said += shown
        assert code == 0, said
    assert "\x1b[" in said
    assert "taken" in said
    assert "save" in said
    assert "restore" in said
    assert "%" in said
    assert "20 keys restored" in said


@pytest.mark.parametrize(
    ("text", "seconds"), [("90", 90), ("30s", 30), ("10m", 600), ("1.5h", 5400), ("1d", 86400), (" 2 m", 120)]
)
def test_periods(text, seconds):
    assert period(text) == seconds


@pytest.mark.parametrize("text", ["", "m", "0", "0.5s", "-1m", "1w", "ten", "1e3", "1000d", "1m30s"])
def test_bad_periods(text):
    with pytest.raises(typer.BadParameter, match="10m"):
        period(text)
