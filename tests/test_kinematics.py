"""Batched kinematics agree with Drake: poses, grasp frame, Jacobian of real and odd robots; edge rotations."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.tree import JacobianWrtVariable

from mrtamp.kinematics import Chain, Tool, inverse, matrix, quaternions, rotation_vectors
from mrtamp.problem import MrtampError, Problem, Robot, RobotModel
from mrtamp.robot_file import load_robot_model
from mrtamp.scene import Scene, build_scene, chain_of, robot_joints

ROOT = Path(__file__).resolve().parents[1]
DRAKE_MODELS = Path(os.environ.get("DRAKE_MODELS_DIR", ROOT.parent / "shared" / "drake_models"))
OFFICIAL = ROOT / "tests" / "data" / "robots" / "panda_official.yaml"
X_WB = RigidTransform(RollPitchYaw(0.3, -0.2, 1.1), [0.4, -0.2, 0.3])

ODD = """
<robot name="odd">
  <link name="foot"/><link name="plate"/><link name="mast"/>
  <link name="arm"/><link name="bracket"/><link name="wrist"/>
  <link name="pin"/><link name="tip"/><link name="branch"/>
  <joint name="bolt" type="fixed"><parent link="foot"/><child link="plate"/>
    <origin xyz="0.1 0.02 -0.03" rpy="0.1 0.2 0.3"/></joint>
  <joint name="lift" type="prismatic"><parent link="plate"/><child link="mast"/>
    <origin xyz="0 0.1 0.2" rpy="-0.4 0.1 0.7"/><axis xyz="0.3 -0.5 0.81"/>
    <limit lower="-0.3" upper="0.6" effort="1" velocity="0.5"/></joint>
  <joint name="turn" type="revolute"><parent link="mast"/><child link="arm"/>
    <origin xyz="0.3 0 0.1" rpy="1.2 -0.4 0"/><axis xyz="-1 2 0.5"/>
    <limit lower="-2.5" upper="1.5" effort="1" velocity="2"/></joint>
  <joint name="glue" type="fixed"><parent link="arm"/><child link="bracket"/>
    <origin xyz="0.05 0.25 0" rpy="0 1.5707963 0.2"/></joint>
  <joint name="roll" type="revolute"><parent link="bracket"/><child link="wrist"/>
    <origin xyz="0 0 0.2"/><axis xyz="0 -1 0"/><limit lower="-3" upper="3" effort="1" velocity="3"/></joint>
  <joint name="passive" type="revolute"><parent link="wrist"/><child link="pin"/>
    <origin xyz="0.02 0 0" rpy="0 0.3 0"/><axis xyz="1 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="3"/></joint>
  <joint name="cap" type="fixed"><parent link="pin"/><child link="tip"/><origin xyz="0 0 0.07" rpy="0.2 0 0"/></joint>
  <joint name="aside" type="prismatic"><parent link="arm"/><child link="branch"/><origin xyz="0 -0.1 0"/>
    <axis xyz="0 0 -1"/><limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>
</robot>
"""


def odd_robot(folder: Path) -> RobotModel:
    """Prismatic, revolute and fixed joints about odd axes; `passive` is not planned for, and q is not in file order."""
    (folder / "odd.urdf").write_text(ODD)
    return RobotModel(
        name="odd",
        model="odd.urdf",
        base="foot",
        arm_joints=("roll", "lift", "turn"),
        home=(0.0, 0.0, 0.0),
        gripper=None,
        grasp_body="tip",
        X_BG=RigidTransform(RollPitchYaw(0.5, -1.0, 2.0), [0.01, 0.02, 0.1]),
        file=folder / "odd.yaml",
    )


def alone(model: RobotModel, packages: tuple[Path, ...] = ()) -> Scene:
    home = np.array(model.home)
    return build_scene(
        Problem("alone", (Robot("robot", model, X_WB, home, home),), (), (), (), (), package_paths=packages)
    )


@pytest.fixture(scope="module", params=["panda", "panda_official", "odd"])
def scene(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    if request.param == "odd":
        return alone(odd_robot(tmp_path_factory.mktemp("odd")))
    if request.param == "panda":
        return alone(load_robot_model("panda"))
    if not (DRAKE_MODELS / "package.xml").exists():
        pytest.skip("the official Panda is not there; set DRAKE_MODELS_DIR")
    return alone(load_robot_model(str(OFFICIAL), (DRAKE_MODELS,)), (DRAKE_MODELS,))


def samples(chain: Chain, n: int = 30) -> np.ndarray:
    return np.random.default_rng(0).uniform(chain.lower, chain.upper, size=(n, chain.n))


def drake_context(scene: Scene, q: np.ndarray):
    """The plant's context with the arm at q (n,) and the fingers open."""
    in_scene = scene.robots["robot"]
    _, context = scene.context()
    positions = scene.plant.GetPositions(context)
    positions[in_scene.arm] = q
    positions[in_scene.fingers] = in_scene.finger_positions(None)
    scene.plant.SetPositions(context, positions)
    return context


def test_body_poses_are_drakes(scene: Scene) -> None:
    chain, _ = chain_of(scene, "robot")
    q = samples(chain)
    R, p = chain.poses(q)
    assert len(chain.bodies) == scene.plant.num_bodies() - 1, "every body but the world"
    for i, row in enumerate(q):
        context = drake_context(scene, row)
        for b, name in enumerate(chain.bodies):
            X_WL = scene.plant.GetBodyByName(name).EvalPoseInWorld(context)
            np.testing.assert_allclose(R[b, i], X_WL.rotation().matrix(), atol=1e-12)
            np.testing.assert_allclose(p[b, i], X_WL.translation(), atol=1e-12)
    some = chain.bodies[::-2]
    np.testing.assert_array_equal(chain.poses(q, some)[1], p[[chain.bodies.index(b) for b in some]])


def test_grasp_frame_and_jacobian_are_drakes(scene: Scene) -> None:
    chain, tool = chain_of(scene, "robot")
    in_scene = scene.robots["robot"]
    model, plant = in_scene.robot.model, scene.plant
    q = samples(chain)
    R, p, J = tool.jacobian(q)
    X = tool.matrix(q)
    body = plant.GetBodyByName(model.grasp_body)
    world = plant.world_frame()
    for i, row in enumerate(q):
        context = drake_context(scene, row)
        X_WG = body.EvalPoseInWorld(context) @ model.X_BG
        np.testing.assert_allclose(X[i], X_WG.GetAsMatrix4(), atol=1e-12)
        np.testing.assert_array_equal(X[i], matrix(R[i], p[i]))
        Jv = plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kQDot, body.body_frame(), model.X_BG.translation(), world, world
        )
        np.testing.assert_allclose(J[i], Jv[:, in_scene.arm], atol=1e-12)


def test_limits_are_drakes(scene: Scene) -> None:
    chain, _ = chain_of(scene, "robot")
    joints = [scene.plant.GetJointByName(j) for j in scene.robots["robot"].robot.model.arm_joints]
    np.testing.assert_array_equal(chain.lower, [j.position_lower_limits()[0] for j in joints])
    np.testing.assert_array_equal(chain.upper, [j.position_upper_limits()[0] for j in joints])
    np.testing.assert_array_equal(chain.velocity, [j.velocity_upper_limits()[0] for j in joints])
    np.testing.assert_array_equal(chain.prismatic, [j.type_name() == "prismatic" for j in joints])


def test_joints_that_are_not_planned_for_stay_where_they_are_fixed(tmp_path: Path) -> None:
    scene = alone(odd_robot(tmp_path))
    in_scene = scene.robots["robot"]
    model = in_scene.robot.model
    chain = Chain(robot_joints(scene.plant, in_scene), "foot", X_WB, model.arm_joints, {"passive": 0.7, "aside": 0.15})
    q = samples(chain, 5)
    X_WG = Tool(chain, "tip", RigidTransform()).matrix(q)
    R, p = chain.poses(q)
    for i, row in enumerate(q):
        context = drake_context(scene, row)
        scene.plant.GetJointByName("passive").set_angle(context, 0.7)
        scene.plant.GetJointByName("aside").set_translation(context, 0.15)
        tip = scene.plant.GetBodyByName("tip").EvalPoseInWorld(context)
        np.testing.assert_allclose(X_WG[i], tip.GetAsMatrix4(), atol=1e-12)
        branch = scene.plant.GetBodyByName("branch").EvalPoseInWorld(context)
        b = chain.bodies.index("branch")
        np.testing.assert_allclose(matrix(R[b, i], p[b, i]), branch.GetAsMatrix4(), atol=1e-12)


def test_a_tool_on_a_branch_or_on_the_base_has_the_right_columns(tmp_path: Path) -> None:
    scene = alone(odd_robot(tmp_path))
    model = scene.robots["robot"].robot.model
    chain, _ = chain_of(scene, "robot")
    q = samples(chain, 4)
    roll, lift, turn = (model.arm_joints.index(j) for j in ("roll", "lift", "turn"))
    J = Tool(chain, "branch", RigidTransform()).jacobian(q)[2]
    assert np.all(J[:, :, roll] == 0)
    assert np.all(np.linalg.norm(J[:, 3:, lift], axis=1) > 0.99)
    assert np.all(np.linalg.norm(J[:, :3, turn], axis=1) > 0.99)
    assert np.all(Tool(chain, "foot", RigidTransform()).jacobian(q)[2] == 0)


def test_an_unknown_arm_joint_is_named(tmp_path: Path) -> None:
    scene = alone(odd_robot(tmp_path))
    with pytest.raises(MrtampError, match=r"elbow.*lift"):
        Chain(robot_joints(scene.plant, scene.robots["robot"]), "foot", X_WB, ("lift", "elbow"), {})


def rotations() -> list[RotationMatrix]:
    """Random rotations, none at all, and half turns (nearly and exactly) about axes in all directions."""
    rng = np.random.default_rng(1)
    axes = [*np.eye(3), *(-np.eye(3)), *rng.normal(size=(20, 3)), [1, 1, 0], [0, 1, -1], [1e-9, 1, 0]]
    angles = [0.0, 1e-12, 1e-7, 0.5, np.pi / 2, np.pi - 1e-4, np.pi - 1e-7, np.pi, 3.5, 2 * np.pi - 1e-7]
    return [RotationMatrix(AngleAxis(a, np.array(v) / np.linalg.norm(v))) for a in angles for v in axes]


def test_quaternions_are_drakes_up_to_sign() -> None:
    R = rotations()
    ours = quaternions(np.array([r.matrix() for r in R]))
    theirs = np.array([r.ToQuaternion().wxyz() for r in R])
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", ours, theirs)), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(ours, axis=1), 1.0, atol=1e-14)
    back = np.array([RotationMatrix(Quaternion(q)).matrix() for q in ours])
    np.testing.assert_allclose(back, [r.matrix() for r in R], atol=1e-12)


def test_rotation_vectors_are_drakes_axis_and_angle() -> None:
    R = rotations()
    ours = rotation_vectors(np.array([r.matrix() for r in R]))
    angle = np.array([r.ToAngleAxis().angle() for r in R])
    np.testing.assert_allclose(np.linalg.norm(ours, axis=1), angle, atol=1e-7)
    for v, r in zip(ours, R, strict=True):
        size = np.linalg.norm(v)
        again = RotationMatrix(AngleAxis(size, v / size)) if size > 0 else RotationMatrix()
        np.testing.assert_allclose(again.matrix(), r.matrix(), atol=1e-7)
    small = np.random.default_rng(2).normal(scale=1e-9, size=(5, 3))
    skew = np.array([[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in small])
    np.testing.assert_allclose(rotation_vectors(np.eye(3) + skew), small, rtol=1e-6)


def test_inverse_is_the_inverse_for_stacks_of_transforms() -> None:
    rng = np.random.default_rng(3)
    X = np.array(
        [RigidTransform(RollPitchYaw(*rng.uniform(-3, 3, 3)), rng.normal(size=3)).GetAsMatrix4() for _ in "abcdef"]
    )
    np.testing.assert_allclose(inverse(X) @ X, np.broadcast_to(np.eye(4), X.shape), atol=1e-14)
    stacked = X.reshape(2, 3, 4, 4)
    np.testing.assert_array_equal(inverse(stacked), inverse(X).reshape(2, 3, 4, 4))
