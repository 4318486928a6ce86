"""The program between an embedded server and its owner: when the owner ends, so does the server.

Run as a script, never imported; it uses the standard library alone, so that it is up in a few milliseconds.

How it knows that the owner ended: its standard input is a pipe that only the owner can write to, and the
kernel closes that pipe however the owner ends, kill -9 included. This works on Linux and macOS, and from any
thread: Linux's parent-death signal alone would fire when the *thread* that started the server ends.

Whom it signals: its own process group, which is the server and whatever a wrapper script around it has
started, and whose number cannot become another group's while the watchdog lives. How it knows that all of
them are gone: they inherit the writing end of a second pipe, and the reading end comes to its end.

Its input is one line of JSON: program, config, scratch, lock. Its output, one line each: `pid N`,
`busy` (another server holds the directory), `failed WHY`, `exited CODE`.
"""

from __future__ import annotations

import ctypes
import fcntl
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType

STOP_SECONDS = 10.0  # what a server gets to write its data before it is killed
LOCK_SECONDS = 5.0  # what the last server of a directory gets to end
PR_SET_PDEATHSIG = 1
OWNER = 0  # standard input


def main() -> None:
    """Serve one owner from its order to its end."""
    # The SIGTERM sent to the group below; and a `pkill python`, which reaches the owner too and is noticed by
    # its end. Handlers, not SIG_IGN: the server would inherit that.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _carry_on)
    line = sys.stdin.buffer.readline()
    if not line.endswith(b"\n"):
        return  # the owner ended before it could ask for anything
    order = json.loads(line)
    alive, inherited = os.pipe()
    server = _start(order["program"], order["config"].encode(), order["lock"], inherited)
    os.close(inherited)
    if server is not None and _ends_before_owner(alive):
        _say(f"exited {server.wait()}")
    os.read(OWNER, 1)  # blocks until the owner has ended or wants the server stopped
    os.killpg(0, signal.SIGTERM)
    stopped = bool(select.select([alive], [], [], STOP_SECONDS)[0])
    if server is not None:
        if not stopped:
            server.kill()
        server.wait()  # from now on its port is free
    _remove(order["scratch"])
    if not stopped:
        os.killpg(0, signal.SIGKILL)  # what a wrapper script has started, and this process


def _carry_on(_number: int, _frame: FrameType | None) -> None:
    """Let the signal be."""


def _start(program: str, config: bytes, lock: str | None, alive: int) -> subprocess.Popen[bytes] | None:
    """Start the server and report it; None, and a report why, if that was not possible."""
    try:
        # The server inherits the lock and so holds it for as long as it lives.
        held = [alive] if lock is None else [alive, _lock(lock)]
        # The configuration goes in by a pipe: a password is neither in `ps` nor in a file.
        # preexec_fn is safe here and only here: this process has one thread.
        server = subprocess.Popen(  # noqa: S603 - chosen by the user
            [program, "-"],
            stdin=subprocess.PIPE,
            stdout=sys.stderr,  # the log file
            pass_fds=held,
            preexec_fn=_end_with_parent(),
        )
    except BlockingIOError:
        _say("busy")
        return None
    except OSError as error:
        _say(f"failed {error}")
        return None
    assert server.stdin is not None
    with suppress(OSError):  # it may have ended already: that is reported later
        server.stdin.write(config)
        server.stdin.close()
    _say(f"pid {server.pid}")
    return server


def _end_with_parent() -> Callable[[], None] | None:
    """What makes the server end with the watchdog, should both be killed (`killall -9 python`).

    Linux only. Here the parent-death signal is sound: this process has no thread that could end before it.
    """
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None).prctl
    parent = os.getpid()

    def in_child() -> None:
        prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:
            os._exit(1)

    return in_child


def _lock(path: str) -> int:
    """Lock the file and return its descriptor; BlockingIOError if another server keeps it."""
    file = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    deadline = time.monotonic() + LOCK_SECONDS
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.02)
        else:
            return file


def _ends_before_owner(alive: int) -> bool:
    """Wait for the end of the server or of the owner; whether it was the server's."""
    return OWNER not in select.select([OWNER, alive], [], [])[0]


def _remove(folder: str) -> None:
    import shutil  # only now: it would be a third of the start-up time

    shutil.rmtree(folder, ignore_errors=True)


def _say(text: str) -> None:
    with suppress(OSError):  # the owner has ended
        os.write(1, f"{text}\n".encode())


if __name__ == "__main__":
    main()
