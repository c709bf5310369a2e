"""Objects that have to be regrasped by one handover after the other, and what is learnt of grasps on the way."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from gantry import gantry_model
from pydrake.math import RigidTransform

from mrtamp.check import check_plan
from mrtamp.guidance import Choice
from mrtamp.kinematics import inverse
from mrtamp.modes import Attachment, Mode
from mrtamp.planner import Options, Planner
from mrtamp.problem import AntipodalGrasps, InRegion, MovableObject, Problem, Robot, Shape, StaticBody, Support
from mrtamp.transitions.holds import faces

GIVE = Choice("handover", ("left", "right"), "bar", "left")
SLOT = 0.06
"""Width of the gap between the guards (m), which leaves 2 cm to either side for fingers 2 cm wide."""


def relay(folder: Path) -> Problem:
    """A long bar; only the left gantry reaches its start, only the right one its goal, and both lie between guards.

    So both have to grasp the bar at its middle, where there is room for one hand: handed over once, the bar is in the
    wrong hand or held at the wrong place, and it takes three handovers at least.
    """
    model = gantry_model(folder)
    table = StaticBody("table", RigidTransform([0, 0, -0.02]), Shape("box", (3.0, 2.0, 0.04)))
    guards = []
    for x in (-0.9, 0.9):
        for end in (-1, 1):
            for side in (-1, 1):
                X_WB = RigidTransform([x + end * (SLOT + 0.1) / 2, side * 0.045, 0.025])
                guards.append(StaticBody(f"guard {len(guards)}", X_WB, Shape("box", (0.1, 0.03, 0.05))))
    start, target = (
        Support(name, "table", RigidTransform([x, 0, 0.02]), (0.004, 0.004), yaw=(0.0, 0.0))
        for name, x in (("start", -0.9), ("target", 0.9))
    )
    bar = MovableObject(
        "bar",
        "table",
        RigidTransform([-0.9, 0, 0.045]),
        "start",
        Shape("box", (0.3, 0.04, 0.05)),
        grasps=(AntipodalGrasps(("-z",), 0.13, (0.01, 0.03)),),
    )
    robots = []
    for name, x in (("left", -0.6), ("right", 0.6)):
        q = np.array([0.0, 0.5, 0.3, 0.0])
        robots.append(Robot(name, model, RigidTransform([x, 0, 0]), q, q))
    return Problem("relay", tuple(robots), (table, *guards), (start, target), (bar,), (InRegion("bar", "target"),))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("relay")


@pytest.mark.parametrize("seed", [1, 3])
def test_a_bar_goes_to_and_fro_until_the_right_hand_has_its_middle(folder: Path, seed: int) -> None:
    options = Options(without=frozenset({"skeletons"}))
    (plan,) = Planner(relay(folder), seed=seed, options=options).improve(iterations=120, first=True)
    assert check_plan(plan).ok
    actions = [a for t in plan.transitions for a in t.actions]
    assert [a.robots for a in actions if a.kind == "handover"][:3] == [
        ("left", "right"),
        ("right", "left"),
        ("left", "right"),
    ]
    assert actions[0].kind == "pick" and actions[-1].kind == "place"
    # The clearance of fingers between the guards, worked out by hand.
    for a in (actions[0].after, actions[-1].before):
        assert a is not None and abs(inverse(a.X_PO)[0, 3]) <= SLOT / 2 - 0.01


def holding(planner: Planner) -> Mode:
    """The left hand holds the bar by its middle."""
    start = planner.root.mode
    while not (picks := planner.sampler.sample_pick(start, "left", "bar")):
        pass
    assert picks[0].after is not None
    return start.replace(picks[0].after)


def test_candidates_that_seem_to_lead_nowhere_are_held_back_by_guidance_alone(folder: Path) -> None:
    """Exploration hands out every known one, about as often as any other."""
    planner = Planner(relay(folder), seed=0)
    mode, sampler = holding(planner), planner.sampler
    while len(sampler.handovers(mode, "left", "right")) < 8:
        sampler.sample_handover(mode, "left", "right")
    # The other hand is where this one would have to be.
    assert not any(c.promising for c in sampler.handovers(mode, "left", "right"))
    handed = Counter[int]()
    planner.orbit_guidance.guided = False
    sampler.sample_handover = lambda *_: []  # type: ignore[method-assign, assignment]
    for _ in range(200):
        for [c] in planner.sampling.sample_transitions(mode, [GIVE], improving=False):
            handed[id(c)] += 1
    known = {id(c) for c in sampler.handovers(mode, "left", "right")}
    assert set(handed) == known
    assert min(handed.values()) > 0.5 * np.mean(list(handed.values()))


def test_search_without_guidance_enters_what_seems_to_lead_nowhere(folder: Path) -> None:
    options = Options(persistent=1.0, without=frozenset({"skeletons"}))
    planner = Planner(relay(folder), seed=0, options=options)
    for _ in range(150):
        list(planner.improve(iterations=1))
        if planner.graphs.orbits_of.get((("bar", "right"),)):
            return
    raise AssertionError("handovers were sampled, and never taken")


def test_guidance_lets_candidates_that_seem_to_lead_nowhere_pass_in_the_end(folder: Path) -> None:
    planner = Planner(relay(folder), seed=0)
    mode = holding(planner)
    while not (found := planner.sampler.sample_handover(mode, "left", "right", directly=True)):
        pass
    before = planner.guidance.leads_on(mode, GIVE, found[0])
    for _ in range(10):
        planner.guidance.record(mode, GIVE, success=False)
    assert not before and planner.guidance.leads_on(mode, GIVE, found[0])


def test_what_faces_do_not_allow_leads_the_estimates_round(folder: Path) -> None:
    """Fabricated experience with a cube: picked from above only, put down from above only, never both hands there."""
    planner = Planner(cube_of_five_faces(folder))
    estimates, holds = planner.sampler.estimates, planner.sampler.holds
    for key in (("pick", ("right",), "cube", "start"), ("place", ("left",), "cube", "target")):
        # Out of reach.
        planner.sampler.outcome(key).calls += 5
    assert planner.guidance.remaining(planner.root.mode) == pytest.approx(3.0), "pick, handover, place"
    above = 5
    holds.note_families("left", "cube", "start", dict.fromkeys(range(20), 400), 0.1)
    grasps = {r: {holds.face(g): g for g in (draw(planner, r) for _ in range(200))} for r in ("left", "right")}
    holds.note_picks("left", "cube", "start", [grasps["left"][above]])
    for face, g in grasps["right"].items():
        for _ in range(40):
            holds.note_place(g, face == above)
    for _ in range(200):
        holds.note_exchange(grasps["left"][above], grasps["right"][above], False)
    assert planner.guidance.remaining(planner.root.mode) == pytest.approx(5.0), "three handovers"
    assert planner.guidance.transitions_to_go(planner.root.mode) == 5
    assert estimates.to_goal(grasps["right"][above]) == 1.0
    assert estimates.to_goal(grasps["right"][0]) == pytest.approx(3.0), "to the left hand and back"
    assert estimates.to_goal(grasps["left"][0]) == pytest.approx(2.0)
    held = planner.root.mode.replace(grasps["right"][0])
    assert planner.guidance.proposals(held)[0][1].kind == "handover", "not the place, which this grasp does not allow"


def cube_of_five_faces(folder: Path) -> Problem:
    """The same arms and places, a cube that could be grasped from above and from all sides."""
    problem = relay(folder)
    cube = MovableObject(
        "cube",
        "table",
        RigidTransform([-0.9, 0, 0.04]),
        "start",
        Shape("box", (0.04, 0.04, 0.04)),
        grasps=(AntipodalGrasps(("-z", "+x", "-x", "+y", "-y"), 0.01, (0.01, 0.02)),),
    )
    return Problem("cube", problem.robots, problem.statics, problem.supports, (cube,), (InRegion("cube", "target"),))


def draw(planner: Planner, robot: str) -> Attachment:
    families = planner.sampler.families[robot, "cube"]
    return planner.sampler.draw_grasp(robot, "cube", int(planner.rng.integers(len(families))))


def test_faces_are_where_hands_come_from(folder: Path) -> None:
    planner = Planner(cube_of_five_faces(folder))
    for number, family in enumerate(planner.sampler.families["left", "cube"]):
        (face,) = [f for f, known in enumerate(planner.sampler.holds.families["left", "cube"]) if number in known]
        X_OG = family.pose((family.lower + family.upper)[None] / 2)[0]
        # The palm is behind the grasp point, as seen along the hand's approach.
        palm = X_OG[:3, 3] - X_OG[:3, 2]
        assert abs(palm[face % 3]) == np.abs(palm).max() and (palm[face % 3] > 0) == (face >= 3)
        assert faces(inverse(X_OG)) == face


def test_explanation_of_a_regrasp_that_was_not_found_speaks_of_handovers(folder: Path) -> None:
    planner = Planner(relay(folder), seed=1, options=Options(without=frozenset({"skeletons"})))
    while not any(s == (("bar", "left"),) and orbits for s, orbits in planner.graphs.orbits_of.items()):
        list(planner.improve(iterations=1))
    while not planner.sampler.outcome(GIVE.key).samples:
        list(planner.improve(iterations=1))
    assert planner.best is None
    text = planner.explain()
    assert "bar (held by left)" in text
    assert "handover from left to right: " in text
    assert "no robot found a way to pick it up" not in text
    assert " 0 " not in text
