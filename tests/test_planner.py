"""The planner as a whole: what it returns is valid, equal seeds give equal runs, what cannot be done is not done.

Scenes are small: one to three Pandas around a table, a few boxes and cylinders, every kind of goal.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gantry import gantry_model
from pydrake.math import RigidTransform, RollPitchYaw

import mrtamp
from mrtamp.check import check_plan
from mrtamp.plan import Plan
from mrtamp.planner import Options, Planner
from mrtamp.problem import (
    AntipodalGrasps,
    Gripper,
    InRegion,
    MovableObject,
    MrtampError,
    Problem,
    Robot,
    RobotAt,
    RobotModel,
    Shape,
    StaticBody,
    Support,
)
from mrtamp.problem_file import load_robot_model, problem_from_dict

ROOT = Path(__file__).resolve().parents[1]
DRAKE_MODELS = Path(os.environ.get("DRAKE_MODELS_DIR", ROOT.parent / "shared" / "drake_models"))
OFFICIAL = ROOT / "tests" / "data" / "robots" / "panda_official.yaml"
CUBE = {"box": [0.05, 0.05, 0.05]}


@contextmanager
def at_most(seconds: int) -> Iterator[None]:
    """Fail instead of waiting for ever."""

    def fail(*_: object) -> None:
        raise TimeoutError(f"not done within {seconds} s")

    old = signal.signal(signal.SIGALRM, fail)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)


def pose(x: float, y: float, z: float, yaw_deg: float = 0.0) -> dict[str, Any]:
    return {"translation": [float(x), float(y), float(z)], "rotation": {"rpy_deg": [0.0, 0.0, float(yaw_deg)]}}


def scene(**sections: Any) -> dict[str, Any]:
    """One Panda at the edge of a table whose top is at z = 0; sections are added or replaced."""
    return {
        "mrtamp": 1,
        "name": "scene",
        "robots": [{"name": "left", "model": "panda", "X_WB": pose(-0.5, 0, 0)}],
        "world": [{"name": "table", "shape": {"box": [1.6, 1.4, 0.1]}, "X_WB": pose(0, 0, -0.05)}],
        "goal": [{"robot": "left", "at": "home"}],
        **sections,
    }


LEFT = {"name": "left", "model": "panda", "X_WB": pose(-0.5, 0, 0)}
RIGHT = {"name": "right", "model": "panda", "X_WB": pose(0.5, 0, 0, 180)}
BACK = {"name": "back", "model": "panda", "X_WB": pose(0, 0.65, 0, -90)}


def cube(name: str, x: float, y: float, yaw: float = 0.0, **keys: Any) -> dict[str, Any]:
    return {"name": name, "shape": CUBE, "start": {"on": "table", "X_WO": pose(x, y, 0.025, yaw)}, **keys}


def solve(problem: Problem, seed: int = 0, budget_s: float = 10.0) -> Plan | None:
    """The first plan, checked once more by a judge of its own."""
    planner = Planner(problem, seed=seed)
    for plan in planner.improve(budget_s, first=True):
        report = check_plan(plan)
        assert report.ok, str(report)
        return plan
    return None


def actions(plan: Plan) -> list[tuple[str, tuple[str, ...], str]]:
    return [(a.kind, a.robots, a.object) for t in plan.transitions for a in t.actions]


# -- random scenes -----------------------------------------------------------------------------------------------------

SHAPES = [
    ({"box": [0.05, 0.05, 0.05]}, 0.025),
    ({"box": [0.04, 0.04, 0.12]}, 0.06),
    ({"box": [0.18, 0.04, 0.04]}, 0.02),
    ({"cylinder": [0.025, 0.1]}, 0.05),
]


def random_scene(seed: int) -> dict[str, Any]:
    """Arms, objects, obstacles and goals drawn at random; free spots are far enough apart for a hand."""
    rng = np.random.default_rng(seed)
    robots = [LEFT, RIGHT, BACK][: int(rng.integers(1, 4))]
    spots: list[np.ndarray] = []

    def spot() -> np.ndarray:
        while True:
            p = rng.uniform([-0.15, -0.45], [0.2, 0.3])
            if all(np.linalg.norm(p - other) > 0.17 for other in spots):
                spots.append(p)
                return p

    names = [f"thing{i}" for i in range(int(rng.integers(1, 4)))]
    world = scene()["world"]
    for i in range(int(rng.integers(0, 3))):
        world.append({"name": f"wall{i}", "shape": {"box": [0.04, 0.08, 0.12]}, "X_WB": pose(*spot(), 0.06)})
    objects, heights = [], {}
    for name in names:
        shape, heights[name] = SHAPES[int(rng.integers(len(SHAPES)))]
        start = {"on": "table", "X_WO": pose(*spot(), heights[name], rng.uniform(-180, 180))}
        objects.append({"name": name, "shape": shape, "start": start})
    supports = [{"name": "target", "on": "table", "X_BS": pose(*spot(), 0.05), "size": [0.08, 0.08]}]
    goal: list[dict[str, Any]] = []
    holders = [r["name"] for r in robots]
    flat_first = objects[0]["shape"].get("box", [1, 1, 1])[2] <= 0.05
    for i, name in enumerate(names):
        kind = rng.choice(["in", "at", "on", "held_by", "nothing"])
        if kind == "in":
            goal.append({"object": name, "in": "target"})
        elif kind == "at":
            goal.append({"object": name, "at": pose(*spot(), heights[name], rng.uniform(-180, 180)), "on": "table"})
        elif kind == "on" and i > 0 and flat_first and all(g.get("on") != names[0] for g in goal):
            goal.append({"object": name, "on": names[0]})
        elif kind == "held_by" and holders and not (i == 0 and flat_first):
            goal.append({"object": name, "held_by": holders.pop()})
    if rng.random() < 0.5 or not goal:
        goal.append({"robot": robots[0]["name"], "at": "home"})
    return scene(robots=robots, world=world, supports=supports, objects=objects, goal=goal)


@pytest.mark.parametrize("seed", range(10))
def test_whatever_comes_back_is_valid(seed: int) -> None:
    problem = problem_from_dict(random_scene(seed))
    planner = Planner(problem, seed=seed)
    with at_most(60):
        for _ in planner.improve(4.0, first=True):
            pass
        if planner.best is not None:
            list(planner.improve(iterations=10))
            report = check_plan(planner.best)
            assert report.ok, str(report)
            costs = [entry["cost"] for entry in planner.best.history]
            assert costs == sorted(costs, reverse=True)
            assert costs[-1] == pytest.approx(planner.best.cost)


# -- repeatability -----------------------------------------------------------------------------------------------------


def fingerprint(planner: Planner) -> str:
    """Everything the search produced, to the last bit, without clock times."""
    digest = hashlib.sha256()
    for node in planner.tree.nodes:
        digest.update(repr((node.at, node.cost, node.parent and node.parent.index, node.alive)).encode())
    for roadmap in planner.roadmaps.values():
        digest.update(roadmap.q.tobytes() + roadmap.ends.tobytes())
    if planner.best is not None:
        for segment in planner.best.segments:
            digest.update(b"".join(q.tobytes() for q in segment.q.values()))
            digest.update(b"".join(a.X_PO.tobytes() for a in segment.mode.attachments))
        digest.update(repr([entry["cost"] for entry in planner.best.history]).encode())
    digest.update(repr(planner.counts()).encode())
    return digest.hexdigest()


def run(name: str, seed: int, iterations: int) -> Planner:
    planner = Planner(mrtamp.load_problem(name), seed=seed)
    list(planner.improve(iterations=iterations))
    return planner


_OTHER_PROCESS = """
import sys
sys.path.insert(0, {tests!r})
from test_planner import fingerprint, run
print(fingerprint(run({name!r}, {seed}, {iterations})))
"""


def test_equal_seeds_give_equal_runs_in_any_process() -> None:
    name, seed, iterations = "stacking", 1, 20
    code = _OTHER_PROCESS.format(tests=str(Path(__file__).parent), name=name, seed=seed, iterations=iterations)
    others = [
        subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "PYTHONHASHSEED": h}, stdout=subprocess.PIPE)
        for h in ("1", "77")
    ]
    planner = run(name, seed, iterations)
    assert planner.best is not None, "the comparison should include a plan"
    printed = {p.communicate(timeout=120)[0].decode().strip() for p in others}
    assert printed == {fingerprint(planner)}


def test_other_seeds_give_other_runs() -> None:
    assert len({fingerprint(run("box", seed, 2)) for seed in (0, 1)}) == 2


def test_a_run_may_be_cut_in_pieces() -> None:
    whole, pieces = run("box", 0, 8), run("box", 0, 3)
    for n in (4, 1):
        list(pieces.improve(iterations=n))
    assert pieces.iteration == whole.iteration == 8
    assert fingerprint(pieces) == fingerprint(whole)


def test_every_plan_is_better_than_the_last_and_history_says_so() -> None:
    planner = Planner(mrtamp.load_problem("box"), seed=0)
    plans = list(planner.improve(iterations=25))
    costs = [plan.cost for plan in plans]
    assert len(costs) >= 2
    assert all(b < a for a, b in itertools.pairwise(costs))
    history = plans[-1].history
    recorded = [entry["cost"] for entry in history]
    assert recorded == sorted(recorded, reverse=True)
    assert set(costs) <= set(recorded), "one iteration may find several"
    times = [entry["time_s"] for entry in history]
    assert times == sorted(times)
    assert planner.best is plans[-1]
    assert plans[-1].seed == 0
    assert plans[-1].counts["collision_checks"] > 0


def test_first_stops_after_the_first_plan() -> None:
    planner = Planner(mrtamp.load_problem("box"), seed=0)
    assert len(list(planner.improve(20.0, first=True))) == 1


def test_budgets_are_kept() -> None:
    planner = Planner(mrtamp.load_problem("handover"), seed=0)
    assert list(planner.improve(iterations=0)) == []
    assert list(planner.improve(0.0)) == []
    assert planner.iteration == 0
    seen = []
    list(planner.improve(iterations=3, progress=seen.append))
    assert [status.iteration for status in seen] == [1, 2, 3]
    assert all(status.modes >= 1 and status.nodes >= 1 for status in seen)


# -- what is easy ------------------------------------------------------------------------------------------------------


def test_a_goal_that_holds_already_costs_nothing() -> None:
    plan = solve(problem_from_dict(scene(objects=[cube("red", 0, 0)])), budget_s=5.0)
    assert plan is not None
    assert plan.cost == 0.0
    assert plan.transitions == []


def test_moving_alone_is_planned_too() -> None:
    """No objects at all: two arms exchange the sides they reach to."""
    reach = [[0.6, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8], [-0.6, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]]
    robots = [{**LEFT, "start": reach[0]}, {**RIGHT, "start": reach[0]}]
    goal = [{"robot": "left", "at": reach[1]}, {"robot": "right", "at": reach[1]}]
    plan = solve(problem_from_dict(scene(robots=robots, goal=goal)))
    assert plan is not None
    assert len(plan.segments) == 1
    straight = float(np.linalg.norm(np.subtract(*reach)))
    assert plan.cost >= straight


def test_transition_costs_are_part_of_the_cost() -> None:
    data = scene(objects=[cube("red", 0, 0)], goal=[{"object": "red", "held_by": "left"}])
    cheap = solve(problem_from_dict(data))
    dear = solve(problem_from_dict({**data, "cost": {"transitions": {"pick": 10.0}}}))
    assert cheap is not None and dear is not None
    assert actions(cheap) == actions(dear) == [("pick", ("left",), "red")]
    assert dear.cost == pytest.approx(cheap.cost + 10.0)


def test_objects_that_rest_on_the_world_frame() -> None:
    """The world is a body like any other: here the table ends a centimetre below the region."""
    world = [{"name": "table", "shape": {"box": [1.6, 1.4, 0.1]}, "X_WB": pose(0, 0, -0.06)}]
    floor = {"name": "floor", "on": "world", "X_BS": {"translation": [0, 0, 0]}, "size": [0.4, 0.4]}
    red = {"name": "red", "shape": CUBE, "start": {"in": "floor", "xy": [0.05, 0.1]}}
    goal = [{"object": "red", "at": pose(0, -0.2, 0.025), "on": "world"}]
    plan = solve(problem_from_dict(scene(world=world, supports=[floor], objects=[red], goal=goal)))
    assert plan is not None


# -- what cannot be done -----------------------------------------------------------------------------------------------


def no_plan(problem: Problem, budget_s: float = 2.0) -> Planner:
    planner = Planner(problem, seed=0)
    with at_most(30):
        assert list(planner.improve(budget_s)) == []
    assert planner.best is None
    assert planner.iteration > 3
    return planner


def test_an_object_out_of_everyones_reach_is_named() -> None:
    objects = [cube("near", 0, 0.2), cube("distant", 0.75, 0.6)]
    goal = [{"object": "near", "at": pose(0, -0.2, 0.025), "on": "table"}]
    goal.append({"object": "distant", "at": pose(0, 0, 0.025), "on": "table"})
    planner = no_plan(problem_from_dict(scene(objects=objects, goal=goal)))
    assert "distant" in planner.explain()


def test_a_goal_inside_a_wall_is_named() -> None:
    wall = {"name": "wall", "shape": {"box": [0.2, 0.2, 0.2]}, "X_WB": pose(0, -0.2, 0.1)}
    world = [*scene()["world"], wall]
    goal = [{"object": "red", "at": pose(0, -0.2, 0.025), "on": "table"}]
    planner = no_plan(problem_from_dict(scene(world=world, objects=[cube("red", 0, 0.2)], goal=goal)))
    assert "red" in planner.explain()


def test_a_goal_out_of_reach_of_the_only_arm_is_named() -> None:
    goal = [{"object": "red", "at": pose(0.75, 0.6, 0.025), "on": "table"}]
    planner = no_plan(problem_from_dict(scene(objects=[cube("red", 0, 0.2)], goal=goal)))
    assert "red" in planner.explain()


def test_a_robot_goal_in_collision_ends_at_the_budget() -> None:
    # The hand is in the table.
    goal = [{"robot": "left", "at": [0.0, 0.9, 0.0, -1.6, 0.0, 2.5, 0.8]}]
    no_plan(problem_from_dict(scene(goal=goal)), budget_s=1.0)


def test_two_cubes_cannot_share_a_goal() -> None:
    goal = [{"object": name, "at": pose(0, -0.2 + d, 0.025), "on": "table"} for name, d in (("red", 0), ("blue", 0.03))]
    no_plan(problem_from_dict(scene(objects=[cube("red", 0, 0.2), cube("blue", 0.1, 0)], goal=goal)))


def test_a_start_in_collision_is_an_error_that_says_who() -> None:
    wall = {"name": "wall", "shape": {"box": [0.2, 0.2, 0.2]}, "X_WB": pose(-0.05, 0, 0.5)}
    with pytest.raises(MrtampError, match=r"left.*wall|wall.*left"):
        Planner(problem_from_dict(scene(world=[*scene()["world"], wall])))


def test_objects_that_start_inside_each_other_are_an_error_that_says_which() -> None:
    objects = [cube("red", 0, 0), cube("blue", 0.03, 0)]
    with at_most(10), pytest.raises(MrtampError, match=r"red.*blue|blue.*red"):
        list(Planner(problem_from_dict(scene(objects=objects))).improve(2.0))


# -- tasks that need more than one step of thought ---------------------------------------------------------------------

FLOOR = {"name": "floor", "on": "table", "X_BS": {"translation": [0, 0, 0.05]}, "size": [0.4, 0.6]}


@pytest.mark.parametrize("robots", [[LEFT], [LEFT, RIGHT]], ids=["one arm", "two arms"])
def test_two_cubes_exchange_places(robots: list[dict[str, Any]]) -> None:
    at = {"red": (0.0, 0.15, 20.0), "blue": (0.0, -0.15, -30.0)}
    objects = [cube(name, *xyyaw) for name, xyyaw in at.items()]
    goal = [
        {"object": name, "at": pose(*at[other][:2], 0.025, at[other][2]), "on": "table"}
        for name, other in (("red", "blue"), ("blue", "red"))
    ]
    plan = solve(problem_from_dict(scene(robots=robots, supports=[FLOOR], objects=objects, goal=goal)), budget_s=15.0)
    assert plan is not None
    if len(robots) == 1:
        assert len(plan.transitions) >= 6, "one of the cubes has to be set down somewhere else first"


def test_a_cube_that_stands_in_the_way_is_moved() -> None:
    """The goal is occupied by a cube without a goal of its own."""
    objects = [cube("red", 0, 0.2), cube("lazy", 0.0, -0.1)]
    goal = [{"object": "red", "at": pose(0.01, -0.11, 0.025), "on": "table"}]
    plan = solve(problem_from_dict(scene(supports=[FLOOR], objects=objects, goal=goal)))
    assert plan is not None
    assert ("pick", ("left",), "lazy") in actions(plan)


def test_a_tower_is_turned_upside_down() -> None:
    low, high = cube("low", 0, 0.1), {"name": "high", "shape": CUBE, "start": {"on": "low"}}
    goal = [{"object": "high", "at": pose(0, -0.2, 0.025), "on": "table"}, {"object": "low", "on": "high"}]
    plan = solve(problem_from_dict(scene(supports=[FLOOR], objects=[low, high], goal=goal)))
    assert plan is not None
    assert [a[2] for a in actions(plan)][:2] == ["high", "high"]


POST = {"box": [0.04, 0.04, 0.12]}


def regrasp_problem(gap: float = 0.06) -> dict[str, Any]:
    """A post `gap` (m) under a roof, to be taken from the side; its goal is a well, entered from above; a bench."""
    world = [
        *scene()["world"],
        {"name": "pedestal", "shape": {"box": [0.06, 0.06, 0.2]}, "X_WB": pose(0, 0.3, 0.1)},
        {"name": "roof", "shape": {"box": [0.2, 0.2, 0.01]}, "X_WB": pose(0, 0.3, 0.325 + gap)},
        {"name": "bench", "shape": {"box": [0.2, 0.2, 0.2]}, "X_WB": pose(0.05, 0, 0.1)},
        {"name": "well_left", "shape": {"box": [0.01, 0.1, 0.075]}, "X_WB": pose(-0.045, -0.3, 0.0375)},
        {"name": "well_right", "shape": {"box": [0.01, 0.1, 0.075]}, "X_WB": pose(0.045, -0.3, 0.0375)},
        {"name": "well_near", "shape": {"box": [0.08, 0.01, 0.075]}, "X_WB": pose(0, -0.345, 0.0375)},
        {"name": "well_far", "shape": {"box": [0.08, 0.01, 0.075]}, "X_WB": pose(0, -0.255, 0.0375)},
    ]
    post = {
        "name": "post",
        "shape": POST,
        "start": {"on": "pedestal", "X_WO": pose(0, 0.3, 0.26)},
        "grasps": [
            {"antipodal": {"approach": ["-z"], "offset": 0.005, "depth": [0.01, 0.03]}},
            {"antipodal": {"approach": ["+x", "-x", "+y", "-y"], "offset": 0.02, "depth": [0.01, 0.025]}},
        ],
    }
    return scene(
        world=world,
        supports=[{"name": "on_bench", "on": "bench", "size": [0.14, 0.14]}],
        objects=[post],
        goal=[{"object": "post", "at": pose(0, -0.3, 0.06), "on": "table"}],
    )


def test_regrasping_on_a_bench_appears_by_itself() -> None:
    plan = solve(problem_from_dict(regrasp_problem()), budget_s=20.0)
    assert plan is not None
    kinds = [kind for kind, _, _ in actions(plan)]
    assert kinds[:2] == ["pick", "place"] and kinds[-2:] == ["pick", "place"] and len(kinds) >= 4
    picks = [a.after for t in plan.transitions for a in t.actions if a.kind == "pick"]
    approach = [np.linalg.inv(a.X_PO)[:3, 2] for a in picks]
    assert abs(approach[0][2]) < 1e-6, "out from under the roof by the side"
    assert approach[-1][2] == pytest.approx(-1), "into the well from above"


def test_the_direct_transfer_is_impossible_in_the_regrasp_scene() -> None:
    data = regrasp_problem()
    no_plan(problem_from_dict({**data, "supports": []}), budget_s=3.0)


# -- other robots ------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(
    not (DRAKE_MODELS / "package.xml").exists(), reason="the official Panda is not there; set DRAKE_MODELS_DIR"
)
def test_the_official_panda_hands_over_too() -> None:
    problem = mrtamp.load_problem("handover")
    official = load_robot_model(str(OFFICIAL), (DRAKE_MODELS,))
    problem = dataclasses.replace(
        problem,
        robots=tuple(dataclasses.replace(r, model=official) for r in problem.robots),
        package_paths=(DRAKE_MODELS,),
    )
    plan = solve(problem, budget_s=30.0)
    assert plan is not None
    assert [kind for kind, _, _ in actions(plan)].count("handover") >= 2


def gantry_scene(folder: Path, goal: tuple, gap: float = 0.0) -> Problem:
    """Two gantries of four joints over a table: they can only grasp from above and turn about the vertical."""
    model = gantry_model(folder)
    homes = {"left": np.array([-0.5, 0.0, 0.3, 0.0]), "right": np.array([0.5, 0.0, 0.3, 0.0])}
    table = StaticBody("table", RigidTransform([0, 0, -0.02]), Shape("box", (2.0, 2.0, 0.04)))
    top = RigidTransform([0, 0, 0.02])
    floor = Support("floor", "table", top, (1.6, 1.6))
    target = Support("target", "table", RigidTransform([0.2, 0.3, 0.02]), (0.1, 0.1), yaw=(-0.5, 0.5))
    grasps = (AntipodalGrasps(("-z",), 0.005, (0.01, 0.03)),)
    objects = tuple(
        MovableObject(
            name, "table", RigidTransform([x, y, 0.05]), "floor", Shape("box", (0.04, 0.04, 0.06)), grasps=grasps
        )
        for name, x, y in (("red", -0.3, 0.0), ("blue", 0.3, -0.3))
    )
    robots = tuple(Robot(name, model, RigidTransform(), q, q) for name, q in homes.items())
    return Problem("gantries", robots, (table,), (floor, target), objects, goal)


def test_gantries_of_four_joints(tmp_path: Path) -> None:
    goal = (InRegion("red", "target"), RobotAt("right", np.array([0.5, 0.0, 0.3, 0.0])))
    plan = solve(gantry_scene(tmp_path, goal))
    assert plan is not None


_SIX = """
<robot name="six">
  <link name="base"><collision><origin xyz="0 0 0.05"/><geometry><cylinder radius="0.06" length="0.1"/></geometry>
    </collision></link>
  <link name="turret"><collision><origin xyz="0 0 0.08"/><geometry><cylinder radius="0.05" length="0.16"/></geometry>
    </collision></link>
  <link name="upper"><collision><origin xyz="0 0 0.2"/><geometry><capsule radius="0.04" length="0.3"/></geometry>
    </collision></link>
  <link name="fore"><collision><origin xyz="0 0 0.15"/><geometry><capsule radius="0.03" length="0.2"/></geometry>
    </collision></link>
  <link name="wrist"><collision><origin xyz="0 0 0.06"/><geometry><capsule radius="0.03" length="0.04"/></geometry>
    </collision></link>
  <link name="knuckle"/>
  <link name="palm"><collision><origin xyz="0 0 0.08"/><geometry><box size="0.04 0.13 0.04"/>
    </geometry></collision></link>
  <link name="fixed_finger"><collision><origin xyz="0 0 0"/><geometry><box size="0.02 0.01 0.06"/>
    </geometry></collision>
    </link>
  <link name="jaw"><collision><origin xyz="0 0.005 0"/><geometry><box size="0.02 0.01 0.06"/>
    </geometry></collision></link>
  <joint name="j1" type="revolute"><parent link="base"/><child link="turret"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="2"/></joint>
  <joint name="j2" type="revolute"><parent link="turret"/><child link="upper"/><origin xyz="0 0 0.15"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2.2" effort="1" velocity="2"/></joint>
  <joint name="j3" type="revolute"><parent link="upper"/><child link="fore"/>
    <origin xyz="0 0 0.42"/><axis xyz="0 1 0"/>
    <limit lower="-2.7" upper="2.7" effort="1" velocity="2"/></joint>
  <joint name="j4" type="revolute"><parent link="fore"/><child link="wrist"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="2"/></joint>
  <joint name="j5" type="revolute"><parent link="wrist"/><child link="knuckle"/><origin xyz="0 0 0.12"/>
    <axis xyz="0 1 0"/><limit lower="-2.4" upper="2.4" effort="1" velocity="2"/></joint>
  <joint name="j6" type="revolute"><parent link="knuckle"/><child link="palm"/><axis xyz="0 0 1"/>
    <limit lower="-3.1" upper="3.1" effort="1" velocity="2"/></joint>
  <joint name="left" type="prismatic"><parent link="palm"/><child link="fixed_finger"/><origin xyz="0 -0.005 0.14"/>
    <axis xyz="0 -1 0"/><limit lower="0" upper="0.04" effort="1" velocity="1"/></joint>
  <joint name="right" type="prismatic"><parent link="palm"/><child link="jaw"/>
    <origin xyz="0 0 0.14"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.04" effort="1" velocity="1"/></joint>
</robot>
"""


def six_joints(folder: Path, gripper: bool = True) -> RobotModel:
    """An elbow arm of six revolute joints with two fingers; without gripper its hand is just a lump."""
    (folder / "six.urdf").write_text(_SIX)
    return RobotModel(
        name="six",
        model="six.urdf",
        base="base",
        arm_joints=("j1", "j2", "j3", "j4", "j5", "j6"),
        home=(0.0, -0.3, 1.9, 0.0, 1.5, 0.0),
        gripper=Gripper(("palm", "fixed_finger", "jaw"), {"left": 0.5, "right": 0.5}, 0.08) if gripper else None,
        grasp_body="palm" if gripper else "base",
        X_BG=RigidTransform([0, 0, 0.15]) if gripper else RigidTransform(),
        collision_exceptions=(("wrist", "palm"), ("fixed_finger", "jaw"), ("upper", "base")),
        file=folder / "six.yaml",
    )


def test_an_arm_of_six_joints(tmp_path: Path) -> None:
    data = scene(
        objects=[cube("red", -0.1, 0.25)], goal=[{"object": "red", "at": pose(-0.1, -0.2, 0.025, 40), "on": "table"}]
    )
    problem = problem_from_dict(data)
    model = six_joints(tmp_path)
    home = np.array(model.home)
    problem = dataclasses.replace(problem, robots=(Robot("left", model, problem.robots[0].X_WB, home, home),))
    plan = solve(problem)
    assert plan is not None
    assert [kind for kind, _, _ in actions(plan)] == ["pick", "place"]


def test_a_robot_without_gripper_moves_but_does_not_grasp(tmp_path: Path) -> None:
    """It stands right where the cube has to go, and has a goal of its own elsewhere."""
    probe = six_joints(tmp_path, gripper=False)
    start, end = np.array([0.0, 0.6, 1.2, 0.0, 0.9, 0.0]), np.array([1.8, -0.3, 1.9, 0.0, 1.5, 0.0])
    data = scene(
        robots=[LEFT, RIGHT],
        objects=[cube("red", -0.05, 0.3)],
        goal=[{"object": "red", "at": pose(-0.05, 0, 0.025), "on": "table"}],
    )
    problem = problem_from_dict(data)
    X_WB = RigidTransform(RollPitchYaw(0, 0, np.pi), [0.5, 0, 0])
    robots = (problem.robots[0], Robot("probe", probe, X_WB, start, start))
    problem = dataclasses.replace(problem, robots=robots, goal=(*problem.goal, RobotAt("probe", end)))
    plan = solve(problem)
    assert plan is not None
    assert {robots for _, robots, _ in actions(plan)} == {("left",)}
    np.testing.assert_allclose(plan.segments[-1].q["probe"][-1], end)


def test_simultaneous_transitions_never_break_a_plan() -> None:
    """With exploration alone every active set is drawn, also one robot stacking on what another takes."""
    objects = [cube("low", 0, 0.15), cube("high", 0, -0.15)]
    goal = [{"object": "high", "on": "low"}, {"object": "low", "at": pose(0, 0, 0.025), "on": "table"}]
    problem = problem_from_dict(scene(robots=[LEFT, RIGHT], supports=[FLOOR], objects=objects, goal=goal))
    planner = Planner(problem, seed=0, options=Options(persistent=1.0))
    with at_most(60):
        list(planner.improve(4.0))
    if planner.best is not None:
        assert check_plan(planner.best).ok
