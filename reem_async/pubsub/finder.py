"""Which keys there are: nothing announces a key that is only stored, so the server is asked every second."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Iterable

from ..errors import Misuse, RedisError, ReemError
from ..plan.paths import Pattern
from ..session import Session

logger = logging.getLogger("reem.subscribe")

_PERIOD = 1.0  # seconds between searches
_PAUSE = 10  # times as long as the last search took, at least, until the next one: a million keys are a thousand pages


async def present_keys(session: Session, tops: Iterable[str]) -> set[str]:
    """Return the top-level keys that some globs name; a round trip for about 1000 keys and each glob."""
    return {name for top in dict.fromkeys(tops) async for name in session.names(Pattern(top))}


async def find_regularly(find: Callable[[], Awaitable[bool]]) -> None:
    """Call `find` every second from the next one on, less often where it takes long, until it returns False.

    After a call that fails the next one is a second later. `Misuse` ends this, such as a closed interface.
    """
    while True:
        await asyncio.sleep(_PERIOD)
        began = time.monotonic()
        try:
            if not await find():
                return
        except Misuse:
            raise
        except (ReemError, RedisError, OSError) as error:
            logger.debug("keys could not be listed: %s", error)
            continue
        await asyncio.sleep(max(_PAUSE * (time.monotonic() - began) - _PERIOD, 0.0))
