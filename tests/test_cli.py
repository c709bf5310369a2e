"""The command line: exit codes, what is on stdout and stderr, and what survives Ctrl-C."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

import mrtamp
from mrtamp.cli import main

EASY = ("pick_place", "--robots", "2", "--objects", "2")


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plan file made by the command line."""
    out = tmp_path_factory.mktemp("planned") / "deep" / "plan.json"
    assert main(["plan", *EASY, "--first", "--budget", "60", "--quiet", "--out", str(out)]) == 0
    return out


def test_help_does_not_wait_for_drake() -> None:
    code = (
        "import sys; from mrtamp.cli import main\ntry: main(['--help'])\nfinally: assert 'pydrake' not in sys.modules"
    )
    started = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "plan a problem" in done.stdout
    assert time.monotonic() - started < 2.0


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"mrtamp {mrtamp.__version__}\n"


def test_list_names_every_problem(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    table = capsys.readouterr().out
    assert main(["list", "--json"]) == 0
    names = json.loads(capsys.readouterr().out)
    assert set(names) >= {"box", "handover", "stacking", "pick_place"}
    assert all(name in table for name in names)


def test_plan_prints_timeline_cost_history_and_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, page = tmp_path / "plan.json", tmp_path / "plan.html"
    assert main(["plan", *EASY, "--first", "--budget", "60", "--out", str(out), "--html", str(page)]) == 0
    text = capsys.readouterr().out
    for words in (
        "plan found and checked",
        "from -> to",
        "pick",
        "place",
        "makespan",
        "incumbent",
        str(out),
        str(page),
    ):
        assert words in text
    assert mrtamp.check_plan(mrtamp.Plan.load(out)).ok
    assert "MeshCat" in page.read_text(encoding="utf-8")


def test_json_is_the_only_thing_on_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", *EASY, "--first", "--budget", "60", "--seed", "3", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["ok"] is True and data["seed"] == 3
    assert data["history"][-1]["cost"] == pytest.approx(data["cost"])
    assert {row["kind"] for row in data["timeline"]} >= {"pick", "place"}


def test_no_plan_is_exit_1_with_a_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "plan.json"
    hopeless = ("stacking", "--iterations", "1", "--without", "skeletons")
    assert main(["plan", *hopeless, "--out", str(out)]) == 1
    assert "no plan within 1 iterations" in capsys.readouterr().out
    assert not out.exists()
    assert main(["plan", *hopeless, "--json"]) == 1
    data = json.loads(capsys.readouterr().out)
    assert data["ok"] is False and "1 iterations" in data["reason"] and "explanation" in data
    assert data["seed"] == 0 and data["elapsed_s"] > 0 and data["counts"]["collision_checks"] > 0
    assert data["sampled_bound"] is None, "without skeletons nothing is known"
    assert main(["plan", *hopeless, "--quiet"]) == 1
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1


def test_check_accepts_the_plan_and_refuses_a_forged_one(planned: Path, tmp_path: Path, capsys) -> None:
    assert main(["check", str(planned)]) == 0
    assert "ok" in capsys.readouterr().out
    data = json.loads(planned.read_text(encoding="utf-8"))
    data["cost"] = 0.5 * data["cost"]
    forged = tmp_path / "forged.json"
    forged.write_text(json.dumps(data), encoding="utf-8")
    assert main(["check", str(forged), "--json"]) == 1
    verdict = json.loads(capsys.readouterr().out)
    assert verdict["ok"] is False and verdict["violations"][0]["kind"] == "cost"


def test_view_and_show_write_pages(planned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, name in ((["view", str(planned)], "plan.html"), (["show", "handover"], "problem.html")):
        page = tmp_path / "pages" / name
        assert main([*arguments, "--html", str(page)]) == 0
        assert page.stat().st_size > 1e6
        assert str(page) in capsys.readouterr().out


def test_show_warns_of_a_start_that_no_plan_can_have(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for x, warned in ((0.5, False), (-0.45, True)):
        problem = {"mrtamp": 1, "name": "near", "goal": [{"robot": "a", "at": "home"}], "robots": []}
        for name, place in (("a", -0.5), ("b", x)):
            problem["robots"].append({"name": name, "model": "panda", "X_WB": {"translation": [place, 0, 0]}})
        (tmp_path / "near.yaml").write_text(json.dumps(problem), encoding="utf-8")
        assert main(["show", str(tmp_path / "near.yaml"), "--html", str(tmp_path / "near.html")]) == 0
        said = capsys.readouterr()
        assert "wrote" in said.out
        assert ("warning: problem near: the start is not valid: a/" in said.err) == warned


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["plan", "handovr"], "handover"),
        (["plan", "nowhere.yaml"], "nowhere.yaml"),
        (["plan", "handover", "--robots", "3"], "robots"),
        (["plan", "pick_place", "--robots", "99"], "99"),
        (["plan", "handover", "--out", "/proc/nowhere/plan.json"], "/proc/nowhere/plan.json"),
        (["plan", str(Path(__file__).parent)], f"{Path(__file__).parent} is a directory"),
        (["plan", "handover", "--out", "."], "directory"),
        (["plan", "handover", "--out", "/dev/null"], "regular"),
        (["plan", "handover", "--out", "same", "--html", "same"], "same file"),
        (["plan", "handover", "--out", f"{__file__}/plan.json"], f"{__file__} is no folder"),
        (["plan", "handover", "--scheduler", "tcp://localhost:1"], "--scheduler without --portfolio"),
        (["plan", "handover", "--planner", "prioritised", "--without", "skeletons"], "prioritised has no skeletons"),
        (["plan", "handover", "--planner", "composed-prm", "--intra-orbit", "prioritised"], "guided or unguided only"),
        (["check", "nowhere.json"], "nowhere.json"),
        (["view", "nowhere.json"], "nowhere.json"),
        (["show", "nowhere"], "nowhere"),
        (["bench", "costs", "--only", "2/9"], "pick_place 2/4"),
        (["bench", "smoek"], "did you mean 'smoke'"),
        (["bench", "report", "nowhere"], "runs.jsonl"),
        (["bench", "compare", "nowhere", "a", "b"], "runs.jsonl"),
        (["bench", "smoke", "--out", __file__], f"{__file__}: cannot be written to: it is no folder"),
        (["bench", "optimum", "--only", "box"], "planar_doorway"),
        (["bench", "endurance", "--raw", "."], "directory"),
        (["bench", "optimum", "--plot", "/proc/nowhere/plot.svg"], "/proc/nowhere/plot.svg"),
    ],
)
def test_bad_input_is_exit_2_with_one_message(arguments: list[str], words: str, capsys) -> None:
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("mrtamp: ") and words in captured.err
    assert captured.err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "mrtamp: the following arguments are required: COMMAND"),
        (["plan"], "mrtamp plan: the following arguments are required: PROBLEM|FILE"),
        (["fly"], "'fly' (choose from 'list', 'plan'"),
        (["plan", "handover", "--budget", "0"], "--budget: found '0', expected a positive number of seconds"),
        (["plan", "handover", "--budget", "nan"], "--budget: found 'nan', expected a positive number"),
        (["plan", "handover", "--iterations", "-3"], "--iterations: found '-3', expected a whole number from 1"),
        (["plan", "handover", "--seed", "-1"], "--seed: found '-1', expected a whole number from 0"),
        (["plan", "handover", "--seed", "²"], "--seed: found '²', expected a whole number from 0"),
        (["plan", "handover", "--portfolio", "0"], "--portfolio: found '0', expected a whole number from 1"),
        (["plan", "handover", "--planner", "best"], "--planner: invalid choice: 'best' (choose from 'guided'"),
        (["plan", "handover", "--without", "luck"], "--without: invalid choice: 'luck' (choose from 'adoption'"),
        (["plan", "handover", "--json", "--quiet"], "--quiet: not allowed with argument --json"),
        (["plan", "handover", "--speed", "3"], "mrtamp plan: found --speed 3, which is no argument"),
        (["bench"], "mrtamp bench: the following arguments are required: SUITE; "),
        (["bench", "--out", "there", "smoke"], "found --out before SUITE, expected SUITE first"),
        (["bench", "smoke", "--workers", "2", "--scheduler", "tcp://localhost:1"], "--scheduler: not allowed with"),
        (["bench", "smoke", "--workers", "0"], "mrtamp bench smoke: --workers: found '0', expected a whole number"),
        (["bench", "smoke", "--limit", "soon"], "--limit: found 'soon', expected a positive number of seconds"),
        (["bench", "compare", "there", "guided"], "the following arguments are required: B"),
        (["bench", "costs", "--budgets", "1,x"], "--budgets: found '1,x', expected positive numbers of seconds"),
        (["bench", "costs", "--budgets", "10,0"], "--budgets: found '10,0'"),
        (["bench", "endurance", "--minutes", "0"], "--minutes: found '0', expected a positive number of minutes"),
        (["bench", "ablation", "--seeds", "1.5"], "--seeds: found '1.5', expected a whole number from 1"),
        (["bench", "optimum", "--plot", "plot.png"], "--plot: found 'plot.png', expected a file that ends in .svg"),
    ],
)
def test_wrong_arguments_are_exit_2_with_one_line(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("mrtamp") and words in captured.err
    assert captured.err.count("\n") == 1 and captured.err.endswith(" --help\n")


def test_bad_input_with_json_is_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "handovr", "--json"]) == 2
    captured = capsys.readouterr()
    assert json.loads(captured.out)["ok"] is False
    assert "handovr" in captured.err


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "mrtamp.cli", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(process: subprocess.Popen[str], words: str, limit_s: float = 40.0) -> None:
    """Read stderr until `words` appear in it."""
    assert process.stderr is not None
    give_up = time.monotonic() + limit_s
    for line in process.stderr:
        if words in line:
            return
        assert time.monotonic() < give_up, f"{words!r} did not appear"
    raise AssertionError(f"the process ended before {words!r} appeared")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_keeps_and_writes_the_incumbent(number: signal.Signals, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    process = start("plan", *EASY, "--budget", "600", "--out", str(out))
    try:
        wait_for(process, "improving: cost")
        process.send_signal(number)
        stdout, stderr = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == 0, stderr
    assert "stopped; the best plan so far, checked" in stdout
    assert mrtamp.check_plan(mrtamp.Plan.load(out)).ok
    assert list(tmp_path.iterdir()) == [out]


def test_a_signal_before_the_first_plan_is_exit_1(tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    process = start("plan", "pick_place", "--robots", "8", "--objects", "24", "--budget", "600", "--out", str(out))
    try:
        wait_for(process, " s  ")
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == 1, stderr
    assert "without a plan" in stdout
    assert "Traceback" not in stderr
    assert not out.exists()


def test_a_signal_keeps_the_rows_that_were_measured(tmp_path: Path) -> None:
    raw = tmp_path / "raw.json"
    process = start("bench", "costs", "--only", "pick_place", "--seeds", "1", "--budgets", "2", "--raw", str(raw))
    try:
        assert process.stdout is not None
        row = next(line for line in process.stdout if line.startswith("| pick_place 2/2 |"))
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == 1, stderr
    assert "| 1/1 |" in row and "stopped" in stdout and "Traceback" not in stderr
    assert [run["name"] for run in json.loads(raw.read_text(encoding="utf-8"))["runs"]] == ["pick_place 2/2"]


def test_live_window_says_where_it_is_and_ends_with_a_signal(planned: Path) -> None:
    process = start("view", str(planned))
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("open http://localhost:")
        with urllib.request.urlopen(line.split()[1], timeout=10) as page:
            assert b"MeshCat" in page.read()
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == 0, stderr
    assert "Traceback" not in stderr


def test_a_closed_pipe_is_not_an_error() -> None:
    command = f"{sys.executable} -m mrtamp.cli list | head -c 1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    assert done.stderr == ""
