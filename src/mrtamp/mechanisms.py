"""Mechanisms of the planner that can be switched off by name, for ablation (`mrtamp plan --without NAME`)."""

from __future__ import annotations

MECHANISMS = {
    "modal-guidance": "optimistic modal guidance before the first plan; without it orbits and transitions are random",
    "orbit-path-guidance": "after the first plan, half of the search works along the incumbent's orbits",
    "skeletons": "guidance that knows costs: whole skeletons from decoupled distances",
    "rewiring": "after the first plan the tree is rewired to tensor neighbours, inside orbits and across transitions",
    "coordination": "motions of a new plan begin as early as the others allow",
    "refinement": "optimisation of plans once there are some",
    "convex-programming": "the second half of refinement; without it plans are only shortened robot by robot",
    "sliding": "transitions move along their strata in refinement",
    "adoption": "refined configurations go back into the roadmaps and the tree",
}
"""Name -> what it does."""

INTRA_ORBIT_NAMES = ("tensor-tree", "prioritised")
"""Planners of motion inside an orbit; see `mrtamp.intra_orbit.planners`."""
