"""Signed distances of rounded boxes agree with Drake's, and with closed forms where Drake only iterates."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    Capsule,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    ProximityProperties,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation

from mrtamp.optimise.rounded import Solids, beyond, signed_distances

SHAPES = {
    "sphere": (Sphere(0.07), (0.0, 0.0, 0.0), 0.07),
    "capsule": (Capsule(0.05, 0.3), (0.0, 0.0, 0.15), 0.05),
    "box": (Box(0.2, 0.3, 0.1), (0.1, 0.15, 0.05), 0.0),
}
PAIRS = [(a, b) for a in SHAPES for b in SHAPES]


def solids(kind: str, R: np.ndarray, p: np.ndarray) -> Solids:
    _, half, radius = SHAPES[kind]
    return Solids(np.tile(half, (len(p), 1)), np.full(len(p), radius), R, p)


def drawn(a: str, b: str, n: int, far: float, rng: np.random.Generator) -> tuple[Solids, Solids]:
    R = Rotation.random(2 * n, random_state=rng).as_matrix()
    return solids(a, R[:n], np.zeros((n, 3))), solids(b, R[n:], rng.uniform(-far, far, (n, 3)))


def drakes(a: str, b: str, one: Solids, two: Solids) -> np.ndarray:
    """Drake's signed distance of every pair (N,)."""
    graph = SceneGraph()
    source = graph.RegisterSource("test")
    ids, frames = [], []
    for kind in (a, b):
        frames.append(graph.RegisterFrame(source, GeometryFrame(f"{kind}{len(frames)}")))
        instance = GeometryInstance(RigidTransform(), SHAPES[kind][0], "shape")
        instance.set_proximity_properties(ProximityProperties())
        ids.append(graph.RegisterGeometry(source, frames[-1], instance))
    context = graph.CreateDefaultContext()
    out = []
    for k in range(len(one.p)):
        poses = FramePoseVector()
        for frame, s in zip(frames, (one, two), strict=True):
            X = np.eye(4)
            X[:3, :3], X[:3, 3] = s.R[k], s.p[k]
            poses.set_value(frame, RigidTransform(X))
        graph.get_source_pose_port(source).FixValue(context, poses)
        query = graph.get_query_output_port().Eval(context)
        out.append(query.ComputeSignedDistancePairClosestPoints(*ids).distance)
    return np.array(out)


@pytest.mark.parametrize(("a", "b"), PAIRS)
def test_distances_of_separated_solids_are_drakes(a: str, b: str) -> None:
    one, two = drawn(a, b, 300, 0.5, np.random.default_rng(3))
    d, _, _ = signed_distances(one, two)
    theirs = drakes(a, b, one, two)
    apart = theirs > 1e-3
    assert apart.sum() > 100
    # Drake iterates where capsules are involved: its distances are between points of the solids, but not the nearest.
    assert np.all(d[apart] <= theirs[apart] + 2e-6)
    np.testing.assert_allclose(d[apart], theirs[apart], atol=3e-4 if "capsule" in (a, b) else 2e-6)
    assert np.all((d > 0)[np.abs(theirs) > 1e-5] == (theirs > 0)[np.abs(theirs) > 1e-5])


@pytest.mark.parametrize(("a", "b"), PAIRS)
def test_moving_apart_by_the_depth_along_the_normal_separates(a: str, b: str) -> None:
    """The depth suffices along the normal, and nothing less does along any other direction."""
    rng = np.random.default_rng(4)
    one, two = drawn(a, b, 200, 0.1, rng)
    d, n, _ = signed_distances(one, two)
    inside = np.flatnonzero(d < 0)
    assert len(inside) > 50
    one, two, d, n = one[inside], two[inside], d[inside], n[inside]

    def moved(step: np.ndarray) -> np.ndarray:
        return signed_distances(Solids(one.half, one.radius, one.R, one.p + step), two)[0]

    assert np.abs(moved(-d[:, None] * n)).max() < 1e-6
    for _ in range(40):
        v = rng.normal(size=n.shape)
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        assert np.all(moved(-0.98 * d[:, None] * v) < 1e-9)


@pytest.mark.parametrize(("a", "b"), PAIRS)
def test_witness_and_normal_are_the_derivative_of_the_distance(a: str, b: str) -> None:
    """The distance changes by the velocity of the witness point on `a` along the normal."""
    one, two = drawn(a, b, 200, 0.35, np.random.default_rng(5))
    d, n, x = signed_distances(one, two)
    mine = np.flatnonzero(d > 5e-3)
    one, two, d, n, x = one[mine], two[mine], d[mine], n[mine], x[mine]
    h = 1e-6
    rng = np.random.default_rng(6)
    omega, v = rng.normal(size=(2, len(mine), 3))
    turn = Rotation.from_rotvec(h * omega).as_matrix()
    moved = Solids(one.half, one.radius, turn @ one.R, (turn @ one.p[..., None])[..., 0] + h * v)
    change = (signed_distances(moved, two)[0] - d) / h
    expected = (n * (np.cross(omega, x) + v)).sum(axis=1)
    # Where edges are nearly parallel the nearest points jump; everywhere else the derivative is exact.
    assert np.mean(np.abs(change - expected) < 1e-3) > 0.97


def test_the_bound_never_exceeds_the_distance() -> None:
    rng = np.random.default_rng(7)
    for a, b in PAIRS:
        one, two = drawn(a, b, 200, 0.6, rng)
        d = signed_distances(one, two)[0]
        assert np.all(np.maximum(beyond(one, two), beyond(two, one)) <= np.maximum(d, 0) + 1e-9)


def test_parallel_segments_and_flush_faces() -> None:
    eye = np.eye(3)[None]
    capsule = solids("capsule", eye, np.zeros((1, 3)))
    beside = solids("capsule", eye, np.array([[0.25, 0.0, 0.1]]))
    assert signed_distances(capsule, beside)[0] == pytest.approx([0.15])
    box = solids("box", eye, np.array([[0.0, 0.0, -0.3]]))
    assert signed_distances(capsule, box)[0] == pytest.approx([0.3 - 0.05 - 0.15 - 0.05])
    on_top = solids("box", eye, np.array([[0.03, 0.02, -0.2]]))
    d, n, _ = signed_distances(on_top, box)
    assert d == pytest.approx([0.0], abs=1e-9) and n[0] == pytest.approx([0, 0, 1])
    sunk = solids("box", eye, np.array([[0.03, 0.02, -0.203]]))
    d, n, _ = signed_distances(sunk, box)
    assert d == pytest.approx([-0.003]) and n[0] == pytest.approx([0, 0, 1])
