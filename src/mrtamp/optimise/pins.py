"""Which configurations of a polyline may not move: start, goal, and whatever a transition fixes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mrtamp.optimise.polyline import Polyline
from mrtamp.plan import Transition
from mrtamp.problem import AtConfiguration, Problem, RobotAt


def pins(
    problem: Problem, line: Polyline, transitions: Sequence[Transition], slide: bool, fixed_end: bool = False
) -> dict[str, np.ndarray]:
    """Robot -> knots (K,) at which its configuration stays; with `slide` only where no stratum offers freedom, with
    `fixed_end` also where all is over.
    """
    K = line.knots
    out = {r: np.zeros(K, dtype=bool) for r in line.columns}
    for pinned in out.values():
        pinned[0] = True
        pinned[-1] |= fixed_end
    for condition in problem.goal:
        if isinstance(condition, RobotAt):
            out[condition.robot][-1] = True
    used: set[tuple[str, int]] = set()
    for knot, transition in zip(line.events.tolist(), transitions, strict=True):
        for action in transition.actions:
            targets = problem.subgoal(action.subgoal).targets if action.subgoal is not None else {}
            for robot in action.robots:
                exact = isinstance(targets.get(robot), AtConfiguration)
                attaches = action.kind == "reach" and action.after is not None
                # Two transitions of one robot at one knot: what satisfies both is not looked for.
                out[robot][knot] |= not slide or exact or attaches or (robot, knot) in used
                used.add((robot, knot))
    for robot, pinned in out.items():
        own = [s for s in line.stretches if s.robot == robot]
        for one in own:
            for two in own:
                if not one.before and two.before and one.far > two.far and one.event < two.event:
                    # Leaving and approaching overlap: nothing in between may change.
                    pinned[line.events[one.event] : line.events[two.event] + 1] = True
        for _ in range(2):
            for s in own:
                event = int(line.events[s.event])
                waits = slice(min(s.near, event), max(s.near, event) + 1)
                if pinned[waits].any():
                    pinned[min(s.far, event) : max(s.far, event) + 1] = True
    return out
