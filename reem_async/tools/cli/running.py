"""Running a command: one server, one event loop, errors as one line and an exit code.

Exit codes: 0 done, 1 failed, 2 usage error (or the file exists; use --force), 3 not found, 4 timed out (--timeout).
Ctrl-C is how a live command is ended, so it exits with 0; any other command exits with 130.
"""

from __future__ import annotations

import asyncio
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from typing import Any

import typer

from ...connection import RedisInterface
from ...errors import BadInput, MissingKey, RedisError, ReemError
from .output import clean

# Scripts depend on these numbers: the same in every command, listed in docs/reference/environment.md.
FAILED, USAGE, NOTHING, TIMED_OUT, INTERRUPTED = 1, 2, 3, 4, 130

PASSWORD_VARIABLE = "REEM_PASSWORD"  # noqa: S105 - the name of a variable

_HAS_PASSWORD = re.compile(r"[^:]*://[^/?]*:[^/?]*@")

CALL_SECONDS = 5.0
"""How long a call may take: more than a program's second, since a person may sit behind a slow network."""


class CommandFailed(Exception):
    """A command cannot be done; the message says why and what to do."""

    def __init__(self, message: str, code: int = FAILED) -> None:
        super().__init__(message)
        self.code = code


Work = Callable[[RedisInterface], Coroutine[Any, Any, int | None]]


def run(
    name: str,
    work: Work,
    url: str,
    namespace: str,
    *,
    live: bool = False,
    ships: Sequence[Any] | None = None,
) -> None:
    """Connect, do `work`, which returns the exit code, and turn what goes wrong into a line and an exit code.

    A `live` command goes on until Ctrl-C.
    """
    run_local(name, lambda: asyncio.run(_connected(work, url, namespace, ships)), live=live)


def run_local(name: str, work: Callable[[], int | None], *, live: bool = False) -> None:
    """As `run`, for what needs no connection."""
    with guarded(name, live=live):
        if code := work():
            sys.stdout.flush()
            raise typer.Exit(code)


@contextmanager
def guarded(name: str, *, live: bool = False) -> Iterator[None]:
    """End the command where the block fails: errors that users can do something about become one line, and warnings."""

    def show(message: Warning | str, *_: object, **__: object) -> None:
        complain(name, "warning: " + (message if isinstance(message, str) else for_users(message)), 0)

    try:
        with warnings.catch_warnings():
            warnings.showwarning = show  # Python would add the file and line of REEM's own code to each
            yield
        # Here and not when the interpreter ends, so that a closed pipe is seen while it can still be handled.
        sys.stdout.flush()
        return
    except (KeyboardInterrupt, asyncio.CancelledError):
        code = 0 if live else INTERRUPTED
    except BrokenPipeError:  # `| head` has read enough
        code = 0
        # The interpreter flushes when it ends: into nothing.
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except CommandFailed as error:
        code = complain(name, str(error), error.code)
    # Before ReemError, whose subclass it is: that nothing is there is an answer, not a failure.
    except (MissingKey, FileNotFoundError) as error:
        code = complain(name, for_users(error), NOTHING)
    except (BadInput, FileExistsError) as error:
        code = complain(name, for_users(error), USAGE)
    except (ReemError, RedisError, OSError, ModuleNotFoundError) as error:  # what an extra brings is not installed
        code = complain(name, for_users(error), FAILED)
    raise typer.Exit(code)


async def _connected(work: Work, url: str, namespace: str, ships: Sequence[Any] | None) -> Any:
    # Before connecting, so that Ctrl-C ends the waiting for a server that does not answer.
    _cancel_on_signals()
    interface = interface_to(url, namespace, ships=ships)
    try:
        with closing(work(interface)) as doing:  # it may check what was typed before anything is sent
            await interface.initialize()
            return await doing
    finally:
        await interface.close()


def _cancel_on_signals() -> None:
    """Cancel this task at Ctrl-C, SIGTERM, and when the terminal closes. Another Ctrl-C or SIGTERM ends the process.

    `asyncio.run` alone cancels within the signal handler, between any two steps of Python, also within asyncio's own
    code, which reports that at length.
    """
    task, loop = asyncio.current_task(), asyncio.get_running_loop()

    def cancel(number: signal.Signals) -> None:
        if number == signal.SIGHUP:  # the kernel sends one, and the shell another
            loop.add_signal_handler(number, lambda: None)
        else:
            loop.remove_signal_handler(number)
        if task is not None:
            task.cancel()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:  # else nohup has asked for it
            loop.add_signal_handler(number, cancel, number)


def interface_to(
    url: str, namespace: str, timeout: float = CALL_SECONDS, ships: Sequence[Any] | None = None
) -> RedisInterface:
    """Return an interface to a server, not connected yet; `host:port` is taken for `redis://host:port`.

    The password is that of the URL, or else in the environment variable REEM_PASSWORD.
    """
    address = url if "://" in url else f"redis://{url}"
    password = os.environ.get(PASSWORD_VARIABLE)
    # A password in the URL comes first: it is the one that was typed for this server.
    login: dict[str, Any] = {"password": password} if password and not _HAS_PASSWORD.match(address) else {}
    return RedisInterface(address, ships, namespace=namespace, timeout=timeout, **login)


def complain(name: str, message: str, code: int) -> int:
    """Say on standard error what is wrong, in one line unless a server's log is in it; return `code`."""
    prefix = f"reem {name}: "
    if sys.stderr.isatty() and not os.environ.get("NO_COLOR"):
        prefix = typer.style(prefix, fg="red", bold=True)
    with suppress(OSError):  # the terminal has closed
        sys.stderr.write(prefix + "\n".join([clean(" ".join(line.split())) for line in message.splitlines()]) + "\n")
    return code


def for_users(error: Exception | Warning) -> str:
    """Return the message of an error; of the operating system's errors, file and reason."""
    if type(error).__module__ == "builtins" and isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error) or type(error).__name__
