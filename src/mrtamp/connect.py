"""RRT-Connect for one robot: where a roadmap knows no way, two trees look for one and put it onto the roadmap.

Roadmaps are sparse, and a load or a narrow passage can cut them apart in a mode; the trees search that very mode,
other robots aside (Kuffner and LaValle, 2000).  What they find are vertices like all others.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from mrtamp.collision import bisection_order
from mrtamp.deadline import Deadline
from mrtamp.informed import ellipsoid_sample
from mrtamp.modes import Attachment, Mode
from mrtamp.roadmap import Roadmap, lazy_path
from mrtamp.transitions.projection import uniform_configurations
from mrtamp.validity import Validity

_REACH = 0.8
"""Longest extension of a tree, as a share of the mean joint range."""
_SHORTCUTS = 40
_COARSE = 0.06
"""Trees grow along motions that are checked at such steps (rad or m) of a joint; what they find is checked finely."""
_USES = 5
"""How often a path that they found is used."""


class _Tree:
    """Motions from a root, checked coarsely until they are part of a path."""

    def __init__(self, root: np.ndarray) -> None:
        self.q = root[None].copy()
        self.parent = [-1]
        self._confirmed = [True]
        self._alive = np.ones(1, dtype=bool)

    def nearest(self, q: np.ndarray) -> int:
        return int(np.argmin(np.where(self._alive, np.linalg.norm(self.q - q, axis=1), np.inf)))

    def add(self, q: np.ndarray, parent: int) -> int:
        self.q = np.vstack([self.q, q])
        self.parent.append(parent)
        self._confirmed.append(False)
        self._alive = np.append(self._alive, True)
        return len(self.parent) - 1

    def confirm(self, i: int, free: Callable[[np.ndarray, np.ndarray], bool]) -> bool:
        """Whether all motions from the root to vertex i are free; what comes after one that is not is cut off."""
        while i > 0:
            if not self._confirmed[i]:
                if not free(self.q[self.parent[i]], self.q[i]):
                    self._cut(i)
                    return False
                self._confirmed[i] = True
            i = self.parent[i]
        return True

    def _cut(self, i: int) -> None:
        self._alive[i] = False
        for k in range(i + 1, len(self.parent)):
            self._alive[k] &= self._alive[self.parent[k]]

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
        longest: float = np.inf,
    ) -> list[int] | None:
        """Join two vertices by a path that is free of the robot's own world in `mode`; its vertices, None without one.

        Contact vertices are joined from the far ends of their chains, which the path includes unseen.  `standing` are
        configurations of other robots that the path has to keep clear of as well.  Knots are such that the way from end
        to end by any one of them is no longer than `longest`.

        Raises
        ------
        TimeIsUp : the deadline has passed; the roadmap is as it was.
        """
        out, back = ([v, *(roadmap.chains(v) or [[]])[-1]] for v in (a, b))
        start, goal = out[-1], back[-1]
        world = roadmap.world
        held = mode.held.get(roadmap.name)
        objects = {r.name: r.X_WO for r in self.validity.resting(mode)}

        def free(p: np.ndarray, q: np.ndarray, coarse: bool = False) -> bool:
            n = int(np.abs(q - p).max() / _COARSE) + 2 if coarse else roadmap.samples_between(p, q)
            t = np.linspace(0, 1, n)[bisection_order(n)][:, None]
            x = p + t * (q - p)
            if world.first_hit(world.rows(x, held, objects)) >= 0:
                return False
            return all(self._apart(roadmap.name, x, held, o, y, mode.held.get(o)) for o, y in (standing or {}).items())

        reach = _REACH * float(np.mean(np.minimum(world.chain.upper - world.chain.lower, 2.0)))
        if not all(free(roadmap.q[v], roadmap.q[v]) for v in (start, goal)):
            return None
        ends = roadmap.q[[start, goal]]

        def by_way_of(q: np.ndarray) -> float:
            return float(np.linalg.norm(q - ends, axis=1).sum()) if longest < np.inf else 0.0

        def sample() -> np.ndarray:
            if longest == np.inf:
                return uniform_configurations(world.tool, self.rng, 1)[0]
            return np.clip(ellipsoid_sample(ends[0], ends[1], longest, self.rng), world.chain.lower, world.chain.upper)

        one, two = _Tree(ends[0]), _Tree(ends[1])
        for k in range(iterations):
            self.deadline.check()
            here, there = (one, two) if k % 2 == 0 else (two, one)
            target = sample() if k > 1 else there.q[0]
            i = here.nearest(target)
            d = target - here.q[i]
            length = float(np.linalg.norm(d))
            q = here.q[i] + d * min(1.0, reach / max(length, 1e-12))
            if not free(here.q[i], q, coarse=True):
                # Half the way may be open where the whole is not.
                q = here.q[i] + (q - here.q[i]) / 2
                if not free(here.q[i], q, coarse=True):
                    continue
            if by_way_of(q) > longest:
                continue
            i = here.add(q, i)
            j = there.nearest(q)
            while True:
                d = q - there.q[j]
                length = float(np.linalg.norm(d))
                step = there.q[j] + d * min(1.0, reach / max(length, 1e-12))
                if by_way_of(step) > longest or not free(there.q[j], step, coarse=True):
                    break
                j = there.add(step, j)
                if length <= reach:
                    if not (here.confirm(i, free) and there.confirm(j, free)):
                        break
                    knots = [*one.path(i if here is one else j)[::-1], *two.path(j if here is one else i)[1:]]
                    between = self._put(roadmap, start, goal, self._shortened(knots, free))
                    path = [*out[:-1], *between, *back[-2::-1]]
                    roadmap.joined[a, b], roadmap.joined[b, a] = (path, _USES), (path[::-1], _USES)
                    return path
        return None

    def _apart(
        self, robot: str, q: np.ndarray, held: Attachment | None, other: str, y: np.ndarray, load: Attachment | None
    ) -> bool:
        return self.validity.collision.first_hit(robot, q, held, other, np.tile(y, (len(q), 1)), load) < 0

    def _shortened(self, knots: list[np.ndarray], free: Callable[[np.ndarray, np.ndarray], bool]) -> list[np.ndarray]:
        refused: set[tuple[int, int]] = set()
        for _ in range(_SHORTCUTS):
            if len(knots) < 3:
                break
            i, j = sorted(self.rng.choice(len(knots), size=2, replace=False).tolist())
            ends = id(knots[i]), id(knots[j])
            if j - i < 2 or ends in refused:
                continue
            if free(knots[i], knots[j]):
                knots = knots[: i + 1] + knots[j:]
            else:
                refused.add(ends)
        return knots

    @staticmethod
    def _known(roadmap: Roadmap, a: int, b: int) -> list[int] | None:
        """A path found before, now and then forgotten: it may be free of the world and yet lead into other robots."""
        path, uses = roadmap.joined.pop((a, b), (None, 0))
        if path is not None and uses > 1:
            roadmap.joined[a, b] = path, uses - 1
        return path

    def path(
        self,
        roadmap: Roadmap,
        start: int,
        goal: int,
        blocked: np.ndarray,
        validate: Callable[[int], bool],
        rounds: int,
        join: Callable[[], list[int] | None],
        glance: Callable[[Sequence[int]], Sequence[int]] | None = None,
    ) -> list[int] | None:
        """`lazy_path`; where that finds nothing, what trees found before, or else what `join` finds."""
        path = lazy_path(roadmap, start, goal, blocked, validate, rounds, glance)
        if path is not None:
            return path
        for other in (lambda: self._known(roadmap, start, goal), join):
            joined = other()
            if joined is not None and all(validate(roadmap.edge(u, v)) for u, v in itertools.pairwise(joined)):
                return joined
        return None

    @staticmethod
    def _put(roadmap: Roadmap, start: int, goal: int, knots: list[np.ndarray]) -> list[int]:
        if start == goal:
            return [start]
        vertices = [start, *(roadmap.add_vertex(q) for q in knots[1:-1]), goal]
        for u, v in itertools.pairwise(vertices):
            roadmap.edge(u, v)
        return vertices
