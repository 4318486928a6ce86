"""Keys, paths and values, of every kind that makes a difference somewhere."""

from __future__ import annotations

import json
import random
import string
from typing import Any

import numpy as np
from test_bad_input import VALUES, Colour
from test_values import FLOATS

from reem_async.errors import BadInput

from .model import ABSENT, CALCULATIONS, CHANGES, READS, Op, found, refused_in_path

NAMESPACES = ("", "r:", "r:一.")
PLAIN = ["a", "b", "ab", "n", "list", "image"]
ODD = [
    "", "b.c", ".", "..", "*", "$", "$ship a", "$ship numpy .a 8", "[0]", "0", "-1", "~", "a~b", "a%20", "%", "'", '"',
    "it's", 'say "x"', "]", '"]', "a b", "b ", "\t", "\n", "\r\n", "\x00", "\x7f", "é", "一", "가", "Ā", "😀", "\u2028",
    ":ships", ":last", ":notices", "a/b", "@", "?(@.a)", "a,b", "null", "x" * 200,
]  # fmt: skip
BRACES = ["{a}", "a{", "}"]
UNADDRESSABLE = [" x", " ", "\\", "a\\b", "'\""]
WRONG = ["\ud800", None, True, 1.5, b"a", ("a",), Colour.RED, 2**63, -(2**63) - 1, 10**400]
INDEXES = [0, 1, 2, -1, -2, -3, 7, -7, 2**63 - 1, -(2**63), np.int64(0), np.int8(-1)]
TOPS = [
    "pose", "poses", "po.se", "pose ", " pose", "一", "😀Ā", "$ship x", "it's", 'q"', "\\", "'\"", "a\r\nb", "*", "[0]",
    "0", ":", "~", "x:ships", "%41", "x" * 505, "é" * 251, "r:pose",
]  # fmt: skip
"""With each namespace at most 512 bytes."""
BAD_TOPS = ["", "a{b", "}", "x" * 513, "a\ud800", None, 5, True, b"a", ("a",), Colour.RED]
BAD_VALUES = [(value, error) for error, value in VALUES.values()]
OPERANDS = [1, -1, 2, 3, 0, -0.0, 0.0, 0.5, -1.5, 10, 7, 0.1, 2**62, -(2**63), 2**63 - 1, 1e300, True, "1", None]
DTYPES = ["u1", "i2", "<i8", ">i4", "f4", "f8", "?", "c8", "U3", "S2", "M8[ns]", "m8[s]", [("x", "f4"), ("n", "u1", 2)]]
LARGE = 100_000
"""Bytes of a large array: REEM gives such ones a connection of their own."""


class Inputs:
    """Makes inputs from one source of chance."""

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng

    def key(self) -> Any:
        rng, kind = self.rng, self.rng.random()
        if kind < 0.5:
            return rng.choice(PLAIN)
        if kind < 0.75:
            return rng.choice(ODD + BRACES)
        if kind < 0.85:
            return rng.choice(INDEXES)
        if kind < 0.92:
            return chr(
                rng.choice([rng.randrange(1, 0xD7) * 256, rng.randrange(0xD800), rng.randrange(0x10000, 0x110000)])
            )
        return rng.choice(UNADDRESSABLE) if kind < 0.97 else rng.choice(WRONG)

    def name(self) -> str:
        """Return a key of a dict: those too that no path can address."""
        return str(self.rng.choice(PLAIN if self.rng.random() < 0.6 else ODD + BRACES + UNADDRESSABLE))

    def array(self) -> Any:
        rng = self.rng
        if rng.random() < 0.05:
            return np.full(LARGE, rng.randrange(256), np.uint8)
        shape = tuple(rng.choice([0, 1, 2, 3]) for _ in range(rng.randrange(4)))
        dtype = np.dtype(rng.choice(DTYPES))
        if dtype.kind == "U":
            return np.full(shape, rng.choice(["", "é", "a\x00b", "😀"]), dtype)
        made = np.frombuffer(rng.randbytes(max(1, int(np.prod(shape))) * dtype.itemsize), dtype)
        if dtype.kind == "b":
            made = made.view("u1") % 2 == 1
        return (made if 0 in shape else made.reshape(shape)) if 0 not in shape else np.zeros(shape, dtype)

    def leaf(self) -> Any:
        rng, kind = self.rng, self.rng.randrange(12)
        if kind < 3:
            return self.array()
        if kind == 3:
            return rng.choice([b"", b"\r\n", b"$ship ", bytes(range(256)), rng.randbytes(2000)])
        if kind < 6:
            return rng.choice(
                [0, 1, -1, 5, 100, 2**53 + 1, 2**63 - 1, -(2**63), 2**64 - 1, rng.randrange(-(2**63), 2**64)]
            )
        if kind < 8:
            return rng.choice([rng.uniform(-1, 1), 1.7e9 + rng.random() * 1e7, 0.5, rng.choice(FLOATS)])
        if kind == 8:
            return rng.choice(
                ["", "text", "$ship ", "$ship text x", "$ship numpy .a 3", "\x00", "é😀", "\u2028", "x" * 3000]
            )
        if kind == 9:
            return rng.choice([np.float32(0.1), np.int64(-3), np.bool_(True), np.float64(0.1), True, False])
        return rng.choice([True, False, None, [], {}])

    def value(self, depth: int = 0) -> Any:
        kind = self.rng.random()
        if depth > 2 or kind < 0.45:
            return self.leaf()
        if kind < 0.7:
            items = [self.value(depth + 1) for _ in range(self.rng.randrange(4))]
            return tuple(items) if self.rng.random() < 0.1 else items
        return {self.name(): self.value(depth + 1) for _ in range(self.rng.randrange(5))}

    def path(self, document: Any) -> tuple[Any, ...]:
        """Return a path below a top-level key, mostly to what is there."""
        rng, path, tree = self.rng, [], document
        while isinstance(tree, dict | list) and tree and rng.random() < 0.75:
            if isinstance(tree, dict):
                path.append(rng.choice(list(tree)))
            else:
                index = rng.randrange(len(tree))
                path.append(index - len(tree) if rng.random() < 0.4 else index)
            tree = tree[path[-1]]
        if rng.random() < 0.35:
            path.append(self.key())
        return tuple(path[:5])

    def op(self, top: Any, document: Any, names: tuple[str, ...] = READS + CHANGES + ("write",) * 5) -> Op:
        rng, name = self.rng, self.rng.choice(names)
        path = self.path(document)
        if name in (*CALCULATIONS, "append", "extend", "edit") and rng.random() < 0.8:
            kinds = {"append": list, "extend": list, "edit": (dict, list, np.ndarray)}.get(name, (int, float))
            fitting = [place for place in _places(document, 4) if isinstance(found(document, place), kinds)]
            path = rng.choice(fitting) if fitting else path
        if name == "contains":
            path = ()
        if name in ("setdefault", "has", "pop") and (not path or (name != "pop" and not isinstance(path[-1], str))):
            path = (*path[:-1], self.name()) if path else (self.name(),)
        if name == "update" and not all(isinstance(key, str) for key in path):
            path = ()  # in lists with arrays it is refused
        if name in ("get_dotted", "set_dotted") and dotted((top, *path)) is None:
            name = "read" if name == "get_dotted" else "write"
        whole = (top, *path)
        if name in CALCULATIONS:
            value = rng.choice(OPERANDS)
            if name == "multiply" and isinstance(value, str | None.__class__):
                value = 2
            return Op(name, whole, value)
        if name == "get":
            return Op(name, whole, rng.choice([None, 0, "default"]))
        if name not in CHANGES or name in ("delete", "pop"):
            return Op(name, whole)
        return self._valued(name, whole)

    def _valued(self, name: str, path: tuple[Any, ...]) -> Op:
        bad = self.rng.random() < 0.05
        value, refused = self.rng.choice(BAD_VALUES) if bad else (self.value(len(path)), None)
        if name == "extend":
            value = [self.value(2), value] if bad else [self.value(2) for _ in range(self.rng.randrange(4))]
        if name == "edit":
            value = (self.name(), value)
        if name == "update":
            names = [each for each in (*PLAIN, *ODD, *BRACES) if not refused_in_path(each)]
            value = dict.fromkeys(self.rng.sample(names, self.rng.randrange(4))) | ({"b": value} if bad else {})
            value = {each: value[each] if each == "b" and bad else self.value(2) for each in value}
        return Op(name, path, value, BadInput if refused else None)


def _places(tree: Any, depth: int) -> list[tuple[Any, ...]]:
    """Return the paths to all that a path can address."""
    places: list[tuple[Any, ...]] = [] if tree is ABSENT else [()]
    if depth and isinstance(tree, dict | list):
        pairs = tree.items() if isinstance(tree, dict) else enumerate(tree)
        places += [
            (key, *inner) for key, value in pairs if not refused_in_path(key) for inner in _places(value, depth - 1)
        ]
    return places


def dotted(path: tuple[Any, ...]) -> str | None:
    top, *rest = path
    if not isinstance(top, str) or any(type(key) not in (str, int) or refused_in_path(key) for key in rest):
        return None
    simple = set(string.ascii_letters + string.digits)
    if top and set(top) <= simple:
        text = top
    elif top and not refused_in_path(top):
        text = f"[{json.dumps(top)}]"
    else:
        return None
    for key in rest:
        plain = isinstance(key, str) and key and set(key) <= simple
        text += f".{key}" if plain else f"[{json.dumps(key, ensure_ascii=False)}]"
    return text
