"""What the documentation shows is what happens: every Python block runs, and prints what it says."""

from __future__ import annotations

import re
import subprocess

import pytest
from conftest import ROOT, python

DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(ROOT.glob("docs/*.md"))]


def blocks(path, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


PROGRAMS = [
    pytest.param(code, id=f"{path.name}-{number}")
    for path in DOCUMENTS
    for number, code in enumerate(blocks(path, "python"))
]


def run(code, url, prefix):
    """Run a block on the test server, its keys out of the way of others; returns the lines it printed."""
    if "Embedded" in code:
        if python("from reem_async._server_programs import find_program; find_program()").returncode:
            pytest.skip("there is no embedded server here")
    else:
        assert '"localhost"' in code, "a block that connects to something else would not be redirected"
        assert "6379" not in code
        connected = re.findall(r'RedisInterface\((?:host=)?"localhost"', code)
        assert code.count('"localhost"') == len(connected), "only RedisInterface takes a namespace"
        code = code.replace('"localhost"', f"{url!r}, namespace={prefix!r}")
    done = python(code)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout.splitlines()


def test_there_are_programs_to_run():
    """A change of the fences would otherwise pass unseen."""
    assert len(blocks(ROOT / "README.md", "python")) >= 4


@pytest.mark.parametrize("code", PROGRAMS)
def test_a_block_runs_and_prints_what_its_comments_say(code, server_url, key):
    """`print(x)  # y` prints y; those of callbacks come in between."""
    printed = run(code, server_url, key(""))
    expected = re.findall(r"^ *print\(.*\)  # (.*)$", code, re.MULTILINE)
    assert [line for line in printed if line in expected] == expected, printed
    callback = [line for line in printed if line not in expected]
    if "on_update" in code:
        text = (ROOT / "README.md").read_text(encoding="utf-8")
        assert callback == ["left arm 0.0", "left arm.joint 1.5"]
        assert all(f"`{line}`" in text for line in callback)
    else:
        assert callback == []


def test_the_document_shown_is_what_the_server_holds(server_url, key, raw):
    """After the first block of the README."""
    (shown,) = blocks(ROOT / "README.md", "console")
    command, document = shown.strip().splitlines()
    assert command == "$ redis-cli JSON.GET foo"
    run(blocks(ROOT / "README.md", "python")[0], server_url, key(""))
    assert raw.execute_command("JSON.GET", key("foo")) == document


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    """Those to files of this repository."""
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", path.read_text(encoding="utf-8")):
        assert (path.parent / target).exists(), target


def test_the_commands_of_make_exist():
    """`make demo`, `make test`, `make check`, on the first screen."""
    first_screen = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()[:16]
    for target in ("demo", "test", "check"):
        assert any(line.startswith(f"make {target} ") for line in first_screen), target
        done = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
