"""What the browser answers, over a real port and from a real server."""

# ruff: noqa: F811 - fixtures are named as arguments
import asyncio
import io
import socket
import time

import numpy as np
import orjson
import pytest
from browserkit import address, ask, client_of, live, served  # noqa: F401 - fixtures
from conftest import eventually, python, repeated, sized
from PIL import Image

import reem
from reem_async.server import EmbeddedServer
from reem_async.tools.browser import listen

IMAGE = np.random.default_rng(1).integers(0, 256, (40, 60, 3), np.uint8)


@pytest.fixture
def robot(kvs, key):
    name = key("robot")
    kvs[name] = {
        "n": 1,
        "f": 0.1 + 0.2,
        "big": 2**60 + 1,
        "s": "hello",
        "b": True,
        "none": None,
        "q": [1, 2.5, 3],
        "nested": [{"a": 1}, {"a": 2}],
        "image": IMAGE,
        "depth": np.array([[0.5, np.nan], [2.0, 3.0]], np.float32),
        "raw": b"\x00\x01\xff",
        "a.b": {"c d": 5},
    }
    return name


# --- looking -------------------------------------------------


def test_the_tree_has_types_sizes_and_values(ask, robot):
    eventually(lambda: ask.rows(robot)["nested"]["size"])  # the sizes of dicts come from what has been read
    rows = ask.rows(robot)
    said = {label: (row["kind"], row["text"], row["size"], row["count"]) for label, row in rows.items()}
    assert said == {
        "n": ("int", "1", 8, None),
        "f": ("float", "0.30000000000000004", 8, None),
        "big": ("int", str(2**60 + 1), 8, None),
        "s": ("str", '"hello"', 5, None),
        "b": ("bool", "true", 8, None),
        "none": ("NoneType", "null", 8, None),
        "q": ("list", "[1, 2.5, 3]", 24, 3),
        "nested": ("list", "", 16, 2),
        "image": ("numpy", "uint8[40,60,3]", 7200, None),
        "depth": ("numpy", "float32[2,2]", 16, None),
        "raw": ("bytes", "bytes", 3, None),
        '["a.b"]': ("dict", "", 8, 1),
    }
    assert ask.rows(rows['["a.b"]']["address"])["c d"]["text"] == "5"
    assert ask.rows(rows["nested"]["address"])["[1]"]["address"] == f"{robot}.nested[1]"
    eventually(lambda: robot in ask.rows())


def test_long_branches_come_in_pages(ask, kvs, key):
    kvs[key()] = {f"k{number:04}": number for number in range(1500)}
    (branch,) = ask.json("tree", open=f"100:1450:{key()}")["branches"]
    assert (branch["total"], branch["start"], len(branch["nodes"])) == (1500, 1450, 50)
    assert branch["nodes"][0]["label"] == "k1450"
    (branch,) = ask.json("tree", open=f"999999:0:{key()}")["branches"]
    assert len(branch["nodes"]) == 1000


def test_long_texts_are_not_fetched_for_the_tree_but_for_the_view(ask, kvs, key):
    kvs[key()] = {"t": "x" * 100_000}
    assert ask.rows(key())["t"]["text"] == "100000 bytes of text"
    assert ask.json("node", path=f"{key()}.t")["full"] == "x" * 100_000


def test_the_snippets_of_a_path_are_programs_that_read_it(ask, robot, kvs, key):
    kvs[key()] = {"d": {"a\\b": [5, 6]}}
    for path, said in ((f'{robot}["a.b"]["c d"]', "5"), (f'{key()}.d["a\\\\b"][1]', "6")):
        for front, code in ask.json("node", path=path)["snippets"].items():
            done = python(code + "print(value)")
            assert (done.returncode, done.stdout.strip()) == (0, said), (front, done.stderr)


def test_arrays_as_pictures_tables_lines_and_histograms(ask, robot):
    about = ask.json("array", path=f"{robot}.image")
    assert (about["dtype"], about["shape"], about["view"]) == ("uint8", [40, 60, 3], "image")
    answer = ask.ask("image", path=f"{robot}.image")
    assert answer.headers["content-type"] == "image/png"
    with Image.open(io.BytesIO(answer.content)) as image:
        assert (np.asarray(image) == IMAGE).all()
    said = orjson.loads(ask.ask("image", path=f"{robot}.depth", map="viridis").headers["x-picture"])
    statistics = {"low": "0.5", "high": "3", "mean": "1.8333333333333333", "bad": 1, "sampled": False}
    about = {"late": 0.0, "age": None, "preview": False, "statistics": statistics}
    assert said == {"low": 0.5, "high": 3.0, "bad": 1, "size": [2, 2], **about}
    page = ask.json("table", path=f"{robot}.image", slice=":,:,1", row=39, column=58)
    assert page["cells"] == [[str(value) for value in IMAGE[39, 58:, 1]]]
    assert ask.json("line", path=f"{robot}.image", slice="3,:,0")["lines"] == [IMAGE[3, :, 0].tolist()]
    assert sum(ask.json("histogram", path=f"{robot}.image")["counts"]) == IMAGE.size
    assert ask.json("array", path=f"{robot}.q")["shape"] == [3]


@pytest.mark.parametrize(
    ("what", "values", "status"),
    [
        ("image", {"path": "{}.q"}, 400),
        ("image", {"path": "{}.image", "slice": "0,0,9"}, 400),
        ("image", {"path": "{}.image", "map": "nope"}, 400),
        ("image", {"path": "{}.image", "low": "nan"}, 400),
        ("table", {"path": "{}.image"}, 400),
        ("table", {"path": "{}.n"}, 400),
        ("table", {"path": "{}.missing"}, 404),
        ("node", {"path": "{}..x"}, 400),
        ("node", {"path": "../../etc/passwd"}, 400),
        ("node", {"path": "x" * 5000}, 400),
        ("node", {"path": "{}", "at": "later"}, 400),
        ("tree", {"open": "many:0:"}, 400),
        ("picture", {"path": "{}.raw"}, 400),
        ("nothing", {}, 404),
        *(
            (what, {}, 400)
            for what in ("series", "json", "array", "image", "table", "line", "histogram", "bytes", "picture")
        ),
    ],
)
def test_what_cannot_be_shown_is_an_error_that_says_so(ask, robot, what, values, status):
    answer = ask.ask(what, **{name: value.format(robot) for name, value in values.items()})
    assert answer.status_code == status
    assert status == 404 or len(answer.json()["error"]) > 10


def test_what_is_not_there_is_told_to_a_page_that_waits_for_it(ask, robot):
    """It is no error: the browser's console stays empty."""
    for what in ("node", "array"):
        assert "nothing is stored" in ask.json(what, path=f"{robot}.missing")["missing"]


def test_what_the_server_refuses_does_not_look_as_if_it_were_away(ask, raw, key):
    name = key("foreign")
    raw.set(name, "of another program")
    for _ in range(2):  # the page may not have the key the first time
        answer = ask.ask("image", path=name)
        assert (answer.status_code, answer.json()["error"]) == (400, f"{name} is of type str, not an array")


def test_what_is_edited_is_read_as_json(ask, robot, kvs, key):
    kvs[key()] = {"n": 1, "s": "ä"}
    assert ask.ask("json", path=key()).json() == {"n": 1, "s": "ä"}
    for path in (robot, f"{robot}.image", f"{robot}.raw"):
        answer = ask.ask("json", path=path)
        assert (answer.status_code, "holds arrays" in answer.json()["error"]) == (400, True), path


def test_bytes_that_are_a_picture_are_shown_as_one(ask, kvs, key):
    file = io.BytesIO()
    Image.fromarray(IMAGE).save(file, "PNG")
    kvs[key()] = {"png": file.getvalue(), "html": b"<script>alert(1)</script>"}
    answer = ask.ask("picture", path=f"{key()}.png")
    assert (answer.headers["content-type"], answer.content) == ("image/png", file.getvalue())
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert ask.ask("picture", path=f"{key()}.html").status_code == 400
    assert ask.json("bytes", path=f"{key()}.html")["rows"][0][2] == "<script>alert(1)"


def test_search_finds_keys_and_what_is_below(ask, robot, key):
    eventually(
        lambda: f"{robot}.nested[0].a" in [row["address"] for row in ask.json("search", q=f"{key.prefix}")["found"]]
    )
    found = [row["address"] for row in ask.json("search", q=f"{robot}.NES".upper())["found"]]
    assert found == [
        f"{robot}.nested",
        f"{robot}.nested[0]",
        f"{robot}.nested[0].a",
        f"{robot}.nested[1]",
        f"{robot}.nested[1].a",
    ]
    found = [row["address"] for row in ask.json("search", q=f"{robot}.nested[1]")["found"]]
    assert found == [f"{robot}.nested[1]", f"{robot}.nested[1].a"]
    assert ask.json("search", q="no such thing")["found"] == []
    assert ask.json("search", q="")["found"] == []


# --- time -------------------------------------------------


def test_the_past_is_as_it_was(ask, pspace, key):
    name = key("arm")
    before = time.time()
    pspace[name] = {"q": [0.0, 0.0], "mode": "idle"}
    eventually(lambda: ask.json("tree", open="10:0:")["end"] > before and name in ask.rows())
    times = []
    for step in range(1, 6):
        pspace[name]["q"] = [float(step), 0.5]
        eventually(lambda step=step: ask.json("series", path=f"{name}.q")["lines"][0][-1:] == [float(step)])
        times.append(ask.json("tree", open="1:0:")["end"])
    pspace[name]["mode"] = "run"
    eventually(lambda: ask.rows(name)["mode"]["text"] == '"run"')
    for step, at in enumerate(times, 1):
        assert ask.rows(name, at=at)["q"]["text"] == f"[{step}, 0.5]"
        assert ask.rows(name, at=at)["mode"]["text"] == '"idle"'
    marks = ask.rows(name, at=times[2], since=times[1])
    assert (marks["q"]["mark"], marks["mode"]["mark"]) == ("changed", "")
    assert ask.rows(at=times[2], since=times[1])[name]["mark"] == "inside"
    assert name not in ask.rows(at=before - 0.001)
    assert "missing" in ask.json("node", path=name, at=before - 0.001)
    assert sum(ask.json("activity", bins=50, path=name)["counts"]) == 7
    del pspace[name]
    eventually(lambda: name not in ask.rows())
    assert ask.rows(name, at=times[0])["mode"]["text"] == '"idle"'
    assert name in ask.rows(at=times[0])


def test_what_is_only_stored_in_a_key_that_is_published_all_the_time_is_noticed(ask, pspace, kvs, key):
    def mode(at):
        return ask.json("node", path=f"{key()}.mode", at=at).get("text")

    def writes():
        return sum(ask.json("activity", path=f"{key()}.mode")["counts"])

    def was_running(at):
        time.sleep(0.2)  # what was published since makes it the past
        return mode(at) == '"run"'

    pspace[key()] = {"x": 0, "mode": "idle", "items": [0] * 5, "image": np.zeros((300, 300), np.uint8)}
    eventually(lambda: mode(time.time()) == '"idle"')

    def publish(number):
        pspace[key()]["x"] = number
        pspace[key()]["items"].append(number)
        del pspace[key()]["items"][0]
        if number % 5 == 0:
            pspace[key()]["image"] = np.full((300, 300), number % 255, np.uint8)

    with repeated(publish, 0.01):
        time.sleep(0.5)  # what comes now is of a key that has been published for a while
        before = writes()
        time.sleep(sized(1.2, 2.5))
        assert writes() == before, "what was published looks like something stored by others"
        earlier = time.time()
        kvs[key()]["mode"] = "run"
        eventually(lambda: writes() > before)
        eventually(lambda: was_running(time.time()))  # since the document has arrays it is read once more
        assert mode(earlier) == '"idle"'
    assert writes() == before + 1
    items = [str(item) for item in kvs[key()]["items"].read()]

    def shown():  # an append is only announced, so the page has it once it has read the list
        return [node["text"] for node in ask.rows(f"{key()}.items", at=time.time()).values()]

    eventually(lambda: shown() == items)


def content(ask, name, at):
    answer = ask.ask("json", path=name, at=at)
    return answer.json() if answer.status_code == 200 else None


def test_events_name_what_changed_and_are_few(ask, pspace, key):
    pspace[key()] = {"x": 0}
    with ask.http.stream("GET", "/api/events") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        lines = stream.iter_lines()
        next(lines)
        with repeated(lambda number: pspace[key()]["x"].write(number)):
            said, began = [], time.monotonic()
            while len(said) < 5:
                line = next(lines)
                if line.startswith("data: ") and f"{key()}.x" in orjson.loads(line[6:])["paths"]:
                    said.append(time.monotonic() - began)
    assert said[4] - said[0] > 0.3, "more than ten a second"


def test_arrays_are_read_less_often_while_no_page_is_open(server_url):
    with served(live(server_url)) as (address, source), client_of(address) as ask:
        arrays = source._follower.arrays
        alone = arrays.rate
        with ask.http.stream("GET", "/api/events"):
            eventually(lambda: arrays.rate == 8 * alone)
        eventually(lambda: arrays.rate == alone)


def test_a_server_that_goes_away_is_said_and_so_is_its_return(tmp_path):
    with EmbeddedServer(directory=tmp_path / "data") as server:
        port = server.port
        with reem.RedisInterface(f"redis://127.0.0.1:{port}") as interface:
            reem.KeyValueStore(interface)["a"] = 1
            reem.KeyValueStore(interface)["d"] = {"fixed": [1, 2]}
        with served(live(f"redis://127.0.0.1:{port}")) as (address, _), client_of(address) as ask:
            assert ask.rows()["a"]["text"] == "1"
            eventually(lambda: ask.rows("d", at=time.time())["fixed"]["text"] == "[1, 2]")
            at = time.time()
            server.stop()
            eventually(lambda: "no server answers" in ask.json("tree")["lost"])
            assert ask.rows(at=at)["a"]["text"] == "1", "the past is known without the server"
            assert ask.rows("d", at=at)["fixed"]["text"] == "[1, 2]"
            assert content(ask, "d", at) == {"fixed": [1, 2]}
            assert ask.ask("node", path="a").status_code == 503
            with EmbeddedServer(port, tmp_path / "data"):
                eventually(lambda: ask.json("tree")["lost"] == "")
                assert ask.rows()["a"]["text"] == "1"


# --- size -------------------------------------------------


async def test_answers_are_sent_at_once():
    """Nagle's algorithm held each answer back until the browser acknowledged its headers, 40 ms later."""
    loop = asyncio.get_running_loop()
    accepted = loop.create_future()

    async def answer(reader, writer):
        accepted.set_result(writer.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
        writer.close()

    listening = listen("127.0.0.1", 0)
    async with await asyncio.start_server(answer, sock=listening):
        _, writer = await asyncio.open_connection(*listening.getsockname())
        assert await accepted
        writer.close()
        await writer.wait_closed()
