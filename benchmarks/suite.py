"""All cases of a whole run, chapter by chapter."""

import dataclasses
from collections.abc import Callable
from typing import Any

from .contenders import BEFORE, EARLY, HOST, LOCAL, OFF
from .measure import CallCase, Case, ClientsCase
from .measure_host import LOOP, VIEWERS, ControlLoopCase, HostCase
from .measure_other import IMPORTS, CameraCase, ImportCase
from .measure_pubsub import PublishCase, SubscribersCase
from .measure_recorder import BESIDE, RecorderCase
from .targets import UNCHANGED
from .values import Spec

# What grows along the axes of the figures.
STRINGS = (1, 100, 200, 300, 400)
ARRAYS = (1, 10, 20, 30, 40)
SIDES = (10, 200, 400, 600, 800, 1000)
ENTRIES = (1, 10, 100, 1000, 10_000)
BYTES = (100, 1_000, 10_000, 100_000, 1_000_000, 8_000_000, 64_000_000)
CALLERS = (1, 10, 100, 1000)
THREADS = (1, 2, 4, 8)
CLIENTS = (1, 5, 20, 50)
ON_HOST = (1, 5, 20)
SUBSCRIBERS = {1: (1, 1), 10: (10, 1), 100: (100, 1), 1000: (10, 100)}  # processes, subscribers in each

# The same in a quick run.
QUICK = {
    STRINGS: (1, 400),
    ARRAYS: (1, 40),
    SIDES: (10, 1000),
    ENTRIES: (1, 10_000),
    BYTES: (100, 8_000_000),
    CALLERS: (1, 100),
    THREADS: (1, 8),
    CLIENTS: (1, 20),
    tuple(SUBSCRIBERS): (100,),
    ON_HOST: (1,),
}

FRONTS = ("reem", "async")
NEARBY = tuple(LOCAL.values())
DOCUMENTS = (*FRONTS, "original", "redis-py", "redis-asyncio")
LEAF = ("sub_0", "sub_1", "sub_2", "sub_3", "sub_4", "copy_0_single_key")


Grown = Callable[[tuple[int, ...]], tuple[int, ...]]


def _both(name: str, contenders: tuple[str, ...], value: Spec, **more: Any) -> list[Case]:
    # Documents are about what the programs do; large arrays, about two of them copying at the same time.
    more = {"one_core": value["kind"] not in ("array", "bytes")} | more
    return [
        CallCase(f"{name}.{operation}", contenders, operation=operation, value=value, **more)
        for operation in ("set", "get")
    ]


def small(grown: Grown) -> list[Case]:
    """A dictionary of two entries, over TCP, the Unix socket and another loop."""
    everyone = (*DOCUMENTS, *NEARBY, "async-uvloop", "redis-asyncio-uvloop", "floor")
    return _both("small", everyone, {"kind": "small"}, count=4000, limit=1.0)


def strings_and_arrays(grown: Grown) -> list[Case]:
    """Chapter 5.1.1: entries against latency."""
    cases: list[Case] = []
    for count in grown(STRINGS):
        more = (*NEARBY, "floor") if count == STRINGS[-1] else ()
        cases += _both(f"strings.{count}", (*DOCUMENTS, *more), {"kind": "strings", "count": count})
    for count in grown(ARRAYS):
        more = NEARBY if count == ARRAYS[-1] else ()
        cases += _both(f"arrays.{count}", (*FRONTS, "original", *more), {"kind": "arrays", "count": count})
    return cases


def array_rates(grown: Grown) -> list[Case]:
    """Chapter 5.1.2: square arrays."""
    cases: list[Case] = []
    for side in grown(SIDES):
        contenders: tuple[str, ...] = (*DOCUMENTS, "connection")
        if side == SIDES[-1]:
            contenders += NEARBY
        value: Spec = {"kind": "array", "shape": [side, side]}
        cases += _both(f"array.{side}", contenders, value, inner=("key",), count=500)
    return cases


def subscribers(grown: Grown) -> list[Case]:
    """Chapter 5.2: subscriber overhead, and peers with one subscriber."""
    fronts = (*FRONTS, "original", "redis-py")
    others = ("pyzmq", "zenoh", "zenoh-tcp", "iceoryx2", "floor")
    ways = (*OFF.values(), *EARLY.values())
    cases: list[Case] = [
        PublishCase("publish.small", (*fronts, *NEARBY, *others), payload="small", count=600, gap=0.004),
        # What differs by a few percent: alone, in many turns.
        PublishCase("publish.ways", (*FRONTS, *OFF.values()), payload="small", count=600, gap=0.004, rounds=12),
        PublishCase("publish.frame", (*fronts, *NEARBY, *ways, *others), payload="frame", count=60, gap=0.05, rounds=5),
        PublishCase("publish.image", (*fronts, *ways, *others), payload="image", count=100, gap=0.03, rounds=5),
    ]
    for total in grown(tuple(SUBSCRIBERS)):
        processes, each = SUBSCRIBERS[total]
        messages, gap = (20, 0.2) if total > 100 else (200, 0.02 if total > 10 else 0.01)
        cases.append(
            SubscribersCase(f"subscribers.{total}", fronts, processes=processes, each=each, messages=messages, gap=gap)
        )
    return cases


def comparison(grown: Grown) -> list[Case]:
    """Chapter 5.3: pottery."""
    contenders = (*FRONTS, *NEARBY, "original", "pottery")
    value: Spec = {"kind": "pottery"}
    return [
        CallCase("pottery.set", (*contenders, "redis-py"), operation="set", value=value, one_core=True),
        CallCase("pottery.get", contenders, operation="get", value=value, tail=LEAF, one_core=True),
    ]


def growth(grown: Grown) -> list[Case]:
    """How cost grows beyond what the manual shows."""
    cases: list[Case] = []
    for count in grown(ENTRIES):
        cases += _both(f"entries.{count}", DOCUMENTS, {"kind": "strings", "count": count}, limit=0.4)
    cases += _both("floats.1000", DOCUMENTS, {"kind": "floats", "count": 1000}, limit=0.4)
    for count in grown(BYTES):
        value: Spec = {"kind": "bytes", "count": count}
        rounds = 15 if count < 1_000_000 else 5  # of the largest, no block has less than two
        cases += _both(f"bytes.{count}", (*DOCUMENTS, "connection"), value, inner=("key",), limit=0.4, rounds=rounds)
    return cases


def crowds(grown: Grown) -> list[Case]:
    """Many callers, threads and processes."""
    loops = ("async", "redis-asyncio", "async-uvloop", "redis-asyncio-uvloop")
    cases: list[Case] = [
        CallCase(f"callers.{width}", loops, width=width, count=500, limit=1.0) for width in grown(CALLERS)
    ]
    cases += [
        CallCase(f"threads.{width}", ("reem", "original", "redis-py"), width=width, count=20, limit=1.0)
        for width in grown(THREADS)
    ]
    cases += [
        ClientsCase(f"clients.{processes}", (*FRONTS, "original", "redis-py"), processes=processes)
        for processes in grown(CLIENTS)
    ]
    return cases


def programs(grown: Grown) -> list[Case]:
    """A controller beside a camera, both beside a recorder, and imports."""
    return [
        CameraCase("camera", (*FRONTS, *NEARBY, "original", "redis-py", "redis-asyncio")),
        RecorderCase("recorder", tuple(BESIDE)),
        ImportCase("import", tuple(IMPORTS)),
    ]


def one_host(grown: Grown) -> list[Case]:
    """The programs of a robot's computer."""
    publishing = tuple(name for name in HOST if name != "redis-socket")
    return [
        *(HostCase(f"host.{subscribers}", publishing, subscribers=subscribers) for subscribers in grown(ON_HOST)),
        ControlLoopCase("host.loop", tuple(LOOP), ways=LOOP),
        ControlLoopCase("host.viewer", tuple(VIEWERS), ways=VIEWERS),
    ]


def beside_before(cases: list[Case]) -> list[Case]:
    """The cases, those in which nothing may have changed with REEM of an earlier commit among the contenders."""
    return [
        dataclasses.replace(case, contenders=(*case.contenders, *BEFORE.values()))
        if case.identifier in UNCHANGED
        else case
        for case in cases
    ]


def every_case(quick: bool = False) -> list[Case]:
    """The whole run, in order; in a quick one only the ends of each axis."""

    def grown(axis: tuple[int, ...]) -> tuple[int, ...]:
        return QUICK[axis] if quick else axis

    parts = (small, strings_and_arrays, array_rates, comparison, growth, crowds, programs, subscribers, one_host)
    return [case for part in parts for case in part(grown)]
