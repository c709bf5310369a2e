"""Small collision plants: bisection order, held objects, contact allowances, bounds that enclose, padding."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from gantry import gantry_model, gantry_problem, gantry_urdf, grasp

from mrtamp.collision import CONTACT_DEPTH, PADDING, Collision, Counts, bisection_order
from mrtamp.modes import Attachment, start_mode
from mrtamp.problem import Gripper, Problem
from mrtamp.scene import build_scene, geometry_ids


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return gantry_problem(tmp_path_factory.mktemp("gantry"))


@pytest.fixture(scope="module")
def collision(problem: Problem) -> Collision:
    return Collision(problem)


def resting(problem: Problem) -> dict[str, np.ndarray]:
    X_WB = {s.name: s.X_WB.GetAsMatrix4() for s in problem.statics}
    return {a.object: X_WB[a.parent] @ a.X_PO for a in start_mode(problem).attachments}


@pytest.mark.parametrize("n", [1, 2, 3, 4, 7, 64, 101])
def test_bisection_order_is_a_permutation_that_halves_gaps(n: int) -> None:
    order = bisection_order(n)
    assert sorted(order) == list(range(n))
    if n > 4:
        assert set(order[:3]) == {0, n - 1, (n - 1) // 2}
        first = np.sort(order[: n // 2 + 1])
        assert np.diff(first).max() <= 4


def test_a_hand_around_a_cube_is_free_and_one_through_it_is_not(problem: Problem, collision: Collision) -> None:
    """The open fingers (8 cm) straddle the 4 cm cube; 3 cm aside they are in it; above it everything is free."""
    world = collision.worlds["left"]
    q = np.array(
        [[-0.4, 0, 0.04, 0], [-0.4, 0.03, 0.04, 0], [-0.4, 0.03, 0.2, 0], [-0.4, 0, 0.005, 0], [0, 0.6, 0.1, 0]]
    )
    rows = world.rows(q, None, resting(problem))
    np.testing.assert_array_equal(world.hits(rows), [False, True, False, True, True])
    assert world.first_hit(rows[[0, 2, 4, 1]]) == 2
    assert world.first_hit(rows[[0, 2]]) == -1
    assert world.culprits(rows[4])[0] in [("left", "wall"), ("wall", "left")]
    assert {x for pair in world.culprits(rows[1]) for x in pair} == {"left", "cube"}


def test_objects_that_are_not_named_are_not_there(problem: Problem, collision: Collision) -> None:
    world = collision.worlds["left"]
    q = np.array([[-0.4, 0.03, 0.04, 0]])
    assert world.hits(world.rows(q, None, {}))[0] == np.False_
    assert world.hits(world.rows(q, None, resting(problem)))[0] == np.True_
    assert world.hits(world.rows(q, None, {}))[0] == np.False_, "nothing is remembered"


def test_a_held_object_may_touch_its_hand_and_what_it_stands_on_and_nothing_else(
    problem: Problem, collision: Collision
) -> None:
    world = collision.worlds["left"]
    held = grasp("cube", "left")
    # The cube's centre is 1 cm below the grasp point, its bottom 4 cm: it touches the table at z = 0.04.
    heights = np.array([0.05, 0.04 - CONTACT_DEPTH / 2, 0.04 - 2 * CONTACT_DEPTH])
    q = np.column_stack([np.full(3, -0.2), np.zeros(3), heights, np.zeros(3)])
    rows = world.rows(q, held, {})
    np.testing.assert_array_equal(world.hits(rows), [False, True, True])
    slot = world.slot_of["cube"]
    assert [world.first_hit(row[None], "table", slot) for row in rows] == [-1, -1, 0]
    assert world.first_hit(rows[1:2], "wall", slot) == 0, "that is not what it touches"
    beside = world.rows(np.array([[-0.4, 0.27, 0.06, 0]]), held, resting(problem))
    assert world.first_hit(beside) == 0
    assert {slot, "block"} in [set(pair) for pair in world.culprits(beside[0])]


def test_equal_shapes_share_a_slot(collision: Collision) -> None:
    slots = collision.worlds["left"].slot_of
    assert slots["cube"] == slots["block"] != slots["bar"]


def test_pairs_agree_in_both_orders(problem: Problem, collision: Collision) -> None:
    rng = np.random.default_rng(0)
    qa = np.column_stack([rng.uniform(-0.3, 0.3, (60, 2)), np.full(60, 0.3), rng.uniform(-3, 3, 60)])
    qb = np.column_stack([rng.uniform(-0.3, 0.3, (60, 2)), np.full(60, 0.3), rng.uniform(-3, 3, 60)])
    held = grasp("bar", "left", offset=0.05)
    pair, swapped = collision.pair("left", "right")
    again, other = collision.pair("right", "left")
    assert pair is again
    assert not swapped and other
    hits = [pair.first_hit(a[None], held, b[None], None) for a, b in zip(qa, qb, strict=True)]
    assert -1 in hits and 0 in hits
    loaded = [pair.first_hit(a[None], None, b[None], None) for a, b in zip(qa, qb, strict=True)]
    assert all(h == 0 for h, bare in zip(hits, loaded, strict=True) if bare == 0), "a load adds collisions"
    assert hits != loaded


def test_arms_are_padded_between_robots_by_3_mm_and_hands_are_not(problem: Problem, collision: Collision) -> None:
    """All of the gantry that can touch is its hand, so palms meet exactly: 12 cm of width."""
    pair, _ = collision.pair("left", "right")

    def meet(gap: float) -> bool:
        y = 0.12 + gap
        q = np.array([[0.0, 0.0, 0.3, 0.0]])
        return pair.first_hit(q, None, q + np.array([0, y, 0, 0]), None) == 0

    assert meet(-0.001) and not meet(0.001)
    arm = dataclasses.replace(problem.robots[0].model.gripper, bodies=("finger_left", "finger_right"))
    padded = dataclasses.replace(
        problem,
        robots=tuple(dataclasses.replace(r, model=dataclasses.replace(r.model, gripper=arm)) for r in problem.robots),
    )
    pair, _ = Collision(padded).pair("left", "right")
    assert meet(2 * PADDING - 0.0005) and not meet(2 * PADDING + 0.0005)


@pytest.mark.parametrize("jaws", ["two", "one"])
def test_bounding_spheres_hold_everything_at_every_opening(tmp_path: Path, jaws: str) -> None:
    """Also of a gripper of which one finger travels the whole opening."""
    text = gantry_urdf()
    model = gantry_model(tmp_path)
    if jaws == "one":
        (tmp_path / "gantry.urdf").write_text(text.replace('upper="0.04"', 'upper="0.08"'))
        gripper = Gripper(("tool", "finger_left", "finger_right"), {"open_left": 1.0, "open_right": 0.0}, 0.08)
        model = dataclasses.replace(model, gripper=gripper)
    problem = gantry_problem(tmp_path)
    problem = dataclasses.replace(
        problem, robots=tuple(dataclasses.replace(r, model=model) for r in problem.robots), objects=(), goal=()
    )
    world = Collision(problem).worlds["left"]
    scene = build_scene(problem, robots=["left"])
    _, context = scene.context()
    q = np.array([[0.1, 0.2, 0.3, 0.4]])
    centres = dict(zip(world.bounds.bodies, world.bounds.spheres(q)[0], strict=True))
    radii = dict(zip(world.bounds.bodies, world.bounds.radii, strict=True))
    inspector = scene.scene_graph.model_inspector()
    in_scene = scene.robots["left"]
    for width in np.linspace(0, 0.08, 5):
        positions = scene.plant.GetPositions(context)
        positions[in_scene.arm], positions[in_scene.fingers] = q[0], in_scene.finger_positions(width)
        scene.plant.SetPositions(context, positions)
        for name in world.bounds.bodies:
            body = scene.plant.GetBodyByName(name)
            for g in geometry_ids(scene.plant, [body]):
                half = inspector.GetShape(g).size() / 2
                corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
                X_WG = body.EvalPoseInWorld(context) @ inspector.GetPoseInFrame(g)
                points = X_WG.multiply(corners.T).T
                far = np.linalg.norm(points - centres[name], axis=1).max()
                assert far <= radii[name] + 1e-9, f"{name} at {width:.2f}: {far:.3f} > {radii[name]:.3f}"


def test_every_check_is_counted(problem: Problem) -> None:
    counts = Counts()
    world = Collision(problem, counts).worlds["left"]
    world.hits(world.rows(np.zeros((5, 4)), None, {}))
    assert counts.collision_checks == 5
    assert counts.as_dict()["collision_checks"] == 5


def test_attachments_are_compared_by_identity() -> None:
    X = np.eye(4)
    assert Attachment("a", "b", X) != Attachment("a", "b", X), "they are cache keys"
