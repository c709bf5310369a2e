"""`mrtamp bench`: what can be measured, its arguments, and what each of them calls.

Everything that takes long to import is imported inside the function that needs it.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mrtamp.arguments import Parser, count, positive, seconds

if TYPE_CHECKING:
    from mrtamp.bench.costs import Job
    from mrtamp.bench.suite import Suite
    from mrtamp.bench.table import Line

DESCRIPTION = """\
Measure planners.  SUITE is a suite of runs: one of those that are shipped (see
`mrtamp bench list`) or a YAML file.  Each run is a process of its own, its record is
on the disk before the next one begins, and the same command goes on where it was
stopped.  In the end, or with `report`, tables and figures are made of the records.
"""
COMMANDS = {
    "list": "the suites, how many runs they have and how long they take",
    "report": "make tables and figures anew from the records in a folder",
    "compare": "two planners of a suite, run by run: ratios with bootstrap intervals",
    "first": "time to the first checked plan on the shipped tasks",
    "costs": "costs after some seconds, relative to the best ever found",
    "optimum": "convergence to the known optima of the planar problems",
    "endurance": "memory and cost over a long run",
}
"""What is not a suite of runs, and what it does."""
_EPILOG = "\n".join(
    [
        "in place of SUITE:",
        *(f"  {name:<10} {text}" for name, text in COMMANDS.items()),
        "",
        "`mrtamp bench SUITE --help` names the arguments of each.",
    ]
)


# -- what is called --------------------------------------------------------------------------------------------------


def _suite(options: argparse.Namespace, line: Line) -> bool:
    """Run a suite and report it; whether every run came to its end and no plan was refused."""
    from mrtamp.bench.execute import execute
    from mrtamp.bench.suite import load_suite

    suite = _adjusted(load_suite(options.name), options)
    folder = options.out or Path("out/bench") / suite.name
    keys = [a.key for a in suite.assignments()]
    if not any(options.only in key for key in keys):
        raise _nothing(options.only, [case.name for case in suite.cases] + [e.label for e in suite.entrants])
    lost: list[str] = []
    try:
        lost = execute(
            suite,
            folder,
            line,
            workers=options.workers,
            scheduler=options.scheduler,
            again=options.again,
            wanted=lambda assignment: options.only in assignment.key,
        )
    except KeyboardInterrupt:
        _say_report(folder, line)
        line.say("the same command goes on from here")
        raise
    good = _say_report(folder, line)
    for text in lost:
        line.say(f"not run: {text}")
    return good and not lost


def _adjusted(suite: Suite, options: argparse.Namespace) -> Suite:
    """The suite with other seeds and limits, where asked for."""
    if options.seeds is not None:
        suite = dataclasses.replace(suite, seeds=tuple(range(options.seeds)))
    if options.limit is not None:
        cases = tuple(dataclasses.replace(case, limit_s=options.limit) for case in suite.cases)
        suite = dataclasses.replace(suite, cases=cases)
    return suite


def _report(options: argparse.Namespace, line: Line) -> bool:
    return _say_report(options.folder, line)


def _say_report(folder: Path, line: Line) -> bool:
    """Make the report and print its table; whether nothing went wrong in the runs."""
    from mrtamp.bench.records import read_records
    from mrtamp.bench.report import overhead_text, report, trouble_text

    line.show("making tables and figures")
    text, files = report(folder)
    records = read_records(folder)[1]
    trouble = trouble_text(records)
    figures = [file for file in files if file.suffix == ".png"]
    names = ", ".join(file.name for file in files if file not in figures)
    wrote = f"wrote {names} and {len(figures)} figure{'' if len(figures) == 1 else 's'} to {folder}"
    line.say("\n\n".join(part for part in (text, overhead_text(records), trouble, wrote) if part))
    return not trouble


def _compare(options: argparse.Namespace, line: Line) -> bool:
    from mrtamp.bench.cells import markdown
    from mrtamp.bench.compare import comparison
    from mrtamp.bench.records import read_records

    line.say(markdown(comparison(*read_records(options.folder), options.a, options.b)))
    return True


def _list(options: argparse.Namespace, line: Line) -> bool:
    from mrtamp.bench.execute import duration, expected_s
    from mrtamp.bench.suite import load_suite, shipped_suites
    from mrtamp.report import table

    rows = []
    for name in shipped_suites():
        suite = load_suite(name, find=False)
        runs = sum(1 for _ in suite.assignments())
        rows.append((name, str(runs), duration(expected_s(suite)), " ".join(suite.description.split())))
    line.say(table(("suite", "runs", "takes", "what it is about"), rows))
    line.say("\nTimes are for one run after the other; --workers and --scheduler share them out.")
    return True


def _first(options: argparse.Namespace, line: Line) -> bool:
    from mrtamp.bench.first import FIRST, first_plans

    return first_plans(options.seeds, _rows(FIRST, options), line)


def _costs(options: argparse.Namespace, line: Line) -> bool:
    from mrtamp.bench.costs import costs

    with _job(options, "costs --budgets " + ",".join(f"{t:g}" for t in options.budgets)) as job:
        return costs(job, options.budgets, line)


def _optimum(options: argparse.Namespace, line: Line) -> bool:
    from mrtamp.bench.convergence import KNOWN, convergence

    rows = _rows(KNOWN, options, lambda row: row.problem)
    waiting = [f"{row.problem}, {options.seeds} runs of {row.budget_s:g} s" for row in rows]

    def say(text: str) -> None:
        line.say(text)
        line.show(waiting.pop(0) if waiting else "drawing")

    return convergence(options.seeds, rows, say, options.plot)


def _endurance(options: argparse.Namespace, line: Line) -> bool:
    from mrtamp.bench.endurance import endurance

    with _job(options, f"endurance --minutes {options.minutes:g}") as job:
        return endurance(job, options.minutes, line)


def _rows(rows: Sequence[Any], options: argparse.Namespace, name: Callable[[Any], str] = lambda row: row.name) -> list:
    """The rows whose name contains the text of --only."""
    chosen = [row for row in rows if options.only in name(row)]
    if not chosen:
        raise _nothing(options.only, [name(row) for row in rows])
    return chosen


def _nothing(text: str, names: Sequence[str]) -> Exception:
    from mrtamp.problem import MrtampError

    return MrtampError(f"--only: found {text!r}, expected part of one of: {'; '.join(names)}")


@contextmanager
def _job(options: argparse.Namespace, command: str) -> Iterator[Job]:
    """What `costs` and `endurance` measure; in the end, however it comes, the runs are in the file of --raw."""
    from mrtamp.bench.best import BestKnown, best_known_file
    from mrtamp.bench.costs import COSTS, Job

    rows, known = _rows(COSTS, options), BestKnown(best_known_file())
    runs: list[dict[str, Any]] = []
    try:
        yield Job(
            rows,
            options.seeds,
            known,
            f"mrtamp bench {command}",
            options.update,
            keep=lambda run: runs.append(run.as_dict()),
        )
    finally:
        if options.raw is not None:
            options.raw.write_text(json.dumps({"runs": runs}, indent=1) + "\n", encoding="utf-8")


# -- arguments -------------------------------------------------------------------------------------------------------


def add_bench(bench: argparse.ArgumentParser) -> None:
    """The arguments of `mrtamp bench` itself: what to do, and the arguments of that, which `parse` looks at."""
    bench.formatter_class = argparse.RawDescriptionHelpFormatter
    bench.description, bench.epilog = DESCRIPTION, _EPILOG
    bench.usage = "mrtamp bench SUITE [arguments]"
    bench.add_argument("what", metavar="SUITE", help="a shipped suite, a YAML file, or one of the words below")
    rest = bench.add_argument("arguments", nargs=argparse.REMAINDER, metavar="...", help="its arguments")
    rest.required = False


def parse(what: str, arguments: Sequence[str]) -> argparse.Namespace:
    """The arguments of one of the things to do: `measure` does it; `files` are those that it will write."""
    parser = Parser(prog=f"mrtamp bench {what}", description=COMMANDS.get(what))
    parser.set_defaults(raw=None, plot=None, update=False)
    {
        "list": _list_arguments,
        "report": _report_arguments,
        "compare": _compare_arguments,
        "first": _first_arguments,
        "costs": _costs_arguments,
        "optimum": _optimum_arguments,
        "endurance": _endurance_arguments,
    }.get(what, _suite_arguments)(parser)
    options = parser.parse_args(arguments)
    options.name = what
    options.files = [file for file in (options.raw, options.plot) if file is not None]
    return options


def _suite_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Run a suite, or what is left of it, and report it."
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of records and report (default out/bench/SUITE)"
    )
    parser.add_argument("--seeds", type=count, metavar="N", help="planner seeds 0 to N-1 in place of the suite's")
    parser.add_argument("--limit", type=seconds, metavar="S", help="seconds per run in place of the suite's limits")
    parser.add_argument(
        "--only", metavar="TEXT", default="", help="only runs whose name (problem, planner, seed) contains TEXT"
    )
    parser.add_argument("--again", action="store_true", help="run those once more that failed with an error")
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers",
        type=count,
        default=1,
        metavar="N",
        help="runs at the same time (default 1: they disturb each other)",
    )
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a Dask scheduler, tcp://host:port: run on its workers"
    )
    parser.set_defaults(measure=_suite)


def _report_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder of the records")
    parser.set_defaults(measure=_report)


def _compare_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder of the records")
    parser.add_argument("a", metavar="A", help="label of a planner")
    parser.add_argument("b", metavar="B", help="label of the planner that A is divided by")
    parser.set_defaults(measure=_compare)


def _list_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(measure=_list)


def _rows_arguments(parser: argparse.ArgumentParser, seeds: int) -> None:
    parser.add_argument(
        "--seeds", type=count, default=seeds, metavar="N", help=f"planner seeds per row (default {seeds})"
    )
    parser.add_argument("--only", metavar="TEXT", default="", help="only the rows whose name contains TEXT")


def _raw_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--raw", type=Path, metavar="FILE", help="write every run with its whole curve (JSON)")
    parser.add_argument(
        "--update", action="store_true", help="lower models/best_known.json where a run was better (never raises)"
    )


def _first_arguments(parser: argparse.ArgumentParser) -> None:
    _rows_arguments(parser, 5)
    parser.set_defaults(measure=_first)


def _costs_arguments(parser: argparse.ArgumentParser) -> None:
    _rows_arguments(parser, 5)
    parser.add_argument(
        "--budgets",
        type=_budgets,
        default=(10.0, 60.0),
        metavar="S,S",
        help="seconds after which costs are looked at (default 10,60)",
    )
    _raw_arguments(parser)
    parser.set_defaults(measure=_costs)


def _optimum_arguments(parser: argparse.ArgumentParser) -> None:
    _rows_arguments(parser, 10)
    parser.add_argument("--plot", type=_svg, metavar="FILE", help="draw every run, their mean and the optimum (SVG)")
    parser.set_defaults(measure=_optimum)


def _endurance_arguments(parser: argparse.ArgumentParser) -> None:
    _rows_arguments(parser, 1)
    parser.add_argument(
        "--minutes",
        type=positive(float, "a positive number of minutes"),
        default=10.0,
        metavar="M",
        help="length of a run (default 10)",
    )
    _raw_arguments(parser)
    parser.set_defaults(measure=_endurance)


def _budgets(text: str) -> tuple[float, ...]:
    meaning = "positive numbers of seconds, separated by commas, such as 10,60"
    try:
        values = {float(part) for part in text.split(",")}
    except ValueError:
        values = {0.0}
    if not all(0 < value < float("inf") for value in values):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected {meaning}")
    return tuple(sorted(values))


def _svg(text: str) -> Path:
    if not text.endswith(".svg"):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a file that ends in .svg")
    return Path(text)
