"""The figures that are bars and dots."""

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from .contenders import CONTENDERS
from .report import OTHERS, duration, label
from .results import Results

VERDICTS = {"PASS *": "#1b7837", "PASS": "#5aae61", "near": "#e0a030", "FAIL": "#d1495b"}


def _colour(name: str) -> str:
    return CONTENDERS[name].colour if name in CONTENDERS else "#a0a0a0"


def _bars(axes: Axes, results: Results, case: str, title: str, statistic: str = "median") -> bool:
    entries = results.cases.get(case, {})
    names = [name for name in (*CONTENDERS, *OTHERS) if "median" in entries.get(name, {})][::-1]
    values = [entries[name][statistic] * 1e3 for name in names]
    bars = axes.barh([label(name) for name in names], values, color=[_colour(name) for name in names], height=0.65)
    axes.bar_label(bars, [f" {duration(value / 1e3)}" for value in values], fontsize=9)
    axes.set_title(title)
    axes.margins(x=0.22)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("milliseconds")
    return bool(names)


def _panels(results: Results, title: str, cases: dict[str, str], statistic: str = "median") -> Figure | None:
    present = {case: name for case, name in cases.items() if case in results.cases}
    if not present:
        return None
    most = max(len(results.cases[case]) for case in present)
    figure, grid = plt.subplots(1, len(present), figsize=(6.4 * len(present), 1.6 + 0.36 * most), squeeze=False)
    for axes, (case, name) in zip(grid[0], present.items(), strict=True):
        _bars(axes, results, case, name, statistic)
    figure.suptitle(title)
    figure.tight_layout()
    return figure


def draw_small(results: Results) -> Figure | None:
    """One small dictionary."""
    return _panels(results, "A small dictionary, medians", {"small.set": "set", "small.get": "get"})


def draw_pottery(results: Results) -> Figure | None:
    """Chapter 5.3."""
    return _panels(results, "Comparison with pottery, medians", {"pottery.set": "set", "pottery.get": "get"})


def draw_messages(results: Results) -> Figure | None:
    """Publish to callback, one subscriber."""
    cases = {
        "publish.small": "small message",
        "publish.image": "image, 640x480x3 uint8 (0.92 MB)",
        "publish.frame": "frame, 640x480x3 float64 (7.4 MB)",
    }
    return _panels(results, "Publish to callback between two processes, medians", cases)


def draw_camera(results: Results) -> Figure | None:
    """The controller beside the camera."""
    cases = {"camera.alone": "alone", "camera.beside": "beside 8 MB frames at 30 Hz"}
    figure = _panels(results, "Set points at 1 kHz: 99th percentile of a write", cases, "p99")
    if figure is not None:
        widest = max(axes.get_xlim()[1] for axes in figure.axes)
        for axes in figure.axes:
            axes.set_xlim(0, widest)
    return figure


def draw_import(results: Results) -> Figure | None:
    """Start of a program."""
    return _panels(results, "A process that imports one thing and ends, medians", {"import": ""})


def draw_ratios(results: Results) -> Figure | None:
    """Every row that was measured against what must be and what is hoped for; left is better."""
    rows = [row for row in results.rows if row["ratio"] is not None][::-1]
    if not rows:
        return None
    figure, axes = plt.subplots(figsize=(10, 1.6 + 0.27 * len(rows)))
    for place, row in enumerate(rows):
        ratio, must, hope = (_as_cost(row, row[name]) for name in ("ratio", "must", "hope"))
        axes.plot([hope, must], [place, place], color="#d0d0d0", linewidth=7, solid_capstyle="butt", zorder=1)
        axes.plot([must, must], [place - 0.35, place + 0.35], color="#444444", linewidth=1.5, zorder=2)
        axes.plot(ratio, place, "o", color=VERDICTS[row["verdict"]], markersize=7, zorder=3)
    axes.set_yticks(range(len(rows)), [row["text"] for row in rows], fontsize=8)
    axes.set_ylim(-0.7, len(rows) - 0.3)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(
        "ratio of cost, ours to theirs\ndot: measured; dark mark: must; grey band: from there to what is hoped for"
    )
    axes.set_title("What had to be shown")
    figure.tight_layout()
    return figure


def _as_cost(row: dict[str, float], ratio: float) -> float:
    return 1 / ratio if row["throughput"] else ratio
