"""What the documentation shows is what happens: each page is followed word for word, and prints what it says.

How a page is written, so that it can be followed:

- `python` runs at once; `print(x)  # y` prints y. With `# name.py` as its first line it is saved under that name.
- `console` holds commands behind `$`, and below each what it prints. `...` stands for what differs between runs.
- `sh` holds commands that succeed, whatever they print.
- A command with the comment `until Ctrl-C` runs beside all that follows; what is printed below it is how its output
  begins.
- `bash` is for commands of other programs that cannot run here, such as docker. All other languages are shown only.
"""

import importlib.metadata
import importlib.util
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import redis
from conftest import ROOT, SLOW_MACHINE, eventually, python

import reem_async.errors
from benchmarks import summary
from benchmarks.results import FULL, Results
from reem_async.server import EmbeddedServer

PYTHON = os.environ.get("REEM_TEST_PYTHON", sys.executable)
"""`make dist` names the one of an environment that has the wheel alone."""
DOCS = ROOT / "docs"
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    DOCS / "llms.txt",
    *(path for path in sorted(DOCS.rglob("*.md")) if "generated" not in path.parts),
]
RUN = {"python", "console", "sh"}
SHOWN = {"text", "ini", "json", "toml", "yaml", "{toctree}", "{image}"}
ELSEWHERE = {
    "docker",
    "git",
    "cd",
    "sudo",
    "systemctl",
    "openssl",
    "deploy/prepare.sh",
    "export",
    "REEM_PASSWORD=...",
    "ros2",
}
"""What a block of `bash` may call: programs that do not run in a test."""
STARTS_NOTHING = {"pip", "uv", "uvx", "make"}
"""Commands whose effect is there already; the targets of make have to exist."""
LIVE = {"echo", "top", "hz", "bw", "delay", "record", "browse"}
"""Commands of reem that go on until Ctrl-C, unless an option says how long."""
NEEDS = {"foxglove": "foxglove-sdk", "zmq": "pyzmq"}


def title(path):
    return str(path.relative_to(ROOT))


def fenced(path):
    return re.findall(r"^```(\S+)[^\n]*\n(.*?)^```$", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def shaped(expected):
    """A pattern for text in which `...` stands for anything within a line, or alone for any lines."""
    lines = [
        r"(?:.*\n)*?" if line.strip() == "..." else re.escape(line).replace(re.escape("..."), r"[^\n]*") + "\n"
        for line in expected.splitlines()
    ]
    return re.compile("".join(lines))


def ends(process):
    try:
        return process.wait(30)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


class Reader:
    """Follows a page in an empty folder, beside a server that was started as the page says."""

    def __init__(self, folder, port):
        self.folder, self.port = folder, port
        self.redis = redis.Redis(port=port, protocol=3)
        self.live = []
        left_out = ("REEM_PASSWORD", "FORCE_COLOR", "COLUMNS", "LINES")
        clean = {name: value for name, value in os.environ.items() if name not in left_out}
        self.environment = {**clean, "REEM_URL": f"redis://localhost:{port}", "PYTHONUNBUFFERED": "1"}
        if not any(point.name == "reem" for point in importlib.metadata.entry_points(group="pytest11")):
            self.environment["PYTEST_PLUGINS"] = "reem_async.tools.pytest_plugin"  # installed before there was one

    def follow(self, blocks):
        try:
            for language, text in blocks:
                if language in RUN:
                    getattr(self, language)(text)
        finally:
            self.end()

    def python(self, code):
        """Save a program, or run it: its lines are those that its comments promise, in their order."""
        code = code.replace('"localhost"', f'"localhost:{self.port}"').replace(
            "redis.Redis()", f"redis.Redis(port={self.port})"
        )
        if name := re.match(r"# (\w+\.py)\n", code):
            (self.folder / name[1]).write_text(code, encoding="utf-8")
            return
        done = self.run([PYTHON, "-W", "error", "-c", code])
        assert (done.returncode, SLOW_MACHINE.sub("", done.stderr)) == (0, ""), done.stderr
        expected = "\n".join(re.findall(r"^ *print\(.*\)  # (.*)$", code, re.MULTILINE))
        assert shaped(expected).fullmatch(done.stdout), f"{done.stdout}\nis not\n{expected}"

    def console(self, text):
        for line, expected in re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", text, re.MULTILINE):
            self.command(line, expected)

    def sh(self, text):
        for line in text.splitlines():
            if line.strip() and not line.startswith("#"):
                self.command(line, None)

    def command(self, line, expected):
        """Run one command, to its end or, if it goes on until Ctrl-C, to the end of the page."""
        program, *words = shlex.split(line, comments=True)
        if program in STARTS_NOTHING:
            if program == "make":
                done = subprocess.run(["make", "-n", *words], cwd=ROOT, capture_output=True, text=True, check=False)
                assert done.returncode == 0, done.stderr
            return
        if program == "reem" and words[0] in ("up", "demo"):
            return  # the server is up
        if program == "redis-cli":
            said = self.redis.execute_command(*words)
            assert expected is None or shaped(expected).fullmatch(f"{said.decode()}\n"), said
            return
        flags = ["-W", "error"]
        start = {
            "reem": [str(Path(PYTHON).parent / "reem")],
            "python": [PYTHON, *flags],
            "pytest": [sys.executable, "-m", "pytest", "-p", "no:cacheprovider"],
            "sleep": ["sleep"],
        }
        bounded = any(word in words for word in ("--duration", "--count", "--timeout", "-n"))
        if "until Ctrl-C" in line or (program == "reem" and words[0] in LIVE and not bounded):
            self.begin([*start[program], *words], expected or "", program == "reem")
            return
        done = self.run([*start[program], *words])
        assert done.returncode == 0, (line, done.stdout, done.stderr)
        shown = done.stdout, done.stdout + done.stderr  # a page may leave out what is said beside the output
        assert expected is None or any(map(shaped(expected).fullmatch, shown)), f"{line}: {shown}\nis not\n{expected}"

    def begin(self, words, expected, says_something):
        """Start a program that goes on until Ctrl-C, and wait until it is connected or has printed something."""
        output = self.folder / f"output-{len(self.live)}.txt"
        before = len(self.redis.client_list())
        with output.open("w") as file:
            process = subprocess.Popen(
                words, cwd=self.folder, env=self.environment, stdout=file, stderr=subprocess.STDOUT
            )
        self.live.append((words, process, output, expected, says_something))
        deadline = time.monotonic() + (20 if says_something else 1.5)  # a program may do neither
        while process.poll() is None and not output.stat().st_size and len(self.redis.client_list()) <= before:
            if time.monotonic() > deadline:
                break
            time.sleep(0.02)
        time.sleep(0.2)  # what it does first: subscribe, read what is there
        assert process.poll() is None, output.read_text()

    def end(self):
        """Press Ctrl-C in each terminal once all show what the page says."""
        failed = sys.exception() is not None
        try:
            for program in self.live if not failed else ():
                self.shows(*program)
        finally:
            for _, process, *_ in self.live:
                process.send_signal(signal.SIGINT)
            ended = [(words, ends(process), output.read_text()) for words, process, output, *_ in self.live]
        assert [each for each in ended if each[1] not in (0, 130, -signal.SIGINT)] == []

    @staticmethod
    def shows(words, process, output, expected, says_something):
        try:
            eventually(lambda: shaped(expected).match(output.read_text()), 20)
            eventually(lambda: output.stat().st_size or not says_something, 20)
        except AssertionError as wrong:
            raise AssertionError(f"{words}: {output.read_text()}\nis not\n{expected}") from wrong

    def run(self, words):
        return subprocess.run(
            words, cwd=self.folder, env=self.environment, capture_output=True, text=True, timeout=60, check=False
        )


@pytest.fixture(scope="module")
def port():
    with EmbeddedServer() as server:
        yield server.port


FIRST = ROOT / "README.md"
"""What a newcomer follows first. The fast run leaves out the others: each program of theirs takes a second to start."""


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(page, marks=() if page == FIRST else pytest.mark.long)
        for page in PAGES
        if RUN & {language for language, _ in fenced(page)}
    ],
    ids=title,
)
def test_a_page_is_followed_word_for_word(path, port, tmp_path):
    blocks = fenced(path)
    for module, package in NEEDS.items():
        if (
            any(f"{word} {module}" in text for word in ("import", "reem") for _, text in blocks)
            and importlib.util.find_spec(module) is None
        ):
            pytest.skip(f"needs {package}")
    reader = Reader(tmp_path, port)
    if names := list(reader.redis.scan_iter(count=1000)):
        reader.redis.unlink(*names)  # of the page before
    reader.follow(blocks)


@pytest.mark.parametrize("path", PAGES, ids=title)
def test_every_block_is_run_or_only_shown(path):
    """A block of another language would be left out without a word; `bash` holds nothing that could run here."""
    for language, text in fenced(path):
        assert language in RUN | SHOWN | {"bash"}, language
        if language == "bash":
            whole = text.replace("\\\n", " ")
            assert {line.split()[0] for line in whole.splitlines() if line.strip()} <= ELSEWHERE, text


@pytest.mark.parametrize("path", PAGES, ids=title)
def test_links_lead_somewhere(path):
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", path.read_text(encoding="utf-8")):
        if "generated" not in target:
            assert (path.parent / target).exists(), target


def test_every_page_is_in_the_table_of_contents():
    listed = set(re.findall(r"^[\w/-]+$", (DOCS / "index.md").read_text(encoding="utf-8"), re.MULTILINE))
    assert {str(path.relative_to(DOCS).with_suffix("")) for path in PAGES if DOCS in path.parents} - listed <= {
        "index",
        "llms",
        "skills/reem/SKILL",
    }


def test_recordings_say_what_to_install():
    for module in ("reem.recording", "reem_async.recording"):
        done = python(f"import sys; sys.modules['mcap'] = None; import {module}")
        assert "ModuleNotFoundError: recordings need mcap: pip install " in done.stderr


def test_every_error_and_variable_is_in_the_reference():
    errors = (DOCS / "reference" / "errors.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^\| `(\w+)`", errors, re.MULTILINE))
    assert listed == set(reem_async.errors.__all__) - {"ReemError"}
    environment = (DOCS / "reference" / "environment.md").read_text(encoding="utf-8")
    source = "".join(
        path.read_text(encoding="utf-8") for front in ("reem", "reem_async") for path in (ROOT / front).rglob("*.py")
    )
    assert set(re.findall(r"\bREEM_[A-Z_]+\b", source)) <= set(re.findall(r"`(REEM_\w+)`", environment))


def test_the_figures_are_those_of_the_last_whole_run(tmp_path):
    page, image = tmp_path / "page.md", tmp_path / "chart.svg"
    page.write_text(summary.PAGE.read_text())
    summary.rewrite(Results.load(FULL), page, image)
    assert page.read_text() == summary.PAGE.read_text()
    assert image.read_text() == summary.CHART.read_text()


def test_the_readme_is_short_and_begins_with_what_it_is():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    first_screen = "\n".join(lines[:40])
    for part in (
        "reem.gif",
        "reem demo",
        "```python",
        "| ROS 2 |",
        "| Redis by hand |",
        "| ZeroMQ or Zenoh |",
        "| LeRobot |",
    ):
        assert part in first_screen
    assert (DOCS / "images" / "reem.gif").stat().st_size < 3_000_000


def test_a_decision_is_short():
    _, *entries = re.split(r"^## ", (DOCS / "decisions.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    for entry in entries:
        heading, *lines = [line for line in entry.splitlines() if line]
        assert re.findall(r"^\*\*(\w+)\.\*\*", "\n".join(lines), re.MULTILINE) == [
            "Context",
            "Decision",
            "Consequence",
        ], heading
        assert len(lines) <= 12, heading


def test_files_that_contributing_names_are_there():
    for line in (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").splitlines():
        folder = "."  # a name alone is in the folder of the one before it in the line
        for name in re.findall(r"[\w/]+\.py\b", line):
            folder = name.rpartition("/")[0] or folder
            places = [name, f"reem_async/{name}", f"{folder}/{name}", f"reem_async/{folder}/{name}"]
            assert any((ROOT / place).exists() for place in places), f"{name} in {line}"
