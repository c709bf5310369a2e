"""Motions in space and time: discs wait exactly as long as geometry demands, and not at all where it does not."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from arena import XY, Parts, arena

from mrtamp.check_report import Report, Side, Violation
from mrtamp.modes import Mode
from mrtamp.plan import measures
from mrtamp.space_time import STEP, Clearances, Leg, SpaceTime

RADIUS = 0.2
PADDING = 0.01
"""Discs are kept apart by a little more than contact: see `mrtamp.collision.RESOLUTION`."""


class Timing:
    """Straight legs of discs, inserted one after another into an empty schedule."""

    def __init__(self, folder: Path, starts: dict[str, XY]) -> None:
        self.parts = Parts(arena(folder, starts))
        self.clearances = Clearances(self.parts.collision, self.parts.validity, list(starts))
        q = {r: np.array(x, dtype=float) for r, x in starts.items()}
        self.mode: Mode = self.parts.root
        self.time = SpaceTime(self.clearances, q, [self.mode])

    def leg(self, robot: str, *points: XY) -> Leg:
        """From where the robot stands through points, in equal pieces of at most `STEP`."""
        table = self.clearances.tables[robot]
        rows = [self.time.at[robot]]
        for p in points:
            a, b = table[rows[-1]], np.array(p, dtype=float)
            n = int(np.ceil(np.linalg.norm(b - a) / STEP - 1e-9))
            rows += [self.clearances.row(robot, a + (b - a) * (j / n)) for j in range(1, n + 1)]
        return Leg({robot: rows}, self.mode)

    def go(self, robot: str, *points: XY) -> bool:
        return self.time.insert(self.leg(robot, *points))

    def makespan(self) -> float:
        return measures(self.time.segments())["makespan"]

    def judged(self) -> bool:
        return self.parts.judged(self.time.segments(), [])[1].ok


def test_who_comes_later_waits_exactly_as_long_as_needed(tmp_path: Path) -> None:
    """Paths that cross at right angles.  With b late by w the discs are nearest at w / sqrt(2), so w = sqrt(2) 2 r.

    Waiting earlier or later on the way makes no difference.
    """
    t = Timing(tmp_path, {"a": (-1, 0), "b": (0, -1)})
    assert t.go("a", (1, 0)) and t.go("b", (0, 1))
    piece = 2 / np.ceil(2 / STEP)
    late = t.time.free_from["b"] * piece - 2.0
    needed = np.sqrt(2) * 2 * RADIUS
    assert needed <= late <= needed + np.sqrt(2) * PADDING + piece
    assert t.time.free_from["a"] * piece == pytest.approx(2.0), "who was there first does not wait"
    assert t.makespan() == pytest.approx(2.0 + late)
    assert t.judged()


@pytest.mark.parametrize("delay", [0.4, 0.7, 1.1])
def test_who_is_late_enough_anyway_does_not_wait(tmp_path: Path, delay: float) -> None:
    """b starts farther away, and only what is missing of sqrt(2) 2 r is waited for."""
    t = Timing(tmp_path, {"a": (-0.7, 0), "b": (0, -0.7 - delay)})
    assert t.go("a", (1, 0)) and t.go("b", (0, 0.7))
    steps = len(t.leg("b", (0, -0.7 - delay)).path["b"]) - 1
    piece = (1.4 + delay) / steps
    waited = (t.time.free_from["b"] - steps) * piece
    needed = max(0.0, np.sqrt(2) * 2 * RADIUS - delay)
    # The two discs' steps differ in length by up to a tenth, so b is as much slower than a.
    assert needed - 0.1 <= waited <= needed + 0.1 + 2 * STEP
    assert t.judged()


def test_robots_far_from_each_other_do_not_wait(tmp_path: Path) -> None:
    t = Timing(tmp_path, {"a": (-1, -1), "b": (0, 1)})
    assert t.go("a", (1, -1)) and t.go("b", (1, 1))
    assert t.makespan() == pytest.approx(2.0)
    assert t.judged()


def test_no_timing_helps_against_who_stands_in_the_way_for_ever(tmp_path: Path) -> None:
    t = Timing(tmp_path, {"a": (-1, 0), "b": (0, 0)})
    leg = t.leg("a", (1, 0))
    assert t.time.in_the_way(leg) == ["b"]
    before = t.time.end
    assert not t.time.insert(leg)
    assert t.time.end == before and not t.time.moves["a"], "a failed insertion leaves no trace"
    assert t.go("b", (0, 1))
    assert t.time.in_the_way(leg) == []
    assert t.time.insert(leg)
    assert t.judged()


def test_nobody_stops_where_somebody_is_still_to_pass(tmp_path: Path) -> None:
    """a crosses the place where b goes to, later than b could be there: b arrives after a has passed."""
    t = Timing(tmp_path, {"a": (-1.5, 0), "b": (0, 0.6)})
    assert t.go("a", (1.5, 0)) and t.go("b", (0, 0))
    passed = (1.5 + 2 * RADIUS) / 3.0 * np.ceil(3.0 / STEP)
    assert t.time.free_from["b"] >= passed - 1
    assert t.judged()


@pytest.mark.parametrize("seed", range(6))
def test_schedules_of_random_legs_are_free_of_collisions(tmp_path: Path, seed: int) -> None:
    """Three discs cross the square again and again; a leg that cannot be inserted is left out."""
    rng = np.random.default_rng(seed)
    starts = {"a": (-1.5, -1.5), "b": (1.5, -1.5), "c": (0.0, 1.5)}
    t = Timing(tmp_path, starts)
    inserted, alone = 0, dict.fromkeys(starts, 0.0)
    for k in range(9):
        robot = "abc"[k % 3]
        here = t.clearances.tables[robot][t.time.at[robot]]
        there = tuple(rng.uniform(-1.5, 1.5, size=2))
        if t.go(robot, there):
            inserted += 1
            alone[robot] += float(np.linalg.norm(here - there))
    assert inserted >= 4
    assert t.judged()
    assert t.makespan() >= max(alone.values()) - 1e-9
    for robot, rows in t.time.segments()[0].q.items():
        length = sum(float(np.linalg.norm(b - a)) for a, b in itertools.pairwise(rows))
        assert length == pytest.approx(alone[robot]), "waiting costs time, not path"


def test_who_is_scheduled_alone_goes_through_others_and_others_still_wait(tmp_path: Path) -> None:
    """Schedules of both kinds share what is known of moves, and it stays true for both."""
    t = Timing(tmp_path, {"a": (-1, 0), "b": (0, -1)})
    q = {r: t.clearances.tables[r][0] for r in t.time.names}
    makespans = []
    for alone in (False, True, False):
        t.time = SpaceTime(t.clearances, q, [t.mode], alone=alone)
        assert t.go("a", (1, 0))
        t.time = t.time.copy()
        assert t.go("b", (0, 1))
        assert t.judged() != alone
        makespans.append(t.makespan())
    assert makespans[1] == pytest.approx(2.0)
    assert makespans[0] == makespans[2] > 2.0


def test_who_is_scheduled_alone_stands_and_acts_inside_others(tmp_path: Path) -> None:
    t = Timing(tmp_path, {"a": (-1, 0), "b": (0, 0)})
    q = {r: t.clearances.tables[r][0] for r in t.time.names}
    for alone in (False, True):
        t.time = SpaceTime(t.clearances, q, [t.mode, t.mode], alone=alone)
        leg = t.leg("a", (0.1, 0))
        assert t.time.in_the_way(leg) == ([] if alone else ["b"])
        assert t.time.insert(leg, certain=True), "scheduled even where it is not free"
        assert t.time.happen(("a",)) == alone


def test_a_step_that_the_judge_objected_to_is_not_taken_again(tmp_path: Path) -> None:
    """Side by side the discs are clear of each other: only what is said against the step keeps them apart in time."""
    t = Timing(tmp_path, {"a": (-1, 0.5), "b": (-1, -0.5)})
    assert t.go("a", (1, 0.5)) and t.go("b", (1, -0.5))
    end = t.time.end
    sides = (Side("robot", "a", "disc"), Side("robot", "b", "disc"))
    step = Violation("collision", "they graze", segment=0, step=2, fraction=0.5, value=1e-3, sides=sides)
    assert t.time.forbid(Report([step])) == (True, [])
    assert t.time.forbid(Report([Violation("goal", "not there")])) == (False, []), "nothing to learn from"
    again = SpaceTime(t.clearances, {r: t.clearances.tables[r][0] for r in "ab"}, [t.mode])
    again.at = {r: 0 for r in "ab"}
    rows = {r: [m.a for m in t.time.moves[r]] + [t.time.at[r]] for r in "ab"}
    assert again.insert(Leg({"a": rows["a"]}, t.mode)) and again.insert(Leg({"b": rows["b"]}, t.mode))
    assert again.end == end + 1, "one of them waits once"


def test_copies_are_independent(tmp_path: Path) -> None:
    t = Timing(tmp_path, {"a": (-1, 0), "b": (0, -1)})
    assert t.go("a", (1, 0))
    trial = t.time.copy()
    assert trial.insert(t.leg("b", (0, 1)))
    assert not t.time.moves["b"] and t.time.end < trial.end


def hits(robot: str, step: int, depth: float) -> Violation:
    """What the judge says of a robot that hits a wall in a step."""
    sides = (Side("robot", robot, "disc"), Side("static", "wall", "wall"))
    return Violation("collision", "deep", segment=0, step=step, fraction=0.5, value=depth, sides=sides)


def test_a_robot_that_hits_the_world_alone_is_to_blame_for_it(tmp_path: Path) -> None:
    t = Timing(tmp_path, {"a": (-1, 0.5), "b": (-1, -0.5)})
    assert t.go("a", (1, 0.5)) and t.go("b", (1, -0.5))
    learnt, alone = t.time.forbid(Report([hits("a", 2, 0.02), hits("b", 4, 0.02)]))
    assert not learnt, "nothing that other timings of the same moves could change"
    assert alone == [(robot, t.time.moves[robot][k], t.mode, "wall") for robot, k in (("a", 2), ("b", 4))]


def test_robots_whose_penetrations_only_add_up_to_too_much_do_not_hit_the_world_at_the_same_time(
    tmp_path: Path,
) -> None:
    t = Timing(tmp_path, {"a": (-1, 0.5), "b": (-1, -0.5)})
    assert t.go("a", (1, 0.5)) and t.go("b", (1, -0.5))
    both = {r: t.time.moves[r][2] for r in "ab"}
    assert t.clearances.apart("a", both["a"], None, "b", both["b"], None)
    assert t.time.forbid(Report([hits("a", 2, 0.007), hits("b", 2, 0.004)])) == (True, [])
    assert not t.clearances.apart("a", both["a"], None, "b", both["b"], None)
    assert t.clearances.apart("a", both["a"], None, "b", t.time.moves["b"][3], None)
