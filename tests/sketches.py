"""Plans drawn by hand for tests of what shows plans: their motion is smooth and consistent, but nobody checked it."""

from __future__ import annotations

import numpy as np

from mrtamp.kinematics import inverse
from mrtamp.modes import Attachment, object_poses, start_mode, static_poses
from mrtamp.plan import Action, Plan, Segment, Transition, plan_cost
from mrtamp.problem import Problem
from mrtamp.scene import build_scene, chain_of


def sketch(problem: Problem, waypoints: int = 5) -> Plan:
    """The first robot picks the first object and hands it to the second, which places it; then all go home.

    The object is grasped from wherever the hand happens to be.
    """
    first, second = (r.name for r in problem.robots[:2])
    home = {r.name: np.asarray(r.home) for r in problem.robots}
    scene = build_scene(problem)
    tools = {name: chain_of(scene, name)[1] for name in home}

    def leg(start: dict[str, np.ndarray], end: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        s = np.linspace(0, 1, waypoints)[:, None]
        return {name: start[name] + s * (end[name] - start[name]) for name in home}

    def swing(at: dict[str, np.ndarray], name: str, *change: float) -> dict[str, np.ndarray]:
        return {**at, name: at[name] + np.array(change)}

    stops = [home]
    stops.append(swing(stops[-1], first, 0.5, 0.3, 0, -0.2, 0, 0.3, 0))
    stops.append(swing(stops[-1], first, -0.9, 0.1, 0.2, 0.3, 0, 0, 0.5))
    stops.append(swing(stops[-1], second, -0.6, 0.3, 0, -0.2, 0.1, 0.2, 0))
    stops.append(home)

    modes = [start_mode(problem)]
    name = problem.objects[0].name
    rest = modes[0].of[name]

    def world(k: int) -> np.ndarray:
        frames = {r: tool.matrix(stops[k][r][None])[0] for r, tool in tools.items()}
        return object_poses(modes[-1], {**static_poses(problem), **frames})[name]

    def held(robot: str, k: int) -> Attachment:
        X_WG = tools[robot].matrix(stops[k][robot][None])[0]
        return Attachment(name, robot, inverse(X_WG) @ world(k), None, 0.03)

    changes = []
    for k, robot in ((1, first), (2, second)):
        changes.append(held(robot, k))
        modes.append(modes[-1].replace(changes[-1]))
    X_WP = static_poses(problem)[rest.parent]
    changes.append(Attachment(name, rest.parent, inverse(X_WP) @ world(3), rest.support))
    modes.append(modes[-1].replace(changes[-1]))

    kinds = (("pick", (first,)), ("handover", (first, second)), ("place", (second,)))
    transitions = [
        Transition((Action(kind, robots, before.of[name], after),))
        for (kind, robots), before, after in zip(kinds, modes, changes, strict=False)
    ]
    segments = [Segment(mode, leg(a, b)) for mode, a, b in zip(modes, stops, stops[1:], strict=False)]
    cost = plan_cost(segments, transitions, problem.cost)
    history = [{"time_s": 0.2, "cost": cost + 1.0}, {"time_s": 0.9, "cost": cost}]
    return Plan(problem, segments, transitions, cost, history, {"nodes": 12}, seed=0)
