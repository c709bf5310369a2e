"""Which solids are near each other at samples of a motion, and how their distances change (DESIGN section 8).

Boxes, capsules and spheres of the planner's small plants are measured all at once, other shapes by Drake; so are the
gradients.  Everything that moves, moves by screws: a distance d = n.(p_A - p_B) changes by W.(V_A - V_B) with
the wrench W = (p x n, n) and the spatial velocities V = (omega, v at the world's origin) of the two bodies.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from pydrake.geometry import GeometryId, QueryObject, SignedDistancePair
from pydrake.systems.framework import Context

from mrtamp.collision import Collision
from mrtamp.kinematics import Chain, matrix
from mrtamp.modes import Attachment, Mode
from mrtamp.optimise.choices import Arrangement
from mrtamp.optimise.screws import cross, screws_of, transported, upstream
from mrtamp.optimise.shapes import Poses, Shapes
from mrtamp.scene import Scene, chain_of, geometry_ids, robot_bodies

_ROUNDING = 1e-6
"""Error (m^2) of squared distances for which nothing that is near may be missed."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Instants of a composite polyline: between knots `lo` and `lo + 1` (S,) at fraction t (S,), in segment (S,)."""

    lo: np.ndarray
    t: np.ndarray
    segment: np.ndarray

    @classmethod
    def none(cls) -> Samples:
        """No samples."""
        return cls(np.zeros(0, dtype=int), np.zeros(0), np.zeros(0, dtype=int))

    def __len__(self) -> int:
        return len(self.lo)

    def __getitem__(self, index: np.ndarray) -> Samples:
        return Samples(self.lo[index], self.t[index], self.segment[index])

    def at(self, q: np.ndarray) -> np.ndarray:
        """Configurations (S, n) on knots q (K, n)."""
        high = np.minimum(self.lo + 1, len(q) - 1)
        # Exact at knots and for whoever stands, so that equal configurations are equal to the last bit.
        return q[self.lo] + self.t[:, None] * (q[high] - q[self.lo])

    def joined(self, other: Samples) -> Samples:
        """These and others."""
        return Samples(*(np.concatenate([x, y]) for x, y in zip(self._parts(), other._parts(), strict=True)))

    def _parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.lo, self.t, self.segment


@dataclass(frozen=True, eq=False)
class Near:
    """Pairs of solids near each other: at `sample` (P,), `distance` (P,), wrench (P, 6), carriers `a`, `b` (P,).

    Distances are those of the shapes as they are, without padding.
    """

    sample: np.ndarray
    distance: np.ndarray
    wrench: np.ndarray
    a: np.ndarray
    b: np.ndarray

    def of(self, index: np.ndarray) -> Near:
        """Some of the pairs."""
        return Near(*(x[index] for x in vars(self).values()))


class Situations(Protocol):
    """What is held and what rests where, by the numbers of segments."""

    @property
    def modes(self) -> Sequence[Mode]:
        """Mode by segment."""

    def resting(self, mode: Mode) -> Mapping[str, np.ndarray]:
        """World poses (4, 4) of the objects that rest in one of the modes."""


class Carriers:
    """Numbers for what carries a solid: a link of a robot, a robot's grasp, an object at rest, a static body."""

    def __init__(self, collision: Collision) -> None:
        self.number: dict[Hashable, int] = {}
        problem = collision.problem
        for static in problem.statics:
            self._add(("static", static.name))
        for item in problem.objects:
            self._add(("object", item.name))
        for name, world in collision.worlds.items():
            self._add(("held", name))
            for body in world.chain.bodies:
                self._add(("link", name, body))
        self.moves: dict[str, np.ndarray] = {}
        """Robot -> which joints (columns) move which carrier (rows), 0 or 1."""
        for name, world in collision.worlds.items():
            table = np.zeros((len(self.number), world.chain.n))
            masks = upstream(world.chain)
            for body, mask in masks.items():
                table[self.number["link", name, body]] = mask
            table[self.number["held", name]] = masks[problem.robot(name).model.grasp_body]
            self.moves[name] = table

    def _add(self, key: Hashable) -> None:
        self.number[key] = len(self.number)

    def of_geometries(self, scene: Scene) -> dict:
        """Geometry id -> carrier number in a plant of robot worlds or pairs."""
        plant = scene.plant
        out = {}
        for name, in_scene in scene.robots.items():
            for body in robot_bodies(plant, in_scene):
                key = ("link", name, body.name())
                out.update(dict.fromkeys(geometry_ids(plant, [body]), self.number.get(key, -1)))
        for name, bodies in scene.statics.items():
            out.update(dict.fromkeys(geometry_ids(plant, bodies), self.number["static", name]))
        for name, bodies in scene.free_bodies.items():
            prefix = name.split(":", 1)[0]
            holder = prefix if ("held", prefix) in self.number else next(iter(scene.robots))
            number = self.number.get(("object", name), self.number["held", holder])
            out.update(dict.fromkeys(geometry_ids(plant, bodies), number))
        return out


def _ask(scene: Scene, context: Context, known: _Plant, rows: np.ndarray, reach: float, kept: np.ndarray) -> Near:
    """Drake's nearest pairs with shapes that only it knows, at every row of the samples numbered `kept` (N,)."""
    plant, foreign, carrier = scene.plant, known.shapes.foreign, known.carrier
    port = plant.get_geometry_query_input_port()
    sample, distance, normal, point, a, b = [], [], [], [], [], []
    last, found = None, []
    for i, row in zip(kept.tolist(), rows, strict=True):
        if last is None or not np.array_equal(row, last):
            plant.SetPositions(context, row)
            query = port.Eval(context)
            found = [
                (
                    p.distance + scene.padding(p.id_A, p.id_B),
                    p.nhat_BA_W,
                    query.GetPoseInWorld(p.id_A).multiply(p.p_ACa),
                    carrier[p.id_A],
                    carrier[p.id_B],
                )
                for p in closest_points(query, reach, foreign)
            ]
            last = row
        for d, n, p, x, y in found:
            sample.append(i)
            distance.append(d)
            normal.append(n)
            point.append(p)
            a.append(x)
            b.append(y)
    n, p = np.array(normal).reshape(-1, 3), np.array(point).reshape(-1, 3)
    wrench = np.concatenate([cross(p, n), n], axis=1)
    i, j, k = (np.array(x, dtype=int) for x in (sample, a, b))
    return Near(i, np.array(distance), wrench, j, k)


def closest_points(query: QueryObject, reach: float, of: Set[GeometryId]) -> list[SignedDistancePair]:
    """Drake's nearest points of all pairs within `reach` (m) one of which is among `of`.

    Drake's search for a distance does not always converge.  It then says nothing about any pair, and each is asked for
    alone; those about which there is nothing to learn are left out.
    """
    try:
        found = query.ComputeSignedDistancePairwiseClosestPoints(reach)
    except RuntimeError:
        found = []
        for a, b in query.inspector().GetCollisionCandidates():
            if a in of or b in of:
                with suppress(RuntimeError):
                    found.append(query.ComputeSignedDistancePairClosestPoints(a, b))
    return [p for p in found if (p.id_A in of or p.id_B in of) and p.distance <= reach]


@dataclass(frozen=True, eq=False)
class State:
    """A robot at samples: configurations x (S, n), bounding spheres with its load, screws (S, n, 6) of its joints, and
    poses of its bodies (S, B) and of its load (S,), not a number where there is none."""

    x: np.ndarray
    centres: np.ndarray
    radii: np.ndarray
    screws: np.ndarray
    R: np.ndarray
    p: np.ndarray
    R_load: np.ndarray
    p_load: np.ndarray

    def joined(self, other: State) -> State:
        """At these samples and others."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return State(*(np.concatenate(pair) for pair in pairs))

    def of(self, index: np.ndarray) -> State:
        """At some of the samples."""
        return State(*(x[index] for x in vars(self).values()))


def _nowhere(n: int) -> Poses:
    return np.zeros((n, 3, 3)), np.full((n, 3), np.nan)


def _resting(poses: Sequence[Mapping[str, np.ndarray]], which: np.ndarray) -> dict[str, Poses]:
    """Poses of objects at samples (S,), from world poses (4, 4) in situations, the number of which is `which` (S,)."""
    out = {}
    [absent] = matrix(*_nowhere(1))
    for name in dict.fromkeys(name for x in poses for name in x):
        X = np.array([x.get(name, absent) for x in poses])[which]
        out[name] = X[:, :3, :3], X[:, :3, 3]
    return out


@dataclass(frozen=True, eq=False)
class _Plant:
    """One of the planner's plants: its shapes, and what carries each of its geometries, by id and by index (G,)."""

    shapes: Shapes
    carrier: dict
    number: np.ndarray

    def near(
        self, n: int, robots: Mapping[str, State], free: Mapping[str, Poses], reach: float
    ) -> tuple[Near, np.ndarray]:
        """What is near at n samples, and samples at which Drake has to be asked as well."""
        poses = self.shapes.placed(n, {r: (x.R, x.p) for r, x in robots.items()}, free)
        found = self.shapes.near(poses, reach)
        wrench = np.concatenate([cross(found.witness, found.normal), found.normal], axis=1)
        near = Near(found.sample, found.distance, wrench, self.number[found.a], self.number[found.b])
        return near, self.shapes.unsettled(poses, reach)


class Nearness:
    """Asks the planner's plants what is near, and turns the answers into gradients."""

    def __init__(self, collision: Collision) -> None:
        self.collision = collision
        self.worlds = collision.worlds
        self.carriers = Carriers(collision)
        self._plants: dict[int, _Plant] = {}
        self._chains: dict[tuple[str, float], Chain] = {}

    def _plant(self, scene: Scene) -> _Plant:
        if id(scene) not in self._plants:
            carrier = self.carriers.of_geometries(scene)
            shapes = Shapes(scene, {r: self.worlds[r].chain.bodies for r in scene.robots})
            number = np.array([carrier[g] for g in shapes.ids], dtype=int)
            self._plants[id(scene)] = _Plant(shapes, carrier, number)
        return self._plants[id(scene)]

    def _chain(self, robot: str, held: Attachment | None) -> Chain:
        """Kinematics of a robot with its hand as far open as what it holds has it."""
        world = self.worlds[robot]
        if held is None or held.width is None:
            return world.chain
        key = robot, held.width
        if key not in self._chains:
            self._chains[key] = chain_of(world.scene, robot, held.width)[0]
        return self._chains[key]

    def state(self, robot: str, q: np.ndarray, samples: Samples, modes: Sequence[Mode]) -> State:
        """A robot with knots q (K, n) at samples of a motion through `modes`."""
        world = self.worlds[robot]
        x = samples.at(q)
        S, B, bounds = len(x), len(world.chain.bodies), world.bounds
        R, p = np.empty((S, B, 3, 3)), np.empty((S, B, 3))
        R_load, p_load = np.full((S, 3, 3), np.nan), np.full((S, 3), np.nan)
        screws = np.empty((S, world.chain.n, 6))
        # The last sphere is around the load; what is not there has no size.
        centres = np.zeros((S, len(bounds.radii) + 1, 3))
        radii = np.tile(np.append(bounds.radii, -1e3), (S, 1))
        of = {s: modes[s].held.get(robot) for s in np.unique(samples.segment).tolist()}
        chains = {s: self._chain(robot, held) for s, held in of.items()}
        for chain in dict.fromkeys(chains.values()):
            i = np.flatnonzero(np.isin(samples.segment, [s for s, c in chains.items() if c is chain]))
            Rs, ps, axes = chain.sweep(x[i])
            R[i], p[i] = np.stack(Rs, axis=1), np.stack(ps, axis=1)
            screws[i] = screws_of(chain, len(i), axes)
            centres[i, :-1] = bounds.placed(Rs, ps)
        R_WG, p_WG = world.tool.carried(R.swapaxes(0, 1), p.swapaxes(0, 1))
        for held in {h for h in of.values() if h is not None}:
            i = np.flatnonzero(np.isin(samples.segment, [s for s, h in of.items() if h == held]))
            R_load[i], p_load[i] = R_WG[i] @ held.X_PO[:3, :3], p_WG[i] + R_WG[i] @ held.X_PO[:3, 3]
            centres[i, -1], radii[i, -1] = p_load[i], world.object_radius[held.object]
        return State(x, centres, radii, screws, R, p, R_load, p_load)

    def rows(
        self,
        robot: str,
        q: np.ndarray,
        held: Attachment | None,
        poses: Mapping[str, np.ndarray],
        spheres: tuple,
        far: float,
    ) -> np.ndarray:
        """Positions of the robot's plant, with those resting objects whose spheres come within `far` (m)."""
        world = self.worlds[robot]
        rows = world.rows(q, held, {})
        for name, X in poses.items():
            gap = np.linalg.norm(spheres[0] - X[:3, 3], axis=2) - spheres[1]
            near = gap.min(axis=1) < world.object_radius[name] + far
            if near.any():
                one = rows[0].copy()
                world.scene.write_pose(one, name, X)
                k = world.scene.floating[name]
                rows[near, k : k + 7] = one[k : k + 7]
        return rows

    def world(self, robot: str, state: State, samples: Samples, arrangement: Situations, reach: float) -> Near:
        """What is within `reach` (m) of a robot and its load: itself, the static world, objects at rest."""
        world = self.worlds[robot]
        known = self._plant(world.scene)
        segments, which = np.unique(samples.segment, return_inverse=True)
        modes = [arrangement.modes[s] for s in segments.tolist()]
        free = _resting([arrangement.resting(mode) for mode in modes], which)
        for k, mode in enumerate(modes):
            self._carry(free, world.slot_of, mode.held.get(robot), state, np.flatnonzero(which == k))
        near, open_ones = known.near(len(samples), {robot: state}, free, reach)
        parts = [near]
        for s in np.unique(samples.segment[open_ones]).tolist():
            i = open_ones[samples.segment[open_ones] == s]
            mode = arrangement.modes[s]
            spheres = (state.centres[i], state.radii[i])
            rows = self.rows(robot, state.x[i], mode.held.get(robot), arrangement.resting(mode), spheres, reach)
            parts.append(_ask(world.scene, world.context, known, rows, reach, i))
        return _joined(parts)

    def _carry(
        self, free: dict[str, Poses], slot_of: Mapping[str, str], held: Attachment | None, state: State, i: np.ndarray
    ) -> None:
        """The pose of what a robot holds at samples i."""
        if held is not None:
            R, p = free.setdefault(slot_of[held.object], _nowhere(len(state.x)))
            R[i], p[i] = state.R_load[i], state.p_load[i]

    def close(self, spheres: tuple[tuple, tuple], far: float) -> np.ndarray:
        """Samples at which bounding spheres of two robots come within `far` (m)."""
        (ca, ra), (cb, rb) = spheres
        (low_a, high_a), (low_b, high_b) = _extent(ca, ra), _extent(cb, rb)
        maybe = np.flatnonzero(np.all(low_a < high_b + far, axis=0) & np.all(low_b < high_a + far, axis=0))
        if not len(maybe):
            return maybe
        a, b = ca[maybe], cb[maybe]
        square = (a * a).sum(axis=2)[:, :, None] + (b * b).sum(axis=2)[:, None] - 2 * (a @ np.swapaxes(b, 1, 2))
        # The squares of what is far from the origin cost some digits; what is not there has no radius.
        limit = np.maximum(ra[maybe, :, None] + rb[maybe, None] + far, 0.0)
        return maybe[(square < limit**2 + _ROUNDING * (limit > 0)).any(axis=(1, 2))]

    def pair_rows(self, a: str, b: str, qa: np.ndarray, qb: np.ndarray, mode: Mode) -> np.ndarray:
        """Positions of the plant of two robots."""
        pair, swapped = self.collision.pair(a, b)
        one, two = (qa, mode.held.get(a)), (qb, mode.held.get(b))
        return pair.rows(*two, *one) if swapped else pair.rows(*one, *two)

    def between(
        self,
        robots: tuple[str, str],
        states: tuple[State, State],
        samples: Samples,
        arrangement: Situations,
        reach: float,
    ) -> Near:
        """What is within `reach` (m) between two robots and their loads."""
        a, b = states
        close = self.close(((a.centres, a.radii), (b.centres, b.radii)), reach)
        pair, swapped = self.collision.pair(*robots)
        known = self._plant(pair.scene)
        within = samples[close]
        at = {r: x.of(close) for r, x in zip(robots, states, strict=True)}
        free: dict[str, Poses] = {}
        for s in np.unique(within.segment).tolist():
            i = np.flatnonzero(within.segment == s)
            for robot, slot_of in zip(robots, pair.slot_of[::-1] if swapped else pair.slot_of, strict=True):
                self._carry(free, slot_of, arrangement.modes[s].held.get(robot), at[robot], i)
        near, open_ones = known.near(len(close), at, free, reach)
        parts = [replace(near, sample=close[near.sample])]
        for s in np.unique(within.segment[open_ones]).tolist():
            i = close[open_ones[within.segment[open_ones] == s]]
            rows = self.pair_rows(*robots, a.x[i], b.x[i], arrangement.modes[s])
            parts.append(_ask(pair.scene, pair.context, known, rows, reach, i))
        return _joined(parts)

    def touching(self, robot: str, contact: np.ndarray, near: Near) -> np.ndarray:
        """Pairs (P,) of a robot's load and what it may touch: at every sample a name in `contact` (S,), or ''."""
        number = self.carriers.number
        numbers = {"": -2}
        for name in set(contact) - {""}:
            numbers[name] = number.get(("static", name), number.get(("object", name), -2))
        support = np.array([numbers[c] for c in contact], dtype=int)[near.sample]
        held = number["held", robot]
        return ((near.a == held) & (near.b == support)) | ((near.b == held) & (near.a == support))

    def joint_gradient(self, robot: str, state: State, near: Near) -> np.ndarray:
        """Change of the distances (P, n) with the configurations of a robot."""
        table = self.carriers.moves[robot]
        direction = table[near.a] - table[near.b]
        return direction * (state.screws[near.sample] @ near.wrench[:, :, None])[..., 0]

    def choice_gradient(
        self, near: Near, samples: Samples, states: Mapping[str, State], arrangement: Arrangement
    ) -> np.ndarray:
        """Change of the distances (P, count) with all coordinates."""
        out = np.zeros((len(near.distance), len(arrangement.c)))
        if not out.size:
            return out
        segment = samples.segment[near.sample]
        number = self.carriers.number
        for s in np.unique(segment).tolist():
            mode = arrangement.modes[s]
            here = segment == s
            for a in mode.attachments:
                key = ("held", a.parent) if a.held else ("object", a.object)
                if a.held and a.parent not in states:
                    continue
                sign = (near.a == number[key]).astype(float) - (near.b == number[key])
                rows = np.flatnonzero(here & (sign != 0))
                if not len(rows):
                    continue
                if a.held:
                    slide = arrangement.slide(a)
                    if slide is None:
                        continue
                    X_WG = self.worlds[a.parent].tool.matrix(states[a.parent].x[near.sample[rows]])
                    moved = [(slide.columns, transported(arrangement.own_screws(a), X_WG))]
                else:
                    moved = arrangement.world_screws(mode.chain(a.object))
                for columns, screws in moved:
                    change = (screws @ near.wrench[rows][:, :, None])[..., 0]
                    out[rows, columns] += sign[rows, None] * change
        return out


def _extent(centres: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest coordinates (3, S) of spheres at samples: centres (S, K, 3), radii (S, K)."""
    # Reductions over rows of many samples take far less time than over a few spheres each.
    c, r = np.ascontiguousarray(centres.T), np.maximum(radii.T, 0.0)
    return (c - r).min(axis=1), (c + r).max(axis=1)


def _joined(parts: Sequence[Near]) -> Near:
    return Near(*(np.concatenate(x) for x in zip(*(vars(p).values() for p in parts), strict=True)))
