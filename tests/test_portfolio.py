"""The portfolio: plans take turns under refinement, never get worse, and come to rest when nothing promises a gain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arena import XY, arena, visit, wall
from discs import Errands

from mrtamp.check import check_plan
from mrtamp.optimise import Optimiser
from mrtamp.plan import Plan
from mrtamp.planner import Options, Planner
from mrtamp.portfolio import _PATIENCE, _PLENTY, SIZE, Portfolio
from mrtamp.portfolio_entry import Entry, Sketch
from mrtamp.transitions.ways import Way

STARTS: Mapping[str, XY] = {"a": (-1, 1), "b": (-1, -1)}


def planner_for(folder: Path, robots: str = "ab", *without: str) -> Planner:
    """Every disc has to visit the other side of the square."""
    subgoals = [visit(f"{r} there", r, (1, STARTS[r][1])) for r in robots]
    problem = arena(folder, {r: STARTS[r] for r in robots}, subgoals=subgoals)
    return Planner(problem, options=Options(initial_vertices=5, without=frozenset(without)))


def roundabout(planner: Planner, height: float) -> Plan:
    """One disc after the other, by way of a point in the middle, so high."""
    errands = Errands(planner.problem)
    for robot in planner.names:
        errands.move(**{robot: (0, height * STARTS[robot][1])}).move(**{robot: (1, STARTS[robot][1])})
        errands.reach(f"{robot} there")
    plan = errands.plan()
    assert check_plan(plan).ok
    return plan


@pytest.mark.parametrize("robots", ["a", "ab"])
def test_plans_are_refined_to_the_optimum_and_then_left_alone(tmp_path: Path, robots: str) -> None:
    """Straight across, all at the same time: makespan 2, and 2 of path for each."""
    planner = planner_for(tmp_path, robots)
    portfolio, best = planner.portfolio, roundabout(planner, 0.6)
    assert portfolio.idle(best.cost), "nothing to do yet"
    portfolio.add(best)
    turns = 0
    while not portfolio.idle(best.cost) and turns < 300:
        plan = portfolio.improve(best.cost)
        turns += 1
        if plan is not None:
            assert plan.cost < best.cost
            assert check_plan(plan).ok
            best = plan
    assert turns < 300, "it comes to rest"
    assert best.cost == pytest.approx(2.0 + 0.02 * len(robots), rel=5e-3)
    assert best.cost >= 2.0 + 0.02 * len(robots) - 1e-6


def test_a_plan_is_taken_once_and_only_so_many_are_kept(tmp_path: Path) -> None:
    planner = planner_for(tmp_path)
    plan = roundabout(planner, 0.9)
    assert planner.portfolio.add(plan)
    assert not planner.portfolio.add(plan)
    taken = sum(planner.portfolio.add(roundabout(planner, 0.8 - 0.2 * k)) for k in range(SIZE + 2))
    assert taken >= SIZE - 1
    assert len(planner.portfolio._entries) == SIZE


def test_the_incumbent_has_its_second_round_before_others_have_their_trial(tmp_path: Path) -> None:
    planner = planner_for(tmp_path)
    portfolio, best = planner.portfolio, roundabout(planner, 0.6)
    portfolio.add_drafts([Sketch(best.cost, portfolio.yielding.time(best.segments, best.transitions))])
    [entry] = portfolio._entries
    best = entry.plan
    while not entry.done:
        best = portfolio.improve(best.cost) or best
    assert entry.rounds == 1
    assert portfolio.add(roundabout(planner, -0.9))
    assert portfolio._choose(best.cost) is entry
    while entry.rounds == 1:
        assert portfolio._choose(best.cost) is entry, "until it is over"
        best = portfolio.improve(best.cost) or best
    assert portfolio._choose(best.cost) is not entry, "now it is the other's turn"


def test_an_incumbent_far_above_what_skeletons_promise_is_challenged_before_its_second_round(tmp_path: Path) -> None:
    planner = planner_for(tmp_path)
    portfolio, best = planner.portfolio, roundabout(planner, 0.6)
    portfolio.add_drafts([Sketch(best.cost, portfolio.yielding.time(best.segments, best.transitions))])
    [entry] = portfolio._entries

    def poor(times: float) -> bool:
        """As if skeletons promised that the incumbent costs so many times as much as it could."""
        planner.skeletons.bound = best.cost / times
        return planner._poor(best.cost)

    assert not poor(1.2), "its first round is not over"
    while not entry.done:
        best = portfolio.improve(best.cost) or best
    assert portfolio.add(roundabout(planner, -0.9))
    assert not poor(1.1) and portfolio._choose(best.cost, planner.skeletons.bound) is entry
    assert poor(1.2) and portfolio._choose(best.cost, planner.skeletons.bound) is not entry
    assert not poor(1.2), "skeletons had their turn"
    portfolio.suit(choice=False)
    entry.patience = portfolio.patience
    assert portfolio._choose(best.cost, planner.skeletons.bound) is entry, "there are no other ways"


def test_drafts_begin_with_the_most_promising_whatever_they_seem_to_cost(tmp_path: Path) -> None:
    planner = planner_for(tmp_path)
    portfolio = planner.portfolio
    plans = [roundabout(planner, height) for height in (0.2, 0.9, 0.5)]
    assert plans[1].cost < plans[0].cost
    portfolio.add_drafts([Sketch(1.0, portfolio.yielding.time(p.segments, p.transitions)) for p in plans])
    first = portfolio._entries[-1]
    assert portfolio._choose(10 * plans[0].cost) is first
    assert first.plan.cost == max(e.plan.cost for e in portfolio._entries)


def test_drafts_that_are_free_count_as_plans_and_make_room_for_themselves(tmp_path: Path) -> None:
    planner = planner_for(tmp_path)
    portfolio = planner.portfolio
    for k in range(SIZE):
        assert portfolio.add(roundabout(planner, 0.9 - 0.2 * k))
    plans = [roundabout(planner, 0.85 - 0.2 * k) for k in range(3)]
    drafts = [Sketch(p.cost, portfolio.yielding.time(p.segments, p.transitions)) for p in plans]
    assert all(x.draft.conflict == 0.0 for x in drafts), "both at once, on opposite sides"
    assert portfolio.add_drafts(drafts) == 3
    assert portfolio.add_drafts(drafts) == 0, "they are known"
    assert len(portfolio._entries) == SIZE
    assert not any(e.draft for e in portfolio._entries)
    best = portfolio.improve(plans[0].cost)
    assert best is None or check_plan(best).ok


def test_a_plan_is_refined_until_it_is_cheap_enough_unless_the_judge_objects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = planner_for(tmp_path)
    plan = roundabout(planner, 0.6)
    refined = planner.portfolio.refined(plan, 0.9 * plan.cost, 8)
    assert refined.cost < 0.9 * plan.cost
    assert check_plan(refined).ok
    assert planner.portfolio.refined(plan, 0.9 * plan.cost, 0) is plan, "nothing was tried"
    assert planner.portfolio.refined(plan, 0.1 * plan.cost, 8) is plan, "it cannot be had that cheap"
    monkeypatch.setattr(planner.incumbent, "accepted", lambda *_: None)
    assert planner.portfolio.refined(plan, 0.9 * plan.cost, 8) is plan


@pytest.mark.parametrize(("promised", "refined"), [(0.9, False), (0.4, True), (np.inf, False)])
def test_only_a_first_plan_that_is_far_dearer_than_promised_has_to_wait(
    tmp_path: Path, promised: float, refined: bool
) -> None:
    planner = planner_for(tmp_path)
    plan = roundabout(planner, 0.6)
    realisation = planner.realisation
    realisation._promised = promised * plan.cost
    assert (realisation.presentable(plan) is plan) is not refined
    realisation.refines = False
    assert realisation.presentable(plan) is plan


def test_a_first_plan_is_kept_where_its_refinement_is_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = planner_for(tmp_path)
    plan = roundabout(planner, 0.6)
    planner.realisation._promised = 0.4 * plan.cost

    def interrupted(self: Optimiser) -> float:
        raise KeyboardInterrupt

    monkeypatch.setattr(Optimiser, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        planner.realisation.presentable(plan)
    assert planner.best is plan


def test_what_the_same_search_finds_takes_the_place_of_what_has_hardly_begun(tmp_path: Path) -> None:
    """With the same order of events it most likely becomes the same plan: it is not worth a trial of its own."""
    planner = planner_for(tmp_path)
    portfolio = planner.portfolio
    dear, cheap, between = (roundabout(planner, height) for height in (-0.1, 0.9, 0.4))
    assert portfolio.add(dear, similar=True)
    assert portfolio.add(cheap, similar=True)
    assert [e.plan for e in portfolio._entries] == [cheap]
    assert not portfolio.add(between, similar=True), "it has come too late"
    assert portfolio.add(between), "what another search finds may be different in other ways"
    assert len(portfolio._entries) == 2


def test_what_was_not_judged_is_no_plan_before_the_judge_accepts_it(tmp_path: Path) -> None:
    planner = planner_for(tmp_path)
    portfolio, begun = planner.portfolio, roundabout(planner, 0.6)
    assert portfolio.add_unchecked(begun.segments, begun.transitions)
    assert not portfolio.add_unchecked(begun.segments, begun.transitions), "it is known"
    [entry] = portfolio._entries
    assert entry.draft and not entry.began_as_draft and not portfolio.nearing(2 * begun.cost)
    found = [plan for plan in (portfolio.improve(begun.cost) for _ in range(8)) if plan is not None]
    assert found and all(check_plan(plan).ok for plan in found)
    assert not entry.draft


def test_a_first_round_is_expected_to_go_on_at_its_pace(tmp_path: Path) -> None:
    """Where there is no choice of ways what falls fast is kept though it is dear, and what has come to rest is not."""
    planner = planner_for(tmp_path)
    portfolio, plan = planner.portfolio, roundabout(planner, 0.6)
    for choice in (True, False):
        portfolio.suit(choice=choice)
        for trail, kept in ((np.linspace(1.5, 1.2, 10), not choice), (np.linspace(1.21, 1.2, 10), False)):
            entry = Entry(plan, draft=True, patience=portfolio.patience)
            entry.optimiser = portfolio._optimiser(entry)
            entry.trail = [x * plan.cost for x in trail]
            entry.optimiser.steps = 20
            work = entry.optimiser
            work._now = work._best = replace(work._now, cost=entry.trail[-1])
            assert portfolio._hopeful(entry, plan.cost) == kept, (choice, trail)


def test_ways_are_kept_of_plans_that_are_done_with(tmp_path: Path) -> None:
    """Whether they cost little or not."""
    block = wall("block", (-0.1, -0.1), (0.1, 0.5))
    problem = arena(tmp_path, {"a": (-1, 0)}, {"a": (1, 0)}, walls=[block])
    portfolio = Planner(problem, options=Options(initial_vertices=5)).portfolio
    portfolio.suit(choice=False)
    above, below = (Errands(problem).move(a=(-0.4, y)).move(a=(0.4, y)).move(a=(1, 0)).plan() for y in (0.8, -0.5))
    portfolio.add(above)
    best = above.cost
    while not portfolio._entries[0].done:
        plan = portfolio.improve(best)
        best = plan.cost if plan is not None else best
    [ways] = portfolio.stock._ways.values()
    assert len(ways) == 1
    assert portfolio.add_unchecked(below.segments, below.transitions)
    entry = portfolio._entries[-1]
    turns = 0
    while entry in portfolio._entries and not entry.done and turns < 100:
        portfolio.improve(0.5 * best)
        turns += 1
    assert turns < 100
    assert len(ways) == 2


def test_small_gains_wait_for_the_judge_until_several_programs_have_passed(tmp_path: Path) -> None:
    planner = planner_for(tmp_path)
    entry = Entry(roundabout(planner, 0.6))
    gains = [0.1, 0.0, *(_PATIENCE + 2) * [0.005]]
    due = [planner.portfolio._due(entry, entry.cost * (1 + gain)) for gain in gains]
    assert due == [True, False, *_PATIENCE * [False], True, False]


@pytest.mark.parametrize("programs", [1, 2, 3])
def test_the_longer_a_gain_waits_for_the_judge_the_less_is_enough(tmp_path: Path, programs: int) -> None:
    """The next program may gain as much again, and the judge takes longer than that."""
    portfolio = (planner := planner_for(tmp_path)).portfolio
    entry = Entry(roundabout(planner, 0.6))
    incumbent = entry.cost / (1 - 1.01 * _PLENTY / programs)
    assert [portfolio._due(entry, incumbent) for _ in range(programs)] == [*(programs - 1) * [False], True]


def test_what_most_likely_goes_the_wrong_way_around_does_not_hold_up_others(tmp_path: Path) -> None:
    planner = planner_for(tmp_path)
    portfolio, plan = planner.portfolio, roundabout(planner, 0.6)
    portfolio.add(plan)
    [entry] = portfolio._entries
    assert portfolio.converging(plan.cost, plan.cost), "it has its trial"
    entry.optimiser = portfolio._optimiser(entry)
    entry.optimiser.steps = 10
    assert portfolio.converging(plan.cost, 0.9 * plan.cost)
    assert not portfolio.converging(plan.cost, 0.5 * plan.cost)
    assert not portfolio.converging(0.5 * plan.cost, plan.cost), "it will not beat the incumbent"


def test_what_a_round_has_gained_in_the_end_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even where the judge would not have been asked for so little yet."""
    planner = planner_for(tmp_path)
    portfolio, plan = planner.portfolio, roundabout(planner, 0.6)
    portfolio.add(plan)
    monkeypatch.setattr(Portfolio, "_due", lambda *_: False)
    found = None
    while found is None and not portfolio._entries[0].done:
        found = portfolio.improve(plan.cost)
    assert found is not None and found.cost < plan.cost
    assert portfolio._entries[0].plan is found


def test_patience_follows_the_choice_there_is(tmp_path: Path) -> None:
    """Ways may be found later for what had only one."""
    planner = planner_for(tmp_path)
    portfolio = planner.portfolio
    for height, choice in ((0.9, False), (0.4, True), (-0.1, False)):
        portfolio.suit(choice=choice)
        assert portfolio.add(roundabout(planner, height))
    slow = [e.patience.slow for e in portfolio._entries]
    assert slow[0] == slow[2] > slow[1]


@pytest.mark.parametrize(("choice", "gain", "over"), [(False, 1e-4, True), (False, 5e-3, False), (True, 1e-4, False)])
def test_a_second_round_goes_on_while_it_gains_what_other_motions_would(
    tmp_path: Path, choice: bool, gain: float, over: bool
) -> None:
    """Where there is a choice of ways it goes on to the end."""
    planner = planner_for(tmp_path)
    portfolio = planner.portfolio
    portfolio.suit(choice=choice)
    portfolio.add(roundabout(planner, 0.6))
    [entry] = portfolio._entries
    entry.optimiser, entry.rounds = portfolio._optimiser(entry), 1
    for k in range(4):
        assert not entry.over, "it is too early to say"
        entry.trail.append(2.0 * (1 - gain) ** k)
    assert entry.over == over


def test_what_has_converged_goes_on_beside_what_is_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many new plans come, what is refined further has its share of the turns, and new plans have theirs."""
    planner = planner_for(tmp_path)
    portfolio, best = planner.portfolio, roundabout(planner, 0.6)
    portfolio.add(best)
    [entry] = portfolio._entries
    while entry.rounds < 2:
        best = portfolio.improve(best.cost) or best
    monkeypatch.setattr(Portfolio, "_worth_a_round", lambda self, e, incumbent: e is entry and e.done)
    # The incumbent is as cheap as it gets: neither gains anything.
    turns, heights = {False: 0, True: 0}, iter(0.9 - 0.001 * k for k in range(1000))
    for _ in range(60):
        if not any(e.fresh for e in portfolio._entries):
            portfolio._seen.clear()
            portfolio._entries = [entry]
            portfolio._admit([Entry(roundabout(planner, next(heights)))])
        worked: list[Entry] = []
        choose = Portfolio._choose

        def chosen(
            self: Portfolio, incumbent: float, bound: float | None, choose=choose, worked=worked
        ) -> Entry | None:
            worked.append(choose(self, incumbent, bound))
            return worked[-1]

        with monkeypatch.context() as patch:
            patch.setattr(Portfolio, "_choose", chosen)
            best = portfolio.improve(best.cost) or best
        turns[worked[0] is entry] += 1
    assert min(turns.values()) >= 10, turns


def test_what_was_gained_is_judged_before_time_is_up(tmp_path: Path) -> None:
    planner = planner_for(tmp_path)
    portfolio = planner.portfolio
    entry = Entry(roundabout(planner, 0.6))
    portfolio.incumbent.judging_s = 1.0
    for left, took, due in ((None, 1.0, False), (60.0, 1.0, False), (2.3, 1.0, True), (2.3, 0.1, False)):
        portfolio.deadline.set(left)
        portfolio._took.append(took)
        assert portfolio._due(entry, entry.cost * 1.005) is due
        assert not portfolio._due(entry, entry.cost), "nothing was gained"
        portfolio._took.clear()


@pytest.mark.parametrize(
    ("without", "searched", "fineness"),
    [((), [2, 4, 6], [0, 1, 2, 2, 3, 3, 4]), (("local-search",), [], [0, 1, 2, 3, 4, 5, 6])],
)
@pytest.mark.parametrize("choice", [True, False])
def test_rounds_of_local_search_and_of_finer_programs_take_turns(
    tmp_path: Path, choice: bool, without: tuple[str, ...], searched: list[int], fineness: list[int]
) -> None:
    portfolio = (planner := planner_for(tmp_path, "ab", *without)).portfolio
    portfolio.suit(choice=choice)
    plan = roundabout(planner, 0.6)
    rounds = [Entry(plan, rounds=k, patience=portfolio.patience) for k in range(7)]
    assert [e.rounds for e in rounds if e.searches] == searched
    assert [e.fineness for e in rounds] == fineness
    assert [e.rounds for e in rounds if e.goes_ahead] == ([] if choice else [1])


def sequential(planner: Planner) -> Entry:
    """A draft, past its trial, of discs that go one after the other although nothing keeps them from going at once."""
    plan = roundabout(planner, 0.9)
    draft = planner.portfolio.yielding.time(plan.segments, plan.transitions)
    entry = Entry(plan, draft=True, sketch=Sketch(1.0, draft), patience=planner.portfolio.patience)
    entry.optimiser = planner.portfolio._optimiser(entry)
    entry.optimiser.step()
    entry.optimiser.steps = 100
    planner.portfolio._entries.append(entry)
    return entry


def test_what_is_still_a_draft_is_timed_anew_before_it_is_given_up(tmp_path: Path) -> None:
    planner = planner_for(tmp_path)
    portfolio, entry = planner.portfolio, sequential(planner)
    before, work = entry.outlook, entry.optimiser
    assert portfolio._choose(1.5) is entry, "another trial instead of its end"
    assert entry.optimiser is not work and entry.plan.cost < 0.8 * before
    assert entry.retimings == 1 and entry.on_trial
    for _ in range(3):
        while entry in portfolio._entries and entry.on_trial:
            portfolio.improve(0.1)
    assert entry not in portfolio._entries, "not for ever"


def test_a_plan_that_is_no_draft_any_more_is_not_timed_anew(tmp_path: Path) -> None:
    planner = planner_for(tmp_path)
    entry = sequential(planner)
    entry.draft = False
    assert not planner.portfolio._timed_anew(entry)


def test_drafts_are_compared_with_the_incumbent_by_what_second_rounds_have_gained(tmp_path: Path) -> None:
    planner = planner_for(tmp_path)
    portfolio, entry = planner.portfolio, sequential(planner)
    incumbent = entry.outlook / 1.1
    portfolio._left = [0.95]
    assert not portfolio.busy(incumbent)
    portfolio._left = [0.95, 0.80]
    assert portfolio.busy(incumbent), "it may come to 12 % less"
    assert portfolio._choose(incumbent) is entry
    entry.draft, entry.rounds, entry.done, entry.optimiser = False, 1, True, None
    entry.coarse = entry.plan.cost
    for share, busy in ((0.85, False), (0.90, True), (1.0, True)):
        assert portfolio.busy(share * entry.coarse) is busy, "its second round may make it the best"
    entry.rounds = 2
    assert not portfolio.busy(10 * entry.coarse), "it has had both"


def test_ways_that_keep_a_draft_in_collision_are_given_up_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = planner_for(tmp_path)
    portfolio = planner.portfolio
    one, two, three = (Way(()) for _ in range(3))
    plans = [roundabout(planner, height) for height in (0.2, 0.9, 0.5)]
    drafts = [replace(portfolio.yielding.time(p.segments, p.transitions), conflict=1e-4) for p in plans]
    ways = [{one, two}, {one, two, three}, {one, three}]
    guilty = [{one, two}, {three}, {three}]
    sketches = [Sketch(1.0, d, frozenset(w), frozenset(g)) for d, w, g in zip(drafts, ways, guilty, strict=True)]
    assert portfolio.add_drafts(sketches) == 3
    lodged, _, other = portfolio._entries[::-1]
    monkeypatch.setattr(Optimiser, "stuck", property(lambda self: self is lodged.optimiser))
    monkeypatch.setattr(Optimiser, "step", lambda self: 0.0)
    assert portfolio.crowded == set()
    portfolio.improve(10.0)
    assert portfolio._entries == [other], "the other has one of the two ways only"
    assert portfolio.crowded == {frozenset({one, two})}
