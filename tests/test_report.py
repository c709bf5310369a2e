"""A plan in words."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
from discs import disc_problem, errand
from gantry import gantry_problem
from sketches import sketch

from mrtamp import report
from mrtamp.plan import Plan
from mrtamp.playback import standstill
from mrtamp.problem_file import load_problem


@pytest.fixture(scope="module")
def plan() -> Plan:
    return sketch(load_problem("pick_place", robots=2, objects=2))


def test_timeline_names_what_changes_and_when(plan: Plan) -> None:
    rows = report.timeline(plan)
    assert [(r.step, r.kind, r.robots, r.target) for r in rows] == [
        (1, "pick", ("arm1",), "arm1"),
        (2, "handover", ("arm1", "arm2"), "arm2"),
        (3, "place", ("arm2",), rows[0].source),
    ]
    assert [r.time for r in rows] == sorted(r.time for r in rows)
    assert rows[0].sentence == "arm1 picks cube1"
    assert rows[1].sentence == "arm1 hands cube1 to arm2"
    assert rows[2].sentence == "arm2 places cube1 at its start"


def test_text_has_aligned_columns(plan: Plan) -> None:
    lines = report.timeline_text(plan).splitlines()
    assert len(lines) == 2 + len(plan.transitions)
    column = lines[0].index("robots")
    assert [line[column:].split()[0] for line in lines[2:]] == ["arm1", "arm1", "arm2"]


def test_subgoals_have_words_too(tmp_path: Path) -> None:
    plan = errand(disc_problem(tmp_path))
    rows = report.timeline(plan)
    assert [(r.step, r.kind, r.subgoal, r.object, r.source, r.target) for r in rows] == [
        (1, "reach", "visit", "", "", ""),
        (1, "reach", "take", "token", "start of token", "b"),
        (2, "reach", "drop", "token", "b", "world"),
    ]
    assert [r.sentence for r in rows] == [
        "a reaches visit",
        "b reaches take and takes token",
        "b reaches drop, token stays there",
    ]
    lines = report.timeline_text(plan).splitlines()[2:]
    assert lines[0].endswith("visit") and lines[2].endswith("drop: b -> world")
    together = dataclasses.replace(rows[1], robots=("a", "b"))
    assert together.sentence == "a and b reach take and b takes token"
    assert json.loads(json.dumps(report.summary(plan)))["timeline"][1]["subgoal"] == "take"


def test_lengths_have_the_unit_of_the_joints(plan: Plan, tmp_path: Path) -> None:
    assert " rad, path length " in report.cost_text(plan)
    assert " m, path length " in report.cost_text(errand(disc_problem(tmp_path)))
    gantries = standstill(gantry_problem(tmp_path))
    assert "(makespan 0.000, path length 0.000)" in report.cost_text(gantries), "its joints slide and turn"


def test_a_plan_without_transitions_has_words_too(plan: Plan) -> None:
    still = standstill(plan.problem)
    assert "only move" in report.timeline_text(still)
    assert report.history_text(still) == "(no history)"


def test_long_history_keeps_first_last_and_largest_gains(plan: Plan) -> None:
    costs = [20.0, 19.9, 15.0, 14.9, 14.8, 9.0, 8.95, 8.9]
    plan.history[:] = [{"time_s": float(i), "cost": c} for i, c in enumerate(costs)]
    text = report.history_text(plan, most=4)
    assert [line.split()[-1] for line in text.splitlines()[2:6]] == ["20.000", "15.000", "9.000", "8.900"]
    assert "4 smaller improvements" in text
    assert "not shown" not in report.history_text(plan, most=8)


def test_summary_is_json(plan: Plan) -> None:
    data = json.loads(json.dumps(report.summary(plan)))
    assert data["problem"] == plan.problem.name
    assert [row["kind"] for row in data["timeline"]] == ["pick", "handover", "place"]
    assert data["makespan"] <= data["path_length"]
