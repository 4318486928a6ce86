"""The page of promises names tests that exist."""

import re

import pytest
from conftest import ROOT

TEXT = (ROOT / "docs" / "guarantees.md").read_text(encoding="utf-8")
TESTS = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "tests").glob("test_*.py")}


def test_the_page_names_tests():
    assert len(re.findall(r"test_\w+", TEXT)) > 15


@pytest.mark.parametrize("name", sorted(set(re.findall(r"\btest_\w+\.py", TEXT))))
def test_every_file_named_is_there(name):
    assert name in TESTS


@pytest.mark.parametrize("name", sorted(set(re.findall(r"\btest_\w+\b(?!\.py)", TEXT))))
def test_every_test_named_is_there(name):
    assert any(f"def {name}(" in text for text in TESTS.values())


def fast(name):
    """Return whether the fast run has a test, or any test of a file."""
    pattern = r"def test_\w+\(" if name.endswith(".py") else rf"def {name}\("
    texts = [TESTS[name]] if name.endswith(".py") else [text for text in TESTS.values() if f"def {name}(" in text]
    heads = [text[: found.start()].rpartition("\n\n")[2] for text in texts for found in re.finditer(pattern, text)]
    return any("mark.long" not in head and "mark.alone" not in head for head in heads) and not any(
        "pytestmark = pytest.mark.long" in text for text in texts
    )


PROMISES = dict(re.findall(r"^### (\d+\. .*?)\n(.*?)(?=^##|\Z)", TEXT, re.MULTILINE | re.DOTALL))


def test_each_number_is_used_once():
    numbers = [int(promise.partition(".")[0]) for promise in PROMISES]
    assert sorted(numbers) == list(range(1, len(numbers) + 1))


@pytest.mark.parametrize("promise", PROMISES)
def test_the_fast_run_fails_if_a_promise_breaks(promise):
    """Some promises have nothing but a test that takes long or measures time: none may."""
    names = re.findall(r"\btest_\w+(?:\.py)?", PROMISES[promise])
    assert any(fast(name) for name in names), f"{names} are all in the long run only"
