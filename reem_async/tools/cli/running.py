"""Running a command: one server, one event loop, errors as one line and an exit code.

Exit codes: 0 done, 1 failed, 2 wrong usage (also a file that is there already, without --force), 3 nothing is there
(also a file to read), 4 waited in vain (--timeout).
Ctrl-C is how a live command is ended, so it exits with 0; any other command exits with 130.
"""

from __future__ import annotations

import asyncio
import os
import re
import signal
import sys
import warnings
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, TypeVar

import typer

from reem_async.tools.cli.output import clean

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface

Result = TypeVar("Result")


# Scripts depend on these numbers: the same in every command, listed in the README.
FAILED, USAGE, NOTHING, TIMED_OUT, INTERRUPTED = 1, 2, 3, 4, 130

PASSWORD_VARIABLE = "REEM_PASSWORD"  # noqa: S105 - the name of a variable

_HAS_PASSWORD = re.compile(r"[^:]*://[^/?]*:[^/?]*@")

CALL_SECONDS = 5.0
"""How long a call may take: more than a program's second, since a person may sit behind a slow network."""


class Refused(Exception):
    """A command cannot be done; the message says why and what to do.

    Attributes:
        code: The exit code.
    """

    def __init__(self, message: str, code: int = FAILED) -> None:
        super().__init__(message)
        self.code = code


def run(
    name: str,
    work: Callable[[RedisInterface], Awaitable[int | None]],
    url: str,
    namespace: str,
    *,
    live: bool = False,
    ships: Sequence[Any] | None = None,
) -> None:
    """Connect, do `work`, and turn what goes wrong into a line and an exit code.

    Args:
        name: The command, for messages.
        work: What to do with the server; returns the exit code, None for 0.
        url: The server.
        namespace: What goes before every key.
        live: The command goes on until Ctrl-C.
        ships: The interface's ships; None for the default ones.
    """
    code = guarded(name, lambda: asyncio.run(_connected(work, url, namespace, ships)), live=live)
    if code:
        raise typer.Exit(code)


def guarded(name: str, work: Callable[[], int | None], *, live: bool = False) -> int:
    """Do `work` and return its exit code; errors that users can do something about become one line."""
    from reem_async.errors import BadInput, MissingKey, RedisError, ReemError

    try:
        with _warnings_in_words(name):
            code = work() or 0
        # Here and not when the interpreter ends, so that a closed pipe is seen while it can still be handled.
        sys.stdout.flush()
    except (KeyboardInterrupt, asyncio.CancelledError):
        return 0 if live else INTERRUPTED
    except BrokenPipeError:  # `| head` has seen enough
        _close_stdout()
        return 0
    except Refused as error:
        return complain(name, str(error), error.code)
    # Before ReemError, whose subclass it is: that nothing is there is an answer, not a failure.
    except MissingKey as error:
        return complain(name, for_users(error), NOTHING)
    except (BadInput, FileExistsError) as error:
        return complain(name, for_users(error), USAGE)
    except FileNotFoundError as error:
        return complain(name, for_users(error), NOTHING)
    except (ReemError, RedisError, OSError) as error:
        return complain(name, for_users(error), FAILED)
    return code


def prepared(name: str, make: Callable[[], Result]) -> Result:
    """Return what `make` returns; what goes wrong, a closed pipe too, ends the command before anything is sent."""
    # A list, since the exit code takes the place of the return value.
    result: list[Result] = []
    code = guarded(name, lambda: result.append(make()))
    if not result or code:
        raise typer.Exit(code)
    return result[0]


async def _connected(
    work: Callable[[RedisInterface], Awaitable[int | None]], url: str, namespace: str, ships: Sequence[Any] | None
) -> Any:
    # Before connecting, so that Ctrl-C ends the waiting for a server that does not answer.
    _cancel_on([signal.SIGINT, signal.SIGTERM, *_hangup()])
    interface = interface_to(url, namespace, ships=ships)
    try:
        await interface.initialize()
        return await work(interface)
    finally:
        await interface.close()


def _hangup() -> list[signal.Signals]:
    """Return the signal of a terminal that closes, unless the command is to outlive it (nohup)."""
    hangup = getattr(signal, "SIGHUP", None)
    return [] if hangup is None or signal.getsignal(hangup) is signal.SIG_IGN else [hangup]


def _cancel_on(signals: Sequence[signal.Signals]) -> None:
    """Cancel this task, once, when a signal comes; the same signal again ends the process as ever, but for a hangup.

    `asyncio.run` alone cancels within the handler of the signal, between any two steps of Python: thus also
    after a reply's waiter was seen to wait and before it is told, which asyncio complains about at length.
    """
    task, loop = asyncio.current_task(), asyncio.get_running_loop()

    def cancel(number: signal.Signals) -> None:
        if number in _hangup():  # the kernel sends one, and the shell another
            loop.add_signal_handler(number, lambda: None)
        else:
            loop.remove_signal_handler(number)
        if task is not None:
            task.cancel()

    with suppress(NotImplementedError):  # Windows
        for number in signals:
            loop.add_signal_handler(number, cancel, number)


def interface_to(
    url: str, namespace: str, timeout: float = CALL_SECONDS, ships: Sequence[Any] | None = None
) -> RedisInterface:
    """Return an interface to a server, not connected yet; `host:port` is taken for `redis://host:port`.

    The password is that of the URL, or else in the environment variable REEM_PASSWORD.
    """
    from reem_async.connection import RedisInterface

    address = url if "://" in url else f"redis://{url}"
    password = os.environ.get(PASSWORD_VARIABLE)
    # A password in the URL comes first: it is the one that was typed for this server.
    login: dict[str, Any] = {"password": password} if password and not _HAS_PASSWORD.match(address) else {}
    return RedisInterface(address, ships, namespace=namespace, timeout=timeout, **login)


def complain(name: str, message: str, code: int) -> int:
    """Say in one line on standard error what is wrong; return `code`."""
    prefix = f"reem {name}: "
    if sys.stderr.isatty() and not os.environ.get("NO_COLOR"):
        prefix = typer.style(prefix, fg="red", bold=True)
    with suppress(OSError):  # the terminal has closed
        sys.stderr.write(prefix + clean(" ".join(message.split())) + "\n")
    return code


@contextmanager
def _warnings_in_words(name: str) -> Iterator[None]:
    """Show warnings as one line each, without the place in the code that Python adds."""

    def show(message: Warning | str, *_: object, **__: object) -> None:
        complain(name, "warning: " + (message if isinstance(message, str) else for_users(message)), 0)

    # Python would add the file and line of REEM's own code to each.
    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def _close_stdout() -> None:
    """Let the interpreter flush into nothing when it ends."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def for_users(error: Exception | Warning) -> str:
    """Return the message of an error; of the operating system's errors, file and reason."""
    if type(error).__module__ == "builtins" and isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error) or type(error).__name__
