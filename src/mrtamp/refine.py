"""Refinement of an incumbent: robot-wise shortcuts and re-timing on the composite polyline (DESIGN section 8).

A plan becomes a sequence of knots, one configuration per robot at each, with the knot at which every transition
happens.  A proposal changes one robot between two of its own anchors while the others stay as they are; it is priced
first and checked only when it pays.  Because a robot's motion may be spread over knots at which others move, arms
come to move at the same time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mrtamp.collision import RESOLUTION, Collision
from mrtamp.modes import Mode
from mrtamp.plan import Segment, Transition
from mrtamp.problem import CostWeights
from mrtamp.roadmap import Roadmap
from mrtamp.validity import Validity

_KNOT = 0.3
"""Largest distance (rad) between knots after subdivision."""
_LONGEST = 40
_EPS = 1e-9


class Refiner:
    """Improves one sequence of segments and transitions; event order and transition configurations stay as they are.

    Attributes
    ----------
    cost : cost of the current polyline, transitions included.
    """

    def __init__(
        self,
        segments: Sequence[Segment],
        transitions: Sequence[Transition],
        weights: CostWeights,
        collision: Collision,
        validity: Validity,
        roadmaps: Mapping[str, Roadmap],
        rng: np.random.Generator,
        resolution: float = RESOLUTION,
    ) -> None:
        self.weights = weights
        self.collision = collision
        self.validity = validity
        self.roadmaps = roadmaps
        self.rng = rng
        self.resolution = resolution
        self.names = list(segments[0].q)
        self.modes: list[Mode] = [s.mode for s in segments]
        self.transitions = list(transitions)
        self.proposals = 0
        self._load(segments)
        self._subdivide()
        self._measure()

    # -- representation -------------------------------------------------------------------------------------------

    def _load(self, segments: Sequence[Segment]) -> None:
        parts: dict[str, list[np.ndarray]] = {r: [] for r in self.names}
        self._of_step: list[int] = []
        self._events: list[int] = []
        for s, segment in enumerate(segments):
            skip = 0 if s == 0 else 1
            for r in self.names:
                parts[r].append(segment.q[r][skip:])
            self._of_step += [s] * (segment.length - 1)
            if s < len(segments) - 1:
                self._events.append(len(self._of_step))
        self._q = {r: np.concatenate(parts[r]) for r in self.names}
        K = len(self._of_step) + 1
        self._anchor = {r: np.zeros(K, dtype=bool) for r in self.names}
        for r in self.names:
            self._anchor[r][[0, K - 1]] = True
        for t, knot in zip(self.transitions, self._events, strict=True):
            for r in t.active:
                self._protect(r, knot)

    def _protect(self, robot: str, knot: int) -> None:
        """Anchor a transition and the last motion before and first motion after it: approach, lift, retreat."""
        q, anchor = self._q[robot], self._anchor[robot]
        for step in (-1, 1):
            k = knot
            while 0 <= k + step < len(q) and np.array_equal(q[k + step], q[knot]):
                k += step
            # Standing still at the transition may be re-timed; the motion next to it may not be changed.
            if 0 <= k + step < len(q):
                anchor[min(k, k + step) : max(k, k + step) + 1] = True
        anchor[knot] = True

    def _subdivide(self) -> None:
        """Insert knots so that no step is longer than _KNOT."""
        steps = np.array([np.linalg.norm(np.diff(q, axis=0), axis=1) for q in self._q.values()])
        pieces = np.maximum(1, np.ceil(steps.max(axis=0) / _KNOT)).astype(int) if steps.size else np.zeros(0, int)
        starts = np.concatenate([[0], np.cumsum(pieces)])
        t = np.concatenate([[k + j / n for j in range(n)] for k, n in enumerate(pieces)] + [[float(len(pieces))]])
        low = np.minimum(t.astype(int), max(len(pieces) - 1, 0))
        for r in self.names:
            q, anchor = self._q[r], self._anchor[r]
            if not len(pieces):
                continue
            fresh = q[low] + (t - low)[:, None] * (q[low + 1] - q[low])
            fresh[starts] = q
            inside = anchor[low] & anchor[low + 1] & np.any(q[low] != q[low + 1], axis=1)
            inside[starts] = anchor
            self._q[r], self._anchor[r] = fresh, inside
        self._events = [int(starts[e]) for e in self._events]
        self._of_step = [s for s, n in zip(self._of_step, pieces, strict=True) for _ in range(n)]

    def _measure(self) -> None:
        self._lengths = np.array([np.linalg.norm(np.diff(self._q[r], axis=0), axis=1) for r in self.names])
        changes = sum(self.weights.transitions.get(a.kind, 0.0) for t in self.transitions for a in t.actions)
        self.cost = self._price(self._lengths) + changes

    def _price(self, lengths: np.ndarray) -> float:
        if not lengths.size:
            return 0.0
        return float(self.weights.makespan * lengths.max(axis=0).sum() + self.weights.path_length * lengths.sum())

    def segments(self) -> list[Segment]:
        """The current polyline as segments."""
        bounds = [0, *self._events, len(self._of_step)]
        return [
            Segment(mode, {r: self._q[r][a : b + 1].copy() for r in self.names})
            for mode, a, b in zip(self.modes, bounds[:-1], bounds[1:], strict=True)
        ]

    def _compress(self) -> None:
        """Drop steps in which nobody moves."""
        still = self._lengths.max(axis=0) <= _EPS
        if not still.any():
            return
        keep = np.concatenate([[True], ~still])
        # A dropped knot equals the one kept before it; whatever was anchored there is anchored here.
        kept = np.cumsum(keep) - 1
        for r in self.names:
            anchor = np.zeros(int(keep.sum()), dtype=bool)
            np.logical_or.at(anchor, kept, self._anchor[r])
            self._q[r], self._anchor[r] = self._q[r][keep], anchor
        self._events = [int(kept[e]) for e in self._events]
        self._of_step = [s for s, dead in zip(self._of_step, still, strict=True) if not dead]
        self._measure()

    # -- proposals ------------------------------------------------------------------------------------------------

    def improve(self, proposals: int) -> float:
        """Try a number of proposals; returns by how much the cost went down."""
        before = self.cost
        for _ in range(proposals):
            self.proposals += 1
            self._propose()
        self._compress()
        return before - self.cost

    def _propose(self) -> None:
        index = int(self.rng.integers(len(self.names)))
        robot = self.names[index]
        q, anchor = self._q[robot], self._anchor[robot]
        anchors = np.flatnonzero(anchor)
        gaps = np.flatnonzero(np.diff(anchors) > 1)
        if not len(gaps):
            return
        g = int(gaps[self.rng.integers(len(gaps))])
        i, j = int(anchors[g]), int(anchors[g + 1])
        if self.rng.random() < 0.6 and j - i > 2:
            a = int(self.rng.integers(i, j - 1))
            b = int(self.rng.integers(a + 2, min(j, a + _LONGEST) + 1))
            i, j = a, b
        others = np.delete(self._lengths[:, i:j], index, axis=0)
        pace = others.max(axis=0) if len(others) else np.zeros(j - i)
        fresh = self._shape(q[i : j + 1], pace)
        own = np.linalg.norm(np.diff(fresh, axis=0), axis=1)
        lengths = self._lengths[:, i:j].copy()
        old = self._price(lengths)
        lengths[index] = own
        if self._price(lengths) >= old - 1e-6 or not self._is_free(robot, i, fresh):
            return
        q[i : j + 1] = fresh
        self._lengths[index, i:j] = own
        self.cost += self._price(lengths) - old

    def _shape(self, q: np.ndarray, pace: np.ndarray) -> np.ndarray:
        """A new motion (m, n) between the same ends: straight, the same path at another time, or bent."""
        kind = self.rng.random()
        if kind < 0.5:
            path = q[[0, -1]]
        elif kind < 0.75:
            path = q
        else:
            middle = q[len(q) // 2] + self.rng.normal(scale=0.25, size=q.shape[1])
            path = np.stack([q[0], middle, q[-1]])
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        length = along[-1]
        if length <= _EPS:
            return np.repeat(q[:1], len(q), axis=0)
        total = pace.sum()
        clock = np.concatenate([[0.0], np.cumsum(pace)])
        timing = self.rng.random()
        if total <= _EPS or timing < 0.2:
            progress = np.linspace(0, length, len(q))
        elif timing < 0.6:
            progress = clock / total * length
        elif timing < 0.8:
            progress = np.minimum(clock, length)
        else:
            progress = np.maximum(clock - total + length, 0.0)
        progress[0], progress[-1] = 0.0, length
        fresh = np.column_stack([np.interp(progress, along, path[:, d]) for d in range(q.shape[1])])
        fresh[0], fresh[-1] = q[0], q[-1]
        return fresh

    # -- validity -------------------------------------------------------------------------------------------------

    def _is_free(self, robot: str, i: int, fresh: np.ndarray) -> bool:
        """Whether the robot may move through `fresh` (m, n) from knot i on, the others as they are."""
        world = self.roadmaps[robot].world
        if np.any(fresh < world.chain.lower) or np.any(fresh > world.chain.upper):
            return False
        m = len(fresh)
        spheres = {r: self.roadmaps[r].world.bounds.spheres(self._q[r][i : i + m]) for r in self.names if r != robot}
        own = world.bounds.spheres(fresh)
        R, p = world.tool.pose(fresh)
        hand = p[:, None] + np.einsum("nij,kj->nki", R, 0.1 * np.eye(3))
        travel = np.maximum(
            np.linalg.norm(np.diff(own, axis=0), axis=2).max(axis=1),
            np.linalg.norm(np.diff(hand, axis=0), axis=2).max(axis=1),
        )
        for x in spheres.values():
            travel = np.maximum(travel, np.linalg.norm(np.diff(x, axis=0), axis=2).max(axis=1))
        pieces = np.maximum(1, np.ceil(1.1 * travel / self.resolution)).astype(int)
        of_step = np.array(self._of_step[i : i + m - 1])
        for s in np.unique(of_step):
            steps = np.flatnonzero(of_step == s)
            k = np.repeat(steps, pieces[steps])
            t = np.concatenate([np.arange(n) / n for n in pieces[steps]])
            k, t = np.append(k, steps[-1]), np.append(t, 1.0)
            if not self._segment_is_free(robot, self.modes[s], i, fresh, k, t):
                return False
        return True

    def _segment_is_free(self, robot: str, mode: Mode, i: int, fresh: np.ndarray, k: np.ndarray, t: np.ndarray) -> bool:
        world = self.roadmaps[robot].world
        q = fresh[k] + t[:, None] * (fresh[k + 1] - fresh[k])
        held = mode.held.get(robot)
        order = self.rng.permutation(len(q))
        centres = world.bounds.spheres(q)
        radii = world.bounds.radii
        if held is not None:
            R, p = world.tool.pose(q)
            centres = np.concatenate([centres, (p + R @ held.X_PO[:3, 3])[:, None]], axis=1)
            radii = np.append(radii, world.object_radius[held.object])
        near = {
            o.name: o.X_WO
            for o in self.validity.resting(mode)
            if np.min(np.linalg.norm(centres - o.X_WO[:3, 3], axis=2) - radii) < world.object_radius[o.name] + 0.02
        }
        if world.first_hit(world.rows(q, held, near)[order]) >= 0:
            return False
        for other in self.names:
            if other == robot:
                continue
            theirs = self._q[other][i + k] + t[:, None] * (self._q[other][i + k + 1] - self._q[other][i + k])
            their_world = self.roadmaps[other].world
            there = their_world.bounds.spheres(theirs)
            sizes = their_world.bounds.radii
            load = mode.held.get(other)
            if load is not None:
                R, p = their_world.tool.pose(theirs)
                there = np.concatenate([there, (p + R @ load.X_PO[:3, 3])[:, None]], axis=1)
                sizes = np.append(sizes, their_world.object_radius[load.object])
            gap = np.linalg.norm(centres[:, :, None] - there[:, None], axis=3) - radii[None, :, None] - sizes
            close = np.flatnonzero(gap.min(axis=(1, 2)) < 0.02)
            if not len(close):
                continue
            close = self.rng.permutation(close)
            pair, swapped = self.collision.pair(robot, other)
            first, second = (q[close], held), (theirs[close], load)
            hit = pair.first_hit(*second, *first) if swapped else pair.first_hit(*first, *second)
            if hit >= 0:
                return False
        return True
