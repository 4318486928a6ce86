"""The plots of docs/lab/scale.md."""

from __future__ import annotations

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from . import kinds, spread
from .model import Figures, robot_load
from .results import ROOT, Results, figures

FOLDER = ROOT / "docs" / "lab" / "images"
PLAIN, SHARED, ARM = "#1f6fb4", "#c8452e", "#3c8d40"


def draw(found: Results) -> None:
    """Draw both plots."""
    _balance(figures(found, "six"))
    _cores(figures(found, "one"))


def _balance(given: Figures) -> None:
    figure, grid = plt.subplots(1, len(spread.NODES), figsize=(11, 4.6), sharey=True)
    for axes, nodes in zip(grid, spread.NODES, strict=True):
        _balance_panel(axes, nodes, given)
    grid[0].set_ylabel("load of the fullest primary / mean")
    grid[0].legend(frameon=False, fontsize=8, loc="upper right")
    figure.suptitle("Balance over hash slots: 1 is even")
    figure.tight_layout()
    figure.savefig(FOLDER / "scale-balance.png", dpi=110)
    plt.close(figure)


def _balance_panel(axes: Axes, nodes: int, given: Figures) -> None:
    arm, base = (spread.cores(kinds.ROBOTS[name], given) for name in ("arm", "base"))
    luck = [spread.by_luck(base, nodes, robots) for robots in spread.SIZES]
    axes.fill_between(
        spread.SIZES, [row[2] for row in luck], [row[-3] for row in luck],
        color=PLAIN, alpha=0.15, label="bases, 10 % to 90 % of 20 namings",
    )  # fmt: skip
    lines = [
        ("arms", ARM, spread.over_sizes(arm, nodes)),
        ("bases", PLAIN, spread.over_sizes(base, nodes)),
        ("bases and a key they all follow", SHARED, spread.over_sizes(base, nodes, given)),
    ]
    for label, colour, spreads in lines:
        axes.plot(spread.SIZES, [it.fallen for it in spreads], color=colour, marker="o", ms=4, label=label)
        axes.plot(
            spread.SIZES, [it.resharded for it in spreads], color=colour, marker="o", ms=4, mfc="white",
            linestyle="--", label=f"{label}, slots moved by weight",
        )  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="robots", title=f"{nodes} primaries")
    ticks = [1, 1.5, 2, 3, 5, 10, 20, 50]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks(spread.SIZES[::2], [f"{size:,}" for size in spread.SIZES[::2]])
    axes.minorticks_off()
    axes.grid(alpha=0.25)


def _cores(given: Figures) -> None:
    """Where the core's time goes, robot by robot."""
    names = ["publishing", "notices and fetches", "heartbeats"]
    colours = [PLAIN, SHARED, "#999999"]
    rows = {}
    for what, robot in {**kinds.REMEDIES, "mobile base": kinds.BASE}.items():
        publishing = sum(each.hertz * given.values[each.value].publish(0).core_us for each in robot.topics)
        following = sum(
            each.hertz * each.followers * given.values[each.value].following(each.followers).core_us
            for each in robot.topics
        )
        beating = sum(each.followers * given.heartbeat.core_us for each in robot.topics)
        rows[what] = (publishing / 1e4, following / 1e4, beating / 1e4)
        assert abs(sum(rows[what]) / 100 - robot_load(robot, given).core) < 1e-9
    figure, axes = plt.subplots(figsize=(9, 3.6))
    left = [0.0] * len(rows)
    for place, (name, colour) in enumerate(zip(names, colours, strict=True)):
        widths = [row[place] for row in rows.values()]
        axes.barh(list(rows), widths, left=left, color=colour, label=name, height=0.62)
        left = [a + b for a, b in zip(left, widths, strict=True)]
    axes.invert_yaxis()
    axes.set_xlabel("% of one server core, for one robot")
    axes.legend(frameon=False, fontsize=8, loc="lower right")
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(FOLDER / "scale-core.png", dpi=110)
    plt.close(figure)
