"""Several plans under refinement at once: the one that starts dearest may end cheapest."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mrtamp.collision import RESOLUTION
from mrtamp.deadline import Deadline
from mrtamp.effort import Effort
from mrtamp.incumbent import Incumbent
from mrtamp.optimise import LocalSearch, Optimiser, Stock, tools_of
from mrtamp.optimise.legs import order_of
from mrtamp.optimise.nearness import Nearness
from mrtamp.optimise.yielding import Draft, Yielding
from mrtamp.plan import Plan, Segment, Transition
from mrtamp.problem import Problem
from mrtamp.refine import Refiner
from mrtamp.transitions.sampler import TransitionSampler
from mrtamp.validity import Validity

SIZE = 6
_SLICE = 40
"""Proposals of shortening per turn."""
_SHORTENING = 1
"""Proposals, per robot and transition, after which shortening gives way to convex programming."""
_ALONE = 1200
"""The same where there is no convex programming."""
_STALE = 0.004
"""Relative gain of a turn below which shortening has done its part."""
_TRIAL, _FAST, _SLOWLY = 5, 0.03, 0.01
"""Conic programs that a plan gets before it is compared with the others, and more as long as each makes it cheaper by
that share, or at least by that of them (see `_Patience`)."""
_LUCK = 0.93
"""A draft may come to so many times less than the best one so far, relative to what their skeletons promised."""
_NEARLY = 0.97
"""A plan whose current iterate costs less than the incumbent times this goes on until it is free of collision."""
_CRAWL = 0.01
"""Share that a first round has to gain in so many programs as `_Patience` says to go on."""
_PACE, _FURTHER = 3, 6
"""A first round is expected to go on at the pace of its last programs for so many more."""
_ASTRAY = 1.4
"""A plan that costs so many times the least that is possible most likely goes the wrong way around."""
_ALIKE = 0.02
"""Relative difference of cost below which two plans with the same order of events are held to be alike."""
_EPS = 1e-9
"""By how much the costs of a plan and of the polyline that it was made from may differ."""
WORTH_CHECKING = 0.002
"""Relative gain over the incumbent that is worth a check."""
_PLENTY, _PATIENCE, _LONGER = 0.01, 4, 24
"""Relative gain that is checked at once, and programs after which a smaller one is: more of them where they are small
ones of local search."""

_POOR = 1.12
"""How many times as much as skeletons promise a converged plan costs that others had better challenge."""
_ROUNDS = 6
"""Rounds without gain after which a plan is left alone."""
_FIRST_SEARCH = 2
"""Rounds that have converged before the first that is local search."""
_FIRST, _LATER = "first rounds", "later rounds"
"""What turns go to: plans that have not converged, and those that are shaken and refined again."""
_LAST, _RECENT = 1.5, 6
"""When there is no more time than the judge takes so many times, and the longest of so many programs (with what mends
their outcome) took, what was gained is checked at once."""


@dataclass(frozen=True)
class _Patience:
    """How much work a plan gets.

    slow : number of programs up to which its trial goes on even if it becomes cheaper slowly.
    hopeless : if it costs so many times the best after its trial it waits until nothing else is left to do.
    lately : number of programs in which a first round has to gain something to go on.
    shares : least shares of first and of later rounds; as long as neither gains anything first ones have what is left.
    same_ways : whether there is no choice of ways.
    local : whether, from the third on, every other round is local search.
    """

    slow: int
    hopeless: float
    lately: int
    shares: tuple[float, float]
    same_ways: bool = False
    local: bool = True

    def effort(self) -> Effort:
        """Shares out turns to first and later rounds."""
        first, later = self.shares
        return Effort({_FIRST: first, _LATER: later}, {_FIRST: 1.0, _LATER: 0.0})


_OTHER_WAYS = _Patience(slow=0, hopeless=1.12, lately=5, shares=(0.5, 0.2))
_SAME_WAYS = _Patience(slow=12, hopeless=1.02, lately=3, shares=(0.5, 0.4), same_ways=True)
"""Where there is no choice of ways, most plans come near to each other, but with many robots a few end far below."""


@dataclass(eq=False)
class _Entry:
    """A checked plan and what works on it: convex programming, in later rounds after some shortening.

    A draft is no plan yet: its robots still collide with each other, and convex programs have to pull them apart.
    """

    plan: Plan
    draft: bool = False
    estimate: float = np.nan
    """What its skeleton was to cost, if it began as a draft."""
    resolution: float = RESOLUTION
    refiner: Refiner | None = None
    optimiser: Optimiser | LocalSearch | None = None
    proposals: int = 0
    done: bool = False
    rounds: int = 0
    """How often refinement has converged."""
    fruitless: int = 0
    """How often since it last gained anything."""
    before: float = np.inf
    """Cost when this round began."""
    trail: list[float] = field(default_factory=list)
    """Outlook after every conic program of this round."""
    patience: _Patience = _OTHER_WAYS
    waiting: int = 0
    """Conic programs since it has been worth a check."""

    @property
    def cost(self) -> float:
        work = self.optimiser or self.refiner
        return work.cost if work is not None else self.plan.cost

    @property
    def outlook(self) -> float:
        """What the plan is likely to cost soon."""
        return self.optimiser.outlook if self.optimiser is not None else self.cost

    @property
    def expected(self) -> float:
        """What it is likely to cost after its first round, where there is no choice of ways; else the outlook."""
        trail = self.trail[-_PACE - 1 :]
        if self.rounds or not self.patience.same_ways or len(trail) <= _PACE:
            return self.outlook
        return self.outlook - _FURTHER * max(trail[0] - trail[-1], 0.0) / _PACE

    @property
    def slow(self) -> bool:
        """Whether a first round gains so little that other plans are worth more; later rounds go on to the end."""
        # What has not been checked has to be good by then to go on.
        lately = self.patience.lately * (2 if self.unchecked else 1)
        trail = self.trail[-lately:]
        clean = self.optimiser is not None and self.optimiser.cost <= (1 + _CRAWL) * self.outlook
        return self.rounds == 0 and clean and len(trail) == lately and trail[0] - min(trail) < _CRAWL * trail[-1]

    @property
    def over(self) -> bool:
        """Whether convex programming has come to the end of this round."""
        return self.optimiser is not None and (self.optimiser.converged or self.optimiser.stuck or self.slow)

    @property
    def on_trial(self) -> bool:
        """Whether it has begun only just, or gains much with every program of its first round."""
        if self.rounds or self.done:
            return False
        if self.optimiser is None:
            return True
        steps = self.optimiser.steps
        least = _SLOWLY if steps < self.patience.slow else _FAST
        return steps < _TRIAL or (len(self.trail) > 1 and self.trail[-1] < (1 - least) * self.trail[-2])

    @property
    def began_as_draft(self) -> bool:
        return bool(np.isfinite(self.estimate))

    @property
    def unchecked(self) -> bool:
        """Whether it is free of collision as far as the planner knows, and the judge has not been asked."""
        return self.draft and not self.began_as_draft

    @property
    def size(self) -> int:
        """Number of knots that a turn works on."""
        return self.optimiser.knots if self.optimiser is not None else sum(s.length for s in self.plan.segments)

    @property
    def fresh(self) -> bool:
        """Whether it has not converged for the first time."""
        return self.rounds == 0 and not self.done

    @property
    def fresh_draft(self) -> bool:
        """Whether it began as a draft and has not converged yet."""
        return self.rounds == 0 and self.began_as_draft

    @property
    def goes_ahead(self) -> bool:
        """Whether, as the incumbent, it has its turns before others: from its trial to the end of its first round of
        finer steps, which with re-timing gain most, if it began as a draft or there is no choice of ways.
        """
        begun = self.rounds == 1 or (self.rounds == 0 and not self.on_trial)
        return begun and (self.began_as_draft or self.patience.same_ways)

    @property
    def fineness(self) -> int:
        """How often convex programs for the whole plan have converged."""
        return self.rounds - (max(self.rounds - 1, 0) // 2 if self.patience.local else 0)

    @property
    def searches(self) -> bool:
        """Whether its round is local search."""
        return self.patience.local and self.rounds >= _FIRST_SEARCH and self.rounds % 2 == 0

    def is_near(self, incumbent: float) -> bool:
        """Whether it is about to beat the incumbent clearly."""
        return bool(self.trail) and self.outlook < _NEARLY * incumbent


class Portfolio:
    """Up to SIZE plans and drafts in turns: the newest get a trial, then the cheapest goes on until it converges."""

    def __init__(
        self,
        problem: Problem,
        validity: Validity,
        sampler: TransitionSampler,
        incumbent: Incumbent,
        rng: np.random.Generator,
        *,
        deadline: Deadline | None = None,
        convex: bool = True,
        sliding: bool = True,
        local: bool = True,
    ) -> None:
        self.problem = problem
        self.validity = validity
        self.sampler = sampler
        self.incumbent = incumbent
        self.rng = rng
        self.deadline = deadline or Deadline()
        self.convex = convex
        self.sliding = sliding
        self._patiences = [replace(p, local=local) for p in (_OTHER_WAYS, _SAME_WAYS)]
        self._entries: list[_Entry] = []
        self._settled: list[Plan] = []
        self._seen: set[float] = set()
        self._took: deque[float] = deque(maxlen=_RECENT)
        """Seconds that the last programs took."""
        self._contest: str | None = None
        """Which of the two had its turn last, where there was a choice."""
        self._share = 0.0
        """The least that a draft has cost in the end, relative to its estimate."""
        self.drafted = False
        """Whether what was worked on last came from a draft and has not converged since."""
        self.patience = self._patiences[0]
        self._effort = self.patience.effort()
        self._coarse = 0.0
        """The least that a plan has cost after its first round, where there is no choice of ways."""
        self.nearness = Nearness(validity.collision)
        self.stock = Stock(tools_of(self.nearness))
        self.yielding = Yielding(problem, self.nearness)

    def add(self, plan: Plan, *, similar: bool = False) -> bool:
        """Put a checked plan under refinement; False if one like it is or was.

        `similar`: it comes of the same search as those before, and with the same order of events it most likely becomes
        the same plan.  Then it takes the place of one that has hardly begun, or else has come too late.
        """
        alike = [e for e in self._entries if order_of(e.plan.transitions) == order_of(plan.transitions)]
        if round(plan.cost, 6) in self._seen or any(abs(e.cost - plan.cost) < _ALIKE * plan.cost for e in alike):
            return False
        fresh = [e for e in alike if similar and e.fresh and not e.began_as_draft]
        if any(e.outlook < plan.cost for e in fresh):
            return False
        self._seen.add(round(plan.cost, 6))
        self._entries = [e for e in self._entries if not (e in fresh and e.on_trial)]
        self._admit([_Entry(plan, patience=self.patience)])
        return True

    def add_unchecked(self, segments: list[Segment], transitions: list[Transition]) -> bool:
        """Put motions under refinement of which the judge has not been asked: what may have slipped between samples is
        mended sooner than found; False if they are known."""
        plan = self.incumbent.plan(segments, transitions)
        if round(plan.cost, 6) in self._seen:
            return False
        self._seen.add(round(plan.cost, 6))
        entry = _Entry(plan, draft=True, patience=self.patience)
        entry.optimiser = self._optimiser(entry)
        self._admit([entry])
        return True

    def shortened(self, plan: Plan, proposals: int) -> Plan:
        """A checked plan after so many shortcuts were tried on it; the same one if the judge objects to the outcome."""
        work = Refiner(plan, self.validity, self.rng, RESOLUTION)
        if not work.improve(proposals):
            return plan
        return self.incumbent.accepted(work.segments(), work.transitions) or plan

    def worth_drafting(self, incumbent: float) -> float:
        """Estimate below which drafts may come to beat the incumbent, from what became of those so far."""
        return _NEARLY * incumbent / (_LUCK * self._share) if self._share else incumbent

    def knows(self, transitions: Sequence[Transition]) -> bool:
        """Whether a plan with the same order of events is under refinement."""
        return any(order_of(e.plan.transitions) == order_of(transitions) for e in self._entries)

    def add_drafts(self, drafts: Sequence[tuple[float, Draft]]) -> int:
        """Put motions in which robots still collide with each other under convex programming; how many are new.

        They come with what their skeletons were to cost.  The first is worked on first: among those on trial the newest
        goes on.
        """
        fresh = []
        for estimate, draft in drafts:
            plan = self.incumbent.plan(draft.segments, draft.transitions)
            if round(plan.cost, 6) in self._seen:
                continue
            self._seen.add(round(plan.cost, 6))
            free = self.incumbent.accepted(draft.segments, draft.transitions) if draft.conflict == 0.0 else None
            entry = _Entry(free or plan, draft=free is None, estimate=estimate, patience=self.patience)
            entry.optimiser = self._optimiser(entry)
            fresh.append(entry)
        self._admit(fresh[::-1])
        return len(fresh)

    def _admit(self, fresh: list[_Entry]) -> None:
        """Take entries in; when there are too many the dearest of the others go, finished ones first, drafts last.

        The cheapest of all stays.
        """
        self._entries += fresh
        best = min(self._entries, key=lambda e: e.cost, default=None)
        while len(self._entries) > SIZE:
            others = [e for e in self._entries if e not in fresh and e is not best]
            going = [e for e in others if e.done] or [e for e in others if not e.draft] or others
            self._entries.remove(max(going, key=lambda e: e.cost))

    def improve(self, incumbent: float, bound: float | None = None) -> Plan | None:
        """Give one plan its turn; a checked plan when it is clearly cheaper than `incumbent`; `bound` as in `poor`."""
        entry = self._choose(incumbent, bound)
        self.drafted = entry is not None and entry.fresh_draft
        if entry is None:
            return None
        plan = self._work(entry, incumbent)
        if self._contest is not None:
            gain = incumbent - plan.cost if plan is not None else 0.0
            self._effort.record(self._contest, entry.size, max(gain, 0.0))
        return plan

    def _work(self, entry: _Entry, incumbent: float) -> Plan | None:
        """A turn of one plan."""
        if entry.optimiser is None and self.convex and entry.rounds == 0 and entry.resolution == RESOLUTION:
            # Shortening gains far less in the time.
            entry.before = entry.plan.cost
            entry.optimiser = self._optimiser(entry)
        if entry.optimiser is None and entry.refiner is None and self.convex and entry.searches:
            entry.before = entry.plan.cost
            entry.optimiser = self._local_search(entry)
        if entry.optimiser is None:
            return self._shorten(entry, incumbent)
        if entry.unchecked and isinstance(entry.optimiser, Optimiser):
            entry.optimiser.to_beat = incumbent
        began = time.perf_counter()
        entry.optimiser.step()
        self._took.append(time.perf_counter() - began)
        entry.trail.append(entry.optimiser.outlook)
        due = self._due(entry, incumbent) or entry.over
        plan = self._offer(entry, incumbent, entry.optimiser) if due else None
        if entry.over:
            self._finish(entry, incumbent)
        return plan

    @property
    def busy(self) -> bool:
        """Whether a plan is on trial: until it is over, more plans would only wait."""
        return any(e.on_trial for e in self._entries)

    def suit(self, *, choice: bool) -> None:
        """From now on plans may use different ways; without `choice` they are other motions of the same ones."""
        patience = self._patiences[0 if choice else 1]
        if patience is not self.patience:
            self.patience, self._effort = patience, patience.effort()

    def converging(self, incumbent: float, bound: float) -> bool:
        """Whether a plan that may beat `incumbent`, or is it, is yet to converge; no plan costs less than `bound`."""
        return any(
            (e.fresh and (e.on_trial or (self._hopeful(e, incumbent) and e.outlook < _ASTRAY * bound)))
            or (e.goes_ahead and e.cost <= incumbent + _EPS and e.outlook < _ASTRAY * bound)
            for e in self._entries
        )

    def poor(self, incumbent: float, bound: float | None) -> bool:
        """Whether the first round of the incumbent is over, and other ways would gain more than a finer one can.

        `bound` is what the cheapest skeleton promises; None where that is not known.
        """
        return any(e.cost <= incumbent + _EPS and self._poor(e, bound) for e in self._entries)

    def _poor(self, entry: _Entry, bound: float | None) -> bool:
        # Where there are no other ways, there is nothing better.
        return entry.rounds > 0 and not self.patience.same_ways and entry.cost > _POOR * (bound or np.inf)

    def _hopeful(self, entry: _Entry, incumbent: float) -> bool:
        """Whether a plan may still beat the incumbent; later rounds take off all plans about the same."""
        best = max(incumbent, self._coarse) if entry.rounds <= 1 else incumbent
        return entry.expected < self.patience.hopeless * best

    def nearing(self, incumbent: float) -> bool:
        """Whether a plan is about to beat `incumbent` clearly."""
        return any(e.is_near(incumbent) and not e.draft for e in self._entries)

    @property
    def outlook(self) -> float:
        """The least that a plan under refinement is likely to cost soon."""
        return min((e.outlook for e in self._entries), default=np.inf)

    def idle(self, incumbent: float) -> bool:
        """Whether no plan promises a gain any more."""
        return all(e.done and not self._worth_a_round(e, incumbent) for e in self._entries)

    def _worth_a_round(self, entry: _Entry, incumbent: float) -> bool:
        """Whether a plan that has converged is shaken and refined again."""
        return entry.done and entry.fruitless < _ROUNDS and self._hopeful(entry, incumbent)

    def _choose(self, incumbent: float, bound: float | None = None) -> _Entry | None:
        """One that is about to beat the incumbent; else the incumbent itself if it `goes_ahead`, unless it is poor for
        what skeletons promise; else, as the shares of both have it, one in its first round, the newest first, or one in
        a later round.

        What drafts seem to cost before their first program says nothing: those on trial begin with the most promising.
        Drafts that are hopeless are given up.
        """
        self._contest = None
        most = self.worth_drafting(incumbent) if self._share else np.inf
        for entry in [e for e in self._entries if e.draft and self._hopeless(e, incumbent, most)]:
            self._learn(entry)
            self._entries.remove(entry)
        near = [e for e in self._entries if e.is_near(incumbent)]
        if near:
            return min(near, key=lambda e: e.outlook)
        ahead = next(
            (e for e in self._entries if e.goes_ahead and e.cost <= incumbent + _EPS and not self._poor(e, bound)), None
        )
        if ahead is not None:
            return self._again(ahead) if ahead.done else ahead
        hopeful = [e for e in self._entries if not e.done and self._hopeful(e, incumbent)]
        trial = [e for e in self._entries if e.on_trial]
        first = trial[-1] if trial else min((e for e in hopeful if e.fresh), key=lambda e: e.outlook, default=None)
        begun = [e for e in hopeful if e.rounds]
        rested = [e for e in self._entries if self._worth_a_round(e, incumbent)]
        later = min(begun or rested, key=lambda e: e.cost * (1 + 0.02 * e.fruitless), default=None)
        if first is not None and later is not None:
            self._contest = self._effort.next((_FIRST, _LATER))
        if first is not None and self._contest != _LATER:
            return first
        if later is not None:
            return self._again(later) if later.done else later
        waiting = [e for e in self._entries if not e.done]
        return min(waiting, key=lambda e: e.cost, default=None)

    def _hopeless(self, draft: _Entry, incumbent: float, most: float) -> bool:
        """Whether to give up a draft: its estimate is above `most`, where no draft so far has ended cheap enough,
        or its trial left it no cheaper than the incumbent, and to come free costs it more still.

        What is only unchecked has nothing more to pay.
        """
        if draft.estimate > most:
            return True
        if draft.on_trial:
            return False
        return draft.outlook >= incumbent if draft.began_as_draft else not self._hopeful(draft, incumbent)

    @staticmethod
    def _again(entry: _Entry) -> _Entry:
        """A plan that goes on to its next round."""
        entry.refiner, entry.optimiser, entry.proposals, entry.done = None, None, 0, False
        return entry

    def _shorten(self, entry: _Entry, incumbent: float) -> Plan | None:
        if entry.refiner is None:
            entry.refiner = self._refiner(entry)
            entry.before = entry.plan.cost
        gain = entry.refiner.improve(_SLICE)
        entry.proposals += _SLICE
        size = len(self.validity.roadmaps) * max(len(entry.plan.transitions), 1)
        enough = entry.proposals >= (_SHORTENING * size if self.convex else _ALONE)
        over = enough or (self.convex and entry.proposals > 2 * _SLICE and gain < _STALE * entry.cost)
        if self.convex and not over:
            # Convex programming follows within moments: the judge, who takes longer, is asked once.
            return None
        plan = self._offer(entry, incumbent, entry.refiner)
        if entry.refiner is None or not over:
            return plan
        if self.convex:
            self._begin_convex(entry, entry.refiner, judged=plan is not None)
        else:
            self._finish(entry, incumbent)
        return plan

    def _begin_convex(self, entry: _Entry, work: Refiner, *, judged: bool) -> None:
        """Go on from the shortened plan, if it is worth a check and the judge agrees, else from the one before."""
        if not judged and work.cost < entry.plan.cost * (1 - WORTH_CHECKING):
            plan = self.incumbent.accepted(work.segments(), work.transitions)
            if plan is not None:
                entry.plan = plan
            else:
                entry.resolution /= 2
        entry.refiner = None
        entry.optimiser = self._optimiser(entry)

    def _optimiser(self, entry: _Entry) -> Optimiser:
        return Optimiser(
            self.problem,
            self.nearness,
            entry.plan.segments,
            entry.plan.transitions,
            self.sampler.families,
            slide=self.sliding,
            draft=entry.draft and not entry.unchecked,
            # Finer steps beside bends gain little: they wait until a plan has proved itself.
            levels=entry.fineness,
            level=min(entry.fineness, 1),
            deadline=self.deadline,
        )

    def _local_search(self, entry: _Entry) -> LocalSearch:
        # A piece is small enough for finer steps, which with coarse ones all around gain as much; but where there are
        # many ways of other plans to try, with coarse ones it is twice as many in the time.
        level = 0 if self.patience.same_ways and entry.rounds == _FIRST_SEARCH else 1
        plan = entry.plan
        what = self.problem, self.nearness, plan.segments, plan.transitions, self.rng
        return LocalSearch(*what, stock=self.stock, level=level, deadline=self.deadline)

    def _finish(self, entry: _Entry, incumbent: float) -> None:
        """Convergence: what was gained decides whether the plan is worth another round; a draft is given up."""
        work = entry.optimiser
        self._learn(entry)
        if entry.draft and not self._hopeful(entry, incumbent):
            self._entries.remove(entry)
            return
        if work is not None and np.isfinite(work.cost) and (entry.draft or work.cost < entry.plan.cost - _EPS):
            plan = self.incumbent.accepted(work.segments(), work.transitions)
            if plan is not None:
                entry.plan, entry.draft = plan, False
        if entry.draft:
            self._entries.remove(entry)
            return
        if entry.began_as_draft:
            # The second round, too, often gains much.
            share = entry.plan.cost / entry.estimate
            self._share = min(self._share or share, share)
        if entry.rounds == 0 and self.patience.same_ways:
            self._coarse = min(self._coarse or entry.plan.cost, entry.plan.cost)
        gained = entry.before - entry.plan.cost > WORTH_CHECKING * entry.plan.cost
        entry.fruitless = 0 if gained else entry.fruitless + 1
        entry.rounds += 1
        entry.trail.clear()
        entry.done, entry.refiner, entry.optimiser = True, None, None
        self._settled.append(entry.plan)

    def _learn(self, entry: _Entry) -> None:
        """Keep the ways that robots take in a plan that is done with, for the time being or for good."""
        if entry.optimiser is not None and (entry.over or not entry.on_trial):
            self.stock.add(*entry.optimiser.latest())

    def settled(self) -> list[Plan]:
        """Plans whose refinement has converged since this was last asked."""
        out, self._settled = self._settled, []
        return out

    def _offer(self, entry: _Entry, incumbent: float, work: Refiner | Optimiser | LocalSearch) -> Plan | None:
        """Have a plan checked that is clearly cheaper than the incumbent; where the judge objects, look closer."""
        if work.cost > incumbent * (1 - WORTH_CHECKING):
            return None
        plan = self.incumbent.plan(work.segments(), work.transitions)
        report = self.incumbent.judge(plan)
        if report.ok:
            entry.plan, entry.draft = plan, False
            if not isinstance(work, Refiner):
                work.confirm()
            return plan
        if not isinstance(work, Refiner):
            work.tighten(report)
        else:
            # Something slipped between the samples: go back to what was checked.
            entry.resolution /= 2
            entry.refiner = None
        return None

    def _due(self, entry: _Entry, incumbent: float) -> bool:
        """Whether the judge is asked now: that takes longer than a program, and the next may gain as much again.

        What has been gained when time is nearly up would be lost otherwise.
        """
        worth = entry.cost <= incumbent * (1 - WORTH_CHECKING)
        entry.waiting = entry.waiting + 1 if worth else 0
        patience = _LONGER if isinstance(entry.optimiser, LocalSearch) else _PATIENCE
        needed = _LAST * self.incumbent.judging_s + max(self._took, default=0.0)
        last = worth and self.deadline.left_s < needed
        due = last or entry.waiting > patience or entry.cost <= incumbent * (1 - _PLENTY)
        if due:
            entry.waiting = 0
        return due

    def _refiner(self, entry: _Entry) -> Refiner:
        return Refiner(entry.plan, self.validity, self.rng, entry.resolution)
