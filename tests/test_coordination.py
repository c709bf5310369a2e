"""Coordination: plans that move one robot at a time become plans that move robots at the same time, and stay valid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arena import Parts, arena, visit, wall
from discs import HEIGHT, Errands, disc_problem, errand
from gantry import gantry_problem, valid_plan
from pydrake.math import RigidTransform

from mrtamp.check import check_plan
from mrtamp.coordination import coordinate
from mrtamp.plan import Plan, measures
from mrtamp.problem import WORLD, AtConfiguration, Attach, MovableObject, Shape, Subgoal


def coordinated(plan: Plan) -> Plan:
    """The plan with its motions at the earliest times; both are judged."""
    assert check_plan(plan).ok, str(check_plan(plan))
    parts = Parts(plan.problem)
    segments = coordinate(plan.segments, plan.transitions, parts.collision, parts.validity)
    after, report = parts.judged(segments, plan.transitions)
    assert report.ok, str(report)
    assert after.cost <= plan.cost + 1e-9
    return after


def ends(plan: Plan) -> list[dict[str, np.ndarray]]:
    """Where every robot that acts stands at each transition, and where all stand in the end."""
    at = [{r: s.q[r][-1] for r in t.active} for s, t in zip(plan.segments[:-1], plan.transitions, strict=True)]
    return [*at, {r: q[-1] for r, q in plan.segments[-1].q.items()}]


def assert_same_story(before: Plan, after: Plan) -> None:
    """The same transitions at the same configurations in the same modes, and paths of the same length."""
    assert [s.mode.key for s in after.segments] == [s.mode.key for s in before.segments]
    for a, b in zip(ends(before), ends(after), strict=True):
        assert set(a) == set(b)
        assert all(np.array_equal(a[r], b[r]) for r in a)
    path = [measures(p.segments)["path_length"] for p in (before, after)]
    assert path[1] == pytest.approx(path[0])


@pytest.mark.parametrize("scene", ["discs", "gantries"])
def test_hand_made_plans_stay_valid_and_never_cost_more(tmp_path: Path, scene: str) -> None:
    plan = errand(disc_problem(tmp_path)) if scene == "discs" else valid_plan(gantry_problem(tmp_path))
    assert_same_story(plan, coordinated(plan))


def test_independent_robots_take_as_long_as_the_longer_of_both(tmp_path: Path) -> None:
    subgoals = [visit("far", "a", (1, -1)), visit("near", "b", (0, 1))]
    problem = arena(tmp_path, {"a": (-1, -1), "b": (-1, 1)}, subgoals=subgoals)
    one_by_one = Errands(problem).move(b=(0, 1)).reach("near").move(a=(1, -1)).reach("far").plan()
    after = coordinated(one_by_one)
    assert measures(one_by_one.segments)["makespan"] == pytest.approx(3.0)
    assert measures(after.segments)["makespan"] == pytest.approx(2.0)
    assert_same_story(one_by_one, after)


def test_subgoals_keep_their_order_even_where_the_later_one_is_nearer(tmp_path: Path) -> None:
    """`near` is planned after `far`, so it happens when `far` has happened, although b could be there earlier."""
    subgoals = [visit("far", "a", (1, -1)), visit("near", "b", (-0.5, 1))]
    problem = arena(tmp_path, {"a": (-1, -1), "b": (-1, 1)}, subgoals=subgoals)
    plan = Errands(problem).move(a=(1, -1)).reach("far").move(b=(-0.5, 1)).reach("near").plan()
    after = coordinated(plan)
    assert [a.subgoal for t in after.transitions for a in t.actions] == ["far", "near"]
    assert measures(after.segments)["makespan"] == pytest.approx(2.0)


TOKEN = 0.05
"""Half the side of a token."""


def token_problem(folder: Path, at: tuple[float, float], stand: tuple[float, float], to: str):
    """A token at `at`, which disc b takes or lets go of where it stands at `stand`; disc a wants to cross."""
    token = MovableObject("token", WORLD, RigidTransform([*at, HEIGHT]), None, Shape("box", (2 * TOKEN,) * 3))
    take = Subgoal("take", {"b": AtConfiguration(np.array(stand))}, (), Attach("token", "b"))
    drop = Subgoal("drop", {"b": AtConfiguration(np.array([0.0, 0.3]))}, ("take",), Attach("token", WORLD))
    subgoals = [take, drop] if to == "world" else [take]
    return arena(folder, {"a": (-1, 0), "b": (0, 0.9)}, {"a": (1, 0)}, subgoals=subgoals, objects=[token])


def test_nobody_passes_where_an_object_still_lies(tmp_path: Path) -> None:
    """b takes the token out of a's way; a sets out at once but must not be there before b has left with it."""
    problem = token_problem(tmp_path, (0, 0), (0, 0.3), "b")
    plan = Errands(problem).move(b=(0, 0.3)).reach("take").move(b=(0, 0.9)).move(a=(1, 0)).plan()
    after = coordinated(plan)
    assert measures(plan.segments)["makespan"] == pytest.approx(3.2)
    assert measures(after.segments)["makespan"] < 2.9
    q_a = after.segments[0].q["a"]
    assert q_a[-1][0] > -1 + 0.3, "it did set out"
    assert q_a[:, 0].max() <= -0.2 - TOKEN + 1e-9, "but stays clear of the token as long as it lies there"


def test_nothing_is_put_where_somebody_is_still_to_pass(tmp_path: Path) -> None:
    """b brings the token to where a comes by: a was planned first, so b lets it go only behind a's back."""
    problem = token_problem(tmp_path, (0.0, 1.2), (0.0, 1.5), "world")
    problem = arena(
        tmp_path, {"a": (-1.6, 0), "b": (0, 1.5)}, {"a": (1, 0)}, subgoals=problem.subgoals, objects=problem.objects
    )
    plan = Errands(problem).reach("take").move(a=(1, 0)).move(b=(0, 0.3)).reach("drop").plan()
    after = coordinated(plan)
    assert measures(plan.segments)["makespan"] == pytest.approx(3.8)
    assert measures(after.segments)["makespan"] < 3.3, "b is on its way while a passes"
    assert after.segments[1].q["a"][-1][0] >= 0.2 + TOKEN - 1e-9, "a has passed when the token is put down"


@pytest.mark.parametrize("seed", range(6))
def test_random_plans_one_robot_at_a_time_never_get_worse(tmp_path: Path, seed: int) -> None:
    """Three discs visit random places in turn around a pillar; moves that would collide are not part of the plan."""
    rng = np.random.default_rng(seed)
    starts = {"a": (-1.5, -1.5), "b": (1.5, -1.5), "c": (1.5, 1.5)}
    pillar = wall("pillar", (-0.2, -0.2), (0.2, 0.2))
    here = {r: np.array(q) for r, q in starts.items()}

    def free(robot: str, there: np.ndarray) -> bool:
        x = here[robot] + np.linspace(0, 1, 60)[:, None] * (there - here[robot])
        others = [q for r, q in here.items() if r != robot]
        clear = all(np.linalg.norm(x - q, axis=1).min() > 0.42 for q in others)
        return clear and bool((np.abs(x).max(axis=1) > 0.45).all())

    visits: list[tuple[str, np.ndarray]] = []
    while len(visits) < 6:
        robot, there = str(rng.choice(list(starts))), rng.uniform(-1.7, 1.7, size=2)
        if free(robot, there):
            visits.append((robot, there))
            here[robot] = there
    subgoals = [visit(f"v{k}", r, (x[0], x[1])) for k, (r, x) in enumerate(visits)]
    problem = arena(tmp_path, starts, subgoals=subgoals, walls=[pillar])
    errands = Errands(problem)
    for k, (robot, there) in enumerate(visits):
        errands.move(**{robot: tuple(there)}).reach(f"v{k}")
    plan = errands.plan()
    after = coordinated(plan)
    assert_same_story(plan, after)
    longest = max(
        sum(float(np.linalg.norm(np.diff(s.q[r], axis=0), axis=1).sum()) for s in plan.segments) for r in starts
    )
    assert measures(after.segments)["makespan"] >= longest - 1e-9
