"""The suites of `mrtamp bench`: their arguments, and what each of them calls.

Everything that takes long to import is imported inside the suite that needs it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mrtamp.bench_best import BestKnown
    from mrtamp.bench_run import Run
    from mrtamp.bench_table import Line


def _first(options: argparse.Namespace, line: Line) -> bool:
    from mrtamp import bench

    return bench.first_plans(options.seeds, _rows(bench.FIRST, options), line)


def _costs(options: argparse.Namespace, line: Line) -> bool:
    from mrtamp.bench_costs import COSTS, costs

    rows = _rows(COSTS, options)
    known = _best_known()
    command = "mrtamp bench costs --budgets " + ",".join(f"{t:g}" for t in options.budgets)
    with _raw(options.raw) as keep:
        return costs(
            options.seeds, options.budgets, rows, known, line, command=command, update=options.update, keep=keep
        )


def _optimum(options: argparse.Namespace, line: Line) -> bool:
    from mrtamp.convergence import KNOWN, convergence

    rows = _rows(KNOWN, options, lambda row: row.problem)
    waiting = [f"{row.problem}, {options.seeds} runs of {row.budget_s:g} s" for row in rows]

    def say(text: str) -> None:
        line.say(text)
        line.show(waiting.pop(0) if waiting else "drawing")

    return convergence(options.seeds, rows, say, options.plot)


def _endurance(options: argparse.Namespace, line: Line) -> bool:
    from mrtamp.bench_costs import COSTS
    from mrtamp.bench_endurance import endurance

    rows = _rows(COSTS, options)
    known = _best_known()
    command = f"mrtamp bench endurance --minutes {options.minutes:g}"
    with _raw(options.raw) as keep:
        return endurance(
            options.minutes, options.seeds, rows, known, line, command=command, update=options.update, keep=keep
        )


def _ablation(options: argparse.Namespace, line: Line) -> bool:
    from mrtamp.bench_ablation import ABLATION, ablation

    rows = _rows(ABLATION, options)
    with _raw(options.raw) as keep:
        return ablation(options.seeds, options.budget, rows, line, keep=keep)


def _rows(rows: Sequence[Any], options: argparse.Namespace, name: Callable[[Any], str] = lambda row: row.name) -> list:
    """The rows whose name contains the text of --only."""
    chosen = [row for row in rows if options.only in name(row)]
    if not chosen:
        names = "; ".join(name(row) for row in rows)
        from mrtamp.problem import MrtampError

        raise MrtampError(f"--only: found {options.only!r}, expected part of one of: {names}")
    return chosen


def _best_known() -> BestKnown:
    from mrtamp.bench_best import BestKnown, best_known_file

    return BestKnown(best_known_file())


@contextmanager
def _raw(file: Path | None) -> Iterator[Callable[[Run], None]]:
    """Collects runs; in the end, however it comes, they are in the file."""
    runs: list[dict[str, Any]] = []
    try:
        yield lambda run: runs.append(run.as_dict())
    finally:
        if file is not None:
            file.write_text(json.dumps({"runs": runs}, indent=1) + "\n", encoding="utf-8")


# -- arguments -------------------------------------------------------------------------------------------------------


Converter = Callable[[str], float]


def add_suites(bench: argparse.ArgumentParser, positive: Callable[[Callable[[str], float], str], Converter]) -> None:
    """Add the suites to `mrtamp bench`.

    The namespace gets `suite`, which measures and prints; `raw` and `plot`, the files it writes; `update`.

    Parameters
    ----------
    positive : makes the converter of an argument from a type of number and what is expected, in words.
    """
    count = positive(int, "a whole number from 1")
    suites = bench.add_subparsers(title="suites", metavar="SUITE", required=True)

    def suite(name: str, run: Callable[..., bool], seeds: int, help: str) -> argparse.ArgumentParser:
        parser = suites.add_parser(name, help=help, description=help)
        parser.add_argument(
            "--seeds", type=count, default=seeds, metavar="N", help=f"planner seeds per row (default {seeds})"
        )
        parser.add_argument("--only", metavar="TEXT", default="", help="only the rows whose name contains TEXT")
        parser.set_defaults(suite=run, raw=None, plot=None, update=False)
        return parser

    def raw(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--raw", type=Path, metavar="FILE", help="write every run with its whole curve (JSON)")

    def update(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--update", action="store_true", help="lower models/best_known.json where a run was better (never raises)"
        )

    suite("first", _first, 5, "time to the first checked plan on the shipped tasks")
    costs = suite("costs", _costs, 5, "costs after some seconds, relative to the best ever found")
    costs.add_argument(
        "--budgets",
        type=_budgets,
        default=(10.0, 60.0),
        metavar="S,S",
        help="seconds after which costs are looked at (default 10,60)",
    )
    raw(costs)
    update(costs)
    optimum = suite("optimum", _optimum, 10, "convergence to the known optima of the planar problems")
    optimum.add_argument("--plot", type=_svg, metavar="FILE", help="draw every run, their mean and the optimum (SVG)")
    endurance = suite("endurance", _endurance, 1, "memory and cost over a long run")
    endurance.add_argument(
        "--minutes",
        type=positive(float, "a positive number of minutes"),
        default=10.0,
        metavar="M",
        help="length of a run (default 10)",
    )
    raw(endurance)
    update(endurance)
    ablation = suite("ablation", _ablation, 5, "what each mechanism is worth: the same runs without it")
    ablation.add_argument(
        "--budget",
        type=positive(float, "a positive number of seconds"),
        default=10.0,
        metavar="S",
        help="seconds per run (default 10)",
    )
    raw(ablation)


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
