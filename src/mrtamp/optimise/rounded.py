"""Signed distances between many pairs of rounded boxes at once, in closed form.

A rounded box is a box grown by a radius: boxes (radius 0), capsules (a box that is a segment) and spheres (a box that
is a point) are all of them.  Distances of separated ones are exact, and so are depths of penetration: the depth of two
convex polytopes is attained along a normal of a face of one of them or across two of their edges.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from mrtamp.optimise.screws import cross

_TOUCHING = 1e-7
"""Distance (m) of two cores below which their direction says nothing."""
_TINY = 1e-12
_PROVED = 1e-9
"""Distance (m) up to which two bounds of a distance are held to be the same."""
_SIGNS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_EDGES = [(a, b) for a, b in itertools.combinations(range(8), 2) if np.sum(_SIGNS[a] != _SIGNS[b]) == 1]
_TAILS, _HEADS = (np.array(x) for x in zip(*_EDGES, strict=True))


@dataclass(frozen=True, eq=False)
class Solids:
    """Rounded boxes in W: half sizes of the core (N, 3) and radius (N,) in m, rotation (N, 3, 3) and centre (N, 3)."""

    half: np.ndarray
    radius: np.ndarray
    R: np.ndarray
    p: np.ndarray

    def __getitem__(self, index: np.ndarray) -> Solids:
        return Solids(self.half[index], self.radius[index], self.R[index], self.p[index])

    def local(self, x: np.ndarray) -> np.ndarray:
        """Points (N, 3) in the frames of the solids."""
        return ((x - self.p)[:, None] @ self.R)[:, 0]

    def world(self, x: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the solids' frames in the world."""
        return self.p + (self.R @ x[..., None])[..., 0]

    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Where cores that are segments or points begin (N, 3), and the vectors (N, 3) to their ends."""
        half = (self.R @ self.half[..., None])[..., 0]
        return self.p - half, 2 * half


def beyond(a: Solids, b: Solids) -> np.ndarray:
    """A lower bound (N,) of the distance: between a and the box around b whose faces are parallel to those of a."""
    x = np.maximum(_beside(a, b)[0], 0.0)
    return np.sqrt((x * x).sum(axis=1)) - a.radius - b.radius


def _beside(a: Solids, b: Solids) -> tuple[np.ndarray, np.ndarray]:
    """By how much (N, 3) the box around b whose faces are parallel to those of a is beside the core of a, and where b
    is (N, 3), in the frame of a."""
    size = (np.abs(np.swapaxes(a.R, 1, 2) @ b.R) @ b.half[..., None])[..., 0]
    there = a.local(b.p)
    return np.abs(there) - a.half - size, there


def signed_distances(a: Solids, b: Solids) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances (N,), negative where pairs penetrate, normals (N, 3) from b to a, and witness points (N, 3) on a."""
    N = len(a.p)
    x, y = np.empty((N, 3)), np.empty((N, 3))
    extents = [np.count_nonzero(s.half, axis=1) for s in (a, b)]
    thin_a, thin_b = extents[0] <= 1, extents[1] <= 1
    for mine, nearest in (
        (thin_a & thin_b, _between_segments),
        (thin_a & ~thin_b, _from_segment),
        (~thin_a & thin_b, _to_segment),
        (~thin_a & ~thin_b, _between_boxes),
    ):
        i = np.flatnonzero(mine)
        if len(i):
            x[i], y[i] = nearest(a[i], b[i])
    apart = x - y
    d = np.sqrt((apart**2).sum(axis=1))
    normal = apart / np.maximum(d, _TINY)[:, None]
    inside = np.flatnonzero(d < _TOUCHING)
    if len(inside):
        d[inside], normal[inside], x[inside] = _overlap(a[inside], b[inside])
    return d - a.radius - b.radius, normal, x - a.radius[:, None] * normal


# -- nearest points of cores -------------------------------------------------------------------------------------------


def _between_segments(a: Solids, b: Solids) -> tuple[np.ndarray, np.ndarray]:
    (p, u), (q, v) = a.ends(), b.ends()
    r = p - q
    uu, vv, uv = (u * u).sum(axis=1), (v * v).sum(axis=1), (u * v).sum(axis=1)
    ur, vr = (u * r).sum(axis=1), (v * r).sum(axis=1)
    det = uu * vv - uv * uv
    safe_u, safe_v = np.maximum(uu, _TINY), np.maximum(vv, _TINY)
    # Of parallel segments any point will do at first; the clamps below put it right.
    s = np.where(det > _TINY * safe_u * safe_v, np.clip((uv * vr - ur * vv) / np.maximum(det, 1e-300), 0, 1), 0.5)
    t = np.clip((uv * s + vr) / safe_v, 0, 1)
    s = np.clip((uv * t - ur) / safe_u, 0, 1)
    return p + s[:, None] * u, q + t[:, None] * v


def _from_segment(a: Solids, b: Solids) -> tuple[np.ndarray, np.ndarray]:
    p, u = a.ends()
    return _segment_to_box(p, u, b)


def _to_segment(a: Solids, b: Solids) -> tuple[np.ndarray, np.ndarray]:
    y, x = _from_segment(b, a)
    return x, y


def _segment_to_box(p: np.ndarray, u: np.ndarray, box: Solids) -> tuple[np.ndarray, np.ndarray]:
    """Nearest points of segments from p (N, 3) along u (N, 3) and of the boxes' cores.

    The derivative of the squared distance along a segment is piecewise linear and never falls: its root lies between
    two of the places where the segment crosses the planes of the faces.
    """
    o, w = box.local(p), (u[:, None] @ box.R)[:, 0]
    h = box.half
    slow = np.abs(w) < _TINY
    speed = np.where(slow, 1.0, w)
    crossings = np.concatenate([(h - o) / speed, (-h - o) / speed], axis=1)
    crossings[np.concatenate([slow, slow], axis=1)] = 0.0
    t = np.sort(np.concatenate([np.zeros((len(p), 1)), np.clip(crossings, 0, 1), np.ones((len(p), 1))], axis=1), axis=1)
    x = o[:, None] + t[..., None] * w[:, None]
    slope = ((x - np.clip(x, -h[:, None], h[:, None])) * w[:, None]).sum(axis=2)
    last = (slope < -_TINY).sum(axis=1) - 1
    rows = np.arange(len(p))
    low, high = np.maximum(last, 0), np.clip(last + 1, 0, 7)
    rise = slope[rows, high] - slope[rows, low]
    share = np.clip(-slope[rows, low] / np.where(rise > _TINY, rise, 1.0), 0, 1)
    best = t[rows, low] + share * (t[rows, high] - t[rows, low])
    nearest = o + best[:, None] * w
    return p + best[:, None] * u, box.world(np.clip(nearest, -h, h))


def _between_boxes(a: Solids, b: Solids) -> tuple[np.ndarray, np.ndarray]:
    """Wherever boxes are nearest, or overlap, an edge of one of them is.

    Most often it is at the corner that reaches furthest towards the other: then there is a slab as thick as they are
    apart between them, which proves it.  Otherwise all edges are asked.
    """
    towards = _towards(a, b)
    ends = _corner(a, towards), _corner(b, -towards)
    x, y = _nearest_of(_edges_to_box(*ends[0], b), _edges_to_box(*ends[1], a))
    n = y - x
    d = np.sqrt((n * n).sum(axis=1))
    n /= np.maximum(d, _TINY)[:, None]
    sizes = sum((np.abs((n[:, None] @ s.R)[:, 0]) * s.half).sum(axis=1) for s in (a, b))
    doubtful = np.flatnonzero((n * (b.p - a.p)).sum(axis=1) - sizes < d - _PROVED)
    if len(doubtful):
        one, two = a[doubtful], b[doubtful]
        found = _nearest_of(_edges_to_box(*_all_edges(one), two), _edges_to_box(*_all_edges(two), one))
        x[doubtful], y[doubtful] = found
    return x, y


def _towards(a: Solids, b: Solids) -> np.ndarray:
    """About the direction (N, 3) from a to b in which they are the least apart: across the faces of the one that is
    farther beside the other, or between the centres where neither is."""
    (out_a, at_b), (out_b, at_a) = _beside(a, b), _beside(b, a)
    out_a, out_b = np.maximum(out_a, 0.0), np.maximum(out_b, 0.0)
    far_a, far_b = (out_a * out_a).sum(axis=1), (out_b * out_b).sum(axis=1)
    along = np.where(
        (far_a >= far_b)[:, None],
        (a.R @ np.copysign(out_a, at_b)[..., None])[..., 0],
        -(b.R @ np.copysign(out_b, at_a)[..., None])[..., 0],
    )
    return np.where((np.maximum(far_a, far_b) > 0.0)[:, None], along, b.p - a.p)


def _corner(box: Solids, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges (N, 3) at the corner that reaches furthest along a direction (N, 3), as they begin and go on."""
    half = np.copysign(box.half, (towards[:, None] @ box.R)[:, 0])
    corner = box.world(half)
    return np.repeat(corner[:, None], 3, axis=1), -2 * np.swapaxes(box.R * half[:, None], 1, 2)


def _all_edges(box: Solids) -> tuple[np.ndarray, np.ndarray]:
    """All edges (N, 12, 3), as they begin and go on."""
    corners = box.p[:, None] + (_SIGNS * box.half[:, None]) @ np.swapaxes(box.R, 1, 2)
    tails = corners[:, _TAILS]
    return tails, corners[:, _HEADS] - tails


def _edges_to_box(tails: np.ndarray, along: np.ndarray, box: Solids) -> tuple[np.ndarray, np.ndarray]:
    """Nearest points (N, E, 3) of edges (N, E, 3) and of the boxes."""
    N, E, _ = tails.shape
    x, y = _segment_to_box(tails.reshape(-1, 3), along.reshape(-1, 3), box[np.repeat(np.arange(N), E)])
    return x.reshape(N, E, 3), y.reshape(N, E, 3)


def _nearest_of(
    of_a: tuple[np.ndarray, np.ndarray], of_b: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of a and of b that are nearest to each other, from those of the edges of each and of the other."""
    x, y = np.concatenate([of_a[0], of_b[1]], axis=1), np.concatenate([of_a[1], of_b[0]], axis=1)
    best = ((x - y) ** 2).sum(axis=2).argmin(axis=1)
    rows = np.arange(len(x))
    return x[rows, best], y[rows, best]


# -- cores that overlap ------------------------------------------------------------------------------------------------


def _overlap(a: Solids, b: Solids) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Minus the depth (N,) of overlapping cores, its direction (N, 3) from b to a, and a witness point (N, 3) on a."""
    N = len(a.p)
    A, B = np.swapaxes(a.R, 1, 2), np.swapaxes(b.R, 1, 2)
    across = cross(A[:, :, None], B[:, None]).reshape(N, 9, 3)
    n = np.concatenate([A, B, across], axis=1)
    size = np.sqrt((n**2).sum(axis=2))
    along = np.where(size > 1e-6, size, 1.0)
    n = n / along[..., None]
    between = (n * (a.p - b.p)[:, None]).sum(axis=2)
    reach = sum((np.abs(n @ s.R) * s.half[:, None]).sum(axis=2) for s in (a, b))
    depth = np.where(size > 1e-6, reach - np.abs(between), np.inf)
    best = depth.argmin(axis=1)
    rows = np.arange(N)
    normal = n[rows, best] * np.where(between[rows, best] < 0, -1.0, 1.0)[:, None]
    # The middle of what of a reaches furthest into b.
    along = (normal[:, None] @ a.R)[:, 0]
    deepest = a.world(-np.where(np.abs(along) > 1e-6, np.sign(along), 0.0) * a.half)
    return -depth[rows, best], normal, deepest
