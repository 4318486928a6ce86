"""The page of promises names tests that exist."""

from __future__ import annotations

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
