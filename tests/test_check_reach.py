"""The judge on subgoals: a hand-made plan is accepted, and each way of getting it wrong is found."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from discs import HEIGHT, RADIUS, Errands, disc_problem, errand
from gantry import Script, gantry_problem, grasp
from pydrake.math import RigidTransform, RollPitchYaw

from mrtamp.check import Report, check_plan
from mrtamp.check_stretches import Allowance
from mrtamp.collision import Collision
from mrtamp.modes import Attachment
from mrtamp.plan import Plan, Segment, Transition
from mrtamp.problem import WORLD, AtConfiguration, Attach, CollisionRules, Problem, Shape, StaticBody, Subgoal


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return disc_problem(tmp_path_factory.mktemp("discs"))


def verdict(plan: Plan) -> set[str]:
    return check_plan(plan).kinds


def test_a_plan_that_reaches_every_subgoal_is_accepted(problem: Problem) -> None:
    report = check_plan(errand(problem))
    assert report.ok, str(report)
    # The closest approach: b stands 5 cm from the token when it takes it.
    assert report.min_clearance_m == pytest.approx(0.05, abs=1e-3)


def test_things_may_follow_each_other_in_no_time(problem: Problem) -> None:
    """Two transitions at one configuration, with a segment of a single waypoint between them."""
    e = Errands(problem).move(a=(-0.5, -0.9)).move(b=(0.9, -0.5)).reach("visit").reach("take")
    e.move(b=(0.9, 0.5)).move(a=(-0.5, -0.5), b=(0.5, 0.5)).reach("drop")
    plan = e.plan()
    assert plan.segments[1].length == 1
    report = check_plan(plan)
    assert report.ok, str(report)


def forget(problem: Problem) -> Plan:
    return (
        Errands(problem).move(b=(0.9, -0.5)).reach("take").move(b=(0.9, 0.5)).move(b=(0.55, 0.5)).reach("drop").plan()
    )


def twice(problem: Problem) -> Plan:
    e = Errands(problem).move(a=(-0.5, -0.9), b=(0.9, -0.5)).reach("visit", "take").reach("visit")
    return e.move(b=(0.9, 0.5)).move(a=(-0.5, -0.5), b=(0.55, 0.5)).reach("drop").plan()


def too_early(problem: Problem) -> Plan:
    return Errands(problem).move(b=(0.9, 0.5)).move(b=(0.55, 0.5)).reach("drop").plan()


def beside(problem: Problem) -> Plan:
    return Errands(problem).move(a=(-0.5, -0.8999)).move(a=(-0.5, -0.8997)).reach("visit").plan()


def beside_the_pose(problem: Problem) -> Plan:
    return Errands(problem).move(b=(0.8997, -0.5)).reach("take").plan()


def beside_the_box(problem: Problem) -> Plan:
    return (
        Errands(problem).move(b=(0.9, -0.5)).reach("take").move(b=(0.9, 0.5)).move(b=(0.601, 0.5)).reach("drop").plan()
    )


@pytest.mark.parametrize(
    ("plan", "kind", "text"),
    [
        (forget, "goal", "visit is never reached"),
        (twice, "transition", "reach of visit: it has been reached before"),
        (too_early, "transition", "reach of drop: take should have been reached before"),
        (beside, "transition", "reach of visit: a is 0.0003 from its configuration"),
        (beside_the_pose, "transition", "reach of take: b is 0.30 mm and 0.00 degrees from its pose"),
        (beside_the_box, "transition", "reach of drop: b is 1.00 mm outside its box"),
    ],
)
def test_what_is_not_reached_is_found(problem: Problem, plan: Callable[[Problem], Plan], kind: str, text: str) -> None:
    report = check_plan(plan(problem))
    assert any(v.kind == kind and text in v.message for v in report.violations), str(report)


def edit(plan: Plan, k: int, n: int = 0, **changes) -> Plan:
    """The plan with another action n at transition k, and modes that follow from it."""
    actions = list(plan.transitions[k].actions)
    actions[n] = dataclasses.replace(actions[n], **changes)
    transitions = [Transition(tuple(actions)) if i == k else t for i, t in enumerate(plan.transitions)]
    segments = [plan.segments[0]]
    for segment, transition in zip(plan.segments[1:], transitions, strict=True):
        segments.append(Segment(segments[-1].mode.after(transition), segment.q))
    return dataclasses.replace(plan, segments=segments, transitions=transitions)


def moved(a: Attachment | None, **changes) -> Attachment:
    assert a is not None
    return dataclasses.replace(a, **changes)


def test_an_unknown_subgoal_and_the_wrong_robots_are_found(problem: Problem) -> None:
    plan = errand(problem)
    assert "unknown subgoal 'visits', expected one of visit, take, drop" in str(
        check_plan(edit(plan, 0, subgoal="visits"))
    )
    assert "the robots are a, b, expected a" in str(check_plan(edit(plan, 0, robots=("a", "b"))))
    assert "only a reach reaches a subgoal" in str(check_plan(edit(plan, 0, kind="pick")))
    assert "token is not attached to world" in str(check_plan(edit(plan, 1, before=None, after=None)))


def test_the_object_is_attached_as_the_subgoal_says_and_where_it_is(problem: Problem) -> None:
    plan = errand(problem)
    take, drop = plan.transitions[0].actions[1], plan.transitions[1].actions[0]
    elsewhere = moved(take.after, X_PO=RigidTransform([0, -0.31, 0]).GetAsMatrix4())
    assert "token jumps by 10.00 mm" in str(check_plan(edit(plan, 0, 1, after=elsewhere)))
    turned = moved(take.after, X_PO=RigidTransform(RollPitchYaw(0, 0, 0.1), [0, -0.3, 0]).GetAsMatrix4())
    assert "continuity" in verdict(edit(plan, 0, 1, after=turned))
    assert "token is held by a, which has no gripper" in str(
        check_plan(edit(plan, 0, 1, after=moved(take.after, parent="a")))
    )
    assert "rests on 'somewhere'" in str(check_plan(edit(plan, 1, after=moved(drop.after, support="somewhere"))))
    assert "rests on 'at drop'" in str(check_plan(edit(plan, 1, after=moved(drop.after, parent="wall"))))


def test_modes_say_what_has_been_reached(problem: Problem) -> None:
    plan = errand(problem)
    segments = [dataclasses.replace(s, mode=dataclasses.replace(s.mode, done=frozenset())) for s in plan.segments]
    report = check_plan(dataclasses.replace(plan, segments=segments))
    assert "transition" in report.kinds and "goal" in report.kinds
    everything = frozenset(s.name for s in problem.subgoals)
    segments = [dataclasses.replace(s, mode=dataclasses.replace(s.mode, done=everything)) for s in plan.segments]
    report = check_plan(dataclasses.replace(plan, segments=segments))
    assert "start" in report.kinds and "transition" in report.kinds


def test_two_robots_reach_together_or_not_at_all(problem: Problem) -> None:
    both = Subgoal("meet", {n: AtConfiguration(np.array([x, 0.5])) for n, x in (("a", 0.3), ("b", 0.75))})
    apart = dataclasses.replace(problem, subgoals=(both,), goal=())
    e = Errands(apart).move(a=(-1.1, -0.5), b=(1, -0.5)).move(a=(-1.1, 0.5), b=(1, 0.5))
    assert check_plan(e.move(a=(0.3, 0.5), b=(0.75, 0.5)).reach("meet").plan()).ok
    e = Errands(apart).move(a=(-1.1, -0.5), b=(1, -0.5)).move(a=(-1.1, 0.5), b=(1, 0.5))
    assert "b is 0.05 from its configuration" in str(
        check_plan(e.move(a=(0.3, 0.5), b=(0.8, 0.5)).reach("meet").plan())
    )


def test_what_was_let_go_stays_and_may_not_be_run_over(problem: Problem) -> None:
    plan = errand(problem)
    through = {**plan.segments[-1].q, "b": np.array([[0.55, 0.5], [0.55, 0.3]])}
    segments = [*plan.segments[:-1], Segment(plan.segments[-1].mode, through)]
    assert "collision" in verdict(dataclasses.replace(plan, segments=segments))


def test_a_held_object_may_touch_the_body_that_carries_the_grasp_frame(problem: Problem) -> None:
    """The token starts 5 mm inside the place of the disc that takes it: arriving collides, carrying does not."""
    token = dataclasses.replace(problem.objects[0], start_X_BO=RigidTransform([0.9, -0.745, 0.06]))
    close = dataclasses.replace(problem, objects=(token,))
    report = check_plan(errand(close))
    assert {v.segment for v in report.violations} == {0, 2}, "on arrival, and once it is let go"
    through = dataclasses.replace(close, collision=CollisionRules((("b/disc", "token"),)))
    assert check_plan(errand(through)).ok


def test_a_taken_object_leaves_what_it_stands_on_like_a_picked_one(problem: Problem) -> None:
    """The disc drags the token in +y off a ledge: over its edge is a lift, along its top is not."""

    def on_ledge(overlap: float) -> Problem:
        ledge = StaticBody("ledge", RigidTransform([0.9, -0.9 + overlap, 0.0]), Shape("box", (0.1, 0.1, 0.02)))
        X_BO = RigidTransform([0, 0.1 - overlap, HEIGHT])
        token = dataclasses.replace(problem.objects[0], start_on="ledge", start_X_BO=X_BO)
        return dataclasses.replace(problem, statics=(*problem.statics, ledge), objects=(token,))

    report = check_plan(errand(on_ledge(0.007)))
    assert report.ok, str(report)
    report = check_plan(errand(on_ledge(0.05)))
    assert "contact" in report.kinds
    assert "token has moved 10.0 mm along ledge in contact after it is picked from it" in str(report)
    free = dataclasses.replace(on_ledge(0.05), collision=CollisionRules((("token", "ledge"),)))
    assert check_plan(errand(free)).ok, "pairs that are ignored are never in contact"


def test_a_tolerance_is_for_the_sum_of_penetrations(problem: Problem) -> None:
    """Discs that overlap by 4 mm at their meeting, and one of them the wall by 3 mm."""
    meeting = {"a": np.array([0.15, 0.247]), "b": np.array([0.15 + 0.396, 0.247])}
    both = Subgoal("meet", {n: AtConfiguration(q) for n, q in meeting.items()})

    def with_tolerance(tolerance: float) -> Problem:
        return dataclasses.replace(
            problem, subgoals=(both,), goal=(), objects=(), collision=CollisionRules((), tolerance)
        )

    def meet(tolerance: float) -> Plan:
        e = Errands(with_tolerance(tolerance)).move(a=(-1.1, -0.5), b=(1, -0.5)).move(a=(-1.1, 0.5), b=(1, 0.5))
        e.move(a=(0.1, 0.5), b=(1, 0.5)).move(**meeting).reach("meet")
        return e.plan()

    apart = {v.sides[0].owner + v.sides[1].owner for v in check_plan(meet(0.0)).violations if v.sides}
    assert len(apart) == 2
    assert not check_plan(meet(0.005)).ok, "each alone would be tolerated"
    assert check_plan(meet(0.0071)).ok, str(check_plan(meet(0.0071)))


def test_a_subgoal_can_hand_an_object_from_robot_to_robot(problem: Problem) -> None:
    give = Subgoal("give", {"a": AtConfiguration(np.array([0.9, -1.05]))}, ("take",), Attach("token", "a"))
    both = dataclasses.replace(problem, subgoals=(problem.subgoal("take"), give), goal=())
    e = Errands(both).move(b=(0.9, -0.5)).move(a=(-0.5, -1.2)).move(a=(0.8, -1.2)).reach("take")
    e.move(b=(0.9, -0.45)).move(a=(0.9, -1.05)).reach("give").move(a=(0.9, -1.2))
    report = check_plan(e.plan())
    assert report.ok, str(report)


def test_a_robot_with_fingers_keeps_them_as_they_are(tmp_path: Path) -> None:
    """The gantry takes the cube between its open fingers, though that is none of the cube's grasps; then lets go."""
    gantries = gantry_problem(tmp_path)
    take = Subgoal("take", {"left": AtConfiguration(np.array([-0.4, 0, 0.04, 0]))}, (), Attach("cube", "left"))
    drop = Subgoal("drop", {"left": AtConfiguration(np.array([-0.4, 0.1, 0.3, 0]))}, ("take",), Attach("cube", WORLD))
    problem = dataclasses.replace(gantries, subgoals=(take, drop), goal=())

    def carry() -> Plan:
        s = Script(problem).move(left=(-0.4, 0, 0.2)).move(left=(-0.4, 0, 0.04))
        X_GO = RigidTransform(RollPitchYaw(np.pi, 0, 0), [0, 0, 0.01]).inverse()
        s.reach("take", Attachment("cube", "left", X_GO.GetAsMatrix4()))
        s.move(left=(-0.4, 0, 0.3)).move(left=(-0.4, 0.1, 0.3))
        s.reach("drop", Attachment("cube", WORLD, RigidTransform([-0.4, 0.1, 0.29]).GetAsMatrix4(), "at drop"))
        return s.move(left=(-0.4, 0.1, 0.4)).plan()

    report = check_plan(carry())
    assert report.ok, str(report)
    plan = carry()
    picked = edit(plan, 0, kind="pick", subgoal=None)
    assert "only a reach fixes an object like that" in str(check_plan(picked))
    squeezed = edit(plan, 0, after=moved(plan.transitions[0].actions[0].after, width=0.04))
    assert "expected cube to left" in str(check_plan(squeezed))


def test_what_rests_can_be_fixed_to_something_else_where_it_is(tmp_path: Path) -> None:
    """The cube stands on the table, beside the block: from now on it belongs to the block and goes where that goes."""
    gantries = gantry_problem(tmp_path)
    cube = dataclasses.replace(gantries.objects[0], start_X_BO=RigidTransform([-0.4, 0.2595, 0.05]))
    tie = Subgoal("tie", {"right": AtConfiguration(np.array([0.5, 0.1, 0.3, 0]))}, (), Attach("cube", "block"))
    problem = dataclasses.replace(gantries, objects=(cube, *gantries.objects[1:]), subgoals=(tie,), goal=())
    X_BO = RigidTransform([0, -0.0405, 0]).GetAsMatrix4()

    def tied() -> Script:
        return Script(problem).move(right=(0.5, 0.1, 0.3)).reach("tie", Attachment("cube", "block", X_BO, "at tie"))

    report = check_plan(tied().move(right=(0.5, 0.2, 0.3)).plan())
    assert report.ok, str(report)
    s = tied().move(left=(-0.4, 0.3, 0.3)).move(left=(-0.4, 0.3, 0.04)).change("pick", grasp("block", "left"))
    assert "cube rests on it" in str(check_plan(s.move(left=(-0.4, 0.3, 0.3)).plan()))


def test_objects_at_rest_count_towards_the_tolerance(tmp_path: Path) -> None:
    """Cube and block overlap by 2 mm where they stand."""
    gantries = gantry_problem(tmp_path)
    cube = dataclasses.replace(gantries.objects[0], start_X_BO=RigidTransform([-0.4, 0.262, 0.05]))

    def report(tolerance: float) -> Report:
        rules = CollisionRules((), tolerance)
        objects = (cube, *gantries.objects[1:])
        problem = dataclasses.replace(gantries, objects=objects, goal=(), collision=rules)
        return check_plan(Script(problem).move(left=(-0.5, 0, 0.4)).plan())

    assert "cube and block collide at rest, 2.00 mm deep" in str(report(0.0))
    assert not report(0.0019).ok
    assert report(0.0021).ok


def test_the_judge_and_the_planners_plants_agree_with_the_formula(problem: Problem) -> None:
    """Two discs and a wall, at random: penetrations in closed form, against the judge's sum and each plant's own."""
    rng = np.random.default_rng(0)
    verdicts = set()
    for _ in range(60):
        tolerance = float(rng.choice([0.0, 0.01, 0.03]))
        a = np.array([rng.uniform(-0.7, 0.1), rng.uniform(0.22, 0.27)])
        angle, gap = rng.uniform(0.3, 2.8), rng.uniform(-0.03, 0.02)
        b = a + (2 * RADIUS + gap) * np.array([np.cos(angle), np.sin(angle)])
        into_wall, into_disc = max(0.05 + RADIUS - a[1], 0.0), max(-gap, 0.0)
        if min(abs(x - tolerance) for x in (into_wall, into_disc, into_wall + into_disc)) < 2e-4:
            continue  # Drake's depths are good to 2e-5
        robots = tuple(dataclasses.replace(r, start=q) for r, q in zip(problem.robots, (a, b), strict=True))
        rules = CollisionRules((), tolerance)
        here = dataclasses.replace(problem, robots=robots, subgoals=(), goal=(), objects=(), collision=rules)
        plan = Errands(here).move(a=(a[0], a[1] + 1e-5)).plan()
        assert check_plan(plan).ok == (into_wall + into_disc <= tolerance)
        collision = Collision(here)
        world = collision.worlds["a"]
        assert world.hits(world.rows(a[None], None, {}))[0] == (into_wall > tolerance)
        pair, _ = collision.pair("a", "b")
        hit = pair.first_hit(a[None], None, b[None], None, exact=np.array([True])) == 0
        assert hit == (into_disc > tolerance)
        verdicts.add((into_wall > 0, into_disc > 0, into_wall + into_disc <= tolerance))
    assert len(verdicts) >= 6


def test_what_is_tolerated_holds_at_every_instant_of_a_motion(problem: Problem) -> None:
    """Two discs that rub against a wall and each other, at random, against a close look at the formula."""
    rng = np.random.default_rng(1)
    verdicts = []
    t = np.linspace(0, 1, 4001)[:, None]
    for _ in range(120):
        # Some of them so short that only their ends are looked at unless there is more to know.
        tolerance, far = float(rng.choice([0.002, 0.004, 0.01])), float(rng.choice([0.02, 0.5]))
        a = np.column_stack([rng.uniform(-0.7, -0.6) + far * rng.uniform(0, 1, 2), rng.uniform(0.244, 0.254, 2)])
        angle = np.clip(rng.uniform(0.3, 2.8) + np.array([0, rng.choice([-0.2, 0.2])]), 0.3, 2.8)
        gap = rng.uniform(-0.003, 0.003, 2)
        b = a + (2 * RADIUS + gap)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        along_a, along_b = ((1 - t) * ends[0] + t * ends[1] for ends in (a, b))
        into_wall = np.maximum(0.05 + RADIUS - along_a[:, 1], 0.0)
        into_disc = np.maximum(2 * RADIUS - np.linalg.norm(along_b - along_a, axis=1), 0.0)
        most = float((into_wall + into_disc).max())
        if abs(most - tolerance) < 2e-4:
            continue  # Drake's depths are good to 2e-5
        robots = tuple(dataclasses.replace(r, start=ends[0]) for r, ends in zip(problem.robots, (a, b), strict=True))
        rules = CollisionRules((), tolerance)
        here = dataclasses.replace(problem, robots=robots, subgoals=(), goal=(), objects=(), collision=rules)
        report = check_plan(Errands(here).move(a=a[1], b=b[1]).plan())
        assert report.ok == (most <= tolerance), (most, tolerance, str(report))
        verdicts.append((report.ok, most > 0.0, most > max(into_wall.max(), into_disc.max()) + 1e-3))
    assert len(verdicts) > 80
    assert {(True, True, True), (False, True, True)} <= set(verdicts)


def test_an_allowance_is_given_out_once() -> None:
    rng = np.random.default_rng(0)
    s, tolerance = np.linspace(0, 1, 5), 0.01
    allowance = Allowance(tolerance, s)
    granted: dict[tuple[int, int], float] = {}
    for _ in range(6):
        begin, pair, depth = rng.uniform(0, 0.99, 20), rng.integers(0, 8, 20), rng.uniform(0, 0.008, 20)
        given = allowance.granted(begin, pair, depth)
        for t, k, d in zip(begin[given], pair[given], depth[given], strict=True):
            key = int(4 * t), int(k)
            granted[key] = max(granted.get(key, 0.0), d)
    for part in range(4):
        total = sum(d for (at, _), d in granted.items() if at == part)
        assert 0.5 * tolerance < total <= tolerance
    assert not Allowance(0.0, s).granted(np.zeros(1), np.zeros(1, dtype=int), np.full(1, 1e-6)).any()
