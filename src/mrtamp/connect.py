"""RRT-Connect for one robot: where a roadmap knows no way, two trees look for one and put it onto the roadmap.

Roadmaps are sparse, and a load or a narrow passage can cut them apart in a mode; the trees search that very mode,
other robots aside (Kuffner and LaValle, 2000).  What they find are vertices like all others.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping

import numpy as np

from mrtamp.collision import bisection_order
from mrtamp.deadline import Deadline
from mrtamp.modes import Attachment, Mode
from mrtamp.roadmap import Roadmap
from mrtamp.transitions.projection import uniform_configurations
from mrtamp.validity import Validity

_REACH = 0.8
"""Longest extension of a tree, as a share of the mean joint range."""
_SHORTCUTS = 40


class _Tree:
    def __init__(self, root: np.ndarray) -> None:
        self.q = root[None].copy()
        self.parent = [-1]

    def nearest(self, q: np.ndarray) -> int:
        return int(np.argmin(np.linalg.norm(self.q - q, axis=1)))

    def add(self, q: np.ndarray, parent: int) -> int:
        self.q = np.vstack([self.q, q])
        self.parent.append(parent)
        return len(self.parent) - 1

    def path(self, i: int) -> list[np.ndarray]:
        out = []
        while i >= 0:
            out.append(self.q[i])
            i = self.parent[i]
        return out


class Connector:
    """Finds motions of one robot in one mode and adds their knots to its roadmap."""

    def __init__(self, validity: Validity, rng: np.random.Generator, deadline: Deadline | None = None) -> None:
        self.validity = validity
        self.rng = rng
        self.deadline = deadline or Deadline()

    def connect(
        self,
        roadmap: Roadmap,
        mode: Mode,
        a: int,
        b: int,
        iterations: int,
        standing: Mapping[str, np.ndarray] | None = None,
    ) -> bool:
        """Join two vertices by a path that is free of the robot's own world in `mode`; whether one was found.

        Contact vertices are joined from the far ends of their chains.  `standing` are configurations of other robots
        that the path has to keep clear of as well.

        Raises
        ------
        TimeIsUp : the deadline has passed; the roadmap is as it was.
        """
        starts, goals = (list(roadmap.exits.get(v, []))[-1:] or [v] for v in (a, b))
        world = roadmap.world
        held = mode.held.get(roadmap.name)
        objects = {r.name: r.X_WO for r in self.validity.resting(mode)}

        def free(p: np.ndarray, q: np.ndarray) -> bool:
            n = roadmap.samples_between(p, q)
            t = np.linspace(0, 1, n)[bisection_order(n)][:, None]
            x = p + t * (q - p)
            if world.first_hit(world.rows(x, held, objects)) >= 0:
                return False
            return all(self._apart(roadmap.name, x, held, o, y, mode.held.get(o)) for o, y in (standing or {}).items())

        reach = _REACH * float(np.mean(np.minimum(world.chain.upper - world.chain.lower, 2.0)))
        if not all(free(roadmap.q[v], roadmap.q[v]) for v in (starts[0], goals[0])):
            return False
        one, two = _Tree(roadmap.q[starts[0]]), _Tree(roadmap.q[goals[0]])
        for k in range(iterations):
            self.deadline.check()
            here, there = (one, two) if k % 2 == 0 else (two, one)
            target = uniform_configurations(world.tool, self.rng, 1)[0] if k > 1 else there.q[0]
            i = here.nearest(target)
            d = target - here.q[i]
            length = float(np.linalg.norm(d))
            q = here.q[i] + d * min(1.0, reach / max(length, 1e-12))
            if not free(here.q[i], q):
                # Half the way may be open where the whole is not.
                q = here.q[i] + (q - here.q[i]) / 2
                if not free(here.q[i], q):
                    continue
            i = here.add(q, i)
            j = there.nearest(q)
            while True:
                d = q - there.q[j]
                length = float(np.linalg.norm(d))
                step = there.q[j] + d * min(1.0, reach / max(length, 1e-12))
                if not free(there.q[j], step):
                    break
                j = there.add(step, j)
                if length <= reach:
                    knots = [*one.path(i if here is one else j)[::-1], *two.path(j if here is one else i)[1:]]
                    self._put(roadmap, starts[0], goals[0], self._shortened(knots, free))
                    return True
        return False

    def _apart(
        self, robot: str, q: np.ndarray, held: Attachment | None, other: str, y: np.ndarray, load: Attachment | None
    ) -> bool:
        return self.validity.collision.first_hit(robot, q, held, other, np.tile(y, (len(q), 1)), load) < 0

    def _shortened(self, knots: list[np.ndarray], free: Callable[[np.ndarray, np.ndarray], bool]) -> list[np.ndarray]:
        for _ in range(_SHORTCUTS):
            if len(knots) < 3:
                break
            i, j = sorted(self.rng.choice(len(knots), size=2, replace=False).tolist())
            if j - i > 1 and free(knots[i], knots[j]):
                knots = knots[: i + 1] + knots[j:]
        return knots

    @staticmethod
    def _put(roadmap: Roadmap, start: int, goal: int, knots: list[np.ndarray]) -> None:
        vertices = [start, *(roadmap.add_vertex(q) for q in knots[1:-1]), goal]
        for u, v in itertools.pairwise(vertices):
            if u != v:
                roadmap.edge(u, v)
