"""Runs `reem`: in this process, as a user does, and in a terminal."""

import contextlib
import os
import pathlib
import subprocess
import sys
import threading

from conftest import line_of
from typer.testing import CliRunner

from reem_async.tools.cli import build
from reem_async.tools.recording import open_log

REEM = str(pathlib.Path(sys.executable).parent / "reem")
TERMINAL = "import os, pty, sys; sys.exit(os.waitstatus_to_exitcode(pty.spawn(sys.argv[1:])))"


def environment(**changes):
    """The variables of a user's shell; warnings are errors."""
    left_out = ("REEM_URL", "REEM_PASSWORD", "FORCE_COLOR", "NO_COLOR", "COLUMNS", "LINES", "DISPLAY")
    clean = {name: value for name, value in os.environ.items() if name not in left_out}
    settings = {"PYTHONWARNINGS": "error", "PYTHONUNBUFFERED": "1", "TERM": "xterm-256color"}
    return {**clean, **settings, **changes}


def invoked(*words, input=None, **changes):  # noqa: A002
    """Run a command in this process; `changes` are variables."""
    words = [*map(str, words)]
    run = CliRunner().invoke(build(), words, input, environment(**changes), prog_name="reem")
    assert run.exception is None or isinstance(run.exception, SystemExit), repr(run.exception)
    return subprocess.CompletedProcess(words, run.exit_code, run.stdout, run.stderr)


def finished(*words, cwd=None, **changes):
    """Run a command to its end, without a traceback; `changes` are variables."""
    command, env = [REEM, *map(str, words)], environment(**changes)
    run = subprocess.run(command, env=env, cwd=cwd, capture_output=True, text=True, timeout=30, check=False)
    assert "Traceback" not in run.stderr, run.stderr
    return run


@contextlib.contextmanager
def running(*words, env=None, **options):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **options}
    with subprocess.Popen([REEM, *map(str, words)], env=env or environment(), **pipes) as process:
        try:
            yield process
        finally:
            process.kill()


def said_until(process, start):
    """What a command prints, up to the line that begins so."""
    lines = []
    while not lines or not lines[-1].startswith(start):
        lines.append(process.stdout.readline())
        assert lines[-1], process.stderr.read()
    return "".join(lines)


class CommandLine:
    def __init__(self, url, namespace):
        self.url, self.namespace = url, namespace

    def environment(self, **changes):
        return environment(**{"REEM_URL": self.url, **changes})

    def words(self, command, *arguments):
        return [REEM, command, "--namespace", self.namespace, *map(str, arguments)]

    def __call__(self, command, *arguments, input=None, **changes):  # noqa: A002
        return invoked(*self.words(command, *arguments)[1:], input=input, **{"REEM_URL": self.url, **changes})

    def process(self, command, *arguments, **changes):
        return finished(*self.words(command, *arguments)[1:], **{"REEM_URL": self.url, **changes})

    def result(self, *arguments, **options):
        run = self(*arguments, **options)
        assert run.returncode == 0, run.stderr
        return run.stdout

    def error(self, code, *arguments, **options):
        """The one line of a command that must fail with this exit code."""
        run = self(*arguments, **options)
        assert run.returncode == code, (run.stdout, run.stderr)
        assert run.stdout == ""
        if code != 2:
            assert run.stderr.count("\n") == 1, run.stderr
        return run.stderr

    def running(self, command, *arguments, **options):
        return running(*self.words(command, *arguments)[1:], env=self.environment(), **options)

    def in_terminal(self, command, *arguments, keys=(), columns=100):
        return in_terminal(*self.words(command, *arguments)[1:], keys=keys, REEM_URL=self.url, COLUMNS=str(columns))


def in_terminal(*words, keys=(), **changes):
    """What a terminal shows of a command, and its exit code; `keys` are (text seen, what is typed then)."""
    with subprocess.Popen(
        [sys.executable, "-c", TERMINAL, REEM, *map(str, words)],
        env=environment(**{"COLUMNS": "100", **changes}),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        bufsize=0,
    ) as process:
        said, todo = b"", list(keys)
        patience = threading.Timer(60.0, process.kill)
        patience.start()
        while data := process.stdout.read(4096):
            said += data
            while todo and todo[0][0] in said:
                process.stdin.write(todo.pop(0)[1])
        patience.cancel()
        code = process.wait(10)
    assert not todo, said
    assert b"Traceback" not in said, said.decode()
    return said.decode(), code


# --- reem record -------------------------------------------------


def started(url, cwd, *words, **options):
    """A command in a folder, against a server; killed at the end."""
    return running(*words, env=environment(REEM_URL=url, COLUMNS="200"), cwd=cwd, **options)


def begins(process, *, as_json=False):
    """Wait until `reem record` says that it has begun: before that, a signal leaves no recording."""
    line = line_of((process.stdout if as_json else process.stderr).fileno())
    assert line.startswith('{"seconds":' if as_json else "recording into "), line + process.communicate()[1]
    return line


def is_recording(file):
    """Whether the first messages are in the file; that does not mean that the command has begun."""
    with contextlib.suppress(OSError, ValueError), open_log(file) as log:
        return bool(log.names())
