"""The planner as a whole: whatever it returns is valid, equal seeds give equal runs, and what cannot be done is not done.

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
    for i, name in enumerate(names):
        kind = rng.choice(["in", "at", "on", "held_by", "nothing"])
        flat = i > 0 and "box" in objects[0]["shape"] and objects[0]["shape"]["box"][2] <= 0.05
        if kind == "in":
            goal.append({"object": name, "in": "target"})
        elif kind == "at":
            goal.append({"object": name, "at": pose(*spot(), heights[name], rng.uniform(-180, 180)), "on": "table"})
        elif kind == "on" and flat and all(g.get("on") != names[0] for g in goal):
            goal.append({"object": name, "on": names[0]})
        elif kind == "held_by" and holders:
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
