"""Is every instant of a motion free of collision?  Conservative advancement on the full plant (paper, section III).

A segment is parametrised by s, the largest displacement that any robot point can have made.  Distances are asked for at
samples of s; between two samples at which a pair of solids is d0 and d1 apart, it cannot have met if d0 + d1 exceeds
the bound on its relative displacement.  Pairs that this does not settle are bisected, down to samples at most
`resolution` of relative displacement apart.

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
from typing import Any

import numpy as np

from mrtamp.check_bounds import Snapshot
from mrtamp.check_contact import TOUCH
from mrtamp.check_report import Report, Side, Violation
from mrtamp.check_scene import JudgeScene, box_gap
from mrtamp.kinematics import inverse

STRIDE = 0.1
"""Displacement (m) of any robot point between the samples from which bisection starts: the pace in free space."""
NOISE = 1e-4
"""Margin (m) on certificates for the accuracy of Drake's distances (2e-5)."""


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


@dataclass(eq=False)
class _Pairs:
    """Pairs of solids (P, 2), their displacement rates (P, N), and the window (P, 2) of s in which each is judged."""

    solids: np.ndarray
    rates: np.ndarray
    window: np.ndarray
    resolution: float

    def inside(self, s: np.ndarray, pair: Any) -> np.ndarray:
        """Whether s lies in the windows of `pair`."""
        return (s >= self.window[pair, 0]) & (s <= self.window[pair, 1])

    def unsettled(self, d: tuple[Any, Any], moved: Any, s: tuple[Any, Any], pair: Any) -> np.ndarray:
        """Whether `pair`, at least d apart at the two s, may meet in between and is sampled too coarsely there."""
        open_ = (d[0] + d[1] <= moved + NOISE) & (moved > self.resolution)
        return open_ & (s[0] < self.window[pair, 1]) & (s[1] > self.window[pair, 0])

    def stretches(self, d: np.ndarray, moved: np.ndarray, s: np.ndarray) -> np.ndarray:
        """`unsettled` for all stretches between samples s (S,) and all pairs (S - 1, P), at least d (S, P) apart."""
        return self.unsettled((d[:-1], d[1:]), moved, (s[:-1, None], s[1:, None]), slice(None))


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
        snapshot = Snapshot(line.envelopes, self.world.screws, line.configurations(s))
        # No solid moves further than STRIDE between samples, so two that are further apart at both are settled.
        i, j = snapshot.near(line.eligible, STRIDE)
        if not len(i):
            return
        window = np.tile([0.0, line.length], (len(i), 1))
        for (name, other), interval in exempt.items():
            mine, theirs = self.world.of.get(name, []), self.world.of.get(other, [])
            window[(np.isin(i, mine) & np.isin(j, theirs)) | (np.isin(i, theirs) & np.isin(j, mine))] = interval
        pairs = _Pairs(np.column_stack([i, j]), line.rates(i, j), window, self.resolution)
        d = snapshot.spheres(i, j).T
        moved = np.diff(line.travelled(s), axis=0) @ pairs.rates.T
        d[1:, moved.sum(axis=0) == 0.0] = np.inf  # what does not move is looked at once
        at, pair = self._open(pairs, s, d, moved)
        d[at, pair] = np.maximum(d[at, pair], snapshot.shapes(at, i[pair], j[pair]))
        at, pair = self._open(pairs, s, d, moved)
        d[at, pair] = self._distances(line, s, at, pairs.solids[pair], report)
        report.clearance(d[at, pair][pairs.inside(s[at], pair)])
        self._sift(line, s, pairs, d, report, exempt).report(report)

    def _open(self, pairs: _Pairs, s: np.ndarray, d: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Samples and pairs whose bounds d (S, P) decide nothing: about the sample, or about a neighbouring stretch."""
        unsettled = pairs.stretches(d, moved, s)
        need = (d <= NOISE) & pairs.inside(s[:, None], slice(None))
        need[:-1] |= unsettled
        need[1:] |= unsettled
        at, pair = np.nonzero(need)
        return at, pair

    def _distances(
        self, line: Timeline, s: np.ndarray, at: np.ndarray, solids: np.ndarray, report: Report
    ) -> np.ndarray:
        """Drake's distances (E,) of pairs of solids (E, 2) at the samples s[at]; `at` (E,) in ascending order."""
        out = np.empty(len(at))
        samples, row = np.unique(at, return_inverse=True)
        q, _ = line.state(s[samples]) if len(samples) else (np.empty((0, 0)), {})
        current, query = -1, None
        for e, (i, j) in enumerate(solids):
            if row[e] != current:
                current = row[e]
                query = self.world.query(q[current])
            out[e] = self.world.distance(query, i, j)
        return out

    def _sift(
        self,
        line: Timeline,
        s: np.ndarray,
        pairs: _Pairs,
        d: np.ndarray,
        report: Report,
        exempt: Mapping[tuple[str, str], tuple[float, float]],
    ) -> _Hits:
        """Note the samples in collision, and bisect the stretches that their ends do not certify."""
        hits = _Hits(self.world, line)
        hit = pairs.inside(s[:, None], slice(None)) & (d <= 0.0)
        touched = np.flatnonzero(hit.any(axis=1))
        hit[touched[self._tolerated(line, s[touched], exempt)]] = False
        for n, c in zip(*np.nonzero(hit), strict=True):
            hits.note(pairs.solids[c], float(s[n]), float(d[n, c]))
        if hits and report.first_only:
            return hits
        moved = np.diff(line.travelled(s), axis=0) @ pairs.rates.T
        unsettled = pairs.stretches(d, moved, s)
        unsettled &= ~hit[:-1] & ~hit[1:]
        stretch, pair = np.nonzero(unsettled)
        lo, hi, d0, d1 = s[stretch], s[stretch + 1], d[stretch, pair], d[stretch + 1, pair]
        while len(pair) and not (hits and report.first_only):
            # One row per stretch and pair; rows of one stretch share one sample.
            order = np.argsort(lo, kind="stable")
            lo, hi, d0, d1, pair = lo[order], hi[order], d0[order], d1[order], pair[order]
            middle = (lo + hi) / 2
            samples, at = np.unique(middle, return_inverse=True)
            dm = self._distances(line, samples, at, pairs.solids[pair], report)
            report.samples += len(samples)
            inside = pairs.inside(middle, pair)
            report.clearance(dm[inside])
            hit = inside & (dm <= 0.0)
            touched = np.unique(at[hit])
            hit &= ~np.isin(at, touched[self._tolerated(line, samples[touched], exempt)])
            for row in np.flatnonzero(hit):
                hits.note(pairs.solids[pair[row]], float(middle[row]), float(dm[row]))
            # A pair that collides is not searched any further here: its stretch is known to be bad.
            free = ~hit
            lo, hi = np.concatenate([lo[free], middle[free]]), np.concatenate([middle[free], hi[free]])
            d0, d1 = np.concatenate([d0[free], dm[free]]), np.concatenate([dm[free], d1[free]])
            pair = np.concatenate([pair[free], pair[free]])
            travel = np.einsum("rn,rn->r", line.travelled(hi) - line.travelled(lo), pairs.rates[pair])
            keep = pairs.unsettled((d0, d1), travel, (lo, hi), pair)
            lo, hi, d0, d1, pair = lo[keep], hi[keep], d0[keep], d1[keep], pair[keep]
        return hits

    def _tolerated(
        self, line: Timeline, s: np.ndarray, exempt: Mapping[tuple[str, str], tuple[float, float]]
    ) -> np.ndarray:
        """At which s (S,) all penetrations of the configuration add up to no more than the problem tolerates."""
        out = np.zeros(len(s), dtype=bool)
        if self.tolerance <= 0.0 or not len(s):
            return out
        q, _ = line.state(s)
        for k, at in enumerate(s):
            total = 0.0
            for pair, depth in self.world.penetrations(self.world.query(q[k])).items():
                one, two = (self.world.solids[i].side.owner for i in pair)
                low, high = exempt.get((one, two)) or exempt.get((two, one)) or (0.0, line.length)
                if pair not in line.motion.allowed and low <= at <= high:
                    total += depth
            out[k] = total <= self.tolerance
        return out

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
        for name in names:
            for i in world.of.get(name, []) if name in poses else []:
                for j in fixed + [j for other in poses if other != name for j in world.of.get(other, [])]:
                    pair = (min(i, j), max(i, j))
                    X_WC, X_WD = (
                        poses.get(world.solids[k].side.owner, world.X_WB[k]) @ world.solids[k].X_BC for k in (i, j)
                    )
                    p = inverse(X_WD) @ X_WC[:, 3]
                    if pair in done or box_gap(p[:3], world.solids[j].half) > world.solids[i].bound + TOUCH:
                        continue
                    done.add(pair)
                    if not world.may_collide(*pair) or (name, world.solids[j].side.owner) in standing:
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
