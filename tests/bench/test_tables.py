"""Measurements: runs have processes of their own, what went wrong is not hidden, and the best known only gets lower."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.popen_spawn_posix import Popen
from pathlib import Path

import numpy as np
import pytest

from mrtamp.bench import costs as costs_module
from mrtamp.bench import endurance as endurance_module
from mrtamp.bench import first
from mrtamp.bench.best import Best, BestKnown, best_known_file
from mrtamp.bench.costs import COSTS, CostRow, Job, cost_row, costs
from mrtamp.bench.endurance import course, endurance, endurance_row, growth, sampled
from mrtamp.bench.run import Point, Run, Stopped, Task, apart, measure, pick_place
from mrtamp.bench.table import Line
from mrtamp.problem import MrtampError

EASY = Task("square_free")
FLOW = (Point(0.5, 12.0, 8.0, 14.0), Point(2.0, 11.0, 7.0, 13.0), Point(9.0, 10.5, 6.0, 12.0))


class Screen:
    """A stream that is no terminal."""

    def __init__(self) -> None:
        self.text = ""

    def isatty(self) -> bool:
        return False

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None: ...


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def line(said: list[str]) -> Line:
    return Line(Screen(), said.append)  # type: ignore[arg-type]


def run(points: tuple[Point, ...] = FLOW, **changes) -> Run:
    memory = tuple((float(t), 200.0 + 0.1 * t) for t in range(1, 61))
    return Run(
        **{"name": "some", "seed": 0, "budget_s": 60.0, "points": points, "memory": memory} | changes, peak_mb=210
    )


# -- first plans -----------------------------------------------------------------------------------------------------


def test_a_row_is_measured_and_printed(monkeypatch: pytest.MonkeyPatch, line: Line, said: list[str]) -> None:
    monkeypatch.setattr(first, "start_to_exit", lambda: 1.0)
    assert first.first_plans(1, [first.Row(Task("box"), 60.0, "10 s")], line)
    assert "| box | 1/1 |" in "\n".join(said)


def test_a_row_without_a_plan_counts_as_the_whole_budget(
    monkeypatch: pytest.MonkeyPatch, line: Line, said: list[str]
) -> None:
    monkeypatch.setattr(first, "start_to_exit", lambda: 1.0)
    monkeypatch.setattr(first, "FIRST_BUDGET_S", 0.0)
    assert not first.first_plans(1, [first.Row(Task("stacking"), 60.0, "-")], line)
    assert "| stacking | 0/1 | 0.00 s | - | 60 s | - |" in "\n".join(said)


def test_the_rows_are_the_tasks_of_the_paper() -> None:
    names = [row.name for row in first.FIRST]
    assert names[:4] == ["box", "handover", "stacking", "pick_place 2/2"] and names[-1] == "pick_place 8/24"


# -- runs ------------------------------------------------------------------------------------------------------------


def test_a_run_knows_its_whole_curve_and_was_checked_from_files(line: Line) -> None:
    found = measure(EASY, 3, 4.0, line)
    assert found.name == "square_free" and found.seed == 3 and found.points and found.flawless and not found.stopped
    assert found.first is not None and found.best is not None and found.best.cost >= 4.06 - 1e-3
    assert found.best.cost == pytest.approx(found.best.makespan + 0.01 * found.best.path_length)
    assert found.peak_mb > 20
    assert json.loads(json.dumps(found.as_dict()))["points"][-1]["cost"] == found.best.cost


def test_the_incumbent_at_a_time() -> None:
    assert [run().cost_at(t) for t in (0.1, 0.5, 5.0, 9.0, 99.0)] == [math.inf, 12.0, 11.0, 10.5, 10.5]
    assert run().never_rises
    assert not run((*FLOW, Point(10.0, 10.6, 6.0, 12.0))).never_rises
    assert not run(refused=("the plan of cost 9: an arm is in the table",)).flawless


def _fail(tell: Callable[[str], None]) -> None:
    tell("about to fail")
    raise ValueError("it fell over")


def _interrupt_me(tell: Callable[[str], None]) -> str:
    try:
        tell("running")
        time.sleep(60)
    except KeyboardInterrupt:
        return "what there was"
    return "slept through it"


def _interrupted(text: str) -> None:
    if text == "running":
        raise KeyboardInterrupt


def test_failures_in_another_process_arrive_with_their_traceback() -> None:
    told: list[str] = []
    with pytest.raises(RuntimeError, match="it fell over"):
        apart(_fail, tell=told.append)
    assert told == ["about to fail"]


@pytest.mark.parametrize(("salvage", "kept"), [(True, "what there was"), (False, None)])
def test_a_stopped_run_hands_over_what_it_has_when_asked_to(salvage: bool, kept: str | None) -> None:
    began = time.monotonic()
    with pytest.raises(Stopped) as stop:
        apart(_interrupt_me, tell=_interrupted, salvage=salvage)
    assert stop.value.run == kept and time.monotonic() - began < 30


def test_a_process_that_is_being_made_is_told_what_to_do_before_a_signal_counts(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A signal between the making of the process and the sending of its task leaves no broken process behind."""
    made = Popen._launch

    def launch(self: Popen, process: object) -> None:
        signal.raise_signal(signal.SIGINT)
        made(self, process)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Popen, "_launch", launch)
    with pytest.raises(KeyboardInterrupt):
        apart(_fail, tell=lambda text: None)
    assert "Traceback" not in capfd.readouterr().err


def test_progress_appears_after_two_seconds_on_a_stream_that_is_no_terminal() -> None:
    screen = Screen()
    with Line(screen) as line:  # type: ignore[arg-type]
        line.show("box, seed 0: 1 s")
        time.sleep(2.4)
    assert screen.text.endswith("s  box, seed 0: 1 s\n")


# -- the best known --------------------------------------------------------------------------------------------------


def test_the_best_known_never_rises(tmp_path: Path) -> None:
    file = tmp_path / "best.json"
    rng = np.random.default_rng(0)
    task, other = pick_place(2, 2), Task("box")
    BestKnown(file).update(other, Best(20.0, 0, 1.0, "x"))
    least, stale = math.inf, BestKnown(file)
    for k, cost in enumerate(rng.uniform(1, 100, 60).tolist()):
        # Sometimes somebody else who read the file long ago.
        known = BestKnown(file) if k % 3 else stale
        stale = BestKnown(file) if k % 7 == 0 else known
        assert known.update(task, Best(cost, k, 1.0, "x")) == (cost < least)
        least = min(least, cost)
        assert BestKnown(file).cost(task) == known.cost(task) == least
        assert BestKnown(file).cost(other) == 20.0
    assert [p.name for p in tmp_path.iterdir()] == ["best.json"]


def test_writers_at_the_same_time_lose_nothing(tmp_path: Path) -> None:
    file = tmp_path / "best.json"

    def work(offset: int) -> None:
        for k in range(20):
            BestKnown(file).update(Task(f"problem {k}"), Best(100.0 - offset, offset, 1.0, "x"))

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {BestKnown(file).cost(Task(f"problem {k}")) for k in range(20)} == {97.0}


@pytest.mark.parametrize("cost", [math.nan, math.inf, -math.inf, 0.0, -1.0])
def test_what_is_no_cost_is_refused(cost: float, tmp_path: Path) -> None:
    known = BestKnown(tmp_path / "best.json")
    with pytest.raises(MrtampError, match="expected a positive number"):
        known.update(EASY, Best(cost, 0, 1.0, "x"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["", "[]", '{"mrtamp_best_known": 2}', '{"mrtamp_best_known": 1, "problems": [{}]}'])
def test_a_wrong_file_is_named(text: str, tmp_path: Path) -> None:
    file = tmp_path / "best.json"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(MrtampError, match=r"best\.json"):
        BestKnown(file)


def test_every_problem_has_a_best_known_cost_in_the_package() -> None:
    known = BestKnown(best_known_file())
    assert all(0 < known.cost(row.task) < math.inf for row in COSTS)
    assert known.cost(Task("pick_place", {"robots": 2, "objects": 2, "layout_seed": 0})) == known.cost(pick_place(2, 2))


# -- costs -----------------------------------------------------------------------------------------------------------


def test_costs_are_written_only_when_asked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, line: Line, said: list[str]
) -> None:
    monkeypatch.setattr(costs_module, "measure", lambda task, seed, *_: run(seed=seed))
    file = tmp_path / "best.json"
    kept: list[Run] = []
    job = Job([CostRow(EASY, {10: 0.01})], 1, BestKnown(file), "mrtamp bench costs", keep=kept.append)
    assert costs(job, [5, 10], line)
    assert not file.exists() and "not written: --update does" in "\n".join(said)
    assert costs(replace(job, known=BestKnown(file), update=True), [5, 10], line)
    [entry] = json.loads(file.read_text(encoding="utf-8"))["problems"]
    assert entry["problem"] == "square_free" and entry["command"] == "mrtamp bench costs"
    assert [r.seed for r in kept] == [0, 0] and "| square_free |" in said[1]


@pytest.mark.parametrize(
    ("best", "change", "good"),
    [
        (10.4, {}, True),
        (10.0, {}, False),
        (4.0, {}, False),
        (10.4, {"points": ()}, False),
        (10.4, {"refused": ("no",)}, False),
        (10.4, {"points": (*FLOW, Point(9.5, 10.51, 6.0, 12.0))}, False),
    ],
)
def test_every_missed_aim_counts_and_is_bold(best: float, change: dict, good: bool) -> None:
    text, ok = cost_row(CostRow(EASY, {10: 0.02}), [run(**change)], best, [10])
    assert ok is good and ("**" not in text or not good)
    assert ok or "**" in text or not change.get("points", FLOW)


def test_arms_that_move_one_at_a_time_miss_the_aim() -> None:
    assert cost_row(CostRow(EASY, {}, ratio=0.65), [run()], 10.5, [60])[1]
    assert not cost_row(CostRow(EASY, {}, ratio=0.45), [run()], 10.5, [60])[1]


def test_the_finished_seeds_stay_when_it_is_stopped(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, line: Line, said: list[str]
) -> None:
    def stopping(task: Task, seed: int, *_: object, **__: object) -> Run:
        if seed == 2:
            raise Stopped(None)
        return run(seed=seed)

    monkeypatch.setattr(costs_module, "measure", stopping)
    with pytest.raises(Stopped):
        costs(Job([CostRow(EASY)], 5, BestKnown(tmp_path / "best.json"), "x", update=True), [10], line)
    assert "| 2/2 |" in said[1] and "(written)" in said[-1]
    assert BestKnown(tmp_path / "best.json").cost(EASY) == 10.5


# -- endurance -------------------------------------------------------------------------------------------------------


def test_growth_is_told_apart_from_a_burst_at_the_start() -> None:
    steady = [(float(t), 200.0 + t / 6) for t in range(10, 610, 10)]
    assert growth(steady) == pytest.approx((10.0, 10.0))
    burst = [(float(t), 200.0 + min(t, 300) / 3) for t in range(10, 610, 10)]
    assert growth(burst) == pytest.approx((20.0, 0.0))
    assert growth([]) == (0.0, 0.0)


def test_memory_that_grows_faster_and_faster_is_seen() -> None:
    squares = tuple((float(t), 200.0 + (t / 20) ** 2) for t in range(1, 601))
    steady = tuple((float(t), 200.0 + t) for t in range(1, 601))
    assert endurance_row(run(memory=steady), 10.0)[1]
    assert not endurance_row(run(memory=squares), 10.0)[1]
    assert [t for t, _ in sampled(run(memory=steady))][:3] == [1.0, 11.0, 21.0]
    assert course(run(memory=steady, points=FLOW)).startswith("some, seed 0: 1 s: 201 MB, cost 12.000; ")


def test_a_long_run_that_is_stopped_is_still_reported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, line: Line, said: list[str]
) -> None:
    def stopping(*_: object, **__: object) -> Run:
        raise Stopped(run(stopped=True))

    monkeypatch.setattr(endurance_module, "measure", stopping)
    known = BestKnown(tmp_path / "best.json")
    with pytest.raises(Stopped):
        endurance(Job([CostRow(EASY)], 1, known, "x", update=True), 10.0, line)
    assert "1.0 min, stopped" in said[1] and BestKnown(known.file).cost(EASY) == 10.5


def test_a_short_endurance_run(tmp_path: Path, line: Line, said: list[str]) -> None:
    assert endurance(Job([CostRow(EASY)], 1, BestKnown(tmp_path / "best.json"), "x"), 5 / 60, line)
    assert "| square_free | 0 |" in said[1] and " MB, cost " in said[2]
