"""The command line: list, plan, check, view, show, bench.

Exit codes: 0 a plan was found and checked (or the check passed, or every aim of a suite was met), 1 no plan within the
budget (or the check failed, or an aim was missed), 2 bad input, 130 interrupted before there was anything to lose
(see `mrtamp.__main__`).  What takes long to import is imported inside the
command that needs it.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from mrtamp.arguments import Parser, count, natural, seconds
from mrtamp.bench.arguments import add_bench, parse
from mrtamp.mechanisms import (
    BASELINE_MECHANISMS,
    INTRA_ORBIT_NAMES,
    INTRA_ORBIT_PLANNERS,
    MECHANISMS,
    PLANNER_NAMES,
)

if TYPE_CHECKING:
    from mrtamp.plan import Plan
    from mrtamp.planners import AnyPlanner, PlannerOptions
    from mrtamp.portfolio_plan import SeedPortfolio
    from mrtamp.problem import Problem

FOUND, NOT_FOUND, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
DEFAULT_BUDGET_S = 10.0


class _BadInput(Exception):
    """Something the person can put right; its text is all they need to see."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    options, left_over = _parser().parse_known_args(arguments)
    if left_over:
        text = " ".join(left_over)
        if options.run is _bench:
            options.parser.error(f"found {text} before SUITE, expected SUITE first")
        options.parser.error(f"found {text}, which is no argument")
    try:
        code = _run(options)
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader of our output has seen enough; leave nothing for the interpreter to flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FOUND
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return INTERRUPTED


def _run(options: argparse.Namespace) -> int:
    try:
        return options.run(options)
    except _BadInput as error:
        message = str(error)
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            raise
        message = f"{error.filename}: {error.strerror}" if error.filename else str(error)
    except Exception as error:
        from mrtamp.problem import MrtampError

        if not isinstance(error, MrtampError):
            raise
        message = str(error)
    print(f"mrtamp: {message}", file=sys.stderr)
    if getattr(options, "json", False):
        print(json.dumps({"ok": False, "error": message}))
    return BAD_INPUT


# -- commands -------------------------------------------------------------------------------------------------------


def _list(options: argparse.Namespace) -> int:
    from mrtamp.problem_file import list_problems
    from mrtamp.report import table

    problems = list_problems()
    if options.json:
        print(json.dumps(problems))
    else:
        print(table(("problem", "what it is about"), [(n, " ".join(d.split())) for n, d in problems.items()]))
    return FOUND


def _plan(options: argparse.Namespace) -> int:
    from mrtamp.progress import ProgressLine

    if options.scheduler is not None and options.portfolio is None:
        raise _BadInput("found --scheduler without --portfolio N, expected both: one seed is planned here")
    if options.intra_orbit is not None and options.planner not in INTRA_ORBIT_PLANNERS:
        either = " or ".join(INTRA_ORBIT_PLANNERS)
        raise _BadInput(f"--intra-orbit: {options.planner} has no such setting, expected it with {either} only")
    if options.out and options.html and options.out.resolve() == options.html.resolve():
        raise _BadInput(f"--out and --html are the same file, {options.out}")
    for path in (options.out, options.html):
        _ensure_writable(path)
    started = time.monotonic()
    settings = _settings(options)
    planner: AnyPlanner | SeedPortfolio | None = None
    with _stop_on_signals() as signals, ProgressLine(sys.stderr, enabled=not options.quiet) as progress:
        try:
            problem = _load_problem(options)
            planner = _planner(options, problem, settings)
            progress(planner.status())
            budget = options.budget
            if budget is None and options.iterations is None:
                budget = DEFAULT_BUDGET_S
            for _ in planner.improve(budget, iterations=options.iterations, first=options.first, progress=progress):
                pass
        except KeyboardInterrupt:
            pass
    elapsed = time.monotonic() - started
    best = planner.best if planner else None
    if best is None:
        return _report_failure(options, planner, elapsed, stopped=bool(signals))
    written = []
    if options.out:
        best.save(options.out)
        written.append(options.out)
    if options.html:
        from mrtamp.view import write_html

        write_html(best, options.html)
        written.append(options.html)
    assert planner is not None
    _report_plan(options, best, elapsed, written, planner.sampled_bound, stopped=bool(signals))
    if options.view:
        _serve(best, options)
    return FOUND


def _settings(options: argparse.Namespace) -> PlannerOptions:
    """The options of the planner that was asked for.

    Everything that planning imports is imported here, before a signal becomes an exception.
    """
    import mrtamp.problem_file
    from mrtamp.planners import planner_options

    if options.portfolio is not None:
        import mrtamp.portfolio_plan  # noqa: F401

        with suppress(ImportError):  # what lacks is said by whoever needs it
            import distributed  # noqa: F401
    given = {"without": options.without} if options.without else {}
    if options.intra_orbit is not None:
        given["intra_orbit"] = options.intra_orbit
    return planner_options(options.planner, given)


def _planner(options: argparse.Namespace, problem: Problem, settings: PlannerOptions) -> AnyPlanner | SeedPortfolio:
    from mrtamp.planners import make_planner

    if options.portfolio is None:
        return make_planner(options.planner, problem, options.seed, settings)
    from mrtamp.portfolio_plan import SeedPortfolio

    seeds = range(options.seed, options.seed + options.portfolio)
    return SeedPortfolio(problem, seeds, scheduler=options.scheduler, planner=options.planner, options=settings)


def _report_failure(
    options: argparse.Namespace, planner: AnyPlanner | SeedPortfolio | None, elapsed: float, *, stopped: bool
) -> int:
    explanation = planner.explain() if planner else "stopped before planning began"
    reason = f"{'stopped' if stopped else 'no plan'} after {elapsed:.1f} s without a plan"
    if not stopped:
        reason = f"no plan within {_bounds(options)}"
    if options.json:
        data = {"ok": False, "stopped": stopped, "elapsed_s": elapsed, "problem": options.problem, "seed": options.seed}
        data |= {"reason": reason, "explanation": explanation, "counts": planner.counts() if planner else {}}
        print(json.dumps({**data, "sampled_bound": planner.sampled_bound if planner else None}))
    elif options.quiet:
        print(f"mrtamp: {reason}", file=sys.stderr)
    else:
        print(f"{options.problem}: {reason}\n\n{explanation}")
    return NOT_FOUND


def _bounds(options: argparse.Namespace) -> str:
    parts = [f"{options.iterations} iterations"] if options.iterations is not None else []
    if options.budget is not None or not parts:
        parts.insert(0, f"{options.budget or DEFAULT_BUDGET_S:g} s")
    return " and ".join(parts)


def _report_plan(
    options: argparse.Namespace,
    plan: Plan,
    elapsed: float,
    written: list[Path],
    bound: float | None,
    *,
    stopped: bool,
) -> None:
    from mrtamp import report

    if options.json:
        files = {"out": options.out, "html": options.html}
        data = {"ok": True, "stopped": stopped, "elapsed_s": elapsed, **report.summary(plan), "sampled_bound": bound}
        data["files"] = {key: str(path) for key, path in files.items() if path}
        print(json.dumps(data))
        return
    if options.quiet:
        return
    manner = "stopped; the best plan so far, checked" if stopped else "plan found and checked"
    others = f", best of {plan.found_by['portfolio']}" if "portfolio" in plan.found_by else ""
    blocks = [
        f"{plan.problem.name}: {manner} (seed {plan.seed}{others}, {elapsed:.1f} s)",
        report.timeline_text(plan),
        report.cost_text(plan),
        _bound_text(plan.cost, bound),
        report.history_text(plan),
        report.counts_text(plan),
    ]
    if written:
        blocks.append("\n".join(f"wrote {path} ({_size(path)})" for path in written))
    print("\n\n".join(block for block in blocks if block))


def _bound_text(cost: float, bound: float | None) -> str:
    """How far the plan is from the cheapest decoupled skeleton; that bounds what these transitions allow, no more."""
    if not bound:
        return ""
    return (
        f"sampled bound: {bound:.3f} ({cost / bound - 1:+.1%}): the cheapest assignment and order over the transitions "
        "sampled so far, robots not in each other's way"
    )


def _size(path: Path) -> str:
    size = path.stat().st_size
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{max(size / 1e3, 0.1):.1f} kB"


def _check(options: argparse.Namespace) -> int:
    from mrtamp.check import check_plan

    report = check_plan(_load_plan(options.plan))
    if options.json:
        violations = [
            {"kind": v.kind, "message": v.message, "segment": v.segment, "step": v.step, "value": v.value}
            for v in report.violations
        ]
        clearance = report.min_clearance_m if report.min_clearance_m != float("inf") else None
        facts = {"samples": report.samples, "min_clearance_m": clearance, "elapsed_s": report.elapsed}
        print(json.dumps({"ok": report.ok, "violations": violations, **facts}))
    else:
        print(f"{options.plan}: {report}")
    return FOUND if report.ok else NOT_FOUND


def _view(options: argparse.Namespace) -> int:
    return _look(_load_plan(options.plan), options)


def _show(options: argparse.Namespace) -> int:
    from mrtamp.check import Checker
    from mrtamp.incumbent import start_fault

    problem = _load_problem(options)
    fault = start_fault(Checker(problem))
    if fault is not None:
        print(f"mrtamp: warning: {fault}", file=sys.stderr)
    return _look(problem, options)


def _look(what: Plan | Problem, options: argparse.Namespace) -> int:
    if options.html:
        from mrtamp.view import write_html

        _ensure_writable(options.html)
        write_html(what, options.html)
        print(f"wrote {options.html} ({_size(options.html)})")
    else:
        _serve(what, options)
    return FOUND


def _serve(what: Plan | Problem, options: argparse.Namespace) -> None:
    """A live window until it is stopped there, or here with Ctrl-C."""
    from mrtamp.view import view

    with _stop_on_signals():
        try:
            viewer = view(what)
            # With --json, stdout holds the one object and nothing else.
            stream = sys.stderr if getattr(options, "json", False) else sys.stdout
            print(f"open {viewer.url} in a browser; Ctrl-C ends", file=stream, flush=True)
            if viewer.duration > 0:
                print(
                    "space: play or pause; 'Open Controls' has the time slider and every step", file=stream, flush=True
                )
            viewer.run()
        except KeyboardInterrupt:
            pass


def _bench(options: argparse.Namespace) -> int:
    """One kind of measurement; `chosen.measure` takes it and prints it."""
    chosen = parse(options.what, options.arguments)
    from mrtamp.bench.table import Line

    files = chosen.files
    if chosen.update:
        from mrtamp.bench.best import best_known_file

        files.append(best_known_file())
    for path in files:
        _ensure_writable(path)
    with _stop_on_signals(), Line(sys.stderr, lambda text: print(text, flush=True)) as line:
        try:
            good = chosen.measure(chosen, line)
        except KeyboardInterrupt:
            line.say("stopped: the rows above are what was finished")
            return NOT_FOUND
    return FOUND if good else NOT_FOUND


# -- input and output -----------------------------------------------------------------------------------------------


def _load_problem(options: argparse.Namespace) -> Problem:
    from mrtamp.problem_file import load_problem

    names = ("robots", "objects", "layout_seed")
    parameters = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    return load_problem(options.problem, **parameters)


def _load_plan(path: Path) -> Plan:
    from mrtamp.plan import Plan

    return Plan.load(path)


def _ensure_writable(path: Path | None) -> None:
    """Find out now, not after planning, that a file cannot be written; missing folders are made."""
    if path is None:
        return
    if path.exists() and not path.is_file():
        raise _BadInput(f"cannot write {path}: it is {'a directory' if path.is_dir() else 'not a regular file'}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
        if path.exists():
            with path.open("ab"):
                pass
    except FileExistsError as error:
        raise _BadInput(f"cannot write {path}: {error.filename} is no folder") from None
    except OSError as error:
        raise _BadInput(f"cannot write {path}: {error.strerror}") from None


@contextmanager
def _stop_on_signals() -> Iterator[list[int]]:
    """Turn the first SIGINT or SIGTERM into a KeyboardInterrupt; a second one ends the process at once.

    Yields the list of signals received so far.
    """
    received: list[int] = []
    watched = (signal.SIGINT, signal.SIGTERM)

    def handle(number: int, frame: object) -> NoReturn:
        received.append(number)
        for s in watched:
            signal.signal(s, signal.SIG_DFL)
        raise KeyboardInterrupt

    previous = {s: signal.signal(s, handle) for s in watched}
    try:
        yield received
    finally:
        # After a first signal the default action stays: what follows, writing files, can still be aborted.
        if not received:
            for s, handler in previous.items():
                signal.signal(s, handler)


# -- arguments ------------------------------------------------------------------------------------------------------


class _Version(argparse.Action):
    """Prints the version; a class of its own because finding it out takes longer than everything else."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        from mrtamp import __version__

        print(f"mrtamp {__version__}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="mrtamp",
        description="Plan what several robot arms do together: who handles what, when, and every motion.",
        epilog="Exit codes: 0 found and checked, 1 no plan, failed check or missed aim, 2 bad input, 130 interrupted.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def problem_arguments(command: argparse.ArgumentParser) -> None:
        command.add_argument(
            "problem", metavar="PROBLEM|FILE", help="a shipped problem (see mrtamp list) or a YAML file"
        )
        command.add_argument("--robots", type=count, metavar="N", help="number of robots (generated problems)")
        command.add_argument("--objects", type=count, metavar="N", help="number of objects (generated problems)")
        command.add_argument("--layout-seed", type=natural, metavar="N", help="seed of the layout (generated problems)")

    listing = commands.add_parser("list", help="list the shipped problems")
    listing.add_argument("--json", action="store_true", help="print one JSON object")
    listing.set_defaults(run=_list)

    plan = commands.add_parser("plan", help="plan a problem and keep improving the plan")
    problem_arguments(plan)
    plan.add_argument(
        "--planner",
        default=PLANNER_NAMES[0],
        choices=PLANNER_NAMES,
        help=f"which planner (default {PLANNER_NAMES[0]}); the others are baselines to compare with",
    )
    plan.add_argument("--seed", type=natural, default=0, metavar="N", help="seed of the planner (default 0)")
    plan.add_argument(
        "--portfolio",
        type=count,
        metavar="N",
        help="plan with N seeds side by side, from --seed on, each for the whole --budget, which counts from when all "
        "have started; the best wins",
    )
    plan.add_argument(
        "--scheduler", metavar="ADDRESS", help="where: a Dask scheduler, tcp://host:port (default: N processes here)"
    )
    plan.add_argument("--budget", type=seconds, metavar="S", help=f"seconds of planning (default {DEFAULT_BUDGET_S:g})")
    plan.add_argument("--iterations", type=count, metavar="N", help="stop after N iterations; repeatable for a seed")
    plan.add_argument("--first", action="store_true", help="stop at the first plan")
    plan.add_argument("--out", type=Path, metavar="FILE", help="write the plan (JSON)")
    plan.add_argument("--html", type=Path, metavar="FILE", help="write a page with the animation, good without network")
    plan.add_argument("--view", action="store_true", help="open a live window on the plan afterwards")
    plan.add_argument(
        "--without",
        action="append",
        default=[],
        metavar="MECHANISM",
        choices=sorted({**MECHANISMS, **BASELINE_MECHANISMS}),
        help=f"switch a mechanism off (repeatable): {', '.join({**MECHANISMS, **BASELINE_MECHANISMS})}",
    )
    plan.add_argument(
        "--intra-orbit",
        choices=INTRA_ORBIT_NAMES,
        help="planner of motion inside an orbit (default tensor-tree)",
    )
    how = plan.add_mutually_exclusive_group()
    how.add_argument("--quiet", action="store_true", help="print nothing but errors")
    how.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    plan.set_defaults(run=_plan)

    check = commands.add_parser("check", help="judge a plan file, from the problem and the plan alone")
    check.add_argument("plan", type=Path, metavar="PLAN", help="a plan file")
    check.add_argument("--json", action="store_true", help="print one JSON object")
    check.set_defaults(run=_check)

    viewing = commands.add_parser("view", help="look at a plan: play, pause, time slider")
    viewing.add_argument("plan", type=Path, metavar="PLAN", help="a plan file")
    viewing.add_argument("--html", type=Path, metavar="FILE", help="write a page instead of opening a window")
    viewing.set_defaults(run=_view)

    show = commands.add_parser("show", help="look at a problem before planning it")
    problem_arguments(show)
    show.add_argument("--html", type=Path, metavar="FILE", help="write a page instead of opening a window")
    show.set_defaults(run=_show)

    bench = commands.add_parser("bench", help="measure planners: suites of runs, their reports and comparisons")
    bench.set_defaults(run=_bench)
    add_bench(bench)
    for command in commands.choices.values():
        command.set_defaults(parser=command)
    return parser


if __name__ == "__main__":
    sys.exit(main())
