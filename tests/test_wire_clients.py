"""The clients of examples/clients do what docs/wire.md says, with both fronts, and survive hostile bytes."""

import ast
import asyncio
import contextlib
import io
import json
import os
import shutil
import socket
import subprocess
import sys
import threading

import numpy as np
import pytest
import redis
from conftest import FRONTS, PATIENCE, PLAIN, ROOT, sized
from test_hostile import HEADERS

from reem_async.server import EmbeddedServer

FOLDER = ROOT / "examples" / "clients"
MICROPYTHON = os.environ.get("REEM_TEST_MICROPYTHON") or shutil.which("micropython")
ALLOWED = {"json", "os", "select", "socket", "struct", "sys", "time"}  # that MicroPython has as well


@pytest.fixture(scope="session")
def in_c(tmp_path_factory):
    """The client in C, with the compiler's checks of memory."""
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc")
    program = tmp_path_factory.mktemp("clients") / "reem"
    checks = ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    subprocess.run(["gcc", "-O1", *checks, "-o", program, FOLDER / "c" / "reem.c"], check=True)
    return [str(program)]


LANGUAGES = ["c", "javascript", "micropython", pytest.param("micropython-itself", marks=pytest.mark.long)]
C_AND_LONG = [LANGUAGES[0], *(pytest.param(it, marks=pytest.mark.long) for it in LANGUAGES[1:3]), LANGUAGES[3]]
IN_C = pytest.mark.parametrize("client", C_AND_LONG, indirect=True)  # the others wait for the long run


@pytest.fixture(params=LANGUAGES)
def client(request):
    """The words that start a client."""
    name = request.param
    if name == "c":
        return request.getfixturevalue("in_c")
    if name == "javascript":
        if shutil.which("node") is None:
            pytest.skip("needs node")
        return ["node", str(FOLDER / "javascript" / "reem.mjs")]
    if name == "micropython":
        return [sys.executable, "-I", "-S", "-u", str(FOLDER / "micropython" / "reem.py")]
    if MICROPYTHON is None:
        pytest.skip("needs micropython, on PATH or as REEM_TEST_MICROPYTHON")
    return [MICROPYTHON, str(FOLDER / "micropython" / "reem.py")]


@pytest.fixture
def url(server_url):
    if PLAIN or server_url.startswith("redis+cluster:"):
        pytest.skip("the clients are for one server with the JSON module")
    return server_url


def run(client, *words):
    environment = os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}  # a command leaves that to its end
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
    return done.stdout == "" and ends_with_an_error(done)


def ends_with_an_error(done):
    """Whether a client that may have printed updates has ended with one line."""
    return (done.returncode, done.stderr.count("\n")) == (1, 1) and done.stderr.startswith(("error: ", "reem: "))


class Watch:
    """A client that watches, and its lines."""

    def __init__(self, client, url, place, count=100):
        command = [*client, url, "watch", place, str(count)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.process = subprocess.Popen(
            command, text=True, env=os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}, **pipes
        )
        self._timer = threading.Timer(PATIENCE, self.process.kill)
        self._timer.start()

    def next(self):
        """Return the number of the last update, and the value."""
        line = self.process.stdout.readline()
        assert line, self.process.stderr.read()
        found = json.loads(line)
        return int((found["update"] or "").partition(" ")[2] or 0), found["value"]

    def close(self):
        self._timer.cancel()
        self.process.kill()
        self.process.communicate()


def as_shown(array):
    """What the clients print of an array."""
    return {"dtype": array.dtype.str, "shape": list(array.shape), "data": array.tolist()}


PLAIN_JSON = {
    "list": [1, {"n": None, "yes": True}],
    "text": 'of "fools"\n\\ ü 键 \U0001f600',
    "floats": [0.1 + 0.2, 1e22, 123456789.0, -0.0],
    "ints": [2**63 - 1, -(2**63), 2**53 + 1, 0],
}
ARRAYS = {"q": np.array([0.1, -1e300, 5e-324]), "none": np.zeros(0), "lists": [0, {"deep": np.array([0.1 + 0.2])}]}
OTHERS = {
    "kind": np.arange(3),
    "order": np.arange(3, dtype=">f8"),
    "matrix": np.eye(2),
    "scalar": np.array(0.5),
    "bytes": b"abc",
    "mark": "$ship of fools",
}
WRONG = ["foo..q", "foo.*", "", "foo[0:2]", ".q", "foo.a b", 'foo["q"]', "foo[a", "foo{}", "foo\nq"]


def test_a_client_reads_what_is_stored(client, url, key):
    with contextlib.closing(FRONTS["blocking"](url)) as front:
        front.kvs[key()] = PLAIN_JSON
        assert result(client, url, "get", key()) == PLAIN_JSON
        assert result(client, url, "get", f"{key()}.list[1].yes") is True
        assert refused(client, url, "get", f"{key()}.list[7]")
        assert "nothing is stored at" in refused(client, url, "get", key("other"))
        front.kvs[key()] = PLAIN_JSON | ARRAYS | OTHERS
        assert result(client, url, "get", f"{key()}.text") == PLAIN_JSON["text"]
        assert result(client, url, "get", f"{key()}.q") == as_shown(ARRAYS["q"])
        assert result(client, url, "get", f"{key()}.none") == as_shown(ARRAYS["none"])
        assert result(client, url, "get", f"{key()}.lists[1].deep") == as_shown(ARRAYS["lists"][1]["deep"])
        for place in sized(list(OTHERS)[::3], ["", "lists", *OTHERS]):
            refused(client, url, "get", f"{key()}.{place}".rstrip("."))
        for place in sized(WRONG[::3], WRONG):
            refused(client, url, "get", place.replace("foo", key()))


@pytest.mark.parametrize("name", FRONTS)
def test_what_a_client_publishes_arrives(client, url, key, name):
    document = {"speed": 0.25, "digits": 123456789.012345, "count": 7, "text": 'ü "\\', "list": [[], {"n": None}]}
    with contextlib.closing(FRONTS[name](url)) as front:
        front.write([key()], {"old": 1})
        loop = front.at([key()]).watch()
        front.take(loop)
        assert result(client, url, "publish", key(), json.dumps(document)) is None
        (update,) = front.take(loop)
        assert (update.gap, update.data) == (False, document)
        assert front.read([key()]) == document
        front.wait(loop.close())
        with contextlib.closing(redis.Redis.from_url(url, decode_responses=True)) as raw:
            assert sorted(raw.scan_iter(f"{{{key()}}}*", count=1000)) == [f"{{{key()}}}:last"]
            assert 50 < raw.ttl(f"{{{key()}}}:last") <= 60


@IN_C
def test_a_client_writes_over_nothing_but_what_is_its_own(client, url, key):
    """A key of another program, an owned one, one with arrays, and no JSON are refused, and nothing changes."""
    with contextlib.closing(FRONTS["blocking"](url)) as front:
        server = front.interface.client
        server.set(key("foreign"), "text of another program")
        server.rpush(key("list"), "a")
        for name in ("foreign", "list"):
            refused(client, url, "publish", key(name), '{"n":1}')
        assert (server.get(key("foreign")), server.lrange(key("list"), 0, -1)) == ("text of another program", ["a"])
        with front.at([key()]).own(ttl=5, name="joystick") as own:
            own.write({"n": 1})
            assert "owned by another program" in refused(client, url, "publish", key(), '{"n":2}')
        for words in ("", "{", '{"n":NaN}', '{"n":0.12345678901234567}', '{"n":[1E30]}', '{"n":"$ship numpy .n 8 x"}'):
            refused(client, url, "publish", key(), words)
        refused(client, url, "publish", key() + ".n", "2")
        refused(client, url, "delete", key(), "2")
        assert front.read([key()]) == {"n": 1}
        front.write([key()], {"q": np.zeros(1)})
        assert "has arrays" in refused(client, url, "publish", key(), '{"n":2}')
        assert front.read([key()])["q"].tolist() == [0]


@pytest.mark.parametrize("name", FRONTS)
def test_a_client_follows_updates_and_notices_gaps(client, url, key, name):
    space = FRONTS[name](url, "PublishSpace", local="off")
    places = [f"{key()}.q", key("n")]
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.closing(space))
        array, number = (stack.enter_context(contextlib.closing(Watch(client, url, place))) for place in places)
        raw = stack.enter_context(contextlib.closing(redis.Redis.from_url(url, decode_responses=True)))
        assert (array.next(), number.next()) == ((0, None), (0, None))
        for step, size in enumerate((2, 3000), 1):
            space.write([key()], {"q": np.full(size, step / 2)})
            assert array.next() == (step, as_shown(np.full(size, step / 2)))
        space.delete([key()])
        assert array.next() == (3, None)
        space.write([key("n")], {"n": 0.1 + 0.2})
        assert number.next() == (1, {"n": 0.1 + 0.2})
        # Two updates of which the notices are lost, and a notice that is none.
        raw.set(f"{{{key('n')}}}:last", raw.get(f"{{{key('n')}}}:last").split()[0] + " 3")
        assert number.next() == (3, {"n": 0.1 + 0.2})
        raw.publish(f"{{{key('n')}}}:notices", "[" * 100_000)
        raw.delete(f"{{{key('n')}}}:last")  # it expires after a minute
        space.write([key("n")], {"n": 2})
        assert number.next() == (2, {"n": 2})
        raw.json().set(key("n"), "$", {"n": 3})  # without a notice: the client in C prints published updates only
        assert len(client) == 1 or number.next() == (2, {"n": 3})


@IN_C
def test_the_values_of_a_burst_belong_to_their_updates(client, url, key):
    """Some may be skipped, and the last one is not: value, array and number are of one instant."""
    space = FRONTS["blocking"](url, "PublishSpace", local="off")
    with contextlib.closing(space), contextlib.closing(Watch(client, url, f"{key()}.q", 100_000)) as watch:
        assert watch.next() == (0, None)
        count, seen = sized(60, 1000), [0]
        for number in range(1, count + 1):
            space.write([key()], {"q": np.full(3000 if number % 7 == 3 else 2, float(number))})
        while seen[-1] < count:
            number, value = watch.next()
            assert set(value["data"]) == {float(number)}
            seen.append(number)
        assert seen == sorted(set(seen))


@pytest.mark.parametrize("name", FRONTS)
def test_a_client_calls_a_service(client, url, key, name):
    def plan(goal, name="", large=False):
        if goal < 0:
            raise ValueError(f'"{goal}" is too far')
        if large:
            return "x" * 100_000
        return {"path": [goal, 0.1 + 0.2], "name": name} if goal else np.zeros(2)

    with contextlib.closing(FRONTS[name](url)) as front:

        def meanwhile(function, words="{}"):
            call = lambda: function(client, url, "call", place, words)  # noqa: E731
            return call() if name == "blocking" else front.run(asyncio.to_thread(call))

        place = key() + ".plan"
        assert "no program serves" in meanwhile(refused)

        async def serve():
            return front.at([key(), "plan"]).serve(plan)

        service = front.run(serve()) if name == "asyncio" else front.at([key(), "plan"]).serve(plan)
        front.wait(service.listen())
        assert meanwhile(result, '{"goal": 2, "name": "ü"}') == {"path": [2, 0.1 + 0.2], "name": "ü"}
        assert "is too far" in meanwhile(refused, '{"goal": -1}')
        assert "goal" in meanwhile(refused)
        meanwhile(refused, '{"goal": 0}')
        meanwhile(refused, '{"goal": 1, "large": true}')
        front.wait(service.close())
        assert "no program serves" in meanwhile(refused)


@IN_C
@pytest.mark.skipif(PLAIN, reason="there is no server with JSON")
def test_a_client_ends_with_an_error_if_it_has_no_server(client):
    """The server stops during a watch; is not there; has no JSON module."""
    with EmbeddedServer() as server:
        watch = Watch(client, url := server.url, "foo")
        assert watch.next() == (0, None)
    out, error = watch.process.communicate(timeout=PATIENCE)
    watch.close()
    assert (watch.process.returncode, out, error.count("\n")) == (1, "", 1), error
    refused(client, url, "get", "foo")
    refused(client, "redis://127.0.0.1:1/3", "get", "foo")  # another database, which it does not select
    with EmbeddedServer(json=False) as server:
        for words in (["get", "foo"], ["publish", "foo", "1"], ["watch", "foo"]):
            assert "unknown command" in refused(client, server.url, *words)


# --- hostile bytes

np.save(SAVED := io.BytesIO(), np.ones(1))
WHOLE = HEADERS["a size of True"].replace(b"(True,)", b"(1,)   ")
FLOATS = WHOLE[:10] + WHOLE[10:-1].replace(b"'|u1'", b"'<f8'")
BLOBS = [
    *HEADERS.values(),
    b"",
    b"abc",
    b"\x93NUMPY",
    b"\x93NUMPY\x01\x00",
    b"\x93NUMPY\x01\x00\xff\xff",
    *(FLOATS[:size] for size in range(8, len(FLOATS), 17)),
    FLOATS,
    FLOATS.replace(b"(1,)", b"(-1,)"),
    FLOATS.replace(b"(1,) ", b"(99999999999999999999,)") + b"x" * 8,
    WHOLE + b"x",
    SAVED.getvalue()[:-1],
    SAVED.getvalue() + b"x",
]
PLACEHOLDERS = [
    "$ship",
    "$ship ",
    "$ship numpy",
    "$ship numpy .a",
    "$ship numpy .b 8",
    "$ship zip .a 8",
    "$ship float inf",
]


@IN_C
def test_bytes_that_are_no_value_are_an_error_and_no_crash(client, url, key):
    with contextlib.closing(redis.Redis.from_url(url)) as raw:
        raw.json().set(key(), "$", {"a": "$ship numpy .a 8 float64[1]"})
        for blob in sized([*BLOBS[::5], *BLOBS[-2:]], BLOBS):
            raw.set(f"{{{key()}}}.a", blob)
            refused(client, url, "get", key() + ".a")
        for text in PLACEHOLDERS[1:]:
            raw.json().set(key(), "$", {"a": text})
            refused(client, url, "get", key() + ".a")
        raw.json().set(key(), "$", {"a": PLACEHOLDERS[0]})
        assert result(client, url, "get", key()) == {"a": PLACEHOLDERS[0]}


@contextlib.contextmanager
def server_that_says(reply):
    """A server that sends some bytes to each connection, and ends it; its address."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            with contextlib.suppress(OSError):
                connection, _ = listener.accept()
                threading.Thread(target=serve, daemon=True).start()
                with connection:
                    connection.sendall(reply)
                    connection.shutdown(socket.SHUT_WR)
                    while connection.recv(65536):
                        pass

        threading.Thread(target=serve, daemon=True).start()
        yield f"redis://127.0.0.1:{listener.getsockname()[1]}"
        listener.shutdown(socket.SHUT_RDWR)


CONFIRMED = b"*3\r\n$9\r\nsubscribe\r\n$3\r\n{f}\r\n:1\r\n"
READ = b"+OK\r\n+QUEUED\r\n+QUEUED\r\n+QUEUED\r\n"
REPLIES = [
    b"",
    b"$",
    b"$5\r\nab",
    b"\r\n",
    b"?\r\n",
    b"x" * 100_000,
    b"-ERR no\r\n",
    b"*1\r\n" * 100,
    b"*1000000000\r\n",
    b"~1\r\n-ERR x\r\n",
    READ,
    READ + b"*-1\r\n",
    READ + b"*1\r\n$-1\r\n",
    READ + b"*3\r\n$5\r\nabcdefg\r\n",
    READ + b"*3\r\n$-7\r\n",
    READ + b"*3\r\n$99999999999999999999\r\n",
    READ + b"*3\r\n$\r\n\r\n$\r\n\r\n$\r\n\r\n",
    READ + b'*3\r\n$13\r\n"$ship numpy \r\n$12\r\n\x93NUMPY\x01\x00\xff\xffxx\r\n$-1\r\n',
    CONFIRMED,
    CONFIRMED + b"*3\r\n$7\r\nmessage\r\n$3\r\n{f}\r\n$-1\r\n",
    b"%1\r\n+mode\r\n+x\r\n" + READ + b"*3\r\n_\r\n_\r\n",
    b"%1\r\n+mode\r\n+x\r\n>0\r\n",
    b"%1\r\n+mode\r\n+x\r\n>3\r\n$7\r\nmessage\r\n_\r\n_\r\n" * 9,
]


@IN_C
def test_truncated_and_hostile_replies_are_an_error_and_no_crash(client):
    actions = {"get": [], "watch": [], "publish": ["1"], "call": ["{}"]}
    for number, reply in enumerate(sized(REPLIES[::2], REPLIES)):
        with server_that_says(reply) as address:
            for action in sized([list(actions)[number % 4]], actions):
                done = run(client, address, action, "foo", *actions[action])
                assert ends_with_an_error(done), (reply, action, done)


ANSWERS = [
    b"",
    b"\n",
    b"[]",
    b"[]\n",
    b"{}\n1",
    b'[2,"answer","%c","%s",0,["",""],"here",1,[]]\n1',
    b'[1,"answer","0000000000000000","%s",0,["",""],"here",1,[]]\n1',
    b'[1,"answer","%c","0000000000000000",0,["",""],"here",1,[]]\n1',
    b'[1,"answer","%c","%s",0,["",""],"here",9,[]]\n1',
    b'[1,"answer","%c","%s",0,["",""],"here",-1,[]]\n1',
    b'[1,"answer","%c","%s",0,["",""],"here",1,[["numpy",".a",99]]]\n1abc',
    b'[1,"answer","%c","%s",0,["",""],["x",1,2,3,4,5,6],1,[]]\n',
    b'[1,"answer","%c","%s",0,["",""],"stored",9,[]]\n',
    b'[1,"answer","%c","%s",0,5,"here",1,[]]\n',
    b'[1,"answer","%c","%s",0,["",""],"here",14,[]]\n"$ship text a"',
    b'[1,"answer","%c","%s",0,["",""],"here',
    b'[1,"pong","%c","%s",0,[],"",0,[]]\n',
    b'[1,"busy","%c","%s",0,[],"",0,[]]\n',
    b'[1,"failed","%c","%s",0,[],"",0,[]]\n',
]


@IN_C
def test_an_answer_that_is_none_is_an_error(client, url, key):
    server = "0123456789abcdef"
    with contextlib.closing(redis.Redis.from_url(url)) as raw, contextlib.closing(raw.pubsub()) as requests:
        requests.subscribe(f"{{{key()}}}:serve@{server}")
        requests.get_message(timeout=PATIENCE)
        answers = iter(sized(ANSWERS[::2], ANSWERS))

        def answer(message):
            line = json.loads(message["data"].partition(b"\n")[0])
            said = next(answers).replace(b"%c", line[2].encode()).replace(b"%s", server.encode())
            raw.publish(f"{{{key()}}}:answers@{line[3]}", said)

        requests.subscribe(**{f"{{{key()}}}:serve@{server}": answer})
        thread = requests.run_in_thread(0.01, daemon=True)
        try:
            for _ in sized(ANSWERS[::2], ANSWERS):
                refused(client, url, "call", key(), "{}")
        finally:
            thread.stop()
            thread.join()


def test_the_client_for_micropython_imports_what_micropython_has():
    tree = ast.parse((FOLDER / "micropython" / "reem.py").read_text(encoding="utf-8"))
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    assert {alias.name for node in found for alias in node.names} == ALLOWED
