"""When discs could be where, if they could pass through each other: an exact lower bound on the cost of a plan.

Every robot takes the exact shortest path (`mrtamp.planar`) between its subgoals, in the best order, at full speed, and
waits only for subgoals that others have to reach first.  No plan is cheaper.  Where robots can get out of each other's
way by waiting on these paths, without being late, the bound is attained and so is the optimum; for the shipped planar
problems the tests show that by such a plan.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import networkx as nx
import numpy as np
from pydrake.geometry import Box, Cylinder

from mrtamp.planar import shortest_path, visibility_graph
from mrtamp.problem import AtConfiguration, MrtampError, Problem, RobotAt, Subgoal
from mrtamp.scene import Scene, build_scene, robot_bodies, robot_joint

START = "start"
END = "end"


@dataclass(frozen=True, eq=False)
class Timetable:
    """The cheapest timetable of discs that ignore each other.

    `order` maps each robot to its subgoals in the order in which it reaches them, `legs` to the polylines (k, 2) of
    joint positions from its start by way of these to its end, `lengths` to their lengths (m).  `arrival` is when each
    subgoal is reached at the earliest, in metres of travel at unit speed.
    """

    cost: float
    makespan: float
    order: dict[str, tuple[str, ...]]
    legs: dict[str, list[np.ndarray]]
    lengths: dict[str, list[float]]
    arrival: dict[str, float]


def timetable(problem: Problem, clearance: float = 0.0) -> Timetable:
    """The lower bound of a problem of discs among box-shaped walls.

    Parameters
    ----------
    problem : robots that slide along x and y, with one cylinder each; no objects; subgoals at configurations.
    clearance : metres by which the discs grow, for paths that keep a distance from the walls.

    Raises
    ------
    MrtampError : the problem is of another kind.
    """
    if problem.objects:
        raise MrtampError(f"{problem.name}: found objects, expected discs that only move")
    scene = build_scene(problem)
    legs = {r.name: _legs(problem, scene, r.name, clearance) for r in problem.robots}
    best: Timetable | None = None
    for order in _orders(problem):
        found = _timed(problem, order, legs)
        if found is not None and (best is None or found.cost < best.cost):
            best = found
    if best is None:
        raise MrtampError(f"{problem.name}: found no order of its subgoals in which each comes after its predecessors")
    return best


_Legs = dict[tuple[str, str], tuple[float, np.ndarray]]


def _legs(problem: Problem, scene: Scene, name: str, clearance: float) -> _Legs:
    """Length and polyline between every two sites of a robot: its start, its subgoals and its end."""
    robot = problem.robot(name)
    X_WB = robot.X_WB
    if not np.allclose(X_WB.rotation().matrix(), np.eye(3)):
        raise MrtampError(f"{problem.name}: found a turned base of {name}, expected discs that slide along x and y")
    base = X_WB.translation()[:2]
    sites = {START: robot.start}
    sites |= {s.name: _point(problem, s, name) for s in problem.subgoals if name in s.targets}
    for condition in problem.goal:
        if isinstance(condition, RobotAt) and condition.robot == name:
            sites[END] = condition.q
    radius, height = _disc(problem, scene, name)
    joints = [robot_joint(scene.plant, scene.robots[name], j) for j in robot.model.arm_joints]
    room = tuple(
        base + [limit(j) for j in joints]
        for limit in (lambda j: j.position_lower_limit(), lambda j: j.position_upper_limit())
    )
    walls = _walls(problem, scene, height)
    graph = visibility_graph(walls, radius + clearance, {k: base + q for k, q in sites.items()}, (room[0], room[1]))
    out: _Legs = {}
    for a, b in itertools.permutations(sites, 2):
        if b != START and a != END:
            length, points = shortest_path(graph, a, b)
            out[a, b] = (length, points - base)
    return out


def _point(problem: Problem, subgoal: Subgoal, robot: str) -> np.ndarray:
    """Where (2,) a subgoal wants a robot."""
    target = subgoal.targets[robot]
    if not isinstance(target, AtConfiguration):
        raise MrtampError(f"{problem.name}: found a pose or a region in {subgoal.name}, expected configurations")
    return target.q


def _disc(problem: Problem, scene: Scene, name: str) -> tuple[float, tuple[float, float]]:
    """Radius of a robot that is one upright cylinder, and the heights of its faces."""
    inspector = scene.scene_graph.model_inspector()
    solids = [
        (body, g)
        for body in robot_bodies(scene.plant, scene.robots[name])
        for g in scene.plant.GetCollisionGeometriesForBody(body)
    ]
    shape = inspector.GetShape(solids[0][1]) if len(solids) == 1 else None
    if not isinstance(shape, Cylinder) or len(problem.robot(name).model.arm_joints) != 2:
        raise MrtampError(
            f"{problem.name}: found the robot {name}, expected a disc: one cylinder sliding along x and y"
        )
    _, context = scene.context()
    body, g = solids[0]
    z = (body.EvalPoseInWorld(context) @ inspector.GetPoseInFrame(g)).translation()[2]
    return shape.radius(), (z - shape.length() / 2, z + shape.length() / 2)


def _walls(problem: Problem, scene: Scene, height: tuple[float, float]) -> list[np.ndarray]:
    """Corners (4, 2), counter-clockwise, of the upright boxes that a disc between two heights can run into."""
    inspector = scene.scene_graph.model_inspector()
    _, context = scene.context()
    walls = []
    for name, bodies in scene.statics.items():
        for body in bodies:
            for g in scene.plant.GetCollisionGeometriesForBody(body):
                X_WC = body.EvalPoseInWorld(context) @ inspector.GetPoseInFrame(g)
                shape = inspector.GetShape(g)
                if not isinstance(shape, Box) or not np.isclose(X_WC.rotation().matrix()[2, 2], 1.0):
                    raise MrtampError(f"{problem.name}: found the wall {name}, expected an upright box")
                x, y, z = shape.size() / 2
                if abs(X_WC.translation()[2] - (height[0] + height[1]) / 2) < z + (height[1] - height[0]) / 2:
                    corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
                    walls.append(X_WC.multiply(corners.T).T[:, :2])
    return walls


def _orders(problem: Problem) -> Iterator[dict[str, tuple[str, ...]]]:
    """Every order in which each robot can reach its own subgoals."""
    names = [r.name for r in problem.robots]
    own = [[s.name for s in problem.subgoals if name in s.targets] for name in names]
    for choice in itertools.product(*(itertools.permutations(subgoals) for subgoals in own)):
        yield dict(zip(names, choice, strict=True))


def _timed(problem: Problem, order: Mapping[str, tuple[str, ...]], legs: Mapping[str, _Legs]) -> Timetable | None:
    """The earliest arrivals for one order of every robot; None if the orders contradict each other or `after`."""
    events = nx.DiGraph()
    events.add_node(START)
    for s in problem.subgoals:
        events.add_node(s.name)
        events.add_edges_from((before, s.name, {"length": 0.0}) for before in s.after)
    lengths: dict[str, list[float]] = {}
    paths: dict[str, list[np.ndarray]] = {}
    for robot, subgoals in order.items():
        sites = [START, *subgoals, *([END] if any(b == END for _, b in legs[robot]) else [])]
        steps = list(itertools.pairwise(sites))
        lengths[robot] = [legs[robot][step][0] for step in steps]
        paths[robot] = [legs[robot][step][1] for step in steps]
        for (a, b), length in zip(steps, lengths[robot], strict=True):
            end = (END, robot) if b == END else b
            known = events.edges[a, end]["length"] if events.has_edge(a, end) else 0.0
            events.add_edge(a, end, length=max(length, known))
    if not nx.is_directed_acyclic_graph(events):
        return None
    at = dict.fromkeys(events, 0.0)
    for event in nx.topological_sort(events):
        for before in events.predecessors(event):
            at[event] = max(at[event], at[before] + events.edges[before, event]["length"])
    makespan = max(at.values())
    weights = problem.cost
    changes = weights.transitions.get("reach", 0.0) * len(problem.subgoals)
    cost = weights.makespan * makespan + weights.path_length * sum(map(sum, lengths.values())) + changes
    arrival = {s.name: at[s.name] for s in problem.subgoals}
    return Timetable(cost, makespan, dict(order), paths, lengths, arrival)
