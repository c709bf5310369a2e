"""One measured run: a problem planned with one seed in a process of its own, so that nothing is warm and its memory is
its own.

Every plan that the run yields is saved, loaded again and judged from that file; only then is the run handed back.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mrtamp.bench.table import Line
from mrtamp.workers import uninterrupted

if TYPE_CHECKING:
    from mrtamp.plan import Plan
    from mrtamp.problem import Problem

Tell = Callable[[str], None]
"""Says in a few words how far a run has come."""

_END_S = 5.0
"""Seconds in which a process is over that says nothing more."""
_PULSE_S = 1.0
"""Seconds between two reports of a run."""


@dataclass(frozen=True)
class Task:
    """A shipped problem; `parameters` where it is generated (the layout seed is the generator's default)."""

    problem: str
    parameters: Mapping[str, int] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The problem, with robots/objects where it is generated; the layout is no part of it."""
        sizes = {key: number for key, number in self.parameters.items() if key != "layout_seed"}
        if set(sizes) == {"robots", "objects"}:
            return f"{self.problem} {sizes['robots']}/{sizes['objects']}"
        return " ".join([self.problem, *(f"{number} {key}" for key, number in sizes.items())])

    def load(self) -> Problem:
        """The problem itself."""
        from mrtamp.problem_file import load_problem

        return load_problem(self.problem, **self.parameters)


def pick_place(robots: int, objects: int) -> Task:
    """The scalable task."""
    return Task("pick_place", {"robots": robots, "objects": objects})


@dataclass(frozen=True)
class Point:
    """An incumbent: when it was found (s since planning began), its cost, makespan and path length."""

    time_s: float
    cost: float
    makespan: float
    path_length: float


@dataclass(frozen=True)
class Run:
    """What came of one run.

    Attributes
    ----------
    points : every plan that was yielded, in order.
    memory : (s since planning began, resident megabytes), once per `_PULSE_S`.
    peak_mb : the most memory at any time.
    refused : what the judge said against plans when they were loaded from their files: empty, or something is wrong.
    stopped : somebody did not want to wait for the end.
    """

    name: str
    seed: int
    budget_s: float
    points: tuple[Point, ...]
    memory: tuple[tuple[float, float], ...]
    peak_mb: float
    refused: tuple[str, ...] = ()
    stopped: bool = False

    def at(self, time_s: float) -> Point | None:
        """The incumbent at a time; None before there was one."""
        return next((p for p in reversed(self.points) if p.time_s <= time_s), None)

    def cost_at(self, time_s: float) -> float:
        """The cost of the incumbent at a time, infinite before there was one."""
        point = self.at(time_s)
        return point.cost if point else float("inf")

    @property
    def first(self) -> Point | None:
        """The first plan."""
        return self.points[0] if self.points else None

    @property
    def best(self) -> Point | None:
        """The last plan, which is the cheapest."""
        return self.points[-1] if self.points else None

    @property
    def never_rises(self) -> bool:
        """Whether every plan was found after the one before it, and cost no more."""
        return all(a.time_s <= b.time_s and a.cost >= b.cost for a, b in pairwise(self.points))

    @property
    def flawless(self) -> bool:
        """Whether the curve never rises and every plan passed the check from its file."""
        return self.never_rises and not self.refused

    def as_dict(self) -> dict[str, Any]:
        """The same as JSON-able data."""
        return asdict(self)


class Stopped(KeyboardInterrupt):
    """A run was stopped; `run` is what it had come to, None if nothing."""

    def __init__(self, run: Run | None) -> None:
        super().__init__()
        self.run = run


# -- in the process of the run ---------------------------------------------------------------------------------------


def plan_once(task: Task, seed: int, budget_s: float, tell: Tell) -> Run:
    """Plan once, in this process; `budget_s` includes the planner's preparation, not imports and loading."""
    from mrtamp.plan import measures
    from mrtamp.planner import Planner

    problem = task.load()
    plans: list[Plan] = []
    stopped = False
    with Pulse(tell) as pulse:
        try:
            planner = Planner(problem, seed=seed)
            for plan in planner.improve(max(budget_s - planner.status().elapsed_s, 0.0)):
                plans.append(plan)
                pulse.cost = plan.cost
        except KeyboardInterrupt:
            stopped = True
    peak = peak_mb()
    points = tuple(Point(p.history[-1]["time_s"], p.cost, **measures(p.segments)) for p in plans)
    tell(f"checking {len(plans)} plans from their files")
    return Run(task.name, seed, budget_s, points, tuple(pulse.memory), peak, tuple(refusals(plans)), stopped)


def refusals(plans: Sequence[Plan]) -> list[str]:
    """What the judge has against plans, each loaded from the file it was saved to."""
    from mrtamp.check import check_plan
    from mrtamp.plan import Plan

    out = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plan.json"
        for plan in plans:
            plan.save(file)
            report = check_plan(Plan.load(file))
            if not report.ok:
                out.append(f"the plan of cost {plan.cost:.3f}: {report.violations[0].message}")
    return out


class Pulse:
    """Reports how far a run is and notes its memory, from a thread of its own."""

    def __init__(self, tell: Tell) -> None:
        self.cost: float | None = None
        self.memory: list[tuple[float, float]] = []
        self._tell = tell
        self._began = time.perf_counter()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Pulse:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(_PULSE_S):
            elapsed, memory = time.perf_counter() - self._began, resident_mb()
            self.memory.append((elapsed, memory))
            cost = "no plan yet" if self.cost is None else f"cost {self.cost:.3f}"
            self._tell(f"{elapsed:.0f} s, {cost}, {memory:.0f} MB")


def resident_mb() -> float:
    """Resident memory of this process (MB of 2^20 bytes)."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text(encoding="ascii").split()[1]) * resource.getpagesize() / 2**20
    text = subprocess.run(["ps", "-o", "rss=", "-p", str(os.getpid())], capture_output=True, text=True, check=True)
    return int(text.stdout) / 2**10


def peak_mb() -> float:
    """The most resident memory this process ever had (MB of 2^20 bytes)."""
    # Kilobytes on Linux, bytes on macOS.
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


# -- in the process of whoever measures ------------------------------------------------------------------------------


def measure(task: Task, seed: int, budget_s: float, line: Line, *, salvage: bool = False) -> Run:
    """Plan once, in a process of its own; `salvage` as in `apart`.

    Raises
    ------
    Stopped : Ctrl-C came.
    """
    prefix = f"{task.name}, seed {seed}: "
    line.show(f"{prefix}starting")
    return apart(plan_once, task, seed, budget_s, tell=lambda text: line.show(prefix + text), salvage=salvage)


def apart(
    function: Callable[..., Any],
    *arguments: Any,
    tell: Tell,
    salvage: bool = False,
    patience: Mapping[str, float] | None = None,
    environment: Mapping[str, str] | None = None,
) -> Any:
    """`function(*arguments, tell)` in a fresh process; what it tells arrives here.

    Parameters
    ----------
    patience : what the function tells when it begins something -> seconds after which it has to have begun the next of
        these, or be finished ("" is the start of the process); then the process is killed.  None: wait for ever.
    environment : variables that the process has besides those of this one.

    Raises
    ------
    Stopped : Ctrl-C came; with `salvage`, what the function returned when it was interrupted is attached.
    TimeoutError : patience came to an end.
    RuntimeError : the function failed (its traceback is the message), or its process was killed.
    """
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, function, arguments), daemon=True)
    try:
        with uninterrupted(), _variables(environment or {}):
            process.start()
        theirs.close()
        try:
            return _receive(ours, tell, patience)
        except KeyboardInterrupt:
            if not salvage:
                raise Stopped(None) from None
            process.terminate()
            raise Stopped(_receive(ours, tell, None)) from None
        except EOFError:
            process.join(_END_S)
            raise RuntimeError(f"the process of a run ended before its time: {_ending(process.exitcode)}") from None
    finally:
        ours.close()
        if process.pid is not None:
            process.kill()
            process.join()


_starting = threading.Lock()


@contextmanager
def _variables(environment: Mapping[str, str]) -> Iterator[None]:
    """Environment variables for the process that is started in the block, and for no other thread's."""
    with _starting:
        before = {name: os.environ.get(name) for name in environment}
        os.environ.update(environment)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _ending(code: int | None) -> str:
    """What an exit code says, in words."""
    if code is not None and code < 0:
        return f"killed by {signal.Signals(-code).name}"
    return f"exit code {code}"


def _receive(connection: Connection, tell: Tell, patience: Mapping[str, float] | None) -> Any:
    doing = ""
    due = time.monotonic() + patience[doing] if patience else None
    while True:
        if due is not None and not connection.poll(max(due - time.monotonic(), 0.0)):
            assert patience is not None
            raise TimeoutError(f"killed: {doing or 'starting'} took more than {patience[doing]:g} s")
        kind, content = connection.recv()
        if kind == "told":
            if patience and content in patience:
                doing, due = content, time.monotonic() + patience[content]
            tell(content)
        elif kind == "failed":
            raise RuntimeError(content)
        else:
            return content


def _serve(connection: Connection, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    # Ctrl-C in a terminal reaches every process of its group; only the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)

    def tell(text: str) -> None:
        try:
            connection.send(("told", text))
        except BrokenPipeError:
            # Nobody waits for this run any more; it would only disturb the next one.
            os._exit(1)

    try:
        message = ("done", function(*arguments, tell))
    except KeyboardInterrupt:
        message = ("done", None)
    except BaseException:
        message = ("failed", traceback.format_exc())
    connection.send(message)
