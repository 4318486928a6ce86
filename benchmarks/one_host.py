"""The tables of "one host": messages by size, the control loop, and the viewers, with the floor beside each figure."""

from rich.console import Console
from rich.table import Table

from .contenders import HOST
from .measure_host import LOOP, VIEWERS
from .report import duration, label
from .results import Results
from .suite import ON_HOST

HEADS = {
    "reem-local": "REEM auto",
    "reem-host-early": "REEM early",
    "reem-host-queued": "REEM early, no wait",
    "zenoh": "zenoh",
}
"""Names for columns that are shorter than the contenders' own."""
SIZES = {"state": "100 B", "scan": "10 KB", "image": "0.92 MB", "frame": "7.4 MB"}

Rows = list[list[str]]  # the first one names the columns


def tables(results: Results) -> dict[str, Rows]:
    """The tables of which something was measured, by title."""
    beside = "a camera of 0.92 MB at 30 Hz"
    found = {
        "One host: publish to callback, and the publisher's call; medians": _messages(results),
        f"One host: a loop at 1 kHz beside {beside} and a program that looks": _loop(results, "host.loop", list(LOOP)),
        f"One host: REEM's loop beside {beside}, and a viewer": _loop(results, "host.viewer", list(VIEWERS)),
    }
    return {title: rows for title, rows in found.items() if len(rows) > 1}


def _messages(results: Results) -> Rows:
    measured = {way for n in ON_HOST for size in SIZES for way in results.cases.get(f"host.{n}.{size}", {})}
    ways = [name for name in HOST if name in measured]
    rows = [["size", "subscribers", *map(_head, ways)]]
    for subscribers in ON_HOST:
        for payload, size in SIZES.items():
            case = f"host.{subscribers}.{payload}"
            if case in results.cases:
                each = [f"{_shown(results, case, way)}, {_shown(results, f'{case}.call', way)}" for way in ways]
                rows.append([size, str(subscribers), *each])
    return rows


def _loop(results: Results, case: str, ways: list[str]) -> Rows:
    entries = [results.cases.get(case, {}).get(way, {}) for way in ways]
    if not any("median" in entry for entry in entries):
        return []
    rows = [["cycle", *map(_head, ways)]]
    for name, statistic in (("p50", "median"), ("p99", "p99")):
        rows.append([name, *(_shown(results, case, way, statistic) for way in ways)])
    rows.append(["missed deadlines", *(f"{e['missed']} of {e['periods']}" if "missed" in e else "-" for e in entries)])
    without = results.value(case, "no viewer", "p99")
    if without is not None:
        rows.append(["p99 / without", *(f"{e['p99'] / without:.2f}" if "p99" in e else "-" for e in entries)])
    return rows


def _head(way: str) -> str:
    return HEADS.get(way) or label(way)


def _shown(results: Results, case: str, way: str, statistic: str = "median") -> str:
    value = results.value(case, way, statistic)
    return "-" if value is None else duration(value)


def show(results: Results, console: Console) -> None:
    """Print all tables."""
    for title, (heads, *rows) in tables(results).items():
        table = Table(*heads, title=title, title_justify="left")
        for row in rows:
            table.add_row(*row)
        console.print(table)


def markdown(results: Results) -> str:
    """All tables, for the page."""
    blocks = []
    for title, (heads, *rows) in tables(results).items():
        lines = [f"| {' | '.join(row)} |" for row in (heads, ["---"] * len(heads), *rows)]
        blocks.append("\n".join([f"{title}:", "", *lines, ""]))
    return "\n".join(blocks) or "The last whole run did not have these tables.\n"
