"""Running a command: one server, one event loop, errors as one line and an exit code.

Exit codes: 0 done, 1 failed, 2 wrong usage, 3 nothing is there, 4 waited in vain (--timeout).
Ctrl-C is how a live command is ended, so it exits with 0; any other command exits with 130.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import warnings
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, TypeVar

import typer

from reem_async.cli.output import clean

if TYPE_CHECKING:
    from reem_async.connection import RedisInterface

Result = TypeVar("Result")

__all__ = [
    "CALL_SECONDS", "FAILED", "INTERRUPTED", "NOTHING", "TIMED_OUT", "USAGE", "Refused", "address_of", "complain",
    "for_users", "guarded", "prepared", "run",
]  # fmt: skip

FAILED, USAGE, NOTHING, TIMED_OUT, INTERRUPTED = 1, 2, 3, 4, 130

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
) -> None:
    """Connect, do `work`, and turn what goes wrong into a line and an exit code.

    Args:
        name: The command, for messages.
        work: What to do with the server; returns the exit code, None for 0.
        url: The server.
        namespace: What goes before every key.
        live: The command goes on until Ctrl-C.
    """
    code = guarded(name, lambda: asyncio.run(_connected(work, url, namespace)), live=live)
    if code:
        raise typer.Exit(code)


def guarded(name: str, work: Callable[[], int | None], *, live: bool = False) -> int:
    """Do `work` and return its exit code; errors that users can do something about become one line."""
    from reem_async.errors import BadInput, MissingKey, RedisError, ReemError

    try:
        with _warnings_in_words(name):
            code = work() or 0
        sys.stdout.flush()
    except (KeyboardInterrupt, asyncio.CancelledError):
        return 0 if live else INTERRUPTED
    except BrokenPipeError:  # `| head` has seen enough
        _close_stdout()
        return 0
    except Refused as error:
        return complain(name, str(error), error.code)
    except MissingKey as error:
        return complain(name, str(error), NOTHING)
    except BadInput as error:
        return complain(name, for_users(error), USAGE)
    except (ReemError, RedisError, OSError) as error:
        return complain(name, for_users(error), FAILED)
    return code


def prepared(name: str, make: Callable[[], Result]) -> Result:
    """Return what `make` returns; what goes wrong becomes one line, before anything is sent."""
    result: list[Result] = []
    code = guarded(name, lambda: result.append(make()))
    if code:
        raise typer.Exit(code)
    return result[0]


async def _connected(work: Callable[[RedisInterface], Awaitable[int | None]], url: str, namespace: str) -> Any:
    from reem_async.connection import RedisInterface

    _cancel_on([signal.SIGINT, signal.SIGTERM])
    interface = RedisInterface(address_of(url), namespace=namespace, timeout=CALL_SECONDS)
    try:
        await interface.initialize()
        return await work(interface)
    finally:
        await interface.close()


def _cancel_on(signals: Sequence[signal.Signals]) -> None:
    """Cancel this task, once, when a signal comes; the same signal again ends the process as ever.

    `asyncio.run` alone cancels within the handler of the signal, between any two steps of Python: thus also
    after a reply's waiter was seen to wait and before it is told, which asyncio complains about at length.
    """
    task, loop = asyncio.current_task(), asyncio.get_running_loop()

    def cancel(number: signal.Signals) -> None:
        loop.remove_signal_handler(number)
        if task is not None:
            task.cancel()

    with suppress(NotImplementedError):  # Windows
        for number in signals:
            loop.add_signal_handler(number, cancel, number)


def address_of(url: str) -> str:
    """Return the address of a server; `host:port` is taken for `redis://host:port`."""
    return url if "://" in url else f"redis://{url}"


def complain(name: str, message: str, code: int) -> int:
    """Say in one line on standard error what is wrong; return `code`."""
    prefix = f"reem {name}: "
    if sys.stderr.isatty() and not os.environ.get("NO_COLOR"):
        prefix = typer.style(prefix, fg="red", bold=True)
    sys.stderr.write(prefix + clean(" ".join(message.split())) + "\n")
    return code


@contextmanager
def _warnings_in_words(name: str) -> Iterator[None]:
    """Show warnings as one line each, without the place in the code that Python adds."""

    def show(message: Warning | str, *_: object, **__: object) -> None:
        complain(name, "warning: " + (message if isinstance(message, str) else for_users(message)), 0)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def for_users(error: Exception) -> str:
    """Return the message of an error, in the words of the command line."""
    if type(error).__module__ == "builtins" and isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    text = str(error) or type(error).__name__
    for of_library, of_command in (
        ("RedisInterface('redis://host:port')", "--url redis://host:port or REEM_URL"),
        ("warnings.filterwarnings('ignore', category=reem.InsecureConnection)", "PYTHONWARNINGS=ignore::UserWarning"),
        ("use store['a']['b'] for such keys", 'write it like foo.bar[0]; a key with a dot in it: foo["a.b"]'),
        (
            "RedisInterface(..., username=..., password=...)",
            "--url redis://user:password@host:port, better in REEM_URL",
        ),
    ):
        text = text.replace(of_library, of_command)
    return text


def _close_stdout() -> None:
    """Let the interpreter flush into nothing when it ends."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
