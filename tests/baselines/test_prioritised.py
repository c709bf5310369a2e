"""Space-time around what is scheduled: whole sequences wait, and only as long as they have to."""

from __future__ import annotations

import dataclasses
import itertools
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from arena import XY, Parts, arena, visit

from mrtamp.baselines.prioritised import Prioritised, PrioritisedOptions
from mrtamp.baselines.timeline import Piece, Timeline
from mrtamp.check import check_plan
from mrtamp.plan import Action, measures
from mrtamp.problem import HeldBy
from mrtamp.problem_file import load_problem
from mrtamp.space_time import STEP, Clearances
from mrtamp.timetable import timetable


class Course:
    """Straight courses of discs on a timeline."""

    def __init__(self, folder: Path, starts: dict[str, XY], subgoals: tuple = ()) -> None:
        self.parts = Parts(arena(folder, starts, subgoals=subgoals))
        self.clearances = Clearances(self.parts.collision, self.parts.validity, list(starts))
        q = {r: np.array(x, dtype=float) for r, x in starts.items()}
        self.line = Timeline(self.clearances, q, self.parts.root)

    def pieces(self, robot: str, *points: XY, start: XY | None = None) -> list[Piece]:
        table = self.clearances.tables[robot]
        rows = [self.line.at[robot] if start is None else self.clearances.row(robot, np.array(start, dtype=float))]
        for p in points:
            a, b = table[rows[-1]], np.array(p, dtype=float)
            n = int(np.ceil(np.linalg.norm(b - a) / STEP - 1e-9))
            rows += [self.clearances.row(robot, a + (b - a) * (j / n)) for j in range(1, n + 1)]
        return [Piece(a, b, self.parts.root) for a, b in itertools.pairwise(rows)]

    def makespan(self) -> float:
        segments, transitions = self.line.plan()
        assert self.parts.judged(segments, transitions)[1].ok
        return measures(segments)["makespan"]


def reach(name: str, robot: str) -> Action:
    return Action("reach", (robot,), None, None, name)


def test_the_second_waits_for_the_first_and_no_longer(tmp_path: Path) -> None:
    """Paths cross at right angles; with b late by w they are nearest at w / sqrt(2), so w = sqrt(2) 2 r has to be."""
    c = Course(tmp_path, {"a": (-1, 0), "b": (0, -1)})
    assert c.line.insert("a", c.pieces("a", (1, 0))) == []
    assert c.line.insert("b", c.pieces("b", (0, 1))) == []
    needed = np.sqrt(2) * 2 * 0.2
    assert needed - 0.02 <= c.makespan() - 2.0 <= needed + 2 * STEP


def test_who_is_far_away_does_not_wait(tmp_path: Path) -> None:
    c = Course(tmp_path, {"a": (-1, 1), "b": (-1, -1)})
    for robot, y in (("a", 1), ("b", -1)):
        assert c.line.insert(robot, c.pieces(robot, (1, y))) == []
    assert c.makespan() == pytest.approx(2.0)


def test_who_stands_in_the_way_for_good_cannot_be_passed(tmp_path: Path) -> None:
    c = Course(tmp_path, {"a": (0, 0), "b": (-1, 0)})
    assert c.line.insert("b", c.pieces("b", (1, 0))) is None
    assert c.line.blame["a"] > 0


def test_a_change_of_mode_waits_for_its_time(tmp_path: Path) -> None:
    """Half way, b has to wait until time 9; what it does afterwards is later, what a does is not."""
    goals = (visit("there", "b", (0, -1)),)
    c = Course(tmp_path, {"a": (-1, 1), "b": (-1, -1)}, goals)
    assert c.line.insert("a", c.pieces("a", (1, 1))) == []
    course = c.pieces("b", (0, -1))
    stop = course[-1].b
    course.append(Piece(stop, stop, c.parts.root, reach("there", "b"), earliest=9))
    course += c.pieces("b", (1, -1), start=(0, -1))
    assert c.line.insert("b", course) == [9]
    assert c.line.free_from == {"a": 7, "b": 9 + 4}
    assert [a.time for a in c.line.actions] == [9]
    assert c.line.mode.done == {"there"}


def test_later_in_priority_may_be_earlier_in_time(tmp_path: Path) -> None:
    goals = (visit("late", "a", (1, 1)), visit("soon", "b", (-0.7, -1)))
    c = Course(tmp_path, {"a": (-1, 1), "b": (-1, -1)}, goals)
    for robot, end, name in (("a", (1, 1), "late"), ("b", (-0.7, -1), "soon")):
        course = c.pieces(robot, end)
        row = course[-1].b
        c.line.insert(robot, [*course, Piece(row, row, c.parts.root, reach(name, robot))])
    segments, transitions = c.line.plan()
    assert [t.actions[0].subgoal for t in transitions] == ["soon", "late"]
    assert [len(s.mode.done) for s in segments] == [0, 1, 2]


def test_a_retreat_makes_room_and_is_taken_back_when_it_is_not_needed(tmp_path: Path) -> None:
    """a parks aside after its course; when it goes on first after all, it goes on from where it was."""
    c = Course(tmp_path, {"a": (-1, 0), "b": (0, -1)})
    course = c.pieces("a", (0, 0))
    c.line.insert("a", course, c.pieces("a", (-1, 0), start=(0, 0)))
    parked = c.line.free_from["a"]
    assert parked == 8
    following = c.pieces("a", (1, 0), start=(0, 0))
    following[0] = Piece(course[-1].b, following[0].b, c.parts.root)
    c.line.insert("a", following)
    assert c.line.free_from["a"] == 8 and c.makespan() == pytest.approx(2.0)


def test_prioritised_comes_near_known_optima() -> None:
    for name, share in (("square_free", 1.001), ("planar_passages", 1.06), ("planar_doorway", 1.15)):
        problem = load_problem(name)
        best = timetable(problem).cost
        planner = Prioritised(problem, seed=0)
        for plan in planner.improve(20.0, iterations=30):
            assert check_plan(plan).ok
            assert plan.cost >= best * (1 - 1e-6)
            if plan.cost <= share * best:
                break
        assert planner.cost <= share * best, name


def test_without_shortening_plans_are_dearer() -> None:
    problem = load_problem("planar_doorway")
    raw = Prioritised(problem, seed=0, options=PrioritisedOptions(without=frozenset({"refinement"})))
    full = Prioritised(problem, seed=0)
    for planner in (raw, full):
        list(planner.improve(iterations=6))
    assert full.cost < raw.cost < np.inf


def test_goals_that_are_no_list_of_tasks_are_named(tmp_path: Path) -> None:
    box = load_problem("box")
    item = box.objects[0].name
    planner = Prioritised(dataclasses.replace(box, goal=(HeldBy(item, box.robots[0].name),)), seed=0)
    assert list(planner.improve(iterations=2)) == []
    assert "no list of objects" in planner.explain()
