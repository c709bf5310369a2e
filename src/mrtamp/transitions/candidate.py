"""What transition sampling yields, and what it counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mrtamp.modes import Attachment
from mrtamp.plan import Action


@dataclass(frozen=True, eq=False)
class Candidate:
    """An elementary transition that stands on roadmap vertices.

    `at` maps each active robot to its contact vertex.  `base` is the chain of attachments of the object it is placed
    on or picked from (empty for a static body): the candidate exists only while that object is there.  `promising` is
    the sampler's guess that what is gained can be put down at its goal; guidance prefers such candidates.  `subgoal` is
    what a reach candidate reaches.
    """

    kind: str
    robots: tuple[str, ...]
    at: Mapping[str, int]
    before: Attachment | None
    after: Attachment | None
    base: tuple[Attachment, ...] = ()
    promising: bool = True
    subgoal: str | None = None

    @property
    def action(self) -> Action:
        """The change of mode, without the vertices."""
        return Action(self.kind, self.robots, self.before, self.after, self.subgoal)


StratumKey = tuple[str, tuple[str, ...], str, str]
"""Kind, robots, object, and the place it comes from (pick), goes to (place), the giver (handover) or the subgoal."""


@dataclass(frozen=True, eq=False)
class SolvedHandover:
    """Where two robots stand, by IK, when an object goes from the grasp `given` into the grasp `taken`.

    `q` maps both to their configurations, of which nothing else is known.  `promising` is as for candidates;
    `leads_on`: whether it seems to be on a shortest way to the goal.  `retreats` maps the robots to configurations
    along a straight retreat of the hand, once those are known.
    """

    given: Attachment
    taken: Attachment
    q: Mapping[str, np.ndarray]
    promising: bool = True
    leads_on: bool = True
    retreats: Mapping[str, Sequence[np.ndarray]] | None = None

    @property
    def stratum(self) -> StratumKey:
        """Under which its outcome is counted."""
        giver, receiver = self.given.parent, self.taken.parent
        return "handover", (giver, receiver), self.taken.object, giver


@dataclass
class Outcome:
    """What became of the samples of one stratum.

    `tries` and `fits` count samples per family, and those that IK and the first collision check let through.
    `blockers` are the resting objects, where they rested, that stood in the way of the last call if it yielded nothing.
    """

    calls: int = 0
    samples: int = 0
    ik_solved: int = 0
    accepted: int = 0
    collisions: Counter[str] = field(default_factory=Counter)
    blockers: set[Attachment] = field(default_factory=set)
    tries: Counter[str] = field(default_factory=Counter)
    fits: Counter[str] = field(default_factory=Counter)

    def weights(self, families: Sequence[str], floor: float = 0.3) -> np.ndarray:
        """Probabilities (F,) of the families: by how often their samples fitted, and a floor shared by all."""
        rate = np.array([(self.fits[f] + 1) / (self.tries[f] + 2) for f in families])
        return (1 - floor) * rate / rate.sum() + floor / len(families)
