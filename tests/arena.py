"""Discs in the plane, and what plans their motion in space and time, put together without a planner.

A disc has radius 0.2; its joints (x, y) are the world position of its axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from discs import disc_model
from pydrake.math import RigidTransform

from mrtamp.check import Checker, Report
from mrtamp.collision import Collision, Counts
from mrtamp.insertion import Insertion
from mrtamp.modes import start_mode
from mrtamp.plan import Plan, Segment, Transition, plan_cost
from mrtamp.problem import (
    AtConfiguration,
    MovableObject,
    Problem,
    Robot,
    RobotAt,
    Shape,
    StaticBody,
    Subgoal,
)
from mrtamp.roadmap import Roadmap
from mrtamp.steering import Steering
from mrtamp.tensor_tree import TensorTree
from mrtamp.validity import Validity

XY = tuple[float, float]


def wall(name: str, low: XY, high: XY) -> StaticBody:
    """A box over the rectangle from `low` to `high`, higher than the discs."""
    (x0, y0), (x1, y1) = low, high
    X_WB = RigidTransform([(x0 + x1) / 2, (y0 + y1) / 2, 0.15])
    return StaticBody(name, X_WB, Shape("box", (x1 - x0, y1 - y0, 0.3)))


def visit(name: str, robot: str, at: XY, *after: str, **more) -> Subgoal:
    """A subgoal: one disc at one place."""
    return Subgoal(name, {robot: AtConfiguration(np.array(at, dtype=float))}, after, **more)


def arena(
    folder: Path,
    starts: Mapping[str, XY],
    ends: Mapping[str, XY] | None = None,
    *,
    subgoals: Sequence[Subgoal] = (),
    walls: Sequence[StaticBody] = (),
    objects: Sequence[MovableObject] = (),
) -> Problem:
    """Discs that start, and perhaps have to end, somewhere, among walls."""
    model = disc_model(folder)
    places = {name: np.array(q, dtype=float) for name, q in starts.items()}
    return Problem(
        name="arena",
        robots=tuple(Robot(name, model, RigidTransform(), q, q) for name, q in places.items()),
        statics=tuple(walls),
        supports=(),
        objects=tuple(objects),
        goal=tuple(RobotAt(name, np.array(q, dtype=float)) for name, q in (ends or {}).items()),
        subgoals=tuple(subgoals),
    )


class Parts:
    """What motion in space and time needs of a planner: collision queries, validity and roadmaps, the start first."""

    def __init__(self, problem: Problem, seed: int = 0) -> None:
        self.problem = problem
        self.rng = np.random.default_rng(seed)
        self.collision = Collision(problem, Counts())
        self.roadmaps = {r.name: Roadmap(self.collision.worlds[r.name], 0.2) for r in problem.robots}
        self.validity = Validity(problem, self.collision, self.roadmaps)
        self.root = start_mode(problem)
        self.start = {r.name: self.vertex(r.name, tuple(r.start)) for r in problem.robots}
        self._checker = Checker(problem)

    def vertex(self, robot: str, q: XY) -> int:
        """A vertex of a robot's roadmap."""
        return self.roadmaps[robot].add_vertex(np.array(q, dtype=float))

    def scatter(self, n: int) -> None:
        """Free vertices at random on every roadmap."""
        for roadmap in self.roadmaps.values():
            world = roadmap.world
            q = self.rng.uniform(world.chain.lower, world.chain.upper, size=(n, 2))
            for x in q[~world.hits(world.rows(q, None, {}))]:
                roadmap.add_vertex(x)

    def insertion(self) -> Insertion:
        """Realises skeletons on the roadmaps."""
        graphs = list(self.roadmaps.values())
        tree = TensorTree(graphs, self.problem.cost)
        steering = Steering(graphs, self.validity, lambda node, at: tree.insert(node, at)[0], self.rng)
        return Insertion(self.roadmaps, self.collision, self.validity, steering, self.rng)

    def judged(self, segments: Sequence[Segment], transitions: Sequence[Transition]) -> tuple[Plan, Report]:
        """The plan, and what the independent judge says of it."""
        cost = plan_cost(list(segments), list(transitions), self.problem.cost)
        plan = Plan(self.problem, list(segments), list(transitions), cost)
        return plan, self._checker.check(plan)
