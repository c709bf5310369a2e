"""The best plan so far: nothing becomes it that the independent judge has not accepted."""

from __future__ import annotations

import platform
import time
from importlib.metadata import version

from mrtamp.check import Checker, Report
from mrtamp.collision import Counts
from mrtamp.modes import start_mode
from mrtamp.plan import Plan, Segment, Transition, plan_cost
from mrtamp.problem import MrtampError, Problem


class Incumbent:
    """Assembles plans, has them judged, and keeps the cheapest with the history of its cost."""

    def __init__(self, problem: Problem, seed: int, counts: Counts) -> None:
        self.problem = problem
        self.seed = seed
        self.counts = counts
        self.best: Plan | None = None
        self.refused = 0
        self.last_refusal = ""
        self.judging_s = 0.0
        """Seconds that the judge took for the last plan."""
        self._history: list[dict[str, float]] = []
        self._checker = Checker(problem)

    def plan(self, segments: list[Segment], transitions: list[Transition]) -> Plan:
        """A plan with its cost, not judged yet."""
        cost = plan_cost(segments, transitions, self.problem.cost)
        plan = Plan(self.problem, segments, transitions, cost, seed=self.seed, versions=versions())
        plan.history = [{"time_s": 0.0, "cost": cost}]
        return plan

    def accepted(self, segments: list[Segment], transitions: list[Transition]) -> Plan | None:
        """A plan with its cost if the judge accepts it, else None."""
        plan = self.plan(segments, transitions)
        return plan if self.judge(plan).ok else None

    def judge(self, plan: Plan) -> Report:
        """The independent judge's report."""
        began = time.perf_counter()
        report = self._checker.check(plan)
        self.judging_s = time.perf_counter() - began
        if not report.ok:
            self.refused += 1
            self.last_refusal = str(report.violations[0])
        return report

    def offer(self, plan: Plan, time_s: float) -> bool:
        """Keep a plan that passed the judge if it is cheaper than the best so far."""
        if self.best is not None and plan.cost >= self.best.cost:
            return False
        self._history.append({"time_s": time_s, "cost": plan.cost})
        plan.history = list(self._history)
        plan.counts = self.counts.as_dict()
        self.best = plan
        return True

    def check_start(self) -> None:
        """Refuse a problem whose start no plan can have: collisions, limits, objects that float or overlap."""
        fault = start_fault(self._checker)
        if fault is not None:
            raise MrtampError(fault)


def start_fault(checker: Checker) -> str | None:
    """Why no plan of the checker's problem can have its start: a collision, a limit, an object that floats."""
    problem = checker.problem
    standing = Segment(start_mode(problem), {r.name: r.start[None] for r in problem.robots})
    report = checker.check(Plan(problem, [standing], [], 0.0))
    wrong = [v for v in report.violations if v.kind != "goal"]
    if not wrong:
        return None
    more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
    return f"problem {problem.name}: the start is not valid: {wrong[0].message}{more}"


def versions() -> dict[str, str]:
    """Versions that a plan depends on."""
    return {
        "mrtamp": version("mrtamp"),
        "drake": version("drake"),
        "numpy": version("numpy"),
        "python": platform.python_version(),
    }
