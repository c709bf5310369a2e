"""Batched inverse kinematics: what it calls solved is solved, it stays within limits, and it finds what Drake finds."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.plant import MultibodyPlant
from pydrake.solvers import Solve

from mrtamp.kinematics import Tool
from mrtamp.problem import Problem, Robot
from mrtamp.robot_file import load_robot_model
from mrtamp.scene import Scene, build_scene, chain_of
from mrtamp.transitions.projection import TOLERANCE, mixed_seeds, solve_ik, uniform_configurations


@pytest.fixture(scope="module")
def scene() -> Scene:
    panda = load_robot_model("panda")
    home = np.array(panda.home)
    X_WB = RigidTransform(RollPitchYaw(0, 0, 0.7), [0.2, -0.1, 0.05])
    return build_scene(Problem("alone", (Robot("panda", panda, X_WB, home, home),), (), (), (), ()))


@pytest.fixture(scope="module")
def tool(scene: Scene) -> Tool:
    return chain_of(scene, "panda")[1]


def reachable(tool: Tool, n: int, seed: int = 0, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the grasp frame at random configurations, a share of the joint range away from the limits."""
    rng = np.random.default_rng(seed)
    gap = margin * (tool.chain.upper - tool.chain.lower)
    return tool.pose(rng.uniform(tool.chain.lower + gap, tool.chain.upper - gap, size=(n, tool.chain.n)))


def error(tool: Tool, q: np.ndarray, R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Largest of angle (rad) and distance (m) to the targets."""
    R_q, p_q = tool.pose(q)
    angle = [RotationMatrix.ProjectToRotationMatrix(a.T @ b).ToAngleAxis().angle() for a, b in zip(R_q, R, strict=True)]
    return np.maximum(np.abs(angle), np.linalg.norm(p_q - p, axis=1))


def test_solutions_are_solutions_within_the_limits(tool: Tool) -> None:
    R, p = reachable(tool, 300)
    q, solved = solve_ik(tool, R, p, uniform_configurations(tool, np.random.default_rng(1), 300))
    assert q.shape == (300, 7)
    assert error(tool, q[solved], R[solved], p[solved]).max() < 10 * TOLERANCE
    assert np.all(q >= tool.chain.lower) and np.all(q <= tool.chain.upper)
    assert np.all(error(tool, q[~solved], R[~solved], p[~solved]) > TOLERANCE / 2)


def test_reachable_targets_are_found(tool: Tool) -> None:
    """Away from the limits: from a third of single uniform seeds or so, and nearly every target with twenty of them."""
    R, p = reachable(tool, 100, margin=0.15)
    seeds = uniform_configurations(tool, np.random.default_rng(2), 2000)
    _, solved = solve_ik(tool, np.repeat(R, 20, axis=0), np.repeat(p, 20, axis=0), seeds)
    solved = solved.reshape(100, 20)
    assert solved.mean() > 0.25
    assert solved.any(axis=1).mean() > 0.97


def test_from_nearby_seeds_almost_every_target_is_found_nearby(tool: Tool) -> None:
    rng = np.random.default_rng(3)
    gap = 0.1 * (tool.chain.upper - tool.chain.lower)
    truth = rng.uniform(tool.chain.lower + gap, tool.chain.upper - gap, size=(300, 7))
    R, p = tool.pose(truth)
    q, solved = solve_ik(tool, R, p, truth + rng.normal(scale=0.1, size=truth.shape))
    assert solved.mean() > 0.97
    assert np.median(np.linalg.norm(q - truth, axis=1)[solved]) < 0.5


def test_a_seed_that_is_a_solution_is_returned_as_it_is(tool: Tool) -> None:
    truth = uniform_configurations(tool, np.random.default_rng(4), 20)
    q, solved = solve_ik(tool, *tool.pose(truth), truth)
    assert solved.all()
    np.testing.assert_array_equal(q, truth)


def test_unreachable_targets_are_not_solved(tool: Tool) -> None:
    R, p = reachable(tool, 50)
    q, solved = solve_ik(tool, R, p + np.array([3.0, 0, 0]), uniform_configurations(tool, np.random.default_rng(5), 50))
    assert not solved.any()
    assert np.isfinite(q).all()
    assert np.all(q >= tool.chain.lower) and np.all(q <= tool.chain.upper)


def test_half_a_turn_away_is_no_obstacle(tool: Tool) -> None:
    """The rotation error is largest and its direction least certain at pi."""
    home = np.array(load_robot_model("panda").home)
    R, p = tool.pose(home[None])
    turned = (R[0] @ RotationMatrix.MakeZRotation(np.pi).matrix())[None]
    seeds = np.vstack([home, mixed_seeds(tool, np.random.default_rng(0), 9, home[None])])
    _, solved = solve_ik(tool, np.tile(turned, (10, 1, 1)), np.tile(p, (10, 1)), seeds)
    assert solved.any()


def test_no_targets_no_solutions(tool: Tool) -> None:
    q, solved = solve_ik(tool, np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 7)))
    assert q.shape == (0, 7) and solved.shape == (0,)


def drake_ik(plant: MultibodyPlant, scene: Scene, R: np.ndarray, p: np.ndarray, seed: np.ndarray) -> bool:
    """Whether Drake's InverseKinematics finds a configuration for one target from one seed."""
    in_scene = scene.robots["panda"]
    model = in_scene.robot.model
    frame, world = plant.GetFrameByName(model.grasp_body), plant.world_frame()
    ik = InverseKinematics(plant)
    p_BG, R_BG = model.X_BG.translation(), model.X_BG.rotation()
    ik.AddPositionConstraint(frame, p_BG, world, p - 1e-6, p + 1e-6)
    ik.AddOrientationConstraint(frame, R_BG, world, RotationMatrix(R.T).inverse(), 1e-5)
    start = plant.GetPositions(plant.CreateDefaultContext())
    start[in_scene.arm] = seed
    ik.prog().SetInitialGuess(ik.q(), start)
    return bool(Solve(ik.prog()).is_success())


def test_what_drake_solves_is_solved_and_vice_versa(scene: Scene, tool: Tool) -> None:
    """40 targets, some of them out of reach: SNOPT from five seeds each, ours from twenty-five (in less time)."""
    R, p = reachable(tool, 40, seed=6, margin=0.1)
    p[30:] += 2.0
    seeds = uniform_configurations(tool, np.random.default_rng(6), 1000).reshape(40, 25, 7)
    _, solved = solve_ik(tool, np.repeat(R, 25, axis=0), np.repeat(p, 25, axis=0), seeds.reshape(-1, 7))
    ours = solved.reshape(40, 25).any(axis=1)
    theirs = np.array([any(drake_ik(scene.plant, scene, R[i], p[i], s) for s in seeds[i, :5]) for i in range(40)])
    assert theirs[:30].mean() > 0.8
    assert not (ours | theirs)[30:].any()
    assert np.all(ours[:30] >= theirs[:30])


def test_uniform_configurations_fill_the_joint_range(tool: Tool) -> None:
    q = uniform_configurations(tool, np.random.default_rng(0), 5000)
    share = (q - tool.chain.lower) / (tool.chain.upper - tool.chain.lower)
    assert share.min() >= 0 and share.max() <= 1
    counts = np.array([np.histogram(x, bins=10, range=(0, 1))[0] for x in share.T])
    assert counts.min() > 400 and counts.max() < 600


def test_mixed_seeds_are_partly_near_and_partly_uniform(tool: Tool) -> None:
    near = uniform_configurations(tool, np.random.default_rng(0), 2) * 0.3
    q = mixed_seeds(tool, np.random.default_rng(1), 2000, near, spread=0.05, share=0.6)
    close = np.linalg.norm(q[:, None] - near, axis=2).min(axis=1) < 0.4
    assert 0.55 < close.mean() < 0.65
    assert np.all(np.linalg.norm(q[:, None] - near, axis=2).argmin(axis=1)[close].mean() > 0.3)
