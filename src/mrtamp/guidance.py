"""Where planning effort goes before there is a plan: optimistic modal guidance (paper, section V).

Guidance works on names: for each object a small graph whose nodes are the places it can be (supports, robots) and whose
edges are pick, place and handover, each at an optimistic cost of one, dearer the more often it was tried in vain (see
`mrtamp.transitions.estimates`).  Of grasps it knows no more than the face of the object that the hand comes from.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from mrtamp.graphs import Graphs
from mrtamp.modes import Attachment, ModalState, Mode, condition_holds
from mrtamp.problem import AtPose, Problem, RobotAt, Subgoal
from mrtamp.transitions.candidate import Candidate, StratumKey
from mrtamp.transitions.sampler import TransitionSampler

FAILED_TRY = 0.7
"""What a failure of a transition in one mode adds to it there."""
FAILED_STATE = 0.35
"""The same in all modes of its modal state together; at most FAILED_STATES."""
FAILED_STATES = 4.0
VISITED = 0.3
"""Per square root of the visits to the modal state that a transition leads to: going back is no progress."""
BLOCKED = 2.0
"""What is added to acting on an object while another stands in its way."""
UNPROMISING = 4.0
"""What is added to the cost after a grasp that the sampler saw no way on from, as far as it can see."""
_DRAWS = 8
"""Active sets that are drawn at a time, at most."""
SLACK = 0.25
"""How much dearer than the best way on a candidate may seem; failures add to that."""

Outline = tuple[ModalState, tuple[int, ...]]
"""A modal state, and from which face each of the held objects is held."""


@dataclass(frozen=True)
class Choice:
    """One elementary transition by name: what to sample."""

    kind: str
    robots: tuple[str, ...]
    object: str
    place: str

    @property
    def key(self) -> StratumKey:
        """The key of its stratum's statistics."""
        return (self.kind, self.robots, self.object, self.place)


class ModalGuidance:
    """Estimates how far modes are from the goal and proposes the transitions that lead there."""

    def __init__(self, problem: Problem, sampler: TransitionSampler, graphs: Graphs) -> None:
        self.problem = problem
        self.sampler = sampler
        self._graphs = graphs
        self.robots = [r.name for r in problem.robots if r.model.gripper is not None]
        self._static = sampler.validity.X_WB
        self._conditions = {c.object: c for c in problem.goal if not isinstance(c, RobotAt)}
        self._led = {s.attach.object for s in problem.subgoals if s.attach is not None}
        self.estimates = sampler.estimates
        self._visits: Counter[Outline] = Counter()
        self._failures: Counter[tuple[tuple, Choice]] = Counter()

    # -- distances ------------------------------------------------------------------------------------------------

    def edge_cost(self, choice: Choice) -> float:
        """Optimistic cost of one transition: one, and what failed attempts and reach say against it."""
        return self.estimates.edge_cost(choice.key)

    def goal_places(self, item: str) -> list[str]:
        """Names of the supports or the robot that satisfy the object's goal."""
        return self.estimates.goal_places(item)

    def costs_to_goal(self, item: str) -> dict[str, float]:
        """Optimistic cost of the transitions from every place of an object to its goal, held from the best face."""
        costs = self.estimates.costs(item)
        held = {r: float(costs.held[k].min()) for r, k in self.sampler.holds.number.items()}
        return {place: cost for place, cost in (costs.resting | held).items() if np.isfinite(cost)}

    def _choices(self, item: str) -> list[Choice]:
        fits = [r for r in self.robots if self.sampler.families[r, item]]
        out = []
        for r in fits:
            for s in self.estimates.supports[item]:
                out += [Choice("pick", (r,), item, s.name), Choice("place", (r,), item, s.name)]
            out += [Choice("handover", (r, b), item, r) for b in fits if b != r]
        return out

    def done(self, mode: Mode, item: str) -> bool:
        """Whether the object satisfies its goal and rests on nothing that still has to move."""
        condition = self._conditions.get(item)
        if condition is not None and not condition_holds(self.problem, condition, mode, self._static):
            return False
        a = mode.of[item]
        if a.held:
            return condition is not None
        return a.parent not in mode.of or self.done(mode, a.parent)

    def remaining(self, mode: Mode) -> float:
        """Optimistic cost of the transitions from `mode` to a goal mode: their number, and what failures say."""
        return self._subgoals_left(mode) + sum(self._remaining(mode, item) for item in mode.of)

    def _subgoals_left(self, mode: Mode) -> int:
        return len(self.problem.subgoals) - len(mode.done)

    def transitions_to_go(self, mode: Mode) -> int:
        """Number of transitions on the paths that `remaining` is the cost of."""
        return self._subgoals_left(mode) + sum(self._transitions_to_go(mode, item) for item in mode.of)

    def _transitions_to_go(self, mode: Mode, item: str) -> int:
        if self.done(mode, item):
            return 0
        estimate = self._remaining(mode, item)
        return self.estimates.transitions(mode.of[item]) or round(min(estimate, 4.0))

    def _remaining(self, mode: Mode, item: str) -> float:
        a = mode.of[item]
        condition = self._conditions.get(item)
        if self.done(mode, item):
            return 0.0
        if condition is None and item in self._led and self._subgoals_left(mode):
            # Subgoals say what becomes of it.
            return 0.0
        if condition is None:
            # Without a goal of its own, it only has to be put down, or taken off what it rests on.
            return 1.0 if a.held else 2.0
        if condition_holds(self.problem, condition, mode, self._static):
            return 4.0
        return self.estimates.to_goal(a)

    # -- experience -----------------------------------------------------------------------------------------------

    def failed(self, mode: Mode, choice: Choice) -> int:
        """How often a transition came to nothing in this very mode."""
        return self._failures[mode.key, choice]

    def record(self, mode: Mode, choice: Choice, success: bool) -> None:
        """Note whether acting on a choice led anywhere new, for the mode and for its modal state."""
        if success:
            self._failures[mode.state, choice] //= 2
        else:
            self._failures[mode.key, choice] += 1
            self._failures[mode.state, choice] += 1

    def _vain(self, mode: Mode, choice: Choice) -> float:
        """What failures say against a choice, here and in modes alike but for poses."""
        alike = min(FAILED_STATE * self._failures[mode.state, choice], FAILED_STATES)
        return FAILED_TRY * self.failed(mode, choice) + alike

    def _discouragement(self, mode: Mode, choice: Choice, face: int | None = None) -> float:
        """What speaks against a choice: failures, and where it leads, with the object held from `face` then."""
        visits = 0
        if choice.kind != "reach":
            item, end = choice.object, _ends(choice)[1]
            held = {a.object: self._face(a) for a in mode.held.values() if a.object != item}
            if face is not None:
                held[item] = face
            state = tuple((o, end if o == item else place) for o, place in mode.state)
            visits = self._visits[state, tuple(held[o] for o in sorted(held))]
        return self._vain(mode, choice) + VISITED * float(np.sqrt(visits))

    def outline(self, mode: Mode) -> Outline:
        """What tells modes apart for guidance: neither poses nor, but for their faces, grasps."""
        return mode.state, tuple(self._face(a) for a in sorted(mode.held.values(), key=lambda a: a.object))

    def _face(self, a: Attachment) -> int:
        return self.sampler.holds.face(a)

    def visit(self, mode: Mode) -> None:
        """Count that work is done in a mode."""
        self._graphs.modal.nodes[mode.state]["visits"] += 1
        self._visits[self.outline(mode)] += 1

    def visits(self, outline: Outline) -> int:
        """How often work was done in modes of an outline."""
        return self._visits[outline]

    def leads_on(self, mode: Mode, choice: Choice, candidate: Candidate) -> bool:
        """Whether a candidate seems hardly dearer than the best of its choice could be.

        The more often the choice came to nothing the more is allowed for, so that in the end none is left out.
        """
        a = candidate.after
        if choice.kind not in ("pick", "handover") or a is None:
            return True
        before = mode.of[choice.object]
        best, _ = self.estimates.through(before, choice.key)
        own = self.estimates.through_grasp(before, choice.key, a, UNPROMISING * (not candidate.promising))
        return own <= best + SLACK + self._vain(mode, choice)

    # -- proposals ------------------------------------------------------------------------------------------------

    def enabled(self, mode: Mode) -> list[Choice]:
        """Every elementary transition whose discrete conditions hold in `mode`."""
        out = []
        for item in mode.of:
            a = mode.of[item]
            if item in mode.loaded:
                continue
            for choice in self._choices(item):
                start, end = _ends(choice)
                if start != a.place or (choice.kind != "place" and end in mode.held):
                    continue
                if choice.kind == "place":
                    body = self.problem.support(choice.place).body
                    if body in mode.of and mode.of[body].held:
                        continue
                out.append(choice)
        reach = self.sampler.reaching
        return out + [reach_choice(s) for s in self.problem.subgoals if reach.enabled(mode, s)]

    def proposals(self, mode: Mode) -> list[tuple[float, Choice]]:
        """Enabled transitions and how much dearer than the best path each is by the estimate, lowest first."""
        out = []
        blocked = self._blockers(mode)
        blockers = {name for names in blocked.values() for name in names}
        enabled = self.enabled(mode)
        reserved = self._reserved(mode)
        for choice in enabled:
            item = choice.object
            if choice.kind == "reach":
                out.append((self._discouragement(mode, choice), choice))
                continue
            start, end = _ends(choice)
            if self.done(mode, item) and item not in blockers:
                continue
            through, face = self.estimates.through(mode.of[item], choice.key)
            detour = through - self.estimates.to_goal(mode.of[item])
            if item in blockers or (start in self.goal_places(item) and choice.kind == "pick"):
                # Out of the way, to anywhere.
                detour = min(detour, 1.0)
            if item in blocked and (choice.kind == "pick" or end in self.goal_places(item)):
                # First what stands in its way.
                detour += BLOCKED
            if end in reserved and reserved[end] != item:
                # That hand is about to take something else over.
                detour += 3.0
            against = self._not_yet(mode, choice) + self._discouragement(mode, choice, face)
            out.append((max(detour, 0.0) + against, choice))
        out.sort(key=lambda pair: pair[0])
        return out

    def _reserved(self, mode: Mode) -> dict[str, str]:
        """Robots that the best path of a held object hands it to, and that object."""
        out = {}
        for robot, a in mode.held.items():
            options = [c for c in self._choices(a.object) if c.kind != "pick" and c.robots[0] == robot]
            through = [self.estimates.through(a, c.key)[0] for c in options]
            best = options[int(np.argmin(through))] if options else None
            if best is not None and best.kind == "handover":
                out[best.robots[1]] = a.object
        return out

    def _not_yet(self, mode: Mode, choice: Choice) -> float:
        """How much speaks against acting now: what the object goes onto is not in its own goal yet."""
        condition = self._conditions.get(choice.object)
        penalty = 0.0
        if isinstance(condition, AtPose) and condition.on in mode.of and not self.done(mode, condition.on):
            penalty = 2.0
        if choice.kind == "place":
            body = self.problem.support(choice.place).body
            if body in mode.of and not self.done(mode, body):
                # Whatever is put there now has to come off again.
                penalty += 4.0
            elif condition is not None and choice.place not in self.goal_places(choice.object):
                penalty += 0.5
        return penalty

    def _blockers(self, mode: Mode) -> dict[str, set[str]]:
        """Object -> resting objects that kept it from its goal or from being picked, and are still where they were."""
        out: dict[str, set[str]] = {}
        for (kind, _robots, item, place), outcome in self.sampler.outcomes.items():
            if not outcome.blockers or (kind == "place" and place not in self.goal_places(item)):
                continue
            here = {a.object for a in outcome.blockers if mode.of[a.object] is a and a.object != item}
            if here and not self.done(mode, item):
                out.setdefault(item, set()).update(here)
        return out

    def feasible_sets(self, mode: Mode, rng: np.random.Generator) -> list[Choice]:
        """A random non-empty active set and a random elementary transition for each of its robots.

        Active sets without a joint assignment are drawn again; empty when that happens too often.
        """
        enabled = self.enabled(mode)
        names = [r.name for r in self.problem.robots]
        for _ in range(_DRAWS):
            members = [n for n in names if rng.random() < 0.5] or [names[int(rng.integers(len(names)))]]
            out = self._assignment(mode, enabled, members, rng)
            if out:
                return out
        return []

    def _assignment(
        self, mode: Mode, enabled: list[Choice], members: list[str], rng: np.random.Generator
    ) -> list[Choice]:
        """A random elementary transition for each of the robots, in random order; empty where one has none left."""
        out: list[Choice] = []
        used: set[str] = set()
        # In a fixed order, the first would hardly ever wait for another to hand something over.
        for name in [members[int(i)] for i in rng.permutation(len(members))]:
            if name in used:
                continue
            options = [
                c
                for c in enabled
                if name in c.robots
                and set(c.robots) <= set(members)
                and not used & set(c.robots)
                and not any(self._touched(mode, c) & self._touched(mode, o) for o in out)
            ]
            if not options:
                return []
            choice = options[int(rng.integers(len(options)))]
            out.append(choice)
            used |= set(choice.robots)
        return out

    def _touched(self, mode: Mode, choice: Choice) -> set[str]:
        """Objects that a transition is about: what it moves, and what that is put on."""
        if choice.kind == "reach":
            attach = self.problem.subgoal(choice.place).attach
            return {attach.object, attach.parent} & set(mode.of) if attach else set()
        body = self.problem.support(choice.place).body if choice.kind == "place" else choice.object
        return {choice.object, body} & set(mode.of)


def reach_choice(subgoal: Subgoal) -> Choice:
    """The transition that reaches a subgoal."""
    return Choice("reach", tuple(subgoal.targets), subgoal.attach.object if subgoal.attach else "", subgoal.name)


def _ends(choice: Choice) -> tuple[str, str]:
    """Place before and place after."""
    if choice.kind == "pick":
        return choice.place, choice.robots[0]
    if choice.kind == "place":
        return choice.robots[0], choice.place
    return choice.robots[0], choice.robots[1]
