"""Mechanisms of the planner that can be switched off by name, for ablation (`mrtamp plan --without NAME`)."""

from __future__ import annotations

from collections.abc import Iterable

MECHANISMS = {
    "modal-guidance": "optimistic modal guidance before the first plan; without it orbits and transitions are random",
    "orbit-path-guidance": "after the first plan, half of the search works along the incumbent's orbits",
    "skeletons": "guidance that knows costs: whole skeletons from decoupled distances",
    "way-descent": "sampled ways are shortened along their strata before skeletons choose among them",
    "shorter-paths": "where a roadmap's path goes a long way round, trees look for one on another side",
    "lazy-validation": "roadmap edges are validated when a search asks; without it, all of them when they are made",
    "factored-cache": "what is known of an edge in one mode counts in others; without it every mode asks again",
    "rewiring": "after the first plan the tree is rewired to tensor neighbours, inside orbits and across transitions",
    "coordination": "motions of a new plan begin as early as the others allow",
    "refinement": "optimisation of plans once there are some",
    "convex-programming": "the second half of refinement; without it plans are only shortened robot by robot",
    "local-search": "ways of refined plans are bent aside, or taken from other plans, to pass on another side",
    "drafts": "skeletons are refined as they are, robots still in each other's way; without it only what is free",
    "sliding": "transitions move along their strata in refinement",
    "adoption": "refined configurations go back into the roadmaps and the tree",
}
"""Name -> what it does."""

INTRA_ORBIT_NAMES = ("tensor-tree", "prioritised")
"""Planners of motion inside an orbit; see `mrtamp.intra_orbit.planners`."""

INTRA_ORBIT_PLANNERS = ("guided", "unguided")
"""Planners that have a choice of them."""

PLANNER_NAMES = ("guided", "unguided", "composed-prm", "prioritised")
"""Planners that can be asked for by name; see `mrtamp.planners`."""

BASELINE_MECHANISMS = {
    "informed-sampling": "composed-prm: after the first plan, only configurations that may be on a better one",
    "goal-bias": "composed-prm: most modes and transitions are drawn for how near they seem to the goal",
    "refinement": "plans are shortened robot by robot",
    "factored-cache": MECHANISMS["factored-cache"],
}
"""The same for the baselines, as far as they have them."""

MECHANISMS_OF = {
    "guided": tuple(MECHANISMS),
    "unguided": tuple(MECHANISMS),
    "composed-prm": tuple(BASELINE_MECHANISMS),
    "prioritised": ("refinement", "factored-cache"),
}
"""Planner -> the mechanisms that can be switched off in it."""


def check_without(planner: str, without: Iterable[str]) -> None:
    """Refuse names of mechanisms that a planner does not have.

    Raises
    ------
    MrtampError : naming the planner, what it does not have and what there is.
    """
    # Takes long, and the command line knows the names before it needs anything else.
    from mrtamp.problem import MrtampError

    known = MECHANISMS_OF[planner]
    unknown = sorted(set(without) - set(known))
    if unknown:
        raise MrtampError(f"without: {planner} has no {', '.join(unknown)}; choose from {', '.join(known)}")
