"""Prioritised planning: robots one after another, each around the synchronous schedule of those before it.

A schedule is a sequence of synchronous steps.  The next robot searches over (step of the schedule, own vertex): it may
move or wait while the schedule takes a step, or move while the schedule is held.  Costs are exactly what the joint
schedule then costs more, so riding along with a longer step of another robot is all but free.  Edges are validated
lazily; who cannot be fitted in is given a higher priority and planning starts again.
"""

from __future__ import annotations

import heapq
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mrtamp.deadline import Deadline
from mrtamp.intra_orbit.lazy_validate import at_once, pair_is_apart
from mrtamp.modes import Mode
from mrtamp.problem import CostWeights
from mrtamp.roadmap import Roadmap
from mrtamp.steering import Insert, Steering
from mrtamp.tensor_tree import At, Node
from mrtamp.validity import Validity

_VERTICES = 80
"""Vertices per robot that a search may use: those of the smallest detour."""
_ROUNDS = 60
_ORDERS = 6
"""Orders of priority tried before giving up."""
_EXPANSIONS = 4000


@dataclass
class _Task:
    """One robot to fit into a schedule: where it starts and ends (None: anywhere), and what is known to be blocked."""

    robot: int
    start: int
    goal: int | None
    to_go: np.ndarray
    """(V,) length of the way to the goal, alone."""
    allowed: np.ndarray
    """(V,) vertices of the search."""
    near: dict[int, list[tuple[int, float]]] = field(default_factory=dict)
    """Neighbours on edges not known to be invalid for the robot alone, with their distance; the vertex itself first."""
    clashes: set[tuple[int, int, int, bool]] = field(default_factory=set)
    """(layer, from, to, whether the schedule moves too) that collide with the robots of the schedule."""


class Prioritised:
    """Plans robots in an order of priority and inserts the joint schedule into the tree.

    `depth` of `drive` says only whether robots without a target may move at all.
    """

    def __init__(
        self,
        roadmaps: Sequence[Roadmap],
        validity: Validity,
        insert: Insert,
        rng: np.random.Generator,
        weights: CostWeights,
        deadline: Deadline | None = None,
    ) -> None:
        self.roadmaps = list(roadmaps)
        self.validity = validity
        self.insert = insert
        self.random = Steering(roadmaps, validity, insert, rng, deadline)
        self.trouble: Counter[tuple[str, str]] = self.random.trouble
        self.index = self.random.index
        self.weights = weights

    def explore(self, node: Node) -> Node | None:
        """A random tensor neighbour, if the step to it is valid."""
        return self.random.random_step(node)

    def drive(self, node: Node, targets: Mapping[str, int], depth: int = 1) -> Node | None:
        """Extend the tree until every robot in `targets` stands at its vertex; None if no order of priority works."""
        goal = {self.index[r]: v for r, v in targets.items()}
        if all(node.at[i] == v for i, v in goal.items()):
            return node
        if not at_once(self.roadmaps, self.validity, node.mode, goal):
            return None
        tasks = []
        for i in range(len(node.at)):
            task = self._task(node, i, goal.get(i))
            if task is None:
                return None
            if depth <= 0 and i not in goal:
                task.near[node.at[i]] = [(node.at[i], 0.0)]
            tasks.append(task)
        tried: set[tuple[int, ...]] = set()
        # Those with a target first, the longest way before all.
        order = sorted(range(len(tasks)), key=lambda i: (i not in goal, -float(tasks[i].to_go[node.at[i]]), i))
        for _ in range(_ORDERS):
            tried.add(tuple(order))
            schedule, failed = self._plan(node.mode, [tasks[i] for i in order])
            if schedule is not None:
                for row in schedule[1:]:
                    at = dict(zip(order, row, strict=True))
                    node = self.insert(node, tuple(at[i] for i in range(len(at))))
                return node
            assert failed is not None
            order = [failed, *(i for i in order if i != failed)]
            if tuple(order) in tried:
                return None
        return None

    def _task(self, node: Node, i: int, goal: int | None) -> _Task | None:
        roadmap = self.roadmaps[i]
        start = node.at[i]
        if goal is not None:
            roadmap.offer_direct(start, goal)
        blocked = self.validity.blocked(roadmap.name, node.mode, {})
        detour = roadmap.distances_to(start, blocked)
        to_go = np.zeros(roadmap.n_vertices)
        if goal is not None:
            to_go = roadmap.distances_to(goal, blocked)
            detour = detour + to_go
            if not np.isfinite(to_go[start]):
                return None
        allowed = np.zeros(roadmap.n_vertices, dtype=bool)
        nearest = np.argsort(detour, kind="stable")[:_VERTICES]
        allowed[nearest[np.isfinite(detour[nearest])]] = True
        return _Task(i, start, goal, to_go, allowed)

    def _plan(self, mode: Mode, tasks: Sequence[_Task]) -> tuple[list[At] | None, int | None]:
        """The joint schedule of all robots in the order of `tasks`, or the robot that could not be fitted in."""
        schedule: list[At] = [()]
        robots: list[int] = []
        for task in tasks:
            task.clashes.clear()
            found = self._fit_in(mode, schedule, robots, task)
            if found is None:
                return None, task.robot
            schedule = [(*schedule[k], v) for k, v in found]
            robots.append(task.robot)
        return [row for k, row in enumerate(schedule) if k == 0 or row != schedule[k - 1]], None

    def _fit_in(
        self, mode: Mode, schedule: list[At], robots: Sequence[int], task: _Task
    ) -> list[tuple[int, int]] | None:
        """One robot's cheapest valid motion beside a schedule, as (row of the schedule, own vertex)."""
        longest = [
            max((self.roadmaps[i].length(u, v) for i, u, v in zip(robots, a, b, strict=True)), default=0.0)
            for a, b in itertools.pairwise(schedule)
        ]
        for _ in range(_ROUNDS):
            self.random.deadline.check()
            way = self._search(longest, task)
            if way is None:
                return None
            if all(self._valid(mode, schedule, robots, task, one, two) for one, two in itertools.pairwise(way)):
                return way
        return None

    def _search(self, longest: Sequence[float], task: _Task) -> list[tuple[int, int]] | None:
        """A* over (row, vertex); the bound is the rest of the way, part of it hidden by the schedule's other steps."""
        last = len(longest)
        rest = np.append(np.cumsum(longest[::-1])[::-1], 0.0)
        ms, pl = self.weights.makespan, self.weights.path_length

        def bound(k: int, v: int) -> float:
            return pl * task.to_go[v] + ms * max(0.0, task.to_go[v] - rest[k])

        first = (0, task.start)
        cost: dict[tuple[int, int], float] = {first: 0.0}
        came: dict[tuple[int, int], tuple[int, int]] = {}
        closed: set[tuple[int, int]] = set()
        heap = [(bound(*first), 0, first)]
        ticket = itertools.count(1)
        while heap and len(closed) < _EXPANSIONS:
            _, _, state = heapq.heappop(heap)
            if state in closed:
                continue
            closed.add(state)
            k, u = state
            if k == last and (task.goal is None or u == task.goal):
                way = [state]
                while way[-1] in came:
                    way.append(came[way[-1]])
                return way[::-1]
            for v, length in self._near(task, u):
                for row in (k, k + 1):
                    new = (row, v)
                    if row > last or new in closed or (k, u, v, row > k) in task.clashes:
                        continue
                    hidden = longest[k] if row > k else 0.0
                    total = cost[state] + ms * max(0.0, length - hidden) + pl * length
                    if total < cost.get(new, np.inf):
                        cost[new], came[new] = total, state
                        heapq.heappush(heap, (total + bound(row, v), next(ticket), new))
        return None

    def _near(self, task: _Task, u: int) -> list[tuple[int, float]]:
        found = task.near.get(u)
        if found is None:
            roadmap = self.roadmaps[task.robot]
            ends = [v for v in roadmap.neighbours(u) if task.allowed[v]]
            found = task.near[u] = [(u, 0.0), *((v, roadmap.length(u, v)) for v in ends)]
        return found

    def _valid(
        self,
        mode: Mode,
        schedule: Sequence[At],
        robots: Sequence[int],
        task: _Task,
        one: tuple[int, int],
        two: tuple[int, int],
    ) -> bool:
        """Validate one move of the robot beside the schedule's; what fails is noted for the next search."""
        (k, u), (row, v) = one, two
        roadmap = self.roadmaps[task.robot]
        if u != v and not self.validity.edge(roadmap.name, roadmap.edge(u, v), mode):
            self.trouble[roadmap.name, "world"] += 1
            for a, b in ((u, v), (v, u)):
                task.near[a] = [x for x in self._near(task, a) if x[0] != b]
            return False
        for i, a, b in zip(robots, schedule[k], schedule[row], strict=True):
            if u == v and a == b:
                continue
            pair = ([self.roadmaps[i], roadmap], self.validity, mode, (a, u), (b, v), 0, 1)
            if not pair_is_apart(*pair):
                self.trouble[roadmap.name, self.roadmaps[i].name] += 1
                task.clashes.add((k, u, v, row > k))
                return False
        return True
