"""Which solids are near each other at samples of a motion, and how their distances change (DESIGN section 8).

Drake finds the pairs and their witness points in the planner's small plants; the gradients of all of them are then
computed at once.  Everything that moves, moves by screws: a distance d = n.(p_A - p_B) changes by W.(V_A - V_B) with
the wrench W = (p x n, n) and the spatial velocities V = (omega, v at the world's origin) of the two bodies.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from mrtamp.collision import Collision
from mrtamp.modes import Attachment, Mode
from mrtamp.optimise.choices import Arrangement
from mrtamp.optimise.screws import cross, joint_screws, transported, upstream
from mrtamp.scene import Scene, geometry_ids, robot_bodies

CULL = 0.02
"""Clearance (m) of bounding spheres beyond which nothing is asked about two robots, or about an object, in yes or no
queries: padding and more."""


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
    """Pairs of solids near each other: at `sample` (P,), `distance` (P,), wrench (P, 6), carriers `a`, `b` (P,)."""

    sample: np.ndarray
    distance: np.ndarray
    wrench: np.ndarray
    a: np.ndarray
    b: np.ndarray


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


def _ask(
    plant: MultibodyPlant, context: Context, rows: np.ndarray, carrier: dict, reach: float, kept: np.ndarray
) -> Near:
    """Drake's nearest pairs at every row of positions; `kept` (N,) are the numbers of the samples."""
    port = plant.get_geometry_query_input_port()
    sample, distance, normal, point, a, b = [], [], [], [], [], []
    last, found = None, []
    for i, row in zip(kept.tolist(), rows, strict=True):
        if last is None or not np.array_equal(row, last):
            plant.SetPositions(context, row)
            query = port.Eval(context)
            found = [
                (
                    p.distance,
                    p.nhat_BA_W,
                    query.GetPoseInWorld(p.id_A).multiply(p.p_ACa),
                    carrier[p.id_A],
                    carrier[p.id_B],
                )
                for p in query.ComputeSignedDistancePairwiseClosestPoints(reach)
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
    return Near(np.array(sample, dtype=int), np.array(distance), wrench, np.array(a, dtype=int), np.array(b, dtype=int))


@dataclass(frozen=True, eq=False)
class State:
    """A robot at samples: configurations x (S, n), bounding spheres with its load, screws (S, n, 6) of its joints."""

    x: np.ndarray
    centres: np.ndarray
    radii: np.ndarray
    screws: np.ndarray

    def joined(self, other: State) -> State:
        """At these samples and others."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return State(*(np.concatenate(pair) for pair in pairs))


class Nearness:
    """Asks the planner's plants what is near, and turns the answers into gradients."""

    def __init__(self, collision: Collision) -> None:
        self.collision = collision
        self.worlds = collision.worlds
        self.carriers = Carriers(collision)
        self._ids: dict[int, dict] = {}

    def _carrier(self, scene: Scene) -> dict:
        if id(scene) not in self._ids:
            self._ids[id(scene)] = self.carriers.of_geometries(scene)
        return self._ids[id(scene)]

    def spheres(self, robot: str, q: np.ndarray, modes: Sequence[Mode], segment: np.ndarray) -> tuple:
        """Bounding spheres of a robot and what it holds: centres (S, B + 1, 3) and radii (S, B + 1)."""
        world = self.worlds[robot]
        centres = world.bounds.spheres(q)
        load = np.zeros((len(q), 1, 3))
        size = np.full((len(q), 1), -1e3)
        for s in np.unique(segment).tolist():
            held = modes[s].held.get(robot)
            if held is not None:
                rows = np.flatnonzero(segment == s)
                R, p = world.tool.pose(q[rows])
                load[rows, 0] = p + R @ held.X_PO[:3, 3]
                size[rows, 0] = world.object_radius[held.object]
        radii = np.tile(world.bounds.radii, (len(q), 1))
        return np.concatenate([centres, load], axis=1), np.concatenate([radii, size], axis=1)

    def state(self, robot: str, q: np.ndarray, samples: Samples, modes: Sequence[Mode]) -> State:
        """A robot with knots q (K, n) at samples of a motion through `modes`."""
        x = samples.at(q)
        centres, radii = self.spheres(robot, x, modes, samples.segment)
        return State(x, centres, radii, joint_screws(self.worlds[robot].chain, x))

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

    def world(self, robot: str, state: State, samples: Samples, arrangement: Arrangement, reach: float) -> Near:
        """What is within `reach` (m) of a robot and its load: itself, the static world, objects at rest."""
        world = self.worlds[robot]
        parts = []
        for s in np.unique(samples.segment).tolist():
            i = np.flatnonzero(samples.segment == s)
            mode = arrangement.modes[s]
            spheres = (state.centres[i], state.radii[i])
            rows = self.rows(robot, state.x[i], mode.held.get(robot), arrangement.resting(mode), spheres, reach)
            parts.append(_ask(world.scene.plant, world.context, rows, self._carrier(world.scene), reach, i))
        return _joined(parts)

    def close(self, spheres: tuple[tuple, tuple], far: float) -> np.ndarray:
        """Samples at which bounding spheres of two robots come within `far` (m)."""
        (ca, ra), (cb, rb) = spheres
        low_a, high_a = (ca - np.maximum(ra, 0)[..., None]).min(axis=1), (ca + np.maximum(ra, 0)[..., None]).max(axis=1)
        low_b, high_b = (cb - np.maximum(rb, 0)[..., None]).min(axis=1), (cb + np.maximum(rb, 0)[..., None]).max(axis=1)
        maybe = np.flatnonzero(np.all(low_a < high_b + far, axis=1) & np.all(low_b < high_a + far, axis=1))
        if not len(maybe):
            return maybe
        gap = np.linalg.norm(ca[maybe, :, None] - cb[maybe, None], axis=3) - ra[maybe, :, None] - rb[maybe, None]
        return maybe[gap.min(axis=(1, 2)) < far]

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
        arrangement: Arrangement,
        reach: float,
    ) -> Near:
        """What is within `reach` (m) between two robots and their loads."""
        a, b = states
        close = self.close(((a.centres, a.radii), (b.centres, b.radii)), reach)
        pair, _ = self.collision.pair(*robots)
        parts = []
        for s in np.unique(samples.segment[close]).tolist():
            i = close[samples.segment[close] == s]
            rows = self.pair_rows(*robots, a.x[i], b.x[i], arrangement.modes[s])
            parts.append(_ask(pair.scene.plant, pair.context, rows, self._carrier(pair.scene), reach, i))
        return _joined(parts)

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


def _joined(parts: Sequence[Near]) -> Near:
    if not parts:
        return Near(np.zeros(0, int), np.zeros(0), np.zeros((0, 6)), np.zeros(0, int), np.zeros(0, int))
    names = ("sample", "distance", "wrench", "a", "b")
    return Near(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))
