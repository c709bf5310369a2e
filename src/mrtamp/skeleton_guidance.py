"""Guidance that knows costs: whole skeletons from dense sets of ways, and what experience says against them.

Tasks are read off the goal (objects to be carried, subgoals to be reached); their options and candidates are the ways
sampled so far.  The cheapest decoupled schedules are proposed; the tensor tree realises them among all robots, and
where that fails or is dearer, the ways concerned are held to be dearer too (DESIGN section 9).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mrtamp.connect import Connector
from mrtamp.deadline import Deadline
from mrtamp.guidance import ModalGuidance
from mrtamp.modes import Attachment, Mode
from mrtamp.optimise.descent import Descent, Surroundings
from mrtamp.plan import Plan
from mrtamp.problem import HeldBy, Problem, RobotAt
from mrtamp.schedule import FAR, Distance
from mrtamp.skeletons import Event, Option, Skeleton, Task, lower_bound, skeletons
from mrtamp.transitions.candidate import Candidate, SolvedHandover
from mrtamp.transitions.sampler import TransitionSampler
from mrtamp.transitions.ways import Stop, Way, Ways

_CROWDED = 100.0
"""Added to the estimated cost of a way (rad) for a conflict of 1 (see `mrtamp.optimise.yielding.Draft`)."""
_LIKE = 0.5
"""Distance (rad) of all configurations of two ways at which what was learnt of one counts for the other by a third."""
_FAILED = 2.0
"""Added to the estimated cost of a way (rad) whose stop could not be realised."""
_REPEATED = 0.04
"""How much dearer an order of events seems for every time that it was realised before."""
_FEW = 30
"""Stops per robot up to which distances are those of the roadmaps."""
_GROWN = 1.15
"""Growth of a roadmap after which distances on it are computed anew."""
_TRIES = 4
"""Calls without result after which a set of ways is grown now and then only."""
_ROUNDS = 200
"""Lazy searches for the length of one roadmap path."""
_TREE = 100
"""Tree extensions to find one where the roadmap has none."""
_ADMITTED = 4
"""Shortened ways that are kept at a time, of different lengths."""
_SLACK, _UNHURRIED = 0.5, 0.1
"""Time to spare (rad) from which on a motion hardly counts, and how much it still does."""
_LIMIT = 12
_MOST = 120
"""Ways per option that are handed to the search for skeletons."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A skeleton and its stops in the order in which they happen, with the ways they belong to.

    `before` lists for every stop the numbers of those that must happen earlier; `repeated` is how often this order was
    realised already; `hasty` says that its cost leaves obstacles out of account.
    """

    skeleton: Skeleton
    stops: tuple[tuple[Stop, Way], ...]
    before: tuple[tuple[int, ...], ...]
    repeated: int
    hasty: bool = False

    @property
    def ways(self) -> list[Way]:
        """The ways that the stops belong to, each once."""
        return list(dict.fromkeys(way for _, way in self.stops))


class SkeletonGuidance:
    """Grows ways, proposes skeletons, and learns from their realisation.

    Attributes
    ----------
    ways : the dense sets.
    bound : the least cost of a decoupled schedule over all ways sampled so far, without what was learnt; None before
        every task has a way.  A lower bound on plans that use these very transitions, nothing more.
    """

    def __init__(
        self,
        problem: Problem,
        sampler: TransitionSampler,
        guidance: ModalGuidance,
        root: Mode,
        deadline: Deadline | None = None,
    ) -> None:
        self.problem = problem
        self.deadline = deadline or Deadline()
        self.sampler = sampler
        self.guidance = guidance
        self.root = root
        self.rng = sampler.rng
        self.ways = Ways(sampler)
        self.connector = Connector(sampler.validity, self.rng, self.deadline)
        self._chains: dict[str, tuple[Attachment, ...]] = {}
        self.bound: float | None = None
        self._realised: Counter[tuple] = Counter()
        self._lengths: dict[tuple[str, int, int], tuple[int, float]] = {}
        self._reaching: dict[tuple[str, int], Way] = {}
        self.items = self._in_order([o for o in root.of if not guidance.done(root, o)])
        # A goal that ends with an object in a hand, or an object that subgoals lead as well, is the search's business.
        led = {s.attach.object for s in problem.subgoals if s.attach is not None}
        held = any(isinstance(c, HeldBy) for c in problem.goal)
        self.applies = not held and not led & set(self.items) and bool(self.items or problem.subgoals)
        self.robots = [r.name for r in problem.robots if r.model.gripper is not None]

    def _in_order(self, items: list[str]) -> list[str]:
        """Objects that others will rest on come before those."""
        below = {o: {s.body for s in self.sampler.goal_supports[o]} & set(items) - {o} for o in items}
        out: list[str] = []
        while len(out) < len(items):
            ready = [o for o in items if o not in out and below[o] <= set(out)]
            out += ready or [o for o in items if o not in out]
        return out

    # -- sampling -------------------------------------------------------------------------------------------------

    def grow(self, n: int, keep: int) -> None:
        """New ways for every task: n IK seeds per robot and object, at most `keep` new ways each.

        Raises
        ------
        TimeIsUp : the deadline has passed; the ways found until then are kept.
        """
        chains: dict[str, tuple[Attachment, ...]] = {}
        serve = {s.body for o in self.items for s in self.sampler.goal_supports[o]}
        for body in self.root.of:
            if body in serve and body not in self.items:
                chains[body] = self.root.chain(body)
        for item in self.items:
            self._grow_carries(item, chains, n, keep)
            if not any(self.ways.of.get((item, (r,))) for r in self.robots):
                self._grow_handovers(item, chains, n, keep)
            if item in serve:
                if self.ways.plan_placement(item):
                    self._grow_carries(item, chains, n, keep)
                chain = self.ways.settle(self.root, item, chains)
                if chain is not None:
                    chains[item] = chain
        self._chains = chains
        for subgoal in self.problem.subgoals:
            self.sampler.reaching.sample(self.root, subgoal, n, keep)

    @property
    def hands_over(self) -> bool:
        """Whether there are ways with handovers."""
        return any(len(robots) > 1 and known for (_, robots), known in self.ways.of.items())

    def shorten(self, descent: Descent, most: int) -> None:
        """Let up to `most` of the shortest ways of every set with handovers slide along their strata to become shorter.

        A handover has so many dimensions that samples hardly come near a short one; of other ways there are many, and
        their variety is worth more than that each is as short as it can be.

        Raises
        ------
        TimeIsUp : the deadline has passed.
        """
        for (item, robots), known in list(self.ways.of.items()):
            self.deadline.check()
            if len(robots) < 2:
                continue
            fresh = sorted((w for w in known if not w.shortened), key=self.ways.length)[:most]
            for way in fresh:
                way.shortened = True
            if fresh:
                self._shorten(descent, item, fresh)

    def shorten_proposed(self, descent: Descent, proposals: Sequence[Proposal]) -> None:
        """The same for the handovers of some skeletons, between what their robots do before and after."""
        groups: dict[tuple[str, tuple[str, ...]], list[tuple[Way, dict[str, Surroundings]]]] = {}
        for proposal in proposals:
            for way, around in self._in_context(proposal):
                gained = way.stops[0].after
                if gained is not None and len(way.robots) > 1:
                    groups.setdefault((gained.object, way.robots), []).append((way, around))
        for (item, robots), found in groups.items():
            self.deadline.check()
            around = {
                r: Surroundings(
                    *(np.array([getattr(e[r], k) for _, e in found]) for k in ("before", "after", "weight"))
                )
                for r in robots
            }
            self._shorten(descent, item, [way for way, _ in found], around)

    def _in_context(self, proposal: Proposal) -> Iterator[tuple[Way, dict[str, Surroundings]]]:
        """The ways of a proposal with what their robots do before and after; what nobody waits for counts less."""
        ends, slack = self._ends(), self._slack(proposal)
        for way in proposal.ways:
            around = {}
            for r in way.robots:
                course = [k for k, (stop, _) in enumerate(proposal.stops) if r in stop.robots]
                own = [i for i, k in enumerate(course) if proposal.stops[k][1] is way]
                start, end = self.problem.robot(r).start, ends[r]
                first, last = own[0], own[-1] + 1
                before = proposal.stops[course[first - 1]][0].q[r] if first else start
                after = proposal.stops[course[last]][0].q[r] if last < len(course) else end
                motions = [*course[first:last], course[last] if last < len(course) else len(proposal.stops)]
                weight = [max(_UNHURRIED, 1 - slack[r, k] / _SLACK) for k in motions]
                around[r] = Surroundings(
                    before, np.full(len(start), np.nan) if after is None else after, np.array(weight)
                )
            yield way, around

    def _slack(self, proposal: Proposal) -> dict[tuple[str, int], float]:
        """By how much (rad) a robot may be later at a stop, or at the end, before the decoupled schedule takes longer.

        Keys are the robot and the number of the stop; the end has the next number.
        """
        waits, earliest, latest = self._schedule(proposal)
        return {
            (r, k): float(latest[k] - earliest[j] - length)
            for k in range(len(waits))
            for r, j, length in waits[k]
            if r is not None
        }

    def latest(self, proposal: Proposal) -> list[float]:
        """When (rad) every stop has to happen at the latest for the decoupled schedule not to take longer."""
        return self._schedule(proposal)[2][: len(proposal.stops)].tolist()

    def _schedule(self, proposal: Proposal) -> tuple[list[list[tuple[str | None, int, float]]], np.ndarray, np.ndarray]:
        """What every stop and the end wait for (robot, number of a stop, length of the motion from there), and when
        they happen at the earliest and at the latest, if every robot moves straight as if it were alone."""
        stops, n = [stop for stop, _ in proposal.stops], len(proposal.stops)
        waits: list[list[tuple[str | None, int, float]]] = [[(None, j, 0.0) for j in b] for b in proposal.before]
        waits.append([])
        last = {r.name: (-1, r.start) for r in self.problem.robots}
        for k, stop in enumerate(stops):
            for r in stop.robots:
                j, q = last[r]
                waits[k].append((r, j, float(np.linalg.norm(stop.q[r] - q))))
                last[r] = k, stop.q[r]
        for r, end in self._ends().items():
            j, q = last[r]
            waits[n].append((r, j, 0.0 if end is None else float(np.linalg.norm(end - q))))
        # The start is number -1, so that it comes last.
        earliest = np.zeros(n + 2)
        for k in range(n + 1):
            earliest[k] = max((earliest[j] + length for _, j, length in waits[k]), default=0.0)
        latest = np.full(n + 2, earliest[n])
        for k in reversed(range(n + 1)):
            for _, j, length in waits[k]:
                latest[j] = min(latest[j], latest[k] - length)
        return waits, earliest, latest

    def _shorten(
        self,
        descent: Descent,
        item: str,
        fresh: list[Way],
        around: Mapping[str, Surroundings] | None = None,
    ) -> None:
        bases = {body: self.sampler.validity.world_pose(chain) for body, chain in self._chains.items()}
        lengths, stages = descent.shorten(self.root, fresh, bases, item in self.ways.planned, around)
        order = np.argsort(lengths, kind="stable").tolist()
        slid = [[(s.q, s.after) for s in stages[k]] for k in order]
        self.ways.admit(self.root, (item, fresh[0].robots), [fresh[k] for k in order], slid, self._chains, _ADMITTED)

    def _grow_carries(self, item: str, chains: Mapping[str, tuple[Attachment, ...]], n: int, keep: int) -> None:
        for robot in self.robots:
            self.deadline.check()
            if self._worth((item, (robot,))):
                self.ways.carry(self.root, robot, item, chains, n, keep)

    def _grow_handovers(self, item: str, chains: Mapping[str, tuple[Attachment, ...]], n: int, keep: int) -> None:
        for giver in self.robots:
            for receiver in self.robots:
                self.deadline.check()
                pair = (giver, receiver)
                fits = all(self.sampler.families[r, item] for r in pair)
                if giver != receiver and fits and self._worth((item, pair)):
                    self.ways.hand_over(self.root, giver, receiver, item, chains, n, keep)

    def _worth(self, key: tuple[str, tuple[str, ...]]) -> bool:
        """Whether a set of ways should be grown: it has some, or was not tried often, or it is its turn again."""
        fruitless = not self.ways.of.get(key) and self.ways.tries.get(key, 0) >= _TRIES
        return not fruitless or self.rng.random() < 0.1

    # -- tasks ----------------------------------------------------------------------------------------------------

    def _options(self) -> dict[str, list[list[Way]]] | None:
        """Task -> the sets of ways that are its options; None while a task has none."""
        out: dict[str, list[list[Way]]] = {}
        for item in self.items:
            sets = [ways for (o, _), ways in self.ways.of.items() if o == item and ways]
            if not sets:
                return None
            out[item] = [sorted(ways, key=lambda w: w.penalty)[:_MOST] for ways in sets]
        for subgoal in self.problem.subgoals:
            reaching = self._reach_ways(subgoal.name)
            if not reaching:
                return None
            out[subgoal.name] = [reaching]
        return out

    def _reach_ways(self, name: str) -> list[Way]:
        subgoal = self.problem.subgoal(name)
        out = []
        for k, at in enumerate(self.sampler.reaching.stands(name)[:_MOST]):
            if (name, k) not in self._reaching:
                q = {r: self.sampler.roadmaps[r].q[v].copy() for r, v in at.items()}
                stop = Stop("reach", tuple(subgoal.targets), None, None, q, subgoal=name, at=at)
                self._reaching[name, k] = Way((stop,))
            out.append(self._reaching[name, k])
        return out

    def _precedence(self) -> list[tuple[tuple[str, int], tuple[str, int]]]:
        out = []
        for item in self.items:
            for body in {s.body for s in self.sampler.goal_supports[item]} & set(self.items):
                out.append(((body, -1), (item, -1)))
            below = self.root.of[item].parent
            if below in self.items:
                out.append(((item, 0), (below, 0)))
        for subgoal in self.problem.subgoals:
            out += [((before, 0), (subgoal.name, 0)) for before in subgoal.after]
        return out

    def _ends(self) -> dict[str, np.ndarray | None]:
        ends: dict[str, np.ndarray | None] = {r.name: None for r in self.problem.robots}
        return ends | {c.robot: c.q for c in self.problem.goal if isinstance(c, RobotAt)}

    def _option(self, ways: list[Way], penalised: bool, least: float) -> Option:
        """Ways as an option of a task; penalties count by how much they exceed the `least` of all ways of the task."""
        stops = ways[0].stops
        events = tuple(
            Event(s.kind, {r: np.array([w.stops[i].q[r] for w in ways]) for r in s.robots}) for i, s in enumerate(stops)
        )
        constant = self.problem.cost.of_changes(s.kind for s in stops)
        penalty = np.array([w.penalty - least for w in ways]) if penalised else None
        return Option(ways[0].robots, events, constant, penalty)

    def _question(self, sets: Mapping[str, list[list[Way]]], *, penalised: bool) -> tuple:
        """Tasks, precedence, starts, ends and weights, as the search for skeletons and the bound take them."""
        least = {name: min(w.penalty for ways in options for w in ways) for name, options in sets.items()}
        tasks = [Task(n, tuple(self._option(w, penalised, least[n]) for w in options)) for n, options in sets.items()]
        starts = {r.name: r.start for r in self.problem.robots}
        return tasks, self._precedence(), starts, self._ends(), self.problem.cost

    # -- proposals ------------------------------------------------------------------------------------------------

    def propose(self, below: float = np.inf, effort: int = 300, *, hasty: bool = False) -> Iterator[Proposal]:
        """Skeletons whose estimate is less than `below`, cheapest first, those realised before held back a little.

        `effort` bounds the search among orders where they are too many for exact methods.  `hasty`: ways are taken to
        be straight, because it takes time to measure them on the roadmaps.
        """
        sets = self._options()
        if sets is None or not self.applies:
            return
        distance = self._distance(sets)
        found = skeletons(
            *self._question(sets, penalised=True),
            limit=_LIMIT,
            rng=self.rng,
            distance=None if hasty else distance,
            effort=effort,
        )
        found.sort(key=lambda x: x.cost * (1 + _REPEATED * self._realised[x.order]))
        hasty = hasty and distance is not None
        for skeleton in found:
            if skeleton.cost >= min(below, FAR):
                continue
            ways = {name: sets[name][o][m] for name, (o, m) in skeleton.choices.items()}
            stops = tuple((ways[h.task].stops[h.event], ways[h.task]) for h in skeleton.happenings)
            yield Proposal(skeleton, stops, self._before(skeleton, sets), self._realised[skeleton.order], hasty)

    @property
    def has_choice(self) -> bool:
        """Whether there is not just one way for every task."""
        counts = [*self.counts.values(), *(len(self.sampler.reaching.stands(s.name)) for s in self.problem.subgoals)]
        return any(n != 1 for n in counts)

    @property
    def counts(self) -> Counter[str]:
        """How many ways there are to bring every object where it belongs, whoever does it."""
        out = Counter[str](dict.fromkeys(self.items, 0))
        for (item, _), ways in self.ways.of.items():
            out[item] += len(ways)
        return out

    @property
    def kinds(self) -> int:
        """Number of sets of ways that grow: one for every task and the robots that may do it."""
        return len(self.ways.of)

    def _distance(self, sets: Mapping[str, list[list[Way]]]) -> Distance | None:
        """Lengths of roadmap paths where stops are few and stand on the roadmaps; else None: straight lines."""
        ways = [w for options in sets.values() for option in options for w in option]
        stops = [(r, v) for w in ways for s in w.stops for r, v in (s.at or {}).items()]
        if any(s.at is None for w in ways for s in w.stops) or len(stops) > _FEW * len(self.problem.robots):
            return None
        roadmaps = self.sampler.roadmaps
        vertex = {(r, roadmaps[r].q[v].tobytes()): v for r, v in stops}
        for robot in self.problem.robots:
            vertex[robot.name, robot.start.tobytes()] = 0
        for condition in self.problem.goal:
            if isinstance(condition, RobotAt):
                goal = roadmaps[condition.robot].find(condition.q)
                assert goal is not None
                vertex[condition.robot, condition.q.tobytes()] = goal

        def distance(robot: str, A: np.ndarray, B: np.ndarray) -> np.ndarray:
            rows, columns = ([vertex[robot, q.tobytes()] for q in X] for X in (A, B))
            # A robot that takes part in no task has no stops.
            return np.array([self._length(robot, a, b) for a in rows for b in columns]).reshape(len(A), len(B))

        return distance

    def _length(self, robot: str, a: int, b: int) -> float:
        """Length of the shortest roadmap path between two vertices past the static world; infinite without one."""
        if a == b:
            return 0.0
        a, b = min(a, b), max(a, b)
        roadmap, validity = self.sampler.roadmaps[robot], self.sampler.validity
        known = self._lengths.get((robot, a, b))
        if known is None or roadmap.n_vertices > _GROWN * known[0]:
            self.deadline.check()
            roadmap.offer_direct(a, b)
            blocked = validity.blocked(robot, self.root, {})
            path = self.connector.path(
                roadmap,
                a,
                b,
                blocked,
                lambda e: validity.edge(robot, e, self.root),
                _ROUNDS,
                lambda: self.connector.connect(roadmap, self.root, a, b, _TREE),
            )
            length = roadmap.path_length(path) if path else np.inf
            known = self._lengths[robot, a, b] = (roadmap.n_vertices, length)
        return known[1]

    def _before(self, skeleton: Skeleton, sets: Mapping[str, list[list[Way]]]) -> tuple[tuple[int, ...], ...]:
        """What has to happen before every happening: the earlier events of its task, and what precedence says."""
        number = {(h.task, h.event): k for k, h in enumerate(skeleton.happenings)}
        count = {name: len(sets[name][o][m].stops) for name, (o, m) in skeleton.choices.items()}
        before: list[list[int]] = [[number[h.task, h.event - 1]] if h.event else [] for h in skeleton.happenings]
        for (a, i), (b, j) in self._precedence():
            before[number[b, j % count[b]]].append(number[a, i % count[a]])
        return tuple(tuple(x) for x in before)

    def update_bound(self, *, hasty: bool = False) -> None:
        """Compute the least cost over all ways sampled so far; `hasty` as in `propose`: it may be less than that."""
        sets = self._options()
        if sets is None or not self.applies:
            return
        distance = None if hasty else self._distance(sets)
        bound = lower_bound(*self._question(sets, penalised=False), distance=distance)
        self.bound = bound.value if bound.value < FAR else None

    def failed(self, way: Way) -> None:
        """A stop of this way could not be reached, or its transition could not happen."""
        way.failures += 1
        way.penalty += _FAILED

    def refused(self, proposal: Proposal) -> set[Way]:
        """The judge objects to realisations of this; its ways, which seem dearer now."""
        ways = set(proposal.ways)
        for way in ways:
            self.failed(way)
        return ways

    def crowded(self, blame: Mapping[Way, float]) -> None:
        """Robots would collide so much on these ways; those near to them are no better."""
        for way, conflict in blame.items():
            known = self._alternatives(way)
            q, mine = (np.array([w.flat() for w in ways]) for ways in (known, [way]))
            share = np.exp(-((np.linalg.norm(q - mine, axis=1) / _LIKE) ** 2))
            for other, much in zip(known, share.tolist(), strict=True):
                other.penalty += _CROWDED * conflict * much

    def _alternatives(self, way: Way) -> list[Way]:
        """All ways, itself among them, that do the same with the same robots."""
        stop = way.stops[0]
        if stop.subgoal is not None:
            return self._reach_ways(stop.subgoal)
        known = next((ways for ways in self.ways.of.values() if way in ways), [way])
        return [w for w in known if len(w.stops) == len(way.stops)]

    def realised(self, proposal: Proposal) -> None:
        """A proposal became a plan; others get their turn, and this order again when it still seems cheapest."""
        self._realised[proposal.skeleton.order] += 1

    def learn(self, plan: Plan) -> None:
        """Take over the transitions of a refined plan as ways, so that later skeletons may combine them anew."""
        fixed = {b for o in self.items for s in self.sampler.goal_supports[o] for b in (s.body,) if b in self.root.of}
        for item in self.items:
            if item in fixed or any(s.body in self.root.of for s in self.sampler.goal_supports[item]):
                # Solved for one planned placement; those of the plan need not be the same.
                continue
            stops = []
            for segment, transition in zip(plan.segments, plan.transitions, strict=False):
                for a in transition.actions:
                    if a.object == item:
                        q = {r: segment.q[r][-1].copy() for r in a.robots}
                        stops.append(Stop(a.kind, a.robots, a.before, a.after, q))
            way = Way(tuple(stops), shortened=True)
            kinds = [s.kind for s in stops]
            if (kinds, len(way.robots)) not in ((["pick", "place"], 1), (["pick", "handover", "place"], 2)):
                continue
            if stops[0].before is self.root.of[item]:
                self.ways.of.setdefault((item, way.robots), []).append(way)

    # -- realisation ----------------------------------------------------------------------------------------------

    def candidate(self, stop: Stop, mode: Mode) -> Candidate | None:
        """A stop on the roadmaps, for use in `mode`; None where it collides with how things are there."""
        if stop.kind == "reach":
            assert stop.subgoal is not None and stop.at is not None
            return self.sampler.reaching.candidate(mode, self.problem.subgoal(stop.subgoal), stop.at)
        assert stop.before is not None
        if mode.of[stop.before.object] is not stop.before:
            return None
        if stop.candidate is None:
            stop.candidate = self._register(stop, mode)
        return stop.candidate

    def _register(self, stop: Stop, mode: Mode) -> Candidate | None:
        sampler = self.sampler
        assert stop.before is not None and stop.after is not None
        if stop.kind == "handover":
            return sampler.meet(SolvedHandover(stop.before, stop.after, stop.q))
        picks = stop.kind == "pick"
        [robot] = stop.robots
        placement, grasp = (stop.before, stop.after) if picks else (stop.after, stop.before)
        base = mode.chain(placement.parent) if placement.parent in mode.of else ()
        stats = sampler.outcome((stop.kind, stop.robots, placement.object, placement.place))
        v = sampler.contacts.contact(robot, placement, (placement, *base), grasp, stop.q[robot], stats, mode)
        if v is None:
            return None
        stats.accepted += 1
        pick, place = sampler.register(robot, v, placement, grasp, base)
        return pick if picks else place
