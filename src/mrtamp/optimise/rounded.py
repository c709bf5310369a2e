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
    size = (np.abs(np.swapaxes(a.R, 1, 2) @ b.R) @ b.half[..., None])[..., 0]
    x = np.maximum(np.abs(a.local(b.p)) - a.half - size, 0.0)
    return np.sqrt((x * x).sum(axis=1)) - a.radius - b.radius


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
    """Wherever boxes are nearest, or overlap, an edge of one of them is."""
    (x, y), (v, u) = _edges_to_box(a, b), _edges_to_box(b, a)
    x, y = np.concatenate([x, u], axis=1), np.concatenate([y, v], axis=1)
    best = ((x - y) ** 2).sum(axis=2).argmin(axis=1)
    rows = np.arange(len(x))
    return x[rows, best], y[rows, best]


def _edges_to_box(a: Solids, b: Solids) -> tuple[np.ndarray, np.ndarray]:
    """Nearest points (N, 12, 3) of the edges of a and of b."""
    N = len(a.p)
    corners = a.p[:, None] + (_SIGNS * a.half[:, None]) @ np.swapaxes(a.R, 1, 2)
    tails, heads = corners[:, _TAILS].reshape(-1, 3), corners[:, _HEADS].reshape(-1, 3)
    x, y = _segment_to_box(tails, heads - tails, b[np.repeat(np.arange(N), len(_TAILS))])
    return x.reshape(N, -1, 3), y.reshape(N, -1, 3)


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
