"""What the examples share and what is not about REEM: options, a server, a steady clock."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from typing import Any

import anyio

from reem import ReemError
from reem.server import EmbeddedServer


def parser(documentation: str | None, **url: Any) -> argparse.ArgumentParser:
    """Options of every example: `--front`, and `--url`, by default a server of its own."""
    made = argparse.ArgumentParser(description=documentation, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--front", choices=["blocking", "asyncio"], default="blocking", help="default: %(default)s")
    help_ = "the server; default: one of its own"
    made.add_argument("--url", **({"help": help_} | url))
    return made


def server(url: str | None) -> Any:
    """For a `with` or `async with`: the server given, or one that lives as long as the block."""
    return EmbeddedServer() if url is None else contextlib.nullcontext(url)


def run(
    options: argparse.Namespace,
    blocking: Callable[[argparse.Namespace], None],
    asynchronous: Callable[[argparse.Namespace], Awaitable[None]],
) -> None:
    """Run one of the two fronts; an error of REEM becomes one line and exit code 1, Ctrl-C code 130."""
    try:
        if options.front == "asyncio":
            anyio.run(asynchronous, options)
        else:
            blocking(options)
    except ReemError as error:
        sys.exit(f"{type(error).__name__}: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


def ticks(rate: float, seconds: float | None = None) -> Iterator[float]:
    """Yield the time since the start, `rate` times a second; one late tick does not delay the next."""
    start = time.perf_counter()
    for number in itertools.count() if seconds is None else range(round(rate * seconds)):
        time.sleep(max(0.0, start + number / rate - time.perf_counter()))
        yield time.perf_counter() - start


async def aticks(rate: float, seconds: float | None = None) -> AsyncIterator[float]:
    """`ticks` for asyncio."""
    start = time.perf_counter()
    for number in itertools.count() if seconds is None else range(round(rate * seconds)):
        await anyio.sleep(max(0.0, start + number / rate - time.perf_counter()))
        yield time.perf_counter() - start
