"""One robot out of several model files: an arm and a gripper, combined as README says, are the robot in one file."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import mrtamp
from mrtamp.problem import Problem, ProblemError
from mrtamp.scene import build_scene, chain_of, geometry_ids, robot_bodies

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")
[MERGED] = re.findall(r"```xml\n(.*?)```", README, flags=re.DOTALL)
NESTED = (
    MERGED.replace(' merge="true"', "")
    .replace(">flange<", ">arm::flange<")
    .replace(">hand</child", ">hand::hand</child")
)
NESTED = NESTED.replace('"flange"', '"arm::flange"')
DIRECTIVES = """directives:
- add_model: {name: arm, file: package://parts/arm.urdf}
- add_model: {name: hand, file: package://parts/hand.urdf}
- add_weld:
    parent: arm::flange
    child: hand::hand
    X_PC: {translation: [0, 0, 0.05], rotation: !Rpy {deg: [0, 0, 90]}}
"""
BOX = '<collision><origin xyz="0 0 {z}"/><geometry><box size="{size}"/></geometry></collision>'
INERTIA = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
ARM = f"""
  <link name="base">{BOX.format(z=0.1, size="0.1 0.1 0.1")}</link>
  <link name="upper">{INERTIA}{BOX.format(z=0.25, size="0.04 0.04 0.2")}</link>
  <link name="flange">{INERTIA}</link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.2"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="flange"/><origin xyz="0 0 0.4"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2"/></joint>"""
HAND = f"""
  <link name="hand">{INERTIA}{BOX.format(z=0.02, size="0.1 0.03 0.02")}</link>
  <link name="finger">{INERTIA}{BOX.format(z=0.06, size="0.01 0.02 0.05")}</link>
  <joint name="slide" type="prismatic"><parent link="hand"/><child link="finger"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.08"/></joint>"""
MOUNT = """
  <joint name="mount" type="fixed"><parent link="flange"/><child link="hand"/>
    <origin xyz="0 0 0.05" rpy="0 0 1.5707963267948966"/></joint>"""
ROBOT = """
mrtamp_robot: 1
name: arm
model: {model}
base: base
arm_joints: [shoulder, elbow]
home: [0.0, 0.5]
gripper: {{bodies: [hand, finger], joints: {{slide: 1.0}}, max_width: 0.08}}
grasp_frame: {{body: hand, X_BG: {{translation: [0, 0.02, 0.1]}}}}
collision_exceptions: [[upper, hand]]
"""
PROBLEM = """
mrtamp: 1
name: two
packages: [.]
robots:
  - {{name: left, model: {robot}, X_WB: {{translation: [-0.5, 0, 0]}}}}
  - {{name: right, model: {robot}, X_WB: {{translation: [0.5, 0, 0], rotation: !Rpy {{deg: [0, 0, 180]}}}}}}
goal:
  - {{robot: left, at: [1.0, 0.5]}}
  - {{robot: right, at: [-1.0, 1.5]}}
"""
FILES = {"merged.sdf": MERGED, "nested.sdf": NESTED, "welded.dmd.yaml": DIRECTIVES}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with the arm and the hand alone, in one file, and combined in every way."""
    texts = {"arm.urdf": ("arm", ARM), "hand.urdf": ("hand", HAND), "whole.urdf": ("whole", ARM + HAND + MOUNT)}
    for name, (robot, content) in texts.items():
        (tmp_path / name).write_text(f'<robot name="{robot}">{content}\n</robot>\n')
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "package.xml").write_text('<package format="2"><name>parts</name></package>\n')
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MRTAMP_PACKAGE_PATH", raising=False)
    return tmp_path


def load(model: str) -> Problem:
    """Two of the robots described by `model`."""
    Path("robot.yaml").write_text(ROBOT.format(model=model))
    Path("problem.yaml").write_text(PROBLEM.format(robot="robot.yaml"))
    return mrtamp.load_problem("problem.yaml")


@pytest.mark.parametrize("file", FILES)
def test_combined_robot_is_the_whole_robot(folder: Path, file: str) -> None:
    whole, combined = (build_scene(load(model)) for model in ("whole.urdf", file))
    q = np.random.default_rng(0).uniform(-1.5, 1.5, size=(20, 2))
    for name in ("left", "right"):
        frames = [chain_of(scene, name, 0.03)[1].matrix(q) for scene in (whole, combined)]
        np.testing.assert_allclose(*frames, atol=1e-4)  # README turns by 1.5708
        solids = [
            [len(geometry_ids(s.plant, [b])) for b in robot_bodies(s.plant, s.robots[name])] for s in (whole, combined)
        ]
        assert solids[0] == solids[1]
        assert len(combined.robots[name].fingers) == 1
    filtered = []
    for scene in (whole, combined):
        ids = geometry_ids(scene.plant, [b for r in scene.robots.values() for b in robot_bodies(scene.plant, r)])
        inspector = scene.scene_graph.model_inspector()
        filtered.append([inspector.CollisionFiltered(a, b) for a in ids for b in ids])
    assert filtered[0] == filtered[1]
    assert not all(filtered[0])


@pytest.mark.parametrize("file", FILES)
def test_combined_robots_are_planned_for(folder: Path, file: str) -> None:
    planner = mrtamp.Planner(load(file), seed=0)
    plan = next(iter(planner.improve(iterations=50, first=True)))
    plan.save("plan.json")
    assert mrtamp.check_plan(mrtamp.Plan.load("plan.json")).ok


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (DIRECTIVES[DIRECTIVES.index("- add_weld") :], "", "nothing connects (base, hand)"),
        (
            "name: hand, file: package://parts/hand.urdf",
            "name: hand, file: package://parts/whole.urdf",
            "several bodies or joints named base, upper, flange",
        ),
        ("- add_weld", "- add_weld: {parent: world, child: arm::base}\n- add_weld", "'base' fixed to the world"),
    ],
    ids=["loose", "repeated", "anchored"],
)
def test_parts_that_are_no_robot(folder: Path, old: str, new: str, says: str) -> None:
    assert DIRECTIVES.count(old) == 1
    (folder / "welded.dmd.yaml").write_text(DIRECTIVES.replace(old, new))
    with pytest.raises(ProblemError, match=re.escape(says)) as caught:
        load("welded.dmd.yaml")
    assert "robot.yaml:4: model: " in str(caught.value)


def test_file_that_works_only_once_is_reported(folder: Path) -> None:
    camera = "- add_frame: {name: camera, X_PF: {base_frame: world}}\n"
    (folder / "welded.dmd.yaml").write_text(DIRECTIVES + camera)
    with pytest.raises(ProblemError, match=r"cannot parse the model .*welded\.dmd\.yaml: .*camera"):
        build_scene(load("welded.dmd.yaml"))


def test_body_of_the_world_is_one_model(folder: Path) -> None:
    text = PROBLEM.format(robot="panda") + "world:\n  - {name: thing, model: welded.dmd.yaml}\n"
    Path("problem.yaml").write_text(text)
    with pytest.raises(ProblemError, match=r"world\[0\].model: .* holds the models arm, hand, expected one"):
        mrtamp.load_problem("problem.yaml")
