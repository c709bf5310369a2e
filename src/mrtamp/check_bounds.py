"""Cheap lower bounds on distances, for many samples of a motion at once: what they settle, Drake is not asked.

Every solid is enclosed in a sphere, a capsule and a box, all read from the judge's SceneGraph at the plant's default
configuration; the joints move them by the product of exponentials.  A bound is never more than the true distance, so it
can only ever clear a pair, not convict it.

Between two samples every point of a solid stays near its chord, the straight line from where it was to where it will
be: at most an eighth of its largest second derivative away (`Screws.bends` bounds that).  Chords say how far a solid
has moved, and, where a plane separates two solids at both samples, how far it stays between them on the way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
"""Corners (8, 3) of the box of half sizes 1."""


@dataclass(eq=False)
class Envelopes:
    """Enclosing shapes of all solids (n) in the world at the default configuration, and the joints that carry them.

    The capsule of a solid is the segment `ends` (n, 2, 3) with radius `radius`; its sphere is `centre` with radius
    `bound`; its box has the axes `axes` (columns) and the half sizes `half`.
    """

    centre: Array
    bound: Array
    ends: Array
    radius: Array
    axes: Array
    half: Array
    round: Array
    """Whether the capsule is exact (n,), so that the box adds nothing."""
    disc: Array
    """Whether it is a cylinder (n,) along the third axis of its box."""
    joint: Array

    def moved(self, solids: list[int], X: Array, joint: int) -> None:
        """Put some solids, given in the frame of their body, at the pose X (4, 4) and hang them on `joint`."""
        R, p = X[:3, :3], X[:3, 3]
        self.centre[solids] = self.centre[solids] @ R.T + p
        self.ends[solids] = self.ends[solids] @ R.T + p
        self.axes[solids] = R @ self.axes[solids]
        self.joint[solids] = joint

    def copy(self) -> Envelopes:
        """A copy whose objects can be put elsewhere."""
        return Envelopes(
            self.centre.copy(),
            self.bound,
            self.ends.copy(),
            self.radius,
            self.axes.copy(),
            self.half,
            self.round,
            self.disc,
            self.joint.copy(),
        )


def capsule_around(X: Array, half: Array) -> tuple[Array, float]:
    """Ends (2, 3) and radius of a capsule around the box of half sizes `half` at X (4, 4), along its longest side."""
    k = int(np.argmax(half))
    radius = float(np.linalg.norm(np.delete(half, k)))
    # The corners lie `radius` off the axis, at its very ends: the segment cannot be shorter than the box.
    axis = X[:3, k] * half[k]
    return np.array([X[:3, 3] - axis, X[:3, 3] + axis]), radius


class Screws:
    """The joints of all robots as screws: world axes and origins at the default configuration `at` (N,)."""

    def __init__(self, axis: Array, origin: Array, prismatic: Array, parent: list[int], at: Array) -> None:
        self.axis, self.origin, self.prismatic, self.parent, self.at = axis, origin, prismatic, parent, at
        above = [self._above(j) for j in range(len(parent))]
        depth = np.array([len(upstream) for upstream in above], dtype=int)
        self._ranks = [np.flatnonzero(depth == d) for d in range(int(depth.max(initial=-1)) + 1)]
        """Joints that hang on joints of the rank before."""
        a, zero = axis.T, np.zeros(len(parent))
        K = np.array([[zero, -a[2], a[1]], [a[2], zero, -a[0]], [-a[1], a[0], zero]])
        self._K = np.moveaxis(K, 2, 0)[:, None]
        self._turns_before = np.zeros((len(parent), len(parent)))
        for j, upstream in enumerate(above):
            self._turns_before[j, [k for k in upstream if not prismatic[k]]] = 1.0

    def _above(self, j: int) -> list[int]:
        return [] if self.parent[j] < 0 else [self.parent[j], *self._above(self.parent[j])]

    def transforms(self, z: Array) -> tuple[Array, Array]:
        """How each joint moves what it carries away from the default: R (N + 1, S, 3, 3), p (N + 1, S, 3).

        The last entry is the identity, for what no joint carries (joint -1).
        """
        S, N = z.shape
        R = np.empty((N + 1, S, 3, 3))
        p = np.zeros((N + 1, S, 3))
        R[N] = np.eye(3)
        for joints in self._ranks:
            before = np.array(self.parent)[joints]
            moved = (z[:, joints] - self.at[joints]).T[..., None]  # (J, S, 1)
            slides = self.prismatic[joints][:, None, None]
            angle, way = np.where(slides, 0.0, moved), np.where(slides, moved, 0.0)
            K, origin = self._K[joints], self.origin[joints][:, None]
            turn = np.eye(3) + np.sin(angle)[..., None] * K + (1 - np.cos(angle))[..., None] * (K @ K)
            R[joints] = R[before] @ turn
            shift = origin - (turn @ origin[..., None])[..., 0] + way * self.axis[joints][:, None]
            p[joints] = p[before] + (R[before] @ shift[..., None])[..., 0]
        return R, p

    def bends(self, moved: Array) -> Array:
        """Second derivatives of straight joint motions of |dq| = `moved` (E, N), per metre of reach: (E, N).

        A point that joint k can have `reach[k]` (m) from its axis has, in time that runs from 0 to 1, a second
        derivative of at most bends @ reach: |d2p / dq_j dq_k| is no more than the reach of the joint further down, and
        nothing where the one further up is prismatic.
        """
        turns = np.where(self.prismatic, 0.0, moved)
        return np.asarray(moved * (turns + 2.0 * moved @ self._turns_before.T))


class Snapshot:
    """The envelopes at S samples."""

    def __init__(self, envelopes: Envelopes, screws: Screws, z: Array) -> None:
        self.envelopes = envelopes
        self._R, self._p = screws.transforms(z)
        R, p = self._R[envelopes.joint], self._p[envelopes.joint]
        self.centre = np.einsum("nsab,nb->nsa", R, envelopes.centre) + p  # (n, S, 3)
        corners = envelopes.centre[:, None] + (CORNERS * envelopes.half[:, None]) @ envelopes.axes.swapaxes(1, 2)
        self._hull = np.where(envelopes.round[:, None, None], np.tile(envelopes.ends, (1, 4, 1)), corners)

    def extended(self, other: Snapshot) -> Snapshot:
        """The samples of this one and then those of another one of the same envelopes."""
        out = object.__new__(Snapshot)
        out.envelopes, out._hull = self.envelopes, self._hull
        out._R, out._p = np.concatenate([self._R, other._R], axis=1), np.concatenate([self._p, other._p], axis=1)
        out.centre = np.concatenate([self.centre, other.centre], axis=1)
        return out

    def hull(self, solids: Array, s: Array) -> Array:
        """Points (E, 8, 3) at the samples s (E,) in whose hull `solids` (E,) are, but for the radius if round."""
        k = self.envelopes.joint[solids]
        return np.asarray(self._hull[solids] @ self._R[k, s].swapaxes(1, 2) + self._p[k, s][:, None])

    def chords(self, solids: Array, s: tuple[Array, Array]) -> Array:
        """The longest chord (E,) of any point of the hulls of `solids` (E,) from one sample to the other.

        What is round counts by the ends of its axis: it is the same ball around them however it turns.
        """
        way = self.hull(solids, s[1]) - self.hull(solids, s[0])
        return np.asarray(np.sqrt(np.einsum("eab,eab->ea", way, way).max(axis=1)))

    def parted(self, i: Array, j: Array, s: tuple[Array, Array], normal: Array) -> Array:
        """How far apart (E,) planes with the `normal` (E, 3) keep solids i and j, at both samples, each on one side."""
        side = np.zeros(len(i))
        out = np.full(len(i), np.inf)
        for at in s:
            between = np.einsum("ea,ea->e", normal, self.centre[i, at] - self.centre[j, at])
            side = np.where(side == 0.0, np.sign(between), side)
            out = np.minimum(out, side * between - self._extent(i, at, normal) - self._extent(j, at, normal))
        return out

    def _extent(self, i: Array, s: Array, normal: Array) -> Array:
        """How far (E,) solids reach from their centres along unit vectors (E, 3)."""
        e = self.envelopes
        local = np.einsum("eba,eb->ea", self._R[e.joint[i], s], normal)
        m, half = np.abs(np.einsum("eba,eb->ea", e.axes[i], local)), e.half[i]
        box = np.einsum("ea,ea->e", m, half)
        disc = half[:, 0] * np.hypot(m[:, 0], m[:, 1]) + half[:, 2] * m[:, 2]
        axis = np.einsum("ea,ea->e", e.ends[i, 1] - e.ends[i, 0], local)
        return np.where(e.round[i], np.abs(axis) / 2 + e.radius[i], np.where(e.disc[i], disc, box))

    def spheres(self, i: Array, j: Array) -> Array:
        """Bounds (P, S) for pairs of solids i, j (P,) at all samples."""
        gap = np.linalg.norm(self.centre[i] - self.centre[j], axis=2)
        return gap - (self.envelopes.bound[i] + self.envelopes.bound[j])[:, None]

    def near(self, eligible: Array, margin: float) -> tuple[Array, Array]:
        """Pairs i < j of the `eligible` (n, n) whose spheres come within `margin` at some sample."""
        limit = self.envelopes.bound[:, None] + self.envelopes.bound[None] + margin
        limit = np.where(eligible, limit**2, -1.0)
        squared = np.full(limit.shape, np.inf)
        for c in self.centre.swapaxes(0, 1):
            norms = np.einsum("na,na->n", c, c)
            np.minimum(squared, norms[:, None] + norms[None] - 2 * (c @ c.T), out=squared)
        i, j = np.nonzero(squared <= limit + 1e-9)
        return i, j

    def shapes(self, s: Array, i: Array, j: Array) -> Array:
        """Bounds (E,) for pairs of solids i, j (E,) at the samples s (E,), from capsules and boxes."""
        envelopes = self.envelopes
        a, b = self._ends(s, i), self._ends(s, j)
        out = segment_distance(a, b) - envelopes.radius[i] - envelopes.radius[j]
        for mine, theirs, ends in ((i, j, b), (j, i, a)):
            boxes = np.flatnonzero(~envelopes.round[mine])
            if len(boxes):
                k = envelopes.joint[mine[boxes]]
                axes = self._R[k, s[boxes]] @ envelopes.axes[mine[boxes]]
                middle = self.centre[mine[boxes], s[boxes]]
                local = np.einsum("epa,eab->epb", ends[boxes] - middle[:, None], axes)
                beyond = np.maximum(local.min(axis=1), -local.max(axis=1)) - envelopes.half[mine[boxes]]
                out[boxes] = np.maximum(out[boxes], beyond.max(axis=1) - envelopes.radius[theirs[boxes]])
        return out

    def _ends(self, s: Array, i: Array) -> Array:
        k = self.envelopes.joint[i]
        return np.einsum("eab,epb->epa", self._R[k, s], self.envelopes.ends[i]) + self._p[k, s][:, None]


def segment_distance(a: Array, b: Array) -> Array:
    """Distance (E,) of the segments a and b (E, 2, 3)."""
    u, v = a[:, 1] - a[:, 0], b[:, 1] - b[:, 0]
    ends = [_point_segment(a[:, e], b[:, 0], v) for e in (0, 1)] + [_point_segment(b[:, e], a[:, 0], u) for e in (0, 1)]
    out = np.min(ends, axis=0)
    # Where the common normal meets both segments inside, they come closer than any end does.
    r = a[:, 0] - b[:, 0]
    uu, vv, uv = (np.einsum("ea,ea->e", x, y) for x, y in ((u, u), (v, v), (u, v)))
    ur, vr = np.einsum("ea,ea->e", u, r), np.einsum("ea,ea->e", v, r)
    denominator = uu * vv - uv * uv
    safe = np.where(denominator > 1e-12 * uu * vv, denominator, np.inf)
    s, t = (uv * vr - vv * ur) / safe, (uu * vr - uv * ur) / safe
    within = (s > 0) & (s < 1) & (t > 0) & (t < 1)
    inner = np.linalg.norm(r + s[:, None] * u - t[:, None] * v, axis=1)
    return np.where(within, np.minimum(out, inner), out)


def _point_segment(p: Array, a: Array, u: Array) -> Array:
    length = np.maximum(np.einsum("ea,ea->e", u, u), 1e-30)
    t = np.clip(np.einsum("ea,ea->e", p - a, u) / length, 0.0, 1.0)
    return np.linalg.norm(p - a - t[:, None] * u, axis=1)


__all__ = ["CORNERS", "Envelopes", "Screws", "Snapshot", "capsule_around", "segment_distance"]
