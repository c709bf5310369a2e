"""A detour that guidance disfavours: the cheapest plan moves an object that has no need to move.

A plug stands in a slot of a high wall.  The cube has to go to the other side; it can be lifted over plug and wall, and
that is all that guidance and skeletons ever propose.  Taking the plug away, which a second gantry can do meanwhile,
opens the slot, and the cube goes straight through for less than half.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from gantry import gantry_model
from pydrake.math import RigidTransform

from mrtamp.check import check_plan
from mrtamp.plan import Plan
from mrtamp.planner import Options, Planner
from mrtamp.problem import (
    AntipodalGrasps,
    InRegion,
    MovableObject,
    Problem,
    Robot,
    Shape,
    StaticBody,
    Support,
)

WALL = 1.03
PLUG = 0.98
OVER = 2 * (PLUG - 0.1)
"""Less than the cost of lifting the cube over the plug and down again."""


def box(name: str, low: tuple[float, float, float], high: tuple[float, float, float]) -> StaticBody:
    middle = (np.array(low) + np.array(high)) / 2
    return StaticBody(name, RigidTransform(middle), Shape("box", tuple(np.subtract(high, low).tolist())))


def plugged(folder: Path) -> Problem:
    """`carrier` starts above the cube, lower than the wall; `helper` above the plug."""
    model = gantry_model(folder)
    top = RigidTransform([0, 0, 0.02])
    here = RigidTransform([0, 0, 0.02 + PLUG / 2])
    supports = (
        Support("floor", "table", RigidTransform([-0.4, 0, 0.02]), (0.5, 0.8), objects=("cube",)),
        Support("target", "table", RigidTransform([0.25, 0, 0.02]), (0.06, 0.06), yaw=(-0.5, 0.5), objects=("cube",)),
        Support("slot", "table", top, (0.01, 0.01), X_BO=here, objects=("plug",)),
        Support("aside", "table", RigidTransform([0.25, -0.4, 0.02]), (0.2, 0.2), objects=("plug",)),
    )
    grasps = (AntipodalGrasps(("-z",), 0.005, (0.01, 0.03)),)
    cube = MovableObject(
        "cube", "table", RigidTransform([-0.25, 0, 0.05]), "floor", Shape("box", (0.04, 0.04, 0.06)), grasps=grasps
    )
    plug = MovableObject("plug", "table", here, "slot", Shape("box", (0.05, 0.2, PLUG)), grasps=grasps)
    # Bases are apart: only the carrier reaches the cube, only the helper the place where the plug is out of the way.
    bases = {"carrier": RigidTransform([-0.7, 0, 0.18]), "helper": RigidTransform([0.9, 0, 0.18])}
    homes = {"carrier": np.array([0.45, 0, -0.03, 0]), "helper": np.array([-0.9, 0.0, 0.92, np.pi / 2])}
    return Problem(
        name="plugged",
        robots=tuple(Robot(name, model, bases[name], q, q) for name, q in homes.items()),
        statics=(
            StaticBody("table", RigidTransform([0, 0, -0.02]), Shape("box", (2.4, 2.4, 0.04))),
            box("wall_right", (-0.02, -1.2, 0), (0.02, -0.15, WALL)),
            box("wall_left", (-0.02, 0.15, 0), (0.02, 1.2, WALL)),
        ),
        supports=supports,
        objects=(cube, plug),
        goal=(InRegion("cube", "target"),),
    )


def moves_plug(plan: Plan) -> bool:
    return any(a.object == "plug" for t in plan.transitions for a in t.actions)


def test_guidance_disfavours_the_detour_and_the_planner_finds_it_all_the_same(tmp_path: Path) -> None:
    """Skeletons are off only as their turns would make the run longer.

    How soon it is found is chance: of seeds 1 to 16 twelve once found it within 400 iterations, half of them within 80.
    """
    options = Options(persistent=0.5, refinement_share=0.2, without=frozenset({"skeletons", "convex-programming"}))
    planner = Planner(plugged(tmp_path), seed=2, options=options)
    start = planner.root.mode
    assert any(c.object == "plug" for c in planner.guidance.enabled(start)), "it can be done"
    assert {c.object for _, c in planner.guidance.proposals(start)} == {"cube"}, "but is not proposed"
    plans = []
    for plan in planner.improve(iterations=400):
        plans.append(plan)
        if moves_plug(plan) and plan.cost < 0.7 * OVER:
            break
    assert moves_plug(plans[-1]) and check_plan(plans[-1]).ok
    assert plans[-1].cost < 0.7 * OVER
    planner.skeletons.grow(40, 10)
    proposed = [stop for p in planner.skeletons.propose() for stop, _ in p.stops]
    assert {stop.after.object for stop in proposed if stop.after is not None} == {"cube"}
