"""The table of goals on the page docs/performance.md, written from the figures of a whole run."""

import pathlib
import re

from .environment import FOLDER
from .report import label
from .results import Results
from .targets import bare, rows

PAGE = FOLDER.parent / "docs" / "performance.md"
_TABLE = re.compile(r"<!-- goals -->\n.*?<!-- end of goals -->\n", re.DOTALL)


def table(results: Results) -> str:
    """Markdown: each ratio, its goal, and what a client without REEM's guarantees reaches in the same run."""
    lines = ["| case | ratio | goal | met | a bare client |", "|---|---|---|---|---|"]
    for row in results.rows:
        sign = ">=" if row["throughput"] else "<="
        ratio = "-" if row["ratio"] is None else f"{row['ratio']:.2f}"
        met = {"PASS": "yes", "PASS *": "yes, as hoped", "near": "nearly"}.get(row["verdict"], "no")
        lines.append(f"| {row['text']} | {ratio} | {sign} {row['must']:g} | {met} | {_bare(row['text'], results)} |")
    return "\n".join(lines) + "\n"


def _bare(text: str, results: Results) -> str:
    """The same ratio for a client that only moves the bytes, where one was measured beside."""
    found = next((bare(row) for row in rows() if row.text == text), None)
    ratio = None if found is None else found.ratio(results)
    return "" if found is None or ratio is None else f"{ratio:.2f} ({label(found.ours[1])})"


def rewrite(results: Results, page: pathlib.Path = PAGE) -> None:
    """Put the table, and the line on where it was measured, into the page."""
    told = f"Measured {results.started[:10]}: {results.environment}.\n\n"
    block = f"<!-- goals -->\n{told}{table(results)}<!-- end of goals -->\n"
    page.write_text(_TABLE.sub(lambda _: block, page.read_text()))
