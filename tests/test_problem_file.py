"""Problem files: what a right one means, and that it survives the way through a dict and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from mrtamp.problem import (
    AntipodalGrasps,
    AtConfiguration,
    AtPose,
    Attach,
    CollisionRules,
    ExplicitGrasp,
    HandAt,
    HandIn,
    HeldBy,
    InRegion,
    Problem,
    ProblemError,
    RobotAt,
)
from mrtamp.problem_file import list_problems, load_problem, problem_from_dict, problem_to_dict
from mrtamp.reading import parse_document

EXAMPLE = Path(__file__).parent / "data" / "example"
URDF, ROBOT, PROBLEM = ((EXAMPLE / name).read_text() for name in ("arm.urdf", "arm.yaml", "example.yaml"))


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the example arm; also the working directory, where the relative paths of a dict start."""
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "arm.yaml").write_text(ROBOT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MRTAMP_PACKAGE_PATH", raising=False)
    return tmp_path


def load(text: str) -> Problem:
    """The problem that `text` states, read through a file."""
    Path("example.yaml").write_text(text)
    return load_problem("example.yaml")


def change(old: str, new: str, text: str = PROBLEM) -> str:
    """`text` with its one occurrence of `old` replaced."""
    assert text.count(old) == 1, old
    return text.replace(old, new)


def example_data() -> dict[str, Any]:
    """The example as plain data."""
    data: dict[str, Any] = parse_document(PROBLEM, "example", Path.cwd()).data
    return data


# What a right file means.


def test_every_section_is_read() -> None:
    problem = load(PROBLEM)
    left, right = problem.robots
    assert left.start.tolist() == left.home.tolist() == [0.0, 0.5]
    assert (right.home.tolist(), right.start.tolist()) == ([0.1, 0.2], [1.0, 0.3])
    assert right.X_WB.rotation().matrix() == pytest.approx(RotationMatrix.MakeZRotation(np.pi).matrix())
    assert right.X_WB.translation() == pytest.approx([0.5, 0, 0])
    assert left.model.gripper is not None
    assert (left.model.gripper.bodies, left.model.gripper.joints) == (("hand", "finger"), {"slide": 1.0})
    assert [s.name for s in problem.supports] == ["left_table", "right_table", "start of blue", "top of red"]
    assert problem.cost.transitions == {"handover": 0.5}
    assert [type(c) for c in problem.goal] == [InRegion, AtPose, RobotAt]
    antipodal, explicit = problem.object("red").grasps
    assert isinstance(antipodal, AntipodalGrasps)
    assert (antipodal.approaches, antipodal.offset, antipodal.depth) == (("-z", "+x"), 0.01, (0.02, 0.03))
    assert isinstance(explicit, ExplicitGrasp)
    assert np.allclose(explicit.X_OG.rotation().matrix(), np.diag([1, -1, -1]))


def test_start_in_a_region_rests_on_it() -> None:
    red = load(PROBLEM).object("red")
    assert (red.start_on, red.start_support) == ("table", "left_table")
    assert red.start_X_BO.rotation().matrix() == pytest.approx(RotationMatrix.MakeZRotation(np.pi / 6).matrix())
    assert red.start_X_BO.translation() == pytest.approx([-0.3, 0.2, 0.075])


def test_exact_start_becomes_a_support_of_its_own() -> None:
    problem = load(PROBLEM)
    blue, support = problem.object("blue"), problem.support("start of blue")
    assert blue.start_support == "start of blue"
    assert (support.body, support.objects) == ("table", ("blue",))
    assert support.X_BO is not None
    assert support.X_BO.IsNearlyEqualTo(blue.start_X_BO, 0)
    assert support.X_BS.translation() == pytest.approx([0.3, 0.2, 0.05])


def test_goal_on_an_object_becomes_its_top() -> None:
    top = load(PROBLEM).support("top of red")
    assert (top.body, top.size, top.objects, top.X_BO) == ("red", (0.0, 0.0), None, None)
    assert top.X_BS.translation() == pytest.approx([0, 0, 0.025])


def test_goal_poses_become_supports() -> None:
    goal = "{object: red, at: {translation: [0.2, 0.1, 0.025]}, on: table}"
    problem = load(change("{object: red, in: right_table}", goal))
    condition, support = problem.goal[0], problem.support("goal of red")
    assert isinstance(condition, AtPose)
    assert condition.X_BO is not None
    assert condition.X_BO.translation() == pytest.approx([0.2, 0.1, 0.075])
    assert support.objects == ("red",)


def test_held_by_and_configuration_goals() -> None:
    text = change("{object: red, in: right_table}", "{object: red, held_by: left}")
    problem = load(change("{robot: right, at: home}", "{robot: right, at: [-1.5, 0.5]}", text))
    held, at = problem.goal[0], problem.goal[2]
    assert held == HeldBy("red", "left")
    assert isinstance(at, RobotAt)
    assert at.q.tolist() == [-1.5, 0.5]


def test_region_defaults_to_the_whole_top() -> None:
    support = load(change(", X_BS: {translation: [0.4, 0, 0.05]}, size: [0.4, 0.6]", "")).support("right_table")
    assert support.size == (2.0, 1.0)
    assert support.X_BS.IsNearlyEqualTo(RigidTransform([0, 0, 0.05]), 0)
    assert support.margin == 0.01, "things would fall over the edge"
    assert support.reach == (0.99, 0.49)


@pytest.mark.parametrize(
    ("keys", "margin"),
    [
        (", size: [0.4, 0.6]", 0.0),
        (", size: [0.4, 0.6], margin: 0.03", 0.03),
        (", margin: 0", 0.0),
        (", X_BO: {translation: [0.999, 0, 0.09]}", 0.0),
    ],
)
def test_margin_of_a_support(keys: str, margin: float) -> None:
    problem = load(change(", X_BS: {translation: [0.4, 0, 0.05]}, size: [0.4, 0.6]", keys))
    assert problem.support("right_table").margin == margin
    assert problem_from_dict(problem_to_dict(problem)).support("right_table").margin == margin
    assert {s.margin for s in problem.supports if s.name != "right_table"} == {0.0}


def test_start_keeps_the_margin_of_its_region() -> None:
    text = change("size: [0.4, 0.6]}\n  - {name: right", "size: [0.4, 0.6], margin: 0.1}\n  - {name: right")
    load(text)
    with pytest.raises(ProblemError, match=r"less its margin of 0\.1 m: \|x\| <= 0\.1, \|y\| <= 0\.2"):
        load(change("xy: [0.1, 0.2]", "xy: [0.11, 0.2]", text))


def test_grasps_for_some_robots() -> None:
    text = change("width: 0.05}", "width: 0.05, robots: [right]}")
    problem = load(change("depth: [0.02, 0.03]}", "depth: [0.02, 0.03]}\n        robots: [left, right]", text))
    for read in (problem, problem_from_dict(problem_to_dict(problem))):
        assert [grasp.robots for grasp in read.object("red").grasps] == [("left", "right"), ("right",)]
        assert {grasp.robots for grasp in read.object("blue").grasps} == {None}


def test_top_is_the_face_that_looks_up() -> None:
    """A plank on its edge is 0.1 m wide on top, and its region frame looks up in the world."""
    plank = "X_WB: {translation: [0, 0, -0.5], rotation: !Rpy {deg: [90, 0, 0]}}"
    text = change("X_WB: {translation: [0, 0, -0.05]}", plank)
    text = change("{name: left_table, on: table, X_BS: {translation: [-0.4, 0, 0.05]}, size: [0.4, 0.6]}", "", text)
    text = change("  - \n", "", text)
    text = change("X_BS: {translation: [0.4, 0, 0.05]}, size: [0.4, 0.6]}", "}", text)
    text = change("{in: left_table, xy: [0.1, 0.2], yaw_deg: 30}", "{in: right_table, xy: [0.3, 0.01]}", text)
    text = change("X_WO: {translation: [0.3, 0.2, 0.04]}", "X_WO: {translation: [-0.3, 0, 0.04]}", text)
    problem = load(text)
    X_WS = problem.statics[0].X_WB @ problem.support("right_table").X_BS
    assert sorted(problem.support("right_table").size) == pytest.approx([0.1, 2.0])
    assert X_WS.rotation().matrix()[:, 2] == pytest.approx([0, 0, 1])
    assert X_WS.translation() == pytest.approx([0, 0, 0])


def test_objects_may_start_on_objects_in_any_order() -> None:
    problem = load(change("{in: left_table, xy: [0.1, 0.2], yaw_deg: 30}", "{on: blue}"))
    red = problem.object("red")
    assert (red.start_on, red.start_support) == ("blue", "start of red")
    assert red.start_X_BO.translation() == pytest.approx([0, 0, 0.04 + 0.025])


@pytest.mark.parametrize("face", ["-z", "+z", "-x", "+x", "-y", "+y"])
def test_resting_face_is_the_lowest(face: str) -> None:
    text = change("mass: 0.2", f'resting_faces: ["{face}"]')
    problem = load(
        change(
            "{box: [0.05, 0.05, 0.05]}",
            "{box: [0.02, 0.05, 0.07]}",
            change('      - antipodal: {approach: ["-z", "+x"], offset: 0.01, depth: [0.02, 0.03]}\n', "", text),
        )
    )
    red = problem.object("red")
    X_WO = problem.statics[0].X_WB @ red.start_X_BO
    axis = "xyz".index(face[1])
    outward = np.eye(3)[axis] * (1 if face[0] == "+" else -1)
    assert X_WO.rotation().matrix() @ outward == pytest.approx([0, 0, -1])
    assert X_WO.translation()[2] == pytest.approx([0.02, 0.05, 0.07][axis] / 2)


def test_default_grasps_keep_clear_of_palm_and_table() -> None:
    for grasp in load(PROBLEM).object("blue").grasps:
        assert isinstance(grasp, AntipodalGrasps)
        assert 0.008 <= grasp.depth[0] <= grasp.depth[1] <= 0.035
    top, side = load(PROBLEM).object("blue").grasps
    assert isinstance(top, AntipodalGrasps)
    assert isinstance(side, AntipodalGrasps)
    assert (top.approaches, top.offset) == (("-z",), 0.0)
    assert set(side.approaches) == {"+x", "-x", "+y", "-y"}
    assert side.offset == pytest.approx(0.03)


def test_yaml_reads_on_and_exponents_as_written() -> None:
    """YAML 1.1 would read the key `on` as a boolean and 1e-3 as a text."""
    data = parse_document("{on: off, size: 1e-3, count: 3, text: '3', nothing: }", "x", Path.cwd()).data
    assert data == {"on": "off", "size": 1e-3, "count": 3, "text": "3", "nothing": None}


def test_python_data_may_hold_arrays_and_transforms() -> None:
    data = example_data()
    data["robots"][0]["X_WB"] = RigidTransform([-0.5, 0, 0])
    data["robots"][0]["start"] = np.array([0.1, -0.2])
    problem = problem_from_dict(data)
    assert problem.robots[0].X_WB.translation() == pytest.approx([-0.5, 0, 0])
    assert problem.robots[0].start.tolist() == [0.1, -0.2]


def test_packages_are_found_by_key_and_by_environment(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = folder / "parts"
    package.mkdir()
    (package / "package.xml").write_text("<package format='2'><name>our_parts</name></package>")
    (package / "arm.urdf").write_text(URDF)
    (folder / "arm.yaml").write_text(change("model: arm.urdf", "model: package://our_parts/arm.urdf", ROBOT))
    problem = load(change("name: example", "name: example\npackages: [parts]"))
    assert problem.robots[0].model.model == "package://our_parts/arm.urdf"
    assert problem.package_paths == (package,)
    with pytest.raises(ProblemError, match="unknown package 'our_parts'"):
        load(PROBLEM)
    monkeypatch.setenv("MRTAMP_PACKAGE_PATH", str(package))
    assert load(PROBLEM).robots[0].model.model == "package://our_parts/arm.urdf"


def test_model_files_as_objects_and_world(folder: Path) -> None:
    body = (
        '<robot name="part"><link name="part"><collision><origin xyz="0 0 0.05"/><geometry><box size="0.04 0.06 0.1"/>'
    )
    (folder / "part.urdf").write_text(body + "</geometry></collision></link></robot>")
    text = change("shape: {cylinder: [0.03, 0.08]}", "model: part.urdf\n    grasps: [{X_OG: {}, width: 0.04}]")
    problem = load(change("X_WO: {translation: [0.3, 0.2, 0.04]}", "X_WO: {translation: [0.3, 0.2, 0]}", text))
    assert problem.object("blue").model == str(folder / "part.urdf")
    with pytest.raises(ProblemError, match=r"floating 0\.05 m above"):
        load(change("[0.3, 0.2, 0.04]", "[0.3, 0.2, 0.05]", text))


# Round trip.


def assert_same(a: Any, b: Any) -> None:
    """Plain data, equal up to rounding of the last digits."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, list):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        assert a == (pytest.approx(b, abs=1e-12) if isinstance(a, float) else b)


SUBGOALS = """
subgoals:
  - {name: look, robots: {left: {q: [0.2, 0.4]}, right: {q: home}}}
  - name: take
    robots: {left: {hand: {translation: [0.2, 0, 0.3], rotation: !Rpy {deg: [180, 0, 0]}}}}
    attach: {object: red, to: left}
  - name: drop
    robots: {left: {in: {X_WC: {translation: [0.1, 0, 0.2]}, size: [0.2, 0, 0.1]}}}
    after: [take]
    attach: {object: red, to: world}
collision: {ignore: [[left, table], [left/hand, red]], tolerance: 0.002}
"""


def test_subgoals_and_collision_rules_are_read() -> None:
    problem = load(PROBLEM + SUBGOALS)
    look, take, drop = problem.subgoals
    targets = list(look.targets.values())
    assert list(look.targets) == ["left", "right"]
    assert [t.q.tolist() for t in targets if isinstance(t, AtConfiguration)] == [[0.2, 0.4], [0.1, 0.2]]
    assert (look.after, take.after, drop.after) == ((), (), ("take",))
    hand, box = take.targets["left"], drop.targets["left"]
    assert isinstance(hand, HandAt)
    assert hand.X_WG.rotation().matrix() == pytest.approx(np.diag([1, -1, -1]))
    assert isinstance(box, HandIn)
    assert (box.size, box.X_WC.translation().tolist()) == ((0.2, 0.0, 0.1), [0.1, 0, 0.2])
    assert (look.attach, take.attach, drop.attach) == (None, Attach("red", "left"), Attach("red", "world"))
    assert problem.collision == CollisionRules((("left", "table"), ("left/hand", "red")), 0.002)
    plain = load(PROBLEM)
    assert (plain.subgoals, plain.collision) == ((), CollisionRules())


def test_a_sequence_says_what_comes_after_what() -> None:
    problem = load(PROBLEM + SUBGOALS + "order: sequence\n")
    assert [s.after for s in problem.subgoals] == [(), ("look",), ("take",)]
    anything = load(PROBLEM + SUBGOALS + "order: any\n")
    assert [s.after for s in anything.subgoals] == [(), (), ("take",)]


def test_subgoals_are_goal_enough() -> None:
    goal = PROBLEM[PROBLEM.index("goal:") : PROBLEM.index("cost:")]
    assert load(change(goal, "") + SUBGOALS).goal == ()
    assert load(change(goal, "goal: []\n") + SUBGOALS).goal == ()


def test_what_subgoals_attach_needs_neither_grasps_nor_gripper() -> None:
    text = PROBLEM + SUBGOALS
    red = text[text.index("    grasps:") : text.index("  - name: blue")]
    assert load(change(red, "    grasps: []\n", text)).object("red").grasps == ()
    with pytest.raises(ProblemError, match="no grasps"):
        load(change(red, "    grasps: []\n"))
    grip = "gripper: {bodies: [hand, finger], joints: {slide: 1.0}, max_width: 0.08}\n"
    Path("arm.yaml").write_text(change(grip, "", ROBOT))
    ends = change(red, "    grasps: []\n", text)
    ends = change("{object: red, in: right_table}", "{object: red, held_by: left}", ends)
    ends = change("  - {object: blue, on: red}\n", "", ends)
    assert load(ends).goal[0] == HeldBy("red", "left")


def test_subgoals_survive_the_round_trip() -> None:
    problem = load(PROBLEM + SUBGOALS + "order: sequence\n")
    data = problem_to_dict(problem)
    again = problem_from_dict(json.loads(json.dumps(data)))
    assert problem_to_dict(again) == data
    assert [s.after for s in again.subgoals] == [(), ("look",), ("take",)]
    assert [s.attach for s in again.subgoals] == [s.attach for s in problem.subgoals]
    assert again.collision == problem.collision
    assert not {"subgoals", "collision"} & set(problem_to_dict(load(PROBLEM))), (
        "nothing is said about what is not there"
    )


def test_round_trip_through_json() -> None:
    problem = load(PROBLEM)
    data = problem_to_dict(problem)
    again = problem_from_dict(json.loads(json.dumps(data)))
    assert_same(data, problem_to_dict(again))
    assert [s.name for s in problem.supports] == [s.name for s in again.supports]
    for mine, other in zip(problem.supports, again.supports, strict=True):
        assert mine.X_BS.IsNearlyEqualTo(other.X_BS, 1e-12)


@pytest.mark.parametrize("thickness", [1.2345662644e-3, 3e-10, 4.5e-311])
def test_default_grasps_of_thin_objects_survive_the_round_trip(thickness: float) -> None:
    """Depths are rounded for the reader, but the most is never less than the least."""
    data = example_data()
    [red] = [o for o in data["objects"] if o["name"] == "red"]
    red["shape"], red["grasps"] = {"box": [0.05, 0.05, thickness]}, [{"antipodal": {"approach": ["-z"]}}]
    problem = problem_from_dict(data)
    for grasp in problem.object("red").grasps:
        assert isinstance(grasp, AntipodalGrasps)
        assert 0.0 <= grasp.depth[0] <= grasp.depth[1] <= thickness
    again = problem_to_dict(problem)
    assert_same(again, problem_to_dict(problem_from_dict(again)))


def test_dict_stands_alone(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = problem_to_dict(load(PROBLEM))
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    assert problem_from_dict(data).robots[0].model.file == folder / "arm.yaml"


def test_list_problems_describes_each_in_one_line() -> None:
    described = list_problems()
    assert set(described) >= {"box", "handover", "stacking", "pick_place"}
    assert all(text and "\n" not in text for text in described.values())
