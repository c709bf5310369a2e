"""Skeletons: agreement with brute force and with an independent simulation, precedence, and speed."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from itertools import combinations, permutations, product

import numpy as np
import pytest

from mrtamp.options import Event, Option, Skeleton, Task
from mrtamp.problem import CostWeights
from mrtamp.skeletons import lower_bound, skeletons

N = 3
WEIGHTS = CostWeights(makespan=1.0, path_length=0.1)


def carry(rng: np.random.Generator, robot: str, M: int, **more) -> Option:
    events = (Event("pick", {robot: rng.normal(size=(M, N))}), Event("place", {robot: rng.normal(size=(M, N))}))
    return Option((robot,), events, **more)


def relay(rng: np.random.Generator, first: str, second: str, M: int) -> Option:
    a, b = carry(rng, first, M), carry(rng, second, M)
    return Option((first, second), a.events + b.events)


def handover(rng: np.random.Generator, giver: str, receiver: str, M: int) -> Option:
    q = [rng.normal(size=(M, N)) for _ in range(4)]
    events = (
        Event("pick", {giver: q[0]}),
        Event("handover", {giver: q[1], receiver: q[2]}),
        Event("place", {receiver: q[3]}),
    )
    return Option((giver, receiver), events)


def places(rng: np.random.Generator, robots: Sequence[str]) -> tuple[dict, dict]:
    starts = {r: rng.normal(size=N) for r in robots}
    return starts, {r: rng.normal(size=N) if i % 2 == 0 else None for i, r in enumerate(robots)}


def simulate(
    tasks: Sequence[Task],
    choices: Mapping[str, tuple[int, int]],
    courses: Mapping[str, Sequence[tuple[str, int]]],
    precedence: Sequence,
    starts: Mapping[str, np.ndarray],
    ends: Mapping[str, np.ndarray | None],
    weights: CostWeights = WEIGHTS,
) -> tuple[float, float, dict] | None:
    """Cost, bound and times of a schedule by relaxation: raise every time until nothing is too early."""
    options = {t.name: t.options[choices[t.name][0]] for t in tasks}
    stop = lambda r, t, e: options[t].events[e].stops[r][choices[t][1]]  # noqa: E731
    events = [(t, e) for t, o in options.items() for e in range(len(o.events))]
    times = dict.fromkeys(events, 0.0)
    number = {t: len(o.events) for t, o in options.items()}
    for _ in range(len(events) + 1):
        before = dict(times)
        for t, e in events:
            if e > 0:
                times[t, e] = max(times[t, e], times[t, e - 1])
        for (a, i), (b, j) in precedence:
            times[b, j % number[b]] = max(times[b, j % number[b]], times[a, i % number[a]])
        for r, course in courses.items():
            at, clock = starts[r], 0.0
            for t, e in course:
                way = np.linalg.norm(stop(r, t, e) - at)
                times[t, e] = max(times[t, e], clock + way)
                at, clock = stop(r, t, e), times[t, e]
        if before == times:
            break
    else:
        return None
    lengths, finish = [], []
    for r, course in courses.items():
        stops = [starts[r], *(stop(r, t, e) for t, e in course)]
        end = [ends[r]] if ends[r] is not None else []
        lengths.append(sum(np.linalg.norm(y - x) for x, y in zip(stops, stops[1:] + end, strict=False)))
        last = times[course[-1]] if course else 0.0
        finish.append(last + (np.linalg.norm(end[0] - stops[-1]) if end else 0.0))
    extra = sum(o.constant + (0.0 if o.penalty is None else o.penalty[choices[t][1]]) for t, o in options.items())
    rest = weights.path_length * sum(lengths) + extra
    return weights.makespan * max(finish) + rest, weights.makespan * max(lengths) + rest, times


def courses_of(tasks: Sequence[Task], skeleton: Skeleton, robots: Sequence[str]) -> dict[str, list[tuple[str, int]]]:
    option = {t.name: t.options[skeleton.choices[t.name][0]] for t in tasks}
    return {
        r: [(h.task, h.event) for h in skeleton.happenings if r in option[h.task].events[h.event].stops] for r in robots
    }


def brute_force(tasks: Sequence[Task], precedence: Sequence, starts: dict, ends: dict) -> tuple[dict, float]:
    """Cheapest cost of every (assignment, order) of carries, and the cheapest cost without waiting among those possible
    on each robot."""
    robots = list(starts)
    names = [t.name for t in tasks]
    best: dict[tuple, float] = {}
    bound = np.inf
    for chosen in product(*(range(len(t.options)) for t in tasks)):
        robot = {t.name: t.options[o].robots[0] for t, o in zip(tasks, chosen, strict=True)}
        groups = [list(permutations([n for n in names if robot[n] == r])) for r in robots]
        for orders in product(*groups):
            if any(o.index(a) > o.index(b) for o in orders for (a, _), (b, _) in precedence if a in o and b in o):
                continue
            courses = {r: [(n, e) for n in order for e in (0, 1)] for r, order in zip(robots, orders, strict=True)}
            sizes = [range(t.options[o].candidates) for t, o in zip(tasks, chosen, strict=True)]
            for candidates in product(*sizes):
                choices = {n: (o, m) for n, o, m in zip(names, chosen, candidates, strict=True)}
                alone = simulate(tasks, choices, courses, [], starts, ends)
                assert alone is not None
                bound = min(bound, alone[1])
                outcome = simulate(tasks, choices, courses, precedence, starts, ends)
                if outcome is not None:
                    key = tuple(orders)
                    best[key] = min(best.get(key, np.inf), outcome[0])
    return best, bound


@pytest.mark.parametrize("seed", range(6))
def test_the_cheapest_orders_and_the_bound_are_those_of_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robots = ["a", "b"]
    tasks = [Task(f"t{i}", tuple(carry(rng, r, 2) for r in robots)) for i in range(3)]
    if seed % 3 == 1:
        tasks[0] = Task("t0", tasks[0].options[:1])
    if seed % 3 == 2:
        tasks[1] = Task("t1", (*tasks[1].options, carry(rng, "a", 2)))
    starts, ends = places(rng, robots)
    best, bound = brute_force(tasks, [], starts, ends)
    found = skeletons(tasks, [], starts, ends, WEIGHTS, limit=8, rng=rng)
    np.testing.assert_allclose([s.cost for s in found], sorted(best.values())[:8], atol=1e-6)
    floor = lower_bound(tasks, [], starts, ends, WEIGHTS)
    assert floor.exact
    assert floor.value == pytest.approx(bound, abs=1e-6)
    assert len({s.order for s in found}) == 8


@pytest.mark.parametrize("seed", range(6))
def test_precedence_across_robots_is_scheduled_as_well_as_brute_force_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robots = ["a", "b"]
    tasks = [Task(f"t{i}", tuple(carry(rng, r, 2) for r in robots)) for i in range(3)]
    starts, ends = places(rng, robots)
    # A tower: t0 is placed before t1 before t2; and t2 has to be picked up before t1 can be placed.
    precedence = [(("t0", -1), ("t1", -1)), (("t1", 1), ("t2", 1)), (("t0", 0), ("t2", 0))]
    best, bound = brute_force(tasks, precedence, starts, ends)
    found = skeletons(tasks, precedence, starts, ends, WEIGHTS, limit=4, rng=rng)
    assert found[0].cost == pytest.approx(min(best.values()), abs=1e-6)
    np.testing.assert_allclose([s.cost for s in found], sorted(best.values())[:4], rtol=0.02)
    assert lower_bound(tasks, precedence, starts, ends, WEIGHTS).value == pytest.approx(bound, abs=1e-6)
    for skeleton in found:
        at = {(h.task, h.event): (n, h.time) for n, h in enumerate(skeleton.happenings)}
        for (a, i), (b, j) in precedence:
            assert at[a, i % 2] < at[b, j % 2]


def mixed(rng: np.random.Generator, robots: Sequence[str], tasks: int, M: int) -> list[Task]:
    """Carries, relays, handovers and meetings of two robots."""
    out = []
    for i in range(tasks):
        options = [carry(rng, r, M, penalty=rng.random(M), constant=0.1) for r in robots if rng.random() < 0.6]
        for a, b in combinations(robots, 2):
            options.append(relay(rng, a, b, M) if rng.random() < 0.5 else handover(rng, b, a, M))
        out.append(Task(f"t{i}", tuple(options)))
    stops = {r: rng.normal(size=(M, N)) for r in robots[:2]}
    return [*out, Task("meet", (Option(tuple(robots[:2]), (Event("reach", stops),)),))]


@pytest.mark.parametrize("seed", range(4))
def test_costs_and_times_are_those_of_an_independent_simulation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robots = ["a", "b", "c"]
    tasks = mixed(rng, robots, 3, 4)
    starts, ends = places(rng, robots)
    precedence = [(("t0", -1), ("meet", 0)), (("t1", 0), ("t2", -1))]
    found = skeletons(tasks, precedence, starts, ends, WEIGHTS, limit=10, rng=rng, effort=100)
    floor = lower_bound(tasks, precedence, starts, ends, WEIGHTS)
    assert len(found) == 10
    assert not floor.exact
    for skeleton in found:
        outcome = simulate(tasks, skeleton.choices, courses_of(tasks, skeleton, robots), precedence, starts, ends)
        assert outcome is not None
        assert skeleton.cost == pytest.approx(outcome[0], abs=1e-9)
        assert skeleton.bound == pytest.approx(outcome[1], abs=1e-9)
        assert floor.value <= skeleton.bound + 1e-9 <= skeleton.cost + 1e-8
        for h in skeleton.happenings:
            assert h.time == pytest.approx(outcome[2][h.task, h.event], abs=1e-9)
    assert [s.cost for s in found] == sorted(s.cost for s in found)


def test_a_hand_that_is_full_does_nothing_else() -> None:
    rng = np.random.default_rng(0)
    robots = ["a", "b", "c"]
    tasks = mixed(rng, robots, 4, 3)
    starts, ends = places(rng, robots)
    for skeleton in skeletons(tasks, [], starts, ends, WEIGHTS, limit=10, rng=rng, effort=100):
        option = {t.name: t.options[skeleton.choices[t.name][0]] for t in tasks}
        for r, course in courses_of(tasks, skeleton, robots).items():
            load = None
            for t, e in course:
                assert load in (None, t)
                kind = option[t].events[e].kind
                load = t if kind == "pick" or (kind == "handover" and r == option[t].robots[1]) else None


def test_swapping_two_objects_needs_both_hands_or_a_relay() -> None:
    """Each of two objects goes to where the other is: neither can be placed before the other has been picked up."""
    rng = np.random.default_rng(1)
    starts, ends = places(rng, ["a", "b"])
    precedence = [(("x", 0), ("y", -1)), (("y", 0), ("x", -1))]
    both = [Task(n, tuple(carry(rng, r, 3) for r in "ab")) for n in "xy"]
    found = skeletons(both, precedence, starts, ends, WEIGHTS, limit=5, rng=rng)
    assert {s.order for s in found} == {
        ((("x", 0, ("a",)),), (("y", 0, ("b",)),)),
        ((("y", 0, ("a",)),), (("x", 0, ("b",)),)),
    }
    alone = [Task("x", (relay(rng, "a", "a", 3),)), Task("y", (carry(rng, "a", 3),))]
    found = skeletons(alone, precedence, starts, ends, WEIGHTS, limit=5, rng=rng)
    assert found
    assert all([h.task for h in s.happenings] == ["x", "x", "y", "y", "x", "x"] for s in found)
    hopeless = [Task(n, (carry(rng, "a", 3),)) for n in "xy"]
    assert skeletons(hopeless, precedence, starts, ends, WEIGHTS, limit=5, rng=rng) == []


def test_penalties_steer_to_other_candidates_and_other_robots() -> None:
    rng = np.random.default_rng(2)
    starts, ends = places(rng, ["a", "b"])
    options = [carry(rng, r, 3) for r in "ab"]
    [first] = skeletons([Task("t", tuple(options))], [], starts, ends, WEIGHTS, limit=1, rng=rng)
    o, m = first.choices["t"]
    penalty = np.zeros(3)
    penalty[m] = 100.0
    options[o] = Option(options[o].robots, options[o].events, penalty=penalty)
    [second] = skeletons([Task("t", tuple(options))], [], starts, ends, WEIGHTS, limit=1, rng=rng)
    assert second.choices["t"] != (o, m)
    options[o] = Option(options[o].robots, options[o].events, penalty=np.full(3, np.inf))
    [third] = skeletons([Task("t", tuple(options))], [], starts, ends, WEIGHTS, limit=1, rng=rng)
    assert third.choices["t"][0] != o


def test_given_distances_replace_straight_ones_and_no_way_means_no_skeleton() -> None:
    rng = np.random.default_rng(3)
    starts, ends = places(rng, ["a", "b"])
    tasks = [Task(n, tuple(carry(rng, r, 3) for r in "ab")) for n in "xy"]

    def twice(robot: str, A: np.ndarray, B: np.ndarray) -> np.ndarray:
        D = 2.0 * np.linalg.norm(A[:, None] - B[None], axis=2)
        return D if robot == "a" else np.full_like(D, np.inf)

    straight = skeletons([Task(t.name, t.options[:1]) for t in tasks], [], starts, ends, WEIGHTS, limit=1, rng=rng)
    found = skeletons(tasks, [], {"a": starts["a"], "b": starts["b"]}, ends, WEIGHTS, limit=9, rng=rng, distance=twice)
    assert found[0].cost == pytest.approx(2 * straight[0].cost, abs=1e-6)
    assert all(o == 0 for s in found for o, _ in s.choices.values())


def test_fewer_orders_than_asked_for_are_filled_up_with_other_candidates() -> None:
    rng = np.random.default_rng(4)
    starts, ends = places(rng, ["a"])
    tasks = [Task("t", (carry(rng, "a", 6),))]
    found = skeletons(tasks, [], starts, ends, WEIGHTS, limit=4, rng=rng)
    assert len({s.choices["t"] for s in found}) == 4
    assert len({s.order for s in found}) == 1
    assert [s.cost for s in found] == sorted(s.cost for s in found)


def test_assignments_can_be_kept_apart() -> None:
    rng = np.random.default_rng(5)
    starts, ends = places(rng, ["a", "b"])
    tasks = [Task(f"t{i}", tuple(carry(rng, r, 5) for r in "ab")) for i in range(4)]
    found = skeletons(tasks, [], starts, ends, WEIGHTS, limit=6, rng=rng, per_assignment=1)
    assert len({tuple(o for o, _ in s.choices.values()) for s in found}) == 6


def test_skeletons_are_the_same_for_the_same_seed() -> None:
    def run() -> list:
        rng = np.random.default_rng(6)
        robots = ["a", "b", "c"]
        tasks = mixed(rng, robots, 4, 4)
        starts, ends = places(rng, robots)
        return [(s.cost, s.choices) for s in skeletons(tasks, [], starts, ends, WEIGHTS, limit=6, rng=rng, effort=60)]

    assert run() == run()


@pytest.mark.parametrize(("robots", "tasks", "seconds"), [(2, 4, 0.3), (4, 4, 0.3), (4, 6, 1.0), (8, 24, 8.0)])
def test_it_is_fast(robots: int, tasks: int, seconds: float) -> None:
    """Generous limits; measured: 10, 20, 150 and 1500 ms."""
    rng = np.random.default_rng(7)
    names = [f"r{i}" for i in range(robots)]
    starts, ends = places(rng, names)
    every = [Task(f"t{i}", tuple(carry(rng, r, 100) for r in names)) for i in range(tasks)]
    clock = time.process_time()
    found = skeletons(every, [], starts, ends, CostWeights(), limit=10, rng=rng)
    assert time.process_time() - clock < seconds
    assert len(found) == 10


def test_other_candidates_of_an_order_are_clearly_different_ones_as_long_as_there_are() -> None:
    """Ten all but equal candidates at each of three places, near, farther and far away."""
    rng = np.random.default_rng(0)
    q = np.repeat([0.5, 1.5, 2.5], 10)[:, None] + rng.normal(scale=0.01, size=(30, N))
    task = Task("fetch", (Option(("a",), (Event("pick", {"a": q}),)),))
    question = ([task], [], {"a": np.zeros(N)}, {"a": np.zeros(N)}, WEIGHTS)
    found = skeletons(*question, limit=3, rng=rng)
    assert [s.choices["fetch"][1] // 10 for s in found] == [0, 1, 2]
    # Where no other place is left, what is near is better than nothing.
    found = skeletons(*question, limit=6, rng=rng)
    chosen = [s.choices["fetch"][1] for s in found]
    assert len(set(chosen)) == 6 and {m // 10 for m in chosen} == {0, 1, 2}
