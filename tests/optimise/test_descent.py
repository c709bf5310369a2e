"""Ways after their descent: exactly on their strata, never longer, and as short as a general solver makes them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from scipy.optimize import minimize

import mrtamp
from mrtamp.kinematics import inverse, rotation_vectors
from mrtamp.mechanisms import MECHANISMS
from mrtamp.optimise.descent import Descent, Shortened, Surroundings
from mrtamp.planner import Options, Planner
from mrtamp.tasks import pick_place
from mrtamp.transitions.families import residual
from mrtamp.transitions.ways import Way


def sampled(problem: mrtamp.Problem, seed: int = 0) -> Planner:
    """A planner with some sampled ways, none of which was shortened."""
    planner = Planner(problem, seed=seed, options=Options(initial_vertices=2))
    for _ in range(3):
        planner.skeletons.grow(60, 8)
    return planner


def shortened(planner: Planner, ways: list[Way], around: Mapping[str, Surroundings] | None = None):
    descent = Descent(planner.sampler, planner.portfolio.nearness)
    return descent.shorten(planner.skeletons.root, ways, {}, fixed=False, around=around)


def length(planner: Planner, q: list[Mapping[str, np.ndarray]]) -> float:
    """From home through the stops and back, summed over robots."""
    total, last = 0.0, {r: planner.roadmaps[r].world.home for stop in q for r in stop}
    home = dict(last)
    for stop in q:
        for r, x in stop.items():
            total += float(np.linalg.norm(x - last[r]))
            last[r] = x
    return total + sum(float(np.linalg.norm(last[r] - home[r])) for r in last)


def gaps(planner: Planner, way: Way, found: Shortened) -> np.ndarray:
    """How far (rad, m) the object is from where it was left, at every stop, through either attachment."""
    validity = planner.validity
    root = planner.root.mode
    attachments = [way.stops[0].before, *found.after]
    out = []
    for k, stop in enumerate(found.q):
        poses = []
        for a in attachments[k : k + 2]:
            if a.held:
                poses.append(planner.roadmaps[a.parent].world.tool.matrix(stop[a.parent][None])[0] @ a.X_PO)
            else:
                chain = root.chain(a.object) if a in root.attachments else (a,)
                poses.append(validity.world_pose(chain))
        D = inverse(poses[0][None])[0] @ poses[1]
        out.append(np.concatenate([rotation_vectors(D[None, :3, :3])[0], D[:3, 3]]))
    return np.abs(np.array(out))


def on_family(planner: Planner, found: Shortened) -> bool:
    """Whether every grasp belongs to a family of its robot, within its bounds."""
    for a in found.after:
        if not a.held:
            continue
        X = inverse(a.X_PO[None])
        fits = []
        for f in planner.sampler.families[a.parent, a.object]:
            c = f.coordinates(X)[0]
            inside = np.all(c >= f.lower - 1e-9) and np.all(c <= f.upper + 1e-9)
            fits.append(bool(inside) and np.abs(residual(f, X)).max() < 1e-9)
        if not any(fits):
            return False
    return True


@pytest.mark.parametrize("scene", ["pick_place", "box", "handover"])
def test_ways_stay_on_their_strata_and_become_no_longer(scene: str) -> None:
    planner = sampled(pick_place(2, 2) if scene == "pick_place" else mrtamp.load_problem(scene))
    gains = []
    for ways in planner.skeletons.ways.of.values():
        lengths, stages = shortened(planner, ways)
        for way, final, found in zip(ways, lengths, stages, strict=True):
            before = length(planner, [s.q for s in way.stops])
            for stage in found:
                assert gaps(planner, way, stage).max() < 1e-6
                assert on_family(planner, stage)
                for r, x in (pair for stop in stage.q for pair in stop.items()):
                    chain = planner.roadmaps[r].world.chain
                    assert np.all(x >= chain.lower) and np.all(x <= chain.upper)
            assert length(planner, found[0].q) <= before + 1e-9
            # What robots that meet lack of clearance weighs as well.
            assert length(planner, found[0].q) <= final + 1e-9
            gains.append(1 - length(planner, found[0].q) / before)
    assert np.median(gains) > 0.03


def test_the_descent_ends_where_a_general_solver_does() -> None:
    """One pick and place of a cube whose grasp may slide: SLSQP from the same start, on the same constraints."""
    planner = sampled(pick_place(1, 1))
    [ways] = planner.skeletons.ways.of.values()
    ways = sorted(ways, key=planner.skeletons.ways.length)[:3]
    [robot] = planner.roadmaps
    world = planner.roadmaps[robot].world
    home, tool = world.home, world.tool
    lengths, _ = shortened(planner, ways)
    n = len(home)
    for way, reached in zip(ways, lengths, strict=True):
        grasp = way.stops[0].after
        X_OG = inverse(grasp.X_PO[None])
        [family] = [
            f
            for f in planner.sampler.families[robot, grasp.object]
            if np.abs(residual(f, X_OG)).max() < 1e-9
            and np.all(f.coordinates(X_OG)[0] >= f.lower - 1e-9)
            and np.all(f.coordinates(X_OG)[0] <= f.upper + 1e-9)
        ]
        mode = planner.root.mode
        rest = [
            planner.validity.world_pose(mode.chain(grasp.object)),
            planner.validity.world_pose((way.stops[1].after,)),
        ]

        def cost(z: np.ndarray) -> float:
            a, b = z[:n], z[n : 2 * n]
            return float(np.linalg.norm(a - home) + np.linalg.norm(b - a) + np.linalg.norm(b - home))

        def closure(z: np.ndarray, family=family, rest=rest) -> np.ndarray:
            out = []
            X = family.pose(z[None, 2 * n :])[0]
            for x, X_WO in zip((z[:n], z[n : 2 * n]), rest, strict=True):
                D = inverse((X_WO @ X)[None]) @ tool.matrix(x[None])
                out += [*rotation_vectors(D[:, :3, :3])[0], *D[0, :3, 3]]
            return np.array(out)

        start = np.concatenate([way.stops[0].q[robot], way.stops[1].q[robot], family.coordinates(X_OG)[0]])
        chain = world.chain
        bounds = [*zip(chain.lower, chain.upper, strict=True)] * 2 + [*zip(family.lower, family.upper, strict=True)]
        solved = minimize(
            cost,
            start,
            method="SLSQP",
            bounds=bounds,
            constraints={"type": "eq", "fun": closure},
            options={"maxiter": 300},
        )
        assert np.abs(closure(solved.x)).max() < 1e-5
        assert reached <= solved.fun * 1.02, "within two per cent, in a few steps"


def test_what_comes_before_and_after_counts_as_much_as_it_is_weighed() -> None:
    planner = sampled(pick_place(1, 1))
    [ways] = planner.skeletons.ways.of.values()
    ways = sorted(ways, key=planner.skeletons.ways.length)[:8]
    [robot] = planner.roadmaps
    home = np.tile(planner.roadmaps[robot].world.home, (len(ways), 1))
    nowhere = np.full_like(home, np.nan)

    def first(weight: tuple[float, float, float], after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        around = {robot: Surroundings(home, after, np.tile(weight, (len(ways), 1)))}
        lengths, stages = shortened(planner, ways, around)
        approach = [float(np.linalg.norm(x[0].q[0][robot] - home[0])) for x in stages]
        return lengths, np.array(approach)

    closed, _ = first((1.0, 1.0, 1.0), home)
    open_ended, near = first((1.0, 1.0, 1.0), nowhere)
    assert np.all(open_ended < closed), "nobody has to come back"
    _, nearer = first((10.0, 1.0, 1.0), nowhere)
    assert nearer.mean() < near.mean(), "the way there matters most"


def test_handovers_are_shortened_without_bringing_the_robots_together() -> None:
    """Every one that is kept is a transition on the roadmaps, so both robots and what they hold keep clear."""
    planner = sampled(mrtamp.load_problem("handover"), seed=1)
    skeletons, descent = planner.skeletons, Descent(planner.sampler, planner.portfolio.nearness)
    before = {key: min(map(skeletons.ways.length, ways)) for key, ways in skeletons.ways.of.items()}
    known = {id(w) for ways in skeletons.ways.of.values() for w in ways}
    skeletons.shorten(descent, 20)
    for key, ways in skeletons.ways.of.items():
        new = [w for w in ways if id(w) not in known]
        assert new and all(w.shortened and w.stops[1].candidate is not None for w in new)
        assert min(map(skeletons.ways.length, new)) < 0.9 * before[key]
        giver, receiver = new[0].stops[1].robots
        for w in new:
            stop = w.stops[1]
            a, b = stop.q[giver][None], stop.q[receiver][None]
            assert planner.collision.first_hit(giver, a, stop.before, receiver, b, None) < 0
            assert planner.collision.first_hit(giver, a, None, receiver, b, stop.after) < 0


def test_skeletons_get_cheaper_by_it_and_it_can_be_switched_off() -> None:
    problem = mrtamp.load_problem("handover")
    planner = sampled(problem, seed=2)
    before = min(p.skeleton.cost for p in planner.skeletons.propose())
    descent = Descent(planner.sampler, planner.portfolio.nearness)
    planner.skeletons.shorten(descent, 20)
    alone = min(p.skeleton.cost for p in planner.skeletons.propose())
    planner.skeletons.shorten_proposed(descent, list(planner.skeletons.propose(effort=100)))
    together = min(p.skeleton.cost for p in planner.skeletons.propose())
    assert alone < 0.9 * before and together < alone

    assert "way-descent" in MECHANISMS
    without = Planner(problem, options=Options(without=frozenset({"way-descent"})))
    next(without.improve(iterations=400, first=True))
    assert not any(w.shortened for ways in without.skeletons.ways.of.values() for w in ways)
