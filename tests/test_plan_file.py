"""Plan files come back bit for bit, stand alone, fit their schema, and say what is wrong with them."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from discs import disc_problem, errand
from gantry import gantry_problem, valid_plan

from mrtamp.check import check_plan
from mrtamp.model_files import models_dir
from mrtamp.plan import Plan
from mrtamp.plan_file import PlanError, load_plan, plan_from_dict, plan_to_dict, save_plan
from mrtamp.problem import MrtampError


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    plan = valid_plan(gantry_problem(tmp_path_factory.mktemp("gantry")))
    # Numbers that need all their digits.
    for segment in plan.segments:
        segment.q["right"][:, 3] = np.pi / 3 * 1e-17
    return plan


@pytest.fixture(scope="module")
def data(plan: Plan) -> dict[str, Any]:
    return json.loads(json.dumps(plan_to_dict(plan)))


def test_a_plan_comes_back_bit_for_bit(plan: Plan, tmp_path: Path) -> None:
    plan.save(tmp_path / "plan.json")
    back = Plan.load(tmp_path / "plan.json")
    assert back.cost == plan.cost
    assert back.history == plan.history
    assert (back.counts, back.seed, back.versions) == (plan.counts, plan.seed, plan.versions)
    for one, two in zip(plan.segments, back.segments, strict=True):
        assert list(one.q) == list(two.q)
        assert all(np.array_equal(one.q[r], two.q[r]) for r in one.q)
        for a, b in zip(one.mode.attachments, two.mode.attachments, strict=True):
            assert (a.object, a.parent, a.support, a.width) == (b.object, b.parent, b.support, b.width)
            assert np.array_equal(a.X_PO, b.X_PO)
    for s, t in zip(plan.transitions, back.transitions, strict=True):
        assert (s.kind, s.active) == (t.kind, t.active)
    back.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_text() == (tmp_path / "plan.json").read_text()


def test_attachments_keep_their_identity(plan: Plan, data: dict[str, Any]) -> None:
    back = plan_from_dict(data)
    for k, transition in enumerate(back.transitions):
        for action in transition.actions:
            assert action.before is back.segments[k].mode.of[action.object]
            assert action.after is back.segments[k + 1].mode.of[action.object]
    assert back.segments[0].mode.of["block"] is back.segments[-1].mode.of["block"]
    assert len(data["attachments"]) == len({id(a) for s in plan.segments for a in s.mode.attachments})


def test_a_loaded_plan_is_still_valid(data: dict[str, Any]) -> None:
    report = check_plan(plan_from_dict(data))
    assert report.ok, str(report)


def test_a_file_is_one_line_per_waypoint(plan: Plan, tmp_path: Path) -> None:
    plan.save(tmp_path / "plan.json")
    lines = [line.strip().rstrip(",") for line in (tmp_path / "plan.json").read_text().splitlines()]
    assert json.dumps(plan.segments[1].q["left"][1].tolist()) in lines


def test_the_schema_accepts_plans_and_rejects_others(data: dict[str, Any]) -> None:
    schema = json.loads((models_dir() / "schema" / "plan.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    validator.validate(data)
    for key in ("problem", "segments", "attachments"):
        assert not validator.is_valid({k: v for k, v in data.items() if k != key})
    assert not validator.is_valid({**data, "mrtamp_plan": 2})


@pytest.fixture(scope="module")
def errands(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The file of a plan that reaches subgoals: two at once, one of which takes an object, then one that drops it."""
    plan = errand(disc_problem(tmp_path_factory.mktemp("discs")))
    return json.loads(json.dumps(plan_to_dict(plan)))


def test_subgoals_come_back(errands: dict[str, Any]) -> None:
    back = plan_from_dict(errands)
    assert [sorted(s.mode.done) for s in back.segments] == [[], ["take", "visit"], ["drop", "take", "visit"]]
    assert [[a.subgoal for a in t.actions] for t in back.transitions] == [["visit", "take"], ["drop"]]
    visit, take = back.transitions[0].actions
    assert (visit.kind, visit.before, visit.after, visit.object) == ("reach", None, None, None)
    assert take.before is back.segments[0].mode.of["token"] and take.after is back.segments[1].mode.of["token"]
    assert plan_to_dict(back) == errands
    assert "done" not in errands["segments"][0]
    report = check_plan(back)
    assert report.ok, str(report)


def test_the_schema_knows_subgoals(errands: dict[str, Any]) -> None:
    validator = jsonschema.Draft202012Validator(json.loads((models_dir() / "schema" / "plan.schema.json").read_text()))
    validator.validate(errands)
    for spoil in (
        _drop("transitions", 0, "actions", 0, "subgoal"),
        _set("transitions", 0, "actions", 0, "kind", "pick"),
        _set("segments", 1, "done", ["take", "take"]),
    ):
        spoiled = copy.deepcopy(errands)
        spoil(spoiled)
        assert not validator.is_valid(spoiled)


def _set(*path_and_value: Any) -> Callable[[dict[str, Any]], None]:
    *path, key, value = path_and_value

    def spoil(data: dict[str, Any]) -> None:
        place: Any = data
        for step in path:
            place = place[step]
        place[key] = value

    return spoil


def _drop(*path: Any) -> Callable[[dict[str, Any]], None]:
    def spoil(data: dict[str, Any]) -> None:
        place: Any = data
        for step in path[:-1]:
            place = place[step]
        del place[path[-1]]

    return spoil


MISTAKES = {
    "mrtamp_plan: found 7": _set("mrtamp_plan", 7),
    "found no key 'segments'": _drop("segments"),
    "plan: price: found the unknown key 'price'": _set("price", 1),
    "cost: found 'cheap', expected a number": _set("cost", "cheap"),
    "seed: found 1.5, expected a whole number": _set("seed", 1.5),
    "problem: goal": _set("problem", "goal", []),
    "problem: robots[0].model": _set("problem", "robots", 0, "model", "robby"),
    "attachments[1].id: found the id 0 again": _set("attachments", 1, "id", 0),
    "attachments[0].parent: found 'tabel'": _set("attachments", 0, "parent", "tabel"),
    "did you mean 'table'?": _set("attachments", 0, "parent", "tabel"),
    "attachments[0].X_PO: found [0, 0, 0, 1]": _set("attachments", 0, "X_PO", [0, 0, 0, 1]),
    "a quaternion of length 1": _set("attachments", 0, "X_PO", [0, 0, 0, 1, 1, 0, 0]),
    "the rotation matrix of the quaternion": _set("attachments", 0, "R_PO", [0.0] * 9),
    "segments[1].mode.cube: found 99, expected the id of an attachment of 'cube'": _set(
        "segments", 1, "mode", "cube", 99
    ),
    "segments[1].mode.cube: found 1, expected the id of an attachment": _set("segments", 1, "mode", "cube", 1),
    "segments[2].q.left[1]": _set("segments", 2, "q", "left", 1, [0.0, 0.0]),
    "segments[2].q.left[1][0]: found 'a'": _set("segments", 2, "q", "left", 1, ["a", 0, 0, 0]),
    "segments[2].q: found no key 'right'": _drop("segments", 2, "q", "right"),
    "the same number for every robot": _drop("segments", 2, "q", "right", 0),
    "transitions[0].active: found ['right'], expected ['left']": _set("transitions", 0, "active", ["right"]),
    "transitions[0].kind: found 'place', expected 'pick'": _set("transitions", 0, "kind", "place"),
    "transitions[0].actions[0].kind: found 'grab'": _set("transitions", 0, "actions", 0, "kind", "grab"),
    "transitions[0].actions: found [], expected at least one action": _set("transitions", 0, "actions", []),
    "expected one between every two of the 6 segments": _drop("transitions", 0),
    "history[0]: found no key 'time_s'": _drop("history", 0, "time_s"),
    "counts.nodes: found 'many'": _set("counts", "nodes", "many"),
}


SUBGOAL_MISTAKES = {
    "segments[1].done[0]: found 'tke', expected one of the subgoals: visit, take, drop": _set(
        "segments", 1, "done", ["tke"]
    ),
    "segments[1].done: found ['take', 'take'], expected each subgoal once": _set("segments", 1, "done", ["take"] * 2),
    "transitions[0].actions[0]: found no key 'subgoal'": _drop("transitions", 0, "actions", 0, "subgoal"),
    "transitions[0].actions[0].subgoal: found 'a', expected one of the subgoals": _set(
        "transitions", 0, "actions", 0, "subgoal", "a"
    ),
    "transitions[0].actions[0].subgoal: found 'visit', expected none: a pick reaches": _set(
        "transitions", 0, "actions", 0, "kind", "pick"
    ),
    "transitions[0].actions[0].after: found 0, expected null": _set("transitions", 0, "actions", 0, "after", 0),
    "transitions[0].actions[1].after: found nothing, expected the id": _set(
        "transitions", 0, "actions", 1, "after", None
    ),
    "problem: subgoals[2].after[0]: found 'tke'": _set("problem", "subgoals", 2, "after", ["tke"]),
}


@pytest.mark.parametrize("message", SUBGOAL_MISTAKES)
def test_mistakes_about_subgoals_are_named(errands: dict[str, Any], message: str) -> None:
    spoiled = copy.deepcopy(errands)
    SUBGOAL_MISTAKES[message](spoiled)
    with pytest.raises(PlanError) as caught:
        plan_from_dict(spoiled)
    assert message in str(caught.value)


@pytest.mark.parametrize("message", MISTAKES)
def test_mistakes_are_named(data: dict[str, Any], message: str) -> None:
    spoiled = copy.deepcopy(data)
    MISTAKES[message](spoiled)
    with pytest.raises(PlanError) as caught:
        plan_from_dict(spoiled)
    assert message in str(caught.value)
    assert issubclass(PlanError, MrtampError)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "plan.json:1: not valid JSON"),
        ('{"cost": NaN}', "found NaN, expected a finite number"),
        ("[]", "expected a mapping"),
        ("[" * 100_000, "not valid JSON"),
    ],
)
def test_files_that_are_no_plans(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "plan.json").write_text(text)
    with pytest.raises(PlanError, match=r"plan\.json") as caught:
        load_plan(tmp_path / "plan.json")
    assert message in str(caught.value)


def test_files_that_are_not_there(plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(PlanError, match="No such file"):
        load_plan(tmp_path / "nothing.json")
    with pytest.raises(PlanError, match="cannot be saved"):
        save_plan(plan, tmp_path / "nowhere" / "plan.json")


def test_a_failed_save_leaves_the_old_file(
    data: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "plan.json"
    plan = plan_from_dict(data)
    plan.save(path)
    before = path.read_text()
    plan.cost = float("nan")
    with pytest.raises(PlanError, match="cannot be saved"):
        plan.save(path)
    plan.cost = 1.0

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mrtamp.plan_file.os.fsync", full)
    with pytest.raises(PlanError, match="No space left"):
        plan.save(path)
    assert path.read_text() == before
    assert [p.name for p in tmp_path.iterdir()] == ["plan.json"]
