"""Plans as data: costs against closed forms, and detours that cancel."""

from __future__ import annotations

import numpy as np
import pytest

from mrtamp.modes import Attachment, Mode
from mrtamp.plan import Action, Segment, measures, segment_cost, without_detours
from mrtamp.problem import CostWeights

X = np.eye(4)
TABLE, SHELF, TABLE_B = (
    Attachment("a", "table", X, "table"),
    Attachment("a", "shelf", X, "shelf"),
    Attachment("b", "table", X, "table"),
)
LEFT, RIGHT, RIGHT_B = (
    Attachment("a", "left", X, None, 0.05),
    Attachment("a", "right", X, None, 0.05),
    Attachment("b", "right", X, None, 0.05),
)


def test_cost_of_a_segment_is_makespan_and_path_length_of_synchronous_steps() -> None:
    q = {"one": np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 4.0]]), "two": np.array([[0.0], [2.0], [3.0]])}
    segment = Segment(Mode(()), q)
    assert measures([segment]) == {"makespan": 6.0, "path_length": 8.0}
    assert segment_cost(segment, CostWeights(2.0, 0.5)) == pytest.approx(2 * 6 + 0.5 * 8)


def pick(robot: str, before: Attachment, after: Attachment) -> tuple[Action, ...]:
    return (Action("pick", (robot,), before, after),)


def place(robot: str, before: Attachment, after: Attachment) -> tuple[Action, ...]:
    return (Action("place", (robot,), before, after),)


def test_what_is_put_back_where_it_came_from_need_not_be_picked() -> None:
    steps = [
        pick("left", TABLE, LEFT),
        pick("right", TABLE_B, RIGHT_B),
        place("left", LEFT, TABLE),
        place("right", RIGHT_B, TABLE_B),
        pick("left", TABLE, LEFT),
        place("left", LEFT, SHELF),
    ]
    assert without_detours(steps) == [4, 5]


def test_what_goes_somewhere_else_stays() -> None:
    handover = (Action("handover", ("left", "right"), LEFT, RIGHT),)
    twin = Attachment("a", "table", X, "table")
    for steps in (
        [pick("left", TABLE, LEFT), place("left", LEFT, SHELF)],
        [pick("left", TABLE, LEFT), place("left", LEFT, twin)],
        [pick("left", TABLE, LEFT), handover, place("right", RIGHT, TABLE)],
        [],
    ):
        assert without_detours(steps) == list(range(len(steps)))
