"""The anytime loop: modal- and orbit-guided asymptotically optimal MR-TAMP (paper, algorithm 1).

Read `Planner.improve` beside the algorithm; each named step is a method below it, and the geometry lives elsewhere.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from mrtamp.check import Report
from mrtamp.check_report import Violation
from mrtamp.collision import Collision, Counts
from mrtamp.explain import explain
from mrtamp.graphs import Graphs
from mrtamp.guidance import Choice, ModalGuidance
from mrtamp.incumbent import Incumbent
from mrtamp.modes import Mode, goal_mode, start_mode
from mrtamp.plan import Plan, Transition, without_detours
from mrtamp.portfolio import Portfolio
from mrtamp.problem import MrtampError, Problem, RobotAt
from mrtamp.refine import Refiner
from mrtamp.roadmap import Roadmap
from mrtamp.steering import Steering
from mrtamp.tensor_tree import At, Node, TensorTree
from mrtamp.transitions.candidate import Candidate
from mrtamp.transitions.projection import uniform_configurations
from mrtamp.transitions.sampler import TransitionSampler
from mrtamp.validity import Validity

_VISIT = 0.8
"""How much farther a modal state seems for the square root of its visits."""
_PATIENCE = 4
"""Failures of a transition in a mode after which guidance no longer insists on promising candidates."""


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
    refinements : proposals of refinement per iteration, once there is a plan; 0 leaves the tree's plans as they are.
    """

    initial_vertices: int = 40
    interior_samples: int = 4
    transition_samples: int = 48
    extensions: int = 3
    persistent: float = 0.1
    refinements: int = 60


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
        self.counts = Counts()
        self.collision = Collision(problem, self.counts)
        radius = max([0.1, *(r for w in self.collision.worlds.values() for r in w.object_radius.values())])
        self.roadmaps = {r.name: Roadmap(self.collision.worlds[r.name], radius) for r in problem.robots}
        self.names = list(self.roadmaps)
        self.validity = Validity(problem, self.collision, self.roadmaps)
        self.sampler = TransitionSampler(problem, self.collision, self.roadmaps, self.validity, self.rng)
        self.graphs = Graphs()
        self.guidance = ModalGuidance(problem, self.sampler, self.graphs)
        self.tree = TensorTree(list(self.roadmaps.values()), problem.cost)
        self.steering = Steering(list(self.roadmaps.values()), self.validity, self._insert, self.rng)
        self.iteration = 0
        self._goal_vertices: dict[str, int] = {}
        self._goal_nodes: list[Node] = []
        self._path: list[int] = []
        self._tree_cost = np.inf
        self._solution: Node | None = None
        self._banned: set[tuple] = set()
        self.incumbent = Incumbent(problem, seed, self.counts)
        self._portfolio = Portfolio(
            self._refiner,
            lambda refiner: self.incumbent.plan(refiner.segments(), refiner.transitions),
            lambda plan: self.incumbent.judge(plan).ok,
        )
        self._start()
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
        try:
            while time.perf_counter() < end and self.iteration < stop:
                orbit, choices = self._guide()
                self._expand_roadmaps(orbit)
                candidates = self._sample_transitions(orbit, choices)
                for combination in candidates:
                    self._discover_adjacent_orbit(orbit, combination)
                self._extend_tree(orbit, choices, candidates)
                self.iteration += 1
                found = self._best_solution()
                self._spent = self._elapsed()
                if progress is not None:
                    progress(self.status())
                if found:
                    yield self._incumbent()
                    if first:
                        return
                    self._drop_detours()
                if self.best is not None and self._refine():
                    yield self._incumbent()
        finally:
            self._spent = self._elapsed()

    def _incumbent(self) -> Plan:
        assert self.best is not None
        return self.best

    def _elapsed(self) -> float:
        """Seconds spent planning, over all calls."""
        return time.perf_counter() - self._clock

    # -- initialisation -------------------------------------------------------------------------------------------

    def _start(self) -> None:
        self.incumbent.check_start()
        mode = start_mode(self.problem)
        self.sampler.remember(mode)
        at = []
        for robot in self.problem.robots:
            roadmap = self.roadmaps[robot.name]
            at.append(roadmap.add_vertex(robot.start))
            if np.max(np.abs(robot.home - robot.start)) > 0:
                roadmap.add_vertex(robot.home)
            for condition in self.problem.goal:
                if isinstance(condition, RobotAt) and condition.robot == robot.name:
                    same = np.flatnonzero(np.max(np.abs(roadmap.q - condition.q), axis=1) == 0)
                    self._goal_vertices[robot.name] = int(same[0]) if len(same) else roadmap.add_vertex(condition.q)
        for robot in self.problem.robots:
            self._add_interior(robot.name, self.options.initial_vertices)
        root_orbit = self.graphs.add_orbit(mode)
        self.root = self.tree.add_root(mode, tuple(at), root_orbit)
        self._note_goal(self.root)

    # -- guidance -------------------------------------------------------------------------------------------------

    def _guide(self) -> tuple[int, list[Choice]]:
        """Orbit to work in and the elementary transitions Gamma to sample there (one per robot, disjoint)."""
        explore = self.rng.random() < self.options.persistent
        if explore:
            orbits = [o for o in self.graphs.orbital.nodes if self.tree.of_orbit.get(o)] or [0]
            orbit = orbits[int(self.rng.integers(len(orbits)))]
        elif self.best is not None:
            orbit = self._orbit_path_guidance()
        else:
            orbit = self._modal_frontier()
        self.graphs.orbital.nodes[orbit]["visits"] += 1
        mode = self.graphs.mode(orbit)
        self.graphs.modal.nodes[mode.state]["visits"] += 1
        if explore:
            return orbit, self.guidance.feasible_sets(mode, self.rng)
        return orbit, self._optimistic_choices(mode)

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

    def _expand_roadmaps(self, orbit: int) -> None:
        """SampleOrbitInterior and ExpandRoadmaps: every constituent roadmap keeps growing."""
        for name in self.names:
            self._add_interior(name, self.options.interior_samples)

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
            known = self._known(mode, choice)
            if guided:
                known = [c for c in known if c.promising and not self._taken(mode, c)]
            # Grow the set while it is small, later in step with its logarithm, for ever.
            if len(known) < 4 or self.best is not None or self.rng.random() < 0.3 + self.options.persistent:
                known = [*(c for c in self._sample(mode, choice) if c.promising or not guided), *known]
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

    def _taken(self, mode: Mode, candidate: Candidate) -> bool:
        """Whether the tree already has the mode that a candidate leads to, and there is no plan to improve yet."""
        return self.best is None and self.tree.entry(mode.replace(candidate.after)) is not None

    def _low_index(self, n: int) -> int:
        """An index below n, earlier ones more likely."""
        return int(min(n - 1, self.rng.geometric(0.35) - 1))

    def _known(self, mode: Mode, choice: Choice) -> list[Candidate]:
        if choice.kind == "pick":
            return self.sampler.picks(mode, choice.robots[0], choice.object)
        if choice.kind == "place":
            return self.sampler.places(mode, choice.robots[0], choice.place)
        return self.sampler.handovers(mode, *choice.robots)

    def _sample(self, mode: Mode, choice: Choice) -> list[Candidate]:
        n = self.options.transition_samples
        if choice.kind == "pick":
            return self.sampler.sample_pick(mode, choice.robots[0], choice.object, n)
        if choice.kind == "place":
            return self.sampler.sample_place(mode, choice.robots[0], choice.place, n)
        giver, receiver = choice.robots
        return self.sampler.sample_handover(mode, giver, receiver, 3 * n // 2)

    def _discover_adjacent_orbit(self, orbit: int, combination: tuple[Candidate, ...]) -> None:
        """Note the modal state that a sampled transition leads to."""
        mode = self.graphs.mode(orbit)
        self.graphs.discover(mode.replace(*(c.after for c in combination)).state, mode.state)

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
            if self._towards(near, combination):
                reached = True
                if self.best is None:
                    break
        if candidates:
            for choice in choices:
                self.guidance.record(mode, choice, reached)
        if self._goal_mode(mode):
            self._towards_goal(orbit)
        if self.rng.random() < self.options.persistent:
            node = self._select_tensor_node(orbit, uniform=True)
            for _ in range(4):
                if node is not None:
                    node = self.steering.random_step(node)

    def _select_tensor_node(self, orbit: int, uniform: bool = False) -> Node | None:
        """A node of the orbit: usually the one it was entered by at the least cost, else any."""
        nodes = self.tree.of_orbit.get(orbit)
        if not nodes:
            return None
        if uniform or self.rng.random() < self.options.persistent:
            return nodes[int(self.rng.integers(len(nodes)))]
        return min(nodes, key=lambda x: x.cost)

    def _towards(self, near: Node, combination: tuple[Candidate, ...]) -> bool:
        """Drive the active robots to their transition vertices and change the mode there."""
        node = self._drive(near, combination)
        return node is not None and self._change_mode(node, combination)

    def _drive(self, near: Node, combination: tuple[Candidate, ...]) -> Node | None:
        """The node at which all active robots of a transition stand at their vertices."""
        return self.steering.drive(near, {r: v for c in combination for r, v in c.at.items()})

    def _change_mode(self, node: Node, combination: tuple[Candidate, ...]) -> bool:
        mode = node.mode.replace(*(c.after for c in combination))
        active = tuple(sorted({r for c in combination for r in c.robots}))
        if (mode.key, node.at) in self._banned:
            return False
        if self.validity.stand(mode, dict(zip(self.names, node.at, strict=True)), active) is not None:
            return False
        cost = sum(self.problem.cost.transitions.get(c.kind, 0.0) for c in combination)
        known = self.tree.find(mode, node.at)
        if known is not None and known.cost <= node.cost + cost:
            return False
        orbit = self.graphs.add_orbit(mode) if known is None else None
        transition = Transition(tuple(c.action for c in combination))
        after = self.tree.insert_transition(node, transition, mode, orbit, cost)
        self.graphs.transition(node.orbit, after.orbit)
        self._note_goal(after)
        return True

    def _towards_goal(self, orbit: int) -> None:
        """In a mode that satisfies the goal, bring the robots to where they have to end."""
        near = self._select_tensor_node(orbit)
        if near is None or not self._goal_vertices:
            return
        for name in [str(x) for x in self.rng.permutation(list(self._goal_vertices))]:
            node = self.steering.drive(near, {name: self._goal_vertices[name]})
            if node is not None:
                near = node
        # Whoever was sent aside comes back at the end.
        for name, v in self._goal_vertices.items():
            node = self.steering.drive(near, {name: v}, depth=0)
            near = node or near

    def _insert(self, node: Node, at: At) -> Node:
        """InsertAndRewire: a validated step; orbits that it proves connected become one."""
        new, is_new = self.tree.insert(node, at)
        if not is_new and new.orbit != node.orbit:
            kept = self.graphs.merge(new.orbit, node.orbit)
            self.tree.merge_orbits(kept, new.orbit if new.orbit != kept else node.orbit)
        self.counts.nodes = len(self.tree.nodes)
        if is_new:
            self._note_goal(new)
        return new

    # -- solutions ------------------------------------------------------------------------------------------------

    def _goal_mode(self, mode: Mode) -> bool:
        return goal_mode(self.problem, mode, self.validity.X_WB)

    def _note_goal(self, node: Node) -> None:
        at = dict(zip(self.names, node.at, strict=True))
        if all(at[r] == v for r, v in self._goal_vertices.items()) and self._goal_mode(node.mode):
            self._goal_nodes.append(node)

    def _best_solution(self) -> bool:
        """Extract the cheapest plan of the tree, have it checked, and keep it when it beats the incumbent."""
        while True:
            self._goal_nodes = [n for n in self._goal_nodes if n.alive]
            node = min(self._goal_nodes, key=lambda n: n.cost, default=None)
            if node is None or node.cost >= self._tree_cost - 1e-9:
                return False
            segments, transitions, groups = self.tree.trace(node)
            plan = self.incumbent.plan(segments, transitions)
            report = self.incumbent.judge(plan)
            if report.ok:
                self._tree_cost = node.cost
                self._path = [g[0].orbit for g in groups]
                self._solution = node
                if self.options.refinements:
                    self._portfolio.add(plan)
                return self.incumbent.offer(plan, self._elapsed())
            self._repair(report, groups)
            if node.alive:
                self.tree.cut(node)

    def _drop_detours(self) -> None:
        """Extend the tree by the newest solution without the picks that were put back where they came from."""
        assert self._solution is not None
        steps = [x for x in self.tree.branch(self._solution) if x.transition is not None]
        kept = without_detours([x.transition.actions for x in steps if x.transition is not None])
        if len(kept) == len(steps):
            return
        at = self.root
        for k in kept:
            transition = steps[k].transition
            assert transition is not None
            vertices = dict(zip(self.names, steps[k].at, strict=True))
            combination = tuple(
                Candidate(a.kind, a.robots, {r: vertices[r] for r in a.robots}, a.before, a.after)
                for a in transition.actions
            )
            there = self._drive(at, combination)
            if there is None:
                return
            self._change_mode(there, combination)
            after = self.tree.find(there.mode.replace(*(c.after for c in combination)), there.at)
            if after is None:
                return
            at = after
        if self._goal_vertices and self._goal_mode(at.mode):
            self._towards_goal(at.orbit)

    def _refine(self) -> bool:
        """A share of proposals to one of the plans under refinement; a checked gain is offered."""
        assert self.best is not None
        plan = self._portfolio.improve(self.options.refinements, self.best.cost)
        return plan is not None and self.incumbent.offer(plan, self._elapsed())

    def _refiner(self, plan: Plan, resolution: float) -> Refiner:
        return Refiner(
            plan.segments,
            plan.transitions,
            self.problem.cost,
            self.collision,
            self.validity,
            self.roadmaps,
            self.rng,
            resolution,
        )

    def _repair(self, report: Report, groups: list[list[Node]]) -> None:
        """The judge found what samples had missed: forbid that step, or that change of mode, and cut the tree there."""
        for violation in report.violations:
            if violation.kind not in ("collision", "contact") or violation.segment is None:
                raise MrtampError(f"the planner produced an illegal plan; please report this: {violation}")
            group = groups[violation.segment]
            step = violation.step or 0
            at_end = step >= len(group) - 2 and (violation.fraction or 0.0) > 0.999
            if at_end and violation.segment + 1 < len(groups):
                # Fingers that close or open at the transition may be the cause.
                after = groups[violation.segment + 1][0]
                self._banned.add((after.mode.key, after.at))
                if after.alive:
                    self.tree.cut(after)
            if step + 1 < len(group):
                before, after = group[step], group[step + 1]
                guilty, obstacle = self._guilty(violation, before)
                one, two = (dict(zip(self.names, x.at, strict=True)) for x in (before, after))
                self.validity.forbid(before.mode, one, two, guilty, obstacle)
                if after.alive:
                    self.tree.cut(after)

    def _guilty(self, violation: Violation, node: Node) -> tuple[tuple[str, ...], str | None]:
        """The one or two robots that a violation is about, counting loads with their carriers, and what one hit."""
        carriers = {a.object: r for r, a in node.mode.held.items()}
        owners = [carriers.get(s.owner, s.owner) for s in violation.sides or ()]
        robots = tuple(dict.fromkeys(o for o in owners if o in self.roadmaps))
        obstacles = [o for o in owners if o not in self.roadmaps]
        if robots and violation.kind == "collision":
            return robots, obstacles[0] if obstacles else robots[0]
        return robots or tuple(self.names[:1]), None

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

    def explain(self) -> str:
        """Why there is no plan yet: per stratum what was tried and what stopped it, and who blocked whose motion."""
        return explain(self)
