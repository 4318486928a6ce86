"""The command line on a real server: what a command does, and the installed `reem` where a process matters.

Starting Python and importing everything takes half a second, so most calls are made in this process.
"""

import importlib
import json
import signal
import socket

import numpy as np
import pytest
from clikit import CommandLine, finished, invoked
from conftest import assert_same, nothing_sent, python

import reem as blocking
from reem_async.server import EmbeddedServer
from reem_async.tools.cli import commands
from reem_async.tools.cli.commands import COMMANDS


@pytest.fixture
def kvs(cli):
    with blocking.RedisInterface(cli.url, namespace=cli.namespace) as interface:
        store = blocking.KeyValueStore(interface)
        store["foo"] = {
            "number": 1,
            "image": np.arange(24, dtype=np.uint8).reshape(2, 4, 3),
            "names": ["left", "right"],
            "deep": {"tiles": [{"a": np.arange(3.0)}, None]},
        }
        store["cam_left"] = np.linspace(0.0, 1.0, 2000).reshape(40, 50)
        store["cam_right"] = b"\x00\xff"
        store["a.b"] = {"x y": True}
        store["evil"] = "\x1b[31mred\x9b32m\nline"
        yield store


SNAPSHOT = [["snapshot", command] for command in ("save", "list", "restore")]
PARAM = [["param", command] for command in ("list", "get", "set", "save", "load")]

# --- the whole -------------------------------------------------


def test_help_has_every_command_under_its_heading():
    """The lines of the table are those of the docstrings, so `reem --help` and `reem NAME --help` agree."""
    run = finished("--help", COLUMNS="100")
    for entry in COMMANDS:
        assert entry.panel in run.stdout
        assert f" {entry.name} " in run.stdout
        thing = getattr(importlib.import_module(entry.full_module), entry.attribute)
        if entry.module not in ("up", "snapshot", "param", "record", "play", "log", "browse"):
            said = commands.help_text(thing.__doc__)
            assert said.split("\n\n")[0].startswith(entry.help.removesuffix(".")[:30])
    assert "--install-completion" in run.stdout
    assert "\x1b" not in run.stdout


def test_help_needs_none_of_the_commands():
    """A heavy import in one of them slows down only that one."""
    code = "import sys; sys.argv = ['reem', '--help']\nfrom reem_async.tools.cli import main\n"
    code += "try: main()\nexcept SystemExit: "
    code += "print([name for name in sys.modules if name.startswith('reem_async.tools.cli')])"
    run = python(code)
    loaded = run.stdout.splitlines()[-1]
    light = ["", ".commands"]
    assert loaded == str([f"reem_async.tools.cli{name}" for name in light])


@pytest.mark.parametrize(
    "words",
    [*[[entry.name] for entry in COMMANDS if entry.attribute != "app"], *SNAPSHOT, *PARAM],
    ids=" ".join,
)
def test_help_of_each_command_has_examples(words):
    run = invoked(*words, "--help", COLUMNS="100")
    assert run.returncode == 0
    assert "Examples:" in run.stdout
    assert f"reem {' '.join(words)}" in run.stdout.partition("Examples:")[2]


def test_version():
    assert invoked("--version").stdout.startswith("reem")


def test_paragraphs_are_joined_and_indented_lines_are_kept():
    said = commands.help_text(
        "One\n    two.\n\n    Three\n    four.\n\n    Examples:\n        reem ls\n        reem tree\n    "
    )
    assert said == "One two.\n\nThree four.\n\n[bold]Examples:[/bold]\n    reem ls\n    reem tree"


def test_wrong_usage(cli):
    assert "No such option" in cli.error(2, "get", "foo", "--ouput", "x")
    assert "Missing argument" in cli.error(2, "get")
    assert "write it like foo.bar[0]" in cli.error(2, "get", "foo..x")
    assert "'foo[' is not a path, at character 3" in cli.error(2, "get", "foo[")
    assert "'.foo[' is not a path, at character 4" in cli.error(2, "get", ".foo[")
    assert "redis://" in cli.error(2, "ls", "--url", "http://nowhere")


@pytest.mark.parametrize(
    "words",
    [["ls"], ["snapshot", "save", "a.zip"], ["browse", "--no-open", "--port", "0"], ["record", "-o", "a.mcap"]],
    ids=" ".join,
)
def test_no_server_is_one_line_that_names_the_remedy_and_no_password(tmp_path, words):
    run = finished(*words, cwd=tmp_path, REEM_URL="redis://:hidden-4711@127.0.0.1:1")
    assert (run.returncode, run.stdout, run.stderr.count("\n")) == (1, "", 1)
    assert run.stderr.startswith(f"reem {words[0]}")
    for part in ("no server answers at 127.0.0.1:1", "reem up", "--url or REEM_URL"):
        assert part in run.stderr
    assert "hidden" not in run.stderr
    assert not list(tmp_path.iterdir())


def test_a_refused_login_is_one_line_without_the_password(cli):
    said = cli.error(1, "ls", "--url", cli.url.replace("//", "//nobody:hidden-4711@"))
    assert "refused this user name and password" in said
    assert "hidden" not in said


FILES = [
    *[["log", "info"], ["log", "export"], ["play"], ["browse", "--no-open", "--log"]],
    *[["snapshot", "restore"], ["snapshot", "list"], ["up", "--from"]],
]


@pytest.mark.parametrize("words", FILES, ids=" ".join)
def test_a_file_that_is_not_there_or_is_none_is_named(cli, tmp_path, words):
    file = tmp_path / "run.file"
    for code in (3, 1):
        run = invoked(*words, file, REEM_URL=cli.url, COLUMNS="300")
        assert (run.returncode, file.name in run.stderr) == (code, True), run.stderr
        file.write_bytes(b"something else")
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.long
def test_the_password_may_be_in_a_variable_of_its_own():
    with EmbeddedServer(password="known-4711") as server:
        cli = CommandLine(f"redis://127.0.0.1:{server.port}", "")
        assert "needs a password" in cli.error(1, "ls")
        for wrong in ("wrong-0815", "wrong 0815"):
            assert "refused this user name and password" in cli.error(1, "ls", REEM_PASSWORD=wrong)
        cli.result("set", "speed", "0.5", REEM_PASSWORD="known-4711")
        assert cli.result("get", "speed", REEM_PASSWORD="known-4711") == "0.5\n"
        assert cli.process("doctor", REEM_PASSWORD="known-4711").returncode == 0
        cli.url = f"redis://:known-4711@127.0.0.1:{server.port}"
        assert cli.result("get", "speed", REEM_PASSWORD="wrong-0815") == "0.5\n"


def test_a_warning_is_one_line_that_says_how_to_silence_it(cli):
    cli.url = "redis://robot.invalid:6379"
    warning, error = cli.process("ls", PYTHONWARNINGS="").stderr.splitlines()
    assert warning.startswith("reem ls: warning: the connection to robot.invalid:6379 is not encrypted")
    silent = warning.rpartition("silence this: ")[2].rpartition("PYTHONWARNINGS=")[2]
    assert cli.process("ls", PYTHONWARNINGS=silent).stderr.splitlines() == [error]


@pytest.mark.long
def test_completion_of_paths(cli, kvs):
    def completed(*words, **changes):
        typed = ["reem", "get", "--namespace", cli.namespace, *words]
        changes = {"_REEM_COMPLETE": "complete_bash", "COMP_WORDS": " ".join(typed), "COMP_CWORD": "4", **changes}
        run = finished(**{"REEM_URL": cli.url, **changes})
        assert run.stderr == ""
        return run.stdout.split()

    assert completed("cam") == ["cam_left", "cam_right"]
    assert completed("foo.na") == ["foo.names"]
    assert completed("foo.de") == ["foo.deep", "foo.deep."]  # a dict: no blank behind it, its keys may follow
    assert completed("fo") == ["foo", "foo."]
    assert completed("foo.nix.") == []
    assert completed("cam", REEM_URL="redis://127.0.0.1:1") == []


# --- ls, tree -------------------------------------------------


def test_ls(cli, kvs):
    rows = [line.split("\t") for line in cli.result("ls").splitlines()]
    assert rows == [
        ['["a.b"]', "dict", "1 key", "8 B"],
        ["cam_left", "numpy", "float64[40,50]", "16.0 kB"],
        ["cam_right", "bytes", "bytes", "2 B"],
        ["evil", "str", r'"\u001b[31mred\u009b32m\nline"', "18 B"],
        ["foo", "dict", "4 keys", "73 B"],
    ]
    assert [line.split("\t")[0] for line in cli.result("ls", "cam_*").splitlines()] == ["cam_left", "cam_right"]
    below = [json.loads(line) for line in cli.result("ls", "foo.*", "--json").splitlines()]
    assert [entry["path"] for entry in below] == ["foo.number", "foo.image", "foo.names", "foo.deep"]
    assert below[0] == {"path": "foo.number", "type": "int", "size": 8, "value": 1}
    assert below[1] == {"path": "foo.image", "type": "numpy", "size": 24, "summary": "uint8[2,4,3]"}
    assert "no key nix_*" in cli.error(3, "ls", "nix_*")
    assert "nothing is stored at nix" in cli.error(3, "ls", "nix")


def test_ls_of_what_others_wrote(cli, kvs, raw):
    raw.execute_command("JSON.SET", f"{cli.namespace}broken", "$", '"$ship nonsense"')
    raw.lpush(f"{cli.namespace}foreign", "x")
    names = {line.split("\t")[0]: line.split("\t")[1] for line in cli.result("ls").splitlines()}
    assert names["broken"] == "?"
    assert names["foo"] == "dict"
    assert "foreign" not in names


def test_tree(cli, kvs):
    assert cli.result("tree", "foo").splitlines() == [
        "foo  4 keys  73 B",
        "├── number  1",
        "├── image  uint8[2,4,3]  24 B",
        '├── names  ["left", "right"]  2 items  9 B',
        "└── deep  1 key  32 B",
        "    └── tiles  2 items  32 B",
        "        ├── [0]  1 key  24 B",
        "        │   └── a  float64[3]  24 B",
        "        └── [1]  null",
    ]
    assert cli.result("tree", "foo.deep.tiles[-2]").startswith("foo.deep.tiles[0]  1 key  24 B\n")
    (line,) = cli.result("tree", "foo.deep.tiles[0]", "--json").splitlines()
    array = {"path": "foo.deep.tiles[0].a", "type": "numpy", "size": 24, "summary": "float64[3]"}
    assert json.loads(line) == {
        "path": "foo.deep.tiles[0]",
        "type": "dict",
        "size": 24,
        "length": 1,
        "children": [array],
    }


def test_tree_is_cut_and_fetches_no_array(cli, kvs, raw):
    kvs["many"] = {f"k{number}": {} for number in range(60)}
    raw.set("{" + cli.namespace + "cam_left}", "not an array any more")
    lines = cli.result("tree", "*").splitlines()
    assert "cam_left  float64[40,50]  16.0 kB" in lines
    assert lines[-1] == "└── … 10 more (--all)"
    assert cli.result("tree", "many", "--all").count("\n") == 61


# --- get -------------------------------------------------


def test_get_for_people(cli, kvs):
    assert cli.result("get", "foo.number") == "1\n"
    assert json.loads(cli.result("get", "foo"))["image"] == "<uint8[2,4,3], 24 B>"
    lines = cli.result("get", "cam_left").splitlines()
    assert lines[0] == "float64[40,50], 16.0 kB, min 0.0, max 1.0, mean 0.5"
    assert "..." in lines[4]
    assert cli.result("get", "cam_right") == "2 bytes\nb'\\x00\\xff'\n"
    assert cli.result("get", "evil") == '"\\u001b[31mred\\u009b32m\\nline"\n'
    assert cli.result("get", "evil", "--raw") == "\x1b[31mred\x9b32m\nline\n"
    shown, code = cli.in_terminal("get", "evil", "--raw")
    assert (shown, code) == ("\\u001b[31mred\\u009b32m\r\nline\r\n", 0)


def test_get_for_programs(cli, kvs, tmp_path):
    assert json.loads(cli.result("get", "foo", "--json")) == {
        "number": 1,
        "image": np.arange(24).reshape(2, 4, 3).tolist(),
        "names": ["left", "right"],
        "deep": {"tiles": [{"a": [0.0, 1.0, 2.0]}, None]},
    }
    assert cli.result("get", "cam_right", "--json") == '"AP8="\n'
    for options in ((), ("--json",), ("--raw",), ("-o", tmp_path / "nix.json")):
        for path in ("nix", "nix.x", "foo.nix"):
            assert f"nothing is stored at {path}" in cli.error(3, "get", path, *options)
    assert not (tmp_path / "nix.json").exists()


def test_get_into_files(cli, kvs, tmp_path):
    from PIL import Image

    def got(path, name):
        run = cli("get", path, "-o", tmp_path / name)
        assert (run.returncode, run.stdout) == (0, ""), run.stderr
        assert str(tmp_path / name) in run.stderr
        return tmp_path / name

    assert_same(np.load(got("foo.deep.tiles[0].a", "a.npy")), np.arange(3.0))
    with np.load(got("foo", "foo.npz")) as arrays:
        assert sorted(arrays) == ["deep.tiles[0].a", "image"]
        assert_same(arrays["image"], np.arange(24, dtype=np.uint8).reshape(2, 4, 3))
    assert json.loads(got("foo", "foo.json").read_text())["deep"] == {"tiles": [{"a": [0.0, 1.0, 2.0]}, None]}
    with Image.open(got("foo.image", "foo.png")) as picture:
        assert_same(np.asarray(picture), np.arange(24, dtype=np.uint8).reshape(2, 4, 3))
    assert got("cam_right", "x.bin").read_bytes() == b"\x00\xff"


def test_files_that_cannot_be_written_leave_nothing_behind(cli, kvs, tmp_path):
    (tmp_path / "old.npy").write_text("old")
    assert "give its path, or use .npz" in cli.error(1, "get", "foo", "-o", tmp_path / "old.npy", "--force")
    assert "replace it with overwrite=True or --force" in cli.error(2, "get", "foo", "-o", tmp_path / "old.npy")
    assert "png takes uint8" in cli.error(1, "get", "cam_left", "-o", tmp_path / "x.png")
    assert "No such file or directory" in cli.error(1, "get", "foo", "-o", tmp_path / "no" / "x.json")
    assert ".npy, .npz, .json" in cli.error(2, "get", "foo", "-o", tmp_path / "x.doc")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("old.npy", "old")]


# --- set, del, pub -------------------------------------------------


def test_set(cli, kvs, tmp_path):
    np.save(tmp_path / "map.npy", np.eye(3))
    (tmp_path / "config.json").write_text('{"gain": 0.1}')
    for value, expected, options in (
        ("-1.5", -1.5, {}),
        ('{"a": [1, null, "x"]}', {"a": [1, None, "x"]}, {}),
        ("18446744073709551615", 2**64 - 1, {}),
        (f"@{tmp_path / 'map.npy'}", np.eye(3), {}),
        (f"@{tmp_path / 'config.json'}", {"gain": 0.1}, {}),
        ("-", [1, 2], {"input": "[1, 2]\n"}),
    ):
        assert cli.result("set", "foo.new", value, **options) == ""
        assert_same(kvs["foo"]["new"].read(), expected)
    cli.result("set", "--str", "foo.names[-1]", "@home")
    assert kvs["foo"]["names"].read() == ["left", "@home"]


def test_what_cannot_be_set_is_refused_before_anything_is_sent(cli, kvs, raw, tmp_path):
    (tmp_path / "x.npy").write_bytes(b"\x93NUMPY nonsense")
    with nothing_sent(raw):
        assert "for text add --str" in cli.error(2, "set", "foo.new", "hello")
        assert "NaN" in cli.error(2, "set", "foo.new", "[NaN]")
        assert "no option --pubslish" in cli.error(2, "set", "foo.new", "--pubslish")
        assert ".json or .npy" in cli.error(2, "set", "foo.new", "@picture.png")
        assert "No such file" in cli.error(3, "set", "foo.new", f"@{tmp_path / 'none.npy'}")
        assert "not an .npy file" in cli.error(1, "set", "foo.new", f"@{tmp_path / 'x.npy'}")
    assert "there is no foo.nix to write into" in cli.error(1, "set", "foo.nix.x", "1")
    assert "18446744073709551616" in cli.error(2, "set", "foo.new", "18446744073709551616")


def test_delete(cli, kvs):
    cli.result("del", "foo.names[0]")
    assert kvs["foo"]["names"].read() == ["right"]
    cli.result("del", "foo")
    assert kvs.get("foo", "gone") == "gone"
    assert "nothing is stored at foo" in cli.error(3, "del", "foo")


def test_subscribers_are_told_if_wanted(cli, kvs):
    with blocking.RedisInterface(cli.url, namespace=cli.namespace) as interface:
        updates = blocking.KeyValueStore(interface)["foo"]["number"].watch(blocking.Every(100))
        assert next(updates).initial
        cli.result("set", "foo.number", "2")
        update = next(updates)
        assert (update.data, update.origin) == (2, "stored")
        cli.result("set", "foo.number", "3", "--publish")
        assert next(updates).data == 3
        run = cli("pub", "foo.number", "4", "--count", "3", "--rate", "200")
        assert (run.returncode, run.stdout) == (0, "")
        assert run.stderr.startswith("publishing foo.number at 200 Hz\npublished 3 times")
        assert [next(updates).data for _ in range(3)] == [4, 4, 4]
        assert cli("pub", "foo.number", "5").stderr == ""
        assert next(updates).data == 5
        cli.result("del", "foo.number", "--publish")
        assert next(updates).data is None


def test_publishing_until_ctrl_c(cli, kvs):
    with blocking.RedisInterface(cli.url, namespace=cli.namespace) as interface:
        updates = blocking.KeyValueStore(interface)["foo"]["number"].watch(blocking.Every(10_000))
        assert next(updates).initial
        with cli.running("pub", "foo.number", "-7", "--rate", "100") as process:
            assert [next(updates).data for _ in range(10)] == [-7] * 10
            process.send_signal(signal.SIGINT)
            said, errors = process.communicate(timeout=10)
    assert (process.returncode, said) == (0, "")
    assert errors.startswith("publishing foo.number at 100 Hz until Ctrl-C\npublished ")


# --- the terminal and the pipe -------------------------------------------------


def test_a_closed_pipe_is_no_error(cli, kvs):
    kvs["many"] = {f"key{number}": "x" * 100 for number in range(3000)}  # more than a pipe holds
    with cli.running("tree", "many", "--all") as process:
        assert process.stdout.readline().startswith("many")
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(10) == 0


def test_ctrl_c_ends_what_is_not_live_with_130(cli):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        cli.url = f"redis://127.0.0.1:{silent.getsockname()[1]}"
        with cli.running("ls") as process:
            connection, _ = silent.accept()
            with connection:
                connection.recv(1)
                process.send_signal(signal.SIGINT)
                said, errors = process.communicate(timeout=10)
    assert (process.returncode, said, errors) == (130, "", "")


def test_elements_of_arrays_are_read_and_not_set(cli, kvs):
    assert cli.result("get", "cam_left[1][0]") == cli.result("get", "cam_left[1][0]", "--json")
    assert float(cli.result("get", "cam_left[39][49]")) == 1.0
    assert cli.result("get", "foo.image[-1]").startswith("uint8[4,3], 12 B")
    assert "index 40 is out of bounds" in cli.error(3, "get", "cam_left[40]")
    assert "nothing is stored at foo.number[1]" in cli.error(3, "get", "foo.number[1]")
    assert "write an array as a whole" in cli.error(1, "set", "cam_left[1]", "5")


@pytest.mark.parametrize(
    ("words", "close"), [(["set", "a", "1", "--publsh"], "--publish"), (["pub", "a", "1", "--rat=5"], "--rate")]
)
def test_an_option_that_does_not_exist_is_called_so(cli, words, close):
    said = cli.error(2, *words)
    assert f"there is no option {words[-1].partition('=')[0]}; did you mean {close}?" in said
