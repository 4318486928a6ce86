"""`reem param`: parameters from the command line, within their bounds."""

import json
import re

import numpy as np
import pytest
import yaml
from clikit import CommandLine

import reem


class ParamCommandLine(CommandLine):
    def words(self, command, *arguments):
        return ["reem", "param", command, "--namespace", self.namespace, *map(str, arguments)]


@pytest.fixture
def cli(server_url, key):
    return ParamCommandLine(server_url, f"{key.prefix}:")


@pytest.fixture
def store(cli):
    with reem.RedisInterface(cli.url, namespace=cli.namespace) as interface:
        store = reem.KeyValueStore(interface)
        control = store["control"]
        control.parameter("kp", 2.0, low=0.0, high=10.0, unit="1/s", help="gain")
        control.parameter("mode", "hold", choices=["hold", "on", "\x1b[31mred"])
        control.parameter("offset", np.zeros(2), low=-1)
        store["arm"].parameter("n", 3, low=-5)
        store["arm"].parameter("on", True)
        yield store


def test_parameters_are_listed_read_and_set(cli, store):
    assert cli.result("list", "control.kp") == "control.kp\t2.0\t2.0\t0.0 to 10.0\t1/s\tgain\n"
    assert len(cli.result("list").splitlines()) == 5
    assert "\x1b" not in cli.result("list")
    row = json.loads(cli.result("list", "control.offset", "--json"))
    specification = {"type": "float[2]", "default": [0.0, 0.0], "low": -1.0}
    assert row == {"path": "control.offset", "value": [0.0, 0.0], "invalid": None, **specification}
    for path, typed, value in [
        ("control.kp", "3", 3.0),
        ("control.mode", "on", "on"),
        ("control.offset", "[1, -0.5]", [1.0, -0.5]),
        ("arm.n", "-4", -4),
        ("arm.on", "false", False),
    ]:
        cli.result("set", path, typed)
        assert store.get(path) == value
        shown = cli.result("get", path)
        assert shown == f"{value}\n" if isinstance(value, str) else json.loads(shown) == value
    shown, code = cli.in_terminal("list", columns=60)
    assert code == 0
    plain = re.sub(r"\x1b\[[0-9;]*m", "", shown)
    assert all(len(line) <= 60 for line in plain.splitlines())
    assert plain.split()[:6] == ["name", "value", "default", "range", "unit", "help"]


def test_what_is_not_allowed_is_refused_and_stays_unsent(cli, store):
    for path, typed, message in [
        ("control.kp", "10.5", "out of range; use 0.0 to 10.0 1/s"),
        ("control.kp", "NaN", "not finite"),
        ("control.kp", "fast", "not of type float"),
        ("control.mode", "off", "use one of hold, on"),
        ("control.offset", "[1]", "use 2"),
        ("arm.n", "2.5", "not of type int"),
        ("arm.on", "1", "not of type bool"),
    ]:
        before = store.get(path)
        assert message in cli.error(2, "set", path, typed)
        assert store.get(path) == before
    for command in (["get", "arm.no"], ["set", "arm.no", "1"]):
        assert "no program has declared arm.no" in cli.error(3, *command)
    store["control"]["kp"] = 99
    assert "programs ignore the stored value: control.kp: 99" in cli.error(1, "get", "control.kp")
    run = cli("list", "control.kp")
    assert (run.returncode, run.stdout.split("\t")[1]) == (0, "")
    assert "99.0 is out of range" in run.stderr


def test_a_file_is_saved_and_loaded_as_a_whole(cli, store, tmp_path):
    file = tmp_path / "tuned.yaml"
    store["control"].update({"kp": 3.5, "mode": "on"})
    cli.result("save", file)
    text = file.read_text()
    assert "# float 0.0 to 10.0 1/s: gain\ncontrol.kp: 3.5\n" in text
    assert "\x1b" not in text
    saved = {"arm.n": 3, "arm.on": True, "control.kp": 3.5, "control.mode": "on", "control.offset": [0.0, 0.0]}
    assert yaml.safe_load(text) == saved
    assert cli.result("save") == text
    assert "--force" in cli.error(2, "save", file)
    store["control"].update({"kp": 99, "mode": "hold"})
    changes = "control.kp: (out of range) -> 3.5\ncontrol.mode: hold -> on\n"
    assert cli.result("load", file, "--dry-run") == changes
    assert store.get("control.mode") == "hold"
    assert cli.result("load", file) == changes
    assert {path: store.get(path) for path in saved} == saved
    run = cli("load", file)
    assert (run.stdout, run.stderr) == ("", "changed 0 parameters\n")
    store["control"]["kp"] = 99
    run = cli("save", file, "--force")
    assert (run.returncode, "control.kp" in yaml.safe_load(file.read_text())) == (1, False)
    assert "not saved: control.kp" in run.stderr


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "arm.n: 4\ncontrol.kp: 99\nno.no: 1\n",
            "control.kp: 99.0 is out of range; use 0.0 to 10.0 1/s; no program",
        ),
        ("arm.n: 4\ncontrol.mode: on\n", "control.mode: True is not of type str; put a text into quotes"),
        ("arm.n: 4\ncontrol.kp: 2026-11-26\n", "control.kp"),
        ("arm.n: 4\n5: 5\n", "a path is a str"),
        ("arm.n: 4\n'a..b': 5\n", "is not a path"),
        ("arm.n: 4\ncontrol.kp: !!python/object/apply:os.getcwd []\n", "is not YAML"),
        ("arm.n: 4\ncontrol.kp: [" + "[" * 1000, "is not YAML"),
        ("a: &a [1]\nb: *a\n", "has aliases"),
        ("arm.n: 4\narm.n: {", "is not YAML"),
        ("[arm.n, 4]", "has no lines"),
        ("", "has no lines"),
        ("#" * 1_000_001, "has no lines"),
        ("arm.n: \xff", "is not YAML"),
    ],
)
def test_of_a_bad_file_nothing_is_loaded(cli, store, tmp_path, text, message):
    file = tmp_path / "bad.yaml"
    file.write_bytes(text.encode("latin-1"))
    assert message in cli.error(2, "load", file)
    assert store.get("arm.n") == 3


def test_what_no_program_declares_any_more_is_forgotten(cli, store):
    store["_parameters"].update({"a[0]": 5, "gone.p": {"type": "float"}})
    run = cli("list")
    assert (run.stdout.count("\n"), run.stderr.count("left out: ")) == (5, 2)
    for path in ("a[0]", "gone.p", "control.kp"):
        CommandLine(cli.url, cli.namespace).result("del", f'_parameters["{path}"]')
    run = cli("list", "control")
    assert (run.stdout.count("\n"), run.stderr) == (2, "")
    assert store.get("control.kp") == 2.0
    del store["_parameters"]
    assert "no program has declared a parameter" in cli.error(3, "list")
