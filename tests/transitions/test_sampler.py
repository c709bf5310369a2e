"""The sampler covers whole strata, keeps what it finds, counts what it does, and accepts only what is free."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mrtamp.check_scene import JudgeScene
from mrtamp.kinematics import inverse
from mrtamp.modes import Attachment, Mode
from mrtamp.planner import Options, Planner
from mrtamp.problem_file import problem_from_dict
from mrtamp.transitions.contacts import APPROACH
from mrtamp.transitions.families import Family, residual
from mrtamp.transitions.projection import solve_ik, uniform_configurations


def pose(x: float, y: float, z: float, yaw: float = 0.0) -> dict[str, Any]:
    return {"translation": [x, y, z], "rotation": {"rpy_deg": [0.0, 0.0, yaw]}}


def problem() -> dict[str, Any]:
    """A cube on a high pedestal, within reach from all sides; a region on a table; a bar to be handed over."""
    return {
        "mrtamp": 1,
        "name": "coverage",
        "robots": [
            {"name": "left", "model": "panda", "X_WB": pose(-0.5, 0, 0)},
            {"name": "right", "model": "panda", "X_WB": pose(0.5, 0, 0, 180)},
        ],
        "world": [
            {"name": "table", "shape": {"box": [1.6, 1.4, 0.1]}, "X_WB": pose(0, 0, -0.05)},
            {"name": "pedestal", "shape": {"box": [0.05, 0.05, 0.4]}, "X_WB": pose(-0.05, 0.2, 0.2)},
        ],
        "supports": [{"name": "region", "on": "table", "X_BS": pose(-0.05, -0.25, 0.05), "size": [0.2, 0.2]}],
        "objects": [
            {
                "name": "cube",
                "shape": {"box": [0.05] * 3},
                "start": {"on": "pedestal", "X_WO": pose(-0.05, 0.2, 0.425)},
            },
            {
                "name": "bar",
                "shape": {"box": [0.2, 0.04, 0.04]},
                "start": {"on": "table", "X_WO": pose(0, -0.05, 0.02)},
            },
        ],
        "goal": [{"object": "cube", "in": "region"}],
    }


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner(problem_from_dict(problem()), seed=0, options=Options(initial_vertices=5))


def family_of(families: list[Family], a: Attachment) -> int:
    """Which family a grasp belongs to: no residual, coordinates within the bounds."""
    X_OG = inverse(a.X_PO)[None]
    for k, f in enumerate(families):
        c = f.coordinates(X_OG)[0]
        inside = np.all(c >= f.lower - 1e-9) and np.all(c <= f.upper + 1e-9)
        if inside and np.abs(residual(f, X_OG)).max() < 1e-6 and np.allclose(f.pose(c[None]), X_OG, atol=1e-6):
            return k
    raise AssertionError("a grasp of no family")


def picked(planner: Planner, robot: str, item: str, n: int) -> list:
    out: list = []
    while len(out) < n:
        out += planner.sampler.sample_pick(planner.root.mode, robot, item)
    return out


def holding(planner: Planner, robot: str, item: str, from_above: bool = False) -> Mode:
    """A mode in which the robot holds the object by some sampled grasp."""
    for _ in range(60):
        for c in planner.sampler.sample_pick(planner.root.mode, robot, item):
            if not from_above or inverse(c.after.X_PO)[2, 2] < -0.99:
                return planner.root.mode.replace(c.after)
    raise AssertionError("no such pick")


def test_every_grasp_family_that_is_free_somewhere_is_drawn(planner: Planner) -> None:
    """Free by brute force: in the joints' whole range, the hand open and closed, and 7 cm back along the approach."""
    world = planner.roadmaps["left"].world
    start = planner.root.mode
    strata = planner.sampler.strata(start, "pick", ("left",), "cube")
    assert len(strata) == 20
    rng = np.random.default_rng(0)
    objects = {r.name: r.X_WO for r in planner.validity.resting(start)}
    free = set()
    for k, stratum in enumerate(strata):
        q, _, solved = stratum.sample(rng, 150)
        q = q[solved]
        X_WG = world.tool.matrix(q)
        X_WG[:, :3, 3] -= 0.07 * X_WG[:, :3, 2]
        back, can = solve_ik(world.tool, X_WG[:, :3, :3], X_WG[:, :3, 3], q)
        ok = can & (np.abs(back - q).max(axis=1) < 0.5)
        ok &= ~world.hits(world.rows(q, None, objects)) & ~world.hits(world.rows(back, None, objects))
        if ok.sum() >= 5:
            free.add(k)
    assert len(free) >= 8
    seen: set[int] = set()
    for _ in range(400):
        seen |= {
            family_of([s.family for s in strata], c.after) for c in planner.sampler.sample_pick(start, "left", "cube")
        }
        if free <= seen:
            break
    assert free <= seen, [strata[k].family.name for k in free - seen]


def test_grasps_are_spread_over_their_family(planner: Planner) -> None:
    families = list(planner.sampler.families["left", "cube"])
    shares = []
    for c in picked(planner, "left", "cube", 150):
        f = families[family_of(families, c.after)]
        x = f.coordinates(inverse(c.after.X_PO)[None])[0]
        shares.append((x - f.lower) / (f.upper - f.lower))
    counts = np.histogramdd(np.array(shares), bins=3, range=[(0, 1)] * 2)[0]
    assert counts.min() >= 4


def test_every_quadrant_and_orientation_of_a_region_is_drawn(planner: Planner) -> None:
    mode = holding(planner, "left", "cube", from_above=True)
    X_BS = planner.problem.support("region").X_BS.GetAsMatrix4()
    found = [c.after.X_PO for _ in range(60) for c in planner.sampler.sample_place(mode, "left", "region")]
    X_SO = inverse(X_BS) @ np.array(found)
    assert np.abs(X_SO[:, :2, 3]).max() <= 0.1
    np.testing.assert_allclose(X_SO[:, 2, 3], 0.025, atol=1e-9)
    quadrants = np.histogram2d(X_SO[:, 0, 3], X_SO[:, 1, 3], bins=2, range=[(-0.1, 0.1)] * 2)[0]
    assert quadrants.min() >= 4
    turns = np.histogram(np.arctan2(X_SO[:, 1, 0], X_SO[:, 0, 0]), bins=4, range=(-np.pi, np.pi))[0]
    assert turns.min() >= 4


def test_handovers_use_many_grasps_of_the_receiver(planner: Planner) -> None:
    mode = holding(planner, "left", "bar")
    families = list(planner.sampler.families["right", "bar"])
    found = [c for _ in range(20) for c in planner.sampler.sample_handover(mode, "left", "right")]
    assert len(found) >= 10
    assert len({family_of(families, c.after) for c in found}) >= 5
    tools = {r: planner.roadmaps[r].world.tool for r in ("left", "right")}
    for c in found:
        X = {r: tools[r].matrix(planner.roadmaps[r].q[[v]])[0] for r, v in c.at.items()}
        np.testing.assert_allclose(X["left"] @ c.before.X_PO, X["right"] @ c.after.X_PO, atol=1e-6)


def test_retreats_go_straight_back_whether_alone_or_many_at_once(planner: Planner) -> None:
    mode, sampler = holding(planner, "left", "bar"), planner.sampler
    solved = [h for _ in range(4) for h in sampler.solve_handovers(mode, "left", "right", 48)]
    assert len(solved) >= 8
    lengths = set()
    for handover, one_of_many in zip(solved, sampler.contacts.with_retreats(solved), strict=True):
        [alone] = sampler.contacts.with_retreats([handover])
        assert one_of_many.retreats is not None and alone.retreats is not None
        for robot, q in handover.q.items():
            many, one = one_of_many.retreats[robot], alone.retreats[robot]
            assert len(many) == len(one)
            lengths.add(len(one))
            X_WG = sampler.roadmaps[robot].world.tool.matrix(np.array([q, *one]))
            for k, x in enumerate(one):
                np.testing.assert_allclose(many[k], x, atol=1e-6)
                expected = X_WG[0, :3, 3] - APPROACH[k] * X_WG[0, :3, 2]
                np.testing.assert_allclose(X_WG[k + 1, :3, 3], expected, atol=1e-6)
    assert lengths >= {0, 2} or lengths >= {1, 2}, "some arms cannot follow all the way"


def full_plant_depth(
    planner: Planner, world: JudgeScene, q: dict[str, np.ndarray], mode: Mode, resting: bool = True
) -> float:
    """Deepest penetration (m) of robots in the full plant, what a hand holds and its gripper aside, contacts aside.

    `resting`: whether resting objects count.
    """
    held = mode.held
    held_names = {a.object for a in held.values()}
    z = np.empty((1, len(world.columns)))
    for name, in_scene in world.scene.robots.items():
        z[0, world.arm[name]] = q.get(name, planner.problem.robot(name).home)
        z[0, world.fingers[name]] = in_scene.finger_positions(held[name].width if name in held else None)
    frames = world.grasp_frames(z, list(held))
    poses = {
        a.object: frames[a.parent][0] @ a.X_PO if a.held else planner.validity.world_pose(mode.chain(a.object))
        for a in mode.attachments
    }
    worst = 0.0
    for pair in world.query(world.positions(z, poses)[0]).ComputePointPairPenetration():
        a, b = (world.solids[world.index[g]].side for g in (pair.id_A, pair.id_B))
        if not resting and any(s.kind == "object" and s.owner not in held_names for s in (a, b)):
            continue
        if not {a.owner, b.owner} & (set(q) | {x.object for x in held.values()}):
            continue
        carried = {x.object: r for r, x in held.items()}
        mine = any(carried.get(s.owner) == t.owner for s, t in ((a, b), (b, a)))
        touching = any(s.owner in carried for s in (a, b)) and {a.kind, b.kind} <= {"object", "static"}
        if mine or (touching and pair.depth <= 1.1e-3):
            continue
        worst = max(worst, pair.depth)
    return worst


def test_what_is_accepted_is_free_before_and_after(planner: Planner) -> None:
    world = JudgeScene(planner.problem)
    start = planner.root.mode
    cases = []
    for robot, item in (("left", "cube"), ("left", "bar"), ("right", "bar")):
        cases += [(start, c) for c in picked(planner, robot, item, 12)]
    mode = holding(planner, "left", "cube", from_above=True)
    cases += [(mode, c) for _ in range(8) for c in planner.sampler.sample_place(mode, "left", "region")]
    mode = holding(planner, "left", "bar")
    cases += [(mode, c) for _ in range(8) for c in planner.sampler.sample_handover(mode, "left", "right")]
    assert {c.kind for _, c in cases} == {"pick", "place", "handover"}
    for before, c in cases:
        q = {r: planner.roadmaps[r].q[v] for r, v in c.at.items()}
        others = [r for r in ("left", "right") if r not in q]
        for m in (before, before.replace(c.after)):
            if any(r in m.held for r in others):
                continue
            # A handover is known for all modes: what rests near it is looked at when it is to happen.
            assert full_plant_depth(planner, world, q, m, resting=c.kind != "handover") == 0.0, c


def test_candidates_are_kept_and_a_pick_is_a_place_backwards(planner: Planner) -> None:
    start = planner.root.mode
    (c, *_) = picked(planner, "left", "bar", 1)
    assert c in planner.sampler.picks(start, "left", "bar")
    back = planner.sampler.places(start.replace(c.after), "left", c.before.support)
    assert [(b.at, b.after) for b in back if b.at == c.at] == [(c.at, c.before)]


def test_outcomes_count_every_sample(planner: Planner) -> None:
    fresh = Planner(problem_from_dict(problem()), seed=1, options=Options(initial_vertices=2))
    total = 0
    for _ in range(5):
        total += len(fresh.sampler.sample_pick(fresh.root.mode, "left", "bar", n=40))
    stats = fresh.sampler.outcomes["pick", ("left",), "bar", "start of bar"]
    # A call draws further rounds while too few grasps fit.
    assert stats.calls == 5 and 200 <= stats.samples <= 600 and stats.samples % 40 == 0
    assert sum(stats.tries.values()) == stats.samples
    assert stats.accepted == total > 0
    assert stats.accepted <= stats.ik_solved <= stats.samples


def test_only_calls_are_counted_where_guidance_reads_calls() -> None:
    """A look ahead at the goal is no attempt there: what stands in the way was not looked at."""
    fresh = Planner(problem_from_dict(problem()), seed=1, options=Options(initial_vertices=2))
    while not fresh.sampler.sample_pick(fresh.root.mode, "left", "cube"):
        pass
    stats = fresh.sampler.outcomes.get(("place", ("left",), "cube", "region"))
    assert stats is None or stats.accepted == 0


def test_everything_that_can_be_reached_counts_as_in_reach(planner: Planner) -> None:
    """Targets outside the ball are never sampled: a reachable one among them would have no density at all."""
    tool = planner.roadmaps["left"].world.tool
    points = tool.pose(uniform_configurations(tool, np.random.default_rng(7), 50_000))[1]
    assert all(planner.sampler.in_reach("left", p) for p in points)


def test_robots_too_small_for_the_object_say_so() -> None:
    data = problem()
    data["objects"].append(
        {
            "name": "block",
            "shape": {"box": [0.2] * 3},
            "grasps": [],
            "start": {"on": "table", "X_WO": pose(0, 0.4, 0.1)},
        }
    )
    planner = Planner(problem_from_dict(data), options=Options(initial_vertices=2))
    assert planner.sampler.sample_pick(planner.root.mode, "left", "block") == []
    assert planner.sampler.outcomes["pick", ("left",), "block", "start of block"].accepted == 0
