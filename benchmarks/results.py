"""What was measured: summaries of samples, and the JSON file that keeps them."""

import dataclasses
import json
import pathlib
from typing import Any

import numpy as np

from .environment import FOLDER

Entry = dict[str, Any]

FULL = FOLDER / "results" / "latest.json"
SCRATCH = FOLDER.parent / "out" / "benchmarks"  # quick and partial runs; not kept


def summary(seconds: list[float], **more: Any) -> Entry:
    """Median, 10th, 90th and 99th percentile, in seconds."""
    if not seconds:
        return {"error": "no sample: nothing arrived", **more}
    low, median, high, tail = np.percentile(seconds, [10, 50, 90, 99]).tolist()
    return {"median": median, "p10": low, "p90": high, "p99": tail, "count": len(seconds), **more}


def failure(error: BaseException | str, **more: Any) -> Entry:
    """What stands in the place of figures that could not be taken."""
    return {"error": str(error), **more}


@dataclasses.dataclass
class Results:
    """All figures of one run: case, contender, entry."""

    mode: str
    started: str
    environment: str
    versions: dict[str, str] = dataclasses.field(default_factory=dict)
    cases: dict[str, dict[str, Entry]] = dataclasses.field(default_factory=dict)
    rows: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    took: dict[str, float] = dataclasses.field(default_factory=dict)
    seconds: float = 0.0

    def add(self, case: str, contender: str, entry: Entry) -> None:
        """Keep one entry."""
        self.cases.setdefault(case, {})[contender] = entry

    def value(self, case: str, contender: str, statistic: str = "median") -> float | None:
        """One figure, or None if it was not taken."""
        found = self.cases.get(case, {}).get(contender, {}).get(statistic)
        return None if found is None else float(found)

    def failures(self) -> dict[str, list[str]]:
        """Contender and reason, with the cases it holds for."""
        reasons: dict[str, list[str]] = {}
        for case, entries in self.cases.items():
            for contender, entry in entries.items():
                if "error" in entry:
                    reasons.setdefault(f"{contender}: {entry['error']}", []).append(case)
        return reasons

    def save(self, path: pathlib.Path) -> None:
        """Write the JSON file."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(_rounded(dataclasses.asdict(self)), indent=1) + "\n")

    @classmethod
    def load(cls, path: pathlib.Path) -> "Results":
        """Read the JSON file."""
        return cls(**json.loads(path.read_text()))


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return value
