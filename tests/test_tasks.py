"""The shipped and the generated tasks: honest geometry, apart from each other, solvable by construction."""

from __future__ import annotations

import functools
import itertools
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from mrtamp.model_files import make_parser, models_dir
from mrtamp.problem import AtPose, InRegion, Problem, ProblemError
from mrtamp.problem_file import load_problem, problem_to_dict
from mrtamp.tasks import MAX_OBJECTS, MAX_ROBOTS, pick_place, pick_place_dict, ring

SHIPPED = sorted(file.stem for file in (models_dir() / "problems").glob("*.yaml"))
SIZES = list(itertools.product(range(1, MAX_ROBOTS + 1), range(1, MAX_OBJECTS + 1)))
# Between these radii a Panda grasps a low object from above with its elbow free.
NEAR, FAR = 0.32, 0.66
# Farther than this from its base a Panda's hand, pointing down at table height, does not reach at all.
OUT_OF_REACH = 0.78


@functools.cache
def generated(robots: int, objects: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bases (R, 2), starts (N, 2) and goals (N, 2) of a generated layout."""
    data = pick_place_dict(robots, objects, seed)
    return (
        np.array([robot["X_WB"]["translation"][:2] for robot in data["robots"]]),
        np.array([thing["start"]["X_WO"]["translation"][:2] for thing in data["objects"]]),
        np.array([condition["at"]["translation"][:2] for condition in data["goal"]]),
    )


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pairwise distances (n, m) of points (n, 2) and (m, 2)."""
    result: np.ndarray = np.linalg.norm(a[:, None] - b[None], axis=2)
    return result


def base_distances(problem: Problem, xy: np.ndarray) -> dict[str, float]:
    """Horizontal distance of each robot's base from the point (2,)."""
    return {robot.name: float(np.linalg.norm(robot.X_WB.translation()[:2] - xy)) for robot in problem.robots}


def goal_points(problem: Problem, name: str) -> np.ndarray:
    """Points (n, 3) in the world that stand for the goal of the object `name`: its pose, or corners of its region."""
    (condition,) = [c for c in problem.goal if isinstance(c, AtPose | InRegion) and c.object == name]
    bodies = {body.name: body.X_WB for body in problem.statics}
    if isinstance(condition, AtPose):
        assert condition.X_BO is not None
        return np.array([(bodies[condition.on] @ condition.X_BO).translation()])
    region = problem.support(condition.region)
    X_WS = bodies[region.body] @ region.X_BS
    signs = itertools.product((-0.5, 0.5), repeat=2)
    return np.array([X_WS.multiply(np.array([sx * region.size[0], sy * region.size[1], 0.0])) for sx, sy in signs])


def start_point(problem: Problem, name: str) -> np.ndarray:
    """Where the object's origin (3,) starts in the world."""
    thing = problem.object(name)
    (X_WB,) = [body.X_WB for body in problem.statics if body.name == thing.start_on]
    point: np.ndarray = (X_WB @ thing.start_X_BO).translation()
    return point


def home_clearance(problem: Problem, limit: float = 0.3) -> float:
    """Smallest distance (m) between two different robots that stand at home; `limit` if it is more."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    owner: dict[int, str] = {}
    for robot in problem.robots:
        parser = make_parser(plant, scene_graph, problem.package_paths)
        parser.SetAutoRenaming(True)
        (instance,) = parser.AddModels(Path(robot.model.model))
        base = plant.GetBodyByName(robot.model.base, instance)
        plant.WeldFrames(plant.world_frame(), base.body_frame(), robot.X_WB)
        for joint, position in zip(robot.model.arm_joints, robot.home, strict=True):
            plant.GetJointByName(joint, instance).set_default_positions([position])
        for body in map(plant.get_body, plant.GetBodyIndices(instance)):
            owner |= {geometry.get_value(): robot.name for geometry in plant.GetCollisionGeometriesForBody(body)}
    plant.Finalize()
    diagram = builder.Build()
    context = scene_graph.GetMyContextFromRoot(diagram.CreateDefaultContext())
    query = scene_graph.get_query_output_port().Eval(context)
    pairs = query.ComputeSignedDistancePairwiseClosestPoints(limit)
    apart = [p.distance for p in pairs if owner[p.id_A.get_value()] != owner[p.id_B.get_value()]]
    return min(apart, default=limit)


# Generated layouts.


@pytest.mark.parametrize(("robots", "objects"), SIZES)
def test_layout_is_solvable_by_construction(robots: int, objects: int) -> None:
    bases, starts, goals = generated(robots, objects)
    from_start, from_goal = distances(starts, bases), distances(goals, bases)
    comfortable = (from_start > NEAR) & (from_start < FAR) & (from_goal > NEAR) & (from_goal < FAR)
    assert comfortable.any(axis=1).all(), "some cube has no robot that reaches both its start and its goal"
    spots = np.vstack([starts, goals])
    apart = distances(spots, spots)[np.triu_indices(len(spots), k=1)]
    assert apart.min() >= 0.14
    assert distances(spots, bases).min() > 0.29


@pytest.mark.parametrize("robots", range(2, MAX_ROBOTS + 1))
def test_neighbours_compete_for_about_half_of_the_objects(robots: int) -> None:
    shared = []
    for seed in range(5):
        bases, starts, _ = generated(robots, 8, seed)
        shared.append(((distances(starts, bases) < 0.62).sum(axis=1) > 1).mean())
    assert 0.4 <= np.mean(shared) <= 0.95


@pytest.mark.parametrize("robots", range(1, MAX_ROBOTS + 1))
def test_bases_are_apart_and_look_inwards(robots: int) -> None:
    bases = ring(robots)
    if robots == 1:
        return
    apart = distances(bases[:, :2], bases[:, :2])[np.triu_indices(robots, k=1)]
    assert 0.8 <= apart.min() <= 0.95
    yaw = np.radians(bases[:, 2])
    towards = np.column_stack([np.cos(yaw), np.sin(yaw)])
    assert np.einsum("ij,ij->i", towards, -bases[:, :2]) == pytest.approx(np.linalg.norm(bases[:, :2], axis=1))


@pytest.mark.parametrize("robots", range(2, MAX_ROBOTS + 1))
def test_homes_are_apart(robots: int) -> None:
    assert home_clearance(pick_place(robots, 1)) > 0.15


@pytest.mark.parametrize("name", SHIPPED)
def test_homes_of_shipped_tasks_are_apart(name: str) -> None:
    assert home_clearance(load_problem(name)) > 0.15


def test_layouts_depend_on_the_seed_and_on_nothing_else() -> None:
    assert pick_place_dict(3, 6, 1) == pick_place_dict(3, 6, 1)
    assert pick_place_dict(3, 6, 1) != pick_place_dict(3, 6, 2)
    assert problem_to_dict(pick_place(2, 4, 5)) == problem_to_dict(
        load_problem("pick_place", robots=2, objects=4, layout_seed=5)
    )


@pytest.mark.parametrize("size", SIZES)
def test_every_size_loads(size: tuple[int, int]) -> None:
    robots, objects = size
    problem = pick_place(robots, objects)
    assert (len(problem.robots), len(problem.objects), len(problem.goal)) == (robots, objects, objects)
    assert len(problem.supports) == 2 * objects


@pytest.mark.parametrize("arguments", [(0, 1), (9, 1), (1, 0), (1, 25), (1, 1, -1), (2.0, 1), ("2", 1), (True, 1)])
def test_sizes_out_of_range_are_refused(arguments: tuple[int, ...]) -> None:
    with pytest.raises(ProblemError, match="expected a whole number from"):
        pick_place(*arguments)


# Shipped tasks.


@pytest.mark.parametrize("name", SHIPPED)
def test_objects_rest_exactly_on_what_they_start_on(name: str) -> None:
    problem = load_problem(name)
    for thing in problem.objects:
        (body,) = [b for b in problem.statics if b.name == thing.start_on]
        assert thing.shape is not None
        assert body.shape is not None
        bottom = start_point(problem, thing.name)[2] - thing.shape.half_height
        assert bottom == pytest.approx(body.X_WB.translation()[2] + body.shape.half_height, abs=1e-9)


def test_box_is_reached_by_both_arms_and_admits_one_hand() -> None:
    problem = load_problem("box")
    points = [start_point(problem, o.name) for o in problem.objects]
    for point in [*points, *goal_points(problem, "red")]:
        assert max(base_distances(problem, point[:2]).values()) < 0.75
    # Two hands pointing down need 9 cm between their flanges; with all its sliding a grasp cannot make that of 5.4 cm.
    slide = 0.01
    assert abs(points[0][0] - points[1][0]) + 2 * slide < 0.088
    inside = {body.name: body.X_WB.translation() for body in problem.statics}
    clear_x = inside["box_wall_right"][0] - inside["box_wall_left"][0] - 0.01
    clear_y = inside["box_wall_far"][1] - inside["box_wall_near"][1] - 0.01
    assert clear_x < 0.204 < clear_y < 2 * 0.204, "a hand of 20.4 cm fits along the box, not across, and not twice"


def test_handover_goals_are_out_of_reach_of_the_arm_at_the_start() -> None:
    problem = load_problem("handover")
    directions = set()
    for thing in problem.objects:
        start = start_point(problem, thing.name)
        near_start = {r for r, d in base_distances(problem, start[:2]).items() if d < OUT_OF_REACH}
        goals = goal_points(problem, thing.name)
        near_goal = {r for p in goals for r, d in base_distances(problem, p[:2]).items() if d < OUT_OF_REACH}
        assert len(near_start) == len(near_goal) == 1
        assert near_start != near_goal
        directions.add((*near_start, *near_goal))
    assert directions == {("left", "right"), ("right", "left")}
    # No spot on a table that both arms reach: the edge of each table is too far from the other arm.
    for table, other in (("left_table", "right"), ("right_table", "left")):
        (body,) = [b for b in problem.statics if b.name == table]
        assert body.shape is not None
        x_base = problem.robot(other).X_WB.translation()[0]
        assert abs(x_base - body.X_WB.translation()[0]) - body.shape.size[0] / 2 > OUT_OF_REACH
    # ... but hands meet over the gap.
    assert max(base_distances(problem, np.zeros(2)).values()) < 0.7


def test_stacking_builds_one_tower_within_reach_of_both_arms() -> None:
    problem = load_problem("stacking")
    on = {c.object: c.on for c in problem.goal if isinstance(c, AtPose)}
    chain = [next(name for name, body in on.items() if body == "table")]
    while len(chain) < 4:
        chain.append(next(name for name, body in on.items() if body == chain[-1]))
    assert sorted(chain) == sorted(o.name for o in problem.objects)
    tower = goal_points(problem, chain[0])[0]
    assert all(NEAR < d < FAR for d in base_distances(problem, tower[:2]).values())
    starts = [start_point(problem, o.name) for o in problem.objects]
    for point in starts:
        assert any(NEAR < d < FAR for d in base_distances(problem, point[:2]).values())
        assert np.linalg.norm(point - tower) > 0.2
