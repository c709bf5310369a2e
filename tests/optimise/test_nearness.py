"""What is near, measured all at once, is what Drake finds in the same plants one sample at a time."""

from __future__ import annotations

import numpy as np
import pytest

from mrtamp.collision import Collision
from mrtamp.modes import Attachment, Mode, start_mode
from mrtamp.optimise.choices import Choices
from mrtamp.optimise.nearness import Near, Nearness, Samples, closest_points
from mrtamp.problem import Problem
from mrtamp.problem_file import load_problem, problem_from_dict
from mrtamp.problem_writer import problem_to_dict
from mrtamp.transitions.families import grasp_families

REACH = 0.06


def drakes(scene, context, rows: np.ndarray, reach: float) -> list[list[tuple[float, str]]]:
    """Distances and names of geometries, per row, sorted."""
    out = []
    for row in rows:
        scene.plant.SetPositions(context, row)
        query = scene.plant.get_geometry_query_input_port().Eval(context)
        found = query.ComputeSignedDistancePairwiseClosestPoints(reach)
        out.append(sorted(p.distance for p in found))
    return out


def by_sample(near: Near, n: int) -> list[list[float]]:
    return [sorted(near.distance[near.sample == k].tolist()) for k in range(n)]


def agree(ours: list[float], theirs: list[float]) -> bool:
    """Drake iterates where capsules are involved and is up to 0.3 mm off there; the deeper, the less it agrees."""
    cut = REACH - 1e-3
    a, b = (np.array([d for d in x if -5e-3 < d < cut]) for x in (ours, theirs))
    return len(a) == len(b) and (not len(a) or np.abs(a - b).max() < 1e-3)


@pytest.fixture(scope="module", params=["boxes", "cylinders"])
def problem(request: pytest.FixtureRequest) -> Problem:
    """Two arms and two objects; cylinders are no rounded boxes, so that Drake is asked about those."""
    data = problem_to_dict(load_problem("pick_place", robots=2, objects=2))
    if request.param == "cylinders":
        for item in data["objects"]:
            item["shape"] = {"cylinder": [0.025, 0.05]}
            item["grasps"] = [{"antipodal": {"approach": ["-z"]}}]
    return problem_from_dict(data)


def held_mode(problem: Problem) -> Mode:
    """The first robot holds the first object."""
    robot, item = problem.robots[0], problem.objects[0]
    family = grasp_families(item, robot.model.gripper.max_width)[0]
    X_OG = family.pose(np.zeros((1, len(family.lower))))[0]
    held = Attachment(item.name, robot.name, np.linalg.inv(X_OG), None, family.width)
    start = start_mode(problem)
    return Mode(tuple(held if a.object == item.name else a for a in start.attachments), start.done)


def test_robots_and_what_they_hold_against_the_world_and_each_other(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Distances are Drake's, to shapes without the padding that the planner's plants have."""
    rng = np.random.default_rng(0)
    collision = Collision(problem)
    nearness = Nearness(collision)
    modes = [start_mode(problem), held_mode(problem)]
    choices = Choices(problem, modes, [], {})
    choices.freeze()
    arrangement = choices.at(np.zeros(0))
    n = 160
    samples = Samples(np.arange(n), np.zeros(n), np.repeat([0, 1], n // 2))
    names = [r.name for r in problem.robots]
    q = {r.name: r.home + rng.normal(scale=0.7, size=(n, len(r.home))) for r in problem.robots}
    states = {r: nearness.state(r, q[r], samples, modes) for r in names}
    matches = []
    for robot in names:
        world = collision.worlds[robot]
        ours = by_sample(nearness.world(robot, states[robot], samples, arrangement, REACH), n)
        rows = np.concatenate(
            [
                world.rows(q[robot][samples.segment == s], mode.held.get(robot), arrangement.resting(mode))
                for s, mode in enumerate(modes)
            ]
        )
        theirs = drakes(world.scene, world.context, rows, REACH)
        assert sum(map(len, theirs)) > 100
        matches += [agree(a, b) for a, b in zip(ours, theirs, strict=True)]
    monkeypatch.setattr("mrtamp.collision.PADDING", 0.0)
    pair, swapped = Collision(problem).pair(*names)
    assert not swapped
    ours = by_sample(
        nearness.between((names[0], names[1]), (states[names[0]], states[names[1]]), samples, arrangement, REACH), n
    )
    rows = np.concatenate(
        [
            nearness.pair_rows(
                names[0], names[1], q[names[0]][samples.segment == s], q[names[1]][samples.segment == s], mode
            )
            for s, mode in enumerate(modes)
        ]
    )
    theirs = drakes(pair.scene, pair.context, rows, REACH)
    assert sum(map(len, theirs)) > 20
    matches += [agree(a, b) for a, b in zip(ours, theirs, strict=True)]
    assert np.mean(matches) > 0.98


class Flaky:
    """A query whose search for distances fails: for all pairs at once, and for one of them alone."""

    def __init__(self, query, fails: tuple) -> None:
        self.query = query
        self.fails = fails

    def inspector(self):
        return self.query.inspector()

    def ComputeSignedDistancePairwiseClosestPoints(self, reach: float):
        raise RuntimeError("maximum number of iterations")

    def ComputeSignedDistancePairClosestPoints(self, a, b):
        if {a, b} == set(self.fails):
            raise RuntimeError("maximum number of iterations")
        return self.query.ComputeSignedDistancePairClosestPoints(a, b)


def test_where_drake_finds_no_distance_the_other_pairs_are_measured_all_the_same() -> None:
    problem = load_problem("pick_place", robots=2, objects=2)
    world = next(iter(Collision(problem).worlds.values()))
    scene = world.scene
    row = world.rows(world.home[None], None, {})[0]
    scene.plant.SetPositions(world.context, row)
    query = scene.plant.get_geometry_query_input_port().Eval(world.context)
    every = {g for pair in query.inspector().GetCollisionCandidates() for g in pair}
    reach = 0.2
    whole = {(p.id_A, p.id_B): p.distance for p in closest_points(query, reach, every)}
    assert len(whole) > 1
    lost, *_ = whole
    found = {(p.id_A, p.id_B): p.distance for p in closest_points(Flaky(query, lost), reach, every)}
    assert found.keys() == whole.keys() - {lost}
    assert all(abs(found[pair] - whole[pair]) < 1e-6 for pair in found)
    assert not closest_points(Flaky(query, lost), reach, set()), "only pairs of those that were asked for"
