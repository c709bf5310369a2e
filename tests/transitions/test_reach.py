"""Reach strata: ranks and dimensions as measured, samples at the target and all over it, what arrival attaches."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from arena import Parts, arena
from discs import HEIGHT, disc_problem
from pydrake.math import RigidTransform, RollPitchYaw

from mrtamp.modes import Mode, object_poses
from mrtamp.planner import Options, Planner
from mrtamp.problem import (
    WORLD,
    AtConfiguration,
    Attach,
    HandAt,
    HandIn,
    MovableObject,
    Problem,
    Shape,
    Subgoal,
    Target,
)
from mrtamp.problem_file import problem_from_dict
from mrtamp.transitions.projection import uniform_configurations
from mrtamp.transitions.reach import ReachTarget
from mrtamp.transitions.sampler import TransitionSampler

HAND = RigidTransform(RollPitchYaw(np.pi, 0.1, 0.3), [0.45, 0.1, 0.35])
SQUARE = RigidTransform(RollPitchYaw(0.4, 0.2, 1.0), [0.4, 0.0, 0.4])
"""A box that is turned against the world."""


@pytest.fixture(scope="module")
def panda() -> Planner:
    data = {
        "mrtamp": 1,
        "name": "reach",
        "robots": [{"name": "arm", "model": "panda"}],
        "goal": [{"robot": "arm", "at": "home"}],
    }
    return Planner(problem_from_dict(data), options=Options(initial_vertices=2))


def targets(planner: Planner) -> dict[str, tuple[Target, int]]:
    """One target of every kind, and its rank."""
    home = planner.problem.robots[0].home
    return {
        "configuration": (AtConfiguration(home), 7),
        "pose": (HandAt(HAND), 6),
        "point": (HandIn(SQUARE, (0.0, 0.0, 0.0)), 3),
        "line": (HandIn(SQUARE, (0.3, 0.0, 0.0)), 2),
        "square": (HandIn(SQUARE, (0.3, 0.0, 0.2)), 1),
        "box": (HandIn(SQUARE, (0.3, 0.2, 0.2)), 0),
    }


KINDS = ("configuration", "pose", "point", "line", "square", "box")


def sampled(planner: Planner, kind: str, n: int, seed: int = 0) -> tuple[ReachTarget, np.ndarray]:
    """A target and samples at it."""
    roadmap = planner.roadmaps["arm"]
    target = ReachTarget(roadmap.world.tool, targets(planner)[kind][0])
    q, on = target.sample(np.random.default_rng(seed), n, roadmap.world.home[None])
    return target, q[on]


@pytest.mark.parametrize("kind", KINDS)
def test_rank_and_dimension_are_those_of_the_jacobian_at_samples(panda: Planner, kind: str) -> None:
    target, q = sampled(panda, kind, 100)
    rank = targets(panda)[kind][1]
    assert len(q) >= 1
    assert (target.rank, target.dimension) == (rank, 7 - rank)
    assert target.h(q).shape == (len(q), rank)
    for D in target.jacobian(q):
        assert np.linalg.matrix_rank(D, tol=1e-4) == rank


@pytest.mark.parametrize("kind", KINDS)
def test_samples_lie_at_the_target(panda: Planner, kind: str) -> None:
    target, q = sampled(panda, kind, 100)
    assert np.abs(target.h(q)).max(initial=0.0) < 1e-6
    assert target.contains(q).all()
    chain = panda.roadmaps["arm"].world.chain
    assert np.all((q >= chain.lower) & (q <= chain.upper))
    X_WG = panda.roadmaps["arm"].world.tool.matrix(q)
    if kind == "pose":
        np.testing.assert_allclose(X_WG, np.tile(HAND.GetAsMatrix4(), (len(q), 1, 1)), atol=1e-5)
    elif kind != "configuration":
        half = np.array(targets(panda)[kind][0].size) / 2
        local = (X_WG[:, :3, 3] - SQUARE.translation()) @ SQUARE.rotation().matrix()
        assert np.all(np.abs(local) <= half + 1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_moved_off_the_target_is_not_at_it(panda: Planner, kind: str) -> None:
    target, q = sampled(panda, kind, 60)
    if kind == "box":
        far = uniform_configurations(panda.roadmaps["arm"].world.tool, np.random.default_rng(3), 400)
        p = panda.roadmaps["arm"].world.tool.pose(far)[1] - SQUARE.translation()
        outside = np.linalg.norm(p, axis=1) > 0.3
        assert not target.contains(far[outside]).any()
        return
    D = target.jacobian(q[:1])[0]
    assert not target.contains(q[:1] + 0.05 * D[0] / np.linalg.norm(D[0])).any()


def test_a_square_is_covered_all_over_and_its_postures_too(panda: Planner) -> None:
    target, q = sampled(panda, "square", 3000)
    p = panda.roadmaps["arm"].world.tool.pose(q)[1]
    local = (p - SQUARE.translation()) @ SQUARE.rotation().matrix()
    counts, _, _ = np.histogram2d(local[:, 0], local[:, 2], bins=3, range=[(-0.15, 0.15), (-0.1, 0.1)])
    # Half of the samples are uniform as far as IK succeeds, so no ninth has less than a third of its part of those.
    assert counts.min() >= len(q) / 2 / 9 / 3
    elbows = np.histogram(q[:, 2], bins=4, range=(-2.0, 2.0))[0]
    assert elbows.min() >= 0.02 * len(q)
    assert target.dimension == 6


def test_samples_near_known_vertices_and_anywhere_both_occur(panda: Planner) -> None:
    """Half of the seeds come from `near`; the other half keeps the whole set of postures reachable."""
    _, q = sampled(panda, "pose", 600)
    different = np.unique(q.round(4), axis=0)
    assert len(different) > 0.3 * len(q)
    spread = [np.linalg.norm(a - b) for a, b in combinations(different[::4], 2)]
    assert np.median(spread) > 1.0
    assert len(different) < 0.7 * len(q), "from the only known vertex there is one way to go"


def meeting_problem(folder: Path) -> Problem:
    """Two discs meet: a on a line, b at a point; the ranks of a subgoal's robots add."""
    line = HandIn(RigidTransform([-0.5, 0, HEIGHT]), (0.4, 0.0, 0.1))
    subgoal = Subgoal("meet", {"a": line, "b": AtConfiguration(np.array([0.5, 0.0]))})
    return arena(folder, {"a": (-1, -1), "b": (1, -1)}, subgoals=[subgoal])


def sampler_of(problem: Problem) -> tuple[Parts, TransitionSampler]:
    parts = Parts(problem)
    return parts, TransitionSampler(problem, parts.collision, parts.roadmaps, parts.validity, parts.rng)


def test_discs_have_two_joints_so_ranks_are_those_that_matter(tmp_path: Path) -> None:
    _, sampler = sampler_of(meeting_problem(tmp_path))
    line, point = (sampler.reaching.targets["meet"][r] for r in "ab")
    assert (line.rank, line.dimension) == (1, 1)
    assert (point.rank, point.dimension) == (2, 0)
    q, on = line.sample(np.random.default_rng(0), 400, np.zeros((1, 2)))
    np.testing.assert_allclose(q[on, 1], 0.0, atol=1e-6)
    assert [np.linalg.matrix_rank(D, tol=1e-6) for D in line.jacobian(q[:5])] == [1] * 5
    counts = np.histogram(q[on, 0], bins=5, range=(-0.69, -0.31))[0]
    assert counts.min() >= 5, "all over the line, although the box is thicker than the plane in which the disc moves"


def test_candidates_are_combinations_of_vertices_at_the_targets_and_are_kept(tmp_path: Path) -> None:
    problem = meeting_problem(tmp_path)
    parts, sampler = sampler_of(problem)
    [subgoal] = problem.subgoals
    reaching = sampler.reaching
    total = 0
    for _ in range(10):
        fresh = reaching.sample(parts.root, subgoal, 30)
        total += len(fresh)
        for c in fresh:
            assert (c.kind, c.robots, c.subgoal) == ("reach", ("a", "b"), "meet")
            for robot, v in c.at.items():
                assert reaching.targets["meet"][robot].contains(parts.roadmaps[robot].q[[v]]).all()
    known = reaching.known(parts.root, subgoal)
    assert len(known) == total >= 10
    assert len({tuple(sorted(c.at.items())) for c in known}) == total, "each of them once"
    assert len({c.at["b"] for c in known}) == 1, "a configuration is one vertex, however often it is sampled"
    stats = sampler.outcomes["reach", ("a", "b"), "", "meet"]
    assert stats.calls == 10 and stats.accepted == total
    xs = np.array([parts.roadmaps["a"].q[c.at["a"]][0] for c in known])
    assert np.histogram(xs, bins=2, range=(-0.7, -0.3))[0].min() >= 1, "both halves of the line"


def world_pose(parts: Parts, mode: Mode, q: dict[str, np.ndarray]) -> np.ndarray:
    X_WP = {WORLD: np.eye(4)} | {r: RigidTransform([*x, HEIGHT]).GetAsMatrix4() for r, x in q.items()}
    return object_poses(mode, X_WP)["token"]


def test_on_arrival_the_object_keeps_its_pose_and_changes_its_parent(tmp_path: Path) -> None:
    problem = disc_problem(tmp_path)
    parts, sampler = sampler_of(problem)
    take, drop = problem.subgoal("take"), problem.subgoal("drop")
    X_start = world_pose(parts, parts.root, {})
    [grabbed, *_] = sampler.reaching.sample(parts.root, take, 30)
    held = parts.root.replace(grabbed.after, done=["take"])
    assert grabbed.before is parts.root.of["token"]
    assert held.held["b"] is grabbed.after and grabbed.after.width is None
    there = {"b": parts.roadmaps["b"].q[grabbed.at["b"]]}
    np.testing.assert_allclose(world_pose(parts, held, there), X_start, atol=1e-9)
    [let_go, *_] = sampler.reaching.sample(held, drop, 30)
    here = {"b": parts.roadmaps["b"].q[let_go.at["b"]]}
    down = held.replace(let_go.after, done=["drop"])
    assert let_go.after.support == "at drop" and let_go.after.parent == WORLD
    np.testing.assert_allclose(world_pose(parts, down, here), world_pose(parts, held, here), atol=1e-9)


def test_the_same_arrival_gives_the_very_same_attachment(tmp_path: Path) -> None:
    """Identity is what a mode is known by: the search must meet the same mode again."""
    problem = disc_problem(tmp_path)
    parts, sampler = sampler_of(problem)
    take = problem.subgoal("take")
    [c, *_] = sampler.reaching.sample(parts.root, take, 30)
    assert sampler.reaching.candidate(parts.root, take, c.at).after is c.after
    assert all(k.after is c.after for k in sampler.reaching.known(parts.root, take) if k.at == c.at)


def test_a_subgoal_is_enabled_when_its_predecessors_are_done_and_its_object_is_at_hand(tmp_path: Path) -> None:
    problem = disc_problem(tmp_path)
    parts, sampler = sampler_of(problem)
    enabled = sampler.reaching.enabled
    names = lambda mode: {s.name for s in problem.subgoals if enabled(mode, s)}  # noqa: E731
    assert names(parts.root) == {"visit", "take"}
    [c, *_] = sampler.reaching.sample(parts.root, problem.subgoal("take"), 30)
    held = parts.root.replace(c.after, done=["take"])
    assert names(held) == {"visit", "drop"}
    assert names(held.replace(done=["visit", "drop"])) == set()


def test_who_has_full_hands_takes_nothing(tmp_path: Path) -> None:
    box = Shape("box", (0.1, 0.1, 0.1))
    objects = [
        MovableObject(name, WORLD, RigidTransform([x, 0.5, HEIGHT]), None, box) for name, x in (("one", 0), ("two", 1))
    ]
    here = {"a": AtConfiguration(np.zeros(2))}
    subgoals = [Subgoal(f"take {n}", here, (), Attach(n, "a")) for n in ("one", "two")]
    problem = arena(tmp_path, {"a": (-1, -1)}, subgoals=subgoals, objects=objects)
    parts, sampler = sampler_of(problem)
    [c, *_] = sampler.reaching.sample(parts.root, subgoals[0], 5)
    full = parts.root.replace(c.after, done=["take one"])
    assert sampler.reaching.enabled(parts.root, subgoals[1])
    assert not sampler.reaching.enabled(full, subgoals[1])
