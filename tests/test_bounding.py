"""Bounding spheres and beads hold what they stand for, and one product of matrices says which balls are near."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryFrame,
    GeometryInstance,
    ProximityProperties,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw

from mrtamp.bounding import Balls, beads_of

TETRAHEDRON = np.array([[0, 0, 0], [0.6, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
SHAPES = {
    "sphere": Sphere(0.1),
    "capsule": Capsule(0.05, 0.4),
    "short capsule": Capsule(0.2, 0.01),
    "cylinder": Cylinder(0.06, 0.5),
    "plate": Cylinder(0.3, 0.02),
    "box": Box(0.1, 0.7, 0.15),
    "rod": Box(0.01, 0.01, 1.0),
    "ellipsoid": Ellipsoid(0.1, 0.2, 0.5),
    "hull": Convex(TETRAHEDRON.T, "tetrahedron"),
}


def surface(shape: Shape, rng: np.random.Generator) -> np.ndarray:
    """Random points (n, 3) of a shape, those that stick out among them."""
    u = rng.normal(size=(4000, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    if isinstance(shape, Sphere):
        return shape.radius() * u
    if isinstance(shape, Capsule):
        along = np.clip(rng.uniform(-2, 2, len(u)), -1, 1) * shape.length() / 2
        return shape.radius() * u + np.outer(along, [0, 0, 1])
    if isinstance(shape, Ellipsoid):
        return u * [shape.a(), shape.b(), shape.c()]
    if isinstance(shape, Box):
        return np.clip(10 * u, -1, 1) * np.asarray(shape.size()) / 2
    if isinstance(shape, Cylinder):
        flat = u[:, :2] / np.linalg.norm(u[:, :2], axis=1)[:, None]
        return np.column_stack([shape.radius() * flat, np.clip(3 * u[:, 2], -1, 1) * shape.length() / 2])
    return np.concatenate([TETRAHEDRON, rng.dirichlet(np.full(4, 0.3), size=2000) @ TETRAHEDRON])


@pytest.mark.parametrize("name", SHAPES)
def test_beads_hold_the_whole_shape_and_fit_it(name: str) -> None:
    shape, rng = SHAPES[name], np.random.default_rng(0)
    X = RigidTransform(RollPitchYaw(0.3, -0.5, 1.2), [0.1, 0.2, 0.3])
    graph = SceneGraph()
    source = graph.RegisterSource("test")
    frame = graph.RegisterFrame(source, GeometryFrame("frame"))
    g = graph.RegisterGeometry(source, frame, GeometryInstance(X, shape, "shape"))
    graph.AssignRole(source, g, ProximityProperties())
    centres, radius = beads_of(graph.model_inspector(), g)
    points = X.multiply(surface(shape, rng).T).T
    gaps = np.linalg.norm(points[:, None] - centres, axis=2) - radius
    assert gaps.min(axis=1).max() <= 1e-9, "every point is in a bead"
    assert gaps.min(axis=0).max() <= 1e-9, "no bead is away from the shape"
    around = np.linalg.norm(points - points.mean(axis=0), axis=1).max()
    if name in ("capsule", "cylinder", "box", "rod", "hull"):
        assert radius < 0.6 * around, "a long shape has several"


@pytest.mark.parametrize("seed", range(3))
def test_near_balls_are_those_whose_gap_is_less_than_the_margin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-1, 1, (200, 4, 3)), rng.uniform(-1, 1, (200, 7, 3))
    r, s = rng.uniform(0.02, 0.2, 4), rng.uniform(0.02, 0.2, 7)
    gaps = np.linalg.norm(a[:, :, None] - b[:, None], axis=3) - r[:, None] - s
    one, two = Balls(a, r), Balls(b, s)
    for margin in (0.0, 0.05):
        expected = gaps.min(axis=(1, 2)) < margin
        assert 0 < expected.sum() < len(a)
        np.testing.assert_array_equal(one.near(two, margin), expected)
        np.testing.assert_array_equal(two.near(one, margin), expected)
        assert Balls(a[3], r).near(Balls(b[3], s), margin) == expected[3]
