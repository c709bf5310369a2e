"""InsertAndRewire and orbits: costs are Dijkstra's over what was proved, orbits are its components, always."""

from __future__ import annotations

import itertools
from collections import Counter
from itertools import pairwise

import networkx as nx
import numpy as np
import pytest
from flatland import MODE, Flatland, Setting, grid, roadmap, step_cost, step_free, tensor_neighbours

from mrtamp.intra_orbit.lazy_validate import step_is_valid
from mrtamp.modes import Mode
from mrtamp.plan import Action, Transition
from mrtamp.tensor_tree import Node

PRICE = 0.3


def crowd(rewirings: int = 0, seed: int = 0) -> Setting:
    """Two robots on 3 x 3 grids that overlap, tight enough for many steps to be blocked."""
    roadmaps = [grid(n, 3, 3, 0.2, seed + k) for k, n in enumerate("ab")]
    return Setting(Flatland(roadmaps, 0.3, [((1.4, 1.5), 0.1)]), roadmaps, (0, 8), rewirings)


def reach(setting: Setting, node: Node, subgoal: str) -> Node:
    """Reach a subgoal on the spot."""
    transition = Transition((Action("reach", ("a",), None, None, subgoal),))
    return setting.orbits.enter(node, transition, node.mode.after(transition), PRICE)


def proofs(setting: Setting) -> tuple[nx.Graph, nx.DiGraph]:
    """All living nodes, under proved steps, and under steps and transitions with their costs."""
    steps, ways = nx.Graph(), nx.DiGraph()
    for x in setting.alive():
        steps.add_node(x)
        ways.add_node(x)
        for y, cost in x.steps.items():
            steps.add_edge(x, y)
            ways.add_edge(x, y, weight=cost)
        for y, (_, cost) in x.entries.items():
            ways.add_edge(y, x, weight=cost)
    return steps, ways


def check(setting: Setting) -> None:
    """All invariants of tree, orbits and graphs at once, by brute force."""
    tree, graphs, alive = setting.tree, setting.graphs, setting.alive()
    steps, ways = proofs(setting)
    assert set(ways) == set(alive), "nothing proved leads to what is no more"
    assert {x: x.cost for x in alive} == pytest.approx(nx.single_source_dijkstra_path_length(ways, setting.root))
    for x in alive:
        assert tree.find(x.mode, x.at) is x
        if x.parent is None:
            assert x is setting.root
        elif x.transition is None:
            assert x.mode.key == x.parent.mode.key
            assert x.cost == pytest.approx(x.parent.cost + step_cost(setting.roadmaps, x.parent.at, x.at))
        else:
            assert x.at == x.parent.at
            assert x.cost == pytest.approx(x.parent.cost + PRICE)
        assert all(child.parent is x for child in x.children)
        assert x.parent is None or x.parent.children.count(x) == 1
        assert tree.branch(x)[0] is setting.root
    components = {frozenset(c) for c in nx.connected_components(steps)}
    by_orbit = {o: frozenset(nodes) for o, nodes in tree.of_orbit.items() if nodes}
    assert set(by_orbit.values()) == components and len(by_orbit) == len(components)
    for orbit, nodes in by_orbit.items():
        assert {x.orbit for x in nodes} == {orbit} and graphs.find(orbit) == orbit
        assert {x.mode.key for x in nodes} == {graphs.mode(orbit).key}
        assert orbit in graphs.orbits_of[graphs.mode(orbit).state]
    transitions = Counter((y.orbit, x.orbit) for x in alive for y in x.entries)
    assert {(a, b): d["count"] for a, b, d in graphs.orbital.edges(data=True)} == transitions


def grow(setting: Setting, rng: np.random.Generator, n: int) -> None:
    """Random valid steps and transitions."""
    for _ in range(n):
        alive = setting.alive()
        node = alive[int(rng.integers(len(alive)))]
        if rng.random() < 0.25:
            left = [s for s in ("one", "two") if s not in node.mode.done]
            if left:
                reach(setting, node, left[int(rng.integers(len(left)))])
            continue
        options = list(tensor_neighbours(setting.roadmaps, node.at))
        at = options[int(rng.integers(len(options)))]
        if step_is_valid(setting.roadmaps, setting.world, node.mode, node.at, at):
            setting.insert(node, at)


def refute(setting: Setting, rng: np.random.Generator) -> None:
    """A random proof turns out wrong, or a node has to go."""
    pairs = [(x, y) for x in setting.alive() for y in x.steps]
    if rng.random() < 0.3:
        entered = [x for x in setting.alive() if x.entries]
        if entered:
            setting.orbits.refute_entries(entered[int(rng.integers(len(entered)))])
    elif rng.random() < 0.2:
        leaves = [x for x in setting.alive() if x.parent is not None and len(x.children) < 3]
        if leaves:
            node = leaves[int(rng.integers(len(leaves)))]
            setting.orbits.remove(node)
            assert not node.alive
    elif pairs:
        x, y = pairs[int(rng.integers(len(pairs)))]
        moving = [g.name for g, u, v in zip(setting.roadmaps, x.at, y.at, strict=True) if u != v]
        alone = rng.random() < 0.3
        if alone and rng.random() < 0.5:
            i = [g.name for g in setting.roadmaps].index(moving[0])
            setting.orbits.refute_edge(x.mode, moving[0], (x.at[i], y.at[i]), "wall")
        else:
            setting.orbits.refute(x, y, (moving[0],) if alone else ("a", "b"), "wall" if alone else None)
        assert y not in x.steps
        assert not step_is_valid(setting.roadmaps, setting.world, x.mode, x.at, y.at)


@pytest.mark.parametrize("rewirings", [0, 6])
@pytest.mark.parametrize("seed", range(6))
def test_costs_and_orbits_survive_growth_and_refutation(seed: int, rewirings: int) -> None:
    setting = crowd(rewirings, seed)
    rng = np.random.default_rng(seed)
    for _ in range(25):
        grow(setting, rng, 20)
        check(setting)
        refute(setting, rng)
        check(setting)
        for x in setting.alive():
            for y in x.steps:
                assert step_is_valid(setting.roadmaps, setting.world, x.mode, x.at, y.at), (
                    "no proof is known to be wrong"
                )
    assert len(setting.tree.nodes) > 60


def test_orbits_merge_and_split_with_the_evidence() -> None:
    """Two entries into one mode, a motion that joins them, and the judge who says no."""
    a = roadmap("a", [(0, 0), (1, 0), (2, 0)], [(0, 1), (1, 2)])
    b = roadmap("b", [(0, 9), (1, 9)], [(0, 1)])
    setting = Setting(Flatland([a, b], 0.2), [a, b], (0, 0))
    near = setting.insert(setting.root, (1, 0))
    far = setting.insert(near, (2, 0))
    one, two = reach(setting, setting.root, "one"), reach(setting, far, "one")
    assert one.orbit != two.orbit and near.orbit == setting.root.orbit
    middle = setting.insert(one, (1, 0))
    assert setting.insert(middle, (2, 0)) is two
    assert one.orbit == two.orbit == middle.orbit
    assert two.parent is far, "the way within the mode is as long, and a transition's price is paid once on both"
    edges = setting.graphs.orbital.edges
    assert edges[setting.root.orbit, one.orbit]["count"] == 2
    check(setting)
    # Robot a does not get from 1 to 2 after all: what rested on it falls apart, in both modes.
    setting.orbits.refute(near, far, ("a",), "wall")
    assert not far.alive and not two.alive
    assert middle.alive and middle.orbit == one.orbit
    assert edges[setting.root.orbit, one.orbit]["count"] == 1
    check(setting)


def test_a_split_orbit_keeps_both_sides_when_both_have_entries() -> None:
    a = roadmap("a", [(0, 0), (1, 0), (2, 0)], [(0, 1), (1, 2), (0, 2)])
    b = roadmap("b", [(0, 9), (1, 9)], [(0, 1)])
    setting = Setting(Flatland([a, b], 0.2), [a, b], (0, 0))
    far = setting.insert(setting.root, (2, 0))
    one, two = reach(setting, setting.root, "one"), reach(setting, far, "one")
    setting.insert(setting.insert(one, (1, 0)), (2, 0))
    joined = one.orbit
    leaf = reach(setting, two, "two")
    assert two.orbit == joined and len(setting.graphs.orbits_of[one.mode.state]) == 1
    middle = setting.tree.find(one.mode, (1, 0))
    assert middle is not None
    # The first mode got there by another edge, so its motions stay proved.
    setting.orbits.refute(middle, two, ("a",), "wall")
    assert all(x.alive for x in (far, one, two, middle, leaf))
    assert one.orbit == middle.orbit == joined and two.orbit != joined
    assert setting.graphs.orbital.has_edge(setting.root.orbit, two.orbit)
    assert setting.graphs.orbital.has_edge(two.orbit, leaf.orbit)
    assert not setting.graphs.orbital.has_edge(joined, leaf.orbit)
    assert sorted(setting.graphs.orbits_of[one.mode.state]) == sorted([joined, two.orbit])
    check(setting)


def test_a_refuted_step_costs_only_what_had_no_other_way() -> None:
    g = roadmap("a", [(0, 0), (1, 0), (1, 1), (2, 0)], [(0, 1), (0, 2), (2, 1), (1, 3)])
    far = roadmap("b", [(0, 9)], [])
    setting = Setting(Flatland([g, far], 0.2), [g, far], (0, 0))
    direct = setting.insert(setting.root, (1, 0))
    end = setting.insert(direct, (3, 0))
    after = reach(setting, end, "one")
    detour = setting.insert(setting.root, (2, 0))
    setting.insert(detour, (1, 0))
    cost = after.cost
    setting.orbits.refute(setting.root, direct, ("a",), "wall")
    assert direct.parent is detour and all(x.alive for x in (direct, end, after))
    assert after.cost == pytest.approx(cost + 1.1 * np.sqrt(2))
    check(setting)


@pytest.mark.parametrize("seed", range(3))
def test_rewiring_lowers_costs_and_validates_no_more_than_it_may(seed: int) -> None:
    plain, rewired = crowd(0, seed), crowd(5, seed)
    rng = np.random.default_rng(seed)
    for _ in range(300):
        k = int(rng.integers(len(plain.alive())))
        options = list(tensor_neighbours(plain.roadmaps, plain.tree.nodes[k].at))
        at = options[int(rng.integers(len(options)))]
        if step_free(plain.world, plain.roadmaps, plain.tree.nodes[k].at, at):
            plain.insert(plain.tree.nodes[k], at)
            twin = rewired.tree.find(MODE, plain.tree.nodes[k].at)
            assert twin is not None
            rewired.insert(twin, at)
    costs = {x.at: x.cost for x in plain.alive()}
    better = {x.at: x.cost for x in rewired.alive()}
    assert set(costs) == set(better), "rewiring connects nodes, it makes none"
    assert all(better[at] <= costs[at] + 1e-9 for at in costs)
    assert sum(better.values()) < 0.99 * sum(costs.values())
    for x in rewired.alive():
        for a, b in pairwise(rewired.tree.branch(x)):
            assert step_free(rewired.world, rewired.roadmaps, a.at, b.at)
    check(rewired)


def test_rewiring_goes_on_until_no_neighbour_is_worth_it() -> None:
    """One validation at a time, each pair once: in the end costs are Dijkstra's over all valid steps between nodes."""
    setting = crowd()
    grow(setting, np.random.default_rng(4), 150)
    setting.orbits.rewirings = 1
    asked: list[int] = []
    for _ in range(200):
        asked += [setting.orbits.rewire(x) for x in setting.alive()]
        if not any(asked[-len(setting.alive()) :]):
            break
    assert set(asked) == {0, 1}
    alive = setting.alive()
    truth = nx.DiGraph()
    for x, y in itertools.permutations(alive, 2):
        if x.mode.key == y.mode.key and y.at in set(tensor_neighbours(setting.roadmaps, x.at)):
            if step_free(setting.world, setting.roadmaps, x.at, y.at):
                truth.add_edge(x, y, weight=step_cost(setting.roadmaps, x.at, y.at))
        elif x in y.entries:
            truth.add_edge(x, y, weight=PRICE)
    assert {x: x.cost for x in alive} == pytest.approx(nx.single_source_dijkstra_path_length(truth, setting.root))
    assert sum(asked) < truth.number_of_edges() / 2, "lazily"
    check(setting)


def test_a_step_from_outside_becomes_a_step_of_the_tensor_product() -> None:
    a = roadmap("a", [(0, 0), (1, 0), (2, 0)], [(0, 1), (1, 2)])
    b = roadmap("b", [(0, 9), (1, 9)], [])
    setting = Setting(Flatland([a, b], 0.2), [a, b], (0, 0))
    far = setting.insert(setting.root, (2, 1))
    assert far.at in set(tensor_neighbours(setting.roadmaps, setting.root.at))
    assert [x.at for x in setting.tree.adjacent(far)[0]] == [(0, 0)]


def test_neighbours_in_the_tree_are_those_of_the_tensor_product() -> None:
    setting = crowd()
    grow(setting, np.random.default_rng(0), 400)
    for x in setting.alive():
        near, costs = setting.tree.adjacent(x)
        product = set(tensor_neighbours(setting.roadmaps, x.at))
        assert {y.at for y in near} == {y.at for y in setting.alive() if y.at in product and y.mode.key == x.mode.key}
        assert list(costs) == pytest.approx([step_cost(setting.roadmaps, x.at, y.at) for y in near])


def test_a_step_is_judged_alike_in_both_directions_and_as_geometry_says() -> None:
    setting = crowd()
    ats = list(itertools.product(range(9), repeat=2))
    for at in ats[::3]:
        for b in tensor_neighbours(setting.roadmaps, at):
            verdict = step_is_valid(setting.roadmaps, setting.world, Mode(()), at, b)
            assert verdict == step_free(setting.world, setting.roadmaps, at, b)
            asked = setting.world.asked
            assert step_is_valid(setting.roadmaps, setting.world, Mode(()), b, at) == verdict
            assert setting.world.asked == asked, "known already"
