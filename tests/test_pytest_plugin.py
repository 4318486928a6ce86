"""The fixture `reem_server`, in test runs of their own."""

import importlib.metadata
import os
import subprocess
import sys

import pytest
from conftest import ROOT

CODE = """
import pytest
from reem import KeyValueStore, RedisInterface

@pytest.mark.parametrize("number", [1, 2])
def test_a_test_begins_without_keys(reem_server, number):
    with RedisInterface(reem_server) as interface:
        kvs = KeyValueStore(interface)
        assert kvs.keys() == []
        kvs.update({f"k{index}": index for index in range(1200)})
        kvs["image"] = {"bytes": b"x" * 100_000}

def test_without_the_fixture_reem_is_not_imported():
    pass
"""


def installed():
    return any(
        point.value == "reem_async.tools.pytest_plugin" for point in importlib.metadata.entry_points(group="pytest11")
    )


def run(folder, code, **environment):
    (folder / "test_it.py").write_text(code)
    (folder / "pytest.ini").write_text("[pytest]\nasyncio_default_fixture_loop_scope = function\n")
    plugin = {} if installed() else {"PYTEST_PLUGINS": "reem_async.tools.pytest_plugin"}
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-W", "error", "test_it.py"],
        cwd=folder,
        env={**os.environ, **plugin, **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_each_test_begins_with_an_empty_server(tmp_path):
    done = run(tmp_path, CODE)
    assert "3 passed" in done.stdout, done.stdout + done.stderr


def test_no_server_program_is_one_line(tmp_path):
    done = run(tmp_path, CODE, REEM_SERVER="/no/such/program")
    assert "1 passed, 2 errors" in done.stdout, done.stdout
    assert "the fixture reem_server needs a server program: " in done.stdout


def test_the_plugin_costs_other_test_runs_nothing(tmp_path):
    done = run(tmp_path, "import sys\n\ndef test_it():\n    assert not {'numpy', 'redis'} & set(sys.modules)\n")
    assert "1 passed" in done.stdout, done.stdout + done.stderr


@pytest.mark.skipif(not installed(), reason="this environment was made before the plugin was there")
def test_pytest_finds_the_plugin_by_itself():
    (point,) = (each for each in importlib.metadata.entry_points(group="pytest11") if each.name == "reem")
    assert point.value in (ROOT / "pyproject.toml").read_text()
