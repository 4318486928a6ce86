"""What the documentation shows is what happens: every Python block runs, and prints what it says."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
import time

import pytest
import redis
from conftest import ROOT, SLOW_MACHINE, eventually, python
from test_cli import REEM

import reem
from reem_async.server.programs import find_program

DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(ROOT.glob("docs/*.md"))]


def blocks(path, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


PROGRAMS = [
    pytest.param(code, id=f"{path.name}-{number}")
    for path in DOCUMENTS[1:]  # the README is followed as a whole
    for number, code in enumerate(blocks(path, "python"))
]


def run(code, url, prefix):
    """Run a block on the test server, its keys out of the way of others; returns the lines it printed."""
    if "Embedded" in code:
        if python("from reem_async.server.programs import find_program; find_program()").returncode:
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
    """`print(x)  # y` prints y, and nothing else is printed."""
    printed = run(code, server_url, key(":"))
    expected = re.findall(r"^ *print\(.*\)  # (.*)$", code, re.MULTILINE)
    assert printed == expected


def fenced(path):
    """The blocks of a document, in order: language and text."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


class Newcomer:
    """Follows a document in an empty folder, beside a server of his own that was started as the document says."""

    def __init__(self, folder, port):
        self.folder, self.port = folder, port
        self.redis = redis.Redis(port=port)
        left_out = ("REEM_URL", "REEM_PASSWORD", "FORCE_COLOR", "COLUMNS", "LINES")
        clean = {name: value for name, value in os.environ.items() if name not in left_out}
        self.environment = {**clean, "REEM_URL": f"redis://localhost:{port}"}

    def python(self, code):
        """Paste a program into a file and run it: its lines are those that its comments promise, in their order."""
        code = code.replace('RedisInterface("localhost")', f'RedisInterface("localhost:{self.port}")')
        done = self.run([sys.executable, "-X", "dev", "-W", "error", "-c", code])
        assert (done.returncode, SLOW_MACHINE.sub("", done.stderr)) == (0, ""), done.stderr
        printed = done.stdout.splitlines()
        called = ["left arm 0.0", "left arm.joint 1.5"] if "on_update" in code else []  # from a thread of its own
        assert [line for line in printed if line in called] == called
        assert [line for line in printed if line not in called] == re.findall(
            r"^ *print\(.*\)  # (.*)$", code, re.MULTILINE
        )

    def console(self, text):
        """Run each command; what is printed below it is what it prints."""
        for command, said in re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", text, re.MULTILINE):
            program, *words = command.split()
            if program == "redis-cli":
                assert self.redis.execute_command(*words).decode() + "\n" == said
            else:
                assert program == "reem"
                done = self.run([REEM, *words])
                assert (done.returncode, done.stdout, done.stderr) == (0, said, "")

    def shell(self, text):
        """Run the commands of a block: those that end one after the other, live ones all together until Ctrl-C."""
        lines = [shlex.split(line, comments=True) for line in text.splitlines()]
        commands = [words for program, *words in lines if program == "reem" and words[0] != "up"]
        assert {program for program, *_ in lines} <= {"reem", "pip", "make"}
        for words in [words for words in commands if words[0] not in LIVE]:
            if words[0] == "play":  # what was recorded meanwhile
                self.live([words for words in commands if words[0] in LIVE and "--log" not in words])
            done = self.run([REEM, *words])
            assert done.returncode == 0, (words, done.stderr)
        self.live([words for words in commands if "--log" in words])

    def live(self, commands):
        """Run commands that go on until Ctrl-C; each says something within its time, and ends well."""
        if not commands:
            return
        with contextlib.ExitStack() as stack:
            running = [
                (words, self.folder / f"{number}.txt", self.begin(stack, words, self.folder / f"{number}.txt"))
                for number, words in enumerate(commands)
            ]

            with reem.RedisInterface(f"localhost:{self.port}") as interface:
                space = reem.PublishSpace(interface)

                def heard():
                    space.update(robot={"battery": 0.5}, raw_image={"size": 1})
                    time.sleep(0.05)
                    return all(output.stat().st_size for _, output, _ in running)

                eventually(heard, 60)
            for words, output, process in running:
                process.send_signal(signal.SIGINT)
                assert process.wait(30) == 0, (words, output.read_text())

    def begin(self, stack, words, output):
        file = stack.enter_context(output.open("w"))
        process = stack.enter_context(
            subprocess.Popen(
                [REEM, *words], cwd=self.folder, env=self.environment, stdout=file, stderr=subprocess.STDOUT
            )
        )
        stack.callback(process.kill)
        return process

    def run(self, words):
        return subprocess.run(
            words, cwd=self.folder, env=self.environment, capture_output=True, text=True, timeout=60, check=False
        )


LIVE = {"echo", "top", "hz", "record", "browse"}


def test_the_readme_is_followed_word_for_word(tmp_path):
    """By a newcomer: every block in its order, in an empty folder, with a server that `reem up` started."""
    try:
        find_program()
    except reem.ServerMissing as missing:
        pytest.skip(f"there is no embedded server here: {missing}")
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert text.index("pip install") < text.index("reem up") < text.index("```python")
    assert re.findall("`(left arm.*?)`", text) == ["left arm 0.0", "left arm.joint 1.5"]
    words = [REEM, "up", "--port", "0"]  # the document's own port may be taken
    with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as server:
        try:
            (port,) = re.findall(r"localhost:(\d+)", "".join(server.stdout.readline() for _ in range(2)))
            newcomer = Newcomer(tmp_path, int(port))
            what = {"python": newcomer.python, "console": newcomer.console, "sh": newcomer.shell}
            followed = [(language, what[language](block)) for language, block in fenced(ROOT / "README.md")]
            assert [language for language, _ in followed].count("python") >= 5
        finally:
            server.send_signal(signal.SIGINT)
            server.wait(30)


def test_recordings_say_what_to_install():
    """Where the extra is missing."""
    for module in ("reem.recording", "reem_async.recording"):
        done = python(f"import sys; sys.modules['mcap'] = None; import {module}")
        assert done.stderr.endswith("ModuleNotFoundError: recordings need mcap: pip install 'reem-async[tools]'\n")


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
