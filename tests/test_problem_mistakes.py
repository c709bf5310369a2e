"""A wrong problem file gets one error that says where, what was found and what is valid; the schema agrees."""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mrtamp.model_files import models_dir
from mrtamp.problem import Problem, ProblemError
from mrtamp.problem_file import load_problem, problem_from_dict, problem_to_dict
from mrtamp.reading import parse_document, read_document

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


# What a wrong file gets.


@dataclass(frozen=True)
class Mistake:
    """`old` becomes `new`; the error names the line of `marker` (default: of `new`), `key`, and all of `says`.

    `schema`: the JSON Schema sees it too; otherwise it takes the loader's knowledge of names, geometry and models.
    """

    old: str
    new: str
    key: str
    says: tuple[str, ...]
    schema: bool = True
    marker: str | None = None


MISTAKES = {
    "version": Mistake("mrtamp: 1", "mrtamp: 2", "mrtamp", ("found 2", "version 1")),
    "unknown section": Mistake("cost:", "costs:", "costs", ("'costs'", "did you mean 'cost'", "supports")),
    "goal misspelt": Mistake(
        "goal:", "gaol:", "gaol", ("mrtamp, name, robots, goal, description, packages", "did you mean 'goal'")
    ),
    "unknown key": Mistake("mass: 0.2", "maas: 0.2", "objects[0].maas", ("'maas'", "did you mean 'mass'", "color")),
    "missing key": Mistake(
        "shape: {cylinder: [0.03, 0.08]}\n    start: {on: table, X_WO: {translation: [0.3, 0.2, 0.04]}}",
        "shape: {cylinder: [0.03, 0.08]}",
        "objects[1]",
        ("no key 'start'",),
        marker="- name: blue",
    ),
    "name is a number": Mistake("name: example", "name: 7", "name", ("found 7", "a name of letters")),
    "shape unknown": Mistake(
        "{cylinder: [0.03, 0.08]}",
        "{cilinder: [0.03, 0.08]}",
        "objects[1].shape.cilinder",
        ("did you mean 'cylinder'",),
    ),
    "shape size negative": Mistake(
        "{cylinder: [0.03, 0.08]}",
        "{cylinder: [-0.03, 0.08]}",
        "objects[1].shape.cylinder[0]",
        ("-0.03", "larger than 0"),
    ),
    "shape size short": Mistake(
        "{cylinder: [0.03, 0.08]}", "{cylinder: [0.03]}", "objects[1].shape.cylinder", ("1 numbers", "[radius, length]")
    ),
    "neither shape nor model": Mistake(
        "    shape: {cylinder: [0.03, 0.08]}\n",
        "",
        "objects[1]",
        ("neither 'shape' nor 'model'",),
        marker="- name: blue",
    ),
    "nan": Mistake("mass: 0.2", "mass: .nan", "objects[0].mass", ("found nan", "finite"), schema=False),
    "huge": Mistake("mass: 0.2", "mass: " + "9" * 5000, "objects[0].mass", ("finite",), schema=False),
    "object with joints": Mistake(
        "shape: {cylinder: [0.03, 0.08]}",
        "model: arm.urdf",
        "objects[1].model",
        ("moving joints", "one rigid body"),
        schema=False,
    ),
    "text for number": Mistake("mass: 0.2", "mass: heavy", "objects[0].mass", ("'heavy'", "a number")),
    "mass zero": Mistake("mass: 0.2", "mass: 0", "objects[0].mass", ("found 0", "larger than 0")),
    "color": Mistake("[0.5, 0.4, 0.3]", "[0.5, 40, 0.3]", "world[0].color[1]", ("found 40", "between 0 and 1")),
    "translation": Mistake(
        "translation: [-0.5, 0, 0]", "translation: [-0.5, 0]", "robots[0].X_WB.translation", ("2 numbers", "[x, y, z]")
    ),
    "rotation form": Mistake(
        "!Rpy {deg: [0, 0, 180]}", "{yaw: 180}", "robots[1].X_WB.rotation", ("'yaw'", "!Rpy", "quaternion")
    ),
    "rotation tag": Mistake(
        "!Rpy {deg: [0, 0, 180]}", "!Rpy {rad: [0, 0, 3.14]}", "robots[1].X_WB.rotation", ("'rad'", "deg"), schema=False
    ),
    "unknown tag": Mistake(
        "!Rpy {deg: [0, 0, 180]}",
        "!Euler {deg: [0, 0, 180]}",
        "robots[1].X_WB.rotation",
        ("!Euler", "!Rpy"),
        schema=False,
    ),
    "quaternion": Mistake(
        "!Rpy {deg: [0, 0, 180]}",
        "{quaternion: [0.5, 0, 0, 0.5]}",
        "robots[1].X_WB.rotation.quaternion",
        ("length 0.707", "length 1"),
        schema=False,
    ),
    "robot model": Mistake(
        "left, model: arm.yaml", "left, model: pamda", "robots[0].model", ("'pamda'", "panda"), schema=False
    ),
    "robot file": Mistake(
        "left, model: arm.yaml", "left, model: no.yaml", "robots[0].model", ("'no.yaml'", "there is no"), schema=False
    ),
    "length of q": Mistake(
        "start: [1.0, 0.3]",
        "start: [1.0]",
        "robots[1].start",
        ("1 numbers", "expected 2", "shoulder, elbow"),
        schema=False,
    ),
    "joint limit": Mistake(
        "start: [1.0, 0.3]", "start: [1.0, 1.3]", "robots[1].start[1]", ("1.3 for elbow", "-1 to 1"), schema=False
    ),
    "goal joint limit": Mistake(
        "right, at: home", "right, at: [2.5, 0]", "goal[2].at[0]", ("2.5 for shoulder", "-2 to 2"), schema=False
    ),
    "goal away": Mistake("right, at: home", "right, at: rest", "goal[2].at", ("'rest'", "'home'")),
    "no robots": Mistake(
        PROBLEM[PROBLEM.index("robots:") : PROBLEM.index("world:")], "robots: []\n", "robots", ("at least one robot",)
    ),
    "duplicate name": Mistake("name: blue", "name: red", "objects[1].name", ("'red'", "objects[0]"), schema=False),
    "clash across kinds": Mistake(
        "{name: table, shape", "{name: left, shape", "world[0].name", ("'left'", "robots[0]"), schema=False
    ),
    "reserved name": Mistake(
        "name: blue", "name: world", "objects[1].name", ("'world'", "the world frame"), schema=False
    ),
    "unknown support body": Mistake(
        "left_table, on: table",
        "left_table, on: tabel",
        "supports[0].on",
        ("'tabel'", "did you mean 'table'"),
        schema=False,
    ),
    "region beyond the table": Mistake(
        "[-0.4, 0, 0.05]}, size: [0.4, 0.6]",
        "[-0.4, 0, 0.05]}, size: [0.4, 1.6]",
        "supports[0].size",
        ("0.300 m beyond 'table'", "2 x 1"),
        schema=False,
    ),
    "region inside the table": Mistake(
        "translation: [-0.4, 0, 0.05]",
        "translation: [-0.4, 0, 0.0]",
        "supports[0].X_BS",
        ("inside 'table'",),
        schema=False,
    ),
    "region upside down": Mistake(
        "X_BS: {translation: [-0.4, 0, 0.05]}",
        "X_BS: {translation: [-0.4, 0, 0.05], rotation: {rpy_deg: [180, 0, 0]}}",
        "supports[0].X_BS",
        ("180 degrees", "faces up"),
        schema=False,
    ),
    "negative region": Mistake(
        "[0.4, 0, 0.05]}, size: [0.4, 0.6]",
        "[0.4, 0, 0.05]}, size: [0.4, -0.6]",
        "supports[1].size[1]",
        ("-0.6", "at least 0"),
    ),
    "start outside its region": Mistake(
        "xy: [0.1, 0.2]",
        "xy: [0.3, 0.2]",
        "objects[0].start.xy",
        ("[0.3, 0.2]", "'left_table'", "<= 0.2"),
        schema=False,
    ),
    "start in nowhere": Mistake(
        "start: {in: left_table",
        "start: {in: leftable",
        "objects[0].start.in",
        ("'leftable'", "'left_table'"),
        schema=False,
    ),
    "start nowhere": Mistake(
        "{on: table, X_WO: {translation: [0.3, 0.2, 0.04]}}",
        "{xy: [0, 0]}",
        "objects[1].start",
        ("in: REGION", "on: BODY"),
    ),
    "start on itself": Mistake(
        "{on: table, X_WO: {translation: [0.3, 0.2, 0.04]}}",
        "{on: blue}",
        "objects[1].start.on",
        ("itself",),
        schema=False,
    ),
    "start floats": Mistake(
        "[0.3, 0.2, 0.04]",
        "[0.3, 0.2, 0.09]",
        "objects[1].start.X_WO",
        ("floating 0.05 m above 'table'",),
        schema=False,
    ),
    "start beside the table": Mistake(
        "[0.3, 0.2, 0.04]", "[0.3, 0.7, 0.04]", "objects[1].start.X_WO", ("0.200 m beside 'table'",), schema=False
    ),
    "start tilted": Mistake(
        "X_WO: {translation: [0.3, 0.2, 0.04]}",
        "X_WO: {translation: [0.3, 0.2, 0.04], rotation: !Rpy {deg: [20, 0, 0]}}",
        "objects[1].start.X_WO",
        ("tilted by 20.0 degrees",),
        schema=False,
    ),
    "approach": Mistake(
        '["-z", "+x"]', '["-z", "down"]', "objects[0].grasps[0].antipodal.approach[1]", ("'down'", "-z, +x", "+z")
    ),
    "depth": Mistake(
        "depth: [0.02, 0.03]",
        "depth: [0.02, 0.3]",
        "objects[0].grasps[0].antipodal.depth[1]",
        ("found 0.3", "between 0 and 0.05"),
        schema=False,
    ),
    "depth order": Mistake(
        "depth: [0.02, 0.03]",
        "depth: [0.03, 0.02]",
        "objects[0].grasps[0].antipodal.depth",
        ("[0.03, 0.02]", "least <= most"),
        schema=False,
    ),
    "offset": Mistake(
        "offset: 0.01", "offset: 0.1", "objects[0].grasps[0].antipodal.offset", ("0.1", "0.025"), schema=False
    ),
    "explicit grasp too wide": Mistake(
        "width: 0.05", "width: 0.12", "objects[0].grasps[1].width", ("0.12", "opening of 0.08 m"), schema=False
    ),
    "grasp for nobody": Mistake(
        "width: 0.05}",
        "width: 0.05, robots: []}",
        "objects[0].grasps[1].robots",
        ("found []", "at least one robot"),
    ),
    "grasp for a stranger": Mistake(
        "width: 0.05}",
        "width: 0.05, robots: [lefd]}",
        "objects[0].grasps[1].robots[0]",
        ("'lefd'", "robots with a gripper: left, right", "did you mean 'left'"),
        schema=False,
    ),
    "negative margin": Mistake(
        "[0.4, 0, 0.05]}, size: [0.4, 0.6]",
        "[0.4, 0, 0.05]}, size: [0.4, 0.6], margin: -0.01",
        "supports[1].margin",
        ("-0.01", "at least 0"),
    ),
    "object too wide": Mistake(
        "{cylinder: [0.03, 0.08]}",
        "{cylinder: [0.05, 0.09]}",
        "objects[1]",
        ("0.1 x 0.1", "0.08 m"),
        schema=False,
        marker="- name: blue",
    ),
    "goal without grasps": Mistake(
        "start: {on: table",
        "grasps: []\n    start: {on: table",
        "goal[1].object",
        ("'blue'", "no grasps"),
        schema=False,
        marker="{object: blue, on: red}",
    ),
    "face": Mistake("mass: 0.2", "resting_faces: [bottom]", "objects[0].resting_faces[0]", ("'bottom'", "-z, +z")),
    "goal object": Mistake("object: blue", "object: bleu", "goal[1].object", ("'bleu'", "'blue'"), schema=False),
    "goal region": Mistake(
        "red, in: right_table", "red, in: table", "goal[0].in", ("'table'", "right_table"), schema=False
    ),
    "goal holder": Mistake(
        "red, in: right_table", "red, held_by: lefd", "goal[0].held_by", ("'lefd'", "'left'"), schema=False
    ),
    "goal robot": Mistake("robot: right", "robot: rihgt", "goal[2].robot", ("'rihgt'", "'right'"), schema=False),
    "goal on itself": Mistake("blue, on: red", "blue, on: blue", "goal[1].on", ("'blue' on itself",), schema=False),
    "goal cycle": Mistake("red, in: right_table", "red, on: blue", "goal[0].on", ("red on blue on red",), schema=False),
    "goal twice": Mistake(
        "blue, on: red", "red, in: left_table", "goal[1].object", ("'red' again", "goal[0]"), schema=False
    ),
    "goal floats": Mistake(
        "red, in: right_table",
        "red, at: {translation: [0, 0, 0.02]}, on: table",
        "goal[0].at",
        ("0.005 m too low on 'table'",),
        schema=False,
    ),
    "goal without place": Mistake("{object: red, in: right_table}", "{object: red}", "goal[0]", ("in, on, held_by",)),
    "no goal": Mistake(
        PROBLEM[PROBLEM.index("goal:") : PROBLEM.index("cost:")], "goal: []\n", "goal", ("at least one condition",)
    ),
    "cost": Mistake("path_length: 0.1", "path_length: -1", "cost.path_length", ("-1", "at least 0")),
    "cost kind": Mistake("handover: 0.5", "handovers: 0.5", "cost.transitions.handovers", ("'handover'",)),
    "all costs zero": Mistake(
        "makespan: 1.0, path_length: 0.1", "makespan: 0, path_length: 0", "cost", ("positive",), schema=False
    ),
    "packages": Mistake(
        "name: example",
        "name: example\npackages: [nowhere]",
        "packages[0]",
        ("'nowhere'",),
        schema=False,
        marker="packages: [nowhere]",
    ),
    "unknown package": Mistake(
        "shape: {cylinder: [0.03, 0.08]}",
        "model: package://parts/a.sdf",
        "objects[1].model",
        ("'parts'", "packages:", "MRTAMP_PACKAGE_PATH"),
        schema=False,
    ),
    "model missing": Mistake(
        "shape: {cylinder: [0.03, 0.08]}",
        "model: bottle.sdf",
        "objects[1].model",
        ("'bottle.sdf'", "there is no"),
        schema=False,
    ),
    "model kind": Mistake(
        "shape: {cylinder: [0.03, 0.08]}",
        "model: bottle.step",
        "objects[1].model",
        ("'bottle.step'", ".urdf"),
        schema=False,
    ),
    "key twice": Mistake(
        "mass: 0.2", "mass: 0.2\n    mass: 0.3", "objects[0].mass", ("twice",), schema=False, marker="mass: 0.3"
    ),
    "list for mapping": Mistake(
        PROBLEM[PROBLEM.index("cost: ") :], "cost: [1]\n", "cost", ("found [1]", "makespan, path_length")
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake_gets_one_clear_error(name: str) -> None:
    mistake = MISTAKES[name]
    text = change(mistake.old, mistake.new)
    place = text.index(mistake.marker) if mistake.marker else PROBLEM.index(mistake.old)
    line = text[:place].count("\n") + 1
    with pytest.raises(ProblemError) as caught:
        load(text)
    message = str(caught.value)
    assert message.startswith(f"example.yaml:{line}: {mistake.key}: "), message
    assert "\n" not in message
    for fragment in mistake.says:
        assert fragment in message, message


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (change("mass: 0.2", "mass: [0.2"), 21),
        (change("mass: 0.2", "mass: 0.2: 3"), 20),
        (change("mass: 0.2", "\tmass: 0.2"), 20),
        (PROBLEM + "---\nmrtamp: 1\n", 33),
    ],
)
def test_syntax_error_names_the_line(text: str, line: int) -> None:
    with pytest.raises(ProblemError, match=f"^example.yaml:{line}: not valid YAML: "):
        load(text)


def test_empty_file_and_recursive_alias() -> None:
    with pytest.raises(ProblemError, match="empty"):
        load("# nothing\n")
    with pytest.raises(ProblemError, match="alias"):
        load("mrtamp: &x [*x]\n")


@pytest.mark.parametrize(
    ("source", "params", "says"),
    [
        ("handovr", {}, ("'handovr'", "did you mean 'handover'", "pick_place")),
        ("no/such.yaml", {}, ("'no/such.yaml'", "there is no")),
        ("stacking", {"robots": 3}, ("robots", "stacking", "pick_place")),
        ("pick_place", {"robots": 9}, ("robots=9", "1 to 8")),
        ("pick_place", {"objects": 0}, ("objects=0", "1 to 24")),
        ("pick_place", {"arms": 2}, ("'arms'", "robots, objects, layout_seed")),
    ],
)
def test_wrong_source(source: str, params: dict[str, int], says: tuple[str, ...]) -> None:
    with pytest.raises(ProblemError) as caught:
        load_problem(source, **params)
    for fragment in says:
        assert fragment in str(caught.value)


SUBGOALS = """subgoals:
  - name: look
    robots: {left: {q: [0.2, 0.4]}, right: {q: home}}
  - name: take
    robots: {left: {hand: {translation: [0.2, 0, 0.3]}}}
    attach: {object: red, to: left}
  - name: drop
    robots: {left: {in: {X_WC: {translation: [0.1, 0, 0.2]}, size: [0.2, 0, 0.1]}}}
    after: [take]
    attach: {object: red, to: world}
order: any
collision: {ignore: [[left, table], [left/hand, red]], tolerance: 0.002}
"""

SUBGOAL_MISTAKES = {
    "name taken by an object": Mistake(
        "name: look", "name: red", "subgoals[0].name", ("'red' again", "objects[0]"), schema=False
    ),
    "name taken by a robot": Mistake(
        "name: look", "name: left", "subgoals[0].name", ("'left' again", "robots[0]"), schema=False
    ),
    "name twice": Mistake(
        "name: drop", "name: take", "subgoals[2].name", ("'take' again", "subgoals[1]"), schema=False
    ),
    "no name": Mistake("- name: look\n    robots", "- robots", "subgoals[0]", ("a mapping with a 'name'",)),
    "no robots": Mistake(
        "robots: {left: {q: [0.2, 0.4]}, right: {q: home}}", "robots: {}", "subgoals[0].robots", ("{}",)
    ),
    "robots as a list": Mistake(
        "{left: {q: [0.2, 0.4]}, right: {q: home}}", "[left]", "subgoals[0].robots", ("['left']", "{NAME: {q: [...]}}")
    ),
    "unknown robot": Mistake(
        "right: {q: home}", "rigth: {q: home}", "subgoals[0].robots", ("'rigth'", "did you mean 'right'"), schema=False
    ),
    "unknown target": Mistake(
        "right: {q: home}", "right: {config: home}", "subgoals[0].robots.right.config", ("'config'", "q, hand, in")
    ),
    "two targets": Mistake(
        "right: {q: home}", "right: {q: home, hand: {}}", "subgoals[0].robots.right", ("exactly one of",)
    ),
    "no target": Mistake("right: {q: home}", "right: {}", "subgoals[0].robots.right", ("exactly one of",)),
    "too few positions": Mistake(
        "q: [0.2, 0.4]", "q: [0.2]", "subgoals[0].robots.left.q", ("1 numbers", "shoulder, elbow"), schema=False
    ),
    "beyond the limits": Mistake(
        "q: [0.2, 0.4]", "q: [0.2, 9]", "subgoals[0].robots.left.q[1]", ("found 9 for elbow", "limits"), schema=False
    ),
    "a word for a configuration": Mistake(
        "q: [0.2, 0.4]", "q: away", "subgoals[0].robots.left.q", ("'away'", "shoulder, elbow")
    ),
    "box without size": Mistake(
        "{X_WC: {translation: [0.1, 0, 0.2]}, size: [0.2, 0, 0.1]}",
        "{X_WC: {translation: [0.1, 0, 0.2]}}",
        "subgoals[2].robots.left.in",
        ("no key 'size'",),
    ),
    "negative box": Mistake(
        "[0.2, 0, 0.1]", "[0.2, -1, 0.1]", "subgoals[2].robots.left.in.size[1]", ("-1", "at least 0")
    ),
    "after something unknown": Mistake(
        "after: [take]",
        "after: [tke]",
        "subgoals[2].after[0]",
        ("'tke'", "look, take", "did you mean 'take'"),
        schema=False,
    ),
    "after itself": Mistake(
        "after: [take]", "after: [drop]", "subgoals[2].after[0]", ("'drop'", "look, take"), schema=False
    ),
    "after twice": Mistake("after: [take]", "after: [take, take]", "subgoals[2].after", ("each subgoal once",)),
    "after a name, not a list": Mistake("after: [take]", "after: take", "subgoals[2].after", ("'take'", "a list")),
    "a ring": Mistake(
        "attach: {object: red, to: left}",
        "attach: {object: red, to: left}\n    after: [drop]",
        "subgoals[1]",
        ("take after drop after take",),
        schema=False,
        marker="  - name: take",
    ),
    "unknown object": Mistake(
        "{object: red, to: left}",
        "{object: rad, to: left}",
        "subgoals[1].attach.object",
        ("'rad'", "red, blue"),
        schema=False,
    ),
    "to a robot elsewhere": Mistake(
        "{object: red, to: left}",
        "{object: red, to: right}",
        "subgoals[1].attach.to",
        ("'right', which is not at this subgoal", "robots of the subgoal: left"),
        schema=False,
    ),
    "to something unknown": Mistake(
        "{object: red, to: world}",
        "{object: red, to: tabel}",
        "subgoals[2].attach.to",
        ("'tabel'", "left, table, blue, world"),
        schema=False,
    ),
    "to itself": Mistake(
        "{object: red, to: world}",
        "{object: red, to: red}",
        "subgoals[2].attach.to",
        ("'red'", "table, blue"),
        schema=False,
    ),
    "attached to nothing": Mistake("{object: red, to: world}", "{object: red}", "subgoals[2].attach", ("no key 'to'",)),
    "unknown order": Mistake("order: any", "order: all", "order", ("'all'", "any, sequence")),
    "three in a pair": Mistake(
        "[left, table]", "[left, table, red]", "collision.ignore[0]", ("['left', 'table', 'red']", "a pair such as")
    ),
    "unknown thing": Mistake(
        "[left, table]",
        "[left, tabl]",
        "collision.ignore[0][1]",
        ("'tabl'", "left, right, table, red, blue"),
        schema=False,
    ),
    "unknown body": Mistake(
        "left/hand",
        "left/hands",
        "collision.ignore[1][0]",
        ("'hands'", "bodies of left", "did you mean 'hand'"),
        schema=False,
    ),
    "body of no robot": Mistake(
        "left/hand", "lift/hand", "collision.ignore[1][0]", ("'lift/hand'", "ROBOT/BODY"), schema=False
    ),
    "a thing with itself": Mistake(
        "[left, table]", "[table, table]", "collision.ignore[0]", ("'table' with itself",), schema=False
    ),
    "negative tolerance": Mistake("tolerance: 0.002", "tolerance: -1", "collision.tolerance", ("-1", "at least 0")),
    "unknown rule": Mistake("tolerance: 0.002", "tol: 0.002", "collision.tol", ("'tol'", "ignore, tolerance")),
}


@pytest.mark.parametrize("name", SUBGOAL_MISTAKES)
def test_mistake_about_subgoals_gets_one_clear_error(name: str) -> None:
    mistake = SUBGOAL_MISTAKES[name]
    text = change(mistake.old, mistake.new, PROBLEM + SUBGOALS)
    place = text.index(mistake.marker) if mistake.marker else (PROBLEM + SUBGOALS).index(mistake.old)
    with pytest.raises(ProblemError) as caught:
        load(text)
    message = str(caught.value)
    assert message.startswith(f"example.yaml:{text[:place].count(chr(10)) + 1}: {mistake.key}: "), message
    for fragment in mistake.says:
        assert fragment in message, message
    if mistake.schema:
        assert not schema("problem").is_valid(parse_document(text, "x", Path.cwd()).data)


def test_a_sequence_against_after_is_a_ring() -> None:
    text = change("right: {q: home}}", "right: {q: home}}\n    after: [drop]", PROBLEM + SUBGOALS)
    load(text)
    with pytest.raises(ProblemError, match="look after drop after take after look"):
        load(change("order: any", "order: sequence", text))


def test_a_robot_without_grasp_frame_has_no_hand_to_go_anywhere() -> None:
    bare = ROBOT[: ROBOT.index("gripper:")]
    Path("bare.yaml").write_text(bare)
    text = change("{name: left, model: arm.yaml", "{name: left, model: bare.yaml", PROBLEM + SUBGOALS)
    with pytest.raises(ProblemError, match=r"subgoals\[1\].robots.left: found the hand of 'left', .* with one: right"):
        load(text)


def test_without_goal_and_subgoals_there_is_nothing_to_plan() -> None:
    goal = PROBLEM[PROBLEM.index("goal:") : PROBLEM.index("cost:")]
    for text in (change(goal, ""), change(goal, "") + "subgoals: []\n", change(goal, "goal: []\nsubgoals: []\n")):
        with pytest.raises(ProblemError, match="goal"):
            load(text)
        assert not schema("problem").is_valid(parse_document(text, "x", Path.cwd()).data)


# The published schema.


@functools.cache
def schema(name: str) -> jsonschema.Draft202012Validator:
    """The validator of a published schema."""
    content = json.loads((models_dir() / "schema" / f"{name}.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(content)
    return jsonschema.Draft202012Validator(content)


def test_schema_accepts_what_ships() -> None:
    for file in (models_dir() / "problems").glob("*.yaml"):
        schema("problem").validate(read_document(file).data)
    for file in (models_dir() / "robots").glob("*.yaml"):
        schema("robot").validate(read_document(file).data)
    schema("robot").validate(parse_document(ROBOT, "robot", Path.cwd()).data)
    schema("problem").validate(example_data())
    visits = parse_document(PROBLEM + SUBGOALS, "visits", Path.cwd()).data
    schema("problem").validate(visits)
    schema("problem").validate(problem_to_dict(problem_from_dict(visits)))
    schema("problem").validate(problem_to_dict(load(PROBLEM)))


@pytest.mark.parametrize("name", [name for name, mistake in MISTAKES.items() if mistake.schema])
def test_schema_refuses_what_the_loader_refuses(name: str) -> None:
    data = parse_document(change(MISTAKES[name].old, MISTAKES[name].new), "x", Path.cwd()).data
    assert not schema("problem").is_valid(data)


WORDS = ["red", "table", "left", "home", "", "-z"]
JUNK: st.SearchStrategy[Any] = (
    st.none()
    | st.booleans()
    | st.integers(-3, 3)
    | st.floats()
    | st.sampled_from(WORDS)
    | st.just([])
    | st.just({})
    | st.lists(st.floats(-1, 1), max_size=4)
)


def places(data: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) inside plain data."""
    keys = list(data) if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else []
    return [pair for key in keys for pair in [(data, key), *places(data[key])]]


@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(choice=st.integers(0, 10_000), junk=JUNK, remove=st.booleans())
def test_loader_and_schema_agree_on_damaged_files(choice: int, junk: Any, remove: bool) -> None:
    """Damage anything anywhere: the loader accepts or raises ProblemError, and accepts nothing the schema refuses."""
    data = parse_document(PROBLEM + SUBGOALS, "example", Path.cwd()).data
    everywhere = places(data)
    container, key = everywhere[choice % len(everywhere)]
    if remove:
        del container[key]
    else:
        container[key] = junk
    try:
        problem = problem_from_dict(data)
    except ProblemError as error:
        assert "\n" not in str(error)
        return
    assert schema("problem").is_valid(data), list(schema("problem").iter_errors(data))
    problem_from_dict(problem_to_dict(problem))
