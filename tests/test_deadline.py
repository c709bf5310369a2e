"""Time is kept inside long activities as well, and what is abandoned for it counts neither way."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from arena import Parts, arena, visit, wall

from mrtamp.connect import Connector
from mrtamp.deadline import Deadline, TimeIsUp
from mrtamp.planner import Options, Planner
from mrtamp.planners import PLANNERS, make_planner
from mrtamp.problem import Problem

QUICK = Options(initial_vertices=5)
ACROSS = wall("across", (-0.1, -2.5), (0.1, 2.5))


def corridor(folder: Path) -> Problem:
    """Three discs in a corridor without a place to pass: two of them have to change sides, and attempts never end."""
    walls = [wall("below", (-2, -0.4), (2, -0.3)), wall("above", (-2, 0.3), (2, 0.4))]
    walls += [wall("left", (-2.1, -0.4), (-2, 0.4)), wall("right", (2, -0.4), (2.1, 0.4))]
    subgoals = [visit("there", "a", (1.7, 0)), visit("back", "b", (-1.7, 0))]
    return arena(folder, {"a": (-1.7, 0), "b": (1.7, 0), "c": (0.3, 0)}, subgoals=subgoals, walls=walls)


def test_a_deadline_passes_once_and_without_a_budget_never() -> None:
    deadline = Deadline()
    deadline.check()
    deadline.set(60.0)
    assert not deadline.passed
    deadline.set(0.0)
    with pytest.raises(TimeIsUp):
        deadline.check()
    deadline.set(None)
    deadline.check()


def test_a_search_that_is_late_leaves_the_roadmap_as_it_was(tmp_path: Path) -> None:
    parts = Parts(arena(tmp_path, {"a": (-1, 0)}, walls=[wall("post", (-0.1, -0.5), (0.1, 0.5))]))
    roadmap, beyond = parts.roadmaps["a"], parts.vertex("a", (1, 0))
    deadline = Deadline(-np.inf)
    connector = Connector(parts.validity, parts.rng, deadline)
    before = roadmap.n_vertices, roadmap.n_edges
    with pytest.raises(TimeIsUp):
        connector.connect(roadmap, parts.root, 0, beyond, 1000)
    assert (roadmap.n_vertices, roadmap.n_edges) == before
    deadline.set(None)
    assert connector.connect(roadmap, parts.root, 0, beyond, 1000)


def test_a_budget_is_kept_within_one_long_attempt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Attempts at skeletons here would go on for ever; abandoned ones are not held against their skeletons."""
    planner = Planner(corridor(tmp_path), options=QUICK)
    insert, failed = planner.growth.insert, []

    def insert_for_ever(*arguments: object, **how: bool) -> None:
        while True:
            insert(*arguments, **how)  # type: ignore[arg-type]

    monkeypatch.setattr(planner.growth, "insert", insert_for_ever)
    began = time.perf_counter()
    assert list(planner.improve(1.0)) == []
    assert 1.0 <= time.perf_counter() - began < 2.0
    assert planner.iteration == 1
    monkeypatch.undo()
    monkeypatch.setattr(planner.skeletons, "failed", failed.append)
    planner.iteration = 0
    planner.deadline.set(0.0)
    with pytest.raises(TimeIsUp):
        planner.realisation.attempt()
    assert failed == []
    # The next call has time again.
    list(planner.improve(iterations=1))
    assert planner.iteration == 1


@pytest.mark.parametrize("name", ["unguided", "composed-prm", "prioritised"])
def test_others_keep_their_budget_too(name: str, tmp_path: Path) -> None:
    planner = make_planner(name, corridor(tmp_path))
    began = time.perf_counter()
    assert list(planner.improve(0.6)) == []
    assert 0.6 <= time.perf_counter() - began < 1.6


def test_skeletons_that_take_long_and_fail_leave_search_its_half(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a clock that only activities move: an attempt takes 5 s, an iteration of search 0.1 s."""
    planner = Planner(corridor(tmp_path), options=QUICK)
    now, spent = [0.0], {"search": 0.0, "skeletons": 0.0}

    def takes(activity: str, seconds: float) -> None:
        now[0] += seconds
        spent[activity] += seconds

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(planner, "_search", lambda: takes("search", 0.1))
    monkeypatch.setattr(planner, "_realise_skeletons", lambda: takes("skeletons", 5.0))
    for status in planner.improve(100.0, progress=lambda s: None):
        raise AssertionError(f"nothing was planned, but {status} came out")
    assert 40.0 <= spent["skeletons"] <= 55.0
    assert spent["search"] == pytest.approx(100.0 - spent["skeletons"], abs=5.0)


def test_runs_bounded_by_iterations_give_skeletons_every_fourth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = Planner(corridor(tmp_path), options=QUICK)
    turns: list[str] = []
    monkeypatch.setattr(planner, "_search", lambda: turns.append("search"))
    monkeypatch.setattr(planner, "_realise_skeletons", lambda: turns.append("skeletons"))
    list(planner.improve(iterations=9))
    assert turns == [*["skeletons", "search", "search", "search"] * 2, "skeletons"]


@pytest.mark.parametrize("name", sorted(PLANNERS))
def test_a_plan_that_costs_nothing_ends_the_call(name: str, tmp_path: Path) -> None:
    planner = make_planner(name, arena(tmp_path, {"a": (-1, 0)}, {"a": (-1, 0)}))
    assert [plan.cost for plan in planner.improve(iterations=50)] == [0.0]
    assert planner.status().iteration < 50
    assert list(planner.improve(60.0)) == []


_INTERRUPTED_IMPORT = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, *_):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
sys.argv = ["mrtamp", "plan", "box"]
from mrtamp.__main__ import main
sys.exit(main())
"""


@pytest.mark.parametrize("module", ["argparse", "pydrake", "mrtamp.planner"])
def test_an_interrupted_import_ends_the_command_quietly(module: str) -> None:
    command = [sys.executable, "-c", _INTERRUPTED_IMPORT.format(module=module)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (128 + signal.SIGINT, "", "stopped\n")
