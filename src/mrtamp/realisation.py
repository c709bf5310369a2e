"""Turning proposed skeletons into plans: as drafts, in space and time, or along the tensor tree (DESIGN section 9).

Skeletons go in as `SkeletonGuidance` proposes them, cheapest first; what could not be realised is reported back to it
and changes what it proposes next.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from mrtamp.growth import Growth, Timed
from mrtamp.incumbent import Incumbent
from mrtamp.optimise.descent import Descent
from mrtamp.optimise.yielding import Draft
from mrtamp.plan import Plan, Transition, plan_cost
from mrtamp.portfolio import Portfolio
from mrtamp.portfolio_entry import Sketch
from mrtamp.skeleton_guidance import Proposal, SkeletonGuidance
from mrtamp.space_time import SpaceTime
from mrtamp.tensor_tree import Node
from mrtamp.transitions.ways import Way

_FIRST_WAYS, _MORE_WAYS = (80, 14), (64, 20)
"""IK seeds, and ways kept, per task and robots: before there is a plan, and later."""
_FEW_TASKS, _FIRST_GROWTHS = 4, 3
"""Where there are no more tasks, how often ways are sampled before there is a plan, at most, as long as one of them has
fewer ways than are kept at a time."""
_FIRST_SHORTENED, _SHORTENED = 16, 40
"""Of these, how many are shortened."""
_GROWTHS, _SLOW_GROWTHS, _WORTH_GROWING = 32, 2, 0.02
"""How often ways are sampled before the first drafts, all kinds of them together: the fewer there are the sooner chance
has found the best; and how often where that takes long since objects are handed over, as long as skeletons get cheaper
by that share.  Later it is half as often."""
_REALISATIONS = 6
"""Skeletons that are tried at a time."""
_QUICK, _THOROUGH = 30, 300
"""Orders evaluated per search for skeletons, before there is a plan and later."""
_RIVALS, _INSERTIONS = 2, 3
"""Skeletons of which the cheapest is refined, and realisations of each that are compared."""
_SKETCHED, _DRAFTS = 16, 3
"""Skeletons that are drafted at a time, and drafts of them that are refined."""
_AT_ONCE = 4
"""Skeletons that are drafted before what was learnt from them changes what is proposed."""
_CONFLICT = 3e-3
"""Conflict of a draft (see `Draft`) from which on it hardly ever comes free of collision."""
_DOUBTFUL = 1e-3
"""What robots that collide where they end have to have in the blame, on top of the conflict, for a draft to be one of
those of which only one is refined at a time, if there are others."""
_GUILTY = 0.25
"""Share in the conflict, or in the most that any way is to blame for where that is more, from which on a way is to
blame; where nobody has it, all are."""
_DETERRENT = 100.0
"""By how many times dearer a skeleton seems for a conflict of 1 in its draft."""
_POOR = 2.0
"""A first realisation that costs so many times what its skeleton promised is not the only one."""
_DEAR, _PROGRAMS, _FEW_STOPS = 2.1, 8, 8
"""If the best of them still costs so many times that, it has so many convex programs to become cheaper before it counts
as a plan; where there are more stops they take too long for that."""
_MENDINGS = 8
"""Times that a realisation is judged, steps to which the judge objected being forbidden before the next."""
_MANY = 12
"""Stops from which on a realisation takes too long for that."""
_LIKE, _CHEAPER, _FADES = 0.5, 0.97, 0.7
"""Difference of every joint (rad) up to which handovers are held to have the same optimum as drafted ones, unless they
promise to cost so much less; and what is left of it when there was nothing else to draft."""


class Realisation:
    """Realises the skeletons of one problem.

    Parameters
    ----------
    growth : realises skeletons in space and time, or along its tree.
    skeletons : proposes them and learns what failed.
    incumbent : has plans judged.  portfolio : takes drafts, and knows which orders of events are under refinement.
    root : the tree's root, where every skeleton starts.
    to_beat : cost that a skeleton has to promise less than.
    offer : makes a plan the incumbent if it is cheaper.
    descent : shortens ways along their strata; None: they stay as they were sampled.
    drafts : whether skeletons are also put under refinement as they are.
    refining : whether a dear first plan is refined before it counts.

    Attributes
    ----------
    undrafted : whether drafts are still to be made for the first time: the sooner the better, once there is a plan.
    """

    def __init__(
        self,
        growth: Growth,
        skeletons: SkeletonGuidance,
        incumbent: Incumbent,
        portfolio: Portfolio,
        root: Node,
        to_beat: Callable[[], float],
        offer: Callable[[Plan], bool],
        *,
        descent: Descent | None = None,
        drafts: bool = True,
        refining: bool = True,
    ) -> None:
        self.growth = growth
        self.skeletons = skeletons
        self.incumbent = incumbent
        self.portfolio = portfolio
        self.root = root
        self.to_beat = to_beat
        self.offer = offer
        self.descent = descent
        self.drafts = drafts and portfolio.convex
        self.refines = refining and portfolio.convex
        self.undrafted = self.drafts
        self._turn = 0
        self._attempted = False
        self._promised = np.inf
        self._early = self._urgent = False
        self._drafted = _Drafted()

    def attempt(self) -> Plan | Node | None:
        """Grow the sets of ways and realise the cheapest skeletons that may beat the incumbent, until one succeeds.

        Returns
        -------
        A checked plan that the tree does not have yet, a goal node of the tree, or None; also where drafts were made.
        """
        first, hasty = self._first, not self._attempted
        self._attempted = True
        self._grow()
        self.skeletons.update_bound(hasty=hasty)
        if not first and self.drafts and self._draft():
            return None
        tries = 0
        while tries < _REALISATIONS:
            failed: set[Way] = set()
            inserted: list[tuple[float, Timed, SpaceTime, Proposal]] = []
            for proposal in self.skeletons.propose(self.to_beat(), _QUICK if first else _THOROUGH, hasty=hasty):
                if not proposal.hasty:
                    self._promised = min(self._promised, proposal.skeleton.cost)
                if not failed.isdisjoint(proposal.ways):
                    # The guidance has learnt something about these since.
                    continue
                tries += 1
                best = self._cheapest_insertion(proposal)
                if best is not None and not first and self.portfolio.convex and not self.skeletons.has_choice:
                    self.skeletons.realised(proposal)
                    self.portfolio.add_unchecked(*best[1])
                    return None
                if best is not None:
                    inserted.append((*best, proposal))
                    if first or len(inserted) == _RIVALS or not self.skeletons.has_choice:
                        break
                    continue
                node = self.growth.realise(proposal, self.skeletons, self.root)
                if node is not None:
                    self.skeletons.realised(proposal)
                    return node
                failed = {way for way in proposal.ways if way.failures}
                if tries >= _REALISATIONS:
                    break
            # An order of events that is under refinement already has had its chance.
            for _, timed, schedule, proposal in sorted(inserted, key=lambda x: (self.portfolio.knows(x[1][1]), x[0])):
                plan = self._judged(timed, schedule, proposal)
                if plan is not None:
                    self.skeletons.realised(proposal)
                    return self.presentable(plan) if first else plan
                failed |= self.skeletons.refused(proposal)
            if not failed:
                return None
        return None

    def presentable(self, plan: Plan) -> Plan:
        """The first plan, refined a little where it is far dearer than skeletons promised and that is quick."""
        enough = _DEAR * self._promised
        if not self.refines or plan.cost <= enough or len(plan.transitions) > _FEW_STOPS:
            return plan
        try:
            return self.portfolio.refined(plan, enough, _PROGRAMS)
        except BaseException:
            # Whatever interrupts this, there is a plan.
            self.offer(plan)
            raise

    def _judged(self, timed: Timed | None, schedule: SpaceTime | None, proposal: Proposal) -> Plan | None:
        """The plan of a realisation if the judge accepts it, after some attempts without the steps it objected to."""
        for _ in range(_MENDINGS):
            if timed is None or schedule is None:
                return None
            plan = self.incumbent.plan(*timed)
            report = self.incumbent.judge(plan)
            if report.ok:
                return plan
            # Something slipped between the samples.
            if not self.growth.refuted(report, schedule):
                return None
            timed = self.growth.insert(proposal, self.skeletons, self.root)
            schedule = self.growth.insertion.schedule
        return None

    def _grow(self) -> None:
        """Sample more ways; where objects are handed over, until more of them hardly make skeletons cheaper."""
        if self._first:
            for _ in range(_FIRST_GROWTHS):
                self.skeletons.grow(*_FIRST_WAYS)
                counts = self.skeletons.counts.values()
                slow = self.skeletons.hands_over or len(counts) > _FEW_TASKS
                if slow or all(n >= _FIRST_WAYS[1] for n in counts):
                    break
            if self.descent is not None:
                self.skeletons.shorten(self.descent, _FIRST_SHORTENED)
            return
        slow, kinds, cheapest = self.skeletons.hands_over, self.skeletons.kinds, np.inf
        most = _SLOW_GROWTHS if slow else _GROWTHS // kinds if kinds else 1
        for _ in range(max(most if self.undrafted else most // 2, 1)):
            before, cheapest = cheapest, self._more_ways()
            if slow and cheapest > (1 - _WORTH_GROWING) * before:
                break

    def _more_ways(self) -> float:
        """Sample ways and shorten them; what the cheapest skeleton promised to cost before its own became shorter."""
        self.skeletons.grow(*_MORE_WAYS)
        if self.descent is not None:
            self.skeletons.shorten(self.descent, _SHORTENED)
        if not self.skeletons.hands_over or (self.descent is None and not self.undrafted):
            # Nobody asks, and there is nothing to be shortened.
            return np.inf
        below = self.portfolio.worth_drafting(self.to_beat())
        proposals = list(self.skeletons.propose(below, _THOROUGH))
        if self.descent is not None:
            self.skeletons.shorten_proposed(self.descent, proposals)
        return min((p.skeleton.cost for p in proposals), default=np.inf)

    @property
    def _first(self) -> bool:
        """Whether there is no plan yet."""
        return self.incumbent.best is None

    def _draft(self) -> bool:
        """Two times out of three, put some cheap skeletons under refinement as they are; whether that was all.

        Each robot goes its way as if it were alone, and only the timing makes them yield to one another.  Where that
        leaves little conflict, convex programs pull them apart at hardly more than the skeleton promised.  Without a
        choice of ways drafts hardly differ: then it is one, every other time.
        """
        self._turn += 1
        choice = self.skeletons.has_choice
        if self._turn % 3 == 0 if choice else self._turn % 2 == 1:
            return False
        self.undrafted = False
        drafts, spare = list[Sketch](), list[Sketch]()
        sketched = 0
        while sketched < _SKETCHED and len(drafts) < (_DRAFTS if choice else 1):
            below = self.portfolio.worth_drafting(self.to_beat())
            found = self.skeletons.propose(below, _THOROUGH)
            proposals, crowded = [], False
            for proposal in found:
                if self._conflicts(proposal, drafts):
                    crowded = True
                elif not self._drafted.knows(proposal):
                    proposals.append(proposal)
                if len(proposals) == _AT_ONCE:
                    break
            if not proposals:
                # Nothing promises a gain, however it were realised, unless it only has to be realised in another way.
                if not sketched and not crowded:
                    self._relent()
                    return True
                break
            for proposal in proposals:
                if self._conflicts(proposal, drafts) or (drafts and not choice):
                    continue
                sketched += 1
                draft = self._sketch(proposal)
                if draft is not None:
                    self._drafted.add(proposal)
                    (spare if draft.doubtful and any(d.doubtful for d in drafts) else drafts).append(draft)
        drafts += spare[: max(_DRAFTS - len(drafts), 0)]
        drafts.sort(key=lambda x: x.estimate * (1 + _DETERRENT * x.draft.conflict))
        added = self.portfolio.add_drafts(drafts[:_DRAFTS]) > 0
        if added:
            self._drafted.like = _LIKE
        else:
            self._relent()
        return added

    def _relent(self) -> None:
        """There was nothing to draft: what was learnt about what need not be tried is only mostly right."""
        self._drafted.like *= _FADES
        self.portfolio.crowded.clear()

    def _sketch(self, proposal: Proposal) -> Sketch | None:
        """The draft of a skeleton; None where there is too much conflict, which then counts against its ways."""
        self.skeletons.realised(proposal)
        timed = self.growth.insert(proposal, self.skeletons, self.root, alone=True)
        if timed is None:
            return None
        # Either is better about as often as the other, and seldom both lead to the same plan.
        self._early = not self._early
        draft = self.portfolio.yielding.time(*timed, early=self._early)
        blamed = self._blamed(proposal, timed[1], draft)
        whole = max(draft.conflict, *blamed.values()) if blamed else 0.0
        guilty = frozenset(w for w, much in blamed.items() if much > _GUILTY * whole) or frozenset(proposal.ways)
        if draft.conflict < _CONFLICT:
            doubtful = whole > draft.conflict + _DOUBTFUL
            return Sketch(proposal.skeleton.cost, draft, frozenset(proposal.ways), guilty, doubtful)
        self.skeletons.crowded(blamed)
        self.portfolio.crowded.add(guilty)
        return None

    def _conflicts(self, proposal: Proposal, drafts: Sequence[Sketch]) -> bool:
        """Whether some of its ways conflicted in a draft before, or may not come free in one of these."""
        own = set(proposal.ways)
        return any(w <= own for w in self.portfolio.crowded) or any(d.doubtful and d.guilty <= own for d in drafts)

    @staticmethod
    def _blamed(proposal: Proposal, transitions: Sequence[Transition], draft: Draft) -> Mapping[Way, float]:
        """How much of the conflict of a draft there is on each of its skeleton's ways."""
        of = {h.task: way for h, (_, way) in zip(proposal.skeleton.happenings, proposal.stops, strict=True)}
        out = defaultdict[Way, float](float)
        for k, much in draft.blame.items():
            for action in transitions[k].actions:
                out[of[action.subgoal or action.object or ""]] += much
        return out

    def _cheapest_insertion(self, proposal: Proposal) -> tuple[float, Timed, SpaceTime] | None:
        """The cheapest of several realisations of a skeleton in space and time, with its cost and schedule; None if the
        first fails.

        They differ by chance, and what starts cheaper usually ends cheaper: far less work than refining all of them.
        Before there is a plan, more than one is tried only where that is quick and the first far dearer than promised.
        """
        if not self._first and not self.skeletons.has_choice:
            return self._another_insertion(proposal)
        best: tuple[float, Timed, SpaceTime] | None = None
        for k in range(_INSERTIONS):
            inserted = self._insertion(proposal, varied=k > 0)
            if inserted is not None and (best is None or inserted[0] < best[0]):
                best = inserted
            good = proposal.hasty or (best is not None and best[0] < _POOR * proposal.skeleton.cost)
            if best is None or (self._first and (good or len(proposal.stops) > _MANY)):
                break
        return best

    def _another_insertion(self, proposal: Proposal) -> tuple[float, Timed, SpaceTime] | None:
        """A realisation that differs by chance from those there were of the same ways, None if several attempts fail.

        What it costs does not tell how cheap it becomes: robots give way to each other in another order or on the other
        side, which only refinement shows the worth of.
        """
        for _ in range(_INSERTIONS):
            self._urgent = not self._urgent
            inserted = self._insertion(proposal, varied=True, urgent=self._urgent)
            if inserted is not None:
                return inserted
        return None

    def _insertion(
        self, proposal: Proposal, *, varied: bool, urgent: bool = False
    ) -> tuple[float, Timed, SpaceTime] | None:
        timed = self.growth.insert(proposal, self.skeletons, self.root, varied=varied, urgent=urgent)
        schedule = self.growth.insertion.schedule
        if timed is None or schedule is None:
            return None
        return plan_cost(*timed, self.growth.problem.cost), timed, schedule


class _Drafted:
    """Skeletons that had drafts of little conflict: others so much like them would be refined to the same plan.

    Attributes
    ----------
    like : difference (rad) of every joint up to which others are.
    """

    def __init__(self) -> None:
        self.like = _LIKE
        self._known: dict[tuple, list[tuple[float, np.ndarray]]] = {}

    def add(self, proposal: Proposal) -> None:
        """Remember a skeleton, if others may be compared with it."""
        if self._comparable(proposal):
            known = self._known.setdefault(proposal.skeleton.order, [])
            known.append((proposal.skeleton.cost, self._flat(proposal)))

    def knows(self, proposal: Proposal) -> bool:
        """Whether the same robots did the same in the same order before, with every joint near to where it was, and for
        hardly more than this promises to cost.
        """
        if not self._comparable(proposal):
            return False
        flat, cost = self._flat(proposal), proposal.skeleton.cost
        known = self._known.get(proposal.skeleton.order, [])
        return any(cost > _CHEAPER * c and np.abs(flat - other).max(initial=0.0) < self.like for c, other in known)

    @staticmethod
    def _comparable(proposal: Proposal) -> bool:
        """Whether every way has a handover and was shortened: near to each other, such skeletons have the same optimum.

        What differs little elsewhere differs in who is in whose way, and to try again has paid.
        """
        return all(way.shortened and len(way.robots) > 1 for way in proposal.ways)

    @staticmethod
    def _flat(proposal: Proposal) -> np.ndarray:
        """All configurations in an order that does not depend on when things happen."""
        happenings = zip(proposal.skeleton.happenings, proposal.stops, strict=True)
        ordered = sorted(happenings, key=lambda x: (x[0].task, x[0].event))
        return np.concatenate([q for _, (stop, _) in ordered for _, q in sorted(stop.q.items())])
