"""Programs that rows run as processes of their own: `python -m tests.chaos.programs NAME ARGUMENTS`.

They say what they found as lines of JSON on stdout.
"""

from __future__ import annotations

import asyncio
import resource
import sys
import time

import reem_async
from reem_async.concurrency.queues import Last

from .tools import Log, background, became, heard, rss, say

# --- row 10 ----------------------------------------------------------------------------------------


def stalled(url: str) -> None:
    """Subscribe to `flood`; stand still when told; then say how long the copy took to be right again."""
    asyncio.run(_stalled(url))


async def _stalled(url: str) -> None:
    async with reem_async.RedisInterface(url) as interface:
        mirror = reem_async.SilentSubscriber("flood", interface)
        log = Log(mirror.watch(Last(1000)))
        await mirror.listen()
        await log.updates.listen()
        async with background(log.follow()):
            say(ready=True)
            await asyncio.to_thread(heard)
            before, gaps, told = rss(), log.gaps, log.told
            say(stalled=True, told=told)
            end = int(heard())  # on the loop's own thread: nothing is read meanwhile
            begun = time.monotonic()
            settled = await became(lambda: (mirror.value() or {}).get("end") == end and log.gaps > gaps, 20)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            say(
                settled=settled,
                took=time.monotonic() - begun,
                gaps=log.gaps - gaps,
                grown=max(peak, rss()) - before,
                silent=log.silent,
                disordered=log.repeated + log.backward,
            )


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
