"""The anytime loop: modal- and orbit-guided asymptotically optimal MR-TAMP (paper, algorithm 1).

Read `Planner.improve` beside the algorithm; each named step is a method below it, and the geometry lives elsewhere.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from mrtamp.collision import Collision, Counts
from mrtamp.coordination import coordinate
from mrtamp.effort import Effort
from mrtamp.explain import explain
from mrtamp.growth import Growth, Timed
from mrtamp.guidance import Choice, ModalGuidance
from mrtamp.incumbent import Incumbent
from mrtamp.intra_orbit.planners import INTRA_ORBIT
from mrtamp.mechanisms import MECHANISMS
from mrtamp.modes import Mode, start_mode
from mrtamp.plan import Plan, Transition, plan_cost
from mrtamp.portfolio import Portfolio
from mrtamp.problem import MrtampError, Problem
from mrtamp.roadmap import Roadmap
from mrtamp.skeleton_guidance import Proposal, SkeletonGuidance
from mrtamp.tensor_tree import Node
from mrtamp.transitions.candidate import Candidate
from mrtamp.transitions.choices import known_candidates, new_candidates
from mrtamp.transitions.projection import uniform_configurations
from mrtamp.transitions.sampler import TransitionSampler
from mrtamp.validity import Validity

_VISIT = 0.8
"""How much farther a modal state seems for the square root of its visits."""
_PATIENCE = 4
"""Failures of a transition in a mode after which guidance no longer insists on promising candidates."""


_SKELETON_TURN = 4
"""Before the first plan, every so many iterations skeletons have their turn."""
_FIRST_WAYS, _MORE_WAYS = (80, 14), (64, 20)
"""IK seeds, and ways kept, per task and robots: before there is a plan, and later."""
_REALISATIONS = 6
"""Skeletons that are tried at a time."""
_WORTH_ADOPTING = 0.01
"""Relative gain over what the tree has for which a refined plan is put into it."""
_COVER = 3200
"""Initial vertices of a robot with n joints: at least this over the square of n."""
_GROWTH = 1.0
"""Roadmaps grow by at least so many times the square root of their size per iteration: in proportion to their size they
would grow exponentially, and less and less exploration would fit into a second."""
_RAREST = 5
"""Binary logarithm of the longest pause, in iterations, between attempts at skeletons that lead to nothing new."""
_REWIRINGS = 6
"""Steps that may be validated for rewiring per insertion, once there is a plan."""
_QUICK, _THOROUGH = 30, 300
"""Orders evaluated per search for skeletons, before there is a plan and later."""
_RIVALS, _INSERTIONS = 2, 3
"""Skeletons of which the cheapest is refined, and realisations of each that are compared."""
_SKETCHED, _DRAFTS = 4, 3
"""Skeletons that are drafted at a time, and drafts of them that are refined."""
_POOR = 2.0
"""A first realisation that costs so many times what its skeleton promised is not the only one."""
_MANY = 12
"""Stops from which on a realisation takes too long for that."""
_HOPE = 1.0
"""Skeletons are realised while their estimate is less than the incumbent's cost times this."""
_TIE = 0.25
"""Difference of optimistic estimates within which guidance chooses at random."""


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
    refinement_share: float = 0.9
    intra_orbit: str = "tensor-tree"
    without: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if self.intra_orbit not in INTRA_ORBIT:
            raise MrtampError(f"intra_orbit: {self.intra_orbit!r} is unknown; choose from {', '.join(INTRA_ORBIT)}")
        unknown = sorted(self.without - set(MECHANISMS))
        if unknown:
            raise MrtampError(f"without: unknown mechanism {', '.join(unknown)}; choose from {', '.join(MECHANISMS)}")


@dataclass(frozen=True)
class Status:
    """Where the planner stands, for people who wait."""

    phase: str
    iteration: int
    elapsed_s: float
    modes: int
    orbits: int
    nodes: int
    remaining: int
    cost: float | None


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
        self._counts = Counts()
        self.collision = Collision(problem, self._counts)
        radius = max([0.1, *(r for w in self.collision.worlds.values() for r in w.object_radius.values())])
        self.roadmaps = {r.name: Roadmap(self.collision.worlds[r.name], radius) for r in problem.robots}
        self.names = list(self.roadmaps)
        self.validity = Validity(problem, self.collision, self.roadmaps, remember=self._uses("factored-cache"))
        for roadmap in self.roadmaps.values():
            roadmap.inserted = None if self._uses("lazy-validation") else self.validity.insert
        self.sampler = TransitionSampler(problem, self.collision, self.roadmaps, self.validity, self.rng)
        self.growth = Growth(problem, self.roadmaps, self.validity, self.rng, self.options.intra_orbit)
        self.graphs, self.tree = self.growth.graphs, self.growth.tree
        self.guidance = ModalGuidance(problem, self.sampler, self.graphs)
        self.iteration = 0
        self._path: list[int] = []
        self._tree_cost = np.inf
        self._stale = self._skeletons_from = 0
        self._drafting = False
        self.incumbent = Incumbent(problem, seed, self._counts)
        self.incumbent.check_start()
        mode = start_mode(problem)
        self.sampler.remember(mode)
        self.root = self.growth.start(mode)
        for robot in problem.robots:
            # A space of few dimensions is soon covered, and then paths in it are nearly shortest.
            n = robot.start.size
            self._add_interior(robot.name, max(self.options.initial_vertices, _COVER // n**2))
        self.skeletons = SkeletonGuidance(problem, self.sampler, self.guidance, mode)
        self.portfolio = Portfolio(
            problem,
            self.collision,
            self.validity,
            self.roadmaps,
            self.sampler,
            self.incumbent,
            self.rng,
            convex=self._uses("convex-programming"),
            sliding=self._uses("sliding"),
        )
        self._effort = Effort(
            {"search": 0.05, "skeletons": 0.08, "refinement": 0.1},
            {"search": 0.0, "skeletons": 0.1, "refinement": 0.9},
            {"refinement": self.options.refinement_share},
        )
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
        budget_s : seconds of planning in this call.  iterations : iterations in this call.  `None`: no bound.
        first : stop after the first plan.
        progress : called with a `Status` after every iteration.
        """
        self._clock = time.perf_counter() - self._spent
        end = np.inf if budget_s is None else time.perf_counter() + budget_s
        stop = np.inf if iterations is None else self.iteration + iterations
        self._timed = iterations is None
        try:
            while time.perf_counter() < end and self.iteration < stop:
                activity = self._next_activity()
                began, before = time.perf_counter(), self._cost()
                better = {"search": self._search, "skeletons": self._realise_skeletons, "refinement": self._refine}[
                    activity
                ]()
                self.iteration += 1
                work = time.perf_counter() - began if self._timed else 1.0
                if np.isfinite(before):
                    self._effort.record(activity, work, before - self._cost())
                self._spent = self._elapsed()
                if progress is not None:
                    progress(self.status())
                if better:
                    yield self._incumbent()
                    if first:
                        return
        finally:
            self._spent = self._elapsed()

    def _search(self) -> bool:
        """One iteration of the algorithm's loop; whether there is a better plan."""
        orbit, choices = self._guide()
        self._expand_roadmaps()
        candidates = self._sample_transitions(orbit, choices)
        for combination in candidates:
            self._discover_adjacent_orbit(orbit, combination)
        self._extend_tree(orbit, choices, candidates)
        return self._best_solution()

    def _next_activity(self) -> str:
        """Before the first plan search and skeletons in turn; then what is behind its share."""
        skeletons = self._uses("skeletons") and self.skeletons.applies and self.iteration >= self._skeletons_from
        if self.best is None:
            return "skeletons" if skeletons and self.iteration % _SKELETON_TURN == 0 else "search"
        refine = self._uses("refinement") and not self.portfolio.idle(self._to_beat())
        skeletons = skeletons and not (refine and self.portfolio.busy)
        available = ["search", *(["skeletons"] if skeletons else []), *(["refinement"] if refine else [])]
        return self._effort.next(available)

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

    # -- guidance -------------------------------------------------------------------------------------------------

    def _guide(self) -> tuple[int, list[Choice]]:
        """Orbit to work in and the elementary transitions Gamma to sample there (one per robot, disjoint)."""
        explore = self.rng.random() < self.options.persistent
        along = self.best is not None and self._uses("orbit-path-guidance") and self.rng.random() < 0.5
        modal = self._uses("modal-guidance")
        if explore or not (along or modal):
            orbit = self._any_orbit()
        elif along:
            orbit = self._orbit_path_guidance()
        else:
            orbit = self._modal_frontier()
        self.graphs.orbital.nodes[orbit]["visits"] += 1
        mode = self.graphs.mode(orbit)
        self.graphs.modal.nodes[mode.state]["visits"] += 1
        if explore or not modal:
            return orbit, self.guidance.feasible_sets(mode, self.rng)
        return orbit, self._optimistic_choices(mode)

    def _any_orbit(self) -> int:
        """A living orbit, drawn uniformly from all or from those of a modal state that is drawn first.

        Orbits grow in number for ever and so does, slowly, the count of draws of each; modal states are finitely many,
        and so is what can be done in them: that keeps its share.
        """
        known = [[o for o in orbits if self.tree.of_orbit.get(o)] for orbits in self.graphs.orbits_of.values()]
        known = [orbits for orbits in known if orbits]
        if self.rng.random() < 0.5:
            known = [[o for orbits in known for o in orbits]]
        orbits = known[int(self.rng.integers(len(known)))]
        return orbits[int(self.rng.integers(len(orbits)))]

    def _modal_frontier(self) -> int:
        """The orbit of the modal state that is optimistically nearest to the goal, visits held against it."""
        best, chosen = np.inf, 0
        for state, known in self.graphs.orbits_of.items():
            orbits = [o for o in known if self.tree.of_orbit.get(o)]
            if not orbits:
                continue
            visits = self.graphs.modal.nodes[state]["visits"]
            orbit = min(orbits, key=lambda o: self.graphs.orbital.nodes[o]["visits"])
            score = self.guidance.remaining(self.graphs.mode(orbit)) + _VISIT * np.sqrt(visits)
            if score <= best:
                best, chosen = score, orbit
        return chosen

    def _orbit_path_guidance(self) -> int:
        """An orbit on the incumbent's path."""
        path = [o for o in {self.graphs.find(o): None for o in self._path} if self.tree.of_orbit.get(o)]
        return path[int(self.rng.integers(len(path)))] if path else self._modal_frontier()

    def _optimistic_choices(self, mode: Mode) -> list[Choice]:
        """A transition of those that are optimistically best."""
        proposals = self.guidance.proposals(mode)
        if not proposals:
            return []
        least = proposals[0][0]
        ties = [c for score, c in proposals if score <= least + _TIE]
        # Whoever acted longest ago acts next: alternating robots can move at the same time later on.
        last = self._last_actions(mode)
        oldest = min(max(last.get(r, -1) for r in c.robots) for c in ties)
        ties = [c for c in ties if max(last.get(r, -1) for r in c.robots) == oldest]
        return [ties[int(self.rng.integers(len(ties)))]]

    def _last_actions(self, mode: Mode) -> dict[str, int]:
        """When each robot last acted on the way to `mode`, counted in transitions."""
        node = self.tree.entry(mode)
        if node is None:
            return {}
        actions = [x.transition for x in self.tree.branch(node) if x.transition is not None]
        return {r: i for i, t in enumerate(actions) for r in t.active}

    def _still_best(self, mode: Mode, choice: Choice) -> bool:
        proposals = self.guidance.proposals(mode)
        return any(c == choice and score <= proposals[0][0] + _TIE for score, c in proposals)

    # -- sampling -------------------------------------------------------------------------------------------------

    def _expand_roadmaps(self) -> None:
        """SampleOrbitInterior and ExpandRoadmaps: every constituent roadmap keeps growing."""
        for name in self.names:
            grown = int(_GROWTH * np.sqrt(self.roadmaps[name].n_vertices))
            self._add_interior(name, max(self.options.interior_samples, grown))

    def _add_interior(self, name: str, n: int) -> None:
        """n samples; half uniform, half around known vertices, where passages matter most; free ones are kept."""
        roadmap = self.roadmaps[name]
        world = roadmap.world
        q = uniform_configurations(world.tool, self.rng, n)
        known = roadmap.q[self.rng.integers(roadmap.n_vertices, size=n)]
        near = np.clip(known + self.rng.normal(scale=0.4, size=q.shape), world.chain.lower, world.chain.upper)
        q = np.where(self.rng.random(n)[:, None] < 0.5, q, near)
        for x in q[~world.hits(world.rows(q, None, {}))]:
            roadmap.add_vertex(x)

    def _sample_transitions(self, orbit: int, choices: list[Choice]) -> list[tuple[Candidate, ...]]:
        """SampleTransitions: new candidates for every choice, combined into simultaneous transitions of A."""
        mode = self.graphs.mode(orbit)
        lists = []
        for choice in choices:
            failed = self.guidance.failed(mode, choice)
            guided = len(choices) == 1 and failed < _PATIENCE
            known = known_candidates(self.sampler, mode, choice)
            if guided:
                known = [c for c in known if c.promising and not (self.best is None and self.growth.taken(mode, c))]
            # Grow the set while it is small, later in step with its logarithm, for ever.
            if len(known) < 4 or self.best is not None or self.rng.random() < 0.3 + self.options.persistent:
                known = [
                    *(
                        c
                        for c in new_candidates(self.sampler, mode, choice, self.options.transition_samples)
                        if c.promising or not guided
                    ),
                    *known,
                ]
            if guided and not self._still_best(mode, choice):
                # What the sampler saw ahead changed the estimate: better to act on that.
                return []
            if not known:
                self.guidance.record(mode, choice, success=False)
                return []
            lists.append(known)
        if not lists:
            return []
        out = []
        for _ in range(self.options.extensions):
            pick = tuple(x[self._low_index(len(x))] for x in lists)
            if pick not in out:
                out.append(pick)
        return out

    def _low_index(self, n: int) -> int:
        """An index below n, earlier ones more likely."""
        return int(min(n - 1, self.rng.geometric(0.35) - 1))

    def _discover_adjacent_orbit(self, orbit: int, combination: tuple[Candidate, ...]) -> None:
        """Note the modal state that a sampled transition leads to."""
        mode = self.graphs.mode(orbit)
        self.graphs.discover(_after(mode, combination).state, mode.state)

    # -- tree -----------------------------------------------------------------------------------------------------

    def _extend_tree(self, orbit: int, choices: list[Choice], candidates: list[tuple[Candidate, ...]]) -> None:
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

    def _realise_skeletons(self) -> bool:
        """Grow the sets of ways and realise the cheapest skeletons that may beat the incumbent, until one succeeds."""
        first = self.best is None
        if not first:
            self._expand_roadmaps()
        self.skeletons.grow(*(_FIRST_WAYS if first else _MORE_WAYS))
        self.skeletons.update_bound()
        if not first and self._uses("drafts") and self.portfolio.convex and self._draft():
            return False
        tries = 0
        while tries < _REALISATIONS:
            failed: set[int] = set()
            inserted: list[tuple[float, Timed, Proposal]] = []
            for proposal in self.skeletons.propose(_HOPE * self._to_beat(), _QUICK if first else _THOROUGH):
                if failed & {id(way) for _, way in proposal.stops}:
                    # The guidance has learnt something about these since.
                    continue
                tries += 1
                best = self._cheapest_insertion(proposal)
                if best is not None:
                    inserted.append((*best, proposal))
                    if first or len(inserted) == _RIVALS:
                        break
                    continue
                node = self.growth.realise(proposal, self.skeletons, self.root)
                if node is not None:
                    self.skeletons.realised(proposal)
                    return self._solution(node)
                failed = {id(way) for _, way in proposal.stops if way.failures}
                if tries >= _REALISATIONS:
                    break
            # An order of events that is under refinement already has had its chance.
            for _, timed, proposal in sorted(inserted, key=lambda x: (self.portfolio.knows(x[1][1]), x[0])):
                plan = self.incumbent.accepted(*timed)
                if plan is not None:
                    self.skeletons.realised(proposal)
                    return self._adopt(plan)
            if not failed:
                return False
        return False

    def _draft(self) -> bool:
        """Every other time, put the cheapest skeletons under refinement as they are; whether there was a new one.

        Each robot is scheduled as if it were alone: where the others let it pass after some pushing and pulling, that
        costs little more than the skeleton promised.
        """
        self._drafting = not self._drafting
        if not self._drafting:
            return False
        drafts = []
        for proposal in itertools.islice(self.skeletons.propose(_HOPE * self._to_beat(), _THOROUGH), _SKETCHED):
            self.skeletons.realised(proposal)
            timed = self.growth.insert(proposal, self.skeletons, self.root, alone=True)
            drafts += [timed] if timed is not None else []
        return self.portfolio.add_drafts(drafts, _DRAFTS) > 0

    def _cheapest_insertion(self, proposal: Proposal) -> tuple[float, Timed] | None:
        """The cheapest of several realisations of a skeleton in space and time, with its cost; None if the first fails.

        They differ by chance, and what starts cheaper usually ends cheaper: far less work than refining all of them.
        Before there is a plan, more than one is tried only where that is quick and the first far dearer than promised.
        """
        best: tuple[float, Timed] | None = None
        for k in range(_INSERTIONS):
            timed = self.growth.insert(proposal, self.skeletons, self.root, varied=k > 0)
            if timed is not None:
                cost = plan_cost(*timed, self.problem.cost)
                if best is None or cost < best[0]:
                    best = cost, timed
            good = best is not None and best[0] < _POOR * proposal.skeleton.cost
            if best is None or (self.best is None and (good or len(proposal.stops) > _MANY)):
                break
        return best

    def _adopt(self, plan: Plan) -> bool:
        """A checked plan that the tree does not have yet: into the tree, and under refinement."""
        better = self._offer(plan)
        if self._found(plan) and self._uses("adoption"):
            self._graft(plan)
        return better

    def _found(self, plan: Plan) -> bool:
        """There is a plan: it is refined, and from now on the tree is rewired; whether it is a new one."""
        new = not self._uses("refinement") or self.portfolio.add(plan)
        # Skeletons that only lead to known plans are asked for ever more rarely.
        self._stale = 0 if new else min(self._stale + 1, _RAREST)
        self._skeletons_from = self.iteration + 2**self._stale
        if self._uses("rewiring"):
            self.growth.orbits.rewirings = _REWIRINGS
        return new

    def _graft(self, plan: Plan) -> None:
        """Put a checked plan into the roadmaps and the tree; guidance follows its orbits from now on."""
        node = self.growth.adopt(plan.segments, plan.transitions, self.root)
        self._tree_cost = min(self._tree_cost, node.cost)
        self._path = list(dict.fromkeys(x.orbit for x in self.tree.branch(node)))

    # -- solutions ------------------------------------------------------------------------------------------------

    def _best_solution(self) -> bool:
        """Extract the cheapest plan of the tree when it beats what the tree gave before."""
        while True:
            growth = self.growth
            growth.goal_nodes = [n for n in growth.goal_nodes if n.alive]
            node = min(growth.goal_nodes, key=lambda n: n.cost, default=None)
            if node is None or node.cost >= self._tree_cost - 1e-9:
                return False
            cost = node.cost
            if self._solution(node):
                self._tree_cost = cost
                if node.alive:
                    growth.without_detours(self.root, node)
                return True
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
        better = self._offer(plan)
        if better:
            self._path = [g[0].orbit for g in groups]
        self._found(plan)
        return better

    def _refine(self) -> bool:
        """Give refinement its turn; whether there is a better plan."""
        plan = self.portfolio.improve(self._to_beat())
        better = plan is not None and self._offer(plan)
        for settled in self.portfolio.settled() if self._uses("adoption") else []:
            self.skeletons.learn(settled)
            if settled.cost < self._tree_cost * (1 - _WORTH_ADOPTING):
                self._graft(settled)
        return better

    # -- reports --------------------------------------------------------------------------------------------------

    def status(self) -> Status:
        """A snapshot for progress displays."""
        nearest = min(self.modes(), key=self.guidance.remaining, default=None) if self.best is None else None
        remaining = self.guidance.transitions_to_go(nearest) if nearest is not None else 0
        return Status(
            phase="first plan" if self.best is None else "improving",
            iteration=self.iteration,
            elapsed_s=self._spent,
            modes=len(self.graphs.modal),
            orbits=len(self.graphs.orbital),
            nodes=len(self.tree.nodes),
            remaining=remaining,
            cost=self.best.cost if self.best else None,
        )

    def modes(self) -> Iterator[Mode]:
        """One discovered mode per modal state."""
        for orbits in self.graphs.orbits_of.values():
            if orbits:
                yield self.graphs.mode(orbits[0])

    @property
    def sampled_bound(self) -> float | None:
        """No plan over the transitions sampled so far costs less; None where skeletons say nothing."""
        return self.skeletons.bound

    def counts(self) -> dict[str, int]:
        """What was done, in numbers that do not depend on the machine: collision checks, IK calls and more."""
        return {**self._counts.as_dict(), "ik_calls": self._counts.ik_attempts}

    @property
    def trouble(self) -> Mapping[tuple[str, str], int]:
        """(robot, what was in its way) -> number of motions that failed for it."""
        return self.growth.motion.trouble

    def explain(self) -> str:
        """Why there is no plan yet: per stratum what was tried and what stopped it, and who blocked whose motion."""
        return explain(self)


def _after(mode: Mode, combination: tuple[Candidate, ...]) -> Mode:
    """The mode to which a simultaneous transition leads."""
    return mode.after(Transition(tuple(c.action for c in combination)))
