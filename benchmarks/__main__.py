"""Run the benchmarks: `python -m benchmarks [--quick] [--only PATTERN]`."""

import argparse
import datetime
import fnmatch
import pathlib
import tempfile
import time

import redis
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from . import environment, figures, one_host, page, report, results, summary, targets
from .measure import Bench, Case
from .process import Workers
from .results import Results
from .server import private_server
from .suite import beside_before, every_case

FIGURES = environment.FOLDER.parent / "docs" / "lab" / "images" / "performance"


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a few minutes, coarse figures")
    parser.add_argument("--only", metavar="PATTERN", help="cases that match, such as 'array.*.get' or 'publish'")
    parser.add_argument("--list", action="store_true", help="name the cases and end")
    parser.add_argument("--draw", action="store_true", help="draw the figures again from the last whole run and end")
    parser.add_argument("--before", metavar="COMMIT", help="also measure REEM as it was then, where nothing may change")
    parser.add_argument("--all", action="store_true", help="print every figure, not only the ratios")
    return parser.parse_args()


def chosen(pattern: str | None, quick: bool) -> list[Case]:
    """The cases whose identifier matches the pattern or begins with it."""
    cases = every_case(quick and pattern is None)
    if pattern is None:
        return cases
    return [
        case
        for case in cases
        if fnmatch.fnmatchcase(case.identifier, pattern) or case.identifier.startswith(f"{pattern}.")
    ]


def run(cases: list[Case], quick: bool, mode: str, console: Console) -> Results:
    """Measure the cases on one private server."""
    started = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    for name in environment.PRIVATE:
        with console.status(f"virtual environment of {name}"):
            _prepare_environment(name, console)
    begin = time.monotonic()
    with private_server() as server, tempfile.TemporaryDirectory(prefix="bench-") as folder:
        found = Results(mode, started, environment.line(server.version()))
        bench = Bench(Workers(server, folder), quick)
        columns = (
            TextColumn("{task.description:32s}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
        )
        try:
            with Progress(*columns, console=console) as progress:
                chapter = ""
                for case in progress.track(cases, description="benchmarks"):
                    progress.update(progress.task_ids[0], description=case.identifier)
                    if chapter != (chapter := case.identifier.partition(".")[0]):
                        bench.workers.end()  # what a process did before has no part in what comes now
                    measure(case, bench, found)
                    server.empty()
        except redis.RedisError as error:
            # What was measured so far is kept, but not in the place of a whole run.
            console.print(f"[bold red]the server no longer answers, the run ends here: {error}")
            found.mode = "aborted"
        finally:
            bench.workers.end()
        found.versions = bench.workers.versions
    found.rows = [row.judged(found) for row in targets.rows()]
    if "before" in environment.PRIVATE:
        found.rows += [row.judged(found) for row in targets.unchanged()]
    found.seconds = time.monotonic() - begin
    return found


def measure(case: Case, bench: Bench, found: Results) -> None:
    """Add what one case yields."""
    begin = time.monotonic()
    for identifier, contender, entry in case.measure(bench):
        found.add(identifier, contender, entry)
    found.took[case.identifier] = time.monotonic() - begin


def _prepare_environment(name: str, console: Console) -> None:
    try:
        environment.interpreter(name)
    except environment.VenvError as error:
        console.print(f"[yellow]no environment for {name}: {error}")


def places(mode: str) -> tuple[pathlib.Path, pathlib.Path]:
    """Where the JSON file and the figures go: only a whole run replaces what is kept."""
    if mode == "full":
        return results.FULL, FIGURES
    return results.SCRATCH / f"{mode}.json", results.SCRATCH / mode


def main() -> None:
    """Measure, keep, draw and print."""
    options, console = arguments(), Console()
    if not console.is_terminal:
        console = Console(width=140)
    if options.list:
        console.print("\n".join(case.identifier for case in every_case()))
        return
    if options.draw:
        found = Results.load(results.FULL)
        figures.draw_all(found, FIGURES)
        page.rewrite(found)
        summary.rewrite(found)
        report.show(found, console, options.all)
        one_host.show(found, console)
        return
    cases = chosen(options.only, options.quick)
    if options.before:
        environment.PRIVATE["before"] = environment.at_commit(options.before)
        cases = beside_before(cases)
    if not cases:
        raise SystemExit(f"no case matches {options.only!r}; --list names them all")
    mode = "partial" if options.only or options.before else "quick" if options.quick else "full"
    found = run(cases, options.quick, mode, console)
    path, folder = places(found.mode)
    found.save(path)
    figures.draw_all(found, folder)
    if found.mode == "full":
        page.rewrite(found)
        summary.rewrite(found)
    report.show(found, console, options.all or bool(options.only))
    one_host.show(found, console)
    console.print(f"kept in {path} and {folder}", highlight=False)


if __name__ == "__main__":
    main()
