"""Whether synchronous stretches of motion keep clear of each other: spheres at the knots first, samples where needed.

The refiner's questions: robots that move while others do, and robots with their loads against resting objects.  Steps
whose bounding spheres prove them apart are never sampled; the others are sampled so that no tracked point moves more
than the resolution, and Drake decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mrtamp.collision import Collision
from mrtamp.modes import Attachment
from mrtamp.roadmap import Roadmap
from mrtamp.validity import Resting

_MARGIN = 0.02
"""Clearance (m) of bounding spheres above which nothing can touch: padding, and what spheres miss of rotation."""
_FIRST = 24
_CURVE = 1.1
"""How much longer than its chord a point's way may be."""


class Track:
    """Motion of one robot with what it holds over M knots, its bounding spheres at the knots and their travel.

    `held` is what the robot holds in each of the M - 1 steps, `finer` how many times as densely each is sampled
    against the world.
    """

    def __init__(self, roadmap: Roadmap, q: np.ndarray, held: Sequence[Attachment | None]) -> None:
        self.roadmap = roadmap
        self.q = q
        self.held = held
        self.finer = np.ones(len(q) - 1, dtype=int)
        world = roadmap.world
        self.centres = world.bounds.spheres(q)
        self.radii = world.bounds.radii
        R, self.hand = world.tool.pose(q)
        axes = self.hand[:, None] + 0.1 * np.swapaxes(R, 1, 2)
        travel = np.linalg.norm(np.diff(self.centres, axis=0), axis=2).max(axis=1, initial=0.0)
        points = np.concatenate([axes, self.hand[:, None]], axis=1)
        self.travel = np.maximum(travel, np.linalg.norm(np.diff(points, axis=0), axis=2).max(axis=1))

    def part(self, i: int, j: int, held: Sequence[Attachment | None]) -> Track:
        """The track from knot i to knot j, with what is held there."""
        out = Track.__new__(Track)
        out.roadmap, out.radii, out.held = self.roadmap, self.radii, held
        out.q, out.centres, out.hand = self.q[i : j + 1], self.centres[i : j + 1], self.hand[i : j + 1]
        out.travel, out.finer = self.travel[i:j], self.finer[i:j]
        return out

    def at(self, k: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Configurations (N, n) a share t of step k on."""
        return self.q[k] + t[:, None] * (self.q[k + 1] - self.q[k])

    def load_radius(self) -> float:
        """How far (m) from the grasp frame's origin anything held may reach."""
        world = self.roadmap.world
        held = {a for a in self.held if a is not None}
        return max((float(np.linalg.norm(a.X_PO[:3, 3])) + world.object_radius[a.object] for a in held), default=0.0)

    def balls(self) -> tuple[np.ndarray, np.ndarray]:
        """Spheres around robot and load at the knots: centres (M, B, 3), radii (B,)."""
        load = self.load_radius()
        if load == 0.0:
            return self.centres, self.radii
        return np.concatenate([self.centres, self.hand[:, None]], axis=1), np.append(self.radii, load)


def near_steps(a: Track, b: Track, margin: float = _MARGIN) -> np.ndarray:
    """Which of the M - 1 steps of two synchronous tracks come near each other by their spheres."""
    ca, ra = a.balls()
    cb, rb = b.balls()
    squares = ((ca[:, :, None] - cb[:, None]) ** 2).sum(axis=3)
    gap = (np.sqrt(squares) - ra[:, None] - rb).min(axis=(1, 2))
    return gap[:-1] + gap[1:] - _CURVE * (a.travel + b.travel) < 2 * margin


def near_object(a: Track, p: np.ndarray, radius: float, margin: float = _MARGIN) -> np.ndarray:
    """Which of the M - 1 steps of a track come near a sphere at p (3,)."""
    centres, radii = a.balls()
    gap = (np.linalg.norm(centres - p, axis=2) - radii).min(axis=1) - radius
    return gap[:-1] + gap[1:] - _CURVE * a.travel < 2 * margin


def samples(steps: np.ndarray, pieces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Step and share of it (N,), (N,) of all samples of the given steps, ends of steps included."""
    k = np.repeat(steps, pieces + 1)
    t = np.concatenate([np.arange(n + 1) / n for n in pieces]) if len(pieces) else np.zeros(0)
    return k, t


def _parts(index: np.ndarray) -> list[np.ndarray]:
    """A few first, then the rest: most of what collides does so soon."""
    return [part for part in np.split(index, [min(_FIRST, len(index))]) if len(part)]


class Clearance:
    """Asks Drake about steps of tracks; remembers nothing."""

    def __init__(self, collision: Collision, resolution: float, rng: np.random.Generator) -> None:
        self.collision = collision
        self.resolution = resolution
        self.rng = rng

    def pieces(self, travel: np.ndarray) -> np.ndarray:
        """Into how many parts steps with the given travel (m) of any point are cut."""
        return np.maximum(1, np.ceil(_CURVE * travel / self.resolution)).astype(int)

    def pair(self, a: Track, b: Track, steps: np.ndarray) -> int:
        """A step among those given (S,) in which two tracks collide, or -1."""
        steps = steps[near_steps(a, b)[steps]]
        if not len(steps):
            return -1
        # Two that move towards each other close in faster than either moves.
        travel = np.maximum(np.maximum(a.travel, b.travel), 0.75 * (a.travel + b.travel))
        k, t = samples(steps, self.pieces(travel[steps]))
        order = self.rng.permutation(len(k))
        k, t = k[order], t[order]
        for held_a, held_b in dict.fromkeys((a.held[s], b.held[s]) for s in steps.tolist()):
            mine = np.array([a.held[s] is held_a and b.held[s] is held_b for s in k.tolist()])
            for part in _parts(np.flatnonzero(mine)):
                qa, qb = a.at(k[part], t[part]), b.at(k[part], t[part])
                hit = self.collision.first_hit(a.roadmap.name, qa, held_a, b.roadmap.name, qb, held_b)
                if hit >= 0:
                    return int(k[part][hit])
        return -1

    def world(self, a: Track, steps: np.ndarray, resting: Sequence[Sequence[Resting]], static: bool) -> int:
        """A step among those given (S,) in which a track hits the world, or -1.

        `resting` are the objects to respect in each of the M - 1 steps.  Where `static` is False, the rest of the world
        is known to be clear: steps that are far from all objects are not looked at.
        """
        world = a.roadmap.world
        near: dict[Resting, np.ndarray] = {}
        for item in dict.fromkeys(x for s in steps.tolist() for x in resting[s]):
            near[item] = near_object(a, item.X_WO[:3, 3], world.object_radius[item.name])
        groups: dict[tuple, list[int]] = {}
        for s in steps.tolist():
            objects = tuple(x for x in resting[s] if near[x][s])
            if objects or static:
                groups.setdefault((a.held[s], objects), []).append(s)
        for (held, objects), members in groups.items():
            group = np.array(members)
            k, t = samples(group, self.pieces(a.travel[group] * a.finer[group]))
            order = self.rng.permutation(len(k))
            k, t = k[order], t[order]
            poses: Mapping[str, np.ndarray] = {x.name: x.X_WO for x in objects}
            for part in _parts(np.arange(len(k))):
                hit = world.first_hit(world.rows(a.at(k[part], t[part]), held, poses))
                if hit >= 0:
                    return int(k[part][hit])
        return -1
