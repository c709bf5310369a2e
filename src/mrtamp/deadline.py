"""The end of a planner's time, which its long loops look at wherever nothing is half done.

A loop that is late raises `TimeIsUp`, and the planner's anytime loop catches it: what is abandoned has not failed, and
nothing is held against it.  Where a call is bounded by iterations alone the deadline never passes, so that such runs
do not depend on the clock.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np


class TimeIsUp(Exception):
    """The deadline has passed: whatever is under way is abandoned."""


@dataclass
class Deadline:
    """One for all parts of a planner, set anew by every call of `improve`.

    Attributes
    ----------
    end : moment on the clock of `time.perf_counter` (s); infinite: there is none.
    """

    end: float = np.inf

    def set(self, budget_s: float | None) -> None:
        """So many seconds from now; None: never."""
        self.end = np.inf if budget_s is None else time.perf_counter() + budget_s

    @property
    def left_s(self) -> float:
        """Seconds until time is up; infinite where it never is."""
        return self.end - time.perf_counter()

    @property
    def passed(self) -> bool:
        """Whether time is up."""
        return time.perf_counter() >= self.end

    def check(self) -> None:
        """Raise `TimeIsUp` if it is."""
        if self.passed:
            raise TimeIsUp
