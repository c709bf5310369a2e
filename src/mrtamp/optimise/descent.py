"""Shortening whole ways: their stops slide along their strata until what robots travel is shortest.

Samples alone hardly come near a short way: a pick, a handover and a place have some thirty dimensions together.  Each
step of the descent is one small quadratic program per way, all solved in one batch: the squares of the motions, weighed
so that their sum falls as that of their lengths does, subject to h_A = 0 linearised, with grasps and placements as
coordinates, bounds, and clearance between two robots that meet.  After each step IK puts every stop back onto its
stratum, and a step after which a way is no shorter is taken back and tried again shorter.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mrtamp.kinematics import inverse, rotation_vectors
from mrtamp.modes import Attachment, Mode
from mrtamp.optimise.nearness import Nearness, Samples, State
from mrtamp.optimise.screws import cross, transported
from mrtamp.transitions.families import Family, FixedFamily, placement_families, residual
from mrtamp.transitions.sampler import TransitionSampler
from mrtamp.transitions.ways import Way

_STEPS = 6
_LARGEST = 0.4
"""Largest change (rad) of a joint per step."""
_WIDER, _NARROWER = 1.5, 0.3
"""By how much larger or smaller steps become after one that led down, or did not."""
_STILL = 0.01
"""Gain (rad) of a step below which it hardly matters; two such steps of all ways end the descent."""
_EARLIER = (3, 1)
"""Steps after which ways are kept as well, for where the last one is not free of collision."""
_CORRECTIONS = 8
"""Iterations of IK after every step."""
_APART = 50.0
"""Weight of what robots that meet lack of clearance (m) against length (rad)."""
_ACTIVE = 3
"""Rounds in which bounds and clearances that a step would violate are added to its program."""
_SHORT = 0.05
"""Motions (rad) shorter than this are weighed as if they were that long."""
_DAMPING, _COORDINATES = 0.1, 16.0
"""Damping of the programs, and that of grasps and placements relative to that of joints."""
_CLEARANCE, _REACH = 2e-3, 0.05
"""Clearance (m) between robots that meet, and distance within which they are looked at."""
_STIFF = 1e6
"""Weight of what is at a bound or too close."""
_ON_FAMILY = 1e-5
"""Largest residual (rad, m) of an attachment that belongs to a family."""
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What a robot does before and after each of N ways.

    It comes from configurations `before` (N, n) and goes to `after` (N, n), not a number where that may be anywhere.
    `weight` (N, m + 1) is what each of its motions to, between and from its m stops counts.
    """

    before: np.ndarray
    after: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True, eq=False)
class Shortened:
    """What became of one way: stop -> robot -> configuration, and the attachments after every stop."""

    q: tuple[Mapping[str, np.ndarray], ...]
    after: tuple[Attachment, ...]


class _Coordinates:
    """Coordinates (N, k) of one attachment of each of N ways, in the families that these belong to.

    `columns` are theirs among all variables; k is that of the largest family, and coordinates that a family lacks are
    fixed.  An attachment that belongs to none has no freedom.
    """

    def __init__(self, attachments: Sequence[Attachment], families: Sequence[Family], first: int) -> None:
        self.held = attachments[0].held
        self.attachments = attachments
        given = np.array([a.X_PO for a in attachments])
        X = inverse(given) if self.held else given
        widths = np.array([np.nan if a.width is None else a.width for a in attachments])
        self.which = np.full(len(X), -1)
        for k, family in enumerate(families):
            width = getattr(family, "width", None)
            fits = np.abs(residual(family, X)).max(axis=1) <= _ON_FAMILY
            fits &= np.ones(len(X), dtype=bool) if width is None else np.abs(widths - width) < 1e-6
            c = family.coordinates(X)
            fits &= np.all((c >= family.lower - 1e-6) & (c <= family.upper + 1e-6), axis=1)
            self.which[fits & (self.which < 0)] = k
        self.families = families
        k = max((len(families[i].lower) for i in set(self.which.tolist()) if i >= 0), default=0)
        self.start, self.lower, self.upper = (np.zeros((len(X), k)) for _ in range(3))
        self._fixed = given
        for family, rows in self._by_family():
            own = slice(0, len(family.lower))
            self.start[rows, own] = np.clip(family.coordinates(X[rows]), family.lower, family.upper)
            self.lower[rows, own], self.upper[rows, own] = family.lower, family.upper
        self.columns = slice(first, first + k)

    def _by_family(self) -> list[tuple[Family, np.ndarray]]:
        found = [(f, np.flatnonzero(self.which == i)) for i, f in enumerate(self.families)]
        return [(f, rows) for f, rows in found if len(rows) and not isinstance(f, FixedFamily)]

    def poses(self, x: np.ndarray) -> np.ndarray:
        """X_PO (N, 4, 4) at variables x (N, n); for a grasp the parent frame is G."""
        return self._poses(x[:, self.columns])

    def _poses(self, c: np.ndarray) -> np.ndarray:
        X = self._fixed.copy()
        for family, rows in self._by_family():
            member = family.pose(c[rows, : len(family.lower)])
            X[rows] = inverse(member) if self.held else member
        return X

    def screws(self, x: np.ndarray) -> np.ndarray:
        """Velocity of the object per unit of each coordinate (N, k, 6): angular, and linear at P's origin, in P."""
        c = x[:, self.columns]
        out = np.zeros((*c.shape, 6))
        for j, step in enumerate(_STEP * np.eye(c.shape[1])):
            X, Y = self._poses(c + step), self._poses(c - step)
            omega = rotation_vectors(X[:, :3, :3] @ np.swapaxes(Y[:, :3, :3], 1, 2)) / (2 * _STEP)
            middle, velocity = (X[:, :3, 3] + Y[:, :3, 3]) / 2, (X[:, :3, 3] - Y[:, :3, 3]) / (2 * _STEP)
            out[:, j] = np.concatenate([omega, velocity - cross(omega, middle)], axis=1)
        return out

    def attachment(self, way: int, x: np.ndarray, X_PO: np.ndarray) -> Attachment:
        """That of one way at its variables x (n,): the very same one where it has not changed."""
        a = self.attachments[way]
        if np.array_equal(x[self.columns], self.start[way]):
            return a
        return Attachment(a.object, a.parent, X_PO, a.support, a.width)


class Descent:
    """Shortens ways of one object by the same robots, in batches.

    Parameters
    ----------
    sampler : of the scene.
    nearness : measures how far robots that meet are from each other.
    """

    def __init__(self, sampler: TransitionSampler, nearness: Nearness) -> None:
        self.sampler = sampler
        self.nearness = nearness

    def shorten(
        self,
        mode: Mode,
        ways: Sequence[Way],
        bases: Mapping[str, np.ndarray],
        fixed: bool,
        around: Mapping[str, Surroundings] | None = None,
    ) -> tuple[np.ndarray, list[list[Shortened]]]:
        """How long every way becomes (N,), and the stages of its descent, the shortest first.

        Parameters
        ----------
        mode : in which the object is where the ways pick it up.
        bases : poses X_WB (4, 4) of bodies that the object is put on and that are no static ones.
        fixed : whether where the object is put must not change.
        around : robot -> where it comes from and goes to; default: home, all motions counting the same.
        """
        programs = _Programs(self.sampler, self.nearness, mode, ways, bases, fixed, around or {})
        at = programs.linearise(programs.start)
        stages: list[np.ndarray] = []
        limit = np.full(len(ways), _LARGEST)
        gaining = [np.ones(len(ways), dtype=bool)]
        while len(stages) < _STEPS and np.any(gaining[-2:]):
            x, on = programs.project(programs.step(at, limit))
            tried = programs.linearise(x)
            better = on & (tried.merit < at.merit)
            gaining.append(better & (tried.merit < at.merit - _STILL))
            limit = np.where(gaining[-1], np.minimum(_WIDER * limit, _LARGEST), _NARROWER * limit)
            at = tried.where(better, at)
            stages.append(at.x)
        last = len(stages) - 1
        found = [programs.ways(stages[k]) for k in dict.fromkeys((last, *(k for k in _EARLIER if k < last)))]
        return at.merit, [list(x) for x in zip(*found, strict=True)]


@dataclass(frozen=True, eq=False)
class _Linear:
    """The programs at variables x (N, n): gradient (N, n) and Hessian (N, n, n) of the objective, closure A dx = b, and
    clearance G dx >= gap with rows (P,) of the ways `way`.  `merit` (N,) weighs length and what is violated."""

    x: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray
    A: np.ndarray
    b: np.ndarray
    way: np.ndarray
    G: np.ndarray
    gap: np.ndarray
    merit: np.ndarray

    def where(self, mask: np.ndarray, other: _Linear) -> _Linear:
        """These programs where `mask` (N,) holds, the other ones elsewhere."""
        own, others = mask[self.way], ~mask[other.way]
        rows = (np.concatenate([getattr(self, k)[own], getattr(other, k)[others]]) for k in ("way", "G", "gap"))
        whole = (
            np.where(mask.reshape(-1, *[1] * (getattr(self, k).ndim - 1)), getattr(self, k), getattr(other, k))
            for k in ("x", "gradient", "hessian", "A", "b")
        )
        x, gradient, hessian, A, b = whole
        way, G, gap = rows
        return _Linear(x, gradient, hessian, A, b, way, G, gap, np.where(mask, self.merit, other.merit))


class _Motion(NamedTuple):
    """From columns `a` to columns `b` of the variables; where one is None, that end is at `end` (N, n), or anywhere
    where that is not a number."""

    a: slice | None
    b: slice | None
    end: np.ndarray
    weight: np.ndarray


class _Programs:
    """The quadratic programs of one batch of N ways; the variables x (N, n) are all configurations, then all
    coordinates."""

    def __init__(
        self,
        sampler: TransitionSampler,
        nearness: Nearness,
        mode: Mode,
        ways: Sequence[Way],
        bases: Mapping[str, np.ndarray],
        fixed: bool,
        around: Mapping[str, Surroundings],
    ) -> None:
        self.sampler = sampler
        self.nearness = nearness
        self.worlds = {r: sampler.roadmaps[r].world for s in ways[0].stops for r in s.robots}
        self.stops = [s.robots for s in ways[0].stops]
        self.n_ways = len(ways)
        self.X_WO = sampler.validity.world_pose(mode.chain(_after(ways[0], 0).object))
        self.columns: dict[tuple[int, str], slice] = {}
        at, parts, lower, upper, damping = 0, [], [], [], []
        for k, robots in enumerate(self.stops):
            for r in robots:
                chain = self.worlds[r].chain
                self.columns[k, r] = slice(at, at + chain.n)
                at += chain.n
                parts.append(np.array([w.stops[k].q[r] for w in ways]))
                lower.append(np.tile(chain.lower, (self.n_ways, 1)))
                upper.append(np.tile(chain.upper, (self.n_ways, 1)))
                damping.append(np.full(chain.n, _DAMPING))
        self.n_joints = at
        self.links: list[_Coordinates] = []
        for k, robots in enumerate(self.stops):
            attachments = [_after(w, k) for w in ways]
            c = _Coordinates(attachments, self._families(attachments[0], robots[-1], fixed), at)
            self.links.append(c)
            at = c.columns.stop
            parts.append(c.start)
            lower.append(c.lower)
            upper.append(c.upper)
            damping.append(np.full(c.start.shape[1], _DAMPING * _COORDINATES))
        self.start = np.concatenate(parts, axis=1)
        self.lower, self.upper = np.concatenate(lower, axis=1), np.concatenate(upper, axis=1)
        self.damping = np.concatenate(damping)
        X_WB = sampler.validity.X_WB
        self.X_WB = np.array([{**X_WB, **bases}[_after(w, -1).parent] for w in ways])
        self.legs = self._legs(around)

    def _families(self, a: Attachment, robot: str, fixed: bool) -> list[Family]:
        if a.held:
            return list(self.sampler.families[robot, a.object])
        if fixed:
            return []
        problem = self.sampler.problem
        supports = [s for s in self.sampler.goal_supports[a.object] if s.body == a.parent]
        item = problem.object(a.object)
        return [f for s in supports for f in placement_families(item, s, problem.package_paths)]

    def _legs(self, around: Mapping[str, Surroundings]) -> list[_Motion]:
        """The motions of every robot to, between and from its stops."""
        out: list[_Motion] = []
        for r, world in self.worlds.items():
            own = [self.columns[k, r] for k, robots in enumerate(self.stops) if r in robots]
            home = np.tile(world.home, (self.n_ways, 1))
            own_around = around.get(r, Surroundings(home, home, np.ones((self.n_ways, len(own) + 1))))
            stops = [None, *own, None]
            for k, (a, b) in enumerate(itertools.pairwise(stops)):
                end = own_around.before if a is None else own_around.after
                out.append(_Motion(a, b, end, own_around.weight[:, k]))
        return out

    # -- one step -------------------------------------------------------------------------------------------------

    def linearise(self, x: np.ndarray) -> _Linear:
        """The programs at variables x (N, n)."""
        gradient, hessian, length = self._objective(x)
        A, b = self._closure(x)
        way, G, gap = self._clearance(x)
        too_close = np.zeros(len(x))
        np.maximum.at(too_close, way, gap)
        return _Linear(x, gradient, hessian, A, b, way, G, gap, length + _APART * too_close)

    def step(self, at: _Linear, limit: np.ndarray) -> np.ndarray:
        """The solutions of the programs, with no joint changed by more than `limit` (N,)."""
        x, way = at.x, at.way
        n, m = x.shape[1], at.A.shape[1]
        K = np.zeros((len(x), n + m, n + m))
        K[:, :n, :n] = at.hessian
        K[:, :n, n:] = np.swapaxes(at.A, 1, 2)
        K[:, n:, :n] = at.A
        K[:, n:, n:] = -1e-8 * np.eye(m)
        rhs = np.concatenate([-at.gradient, at.b], axis=1)
        pressed = np.zeros(len(way), dtype=bool)
        dx = np.linalg.solve(K, rhs[:, :, None])[:, :n, 0]
        for _ in range(_ACTIVE):
            beyond = (x + dx < self.lower - 1e-9) | (x + dx > self.upper + 1e-9)
            close = ~pressed & ((at.G * dx[way]).sum(axis=1) < at.gap)
            rows = np.unique(np.concatenate([np.flatnonzero(beyond.any(axis=1)), way[close]]))
            if not len(rows):
                break
            i, j = np.nonzero(beyond)
            K[i, j, j] += _STIFF
            rhs[i, j] += _STIFF * (np.clip(x + dx, self.lower, self.upper) - x)[i, j]
            for p in np.flatnonzero(close).tolist():
                K[way[p], :n, :n] += _STIFF * np.outer(at.G[p], at.G[p])
                rhs[way[p], :n] += _STIFF * at.gap[p] * at.G[p]
            pressed |= close
            dx[rows] = np.linalg.solve(K[rows], rhs[rows][:, :, None])[:, :n, 0]
        size = np.abs(dx[:, : self.n_joints]).max(axis=1)
        dx *= np.minimum(1.0, limit / np.maximum(size, 1e-12))[:, None]
        return np.clip(x + dx, self.lower, self.upper)

    def _objective(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradient (N, n) and Hessian (N, n, n) of half the squares of the motions, each divided by its length, and the
        sum of the lengths (N,)."""
        total = np.zeros(len(x))
        gradient = np.zeros_like(x)
        hessian = np.tile(np.diag(self.damping), (len(x), 1, 1))
        for a, b, end, importance in self.legs:
            d = (end if b is None else x[:, b]) - (end if a is None else x[:, a])
            d[np.isnan(d[:, 0])] = 0.0
            length = np.linalg.norm(d, axis=1)
            total += importance * length
            weight = importance / np.maximum(length, _SHORT)
            block = weight[:, None, None] * np.eye(d.shape[1])
            for own, other, sign in ((a, b, -1.0), (b, a, 1.0)):
                if own is not None:
                    gradient[:, own] += sign * weight[:, None] * d
                    hessian[:, own, own] += block
                    if other is not None:
                        hessian[:, own, other] -= block
        return gradient, hessian, total

    def _closure(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows A (N, 6 S, n) and what is missing b (N, 6 S): at every stop the object is in one place, held either way.

        Each stop adds three rows of rotation and three of the object's origin.
        """
        A = np.zeros((len(x), 6 * len(self.stops), x.shape[1]))
        b = np.zeros((len(x), 6 * len(self.stops)))
        poses = [c.poses(x) for c in self.links]
        screws = [c.screws(x) for c in self.links]
        for k, robots in enumerate(self.stops):
            rows = slice(6 * k, 6 * k + 6)
            sides: list[np.ndarray] = []
            # What held the object before the stop, and what does after it.
            for number, robot, sign in ((k - 1, robots[0], 1.0), (k, robots[-1], -1.0)):
                if number < 0:
                    sides.append(np.broadcast_to(self.X_WO, poses[0].shape))
                    continue
                link = self.links[number]
                if link.held:
                    own = self.columns[k, robot]
                    R, p, J = self.worlds[robot].tool.jacobian(x[:, own])
                    X_WP = np.zeros_like(poses[number])
                    X_WP[:, :3, :3], X_WP[:, :3, 3], X_WP[:, 3, 3] = R, p, 1.0
                    X = X_WP @ poses[number]
                    arm = np.swapaxes(J, 1, 2)
                    # J is of the velocity at G.
                    shift = cross(arm[..., :3], (X[:, :3, 3] - p)[:, None])
                    moved = np.concatenate([arm[..., :3], arm[..., 3:] + shift], axis=2)
                    A[:, rows, own] += sign * np.swapaxes(moved, 1, 2)
                else:
                    X_WP = self.X_WB
                    X = X_WP @ poses[number]
                if screws[number].shape[1]:
                    turned = transported(screws[number], X_WP)
                    shift = cross(turned[..., :3], X[:, None, :3, 3])
                    moved = np.concatenate([turned[..., :3], turned[..., 3:] + shift], axis=2)
                    A[:, rows, link.columns] += sign * np.swapaxes(moved, 1, 2)
                sides.append(X)
            one, two = sides
            b[:, rows][:, :3] = rotation_vectors(two[:, :3, :3] @ np.swapaxes(one[:, :3, :3], 1, 2))
            b[:, rows][:, 3:] = two[:, :3, 3] - one[:, :3, 3]
        return A, b

    def _clearance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where two robots meet, the object in the first one's hand: ways (P,), gradients G (P, n) of what is between
        them, and what G dx (P,) must exceed."""
        ways, gradients, gaps = [np.zeros(0, dtype=int)], [np.zeros((0, x.shape[1]))], [np.zeros(0)]
        samples = Samples(np.arange(len(x)), np.zeros(len(x)), np.zeros(len(x), dtype=int))
        number = self.nearness.carriers.number
        for k, robots in enumerate(self.stops):
            if len(robots) != 2:
                continue
            link = self.links[k - 1]
            giver, _ = robots
            states = {r: self.nearness.state(r, x[:, self.columns[k, r]], samples, [Mode(())]) for r in robots}
            X_WG = self.worlds[giver].tool.matrix(states[giver].x)
            states[giver] = _holding(states[giver], X_WG @ link.poses(x), self._radius(giver))
            near = self.nearness.between(robots, (states[robots[0]], states[robots[1]]), samples, _Held(link), _REACH)
            G = np.zeros((len(near.sample), x.shape[1]))
            for r in robots:
                G[:, self.columns[k, r]] = self.nearness.joint_gradient(r, states[r], near)
            held = number["held", giver]
            sign = (near.a == held).astype(float) - (near.b == held)
            slid = transported(link.screws(x), X_WG)[near.sample]
            G[:, link.columns] += sign[:, None] * (slid @ near.wrench[:, :, None])[..., 0]
            ways.append(near.sample)
            gradients.append(G)
            gaps.append(_CLEARANCE - near.distance)
        return np.concatenate(ways), np.concatenate(gradients), np.concatenate(gaps)

    def _radius(self, robot: str) -> float:
        return self.worlds[robot].object_radius[self.links[0].attachments[0].object]

    # -- feasibility ----------------------------------------------------------------------------------------------

    def project(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Variables (N, n) with the last robot of every stop brought onto its stratum by IK, and where that worked."""
        poses = [c.poses(x) for c in self.links]
        ok = np.ones(len(x), dtype=bool)
        out = x.copy()
        for k, robots in enumerate(self.stops):
            after, own = self.links[k], self.columns[k, robots[-1]]
            if not after.held:
                X_WO = self.X_WB @ poses[k]
            elif k == 0:
                X_WO = np.broadcast_to(self.X_WO, poses[0].shape)
            else:
                X_WO = self.worlds[robots[0]].tool.matrix(out[:, self.columns[k, robots[0]]]) @ poses[k - 1]
            grasp = poses[k] if after.held else poses[k - 1]
            out[:, own], on = self.sampler.ik(robots[-1], X_WO @ inverse(grasp), x[:, own], _CORRECTIONS)
            ok &= on & (np.abs(out[:, own] - x[:, own]).max(axis=1) <= _LARGEST)
        return out, ok

    def ways(self, x: np.ndarray) -> list[Shortened]:
        """What every way is at variables x (N, n)."""
        poses = [c.poses(x) for c in self.links]
        return [
            Shortened(
                tuple({r: x[i, self.columns[k, r]] for r in robots} for k, robots in enumerate(self.stops)),
                tuple(c.attachment(i, x[i], poses[k][i]) for k, c in enumerate(self.links)),
            )
            for i in range(len(x))
        ]


def _after(way: Way, stop: int) -> Attachment:
    a = way.stops[stop].after
    assert a is not None
    return a


class _Held:
    """A robot holds the object, and nothing else is anywhere."""

    def __init__(self, link: _Coordinates) -> None:
        self.modes = [Mode((link.attachments[0],))]

    def resting(self, mode: Mode) -> Mapping[str, np.ndarray]:
        """No objects."""
        return {}


def _holding(state: State, X_WO: np.ndarray, radius: float) -> State:
    """A robot's state with an object at poses (N, 4, 4) in its hand."""
    centres, radii = state.centres.copy(), state.radii.copy()
    centres[:, -1], radii[:, -1] = X_WO[:, :3, 3], radius
    return replace(state, centres=centres, radii=radii, R_load=X_WO[:, :3, :3], p_load=X_WO[:, :3, 3])
