"""The kept results: a JSON file, and the model's figures in it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from .measure import FOLLOWERS
from .model import Cost, Figures, Value

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / "benchmarks" / "results" / "scale.json"
SCRATCH = ROOT / "out" / "benchmarks" / "scale.json"

Results = dict[str, Any]


def load(path: Path = KEPT) -> Results:
    """Return what a whole run found."""
    found: Results = json.loads(path.read_text())
    return found


def save(found: Results, *, quick: bool) -> Results:
    """Keep results, rounded to four digits; a quick run does not replace a whole one. Returns what was kept."""
    path = SCRATCH if quick else KEPT
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(_rounded(found), indent=1) + "\n")
    return load(path)


def cost(row: dict[str, float]) -> Cost:
    """Return the cost in a row of results; what is below what could be measured is nothing."""
    return Cost(*(max(0.0, row[name]) for name in ("core_us", "bytes_in", "bytes_out", "bytes_replica")))


def figures(found: Results, setting: str) -> Figures:
    """Return what the model works with."""
    here = found["settings"][setting]
    values = {}
    for value, followers in FOLLOWERS.items():
        points = tuple((count, cost(here["cases"][f"{value}.publish.{count}"])) for count in followers)
        values[value] = Value(points, here["memory"][value])
    return Figures(values, cost(here["heartbeat"]), here["connections"], here["memory"]["connection"])


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return value
