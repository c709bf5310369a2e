"""The search tree under random growth: costs add up along branches, no cycles, cuts take all with them."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import networkx as nx
import numpy as np
import pytest

from mrtamp.modes import Attachment, Mode
from mrtamp.plan import Action, Transition, plan_cost
from mrtamp.problem import CostWeights
from mrtamp.tensor_tree import Node, TensorTree, as_mapping

WEIGHTS = CostWeights(makespan=1.0, path_length=0.1, transitions={"pick": 0.5})
RESTING = Attachment("cube", "table", np.eye(4), "floor")
HELD = Attachment("cube", "left", np.eye(4), None, 0.04)
BEFORE, AFTER = Mode((RESTING,)), Mode((HELD,))
PICK = Transition((Action("pick", ("left",), RESTING, HELD),))


def a_tree(vertices: int = 12) -> TensorTree:
    """Two robots of three joints with random roadmap vertices; the tree asks for nothing but configurations."""
    rng = np.random.default_rng(0)
    roadmaps = [SimpleNamespace(name=name, q=rng.normal(size=(vertices, 3))) for name in ("left", "right")]
    return TensorTree(roadmaps, WEIGHTS)  # type: ignore[arg-type]


def check(tree: TensorTree) -> None:
    """All invariants at once."""
    alive = [n for n in tree.nodes if n.alive]
    for node in alive:
        branch = tree.branch(node)
        assert len({id(n) for n in branch}) == len(branch)
        assert branch[0].parent is None and branch[0] is tree.nodes[0]
        assert all(n.alive for n in branch)
        cost = sum(
            WEIGHTS.transitions["pick"] if b.transition else tree.step_cost(a.at, b.at) for a, b in pairwise(branch)
        )
        assert node.cost == pytest.approx(cost, abs=1e-9)
        assert tree.find(node.mode, node.at) is node
        assert node in tree.of_orbit[node.orbit]
        assert all(child.parent is node for child in node.children if child.alive)
        if node.parent is not None:
            assert node.parent.children.count(node) == 1
            assert (node.transition is not None) == (node.mode is not node.parent.mode)
    assert sum(len(nodes) for nodes in tree.of_orbit.values()) == len(alive)
    assert all(node.orbit == orbit for orbit, nodes in tree.of_orbit.items() for node in nodes)


def cheapest(tree: TensorTree) -> dict[Node, float]:
    """Dijkstra over everything that was proved."""
    graph = nx.DiGraph()
    for x in tree.nodes:
        if x.alive:
            graph.add_node(x)
            graph.add_weighted_edges_from((x, y, cost) for y, cost in x.steps.items())
            graph.add_weighted_edges_from((y, x, cost) for y, (_, cost) in x.entries.items())
    return nx.single_source_dijkstra_path_length(graph, tree.nodes[0])


def grow(tree: TensorTree, steps: int, seed: int, cuts: bool) -> None:
    """Random insertions and rewirings in two modes, with picks between them, now and then a cut."""
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        alive = [n for n in tree.nodes if n.alive]
        parent = alive[int(rng.integers(len(alive)))]
        if parent.mode is BEFORE and rng.random() < 0.2:
            tree.insert_transition(parent, PICK, AFTER, 1, WEIGHTS.transitions["pick"])
        elif cuts and parent.parent is not None and rng.random() < 0.05:
            tree.cut(parent)
        elif cuts and parent.steps and rng.random() < 0.1:
            tree.refute([(parent, list(parent.steps)[int(rng.integers(len(parent.steps)))])])
        else:
            at = tuple(int(v) for v in rng.integers(6, size=2))
            tree.insert(parent, at)


@pytest.mark.parametrize("cuts", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_costs_and_structure_survive_random_growth(seed: int, cuts: bool) -> None:
    tree = a_tree()
    tree.add_root(BEFORE, (0, 0), 0)
    for round_ in range(6):
        grow(tree, 60, 10 * seed + round_, cuts)
        check(tree)
        assert {n: n.cost for n in tree.nodes if n.alive} == pytest.approx(cheapest(tree))
    assert len(tree.nodes) > 30


def test_every_node_ends_at_its_shortest_known_cost() -> None:
    """When all steps between six vertices each have been offered often enough, costs are those of Dijkstra."""
    tree = a_tree(4)
    root = tree.add_root(BEFORE, (0, 0), 0)
    ats = [(i, j) for i in range(4) for j in range(4)]
    for _ in range(6):
        for node in list(tree.nodes):
            for at in ats:
                # Only one robot at a time may move, and only to the next vertex.
                if sum(abs(a - b) for a, b in zip(node.at, at, strict=True)) == 1:
                    tree.insert(node, at)
    best = {root.at: 0.0}
    for _ in range(20):
        for a in list(best):
            for b in ats:
                if sum(abs(x - y) for x, y in zip(a, b, strict=True)) == 1:
                    best[b] = min(best.get(b, np.inf), best[a] + tree.step_cost(a, b))
    assert {n.at: n.cost for n in tree.nodes} == pytest.approx(best)
    check(tree)


def test_step_cost_is_the_longest_robot_plus_a_share_of_all() -> None:
    tree = a_tree()
    left, right = tree.roadmaps
    a, b = (float(np.linalg.norm(m.q[1] - m.q[0])) for m in (left, right))
    assert tree.step_cost((0, 0), (1, 1)) == pytest.approx(max(a, b) + 0.1 * (a + b))
    assert tree.step_cost((0, 0), (1, 0)) == pytest.approx(1.1 * a)
    assert tree.step_cost((2, 3), (2, 3)) == 0.0


def test_a_cheaper_parent_is_taken_and_all_that_follows_gets_cheaper() -> None:
    tree = a_tree()
    root = tree.add_root(BEFORE, (0, 0), 0)
    detour, _ = tree.insert(root, (5, 5))
    node, new = tree.insert(detour, (1, 0))
    child, _ = tree.insert(node, (2, 0))
    held = tree.insert_transition(child, PICK, AFTER, 1, 0.5)
    before = held.cost
    again, is_new = tree.insert(root, (1, 0))
    assert new and not is_new and again is node
    assert node.parent is root and node not in detour.children
    assert held.cost < before
    worse, _ = tree.insert(held, (5, 5))
    assert worse.mode is AFTER
    tree.insert(detour, (1, 0))
    assert node.parent is root, "a dearer parent is not"
    check(tree)


def test_a_cut_removes_the_whole_subtree_and_its_place_may_be_taken_again() -> None:
    tree = a_tree()
    root = tree.add_root(BEFORE, (0, 0), 0)
    a, _ = tree.insert(root, (1, 1))
    b, _ = tree.insert(a, (2, 1))
    held = tree.insert_transition(b, PICK, AFTER, 1, 0.5)
    other, _ = tree.insert(root, (3, 3))
    tree.cut(a)
    assert [n.alive for n in (root, a, b, held, other)] == [True, False, False, False, True]
    assert tree.find(BEFORE, (2, 1)) is None and tree.find(AFTER, (2, 1)) is None
    assert tree.of_orbit.get(1, []) == []
    back, new = tree.insert(other, (2, 1))
    assert new and back is not b
    check(tree)


def test_modes_grow_on_after_all_their_nodes_were_cut() -> None:
    tree = a_tree()
    root = tree.add_root(BEFORE, (0, 0), 0)
    for k in range(40):
        held = tree.insert_transition(root, PICK, AFTER, 1, 0.5)
        assert tree.find(AFTER, (0, 0)) is held, k
        tree.cut(held)
    check(tree)


def test_a_refuted_step_is_replaced_by_the_cheapest_other_proof() -> None:
    tree = a_tree()
    root = tree.add_root(BEFORE, (0, 0), 0)
    a, _ = tree.insert(root, (1, 1))
    end, _ = tree.insert(a, (2, 2))
    held = tree.insert_transition(end, PICK, AFTER, 1, 0.5)
    only, _ = tree.insert(end, (5, 5))
    others = [tree.insert(root, at)[0] for at in ((3, 3), (4, 4))]
    for x in others:
        tree.insert(x, (2, 2))
    best = min(others, key=lambda x: x.cost + tree.step_cost(x.at, end.at))
    assert tree.refute([(a, end)]) == []
    assert end.parent is best
    assert held.cost == pytest.approx(best.cost + tree.step_cost(best.at, end.at) + 0.5)
    check(tree)
    assert set(tree.refute([(x, end) for x in others])) == {end, held, only}
    assert not any(x.alive for x in (end, held, only)) and all(x.alive for x in (root, a, *others))
    check(tree)


def test_a_second_cheaper_entry_moves_everything_behind_a_transition() -> None:
    tree = a_tree()
    root = tree.add_root(BEFORE, (0, 0), 0)
    detour, _ = tree.insert(root, (5, 5))
    first = tree.insert_transition(detour, PICK, AFTER, 1, 0.5)
    inside, _ = tree.insert(first, (1, 1))
    short, _ = tree.insert(root, (1, 1))
    second = tree.insert_transition(short, PICK, AFTER, None, 0.5)
    assert second is inside, "the same vertices in the same mode are the same node"
    assert short.cost < detour.cost + tree.step_cost(first.at, inside.at)
    assert inside.parent is short and inside.transition is PICK and inside.cost == pytest.approx(short.cost + 0.5)
    tree.refute([(short, inside)])
    assert inside.parent is first and inside.transition is None
    check(tree)


def test_merged_orbits_are_one() -> None:
    tree = a_tree()
    root = tree.add_root(BEFORE, (0, 0), 0)
    nodes = [tree.insert_transition(root, PICK, AFTER, 1, 0.5)]
    nodes.append(tree.insert(nodes[0], (1, 1))[0])
    elsewhere, _ = tree.insert(root, (2, 2))
    nodes.append(tree.insert_transition(elsewhere, PICK, AFTER, 2, 0.5))
    tree.merge_orbits(1, 2)
    assert {n.orbit for n in nodes} == {1}
    assert set(tree.of_orbit) == {0, 1}
    check(tree)


def test_trace_is_the_branch_as_segments_and_its_cost_is_the_plans() -> None:
    tree = a_tree()
    node: Node = tree.add_root(BEFORE, (0, 0), 0)
    for at in ((1, 0), (1, 2)):
        node, _ = tree.insert(node, at)
    node = tree.insert_transition(node, PICK, AFTER, 1, 0.5)
    node, _ = tree.insert(node, (3, 4))
    segments, transitions, groups = tree.trace(node)
    assert [s.mode for s in segments] == [BEFORE, AFTER]
    assert [s.length for s in segments] == [3, 2]
    assert transitions == [PICK]
    assert [[n.at for n in g] for g in groups] == [[(0, 0), (1, 0), (1, 2)], [(1, 2), (3, 4)]]
    np.testing.assert_array_equal(segments[1].q["right"], tree.roadmaps[1].q[[2, 4]])
    assert plan_cost(segments, transitions, WEIGHTS) == pytest.approx(node.cost)


def test_vertices_by_name() -> None:
    assert as_mapping(a_tree().roadmaps, (3, 5)) == {"left": 3, "right": 5}
