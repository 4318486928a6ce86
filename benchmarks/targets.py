"""What the figures have to show: ratios of one run, each with what must be and what is hoped for."""

import dataclasses
from typing import Any

from .contenders import BEFORE, EARLY, LOCAL, OFF
from .results import Results

Place = tuple[str, str]  # case, contender
NEAR = 1.1  # within a tenth of what must be


@dataclasses.dataclass(frozen=True)
class Row:
    """One ratio. With `throughput`, more is better and the ratio is turned round."""

    text: str
    ours: Place
    theirs: Place
    must: float
    hope: float
    statistic: str = "median"
    throughput: bool = False

    def ratio(self, results: Results) -> float | None:
        """Ours to theirs; None if one of them was not measured."""
        ours = results.value(*self.ours, self.statistic)
        theirs = results.value(*self.theirs, self.statistic)
        if ours is None or theirs is None:
            return None
        return theirs / ours if self.throughput else ours / theirs

    def verdict(self, ratio: float | None) -> str:
        """PASS, near or FAIL; a star where what was hoped for is reached too."""
        if ratio is None:
            return "not measured"
        if self.throughput:
            met, hoped, near = ratio >= self.must, ratio >= self.hope, ratio * NEAR >= self.must
        else:
            met, hoped, near = ratio <= self.must, ratio <= self.hope, ratio <= self.must * NEAR
        if met:
            return "PASS *" if hoped else "PASS"
        return "near" if near else "FAIL"

    def judged(self, results: Results) -> dict[str, Any]:
        """The row as it is kept and printed."""
        ratio = self.ratio(results)
        return {
            "text": self.text,
            "ours": list(self.ours),
            "theirs": list(self.theirs),
            "statistic": self.statistic,
            "ratio": ratio,
            "must": self.must,
            "hope": self.hope,
            "throughput": self.throughput,
            "verdict": self.verdict(ratio),
        }


FRONTS = {"blocking": "reem", "asyncio": "async"}


def _small() -> list[Row]:
    rows = []
    for operation in ("get", "set"):
        case = f"small.{operation}"
        rows += [
            Row(
                f"asyncio {operation}, small dict / redis.asyncio",
                (case, "async"),
                (case, "redis-asyncio"),
                0.9,
                0.75,
            ),
            Row(f"blocking {operation}, small dict / original", (case, "reem"), (case, "original"), 0.5, 0.35),
            Row(
                f"blocking {operation}, small dict / redis-py + orjson",
                (case, "reem"),
                (case, "redis-py"),
                1.3,
                1.1,
            ),
        ]
    return rows


# text, case, against whom, must, hope: for either front
_EITHER = [
    ("400 strings, set", "strings.400.set", "original", 0.2, 0.12),
    ("400 strings, get", "strings.400.get", "original", 0.5, 0.37),
    ("40 arrays (3,4), set", "arrays.40.set", "original", 0.3, 0.2),
    ("40 arrays (3,4), get", "arrays.40.get", "original", 0.3, 0.2),
    ("array 1000x1000, get", "array.1000.get", "original", 0.2, 0.12),
    ("array 1000x1000, get", "array.1000.get", "redis-py", 1.2, 1.0),
    ("array 1000x1000, set", "array.1000.set", "original", 1.0, 0.75),
    ("array 1000x1000, set", "array.1000.set", "connection", 1.3, 1.1),
    ("pottery comparison, set", "pottery.set", "pottery", 0.8, 0.5),
    ("pottery comparison, get", "pottery.get", "pottery", 0.8, 0.5),
    ("publish to callback, small", "publish.small", "original", 0.4, 0.3),
    ("publish to callback, small", "publish.small", "redis-py", 1.3, 1.0),
    ("publish to callback, frame", "publish.frame", "original", 0.35, 0.25),
    ("publish to callback, frame", "publish.frame", "zenoh", 1.2, 0.9),
    ("100 subscriber processes", "subscribers.100", "original", 0.5, 0.3),
]


_FRAME, _IMAGE, _SMALL = "publish.frame", "publish.image", "publish.small"
# The same, told to tell programs near by first.
_EARLY = [("frame", _FRAME, "original", 0.15, 0.1), ("frame", _FRAME, "zenoh", 0.6, 0.35)]
# By default, to the same without shared memory.
_OFF = [
    ("server's CPU for a frame", f"{_FRAME}.server", 0.65, 0.5),
    ("the publisher's call, frame", f"{_FRAME}.call", 1.1, 1.0),
    ("the publisher's call, image of 0.92 MB", f"{_IMAGE}.call", 1.1, 1.0),
    ("publish to callback, small", "publish.ways", 1.03, 1.0),
    ("the publisher's call, small", "publish.ways.call", 1.03, 1.0),
]

# Text, case, REEM's way, the other's, must, hope, statistic: programs of one host.
_HOST = [
    ("100 B to callback, early / zenoh", "host.1.state", "reem-host-early", "zenoh", 0.5, 0.3, "median"),
    ("100 B to callback, early / pyzmq", "host.1.state", "reem-host-early", "pyzmq-ipc", 1.0, 0.6, "median"),
    ("0.92 MB to callback, early / zenoh", "host.1.image", "reem-host-early", "zenoh", 0.6, 0.45, "median"),
    ("7.4 MB to callback, early / zenoh", "host.1.frame", "reem-host-early", "zenoh", 0.4, 0.3, "median"),
    ("7.4 MB to callback / zenoh", "host.1.frame", "reem-local", "zenoh", 1.2, 0.9, "median"),
    ("control loop, p99 / zenoh", "host.loop", "reem-local", "zenoh", 1.0, 0.8, "p99"),
    ("control loop with REEM's page, p99 / without", "host.viewer", "page", "no viewer", 1.2, 1.0, "p99"),
]


def _shared_memory() -> list[Row]:
    rows = []
    for front, ours in FRONTS.items():
        rows += [
            Row(
                f"{front}: publish to callback, {text} / {theirs}, early",
                (case, EARLY[ours]),
                (case, theirs),
                must,
                hope,
            )
            for text, case, theirs, must, hope in _EARLY
        ]
        rows += [
            Row(
                f"{front}: publish to callback, image of 0.92 MB / {theirs}",
                (_IMAGE, ours),
                (_IMAGE, theirs),
                must,
                hope,
            )
            for theirs, must, hope in (("original", 0.35, 0.25), ("zenoh", 1.2, 0.9))
        ]
        rows += [
            Row(f"{front}: {text} / without shared memory", (case, ours), (case, OFF[ours]), must, hope)
            for text, case, must, hope in _OFF
        ]
    return rows


UNCHANGED = (
    "small.get", "small.set", "strings.400.get", "strings.400.set", "pottery.get", "pottery.set", "arrays.40.get",
    "array.1000.get", _SMALL,
)  # fmt: skip
"""Cases that shared memory has no part in: they should take as long as before it came."""


def unchanged() -> list[Row]:
    """What is to be shown beside an earlier commit (`--before`)."""
    return [
        Row(f"{front}: {case} / before", (case, ours), (case, BEFORE[ours]), 1.03, 1.0)
        for case in (*UNCHANGED, f"{_SMALL}.call")
        for front, ours in FRONTS.items()
    ]


def rows() -> list[Row]:
    """Every row, in the order of the specification."""
    found = _small()
    for text, case, theirs, must, hope in _EITHER:
        found += [
            Row(f"{front}: {text} / {theirs}", (case, ours), (case, theirs), must, hope)
            for front, ours in FRONTS.items()
        ]
    found += _shared_memory()
    found += [
        Row(f"one host: {text}", (case, ours), (case, theirs), must, hope, statistic)
        for text, case, ours, theirs, must, hope, statistic in _HOST
    ]
    found.append(
        Row(
            "100 concurrent async reads, throughput / redis.asyncio",
            ("callers.100", "async"),
            ("callers.100", "redis-asyncio"),
            3.0,
            5.0,
            throughput=True,
        )
    )
    found += [
        Row(
            f"{front}: 1 kHz writer beside 8 MB frames, p99 / alone",
            ("camera.beside", ours),
            ("camera.alone", ours),
            3.0,
            2.0,
            statistic="p99",
        )
        for front, ours in FRONTS.items()
    ]
    found += [
        Row(
            f"{writer} beside {text}, p99 / alone",
            (f"recorder.{case}", recorder),
            (f"recorder.{case}", "nobody"),
            1.2,
            1.0,
            statistic="p99",
        )
        for case, writer in (("setpoint", "1 kHz writer"), ("camera", "0.92 MB frames at 30 Hz"))
        for recorder, text in (("recorder", "`reem record`"), ("background", "`reem record --background`"))
    ]
    found += [
        Row("import reem / import redis and numpy", ("import", "reem"), ("import", "redis+numpy"), 1.3, 1.1),
        Row(
            "8 threads on one interface, throughput / 1 thread",
            ("threads.8", "reem"),
            ("threads.1", "reem"),
            1.0,
            1.5,
            throughput=True,
        ),
    ]
    return found


def nearby(row: Row) -> Row | None:
    """Return the row with REEM at `localhost`, and the others as they are; None where REEM has no part."""
    case, ours = row.ours
    if ours not in LOCAL:
        return None
    theirs = row.theirs[0], LOCAL.get(row.theirs[1], row.theirs[1])
    return dataclasses.replace(row, ours=(case, LOCAL[ours]), theirs=theirs)


_BARE = {
    "original": "redis-py",
    "pottery": "redis-py",
    "zenoh": "redis-py",
    "redis-asyncio": "redis-asyncio-uvloop",
    "nobody": "fetches",
}


def bare(row: Row) -> Row | None:
    """Return the row with a client in REEM's place that only moves the bytes; None where that says nothing."""
    client = "redis-py" if row.theirs[1] == row.ours[1] else _BARE.get(row.theirs[1])
    if client is None or row.throughput or row.ours[0] == "import":
        return None
    theirs = (row.theirs[0], client) if row.theirs[1] == row.ours[1] else row.theirs
    return dataclasses.replace(row, ours=(row.ours[0], client), theirs=theirs)


def floor(row: Row) -> Row | None:
    """Return the row with bare sockets in REEM's place; None where they were not measured by themselves."""
    return None if row.throughput else dataclasses.replace(row, ours=(row.ours[0], "floor"))
