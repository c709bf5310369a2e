"""Every planner by name: the same plans as far as the judge goes, the same counts, equal seeds give equal runs."""

from __future__ import annotations

import hashlib
import itertools
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import mrtamp
from mrtamp.baselines.composed_prm import ComposedOptions
from mrtamp.baselines.prioritised import PrioritisedOptions
from mrtamp.check import check_plan
from mrtamp.cli import main
from mrtamp.mechanisms import MECHANISMS_OF, PLANNER_NAMES
from mrtamp.planner import Options, Planner
from mrtamp.planners import PLANNERS, UNGUIDED, AnyPlanner, make_planner, planner_options
from mrtamp.problem import MrtampError, Problem
from mrtamp.problem_file import problem_from_dict
from mrtamp.timetable import timetable

BASELINES = ("composed-prm", "prioritised")


def test_registry_has_every_name_and_a_clear_error_for_others() -> None:
    assert tuple(PLANNERS) == PLANNER_NAMES == ("guided", "unguided", "composed-prm", "prioritised")
    with pytest.raises(MrtampError, match=r"planner: 'best' is unknown; choose from guided, unguided, composed-prm"):
        make_planner("best", mrtamp.load_problem("square_free"))


@pytest.mark.parametrize("name", PLANNER_NAMES)
def test_mechanisms_that_a_planner_does_not_have_are_refused_in_its_name(name: str) -> None:
    assert planner_options(name, {"without": MECHANISMS_OF[name]}).without == set(MECHANISMS_OF[name])
    known = ", ".join(MECHANISMS_OF[name])
    with pytest.raises(MrtampError, match=f"^without: {name} has no magic, sorcery; choose from {known}$"):
        planner_options(name, {"without": ["sorcery", "refinement", "magic"]})


def test_options_that_are_made_by_hand_are_looked_at_too() -> None:
    magic = frozenset({"magic"})
    for kind, name in ((Options, "guided"), (ComposedOptions, "composed-prm"), (PrioritisedOptions, "prioritised")):
        with pytest.raises(MrtampError, match=f"without: {name} has no magic; choose from .*refinement"):
            kind(without=magic)


def test_unguided_is_the_planner_without_guidance_and_with_all_else() -> None:
    planner = make_planner("unguided", mrtamp.load_problem("square_free"), 0, {"without": ["sliding"]})
    assert isinstance(planner, Planner)
    assert planner.options.without == UNGUIDED | {"sliding"}
    assert not UNGUIDED & {"lazy-validation", "factored-cache", "refinement", "rewiring"}


@pytest.mark.parametrize("name", BASELINES)
def test_options_are_by_name_and_wrong_ones_are_named(name: str) -> None:
    assert planner_options(name, {"without": ["refinement"]}).without == {"refinement"}
    # Options of another planner count as far as they differ from its defaults.
    assert planner_options(name, Options()) == planner_options(name)
    assert planner_options(name, Options(without=frozenset({"refinement"}))).without == {"refinement"}
    with pytest.raises(MrtampError, match=rf"{name} has no intra_orbit; choose from .*without"):
        planner_options(name, {"intra_orbit": "prioritised"})
    with pytest.raises(MrtampError, match=rf"{name} has no rewiring; choose from"):
        planner_options(name, Options(without=frozenset({"rewiring"})))
    with pytest.raises(MrtampError, match=r"options: found list, expected settings by name"):
        planner_options(name, ["refinement"])


@pytest.mark.parametrize(("name", "iterations"), [*zip(PLANNER_NAMES, (12, 60, 5, 8), strict=True)])
def test_plans_pass_the_judge_get_better_and_are_not_below_the_bound(name: str, iterations: int) -> None:
    problem = mrtamp.load_problem("planar_doorway")
    bound = timetable(problem).cost
    planner = make_planner(name, problem, 0)
    plans = list(planner.improve(20.0, iterations=iterations))
    assert plans, planner.explain()
    for plan in plans:
        report = check_plan(plan)
        assert report.ok, str(report)
        assert plan.cost >= bound * (1 - 1e-6)
    assert all(b.cost < a.cost for a, b in itertools.pairwise(plans))
    assert planner.best is plans[-1]
    counts = planner.counts()
    assert counts["collision_checks"] > 0 and counts["ik_calls"] == 0
    assert plans[-1].counts["collision_checks"] <= counts["collision_checks"]


@pytest.mark.parametrize("name", BASELINES)
def test_manipulation_of_every_kind(name: str) -> None:
    """Goals in regions, a tower with its order, objects that only two arms together can bring to their places."""
    for task, budget_s in (("box", 30.0), ("stacking", 60.0), ("handover", 60.0)):
        planner = make_planner(name, mrtamp.load_problem(task), 1)
        [plan] = planner.improve(budget_s, first=True)
        report = check_plan(plan)
        assert report.ok, str(report)
        assert planner.counts()["ik_calls"] > 0


def fingerprint(name: str) -> str:
    planner = make_planner(name, mrtamp.load_problem("pick_place", robots=2, objects=2), 0, {"shortcuts": 100})
    plans = list(planner.improve(iterations=2))
    digest = hashlib.sha256(repr((planner.counts(), [p.cost for p in plans])).encode())
    for q in (q for p in plans for s in p.segments for q in s.q.values()):
        digest.update(q.tobytes())
    return f"{len(plans)} {digest.hexdigest()}"


@pytest.mark.parametrize("name", BASELINES)
def test_equal_seeds_give_equal_runs_in_any_process(name: str) -> None:
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import test_planners_by_name as t; "
    other = subprocess.Popen(
        [sys.executable, "-c", code + f"print(t.fingerprint({name!r}))"],
        env={**os.environ, "PYTHONHASHSEED": "77"},
        stdout=subprocess.PIPE,
    )
    here = fingerprint(name)
    assert not here.startswith("0 "), "the comparison should include a plan"
    assert other.communicate(timeout=120)[0].decode().strip() == here


def out_of_reach() -> Problem:
    """One arm, and a cube whose goal is far away from it."""

    def pose(x: float, y: float) -> dict[str, Any]:
        return {"translation": [x, y, 0.025]}

    return problem_from_dict(
        {
            "mrtamp": 1,
            "name": "far",
            "robots": [{"name": "left", "model": "panda", "X_WB": {"translation": [-0.5, 0, 0]}}],
            "world": [{"name": "table", "shape": {"box": [2.4, 1.4, 0.1]}, "X_WB": {"translation": [0, 0, -0.05]}}],
            "objects": [{"name": "red", "shape": {"box": [0.05] * 3}, "start": {"on": "table", "X_WO": pose(0, 0.2)}}],
            "goal": [{"object": "red", "at": pose(1.0, 0.6), "on": "table"}],
        }
    )


@pytest.mark.parametrize("name", BASELINES)
def test_what_cannot_be_done_ends_in_time_and_is_explained(name: str) -> None:
    planner: AnyPlanner = make_planner(name, out_of_reach(), 0)
    began = time.monotonic()
    assert list(planner.improve(2.0)) == []
    assert time.monotonic() - began < 6.0, "within the time, but for the iteration at hand on a slow machine"
    assert planner.best is None
    assert planner.status().phase == "first plan" and planner.status().remaining > 0
    explanation = planner.explain()
    assert "red" in explanation
    assert ("no robot found a way to put it at its goal" in explanation) or ("nobody was found" in explanation)


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "plan.json"
    command = ["plan", "square_free", "--planner", "composed-prm", "--iterations", "2", "--out", str(out), "--quiet"]
    assert main([*command, "--without", "informed-sampling"]) == 0
    assert main(["check", str(out)]) == 0
    capsys.readouterr()
    assert main([*command, "--without", "rewiring"]) == 2
    assert "composed-prm has no rewiring; choose from informed-sampling" in capsys.readouterr().err
    assert main([*command, "--intra-orbit", "prioritised"]) == 2
    assert "--intra-orbit: composed-prm has no such setting" in capsys.readouterr().err
