"""The table of goals on the page docs/lab/performance.md, written from the figures of a whole run."""

import pathlib
import re
from collections.abc import Callable

from . import one_host
from .environment import FOLDER
from .report import label
from .results import Results
from .targets import Row, bare, floor, nearby, rows

PAGE = FOLDER.parent / "docs" / "lab" / "performance.md"
_TABLE = re.compile(r"<!-- goals -->\n.*?<!-- end of goals -->\n", re.DOTALL)
_HOST = re.compile(r"<!-- one host -->\n.*?<!-- end of one host -->\n", re.DOTALL)


def table(results: Results) -> str:
    """Markdown: each ratio, its goal, the same with REEM at localhost, and with others who do less in its place."""
    known = {row.text: row for row in rows()}
    heads = ("case", "ratio", "goal", "met", "at localhost", "bare sockets", "a bare client")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for row in results.rows:
        sign = ">=" if row["throughput"] else "<="
        ratio = "-" if row["ratio"] is None else f"{row['ratio']:.2f}"
        met = {"PASS": "yes", "PASS *": "yes, as hoped", "near": "nearly"}.get(row["verdict"], "no")
        local, least, client = (_other(known.get(row["text"]), of, results) for of in (nearby, floor, bare))
        named = [f"{other[0]:.2f}" if other else "" for other in (local, least)]
        named.append(f"{client[0]:.2f} ({label(client[1])})" if client else "")
        lines.append(f"| {row['text']} | {ratio} | {sign} {row['must']:g} | {met} | {' | '.join(named)} |")
    return "\n".join(lines) + "\n"


def _other(row: Row | None, of: Callable[[Row], Row | None], results: Results) -> tuple[float, str] | None:
    """The same ratio for somebody else in REEM's place, and who that is; None where it was not measured."""
    found = of(row) if row is not None else None
    ratio = found.ratio(results) if found is not None else None
    return None if found is None or ratio is None else (ratio, found.ours[1])


def rewrite(results: Results, page: pathlib.Path = PAGE) -> None:
    """Put the tables, and the line on where they were measured, into the page."""
    told = f"Measured {results.started[:10]}: {results.environment}.\n\n"
    block = f"<!-- goals -->\n{told}{table(results)}<!-- end of goals -->\n"
    host = f"<!-- one host -->\n{one_host.markdown(results)}<!-- end of one host -->\n"
    page.write_text(_HOST.sub(lambda _: host, _TABLE.sub(lambda _: block, page.read_text())))
