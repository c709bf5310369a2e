"""Seeds side by side: the best of all is returned, its cost bounds the others, a lost worker costs only its seed."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import errands
import psutil
import pytest
from arena import arena, visit, wall

from mrtamp.baselines.composed_prm import ComposedOptions
from mrtamp.check import check_plan
from mrtamp.cli import main
from mrtamp.cluster import Outcome, Told, pool
from mrtamp.plan import Plan
from mrtamp.plan_file import plan_from_dict
from mrtamp.planner import Options, Planner
from mrtamp.portfolio_plan import Messenger, SeedPortfolio, plan_portfolio
from mrtamp.problem import MrtampError, Problem
from mrtamp.problem_file import problem_to_dict

QUICK = Options(initial_vertices=5)


def detour(folder: Path) -> Problem:
    """Two discs change sides of a wall that has a way around it above and below."""
    subgoals = [visit("a_there", "a", (1.0, 0.3)), visit("b_there", "b", (-1.0, -0.3))]
    return arena(
        folder, {"a": (-1, 0.3), "b": (1, -0.3)}, subgoals=subgoals, walls=[wall("wall", (-0.1, -0.8), (0.1, 0.8))]
    )


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """A scheduler with one worker."""
    from distributed import LocalCluster

    options = {"dashboard_address": "127.0.0.1:0"}
    with LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", scheduler_kwargs=options, silence_logs=100
    ) as running:
        yield running.scheduler_address


def test_the_best_of_all_seeds_is_returned(tmp_path: Path) -> None:
    portfolio = SeedPortfolio(detour(tmp_path), [3, 5], options=QUICK)
    lines: list[str] = []
    plans = list(portfolio.improve(iterations=12, progress=lines.append))
    best = portfolio.best
    assert best is plans[-1]
    assert set(portfolio.reports) == {3, 5}
    assert not portfolio.failures
    costs = {seed: report.cost for seed, report in portfolio.reports.items()}
    assert best.cost == pytest.approx(min(c for c in costs.values() if c is not None), abs=1e-12)
    assert costs[best.seed] == best.cost
    assert all(a.cost > b.cost for a, b in itertools.pairwise(plans)), "only better plans are yielded"
    assert [entry["cost"] for entry in best.history] == [plan.cost for plan in plans]
    assert check_plan(best).ok
    assert best.found_by == {"portfolio": "seeds 3, 5"}
    assert lines[-1] == f"improving: cost {best.cost:.3f} (seed {best.seed}), 2 of 2 seeds have plans"
    assert portfolio.counts()["collision_checks"] == sum(
        r.counts["collision_checks"] for r in portfolio.reports.values()
    )
    best.save(tmp_path / "plan.json")
    loaded = Plan.load(tmp_path / "plan.json")
    assert (loaded.seed, loaded.found_by, loaded.cost) == (best.seed, best.found_by, best.cost)
    assert check_plan(loaded).ok


def test_the_bound_reaches_the_others(address: str) -> None:
    from distributed import Variable

    with pool(address) as workers:
        bound = Variable("test-bound", workers.client)
        bound.set(float("inf"))
        values = []
        for event in workers.follow(errands.await_bound, [("a", ("test-bound",))]):
            if isinstance(event, Told):
                bound.set(7.5)
            else:
                assert isinstance(event, Outcome)
                values.append(event.value)
    assert values == [7.5]


def test_nothing_is_tried_that_cannot_beat_the_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Below the cost of every plan, neither skeletons nor refinement propose anything, and search goes on."""
    problem = detour(tmp_path)

    def tried(bound: float) -> tuple[int, int]:
        planner = Planner(problem, seed=0, options=QUICK)
        planner.bound = lambda: bound
        counts = {"skeletons": 0, "refined": 0}
        insert, improve = planner.growth.insert, planner.portfolio.improve

        def counted_insert(*arguments: object, **how: bool) -> object:
            counts["skeletons"] += 1
            return insert(*arguments, **how)

        def counted_improve(to_beat: float, promised: float | None) -> Plan | None:
            assert to_beat <= bound
            plan = improve(to_beat, promised)
            counts["refined"] += plan is not None
            assert plan is None or plan.cost < bound
            return plan

        monkeypatch.setattr(planner.growth, "insert", counted_insert)
        monkeypatch.setattr(planner.portfolio, "improve", counted_improve)
        for _ in planner.improve(iterations=40):
            pass
        return counts["skeletons"], counts["refined"]

    skeletons, refined = tried(float("inf"))
    assert skeletons > 0
    assert refined > 0
    assert tried(0.5) == (0, 0)


def test_only_plans_that_beat_the_bound_are_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = detour(tmp_path)
    planner = Planner(problem, options=QUICK)
    plan = next(iter(planner.improve(iterations=100)))
    sent: list[dict] = []
    bound = [float("inf")]
    link = SimpleNamespace(tell=sent.append)
    messenger = Messenger(link, lambda: bound[0])  # type: ignore[arg-type]
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])

    def offered(cost: float) -> None:
        plan.cost = cost
        messenger.offer(plan)

    offered(5.0)
    offered(4.0)
    assert [m["cost"] for m in sent] == [5.0], "the second waits"
    now[0] += 1.0
    messenger.send()
    assert [m["cost"] for m in sent] == [5.0, 4.0]
    bound[0] = 3.0
    now[0] += 1.0
    offered(3.5)
    assert len(sent) == 2, "somebody else has a better one"
    offered(2.0)
    offered(1.0)
    messenger.send(last=True)
    assert [m["cost"] for m in sent] == [5.0, 4.0, 2.0, 1.0]
    import zlib

    assert plan_from_dict(json.loads(zlib.decompress(sent[-1]["plan"]))).cost == 1.0


def workers_of_this_process() -> list[psutil.Process]:
    """Processes that a pool has started."""
    return [p for p in psutil.Process().children() if "--multiprocessing-fork" in p.cmdline()]


def test_a_lost_worker_costs_only_its_seed_which_is_tried_again(tmp_path: Path) -> None:
    portfolio = SeedPortfolio(detour(tmp_path), [0, 1], options=QUICK)
    # The scheduler of another test has its own in this process.
    others = workers_of_this_process()
    killed = []
    for _ in portfolio.improve(iterations=12):
        if not killed:
            killed = [p for p in workers_of_this_process() if p not in others][:1]
            killed[0].kill()
    assert killed
    assert set(portfolio.reports) == {0, 1}, "both came to their end"
    assert portfolio.best is not None
    assert check_plan(portfolio.best).ok


def test_the_first_plan_of_any_seed_ends_it(address: str, tmp_path: Path) -> None:
    portfolio = SeedPortfolio(detour(tmp_path), [0], scheduler=address, options=QUICK)
    began = time.monotonic()
    assert len(list(portfolio.improve(60.0, first=True))) == 1
    assert time.monotonic() - began < 30.0


def test_the_budget_is_kept_by_the_clock(address: str, tmp_path: Path) -> None:
    heard: list[float] = []
    began = time.monotonic()
    plan = plan_portfolio(detour(tmp_path), [1], 3.0, address, lambda plan: heard.append(plan.cost))
    assert time.monotonic() - began < 6.0
    assert plan is not None
    assert plan.cost == heard[-1]


def test_a_scheduler_plans(address: str, tmp_path: Path) -> None:
    portfolio = SeedPortfolio(detour(tmp_path), [4], scheduler=address, options=QUICK)
    plans = list(portfolio.improve(iterations=10))
    assert plans[-1].seed == 4
    assert plans[-1].cost == portfolio.reports[4].cost


def test_every_seed_needs_a_worker(address: str, tmp_path: Path) -> None:
    portfolio = SeedPortfolio(detour(tmp_path), range(3), scheduler=address)
    with pytest.raises(MrtampError, match=f"3 seeds side by side need as many workers; {address} has 1"):
        next(portfolio.improve(5.0))


def test_a_problem_that_cannot_be_planned_is_one_clear_error(address: str, tmp_path: Path) -> None:
    problem = arena(tmp_path, {"a": (0, 0), "b": (0.1, 0)}, subgoals=[visit("there", "a", (1, 1))])
    with pytest.raises(MrtampError, match="the start is not valid"):
        next(SeedPortfolio(problem, [0], scheduler=address).improve(5.0))


def test_what_failed_where_is_told_by_seed(address: str, tmp_path: Path) -> None:
    problem = arena(
        tmp_path, {"a": (-1, 0)}, subgoals=[visit("there", "a", (1, 0))], walls=[wall("wall", (-0.1, -2.5), (0.1, 2.5))]
    )
    portfolio = SeedPortfolio(problem, [8], scheduler=address, options=QUICK)
    assert not list(portfolio.improve(iterations=3))
    assert portfolio.best is None
    assert portfolio.explain().startswith("seed 8: ")
    assert "there" in portfolio.explain()


def test_every_seed_plans_for_the_whole_budget_and_says_in_time_why_there_is_no_plan(tmp_path: Path) -> None:
    """It takes longer than the budget to start the workers, which therefore is no part of it."""
    problem = arena(
        tmp_path, {"a": (-1, 0)}, subgoals=[visit("there", "a", (1, 0))], walls=[wall("wall", (-0.1, -2.5), (0.1, 2.5))]
    )
    portfolio = SeedPortfolio(problem, [8, 9], options=QUICK)
    assert not list(portfolio.improve(0.5))
    for seed in (8, 9):
        assert f"seed {seed}: " in portfolio.explain()
        assert portfolio.reports[seed].counts["collision_checks"] > 0, "it has planned"
    assert "cut short" not in portfolio.explain()


def test_a_plan_that_costs_nothing_ends_it(address: str, tmp_path: Path) -> None:
    portfolio = SeedPortfolio(arena(tmp_path, {"a": (0, 0)}, {"a": (0, 0)}), [0], scheduler=address)
    began = time.monotonic()
    assert [plan.cost for plan in portfolio.improve(600.0)] == [0.0]
    assert time.monotonic() - began < 60.0


@pytest.mark.parametrize("seeds", [[], [1, 1]])
def test_seeds_are_different(seeds: list[int], tmp_path: Path) -> None:
    with pytest.raises(MrtampError, match="expected at least one, all different"):
        SeedPortfolio(detour(tmp_path), seeds)


def test_settings_are_those_of_the_planner_and_refused_before_any_worker_starts(tmp_path: Path) -> None:
    problem = detour(tmp_path)
    portfolio = SeedPortfolio(problem, [0], planner="composed-prm", options={"batch": 7})
    assert portfolio.options == ComposedOptions(batch=7)
    assert SeedPortfolio(problem, [0]).options == Options()
    with pytest.raises(MrtampError, match="composed-prm has no initial_vertices; choose from batch"):
        SeedPortfolio(problem, [0], planner="composed-prm", options=QUICK)


# On the command line.


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scheduler", "tcp://127.0.0.1:8786"], "found --scheduler without --portfolio N"),
        (["--portfolio", "0"], "--portfolio: found '0', expected a whole number from 1"),
        (["--portfolio", "1", "--scheduler", "nowhere"], "--scheduler: 'nowhere' .*expected the address of a running"),
    ],
)
def test_wrong_arguments(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    import re

    try:
        code = main(["plan", "square_free", *arguments])
    except SystemExit as end:
        code = int(str(end.code))
    assert code == 2
    assert re.search(message, capsys.readouterr().err)


def test_ctrl_c_keeps_the_best_plan(tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    (tmp_path / "problem.yaml").write_text(json.dumps(problem_to_dict(detour(tmp_path))))
    seeds = ["--portfolio", "1", "--seed", "6"]
    command = [sys.executable, "-m", "mrtamp", "plan", str(tmp_path / "problem.yaml"), *seeds]
    process = subprocess.Popen(
        [*command, "--budget", "600", "--out", str(out), "--html", str(tmp_path / "plan.html")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr is not None
    complaints = []
    timer = threading.Timer(60, process.kill)
    timer.start()
    for line in process.stderr:
        complaints.append(line)
        if "improving: cost" in line:
            os.killpg(process.pid, signal.SIGINT)
            break
    said, rest = process.communicate(timeout=30)
    timer.cancel()
    assert process.returncode == 0, "".join(complaints) + rest
    assert "stopped; the best plan so far, checked (seed" in said
    assert "best of seed 6" in said
    assert "Traceback" not in rest
    assert check_plan(Plan.load(out)).ok
    assert (tmp_path / "plan.html").exists()
