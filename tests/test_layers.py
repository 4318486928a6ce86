"""What may import what: the middle is pure, one package talks to redis, and nothing is ever evaluated."""

import ast
import functools
import re
import sys

from conftest import ROOT

MODULES = sorted(path for package in ("reem", "reem_async") for path in (ROOT / package).rglob("*.py"))
PURE = [
    path
    for path in MODULES
    if path.relative_to(ROOT).parts[:2] in {("reem_async", name) for name in ("plain", "plan", "ships")}
    or path == ROOT / "reem_async/legacy/olddata.py"
]
TALKS_TO_REDIS = ("reem_async/transport/", "reem_async/errors.py", "reem_async/connection.py")


def label(path):
    return str(path.relative_to(ROOT))


@functools.cache
def tree(path):
    return ast.parse(path.read_text(encoding="utf-8"), label(path))


@functools.cache
def statements(path):
    """Each module that a file imports, wherever in it, relative imports resolved, and what it imports from it."""
    package = path.relative_to(ROOT).parent.parts
    found = []
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            found += [(alias.name, set()) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            found.append((module, {f"{module}.{alias.name}" for alias in node.names}))
    return found


def imported(path):
    return set().union(*({module, *names} for module, names in statements(path)))


def roots(path):
    return {name.split(".")[0] for name in imported(path)}


def test_there_is_something_to_check():
    """An empty list would pass everything."""
    assert len(PURE) >= 4
    assert len(MODULES) > len(PURE)


def wrong(paths, said):
    """What `said` of each file, by file: of files in which nothing is wrong it says nothing."""
    return {label(path): found for path in paths if (found := said(path))}


def test_plans_and_ships_know_nothing_of_loops_sockets_or_redis():
    forbidden = {"asyncio", "anyio", "redis", "hiredis", "socket", "uvloop"}
    assert wrong(PURE, lambda path: roots(path) & forbidden) == {}


def test_plans_and_ships_import_only_each_other_and_the_errors():
    """Nothing of REEM that does I/O, and no third party but numpy and orjson."""
    inside = tuple(f"reem_async.{name}" for name in ("plain", "plan", "ships", "errors", "legacy.olddata"))
    known = {*sys.stdlib_module_names, "numpy", "orjson", "reem_async"}

    def strange(path):
        ours = {name for name in imported(path) if name.split(".")[0] in ("reem", "reem_async")}
        outside = [name for name in ours if name != "reem_async" and not name.startswith(inside)]
        return outside + sorted(roots(path) - known)

    assert wrong(PURE, strange) == {}


def test_redis_is_imported_in_one_place():
    """The transport; the errors, which are subclasses of its errors; and the options of the interface."""
    others = [path for path in MODULES if not label(path).startswith(TALKS_TO_REDIS)]
    assert wrong(others, lambda path: roots(path) & {"redis", "hiredis"}) == {}


def test_the_core_does_not_know_its_facade():
    core = [path for path in MODULES if label(path).startswith("reem_async/")]
    assert wrong(core, lambda path: roots(path) & {"reem"}) == {}


FORBIDDEN = {"EVAL", "EVALSHA", "FCALL", "KEYS", "FLUSHALL", "FLUSHDB", "CONFIG SET", "SCRIPT"}


def spelled(path):
    """The forbidden commands that stand in a file, with their lines."""
    found = []
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Constant) and isinstance(node.value, (str, bytes)):
            text = node.value.decode("latin-1") if isinstance(node.value, bytes) else node.value
            if text.strip().upper() in FORBIDDEN and text == text.upper():
                found.append(f"line {node.lineno}: {text}")
    return found


def test_no_forbidden_command_is_even_spelled():
    """No scripting, KEYS, FLUSH or CONFIG SET in any string that is a command."""
    assert wrong(MODULES, spelled) == {}


def test_what_is_forbidden_would_be_found(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    bad = tmp_path / "bad.py"
    bad.write_text("import pickle, redis\nrun('KEYS', 'Keys')\n")
    assert spelled(bad) == ["line 2: KEYS"]
    assert roots(bad) == {"pickle", "redis"}


ORDER = [
    {"errors", "_installation"},
    {"plan", "ships", "legacy.olddata"},
    {"plain"},
    {"concurrency"},
    {"local"},
    {"transport"},
    {"session"},
    {"coordination.presence", "coordination.clock"},
    {"connection"},
    {"pubsub"},
    {"store", "coordination"},
    {"tools.jsontext", "tools.partfile", "tools.snapshots", "tools.recording", "legacy"},
    {"server"},
    {"tools.browser", "tools.demo", "tools.viewers"},
    {"tools.cli", "legacy.command", "tools.notebook", "tools.pytest_plugin"},
]
"""What may import what: only what stands before it, and its own line. TYPE_CHECKING and functions count too."""
DOORS = {"", "datatypes", "migration", "monitor", "recording", "snapshots", "tools"}
"""Modules that only give documented names; nothing of the core imports them but `timeout` and the like from the top."""
SCRIPTS = sorted((ROOT / "reem_async/tools/browser/static").glob("*.js"))


def dotted(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports():
    """The modules of REEM that each module of REEM imports; `from package import module` is of the module alone."""
    ours = {dotted(path): path for path in MODULES}
    found = {}
    for name, path in ours.items():
        wanted = set()
        for module, names in statements(path):
            wanted |= (names & ours.keys()) | ({module} if not names or names - ours.keys() else set())
        found[name] = (wanted & ours.keys()) - {name}
    return found


def circles(graph):
    """The groups of nodes that can reach each other."""
    reached = {}
    for start in graph:
        seen, ahead = set(), [start]
        while ahead:
            for each in graph[ahead.pop()] - seen:
                seen.add(each)
                ahead.append(each)
        reached[start] = seen
    return sorted({tuple(sorted(b for b in reached[a] if a in reached[b])) for a in graph if a in reached[a]})


def test_a_circle_would_be_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == [("b", "c")]


def test_no_modules_import_each_other():
    assert circles(imports()) == []


def test_no_scripts_of_the_page_import_each_other():
    graph = {path.name: set(re.findall(r'from "\./([\w.]+)"', path.read_text(encoding="utf-8"))) for path in SCRIPTS}
    assert any(graph.values())
    assert circles(graph) == []


def folder(module):
    parts = module.split(".")[1:]
    # The first belongs to the plans, the second to the command line, the third to the interface; the rest of their
    # packages uses all that is below it.
    if parts in (["legacy", "olddata"], ["legacy", "command"], ["coordination", "presence"], ["coordination", "clock"]):
        return ".".join(parts)
    return ".".join(parts[:2] if parts[:1] == ["tools"] else parts[:1])


def test_the_folders_are_in_order():
    place = {name: number for number, names in enumerate(ORDER) for name in names}
    wrong = []
    for module, wanted in imports().items():
        if not module.startswith("reem_async") or folder(module) in DOORS:
            continue
        wrong += [
            f"{module} imports {each}"
            for each in wanted
            if each != "reem_async" and (folder(each) in DOORS or place[folder(each)] > place[folder(module)])
        ]
    assert wrong == []


def test_the_core_uses_what_is_for_old_data_at_one_point():
    """`plan/reads.py`; besides, the command line and the documented `reem_async.migration` do."""
    users = {name for name, wanted in imports().items() if any(".legacy" in each for each in wanted)}
    core = {name for name in users if not name.startswith(("reem.", "reem_async.legacy", "reem_async.tools.cli"))}
    assert core == {"reem_async.plan.reads", "reem_async.migration"}
