"""The anytime loop: modal- and orbit-guided asymptotically optimal MR-TAMP (paper, algorithm 1).

Read `Planner.improve` and `Planner._search` beside the algorithm.  Its steps have their names here, in `orbit_guidance`
(where to work), in `orbit_sampling` (what to sample) and in `growth` (the tree); the geometry lives elsewhere.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from mrtamp.collision import Collision, Counts
from mrtamp.coordination import coordinate
from mrtamp.deadline import Deadline, TimeIsUp
from mrtamp.effort import Effort
from mrtamp.explain import explain
from mrtamp.growth import Combination, Growth
from mrtamp.guidance import Choice, ModalGuidance
from mrtamp.incumbent import Incumbent
from mrtamp.intra_orbit.planners import INTRA_ORBIT
from mrtamp.mechanisms import check_without
from mrtamp.modes import Mode, start_mode
from mrtamp.optimise.descent import Descent
from mrtamp.orbit_guidance import OrbitGuidance
from mrtamp.orbit_sampling import OrbitSampling
from mrtamp.plan import Plan, Transition
from mrtamp.portfolio import Portfolio
from mrtamp.problem import MrtampError, Problem
from mrtamp.realisation import Realisation
from mrtamp.roadmap import roadmaps_of
from mrtamp.skeleton_guidance import SkeletonGuidance
from mrtamp.status import Status, status_of
from mrtamp.tensor_tree import Node
from mrtamp.transitions.sampler import TransitionSampler
from mrtamp.validity import Validity

_SKELETON_TURN = 4
"""Before the first plan, every so many iterations skeletons have their turn."""
_AHEAD = 1.0
"""Work (s, or iterations where these bound a run) that skeletons may have had beyond search's before the first plan."""
_CLEARLY = 0.02
"""Relative gain that makes it another plan."""
_WORTH_ADOPTING = 0.01
"""Relative gain over what the tree has for which a refined plan is put into it."""
_RAREST = 5
"""Binary logarithm of the longest pause, in iterations, between attempts at skeletons that lead to nothing new."""
_REWIRINGS = 6
"""Steps that may be validated for rewiring per insertion, once there is a plan."""


@dataclass(frozen=True)
class Options:
    """Settings of the planner.

    initial_vertices : free configurations per robot on the roadmaps before the search starts.
    interior_samples : N_m, roadmap samples per iteration.  transition_samples : N_t, IK seeds per stratum and
    iteration.
    extensions : candidates the tree is extended to per iteration.
    persistent : share of iterations that ignore guidance, for ever.
    refinement_share : largest share of the time after the first plan that refinement may take.
    intra_orbit : name of the planner of motion inside an orbit, see `INTRA_ORBIT`.
    without : names of mechanisms (see `MECHANISMS`) that are switched off.
    """

    initial_vertices: int = 40
    interior_samples: int = 4
    transition_samples: int = 48
    extensions: int = 3
    persistent: float = 0.1
    refinement_share: float = 0.95
    intra_orbit: str = "tensor-tree"
    without: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if self.intra_orbit not in INTRA_ORBIT:
            raise MrtampError(f"intra_orbit: {self.intra_orbit!r} is unknown; choose from {', '.join(INTRA_ORBIT)}")
        check_without("guided", self.without)


class Planner:
    """Plans one problem; keeps everything it learnt between calls of `improve`.

    Parameters
    ----------
    problem : what to plan.
    seed : of the only random generator; runs bounded by iterations are identical to the last bit for equal seeds.
    options : settings.

    Raises
    ------
    MrtampError : the start is not valid (a collision, an object that floats) or a model cannot be used.
    """

    def __init__(self, problem: Problem, *, seed: int = 0, options: Options | None = None) -> None:
        self.problem = problem
        self.seed = seed
        self.options = options or Options()
        self._clock = time.perf_counter()
        self._spent = 0.0
        self.rng = np.random.default_rng(seed)
        self.deadline = Deadline()
        self._counts = Counts()
        self.collision = Collision(problem, self._counts)
        self.roadmaps = roadmaps_of(problem, self.collision)
        self.names = list(self.roadmaps)
        self.validity = Validity(problem, self.collision, self.roadmaps, remember=self._uses("factored-cache"))
        for roadmap in self.roadmaps.values():
            roadmap.inserted = None if self._uses("lazy-validation") else self.validity.insert
        self.sampler = TransitionSampler(problem, self.collision, self.roadmaps, self.validity, self.rng)
        self.growth = Growth(problem, self.roadmaps, self.validity, self.rng, self.options.intra_orbit, self.deadline)
        self.growth.steering.shorter = self._uses("shorter-paths")
        self.graphs, self.tree = self.growth.graphs, self.growth.tree
        self.guidance = ModalGuidance(problem, self.sampler, self.graphs)
        self.orbit_guidance = OrbitGuidance(
            self.graphs,
            self.tree,
            self.guidance,
            self.rng,
            persistent=self.options.persistent,
            by_mode=self._uses("modal-guidance"),
            along_path=self._uses("orbit-path-guidance"),
        )
        self.sampling = OrbitSampling(
            self.roadmaps,
            self.sampler,
            self.orbit_guidance,
            self.growth,
            self.rng,
            interior_samples=self.options.interior_samples,
            transition_samples=self.options.transition_samples,
            combinations=self.options.extensions,
            persistent=self.options.persistent,
        )
        self.iteration = 0
        self._tree_cost = np.inf
        self._stale = self._skeletons_from = 0
        self._challenged = np.inf
        self.incumbent = Incumbent(problem, seed, self._counts)
        self.incumbent.check_start()
        mode = start_mode(problem)
        self.sampler.remember(mode)
        self.root = self.growth.start(mode)
        self.sampling.cover(self.options.initial_vertices)
        self.skeletons = SkeletonGuidance(problem, self.sampler, self.guidance, mode, self.deadline)
        self.portfolio = Portfolio(
            problem,
            self.validity,
            self.sampler,
            self.incumbent,
            self.rng,
            deadline=self.deadline,
            convex=self._uses("convex-programming"),
            sliding=self._uses("sliding"),
            local=self._uses("local-search"),
        )
        self.realisation = Realisation(
            self.growth,
            self.skeletons,
            self.incumbent,
            self.portfolio,
            self.root,
            self._to_beat,
            self._offer,
            descent=Descent(self.sampler, self.portfolio.nearness) if self._uses("way-descent") else None,
            drafts=self._uses("drafts"),
            refining=self._uses("refinement"),
        )
        self._effort = Effort(
            {"search": 0.05, "skeletons": 0.25, "refinement": 0.1},
            {"search": 0.0, "skeletons": 0.1, "refinement": 0.9},
            {"refinement": self.options.refinement_share},
        )
        # Work before the first plan.
        self._tried = dict.fromkeys(("search", "skeletons"), 0.0)
        self._timed = True
        self.bound: Callable[[], float] = lambda: np.inf
        """Cost of a plan that is known elsewhere; what does not promise to beat it is not worked on."""
        self._spent = time.perf_counter() - self._clock

    @property
    def best(self) -> Plan | None:
        """The incumbent: the cheapest plan so far, checked; None before there is one."""
        return self.incumbent.best

    # -- Algorithm 1 ----------------------------------------------------------------------------------------------

    def improve(
        self,
        budget_s: float | None = None,
        *,
        iterations: int | None = None,
        first: bool = False,
        progress: Callable[[Status], None] | None = None,
    ) -> Iterator[Plan]:
        """Search, yielding every better plan once it has been checked.

        Parameters
        ----------
        budget_s : seconds of planning in this call; what is under way then is abandoned within a fraction of a second.
        iterations : iterations in this call.  `None`: no bound.
        first : stop after the first plan.  A plan of cost 0 ends every call: none is better.
        progress : called with a `Status` after every iteration.
        """
        self._clock = time.perf_counter() - self._spent
        self.deadline.set(budget_s)
        stop = np.inf if iterations is None else self.iteration + iterations
        self._timed = iterations is None
        activities = {"search": self._search, "skeletons": self._realise_skeletons, "refinement": self._refine}
        try:
            while not self.deadline.passed and self.iteration < stop and self._to_beat() > 0:
                activity = self._next_activity()
                began, before = time.perf_counter(), self._cost()
                # What refinement is about to find anyway is no gain of others.
                expected = before if activity == "refinement" else min(before, self.portfolio.outlook)
                with suppress(TimeIsUp):
                    activities[activity]()
                self.iteration += 1
                work = time.perf_counter() - began if self._timed else 1.0
                if np.isfinite(before):
                    gain = max(expected - self._cost(), 0.0)
                    self._effort.record(activity, work, gain)
                    if activity == "refinement" and self.portfolio.drafted:
                        # Without the draft there would be nothing to refine: half of the gain is theirs.
                        self._effort.record("skeletons", 0.0, gain / 2)
                else:
                    self._tried[activity] += work
                self._spent = self._elapsed()
                if progress is not None:
                    progress(self.status())
                if self._cost() < before:
                    yield self._incumbent()
                    if first:
                        return
        finally:
            self._spent = self._elapsed()

    def _search(self) -> None:
        """One iteration of the algorithm's loop."""
        orbit, choices = self.orbit_guidance.choose(improving=self.best is not None)
        self.sampling.expand_roadmaps()
        mode = self.graphs.mode(orbit)
        candidates = self.sampling.sample_transitions(mode, choices, improving=self.best is not None)
        for combination in candidates:
            self._discover_adjacent_orbit(mode, combination)
        self._extend_tree(orbit, choices, candidates)
        self._best_solution()

    def _discover_adjacent_orbit(self, mode: Mode, combination: Combination) -> None:
        """Note the modal state that a sampled transition leads to."""
        after = mode.after(Transition(tuple(c.action for c in combination)))
        self.graphs.discover(after.state, mode.state)

    def _next_activity(self) -> str:
        """Before the first plan search and skeletons in turn; then what is behind its share."""
        skeletons = self._uses("skeletons") and self.skeletons.applies and self.iteration >= self._skeletons_from
        if self.best is None:
            # Attempts that take long, and fail, leave search its half of the time.
            turn = self.iteration % _SKELETON_TURN == 0 and self._tried["skeletons"] <= self._tried["search"] + _AHEAD
            return "skeletons" if skeletons and turn else "search"
        to_beat = self._to_beat()
        refine = self._uses("refinement") and not self.portfolio.idle(to_beat)
        busy = refine and self.portfolio.busy(to_beat)
        if refine and not self.skeletons.has_choice:
            # Others would only be other motions of the same ways: they wait until those there are have converged.
            skeletons = skeletons and not self._one_at_a_time()
            busy = busy or self.portfolio.nearing(to_beat)
        elif skeletons and refine and (self.realisation.undrafted or self._poor(to_beat)):
            return "skeletons"
        available = [
            "search",
            *(["skeletons"] if skeletons and not busy else []),
            *(["refinement"] if refine else []),
        ]
        return self._effort.next(available, eager="refinement" if busy else None)

    def _poor(self, to_beat: float) -> bool:
        """Whether a plan has just converged far above what skeletons promise: once per plan, others come first."""
        if to_beat > (1 - _CLEARLY) * self._challenged or not self.portfolio.poor(to_beat, self.skeletons.bound):
            return False
        self._challenged = to_beat
        return True

    def _one_at_a_time(self) -> bool:
        """Whether other motions of the same ways wait for those under refinement to converge."""
        bound = self.skeletons.bound or np.inf
        return not self.skeletons.has_choice and self.portfolio.converging(self._to_beat(), bound)

    def _uses(self, mechanism: str) -> bool:
        return mechanism not in self.options.without

    def _cost(self) -> float:
        return self.best.cost if self.best is not None else np.inf

    def _to_beat(self) -> float:
        return min(self._cost(), self.bound())

    def _incumbent(self) -> Plan:
        assert self.best is not None
        return self.best

    def _offer(self, plan: Plan) -> bool:
        """Make a checked plan the incumbent if it is cheaper; the modal graph then has its states."""
        if not self.incumbent.offer(plan, self._elapsed()):
            return False
        for one, two in itertools.pairwise(plan.segments):
            self.graphs.discover(one.mode.state)
            self.graphs.discover(two.mode.state, one.mode.state)
        return True

    def _elapsed(self) -> float:
        """Seconds spent planning, over all calls."""
        return time.perf_counter() - self._clock

    # -- tree -----------------------------------------------------------------------------------------------------

    def _extend_tree(self, orbit: int, choices: list[Choice], candidates: list[Combination]) -> None:
        """Extend the tensor tree: towards the sampled transitions, towards the goal, and at random."""
        orbit = self.graphs.find(orbit)
        mode = self.graphs.mode(orbit)
        reached = False
        for combination in candidates:
            near = self._select_tensor_node(orbit)
            if near is None:
                return
            if self.growth.towards(near, combination):
                reached = True
                if self.best is None:
                    break
        if candidates:
            for choice in choices:
                self.guidance.record(mode, choice, reached)
        near = self._select_tensor_node(orbit)
        if near is not None and self.growth.goal_vertices and self.growth.is_goal_mode(mode):
            self.growth.towards_goal(near)
        if self.rng.random() < self.options.persistent:
            node = self._select_tensor_node(orbit, uniform=True)
            for _ in range(4):
                if node is not None:
                    node = self.growth.motion.explore(node)

    def _select_tensor_node(self, orbit: int, uniform: bool = False) -> Node | None:
        """A node of the orbit: usually the one it was entered by at the least cost, else any."""
        nodes = self.tree.of_orbit.get(orbit)
        if not nodes:
            return None
        if uniform or self.rng.random() < self.options.persistent:
            return nodes[int(self.rng.integers(len(nodes)))]
        return min(nodes, key=lambda x: x.cost)

    # -- skeletons ------------------------------------------------------------------------------------------------

    def _realise_skeletons(self) -> None:
        """Let the cheapest skeletons that may beat the incumbent have their turn."""
        if self.best is not None:
            self.sampling.expand_roadmaps()
        found = self.realisation.attempt()
        if isinstance(found, Node):
            self._solution(found)
        elif found is not None:
            self._adopt(found)

    def _adopt(self, plan: Plan) -> None:
        """A checked plan that the tree does not have yet: into the tree, and under refinement."""
        self._offer(plan)
        if self._found(plan) and self._uses("adoption"):
            self._graft(plan)

    def _found(self, plan: Plan, *, similar: bool = False) -> bool:
        """There is a plan: it is refined, and from now on the tree is rewired; whether it is a new one."""
        self.portfolio.suit(choice=self.skeletons.has_choice)
        new = not self._uses("refinement") or self.portfolio.add(plan, similar=similar)
        # Skeletons that only lead to known plans are asked for ever more rarely.
        self._stale = 0 if new else min(self._stale + 1, _RAREST)
        self._skeletons_from = self.iteration + 2**self._stale
        self.growth.steering.thorough = True
        if self._uses("rewiring"):
            self.growth.orbits.rewirings = _REWIRINGS
        return new

    def _graft(self, plan: Plan) -> None:
        """Put a checked plan into the roadmaps and the tree; guidance follows its orbits from now on."""
        node = self.growth.adopt(plan.segments, plan.transitions, self.root)
        self._tree_cost = min(self._tree_cost, node.cost)
        self.orbit_guidance.path = list(dict.fromkeys(x.orbit for x in self.tree.branch(node)))

    # -- solutions ------------------------------------------------------------------------------------------------

    def _best_solution(self) -> None:
        """Extract the cheapest plan of the tree when it beats what the tree gave before."""
        if self.best is not None and self._one_at_a_time():
            # It would only be another motion of the same ways.
            return
        while True:
            growth = self.growth
            growth.goal_nodes = [n for n in growth.goal_nodes if n.alive]
            node = min(growth.goal_nodes, key=lambda n: n.cost, default=None)
            if node is None or node.cost >= self._tree_cost - 1e-9:
                return
            cost = node.cost
            if self._solution(node):
                self._tree_cost = cost
                if node.alive:
                    growth.without_detours(self.root, node)
                return
            if node.alive:
                self._tree_cost = cost

    def _solution(self, node: Node) -> bool:
        """Have a solution of the tree shortened and judged, and put it under refinement; whether it is the best yet."""
        segments, transitions, groups = self.tree.trace(node)
        plan = None
        if self._uses("coordination"):
            # Judged as a whole; what slips between its samples does not count against the tree's own steps.
            timed = coordinate(segments, transitions, self.collision, self.validity)
            plan = self.incumbent.accepted(timed, transitions)
        if plan is None:
            plan = self.incumbent.plan(segments, transitions)
            report = self.incumbent.judge(plan)
            if not report.ok:
                branch = self.tree.branch(node)
                self.growth.repair(report, groups)
                if node.alive and self.tree.branch(node) == branch:
                    # Whatever is wrong is not a step that could be withdrawn.
                    self.growth.orbits.remove(node)
                return False
        if self.best is None:
            plan = self.realisation.presentable(plan)
        better = self._offer(plan)
        if better:
            self.orbit_guidance.path = [g[0].orbit for g in groups]
        self._found(plan, similar=True)
        return better

    def _refine(self) -> None:
        """Give refinement its turn."""
        plan = self.portfolio.improve(self._to_beat(), self.skeletons.bound)
        if plan is not None:
            self._offer(plan)
        for settled in self.portfolio.settled() if self._uses("adoption") else []:
            self.skeletons.learn(settled)
            if settled.cost < self._tree_cost * (1 - _WORTH_ADOPTING):
                self._graft(settled)

    # -- reports --------------------------------------------------------------------------------------------------

    def status(self) -> Status:
        """A snapshot for progress displays."""
        return status_of(self, len(self.tree.nodes), self._spent)

    def modes(self) -> Iterator[Mode]:
        """One discovered mode per modal state."""
        for orbits in self.graphs.orbits_of.values():
            if orbits:
                yield self.graphs.mode(orbits[0])

    @property
    def sampled_bound(self) -> float | None:
        """No plan over the transitions sampled so far costs less; None where skeletons say nothing."""
        return self.skeletons.bound or None

    def counts(self) -> dict[str, int]:
        """What was done, in numbers that do not depend on the machine: collision checks, IK calls and more."""
        return self._counts.work()

    @property
    def trouble(self) -> Mapping[tuple[str, str], int]:
        """(robot, what was in its way) -> number of motions that failed for it."""
        return self.growth.motion.trouble

    def explain(self) -> str:
        """Why there is no plan yet: per stratum what was tried and what stopped it, and who blocked whose motion."""
        return explain(self)
