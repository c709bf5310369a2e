"""Tensor-tree search: best-first in the tensor product, all robots with a target moving at once (dRRT*'s oracle).

Shome, Solovey, Dobson, Halperin and Bekris (2020): the informed oracle sends every robot along the next edge of its
shortest roadmap path.  Here each robot with a target advances or waits, which also aligns edges of different lengths,
and the cheapest estimate (cost so far and the robots' own costs-to-go) is tried next.  A step is validated when its
turn comes; where one fails, the robots that met are offered sidesteps.  What this does not solve within its bounds is
left to moving robots one at a time, which is also compared with wherever sidesteps were taken.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mrtamp.deadline import Deadline
from mrtamp.intra_orbit.lazy_validate import at_once, pair_is_apart
from mrtamp.modes import Mode
from mrtamp.problem import CostWeights
from mrtamp.roadmap import Roadmap
from mrtamp.steering import ROUNDS, Insert, Steering
from mrtamp.tensor_tree import At, Node
from mrtamp.validity import Validity

_EPS = 1e-6
_STEPS = 120
"""Steps validated per search, and per robot with a target."""
_SIDESTEPS = 3
"""Neighbours that a robot is offered when it is in the way."""
_GREED = 0.25
"""Extra weight of the cost-to-go for every robot beyond two: hidden by the longest robot, it underestimates more."""


@dataclass
class _Search:
    """One search: costs-to-go of the robots with a target, and the steps that wait for validation."""

    goal: Mapping[int, int]
    to_go: dict[int, np.ndarray]
    mobile: frozenset[int]
    """Robots that may move."""
    heap: list[tuple[float, int, At, Node]] = field(default_factory=list)
    offered: set[tuple[At, int]] = field(default_factory=set)
    ticket: Iterator[int] = field(default_factory=itertools.count)


class TensorSearch:
    """The informed oracle over all robots at once, with one robot at a time to fall back on."""

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
        self.rng = rng
        self.weights = weights
        self.one_by_one = Steering(roadmaps, validity, insert, rng, deadline)
        self.index = self.one_by_one.index
        self.trouble = self.one_by_one.trouble

    def drive(self, node: Node, targets: Mapping[str, int], depth: int = 1) -> Node | None:
        """Extend the tree until every robot in `targets` stands at its vertex; None if that fails."""
        goal = {self.index[r]: v for r, v in targets.items()}
        if not at_once(self.roadmaps, self.validity, node.mode, goal):
            return None
        if sum(node.at[i] != v for i, v in goal.items()) > 1:
            search = _Search(goal, {}, frozenset(range(len(node.at)) if depth > 0 else goal))
            if not all(self._prepare(search, node, i, v) for i, v in goal.items()):
                return None
            together = self._together(search, node)
            if together is not None and not search.offered:
                return together
            # Sidesteps are random, and may have led a long way round.
            apart = self.one_by_one.drive(node, targets, depth)
            return min((x for x in (together, apart) if x is not None), key=lambda x: x.cost, default=None)
        return self.one_by_one.drive(node, targets, depth)

    def explore(self, node: Node) -> Node | None:
        """A random tensor neighbour, if the step to it is valid."""
        return self.one_by_one.random_step(node)

    def _together(self, search: _Search, node: Node) -> Node | None:
        """Best-first search for a node at which all targets are met; what it validates on the way stays in the tree."""
        reached = {node.at}
        self._expand(search, node)
        for _ in range(_STEPS * len(search.goal)):
            self.one_by_one.deadline.check()
            if not search.heap:
                return None
            _, _, at, parent = heapq.heappop(search.heap)
            if at in reached:
                continue
            met = self._met(parent, at)
            if met:
                self._offer_sidesteps(search, parent, at, met)
                continue
            reached.add(at)
            x = self.insert(parent, at)
            if all(at[i] == v for i, v in search.goal.items()):
                return x
            self._expand(search, x)
        return None

    def _prepare(self, search: _Search, node: Node, i: int, goal: int) -> bool:
        """Cost-to-go of one robot, other robots aside, validated along its shortest path; False if there is none."""
        name = self.roadmaps[i].name
        everyone = {g.name for g in self.roadmaps}
        path, _ = self.one_by_one.path(node.mode, node.at, name, goal, ignore=everyone - {name})
        if path is None:
            return False
        search.to_go[i] = self._to_go(node.mode, i, goal)
        return True

    def _to_go(self, mode: Mode, i: int, goal: int) -> np.ndarray:
        return self.roadmaps[i].distances_to(goal, self.validity.blocked(self.roadmaps[i].name, mode, {}))

    def _push(self, search: _Search, node: Node, at: At) -> None:
        to_go = [float(search.to_go[i][at[i]]) for i in search.goal]
        step = [g.length(u, v) if u != v else 0.0 for g, u, v in zip(self.roadmaps, node.at, at, strict=True)]
        rest = self.weights.makespan * max(to_go) + self.weights.path_length * sum(to_go)
        cost = node.cost + self.weights.makespan * max(step) + self.weights.path_length * sum(step)
        greed = 1.0 + _GREED * max(0, len(to_go) - 2)
        if np.isfinite(rest):
            heapq.heappush(search.heap, (cost + greed * rest, -next(search.ticket), at, node))

    def _expand(self, search: _Search, node: Node) -> None:
        """Every robot with a target advances or waits."""
        options = [[v] for v in node.at]
        for i in search.goal:
            ahead = self._advance(search, node, i)
            if ahead is not None:
                options[i].append(ahead)
        for at in itertools.product(*options):
            if at != node.at:
                self._push(search, node, at)

    def _advance(self, search: _Search, node: Node, i: int) -> int | None:
        """The next vertex on the robot's own shortest path."""
        g, here, goal = self.roadmaps[i], node.at[i], search.goal[i]
        if here == goal:
            return None
        for _ in range(ROUNDS):
            near = list(g.neighbours(here))
            way = [search.to_go[i][v] + g.length(here, v) for v in near]
            # The cost-to-go may rest on edges that have been found out since, one of these perhaps.
            k = next((int(k) for k in np.argsort(way) if self._free(node.mode, g, here, near[k])), None)
            if k is None or not np.isfinite(way[k]):
                return None
            if way[k] <= search.to_go[i][here] + _EPS:
                return near[k]
            search.to_go[i] = self._to_go(node.mode, i, goal)
            if not np.isfinite(search.to_go[i][here]):
                return None
        return None

    def _free(self, mode: Mode, roadmap: Roadmap, a: int, b: int) -> bool:
        free = self.validity.edge(roadmap.name, roadmap.edge(a, b), mode)
        if not free:
            self.trouble[roadmap.name, "world"] += 1
        return free

    def _met(self, parent: Node, at: At) -> tuple[int, ...]:
        """The robots that make a step invalid: two that meet, or one that meets the world; empty if it is valid."""
        moving = [i for i in range(len(at)) if at[i] != parent.at[i]]
        for i in moving:
            if not self._free(parent.mode, self.roadmaps[i], parent.at[i], at[i]):
                return (i,)
        for i in moving:
            for j in range(len(at)):
                if j == i or (j in moving and j < i):
                    continue
                if not pair_is_apart(self.roadmaps, self.validity, parent.mode, parent.at, at, i, j):
                    self.trouble[self.roadmaps[i].name, self.roadmaps[j].name] += 1
                    return (i, j)
        return ()

    def _offer_sidesteps(self, search: _Search, parent: Node, at: At, met: Sequence[int]) -> None:
        """Let each of two robots that met step aside, the other robots moving as they would or waiting."""
        if len(met) < 2:
            return
        for i in met:
            if i not in search.mobile or (at, i) in search.offered:
                continue
            search.offered.add((at, i))
            near = self.roadmaps[i].neighbours(parent.at[i])
            for k in self.rng.integers(len(near), size=min(_SIDESTEPS, len(near))):
                for base in (at, parent.at):
                    aside = (*base[:i], near[int(k)], *base[i + 1 :])
                    if aside != parent.at:
                        self._push(search, parent, aside)
