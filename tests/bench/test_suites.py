"""Suites of runs: what is shipped, what a file may say, and what it is told when it is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest
import yaml

from mrtamp.bench.suite import TABLES, load_suite, shipped_suites, suite_from_dict, suite_to_dict
from mrtamp.mechanisms import INTRA_ORBIT_NAMES, MECHANISMS, PLANNER_NAMES
from mrtamp.model_files import models_dir
from mrtamp.problem import MrtampError
from mrtamp.problem_file import problem_to_dict

GOOD = """\
mrtamp_suite: 1
name: two
description: Two problems.
table: main
seeds: 2
limit: 3
problems:
  - {problem: pick_place, robots: 2, objects: 2, layouts: 3, limit: 1.5, title: Cubes}
  - {problem: square_free}
planners:
  - {planner: guided}
  - {planner: guided, without: [skeletons], intra_orbit: prioritised}
  - {planner: composed-prm, without: [informed-sampling], label: plain}
"""


def write(folder: Path, text: str = GOOD) -> str:
    file = folder / "suite.yaml"
    file.write_text(text, encoding="utf-8")
    return str(file)


@pytest.mark.parametrize("name", sorted(shipped_suites()))
def test_shipped_suites_are_right_and_survive_being_written(name: str) -> None:
    suite = load_suite(name)
    assert suite.name == name and suite.description
    assert suite_from_dict(suite_to_dict(suite), "here") == suite
    keys = [assignment.key for assignment in suite.assignments()]
    assert len(set(keys)) == len(keys) > 0


def test_the_schema_knows_what_the_reader_knows(tmp_path: Path) -> None:
    schema = json.loads((models_dir() / "schema/suite.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    for text in (GOOD, *(file.read_text(encoding="utf-8") for file in shipped_suites().values())):
        jsonschema.validate(yaml.safe_load(text), schema)
    planner = schema["$defs"]["planner"]["properties"]
    assert schema["properties"]["table"]["enum"] == list(TABLES)
    assert planner["planner"]["enum"] == list(PLANNER_NAMES)
    assert planner["intra_orbit"]["enum"] == list(INTRA_ORBIT_NAMES)
    for wrong in (("limit: 3", "limit: 0"), ("layouts: 3", "layouts: 3, layout: 1"), ("title: Cubes", "titel: Cubes")):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(yaml.safe_load(GOOD.replace(*wrong)), schema)


def test_the_suites_that_are_promised_are_there() -> None:
    suites = {name: load_suite(name, find=False) for name in shipped_suites()}
    assert set(suites) == {"smoke", "paper-main", "paper-scalability", "planar", "scaling", "ablation", "layouts"}
    pairs = [(c.parameters["robots"], c.parameters["objects"]) for c in suites["paper-scalability"].cases]
    assert pairs == [(2, 2), (2, 4), (2, 6), (3, 3), (3, 6), (4, 4), (4, 6)]
    assert [e.planner for e in suites["paper-scalability"].entrants] == ["composed-prm", "unguided", "guided"]
    scaling = [case.parameters for case in suites["scaling"].cases]
    assert {p["robots"] for p in scaling} >= {2, 8} and max(p["objects"] for p in scaling) == 24


def test_every_mechanism_has_a_row_in_the_ablation() -> None:
    entrants = load_suite("ablation", find=False).entrants
    off = {e.without for e in entrants if e.planner == "guided"}
    assert off == {(), *((name,) for name in MECHANISMS)}
    assert {e.intra_orbit for e in entrants} == {None, *INTRA_ORBIT_NAMES[1:]}
    assert entrants[0].planner == "guided" and entrants[0].without == ()


def test_runs_are_problems_times_layouts_times_planners_times_seeds(tmp_path: Path) -> None:
    suite = load_suite(write(tmp_path))
    runs = list(suite.assignments())
    assert len(runs) == 2 * (3 + 1) * 3
    # All of the first seed comes before anything of the second.
    assert [run.seed for run in runs] == [0] * 12 + [1] * 12
    cubes = [run for run in runs if run.case.problem == "pick_place"]
    assert {run.layout for run in cubes} == {0, 1, 2} and {run.case.limit_s for run in cubes} == {1.5}
    assert cubes[-1].case.task(2).parameters == {"robots": 2, "objects": 2, "layout_seed": 2}
    assert runs[9].key == "square_free, guided, seed 0" and runs[9].case.limit_s == 3.0
    assert [e.label for e in suite.entrants] == ["guided", "guided, without skeletons, with prioritised", "plain"]


def test_layouts_differ_and_do_not_depend_on_the_planner_seed(tmp_path: Path) -> None:
    case = load_suite(write(tmp_path)).cases[0]
    one, other, again = (problem_to_dict(case.task(layout).load())["objects"] for layout in (1, 2, 1))
    assert one == again != other


def test_a_problem_file_is_found_beside_the_suite(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text((models_dir() / "problems/square_free.yaml").read_text(encoding="utf-8"))
    suite = load_suite(write(tmp_path, GOOD.replace("square_free", "mine.yaml")))
    assert suite.cases[1].name == "mine" and suite.cases[1].task(None).load().robots


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("mrtamp_suite: 1", "mrtamp_suite: 2"), ["mrtamp_suite", "version 1"]),
        (("seeds: 2\n", ""), ["seeds"]),
        (("seeds: 2", "seeds: 0"), ["seeds", "whole number from 1"]),
        (("seeds: 2", "seeds: [1, 1]"), ["seeds", "different"]),
        (("limit: 3", "limit: -3"), ["limit", "larger than 0"]),
        (("table: main", "table: mein"), ["table", "did you mean 'main'"]),
        (("table: main", "table: scalability"), ["problems[1]", "robots and objects"]),
        (("table: main", "table: optimum"), ["problems[0]", "planar_doorway"]),
        (("square_free", "square_fre"), ["problems[1].problem", "did you mean 'square_free'"]),
        (("square_free", "nowhere.yaml"), ["problems[1].problem", "nowhere.yaml"]),
        (("robots: 2", "robots: 200"), ["problems[0].problem", "1 to 8"]),
        (("robots: 2", "robot: 2"), ["problems[0].robot", "did you mean 'robots'"]),
        (("layouts: 3", "layouts: 3, layout: 1"), ["problems[0].layout", "one of the two"]),
        (("problem: square_free", "problem: square_free, robots: 2"), ["problems[1].problem"]),
        (("{problem: square_free}", "{problem: pick_place, robots: 2, objects: 2}"), ["twice", "pick_place 2/2"]),
        (("planner: composed-prm", "planner: composed"), ["planners[2].planner", "did you mean 'composed-prm'"]),
        (("[skeletons]", "[skeleton]"), ["planners[1].without[0]", "did you mean 'skeletons'"]),
        (("[informed-sampling]", "[skeletons]"), ["planners[2].without[0]", "informed-sampling"]),
        (("label: plain", "intra_orbit: prioritised"), ["planners[2].intra_orbit", "guided or unguided"]),
        (("label: plain", "label: guided"), ["planners", "'guided' twice"]),
        (("label: plain", "label: ''"), ["planners[2].label", "not empty"]),
        (
            ("composed-prm, without: [informed-sampling]", "prioritised, without: [goal-bias]"),
            ["planners[2].without[0]", "mechanisms of prioritised: refinement, factored-cache"],
        ),
        (("problems:\n", "problems: []\nx:\n"), ["x", "unknown key"]),
    ],
)
def test_mistakes_are_named(change: tuple[str, str], words: list[str], tmp_path: Path) -> None:
    assert change[0] in GOOD
    file = write(tmp_path, GOOD.replace(*change))
    with pytest.raises(MrtampError) as wrong:
        load_suite(file)
    message = str(wrong.value)
    assert message.startswith(f"{file}:") and "\n" not in message
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    ("name", "words"), [("smok", "did you mean 'smoke'"), ("no/where.yaml", "existing suite file")]
)
def test_unknown_suites_are_named(name: str, words: str) -> None:
    with pytest.raises(MrtampError, match=words):
        load_suite(name)


def test_names_of_generated_problems() -> None:
    named = {case.name: case for case in load_suite("layouts", find=False).cases}
    assert set(named) == {
        *("box_layout", "handover_layout 2 objects", "stacking_layout 2/4", "pick_place 3/3", "clutter 2/4")
    }
    assert named["box_layout"].task(7).parameters == {"layout_seed": 7} and named["box_layout"].task(7).load().robots
