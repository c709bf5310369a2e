"""Robot files: what a right one means, and what a wrong one, or a wrong model behind it, is told."""

from __future__ import annotations

from pathlib import Path

import pytest

from mrtamp.problem import Problem, ProblemError
from mrtamp.problem_file import load_problem, load_robot_model

EXAMPLE = Path(__file__).parent / "data" / "example"
URDF, ROBOT, PROBLEM = ((EXAMPLE / name).read_text() for name in ("arm.urdf", "arm.yaml", "example.yaml"))
BOX_GEOMETRY = '<box size="0.01 0.02 0.05"/>'


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


def test_robot_file_is_read(folder: Path) -> None:
    model = load_robot_model("arm.yaml")
    assert (model.name, model.base, model.grasp_body) == ("arm", "base", "hand")
    assert (model.arm_joints, model.home) == (("shoulder", "elbow"), (0.0, 0.5))
    assert model.model == str(folder / "arm.urdf")
    assert model.X_BG.translation() == pytest.approx([0, 0, 0.1])
    assert model.collision_exceptions == (("base", "hand"),)
    assert model.gripper is not None
    assert (model.gripper.bodies, model.gripper.max_width) == (("hand", "finger"), 0.08)


@pytest.mark.parametrize(
    ("old", "new", "key", "says"),
    [
        ("mrtamp_robot: 1", "mrtamp_robot: 3", "mrtamp_robot", ("found 3", "version 1")),
        ("[shoulder, elbow]", "[shoulder, elbo]", "arm_joints[1]", ("'elbo'", "did you mean 'elbow'")),
        ("base: base", "base: foot", "base", ("'foot'", "base, upper, hand")),
        ("home: [0.0, 0.5]", "home: [0.0, 5]", "home[1]", ("5 for elbow", "-1 to 1")),
        ("{slide: 1.0}", "{elbow: 1.0}", "gripper.joints.elbow", ("'elbow'", "slide")),
        ("max_width: 0.08", "max_width: 0.2", "gripper.max_width", ("0.2", "0 to 0.08")),
        ("model: arm.urdf", "model: leg.urdf", "model", ("'leg.urdf'", "there is no")),
        ("grasp_frame", "grasp_fame", "grasp_fame", ("did you mean 'grasp_frame'",)),
    ],
)
def test_robot_file_mistakes(folder: Path, old: str, new: str, key: str, says: tuple[str, ...]) -> None:
    text = change(old, new, ROBOT)
    (folder / "arm.yaml").write_text(text)
    line = text[: text.index(new)].count("\n") + 1
    with pytest.raises(ProblemError) as caught:
        load_robot_model("arm.yaml")
    assert str(caught.value).startswith(f"{folder / 'arm.yaml'}:{line}: {key}: "), str(caught.value)
    for fragment in says:
        assert fragment in str(caught.value)
    with pytest.raises(ProblemError, match=r"^example.yaml:6: robots\[0\].model: "):
        load(PROBLEM)


def test_stl_collision_mesh_is_refused(folder: Path) -> None:
    (folder / "arm.urdf").write_text(change(BOX_GEOMETRY, '<mesh filename="finger.STL"/>', URDF))
    with pytest.raises(ProblemError, match=r"finger\.STL.*expected \.obj.*Drake cannot collide"):
        load(PROBLEM)


def test_broken_model_is_reported(folder: Path) -> None:
    (folder / "arm.urdf").write_text("<robot><link></robot>")
    with pytest.raises(ProblemError, match=r"arm\.yaml:3: model: Drake cannot parse"):
        load(PROBLEM)


def test_arm_without_gripper_cannot_hold(folder: Path) -> None:
    gripperless = "\n".join(line for line in ROBOT.splitlines() if not line.startswith(("gripper", "grasp_frame")))
    (folder / "bare.yaml").write_text(gripperless)
    text = change("left, model: arm.yaml", "left, model: bare.yaml")
    assert load(text).robots[0].model.gripper is None
    with pytest.raises(ProblemError, match=r"'left', which has no gripper, expected one of .*: right"):
        load(change("red, in: right_table", "red, held_by: left", text))
