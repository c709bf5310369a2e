"""Small collision plants: bisection order, held objects, contact allowances, bounds that enclose, padding."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from discs import HEIGHT, RADIUS, disc_problem
from gantry import gantry_model, gantry_problem, gantry_urdf, grasp
from pydrake.geometry import (
    Box,
    Capsule,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    ProximityProperties,
    SceneGraph,
)
from pydrake.math import RigidTransform, RollPitchYaw

from mrtamp.collision import CONTACT_DEPTH, PADDING, Collision, Counts, bisection_order, depth_of
from mrtamp.modes import Attachment, start_mode
from mrtamp.problem import CollisionRules, Gripper, MrtampError, Problem
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


def ruled(problem: Problem, *ignore: tuple[str, str], tolerance: float = 0.0) -> Problem:
    return dataclasses.replace(problem, collision=CollisionRules(ignore, tolerance))


@pytest.mark.parametrize(
    ("pair", "free"),
    [
        (("left", "wall"), [False, True]),
        (("left/tool", "wall"), [False, True]),
        (("left/finger_left", "wall"), [False, False]),
        (("cube", "left"), [True, False]),
        (("left/finger_right", "cube"), [True, False]),
        (("right", "cube"), [False, False]),
        (("cube", "block"), [False, False]),
    ],
)
def test_pairs_that_are_ignored_may_overlap(problem: Problem, pair: tuple[str, str], free: list[bool]) -> None:
    """The first hand has a finger (the right one) in the cube, the second its palm in the wall."""
    world = Collision(ruled(problem, pair)).worlds["left"]
    q = np.array([[-0.4, 0.03, 0.04, 0], [0, 0.6, 0.1, 0]])
    np.testing.assert_array_equal(~world.hits(world.rows(q, None, resting(problem))), free)


@pytest.mark.parametrize(("thing", "says"), [("lift", "left, right, table"), ("left/palm", "bodies of left: .*tool")])
def test_rules_about_unknown_things_are_errors(problem: Problem, thing: str, says: str) -> None:
    with pytest.raises(MrtampError, match=f"found '{thing}', .*{says}"):
        Collision(ruled(problem, ("table", thing)))


def test_objects_of_one_shape_share_a_slot_only_under_the_same_rules(problem: Problem) -> None:
    """Block and cube are equal boxes; the cube may pass through the bar, which the block may not."""
    same = Collision(ruled(problem, ("cube", "bar"), ("bar", "block"))).worlds["left"]
    assert same.slot_of["cube"] == same.slot_of["block"]
    world = Collision(ruled(problem, ("bar", "cube"))).worlds["left"]
    assert world.slot_of["cube"] != world.slot_of["block"]
    q = np.array([[-0.4, -0.3, 0.06, 0]])
    poses = {"bar": resting(problem)["bar"]}
    assert not world.hits(world.rows(q, grasp("cube", "left"), poses))[0]
    assert world.hits(world.rows(q, grasp("block", "left"), poses))[0]


def test_ignored_pairs_of_robots_and_their_loads(problem: Problem) -> None:
    q = np.array([[0.0, 0.0, 0.3, 0.0]])
    beside = q + np.array([0, 0.06, 0, 0])

    def meet(collision: Collision, held: Attachment | None) -> bool:
        pair, _ = collision.pair("left", "right")
        return pair.first_hit(q, held, beside, None) == 0

    apart = Collision(problem)
    assert meet(apart, None) and meet(apart, grasp("bar", "left"))
    through = Collision(ruled(problem, ("left", "right")))
    assert not meet(through, None) and meet(through, grasp("bar", "left", offset=0.05))
    both = Collision(ruled(problem, ("left", "right"), ("right", "bar")))
    assert not meet(both, grasp("bar", "left", offset=0.05))


def test_a_tolerance_is_for_the_sum_of_penetrations(tmp_path: Path) -> None:
    """A disc 3 mm deep in the wall and 4 mm in the token; two discs that overlap by 4 mm."""
    discs = disc_problem(tmp_path)
    token = RigidTransform([-0.5, -0.247 - RADIUS - 0.05 + 0.004, HEIGHT]).GetAsMatrix4()
    q = np.array([[-0.5, -0.247]])

    def hit(tolerance: float, objects: dict[str, np.ndarray]) -> bool:
        world = Collision(ruled(discs, tolerance=tolerance)).worlds["a"]
        return bool(world.hits(world.rows(q, None, objects))[0])

    assert [hit(t, {}) for t in (0.0, 0.0029, 0.0031)] == [True, True, False]
    assert [hit(t, {"token": token}) for t in (0.005, 0.0069, 0.0071)] == [True, True, False]

    def meet(tolerance: float, gap: float) -> bool:
        pair, _ = Collision(ruled(discs, tolerance=tolerance)).pair("a", "b")
        return pair.first_hit(np.array([[0.0, 0.0]]), None, np.array([[2 * RADIUS + gap, 0.0]]), None) == 0

    # With a tolerance what counts is how deep the shapes are as they are, without padding.
    assert [meet(t, -0.004) for t in (0.0, 0.0039, 0.0041)] == [True, True, False]


def test_where_robots_stand_shapes_are_not_padded(tmp_path: Path) -> None:
    pair, _ = Collision(disc_problem(tmp_path)).pair("a", "b")
    gaps = np.array([0.001, -0.001, 2 * PADDING + 0.001])
    qb = np.column_stack([2 * RADIUS + gaps, np.zeros(3)])
    found = []
    for k, exact in itertools.product(range(3), (False, True)):
        found.append(pair.first_hit(np.zeros((1, 2)), None, qb[[k]], None, exact=np.array([exact])) == 0)
    assert found == [True, False, True, True, False, False]


def test_without_a_gripper_what_is_held_may_touch_the_body_that_holds_it(tmp_path: Path) -> None:
    world = Collision(disc_problem(tmp_path)).worlds["b"]
    q = np.array([[0.5, -0.5], [-0.5, 0.28]])
    held = Attachment("token", "b", RigidTransform([0, -0.2, 0]).GetAsMatrix4())
    np.testing.assert_array_equal(world.hits(world.rows(q, held, {})), [False, True])
    assert {"wall", world.slot_of["token"]} == set(world.culprits(world.rows(q, held, {})[1])[0])


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


def test_what_beads_prove_apart_does_not_collide(problem: Problem, collision: Collision) -> None:
    """Many rows at once, some of which Drake is not asked about, have the verdicts that each has alone."""
    rng = np.random.default_rng(1)
    n = 400
    qa, qb = (
        np.column_stack([rng.uniform(-0.3, 0.3, (n, 2)), rng.uniform(0.2, 0.6, n), rng.uniform(-3, 3, n)])
        for _ in range(2)
    )
    pair, _ = collision.pair("left", "right")
    for held in (None, grasp("bar", "left", offset=0.05)):
        alone = [pair.first_hit(a[None], held, b[None], None) for a, b in zip(qa, qb, strict=True)]
        before = pair.counts.collision_checks
        i, found = 0, []
        while i < n:
            hit = pair.first_hit(qa[i:], held, qb[i:], None)
            found += [-1] * (n - i) if hit < 0 else [-1] * hit + [0]
            i = len(found)
        assert found == alone and 0 in found
        assert pair.counts.collision_checks - before < 0.7 * n, "most that are far apart are not asked about"
        known = tuple(w.posed(q, h) for w, q, h in zip(pair.worlds, (qa, qb), (held, None), strict=True))
        assert pair.first_hit(qa, held, qb, None, posed=known) == found.index(0)


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
    counts.ik_attempts = 7
    assert counts.work() == {**counts.as_dict(), "ik_calls": 7}, "what planners are compared by has a name of its own"


def test_attachments_are_compared_by_identity() -> None:
    X = np.eye(4)
    assert Attachment("a", "b", X) != Attachment("a", "b", X), "they are cache keys"


def test_depths_of_penetration_are_along_the_shortest_way_out() -> None:
    """Capsules whose axes stay outside a box: radius less the distance of the axis, by the nearest of many points."""
    rng = np.random.default_rng(0)
    size, radius, length = np.array([1.0, 1.0, 0.1]), 0.06, 0.5
    graph = SceneGraph()
    source = graph.RegisterSource("test")
    box = graph.RegisterAnchoredGeometry(source, GeometryInstance(RigidTransform(), Box(*size), "box"))
    frame = graph.RegisterFrame(source, GeometryFrame("arm"))
    capsule = graph.RegisterGeometry(
        source, frame, GeometryInstance(RigidTransform(), Capsule(radius, length), "capsule")
    )
    for geometry in (box, capsule):
        graph.AssignRole(source, geometry, ProximityProperties())
    context = graph.CreateDefaultContext()
    t = np.linspace(-length / 2, length / 2, 20001)
    seen = 0
    while seen < 40:
        X = RigidTransform(RollPitchYaw(rng.uniform(-3, 3, 3)), rng.uniform(-0.7, 0.7, 3))
        axis = X.translation() + t[:, None] * X.rotation().matrix()[:, 2]
        away = np.linalg.norm(np.maximum(np.abs(axis) - size / 2, 0.0), axis=1).min()
        if not 1e-3 < away < radius - 1e-3:
            continue
        seen += 1
        poses = FramePoseVector()
        poses.set_value(frame, X)
        graph.get_source_pose_port(source).FixValue(context, poses)
        query = graph.get_query_output_port().Eval(context)
        [pair] = query.ComputePointPairPenetration()
        assert depth_of(query, pair) == pytest.approx(radius - away, abs=2e-5)
        assert pair.depth > radius - away - 2e-5


def test_a_depth_is_known_where_drake_finds_no_distance() -> None:
    """Drake raises where its search does not converge, as it did once for two cubes face to face in a stack."""

    class Query:
        def ComputeSignedDistancePairClosestPoints(self, a: object, b: object) -> None:
            raise RuntimeError("max distance iterations: 1000")

    class Pair:
        id_A, id_B, depth = 1, 2, 0.25

    assert depth_of(Query(), Pair()) == 0.25
