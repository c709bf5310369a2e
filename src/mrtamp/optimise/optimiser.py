"""Sequential convex programming on a whole plan: the loop that ties programs, projections and checks together.

Each step solves one conic program in a trust region around the current polyline, projects transitions back onto their
strata, checks the result as finely as the planner does, and keeps it if it is cheaper and free of collision
(DESIGN section 8).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse

from mrtamp.check_report import Report, Violation
from mrtamp.deadline import Deadline
from mrtamp.optimise.choices import Arrangement, Choices
from mrtamp.optimise.closure import Closure, Rows, independent
from mrtamp.optimise.collisions import CollisionRows, Collisions
from mrtamp.optimise.fine import FineCheck, Violations, Who
from mrtamp.optimise.iterate import Iterate, worth
from mrtamp.optimise.mending import CLEARANCE, Mending
from mrtamp.optimise.nearness import Nearness, Samples
from mrtamp.optimise.pins import pins
from mrtamp.optimise.polyline import Polyline, load
from mrtamp.optimise.program import PENALTY, Linearised, Reduction, reduce, solve
from mrtamp.plan import Segment, Transition
from mrtamp.problem import Problem
from mrtamp.transitions.families import GraspFamily

LEVELS = 1
TRUST = 0.35
"""First radius (rad) of the trust region of every joint."""
_SLIDING = 0.2
"""The same (m) where all joints slide: a step of that size takes a whole robot along."""
_LARGEST, _SMALLEST = 0.5, 0.01
_DEEP = 0.06
"""Penetration (m) at which a step is rejected."""
_HOLD, _HELD, _RAMP = 0.02, 0.2, 4.0
"""Where a step leads deeper than that (m) into collision, so much of it is tried; all of it so many knots away."""
_LINGER, _LODGED, _YIELDS = 5, 0.004, 0.8
"""Steps in which a draft whose robots penetrate by more than that (m) all the time has to reduce it to that share."""
_SHALLOW = 1e-3
"""Penetration (m) at the program's own samples that makes a finer look pointless."""
_AHEAD, _LEAST = 0.5, 0.02
"""Distance (m) of what enters a program, relative to the largest step (rad or m) of a joint in the one before, and the
least: with all that is farther in it, a program takes up to twice as long."""
_MISSED = 1e-3
"""Penetration (m) of what was left out with which a program is solved again, with all there is."""
_TRUE, _FALSE = 0.7, 0.25
_GAINING, _STRIDE = 0.01, 0.6
"""As long as every step makes a plan cheaper by that share, that much of the first trust region is kept: some of the
collisions are left to later, smaller steps."""
_SETTLED = 0.001
"""What a step gains less than that share of, if it leads to what grazes something, is mended: before, the next step
gains more in the time."""
_GRAZES = 2
"""Iterates in collision, one after another, after which more clearance is asked for."""
_PADS = (0.0, 0.003, 0.006)
_WORTH_CLEARING = 0.005
_CHANCES = 4
"""Steps that a polyline which has converged in collision gets to come free."""
_STALL = 1e-3
_PATIENCE = 6
_EPS = 1e-9
_WINDOW = 8
"""Steps within which the best cost and the current merit have to fall by what is worth having."""


def first_trust(nearness: Nearness) -> float:
    """First radius (rad, or m where all joints slide) of the trust region of every joint."""
    return _SLIDING if all(w.chain.prismatic.all() for w in nearness.worlds.values()) else TRUST


_WITHIN_SIGHT = 1.05
"""An iterate is looked at closely if it costs less than so many times what is to be beaten."""


class Optimiser:
    """Improves one plan: same order of events, same homotopy, but everything else may move.

    Parameters
    ----------
    nearness : measures distances in the problem's plants; may be shared by optimisers of the same problem.
    segments, transitions : a valid plan.
    families : (robot, object) -> grasp families within which grasps may slide.
    knot : length (rad) of the steps of the polyline.
    levels : how often steps beside bends are halved, each time the one before has converged.
    level : how often they are halved from the start.
    slide : whether transitions may slide along their strata; otherwise their configurations stay as they are.
    draft : whether robots may still collide with each other in what is given.
    fixed_end : whether all robots end where they do, since it is a piece of a plan.
    clearance : distance (m) that is asked for at all samples: the more, the sooner a step leads to what is free between
    them, too.
    to_beat : cost below which it is worth to mend what grazes something; it may be changed on the way.
    deadline : when mending, which takes longer than a program, is given up.

    Attributes
    ----------
    cost : cost of the best polyline without violations, transitions included; infinite while a draft has none.
    stuck : whether a draft does not come free of collision.
    steps : conic programs solved so far.
    converged : whether further steps promise nothing.
    """

    def __init__(
        self,
        problem: Problem,
        nearness: Nearness,
        segments: Sequence[Segment],
        transitions: Sequence[Transition],
        families: Mapping[tuple[str, str], Sequence[GraspFamily]],
        *,
        knot: float = 0.27,
        levels: int = LEVELS,
        level: int = 0,
        slide: bool = True,
        draft: bool = False,
        fixed_end: bool = False,
        clearance: float = 0.0,
        to_beat: float = np.inf,
        deadline: Deadline | None = None,
    ) -> None:
        self.problem = problem
        self.weights = problem.cost
        self.worlds = nearness.worlds
        self.nearness = nearness
        self.fine = FineCheck(self.nearness)
        self.knot = knot
        self.levels = levels
        self.slide = slide
        self.fixed_end = fixed_end
        self.clearance = clearance
        self.to_beat = to_beat
        self.steps = 0
        self._first_trust = first_trust(nearness)
        self.trust = self._first_trust
        self.converged = False
        self._stalls = 0
        self._grazing = 0
        tolerance = problem.collision.tolerance
        self.mending = Mending(self.fine, tolerance, self._solve, self._violations, deadline or Deadline())
        self._last_chances = _CHANCES
        self._trail: list[float] = []
        self._worth = np.inf
        self._promise = 0.0
        self.collisions = Collisions(self.nearness, tolerance)
        self.collisions.level = level
        self.collisions.pad = clearance
        self._changes = self.weights.of_changes(a.kind for t in transitions for a in t.actions)
        self.choices = Choices(problem, [s.mode for s in segments], transitions, families if slide else {})
        if not slide:
            self.choices.freeze()
        line = load(segments, transitions, {r: w.tool for r, w in self.worlds.items()})
        self._best = self._sure = self._iterate(line, line.q, self.choices.at(self.choices.start))
        self._now = self._best
        if draft:
            self._best = self._sure = replace(self._best, cost=np.inf)
        self._depths: list[float] = []
        self._stride = np.inf
        self._rows: CollisionRows | None = None
        self._resample()

    # -- the result -------------------------------------------------------------------------------------------------

    @property
    def cost(self) -> float:
        """Cost of the best iterate."""
        return self._best.cost

    @property
    def outlook(self) -> float:
        """Cost of the current iterate, which may still collide a little: what the best may soon be."""
        return min(self._best.cost, self._now.cost)

    @property
    def knots(self) -> int:
        """Number of knots that programs are about."""
        return self._now.line.knots

    @property
    def current(self) -> float:
        """Cost of the current iterate, which may still collide."""
        return self._now.cost

    @property
    def deepest(self) -> float:
        """Penetration (m), beyond what is tolerated, that the last program led to; 0 before the first."""
        return self._depths[-1] if self._depths else 0.0

    @property
    def transitions(self) -> list[Transition]:
        """Transitions of the best iterate."""
        return self._best.arrangement.transitions

    def segments(self) -> list[Segment]:
        """Segments of the best iterate."""
        return self._best.line.segments(self._best.q, self._best.arrangement.modes)

    def latest(self) -> tuple[list[Segment], list[Transition]]:
        """Segments and transitions of the best iterate or, if it is cheaper, the current one, which may collide."""
        x = min(self._best, self._now, key=lambda x: x.cost)
        return x.line.segments(x.q, x.arrangement.modes), x.arrangement.transitions

    def take_as_given(self) -> None:
        """Count what was given, a draft, as free of collision if it is; programs only have to make it cheaper then."""
        if np.isfinite(self._best.cost):
            return
        given = self._priced(self._best)
        if given.cost >= self.to_beat:
            return
        clearance = self.collisions.rows(given.line, given.q, given.arrangement).clearance
        if not self._violations(given, clearance):
            self._best = given

    def confirm(self) -> None:
        """The judge accepted the best iterate: `tighten` will not go back behind it."""
        self._sure = self._best

    def tighten(self, report: Report) -> None:
        """The judge refused the best iterate: ask for more clearance where it collided, and go on from there.

        While a draft has none, it is what was given.
        """
        refused = self._priced(self._best)
        self._best, self.converged, self._stalls = self._sure, False, 0
        self._trail.clear()
        self.trust = max(self.trust, 4 * _SMALLEST)
        self._return_to(refused)
        bounds = [0, *refused.line.events.tolist()]
        slipped: list[Violations] = []
        for violation in report.violations:
            who = self._guilty(violation, refused.arrangement)
            if who and violation.kind == "collision":
                s, t, depth = violation.segment or 0, violation.fraction or 0.0, violation.value or 0.0
                lo = min(bounds[s] + (violation.step or 0), refused.line.knots - 2)
                self.collisions.demand(who, lo, t, s, depth)
                where = Samples(np.array([lo]), np.array([t]), np.array([s]))
                slipped.append(Violations(who, where, np.array([depth])))
            elif self.slide:
                # Not a matter of clearance: leave transitions as they were.
                self._fix()
                return
        mended = self._mended(refused, slipped) if slipped else None
        if mended is not None:
            self._best = self._now = mended

    def _guilty(self, violation: Violation, arrangement: Arrangement) -> Who:
        held = arrangement.modes[violation.segment or 0].held
        robots, _ = violation.guilty({a.object: r for r, a in held.items()}, self.worlds)
        return tuple(r for r in self.worlds if r in robots)

    def _fix(self) -> None:
        """Start again from the last confirmed iterate with transitions that stay as they are."""
        self.slide = False
        self.choices = self._sure.arrangement.frozen()
        self.collisions.forget()
        self._sure = self._iterate(self._sure.line, self._sure.q, self.choices.at(self.choices.start))
        self._best = self._now = self._sure
        self._rows = None
        self._adopt(self._now)

    def _return_to(self, iterate: Iterate) -> None:
        """Go on from an earlier iterate."""
        if iterate.line is not self._now.line:
            # What violations taught is about steps of the other polyline.
            self.collisions.forget()
        self._now, self._rows, self._stride = iterate, None, np.inf
        self._adopt(iterate)

    @property
    def stuck(self) -> bool:
        """Whether a draft has not come out of collision and does not get any further."""
        depths = self._depths[-_LINGER:]
        lodged = len(depths) == _LINGER and min(depths) > _LODGED
        return np.isinf(self.cost) and lodged and depths[-1] > _YIELDS * max(depths)

    # -- one step ---------------------------------------------------------------------------------------------------

    def step(self) -> float:
        """Solve one conic program; returns by how much the cost of the best iterate went down."""
        if self.converged or self._now.line.knots < 2:
            self.converged = True
            return 0.0
        now = self._now
        if self._rows is None:
            self._rows = self.collisions.rows(now.line, now.q, now.arrangement)
        self.steps += 1
        solved = self._solve(now, self._rows, self.trust)
        if solved is None:
            return self._reject()
        stride = float(np.abs(solved.q - now.q).max(initial=0.0))
        demands = self.collisions.demands
        before = self._merit(now, self._rows)
        tolerance = self.problem.collision.tolerance
        enough = max(_DEEP, self._rows.deepest(tolerance))
        candidate, rows, u = self._looked_at(solved)
        too_deep = self._too_deep(candidate, rows, enough, before)
        if too_deep and np.isfinite(self.cost):
            # Drafts that have to be pulled apart do better with smaller steps everywhere.
            self.collisions.demands = demands
            deep = u[rows.knots_beyond(tolerance + _HOLD, candidate.q.shape)].astype(float)
            held_back = self._held_back(now, solved, deep)
            if held_back is not None:
                candidate, rows, _ = self._looked_at(held_back)
                too_deep = self._too_deep(candidate, rows, enough, before)
        if too_deep:
            self._depths.append(self._rows.deepest(tolerance))
            self.collisions.demands = demands
            return self._reject()
        self._stride = stride
        deepest = rows.deepest(tolerance)
        where = (candidate.line, candidate.q, candidate.arrangement)
        self._depths.append(deepest)
        self._now = candidate
        if candidate.line is not now.line:
            self._adopt(candidate)
        # What is far from being worth it is not looked at between its samples.
        looked = candidate.cost < _WITHIN_SIGHT * self.to_beat
        violations = self._violations(candidate, rows.clearance) if looked and deepest < _SHALLOW else []
        clean = looked and deepest < _SHALLOW and not violations
        if violations:
            rows = rows.joined(self.collisions.more(*where, self.collisions.learn(violations)))
        falling = candidate.cost < (1 - _GAINING) * now.cost
        gaining = falling and np.isfinite(self.cost)
        settled = candidate.cost >= (1 - _SETTLED) * now.cost
        mended = self._mended(candidate, violations) if violations and settled else None
        if mended is None:
            after = self._merit(candidate, rows)
        else:
            self._now, clean = mended, True
            # What can be mended has to keep hardly any distance before, nowhere.
            self.collisions.forget()
            self.collisions.margin = CLEARANCE
            rows = self.collisions.rows(mended.line, mended.q, mended.arrangement)
            before, after = self._best.cost if np.isfinite(self.cost) else now.cost, mended.cost
        candidate = self._now
        self._rows, self._worth = rows, after
        gain = 0.0
        if clean and candidate.cost < self._best.cost - _EPS:
            gain = self._best.cost - candidate.cost
            self._best = candidate
        if looked:
            self._clear_up(clean)
        self._pace(before, after, self._promise + self._changes, clean or not looked, gaining)
        return gain

    def finish(self) -> None:
        """No more steps come: what they have led to is mended, if it is cheaper than the best and grazes something."""
        x, best = self._now, min(self._best.cost, self.to_beat)
        if self.stuck or self._rows is None or x.cost >= (1 - worth(self.collisions.level)) * best:
            return
        violations = self._violations(x, self._rows.clearance)
        mended = self._mended(x, violations) if violations else None
        if mended is not None:
            self._best = self._now = mended
            self._rows = None

    def _mended(self, x: Iterate, violations: Sequence[Violations]) -> Iterate | None:
        return self.mending.attempt(x, violations, min(self._best.cost, self.to_beat), self.collisions.level)

    def _looked_at(self, solved: Iterate) -> tuple[Iterate, CollisionRows, np.ndarray]:
        """What a program leads to, its knots spread evenly where steps have become too long; its collision rows, and
        where its knots (K,) were before."""
        candidate, u = self._resampled(solved) if self._stretched(solved) else (solved, np.arange(solved.line.knots))
        return candidate, self.collisions.rows(candidate.line, candidate.q, candidate.arrangement), u

    def _too_deep(self, x: Iterate, rows: CollisionRows, enough: float, before: float) -> bool:
        """Whether an iterate collides more than is worth following, for all that a draft gains."""
        tolerance = self.problem.collision.tolerance
        deep = rows.deepest(tolerance) > enough or (np.isfinite(self.cost) and rows.lost(tolerance))
        return deep and not (np.isinf(self.cost) and self._merit(x, rows) < before)

    def _held_back(self, now: Iterate, solved: Iterate, deep: np.ndarray) -> Iterate | None:
        """The step with less of it near knots (M,) that would be deep in collision; None where it cannot be had."""
        away = np.abs(np.arange(now.line.knots)[:, None] - deep).min(axis=1, initial=np.inf)
        share = np.clip(_HELD + (1 - _HELD) * (away - 1) / _RAMP, _HELD, 1.0)
        q = self._clipped(now.q + share[:, None] * (solved.q - now.q))
        projected = self._closure.project(q, solved.arrangement)
        return None if projected is None else self._iterate(now.line, self._clipped(projected), solved.arrangement)

    def _pace(self, before: float, after: float, promised: float, clean: bool, gaining: bool) -> None:
        """Adapt the trust region to how much of the promised gain came true; `gaining`: the cost itself still falls."""
        share = (before - after) / max(before - promised, 1e-9)
        if share > _TRUE:
            self.trust = min(1.3 * self.trust, _LARGEST)
        elif share < _FALSE:
            # What is missing only at samples between those of the program needs rows, not smaller steps.
            least = _STRIDE * self._first_trust if gaining else 0.0 if clean else 4 * _SMALLEST
            self.trust = max(0.5 * self.trust, min(self.trust, least))
        still = not gaining and (before - promised < _STALL * before or share < _FALSE)
        self._stalls = 0 if not still else self._stalls + (2 if clean else 1)
        self._settle(self.trust < _SMALLEST or self._stalls >= _PATIENCE)

    def _clear_up(self, clean: bool) -> None:
        """When cheaper iterates keep grazing something between samples, ask for more clearance until one does not."""
        self._grazing = 0 if clean else self._grazing + 1
        promising = self._now.cost < (1 - _WORTH_CLEARING) * self._best.cost
        pad = _PADS[min(self._grazing // _GRAZES, len(_PADS) - 1)] if promising else 0.0
        self._ask_for(pad)

    def _ask_for(self, pad: float) -> None:
        """Clearance (m) that is asked for everywhere, on top of what is asked for in any case."""
        pad += self.clearance
        if self._rows is not None:
            self._rows = self._rows.stricter(pad - self.collisions.pad)
        self.collisions.pad = pad

    def _settle(self, done: bool) -> None:
        """Where the polyline has converged, go on with finer steps beside its bends."""
        level = self.collisions.level
        self._trail.append(self._best.cost + self._worth)
        if len(self._trail) > _WINDOW:
            first, last = self._trail[-_WINDOW - 1], self._trail[-1]
            done = done or first - last < worth(level) * last
        if done and level < self.levels:
            self.collisions.level += 1
            self.collisions.forget()
            self._stalls, self.trust = 0, self._first_trust / 2**self.collisions.level
            self._trail.clear()
            self._return_to(self._best)
            self._resample()
        elif done and self._now.cost < (1 - _WORTH_CLEARING) * self._best.cost and self._last_chances:
            # What has converged still grazes something: it must come free to count.
            self._last_chances -= 1
            self._stalls, self.trust = 0, max(self.trust, 4 * _SMALLEST)
            self._ask_for(_PADS[-1])
        else:
            self.converged = done

    def _reject(self) -> float:
        self.trust *= 0.5
        self._stride = np.inf
        self._settle(self.trust < _SMALLEST)
        return 0.0

    def _violations(
        self, x: Iterate, clearance: Mapping[Who, np.ndarray], thoroughly: bool = False
    ) -> list[Violations]:
        """Samples in collision; what may become the best is looked at four times as closely.

        `thoroughly`: even where the first look has found some.
        """
        where = x.line, x.q, x.arrangement, clearance
        found = self.fine.violations(*where)
        if x.cost >= self._best.cost - _EPS or (found and not thoroughly):
            return found
        return found + self.fine.violations(*where, between=True)

    def _merit(self, x: Iterate, rows: CollisionRows) -> float:
        return x.cost + PENALTY * float(np.maximum(-rows.gap, 0.0).sum())

    def _solve(self, now: Iterate, rows: CollisionRows, trust: float) -> Iterate | None:
        E, size = self._reduction.E, now.q.size
        n, count = E.shape[1], self.choices.count
        scale = self.choices.scale
        whole = sparse.csr_array(sparse.block_diag([E, sparse.diags_array(scale)])) if count else E
        lower, upper = self._box(now, trust)
        equal = self._stacked(self._closure.equalities(now.q, now.arrangement), n + count)[0]
        F, g = self._stacked(self._closure.inequalities(now.q, now.arrangement), n + count)
        A, gap = sparse.csr_array(rows.A @ whole), rows.gap

        def solution(used: np.ndarray) -> tuple[np.ndarray, float] | None:
            linear = Linearised(sparse.csr_array(A[used]), -gap[used], equal, F, g, lower, upper)
            return solve(self._reduction, now.q, self.weights, linear, self.collisions.level)

        near = gap < max(_LEAST, _AHEAD * self._stride)
        solved = solution(near)
        if solved is not None and np.any(gap[~near] + A[~near] @ solved[0] < -_MISSED):
            solved = solution(np.ones(len(gap), dtype=bool))
        if solved is None:
            return None
        x, self._promise = solved
        q = now.q + (E @ x[:n]).reshape(now.q.shape)
        c = np.clip(now.arrangement.c + scale * x[n:], *self.choices.bounds) if count else now.arrangement.c
        assert q.size == size
        arrangement = self.choices.at(c) if count else now.arrangement
        projected = self._closure.project(self._clipped(q), arrangement)
        return None if projected is None else self._iterate(now.line, self._clipped(projected), arrangement)

    def _box(self, now: Iterate, trust: float) -> tuple[np.ndarray, np.ndarray]:
        """Trust region, joint limits and bounds of coordinates."""
        low, high = self._limits
        at = now.q[self._reduction.knot, self._reduction.column]
        column = self._reduction.column
        lower = np.clip(low[column] - at, -trust, 0.0)
        upper = np.clip(high[column] - at, 0.0, trust)
        if not self.choices.count:
            return lower, upper
        least, most = self.choices.bounds
        c, scale = now.arrangement.c, self.choices.scale
        return (
            np.concatenate([lower, np.clip((least - c) / scale, -trust, 0.0)]),
            np.concatenate([upper, np.clip((most - c) / scale, 0.0, trust)]),
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

    # -- bookkeeping ------------------------------------------------------------------------------------------------

    def _iterate(self, line: Polyline, q: np.ndarray, arrangement: Arrangement) -> Iterate:
        lengths = line.lengths(q)
        if not lengths.size:
            return Iterate(line, q, arrangement, self._changes)
        motion = self.weights.makespan * lengths.max(axis=0).sum() + self.weights.path_length * lengths.sum()
        return Iterate(line, q, arrangement, float(motion) + self._changes)

    def _priced(self, x: Iterate) -> Iterate:
        """An iterate with what it costs, also where it does not count since it is a draft."""
        return self._iterate(x.line, x.q, x.arrangement) if np.isinf(x.cost) else x

    def _clipped(self, q: np.ndarray) -> np.ndarray:
        return np.clip(q, *self._limits)

    @property
    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        chains = [self.worlds[r].chain for r in self._now.line.columns]
        return np.concatenate([c.lower for c in chains]), np.concatenate([c.upper for c in chains])

    def _stretched(self, x: Iterate) -> bool:
        """Whether steps have become too long."""
        return bool(x.line.lengths(x.q).max(initial=0.0) > 1.4 * self.knot)

    def _resampled(self, x: Iterate) -> tuple[Iterate, np.ndarray]:
        """An iterate with its knots spread evenly again, and where they were before (K,); demands move along."""
        line = Polyline(x.line.columns, x.q, x.line.events, x.line.stretches)
        u = line.resampled(self.knot, self.collisions.level)
        fresh = line.at(u)
        self.collisions.move(u)
        return self._iterate(fresh, fresh.q, x.arrangement), u

    def _resample(self) -> None:
        """Spread the knots of the current iterate evenly again."""
        self._now, self._rows = self._resampled(self._now)[0], None
        self._adopt(self._now)

    def _adopt(self, x: Iterate) -> None:
        """Variables and closure rows for a new set of knots."""
        self._pinned = pins(self.problem, x.line, x.arrangement.transitions, self.slide, self.fixed_end)
        self._reduction: Reduction = reduce(x.line, self._pinned)
        self._closure = Closure(self.problem, self.worlds, x.line, x.q, self._pinned)
