"""Which skeletons are drafted: those that refinement would bring to the same plan as another only once, and none whose
ways conflicted before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrtamp.optimise.yielding import Draft, Yielding
from mrtamp.options import Happening, Skeleton
from mrtamp.planner import Planner
from mrtamp.portfolio_entry import Sketch
from mrtamp.realisation import _CHEAPER, _GROWTHS, _LIKE, Realisation, _Drafted
from mrtamp.skeleton_guidance import Proposal, SkeletonGuidance
from mrtamp.tasks import pick_place
from mrtamp.transitions.ways import Stop, Way

ORDER = ((("red", 0, ("a", "b")), ("blue", 0, ("a", "b"))),)


def proposal(
    red: list[float],
    blue: list[float],
    *,
    order: tuple = ORDER,
    turned: bool = False,
    cost: float = 1.0,
    shortened: bool = True,
    robots: tuple[str, ...] = ("a", "b"),
) -> Proposal:
    ways = {
        item: Way((Stop("handover", robots, None, None, {r: np.array(q) for r in robots}),), shortened=shortened)
        for item, q in (("red", red), ("blue", blue))
    }
    happenings = tuple(Happening(item, 0, 0.0) for item in (reversed(ways) if turned else ways))
    skeleton = Skeleton({item: (0, 0) for item in ways}, happenings, cost, 1.0, {}, order)
    stops = tuple((ways[h.task].stops[0], ways[h.task]) for h in happenings)
    return Proposal(skeleton, stops, ((), ()), 0)


@pytest.mark.parametrize(
    ("other", "known"),
    [
        (proposal([0.0, 0.0], [1.0, 1.0]), True),
        (proposal([0.0, 0.9 * _LIKE], [1.0 - 0.9 * _LIKE, 1.0]), True),
        (proposal([0.0, 0.0], [1.0, 1.0 + 1.1 * _LIKE]), False),
        (proposal([1.0, 1.0], [0.0, 0.0]), False),
        # What has become clearly cheaper is worth another draft.
        (proposal([0.0, 0.0], [1.0, 1.0], cost=_CHEAPER + 0.01), True),
        (proposal([0.0, 0.0], [1.0, 1.0], cost=_CHEAPER - 0.01), False),
        # Only when things happen is different, which the decoupled timing decides anew.
        (proposal([0.0, 0.0], [1.0, 1.0], turned=True), True),
        (proposal([0.0, 0.0], [1.0, 1.0], order=()), False),
        (proposal([0.0, 0.0], [1.0, 1.0], shortened=False), False),
        (proposal([0.0, 0.0], [1.0, 1.0], robots=("a",)), False),
    ],
)
def test_shortened_handovers_near_to_drafted_ones_are_known(other: Proposal, known: bool) -> None:
    drafted = _Drafted()
    assert not drafted.knows(other)
    drafted.add(proposal([5.0, 5.0], [5.0, 5.0]))
    drafted.add(proposal([0.0, 0.0], [1.0, 1.0], robots=other.ways[0].robots))
    assert drafted.knows(other) is known


@pytest.mark.parametrize("spread", [False, True])
def test_ways_that_conflict_are_not_drafted_together_again(monkeypatch: pytest.MonkeyPatch, spread: bool) -> None:
    """Where the conflict is `spread` so evenly that nobody is to blame, it is all of them, and no others."""
    planner = Planner(pick_place(2, 2), seed=0)
    assert list(planner.improve(20, first=True))
    sketched: list[set[Way]] = []
    blamed: list[tuple[int, set[Way]]] = []
    sketch, time = Realisation._sketch, Yielding.time

    def noted(self: Realisation, proposal: Proposal) -> Sketch | None:
        sketched.append(set(proposal.ways))
        return sketch(self, proposal)

    def hopeless(self: Yielding, segments: list, transitions: list, *, early: bool = False) -> Draft:
        draft = time(self, segments, transitions, early=early)
        first = {r: k for k, t in reversed(list(enumerate(transitions))) for r in t.active}
        objects = {transitions[k].actions[0].object for k in first.values()}
        ways = {way for way in sketched[-1] if way.stops[0].after and way.stops[0].after.object in objects}
        blamed.append((len(sketched), ways))
        return replace(draft, conflict=1.0, blame=dict.fromkeys(first.values(), 0.1 if spread else 1.0))

    monkeypatch.setattr(Realisation, "_sketch", noted)
    monkeypatch.setattr(Yielding, "time", hopeless)
    for _ in range(3):
        planner.realisation.attempt()
    assert len(sketched) > 5
    for k, ways in enumerate(sketched):
        assert not any(pair <= ways for n, pair in blamed if n <= k)


@pytest.mark.parametrize(("doubtful", "taken"), [(2, 1), (100, 3)])
def test_of_drafts_whose_robots_collide_where_they_end_one_is_refined_if_there_are_others(
    monkeypatch: pytest.MonkeyPatch, doubtful: int, taken: int
) -> None:
    """The first so many are `doubtful`."""
    planner = Planner(pick_place(2, 2), seed=0)
    assert list(planner.improve(20, first=True))
    sketched, refined, time = [0], list[Sketch](), Yielding.time

    def lasting(self: Yielding, segments: list, transitions: list, *, early: bool = False) -> Draft:
        draft = time(self, segments, transitions, early=early)
        sketched[0] += 1
        much = 1e-2 if sketched[0] <= doubtful else 0.0
        return replace(draft, conflict=1e-4, blame={sketched[0] % len(transitions): much})

    monkeypatch.setattr(Yielding, "time", lasting)
    monkeypatch.setattr(planner.portfolio, "add_drafts", lambda drafts: refined.extend(drafts) or len(drafts))
    while not refined:
        planner.realisation.attempt()
    assert len(refined) == 3
    assert sum(sketch.doubtful for sketch in refined) == taken


def test_ways_that_kept_a_draft_in_collision_are_not_drafted_together_again(monkeypatch: pytest.MonkeyPatch) -> None:
    planner = Planner(pick_place(2, 2), seed=0)
    assert list(planner.improve(20, first=True))
    refined = list[Sketch]()
    monkeypatch.setattr(planner.portfolio, "add_drafts", lambda drafts: refined.extend(drafts) or len(drafts))
    while not refined:
        planner.realisation.attempt()
    lodged = refined[0].ways
    planner.portfolio.crowded.add(lodged)
    n = len(refined)
    for _ in range(6):
        planner.realisation.attempt()
    assert len(refined) > n
    assert all(not lodged <= sketch.ways for sketch in refined[n:])


def test_where_nothing_is_left_to_draft_what_was_ruled_out_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    planner = Planner(pick_place(2, 2), seed=0)
    assert list(planner.improve(20, first=True))
    realisation, portfolio = planner.realisation, planner.portfolio
    portfolio.crowded.add(frozenset({Way(())}))
    monkeypatch.setattr(portfolio, "add_drafts", lambda drafts: 0)
    realisation._draft()
    assert portfolio.crowded == set()
    once = realisation._drafted.like
    assert once < _LIKE
    realisation._turn = 0
    realisation._draft()
    assert realisation._drafted.like < once
    monkeypatch.setattr(portfolio, "add_drafts", lambda drafts: 1)
    realisation._drafted._known.clear()
    realisation._turn = 0
    realisation._draft()
    assert realisation._drafted.like == _LIKE


@pytest.mark.parametrize(
    ("kinds", "first", "later"), [(0, 1, 1), (4, _GROWTHS // 4, _GROWTHS // 8), (_GROWTHS + 1, 1, 1)]
)
def test_the_fewer_kinds_of_ways_there_are_the_more_often_they_are_sampled(
    monkeypatch: pytest.MonkeyPatch, kinds: int, first: int, later: int
) -> None:
    planner = Planner(pick_place(2, 2), seed=0)
    assert list(planner.improve(20, first=True))
    assert planner.skeletons.kinds >= 2, "each cube, for every arm that can"
    monkeypatch.setattr(SkeletonGuidance, "kinds", kinds)
    grown = []
    monkeypatch.setattr(Realisation, "_more_ways", lambda self: grown.append(self) or 1.0)
    for undrafted, times in ((True, first), (False, later)):
        grown.clear()
        planner.realisation.undrafted = undrafted
        planner.realisation._grow()
        assert len(grown) == times
