"""Raw records: what is on the disk stays, half lines go, suites are not mixed, two writers do not meet."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest

from mrtamp.bench.machine import this_machine
from mrtamp.bench.records import Record, Records, Times, read_records, records_file
from mrtamp.bench.run import Point
from mrtamp.bench.suite import Case, Entrant, Suite, suite_to_dict
from mrtamp.problem import MrtampError

SUITE = Suite("some", "", "main", (Case("box", 10.0),), (Entrant("guided", "guided"),), (0, 1, 2))


def record(seed: int = 0, **changes) -> Record:
    return Record(
        **{
            "key": f"box, guided, seed {seed}",
            "case": "box",
            "parameters": {},
            "planner": "guided",
            "seed": seed,
            "limit_s": 10.0,
            "points": (Point(1.0, 9.0, 8.0, 10.0), Point(4.0, 7.0, 6.0, 9.0), Point(10.5, 5.0, 4.0, 8.0)),
            "first_counts": {"collision_checks": 100, "ik_calls": 7},
            "counts": {"collision_checks": 900, "ik_calls": 70},
            "times": Times(1.0, 10.5, 0.2, 11.9, 11.0),
            "peak_mb": 200.0,
            "machine": this_machine(),
        }
        | changes
    )


def test_records_come_back_as_they_were(tmp_path: Path) -> None:
    runs = [record(0), record(1, points=(), times=None, error="killed"), record(2, refused=("an arm is in the table",))]
    with Records(tmp_path / "new", SUITE) as file:
        for run in runs:
            file.add(run)
    assert read_records(tmp_path / "new") == (SUITE, runs)


def test_plans_after_the_limit_and_of_wrong_runs_do_not_count() -> None:
    assert [p.cost for p in record().curve] == [9.0, 7.0]
    assert record().final == record().points[1]
    assert [record().cost_at(t) for t in (0.5, 1.0, 5.0, 99.0)] == [math.inf, 9.0, 7.0, 7.0]
    for wrong in (record(refused=("no",)), record(error="killed")):
        assert wrong.first is None and wrong.final is None and wrong.cost_at(9.0) == math.inf
    assert record(limit_s=0.5).first is None


def test_half_a_line_is_read_over_and_replaced(tmp_path: Path) -> None:
    with Records(tmp_path, SUITE) as file:
        file.add(record(0))
    whole = records_file(tmp_path).read_bytes()
    with Records(tmp_path, SUITE) as file:
        file.add(record(1))
    second = records_file(tmp_path).read_bytes()[len(whole) :]
    for length in (0, 1, len(second) // 2, len(second) - 1):
        records_file(tmp_path).write_bytes(whole + second[:length])
        assert [r.seed for r in read_records(tmp_path)[1]] == [0]
        with Records(tmp_path, SUITE) as file:
            assert [r.seed for r in file.done] == [0]
            file.add(record(1))
        assert records_file(tmp_path).read_bytes() == whole + second


def test_a_kill_while_the_first_line_is_written_is_no_harm(tmp_path: Path) -> None:
    records_file(tmp_path).write_bytes(b'{"mrtamp_bench": 1, "sui')
    with Records(tmp_path, SUITE) as file:
        file.add(record(0))
    assert read_records(tmp_path) == (SUITE, [record(0)])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seeds": (0, 1)}, "3 seeds there, 2 here"),
        ({"table": "ablation"}, "'main' there, 'ablation' here"),
        ({"cases": (Case("box", 20.0),)}, "10.0.* there, .*20.0"),
    ],
)
def test_records_of_another_suite_are_refused_and_left_alone(change: dict, words: str, tmp_path: Path) -> None:
    with Records(tmp_path, SUITE) as file:
        file.add(record(0))
    before = records_file(tmp_path).read_bytes()
    with pytest.raises(MrtampError, match=words), Records(tmp_path, dataclasses.replace(SUITE, **change)):
        pass
    assert records_file(tmp_path).read_bytes() == before


def test_two_do_not_add_at_the_same_time(tmp_path: Path) -> None:
    with Records(tmp_path, SUITE), pytest.raises(MrtampError, match="another"), Records(tmp_path, SUITE):
        pass
    with Records(tmp_path, SUITE):
        pass


@pytest.mark.parametrize("line", [b"nonsense", b"[]", b'{"key": "box"}'])
def test_a_wrong_line_is_named(line: bytes, tmp_path: Path) -> None:
    with Records(tmp_path, SUITE) as file:
        file.add(record(0))
    with records_file(tmp_path).open("ab") as stream:
        stream.write(line + b"\n")
    with pytest.raises(MrtampError, match=r"runs\.jsonl:3"):
        read_records(tmp_path)


SCALABILITY = json.dumps({"mrtamp_bench": 1, "suite": suite_to_dict(SUITE) | {"table": "scalability"}}).encode()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, r"found no runs\.jsonl in"),
        (b"", r"runs\.jsonl:1: found no mrtamp_bench: 1"),
        (b'{"mrtamp_bench": 7}', r"runs\.jsonl:1: found no mrtamp_bench: 1"),
        (b'{"mrtamp_bench": 1}', r"runs\.jsonl:1: suite: found nothing, expected a mapping with the keys mrtamp_suite"),
        (b'{"mrtamp_bench": 1, "suite": 5}', r"runs\.jsonl:1: suite: found 5, expected a mapping"),
        (SCALABILITY, r"runs\.jsonl:1: suite: problems\[0\]: the table scalability needs the keys robots and objects"),
    ],
)
def test_what_is_no_file_of_records_is_named(content: bytes | None, words: str, tmp_path: Path) -> None:
    if content is not None:
        records_file(tmp_path).write_bytes(content + b"\n" if content else content)
    with pytest.raises(MrtampError, match=words):
        read_records(tmp_path)


@pytest.mark.parametrize(
    ("place", "reason"),
    [("file", "it is no folder"), ("file/deeper", "Not a directory"), ("/proc/nowhere", "No such file")],
)
def test_a_folder_that_cannot_be_written_is_named(place: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("taken")
    with pytest.raises(MrtampError, match=rf"{place}: cannot be written to: .*{reason}.*--out DIR"):
        Records(tmp_path / place, SUITE).__enter__()
