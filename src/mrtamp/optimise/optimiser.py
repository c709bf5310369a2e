"""Sequential convex programming on a whole plan: the loop that ties programs, projections and checks together.

Each step solves one conic program in a trust region around the current polyline, projects transitions back onto their
strata, checks the result as finely as the planner does, and keeps it if it is cheaper and free of collision
(DESIGN section 8).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from mrtamp.check_report import Report, Violation
from mrtamp.collision import Collision
from mrtamp.optimise.choices import Arrangement, Choices
from mrtamp.optimise.closure import Closure, Rows, independent
from mrtamp.optimise.fine import FineCheck, Violations, Who, contact_of, knot_samples
from mrtamp.optimise.nearness import Near, Nearness, Samples
from mrtamp.optimise.polyline import Polyline, load
from mrtamp.optimise.program import PENALTY, Linearised, Reduction, reduce, solve
from mrtamp.optimise.pins import pins
from mrtamp.plan import Segment, Transition
from mrtamp.problem import Problem
from mrtamp.transitions.families import GraspFamily

Demands = dict[Who, dict[tuple[int, float, int], int]]
"""Who -> (step, fraction, segment) -> by how many millimetres more they shall be clear there."""

LEVELS = 1
TRUST = 0.2
"""First radius (rad) of the trust region of every joint."""
_LARGEST, _SMALLEST = 0.4, 0.01
_DEEP = 0.03
"""Penetration (m) at which a step is rejected."""
_SHALLOW = 1e-3
"""Penetration (m) at the program's own samples that makes a finer look pointless."""
_NEAR = 0.06
"""Distance (m) below which pairs of solids enter the program."""
_MARGIN = 1.5e-3
"""Clearance (m) that the program asks for at its samples; a third of it at every finer level."""
_STRICTER = 1e-3
_TOUCHING = -3e-4
"""Clearance (m) asked of an object and what it is lifted off or put on."""
_TRUE, _FALSE = 0.7, 0.25
_STALL = 5e-4
_PATIENCE = 3


@dataclass(frozen=True, eq=False)
class Iterate:
    """A polyline and what is attached to what along it."""

    line: Polyline
    q: np.ndarray
    arrangement: Arrangement
    cost: float


@dataclass(frozen=True, eq=False)
class _Collisions:
    """Linearised distances at an iterate: A (P, K * N + coordinates) and how far (P,) each may shrink."""

    A: sparse.csr_array
    gap: np.ndarray
    deepest: float

    def joined(self, other: _Collisions) -> _Collisions:
        """These rows and others."""
        A = sparse.csr_array(sparse.vstack([self.A, other.A]))
        return _Collisions(A, np.concatenate([self.gap, other.gap]), max(self.deepest, other.deepest))


class Optimiser:
    """Improves one plan: same order of events, same homotopy, but everything else may move.

    Parameters
    ----------
    segments, transitions : a valid plan.
    families : (robot, object) -> grasp families within which grasps may slide.
    knot : length (rad) of the steps of the polyline.
    levels : how often steps beside bends are halved, each time the one before has converged.
    slide : whether transitions may slide along their strata; otherwise their configurations stay as they are.

    Attributes
    ----------
    cost : cost of the best polyline without violations, transitions included.
    steps : conic programs solved so far.
    converged : whether further steps promise nothing.
    """

    def __init__(
        self,
        problem: Problem,
        collision: Collision,
        segments: Sequence[Segment],
        transitions: Sequence[Transition],
        families: Mapping[tuple[str, str], Sequence[GraspFamily]],
        *,
        knot: float = 0.27,
        levels: int = LEVELS,
        slide: bool = True,
    ) -> None:
        self.problem = problem
        self.weights = problem.cost
        self.worlds = collision.worlds
        self.nearness = Nearness(collision)
        self.fine = FineCheck(self.nearness)
        self.knot = knot
        self.levels = levels
        self._level = 0
        self.slide = slide
        self.steps = 0
        self.trust = TRUST
        self.converged = False
        self._stalls = 0
        self._promise = 0.0
        self._extra: Demands = {}
        self._changes = sum(self.weights.transitions.get(a.kind, 0.0) for t in transitions for a in t.actions)
        self.choices = Choices(problem, [s.mode for s in segments], transitions, families if slide else {})
        if not slide:
            self.choices.freeze()
        line = load(segments, transitions, {r: w.tool for r, w in self.worlds.items()})
        self._best = self._sure = self._iterate(line, line.q, self.choices.at(self.choices.start))
        self._now = self._best
        self._resample()
        self._collisions: _Collisions | None = None

    # -- the result -------------------------------------------------------------------------------------------------

    @property
    def cost(self) -> float:
        """Cost of the best iterate."""
        return self._best.cost

    @property
    def transitions(self) -> list[Transition]:
        """Transitions of the best iterate."""
        return self._best.arrangement.transitions

    def segments(self) -> list[Segment]:
        """Segments of the best iterate."""
        parts = self._best.line.parts(self._best.q)
        return [Segment(mode, q) for mode, q in zip(self._best.arrangement.modes, parts, strict=True)]

    def confirm(self) -> None:
        """The judge accepted the best iterate: `tighten` will not go back behind it."""
        self._sure = self._best

    def tighten(self, report: Report) -> None:
        """The judge refused the best iterate: ask for more clearance where it collided, and go on from there."""
        refused = self._best
        self._best, self.converged, self._stalls = self._sure, False, 0
        self._return_to(refused)
        bounds = [0, *refused.line.events.tolist()]
        for violation in report.violations:
            who = self._guilty(violation, refused.arrangement)
            if who and violation.kind == "collision":
                s = violation.segment or 0
                lo = min(bounds[s] + (violation.step or 0), refused.line.knots - 2)
                self._demand(who, lo, violation.fraction or 0.0, s, 2)
            elif self.slide:
                # Not a matter of clearance: leave transitions as they were.
                self._fix()
                return

    def _guilty(self, violation: Violation, arrangement: Arrangement) -> Who:
        held = arrangement.modes[violation.segment or 0].held
        carrier = {a.object: r for r, a in held.items()}
        owners = [carrier.get(s.owner, s.owner) for s in violation.sides or ()]
        return tuple(dict.fromkeys(r for r in self.worlds if r in owners))

    def _fix(self) -> None:
        """Start again from the last confirmed iterate with transitions that stay as they are."""
        self.slide = False
        self.choices = self._sure.arrangement.frozen()
        self._extra.clear()
        self._sure = self._iterate(self._sure.line, self._sure.q, self.choices.at(self.choices.start))
        self._best = self._now = self._sure
        self._collisions = None
        self._adopt(self._now.line)

    def _return_to(self, iterate: Iterate) -> None:
        """Go on from an earlier iterate."""
        if iterate.line is not self._now.line:
            # What violations taught is about steps of the other polyline.
            self._extra.clear()
        self._now, self._collisions = iterate, None
        self._adopt(iterate.line)

    # -- one step ---------------------------------------------------------------------------------------------------

    def step(self) -> float:
        """Solve one conic program; returns by how much the cost of the best iterate went down."""
        if self.converged or self._now.line.knots < 2:
            self.converged = True
            return 0.0
        now = self._now
        if self._collisions is None:
            self._collisions = self._linearise(now, *self._demands(now.line))
        self.steps += 1
        candidate = self._solve(now, self._collisions)
        if candidate is None:
            return self._reject()
        collisions = self._linearise(candidate, *self._demands(candidate.line))
        if collisions.deepest > _DEEP and collisions.deepest > self._collisions.deepest:
            return self._reject()
        clean = collisions.deepest < _SHALLOW
        if clean:
            violations = self.fine.violations(candidate.line, candidate.q, candidate.arrangement)
            if violations:
                clean = False
                fresh = self._learn(violations)
                collisions = collisions.joined(self._linearise(candidate, Samples.none(), fresh))
        before = self._merit(now, self._collisions)
        after = self._merit(candidate, collisions)
        self._now, self._collisions = candidate, collisions
        gain = 0.0
        if clean and candidate.cost < self._best.cost - 1e-9:
            gain = self._best.cost - candidate.cost
            self._best = candidate
        self._pace(before, after, self._promise + self._changes)
        if self._now is candidate and candidate.line.lengths(candidate.q).max() > 1.4 * self.knot:
            self._resample()
        return gain

    def _pace(self, before: float, after: float, promised: float) -> None:
        """Adapt the trust region to how much of the promised gain came true."""
        share = (before - after) / max(before - promised, 1e-9)
        if share > _TRUE:
            self.trust = min(1.3 * self.trust, _LARGEST)
        elif share < _FALSE:
            self.trust *= 0.5
        self._stalls = self._stalls + 1 if before - promised < _STALL * before or share < _FALSE else 0
        self._settle(self.trust < _SMALLEST or self._stalls >= _PATIENCE)

    def _settle(self, done: bool) -> None:
        """Where the polyline has converged, go on with finer steps beside its bends."""
        if done and self._level < self.levels:
            self._level += 1
            self._stalls, self.trust = 0, TRUST / 2**self._level
            self._return_to(self._best)
            self._extra.clear()
            self._resample()
        else:
            self.converged = done

    def _reject(self) -> float:
        self.trust *= 0.5
        self._settle(self.trust < _SMALLEST)
        return 0.0

    def _merit(self, x: Iterate, collisions: _Collisions) -> float:
        return x.cost + PENALTY * float(np.maximum(-collisions.gap, 0.0).sum())

    def _solve(self, now: Iterate, collisions: _Collisions) -> Iterate | None:
        E, size = self._reduction.E, now.q.size
        n, count = E.shape[1], self.choices.count
        scale = self.choices.scale
        whole = sparse.csr_array(sparse.block_diag([E, sparse.diags_array(scale)])) if count else E
        lower, upper = self._box(now)
        equal = self._stacked(self._closure.equalities(now.q, now.arrangement), n + count)[0]
        F, g = self._stacked(self._closure.inequalities(now.q, now.arrangement), n + count)
        rows = Linearised(
            sparse.csr_array(collisions.A @ whole), -collisions.gap, equal, F, g, lower, upper
        )
        solved = solve(self._reduction, now.q, self.weights, rows)
        if solved is None:
            return None
        x, self._promise = solved
        q = now.q + (E @ x[:n]).reshape(now.q.shape)
        c = np.clip(now.arrangement.c + scale * x[n:], *self.choices.bounds) if count else now.arrangement.c
        assert q.size == size
        arrangement = self.choices.at(c) if count else now.arrangement
        projected = self._closure.project(self._clipped(q), arrangement)
        return None if projected is None else self._iterate(now.line, self._clipped(projected), arrangement)

    def _box(self, now: Iterate) -> tuple[np.ndarray, np.ndarray]:
        """Trust region, joint limits and bounds of coordinates."""
        low, high = self._limits
        at = now.q[self._reduction.knot, self._reduction.column]
        column = self._reduction.column
        lower = np.clip(low[column] - at, -self.trust, 0.0)
        upper = np.clip(high[column] - at, 0.0, self.trust)
        if not self.choices.count:
            return lower, upper
        least, most = self.choices.bounds
        c, scale = now.arrangement.c, self.choices.scale
        return (
            np.concatenate([lower, np.clip((least - c) / scale, -self.trust, 0.0)]),
            np.concatenate([upper, np.clip((most - c) / scale, 0.0, self.trust)]),
        )

    def _stacked(self, parts: Sequence[Rows], n: int) -> tuple[sparse.csr_array, np.ndarray]:
        """Rows over the n independent variables; equalities without the redundant ones."""
        values, rows, columns, lower = [np.zeros(0)], [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0)]
        own = len(self._reduction.knot)
        variable = np.concatenate([self._reduction.variable, own + np.arange(self.choices.count)])
        scale = np.concatenate([np.ones(len(self._reduction.variable)), self.choices.scale])
        m = 0
        for part in parts:
            used = variable[part.columns] >= 0
            block = part.block[:, used] * scale[part.columns[used]]
            if part.lower is None:
                block = independent(block)
            values.append(block.reshape(-1))
            rows.append(np.repeat(m + np.arange(len(block)), block.shape[1]))
            columns.append(np.tile(variable[part.columns[used]], len(block)))
            lower.append(np.zeros(len(block)) if part.lower is None else part.lower)
            m += len(block)
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return sparse.csr_array(entries, shape=(m, n)), np.concatenate(lower)

    # -- collisions -------------------------------------------------------------------------------------------------

    def _learn(self, violations: Sequence[Violations]) -> Demands:
        """Every violating sample becomes a row of the next programs, stricter each time it recurs."""
        fresh: Demands = {}
        for v in violations:
            for lo, t, s in zip(v.samples.lo.tolist(), v.samples.t.tolist(), v.samples.segment.tolist(), strict=True):
                key = self._demand(v.who, lo, t, s, 1)
                fresh.setdefault(v.who, {})[key] = self._extra[v.who][key]
        return fresh

    def _demand(self, who: Who, lo: int, t: float, segment: int, more: int) -> tuple[int, float, int]:
        rows = self._extra.setdefault(who, {})
        key = (lo, round(t * 12) / 12, segment)
        rows[key] = rows.get(key, 0) + more
        return key

    def _demands(self, line: Polyline) -> tuple[Samples, Demands]:
        """Knots and midpoints, and what violations have taught."""
        return knot_samples(line, np.full(line.knots - 1, 2)), self._extra

    def _samples(self, base: Samples, extra: Mapping[tuple[int, float, int], int]) -> tuple[Samples, np.ndarray]:
        """The samples of a query and the clearance (S,) asked for at each."""
        finer = 3.0**-self._level
        least = _MARGIN * finer - 0.25 * self.problem.collision.tolerance
        margin = np.full(len(base), least)
        if not extra:
            return base, margin
        lo, t, segment = (np.array(x) for x in zip(*extra, strict=True))
        strict = least + _STRICTER * finer * np.array(list(extra.values()))
        return base.joined(Samples(lo, t, segment)), np.concatenate([margin, strict])

    def _linearise(self, at: Iterate, base: Samples, demands: Demands) -> _Collisions:
        """Distances and their gradients at the samples of `base` for all, and at those that `demands` adds."""
        line, q, arrangement = at.line, at.q, at.arrangement
        blocks: list[sparse.csr_array] = []
        gaps: list[np.ndarray] = []
        deepest = 0.0
        names = list(line.columns)
        for i, robot in enumerate(names):
            for who in [(robot,), *((other, robot) for other in names[:i])]:
                samples, margin = self._samples(base, demands.get(who, {}))
                if not len(samples):
                    continue
                knots = {r: q[:, line.columns[r]] for r in who}
                if len(who) == 1:
                    near = self.nearness.world(robot, knots[robot], samples, arrangement, _NEAR)
                else:
                    near = self.nearness.between(*who, *knots.values(), samples, arrangement, _NEAR)
                if not len(near.distance):
                    continue
                asked = margin[near.sample]
                if len(who) == 1:
                    touching = self._touching(line, robot, samples, near)
                    asked = np.where(touching, _TOUCHING, asked)
                deepest = max(deepest, float(-(near.distance - np.minimum(asked, 0)).min()))
                blocks.append(self._gradient(line, samples, near, knots, arrangement))
                gaps.append(near.distance - asked)
        A = sparse.csr_array(sparse.vstack(blocks)) if blocks else sparse.csr_array((0, q.size + self.choices.count))
        return _Collisions(A, np.concatenate([np.zeros(0), *gaps]), deepest)

    def _touching(self, line: Polyline, robot: str, samples: Samples, near: Near) -> np.ndarray:
        """Pairs (P,) of a load and what it is being lifted off or put on."""
        contact = contact_of(line.stretches, robot, samples)
        number = self.nearness.carriers.number
        support = np.array(
            [number.get(("static", c), number.get(("object", c), -2)) if c else -2 for c in contact], dtype=int
        )[near.sample]
        held = number["held", robot]
        return ((near.a == held) & (near.b == support)) | ((near.b == held) & (near.a == support))

    def _gradient(
        self, line: Polyline, samples: Samples, near: Near, knots: Mapping[str, np.ndarray], arrangement: Arrangement
    ) -> sparse.csr_array:
        """Rows over flattened knots and coordinates: a row between two knots involves both."""
        N = line.q.shape[1]
        lo, t = samples.lo[near.sample], samples.t[near.sample]
        P = len(lo)
        values, rows, columns = [], [], []
        x = {r: samples.at(k) for r, k in knots.items()}
        for robot in knots:
            G = self.nearness.joint_gradient(robot, x[robot], near)
            cols = line.columns[robot]
            joint = np.arange(cols.start, cols.stop)
            for knot, weight in ((lo, 1 - t), (np.minimum(lo + 1, line.knots - 1), t)):
                values.append((G * weight[:, None]).reshape(-1))
                rows.append(np.repeat(np.arange(P), len(joint)))
                columns.append((knot[:, None] * N + joint).reshape(-1))
        H = self.nearness.choice_gradient(near, samples, x, arrangement)
        r, k = np.nonzero(H)
        values.append(H[r, k])
        rows.append(r)
        columns.append(line.q.size + k)
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        out = sparse.csr_array(entries, shape=(P, line.q.size + len(arrangement.c)))
        out.eliminate_zeros()
        return out

    # -- bookkeeping ------------------------------------------------------------------------------------------------

    def _iterate(self, line: Polyline, q: np.ndarray, arrangement: Arrangement) -> Iterate:
        lengths = line.lengths(q)
        if not lengths.size:
            return Iterate(line, q, arrangement, self._changes)
        motion = self.weights.makespan * lengths.max(axis=0).sum() + self.weights.path_length * lengths.sum()
        return Iterate(line, q, arrangement, float(motion) + self._changes)

    def _clipped(self, q: np.ndarray) -> np.ndarray:
        return np.clip(q, *self._limits)

    @property
    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        chains = [self.worlds[r].chain for r in self._now.line.columns]
        return np.concatenate([c.lower for c in chains]), np.concatenate([c.upper for c in chains])

    def _resample(self) -> None:
        """Spread the knots of the current iterate evenly again."""
        now = self._now
        line = Polyline(now.line.columns, now.q, now.line.events, now.line.stretches)
        u = line.resampled(self.knot, self._level)
        fresh = line.at(u)
        moved: Demands = {}
        for who, rows in self._extra.items():
            moved[who] = {}
            for (lo, t, segment), strict in rows.items():
                at = float(np.interp(lo + t, u, np.arange(len(u))))
                k = min(int(at), max(fresh.knots - 2, 0))
                moved[who][k, round((at - k) * 12) / 12, segment] = strict
        self._extra = moved
        self._now = self._iterate(fresh, fresh.q, now.arrangement)
        self._collisions = None
        self._adopt(fresh)

    def _adopt(self, line: Polyline) -> None:
        """Variables and closure rows for a new set of knots."""
        pinned = pins(self.problem, line, self._now.arrangement.transitions, self.slide)
        self._reduction: Reduction = reduce(line, pinned)
        self._closure = Closure(self.problem, self.worlds, line, self._now.q, pinned)
