"""The table of first plans: rows run in processes of their own, and what did not succeed is not hidden."""

from __future__ import annotations

import pytest

from mrtamp import bench


def test_a_row_is_measured_and_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "start_to_exit", lambda: 1.0)
    said: list[str] = []
    row = bench.Row("box", {}, 60.0, "10 s")
    assert bench.first_plans(1, [row], said.append)
    assert "| box | 1/1 |" in "\n".join(said)


def test_a_row_without_a_plan_counts_as_the_whole_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "start_to_exit", lambda: 1.0)
    monkeypatch.setattr(bench, "FIRST_BUDGET_S", 0.001)
    said: list[str] = []
    row = bench.Row("stacking", {}, 60.0, "-")
    assert not bench.first_plans(1, [row], said.append)
    assert "| stacking | 0/1 | 0.00 s | nan s |" in "\n".join(said)


def test_the_rows_are_the_tasks_of_the_paper() -> None:
    names = [row.name for row in bench.FIRST]
    assert names[:4] == ["box", "handover", "stacking", "pick_place 2/2"] and names[-1] == "pick_place 8/24"
