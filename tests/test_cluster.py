"""Tasks on workers: results, errors, workers that are killed, schedulers found by address, and nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import errands
import pytest

from mrtamp import cluster, workers
from mrtamp.cluster import Outcome, Pool, link, pool
from mrtamp.problem import MrtampError


@pytest.fixture(scope="module")
def two() -> Iterator[Pool]:
    """Two workers of this machine, shared by the tests that do not lose any of them."""
    with pool(None, 2) as made:
        yield made


def soon(condition: Callable[[], bool], limit_s: float = 10.0) -> bool:
    """Whether the condition comes true within the limit."""
    end = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended but was not waited for does not."""
    import psutil

    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_values_come_back_with_what_was_told_before(two: Pool) -> None:
    heard: dict[str, int] = {}
    outcomes = []
    for outcome in two.run(errands.square, ((f"square of {x}", (x,)) for x in range(7)), hear=heard.__setitem__):
        assert heard[outcome.key] == {"square": outcome.value}, "what a task tells arrives before its end"
        outcomes.append(outcome)
    assert sorted(outcomes, key=lambda o: o.key) == [Outcome(f"square of {x}", x * x, None, 1) for x in range(7)]


def test_tasks_run_side_by_side_and_end_in_their_own_order(two: Pool) -> None:
    assert two.size == 2
    began = time.monotonic()
    assert [o.key for o in two.run(time.sleep, [("long", (1.0,)), ("short", (0.3,))])] == ["short", "long"]
    assert time.monotonic() - began < 1.25


def test_tasks_are_asked_for_as_workers_become_free(two: Pool) -> None:
    asked = []

    def tasks() -> Iterator[tuple[str, tuple[int]]]:
        for x in range(20):
            asked.append(x)
            yield str(x), (x,)

    run = two.run(errands.square, tasks())
    next(run)
    assert len(asked) <= 1 + two.size
    run.close()


def test_an_error_stops_nobody_else(two: Pool) -> None:
    by_key = {o.key: o for o in two.run(errands.reciprocal, [(str(x), (x,)) for x in range(3)])}
    assert (by_key["1"].value, by_key["2"].value) == (1.0, 0.5)
    failed = by_key["0"]
    assert failed.value is None
    assert failed.attempts == 1, "an error is no lost worker"
    assert failed.error is not None
    assert failed.error.startswith("ZeroDivisionError: division by zero")
    assert "in reciprocal" in failed.error, "the traceback says where"


def test_a_value_that_cannot_travel_is_an_error(two: Pool) -> None:
    (outcome,) = two.run(errands.lock, [("lock", ())])
    assert outcome.value is None
    assert outcome.error is not None
    assert "pickle" in outcome.error


def test_whoever_stops_asking_cancels_what_runs(two: Pool, tmp_path: Path) -> None:
    heard: list[str] = []
    run = two.run(errands.until_cancelled, [("one", (str(tmp_path),))], hear=lambda _, text: heard.append(text))
    with pytest.raises(KeyboardInterrupt):
        for _ in interrupted(run, lambda: bool(heard)):
            pass
    assert soon((tmp_path / "cancelled").exists)
    assert {o.value for o in two.run(errands.square, [("after", (3,))])} == {9}, "the workers are still there"


def interrupted(run: Iterator[Outcome], when: Callable[[], bool]) -> Iterator[Outcome]:
    """The run, with a Ctrl-C from outside as soon as something is true."""
    import threading

    main = threading.main_thread().ident
    assert main is not None
    killer = threading.Thread(target=lambda: soon(when) and signal.pthread_kill(main, signal.SIGINT))
    killer.start()
    try:
        yield from run
    finally:
        killer.join()


def test_outside_of_any_pool_nobody_listens() -> None:
    assert errands.square(3) == 9
    assert not link().cancelled


def test_a_killed_worker_costs_only_its_task(tmp_path: Path) -> None:
    tasks = [(name, (str(tmp_path), name, 1 if name == "b" else 0)) for name in "abcdef"]
    with pool(None, 2) as made:
        by_key = {o.key: o for o in made.run(errands.noted, tasks)}
        assert {key: (o.value, o.error, o.attempts) for key, o in by_key.items()} == {
            key: (2 if key == "b" else 1, None, 2 if key == "b" else 1) for key in "abcdef"
        }
        assert soon(lambda: made.size == 2), "there is a new worker in place of the old one"


def test_a_task_that_always_kills_its_worker_is_given_up(tmp_path: Path) -> None:
    """The only worker dies again and again, and the pool goes on."""
    tasks = [("deadly", (str(tmp_path), "deadly", 99)), ("harmless", (str(tmp_path), "harmless", 0))]
    with pool(None, 1) as made:
        deadly, harmless = made.run(errands.noted, tasks, retries=1)
    assert (harmless.value, harmless.attempts) == (1, 1)
    assert (deadly.key, deadly.value, deadly.attempts) == ("deadly", None, 2)
    assert deadly.error is not None
    assert "its worker was lost" in deadly.error
    assert (tmp_path / "deadly").read_text() == "xx"


def test_no_process_outlives_the_pool(tmp_path: Path) -> None:
    """Ctrl-C for the whole group, as a terminal sends it: the tasks' own processes go, too, and nothing complains."""
    program = """
import errands, sys
from mrtamp.cluster import pool
if __name__ == "__main__":
    try:
        with pool(None, 2) as made:
            list(made.run(errands.with_child, [(name, (sys.argv[1], name)) for name in "ab"]))
    except KeyboardInterrupt:
        print("stopped")
"""
    (tmp_path / "program.py").write_text(program)
    environment = {**os.environ, "PYTHONPATH": str(Path(errands.__file__).parent)}
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "program.py"), str(tmp_path)],
        env=environment,
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    import psutil

    files = [tmp_path / name for name in "ab"]
    assert soon(lambda: all(f.exists() and f.read_text() for f in files), 30), "the tasks' processes do not start"
    started = [p.pid for p in psutil.Process(process.pid).children(recursive=True)]
    assert {int(f.read_text()) for f in files} < set(started)
    os.killpg(process.pid, signal.SIGINT)
    out, complaints = process.communicate(timeout=20)
    assert (process.returncode, out, complaints) == (0, "stopped\n", "")
    assert soon(lambda: not any(map(alive, started)))


def test_a_process_of_a_task_ends_with_its_worker(tmp_path: Path) -> None:
    with pool(None, 1) as made:
        run = made.run(errands.with_child, [("a", (str(tmp_path), "a"))], retries=0)
        pids: list[int] = []

        def kill_worker() -> bool:
            file = tmp_path / "a"
            if not (file.exists() and file.read_text()):
                return False
            pids.extend(made.client.run(os.getpid).values())
            os.kill(pids[0], signal.SIGKILL)
            return True

        import threading

        killer = threading.Thread(target=soon, args=(kill_worker, 20))
        killer.start()
        (outcome,) = run
        killer.join()
    assert outcome.error is not None
    child = int((tmp_path / "a").read_text())
    assert soon(lambda: not alive(child))


# A scheduler that was there before.


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """A scheduler with one worker, which knows nothing of us."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        host="127.0.0.1",
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
        silence_logs=100,
    ) as running:
        yield running.scheduler_address


def test_a_scheduler_is_used_by_its_address(address: str, tmp_path: Path) -> None:
    tasks = [(name, (str(tmp_path), name, 2 if name == "a" else 0)) for name in "ab"]
    with pool(address) as made:
        by_key = {o.key: (o.value, o.attempts) for o in made.run(errands.noted, tasks, retries=5)}
    assert by_key == {"a": (3, 3), "b": (1, 1)}
    with pool(address) as made:
        assert [o.value for o in made.run(errands.square, [("again", (4,))])] == [16], "it is still there afterwards"


def test_other_patience_of_the_scheduler_changes_nothing(address: str, tmp_path: Path) -> None:
    """Dask by itself gives up after the fourth loss."""
    with pool(address) as made:
        (outcome,) = made.run(errands.noted, [("a", (str(tmp_path), "a", 5))], retries=6)
    assert (outcome.value, outcome.error, outcome.attempts) == (6, None, 6)


def test_other_versions_are_refused(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from distributed import Client

    true_versions = Client.get_versions

    def altered(client: Client, **arguments: object) -> dict:
        found: dict = true_versions(client, **arguments)
        for worker in found["workers"].values():
            worker["packages"] |= {"mrtamp": None, "drake": "0.9", "python": "3.1.4.final.0", "lz4": "0"}
        return found

    monkeypatch.setattr(Client, "get_versions", altered)
    here = f"{sys.version_info.major}.{sys.version_info.minor}"
    with pytest.raises(MrtampError, match=f"has python 3.1 instead of {here}, mrtamp missing instead of .*, drake 0.9"):
        pool(address).__enter__()


def test_a_scheduler_without_workers_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from distributed import LocalCluster

    monkeypatch.setattr(workers, "CONNECT_S", 0.5)
    options = {"dashboard_address": "127.0.0.1:0"}
    with (
        LocalCluster(n_workers=0, host="127.0.0.1", scheduler_kwargs=options, silence_logs=100) as empty,
        pytest.raises(MrtampError, match=f"{empty.scheduler_address} has no workers; start some with: dask worker"),
    ):
        pool(empty.scheduler_address).__enter__()


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ("tcp://127.0.0.1:1", "does not answer"),
        ("somewhere", "missing port"),
        ("smoke://127.0.0.1:8786", "unknown address scheme"),
    ],
)
def test_an_address_where_nobody_answers(wrong: str, reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "CONNECT_S", 0.5)
    with pytest.raises(MrtampError, match=f"--scheduler: '{wrong}' .*{reason}.*, expected the address of a running"):
        pool(wrong).__enter__()


def test_a_worker_is_no_scheduler(address: str) -> None:
    with pool(address) as made:
        (worker,) = made.client.nthreads()
    with pytest.raises(MrtampError, match="is a worker, expected the address of a running Dask scheduler"):
        pool(worker).__enter__()


def test_a_scheduler_that_goes_is_missed() -> None:
    from distributed import LocalCluster

    options = {"dashboard_address": "127.0.0.1:0"}
    running = LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", scheduler_kwargs=options, silence_logs=100
    )
    with pool(running.scheduler_address) as made:
        run = made.run(time.sleep, [("a", (0.0,)), ("b", (30.0,))])
        assert next(run).key == "a"
        running.close()
        with pytest.raises(MrtampError, match=r"the connection to the scheduler .* (is|was) lost"):
            next(run)


def test_without_dask_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MrtampError, match=r"pip install 'mrtamp\[cluster\]'"):
        pool(None, 1).__enter__()


def test_at_least_one_worker() -> None:
    with pytest.raises(MrtampError, match="found workers=0, expected a whole number from 1"):
        pool(None, 0).__enter__()


def test_the_environment_stays_as_it_was() -> None:
    before = dict(os.environ)
    with pool(None, 1):
        pass
    assert dict(os.environ) == before
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_all_workers_gone_for_good(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "NO_WORKERS_S", 0.5)
    monkeypatch.setattr(Pool, "size", 0)
    with pool(address) as made, pytest.raises(MrtampError, match=r"has had no worker for 0\.5 s"):
        list(made.run(errands.square, [("a", (1,))]))
