"""A small fleet that really runs for some seconds, to hold against what the model says of it."""

from __future__ import annotations

import contextlib
import heapq
import time
from typing import Any

from reem import PublishSpace, RedisInterface

from .audience import Audience
from .measure import FRESH_SECONDS, VALUES
from .model import Robot, Topic
from .servers import Running, Sample
from .slots import numbered

ROBOTS = 3
SMALL = Robot("small arm", (Topic("set_point", "point", 100, 9), Topic("camera", "frame", 5, 2)))
"""An arm at a tenth of the pace with a fifth of the followers: two cores are too few for whole ones."""


def replay(running: Running, seconds: float) -> dict[str, Any]:
    """Run the fleet; returns how often each topic was published, what was seen, and what it cost the servers."""
    groups = {
        f"{namespace}{topic.name}": int(topic.followers) for namespace in numbered(ROBOTS) for topic in SMALL.topics
    }
    nodes = running.primaries
    cost = nodes.asking()
    with contextlib.ExitStack() as stack:
        audience = stack.enter_context(Audience(running.url, groups))
        spaces = {
            namespace: PublishSpace(stack.enter_context(RedisInterface(running.url, namespace=namespace, local="off")))
            for namespace in numbered(ROBOTS)
        }
        _pace(spaces, 0.5)
        time.sleep(FRESH_SECONDS)
        seen, first, begin = audience.seen(), nodes.sample(), time.monotonic()
        published = _pace(spaces, seconds)
        spent, took = nodes.sample() - first - cost, time.monotonic() - begin
        seen = {name: count - seen[name] for name, count in audience.seen().items()}
    return {
        "robots": ROBOTS,
        "seconds": took,
        "published": published,
        "seen": {topic.name: _of(seen, topic.name) for topic in SMALL.topics},
        **_per_second(spent, took),
    }


def _of(counts: dict[str, int], name: str) -> int:
    return sum(count for full, count in counts.items() if full.endswith(f":{name}"))


def _per_second(spent: Sample, seconds: float) -> dict[str, float]:
    return {"core": spent.core / seconds, "bytes_in": spent.bytes_in / seconds, "bytes_out": spent.bytes_out / seconds}


def _pace(spaces: dict[str, PublishSpace], seconds: float) -> dict[str, int]:
    """Publish all topics of all robots at their pace; returns how often, by topic."""
    begin, count = time.monotonic(), dict.fromkeys((topic.name for topic in SMALL.topics), 0)
    # Robots are not in step with each other.
    due = [
        (begin + number / topic.hertz / len(spaces), namespace, place)
        for number, namespace in enumerate(spaces)
        for place, topic in enumerate(SMALL.topics)
    ]
    heapq.heapify(due)
    while due[0][0] < begin + seconds:
        moment, namespace, place = heapq.heappop(due)
        time.sleep(max(0.0, moment - time.monotonic()))
        topic = SMALL.topics[place]
        spaces[namespace][topic.name] = VALUES[topic.value](count[topic.name])
        count[topic.name] += 1
        heapq.heappush(due, (moment + 1 / topic.hertz, namespace, place))
    return count
