"""Reader and referee of peer problems: on a small problem with a known optimum, and on the problems themselves."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from mrtamp.check import check_plan
from mrtamp.collision import Collision
from mrtamp.modes import Attachment, start_mode
from mrtamp.plan import Action, Plan, Segment, Transition, plan_cost
from mrtamp.planner import Planner
from mrtamp.problem import WORLD, Problem, RobotAt
from mrtamp.scene import Scene, geometry_ids, robot_bodies

from .data import VARIABLE, Peer, load_peer, matrix_of, peer_files
from .first_path import first_path
from .reader import problem_of
from .referee import Leg, Referee, legs_of

FILES = peer_files()
SKIP = pytest.mark.skipif(not FILES, reason=f"{VARIABLE} does not name a folder with peer problems")
BY_FILE = pytest.mark.parametrize("file", FILES or [Path("none")], ids=lambda f: f.stem)


# -- a small problem --------------------------------------------------------------------------------------------------


def _frame(name: str, parent: str | None, xyz: list[float], **more) -> dict:
    return {"name": name, "parent": parent, "X_PF": [*xyz, 1, 0, 0, 0], **more}


def _task(name: str, robots: list[str], q: list[float], attach: dict | None = None) -> dict:
    goal = {"type": "SingleGoal", "q": [q]}
    return {"name": name, "robots": robots, "attach": attach, "goal": goal, "side_effect": None, "n_constraints": 0}


def _square() -> dict:
    """Two agents in an empty square, the second one shuttling; the first one also takes a box along and leaves it."""
    agent = {"joint": "transXY", "shape": "cylinder", "size": [0.06, 0.05], "contact": 1}
    low, high = [0.5, -0.5], [0.5, 0.5]
    tasks = [
        *(_task(f"a2_{i}", ["a2"], q) for i, q in enumerate([low, high, low, high])),
        _task("take", ["a1"], [-0.5, -0.5], {"object": "box", "new_parent": "a1"}),
        _task("leave", ["a1"], [-0.5, 0.5], {"object": "box", "new_parent": "floor"}),
        _task("end", ["a1", "a2"], [-0.5, -0.5, 0.5, 0.5]),
    ]
    sequence = ["take", *(f"a2_{i}" for i in range(4)), "leave", "end"]
    held, left = ["a1", "box"], ["floor", "box"]
    chain = [
        {"active_task": name, "pairs_added": [], "pairs_removed": gone, "objects": {"box": {"parent": parent}}}
        for name, gone, parent in zip(
            sequence, [[], *[[held]] * 5, [left]], ["floor", *["a1"] * 5, "floor"], strict=True
        )
    ]
    return {
        "cost": {"metric": "euclidean_per_robot", "reduction": "max", "w_sum": 0.01},
        "collision_tolerance_total_penetration": 0.0,
        "dof_names": ["a1:0", "a1:1", "a2:0", "a2:1"],
        "q_start": [-0.5, -0.5, 0.5, 0.5],
        "limits": {"lower": [-1.0] * 4, "upper": [1.0] * 4},
        "robots": [
            {"name": "a1", "dof_indices": [0, 1], "joints": ["a1"]},
            {"name": "a2", "dof_indices": [2, 3], "joints": ["a2"]},
        ],
        "frames": [
            _frame("floor", None, [0, 0, -0.1], shape="box", size=[2, 2, 0.04, 0.005], contact=1),
            _frame("foot1", "floor", [0, 0, 0.1], joint="rigid"),
            _frame("a1", "foot1", [0, 0, 0], **agent),
            _frame("foot2", "floor", [0, 0, 0.1], joint="rigid"),
            _frame("a2", "foot2", [0, 0, 0], **agent),
            _frame("box", "floor", [-0.5, -0.3, 0.1], joint="rigid", shape="ssBox", size=[0.1, 0.1, 0.1, 0.005]),
        ],
        "collision_pairs": [["a1", "a2"], ["a1", "box"], ["a2", "box"], ["floor", "box"]],
        "movable_objects": ["box"],
        "tasks": tasks,
        "ordering": {"kind": "SequenceMixin", "sequence": sequence},
        "mode_chain_example": chain,
        "checks": [],
    }


@pytest.fixture
def square(tmp_path: Path) -> Peer:
    file = tmp_path / "square.json"
    file.write_text(json.dumps(_square()))
    return load_peer(file)


def _legs(*rows: tuple[list[float], str]) -> list[Leg]:
    """One straight leg per row (where it ends, the task done there), from the start of the square."""
    at, out = np.array([-0.5, -0.5, 0.5, 0.5]), []
    for end, done in rows:
        out.append(Leg(np.array([at, end]), tuple(done.split())))
        at = np.array(end)
    return out


OPTIMUM = [
    ([-0.5, -0.5, 0.5, 0.5], "take"),
    ([-0.5, -0.5, 0.5, -0.5], "a2_0"),
    ([-0.5, -0.5, 0.5, 0.5], "a2_1"),
    ([-0.5, -0.5, 0.5, -0.5], "a2_2"),
    ([-0.5, 0.5, 0.5, 0.5], "a2_3 leave"),
    ([-0.5, -0.5, 0.5, 0.5], "end"),
]


def test_the_optimum_of_the_square_is_accepted_at_its_price(square: Peer) -> None:
    verdict = Referee(square).judge(_legs(*OPTIMUM))
    assert verdict.ok, verdict
    assert verdict.price == pytest.approx(5.06)
    # The end needs no leg of its own.
    assert Referee(square).judge(_legs(*OPTIMUM[:-1], (OPTIMUM[-1][0], ""))).ok


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({4: ([-0.5, 0.5, 0.5, 0.5], "leave a2_3 a2_3")}, "twice"),
        ({4: ([-0.5, 0.5, 0.5, 0.4], "a2_3 leave")}, "0.1 from the goal of a2_3"),
        ({2: ([-0.5, -0.5, 0.5, 0.5], "")}, "a2_2 is done before a2_1"),
        ({0: ([-0.5, -0.5, 0.5, 0.5], "")}, "done before take"),
        ({2: ([0.5, 0.45, 0.5, 0.5], "a2_1")}, "a1 and a2"),
        ({2: ([-0.5, -0.5, -0.5, -0.3], "a2_1")}, "a2 and box"),
        ({2: ([-1.1, -0.5, 0.5, 0.5], "a2_1")}, "a1:0 is 0.1 beyond its limits"),
        ({5: ([-0.5, 0.5, 0.5, 0.5], "")}, "from the goal of end"),
    ],
)
def test_what_is_wrong_is_said(square: Peer, change: dict, complaint: str) -> None:
    rows = [change.get(i, row) for i, row in enumerate(OPTIMUM)]
    verdict = Referee(square).judge(_legs(*rows))
    assert not verdict.ok
    assert any(complaint in text for text in verdict.wrong), verdict.wrong


def test_a_jump_is_seen(square: Peer) -> None:
    legs = _legs(*OPTIMUM)
    legs[3] = Leg(legs[3].q + 1e-3, legs[3].done)
    assert any("begins 0.001 from" in text for text in Referee(square).judge(legs).wrong)


def test_what_is_held_moves_along_and_what_is_left_stays(square: Peer) -> None:
    referee, q = Referee(square), np.array([-0.5, -0.5, 0.5, 0.5])
    taken = referee.attach(referee.start(), q, "take")
    moved = np.array([-0.5, 0.5, 0.5, 0.5])
    assert referee.poses(moved[None], taken)["box"][0, :3, 3] == pytest.approx([-0.5, 0.7, 0.0])
    left = referee.attach(taken, moved, "leave")
    assert referee.poses(q[None], left)["box"][0, :3, 3] == pytest.approx([-0.5, 0.7, 0.0])
    assert left.off() == {frozenset(("floor", "box"))}


def test_the_square_is_read_as_a_problem(square: Peer, tmp_path: Path) -> None:
    problem = problem_of(square, tmp_path)
    assert [s.name for s in problem.subgoals] == ["take", "a2_0", "a2_1", "a2_2", "a2_3", "leave"]
    assert [s.after for s in problem.subgoals][:2] == [(), ("take",)]
    attached = {s.name: (s.attach.object, s.attach.parent) for s in problem.subgoals if s.attach}
    assert attached == {"take": ("box", "a1"), "leave": ("box", WORLD)}
    assert all(isinstance(c, RobotAt) for c in problem.goal)
    # The floor is in no pair with the agents, so they may be anywhere above or in it.
    assert set(problem.collision.ignore) == {("a1/a1", "floor"), ("a2/a2", "floor")}


def test_a_dependency_graph_leaves_the_order_open(tmp_path: Path) -> None:
    raw = _square()
    shuttle = [f"a2_{i}" for i in range(4)]
    depends = {name: shuttle[i - 1 : i] if i else [] for i, name in enumerate(shuttle)}
    raw["ordering"] = {
        "kind": "DependencyGraphMixin",
        "depends_on": {**depends, "take": [], "leave": ["take"], "end": ["leave", "a2_3"]},
        "example_sequence": raw["ordering"]["sequence"],
        "per_robot_order": {"a1": ["take", "leave", "end"], "a2": [*shuttle, "end"]},
    }
    file = tmp_path / "square.json"
    file.write_text(json.dumps(raw))
    rows = [
        ([-0.5, -0.5, 0.5, 0.5], "take"),
        ([-0.5, 0.5, 0.5, -0.5], "a2_0 leave"),
        ([-0.5, -0.5, 0.5, 0.5], "a2_1"),
        ([-0.5, -0.5, 0.5, -0.5], "a2_2"),
        ([-0.5, -0.5, 0.5, 0.5], "a2_3 end"),
    ]
    verdict = Referee(load_peer(file)).judge(_legs(*rows))
    assert verdict.ok, verdict
    assert verdict.price == pytest.approx(4.06)


# -- the problems themselves ------------------------------------------------------------------------------------------


@SKIP
@BY_FILE
def test_the_referee_agrees_with_the_file(file: Path) -> None:
    peer = load_peer(file)
    referee = Referee(peer)
    q = np.array([c["q"] for c in peer.checks])
    X = peer.poses(q)
    gaps = [
        np.abs(X[name][i] - matrix_of(pose)).max()
        for i, c in enumerate(peer.checks)
        for name, pose in c.get("fk", {}).items()
    ]
    assert max(gaps) < 1e-12
    totals = np.array([sum(found.values()) for found in referee.penetrations(q, referee.start())])
    theirs = np.array([c["total_penetration"] for c in peer.checks])
    np.testing.assert_array_equal(totals <= peer.tolerance, [c["valid"] for c in peer.checks])
    assert np.abs(totals - theirs)[theirs < 0.02].max() < 1e-4


@SKIP
@BY_FILE
def test_the_referee_goes_through_the_modes_of_the_file(file: Path) -> None:
    peer = load_peer(file)
    referee = Referee(peer)
    state = referee.start()
    for mode in peer.chain:
        for item, there in mode["objects"].items():
            assert state.objects[item][0] == there["parent"]
            assert state.objects[item][1] == pytest.approx(matrix_of(there["X_PF"]), abs=1e-9)
        assert state.off() == {frozenset(p) for p in mode["pairs_removed"]}
        q = np.array(mode["transition_q_example"])
        for one in (state, state := referee.attach(state, q, mode["active_task"])):
            [found] = referee.penetrations(q[None], one)
            assert (sum(found.values()) <= peer.tolerance) == mode["transition_valid_with_idle_at_start"]


@SKIP
@BY_FILE
def test_the_planner_collides_with_what_the_file_says(file: Path, tmp_path: Path) -> None:
    """Same kinematics, and the same verdict as the referee for every configuration of the file."""
    peer = load_peer(file)
    problem = problem_of(peer, tmp_path)
    collision = Collision(problem)
    q = np.array([c["q"] for c in peer.checks])
    X_WF = peer.poses(q)
    objects = {o.name: o.start_X_BO.GetAsMatrix4() for o in problem.objects}
    free = np.ones(len(q), dtype=bool)
    for name, world in collision.worlds.items():
        own = q[:, peer.columns[name]]
        for body in set(world.chain.bodies) & set(X_WF):
            R, p = world.chain.poses(own, [body])
            assert R[0] == pytest.approx(X_WF[body][:, :3, :3], abs=1e-9)
            assert p[0] == pytest.approx(X_WF[body][:, :3, 3], abs=1e-9)
        assert world.chain.lower == pytest.approx(peer.lower[peer.columns[name]])
        assert world.chain.upper == pytest.approx(peer.upper[peer.columns[name]])
        free &= ~world.hits(world.rows(own, None, objects))
    for a, b in combinations(problem.robots, 2):
        pair, _ = collision.pair(a.name, b.name)
        exact = np.ones(1, dtype=bool)
        for i in np.flatnonzero(free):
            qa, qb = (q[[i]][:, peer.columns[r.name]] for r in (a, b))
            free[i] = pair.first_hit(qa, None, qb, None, exact=exact) < 0
    referee = Referee(peer)
    totals = np.array([sum(found.values()) for found in referee.penetrations(q, referee.start())])
    # The planner's plants judge robots one by one and two by two, so each may use the whole tolerance.
    assert not np.any(~free & (totals <= peer.tolerance))
    assert not np.any(free & (totals > peer.tolerance * (1 + len(peer.columns))))


def _names(scene: Scene) -> dict:
    """Geometry id -> what it is: a frame of the peer, or the slot of a held object."""
    bodies = {b.name(): b for r in scene.robots.values() for b in robot_bodies(scene.plant, r)}
    bodies |= {name: b for group in (scene.statics, scene.free_bodies) for name, [b] in group.items()}
    return {g: name for name, body in bodies.items() for g in geometry_ids(scene.plant, [body])}


def _counted(scene: Scene) -> set[frozenset[str]]:
    """Pairs of names that may collide in a plant."""
    names, inspector = _names(scene), scene.scene_graph.model_inspector()
    return {frozenset((names[a], names[b])) for a, b in combinations(names, 2) if not inspector.CollisionFiltered(a, b)}


@SKIP
@BY_FILE
def test_the_planner_judges_exactly_the_pairs_of_the_file(file: Path, tmp_path: Path) -> None:
    """Over all its plants, objects at rest or in hand; only pairs of things at rest are left out."""
    peer = load_peer(file)
    problem = problem_of(peer, tmp_path)
    collision = Collision(problem)
    solids = {r: [f for f in peer.colliding if peer.robot_of.get(f) == r] for r in peer.columns}
    rest = [f for f in peer.colliding if f not in peer.robot_of]

    def listed(one: list[str], two: list[str]) -> set[frozenset[str]]:
        return {p for a in one for b in two if a != b and (p := frozenset((a, b))) in peer.pairs}

    def renamed(pairs: set[frozenset[str]], item: str, slot: str) -> set[frozenset[str]]:
        return {frozenset(slot if name == item else name for name in pair) for pair in pairs}

    for name, world in collision.worlds.items():
        expected = listed(solids[name], [*solids[name], *rest])
        for item in peer.objects:
            held = [pairs for (o, frame), pairs in peer.released_pairs.items() if peer.robot_of.get(frame) == name]
            touching = {n for pairs in held for pair in pairs for n in pair} & set(solids[name])
            in_hand = listed([item], [f for f in [*solids[name], *rest] if f not in touching])
            slot = world.slot_of[item]
            # One slot serves all objects of a shape, so it also is in a pair with what it stands for.
            expected |= renamed(in_hand, item, slot) | {frozenset((slot, item))}
        assert _counted(world.scene) == expected
    for a, b in combinations(peer.columns, 2):
        pair, _ = collision.pair(a, b)
        slots = [{o: slot_of[o] for o in peer.objects} for slot_of in pair.slot_of]
        expected = listed(solids[a], solids[b])
        for mine, theirs in ((slots[0], b), (slots[1], a)):
            for item in peer.objects:
                expected |= renamed(listed([item], solids[theirs]), item, mine[item])
        expected |= {frozenset((one, two)) for one in slots[0].values() for two in slots[1].values()}
        assert _counted(pair.scene) == expected


@cache
def _first(file: Path) -> tuple[Peer, Referee, list[Leg]]:
    """A problem, its referee, and a path that mrtamp has no part in."""
    referee = Referee(load_peer(file))
    return referee.peer, referee, first_path(referee, np.random.default_rng(0))


def _plan(peer: Peer, problem: Problem, legs: list[Leg]) -> Plan:
    """Legs as a plan of the problem; what is attached where comes from the referee."""
    referee = Referee(peer)
    state, mode = referee.start(), start_mode(problem)
    segments, transitions = [], []
    for leg in legs:
        segments.append(Segment(mode, {robot: leg.q[:, c] for robot, c in peer.columns.items()}))
        for subgoal in (s for s in problem.subgoals if s.name in leg.done):
            state, before, after = referee.attach(state, leg.q[-1], subgoal.name), None, None
            if subgoal.attach is not None:
                item, parent = subgoal.attach.object, subgoal.attach.parent
                before = mode.of[item]
                after = Attachment(item, parent, state.objects[item][1])
                if parent == WORLD:
                    X_WO = referee.poses(leg.q[-1:], state)[item][0]
                    after = Attachment(item, parent, X_WO, support=f"at {subgoal.name}")
            action = Action("reach", tuple(subgoal.targets), before, after, subgoal.name)
            transitions.append(Transition((action,)))
            mode = mode.after(transitions[-1])
    return Plan(problem, segments, transitions, plan_cost(segments, transitions, problem.cost))


@SKIP
@BY_FILE
def test_checker_and_referee_agree(file: Path, tmp_path: Path) -> None:
    """Two judges that share nothing: mrtamp's own, and the referee."""
    peer, referee, legs = _first(file)
    problem = problem_of(peer, tmp_path)
    plan = _plan(peer, problem, legs)
    verdict, report = referee.judge(legs), check_plan(plan)
    assert verdict.ok, verdict
    assert report.ok, report.violations
    assert plan.cost == pytest.approx(verdict.price)
    straight = [Leg(leg.q[[0, -1]], leg.done) for leg in legs]
    assert not referee.judge(straight).ok
    assert "collision" in check_plan(_plan(peer, problem, straight)).kinds


@SKIP
@BY_FILE
def test_a_path_is_accepted_until_it_is_tampered_with(file: Path) -> None:
    peer, referee, legs = _first(file)
    verdict = referee.judge(legs)
    assert verdict.ok, verdict
    steps = np.concatenate([np.diff(leg.q, axis=0) for leg in legs])
    by_robot = [np.linalg.norm(steps[:, c], axis=1) for c in peer.columns.values()]
    assert verdict.price == pytest.approx(np.sum(np.max(by_robot, axis=0)) + 0.01 * np.sum(by_robot))
    assert not referee.judge(legs[:-2]).ok
    assert not referee.judge(legs[1:]).ok
    swapped = [replace(leg, done=other.done) for leg, other in zip(legs, [legs[1], legs[0], *legs[2:]], strict=True)]
    assert not referee.judge(swapped).ok
    nudged = [*legs[:-1], Leg(legs[-1].q + 0.01, legs[-1].done)]
    assert not referee.judge(nudged).ok
    straight = [Leg(leg.q[[0, -1]], leg.done) for leg in legs]
    assert any("of penetration" in text for text in referee.judge(straight).wrong)


@SKIP
@BY_FILE
def test_the_referee_accepts_the_plan(file: Path, tmp_path: Path) -> None:
    peer = load_peer(file)
    planner = Planner(problem_of(peer, tmp_path), seed=0)
    for plan in planner.improve(30, first=True):
        verdict = Referee(peer).judge(legs_of(peer, plan))
        assert verdict.ok, verdict
        assert verdict.price == pytest.approx(plan.cost)
    assert planner.best is not None, planner.explain()
