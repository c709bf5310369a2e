"""Letting robots move at the same time: every motion of a plan begins as early as the others allow.

A plan found one robot at a time is a list of legs and events.  In their order, each leg is inserted into the schedule
of what came before.  Waiting until everything before is over is always possible, so the result is never longer than
the plan (list scheduling).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from mrtamp.collision import Collision
from mrtamp.plan import Segment, Transition
from mrtamp.space_time import STEP, Clearances, Leg, SpaceTime
from mrtamp.validity import Validity

_EPS = 1e-9


def coordinate(
    segments: Sequence[Segment],
    transitions: Sequence[Transition],
    collision: Collision,
    validity: Validity,
    step: float = STEP,
) -> list[Segment]:
    """The same motions and transitions, in the same order of transitions, at the earliest times.

    Parameters
    ----------
    step : resolution of the schedule (rad or m of joint motion).
    """
    clearance = Clearances(collision, validity, list(segments[0].q))
    start = {r: q[0] for r, q in segments[0].q.items()}
    schedule = SpaceTime(clearance, start, [s.mode for s in segments])
    for k, segment in enumerate(segments):
        for leg in _legs(segment, clearance, schedule.at, step):
            schedule.insert(leg, certain=True)
        if k < len(transitions):
            schedule.happen(transitions[k].active, certain=True)
    return schedule.segments()


def _legs(segment: Segment, clearance: Clearances, at: Mapping[str, int], step: float) -> list[Leg]:
    """Runs of steps in which the same robots move, cut into pieces of at most `step`."""
    deltas = {r: np.linalg.norm(np.diff(q, axis=0), axis=1) for r, q in segment.q.items()}
    movers = [tuple(r for r in deltas if deltas[r][k] > _EPS) for k in range(segment.length - 1)]
    legs: list[Leg] = []
    now = dict(at)
    for robots, run in itertools.groupby(range(segment.length - 1), key=lambda k: movers[k]):
        if not robots:
            continue
        path = {r: [now[r]] for r in robots}
        for k in run:
            pieces = max(1, int(np.ceil(max(deltas[r][k] for r in robots) / step)))
            for j in range(1, pieces + 1):
                for r in robots:
                    a, b = segment.q[r][k], segment.q[r][k + 1]
                    path[r].append(clearance.row(r, b if j == pieces else a + (b - a) * (j / pieces)))
        now |= {r: rows[-1] for r, rows in path.items()}
        for r, rows in path.items():
            clearance.prepare(r, [*itertools.pairwise(rows), *zip(rows, rows, strict=True)])
        legs.append(Leg(path, segment.mode))
    return legs
