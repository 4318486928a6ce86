"""Who is counted: the robots, the servers and the budgets that docs/lab/scale.md works with."""

from __future__ import annotations

from .model import Node, Robot, Topic

ARM = Robot("arm with a camera", (Topic("set_point", "point", 1000, 45), Topic("camera", "frame", 30, 5)))
BASE = Robot(
    "mobile base",
    (Topic("pose", "point", 50, 4), Topic("status", "point", 1, 2), Topic("camera", "packed", 10, 1)),
)
ROBOTS = {"arm": ARM, "base": BASE}

SHARED = Topic("clock", "point", 100, 0)
"""A key that every robot of a fleet follows; the followers are as many as the robots."""


def _arm(point_hertz: float, point_followers: float, value: str, hertz: float, followers: float) -> Robot:
    return Robot(
        "arm", (Topic("set_point", "point", point_hertz, point_followers), Topic("camera", value, hertz, followers))
    )


REMEDIES = {
    "as it is": ARM,
    "camera at 10 Hz": _arm(1000, 45, "frame", 10, 5),
    "frames compressed by a ship, to 60 kB": _arm(1000, 45, "packed", 30, 5),
    "set point at 200 Hz": _arm(200, 45, "frame", 30, 5),
    "one mirror of each key on a gateway, which tells the rest": _arm(1000, 1, "frame", 30, 1),
    "compressed, and the gateway": _arm(1000, 1, "packed", 30, 1),
    "compressed, the gateway, set point at 200 Hz": _arm(200, 1, "packed", 30, 1),
}

GIGABIT = 1e9
CORE_BUDGET = 0.6
LINE_BUDGET = 0.7
MEMORY_BUDGET = 8 * 2**30
CONNECTION_BUDGET = 10_000


def node(gigabits: float) -> Node:
    """Return the budgets of a server with a network line of so many Gbit/s in each direction."""
    line = gigabits * GIGABIT * LINE_BUDGET
    return Node(CORE_BUDGET, line, line, MEMORY_BUDGET, CONNECTION_BUDGET)


LINES = (1, 10)

FLEETS = {
    "one node": ("one", 1),
    "six nodes (3 primaries, 3 replicas)": ("six", 3),
    "a hundred nodes (50 primaries, 50 replicas)": ("six", 50),
}
"""What a fleet is called: the setting its costs were measured in, and its primaries."""
