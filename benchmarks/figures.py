"""Each figure as a PNG."""

import dataclasses
import functools
import itertools
import pathlib
from collections.abc import Callable
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator

from . import suite
from .contenders import CONTENDERS, LOCAL
from .figures_bars import draw_camera, draw_import, draw_messages, draw_pottery, draw_ratios, draw_small
from .results import Results

MARKS = dict(zip(CONTENDERS, itertools.cycle("os^D*vPXd<>hpH"), strict=False))


@dataclasses.dataclass(frozen=True)
class Panel:
    """One set of axes: `case` with the x value put in, and what is drawn of it."""

    title: str
    case: str
    unit: float = 1e3  # seconds times this
    per_second: bool = False


@dataclasses.dataclass(frozen=True)
class Lines:
    """One file: panels that share the x values."""

    name: str
    title: str
    xs: tuple[int, ...]
    x_label: str
    y_label: str
    panels: tuple[Panel, ...]
    log_x: bool = False
    log_y: bool = False
    rate: bool = False  # draw the entry's own `rate`
    x_names: tuple[str, ...] = ()


def size_name(count: float) -> str:
    """100 B, 10 kB, 8 MB."""
    for factor, unit in ((1e6, "MB"), (1e3, "kB")):
        if count >= factor:
            return f"{count / factor:g} {unit}"
    return f"{count:g} B"


def plain(value: float, _: Any = None) -> str:
    """A number as people write it."""
    return f"{value:,.0f}" if value >= 1 else f"{value:g}"


SET_GET = "set", "get"

LINES = (
    Lines(
        "strings",
        "Entries of 100 characters in one dictionary",
        suite.STRINGS,
        "entries",
        "milliseconds",
        tuple(Panel(name, f"strings.{{x}}.{name}") for name in SET_GET),
        log_y=True,
    ),
    Lines(
        "arrays",
        "Arrays (3, 4) in one dictionary",
        suite.ARRAYS,
        "arrays",
        "milliseconds",
        tuple(Panel(name, f"arrays.{{x}}.{name}") for name in SET_GET),
        log_y=True,
    ),
    Lines(
        "array-rates",
        "Square float64 arrays per second",
        suite.SIDES,
        "rows and columns",
        "arrays per second",
        tuple(Panel(name, f"array.{{x}}.{name}", per_second=True) for name in SET_GET),
        log_y=True,
    ),
    Lines(
        "subscribers",
        "Publish to callback, by number of subscribers",
        tuple(suite.SUBSCRIBERS),
        "subscribers (one process each; 1,000 in 10 processes)",
        "milliseconds",
        (Panel("", "subscribers.{x}"),),
        log_x=True,
        log_y=True,
    ),
    Lines(
        "entries",
        "How cost grows with the entries of a dictionary (100 characters each)",
        suite.ENTRIES,
        "entries",
        "milliseconds",
        tuple(Panel(name, f"entries.{{x}}.{name}") for name in SET_GET),
        log_x=True,
        log_y=True,
    ),
    Lines(
        "bytes",
        "How cost grows with the size of an array",
        suite.BYTES,
        "size of the array",
        "milliseconds",
        tuple(Panel(name, f"bytes.{{x}}.{name}") for name in SET_GET),
        log_x=True,
        log_y=True,
        x_names=tuple(size_name(count) for count in suite.BYTES),
    ),
    Lines(
        "callers",
        "Reads per second, concurrent asyncio callers on one interface",
        suite.CALLERS,
        "callers at once",
        "reads per second",
        (Panel("", "callers.{x}", per_second=True),),
        log_x=True,
    ),
    Lines(
        "threads",
        "Reads per second, threads on one interface",
        suite.THREADS,
        "threads",
        "reads per second",
        (Panel("", "threads.{x}", per_second=True),),
    ),
    Lines(
        "clients",
        "Reads per second of all client processes together",
        suite.CLIENTS,
        "client processes",
        "reads per second",
        (Panel("", "clients.{x}"),),
        rate=True,
    ),
)


def draw_all(results: Results, folder: pathlib.Path) -> list[pathlib.Path]:
    """Draw every figure that has something to show."""
    folder.mkdir(parents=True, exist_ok=True)
    plt.rcParams.update({"font.size": 10, "axes.grid": True, "grid.alpha": 0.25, "axes.axisbelow": True})
    plt.rcParams.update({"axes.spines.top": False, "axes.spines.right": False})
    drawers: dict[str, Callable[[Results], Figure | None]] = {
        **{lines.name: functools.partial(draw_lines, lines) for lines in LINES},
        "small": draw_small,
        "pottery": draw_pottery,
        "messages": draw_messages,
        "camera": draw_camera,
        "import": draw_import,
        "ratios": draw_ratios,
    }
    drawn = []
    for name, draw in drawers.items():
        figure = draw(results)
        if figure is not None:
            drawn.append(folder / f"{name}.png")
            figure.savefig(drawn[-1], dpi=110)
            plt.close(figure)
    return drawn


def draw_lines(lines: Lines, results: Results) -> Figure | None:
    """Medians with the range from the 10th to the 90th percentile."""
    count = len(lines.panels)
    figure, grid = plt.subplots(1, count, figsize=(5.2 * count + 0.8, 4.4), squeeze=False, sharey=True)
    shown = {
        name for axes, panel in zip(grid[0], lines.panels, strict=True) for name in _panel(axes, results, lines, panel)
    }
    if not shown:
        plt.close(figure)
        return None
    grid[0][0].set_ylabel(lines.y_label)
    figure.suptitle(lines.title)
    handles = {
        label: handle for axes in grid[0] for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    columns = 3 if count > 1 else 2
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=columns, frameon=False)
    rows = -(-len(handles) // columns)
    figure.tight_layout(rect=(0, 0.02 + 0.055 * rows, 1, 1))
    return figure


def _panel(axes: Axes, results: Results, lines: Lines, panel: Panel) -> list[str]:
    shown = []
    for name, contender in CONTENDERS.items():
        points = [
            (x, entry)
            for x in lines.xs
            if "median" in (entry := results.cases.get(panel.case.format(x=x), {}).get(name, {}))
        ]
        if points and name not in LOCAL.values():  # which have a point or two, for the table
            figures = [_figures(entry, lines, panel) for _, entry in points]
            middle = [figure[1] for figure in figures]
            below = [figure[1] - figure[0] for figure in figures]
            above = [figure[2] - figure[1] for figure in figures]
            axes.errorbar(
                [x for x, _ in points],
                middle,
                yerr=(below, above),
                color=contender.colour,
                label=contender.label,
                marker=MARKS[name],
                markersize=5,
                linewidth=1.5,
                elinewidth=0.8,
                capsize=2,
            )
            shown.append(name)
    _dress(axes, lines, panel)
    return shown


def _figures(entry: dict[str, float], lines: Lines, panel: Panel) -> tuple[float, float, float]:
    if lines.rate:
        return entry["rate"], entry["rate"], entry["rate"]
    low, middle, high = entry["p10"], entry["median"], entry["p90"]
    if panel.per_second:
        return 1 / high, 1 / middle, 1 / low
    return low * panel.unit, middle * panel.unit, high * panel.unit


def _dress(axes: Axes, lines: Lines, panel: Panel) -> None:
    axes.set_title(panel.title)
    axes.set_xlabel(lines.x_label)
    if lines.log_x:
        axes.set_xscale("log")
    if lines.log_y:
        axes.set_yscale("log")
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(bottom=0)
    axes.yaxis.set_major_formatter(FuncFormatter(plain))
    axes.set_xticks(lines.xs, lines.x_names or [f"{x:,}" for x in lines.xs])
    axes.xaxis.set_minor_locator(NullLocator())
    if lines.x_names:
        axes.tick_params(axis="x", labelrotation=35)
