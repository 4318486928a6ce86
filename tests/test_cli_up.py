"""`reem up`, `reem browse` and `reem --version`, run as a user runs them."""

import contextlib
import os
import pathlib
import re
import signal
import socket
import subprocess

import httpx
import pytest
import redis
import snapshotkit
from clikit import environment, finished, in_terminal, running, said_until
from conftest import PATIENCE, python
from own_servers import other_addresses
from redis.backoff import NoBackoff
from redis.retry import Retry

import reem
import reem.snapshots

snapshots = snapshotkit.snapshots


@contextlib.contextmanager
def up(*words, **changes):
    with running("up", *words, env=environment(PYTHONDEVMODE="1", **changes)) as process:
        yield process, said_until(process, "  to stop")


def port_in(said):
    return int(re.search(r"redis://localhost:(\d+)\n", said)[1])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_up_until_told_to_stop(number):
    with up("--port", "0") as (process, said):
        port = port_in(said)
        with redis.Redis(port=port) as client:
            assert client.execute_command("JSON.SET", "k", "$", "1")
        path = re.search(r"unix://(\S+)", said)[1]
        with redis.Redis(unix_socket_path=path) as client:
            assert client.execute_command("JSON.GET", "k") == b"1"
        process.send_signal(number)
        rest, errors = process.communicate(timeout=10)
        assert (process.returncode, errors) == (0, "")
        assert "Stopped." in rest
        assert not pathlib.Path(path).exists()
        with socket.socket() as probe:
            assert probe.connect_ex(("127.0.0.1", port)) != 0


def test_says_what_to_type(tmp_path):
    with up("--port", "0", "--directory", str(tmp_path / "x" / ("long" * 20))) as (_, said):
        url = f"redis://localhost:{port_in(said)}"
        for package in ("reem", "reem_async"):
            line = f"from {package} import KeyValueStore, RedisInterface; "
            line += f'kvs = KeyValueStore(RedisInterface("{url}"))'
            assert f"{line}\n" in said  # whole, though no terminal is that wide
            compile(line, "line", "exec")
        assert f"{tmp_path / 'x' / ('long' * 20)}, kept\n" in said
        assert "Ctrl-C" in said
        assert "\x1b" not in said


def test_password():
    with up("--port", "0", REEM_PASSWORD="secret-7d1f") as (process, said):
        assert "secret" not in said
        assert 'password=os.environ["REEM_PASSWORD"]' in said
        with redis.Redis(port=port_in(said), password="secret-7d1f") as client:
            assert client.ping()
        once = Retry(NoBackoff(), 0)
        with redis.Redis(port=port_in(said), retry=once) as client, pytest.raises(redis.AuthenticationError):
            client.ping()
        shown = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
        assert "secret-7d1f" not in shown
        process.terminate()
        assert "secret" not in "".join(process.communicate(timeout=10))


def test_a_server_that_ends_by_itself_is_an_error():
    with up("--port", "0") as (process, said):
        os.kill(int(re.search(r"process (\d+)", said)[1]), signal.SIGTERM)
        _, errors = process.communicate(timeout=10)
        assert process.returncode == 1
        assert "ended by itself" in errors
        assert "shutdown" in errors


def test_ctrl_c_in_a_terminal_and_colours():
    said, code = in_terminal("up", "--port", "0", keys=[(b"Ctrl-C", b"\x03")])
    assert code == 0
    assert "\x1b[" in said
    assert "Stopped." in said


@pytest.mark.long
@pytest.mark.parametrize("name", ["a.zip", "b.rdb"])
def test_from_a_snapshot(snapshots, name):
    file = snapshots / name
    before = file.read_bytes()
    with up("--from", str(file)) as (process, said):
        assert f"snapshot  {file}\n" in said
        assert port_in(said) != 6379
        with reem.RedisInterface(f"redis://127.0.0.1:{port_in(said)}", namespace="r1:") as interface:
            kvs = reem.KeyValueStore(interface)
            assert kvs["foo"]["x"].read().tolist() == [0, 1, 2]
            kvs["foo"] = "changed"
        process.terminate()
        assert process.wait(10) == 0
    assert file.read_bytes() == before


@pytest.mark.parametrize("missing", ["typer", "rich"])
def test_without_the_extra(missing):
    code = f"import sys; sys.modules['{missing}'] = None; from reem_async.tools.cli import main; main()"
    run = python(code, flags=())
    assert run.returncode == 1
    assert "pip install 'reem-async[server]'" in run.stderr


@pytest.mark.long
@pytest.mark.parametrize("options", [["--plain", "--port", "0"], ["--cluster"], ["--cluster", "--plain"]], ids=" ".join)
def test_servers_of_other_kinds_until_told_to_stop(options):
    with up(*options) as (process, said):
        if "--cluster" in options:
            url = re.search(r"address +(redis\+cluster://\S+)\n", said)[1]
            assert said.count("process ") == 6
        else:
            url = f"redis://localhost:{port_in(said)}"
            assert "documents stored as text: the server has no JSON module" in said
            with redis.Redis(port=port_in(said)) as client:
                assert b"ReJSON" not in [module[b"name"] for module in client.module_list()]
        with reem.RedisInterface(url) as interface:
            store = reem.KeyValueStore(interface)
            for name in "abcd":
                store[name] = {"x": 1, "l": [1]}
                store[name]["x"] = name
            assert [store[name].read() for name in "abcd"] == [{"x": name, "l": [1]} for name in "abcd"]
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=10)
        assert (process.returncode, errors) == (0, "")
        assert "Stopped." in rest


# --- `reem browse`, run as a user runs it


@contextlib.contextmanager
def browsing(*words):
    with running("browse", "--port", "0", "--no-open", *words) as process:
        yield process, said_until(process, "  to stop")


def address_in(said):
    return re.search(r"http://\S+", said)[0]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_shows_a_server_until_it_is_stopped(server_url, kvs, key, number):
    kvs[key()] = {"x": 5}
    with browsing("--url", server_url) as (process, said):
        address = address_in(said)
        assert address.startswith("http://127.0.0.1:")
        assert "token" not in said
        with httpx.stream("GET", f"{address}api/events", timeout=PATIENCE, trust_env=False) as events:
            assert events.status_code == 200  # an open page must not hold up the end
            answer = httpx.get(f"{address}api/node", params={"path": f"{key()}.x"}, timeout=PATIENCE, trust_env=False)
            assert answer.json()["text"] == "5"
            assert os.getpriority(os.PRIO_PROCESS, process.pid) == 19  # the robot's programs come first
            refused = httpx.post(f"{address}api/write", json={}, timeout=PATIENCE, trust_env=False)
            assert "--allow-write" in refused.json()["error"]
            process.send_signal(number)
            assert process.wait(PATIENCE) == 0
        assert process.stderr.read() == ""


def test_beyond_this_machine_there_is_a_token(server_url):
    with browsing("--url", server_url, "--host", "0.0.0.0") as (_, said):
        token = re.search(r"\?token=([\w-]{20,})\n", said)[1]
        port = re.search(r":(\d+)/", address_in(said))[1]
        local = f"http://127.0.0.1:{port}/"
        assert not re.search(r"//(localhost|127\.)", address_in(said)) or not other_addresses(), "of no use elsewhere"
        with httpx.Client(timeout=PATIENCE, trust_env=False, follow_redirects=True) as client:
            assert client.get(local).status_code == 403
            assert client.get(local, params={"token": token}).status_code == 200
            assert client.get(f"{local}api/tree").status_code == 200
            assert client.get(local, headers={"host": "evil.example"}).status_code == 421


def test_the_options_write_and_namespace(server_url, interface, key):
    import reem

    with reem.RedisInterface(server_url, namespace=f"{key.prefix}:") as spaced:
        reem.KeyValueStore(spaced)["only"] = 1
        arguments = ("--url", server_url, "--namespace", f"{key.prefix}:", "--allow-write")
        with browsing(*arguments) as (_, said):
            assert "reading and writing" in said
            answer = httpx.get(f"{address_in(said)}api/tree?open=10:0:", timeout=PATIENCE, trust_env=False)
            assert [node["label"] for node in answer.json()["branches"][0]["nodes"]] == ["only"]


@pytest.mark.parametrize(
    ("words", "variables", "code", "said"),
    [
        (["up", "--port", "{taken}"], {}, 1, "port {taken}.*reem up --port 0"),
        (["up", "--port", "0"], {"REEM_PASSWORD": ""}, 1, "environment variable"),
        (["up", "--cluster", "--port", "0"], {}, 1, "--cluster takes no other option"),
        (["browse", "--no-open", "--log", "{file}", "--allow-write"], {}, 2, "a recording is not changed"),
        (["browse", "--no-open", "--url", "{url}", "--port", "{taken}"], {}, 1, "use another --host or --port"),
    ],
    ids=lambda it: " ".join(it) if isinstance(it, list) else "",
)
def test_what_cannot_be_begun_says_why(tmp_path, server_url, words, variables, code, said):
    (tmp_path / "run.mcap").touch()
    with socket.create_server(("127.0.0.1", 0)) as other:
        names = {"taken": other.getsockname()[1], "file": tmp_path / "run.mcap", "url": server_url}
        run = finished(*(word.format(**names) for word in words), **variables)
    assert (run.returncode, run.stdout) == (code, "")
    assert re.search(said.format(**names), " ".join(run.stderr.split()))
