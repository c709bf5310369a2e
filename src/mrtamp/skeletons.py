"""Skeletons that know costs: who does which task, with which transitions, in which order (DESIGN section 9).

Robots ignore each other here, so the cost of a skeleton is what its decoupled schedule costs.  Where one robot does
each task alone the cheapest ones come from dynamic programming: Held-Karp per robot over subsets of tasks, with all
their candidates, then all partitions of the tasks among the robots.  Relays, handovers, meetings and long task lists go
through a beam search over stages and a local search on whole orderings.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mrtamp.options import Distance, Event, Option, Precedence, Skeleton, Task
from mrtamp.schedule import FAR, Ordering, Schedules
from mrtamp.stage_search import beam, neighbours
from mrtamp.tours import Ranked, Tours

if TYPE_CHECKING:
    from mrtamp.problem import CostWeights

__all__ = ["Bound", "Event", "Option", "Skeleton", "Task", "lower_bound", "skeletons"]

_EXACT_TASKS = 8
"""Up to so many tasks dynamic programming over subsets is used."""
_PARTITIONS = 100_000
_EPS = 1e-9
_ALIKE = 0.25
"""Largest difference of a joint (rad or m) between candidates from which refinement comes to the same, most likely."""


@dataclass(frozen=True)
class Bound:
    """A lower bound of the cost; `exact` when it is the minimum over all assignments, orders and candidates.

    The minimum is that of the cost without waiting; penalties, being learnt, do not count.
    """

    value: float
    exact: bool


def skeletons(
    tasks: Sequence[Task],
    precedence: Precedence,
    starts: Mapping[str, np.ndarray],
    ends: Mapping[str, np.ndarray | None],
    weights: CostWeights,
    *,
    limit: int,
    rng: np.random.Generator,
    distance: Distance | None = None,
    per_assignment: int | None = None,
    effort: int = 300,
) -> list[Skeleton]:
    """The cheapest skeletons, cheapest first, distinct in who does what in which order.

    Parameters
    ----------
    tasks : what has to be done; a task without options makes the list empty.
    precedence : what happens not after what.
    starts, ends : configuration (n,) where each robot stands and where it has to finish (None: anywhere).
    weights : of makespan and path length.
    limit : how many to return at most.  Only when there are fewer orders than that, further choices of candidates for
        the same order fill up.
    distance : how far robots travel between configurations; default: straight in joint space.
    per_assignment : how many orders of one assignment of tasks to robots to return at most; default: any number.
    effort : how many orderings are evaluated beyond those that are certainly among the cheapest.
    """
    plan = Schedules(tasks, precedence, starts, ends, weights, distance)
    if any(not t.options for t in tasks):
        return []
    pool = _Pool(plan, limit, per_assignment)
    if _single(plan):
        proved = pool.draw(Tours(plan).ranked(), effort)
    else:
        proved = False
        for ordering, choice in beam(plan, max(8, limit)):
            pool.offer(ordering, choice)
    if not proved:
        pool.search(effort, rng)
    return pool.harvest(rng)


def lower_bound(
    tasks: Sequence[Task],
    precedence: Precedence,
    starts: Mapping[str, np.ndarray],
    ends: Mapping[str, np.ndarray | None],
    weights: CostWeights,
    *,
    distance: Distance | None = None,
) -> Bound:
    """A bound no skeleton of these tasks and candidates can beat: see `Bound`.

    Exact when one robot does each task alone, in one go, and tasks are few; a robot's own precedences are respected,
    waiting for others is not counted.
    """
    bare = [Task(t.name, tuple(Option(o.robots, o.events, o.constant) for o in t.options)) for t in tasks]
    if any(not t.options for t in tasks):
        return Bound(np.inf, True)
    plan = Schedules(bare, precedence, starts, ends, weights, distance)
    constants = sum(min(o.constant for o in t.options) for t in tasks)
    if _single(plan):
        same = all(o.constant == t.options[0].constant for t in tasks for o in t.options)
        best = Tours(plan, constants=False).partitions()[0]
        return Bound(float(best[0]) + constants if best[0] < FAR else np.inf, same)
    work = np.zeros(len(tasks))
    span = np.zeros(len(tasks))
    for t, task in enumerate(tasks):
        inner = [plan.inner(t, o) for o in range(len(task.options))]
        work[t] = min(float(np.min(np.sum(list(x.values()), axis=0))) for x in inner)
        span[t] = min(min(float(np.min(v)) for v in x.values()) for x in inner) if task.options else 0.0
    makespan = max(work.sum() / len(plan.robots), span.max(initial=0.0))
    return Bound(float(weights.makespan * makespan + weights.path_length * work.sum() + constants), False)


def _single(plan: Schedules) -> bool:
    """Whether one robot does each task alone and in one go, and there are few enough for dynamic programming."""
    few = len(plan.tasks) <= _EXACT_TASKS and len(plan.robots) ** len(plan.tasks) <= _PARTITIONS
    return few and all(len(o.robots) == 1 and len(o.stages) == 1 for t in plan.tasks for o in t.options)


# -- choice ----------------------------------------------------------------------------------------------------


class _Pool:
    """The cheapest candidates for every ordering met."""

    def __init__(self, plan: Schedules, limit: int, per_assignment: int | None) -> None:
        self.plan = plan
        self.limit = limit
        self.per_assignment = per_assignment
        self.found: dict[tuple, tuple[float, Ordering, list[int]]] = {}

    def offer(self, ordering: Ordering, choice: list[int], polish: bool = True) -> float:
        """Add an ordering; returns its cost, infinite when it cannot happen."""
        steps = self.plan.steps(ordering)
        if steps is None:
            return np.inf
        outcome = self.plan.run(ordering.options, steps, choice)
        if polish and outcome.cost > outcome.bound - _EPS:
            choice = self.plan.polish(ordering, steps, choice)
            outcome = self.plan.run(ordering.options, steps, choice)
        cost = float(outcome.cost)
        key = self.plan.order_of(ordering)
        if cost < FAR and (key not in self.found or cost < self.found[key][0]):
            self.found[key] = (cost, ordering, choice)
        return cost

    def draw(self, ranked: Iterator[Ranked], effort: int) -> bool:
        """Offer orderings by ascending bound until the cheapest `limit` are certain, or the effort is spent."""
        shares: dict[tuple, int] = {}
        best: list[float] = []
        wasted = 0
        for bound, ordering, choice, assignment in ranked:
            if len(best) == self.limit and bound >= best[-1] - _EPS:
                return True
            if self.per_assignment is not None and shares.get(assignment, 0) >= self.per_assignment:
                wasted += 1
            else:
                cost = self.offer(ordering, choice)
                if cost < np.inf:
                    shares[assignment] = shares.get(assignment, 0) + 1
                wasted += cost > bound + 1e-6
                best = sorted([*best, cost])[: self.limit] if cost < FAR else best
            if wasted > effort:
                return False
        return True

    def search(self, effort: int, rng: np.random.Generator) -> None:
        """Offer neighbours of the best orderings found: one task done another way or at another time."""
        for _ in range(effort):
            if not self.found:
                return
            ranked = sorted(self.found.values(), key=lambda x: x[0])[: max(4, self.limit)]
            # Half of the effort goes to the very best, half to the others that would be returned.
            n = 0 if rng.random() < 0.5 else int(rng.integers(len(ranked)))
            _, ordering, choice = ranked[n]
            neighbour = neighbours(self.plan, ordering, choice, rng)
            if neighbour is not None:
                cost = self.offer(*neighbour, polish=False)
                if ranked[0][0] - _EPS > 0.95 * cost and self.plan.order_of(neighbour[0]) != self.plan.order_of(
                    ordering
                ):
                    self.offer(*neighbour)

    def harvest(self, rng: np.random.Generator) -> list[Skeleton]:
        """The cheapest orderings; other candidates of them only where there are fewer than the limit."""
        plan = self.plan
        ranked = sorted(self.found.values(), key=lambda x: (x[0], x[1].options, x[1].stages))
        out: list[Skeleton] = []
        shares: dict[tuple, int] = {}
        for _, ordering, choice in ranked:
            steps = plan.steps(ordering)
            assert steps is not None
            assignment = tuple(plan.tasks[t].options[o].robots for t, o in enumerate(ordering.options))
            if self.per_assignment is not None and shares.get(assignment, 0) >= self.per_assignment:
                continue
            shares[assignment] = shares.get(assignment, 0) + 1
            out.append(plan.skeleton(ordering, steps, choice))
            if len(out) == self.limit:
                return out
        return sorted(out + self._variants(ranked, self.limit - len(out), rng), key=lambda s: s.cost)

    def _variants(self, ranked: list, missing: int, rng: np.random.Generator) -> list[Skeleton]:
        plan = self.plan
        out: list[Skeleton] = []
        taken = {(o.options, tuple(c)) for _, o, c in ranked}
        for _ in range(2 * missing):
            if not ranked or len(out) == missing:
                break
            _, ordering, choice = ranked[int(rng.integers(len(ranked)))]
            steps = plan.steps(ordering)
            assert steps is not None
            t = int(rng.integers(len(plan.tasks)))
            used = [c[t] for o, c in taken if o == ordering.options]
            barred = _near(plan.tasks[t].options[ordering.options[t]], used)
            if barred.all():
                continue
            other = list(choice)
            other[t] = int(np.argmin(barred))
            other = plan.polish(ordering, steps, other, {t: np.flatnonzero(barred)})
            skeleton = plan.skeleton(ordering, steps, other)
            key = (ordering.options, tuple(other))
            if skeleton.cost < FAR and key not in taken:
                taken.add(key)
                out.append(skeleton)
        return out


def _near(option: Option, used: list[int]) -> np.ndarray:
    """Candidates (M,) that are much like one of those in use, as long as there are others; then just these."""
    itself = np.isin(np.arange(option.candidates), used)
    near = itself.copy()
    q = np.concatenate([x for event in option.events for x in event.stops.values()], axis=1)
    for m in used:
        near |= np.abs(q - q[m]).max(axis=1) < _ALIKE
    return itself if near.all() else near
