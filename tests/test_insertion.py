"""Insertion: skeletons become motions in space and time, robots stepping aside for one another where they must."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from arena import XY, Parts, arena, visit, wall

from mrtamp.modes import Mode
from mrtamp.plan import Plan, measures
from mrtamp.problem import Problem
from mrtamp.roadmap import Roadmap
from mrtamp.space_time import STEP
from mrtamp.transitions.candidate import Candidate

DOORWAY = [wall("below", (-0.1, -2.2), (0.1, -0.3)), wall("above", (-0.1, 0.3), (0.1, 2.2))]
"""A wall along the y axis with an opening of 0.6 m, which one disc at a time fits through."""


class Skeleton:
    """Visits of one disc each, in a given order, realised on random roadmaps."""

    def __init__(self, problem: Problem, visits: Sequence[str] = (), *, seed: int = 0, vertices: int = 60) -> None:
        self.problem = problem
        self.parts = Parts(problem, seed)
        self.goal = {c.robot: self.parts.vertex(c.robot, tuple(c.q)) for c in problem.goal}
        self.visits = list(visits)
        self.robots = [tuple(problem.subgoal(v).targets) for v in visits]
        self.at = [{r: self.parts.vertex(r, tuple(t.q)) for r, t in problem.subgoal(v).targets.items()} for v in visits]
        self.parts.scatter(vertices)
        self.insertion = self.parts.insertion()

    def stand(self, k: int, mode: Mode) -> Candidate | None:
        return Candidate("reach", self.robots[k], self.at[k], None, None, subgoal=self.visits[k])

    def realise(self) -> Plan | None:
        """The plan, judged; None when insertion fails."""
        before = [[i for i, v in enumerate(self.visits) if v in self.problem.subgoal(w).after] for w in self.visits]
        timed = self.insertion.realise(self.parts.root, self.parts.start, self.robots, before, self.stand, self.goal)
        if timed is None:
            assert self.insertion.stuck is not None
            return None
        assert self.insertion.stuck is None
        plan, report = self.parts.judged(*timed)
        assert report.ok, str(report)
        return plan


def path_length(plan: Plan, robot: str) -> float:
    return sum(float(np.linalg.norm(np.diff(s.q[robot], axis=0), axis=1).sum()) for s in plan.segments)


def order(plan: Plan) -> list[str | None]:
    return [a.subgoal for t in plan.transitions for a in t.actions]


def test_a_disc_that_is_parked_in_the_way_steps_aside_and_ends_where_it_has_to(tmp_path: Path) -> None:
    """b stands in the doorway and has to be there in the end too; a has to get through."""
    ends: dict[str, XY] = {"a": (1, 0), "b": (0, 0)}
    skeleton = Skeleton(arena(tmp_path, {"a": (-1, 0), "b": (0, 0)}, ends, walls=DOORWAY))
    plan = skeleton.realise()
    assert plan is not None
    assert path_length(plan, "b") > 2 * 0.3, "out of the doorway and back"


@pytest.mark.parametrize("seed", range(3))
def test_discs_that_stand_on_each_others_goals_exchange_them_through_the_doorway(tmp_path: Path, seed: int) -> None:
    starts: dict[str, XY] = {"a": (-0.5, 0), "b": (0.5, 0)}
    skeleton = Skeleton(arena(tmp_path, starts, {"a": starts["b"], "b": starts["a"]}, walls=DOORWAY), seed=seed)
    # Where robots step aside to is drawn at random: a skeleton that fails is tried again.
    plan = next((plan for plan in (skeleton.realise() for _ in range(6)) if plan is not None), None)
    assert plan is not None
    # Whoever goes first needs the other one away from its goal and from the line between.
    assert max(path_length(plan, r) for r in "ab") > 1.0 + 0.2


def test_finished_robots_move_on_for_those_that_are_not(tmp_path: Path) -> None:
    """a visits the doorway and has nowhere to be afterwards; b has to get through it."""
    subgoals = [visit("door", "a", (0, 0)), visit("through", "b", (1.2, 0), "door")]
    skeleton = Skeleton(
        arena(tmp_path, {"a": (-0.7, 0), "b": (-1.5, 0)}, subgoals=subgoals, walls=DOORWAY), ["door", "through"]
    )
    plan = skeleton.realise()
    assert plan is not None
    assert order(plan) == ["door", "through"]
    assert np.linalg.norm(plan.segments[-1].q["a"][-1]) > 0.2


def test_stops_happen_in_the_order_that_is_soonest_unless_precedence_says_otherwise(tmp_path: Path) -> None:
    """The skeleton lists the far visit first; nothing asks for that order, so the near one happens first."""
    starts: dict[str, XY] = {"a": (-1, -1), "b": (-1, 1)}
    for after, expected in (((), ["near", "far"]), (("far",), ["far", "near"])):
        subgoals = [visit("far", "a", (1, -1)), visit("near", "b", (0, 1), *after)]
        skeleton = Skeleton(arena(tmp_path, starts, subgoals=subgoals), ["far", "near"])
        plan = skeleton.realise()
        assert plan is not None
        assert order(plan) == expected
        assert measures(plan.segments)["makespan"] == pytest.approx(2.0, abs=2 * STEP)


def test_robots_that_do_not_meet_move_at_the_same_time(tmp_path: Path) -> None:
    ends: dict[str, XY] = {"a": (1, -1), "b": (1, 0), "c": (1, 1)}
    skeleton = Skeleton(arena(tmp_path, {r: (-1, y) for r, (_, y) in ends.items()}, ends))
    plan = skeleton.realise()
    assert plan is not None
    assert measures(plan.segments)["makespan"] == pytest.approx(2.0)
    assert measures(plan.segments)["path_length"] == pytest.approx(6.0)


CELL = [
    wall("cell_left", (0.7, -0.4), (0.8, 0.4)),
    wall("cell_right", (1.3, -0.4), (1.4, 0.4)),
    wall("cell_below", (0.7, -0.4), (1.4, -0.3)),
    wall("cell_above", (0.7, 0.3), (1.4, 0.4)),
]


def test_the_stop_that_nobody_can_reach_is_reported(tmp_path: Path) -> None:
    """b is shut in where a's second stop is."""
    subgoals = [visit("easy", "a", (-1, 1)), visit("hard", "a", (1.05, 0.0), "easy")]
    skeleton = Skeleton(
        arena(tmp_path, {"a": (-1, 0), "b": (1.05, 0)}, subgoals=subgoals, walls=CELL), ["easy", "hard"]
    )
    assert skeleton.realise() is None
    assert skeleton.insertion.stuck == 1


def test_a_robot_that_cannot_get_out_of_the_way_is_no_reason_to_collide(tmp_path: Path) -> None:
    """The wall has no way through but the doorway, and b is fenced in there."""
    fence = [wall("left", (-0.3, -0.35), (-0.25, 0.35)), wall("right", (0.25, -0.35), (0.3, 0.35))]
    subgoals = [visit("across", "a", (1, 0))]
    skeleton = Skeleton(
        arena(tmp_path, {"a": (-1, 0), "b": (0, 0)}, subgoals=subgoals, walls=[*DOORWAY, *fence]), ["across"]
    )
    assert skeleton.realise() is None
    assert skeleton.insertion.stuck == 0


def test_a_transition_that_is_not_possible_is_reported(tmp_path: Path) -> None:
    skeleton = Skeleton(
        arena(tmp_path, {"a": (-1, 0)}, subgoals=[visit("one", "a", (0, 0)), visit("two", "a", (1, 0), "one")]),
        ["one", "two"],
    )
    possible = skeleton.stand
    skeleton.stand = lambda k, mode: possible(k, mode) if k == 0 else None  # type: ignore[method-assign]
    assert skeleton.realise() is None
    assert skeleton.insertion.stuck == 1


def test_equal_generators_give_equal_plans(tmp_path: Path) -> None:
    starts: dict[str, XY] = {"a": (-0.5, 0), "b": (0.5, 0)}
    problem = arena(tmp_path, starts, {"a": starts["b"], "b": starts["a"]}, walls=DOORWAY)
    one, two = (Skeleton(problem, seed=0).realise() for _ in range(2))
    assert one is not None and two is not None
    for robot in starts:
        np.testing.assert_array_equal(one.segments[0].q[robot], two.segments[0].q[robot])


def test_who_steps_aside_goes_where_the_roadmap_has_a_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """b has to leave the doorway for a; ways that no roadmap has are sought to where robots end, nowhere else."""
    ends: dict[str, XY] = {"a": (1, 0), "b": (0, 0)}
    closed = wall("closed", (1.5, -2.5), (1.6, 2.5))
    skeleton = Skeleton(arena(tmp_path, {"a": (-1, 0), "b": (0, 0)}, ends, walls=[*DOORWAY, closed]), vertices=4)
    for y in np.linspace(-1, 1, 9):
        skeleton.parts.vertex("b", (1.85, float(y)))
    connector = skeleton.insertion.steering.connector
    sought: list[tuple[str, int]] = []

    def connect(roadmap: Roadmap, mode: Mode, a: int, b: int, *_: object) -> None:
        sought.append((roadmap.name, b))

    monkeypatch.setattr(connector, "connect", connect)
    for _ in range(5):
        skeleton.realise()
    assert set(sought) <= set(skeleton.goal.items())
