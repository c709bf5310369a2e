"""The judge accepts a plan written by hand, rejects every way of spoiling it, and agrees with dense sampling."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from gantry import BAR, CUBE, Script, gantry_problem, grasp, put, valid_plan
from pydrake.geometry import Box, Capsule, CollisionFilterDeclaration, Cylinder, GeometrySet, Sphere
from pydrake.math import RigidTransform, RollPitchYaw

from mrtamp.check import Checker, check_plan
from mrtamp.check_attachments import AttachmentJudge
from mrtamp.check_bounds import Snapshot, segment_distance
from mrtamp.check_motion import Motion, MotionJudge, Timeline
from mrtamp.check_report import Report
from mrtamp.check_scene import JudgeScene
from mrtamp.modes import Attachment, Mode, start_mode
from mrtamp.plan import Action, Plan, Segment, Transition, plan_cost
from mrtamp.problem import (
    AntipodalGrasps,
    AtPose,
    CostWeights,
    HeldBy,
    InRegion,
    MovableObject,
    Problem,
    Robot,
    RobotAt,
    Shape,
    StaticBody,
)
from mrtamp.problem_file import load_robot_model
from mrtamp.scene import build_scene, gripper_bodies, robot_body


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return gantry_problem(tmp_path_factory.mktemp("gantry"))


@pytest.fixture(scope="module")
def checker(problem: Problem) -> Checker:
    return Checker(problem)


@pytest.fixture
def plan(problem: Problem) -> Plan:
    return valid_plan(problem)


def price(plan: Plan) -> Plan:
    """The plan with an honest cost, so that only what was spoiled is wrong."""
    plan.cost = plan_cost(plan.segments, plan.transitions, plan.problem.cost)
    plan.history = []
    return plan


def replace_q(plan: Plan, k: int, robot: str, i: int, q) -> None:
    """Overwrite one waypoint, in the neighbouring segment too where they share it."""
    segment = plan.segments[k]
    i %= segment.length
    segment.q[robot] = segment.q[robot].copy()
    segment.q[robot][i] = q
    for other, at, j in ((k - 1, 0, -1), (k + 1, segment.length - 1, 0)):
        if i == at and 0 <= other < len(plan.segments):
            plan.segments[other].q[robot] = plan.segments[other].q[robot].copy()
            plan.segments[other].q[robot][j] = q


def replace_attachment(plan: Plan, old: Attachment, new: Attachment) -> None:
    """The same plan with another attachment in place of `old`."""
    for k, segment in enumerate(plan.segments):
        if any(a is old for a in segment.mode.attachments):
            mode = Mode(tuple(new if a is old else a for a in segment.mode.attachments))
            plan.segments[k] = Segment(mode, segment.q)
    for k, transition in enumerate(plan.transitions):
        plan.transitions[k] = Transition(
            tuple(
                Action(a.kind, a.robots, new if a.before is old else a.before, new if a.after is old else a.after)
                for a in transition.actions
            )
        )


def test_a_plan_written_by_hand_is_accepted(checker: Checker, plan: Plan) -> None:
    report = checker.check(plan)
    assert report.ok, str(report)
    assert report.samples > 50
    assert 0 < report.min_clearance_m < 0.05
    assert "ok" in str(report)


def test_a_checker_serves_one_problem(checker: Checker, tmp_path: Path) -> None:
    other = valid_plan(gantry_problem(tmp_path))
    with pytest.raises(ValueError, match="another problem"):
        checker.check(other)
    assert check_plan(other).ok


def test_a_plan_without_motion_can_be_right(problem: Problem) -> None:
    idle = dataclasses.replace(problem, goal=(RobotAt("left", problem.robot("left").start),))
    q = {r.name: r.start[None] for r in idle.robots}
    assert check_plan(Plan(idle, [Segment(start_mode(idle), q)], [], 0.0)).ok


# -- numbers and bookkeeping -------------------------------------------------------------------------------------------


def _beyond_limits(plan: Plan) -> None:
    replace_q(plan, 0, "right", 1, [0.5, 0.1, 1.001, 0.0])


def _wrong_start(plan: Plan) -> None:
    replace_q(plan, 0, "left", 0, plan.segments[0].q["left"][0] + [0, 0, 1e-3, 0])


def _teleport(plan: Plan) -> None:
    q = plan.segments[1].q["right"].copy()
    q[0] += [0, 0, 1e-6, 0]
    plan.segments[1].q["right"] = q


def _not_finite(plan: Plan) -> None:
    replace_q(plan, 2, "right", 1, [np.nan, 0, 0, 0])


def _uneven_waypoints(plan: Plan) -> None:
    plan.segments[0].q["left"] = plan.segments[0].q["left"][:-1]


def _robot_missing(plan: Plan) -> None:
    del plan.segments[0].q["right"]


def _transition_missing(plan: Plan) -> None:
    del plan.transitions[2]


def _not_home(plan: Plan) -> None:
    replace_q(plan, 5, "right", -1, [0.5, 0.0, 0.31, 0.0])


def _object_not_at_goal(plan: Plan) -> None:
    placed = plan.transitions[1].actions[0].after
    replace_attachment(plan, placed, put("cube", 0, 0, CUBE[2], "floor", yaw=0.3))
    plan.problem = plan.problem


def _stale_cost(plan: Plan) -> None:
    plan.cost *= 1.0001


def _rising_history(plan: Plan) -> None:
    plan.history = [{"time_s": 0.0, "cost": plan.cost - 1}, {"time_s": 1.0, "cost": plan.cost}]


def _history_of_another_plan(plan: Plan) -> None:
    plan.history = [{"time_s": 0.0, "cost": plan.cost + 1}]


# -- attachments and transitions ---------------------------------------------------------------------------------------


def _held_cube(**keys) -> Callable[[Plan], None]:
    def spoil(plan: Plan) -> None:
        replace_attachment(plan, plan.transitions[0].actions[0].after, grasp("cube", "left", **keys))

    return spoil


def _fingers_too_wide(plan: Plan) -> None:
    held = plan.transitions[0].actions[0].after
    replace_attachment(plan, held, dataclasses.replace(held, width=0.06))


def _skewed(plan: Plan) -> None:
    held = plan.transitions[0].actions[0].after
    X = held.X_PO.copy()
    X[:3, 0] *= 1.01
    replace_attachment(plan, held, dataclasses.replace(held, X_PO=X))


def _placed(**keys) -> Callable[[Plan], None]:
    def spoil(plan: Plan) -> None:
        new = {"x": 0, "y": 0, "height": CUBE[2], "support": "target", "yaw": 0.3} | keys
        replace_attachment(plan, plan.transitions[1].actions[0].after, put("cube", **new))

    return spoil


def _on_its_head(plan: Plan) -> None:
    down = put("cube", 0, 0, CUBE[2], "target")
    X = down.X_PO @ RigidTransform(RollPitchYaw(np.pi, 0, 0), [0, 0, 0]).GetAsMatrix4()
    replace_attachment(plan, plan.transitions[1].actions[0].after, dataclasses.replace(down, X_PO=X))


def _object_jumps(plan: Plan) -> None:
    new = put("cube", 0, 0.001, CUBE[2], "target", yaw=0.3)
    replace_attachment(plan, plan.transitions[1].actions[0].after, new)


def _unmentioned_change(plan: Plan) -> None:
    mode = plan.segments[1].mode
    plan.segments[1] = Segment(mode.replace(dataclasses.replace(mode.of["block"])), plan.segments[1].q)


def _no_action(plan: Plan) -> None:
    plan.transitions[0] = Transition(())


def _wrong_kind(plan: Plan) -> None:
    action = plan.transitions[0].actions[0]
    plan.transitions[0] = Transition((dataclasses.replace(action, kind="place"),))


def _wrong_robot(plan: Plan) -> None:
    action = plan.transitions[0].actions[0]
    plan.transitions[0] = Transition((dataclasses.replace(action, robots=("right",)),))


def _held_by_nobody(plan: Plan) -> None:
    held = plan.transitions[0].actions[0].after
    replace_attachment(plan, held, dataclasses.replace(held, parent="nobody"))


def _wrong_start_mode(plan: Plan) -> None:
    replace_attachment(plan, plan.segments[0].mode.of["block"], put("block", -0.4, 0.301, CUBE[2]))


# -- motion ------------------------------------------------------------------------------------------------------------


def _through_the_table(plan: Plan) -> None:
    replace_q(plan, 1, "left", 1, [-0.4, 0, 0.03, 0])


def _through_the_wall(plan: Plan) -> None:
    # 2 mm of wall between two waypoints that are both free.
    replace_q(plan, 0, "right", 1, [0.2, 0.8, 0.2, 0])


def _robots_cross(plan: Plan) -> None:
    replace_q(plan, 1, "right", 1, [-0.6, 0.0, 0.3, 0])
    replace_q(plan, 1, "right", 2, [-0.6, 0.0, 0.3, 0])


def _fingers_through_the_cube(plan: Plan) -> None:
    replace_q(plan, 0, "left", 1, [-0.4, 0.04, 0.04, 0])


def _held_bar_through_the_other_robot(plan: Plan) -> None:
    replace_q(plan, 3, "right", 1, [-0.38, -0.3, 0.3, 0])


SPOILED: dict[Callable[[Plan], None], str] = {
    _beyond_limits: "limits",
    _wrong_start: "start",
    _wrong_start_mode: "start",
    _teleport: "continuity",
    _not_finite: "structure",
    _uneven_waypoints: "structure",
    _robot_missing: "structure",
    _transition_missing: "structure",
    _not_home: "goal",
    _stale_cost: "cost",
    _rising_history: "history",
    _history_of_another_plan: "history",
    _held_cube(offset=0.02): "grasp",
    _held_cube(z=0.025): "grasp",
    _held_cube(yaw=0.1): "grasp",
    _fingers_too_wide: "grasp",
    _skewed: "attachment",
    _held_by_nobody: "attachment",
    _placed(support="nowhere"): "rest",
    _placed(support="on_block"): "rest",
    _placed(x=0.06): "rest",
    _placed(yaw=0.6): "rest",
    _placed(height=CUBE[2] + 0.003): "rest",
    _placed(height=CUBE[2] - 0.003): "rest",
    _on_its_head: "rest",
    _object_jumps: "continuity",
    _unmentioned_change: "transition",
    _no_action: "transition",
    _wrong_kind: "transition",
    _wrong_robot: "transition",
    _through_the_table: "collision",
    _through_the_wall: "collision",
    _robots_cross: "collision",
    _fingers_through_the_cube: "collision",
    _held_bar_through_the_other_robot: "collision",
}


@pytest.mark.parametrize(
    ("spoil", "kind"),
    [pytest.param(s, k, id=f"{s.__qualname__.split('.')[0][1:]}-{i}") for i, (s, k) in enumerate(SPOILED.items())],
)
def test_a_spoiled_plan_is_rejected(checker: Checker, plan: Plan, spoil: Callable[[Plan], None], kind: str) -> None:
    spoil(plan)
    if kind not in ("cost", "history", "structure"):
        price(plan)
    report = checker.check(plan)
    assert kind in report.kinds, str(report)
    assert str(report)
    first = checker.check(plan, first_violation_only=True)
    assert len(first.violations) == 1


def test_an_unfulfilled_goal_is_named(problem: Problem, plan: Plan) -> None:
    lying = RigidTransform([0.3, 0.3, 0.05])
    for goal in (HeldBy("cube", "left"), AtPose("cube", "table", lying), AtPose("cube", "block", None)):
        plan.problem = dataclasses.replace(problem, goal=(goal,))
        report = check_plan(plan)
        assert report.kinds == {"goal"}, str(report)
        assert "cube" in report.violations[0].message


def test_a_collision_says_who_and_where(checker: Checker, plan: Plan) -> None:
    _through_the_wall(plan)
    report = checker.check(price(plan))
    assert {(v.segment, v.step) for v in report.collisions()} == {(0, 0), (0, 1)}
    sides = {(side.kind, side.owner) for v in report.collisions() for side in v.sides or ()}
    assert sides == {("robot", "right"), ("static", "wall")}
    assert all(0 < (v.fraction or 0) < 1 and v.value is not None and v.value > 0 for v in report.violations)


def test_two_robots_that_overlap_by_3_mm_in_the_middle_of_a_step_are_caught(problem: Problem, checker: Checker) -> None:
    for overlap, ok in ((0.003, False), (-0.001, True)):
        # Hands (120 mm wide in y) pass each other; the rods are out of reach of each other.
        y = 0.06 - overlap / 2
        s = (
            Script(problem)
            .move(left=(-0.4, -y, 0.6), right=(0.4, y, 0.6))
            .move(left=(0.4, -y, 0.6), right=(-0.4, y, 0.6))
        )
        report = checker.check(price(s.plan()))
        crossing = [v for v in report.violations if v.kind == "collision"]
        assert (not crossing) == ok
        assert all(v.step == 1 and abs((v.fraction or 0) - 0.5) < 0.05 for v in crossing)
        assert all(abs((v.value or 0) - overlap) < 1e-4 for v in crossing)


# -- contact -----------------------------------------------------------------------------------------------------------


def _kinds(checker: Checker, script: Script) -> set[str]:
    return checker.check(price(script.plan())).kinds - {"goal"}


def _pick(problem: Problem) -> Script:
    s = Script(problem).move(left=(-0.4, 0, 0.2)).move(left=(-0.4, 0, 0.04))
    return s.change("pick", grasp("cube", "left"))


def test_a_held_object_may_not_be_dragged(problem: Problem, checker: Checker) -> None:
    drag = _pick(problem).move(left=(-0.2, 0, 0.04)).move(left=(-0.2, 0, 0.2))
    assert "contact" in _kinds(checker, drag)


def test_a_held_object_may_not_come_back_to_the_table_it_left(problem: Problem, checker: Checker) -> None:
    back = _pick(problem).move(left=(-0.4, 0, 0.1)).move(left=(-0.2, 0, 0.0399)).move(left=(-0.2, 0, 0.2))
    assert _kinds(checker, back) == {"collision"}


def test_lifting_may_dip_a_little_but_not_deep(problem: Problem, checker: Checker) -> None:
    for dip, kinds in ((0.0005, set()), (0.0015, {"contact"})):
        lift = _pick(problem).move(left=(-0.399, 0, 0.04 - dip)).move(left=(-0.398, 0, 0.2))
        found = _kinds(checker, lift)
        assert found == kinds or (kinds and found >= kinds)


def test_contact_lasts_while_the_robot_waits(problem: Problem, checker: Checker) -> None:
    wait = _pick(problem).move(right=(0.5, 0.5, 0.3)).move(left=(-0.4, 0, 0.2)).move(left=(-0.4, 0, 0.04))
    wait.change("place", put("cube", -0.4, 0, CUBE[2])).move(right=(0.5, 0.4, 0.3))
    assert _kinds(checker, wait) == set()


def test_an_object_may_not_be_slid_into_place(problem: Problem, checker: Checker) -> None:
    s = (
        _pick(problem)
        .move(left=(-0.4, 0, 0.2))
        .move(left=(-0.2, 0, 0.2))
        .move(left=(-0.2, 0, 0.04))
        .move(left=(0, 0, 0.04))
    )
    s.change("place", put("cube", 0, 0, CUBE[2], "target"))
    assert "contact" in _kinds(checker, s)


def test_stacking_and_what_may_then_be_picked(problem: Problem, checker: Checker) -> None:
    top = 0.02 + 0.06 + 0.02
    s = _pick(problem).move(left=(-0.4, 0, 0.3)).move(left=(-0.4, 0.3, 0.3)).move(left=(-0.4, 0.3, top))
    s.change("place", put("cube", 0, 0, CUBE[2], "on_block", on="block"))
    assert _kinds(checker, s) == set()
    s = _pick(problem).move(left=(-0.4, 0, 0.3)).move(left=(-0.4, 0.3, 0.3)).move(left=(-0.4, 0.3, top))
    s.change("place", put("cube", 0, 0, CUBE[2], "on_block", on="block"))
    # Reaching for the block below would go through the cube on it; the illegal pick is found all the same.
    s.move(left=(-0.4, 0.3, 0.04)).change("pick", grasp("block", "left")).move(left=(-0.4, 0.3, 0.2))
    report = checker.check(price(s.plan()))
    assert "rests on it" in "".join(v.message for v in report.violations if v.kind == "transition")


def test_a_full_hand_picks_nothing(problem: Problem, checker: Checker) -> None:
    s = _pick(problem).move(left=(-0.4, 0, 0.2)).move(left=(-0.47, -0.3, 0.2)).move(left=(-0.47, -0.3, 0.035))
    s.change("pick", grasp("bar", "left", offset=-0.07))
    assert {"transition", "collision"} <= _kinds(checker, s)


def test_one_robot_does_one_thing_at_a_time(problem: Problem, checker: Checker) -> None:
    s = Script(problem).move(left=(-0.4, 0, 0.2)).move(left=(-0.4, 0, 0.04))
    s.change("pick", grasp("cube", "left"), grasp("block", "left"))
    assert "transition" in _kinds(checker, s)


def test_two_robots_may_pick_at_the_same_time(problem: Problem, checker: Checker) -> None:
    s = Script(problem).move(left=(-0.4, 0, 0.2), right=(0.5, -0.3, 0.2)).move(right=(-0.33, -0.3, 0.2))
    s.move(left=(-0.4, 0, 0.04), right=(-0.33, -0.3, 0.035))
    s.change("pick", grasp("cube", "left"), grasp("bar", "right", offset=0.07))
    s.move(left=(-0.4, 0, 0.2), right=(-0.33, -0.3, 0.2))
    assert _kinds(checker, s) == set()


def test_opening_fingers_must_have_room(tmp_path: Path) -> None:
    problem = gantry_problem(tmp_path)
    # A post thinner than a finger's travel stands between the closed and the open finger.
    post = StaticBody("post", RigidTransform([0, 0.036, 0.01]), Shape("box", (0.01, 0.002, 0.1)))
    for statics, ok in ((problem.statics, True), ((*problem.statics, post), False)):
        crowded = dataclasses.replace(problem, statics=statics)
        s = _pick(crowded).move(left=(-0.4, 0, 0.2)).move(left=(0, 0, 0.2)).move(left=(0, 0, 0.04))
        s.change("place", put("cube", 0, 0, CUBE[2], "target")).move(left=(0, 0, 0.2))
        report = check_plan(price(s.plan()))
        meetings = [v for v in report.violations if v.kind == "collision"]
        assert (not meetings) == ok
        assert ok or any(v.segment == 1 and v.fraction == 1.0 for v in meetings)


@pytest.mark.parametrize(
    ("margin", "x", "support", "kinds"),
    [
        (0.0, 0.049, "target", set()),
        (0.02, 0.029, "target", set()),
        (0.02, 0.031, "target", {"rest", "goal"}),
        (0.02, 0.031, "floor", {"goal"}),
        (0.06, 0.0, "target", set()),
        (0.06, 0.001, "target", {"rest", "goal"}),
    ],
)
def test_origins_keep_the_margin_of_a_region(
    problem: Problem, margin: float, x: float, support: str, kinds: set[str]
) -> None:
    supports = tuple(dataclasses.replace(s, margin=margin) if s.name == "target" else s for s in problem.supports)
    fenced = dataclasses.replace(problem, supports=supports, goal=(InRegion("cube", "target"),))
    s = _pick(fenced).move(left=(-0.4, 0, 0.2)).move(left=(x, 0, 0.2)).move(left=(x, 0, 0.04))
    s.change("place", put("cube", x, 0, CUBE[2], support)).move(left=(x, 0, 0.2))
    assert check_plan(price(s.plan())).kinds == kinds


def test_a_grasp_may_be_for_some_robots_only(problem: Problem) -> None:
    for robots, ok in ((("left", "right"), True), (("right",), False)):
        own = tuple(
            dataclasses.replace(o, grasps=tuple(dataclasses.replace(g, robots=robots) for g in o.grasps))
            if o.name == "cube"
            else o
            for o in problem.objects
        )
        report = check_plan(valid_plan(dataclasses.replace(problem, objects=own)))
        assert report.ok == ok
        assert ok or any("only for right" in v.message for v in report.violations if v.kind == "grasp")


def test_objects_may_not_be_put_into_each_other(problem: Problem, checker: Checker) -> None:
    s = _pick(problem).move(left=(-0.4, 0, 0.2)).move(left=(-0.4, 0.265, 0.2)).move(left=(-0.4, 0.265, 0.04))
    s.change("place", put("cube", -0.4, 0.265, CUBE[2]))
    assert "collision" in _kinds(checker, s)


def _round(problem: Problem, grasp_family: AntipodalGrasps) -> AttachmentJudge:
    can = MovableObject("can", "table", RigidTransform(), None, Shape("cylinder", (0.02, 0.1)), grasps=(grasp_family,))
    judge = AttachmentJudge(JudgeScene(problem))
    judge.objects["can"] = can
    return judge


def test_grasps_around_a_cylinder(problem: Problem) -> None:
    judge = _round(problem, AntipodalGrasps(("+x", "-z"), 0.02, (0.01, 0.03)))
    side = RollPitchYaw(0, np.pi / 2, 0).ToRotationMatrix()
    turn = RollPitchYaw(0, 0, 0.7).ToRotationMatrix()

    def verdict(X_OG: RigidTransform, width: float = 0.04) -> bool:
        report = Report()
        a = Attachment("can", "left", X_OG.inverse().GetAsMatrix4(), None, width)
        judge.legal(a, a, 0, report)
        return report.ok

    assert verdict(RigidTransform(side, [0, 0, 0]))
    assert verdict(RigidTransform(turn @ side, [0, 0, 0.02]))
    assert not verdict(RigidTransform(turn @ side, [0, 0, 0.03]))
    assert not verdict(RigidTransform(side, [0.005, 0, 0]))
    assert not verdict(RigidTransform(side, [0, 0.005, 0]))
    assert not verdict(RigidTransform(side @ RollPitchYaw(0, 0, np.pi / 2).ToRotationMatrix(), [0, 0, 0]))
    assert verdict(RigidTransform(turn @ RollPitchYaw(np.pi, 0, 0).ToRotationMatrix(), [0, 0, 0.03]))
    assert not verdict(RigidTransform(RollPitchYaw(0, 0, 0), [0, 0, -0.03]))
    assert not verdict(RigidTransform(side, [0, 0, 0]), width=0.05)


# -- agreement with brute force ----------------------------------------------------------------------------------------


def _two_pandas() -> Problem:
    panda = load_robot_model("panda")
    home = np.array(panda.home)
    robots = tuple(
        Robot(name, panda, RigidTransform(RollPitchYaw(0, 0, yaw), [x, 0, 0]), home, home)
        for name, x, yaw in (("left", -0.45, 0.0), ("right", 0.45, np.pi))
    )
    table = StaticBody("table", RigidTransform([0, 0, -0.03]), Shape("box", (1.6, 1.2, 0.05)))
    things = (("box", (0.05, 0.05, 0.1)), ("cylinder", (0.03, 0.12)), ("sphere", (0.04,)), ("box", (0.2, 0.05, 0.05)))
    objects = tuple(
        MovableObject(f"thing{i}", "table", RigidTransform([0, 0.3 * i - 0.4, 0.1]), None, Shape(kind, size))
        for i, (kind, size) in enumerate(things)
    )
    return Problem("pandas", robots, (table,), (), objects, (), CostWeights())


class BruteForce:
    """Dense sampling with HasCollisions: another plant, its own filters, its own kinematics of held objects."""

    def __init__(self, problem: Problem, carried: dict[str, tuple[str, np.ndarray]]) -> None:
        self.problem, self.carried = problem, carried
        self.scene = build_scene(problem)
        plant = self.scene.plant
        still = [b for n, bodies in self.scene.free_bodies.items() if n not in carried for b in bodies]
        still += [b for bodies in self.scene.statics.values() for b in bodies]

        def ids(bodies):
            return GeometrySet([g for b in bodies for g in plant.GetCollisionGeometriesForBody(b)])

        manager = self.scene.scene_graph.collision_filter_manager()
        manager.Apply(CollisionFilterDeclaration().ExcludeWithin(ids(still)))
        for name, (robot, _) in carried.items():
            in_scene = self.scene.robots[robot]
            hand = gripper_bodies(plant, in_scene)
            manager.Apply(CollisionFilterDeclaration().ExcludeBetween(ids(hand), ids(self.scene.free_bodies[name])))
        self.root, self.context = self.scene.context()

    def collides(self, waypoints: dict[str, np.ndarray], poses: dict[str, np.ndarray], step: float) -> bool:
        plant, scene = self.scene.plant, self.scene
        length = np.max([np.abs(np.diff(q, axis=0)).sum(axis=1).max() for q in waypoints.values()])
        count = int(np.ceil(length * 1.2 / step))  # no point is 1.2 m from an axis
        q = np.array(plant.GetPositions(self.context))
        for i in range(len(next(iter(waypoints.values()))) - 1):
            for f in np.linspace(0, 1, count + 1):
                for name, robot in scene.robots.items():
                    q[robot.arm] = waypoints[name][i] * (1 - f) + waypoints[name][i + 1] * f
                    q[robot.fingers] = 0.04
                for name, X in poses.items():
                    scene.write_pose(q, name, X)
                plant.SetPositions(self.context, q)
                for name, (robot, X_GO) in self.carried.items():
                    model = scene.robots[robot].robot.model
                    body = robot_body(plant, scene.robots[robot], model.grasp_body)
                    X_WG = body.EvalPoseInWorld(self.context) @ model.X_BG
                    scene.write_pose(q, name, X_WG.GetAsMatrix4() @ X_GO)
                plant.SetPositions(self.context, q)
                query = scene.scene_graph.get_query_output_port().Eval(
                    scene.scene_graph.GetMyContextFromRoot(self.root)
                )
                if query.HasCollisions():
                    return True
        return False


@pytest.fixture(scope="module")
def pandas() -> tuple[Problem, JudgeScene]:
    problem = _two_pandas()
    return problem, JudgeScene(problem)


_CARRIED = {
    "thing0": ("left", RigidTransform(RollPitchYaw(np.pi, 0, 0), [0, 0, 0.03]).GetAsMatrix4()),
    "thing3": ("right", RigidTransform(RollPitchYaw(np.pi, 0, 0.3), [0, 0, 0.02]).GetAsMatrix4()),
}


def _random_motion(problem: Problem, world: JudgeScene, seed: int) -> Motion:
    rng = np.random.default_rng(seed)
    z = np.empty((3, len(world.columns)))
    z[:] = world.base[world.columns]
    for robot in problem.robots:
        arm = world.arm[robot.name]
        q = robot.home + rng.normal(scale=0.45, size=(1, 7)) + np.cumsum(rng.normal(scale=0.08, size=(3, 7)), axis=0)
        z[:, arm] = np.clip(q, world.lower[arm], world.upper[arm])
        z[:, world.fingers[robot.name]] = 0.04
    resting = {o.name: o.start_X_BO.GetAsMatrix4() for o in problem.objects if o.name not in _CARRIED}
    allowed = {
        (min(i, j), max(i, j))
        for name, (robot, _) in _CARRIED.items()
        for i in world.of[name]
        for j in world.gripper[robot]
    }
    return Motion(z, 0, _CARRIED, resting, allowed)


def test_nothing_that_dense_sampling_finds_is_missed(pandas: tuple[Problem, JudgeScene]) -> None:
    problem, world = pandas
    brute = BruteForce(problem, _CARRIED)
    judge = MotionJudge(world, 0.002)
    verdicts = []
    for seed in range(24):
        motion = _random_motion(problem, world, seed)
        report = Report()
        judge.judge(Timeline(world, motion), report, {})
        waypoints = {r.name: motion.z[:, world.arm[r.name]] for r in problem.robots}
        # 0.5 mm where the judge says free; a coarse look where it says not, only to see that it does not cry wolf.
        found = brute.collides(waypoints, motion.resting, 0.0005 if report.ok else 0.002)
        assert not (report.ok and found), f"seed {seed}: accepted, but dense sampling collides"
        if not report.ok:
            assert found or max(v.value or 0 for v in report.violations) < 1e-3, f"seed {seed}: {report}"
        verdicts.append(report.ok)
    assert 3 < sum(verdicts) < 21, "the motions should be a mixture"


def test_bounds_never_exceed_distances(pandas: tuple[Problem, JudgeScene]) -> None:
    problem, world = pandas
    rng = np.random.default_rng(0)
    for seed in range(10):
        line = Timeline(world, _random_motion(problem, world, seed))
        s = rng.uniform(0, line.length, 3)
        snapshot = Snapshot(line.envelopes, world.screws, line.configurations(s))
        i, j = np.nonzero(line.eligible)
        chosen = rng.choice(len(i), 150, replace=False)
        i, j = i[chosen], j[chosen]
        q, _ = line.state(s)
        spheres = snapshot.spheres(i, j)
        for n in range(len(s)):
            query = world.query(q[n])
            exact = np.array([world.distance(query, a, b) for a, b in zip(i, j, strict=True)])
            shapes = snapshot.shapes(np.full(len(i), n), i, j)
            assert (spheres[:, n] <= exact + 1e-4).all()
            assert (shapes <= exact + 1e-4)[exact > 0].all()


def test_displacements_never_exceed_their_bounds(pandas: tuple[Problem, JudgeScene]) -> None:
    problem, world = pandas
    for seed in range(10):
        line = Timeline(world, _random_motion(problem, world, seed))
        s = np.linspace(0, line.length, 50)
        travelled = line.travelled(s)
        snapshot = Snapshot(line.envelopes, world.screws, line.configurations(s))
        moved = np.linalg.norm(np.diff(snapshot.centre, axis=1), axis=2).T
        bound = np.diff(travelled, axis=0) @ line.reach.T
        assert (moved <= bound + 1e-9).all()
        assert (bound.max(axis=1) <= np.diff(s) + 1e-9).all()


def test_points_stay_as_near_to_their_chords_as_their_bends_say(
    pandas: tuple[Problem, JudgeScene], problem: Problem
) -> None:
    """Long straight motions, of arms that turn and of a gantry that slides and turns."""
    rng = np.random.default_rng(5)
    tightest = 0.0
    gantry = JudgeScene(problem)
    slides = [rng.uniform(gantry.lower, gantry.upper, size=(2, len(gantry.lower))) for _ in range(2)]
    for world, motion in (
        *((pandas[1], _random_motion(*pandas, seed)) for seed in range(6)),
        *((gantry, Motion(z, 0, {}, {}, set())) for z in slides),
    ):
        line = Timeline(world, motion)
        s = np.linspace(*line.s[:2], 17)
        share = (s - s[0]) / (s[-1] - s[0])
        snapshot = Snapshot(line.envelopes, world.screws, line.configurations(s))
        moved = line.travelled(s[[-1]]) - line.travelled(s[[0]])
        bend = (world.screws.bends(moved) @ line.reach.T)[0] / 8
        solids = np.arange(len(world.solids))
        hull = np.array([snapshot.hull(solids, np.full(len(solids), n)) for n in range(len(s))])
        chord = hull[-1] - hull[0]
        longest = snapshot.chords(solids, (np.zeros_like(solids), np.full_like(solids, len(s) - 1)))
        np.testing.assert_allclose(longest, np.linalg.norm(chord, axis=2).max(axis=1), atol=1e-12)
        off = np.linalg.norm(hull - hull[0] - share[:, None, None, None] * chord, axis=3).max(axis=(0, 2))
        assert (off <= bend + 1e-12).all()
        tightest = max(tightest, float(np.max(off[bend > 0] / bend[bend > 0])))
        i, j = rng.choice(len(solids), size=(2, 400))
        normal = rng.normal(size=(400, 3))
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        certain = snapshot.parted(i, j, (np.zeros_like(i), np.full_like(i, len(s) - 1)), normal) - bend[i] - bend[j]
        held = certain > 0
        for n in range(len(s)):
            here = snapshot.parted(i, j, (np.full_like(i, n), np.full_like(i, n)), normal)
            assert (here >= certain - 1e-12)[held].all()
    assert tightest > 0.3, "a bound that is never near the truth would be of no use"


def test_planes_find_the_distances_that_drake_finds(pandas: tuple[Problem, JudgeScene]) -> None:
    """Along the normal of the nearest points, boxes, balls, capsules and cylinders are as far apart as they are."""
    problem, world = pandas
    line = Timeline(world, _random_motion(problem, world, 1))
    s = np.array([0.3 * line.length])
    snapshot = Snapshot(line.envelopes, world.screws, line.configurations(s))
    query = world.query(line.state(s)[0][0])
    kinds = set()
    for i, j in np.argwhere(line.eligible):
        d, normal = world.nearest(query, i, j)
        one = np.array([i]), np.array([j]), (np.zeros(1, dtype=int),) * 2
        parted = snapshot.parted(*one, normal[None])[0]
        assert parted <= d + 1e-4
        shapes = [world.scene.scene_graph.model_inspector().GetShape(world.solids[k].id) for k in (i, j)]
        if d > 1e-3 and all(isinstance(shape, Box | Sphere | Capsule | Cylinder) for shape in shapes):
            kinds |= {type(shape) for shape in shapes}
            assert parted >= d - 1e-4
    assert {Box, Cylinder} <= kinds


def test_segment_distances_agree_with_sampling() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 200, 2, 3))
    b[::5, 1] = b[::5, 0] + (a[::5, 1] - a[::5, 0])  # parallel ones
    t = np.linspace(0, 1, 201)
    p = a[:, None, 0] + t[:, None] * (a[:, 1] - a[:, 0])[:, None]
    q = b[:, None, 0] + t[:, None] * (b[:, 1] - b[:, 0])[:, None]
    sampled = np.array([np.linalg.norm(x[:, None] - y[None], axis=2).min() for x, y in zip(p, q, strict=True)])
    exact = segment_distance(a, b)
    assert (exact <= sampled + 1e-9).all()
    assert (sampled - exact < 0.03).all()


def test_the_bar_is_as_long_as_the_script_thinks() -> None:
    # Both hands grip it 70 mm from its middle; they are 40 mm long, so 100 mm stay between them.
    assert BAR[0] / 2 > 0.07 + 0.02


def test_the_judge_goes_on_where_drake_finds_no_distance(problem: Problem) -> None:
    """Drake raises where its search does not converge: what penetrates is as deep as it may be, the rest touches."""
    world = JudgeScene(problem)

    class Pair:
        id_A, id_B, depth = world.solids[0].id, world.solids[1].id, 0.25

    class Query:
        def ComputeSignedDistancePairClosestPoints(self, a: object, b: object) -> None:
            raise RuntimeError("max distance iterations: 1000")

        def ComputePointPairPenetration(self) -> list:
            return [Pair()]

    assert world.distance(Query(), 1, 0) == -0.25
    assert world.distance(Query(), 2, 0) == 0.0
