"""Strata T^A: closed-form rank and dimension, verified numerically at samples; samples and projections lie on them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from mrtamp.kinematics import Tool, inverse
from mrtamp.problem import AntipodalGrasps, ExplicitGrasp, MovableObject, Problem, Robot, Shape, Support
from mrtamp.robot_file import load_robot_model
from mrtamp.scene import build_scene, chain_of
from mrtamp.transitions.families import grasp_families, placement_families
from mrtamp.transitions.stratum import SimultaneousStratum, Stratum

DOWN = RigidTransform(RollPitchYaw(np.pi, 0, 0), [0, 0, 0.0])
X_GO = DOWN.inverse().GetAsMatrix4()
BAR = Shape("box", (0.2, 0.04, 0.04))
ROD = Shape("cylinder", (0.02, 0.2))
TOP = AntipodalGrasps(("-z",), 0.06, (0.01, 0.03))
SIDE = AntipodalGrasps(("+y",), 0.06, (0.01, 0.03))


def _tools() -> dict[str, Tool]:
    panda = load_robot_model("panda")
    home = np.array(panda.home)
    bases = {"left": RigidTransform([-0.45, 0, 0]), "right": RigidTransform(RollPitchYaw(0, 0, np.pi), [0.45, 0, 0])}
    robots = tuple(Robot(name, panda, X_WB, home, home) for name, X_WB in bases.items())
    scene = build_scene(Problem("two", robots, (), (), (), ()))
    return {name: chain_of(scene, name)[1] for name in bases}


TOOLS = _tools()


def thing(shape: Shape, *grasps: AntipodalGrasps | ExplicitGrasp, faces: tuple[str, ...] = ("-z",)) -> MovableObject:
    return MovableObject("bar", "table", RigidTransform(), None, shape, grasps=grasps, resting_faces=faces)


def pick(shape: Shape, grasp: AntipodalGrasps | ExplicitGrasp, robot: str = "left", index: int = 0) -> Stratum:
    """Picks from the table, 0.45 m in front of the robot."""
    X_WO = RigidTransform(RollPitchYaw(0, 0, 0.4), [0, 0.15, 0.1]).GetAsMatrix4()
    family = grasp_families(thing(shape, grasp), 0.08)[index]
    return Stratum("pick", (robot,), "bar", (TOOLS[robot],), family, X_WO, np.eye(4))


def place(support: Support, faces: tuple[str, ...] = ("-z",), robot: str = "left") -> Stratum:
    """Places of a held bar on a support of a body 0.45 m in front of the robot."""
    X_WB = RigidTransform(RollPitchYaw(0, 0, -0.3), [0, -0.15, 0.05]).GetAsMatrix4()
    # With the bar's end up the hand comes from the side: the grasp point is in its middle either way.
    family = placement_families(thing(BAR, faces=faces), support)[0]
    return Stratum("place", (robot,), "bar", (TOOLS[robot],), family, X_WB, X_GO)


def handover(grasp: AntipodalGrasps | ExplicitGrasp, shape: Shape = BAR, index: int = 0) -> Stratum:
    tools = (TOOLS["left"], TOOLS["right"])
    family = grasp_families(thing(shape, grasp), 0.08)[index]
    held = RigidTransform(DOWN.rotation(), [0.06, 0, 0]).GetAsMatrix4()
    return Stratum("handover", ("left", "right"), "bar", tools, family, np.eye(4), np.eye(4), inverse(held))


def region(size: tuple[float, float] = (0.2, 0.1), yaw: tuple[float, float] = (-np.pi, np.pi), **keys) -> Support:
    return Support("region", "table", RigidTransform([0, 0, 0.05]), size, yaw, **keys)


def _both_at_once() -> SimultaneousStratum:
    return SimultaneousStratum((pick(BAR, TOP), place(region(), robot="right")))


def _everyone() -> SimultaneousStratum:
    return SimultaneousStratum((handover(TOP),))


EXPLICIT = ExplicitGrasp(RigidTransform(DOWN.rotation(), [0, 0, 0.005]), 0.04)
FIXED_DEPTH = AntipodalGrasps(("-z",), 0.06, (0.02, 0.02))
FIXED = AntipodalGrasps(("-z",), 0.0, (0.02, 0.02))
CASES: dict[str, tuple[Callable[[], Stratum | SimultaneousStratum], int, int]] = {
    "pick with an explicit grasp": (lambda: pick(BAR, EXPLICIT), 6, 7),
    "pick, offset and depth free": (lambda: pick(BAR, TOP), 4, 7),
    "pick from the side": (lambda: pick(BAR, SIDE), 4, 7),
    "pick, offset free": (lambda: pick(BAR, FIXED_DEPTH), 5, 7),
    "pick, nothing free": (lambda: pick(BAR, FIXED), 6, 7),
    "pick a cylinder from its end": (lambda: pick(ROD, AntipodalGrasps(("-z",), 0.0, (0.01, 0.03))), 4, 7),
    "pick a cylinder from its side": (lambda: pick(ROD, AntipodalGrasps(("+x",), 0.05, (0.01, 0.03)), index=1), 4, 7),
    "place at a pose": (lambda: place(region(X_BO=RigidTransform([0.05, 0, 0.07]))), 6, 7),
    "place in a region": (lambda: place(region()), 3, 7),
    "place in a region on a side face": (lambda: place(region(), ("+y",)), 3, 7),
    "place in a region with a given yaw": (lambda: place(region(yaw=(0.3, 0.3))), 4, 7),
    "place at a point with free yaw": (lambda: place(region(size=(0.0, 0.0))), 5, 7),
    "place with yaw around half a turn": (lambda: place(region(yaw=(2.5, 4.0))), 3, 7),
    "handover, sliding": (lambda: handover(TOP), 4, 14),
    "handover, explicit": (lambda: handover(EXPLICIT), 6, 14),
    "handover of a cylinder": (lambda: handover(AntipodalGrasps(("+x",), 0.05, (0.01, 0.03)), ROD), 4, 14),
    "pick and place at once": (_both_at_once, 4 + 3, 14),
    "everyone at once": (_everyone, 4, 14),
}


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest) -> tuple[Stratum | SimultaneousStratum, int, int, np.ndarray]:
    """A stratum, its closed-form rank and dofs, and at least 20 samples on it."""
    make, rank, dofs = CASES[request.param]
    stratum = make()
    q, _, solved = stratum.sample(np.random.default_rng(0), 400)
    assert solved.sum() >= 20, f"only {solved.sum()} of 400 samples were solved"
    return stratum, rank, dofs, q[solved][:60]


Case = tuple[Stratum | SimultaneousStratum, int, int, np.ndarray]


def limits(stratum: Stratum | SimultaneousStratum) -> tuple[np.ndarray, np.ndarray]:
    parts = stratum.parts if isinstance(stratum, SimultaneousStratum) else (stratum,)
    chains = [t.chain for s in parts for t in s.tools]
    return np.concatenate([c.lower for c in chains]), np.concatenate([c.upper for c in chains])


def test_rank_and_dimension_are_the_closed_form(case: Case) -> None:
    stratum, rank, dofs, _ = case
    assert (stratum.rank, stratum.dofs, stratum.dimension) == (rank, dofs, dofs - rank)


def test_h_vanishes_at_samples_within_the_joint_limits(case: Case) -> None:
    stratum, rank, dofs, q = case
    assert q.shape == (len(q), dofs)
    h = stratum.h(q)
    assert h.shape == (len(q), rank)
    assert np.abs(h).max() <= 1e-6
    lower, upper = limits(stratum)
    assert np.all(q >= lower) and np.all(q <= upper)


def test_the_jacobian_has_that_rank_at_every_sample(case: Case) -> None:
    stratum, rank, dofs, q = case
    J = stratum.jacobian(q)
    assert J.shape == (len(q), rank, dofs)
    singular = np.linalg.svd(J, compute_uv=False)
    assert np.all((singular > 1e-4).sum(axis=1) == rank), singular.min()


def test_the_jacobian_is_a_finite_difference_of_h(case: Case) -> None:
    """Forward differences of another step, one configuration and one joint at a time."""
    stratum, _, dofs, q = case
    J = stratum.jacobian(q[:5])
    for i, row in enumerate(q[:5]):
        for k in range(dofs):
            ahead = row + 1e-5 * np.eye(dofs)[k]
            slope = (stratum.h(ahead[None]) - stratum.h(row[None]))[0] / 1e-5
            np.testing.assert_allclose(J[i, :, k], slope, atol=2e-4)


def test_a_small_step_in_the_null_space_stays_on_the_stratum_to_second_order(case: Case) -> None:
    stratum, rank, dofs, q = case
    J = stratum.jacobian(q[:10])
    for i, row in enumerate(q[:10]):
        tangents = np.linalg.svd(J[i])[2][rank:]
        assert tangents.shape == (dofs - rank, dofs)
        assert np.abs(stratum.h(row + 1e-4 * tangents)).max(initial=0.0) < 1e-6


def test_projection_lands_on_the_stratum_and_is_idempotent(case: Case) -> None:
    stratum, _, _, q = case
    lower, upper = limits(stratum)
    off = np.clip(q + np.random.default_rng(1).normal(scale=0.05, size=q.shape), lower, upper)
    on, c, solved = stratum.project(off)
    assert solved.mean() > 0.7
    assert np.abs(stratum.h(on[solved])).max() <= 1e-6
    assert np.all(on >= lower) and np.all(on <= upper)
    again, _, still = stratum.project(on[solved])
    assert still.all()
    np.testing.assert_allclose(again, on[solved], atol=1e-5)
    for part, chosen in (
        zip(stratum.parts, c, strict=True) if isinstance(stratum, SimultaneousStratum) else [(stratum, c)]
    ):
        assert np.all(chosen >= part.family.lower) and np.all(chosen <= part.family.upper)


def test_projection_stays_near(case: Case) -> None:
    """From a point on the stratum, moved by 0.02 rad per joint, projection comes back to within a few times that."""
    stratum, _, _, q = case
    lower, upper = limits(stratum)
    off = np.clip(q + np.random.default_rng(2).uniform(-0.02, 0.02, size=q.shape), lower, upper)
    on, _, solved = stratum.project(off)
    assert np.median(np.linalg.norm(on - off, axis=1)[solved]) < 0.2


def test_choices_beyond_the_bounds_are_clipped_to_them() -> None:
    small, large = place(region(size=(0.02, 0.02))), place(region(size=(0.3, 0.2)))
    q, wanted, solved = large.sample(np.random.default_rng(0), 100)
    _, c, _ = small.project(q[solved])
    np.testing.assert_allclose(c[:, :2], np.clip(wanted[solved][:, :2], -0.01, 0.01), atol=1e-6)
    np.testing.assert_allclose(c[:, 2], wanted[solved][:, 2], atol=1e-6)


def test_choices_are_drawn_from_the_whole_family() -> None:
    stratum = place(region())
    c = stratum.draw_choices(np.random.default_rng(0), 2000)
    share = (c - stratum.family.lower) / (stratum.family.upper - stratum.family.lower)
    counts = np.histogramdd(share, bins=4, range=[(0, 1)] * 3)[0]
    assert counts.min() > 10, "2000 draws over 64 cells"


def test_seeds_near_known_configurations_give_short_motions() -> None:
    stratum = place(region())
    home = np.array(load_robot_model("panda").home)

    def distances(near: np.ndarray | None) -> np.ndarray:
        q, _, solved = stratum.sample(np.random.default_rng(0), 400, near)
        return np.sort(np.linalg.norm(q[solved] - home, axis=1))

    close, anywhere = distances(home[None]), distances(None)
    assert len(close) > len(anywhere)
    assert np.median(close) < 0.9 * np.median(anywhere)
    assert close[-1] > 4, "some samples are far all the same"


def test_simultaneous_strata_are_products() -> None:
    one, two = pick(BAR, TOP), place(region(), robot="right")
    both = SimultaneousStratum((one, two))
    assert both.active == ("left", "right")
    assert both.rank == one.rank + two.rank
    assert both.dimension == one.dimension + two.dimension
    q = np.random.default_rng(0).uniform(-1, 1, size=(3, 14))
    np.testing.assert_array_equal(both.h(q), np.hstack([one.h(q[:, :7]), two.h(q[:, 7:])]))
    J = both.jacobian(q)
    assert np.all(J[:, :4, 7:] == 0) and np.all(J[:, 4:, :7] == 0)
    np.testing.assert_array_equal(J[:, 4:, 7:], two.jacobian(q[:, 7:]))
