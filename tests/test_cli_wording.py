"""Messages of the library advise what can be typed on the command line too, not only arguments of Python."""

import ast
import re

import numpy as np
from conftest import ROOT

import reem as blocking
from examples.custom_ship import Scan, ScanShip
from reem import NumpyShip

APART = ("tools/cli", "tools/browser", "tools/notebook.py")  # themselves, addresses of the page, HTML
CORE = [
    path for path in sorted((ROOT / "reem_async").rglob("*.py")) if not any(part in path.as_posix() for part in APART)
]

ARGUMENT = re.compile(r"(?<![?&\w])[a-z][a-z_]+=(?!\{\})|RedisInterface\((?!\{\})|\bappend\(\)")
"""What a message advises a program: `timeout=`, `RedisInterface(...)`. `timeout={}` complains of what was given."""

TYPED = re.compile(r"--\w|[?&]\w+=|://|PYTHONWARNINGS")
"""What can be typed: an option, one in a URL, a URL, a variable."""

OF_PROGRAMS = {
    "pubsub/callbacks.py": ["such as ttl=0.2"],  # no command has a callback
    "pubsub/mirror.py": ["use one of the two"],  # no command has a mirror
    "ships/registry.py": ["read it in a program that has this ship"],
    "coordination/parameter_objects.py": ["each field has its own"],  # no command declares a parameter
    "plan/leases.py": ["own(take=True)"],  # no command owns a key
    "store/send_queue.py": ["on_error= is for wait=False"],  # commands wait
    "plan/documents.py": ["value.to_dict(as_series=False)"],  # of a data frame, which no command can hold
    "transport/options.py": [
        "leave protocol= out",  # named as it stands in the URL
        "leave ssl= out",  # likewise
        "user and password go in username=",  # of a host without a scheme, which commands give one
    ],
}
"""What no command can meet, or what can be typed as it is said."""


def messages():
    """Every text with blanks in it, except docstrings: the file and the text, {} for what is filled in."""
    for path in CORE:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        nodes = list(ast.walk(tree))
        inner = {id(value) for node in nodes if isinstance(node, ast.JoinedStr) for value in node.values}
        alone = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        for node in nodes:
            if isinstance(node, ast.JoinedStr):
                text = "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and not {id(node)} & (inner | alone):
                text = node.value
            else:
                continue
            if " " in text:
                yield path.relative_to(ROOT / "reem_async").as_posix(), text


def test_no_message_advises_what_cannot_be_typed():
    wrong = [
        f"{file}: {text}"
        for file, text in messages()
        if ARGUMENT.search(text)
        and not TYPED.search(text)
        and not any(known in text for known in OF_PROGRAMS.get(file, ()))
    ]
    assert wrong == []


def test_a_value_of_a_ship_says_that_a_program_reads_it(cli):
    with blocking.RedisInterface(cli.url, namespace=cli.namespace, ships=[ScanShip(), NumpyShip()]) as interface:
        blocking.KeyValueStore(interface)["scan"] = {"last": Scan("front", np.zeros((2, 3)))}
    assert "read it in a program that has this ship" in cli.error(1, "get", "scan", "--json")
