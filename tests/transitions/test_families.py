"""Grasp and placement families: closed-form dimensions, charts that invert, residuals that vanish only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from mrtamp.kinematics import inverse
from mrtamp.problem import AntipodalGrasps, ExplicitGrasp, MovableObject, Shape, Support
from mrtamp.resting import face_normal
from mrtamp.transitions.families import (
    Family,
    RegionPlacement,
    grasp_families,
    placement_families,
    residual,
)

BOX = Shape("box", (0.04, 0.06, 0.2))
ROD = Shape("cylinder", (0.02, 0.3))
FACES = ("-z", "+z", "-x", "+x", "-y", "+y")


def thing(shape: Shape, *grasps: AntipodalGrasps | ExplicitGrasp, faces: tuple[str, ...] = ("-z",)) -> MovableObject:
    return MovableObject("thing", "table", RigidTransform(), None, shape, grasps=grasps, resting_faces=faces)


def antipodal(*approaches: str, offset: float = 0.01, depth: tuple[float, float] = (0.01, 0.03)) -> AntipodalGrasps:
    return AntipodalGrasps(approaches, offset, depth)


def region(size: tuple[float, float] = (0.3, 0.2), yaw: tuple[float, float] = (-np.pi, np.pi), **keys) -> Support:
    return Support("region", "table", RigidTransform(RollPitchYaw(0.1, -0.2, 0.5), [0.3, 0.1, 0.05]), size, yaw, **keys)


def grasps_of(shape: Shape, *grasps: AntipodalGrasps | ExplicitGrasp) -> list[Family]:
    return list(grasp_families(thing(shape, *grasps), 0.08))


def places_of(support: Support, *faces: str, shape: Shape = BOX) -> list[Family]:
    return list(placement_families(thing(shape, faces=faces or ("-z",)), support))


EXPLICIT = ExplicitGrasp(RigidTransform(RollPitchYaw(np.pi, 0.1, 0), [0, 0, 0.02]), 0.04)

# What a family is, how many members there are of its kind, and its rank (6 minus its free coordinates).
KINDS: dict[str, tuple[list[Family], int, int]] = {
    "explicit": (grasps_of(BOX, EXPLICIT), 1, 6),
    "sliding in offset and depth": (grasps_of(BOX, antipodal("-z")), 4, 4),
    "sliding in depth alone": (grasps_of(BOX, antipodal("-z", offset=0.0)), 4, 5),
    "sliding in offset alone": (grasps_of(BOX, antipodal("+x", depth=(0.02, 0.02))), 2, 5),
    "not sliding": (grasps_of(BOX, antipodal("-z", offset=0.0, depth=(0.02, 0.02))), 4, 6),
    "cylinder from the end": (grasps_of(ROD, antipodal("-z", offset=0.0)), 1, 4),
    "cylinder from the side": (grasps_of(ROD, antipodal("+x", offset=0.1)), 2, 4),
    "cylinder from the end at one depth": (grasps_of(ROD, antipodal("-z", offset=0.0, depth=(0.02, 0.02))), 1, 5),
    "cylinder from the side at one height": (grasps_of(ROD, antipodal("+y", offset=0.0)), 2, 5),
    "place at a pose": (places_of(region(X_BO=RigidTransform([0.1, 0.2, 0.3]))), 1, 6),
    "place in a region": (places_of(region()), 1, 3),
    "place in a region on other faces": (places_of(region(), *FACES), 6, 3),
    "place in a region with given yaw": (places_of(region(yaw=(0.2, 0.2))), 1, 4),
    "place at a point with free yaw": (places_of(region(size=(0.0, 0.0)), *FACES), 6, 5),
    "place on a line with free yaw": (places_of(region(size=(0.2, 0.0)), "-z", "+x"), 2, 4),
    "place in a region with yaw beyond half a turn": (places_of(region(yaw=(2.0, 4.5))), 1, 3),
}
EACH = [pytest.param(f, rank, id=f"{kind}-{i}") for kind, (fs, _, rank) in KINDS.items() for i, f in enumerate(fs)]


def draw(family: Family, n: int = 40, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(family.lower, family.upper, size=(n, len(family.lower)))


def nudged(X: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Poses X (N, 4, 4) after a small rotation and translation `twist` (N, 6) in the parent frame."""
    out = X.copy()
    for i, t in enumerate(twist):
        size = np.linalg.norm(t[:3])
        K = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
        R = np.eye(3) + (np.sin(size) / size * K + (1 - np.cos(size)) / size**2 * K @ K if size > 0 else 0)
        out[i, :3, :3] = R @ X[i, :3, :3]
        out[i, :3, 3] += t[3:]
    return out


@pytest.mark.parametrize(("families", "count", "rank"), KINDS.values(), ids=KINDS)
def test_closed_form_ranks(families: list[Family], count: int, rank: int) -> None:
    assert len(families) == count
    for family in families:
        assert len(family.rows) == len(set(family.rows)) == rank
        assert len(family.lower) == len(family.upper) == 6 - rank
        assert np.all(family.lower < family.upper)


@pytest.mark.parametrize(("family", "rank"), EACH)
def test_the_chart_inverts(family: Family, rank: int) -> None:
    c = draw(family)
    np.testing.assert_allclose(family.coordinates(family.pose(c)), c, atol=1e-9)


@pytest.mark.parametrize(("family", "rank"), EACH)
def test_members_are_rigid_transforms_without_residual(family: Family, rank: int) -> None:
    X = family.pose(draw(family))
    assert X.shape == (40, 4, 4)
    np.testing.assert_allclose(inverse(X) @ X, np.broadcast_to(np.eye(4), X.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(X[:, :3, :3]), 1.0, atol=1e-12)
    np.testing.assert_allclose(residual(family, X), 0.0, atol=1e-7)


@pytest.mark.parametrize(("family", "rank"), EACH)
def test_the_residual_has_full_rank_on_all_poses(family: Family, rank: int) -> None:
    """By SVD of finite differences over the six directions in which a pose can move, at every one of 40 members."""
    X = family.pose(draw(family))
    step = 1e-5
    columns = []
    for k in range(6):
        plus, minus = (residual(family, nudged(X, np.tile(s * step * np.eye(6)[k], (len(X), 1)))) for s in (1, -1))
        columns.append((plus - minus) / (2 * step))
    singular = np.linalg.svd(np.stack(columns, axis=2), compute_uv=False)
    assert singular.shape == (40, rank)
    assert singular.min() > 0.1


@pytest.mark.parametrize(("family", "rank"), EACH)
def test_the_residual_vanishes_only_on_members(family: Family, rank: int) -> None:
    """Where the residual of a pose nearby is zero, the pose is the member at its coordinates."""
    rng = np.random.default_rng(5)
    X = family.pose(draw(family))
    Y = nudged(X, rng.normal(scale=0.02, size=(len(X), 6)))
    far = np.abs(family.pose(family.coordinates(Y)) - Y).max(axis=(1, 2)) > 1e-3
    assert rank == 0 or far.any()
    assert np.abs(residual(family, Y)[far]).max(axis=1).min(initial=np.inf) > 1e-5


@pytest.mark.parametrize("shape", [BOX, ROD, Shape("sphere", (0.03,)), Shape("capsule", (0.02, 0.1))])
def test_fingers_close_on_opposite_points_of_the_surface(shape: Shape) -> None:
    """The closing axis crosses the surface at half the width on both sides; the approach is one of those asked."""
    asked = ("-z", "+z", "+x", "-y")
    families = grasps_of(shape, antipodal(*asked))
    assert {f.name for f in families} == {f.name for f in families} and families
    for family in families:
        X = family.pose(draw(family))
        across, approach, point = X[:, :3, 1], X[:, :3, 2], X[:, :3, 3]
        if shape.kind == "box":
            axis = np.abs(across).argmax(axis=1)
            np.testing.assert_allclose(np.asarray(shape.size)[axis], family.width, atol=1e-12)
        else:
            assert family.width == pytest.approx(2 * shape.size[0])
        np.testing.assert_allclose(np.einsum("ni,ni->n", point, across), 0.0, atol=1e-12)
        if shape.kind in ("cylinder", "capsule"):
            np.testing.assert_allclose(across[:, 2], 0.0, atol=1e-12)
        else:
            assert all(any(np.allclose(a, face_normal(name)) for name in asked) for a in approach)


def test_depth_is_measured_from_the_near_face_and_offset_along_it() -> None:
    for family in grasps_of(BOX, antipodal("+x", offset=0.05, depth=(0.01, 0.02))):
        X = family.pose(draw(family, 400))
        depth = X[:, 0, 3] + BOX.size[0] / 2
        assert 0.01 <= depth.min() < 0.0105
        assert 0.0195 < depth.max() <= 0.02
        along = np.einsum("ni,ni->n", X[:, :3, 3], X[:, :3, 0])
        assert -0.05 <= along.min() < -0.048
        assert 0.048 < along.max() <= 0.05


def test_what_does_not_fit_the_gripper_has_no_family() -> None:
    assert grasp_families(thing(BOX, antipodal("-z"), EXPLICIT), 0.03) == []
    assert len(grasp_families(thing(BOX, antipodal("-z")), 0.05)) == 2, "only across the 4 cm, from either side"
    assert grasp_families(thing(ROD, antipodal("-z", "+x")), 0.039) == []
    assert grasp_families(thing(BOX), 0.08) == []


@pytest.mark.parametrize("face", FACES)
def test_a_placed_object_stands_on_its_face_inside_the_region(face: str) -> None:
    support = region(size=(0.3, 0.2), yaw=(-0.4, 0.3))
    (family,) = places_of(support, face)
    assert isinstance(family, RegionPlacement)
    X_SO = inverse(support.X_BS.GetAsMatrix4()) @ family.pose(draw(family, 200))
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(BOX.size) / 2
    heights = (np.einsum("nij,kj->nki", X_SO[:, :3, :3], corners) + X_SO[:, None, :3, 3])[:, :, 2]
    np.testing.assert_allclose(np.sort(heights, axis=1)[:, :4], 0.0, atol=1e-12)
    np.testing.assert_allclose(X_SO[:, :3, :3] @ face_normal(face), np.tile([0, 0, -1.0], (200, 1)), atol=1e-12)
    assert np.all(np.abs(X_SO[:, :2, 3]) <= [0.15, 0.1])
    assert X_SO[:, 0, 3].min() < -0.12 and X_SO[:, 1, 3].max() > 0.08


def test_placements_keep_the_margin_of_their_region() -> None:
    support = region(size=(0.3, 0.01), margin=0.02)
    (family,) = places_of(support)
    X_SO = inverse(support.X_BS.GetAsMatrix4()) @ family.pose(draw(family, 200))
    assert np.all(np.abs(X_SO[:, 0, 3]) <= 0.13) and X_SO[:, 0, 3].max() > 0.12
    np.testing.assert_allclose(X_SO[:, 1, 3], 0.0, atol=1e-12)  # no room for the margin: the middle
    assert len(family.lower) == 2


def test_grasps_may_be_for_some_robots_only() -> None:
    for_left = replace(EXPLICIT, robots=("left",))
    item = thing(BOX, for_left, antipodal("-z"))
    everything = len(grasp_families(item, 0.08))
    assert len(grasp_families(item, 0.08, "left")) == everything
    assert len(grasp_families(item, 0.08, "right")) == everything - 1


def test_supports_say_who_may_stand_there() -> None:
    item = thing(BOX)
    assert placement_families(item, region(objects=("other",))) == []
    assert len(placement_families(item, region(objects=("thing", "other")))) == 1
    on_itself = Support("top of thing", "thing", RigidTransform(), (0.0, 0.0))
    assert placement_families(item, on_itself) == []
    X_BO = RigidTransform(RotationMatrix.MakeZRotation(0.4), [0.1, 0, 0.2])
    (family,) = placement_families(item, region(X_BO=X_BO))
    np.testing.assert_array_equal(family.pose(np.zeros((1, 0)))[0], X_BO.GetAsMatrix4())
