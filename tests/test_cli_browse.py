"""`reem browse`, run as a user runs it."""

import contextlib
import re
import signal
import socket

import httpx
import pytest
from clikit import finished, running, said_until
from conftest import PATIENCE
from own_servers import other_addresses


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


def test_a_recording_cannot_be_written(tmp_path):
    (tmp_path / "run.mcap").touch()
    done = finished("browse", "--log", str(tmp_path / "run.mcap"), "--allow-write", "--no-open")
    assert done.returncode == 2
    assert "a recording is not changed" in done.stderr


def test_the_options_write_and_namespace(server_url, interface, key):
    import reem

    with reem.RedisInterface(server_url, namespace=f"{key.prefix}:") as spaced:
        reem.KeyValueStore(spaced)["only"] = 1
        arguments = ("--url", server_url, "--namespace", f"{key.prefix}:", "--allow-write")
        with browsing(*arguments) as (_, said):
            assert "reading and writing" in said
            answer = httpx.get(f"{address_in(said)}api/tree?open=10:0:", timeout=PATIENCE, trust_env=False)
            assert [node["label"] for node in answer.json()["branches"][0]["nodes"]] == ["only"]


def test_a_port_that_is_taken_is_said_in_one_line(server_url):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        done = finished("browse", "--url", server_url, "--no-open", "--port", str(taken.getsockname()[1]))
    assert done.returncode == 1
    assert "use another --host or --port" in done.stderr
