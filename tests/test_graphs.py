"""Modal and orbital graphs: discovery, counts, and orbits that become one when a motion joins them."""

from __future__ import annotations

import networkx as nx
import numpy as np

from mrtamp.graphs import Graphs
from mrtamp.modes import Attachment, Mode


def mode(place: str) -> Mode:
    held = place in ("left", "right")
    return Mode((Attachment("cube", place, np.eye(4), None if held else place, 0.04 if held else None),))


def test_orbits_of_one_modal_state_are_kept_apart() -> None:
    graphs = Graphs()
    one, two = graphs.add_orbit(mode("floor")), graphs.add_orbit(mode("floor"))
    assert one != two
    assert list(graphs.modal) == [(("cube", "floor"),)]
    assert graphs.orbits_of[(("cube", "floor"),)] == [one, two]
    assert graphs.mode(two).state == (("cube", "floor"),)


def test_discovery_counts_transitions_without_needing_an_orbit() -> None:
    graphs = Graphs()
    start = mode("floor")
    graphs.add_orbit(start)
    for _ in range(3):
        graphs.discover(mode("left").state, start.state)
    assert graphs.modal.edges[start.state, mode("left").state]["count"] == 3
    assert graphs.orbits_of[mode("left").state] == []


def test_merging_joins_edges_counts_and_visits_and_stale_names_still_work() -> None:
    graphs = Graphs()
    start = graphs.add_orbit(mode("floor"))
    a, b, c = (graphs.add_orbit(mode("left")) for _ in "abc")
    end = graphs.add_orbit(mode("right"))
    for source, target in ((start, a), (start, b), (start, b), (b, end), (c, end)):
        graphs.transition(source, target)
    graphs.orbital.nodes[a]["visits"], graphs.orbital.nodes[b]["visits"] = 2, 5
    kept = graphs.merge(b, a)
    assert kept == a
    assert graphs.find(b) == graphs.find(a) == a
    assert graphs.merge(a, b) == a, "merging twice changes nothing"
    assert graphs.orbital.edges[start, a]["count"] == 3
    assert graphs.orbital.edges[a, end]["count"] == 1
    assert graphs.orbital.nodes[a]["visits"] == 7
    assert graphs.orbits_of[mode("left").state] == [a, c]
    graphs.transition(start, b)
    assert graphs.orbital.edges[start, a]["count"] == 4
    assert graphs.merge(c, b) == a
    assert graphs.find(c) == a
    assert set(graphs.orbital) == {start, a, end}
    assert graphs.mode(c) is graphs.mode(a)


def test_union_find_is_the_connected_components() -> None:
    rng = np.random.default_rng(0)
    graphs, truth = Graphs(), nx.Graph()
    orbits = [graphs.add_orbit(mode("left")) for _ in range(40)]
    truth.add_nodes_from(orbits)
    for _ in range(30):
        a, b = (int(x) for x in rng.integers(40, size=2))
        truth.add_edge(a, b)
        graphs.merge(a, b)
    for component in nx.connected_components(truth):
        assert {graphs.find(o) for o in component} == {min(component)}
    assert len(graphs.orbital) == nx.number_connected_components(truth)
    assert sorted(graphs.orbits_of[mode("left").state]) == sorted(graphs.orbital)


def test_a_split_makes_orbits_of_the_same_mode_and_edges_follow_the_count() -> None:
    graphs = Graphs()
    start, held = graphs.add_orbit(mode("floor")), graphs.add_orbit(mode("left"))
    end = graphs.add_orbit(mode("right"))
    for _ in range(3):
        graphs.transition(start, held)
    graphs.transition(held, end)
    parts = graphs.split(held, 2)
    assert len({held, *parts}) == 3
    assert all(graphs.mode(o) is graphs.mode(held) and graphs.find(o) == o for o in parts)
    assert graphs.orbits_of[mode("left").state] == [held, *parts]
    graphs.recount([held, *parts], {(start, held): 1, (start, parts[0]): 2, (parts[1], end): 1})
    counts = {(a, b): data["count"] for a, b, data in graphs.orbital.edges(data=True)}
    assert counts == {(start, held): 1, (start, parts[0]): 2, (parts[1], end): 1}
    assert graphs.merge(parts[0], held) == held
    assert graphs.orbital.edges[start, held]["count"] == 3
