"""Prioritised planning: tasks are handed out greedily, then robots are planned one after another in space and time.

The practical habit: every object and subgoal goes to the robots that seem to be done with it first; then each robot's
whole sequence is fitted in around the robots planned before it.  Where that fails, or to find something better, tasks
are handed out a little differently and robots planned in another order, again and again.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mrtamp.baselines.anytime import Anytime
from mrtamp.baselines.timeline import Piece, Timeline
from mrtamp.mechanisms import check_without
from mrtamp.modes import Mode, goal_mode
from mrtamp.plan import Action, Transition
from mrtamp.problem import Problem
from mrtamp.roadmap_rows import RoadmapRows
from mrtamp.skeleton_guidance import SkeletonGuidance
from mrtamp.steering import Steering
from mrtamp.tensor_tree import At, Node
from mrtamp.transitions.candidate import Candidate
from mrtamp.transitions.projection import uniform_configurations
from mrtamp.transitions.ways import Stop, Way, stop_of

_DETOURS = 0.2
"""How often a robot takes another way than the shortest one, from the second attempt on."""
_ALIKE = 1.1
"""Plans that cost at most so many times the cheapest one before shortening are shortened too."""


@dataclass(frozen=True)
class PrioritisedOptions:
    """Settings of the planner.

    vertices : configurations per robot on the roadmaps in the beginning; `interior` more per attempt.
    seeds, keep : IK seeds, and ways kept, per task and robots, each time that more are sampled.
    variety : how far, relative to its cost, a way may seem dearer or cheaper than it is when tasks are handed out.
    shortcuts : proposals of shortening per plan.
    without : names of what is switched off, see `mrtamp.mechanisms.MECHANISMS_OF`.
    """

    vertices: int = 80
    interior: int = 6
    seeds: int = 40
    keep: int = 14
    variety: float = 0.5
    shortcuts: int = 600
    without: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        check_without("prioritised", self.without)


@dataclass(frozen=True, eq=False)
class Job:
    """One task as it was handed out: a chain of stops.

    `before` lists jobs that have to be over before its first stop, and before its last one.
    """

    name: str
    way: Way
    before: tuple[tuple[int, ...], tuple[int, ...]]

    @property
    def robots(self) -> tuple[str, ...]:
        """Who takes part."""
        return tuple(dict.fromkeys(r for s in self.way.stops for r in s.robots))


class Prioritised(Anytime):
    """Plans one robot after another, with restarts."""

    def __init__(self, problem: Problem, *, seed: int = 0, options: PrioritisedOptions | None = None) -> None:
        self.options = options or PrioritisedOptions()
        super().__init__(problem, seed, factored_cache="factored-cache" not in self.options.without)
        for name in self.names:
            self._add_interior(name, self.options.vertices)
        self.tasks = SkeletonGuidance(problem, self.sampler, self.guidance, self.root, self.deadline)
        self.steering = Steering(list(self.roadmaps.values()), self.validity, _no_tree, self.rng, self.deadline)
        self.steering.trouble = self.trouble
        # Cost of the cheapest plan before shortening; whether robots go aside after their courses in this attempt.
        self._cheapest = np.inf
        self._courteous = True
        self._rows = RoadmapRows(self.roadmaps, self.collision, self.validity)

    def _add_interior(self, name: str, n: int) -> None:
        world = self.roadmaps[name].world
        q = uniform_configurations(world.tool, self.rng, n)
        for x in q[~world.hits(world.rows(q, None, {}))]:
            self.roadmaps[name].add_vertex(x)

    @property
    def nodes(self) -> int:
        """Vertices of all roadmaps."""
        return sum(g.n_vertices for g in self.roadmaps.values())

    def _iterate(self) -> None:
        for name in self.names:
            self._add_interior(name, self.options.interior)
        self._rows.forget_if_full()
        self.tasks.grow(self.options.seeds, self.options.keep)
        jobs = self._hand_out(self.options.variety if self.iteration else 0.0)
        if jobs is None:
            return
        rank = {name: k for k, name in enumerate(self.names)}
        if self.iteration:
            rank = {name: int(k) for name, k in zip(self.names, self.rng.permutation(len(rank)), strict=True)}
        self._courteous = self.iteration == 0 or bool(self.rng.random() < 0.5)
        timeline = self._attempt(jobs, rank)
        if timeline is None or not goal_mode(self.problem, timeline.mode, self.validity.X_WB):
            return
        plan = self.incumbent.accepted(*timeline.plan())
        if plan is None:
            return
        self._offer(plan)
        if "refinement" not in self.options.without and plan.cost < _ALIKE * self._cheapest:
            self._cheapest = min(self._cheapest, plan.cost)
            shortened = self._shortened(plan, self.options.shortcuts)
            if shortened is not None:
                self._offer(shortened)

    def explain(self) -> str:
        """Why there is no plan yet: tasks that nobody was found to do, and what the modal estimates say."""
        lines = []
        if not self.tasks.applies:
            lines.append("The goal is no list of objects to be put somewhere and subgoals: nothing can be handed out.")
        tries = self.tasks.ways.tries
        for item in self.tasks.items:
            if not any(ways for (name, _), ways in self.tasks.ways.of.items() if name == item):
                asked = ", ".join(f"{' to '.join(r)} {n} times" for (name, r), n in tries.items() if name == item)
                lines.append(f"{item}: nobody was found to bring it to its goal (tried: {asked or 'nobody'})")
        return "\n".join([*lines, super().explain()])

    # -- assignment -----------------------------------------------------------------------------------------------

    def _hand_out(self, variety: float) -> list[Job] | None:
        """Every task to whoever seems to be done with it first, the soonest done first; None while one has no way."""
        choices = self._choices()
        if choices is None:
            return None
        before = self._before()
        where = {r: (0.0, self.roadmaps[r].q[v]) for r, v in self.start.items()}
        number: dict[str, int] = {}
        jobs: list[Job] = []
        while len(jobs) < len(choices):
            best = None
            for name, ways in choices.items():
                if name in number or not set().union(*before[name]) <= set(number):
                    continue
                for way in ways:
                    done = self._times(way, where)
                    score = (max(t for t, _ in done.values()) + way.penalty) * (1 + variety * self.rng.random())
                    if best is None or score < best[0]:
                        best = (score, name, way, done)
            if best is None:
                return None
            _, name, way, done = best
            number[name] = len(jobs)
            first, last = (tuple(sorted(number[b] for b in names)) for names in before[name])
            jobs.append(Job(name, way, (first, last)))
            where |= done
        return jobs

    def _times(self, way: Way, where: dict[str, tuple[float, np.ndarray]]) -> dict[str, tuple[float, np.ndarray]]:
        """When and where each robot would be done with a way, at full speed along straight lines."""
        out: dict[str, tuple[float, np.ndarray]] = {}
        for stop in way.stops:
            arrivals = []
            for r, q in stop.q.items():
                t, here = out.get(r, where[r])
                arrivals.append(t + float(np.linalg.norm(q - here)))
            for r, q in stop.q.items():
                out[r] = (max(arrivals), q)
        return out

    def _choices(self) -> dict[str, list[Way]] | None:
        """Task -> the ways to do it; None while one has none, or where the goal is no list of tasks."""
        if not self.tasks.applies and not goal_mode(self.problem, self.root, self.validity.X_WB):
            return None
        out: dict[str, list[Way]] = {}
        for item in self.tasks.items:
            out[item] = [w for (name, _), ways in self.tasks.ways.of.items() if name == item for w in ways]
        for subgoal in self.problem.subgoals:
            known = self.sampler.reaching.known(self.root, subgoal)
            out[subgoal.name] = [Way((self._reach(c),)) for c in known]
        return out if all(out.values()) else None

    def _reach(self, candidate: Candidate) -> Stop:
        stop = stop_of(candidate, self.sampler)
        stop.subgoal, stop.at = candidate.subgoal, candidate.at
        return stop

    def _before(self) -> dict[str, tuple[set[str], set[str]]]:
        """Task -> tasks to be over before its first stop, and before its last.

        What rests on an object goes first, then what it is put on; subgoals say it themselves.
        """
        items = set(self.tasks.items)
        on = {item: {o for o in items if self.root.of[o].parent == item} for item in items}
        under = {item: {s.body for s in self.sampler.goal_supports[item]} & items - {item} for item in items}
        reach = {s.name: (set(s.after), set[str]()) for s in self.problem.subgoals}
        return {item: (on[item], under[item]) for item in items} | reach

    @staticmethod
    def _order(jobs: Sequence[Job], rank: Mapping[str, int]) -> list[int]:
        """Numbers of the jobs in the order in which they are planned: robot by robot, as far as precedence allows."""
        out: list[int] = []
        while len(out) < len(jobs):
            ready = []
            for k, job in enumerate(jobs):
                earlier = {j for j in range(k) if set(jobs[j].robots) & set(job.robots)} | set().union(*job.before)
                if k not in out and earlier <= set(out):
                    ready.append(k)
            out.append(min(ready, key=lambda k: (rank[jobs[k].robots[0]], k)))
        return out

    # -- space and time -------------------------------------------------------------------------------------------

    def _attempt(self, jobs: Sequence[Job], rank: Mapping[str, int]) -> Timeline | None:
        """The timeline of all jobs, planned robot by robot; None where something cannot be fitted in."""
        q = {r: self.roadmaps[r].q[v] for r, v in self.start.items()}
        draft = _Draft(Timeline(self._rows.clearances, q, self.root), dict(self.start), self.trouble)
        for k in self._order(jobs, rank):
            job = jobs[k]
            if not self._plan_job(draft, k, job):
                self.tasks.failed(job.way)
                return None
            for robot in job.robots:
                if robot in self.goal and not any(robot in jobs[j].robots for j in draft.left(jobs)):
                    self._add_leg(draft, robot, self.goal[robot])
        if not draft.flush():
            return None
        for robot in sorted(self.goal, key=lambda r: rank[r]):
            if draft.at[robot] != self.goal[robot] and not (
                self._add_leg(draft, robot, self.goal[robot]) and draft.flush()
            ):
                return None
        return draft.timeline

    def _plan_job(self, draft: _Draft, k: int, job: Job) -> bool:
        for n, stop in enumerate(job.way.stops):
            before = [*job.before[0], *(job.before[1] if n == len(job.way.stops) - 1 else ())]
            candidate = self.tasks.candidate(stop, draft.mode)
            if candidate is None:
                return False
            alone = len(candidate.robots) == 1
            for robot in candidate.robots:
                if draft.robot in candidate.robots and draft.robot != robot and not draft.flush():
                    # It waits where it is for the others.
                    return False
                # What others have to do first has been scheduled: it is known when.
                earliest = max([draft.done[b] for b in before if b in draft.done], default=0)
                there = [r for r in candidate.robots if r != robot and draft.at[r] == candidate.at[r]]
                if not self._add_leg(draft, robot, candidate.at[robot], there):
                    return False
                if alone:
                    draft.act(k, candidate.action, earliest)
            if alone:
                continue
            if not (draft.flush() and draft.together(k, candidate.action, earliest)):
                return False
            if candidate.kind == "handover":
                # The giver draws its hand back first.
                draft.robot = candidate.robots[0]
                if not self._flush(draft, candidate.robots[1:]):
                    return False
        draft.planned.add(k)
        return True

    def _add_leg(self, draft: _Draft, robot: str, v: int, around: Sequence[str] = ()) -> bool:
        """Add the shortest roadmap path of a robot to its course; False if there is none.

        It leads past what does not move, and past the robots `around` where they stand.
        """
        if draft.robot not in (None, robot) and not self._flush(draft):
            return False
        pieces = self._pieces(draft, robot, v, around)
        if pieces is None:
            return False
        draft.robot = robot
        draft.course += pieces
        draft.row, draft.at[robot] = self._rows.vertex(robot, v), v
        return True

    def _flush(self, draft: _Draft, around: Sequence[str] = ()) -> bool:
        """Schedule a course before it is another robot's turn, followed by a retreat in courteous attempts.

        A retreat from the robots `around`, past where they stand, is part of every attempt.
        """
        assert draft.robot is not None
        if not around and not self._courteous:
            return draft.flush()
        aside = self.goal.get(draft.robot, self.home[draft.robot])
        return draft.flush(self._pieces(draft, draft.robot, aside, around) or [])

    def _pieces(self, draft: _Draft, robot: str, v: int, around: Sequence[str]) -> list[Piece] | None:
        """A way to vertex v past the robots `around` where they stand, as pieces of a course; None if there is none."""
        others = set(self.names) - set(around)
        at = tuple(draft.at[r] for r in self.names)
        detour = self.iteration > 0 and self.rng.random() < _DETOURS
        # Past everything as it is in the end, or else as it is when the robot goes on: then others act afterwards.
        for mode in (draft.mode, draft.present(robot)):
            path, _ = self.steering.path(mode, at, robot, v, ignore=others, detour=detour)
            if path is not None:
                break
        else:
            return None
        rows = self._rows.path(robot, path, self._rows.vertex(robot, path[0]))
        return [Piece(a, b, mode) for a, b in itertools.pairwise(rows)]


class _Draft:
    """A timeline, and the course of one robot that is being put together and not scheduled yet.

    Attributes
    ----------
    at : robot -> vertex where it is when all that is planned is over; `mode` is the mode then.
    robot, course : whose course it is, and what it consists of so far; `row` is where it ends.  None: there is none.
    done : job -> when its last scheduled action happens.  planned : jobs that are complete.
    """

    def __init__(self, timeline: Timeline, at: dict[str, int], trouble: Counter[tuple[str, str]]) -> None:
        self.trouble = trouble
        self.timeline = timeline
        self.at = at
        self.mode = timeline.root
        self.robot: str | None = None
        self.course: list[Piece] = []
        self.row = 0
        self.done: dict[int, int] = {}
        self.planned: set[int] = set()
        self._jobs: list[int] = []

    def left(self, jobs: Sequence[Job]) -> list[int]:
        """Numbers of the jobs that are not planned yet."""
        return [k for k in range(len(jobs)) if k not in self.planned]

    def present(self, robot: str) -> Mode:
        """The mode in which the robot's course goes on, as far as that is known."""
        mode = self.timeline.present(robot)
        for piece in self.course if robot == self.robot else ():
            if piece.action is not None:
                mode = mode.after(Transition((piece.action,)))
        return mode

    def act(self, k: int, action: Action, earliest: int) -> None:
        """Add an action of job k, by the robot alone, to the course."""
        self.mode = self.mode.after(Transition((action,)))
        self.course.append(Piece(self.row, self.row, self.mode, action, earliest))
        self._jobs.append(k)

    def flush(self, retreat: Sequence[Piece] = ()) -> bool:
        """Schedule the course, with a retreat afterwards; False if it cannot be fitted in."""
        if self.robot is None:
            return True
        times = self.timeline.insert(self.robot, self.course, retreat)
        if times is None:
            self.trouble.update({(self.robot, who): n for who, n in self.timeline.blame.items()})
            return False
        self.done.update(zip(self._jobs, times, strict=True))
        self.robot, self.course, self._jobs = None, [], []
        return True

    def together(self, k: int, action: Action, earliest: int) -> bool:
        """Schedule an action of several robots that are where it happens."""
        time = self.timeline.together(action.robots, action, earliest)
        if time is None:
            return False
        self.done[k] = time
        self.mode = self.mode.after(Transition((action,)))
        return True


def _no_tree(node: Node, at: At) -> Node:
    raise AssertionError("only paths are asked for")
