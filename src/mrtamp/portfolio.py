"""Several plans under refinement at once: the one that starts dearest may end cheapest."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mrtamp.collision import RESOLUTION
from mrtamp.deadline import Deadline
from mrtamp.incumbent import Incumbent
from mrtamp.optimise import LocalSearch, Optimiser, Stock, tools_of
from mrtamp.optimise.legs import order_of
from mrtamp.optimise.nearness import Nearness
from mrtamp.optimise.yielding import Yielding
from mrtamp.plan import Plan, Segment, Transition
from mrtamp.portfolio_entry import FIRST, FIRST_SEARCH, LATER, NEARLY, OTHER_WAYS, SAME_WAYS, Entry, Sketch
from mrtamp.problem import Problem
from mrtamp.refine import Refiner
from mrtamp.transitions.sampler import TransitionSampler
from mrtamp.transitions.ways import Way
from mrtamp.validity import Validity

SIZE = 6
_SLICE = 40
"""Proposals of shortening per turn."""
_SHORTENING = 1
"""Proposals, per robot and transition, after which shortening gives way to convex programming."""
_ALONE = 1200
"""The same where there is no convex programming."""
_CLEARANCE = 0.015
"""Clearance (m) with which a plan is free of collision after the first programs, all but always."""
_STALE = 0.004
"""Relative gain of a turn below which shortening has done its part."""
_LUCK = 0.93
"""A draft may come to so many times less than the best one so far, relative to what their skeletons promised."""
_RETIMINGS, _SOONER, _APART = 2, 0.99, 3e-3
"""Times that a draft which is about to be given up is timed anew, share of its cost that this may leave at most, and
its largest conflict then."""
_ASTRAY = 1.2
"""A plan that costs so many times the least that is possible most likely goes the wrong way around."""
_ALIKE = 0.02
"""Relative difference of cost below which two plans with the same order of events are held to be alike."""
_EPS = 1e-9
"""By how much the costs of a plan and of the polyline that it was made from may differ."""
WORTH_CHECKING = 0.002
"""Relative gain over the incumbent that is worth a check."""
_PLENTY, _PATIENCE, _LONGER = 0.04, 4, 24
"""Relative gain that is checked at once, half of it after another program and so on, and programs after which a smaller
one is: more of them where they are small ones of local search."""
_POOR = 1.12
"""How many times as much as skeletons promise a converged plan costs that others had better challenge."""
_FINER = 0.95
"""What a second round, with re-timing and finer steps, may leave of the cost of a draft, before there was one."""
_PROMISING = 0.99
"""Share of the incumbent's cost below which a draft has to be expected to end to go on before there are others."""
_ROUNDS = 6
"""Rounds without gain after which a plan is left alone."""
_LAST, _RECENT = 1.2, 6
"""When there is no more time than so many times what the judge and the longest of so many programs (with what mends
their outcome) took, what was gained is checked at once."""


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
        self._patiences = [replace(p, local=local) for p in (OTHER_WAYS, SAME_WAYS)]
        self._entries: list[Entry] = []
        self._settled: list[Plan] = []
        self.crowded: set[frozenset[Way]] = set()
        """Ways that conflict too much with each other in a draft, or that it did not come free with."""
        self._seen: set[float] = set()
        self._took: deque[float] = deque(maxlen=_RECENT)
        """Seconds that the last programs took."""
        self._contest: str | None = None
        """Which of the two had its turn last, where there was a choice."""
        self._share = 0.0
        """The least that a draft has cost in the end, relative to its estimate."""
        self._left = [_FINER]
        """What second rounds of drafts have left of their cost."""
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
        self._admit([Entry(plan, patience=self.patience)])
        return True

    def add_unchecked(self, segments: list[Segment], transitions: list[Transition]) -> bool:
        """Put motions under refinement of which the judge has not been asked: what may have slipped between samples is
        mended sooner than found; False if they are known."""
        plan = self.incumbent.plan(segments, transitions)
        if round(plan.cost, 6) in self._seen:
            return False
        self._seen.add(round(plan.cost, 6))
        entry = Entry(plan, draft=True, patience=self.patience)
        entry.optimiser = self._optimiser(entry)
        self._admit([entry])
        return True

    def refined(self, plan: Plan, enough: float, programs: int) -> Plan:
        """A checked plan after convex programs, so many at most, have made it cost less than `enough`.

        Where they do not, or the judge objects to the outcome, it is the same one.
        """
        work = self._optimiser(Entry(plan), clearance=_CLEARANCE)
        while work.steps < programs and work.cost >= enough and not (work.converged or self.deadline.passed):
            work.step()
        return (self.incumbent.accepted(work.segments(), work.transitions) or plan) if work.cost < enough else plan

    def worth_drafting(self, incumbent: float) -> float:
        """Estimate below which drafts may come to beat the incumbent, from what became of those so far."""
        return NEARLY * incumbent / (_LUCK * self._share) if self._share else incumbent

    def knows(self, transitions: Sequence[Transition]) -> bool:
        """Whether a plan with the same order of events is under refinement."""
        return any(order_of(e.plan.transitions) == order_of(transitions) for e in self._entries)

    def add_drafts(self, drafts: Sequence[Sketch]) -> int:
        """Put motions in which robots still collide with each other under convex programming; how many are new.

        The first is worked on first: among those on trial the newest goes on.
        """
        fresh = []
        for sketch in drafts:
            draft = sketch.draft
            plan = self.incumbent.plan(draft.segments, draft.transitions)
            if round(plan.cost, 6) in self._seen:
                continue
            self._seen.add(round(plan.cost, 6))
            free = self.incumbent.accepted(draft.segments, draft.transitions) if draft.conflict == 0.0 else None
            entry = Entry(free or plan, draft=free is None, patience=self.patience, sketch=sketch)
            entry.optimiser = self._optimiser(entry)
            fresh.append(entry)
        self._admit(fresh[::-1])
        return len(fresh)

    def _admit(self, fresh: list[Entry]) -> None:
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
            # A piece takes hardly less time than a plan of a few robots, but where it is all there is to do it gains.
            work = entry.size if entry.patience.same_ways else 1.0
            self._effort.record(self._contest, work, max(gain, 0.0))
        return plan

    def _work(self, entry: Entry, incumbent: float) -> Plan | None:
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
        if entry.over and isinstance(entry.optimiser, Optimiser) and self._hopeful(entry, incumbent):
            entry.optimiser.finish()
        due = self._due(entry, incumbent) or entry.over
        plan = self._offer(entry, incumbent, entry.optimiser) if due else None
        if entry.over and not self._timed_anew(entry):
            self._finish(entry, incumbent)
        return plan

    def _timed_anew(self, entry: Entry) -> bool:
        """Whether what is still a draft gets another trial, since its robots can be elsewhere at the time.

        Convex programs never change who goes first where ways cross; with ways as they are by now it may be another.
        """
        work = entry.optimiser
        if not (entry.draft and entry.began_as_draft and isinstance(work, Optimiser) and work.steps):
            return False
        if work.stuck or entry.retimings == _RETIMINGS:
            return False
        entry.retimings += 1
        found = [self.yielding.time(*work.latest(), early=early) for early in (False, True)]
        plans = [self.incumbent.plan(d.segments, d.transitions) for d in found if d.conflict < _APART]
        best = min(plans, key=lambda p: p.cost, default=None)
        if best is None or best.cost > _SOONER * entry.outlook:
            return False
        entry.plan = best
        entry.optimiser = self._optimiser(entry)
        entry.trail.clear()
        return True

    def busy(self, incumbent: float) -> bool:
        """Whether a plan is on trial, or a draft is yet to show whether it beats the incumbent: until that is over,
        more plans would only wait."""
        return any(e.on_trial or self._promising(e, incumbent) for e in self._entries)

    def _promising(self, entry: Entry, incumbent: float) -> bool:
        """Whether a draft that has not had its second round may beat the incumbent with it."""
        young = entry.began_as_draft and entry.rounds <= 1 and not entry.patience.same_ways
        return young and self._prospect(entry) < _PROMISING * incumbent

    def _prospect(self, entry: Entry) -> float:
        """What a draft is likely to cost after its second round, from what those so far have gained by theirs; where
        there is no choice of ways, the outlook."""
        if entry.patience.same_ways or entry.rounds > 1:
            return entry.outlook
        return entry.outlook * self._finer if entry.rounds == 0 else min(entry.outlook, entry.coarse * self._finer)

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

    def _poor(self, entry: Entry, bound: float | None) -> bool:
        # Where there are no other ways, there is nothing better.
        return entry.rounds > 0 and not self.patience.same_ways and entry.cost > _POOR * (bound or np.inf)

    def _hopeful(self, entry: Entry, incumbent: float) -> bool:
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

    def _worth_a_round(self, entry: Entry, incumbent: float) -> bool:
        """Whether a plan that has converged is shaken and refined again."""
        return entry.done and entry.fruitless < _ROUNDS and self._hopeful(entry, incumbent)

    def _choose(self, incumbent: float, bound: float | None = None) -> Entry | None:
        """One that is about to beat the incumbent; else the incumbent itself if it `goes_ahead`, unless it is poor for
        what skeletons promise; else, as the shares of both have it, one in its first round or a later one.

        Of those in their first round the newest on trial goes on, then drafts that may win by their second round.
        What drafts seem to cost before their first program says nothing: those on trial begin with the most promising.
        Drafts that are hopeless are given up.
        """
        self._contest = None
        most = self.worth_drafting(incumbent) if self._share else np.inf
        for entry in [e for e in self._entries if e.draft and self._hopeless(e, incumbent, most)]:
            if entry.estimate > most or not self._timed_anew(entry):
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
        promising = [e for e in self._entries if self._promising(e, incumbent)]
        first = trial[-1] if trial else min(promising, key=self._prospect, default=None)
        first = first or min((e for e in hopeful if e.fresh), key=lambda e: e.outlook, default=None)
        begun = [e for e in hopeful if e.rounds and e not in promising]
        rested = [e for e in self._entries if self._worth_a_round(e, incumbent) and e not in promising]
        later = min(begun or rested, key=lambda e: e.cost * (1 + 0.02 * e.fruitless), default=None)
        if first is not None and later is not None:
            self._contest = self._effort.next((FIRST, LATER))
        if first is not None and self._contest != LATER:
            return self._again(first) if first.done else first
        if later is not None:
            return self._again(later) if later.done else later
        waiting = [e for e in self._entries if not e.done]
        return min(waiting, key=lambda e: e.cost, default=None)

    @property
    def _finer(self) -> float:
        """What a second round leaves of the cost of a draft."""
        return float(np.mean(self._left))

    def _hopeless(self, draft: Entry, incumbent: float, most: float) -> bool:
        """Whether to give up a draft: its estimate is above `most`, where no draft so far has ended cheap enough,
        or after its trial it is not expected to end cheaper than the incumbent, and to come free costs it more still.

        What is only unchecked has nothing more to pay.
        """
        if draft.estimate > most:
            return True
        if draft.on_trial:
            return False
        return self._prospect(draft) >= incumbent if draft.began_as_draft else not self._hopeful(draft, incumbent)

    @staticmethod
    def _again(entry: Entry) -> Entry:
        """A plan that goes on to its next round."""
        entry.refiner, entry.optimiser, entry.proposals, entry.done = None, None, 0, False
        return entry

    def _shorten(self, entry: Entry, incumbent: float) -> Plan | None:
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

    def _begin_convex(self, entry: Entry, work: Refiner, *, judged: bool) -> None:
        """Go on from the shortened plan, if it is worth a check and the judge agrees, else from the one before."""
        if not judged and work.cost < entry.plan.cost * (1 - WORTH_CHECKING):
            plan = self.incumbent.accepted(work.segments(), work.transitions)
            if plan is not None:
                entry.plan = plan
            else:
                entry.resolution /= 2
        entry.refiner = None
        entry.optimiser = self._optimiser(entry)

    def _optimiser(self, entry: Entry, clearance: float = 0.0) -> Optimiser:
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
            clearance=clearance,
            deadline=self.deadline,
        )

    def _local_search(self, entry: Entry) -> LocalSearch:
        # A piece is small enough for finer steps, which with coarse ones all around gain as much; but where there are
        # many ways of other plans to try, with coarse ones it is twice as many in the time.
        level = 0 if self.patience.same_ways and entry.rounds == FIRST_SEARCH else 1
        plan = entry.plan
        what = self.problem, self.nearness, plan.segments, plan.transitions, self.rng
        return LocalSearch(*what, stock=self.stock, level=level, deadline=self.deadline)

    def _finish(self, entry: Entry, incumbent: float) -> None:
        """Convergence: what was gained decides whether the plan is worth another round; a draft is given up."""
        work = entry.optimiser
        self._learn(entry)
        if entry.draft and entry.sketch is not None and isinstance(work, Optimiser) and work.stuck:
            self._beware(entry.sketch)
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
        if entry.began_as_draft and entry.rounds > 0:
            # The second round, too, often gains much.
            share = entry.plan.cost / entry.estimate
            self._share = min(self._share or share, share)
        if entry.rounds == 0:
            entry.coarse = entry.plan.cost
        elif entry.rounds == 1 and entry.began_as_draft:
            self._left.append(entry.plan.cost / entry.coarse)
        if entry.rounds == 0 and self.patience.same_ways:
            self._coarse = min(self._coarse or entry.plan.cost, entry.plan.cost)
        gained = entry.before - entry.plan.cost > WORTH_CHECKING * entry.plan.cost
        entry.fruitless = 0 if gained else entry.fruitless + 1
        entry.rounds += 1
        entry.trail.clear()
        entry.done, entry.refiner, entry.optimiser = True, None, None
        self._settled.append(entry.plan)

    def _learn(self, entry: Entry) -> None:
        """Keep the ways that robots take in a plan that is done with, for the time being or for good."""
        if entry.optimiser is not None and (entry.over or not entry.on_trial):
            self.stock.add(*entry.optimiser.latest())

    def _beware(self, lodged: Sketch) -> None:
        """Give up other drafts with the ways that most likely keep this one in collision."""
        if not lodged.guilty:
            return
        self.crowded.add(lodged.guilty)
        others = [e for e in self._entries if e.draft and e.sketch is not lodged]
        for entry in others:
            if entry.sketch is not None and lodged.guilty <= entry.sketch.ways:
                self._entries.remove(entry)

    def settled(self) -> list[Plan]:
        """Plans whose refinement has converged since this was last asked."""
        out, self._settled = self._settled, []
        return out

    def _offer(self, entry: Entry, incumbent: float, work: Refiner | Optimiser | LocalSearch) -> Plan | None:
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

    def _due(self, entry: Entry, incumbent: float) -> bool:
        """Whether the judge is asked now: that takes longer than a program, and the next may gain as much again.

        What has been gained when time is nearly up would be lost otherwise.
        """
        worth = entry.cost <= incumbent * (1 - WORTH_CHECKING)
        entry.waiting = entry.waiting + 1 if worth else 0
        patience = _LONGER if isinstance(entry.optimiser, LocalSearch) else _PATIENCE
        needed = _LAST * (self.incumbent.judging_s + max(self._took, default=0.0))
        last = worth and self.deadline.left_s < needed
        due = last or entry.waiting > patience or entry.cost <= incumbent * (1 - _PLENTY / max(entry.waiting, 1))
        if due:
            entry.waiting = 0
        return due

    def _refiner(self, entry: Entry) -> Refiner:
        return Refiner(entry.plan, self.validity, self.rng, entry.resolution)
