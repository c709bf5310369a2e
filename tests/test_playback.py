"""A plan on the clock: durations, fingers, and objects that follow the hand that holds them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from discs import disc_problem, errand
from sketches import sketch

from mrtamp.kinematics import inverse
from mrtamp.plan import Plan, measures
from mrtamp.playback import Playback, standstill
from mrtamp.problem_file import load_problem
from mrtamp.scene import Scene, build_scene


@pytest.fixture(scope="module")
def plan() -> Plan:
    return sketch(load_problem("pick_place", robots=2, objects=2))


@pytest.fixture(scope="module")
def playback(plan: Plan) -> Playback:
    return Playback(plan, speed=2.0, dwell=0.5)


@pytest.fixture(scope="module")
def scene(plan: Plan) -> Scene:
    return build_scene(plan.problem)


def object_poses(playback: Playback, scene: Scene, name: str, times: np.ndarray) -> np.ndarray:
    """World poses of an object, read back from the plant."""
    _, context = scene.context()
    out = []
    for q in playback.positions(scene, times):
        scene.plant.SetPositions(context, q)
        out.append(scene.plant.EvalBodyPoseInWorld(context, scene.free_bodies[name][0]).GetAsMatrix4())
    return np.array(out)


def test_duration_is_makespan_over_speed_plus_dwell(plan: Plan, playback: Playback) -> None:
    assert playback.duration == pytest.approx(measures(plan.segments)["makespan"] / 2.0 + 3 * 0.5)
    times = playback.times(30)
    assert times[0] == 0 and times[-1] == playback.duration
    assert np.diff(times).max() <= 1 / 30 + 1e-12


def test_no_robot_is_faster_than_the_given_speed(plan: Plan, playback: Playback) -> None:
    times = playback.times(200)
    for robot in plan.problem.robots:
        speed = np.linalg.norm(np.diff(playback.q(robot.name, times), axis=0), axis=1) / np.diff(times)
        assert speed.max() <= 2.0 + 1e-9


def test_robots_stand_still_while_fingers_move(plan: Plan, playback: Playback) -> None:
    for event in playback.events:
        times = np.linspace(event.start, event.end, 9)
        for robot in plan.problem.robots:
            assert np.ptp(playback.q(robot.name, times), axis=0).max() < 1e-12


def test_receiver_closes_before_giver_opens(plan: Plan, playback: Playback) -> None:
    giver, receiver = plan.transitions[1].actions[0].robots
    event = playback.events[1]
    start, middle, end = ([event.start], [(event.start + event.end) / 2], [event.end])
    open_width = plan.problem.robots[0].model.gripper.max_width
    assert playback.width(giver, start) == pytest.approx(0.03)
    assert playback.width(receiver, start) == pytest.approx(open_width)
    assert playback.width(giver, middle) == playback.width(receiver, middle) == pytest.approx(0.03)
    assert playback.width(giver, end) == pytest.approx(open_width)
    assert playback.width(receiver, end) == pytest.approx(0.03)


def test_held_object_is_rigid_in_the_hand_and_never_jumps(plan: Plan, playback: Playback, scene: Scene) -> None:
    name = plan.problem.objects[0].name
    times = playback.times(100)
    X_WO = object_poses(playback, scene, name, times)
    for robot, since, until in (
        (plan.transitions[0].active[0], playback.events[0].end, playback.events[1].start),
        (plan.transitions[1].actions[0].robots[1], playback.events[1].end, playback.events[2].start),
    ):
        held = (times > since) & (times < until)
        X_GO = inverse(playback.grasp_frames(scene, robot, times[held])) @ X_WO[held]
        assert np.ptp(X_GO, axis=0).max() < 1e-9
    assert np.linalg.norm(np.diff(X_WO[:, :3, 3], axis=0), axis=1).max() < 0.06
    before = X_WO[times < playback.events[0].start]
    assert np.ptp(before, axis=0).max() < 1e-9, "the object moved before it was picked"


def test_problem_alone_stands_still(plan: Plan, scene: Scene) -> None:
    playback = Playback(standstill(plan.problem))
    assert playback.duration == 0 and playback.events == ()
    q = playback.positions(scene, np.zeros(1))[0]
    for robot in plan.problem.robots:
        assert np.array_equal(q[scene.robots[robot.name].arm], robot.start)


def test_what_subgoals_attach_follows_and_stays(tmp_path: Path) -> None:
    """The token lies still, goes along with the disc that took it, and lies still again where it was let go."""
    problem = disc_problem(tmp_path)
    plan = errand(problem)
    playback, scene = Playback(plan), build_scene(problem)
    take, drop = playback.events
    times = playback.times(50)
    X_WO = object_poses(playback, scene, "token", times)
    assert np.ptp(X_WO[times <= take.end], axis=0).max() < 1e-9
    held = (times > take.end) & (times < drop.start)
    apart = X_WO[held, :2, 3] - playback.q("b", times[held])
    assert np.ptp(apart, axis=0).max() < 1e-9
    assert np.ptp(X_WO[times >= drop.start], axis=0).max() < 1e-9
    assert X_WO[-1, :2, 3] == pytest.approx([0.55, 0.2])
    assert [playback.mode(t).done for t in (take.start, take.end)] == [set(), {"visit", "take"}]
    assert not playback.width("a", times).any(), "no gripper, no fingers"
