"""Laziness and the factored cache, switched off: more is asked, and the answers are the same."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from arena import Parts, arena, wall

import mrtamp
from mrtamp.check import check_plan
from mrtamp.modes import Mode, start_mode
from mrtamp.planner import Options, Planner
from mrtamp.problem import Problem
from mrtamp.problem_file import problem_from_dict
from mrtamp.validity import Validity


def walled() -> Problem:
    """One Panda at a table with a wall across it, over which two cubes have to go."""

    def at(x: float, y: float, z: float) -> dict[str, Any]:
        return {"translation": [x, y, z]}

    cubes = {"red": 0.1, "blue": 0.2}
    return problem_from_dict(
        {
            "mrtamp": 1,
            "name": "walled",
            "robots": [{"name": "arm", "model": "panda", "X_WB": at(-0.5, 0, 0)}],
            "world": [
                {"name": "table", "shape": {"box": [1.6, 1.4, 0.1]}, "X_WB": at(0, 0, -0.05)},
                {"name": "wall", "shape": {"box": [0.5, 0.04, 0.25]}, "X_WB": at(0, -0.05, 0.125)},
            ],
            "objects": [
                {"name": name, "shape": {"box": [0.05] * 3}, "start": {"on": "table", "X_WO": at(0, y, 0.025)}}
                for name, y in cubes.items()
            ],
            "goal": [{"object": name, "at": at(0, -0.1 - y, 0.025), "on": "table"} for name, y in cubes.items()],
        }
    )


def planner(problem: Problem, *without: str, iterations: int = 0) -> Planner:
    made = Planner(problem, seed=0, options=Options(without=frozenset(without)))
    list(made.improve(iterations=iterations))
    return made


def test_without_laziness_edges_are_asked_about_when_they_are_made() -> None:
    lazy, eager = planner(walled()), planner(walled(), "lazy-validation")
    before = eager.counts()
    assert before["edges_validated"] == sum(g.n_edges for g in eager.roadmaps.values()) > 100
    assert lazy.counts()["edges_validated"] < 10
    assert before["collision_checks"] > lazy.counts()["collision_checks"]
    mode = start_mode(lazy.problem)
    for robot in lazy.names:
        g = eager.roadmaps[robot]
        np.testing.assert_array_equal(g.ends, lazy.roadmaps[robot].ends)
        verdicts = [eager.validity.edge(robot, e, mode) for e in range(g.n_edges)]
        assert verdicts == [lazy.validity.edge(robot, e, mode) for e in range(g.n_edges)]
        assert 0 < sum(verdicts) < len(verdicts)
    assert eager.counts()["collision_checks"] == before["collision_checks"], "all of it was known"


@pytest.mark.parametrize(
    ("mechanism", "problem", "iterations"),
    [("lazy-validation", walled(), 12), ("factored-cache", mrtamp.load_problem("box"), 25)],
    ids=["lazy-validation", "factored-cache"],
)
def test_without_either_mechanism_the_same_plan_is_found_at_a_higher_price(
    mechanism: str, problem: Problem, iterations: int
) -> None:
    """Answers do not depend on when they are asked for or how often."""
    alone = ("skeletons", "refinement")
    runs = [planner(problem, *without, iterations=iterations) for without in (alone, (*alone, mechanism))]
    costs = [p.best.cost for p in runs if p.best is not None and check_plan(p.best).ok]
    assert len(costs) == 2 and costs[0] == costs[1]
    usual, more = (p.counts()["collision_checks"] for p in runs)
    assert more > usual


def test_without_the_cache_every_mode_asks_for_itself(tmp_path: Path) -> None:
    """Two modes that differ in nothing geometric: the same verdicts, asked for once, or once each."""
    parts = Parts(arena(tmp_path, {"a": (-1, 0), "b": (1, 0)}, walls=[wall("wall", (-0.1, -0.5), (0.1, 0.5))]))
    parts.scatter(25)
    forgetful = Validity(parts.problem, parts.collision, parts.roadmaps, remember=False)
    modes = [parts.root, Mode((), frozenset({"visited"}))]
    a, b = parts.roadmaps.values()
    pairs = list(itertools.islice(((u, v) for u, v in a.ends.tolist() if u != v), 40))

    def ask(validity: Validity, mode: Mode) -> tuple[list[bool], int]:
        before = parts.collision.counts.collision_checks
        out = [validity.edge("a", a.edge(u, v), mode) for u, v in pairs]
        out += [validity.against("a", a.edge(u, v), mode, "b", 0) for u, v in pairs]
        out += [validity.move(mode, "a", p, "b", (0, v)) for p, v in zip(pairs, b.neighbours(0), strict=False)]
        return out, parts.collision.counts.collision_checks - before

    first, asked = ask(parts.validity, modes[0])
    assert ask(parts.validity, modes[1]) == (first, 0)
    assert asked > 0 and 0 < sum(first) < len(first)
    for mode in modes:
        assert ask(forgetful, mode) == (first, asked)
        assert ask(forgetful, mode) == (first, 0), "within a mode it remembers"
