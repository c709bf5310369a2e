"""Is every instant of a motion free of collision?  Conservative advancement on the full plant (paper, section III).

A segment is parametrised by s, the largest displacement that any robot point can have made.  Distances are asked for at
samples of s; between two samples at which a pair of solids is d0 and d1 apart, it cannot have met if d0 + d1 exceeds
the bound on its relative displacement, nor if one plane separates it all the way (`check_stretches`).  Pairs that this
does not settle are bisected, down to samples at most `resolution` of relative displacement apart.

Contact is allowed in four cases only.  What a robot holds may touch its gripper; an object at rest may touch what it
rests on; an object that was just picked may touch what it stood on until they are TOUCH apart for the first time; and
one that is about to be placed may touch what it will stand on since they were TOUCH apart for the last time.  In the
last two cases they penetrate no deeper than TOUCH, and the object stays within CONTACT_TRAVEL of the pose in which it
rested or will rest, so that nothing is dragged along a surface.  Other pairs may penetrate, at any one instant, by no
more in total than the problem tolerates (nothing, unless it says so); pairs it ignores do not count anywhere.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from mrtamp.check_contact import TOUCH
from mrtamp.check_report import Report, Side, Violation
from mrtamp.check_scene import JudgeScene, box_gap
from mrtamp.check_stretches import NOISE, Allowance, Pairs, Samples, Stretches

STRIDE = 0.1
"""Displacement (m) of any robot point between the samples from which bisection starts: the pace in free space."""


@dataclass(eq=False)
class Motion:
    """One stretch of motion in one mode: composite waypoints z (K, N) and the objects."""

    z: np.ndarray
    segment: int
    carried: dict[str, tuple[str, np.ndarray]]
    """Object -> the robot that carries it, directly or on what it holds, and its pose X_GO in the grasp frame."""
    resting: dict[str, np.ndarray]
    """Object -> world pose, for all others."""
    allowed: set[tuple[int, int]]
    """Pairs of solids that may touch throughout."""
    at_step: int | None = None
    """The step at whose end it all happens, for fingers that close or open at a transition."""


class Timeline:
    """Displacement bounds along a motion, and the state of the plant anywhere on it."""

    def __init__(self, world: JudgeScene, motion: Motion) -> None:
        self.world, self.motion = world, motion
        z = motion.z
        self.reach, self.upstream = world.static_reach.copy(), world.static_upstream.copy()
        self.envelopes = world.envelopes.copy()
        for name, X_WO in motion.resting.items():
            self.envelopes.moved(world.of.get(name, []), X_WO, -1)
        for name, (robot, X_GO) in motion.carried.items():
            joint = world.joint_of_grasp(robot)
            self.envelopes.moved(world.of.get(name, []), world.X_WG[robot] @ X_GO, joint)
            for i in world.of.get(name, []):
                self.reach[i] = world.carried_reach(world.solids[i], robot, X_GO)
                self.upstream[i] = world.upstream(joint)
        moving = self.envelopes.joint >= 0
        self.eligible = world.unfiltered & (moving[:, None] | moving[None])
        if motion.allowed:
            self.eligible[tuple(np.array(sorted(motion.allowed)).T)] = False
        self.travel = np.vstack([np.zeros(z.shape[1]), np.cumsum(np.abs(np.diff(z, axis=0)), axis=0)])
        steps = np.abs(np.diff(z, axis=0)) @ self.reach.T
        self.s = np.concatenate([[0.0], np.cumsum(steps.max(axis=1))]) if steps.size else np.zeros(len(z))
        self.length = float(self.s[-1])
        self._knots = np.arange(len(z), dtype=float)
        self._base = world.positions(z[:1], motion.resting)[0]

    def step(self, s: float) -> tuple[int, float]:
        """The waypoint before s, and how far (0 to 1) towards the next one s is."""
        if self.motion.at_step is not None:
            return self.motion.at_step, 1.0
        t = float(np.interp(s, self.s, self._knots))
        step = min(int(t), max(len(self.motion.z) - 2, 0))
        return step, t - step

    def configurations(self, s: np.ndarray) -> np.ndarray:
        """Composite configurations (S, N) at s (S,)."""
        return self._at(s, self.motion.z)

    def _at(self, s: np.ndarray, table: np.ndarray) -> np.ndarray:
        t = np.interp(s, self.s, self._knots)
        i = np.minimum(t.astype(int), max(len(table) - 2, 0))
        f = (t - i)[:, None]
        if len(table) == 1:
            return np.repeat(table, len(t), axis=0)
        return table[i] * (1 - f) + table[i + 1] * f

    def travelled(self, s: np.ndarray) -> np.ndarray:
        """Cumulative joint motion (S, N) at s (S,)."""
        return self._at(s, self.travel)

    def state(self, s: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Plant positions (S, nq) and the world poses of the carried objects (S, 4, 4) at s (S,)."""
        z = self.configurations(s)
        poses = self._carried(z)
        return self.world.positions(z, poses, self._base), poses

    def samples(self, stride: float) -> np.ndarray:
        """Every waypoint, and as many values of s between them that neighbours are at most `stride` apart."""
        knots = np.unique(self.s)
        count = np.maximum(np.ceil(np.diff(knots) / stride).astype(int), 1)
        between = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(knots, knots[1:], count, strict=False)]
        return np.concatenate([*between, knots[-1:]])

    def state_at_end(self) -> dict[str, np.ndarray]:
        """World poses (1, 4, 4) of the carried objects at the last waypoint."""
        return self._carried(self.motion.z[-1:])

    def _carried(self, z: np.ndarray) -> dict[str, np.ndarray]:
        carried = self.motion.carried
        frames = self.world.grasp_frames(z, sorted({robot for robot, _ in carried.values()}))
        return {name: frames[robot] @ X_GO for name, (robot, X_GO) in carried.items()}

    def rates(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Bounds (P, N) on the relative displacement of solids i (P,) and j (P,) per unit of motion of every joint."""
        common = self.upstream[i] & self.upstream[j]
        return np.where(common, 0.0, self.reach[i] + self.reach[j])


class _Hits:
    """Samples in collision: for every pair of bodies and step of the plan, the deepest."""

    def __init__(self, world: JudgeScene, line: Timeline) -> None:
        self.world, self.line = world, line
        self._deepest: dict[tuple[Side, Side, int], tuple[float, float]] = {}

    def __bool__(self) -> bool:
        return bool(self._deepest)

    def note(self, pair: np.ndarray, s: float, d: float) -> None:
        """Record that `pair` is at distance d <= 0 at s."""
        key = (self.world.solids[pair[0]].side, self.world.solids[pair[1]].side, self.line.step(s)[0])
        if key not in self._deepest or d < self._deepest[key][1]:
            self._deepest[key] = (s, d)

    def report(self, report: Report) -> None:
        """One violation per pair of bodies and step, in order of time."""
        for (a, b, step), (s, d) in sorted(self._deepest.items(), key=lambda item: item[1][0]):
            text = f"{a} and {b} collide, {-d * 1e3:.2f} mm deep"
            report.add(Violation("collision", text, self.line.motion.segment, step, self.line.step(s)[1], -d, (a, b)))


class MotionJudge:
    """Judges motions one by one and reports what collides."""

    def __init__(self, world: JudgeScene, resolution: float) -> None:
        self.world = world
        self.resolution = resolution
        self.tolerance = world.problem.collision.tolerance

    def judge(self, line: Timeline, report: Report, exempt: Mapping[tuple[str, str], tuple[float, float]]) -> None:
        """Report every collision on `line`.

        `exempt` maps (object, other) to the interval of s in which that pair is judged here; what happens outside it is
        the business of `contact_phase`.
        """
        s = line.samples(STRIDE)
        report.samples += len(s)
        samples = Samples(self.world, line, s)
        snapshot = samples.snapshot
        # No solid moves further than STRIDE between samples, so two that are further apart at both are settled.
        i, j = snapshot.near(line.eligible, STRIDE)
        if not len(i):
            return
        window = np.tile([0.0, line.length], (len(i), 1))
        for (name, other), interval in exempt.items():
            mine, theirs = self.world.of.get(name, []), self.world.of.get(other, [])
            window[(np.isin(i, mine) & np.isin(j, theirs)) | (np.isin(i, theirs) & np.isin(j, mine))] = interval
        pairs = Pairs(np.column_stack([i, j]), line.rates(i, j), window, self.resolution)
        d = snapshot.spheres(i, j).T
        moved = np.diff(line.travelled(s), axis=0) @ pairs.rates.T
        d[1:, moved.sum(axis=0) == 0.0] = np.inf  # what does not move is looked at once
        at, pair = self._open(pairs, s, d, moved)
        d[at, pair] = np.maximum(d[at, pair], snapshot.shapes(at, i[pair], j[pair]))
        at, pair = self._open(pairs, s, d, moved)
        hits = _Hits(self.world, line)
        d[at, pair], normal, collides = self._looked_at(samples, pairs, at, pair, exempt, hits, report)
        row = np.full(d.shape, -1)
        row[at, pair] = np.arange(len(at))
        hit = np.zeros(d.shape, dtype=bool)
        hit[at, pair] = collides
        start, pair = np.nonzero(pairs.stretches(d, moved, s) & ~hit[:-1] & ~hit[1:])
        ends = np.stack([start, start + 1], axis=1)
        normals = np.concatenate([normal, np.full((1, 3), np.nan)])[row[ends, pair[:, None]]]
        stretches = Stretches(start, start + 1, pair, d[ends, pair[:, None]], normals)
        self._bisect(samples, pairs, stretches, report, exempt, hits)
        hits.report(report)

    def _open(self, pairs: Pairs, s: np.ndarray, d: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Samples and pairs whose bounds d (S, P) decide nothing: about the sample, or about a neighbouring stretch."""
        unsettled = pairs.stretches(d, moved, s)
        need = (d <= NOISE) & pairs.inside(s[:, None], slice(None))
        need[:-1] |= unsettled
        need[1:] |= unsettled
        at, pair = np.nonzero(need)
        return at, pair

    def _looked_at(
        self,
        samples: Samples,
        pairs: Pairs,
        at: np.ndarray,
        pair: np.ndarray,
        exempt: Mapping[tuple[str, str], tuple[float, float]],
        hits: _Hits,
        report: Report,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Drake's distances (E,) of pairs at samples (E,) in ascending order, their directions (E, 3), and which of
        them are collisions (E,): they are noted."""
        d, normal, collides = np.empty(len(at)), np.empty((len(at), 3)), np.zeros(len(at), dtype=bool)
        solids, inside = pairs.solids[pair].tolist(), pairs.inside(samples.s[at], pair)
        used, first = np.unique(at, return_index=True)
        q, _ = samples.line.state(samples.s[used])
        for k, (low, high) in enumerate(pairwise([*first.tolist(), len(at)])):
            query = self.world.query(q[k])
            for e in range(low, high):
                d[e], normal[e] = self.world.nearest(query, *solids[e])
            hit = inside[low:high] & (d[low:high] <= 0.0)
            s = float(samples.s[used[k]])
            if hit.any() and not self._tolerated(samples.line, query, s, exempt):
                collides[low:high] = hit
                for e in low + np.flatnonzero(hit):
                    hits.note(pairs.solids[pair[e]], s, float(d[e]))
        report.clearance(d[inside])
        return d, normal, collides

    def _bisect(
        self,
        samples: Samples,
        pairs: Pairs,
        stretches: Stretches,
        report: Report,
        exempt: Mapping[tuple[str, str], tuple[float, float]],
        hits: _Hits,
    ) -> None:
        """Halve the stretches that their ends do not certify until nothing is left open; note what collides."""
        if not len(stretches):
            return
        allowance = Allowance(self.tolerance - self._standing(samples.line, pairs), samples.s)
        stretches = stretches.unsettled(samples, pairs, allowance)
        while len(stretches) and not (hits and report.first_only):
            # Stretches of several pairs share one sample in the middle.
            middle = (samples.s[stretches.start] + samples.s[stretches.end]) / 2
            order = np.argsort(middle, kind="stable")
            stretches, middle = stretches.where(order), middle[order]
            s, at = np.unique(middle, return_inverse=True)
            at += len(samples.s)
            samples.add(s)
            report.samples += len(s)
            d, normal, hit = self._looked_at(samples, pairs, at, stretches.pair, exempt, hits, report)
            # A pair that collides is not searched any further here: its stretch is known to be bad.
            free = ~hit
            stretches = stretches.where(free).halves(at[free], d[free], normal[free])
            stretches = stretches.unsettled(samples, pairs, allowance)

    def _standing(self, line: Timeline, pairs: Pairs) -> float:
        """Penetration (m) of all that do not move towards each other, which is the same all the way."""
        if self.tolerance <= 0.0:
            return 0.0
        moving = pairs.solids[line.travel[-1] @ pairs.rates.T > 0.0]
        others = line.motion.allowed | set(map(tuple, moving.tolist()))
        query = self.world.query(line.state(np.zeros(1))[0][0])
        return sum(depth for pair, depth in self.world.penetrations(query).items() if pair not in others)

    def _tolerated(
        self, line: Timeline, query: Any, s: float, exempt: Mapping[tuple[str, str], tuple[float, float]]
    ) -> bool:
        """Whether all penetrations at s, where Drake answers `query`, add up to no more than the problem tolerates."""
        if self.tolerance <= 0.0:
            return False
        total = 0.0
        for pair, depth in self.world.penetrations(query).items():
            one, two = (self.world.solids[i].side.owner for i in pair)
            low, high = exempt.get((one, two)) or exempt.get((two, one)) or (0.0, line.length)
            if pair not in line.motion.allowed and low <= s <= high:
                total += depth
        return total <= self.tolerance

    def resting(
        self, motion: Motion, names: list[str], report: Report, standing: Collection[tuple[str, str]] = ()
    ) -> None:
        """Objects at rest do not touch each other nor the world, except what they rest on.

        `names` are the objects to look at, `standing` pairs (object, other) that have been touching since before.
        """
        world = self.world
        poses = motion.resting
        if self.tolerance > 0.0:
            names = list(poses)  # what is tolerated is the total
        found: list[Violation] = []
        fixed = [i for i, solid in enumerate(world.solids) if solid.joint < 0 and solid.side.kind != "object"]
        query = None
        done = set(motion.allowed)
        still = fixed + [i for name in poses for i in world.of.get(name, [])]
        solids = [world.solids[i] for i in still]
        X_WC = np.array([poses.get(x.side.owner, world.X_WB[i]) @ x.X_BC for i, x in zip(still, solids, strict=True)])
        half = np.array([x.half for x in solids])
        for name in names:
            for i in world.of.get(name, []) if name in poses else []:
                centre = X_WC[still.index(i), :3, 3]
                gap = box_gap(np.einsum("na,nab->nb", centre - X_WC[:, :3, 3], X_WC[:, :3, :3]), half)
                for j in (still[k] for k in np.flatnonzero(gap <= world.solids[i].bound + TOUCH)):
                    pair, other = (min(i, j), max(i, j)), world.solids[j].side.owner
                    if pair in done or other == name:
                        continue
                    done.add(pair)
                    if not world.may_collide(*pair) or (name, other) in standing:
                        continue
                    if query is None:
                        query = world.query(world.positions(motion.z[:1], poses)[0])
                    d = world.distance(query, i, j)
                    report.clearance(np.array([d]))
                    if d <= 0.0:
                        a, b = world.solids[i].side, world.solids[j].side
                        text = f"{a} and {b} collide at rest, {-d * 1e3:.2f} mm deep"
                        found.append(Violation("collision", text, motion.segment, 0, 0.0, -d, (a, b)))
        if sum(v.value or 0.0 for v in found) > self.tolerance or (found and self.tolerance <= 0.0):
            for violation in found:
                report.add(violation)
