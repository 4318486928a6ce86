"""Data from the server is not trusted: hostile bytes cost a BadData, quickly, and pixels never become commands."""

import ast
import contextlib
import gc
import os
import random
import resource
import sys
import time

import numpy as np
import orjson
import pytest
from conftest import EXAMPLES, FRONTS, PLAIN, ROOT, assert_same, commands_run
from fuzz.targets import KEYS, SHIPS, TARGETS, blob, header, mutants
from own_servers import own_server

from reem_async.errors import BadData
from reem_async.plan import notices, placeholders
from reem_async.plan.paths import show
from reem_async.plan.replies import loads
from reem_async.ships.numpy import NumpyShip

HOSTILE = max(1400, EXAMPLES * 5)
"""How many hostile inputs the decoders get, in all: 10,000 unless REEM_TEST_EXAMPLES says otherwise."""
SLOWEST = 0.05
MOST_MEMORY = 100 << 20

HEADERS = {
    "objects": header("'|O'", "(1,)", b"12345678"),
    "objects by name": header("'object'", "(1,)", b"12345678"),
    "objects in a field": header("[('a', '<f8'), ('b', '|O')]", "(1,)", b"x" * 16),
    "a huge item": header("'|V999999999'", "(1,)"),
    "a huge text": header("'<U999999999'", "(1,)"),
    "items of nothing": header("'|V0'", "(1099511627776,)"),
    "a huge shape": header("'|u1'", "(99999999999999,)", b"x"),
    "a huge shape of many": header("'|u1'", "(" + "99999999," * 60 + ")", b"x"),
    "a huge shape with a zero": header("'<f8'", "(0, 140737488355327, 140737488355327)"),
    "a negative size": header("'|u1'", "(-1,)", b"x"),
    "two negative sizes": header("'|u1'", "(-1, -1)", b"x"),
    "a size of a float": header("'|u1'", "(1.0,)", b"x"),
    "a size of True": header("'|u1'", "(True,)", b"x"),
    "a shape that is no tuple": header("'|u1'", "1", b"x"),
    "a shape that is a list": header("'|u1'", "[1]", b"x"),
    "too many dimensions": header("'|u1'", "(" + "1," * 65 + ")", b"x"),
    "Fortran order": header("'|u1'", "(1,)", b"x", order=True),
    "an unknown type": header("'<q9'", "(1,)", b"x" * 9),
    "a long double": header("'<f16'", "(1,)", b"x" * 16),
    "no type": header("None", "(1,)", b"x"),
    "a number for a type": header("5", "(1,)", b"x"),
    "types in types": header("[('a', " * 50 + "'<f8'" + ")]" * 50, "(1,)", b"x" * 8),
    "types in types in types": header("[('a', " * 5000 + "'<f8'" + ")]" * 5000, "(1,)", b"x" * 8, version=3),
    "many fields": header("[" + "".join(f"('f{n}','|u1')," for n in range(4000)) + "]", "(1,)", version=3),
    "many numbers": header("(" + "1," * 30_000 + "1)", "(1,)"),
    "subarrays of subarrays": header("[('a', '|u1', (99999, 99999))]", "(1,)"),
    "a subarray of nothing": header("[('a', '|u1', (0,))]", "(9,)"),
    "a field without a name": header("[(None, '<f8')]", "(1,)", b"x" * 8),
    "a dict for a type": header("{'names': ['a'], 'formats': ['|O']}", "(1,)", b"x" * 8),
    "a call": header("__import__('os').system('touch pwned')", "(1,)", b"x"),
    "an attribute": header("().__class__", "(1,)", b"x"),
    "a lambda": header("lambda: 0", "(1,)", b"x"),
    "a sum of ten thousand": header("+".join(["1"] * 10000), "(1,)", b"x", version=3),
    "ten thousand signs": header("-" * 10000 + "1", "(1,)", b"x", version=3),
    "ten thousand brackets": header("(" * 10000, "(1,)", b"x", version=3),
    "an endless number": header("1" * 20000, "(1,)", b"x", version=3),
    "an f-string": header("f'{1}'", "(1,)", b"x"),
    "quotes that do not end": header("'" * 9999, "(1,)", b"x", version=3),
    "backslashes": header("'" + "\\" * 9999, "(1,)", b"x", version=3),
    "more keys": b"\x93NUMPY\x01\x00\x40\x00"
    + b"{'descr':'|u1','fortran_order':False,'shape':(1,),'x':1}".ljust(64)
    + b"x",
    "no header": b"\x93NUMPY\x01\x00\x00\x00",
    "half a magic": b"\x93NUM",
    "nothing": b"",
    "zeros": bytes(200),
    "no dict": b"\x93NUMPY\x01\x00\x08\x00['<i8'] " + bytes(64),
    "a key that is missing": b"\x93NUMPY\x01\x00\x24\x00" + b"{'descr': '<i8', 'shape': (8,)}".ljust(36) + bytes(64),
    "objects in a list of types": header("'<f8,O'", "(1,)", bytes(16)),
    "a field that is a list": header("[['a', '<f8']]", "(1,)", bytes(8)),
    "a subarray of a negative size": header("[('a', '<f8', (-1,))]", "(1,)", bytes(8)),
    "a length beyond the end": b"\x93NUMPY\x01\x00\xff\xff{}",
    "a length beyond all": b"\x93NUMPY\x03\x00\xff\xff\xff\xff{}",
    "an unknown version": b"\x93NUMPY\x04\x00\x10\x00{}",
    "not text": b"\x93NUMPY\x03\x00\x08\x00\x00\x00" + b"\xff" * 8,
    "a pickle": b"\x80\x04cos\nsystem\n(S'touch pwned'\ntR.",
    "too few bytes": header("'<f8'", "(2,)", b"x" * 15),
    "too many bytes": header("'<f8'", "(2,)", b"x" * 17),
}

DOCUMENTS = {
    "half a placeholder": b'["$ship numpy"]',
    "a size of letters": b'["$ship numpy .a many"]',
    "an endless size": b'["$ship numpy .a ' + b"9" * 5000 + b'"]',
    "a float that is none": b'["$ship float 0x1.zz"]',
    "a float beyond all": b'["$ship float 0x1p99999999999"]',
    "infinity": b'["$ship float inf"]',
    "not a number": b'["$ship float nan"]',
    "one array a thousand times": orjson.dumps([[f"$ship bytes .image 8388608 {n}" for n in range(1000)]]),
    "deep down": b"[" * 1000 + b'"$ship numpy"' + b"]" * 1000,
    "deeper than parsers go": b"[" * 100_000,
    "two values": b"[1,2]",
    "no list": b'{"a":1}',
    "not UTF-8": b'["\xff"]',
    "half a surrogate pair": b'["\\ud800"]',
}


@contextlib.contextmanager
def little_memory():
    """Fails if the process grew by 100 MB."""
    gc.collect()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * (1 if sys.platform == "darwin" else 1024)
    assert grown < MOST_MEMORY, f"{grown >> 20} MB"


def timed(function, *arguments):
    for _ in range(3):
        begun = time.thread_time()
        result = function(*arguments)
        took = time.thread_time() - begun
        if took < SLOWEST:
            return result
    pytest.fail(f"{function.__name__} took {took:.3f} s over {arguments!r:.200}")


_deeds = []
_watching = []
_HARMLESS = ("compile", "object.__getattr__", "sys._getframe", "code.__new__", "cpython._PySys_ClearAuditHooks")


def _watch(event, arguments):
    if _watching and event not in _HARMLESS:
        _deeds.append((event, str(arguments)[:200]))


@pytest.fixture(scope="module")
def watched():
    """Notes what Python itself reports: code that is run, files, processes, sockets, modules, pickles."""
    sys.addaudithook(_watch)

    @contextlib.contextmanager
    def watching():
        _deeds.clear()
        _watching.append(1)
        try:
            yield
        finally:
            _watching.clear()
        assert _deeds == []

    return watching


# --- decoders ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(TARGETS))
def test_mutants_of_what_is_valid_cost_nothing_but_bad_data(name, watched):
    """A seventh of HOSTILE for each decoder, always the same ones."""
    inputs = list(mutants(name, HOSTILE // len(TARGETS), seed=1))
    assert len(set(inputs)) > len(inputs) * 0.5
    TARGETS[name](inputs[0])  # what is imported or built at first use
    with little_memory(), watched():
        for data in inputs:
            timed(TARGETS[name], data)


@pytest.mark.parametrize("title", list(HEADERS))
def test_handmade_arrays_are_refused(title, watched, tmp_path, monkeypatch):
    """Before a byte is allocated for them, and with nothing run."""
    monkeypatch.chdir(tmp_path)
    np.lib.format.descr_to_dtype("<f8")

    def unpack():
        with pytest.raises(BadData):
            NumpyShip().unpack(HEADERS[title])

    with little_memory(), watched():
        timed(unpack)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("title", list(DOCUMENTS))
def test_handmade_documents_are_refused(title, watched):
    """Placeholders that are none, nesting, several placeholders for one array."""

    def read():
        with pytest.raises(BadData):
            placeholders.find(loads(DOCUMENTS[title], KEYS), "foo")

    with little_memory(), watched():
        timed(read)


def test_what_is_remembered_of_hostile_data_is_little():
    """Long headers, strings and placeholders, all different and all valid, are not kept."""
    text = "x" * 100_000
    fields = "".join(f"('{n:060}','|u1')," for n in range(800))
    with little_memory():
        for number in range(600):
            placeholders.find([f"$ship text {number}{text}"], "foo")
            placeholders.find([f"$ship numpy .a 1 {number}{text}"], "foo")
        for number in range(60):
            NumpyShip().unpack(header(f"[('n{number}','|u1'),{fields}]", "(1,)", b"x" * 801, version=3))


@pytest.mark.parametrize("length", [5, 100_000])
def test_the_path_of_a_notice_is_not_believed_either(length):
    """Neither very many elements nor very long ones are kept or slow anything down."""
    with little_memory():
        for number in range(2500 if length > 5 else 300):
            path = [f"{number}{'y' * length}"] if length > 5 else ["a"] * 3000
            payload = orjson.dumps([1, "x", number, 0.0, path, "look", 1, []]) + b"\n"
            with contextlib.suppress(BadData):
                decoded = timed(notices.decode, payload, SHIPS)
                show(("foo", *decoded.path))


# --- stored on a real server -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def server():
    with own_server() as process:
        yield process


@pytest.mark.parametrize("name", list(FRONTS))
def test_hostile_arrays_on_the_server_are_refused_with_their_path(server, name):
    """In both fronts; the connection and the rest of the document stay usable."""
    with server.admin() as admin, contextlib.closing(FRONTS[name](server.url)) as front:
        front.write(["foo"], {"n": 1, "image": np.arange(3)})
        for hostile in HEADERS.values():
            admin.set("{foo}.image", hostile)
            with pytest.raises(BadData, match=r"foo\.image"):
                front.read(["foo"])
            assert front.read(["foo", "n"]) == 1
        admin.set("{foo}.image", blob(np.arange(4)))
        assert front.read(["foo", "image"]).tolist() == [0, 1, 2, 3]
        for hostile in DOCUMENTS.values():
            if hostile.startswith(b'["$ship'):
                admin.execute_command("JSON.SET", "foo", "$.bad", hostile[1:-1])
                with pytest.raises(BadData, match="foo"):
                    front.read(["foo"])
                assert front.read(["foo", "n"]) == 1
        front.write(["foo"], 1)


@pytest.mark.parametrize("name", list(FRONTS))
def test_a_hostile_registry_does_not_stop_writes(server, name):
    """What REEM has not entered there is nobody's array; the next full write removes it."""
    junk = [
        "",
        "..",
        "[",
        '["',
        "[99999999999999999999]",
        "~",
        b"\xff\xfe",
        "x" * 100_000,
        "a\r\nFLUSHALL\r\n",
        "{foo}",
    ]
    with server.admin() as admin, contextlib.closing(FRONTS[name](server.url)) as front:
        front.write(["foo"], {"n": 1, "image": np.arange(3)})
        admin.set("{foo}elsewhere", "kept")
        admin.sadd("{foo}:ships", *junk)
        front.write(["foo", "n"], 2)
        front.write(["foo", "image"], np.arange(4))
        front.write(["foo", "m"], {"image": np.arange(2)})
        assert front.read(["foo", "image"]).tolist() == [0, 1, 2, 3]
        front.write(["foo"], {"image": np.arange(5)})
        front.write(["foo"], {"image": np.arange(6)})
        assert front.read(["foo", "image"]).tolist() == [0, 1, 2, 3, 4, 5]
        assert admin.smembers("{foo}:ships") == {".image"}
        assert admin.get("{foo}elsewhere") == "kept"
        admin.flushall()


PROTOCOL = [
    b"\r\n", b"*1\r\n$8\r\nFLUSHALL\r\n", b"*3\r\n$3\r\nSET\r\n$5\r\npwned\r\n$1\r\n1\r\n", b"\r\nSET pwned 1\r\n",
    b"$-1\r\n", b"+OK\r\n", b"*0\r\n", b"QUIT\r\n", b"\r\nEXEC\r\nSHUTDOWN NOSAVE\r\n", b"\x00", b"\xff" * 7, b"$3\r\n",
    b"MULTI\r\n", b"DISCARD\r\n", b"'\"\\", b">2\r\n",
]  # fmt: skip
DTYPES = [
    "|u1", "<i2", ">i4", "<u8", "<f4", ">f8", "<c16", "|S1", "|S9", "<U3", "|V5", "|b1", "<M8[ns]", ">m8[s]",
    [("a", "|u1"), ("b", "<f8", (2,)), ("c", "|S3")],
]  # fmt: skip


def armed(dice):
    dtype = np.dtype(dice.choice(DTYPES))
    shape = tuple(dice.choice((1, 2, 3, 7, 40)) for _ in range(dice.randrange(4)))
    if dice.random() < 0.02:
        shape = (20_000,)  # sent in a piece of its own
    size = int(np.prod(shape)) * dtype.itemsize
    pool = b"".join(dice.choices(PROTOCOL, k=size // 4 + 4))
    start = dice.randrange(len(pool))
    data = (pool[start:] + pool * (size // len(pool) + 1))[:size]
    array = np.frombuffer(bytearray(data), dtype).reshape(shape)
    match dice.randrange(5):
        case 0:
            return array.T
        case 1:
            return array[..., ::2] if array.ndim else array
        case 2:
            return np.asfortranarray(array)
        case _:
            return array


@pytest.mark.parametrize("name", list(FRONTS))
def test_bytes_of_arrays_never_become_commands(server, name):
    """Half of EXAMPLES arrays per front, written, published, and read back bit by bit; the server counts commands."""
    dice = random.Random(name)
    with server.admin() as admin:
        admin.config_resetstat()
        writes = 0
        for space in ("KeyValueStore", "PublishSpace"):
            with contextlib.closing(FRONTS[name](server.url, space)) as front:
                reader = FRONTS[name](server.url)
                with contextlib.closing(reader):
                    for _ in range(max(2, EXAMPLES // 4 // 10)):
                        arrays = {f"a{number}": armed(dice) for number in range(10)}
                        texts = {
                            "text": dice.choice(PROTOCOL).decode("latin-1") * 3,
                            "b": b"".join(dice.choices(PROTOCOL, k=9)),
                        }
                        front.write(["foo"], arrays | texts)
                        writes += 1
                        assert_same(reader.read(["foo"]), {**arrays, **texts})
        ran = commands_run(admin)
        expected = {"json.set", "json.get", "json.type", "set", "get", "unlink", "multi", "exec"}
        expected |= {"sadd", "srem", "smembers", "publish"}
        if PLAIN:  # a document is one more SET, and looked at once, before it is known to be one
            ran["set"] -= writes
            expected |= {"watch", "type", "getrange"}
        else:
            assert ran["json.set"] == writes
        assert set(ran) - {"config|resetstat"} <= expected
        assert ran["set"] == writes * 11 + writes // 2  # the note of each update
        assert ran["publish"] >= writes // 2  # and now and then the question who listens near by
        assert admin.exists("pwned") == 0
        asked = {"errorstat_ERR"} if PLAIN else set()  # whether it knows JSON after all
        assert {row for row in admin.info("errorstats") if row.startswith("errorstat_")} <= asked
        admin.flushall()


# --- the code ---------------------------------------------------------------------------------------------------

MODULES = sorted(path for package in ("reem", "reem_async") for path in (ROOT / package).rglob("*.py"))
RUNS_CODE = {
    "builtins.eval", "builtins.exec", "builtins.compile", "builtins.__import__", "pickle", "cPickle", "cloudpickle",
    "dill", "joblib", "shelve", "jsonpickle", "allow_pickle=", "shell=", "numpy.fromfile", "numpy.memmap(",
    "numpy.lib.format.read_array", "numpy.lib.format.open_memmap", "numpy.loadtxt", "numpy.genfromtxt",
    "numpy.recfromcsv", "numpy.safe_eval", "marshal.load", "marshal.loads", "os.system", "os.popen", "code", "codeop",
    "runpy", "timeit",
}  # fmt: skip
"""What runs code, or may, when it is given bytes of a stranger."""
OF_YAML = {"YAMLError", "safe_load", "safe_dump", "scan", "AliasToken", "SafeLoader"}
"""What runs none; all else of PyYAML may."""


def runs_code(name):
    package, _, rest = name.partition(".")
    return name in RUNS_CODE or (package == "yaml" and rest.rstrip("(") not in {"", *OF_YAML})


def used(path):
    """The full names of all that a module imports or calls."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names, found = {}, set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                names[alias.asname or alias.name.partition(".")[0]] = (
                    alias.name if alias.asname else alias.name.partition(".")[0]
                )
                found.add((alias.name, node.lineno))
        elif isinstance(node, ast.ImportFrom) and not node.level:
            for alias in node.names:
                names[alias.asname or alias.name] = f"{node.module}.{alias.name}"
                found |= {(node.module, node.lineno), (f"{node.module}.{alias.name}", node.lineno)}
    called = {node.func for node in ast.walk(tree) if isinstance(node, ast.Call)}
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.keyword)
            and node.arg in ("allow_pickle", "shell")
            and ast.unparse(node.value) != "False"
        ):
            found.add((f"{node.arg}=", node.value.lineno))
        if isinstance(node, ast.Name | ast.Attribute):
            text = ast.unparse(node)
            first, dot, rest = text.partition(".")
            if text.replace(".", "").isidentifier() and (first in names or not dot):
                name = names.get(first, f"builtins.{first}") + dot + rest
                found |= {(name, node.lineno), (f"{name}(" * (node in called), node.lineno)}
    return found


def test_the_search_for_dangerous_calls_finds_them(tmp_path):
    for number, text in enumerate([
        "import pickle", "from pickle import loads as l", "import numpy as np\nnp.load(x, allow_pickle=y)", "eval(x)",
        "import marshal\nmarshal.loads(x)", "from os import system", "f = exec",
        "import numpy.lib.format as f\nf.read_array(x)", "import numpy\nnumpy.memmap(x)",
        "import yaml\nyaml.load(x)", "from yaml import full_load", "from yaml import *",
    ]):  # fmt: skip
        file = tmp_path / f"m{number}.py"
        file.write_text(text)
        assert any(runs_code(name) for name, _ in used(file)), text


def test_nothing_runs_what_was_read():
    """`marshal.dumps` alone is used, as a type check."""
    assert not [(path, name, line) for path in MODULES for name, line in used(path) if runs_code(name)]
