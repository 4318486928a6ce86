"""Numbers and tables for people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def number(value: float) -> str:
    """Return three digits of a number, with commas: 0.0123, 1.23, 123, 12,300."""
    if value == 0:
        return "0"
    rounded = float(f"{value:.3g}")
    if abs(rounded) >= 100:
        return f"{rounded:,.0f}"
    return f"{rounded:.3g}"


def size(value: float) -> str:
    """Return bytes with a unit."""
    for factor, unit in ((1e9, "GB"), (1e6, "MB"), (1e4, "kB")):
        if abs(value) >= factor:
            return f"{number(value / (1e3 if unit == 'kB' else factor))} {unit}"
    return f"{number(value)} B"


def bits(value: float) -> str:
    """Return bits per second with a unit."""
    return f"{number(value / 1e9)} Gbit/s" if value >= 1e9 else f"{number(value / 1e6)} Mbit/s"


def times(value: float) -> str:
    """Return a ratio with two digits behind the point, fewer if it is large."""
    return f"{value:.2f}" if value < 10 else f"{value:.1f}"


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
