"""IPython and Jupyter: completion by the real completer, what a notebook shows, and outlines."""

import re

import numpy as np
import pytest

import reem
from reem_async.store.catalog import Outline
from reem_async.tools.notebook import picture_of


@pytest.fixture(scope="module")
def shell():
    interactive = pytest.importorskip("IPython.core.interactiveshell", reason="IPython is not installed")
    from traitlets.config import Config

    quiet = {"HistoryManager": {"enabled": False}, "Completer": {"use_jedi": False}}  # jedi knows nothing of keys
    return interactive.InteractiveShell(config=Config(quiet))


def completed(shell, text):
    from IPython.core.completer import provisionalcompleter

    with provisionalcompleter():
        return [text[: it.start] + it.text for it in shell.Completer.completions(text, len(text))]


def test_keys_complete_at_any_depth(shell, kvs, key):
    """As IPython does it: it evaluates what stands before the bracket only where it knows that this has no effect."""
    kvs[key()] = {"arm": {"left": 1, "right": 2}, "m.a": 3}
    shell.push({"kvs": kvs})
    shell.run_line_magic("load_ext", "reem")
    top = f'kvs["{key()}'
    assert top in completed(shell, top[:-1])
    assert completed(shell, f'{top}"]["') == [f'{top}"]["arm', f'{top}"]["m.a']
    assert completed(shell, f'{top}"]["arm"]["l') == [f'{top}"]["arm"]["left']


def test_a_notebook_shows_an_array_as_a_picture(shell):
    """Only with the extension; the numbers stay beside it."""
    image = np.zeros((20, 30, 3), np.uint8)
    shell.run_line_magic("load_ext", "reem_async")
    shown = shell.display_formatter.format(image)[0]
    assert shown["text/html"].startswith('<img src="data:image/png;base64,iVBOR')
    assert "uint8[20,30,3], black is 0, white is 255" in shown["text/html"]
    assert "text/plain" in shown
    shell.run_line_magic("unload_ext", "reem_async")
    assert "text/html" not in shell.display_formatter.format(image)[0]


def test_a_notebook_shows_the_pictures_in_a_dict(shell):
    value = {"t": 1.5, "cam": {"rgb": np.zeros((20, 30, 3), np.uint8), "<b>": np.eye(4)}}
    shell.run_line_magic("load_ext", "reem_async")
    shown = shell.display_formatter.format(value)[0]["text/html"]
    assert shown.count("data:image/png") == 1
    assert "[&#x27;cam&#x27;][&#x27;rgb&#x27;]" in shown
    assert "&#x27;rgb&#x27;: &lt;uint8[20, 30, 3]&gt;" in shown
    assert "&lt;b&gt;" in shown
    many = {str(number): value["cam"] for number in range(10)}
    assert shell.display_formatter.format(many)[0]["text/html"].count("data:image/png") == 4
    assert "text/html" not in shell.display_formatter.format({"a": [1, 2]})[0]
    shell.run_line_magic("unload_ext", "reem_async")
    assert "text/html" not in shell.display_formatter.format(value)[0]


@pytest.mark.parametrize(
    ("array", "caption"),
    [
        (np.full((16, 16), np.nan), "float64[16,16], black is 0, white is 1, 256 of 256 are NaN or infinite"),
        (np.arange(320.0).reshape(16, 20), "float64[16,20], black is 0, white is 319"),
        (np.ones((16, 16, 4), bool), "bool[16,16,4], black is 0, white is 1"),
        (np.eye(4), None),
        (np.zeros(1000), None),
        (np.zeros((20, 20, 2)), None),
        (np.zeros((20, 0)), None),
        (np.full((20, 20), "a"), None),
        (np.zeros((20, 20), complex), None),
    ],
    ids=lambda it: f"{it.dtype}{it.shape}" if isinstance(it, np.ndarray) else "",
)
def test_what_is_a_picture(array, caption):
    """Small matrices and what has no rows and columns stay numbers."""
    shown = picture_of(array)
    assert (shown and re.search("<div>(.*)</div>", shown)[1]) == caption


def test_an_outline_is_a_line_for_each_value(kvs, pspace, key):
    """Arrays are not fetched; what a terminal would obey is not printed."""
    name = key()
    kvs[name] = {
        "n": 1,
        "image": np.zeros((4, 3), np.uint8),
        "m.a": {"x\x1b[31m": None},
        "l": [1, 2],
        "ll": [np.ones(2)],
    }
    assert str(kvs[name].outline()).split("\n") == [
        f"{name}: dict of 5",
        "    n: 1",
        "    image: uint8[4,3], 12 bytes",
        '    ["m.a"]: dict of 1',
        '        ["x\\u001b[31m"]: None',
        "    l: list of 2, [1, 2]",
        "    ll: list of 1",
        "        [0]: float64[2], 16 bytes",
    ]
    assert str(kvs[name]["image"].outline()) == f"{name}.image: uint8[4,3], 12 bytes"
    assert str(Outline(("a\x07",), "int", "", 1)) == "'a\\x07': 1"
    kvs[name] = {f"k{number}": number for number in range(300)}
    lines = repr(kvs[name].outline()).split("\n")
    assert (len(lines), lines[-1]) == (201, "…")
    with pytest.raises(reem.MissingKey):
        kvs[name]["none"].outline()
    with pytest.raises(reem.WriteOnly):
        pspace[name].outline()


async def test_the_awaited_outline(akvs, key):
    await akvs[key()].write({"a": np.zeros(3)})
    assert str(await akvs[key()].outline()) == f"{key()}: dict of 1\n    a: float64[3], 24 bytes"
