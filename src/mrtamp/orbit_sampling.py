"""What an iteration samples: roadmap vertices, and transitions out of an orbit (paper, algorithm 1).

Both sets grow for ever, whatever guidance prefers: that is what optimality in the limit rests on.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mrtamp.growth import Combination, Growth
from mrtamp.guidance import Choice
from mrtamp.modes import Mode
from mrtamp.orbit_guidance import OrbitGuidance
from mrtamp.roadmap import Roadmap
from mrtamp.transitions.choices import known_candidates, new_candidates
from mrtamp.transitions.projection import uniform_configurations
from mrtamp.transitions.sampler import TransitionSampler

_COVER = 3200
"""Initial vertices of a robot with n joints: at least this over the square of n."""
_GROWTH = 1.0
"""Roadmaps grow by at least so many times the square root of their size per iteration: in proportion to their size they
would grow exponentially, and less and less exploration would fit into a second."""


class OrbitSampling:
    """SampleOrbitInterior, ExpandRoadmaps and SampleTransitions.

    Parameters
    ----------
    interior_samples : N_m, least number of samples per roadmap and iteration.
    transition_samples : N_t, IK seeds per stratum and iteration.
    combinations : simultaneous transitions that are handed out per iteration, at most.
    persistent : how much likelier than need be new candidates are sampled before there is a plan.
    """

    def __init__(
        self,
        roadmaps: Mapping[str, Roadmap],
        sampler: TransitionSampler,
        guidance: OrbitGuidance,
        growth: Growth,
        rng: np.random.Generator,
        *,
        interior_samples: int,
        transition_samples: int,
        combinations: int,
        persistent: float,
    ) -> None:
        self.roadmaps = roadmaps
        self.sampler = sampler
        self.guidance = guidance
        self.growth = growth
        self.rng = rng
        self.interior_samples = interior_samples
        self.transition_samples = transition_samples
        self.combinations = combinations
        self.persistent = persistent

    def cover(self, least: int) -> None:
        """The first vertices of every roadmap, from at least so many samples."""
        for roadmap in self.roadmaps.values():
            # A space of few dimensions is soon covered, and then paths in it are nearly shortest.
            self._add_interior(roadmap, max(least, _COVER // roadmap.n_dof**2))

    def expand_roadmaps(self) -> None:
        """Every constituent roadmap keeps growing."""
        for roadmap in self.roadmaps.values():
            grown = int(_GROWTH * np.sqrt(roadmap.n_vertices))
            self._add_interior(roadmap, max(self.interior_samples, grown))

    def _add_interior(self, roadmap: Roadmap, n: int) -> None:
        """n samples; half uniform, half around known vertices, where passages matter most; free ones are kept."""
        world = roadmap.world
        q = uniform_configurations(world.tool, self.rng, n)
        known = roadmap.q[self.rng.integers(roadmap.n_vertices, size=n)]
        near = np.clip(known + self.rng.normal(scale=0.4, size=q.shape), world.chain.lower, world.chain.upper)
        q = np.where(self.rng.random(n)[:, None] < 0.5, q, near)
        roadmap.add_vertices(q[~world.hits(world.rows(q, None, {}))])

    def sample_transitions(self, mode: Mode, choices: list[Choice], *, improving: bool) -> list[Combination]:
        """Candidates for every choice, known and new, combined into simultaneous transitions; none if one has none.

        `improving` says whether there is a plan: from then on the sets of candidates grow every time.
        """
        lists = []
        guided, leads_on = self.guidance.guided, self.guidance.modal.leads_on
        for choice in choices:
            known = known_candidates(self.sampler, mode, choice)
            if guided:
                known = [c for c in known if leads_on(mode, choice, c)]
                known = [c for c in known if improving or not self.growth.taken(mode, c)]
            # Grow the set while it is small, later in step with its logarithm, for ever.
            if len(known) < 4 or improving or self.rng.random() < 0.3 + self.persistent:
                known = [
                    *(
                        c
                        for c in new_candidates(self.sampler, mode, choice, self.transition_samples)
                        if not guided or leads_on(mode, choice, c)
                    ),
                    *known,
                ]
            if guided and not self.guidance.still_best(mode, choice):
                # What the sampler saw ahead changed the estimate: better to act on that.
                return []
            if not known:
                self.guidance.modal.record(mode, choice, success=False)
                return []
            lists.append(known)
        if not lists:
            return []
        out = []
        for _ in range(self.combinations):
            pick = tuple(x[self._index(len(x), guided)] for x in lists)
            if pick not in out:
                out.append(pick)
        return out

    def _index(self, n: int, guided: bool) -> int:
        """An index below n, earlier ones more likely if `guided`: exploration gives every candidate the same chance."""
        if not guided:
            return int(self.rng.integers(n))
        return int(min(n - 1, self.rng.geometric(0.35) - 1))
