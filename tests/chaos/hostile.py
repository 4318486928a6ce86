"""Row 9: what a hostile program may put on the server, and arrays that are full of protocol."""

from __future__ import annotations

import contextlib
import json
import re
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from conftest import FRONTS, same_bits

import reem
from reem_async.errors import BadData

from .proxy import Proxy
from .scoreboard import Run, row, tell
from .servers import PrivateServer
from .tools import rss

TOP = "hostile"


class Watchman:
    """Sees what the interpreter is asked to run: nothing that came from the server may be."""

    EVENTS = ("os.system", "os.exec", "subprocess.Popen", "pickle.find_class", "marshal.loads", "ctypes.dlopen")

    def __init__(self) -> None:
        self.seen: list[str] = []
        self.on = False
        sys.addaudithook(self._hear)

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event in self.EVENTS:
            self.seen.append(event)
        elif event == "exec" and not Path(arguments[0].co_filename).is_absolute():
            self.seen.append(f"exec of {arguments[0].co_filename}")


def _code(canary: Path) -> list[str]:
    """Texts that do harm where they are evaluated."""
    opened = f"open({str(canary)!r},'w').close()"
    return [
        opened,
        f"__import__('os').system('touch {canary}')",
        f"[c for c in ().__class__.__base__.__subclasses__()] or {opened}",
        f"np.{opened}",
        f"dtype('O'),{opened}",
    ]


class Poison:
    """Makes hostile values of every kind that REEM reads."""

    def __init__(self, run: Run, canary: Path) -> None:
        self._rng = run.rng
        self._canary = str(canary).encode()
        self._code = _code(canary)

    def placeholder(self) -> str:
        """A string with the mark, which is not what REEM writes, or names what is not there."""
        rng, code = self._rng, self._rng.choice(self._code)
        label = rng.choice(
            ["numpy", "bytes", "pickle", "text2", "", "%00", "numpy%20", "../numpy", code.replace(" ", "")]
        )
        suffix = rng.choice([".a", "", "a", ".missing", "}.b", ":ships", ":last", ".%0d%0aDEL", code.replace(" ", "")])
        size = rng.choice(["8", "", "-1", "9" * 17, "9" * 30, "0x10", "1e3", "²", "1_0", "NaN"])
        summary = rng.choice(["", "float64[1]", "O[9999999999]", code])
        return f"$ship {label} {suffix} {size} {summary}"

    def inline(self) -> str:
        """A float that stands in the document, and is none."""
        return "$ship float " + self._rng.choice(["", "0x", "nan()", "0x1p99999999999", "1" * 5000, *self._code])

    def header(self) -> bytes:
        """An .npy file whose header lies, or is code, or is not for parsers of weak nerves."""
        rng, code = self._rng, self._rng.choice(self._code)
        descr = rng.choice(
            [
                *(
                    "'O'",
                    "'|O'",
                    "'f8,O'",
                    "'V999999999'",
                    "'<f999'",
                    "[('a','<f8'),('a','O')]",
                    "'<f8'",
                    "[]",
                    "['<f8']",
                ),
                *(
                    "[('a', [('b', [('c', '|O8')])])]",
                    "'<U99999999'",
                    "'|V0'",
                    "[('x','|V0')]",
                    "('<f8',(2**60,))",
                    code,
                ),
            ]
        )
        shape = rng.choice(
            [
                *("(1,)", "(-1,)", "(2**62,)", "(999999999999,)", "(4294967296, 4294967296)", "()", "1", "(1.0,)"),
                *("(True,)", "(0, 99999999999999)", "(1,)*99", "(" + "1," * 70 + ")", "None", code),
            ]
        )
        text = rng.choice(
            [
                f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}",
                f"{{'descr': {descr}, 'fortran_order': True, 'shape': {shape}, }}",
                f"{{'descr': {descr}, 'shape': {shape}}}",
                "(" * rng.choice([100, 5000, 30000]),
                "{" * 200 + "}" * 200,
                "-" * 20000 + "1",
                "'" + "\\" * 9999,
                code,
            ]
        ).encode()
        version = rng.choice([b"\x01\x00", b"\x02\x00", b"\x03\x00", b"\x09\x00"])
        size = len(text) if rng.random() < 0.7 else rng.choice([0, 1, len(text) - 1, len(text) + 1, 65535])
        length = max(0, size).to_bytes(2 if version[0] == 1 else 4, "little")
        return b"\x93NUMPY" + version + length + text + rng.randbytes(rng.choice([0, 1, 8, 64]))

    def mutant(self) -> bytes:
        """A true .npy file with a few bytes changed, cut off, or added."""
        rng = self._rng
        array = np.zeros(rng.randrange(1, 50), rng.choice(["<f8", ">i4", "u1", "<M8[ns]", "<U3", "S4"]))
        blob = bytearray(b"".join(reem.NumpyShip().pack(array)))
        for _ in range(rng.randrange(1, 6)):
            kind = rng.randrange(4)
            at = rng.randrange(len(blob)) if rng.random() < 0.3 else rng.randrange(min(len(blob), 128))
            if kind == 0:
                blob[at] = rng.randrange(256)
            elif kind == 1:
                blob[at : at + 1] = rng.choice([b"9", b"(", b"'", b"O", b"-", b","])
            elif kind == 2:
                del blob[at : at + rng.randrange(1, 9)]
            else:
                blob[at:at] = rng.randbytes(rng.randrange(1, 9))
            blob = blob or bytearray(1)
        return bytes(blob)

    def noise(self) -> bytes:
        """Bytes without a meaning, or with the wrong one: a pickle."""
        import pickle

        pickled = b"cos\nsystem\n(S'touch " + self._canary + b"'\ntR."
        return self._rng.choice([b"", b"\x93NUMPY", pickled, pickle.dumps([1]), self._rng.randbytes(100)])

    def notice(self) -> bytes:
        """A message on the channel that no publisher of REEM has sent."""
        rng, code = self._rng, self._rng.choice(self._code)
        whole: list[Any] = [1, "p", rng.randrange(9), 1.5, [], "set", 2, []]
        whole[rng.randrange(8)] = rng.choice([None, -1, 2**63, "x", [[]], {}, 1e308, code, [code], ["numpy", ".a", 9]])
        whole[7] = rng.choice([whole[7], [["numpy", ".a", 80]], [["pickle", ".a", -80]], [[code, code, 2**62]]])
        body = rng.choice([b"{}", b"[" * 1000, self.placeholder().encode(), self.header(), b""])
        return rng.choice([orjson.dumps(whole) + b"\n" + body, rng.randbytes(40), b"", b"[" * 5000])


@row(
    9,
    "hostile documents, arrays, messages; arrays full of commands",
    "only BadData, each < 50 ms, memory < +100 MB, 0 code run, 0 commands injected, bytes equal",
)
def hostile(run: Run) -> None:
    """10,000 hostile values planted by a plain client; 2,000 arrays of all dtypes that hold protocol bytes."""
    with PrivateServer() as server:
        _poisoned(run, server)
        _protocol(run, server)


def _poisoned(run: Run, server: PrivateServer) -> None:
    count = run.size(10_000, 1_000)
    canary = Path(f"/tmp/reem-canary-{run.seed}")
    poison, watchman = Poison(run, canary), Watchman()
    wrong: list[Any] = []
    times: list[float] = []
    refused = {"placeholder": 0, "blob": 0, "notice": 0}
    with server.raw() as raw, contextlib.ExitStack() as stack:
        fronts = [stack.enter_context(contextlib.closing(front(server.url))) for front in FRONTS.values()]
        mirrored = stack.enter_context(contextlib.closing(reem.RedisInterface(server.url)))
        mirror = reem.SilentSubscriber("mirrored", mirrored)  # hears the notices
        mirror.listen()
        start = peak = 0.0
        for number in range(count):
            kind = ("placeholder", "blob", "blob", "notice")[number % 4]
            _plant(raw, poison, kind, number)
            front = fronts[number % 8 // 4]
            watchman.on = True
            taken = _work(front, kind, refused, wrong)
            if taken > 0.05:  # a collection of garbage may have come between: what is slow by itself is slow again
                taken = min(taken, _work(front, kind, refused, wrong))
            times.append(taken)
            watchman.on = False
            if number == count // 10:
                start = rss()
            peak = max(peak, rss())
        reem.PublishSpace(mirrored)["mirrored"] = {"n": 1}
        deadline = time.monotonic() + 5
        while mirror.value() != {"n": 1} and time.monotonic() < deadline:
            time.sleep(0.01)
        if mirror.value() != {"n": 1}:
            wrong.append(f"the mirror has ended as {mirror.value()!r}")
    tell(f"refused {refused}")
    run.at_least("hostile values", count, count)
    run.at_least("of them refused", refused["placeholder"] + refused["blob"], count // 3)
    run.none("other errors", wrong)
    run.at_most("ms the longest", max(times) * 1000, 50)
    run.at_most("MB more memory", peak - start, 100)
    run.none("pieces of code run", watchman.seen + ([str(canary)] if canary.exists() else []))


def _work(front: Any, kind: str, refused: dict[str, int], wrong: list[Any]) -> float:
    """Read what was planted; returns the seconds of work, not of waiting: a machine that is busy is no defect."""
    begun = time.thread_time()
    try:
        front.read([TOP])
    except BadData:
        refused[kind] += 1
    except Exception as error:
        wrong.append((kind, error))
    return time.thread_time() - begun


def _plant(raw: Any, poison: Poison, kind: str, number: int) -> None:
    """Put a hostile value where REEM will read it."""
    tag = "{" + TOP + "}"
    if kind == "notice":
        raw.publish("{mirrored}:notices", poison.notice())
        return
    if kind == "placeholder":
        text = poison.inline() if number % 20 == 0 else poison.placeholder()
        document = json.dumps({"deep": [text]})
    else:
        blob = poison.header() if number % 4 == 1 else poison.mutant() if number % 16 != 2 else poison.noise()
        raw.set(f"{tag}.a", blob)
        document = json.dumps({"a": f"$ship {'bytes' if number % 50 == 2 else 'numpy'} .a 8 float64[1]"})
    raw.execute_command("JSON.SET", TOP, "$", document)


DTYPES = ["u1", "<i2", ">i4", "<u8", "<f4", ">f8", "<c8", "?", "S7", "<U2", "V5", "<M8[us]", ">m8[s]"]
STRUCT = [("a", "<f8"), ("b", "S3", (2,)), ("c", [("d", ">i2")])]


def _array(run: Run) -> np.ndarray[Any, Any]:
    """An array of a random dtype and shape whose bytes are line ends and commands."""
    dtype = np.dtype(STRUCT if run.rng.random() < 0.1 else run.rng.choice(DTYPES))
    shape = tuple(run.rng.randrange(1, 9) for _ in range(run.rng.randrange(4)))
    if run.rng.random() < 0.2:
        shape = (run.rng.randrange(500, 3000), *shape[:1])
    command = b"*3\r\n$5\r\nLPUSH\r\n$5\r\npwned\r\n$1\r\n1\r\n"
    prefix = run.rng.choice([b"", b"\r\n", b"\r\n" * 7, b"\n", b"+OK\r\n", b"\r\nLPUSH pwned 1\r\n"])
    size = dtype.itemsize * int(np.prod(shape, dtype=int))
    content = (prefix + command * (size // len(command) + 1))[:size]
    if dtype == np.dtype("?") or dtype.kind == "U":  # not every byte is a value of these
        return np.full(shape, "\r\n" if dtype.kind == "U" else True, dtype)
    array = np.frombuffer(content, dtype).reshape(shape)
    return array.T if run.rng.random() < 0.3 else array


def _protocol(run: Run, server: PrivateServer) -> None:
    count = run.size(2_000, 200)
    changed: list[Any] = []
    with Proxy(server.port) as proxy, server.raw() as raw, contextlib.ExitStack() as stack:
        raw.config_resetstat()
        spaces = [
            stack.enter_context(contextlib.closing(front(proxy.url, space)))
            for front in FRONTS.values()
            for space in ("KeyValueStore", "PublishSpace")
        ]
        reading = reem.KeyValueStore(stack.enter_context(contextlib.closing(reem.RedisInterface(server.url))))
        for number in range(count):
            array = _array(run)
            value = {"array": array, "text": "\r\n*1\r\n$4\r\nLPUSH\r\n", "bytes": b"\r\n" + array.tobytes()[:50]}
            spaces[number % 4].write(["arrays"], value)
            found = reading["arrays"].read()
            if (
                not same_bits(found["array"], array)
                or found["text"] != value["text"]
                or found["bytes"] != value["bytes"]
            ):
                changed.append(array)
        odd = [name for name in proxy.names if name in ("LPUSH", "(inline)") or not re.fullmatch(r"[A-Z.]+", name)]
        run.none("commands injected", odd)
        run.none("of them run", int("cmdstat_lpush" in raw.info("commandstats")) + raw.exists("pwned"))
        run.at_least("commands counted", proxy.commands, 2 * count)
    run.at_least("arrays of protocol bytes", count, count)
    run.none("changed", changed)
