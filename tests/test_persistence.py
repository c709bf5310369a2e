"""Persistent exploration: whatever is feasible is tried again and again, however good the plan already is.

Refinement is on in these runs; skeletons, which have turns of their own, are off and shares are such that a run of some
seconds is long.  That search keeps its turns beside everything else is a property of `mrtamp.effort`, and shown once.
"""

from __future__ import annotations

from collections import Counter
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from arena import arena, visit
from gantry import gantry_model
from pydrake.math import RigidTransform

from mrtamp.check import check_plan
from mrtamp.guidance import Choice
from mrtamp.modes import Mode
from mrtamp.planner import _RAREST, Options, Planner
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

OPTIONS = Options(persistent=0.8, refinement_share=0.2, transition_samples=24, without=frozenset({"skeletons"}))


class Watched(Planner):
    """A planner that counts the active sets that persistent exploration draws, and what each draw could have been."""

    def __init__(self, problem: Problem, seed: int = 0) -> None:
        super().__init__(problem, seed=seed, options=OPTIONS)
        self.drawn = Counter[frozenset[str]]()
        self.possible: set[frozenset[str]] = set()
        draw = self.guidance.feasible_sets

        def counted(mode: Mode, rng: np.random.Generator) -> list[Choice]:
            choices = draw(mode, rng)
            self.drawn[active(choices)] += 1
            self.possible |= active_sets(self.guidance.enabled(mode))
            return choices

        self.guidance.feasible_sets = counted  # type: ignore[method-assign]

    def tallies(self) -> dict[str, Counter]:
        """How often every stratum was sampled, every active set drawn and every living orbit visited."""
        tree, graphs = self.tree, self.graphs
        return {
            "stratum": Counter({key: o.calls for key, o in self.sampler.outcomes.items() if o.accepted}),
            "active set": Counter({a: self.drawn[a] for a in self.possible}),
            "modal state": Counter(
                {s: graphs.modal.nodes[s]["visits"] for s, known in graphs.orbits_of.items() if known}
            ),
            "orbit": Counter({o: v for o, v in graphs.orbital.nodes(data="visits") if tree.of_orbit.get(o)}),
        }


def active(choices: list[Choice]) -> frozenset[str]:
    return frozenset(r for c in choices for r in c.robots)


def active_sets(choices: list[Choice]) -> set[frozenset[str]]:
    """By brute force for two robots: one choice, or two that share neither robot nor object."""
    out = {active([c]) for c in choices}
    for a, b in combinations(choices, 2):
        if not set(a.robots) & set(b.robots) and (not a.object or a.object != b.object):
            out.add(active([a, b]))
    return out


def assert_all_grow(planner: Watched, kinds: list[str], iterations: int, more: int) -> None:
    """What was feasible after so many iterations has been tried more often after so many more."""
    list(planner.improve(iterations=iterations))
    assert planner.best is not None and check_plan(planner.best).ok
    early = planner.tallies()
    list(planner.improve(iterations=more))
    late = planner.tallies()
    for kind in kinds:
        alive = [x for x in early[kind] if x in late[kind]]
        assert alive
        starved = [x for x in alive if late[kind][x] <= early[kind][x]]
        assert not starved, f"{kind}: {starved}"
    assert planner._effort.total["refinement"] > 0, "refinement took turns"


def visiting(folder: Path) -> Problem:
    """Two discs and three places: finitely many modes, so orbits too are finitely many but for what is not proved."""
    subgoals = [
        visit("one", "a", (0.0, 0.5)),
        visit("two", "b", (0.0, -0.5)),
        visit("three", "a", (0.5, -1.0)),
    ]
    return arena(folder, {"a": (-1, 0), "b": (1, 0)}, {"a": (-1, 0)}, subgoals=subgoals)


def carrying(folder: Path) -> Problem:
    """Two gantries and a bar that has to go to a target; there is room for it elsewhere, too."""
    model = gantry_model(folder)
    table = StaticBody("table", RigidTransform([0, 0, -0.02]), Shape("box", (2.0, 2.0, 0.04)))
    floor = Support("floor", "table", RigidTransform([0, 0, 0.02]), (1.2, 0.8))
    target = Support("target", "table", RigidTransform([0.2, 0.3, 0.02]), (0.1, 0.1), yaw=(-0.5, 0.5))
    grasps = (AntipodalGrasps(("-z",), 0.03, (0.01, 0.02)),)
    bar = Shape("box", (0.16, 0.04, 0.05))
    objects = tuple(
        MovableObject(name, "table", RigidTransform([x, y, 0.045]), "floor", bar, grasps=grasps)
        for name, x, y in (("red", 0.0, 0.0),)
    )
    homes = {"left": np.array([-0.5, 0.0, 0.3, 0.0]), "right": np.array([0.5, 0.0, 0.3, 0.0])}
    robots = tuple(Robot(name, model, RigidTransform(), q, q) for name, q in homes.items())
    return Problem("carrying", robots, (table,), (floor, target), objects, (InRegion("red", "target"),))


def test_orbits_strata_and_active_sets_of_discs_are_visited_for_ever(tmp_path: Path) -> None:
    planner = Watched(visiting(tmp_path))
    assert_all_grow(planner, ["orbit", "modal state", "stratum", "active set"], 60, 160)
    assert set(planner.tallies()["active set"]) == {frozenset("a"), frozenset("b"), frozenset("ab")}
    assert {key[0] for key in planner.sampler.outcomes} == {"reach"}


def test_strata_active_sets_and_modal_states_of_gantries_are_visited_for_ever(tmp_path: Path) -> None:
    """Every kind, robot and place: also taking away what is at its goal already, and putting it anywhere."""
    planner = Watched(carrying(tmp_path))
    assert_all_grow(planner, ["stratum", "active set"], 60, 160)
    tried = {key for key, o in planner.sampler.outcomes.items() if o.calls}
    for robot in ("left", "right"):
        for kind in ("pick", "place"):
            assert {(kind, (robot,), "red", "floor"), (kind, (robot,), "red", "target")} <= tried
    assert {key[0] for key in tried} == {"pick", "place", "handover"}


def test_every_orbit_and_every_modal_state_keeps_its_share_of_exploration(tmp_path: Path) -> None:
    """Half of the draws are uniform over living orbits, half over modal states."""
    planner = Watched(visiting(tmp_path))
    list(planner.improve(iterations=60))
    living = [o for o, nodes in planner.tree.of_orbit.items() if nodes]
    states = {planner.graphs.mode(o).state for o in living}
    n = 4000
    drawn = Counter(planner.orbit_guidance.any_orbit() for _ in range(n))
    assert set(drawn) == set(living)
    assert min(drawn.values()) > 0.5 * n / 2 / len(living)
    of_state = Counter[tuple]()
    for orbit, k in drawn.items():
        of_state[planner.graphs.mode(orbit).state] += k
    assert set(of_state) == states
    assert min(of_state.values()) > 0.5 * n / 2 / len(states)


def test_search_keeps_its_turns_beside_skeletons_and_refinement(tmp_path: Path) -> None:
    planner = Planner(carrying(tmp_path))
    list(planner.improve(iterations=10, first=True))
    assert planner.best is not None
    list(planner.improve(iterations=80))
    total = planner._effort.total
    least = {name: 0.5 * floor * 80 for name, floor in planner._effort.floors.items()}
    # What leads to nothing new, as in so small a problem, has its turn ever more rarely, but for ever.
    least["skeletons"] = min(least["skeletons"], 80 / 2**_RAREST)
    assert all(total[name] >= least[name] for name in total), total


@pytest.mark.parametrize("persistent", [0.1, 0.4])
def test_the_share_of_unguided_draws_is_the_option(tmp_path: Path, persistent: float) -> None:
    planner = Planner(visiting(tmp_path), options=Options(persistent=persistent, initial_vertices=2))
    draws = Counter[str]()
    planner.guidance.feasible_sets = lambda mode, rng: draws.update(["free"]) or []  # type: ignore[func-returns-value]
    n = 1500
    for _ in range(n):
        planner.orbit_guidance.choose(improving=False)
    assert draws["free"] / n == pytest.approx(persistent, abs=4 * np.sqrt(persistent * (1 - persistent) / n))
