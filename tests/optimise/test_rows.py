"""The rows of the program are derivatives: of Drake's distances, and of what transitions ask for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from discs import HEIGHT, RADIUS, Errands, disc_problem, errand
from gantry import gantry_problem, valid_plan
from pydrake.math import RigidTransform

from mrtamp.collision import Collision
from mrtamp.kinematics import inverse, rotation_vectors
from mrtamp.modes import object_poses
from mrtamp.optimise import Optimiser
from mrtamp.optimise.collisions import CollisionRows
from mrtamp.optimise.fine import knot_samples
from mrtamp.optimise.nearness import Near, Nearness, State
from mrtamp.plan import Plan
from mrtamp.problem import Shape, StaticBody
from mrtamp.transitions.families import grasp_families

STEP = 1e-5


def optimiser(plan: Plan, **keys) -> Optimiser:
    problem = plan.problem
    families = {
        (r.name, o.name): grasp_families(o, r.model.gripper.max_width) if r.model.gripper else []
        for r in problem.robots
        for o in problem.objects
    }
    return Optimiser(problem, Nearness(Collision(problem)), plan.segments, plan.transitions, families, **keys)


def rows(scp: Optimiser) -> CollisionRows:
    return scp.collisions.rows(scp._now.line, scp._now.q, scp._now.arrangement)


@pytest.fixture
def gantries(tmp_path: Path) -> Optimiser:
    return optimiser(valid_plan(gantry_problem(tmp_path)))


def keyed(near: Near) -> dict[tuple[int, int, int], float]:
    """Distances by sample and carriers, where the two carriers are near each other once only."""
    keys = list(zip(near.sample.tolist(), near.a.tolist(), near.b.tolist(), strict=True))
    return {k: d for k, d in zip(keys, near.distance.tolist(), strict=True) if keys.count(k) == 1}


def turned(now, scale: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A small generic displacement of knots and coordinates."""
    return now.q + scale * rng.normal(size=now.q.shape), now.arrangement.c + 0.2 * scale * rng.normal(
        size=now.arrangement.c.shape
    )


def test_distance_rows_are_derivatives_of_drakes_distances(gantries: Optimiser) -> None:
    rng = np.random.default_rng(0)
    now, nearness = gantries._now, gantries.nearness
    line = now.line
    samples = knot_samples(line, np.full(line.knots - 1, 2))
    # Off the start: parallel faces have no unique witness points.
    q, c = turned(now, 0.03, rng)
    dq, dc = rng.normal(size=q.shape), 0.2 * rng.normal(size=c.shape)

    def states(h: float, who: tuple[str, ...]) -> dict[str, State]:
        modes = gantries.choices.at(c + h * dc).modes
        return {r: nearness.state(r, (q + h * dq)[:, line.columns[r]], samples, modes) for r in who}

    def ask(h: float, who: tuple[str, ...]) -> Near:
        arrangement, at = gantries.choices.at(c + h * dc), states(h, who)
        if len(who) == 1:
            return nearness.world(who[0], at[who[0]], samples, arrangement, 0.15)
        return nearness.between((who[0], who[1]), (at[who[0]], at[who[1]]), samples, arrangement, 0.3)

    for who in (("left",), ("right",), ("left", "right")):
        near = ask(0.0, who)
        A = gantries.collisions.gradient(line, samples, near, states(0.0, who), gantries.choices.at(c))
        slopes = dict(
            zip(
                zip(near.sample.tolist(), near.a.tolist(), near.b.tolist(), strict=True),
                (A @ np.concatenate([dq.reshape(-1), dc])).tolist(),
                strict=True,
            )
        )
        plus, minus, here = keyed(ask(STEP, who)), keyed(ask(-STEP, who)), keyed(near)
        errors = [
            abs((plus[k] - minus[k]) / (2 * STEP) - slopes[k])
            for k in here
            # Where the nearest features change, there is no derivative; inside each other Drake is less accurate.
            if k in plus and k in minus and here[k] > 1e-3 and abs(plus[k] + minus[k] - 2 * here[k]) < 3e-8
        ]
        assert len(errors) > 20
        assert np.quantile(errors, 0.9) < 2e-3


def test_rows_of_held_and_resting_objects_are_among_them(gantries: Optimiser) -> None:
    collisions = rows(gantries)
    coordinates = collisions.A[:, gantries._now.q.size :]
    assert (np.abs(coordinates).sum(axis=0) > 0).sum() >= 5


def jumps(optimiser: Optimiser, q: np.ndarray, c: np.ndarray) -> np.ndarray:
    """By how much (m, rad) objects jump at transitions, were robots at knots q and choices at c."""
    line, arrangement = optimiser._now.line, optimiser.choices.at(c)
    out = []
    for e, transition in enumerate(arrangement.transitions):
        X_WP = dict(optimiser.choices.X_WB)
        for r, cols in line.columns.items():
            X_WP[r] = optimiser.worlds[r].tool.matrix(q[None, line.events[e], cols])[0]
        one, two = (object_poses(arrangement.modes[e + k], X_WP) for k in (0, 1))
        for action in transition.actions:
            D = inverse(one[action.object][None]) @ two[action.object][None]
            out += [rotation_vectors(D[:, :3, :3])[0], D[0, :3, 3]]
    return np.concatenate(out)


def test_closure_rows_span_the_derivative_of_the_jumps(gantries: Optimiser) -> None:
    rng = np.random.default_rng(1)
    now = gantries._now
    E, count = gantries._reduction.E, gantries.choices.count
    assert count >= 8
    C = gantries._stacked(gantries._closure.equalities(now.q, now.arrangement), E.shape[1] + count)[0].toarray()
    x = rng.normal(size=C.shape[1])
    along = x - np.linalg.pinv(C) @ (C @ x)

    def jump(direction: np.ndarray, h: float) -> float:
        q = now.q + h * (E @ direction[: E.shape[1]]).reshape(now.q.shape)
        c = now.arrangement.c + h * gantries.choices.scale * direction[E.shape[1] :]
        return float(np.abs(jumps(gantries, q, c)).max())

    assert jump(along, 0.0) < 1e-9
    assert jump(along, 1e-4) < 1e-6
    assert jump(x, 1e-4) > 3e-5


def test_projection_closes_what_the_linear_step_leaves_open(gantries: Optimiser) -> None:
    rng = np.random.default_rng(2)
    now = gantries._now
    E, count = gantries._reduction.E, gantries.choices.count
    C = gantries._stacked(gantries._closure.equalities(now.q, now.arrangement), E.shape[1] + count)[0].toarray()
    x = rng.normal(size=C.shape[1])
    x -= np.linalg.pinv(C) @ (C @ x)
    q = now.q + 0.02 * (E @ x[: E.shape[1]]).reshape(now.q.shape)
    c = np.clip(now.arrangement.c + 0.02 * gantries.choices.scale * x[E.shape[1] :], *gantries.choices.bounds)
    projected = gantries._closure.project(q, gantries.choices.at(c))
    assert projected is not None
    assert np.abs(jumps(gantries, projected, c)).max() < 1e-6


def test_prismatic_robots_without_gripper_have_rows_too(tmp_path: Path) -> None:
    discs = optimiser(errand(disc_problem(tmp_path)))
    collisions = rows(discs)
    assert collisions.A.shape[0] == len(collisions.gap)
    assert isinstance(discs.nearness, Nearness)


def test_finer_levels_look_at_more_samples_of_every_step(gantries: Optimiser) -> None:
    coarse = rows(gantries)
    gantries.collisions.level = 1
    fine = rows(gantries)
    steps = gantries._now.line.knots - 1
    for who, distance in coarse.clearance.items():
        assert distance.shape == (steps, 3)
        assert fine.clearance[who].shape == (steps, 5)
        assert fine.clearance[who][:, ::2] == pytest.approx(distance), "those it had are among them"


@pytest.mark.parametrize(("height", "within", "lost"), [(0.06, 0.02, False), (0.06, 0.3, True), (2.0, 0.3, False)])
def test_no_joint_leads_out_of_what_is_flat_across_the_plane(
    tmp_path: Path, height: float, within: float, lost: bool
) -> None:
    """Far within a block that is flat, the shortest way out is above it, where a disc never goes."""
    block = StaticBody("block", RigidTransform([0, 1.2, HEIGHT - 0.05]), Shape("box", (1.0, 1.0, height)))
    problem = replace(disc_problem(tmp_path), subgoals=(), goal=(), statics=(block,))
    plan = Errands(problem).move(a=(-1.2, -0.5)).move(a=(-1.2, 1.2)).move(a=(within - 0.5 - RADIUS, 1.2)).plan()
    found = rows(optimiser(plan, draft=True))
    assert found.deepest(0.0) == pytest.approx(min(within, height / 2), abs=1e-3)
    assert found.lost(0.0) is lost
    assert not found.lost(tolerance=height), "what is tolerated may be so"
