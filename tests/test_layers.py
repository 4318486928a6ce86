"""What may import what: the middle is pure, one package talks to redis, and nothing is ever evaluated."""

from __future__ import annotations

import ast
import sys

import pytest
from conftest import ROOT

MODULES = sorted(path for package in ("reem", "reem_async") for path in (ROOT / package).rglob("*.py"))
PURE = [
    path
    for path in MODULES
    if path.is_relative_to(ROOT / "reem_async/plan") or path.is_relative_to(ROOT / "reem_async/ships")
]
TALKS_TO_REDIS = ("reem_async/transport/", "reem_async/errors.py", "reem_async/connection.py")
CALLS = {"eval", "exec", "compile", "__import__"}
LOADERS = {"pickle", "cPickle", "dill", "cloudpickle", "shelve"}


def label(path):
    return str(path.relative_to(ROOT))


def tree(path):
    return ast.parse(path.read_text(encoding="utf-8"), label(path))


def imported(path):
    """The absolute names of all modules a file imports, wherever in it, relative imports resolved."""
    package = path.relative_to(ROOT).parent.parts
    names = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            names |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return names


def roots(path):
    return {name.split(".")[0] for name in imported(path)}


def test_there_is_something_to_check():
    """An empty list would pass everything."""
    assert len(PURE) >= 4
    assert len(MODULES) > len(PURE)


@pytest.mark.parametrize("path", PURE, ids=label)
def test_plans_and_ships_know_nothing_of_loops_sockets_or_redis(path):
    """They are values and functions."""
    forbidden = {"asyncio", "anyio", "redis", "hiredis", "socket", "uvloop"}
    assert not roots(path) & forbidden


@pytest.mark.parametrize("path", PURE, ids=label)
def test_plans_and_ships_import_only_each_other_and_the_errors(path):
    """Nothing of REEM that does I/O, and no third party but numpy and orjson."""
    ours = {name for name in imported(path) if name.split(".")[0] in ("reem", "reem_async")}
    inside = ("reem_async.plan", "reem_async.ships", "reem_async.errors")
    assert not [name for name in ours if name != "reem_async" and not name.startswith(inside)]
    assert roots(path) <= set(sys.stdlib_module_names) | {"numpy", "orjson", "reem_async"}


@pytest.mark.parametrize("path", MODULES, ids=label)
def test_redis_is_imported_in_one_place(path):
    """The transport; the errors, which are subclasses of its errors; and the options of the interface."""
    if not label(path).startswith(TALKS_TO_REDIS):
        assert not roots(path) & {"redis", "hiredis"}


@pytest.mark.parametrize("path", MODULES, ids=label)
def test_nothing_that_was_read_is_evaluated(path):
    """No eval, exec, pickle or marshal, no numpy.load with pickles."""
    assert not roots(path) & LOADERS
    assert not imported(path) & {"marshal.load", "marshal.loads"}
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Call):
            assert ast.unparse(node.func) not in {"marshal.load", "marshal.loads"}, f"{label(path)}:{node.lineno}"
            name = node.func.id if isinstance(node.func, ast.Name) else ""
            assert name not in CALLS, f"{label(path)}:{node.lineno} calls {name}"
            allowed = [each for each in node.keywords if each.arg == "allow_pickle"]
            assert not [each for each in allowed if ast.unparse(each.value) != "False"], f"{label(path)}:{node.lineno}"


@pytest.mark.parametrize("path", [path for path in MODULES if label(path).startswith("reem_async/")], ids=label)
def test_the_core_does_not_know_its_facade(path):
    """Only the facade imports the core."""
    assert "reem" not in roots(path)


@pytest.mark.parametrize("path", MODULES, ids=label)
def test_no_forbidden_command_is_even_spelled(path):
    """No scripting, KEYS, FLUSH or CONFIG SET in any string that is a command."""
    forbidden = {"EVAL", "EVALSHA", "FCALL", "KEYS", "FLUSHALL", "FLUSHDB", "CONFIG SET", "SCRIPT"}
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Constant) and isinstance(node.value, (str, bytes)):
            text = node.value.decode("latin-1") if isinstance(node.value, bytes) else node.value
            assert text.strip().upper() not in forbidden or text != text.upper(), f"{label(path)}:{node.lineno}: {text}"
