"""`reem up` and `reem --version`, run as a user runs them."""

from __future__ import annotations

import contextlib
import os
import pathlib
import re
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
import redis
from redis.backoff import NoBackoff
from redis.retry import Retry

import reem
import reem.snapshots
from reem_async.server import EmbeddedServer

ROOT = pathlib.Path(__file__).parents[1]
REEM = [sys.executable, "-X", "dev", "-W", "error", "-c", "from reem_async.tools.cli import main; main()"]


def environment(**changes: str) -> dict[str, str]:
    clean = {name: value for name, value in os.environ.items() if name not in ("REEM_PASSWORD", "FORCE_COLOR")}
    return {**clean, "PYTHONPATH": str(ROOT), **changes}


def reem_command(*arguments: str, **changes: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*REEM, *arguments],
        env=environment(**changes),
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )


@contextlib.contextmanager
def up(*arguments: str, **changes: str):
    with subprocess.Popen(
        [*REEM, "up", *arguments],
        env=environment(**changes),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            lines = []
            while not lines or not lines[-1].startswith("  to stop"):
                lines.append(process.stdout.readline())
                assert lines[-1], process.stderr.read()
            yield process, "".join(lines)
        finally:
            process.kill()


def port_in(said: str) -> int:
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


STORM = """
import os, signal, threading
from reem_async.tools.cli.up import Stop

stop = Stop()
ended = threading.Event()

def send():
    while not ended.is_set():
        os.kill(os.getpid(), signal.SIGINT)

sender = threading.Thread(target=send)
sender.start()
assert all(stop.wait(1.0) for _ in range(20000))
ended.set()
sender.join()
print("done")
"""


def test_a_signal_may_come_at_any_moment():
    """Also while the main thread looks whether one has come, and while another is handled."""
    run = subprocess.run(
        [sys.executable, "-c", STORM], env=environment(), capture_output=True, text=True, timeout=30, check=False
    )
    assert (run.stdout, run.returncode) == ("done\n", 0), run.stderr


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


def test_the_data_is_kept(tmp_path):
    for expected in (None, b"v"):
        with up("--port", "0", "--directory", str(tmp_path)) as (process, said):
            with redis.Redis(port=port_in(said)) as client:
                assert client.get("k") == expected
                client.set("k", "v")
            process.terminate()
            assert process.wait(10) == 0


def test_port_taken():
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        run = reem_command("up", "--port", str(port))
    assert run.returncode == 1
    assert run.stdout == ""
    assert f"port {port}" in run.stderr
    assert "reem up --port 0" in run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.parametrize("name", ["REEM_PASSWORD", "MY_OWN"])
def test_password(name):
    option = [] if name == "REEM_PASSWORD" else ["--password-from-env", name]
    with up("--port", "0", *option, **{name: "secret-7d1f"}) as (process, said):
        assert "secret" not in said
        assert f'password=os.environ["{name}"]' in said
        with redis.Redis(port=port_in(said), password="secret-7d1f") as client:
            assert client.ping()
        once = Retry(NoBackoff(), 0)
        with redis.Redis(port=port_in(said), retry=once) as client, pytest.raises(redis.AuthenticationError):
            client.ping()
        shown = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
        assert "secret-7d1f" not in shown
        process.terminate()
        assert "secret" not in "".join(process.communicate(timeout=10))


@pytest.mark.parametrize(
    ("option", "changes"),
    [
        ([], {"REEM_PASSWORD": ""}),
        (["--password-from-env", "NO_SUCH"], {}),
        (["--password-from-env", "E"], {"E": ""}),
    ],
)
def test_a_password_that_is_not_there_is_no_open_server(option, changes):
    run = reem_command("up", "--port", "0", *option, **changes)
    assert run.returncode == 1
    assert "environment variable" in run.stderr


def test_a_server_that_ends_by_itself_is_an_error():
    with up("--port", "0") as (process, said):
        os.kill(int(re.search(r"process (\d+)", said)[1]), signal.SIGTERM)
        _, errors = process.communicate(timeout=10)
        assert process.returncode == 1
        assert "ended by itself" in errors
        assert "shutdown" in errors


def test_killed_with_9_it_takes_the_server_along():
    with up("--port", "0") as (process, said):
        path = pathlib.Path(re.search(r"unix://(\S+)", said)[1])
        server = int(re.search(r"process (\d+)", said)[1])
        process.kill()
        process.wait()
        for _ in range(200):
            if not path.parent.exists():
                break
            time.sleep(0.02)
        assert not path.parent.exists()
        with pytest.raises(ProcessLookupError):
            os.kill(server, 0)


def test_ctrl_c_in_a_terminal_and_colours():
    terminal = "import os, pty, sys; sys.exit(os.waitstatus_to_exitcode(pty.spawn(sys.argv[1:])))"
    with subprocess.Popen(
        [sys.executable, "-c", terminal, *REEM, "up", "--port", "0"],
        env=environment(TERM="xterm-256color"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        bufsize=0,
    ) as process:
        said, told = b"", False
        while data := process.stdout.read(4096):
            said += data
            if b"Ctrl-C" in said and not told:  # not in `data`: it may come in two parts
                told = bool(process.stdin.write(b"\x03"))
        assert process.wait(10) == 0
    assert b"\x1b[" in said
    assert b"Stopped." in said
    assert b"Traceback" not in said


@pytest.fixture
def snapshots(tmp_path):
    with EmbeddedServer() as server, reem.RedisInterface(server, namespace="r1:") as interface:
        reem.KeyValueStore(interface)["foo"] = {"x": np.arange(3), "n": 1.5}
        reem.snapshots.save(interface, tmp_path / "a.zip")
        reem.snapshots.save_rdb(interface, tmp_path / "b.rdb")
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize(("name", "what"), [("a.zip", "1 key"), ("b.rdb", "3 Redis keys")])
def test_from_a_snapshot(snapshots, name, what):
    file = snapshots / name
    before = file.read_bytes()
    with up("--from", str(file)) as (process, said):
        assert re.search(rf"snapshot  {re.escape(str(file))}, taken \d{{4}}-\d\d-\d\d \d\d:\d\d:\d\d, {what}", said)
        assert ("under the namespace r1:" in said) == (name == "a.zip")
        assert port_in(said) != 6379
        with reem.RedisInterface(f"redis://127.0.0.1:{port_in(said)}", namespace="r1:") as interface:
            kvs = reem.KeyValueStore(interface)
            assert kvs["foo"]["x"].read().tolist() == [0, 1, 2]
            kvs["foo"] = "changed"
        process.terminate()
        assert process.wait(10) == 0
    assert file.read_bytes() == before


@pytest.mark.long
def test_from_a_snapshot_into_a_directory(snapshots):
    """Once; from then on the directory has the data."""
    data = str(snapshots / "data")
    with up("--from", str(snapshots / "a.zip"), "--directory", data, "--port", "0") as (process, _):
        process.terminate()
        process.wait(10)
    run = reem_command("up", "--from", str(snapshots / "a.zip"), "--directory", data)
    assert run.returncode == 1
    assert "holds a server's data" in run.stderr
    with (
        up("--directory", data, "--port", "0") as (_, said),
        reem.RedisInterface(f"redis://127.0.0.1:{port_in(said)}", namespace="r1:") as interface,
    ):
        assert reem.KeyValueStore(interface)["foo"]["n"].read() == 1.5


@pytest.mark.long
def test_from_what_is_no_snapshot(snapshots):
    """Said, with an exit code, and no server is left."""
    whole = (snapshots / "a.zip").read_bytes()
    (snapshots / "cut.zip").write_bytes(whole[:-10])
    (snapshots / "cut.rdb").write_bytes((snapshots / "b.rdb").read_bytes()[:-60])
    (snapshots / "text.zip").write_text("text")
    for name, code, message in (
        ("cut.zip", 1, "damaged"),
        ("cut.rdb", 1, "did not start"),
        ("text.zip", 1, "neither a snapshot"),
        ("none.zip", 3, "none.zip"),
    ):
        run = reem_command("up", "--from", str(snapshots / name), COLUMNS="200")
        assert run.returncode == code
        assert message in run.stderr
        assert "Traceback" not in run.stderr


@pytest.mark.long
def test_version_and_help():
    run = reem_command("--version")
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout.startswith("reem")
    run = reem_command("--help")
    assert (run.returncode, run.stderr) == (0, "")
    assert "up" in run.stdout


@pytest.mark.parametrize("missing", ["typer", "rich"])
def test_without_the_extra(missing):
    code = f"import sys; sys.modules['{missing}'] = None; from reem_async.tools.cli import main; main()"
    run = subprocess.run(
        [sys.executable, "-c", code],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert run.returncode == 1
    assert "pip install 'reem-async[server]'" in run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.long
def test_a_plain_server_is_started_when_told():
    import reem

    with up("--plain", "--port", "0") as (process, said):
        port = port_in(said)
        assert "documents stored as text: the server has no JSON module" in said
        with redis.Redis(port=port) as client:
            assert b"ReJSON" not in [module[b"name"] for module in client.module_list()]
        with reem.RedisInterface(f"redis://localhost:{port}") as interface:
            store = reem.KeyValueStore(interface)
            store["a"] = {"x": 1, "l": [1]}
            store["a"]["x"] = 2
            assert store["a"].read() == {"x": 2, "l": [1]}
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=10)
        assert (process.returncode, errors) == (0, "")
        assert "Stopped." in rest


@pytest.mark.long
@pytest.mark.parametrize("options", [["--cluster"], ["--cluster", "--plain"]], ids=" ".join)
def test_a_cluster_until_told_to_stop(options):
    import reem

    with up(*options) as (process, said):
        url = re.search(r"address +(redis\+cluster://\S+)\n", said)[1]
        assert said.count("process ") == 6
        with reem.RedisInterface(url) as interface:
            store = reem.KeyValueStore(interface)
            for name in ("a", "b", "c", "d"):
                store[name] = {"x": name}
            assert [store[name]["x"].read() for name in ("a", "b", "c", "d")] == ["a", "b", "c", "d"]
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=10)
        assert (process.returncode, errors) == (0, "")
        assert "Stopped." in rest


@pytest.mark.long
def test_a_cluster_takes_no_other_option():
    run = reem_command("up", "--cluster", "--port", "0")
    assert run.returncode == 1
    assert "--cluster takes no other option" in run.stderr
