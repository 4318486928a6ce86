"""The page docs/performance.md for users: a dozen figures and one chart, written from the figures of a whole run."""

import pathlib
import re
from html import escape

from .environment import FOLDER
from .report import duration
from .results import Results

PAGE = FOLDER.parent / "docs" / "performance.md"
CHART = FOLDER.parent / "docs" / "images" / "performance.svg"
_BLOCK = re.compile(r"<!-- figures -->\n.*?<!-- end of figures -->\n", re.DOTALL)

ROWS = (
    ("read a small dict", "small.get", "median", ("redis-py", "redis-py and JSON")),
    ("write a small dict", "small.set", "median", ("redis-py", "redis-py and JSON")),
    ("read an array of 8 MB", "array.1000.get", "median", ("redis-py", "redis-py")),
    ("write an array of 8 MB", "array.1000.set", "median", ("redis-py", "redis-py")),
    ("publish to callback, small dict", "publish.small", "median", ("zenoh", "Zenoh")),
    ("publish to callback, image of 0.92 MB", "publish.image", "median", ("zenoh", "Zenoh")),
    ("publish to callback, frame of 7.4 MB", "publish.frame", "median", ("zenoh", "Zenoh")),
    ("publish to the last of 100 programs", "subscribers.100", "median", ("redis-py", "redis-py")),
    ("set point at 1 kHz, 99th percentile", "camera.alone", "p99", ("redis-py", "redis-py")),
    ("the same beside 8 MB frames at 30 Hz", "camera.beside", "p99", ("redis-py", "redis-py")),
    ("import", "import", "median", ("redis+numpy", "redis and numpy")),
)
"""What it is, the case, the statistic, and who stands beside it."""

BARS = (
    ("reem", "REEM"),
    ("reem-early", 'REEM, local="early"'),
    ("redis-py", "redis-py"),
    ("zenoh", "Zenoh"),
    ("pyzmq", "ZeroMQ"),
)
PANELS = (("publish.small", "small dict"), ("publish.image", "image, 0.92 MB"), ("publish.frame", "frame, 7.4 MB"))


def table(results: Results) -> str:
    """Markdown: each figure in both fronts, and another library's."""
    lines = ["| | blocking | asyncio | for comparison |", "|---|---|---|---|"]
    for text, case, statistic, (other, name) in ROWS:
        ours = [_shown(results.value(case, front, statistic)) for front in ("reem", "async")]
        lines.append(f"| {text} | {' | '.join(ours)} | {name} {_shown(results.value(case, other, statistic))} |")
    calls = results.value("callers.100", "async")
    per_second = f"{round(1 / calls, -3):,.0f} a second" if calls else "-"
    lines.append(f"| small reads by 100 tasks of one program |  | {per_second} |  |")
    return "\n".join(lines) + "\n"


def _shown(seconds: float | None) -> str:
    return "-" if seconds is None else duration(float(f"{seconds:.2g}"))


def chart(results: Results) -> str:
    """One SVG: from publishing to the callback, for three sizes."""
    left, width, parts, y = 170, 640, [], 34
    for case, title in PANELS:
        found = [(name, results.value(case, contender)) for contender, name in BARS]
        bars = [(name, value) for name, value in found if value is not None]
        longest = max(value for _, value in bars)
        parts.append(f'<text x="8" y="{y}" class="t">{escape(title)}</text>')
        for name, value in bars:
            y += 22
            length = max(2.0, (width - left - 90) * value / longest)
            colour = "#0b5fa5" if name.startswith("REEM") else "#9aa7b4"
            parts.append(f'<text x="{left - 8}" y="{y}" text-anchor="end">{escape(name)}</text>')
            parts.append(f'<rect x="{left}" y="{y - 12}" width="{length:.1f}" height="15" rx="2" fill="{colour}"/>')
            parts.append(f'<text x="{left + length + 6:.1f}" y="{y}">{_shown(value)}</text>')
        y += 36
    style = "text{font:12px system-ui,sans-serif;fill:#1c2733}.t{font-weight:600;font-size:13px}"
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {y - 18}" role="img"><style>{style}</style>'
    ground = f'<rect width="{width}" height="{y - 18}" fill="#fff"/>'
    return "\n".join(
        [head, ground, '<text x="8" y="14">Median time from publishing to the callback</text>', *parts, "</svg>\n"]
    )


def rewrite(results: Results, page: pathlib.Path = PAGE, image: pathlib.Path = CHART) -> None:
    """Put the table, and the line on where it was measured, into the page; draw the chart."""
    measured = f"Measured {results.started[:10]} by `make bench`: {results.environment}."
    block = f"<!-- figures -->\n{table(results)}\n{measured}\n<!-- end of figures -->\n"
    page.write_text(_BLOCK.sub(lambda _: block, page.read_text()))
    image.write_text(chart(results))
