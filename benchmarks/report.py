"""Tables in the terminal."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from .contenders import CONTENDERS
from .results import Entry, Results

OTHERS = {
    "python": "Python alone",
    "redis+numpy": "redis and numpy",
    "nobody": "nobody",
    "fetches": "a bare client that subscribes and fetches",
    "recorder": "reem record",
    "background": "reem record --background",
    "no viewer": "REEM's loop, no viewer",
    "page": "REEM's page, seen from elsewhere",
    "page in Chromium": "REEM's page, Chromium here",
}

STYLES = {
    "PASS *": "bold green",
    "PASS": "green",
    "near": "yellow",
    "FAIL": "bold red",
    "not measured": "dim",
}


def label(contender: str) -> str:
    """A contender's name for people."""
    known = CONTENDERS.get(contender)
    return known.label if known else OTHERS.get(contender, contender)


def duration(seconds: float) -> str:
    """Three digits and a unit."""
    for factor, unit in ((1.0, "s"), (1e3, "ms"), (1e6, "µs")):
        if seconds * factor >= 1 or unit == "µs":
            return f"{seconds * factor:.3g} {unit}" if seconds * factor < 1000 else f"{seconds * factor:.0f} {unit}"
    raise AssertionError("unreachable")


def ratios(results: Results) -> Table:
    """What has to be shown."""
    table = Table(title="Shown by: ratios of medians in this run (* what was hoped for)", title_justify="left")
    for name in ("case", "ours", "theirs", "ratio", "must", "hope", ""):
        table.add_column(name, justify="left" if name in {"case", ""} else "right")
    for row in results.rows:
        if results.mode == "partial" and row["ratio"] is None:
            continue
        sign = ">=" if row["throughput"] else "<="
        figures = [results.value(row[side][0], row[side][1], row["statistic"]) for side in ("ours", "theirs")]
        table.add_row(
            row["text"],
            *(duration(figure) if figure is not None else "-" for figure in figures),
            "-" if row["ratio"] is None else f"{row['ratio']:.2f}",
            f"{sign} {row['must']:g}",
            f"{row['hope']:g}",
            Text(row["verdict"], style=STYLES[row["verdict"]]),
        )
    return table


def cases(results: Results) -> Table:
    """Every figure taken."""
    table = Table(title="Medians, with the 99th percentile", title_justify="left")
    names = [name for name in CONTENDERS if any(name in entries for entries in results.cases.values())]
    names += [name for name in OTHERS if any(name in entries for entries in results.cases.values())]
    table.add_column("case")
    table.add_column("contender")
    for name in ("median", "p99", "samples", "remark"):
        table.add_column(name, justify="left" if name == "remark" else "right")
    for case, entries in results.cases.items():
        shown = case
        for name in names:
            if name in entries:
                table.add_row(shown, label(name), *_columns(entries[name]))
                shown = ""
        table.add_section()
    return table


def _columns(entry: Entry) -> list[str]:
    if "error" in entry:
        return ["-", "-", "-", f"could not run: {entry['error']}"]
    remarks = []
    if "measured_by" in entry:
        remarks.append(f"measured: {label(entry['measured_by'])}, because {entry['because']}")
    if "missed" in entry:
        remarks.append(f"{entry['missed']} of {entry['periods']} deadlines missed")
    if "rate" in entry:
        remarks.append(f"{entry['rate']:.0f} per second in all")
    if entry.get("sent", entry["count"]) > entry["count"]:
        remarks.append(f"{entry['sent'] - entry['count']} of {entry['sent']} not seen")
    return [duration(entry["median"]), duration(entry["p99"]), str(entry["count"]), "; ".join(remarks)]


def show(results: Results, console: Console, everything: bool) -> None:
    """Print environment, figures, failures and verdicts."""
    if everything:
        console.print(cases(results))
    console.print(ratios(results))
    for reason, where in results.failures().items():
        console.print(Text(f"could not run: {reason} ({len(where)} cases: {', '.join(where[:3])}, ...)", "yellow"))
    for name, version in results.versions.items():
        console.print(f"{label(name)}: {version}", highlight=False)
    console.print(f"{results.environment}", highlight=False)
    console.print(f"{results.started}, mode {results.mode}, {results.seconds:.0f} s", highlight=False)
