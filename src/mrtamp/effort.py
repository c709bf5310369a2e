"""How the time after the first plan is shared out: every activity has a floor, the rest follows the gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

_FORGET = 0.97
"""What is remembered of work and gains from one record to the next."""


class Effort:
    """Chooses the next activity so that each gets its share of the work.

    A share is the activity's floor plus a part of what the floors leave over, in proportion to the gain per work that
    the activity has had of late; where nothing has gained, in proportion to `prior`.

    Parameters
    ----------
    floors : activity -> least share; their sum is at most 1.
    prior : activity -> its part of the rest while nothing is known; adds up to 1.
    ceilings : activity -> largest share, 1 where missing; at least one activity has to be without.
    """

    def __init__(
        self, floors: Mapping[str, float], prior: Mapping[str, float], ceilings: Mapping[str, float] | None = None
    ) -> None:
        self.floors = dict(floors)
        self._prior = dict(prior)
        self.ceilings = {name: (ceilings or {}).get(name, 1.0) for name in floors}
        self.total = dict.fromkeys(floors, 0.0)
        self._work = dict.fromkeys(floors, 1e-9)
        self._gain = dict.fromkeys(floors, 0.0)

    def shares(self) -> dict[str, float]:
        """The share of every activity; they add up to 1."""
        rates = {name: self._gain[name] / self._work[name] for name in self.floors}
        whole = sum(rates.values())
        spare = 1.0 - sum(self.floors.values())
        out = {
            name: floor + spare * (rates[name] / whole if whole > 0 else self._prior[name])
            for name, floor in self.floors.items()
        }
        excess = sum(max(0.0, share - self.ceilings[name]) for name, share in out.items())
        free = [name for name, share in out.items() if share < self.ceilings[name]]
        return {
            name: min(share, self.ceilings[name]) + (excess / len(free) if name in free else 0.0)
            for name, share in out.items()
        }

    def next(self, available: Sequence[str], eager: str | None = None) -> str:
        """The one of the available activities that is furthest behind its share of the recent work.

        What is not available leaves its share to the others, up to their ceilings.  What is `eager`, since it is too
        soon to tell what it gains, has all that the floors of the other available ones leave.
        """
        shares = self.shares()
        if eager is not None:
            shares = {**self.floors, eager: 1.0 - sum(self.floors[name] for name in available if name != eager)}
        whole = sum(shares[name] for name in available)
        scaled = {name: min(shares[name] / whole, self.ceilings[name]) for name in available}
        work = sum(self._work[name] for name in available)
        return max(available, key=lambda name: scaled[name] * work - self._work[name])

    def record(self, activity: str, work: float, gain: float) -> None:
        """Note what an activity took (s, or any other measure that is the same for all) and by how much cost fell."""
        self.total[activity] += work
        for name in self.floors:
            self._work[name] *= _FORGET
            self._gain[name] *= _FORGET
        self._work[activity] += work
        self._gain[activity] += gain
