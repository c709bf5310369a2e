"""Cached verdicts on edges agree with brute force in the full plant: alone, loaded, beside and between robots."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from mrtamp.check_scene import JudgeScene
from mrtamp.modes import Mode
from mrtamp.planner import Planner
from mrtamp.problem_file import problem_from_dict


def pose(x: float, y: float, z: float, yaw: float = 0.0) -> dict[str, Any]:
    return {"translation": [x, y, z], "rotation": {"rpy_deg": [0.0, 0.0, yaw]}}


def crowded() -> dict[str, Any]:
    """Two Pandas that share a table with a wall, a cube, a post, a long bar and a rod."""
    things = [
        ("cube", {"box": [0.05, 0.05, 0.05]}, 0.0, 0.1, 0.025),
        ("post", {"box": [0.04, 0.04, 0.14]}, 0.05, -0.2, 0.07),
        ("bar", {"box": [0.2, 0.04, 0.04]}, -0.05, 0.3, 0.02),
        ("rod", {"cylinder": [0.02, 0.16]}, -0.1, -0.05, 0.08),
    ]
    return {
        "mrtamp": 1,
        "name": "crowded",
        "robots": [
            {"name": "left", "model": "panda", "X_WB": pose(-0.5, 0, 0)},
            {"name": "right", "model": "panda", "X_WB": pose(0.5, 0, 0, 180)},
        ],
        "world": [
            {"name": "table", "shape": {"box": [1.6, 1.4, 0.1]}, "X_WB": pose(0, 0, -0.05)},
            {"name": "wall", "shape": {"box": [0.04, 0.3, 0.3]}, "X_WB": pose(0.15, 0.1, 0.15)},
        ],
        "objects": [
            {"name": name, "shape": shape, "start": {"on": "table", "X_WO": pose(x, y, z, 25.0)}}
            for name, shape, x, y, z in things
        ],
        "goal": [{"robot": "left", "at": "home"}],
    }


class FullPlant:
    """Brute force: all robots and objects in one plant, `HasCollisions` between what may not touch."""

    def __init__(self, planner: Planner) -> None:
        self.planner = planner
        self.world = JudgeScene(planner.problem)

    def depth(self, mode: Mode, q: dict[str, np.ndarray], kinds: str) -> float:
        """Deepest penetration (m, 0: none) at one composite configuration.

        `kinds`: "robot" counts pairs with exactly one robot (and its load) in them, "pair" those of two robots.
        """
        world = self.world
        held = mode.held
        z = np.empty((1, len(world.columns)))
        for name, in_scene in world.scene.robots.items():
            z[0, world.arm[name]] = q[name]
            z[0, world.fingers[name]] = in_scene.finger_positions(held[name].width if name in held else None)
        frames = world.grasp_frames(z, list(held))
        poses = {
            a.object: frames[a.parent][0] @ a.X_PO if a.held else self.planner.validity.world_pose(mode.chain(a.object))
            for a in mode.attachments
        }
        query = world.query(world.positions(z, poses)[0])
        carrier = {a.object: a.parent for a in mode.attachments if a.held}
        worst = 0.0
        for pair in query.ComputePointPairPenetration():
            a, b = (world.solids[world.index[g]].side for g in (pair.id_A, pair.id_B))
            owners = {carrier.get(s.owner, s.owner) for s in (a, b)} & set(q)
            if len(owners) != (1 if kinds == "robot" else 2):
                continue
            loads = [s for s in (a, b) if s.owner in carrier]
            hands = [s for s in (a, b) if s.kind == "robot"]
            if loads and hands and carrier[loads[0].owner] == hands[0].owner:
                gripper = self.planner.problem.robot(hands[0].owner).model.gripper
                assert gripper is not None
                if hands[0].body in gripper.bodies:
                    continue
            worst = max(worst, pair.depth)
        return worst


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner(problem_from_dict(crowded()), seed=0)


@pytest.fixture(scope="module")
def full(planner: Planner) -> FullPlant:
    return FullPlant(planner)


@pytest.fixture(scope="module")
def modes(planner: Planner) -> list[Mode]:
    """Nothing held; a bar in the left hand; that and a rod in the right one."""
    start = planner.root.mode

    def grasp(robot: str, item: str):
        while True:
            found = planner.sampler.sample_pick(start, robot, item)
            if found:
                return found[0].after

    one = start.replace(grasp("left", "bar"))
    return [start, one, one.replace(grasp("right", "post"))]


def edges(planner: Planner, robot: str, n: int, seed: int) -> list[tuple[int, int]]:
    """Random edges between configurations around a working posture, a few of them long."""
    rng = np.random.default_rng(seed)
    roadmap = planner.roadmaps[robot]
    posture = np.array([0.0, 0.5, 0.0, -1.9, 0.0, 2.3, 0.8])
    chain = roadmap.world.chain
    out = []
    for k in range(n):
        a = posture + rng.normal(scale=0.35, size=7)
        b = a + rng.normal(scale=0.08 if k % 3 else 0.3, size=7)
        a, b = (np.clip(x, chain.lower, chain.upper) for x in (a, b))
        out.append((roadmap.add_vertex(a, connect=False), roadmap.add_vertex(b, connect=False)))
    return out


def line(planner: Planner, robot: str, edge: tuple[int, int], n: int) -> np.ndarray:
    q = planner.roadmaps[robot].q
    return np.linspace(q[edge[0]], q[edge[1]], n)


def home(planner: Planner) -> dict[str, np.ndarray]:
    return {r.name: r.home for r in planner.problem.robots}


@pytest.mark.parametrize("k", [0, 1, 2])
def test_a_robot_alone_is_free_exactly_where_the_full_plant_says_so(
    planner: Planner, full: FullPlant, modes: list[Mode], k: int
) -> None:
    mode, verdicts = modes[k], []
    for robot in ("left", "right"):
        roadmap = planner.roadmaps[robot]
        for a, b in edges(planner, robot, 25, seed=k):
            e = roadmap.edge(a, b)
            free = planner.validity.edge(robot, e, mode)
            samples = roadmap.path_samples(e)
            depths = [full.depth(mode, {**home(planner), robot: q}, "robot") for q in samples]
            assert free == (max(depths) == 0.0), f"{robot} {free} {max(depths)}"
            assert planner.validity.edge(robot, e, mode) is free, "the cache answers the same"
            verdicts.append(free)
    assert 5 < sum(verdicts) < 45, "the edges should be a mixture"


@pytest.mark.parametrize("k", [0, 1, 2])
def test_what_is_blocked_at_a_glance_is_blocked_in_the_full_plant(
    planner: Planner, full: FullPlant, modes: list[Mode], k: int
) -> None:
    """At the vertex, if all its edges are; and every edge that is seen is known to be blocked from then on."""
    mode, seen, refused = modes[k], 0, 0
    for robot in ("left", "right"):
        roadmap = planner.roadmaps[robot]
        pairs = edges(planner, robot, 30, seed=60 + k)
        numbers = [roadmap.edge(a, b) for a, b in pairs]
        for (a, _), (_, c) in pairwise(pairs):
            roadmap.edge(a, c)  # edges beside those that are looked at
        while found := planner.validity.glance(robot, numbers, mode):
            seen += len(found)
            for e in found:
                q = roadmap.path_samples(e, 5)
                assert max(full.depth(mode, {**home(planner), robot: x}, "robot") for x in q) > 0.0
                assert not planner.validity.edge(robot, e, mode)
            numbers = [e for e in numbers if e not in found]
        left = [planner.validity.edge(robot, e, mode) for e in numbers]
        refused += left.count(False)
    assert seen > 15
    assert refused < 0.2 * seen, "few collisions are so short that glances miss them"


def test_fresh_verdicts_are_those_of_the_cache_whatever_was_asked_before(planner: Planner, modes: list[Mode]) -> None:
    """Modes share factors; the order of questions must not matter."""
    pairs = edges(planner, "left", 20, seed=9)
    asked = [[planner.validity.edge("left", planner.roadmaps["left"].edge(*p), m) for p in pairs] for m in modes]
    fresh = Planner(problem_from_dict(crowded()), seed=3)
    q = planner.roadmaps["left"].q
    again = [tuple(fresh.roadmaps["left"].add_vertex(q[v], connect=False) for v in p) for p in pairs]
    for m in (2, 0, 1):
        for p, known in zip(again, asked[m], strict=True):
            assert fresh.validity.edge("left", fresh.roadmaps["left"].edge(*p), modes[m]) == known


@pytest.mark.parametrize("k", [0, 2])
def test_beside_a_standing_robot(planner: Planner, full: FullPlant, modes: list[Mode], k: int) -> None:
    """Free means free at the samples; blocked without contact is blocked by the padding, and by less than that."""
    mode, verdicts = modes[k], []
    stands = edges(planner, "right", 8, seed=20 + k)
    for edge in edges(planner, "left", 8, seed=30 + k):
        e = planner.roadmaps["left"].edge(*edge)
        for v, _ in stands:
            free = planner.validity.against("left", e, mode, "right", v)
            at = {"right": planner.roadmaps["right"].q[v]}
            deep = max(full.depth(mode, {**at, "left": q}, "pair") for q in planner.roadmaps["left"].path_samples(e))
            assert not (free and deep > 0), f"free, but {deep} deep"
            verdicts.append((free, deep))
    assert {free for free, _ in verdicts} == {True, False}
    wrong = [deep for free, deep in verdicts if not free and deep == 0]
    assert len(wrong) <= 0.15 * len(verdicts), "only the 3 mm of padding may differ"


@pytest.mark.parametrize("k", [0, 2])
def test_two_moving_robots(planner: Planner, full: FullPlant, modes: list[Mode], k: int) -> None:
    mode, verdicts = modes[k], []
    for one in edges(planner, "left", 7, seed=40 + k):
        for two in edges(planner, "right", 7, seed=50 + k):
            for a, b in ((one, two), (one[::-1], two)):
                free = planner.validity.move(mode, "left", a, "right", b)
                assert planner.validity.move(mode, "right", b, "left", a) == free
                n = max(
                    planner.roadmaps[r].n_samples(planner.roadmaps[r].edge(*x)) for r, x in (("left", a), ("right", b))
                )
                qa, qb = line(planner, "left", a, n), line(planner, "right", b, n)
                deep = max(full.depth(mode, {"left": x, "right": y}, "pair") for x, y in zip(qa, qb, strict=True))
                assert not (free and deep > 0), f"free, but {deep} deep"
                verdicts.append((free, deep))
    assert {free for free, _ in verdicts} == {True, False}
    wrong = [deep for free, deep in verdicts if not free and deep == 0]
    assert len(wrong) <= 0.15 * len(verdicts)


def test_direction_of_travel_matters_only_to_pairs_that_go_opposite_ways(planner: Planner, modes: list[Mode]) -> None:
    for one in edges(planner, "left", 6, seed=60):
        for two in edges(planner, "right", 6, seed=61):
            there = planner.validity.move(modes[0], "left", one, "right", two)
            back = planner.validity.move(modes[0], "left", one[::-1], "right", two[::-1])
            assert there == back


def test_blocked_lists_what_is_known_to_be_blocked(planner: Planner, modes: list[Mode]) -> None:
    roadmap = planner.roadmaps["left"]
    asked = {
        roadmap.edge(*p): planner.validity.edge("left", roadmap.edge(*p), modes[1])
        for p in edges(planner, "left", 15, 70)
    }
    mask = planner.validity.blocked("left", modes[1], {})
    assert len(mask) == roadmap.n_edges
    assert all(mask[e] == (not free) for e, free in asked.items())


def test_what_the_judge_forbids_stays_forbidden(planner: Planner, modes: list[Mode]) -> None:
    (one,) = edges(planner, "left", 1, seed=80)
    (two,) = edges(planner, "right", 1, seed=81)
    a, b = {"left": one[0], "right": two[0]}, {"left": one[1], "right": two[1]}
    planner.validity.forbid(modes[0], a, b, ("right", "left"))
    assert not planner.validity.move(modes[0], "left", one, "right", two)
    stay = {"left": one[1], "right": two[0]}
    planner.validity.forbid(modes[0], a, stay, ("left", "right"))
    e = planner.roadmaps["left"].edge(*one)
    assert not planner.validity.against("left", e, modes[0], "right", two[0])
    planner.validity.forbid(modes[0], a, stay, ("left",))
    assert not planner.validity.edge("left", e, modes[0])


def test_a_step_forbidden_because_of_an_object_is_free_again_once_the_object_is_gone(
    planner: Planner, modes: list[Mode]
) -> None:
    """The judge blames one robot when it meets a resting object; modes without the object there are another matter."""
    roadmap = planner.roadmaps["right"]
    found = next(
        p for p in edges(planner, "right", 40, seed=90) if planner.validity.edge("right", roadmap.edge(*p), modes[0])
    )
    a, b = ({"left": 0, "right": v} for v in found)
    planner.validity.forbid(modes[0], a, b, ("right",))
    assert not planner.validity.edge("right", roadmap.edge(*found), modes[0])
    assert planner.validity.edge("right", roadmap.edge(*found), modes[1]), "the bar is no longer there"
