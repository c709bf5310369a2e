"""Suites are run: every run once, kills and limits survived, the same on workers as without."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest

from mrtamp.bench import measured
from mrtamp.bench.execute import Progress, duration, execute, expected_s
from mrtamp.bench.measured import run_assignment
from mrtamp.bench.records import Record, Times, read_records, records_file
from mrtamp.bench.run import Point, apart
from mrtamp.bench.suite import Assignment, load_suite
from mrtamp.bench.table import Line
from mrtamp.cli import main

TINY = """\
mrtamp_suite: 1
name: tiny
table: main
seeds: {seeds}
limit: {limit}
problems: [{{problem: square_free}}]
planners: [{{planner: guided}}]
"""


def write(folder: Path, seeds: int, limit: float) -> str:
    file = folder / "tiny.yaml"
    file.write_text(TINY.format(seeds=seeds, limit=limit), encoding="utf-8")
    return str(file)


def quiet() -> Line:
    return Line(io.StringIO(), lambda text: None)


def nothing(text: str) -> None: ...


# -- one run ---------------------------------------------------------------------------------------------------------


def test_a_run_records_what_it_took(tmp_path: Path) -> None:
    [assignment] = load_suite(write(tmp_path, 1, 4.0)).assignments()
    environment = dict(os.environ)
    began = time.monotonic()
    told: list[str] = []
    record = run_assignment(assignment, told.append)
    elapsed = time.monotonic() - began
    assert record.error is None and record.refused == () and record.first is not None and record.final is not None
    # The optimum of this problem, see `mrtamp bench optimum`.
    assert record.final.cost == pytest.approx(4.06, abs=0.01)
    assert 0 < record.first_counts["collision_checks"] <= record.counts["collision_checks"]
    assert "ik_calls" in record.counts
    times = record.times
    assert times is not None and 3.9 <= times.planning <= times.wall <= elapsed
    assert times.start > 0 and times.start + times.planning + times.judging <= times.wall + 1e-6
    assert record.first.time_s <= times.planning and 0 < times.cpu <= 1.5 * times.wall
    assert record.peak_mb is not None and record.peak_mb > 50
    assert record.machine is not None and record.machine.cores >= 1 and record.machine.drake in record.machine.text()
    assert told[0] == "planning" and "judging" in told
    assert dict(os.environ) == environment


def _hang(assignment: Assignment, tell: Callable[[str], None]) -> Record:
    tell("planning")
    while True:
        tell("still here")
        time.sleep(0.05)


def _die(assignment: Assignment, tell: Callable[[str], None]) -> Record:
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def _fail(assignment: Assignment, tell: Callable[[str], None]) -> Record:
    raise ValueError("it fell over")


@pytest.mark.parametrize(
    ("what", "words"), [(_hang, "planning took more than 0.4 s"), (_die, "killed by SIGKILL"), (_fail, "it fell over")]
)
def test_whatever_goes_wrong_in_a_run_is_in_its_record(
    what: Callable, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measured, "plan_assignment", what)
    monkeypatch.setattr(measured, "OVERRUN_S", 0.2)
    [assignment] = load_suite(write(tmp_path, 1, 0.2)).assignments()
    record = run_assignment(assignment, nothing)
    assert record.error is not None and words in record.error
    assert record.first is None and record.times is None and record.key == assignment.key


def _threads(tell: Callable[[str], None]) -> dict[str, str | None]:
    return {name: os.environ.get(name) for name in ("SET_BEFORE", "SET_FOR_IT", "SET_FOR_BOTH")}


def test_a_run_has_variables_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SET_BEFORE", "before")
    monkeypatch.setenv("SET_FOR_BOTH", "before")
    before = dict(os.environ)
    its_own = {"SET_FOR_IT": "1", "SET_FOR_BOTH": "2"}
    # Runs of several threads, as on a worker that takes more than one at a time.
    with ThreadPoolExecutor(3) as executor:
        runs = [executor.submit(apart, _threads, tell=nothing, environment=its_own) for _ in range(3)]
    assert [run.result() for run in runs] == [{"SET_BEFORE": "before", **its_own}] * 3
    assert dict(os.environ) == before


def test_the_plans_that_count_are_judged() -> None:
    """The first and the cheapest within the limit, whatever comes after it."""
    plans: list[Any] = ["first", "cheapest", "worse", "late"]
    points = [Point(t, cost, 1.0, 1.0) for t, cost in ((1.0, 9.0), (2.0, 7.0), (3.0, 8.0), (5.0, 6.0))]
    assert measured._that_count(plans, points, 4.0) == ["first", "cheapest"]
    assert measured._that_count(plans, points, 1.5) == ["first"]
    assert measured._that_count(plans, points, 0.5) == []


_ORPHAN = """
import sys, time
from mrtamp.bench.run import apart
from tests_orphan import busy

if __name__ == "__main__":
    apart(busy, tell=lambda text: print(text, flush=True))
"""
_BUSY = """
import os, time

def busy(tell):
    while True:
        tell(str(os.getpid()))
        time.sleep(0.05)
"""


def test_a_run_ends_when_nobody_waits_for_it_any_more(tmp_path: Path) -> None:
    (tmp_path / "tests_orphan.py").write_text(_BUSY, encoding="utf-8")
    (tmp_path / "script.py").write_text(_ORPHAN, encoding="utf-8")
    process = subprocess.Popen([sys.executable, "script.py"], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    run = psutil.Process(int(process.stdout.readline()))
    process.kill()
    process.wait()
    process.stdout.close()
    run.wait(timeout=10)


def test_patience_counts_from_the_beginning_of_each_part(tmp_path: Path) -> None:
    assert apart(_parts, tell=nothing, patience={"": 60, "one": 0.6, "two": 0.6}) == "done"


def _parts(tell: Callable[[str], None]) -> str:
    for name in ("one", "two"):
        tell(name)
        time.sleep(0.4)
    return "done"


# -- a suite ---------------------------------------------------------------------------------------------------------


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "mrtamp", "bench", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def lines(file: Path) -> list[bytes]:
    return file.read_bytes().splitlines(keepends=True) if file.exists() else []


def test_a_suite_that_is_killed_goes_on_where_it_was(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    suite, out = write(tmp_path, 3, 0.8), tmp_path / "out"
    file = records_file(out)
    process = start(suite, "--out", str(out))
    try:
        give_up = time.monotonic() + 60
        while len(lines(file)) < 2:
            assert process.poll() is None and time.monotonic() < give_up
            time.sleep(0.02)
    finally:
        process.kill()
        process.communicate()
    kept = b"".join(lines(file)[:2])
    # What a kill in the middle of writing leaves behind.
    file.write_bytes(kept + b'{"key": "square_free, gui')
    assert main(["bench", suite, "--out", str(out)]) == 0
    assert file.read_bytes().startswith(kept)
    loaded, records = read_records(out)
    assert [record.key for record in records] == [assignment.key for assignment in loaded.assignments()]
    printed = capsys.readouterr().out
    assert "/3 " in printed and f" to {out}" in printed
    # Nothing is left to do.
    began, before = time.monotonic(), file.read_bytes()
    assert main(["bench", suite, "--out", str(out)]) == 0
    assert file.read_bytes() == before and time.monotonic() - began < 10
    # Something else is asked for.
    assert main(["bench", suite, "--out", str(out), "--seeds", "4"]) == 2
    assert "3 seeds there, 4 here" in capsys.readouterr().err
    assert file.read_bytes() == before


def test_ctrl_c_keeps_what_was_finished_and_reports_it(tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = start(write(tmp_path, 9, 0.5), "--out", str(out))
    try:
        give_up = time.monotonic() + 60
        while len(lines(records_file(out))) < 2:
            assert process.poll() is None and time.monotonic() < give_up
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 1 and "Traceback" not in stderr
    assert "the same command goes on from here" in stdout and (out / "report.md").exists()
    assert 1 <= len(read_records(out)[1]) < 9


def test_workers_do_the_same_runs(tmp_path: Path) -> None:
    suite = load_suite(write(tmp_path, 2, 0.5))
    assert execute(suite, tmp_path, quiet(), workers=2) == []
    records = read_records(tmp_path)[1]
    assert {record.key for record in records} == {assignment.key for assignment in suite.assignments()}
    assert all(record.times is not None and record.times.planning >= 0.5 for record in records)


def runs_of(worker: psutil.Process) -> list[psutil.Process]:
    """Runs are children of workers, which are children of the harness; a worker that starts has other children."""
    with suppress(psutil.NoSuchProcess):
        return [child for child in worker.children() if any("spawn_main" in part for part in child.cmdline())]
    return []


def test_a_worker_that_is_killed_costs_only_its_run(tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = start(write(tmp_path, 3, 1.5), "--out", str(out), "--workers", "2")
    try:
        harness, give_up = psutil.Process(process.pid), time.monotonic() + 60
        busy: list[psutil.Process] = []
        while len(busy) < 2:  # before both are, one may still be starting
            assert process.poll() is None and time.monotonic() < give_up
            time.sleep(0.1)
            busy = [worker for worker in harness.children() if runs_of(worker)]
        orphans = busy[0].children()
        busy[0].kill()
        _, stderr = process.communicate(timeout=60)
        assert psutil.wait_procs(orphans, timeout=10)[1] == []
    finally:
        process.kill()
    assert process.returncode == 0, stderr
    assert sorted(record.seed for record in read_records(out)[1]) == [0, 1, 2]


def test_only_what_is_wanted_is_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    suite = load_suite(write(tmp_path, 3, 0.5))
    execute(suite, tmp_path, quiet(), wanted=lambda assignment: assignment.seed == 1)
    assert [record.seed for record in read_records(tmp_path)[1]] == [1]
    assert main(["bench", write(tmp_path, 3, 0.5), "--out", str(tmp_path), "--only", "seed 7"]) == 2
    assert "--only: found 'seed 7'" in capsys.readouterr().err


def test_failed_runs_are_run_again_only_when_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    suite = load_suite(write(tmp_path, 2, 0.5))
    with monkeypatch.context() as patch:
        patch.setattr(measured, "plan_assignment", _fail)
        execute(suite, tmp_path, quiet(), wanted=lambda assignment: assignment.seed == 1)
    execute(suite, tmp_path, quiet())
    assert [(r.seed, r.error is None) for r in read_records(tmp_path)[1]] == [(1, False), (0, True)]
    execute(suite, tmp_path, quiet(), again=True)
    assert [(r.seed, r.error is None) for r in read_records(tmp_path)[1]] == [(1, True), (0, True)]
    assert len(lines(records_file(tmp_path))) == 4


def test_time_left_counts_what_runs_have_behind_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, shown = 100.0, list[str]()
    monkeypatch.setattr(time, "monotonic", lambda: now)
    line = quiet()
    monkeypatch.setattr(line, "show", shown.append)
    ahead = list(load_suite(write(tmp_path, 4, 10.0)).assignments())
    progress = Progress(ahead, 2, 2, line)
    # Twelve seconds each as long as none is known.
    assert progress.left() == pytest.approx(4 * 12 / 2)
    for run in ahead[:2]:
        progress.tell(run.key, "starting")
    now += 9.0
    assert progress.left() == pytest.approx((2 * 3 + 2 * 12) / 2)
    times = Times(start=0.5, planning=10.0, judging=0.3, wall=11.0, cpu=10.0)
    progress.finished(replace(measured.blank(ahead[0]), times=times))
    assert shown[-1].startswith("3/6 runs, 12 s left; ") and progress.left() == pytest.approx((2 + 2 * 11) / 2)
    progress.lost(ahead[1].key)
    progress.finished(replace(measured.blank(ahead[2]), times=times))
    # The last run has one worker to itself, and the other worker does not make it any shorter.
    assert shown[-1].startswith("4/5 runs, 11 s left; ")
    progress.tell(ahead[3].key, "starting")
    now += 4.0
    assert progress.left() == pytest.approx(7.0)


def test_runs_that_are_not_wanted_are_not_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    line = quiet()
    monkeypatch.setattr(line, "show", shown.append)
    monkeypatch.setattr(measured, "plan_assignment", _fail)
    suite = load_suite(write(tmp_path, 3, 0.5))
    execute(suite, tmp_path, quiet(), wanted=lambda assignment: assignment.seed == 0)
    execute(suite, tmp_path, line, wanted=lambda assignment: assignment.seed == 1)
    assert shown[0].startswith("0/1 runs, ") and shown[-1].startswith("1/1 runs, ")


def test_time_to_wait(tmp_path: Path) -> None:
    assert expected_s(load_suite(write(tmp_path, 3, 10.0))) == pytest.approx(36.0)
    assert [duration(s) for s in (5, 600, 7200)] == ["5 s", "10 min", "2.0 h"]
    assert duration(10_000) == "2.8 h"
