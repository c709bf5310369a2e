"""Mending: what only grazes something is brought out of collision close by, where that costs hardly anything.

Programs with large steps and few samples leave small collisions between samples, each time elsewhere, and clearance
asked for everywhere makes all motions longer.  With many samples and small steps linearised distances are nearly exact:
a few programs, each with what the one before has left, free the iterate at a cost little above its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from mrtamp.deadline import Deadline
from mrtamp.optimise.collisions import CollisionRows, Collisions
from mrtamp.optimise.fine import FineCheck, Violations, Who
from mrtamp.optimise.iterate import Iterate, worth

_MENDABLE = 0.02
"""Penetration (m) between samples up to which an iterate can be mended."""
_PROGRAMS, _NEARBY = 6, 0.02
"""Programs that an iterate is mended by, and their trust region (rad or m)."""
_LESS, _LITTLE = 0.7, 1e-3
"""To what share, or below what depth (m), each program has to reduce the penetration that is left."""
_PIECES, _REACH = 8, 0.02
"""Samples per step, and the distance (m) of what enters the programs."""
CLEARANCE = 8e-4
"""Clearance (m) asked for, and how much more where a program has left a collision."""
_PAUSE = 3
"""Iterates that are let pass after an attempt in vain."""

Solve = Callable[[Iterate, CollisionRows, float], Iterate | None]
"""Iterate, collision rows, trust region -> what one program leads to."""
Look = Callable[[Iterate, Mapping[Who, np.ndarray], bool], list[Violations]]
"""Iterate, distances along its steps, whether to look between samples in any case -> its collisions."""


class Mending:
    """Mends iterates of one optimisation.

    Parameters
    ----------
    fine : knows what is left of distances when knots move.
    tolerance : penetration (m) that the problem tolerates at an instant.
    solve : solves one program.
    look : finds collisions.
    deadline : when attempts are given up.
    """

    def __init__(self, fine: FineCheck, tolerance: float, solve: Solve, look: Look, deadline: Deadline) -> None:
        self.deadline = deadline
        self.fine = fine
        self.tolerance = tolerance
        self.solve = solve
        self.look = look
        self._pause = 0

    def attempt(self, base: Iterate, violations: Sequence[Violations], best: float, level: int = 0) -> Iterate | None:
        """An iterate close to `base`, which has these violations, that is free of collision and costs less than `best`;
        None where none is found, or it is not worth looking for at this `level`."""
        self._pause = max(self._pause - 1, 0)
        if self._pause or _deepest(violations) >= _MENDABLE or base.cost >= (1 - worth(level)) * best:
            return None
        mended = self._mended(base, violations, best, level)
        if mended is None:
            self._pause = _PAUSE
        return mended

    def _mended(self, base: Iterate, violations: Sequence[Violations], best: float, level: int) -> Iterate | None:
        where = base.line, base.q, base.arrangement
        rules = Collisions(
            self.fine.nearness, self.tolerance, pieces=_PIECES, reach=_REACH, margin=CLEARANCE, stricter=CLEARANCE
        )
        rules.level = level
        rows, found, depth = rules.rows(*where), list(violations), np.inf
        for _ in range(_PROGRAMS):
            if self.deadline.passed:
                return None
            rows = rows.joined(rules.more(*where, rules.learn(found, as_deep=True)))
            x = self.solve(base, rows, _NEARBY)
            if x is None or x.cost >= best:
                return None
            found = self.look(x, self.fine.left(rows.clearance, base.line, base.q, x.q), True)
            if not found:
                return x
            before, depth = depth, _deepest(found)
            if depth > max(_LITTLE, _LESS * before):
                return None
        return None


def _deepest(violations: Sequence[Violations]) -> float:
    """Largest penetration (m) beyond what is tolerated."""
    return max(float(v.depth.max()) for v in violations)
