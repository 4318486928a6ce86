"""The clients of examples/clients do what docs/wire.md says, on both kinds of servers, and survive hostile bytes."""

import ast
import asyncio
import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import redis
from conftest import FRONTS, PATIENCE, ROOT, sized
from own_servers import HELLO
from test_hostile import HEADERS

from reem_async.server import EmbeddedServer

FOLDER = ROOT / "examples" / "clients"
MICROPYTHON = os.environ.get("REEM_TEST_MICROPYTHON") or shutil.which("micropython")
ALLOWED = {"json", "math", "os", "select", "socket", "struct", "sys", "time"}  # that MicroPython has as well


@pytest.fixture(scope="session")
def in_c(tmp_path_factory):
    """The client in C, with the compiler's checks of memory."""
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc")
    program = tmp_path_factory.mktemp("clients") / "reem"
    checks = ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    subprocess.run(["gcc", "-O1", *checks, "-o", program, FOLDER / "c" / "reem.c", "-lm"], check=True)
    return [str(program)]


LANGUAGES = ["c", "javascript", "micropython", "micropython-itself"]
PAIRS = [f"{language} {kind}" for language in LANGUAGES for kind in ("json", "plain")]


def pairs(*quick, of=PAIRS):
    """Clients and servers; those that are not `quick` wait for the long run."""
    return [it if it in quick else pytest.param(it, marks=pytest.mark.long) for it in of]


IN_C = pytest.mark.parametrize("pair", pairs("c json"), indirect=True)
ONLY_PLAIN = pytest.mark.parametrize("pair", pairs("c plain", of=PAIRS[1::2]), indirect=True)


@pytest.fixture(params=pairs("c json", "javascript plain", "micropython json"))
def pair(request):
    """A client and a kind of server."""
    return request.param.split()


@pytest.fixture
def client(request, pair):
    """The words that start a client."""
    name, _ = pair
    if name == "c":
        return request.getfixturevalue("in_c")
    if name == "javascript":
        if shutil.which("node") is None:
            pytest.skip("needs node")
        return ["node", str(FOLDER / "javascript" / "reem.mjs")]
    if name == "micropython":
        start = "import sys; sys.path.insert(0, sys.argv.pop(1)); import main"
        return [sys.executable, "-I", "-S", "-u", "-c", start, str(FOLDER / "micropython")]
    if MICROPYTHON is None:
        pytest.skip("needs micropython, on PATH or as REEM_TEST_MICROPYTHON")
    return [MICROPYTHON, str(FOLDER / "micropython" / "main.py")]


@pytest.fixture(scope="module")
def plain_url():
    with EmbeddedServer(json=False) as server:
        yield server.url


@pytest.fixture
def url(request, pair):
    """A server of the kind; with REEM_TEST_SERVER=plain the shared one is plain too."""
    if pair[1] == "plain":
        return request.getfixturevalue("plain_url")
    if (address := request.getfixturevalue("server_url")).startswith("redis+cluster:"):
        pytest.skip("the clients are for one server")
    return address


def run(client, *words):
    environment = os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}
    return subprocess.run(
        [*client, *map(str, words)], capture_output=True, text=True, timeout=PATIENCE, check=False, env=environment
    )


def result(client, *words):
    done = run(client, *words)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    return json.loads(done.stdout) if done.stdout else None


def refused(client, *words):
    """Return the one line with which a client refuses."""
    done = run(client, *words)
    assert refuses(done), (done.returncode, done.stdout[:200], done.stderr[:2000])
    return done.stderr


def refuses(done):
    return (done.returncode, done.stdout, done.stderr[:7], done.stderr.count("\n")) == (1, "", "error: ", 1)


def ends_with_an_error(done):
    """Whether a client that may have printed updates has ended with one line."""
    return (done.returncode, done.stderr[:7], done.stderr.count("\n")) == (1, "error: ", 1)


def keys_of(url, name):
    with contextlib.closing(redis.Redis.from_url(url, decode_responses=True)) as raw:
        return sorted(raw.scan_iter(f"{{{name}}}*", count=1000))


class Watch:
    """A client that watches, and its lines."""

    def __init__(self, client, url, name, count):
        command = [*client, url, "watch", name, str(count)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.process = subprocess.Popen(
            command, text=True, env=os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}, **pipes
        )
        self._timer = threading.Timer(PATIENCE, self.process.kill)
        self._timer.start()

    def next(self):
        line = self.process.stdout.readline()
        assert line, self.process.stderr.read()
        return json.loads(line)

    def close(self):
        self._timer.cancel()
        self.process.kill()
        self.process.communicate()


def as_shown(value):
    """What the clients print of a value."""
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.str, "shape": list(value.shape), "data": value.ravel().tolist()}
    if isinstance(value, dict):
        return {name: as_shown(each) for name, each in value.items()}
    return [as_shown(each) for each in value] if isinstance(value, list) else value


NESTED = {
    "deep": {"list": [1, {"grid": np.arange(6, dtype=np.int16).reshape(2, 3)}], "key with blanks": None},
    "text": '$ship of "fools"\n\\ ü 键 \U0001f600',
    "floats": [0.1 + 0.2, 5.6843418860808015e-13, -5e-324, 1.7976931348623157e308, -0.0, 1e22, 123456789.0],
    "ints": [2**63 - 1, -(2**63), 2**53 + 1, 0],
    "q": np.array([0.1, -1e300, 5e-324]),
    "empty": np.zeros((0, 3), np.float32),
    "scalar": np.array(2.5, ">f8"),
    "mask": np.array([True, False]),
    "bytes": np.arange(250, 256, dtype=np.uint8),
    "wide": np.array([2**64 - 1, 2**53 + 1], np.uint64),
}


def test_a_client_reads_what_is_stored(client, url, key):
    front = FRONTS["blocking"](url)
    with contextlib.closing(front):
        front.kvs[key()] = NESTED
        assert result(client, url, "get", key()) == as_shown(NESTED)
        assert result(client, url, "get", key() + ".deep.list.1.grid") == as_shown(NESTED["deep"]["list"][1]["grid"])
        assert result(client, url, "get", key() + ".text") == NESTED["text"]
        assert "nothing is stored at" in refused(client, url, "get", key() + ".deep.list.7")
        front.kvs[key()] = {"photo": b"abc", "number": 1}
        assert "cannot read a value of the kind" in refused(client, url, "get", key())
        assert result(client, url, "get", key() + ".number") == 1


@pytest.mark.parametrize("name", FRONTS)
def test_what_a_client_publishes_arrives(client, url, key, name):
    """With a value and an array in place of another array, of which nothing is left."""
    words = ["speed=0.25", "long=0.30000000000000004", "small=-5e-324", "count=7", 'text=$ship ü"\\', "q=0.5,-1,1e300"]
    expected = {"speed": 0.25, "long": 0.1 + 0.2, "small": -5e-324, "count": 7, "text": '$ship ü"\\'}
    with contextlib.closing(FRONTS[name](url)) as front:
        front.write([key()], {"old": np.zeros(2)})
        loop = front.at([key()]).watch()
        front.take(loop)
        assert result(client, url, "publish", key(), *words) is None
        (update,) = front.take(loop)
        assert not update.gap
        assert update.data["q"].tobytes() == np.array([0.5, -1, 1e300]).tobytes()
        assert {name: each for name, each in update.data.items() if name != "q"} == expected
        stored = front.read([key()])
        assert stored["q"].dtype == np.float64
        assert [type(stored[name]) for name in expected] == [type(each) for each in expected.values()]
        front.wait(loop.close())
        assert keys_of(url, key()) == [f"{{{key()}}}.q", f"{{{key()}}}:last", f"{{{key()}}}:ships"]
        # A large one is only announced; then plain again.
        big = [f"q{number}={','.join(['1'] * 100)}" for number in range(30)]  # MicroPython takes words of 255 bytes
        result(client, url, "publish", key(), *big)
        assert [each.tolist() for each in front.read([key()]).values()] == [[1.0] * 100] * 30
        result(client, url, "publish", key(), "n=1")
        assert front.read([key()]) == {"n": 1}
        assert keys_of(url, key()) == [f"{{{key()}}}:last"]


@IN_C
def test_a_client_writes_over_nothing_but_what_is_its_own(client, url, key):
    """A key of another program, an owned one, and what is no number of JSON are refused, and nothing changes."""
    with contextlib.closing(FRONTS["blocking"](url)) as front:
        server = front.interface.client
        server.set(key("foreign"), "text of another program")
        server.rpush(key("list"), "a")
        for name in ("foreign", "list"):
            assert "a key of another program" in refused(client, url, "publish", key(name), "n=1")
        assert (server.get(key("foreign")), server.lrange(key("list"), 0, -1)) == ("text of another program", ["a"])
        with front.at([key()]).own(ttl=5, name="joystick") as own:
            own.write({"n": 1})
            assert "owned by another program" in refused(client, url, "publish", key(), "n=2")
        assert front.read([key()]) == {"n": 1}
        for word in ("n=1e999", "noname", "=1", "a.b=1"):
            refused(client, url, "publish", key(), word)
        assert front.read([key()]) == {"n": 1}


@pytest.mark.parametrize("name", FRONTS)
def test_a_client_follows_updates_and_notices_gaps(client, url, key, name):
    space = FRONTS[name](url, "PublishSpace", local="off")
    with contextlib.closing(space), contextlib.closing(Watch(client, url, key(), 100)) as watch:
        assert watch.next() == {"kind": "read", "lost": 0, "path": [], "value": None}
        q = np.array([0.5, 1.5])
        space.write([key()], {"speed": 0.1 + 0.2, "q": q})
        value = {"speed": 0.1 + 0.2, "q": as_shown(q)}
        assert watch.next() == {"kind": "set", "lost": 0, "path": [], "value": value}
        space.write([key(), "speed"], 1)
        assert watch.next() == {"kind": "set", "lost": 0, "path": ["speed"], "value": 1}
        space.write([key(), "q"], np.zeros(3000))
        large = {"speed": 1, "q": as_shown(np.zeros(3000))}
        assert watch.next() == {"kind": "read", "lost": 0, "path": [], "value": large}
        space.delete([key(), "q"])
        assert watch.next() == {"kind": "delete", "lost": 0, "path": ["q"], "value": None}
        # An update of which the notice is lost, and then the next one of the same publisher.
        with contextlib.closing(redis.Redis.from_url(url, decode_responses=True)) as raw:
            publisher, number = raw.get(f"{{{key()}}}:last").split()
            late = json.dumps([1, publisher, int(number) + 3, time.time(), ["speed"], "set", 1, []])
            raw.publish(f"{{{key()}}}:notices", f"{late}\n2")
            assert watch.next() == {"kind": "read", "lost": 2, "path": [], "value": {"speed": 1}}
            # The last update of all: only the note tells of it.
            raw.set(f"{{{key()}}}:last", f"{publisher} {int(number) + 9}")
            assert watch.next() == {"kind": "read", "lost": None, "path": [], "value": {"speed": 1}}


@IN_C
def test_a_burst_arrives_in_order_and_whole(client, url, key):
    """Each update once, or in what was read after it, whatever kinds are mixed."""
    with contextlib.closing(FRONTS["blocking"](url, "PublishSpace", local="off")) as space:
        space.write([key()], {"n": -1})
        with contextlib.closing(Watch(client, url, key(), 1000)) as watch:
            assert watch.next()["value"] == {"n": -1}
            count = sized(60, 1000)
            for number in range(count):
                big = np.full(3000, float(number)) if number % 7 == 3 else np.full(2, float(number))
                space.write([key()], {"n": number, "q": big})
            seen = -1
            while seen < count - 1:
                line = watch.next()
                assert line["lost"] == 0
                now = line["value"]
                assert set(now["q"]["data"]) == {float(now["n"])}
                assert now["n"] == seen + 1 if line["kind"] == "set" else now["n"] > seen
                seen = now["n"]


@pytest.mark.parametrize("name", FRONTS)
def test_a_client_calls_a_service(client, url, key, name):
    def plan(goal, start, name="", large=False):
        if goal < 0:
            raise ValueError(f'"{goal}" is too far')
        return {"path": start * goal, "name": name, "large": np.zeros(9000) if large else 0.1 + 0.2}

    with contextlib.closing(FRONTS[name](url)) as front:

        def meanwhile(function, *words):
            call = lambda: function(client, url, "call", *words)  # noqa: E731
            return call() if name == "blocking" else front.run(asyncio.to_thread(call))

        place = key() + ".arms.0"
        assert "no program serves this" in meanwhile(refused, place)

        async def serve():
            return front.at([key(), "arms", 0]).serve(plan)

        service = front.run(serve()) if name == "asyncio" else front.at([key(), "arms", 0]).serve(plan)
        front.wait(service.listen())
        answer = meanwhile(result, place, "goal=2", "start=0.5,1", "name=$ship ü")
        assert answer == {"path": as_shown(np.array([1.0, 2.0])), "name": "$ship ü", "large": 0.1 + 0.2}
        assert "is too far" in meanwhile(refused, place, "goal=-1", "start=0,1")
        assert "start" in meanwhile(refused, place, "goal=1")
        assert "over 64 KB" in meanwhile(refused, place, "goal=1", "start=0,1", "large=1")
        front.wait(service.close())
        assert "no program serves this" in meanwhile(refused, place, "goal=2", "start=0,1")


@pytest.mark.long
@ONLY_PLAIN
def test_writers_and_readers_at_once_leave_whole_values(client, url, key):
    """A client and Python replace a key with ever other arrays; no reader sees values of two, and no array is left."""
    end, seen = time.monotonic() + 5, []

    def publish(number):
        names = "abc"[: number % 4]
        assert (
            run(client, url, "publish", key(), f"n={number}", *(f"{it}={number},{number}" for it in names)).returncode
            == 0
        )

    def write():
        with contextlib.closing(FRONTS["blocking"](url, "PublishSpace")) as space:
            for number in range(10_000):
                space.write([key()], {"n": -number} | {it: np.full(2, -number) for it in "abc"[: number % 4]})
                time.sleep(0.005)
                if time.monotonic() > end:
                    return

    def fits(value):
        return all(set(each["data"]) == {value["n"]} for it, each in value.items() if it != "n")

    with contextlib.closing(FRONTS["blocking"](url)) as front, ThreadPoolExecutor(2) as threads:
        front.write([key()], {"n": 0})
        works = [threads.submit(write), threads.submit(lambda: [publish(number) for number in range(1, 9)])]
        while not all(work.done() for work in works):
            seen += [as_shown(front.read([key()])), result(client, url, "get", key())]
        for work in works:
            work.result()
        assert all(map(fits, seen))
        assert len({value["n"] for value in seen}) > 5
        left = {f"{{{key()}}}.{it}" for it in front.read([key()]) if it != "n"}
    assert set(keys_of(url, key())) - {f"{{{key()}}}:last", f"{{{key()}}}:ships"} == left


# --- hostile bytes


def stored(raw, name, blob, text=b'{"a":"$ship numpy .a 8 float64[1]"}'):
    raw.set(f"{{{name}}}.a", blob)
    raw.set(name, b" " + text)


WHOLE = HEADERS["a size of True"].replace(b"(True,)", b"(1,)   ")
BLOBS = [
    *HEADERS.values(),
    b"",
    b"abc",
    b"\x93NUMPY",
    b"\x93NUMPY\x01\x00",
    b"\x93NUMPY\x01\x00\xff\xff",
    *(WHOLE[:size] for size in range(8, len(WHOLE), 17)),
    WHOLE + b"x",
]
TEXTS = [
    b'{"a":"$ship numpy"}',
    b'{"a":"$ship numpy .a 8","b":"$ship numpy .a 8"}',
    b'{"a":"$ship "}',
    b"[" * 200_000,
    b'{"a":"$ship float inf"}',
    b'{"a":"$ship float"}',
    b'{"a":"$ship zip .a 8"}',
    b'{"a"',
    b'{"a":"$ship numpy .a',
    b"\xff\xfe",
    b"",
    b'{"a":"$ship numpy .b 8"}',
]


@ONLY_PLAIN
def test_bytes_that_are_no_value_are_an_error_and_no_crash(client, plain_url, key):
    with contextlib.closing(redis.Redis.from_url(plain_url)) as raw:
        for number, blob in enumerate(sized(BLOBS[::4], BLOBS)):
            stored(raw, key(f"blob{number}"), blob)
            done = run(client, plain_url, "get", key(f"blob{number}"))
            assert (done.returncode == 0 and json.loads(done.stdout)) or refuses(done), (blob, done)
        for number, text in enumerate(sized(TEXTS[::2], TEXTS)):
            stored(raw, key(f"text{number}"), WHOLE, text)
            refused(client, plain_url, "get", key(f"text{number}"))


@contextlib.contextmanager
def server_that_says(reply, greeting=HELLO + b"+none\r\n"):
    """A server that sends what answers two commands, then some bytes, and ends; its address."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            with contextlib.suppress(OSError):
                connection, _ = listener.accept()
                with connection:
                    connection.sendall(greeting + reply)
                    connection.shutdown(socket.SHUT_WR)
                    while connection.recv(65536):
                        pass

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"redis://127.0.0.1:{listener.getsockname()[1]}"
        thread.join(PATIENCE)


REPLIES = [
    b"",
    b"$",
    b"$5\r\nab",
    b"$5\r\nabcdefg\r\n",
    b"$-7\r\n",
    b"$99999999999999999999\r\n",
    b"*1000000000\r\n",
    b"\r\n",
    b"*1\r\n" * 100,
    b"?\r\n",
    b":x\r\n",
    b"x" * 100_000,
    b">0\r\n",
    b">3\r\n$7\r\nmessage\r\n_\r\n_\r\n",
    b"-ERR no\r\n",
    b"+OK\r\n",
    b"+OK\r\n$2\r\n[1",
    b"+OK\r\n:5\r\n:5\r\n:5\r\n",
    b"*2\r\n+a\r\n+b\r\n",
    b"%2\r\n+a\r\n",
    b"~1\r\n-ERR x\r\n",
    b"+OK\r\n$3\r\n[1]\r\n+OK\r\n*-1\r\n" * 3,
    b">2\r\n$9\r\nsubscribe\r\n$1\r\nx\r\n+x\r\n",
]


@ONLY_PLAIN
def test_truncated_and_hostile_replies_are_an_error_and_no_crash(client):
    for number, reply in enumerate(sized(REPLIES[::3], REPLIES)):
        for words in sized([("get", "watch", "publish", "call")[number % 4]], ["get", "watch", "publish", "call"]):
            with server_that_says(reply) as address:
                done = run(client, address, words, "foo", *(["n=1"] if words == "publish" else []))
                assert ends_with_an_error(done) if words == "watch" else refuses(done), (reply, words, done)


@IN_C
def test_a_client_refuses_servers_that_it_is_not_for(client):
    """A cluster has other channels; a user without rights is no sign of a plain server, whose documents are text."""
    for greeting, said in (
        (b"%1\r\n+mode\r\n+cluster\r\n+none\r\n", "not a single server"),
        (HELLO + b"-NOPERM this user may not run JSON.TYPE\r\n", "NOPERM"),
    ):
        with server_that_says(b"+OK\r\n+none\r\n_\r\n*0\r\n" + b"+OK\r\n" * 9, greeting) as address:
            assert said in refused(client, address, "publish", "foo", "n=1")
    error = refused(client, "redis://:secret@127.0.0.1:1/3", "get", "foo")  # another database, which it does not select
    assert "[:port]" in error or "database 0" in error
    assert "secret" not in error


LINES = [
    b"",
    b"[",
    b"[]",
    b"{}",
    b"null",
    b'[2,%p,5,0,[],"set",1,[]]\n1',
    b'[1,%p,0,0,[],"set",1,[]]',
    b"[1,%p]\n",
    b'[1,%p,5,0,[],"set",9,[]]\n1',
    b'[1,%p,5,0,[],"set",-1,[]]\n1',
    b'[1,%p,5,0,[],"set","x",[]]\n1',
    b'[1,%p,5,0,[],"set",1,[["numpy",".a",99]]]\n1',
    b'[1,%p,5,0,[],"set",1,[["numpy",".a",-1]]]\n1',
    b'[1,%p,5,0,[],"set",1,[[1]]]\n1',
    b'[1,%p,5,0,[],"set",3,[]]\n{"a',
    b'[1,5,5,0,[],"set",1,[]]\n1',
    b'[1,%p,5,0,[],"set",25,[["numpy",".a",3]]]\n"$ship numpy .a 1 uint8[1]"abc',
    b'[1,%p,"x",0,[],"set",1,[]]\n1',
    b'[1,%p,5,0,[],"other",1,[]]\n1',
    b"[1,%p,5,0,[],7,1,[]]\n1",
]


@ONLY_PLAIN
def test_a_notice_that_is_none_ends_a_watch_with_an_error(client, plain_url, key):
    with contextlib.closing(redis.Redis.from_url(plain_url)) as raw:
        for line in sized(LINES[::3], LINES):
            with contextlib.closing(Watch(client, plain_url, key(), 100)) as watch:
                watch.next()
                raw.publish(f"{{{key()}}}:notices", line.replace(b"%p", b'"stranger"'))
                out, error = watch.process.communicate(timeout=PATIENCE)
                assert (watch.process.returncode, out, error[:7], error.count("\n")) == (1, "", "error: ", 1), line


ANSWERS = [
    b"",
    b"[]",
    b'[2,"answer","%c","%s",0,[],"here",1,[]]\n1',
    b'[1,"answer","%c","%s",0,[],"here",9,[]]\n1',
    b'[1,"answer","%c","%s",0,[],"here",1,[["numpy",".a",99]]]\n1',
    b'[1,"pong","%c","%s",0,[],"",0,[]]\n',
    b'[1,"answer","%c","%s",0,[],["x",1,2,3,4,5,6],1,[]]\n',
    b'[1,"failed","%c","%s",0,[],"",0,[]]\n',
    b'[1,"answer","%c","%s",0,5,"here",6,[]]\n"$ship',
    b'[1,"answer","%c","%s",0,[],"stored",9,5]\n',
]


@ONLY_PLAIN
def test_an_answer_that_is_none_is_an_error(client, plain_url, key):
    server = "0123456789abcdef"
    with contextlib.closing(redis.Redis.from_url(plain_url)) as raw, contextlib.closing(raw.pubsub()) as requests:
        requests.subscribe(f"{{{key()}}}:serve@{server}")
        requests.get_message(timeout=PATIENCE)
        answers = iter(sized(ANSWERS[::2], ANSWERS))

        def answer(message):
            line = json.loads(message["data"].partition(b"\n")[0])
            # One for another call first, which is not for this one.
            for text in (b'[1,"answer","0000000000000000","%s",0,["",""],"here",1,[]]\n7', next(answers)):
                said = text.replace(b"%c", line[2].encode()).replace(b"%s", server.encode())
                raw.publish(f"{{{key()}}}:answers@{line[3]}", said)

        requests.subscribe(**{f"{{{key()}}}:serve@{server}": answer})
        thread = requests.run_in_thread(0.01, daemon=True)
        try:
            for _ in sized(ANSWERS[::2], ANSWERS):
                refused(client, plain_url, "call", key(), "n=1")
        finally:
            thread.stop()
            thread.join()


def test_the_client_for_micropython_imports_what_micropython_has():
    files = sorted((FOLDER / "micropython").glob("*.py"))
    own = {path.stem for path in files}
    imported = set()
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add(node.module)
    assert imported - own == ALLOWED
