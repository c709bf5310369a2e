"""Optimistic costs of bringing objects to their goals, from what samples showed (paper, section V).

For each object there is a small graph: where it rests, or which robot holds it from which face; pick, place and
handover lead from one to another at a cost of one each, and more the more often that was tried in vain.  That a grasp
allows no place at the goal, so that the object has to be regrasped on the way, shows in these costs.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from mrtamp.modes import Attachment
from mrtamp.problem import HeldBy, RobotAt
from mrtamp.transitions.candidate import Outcome, StratumKey
from mrtamp.transitions.workspace import Workspace

FAILED_CALL = 3.0
"""What a sampling call without any accepted sample adds to the optimistic cost of its edge."""
SOFT_FAILURE = 0.3
"""The same for a call in which IK succeeded; at most FAILED_CALL in all."""
UNREACHABLE = 6.0
"""Cost added before any attempt where the place lies outside the reach that was seen of the robot."""
UNKNOWN = 2.0 + FAILED_CALL
"""Cost from where no way to the goal is known."""
_LONGEST = 24
"""Transitions of one object on a way to its goal, at most."""


@dataclass(frozen=True)
class Costs:
    """Optimistic costs of one object to its goal, and numbers of transitions.

    Attributes
    ----------
    held, n_held : from each robot's hand and face (R, 6).
    resting, n_resting : from each support.
    put, elsewhere : from each hand and face (R, 6), if the next transition puts it down at its goal; if it does not.
    pick : support -> cost of picking it up there by each robot and face (R, 6).
    place : support -> cost of putting it down there from each (R, 6).
    handover : cost of every handover (R, 6, R, 6).
    """

    held: np.ndarray
    n_held: np.ndarray
    resting: dict[str, float]
    n_resting: dict[str, int]
    put: np.ndarray
    elsewhere: np.ndarray
    pick: dict[str, np.ndarray]
    place: dict[str, np.ndarray]
    handover: np.ndarray


class Estimates:
    """Estimates for all objects, computed anew when there are new samples."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace = workspace
        self.holds = workspace.holds
        problem = workspace.problem
        self.robots = list(self.holds.number)
        self.supports = {
            o.name: [s for s in problem.supports if s.body != o.name and (s.objects is None or o.name in s.objects)]
            for o in problem.objects
        }
        self._conditions = {c.object: c for c in problem.goal if not isinstance(c, RobotAt)}
        self._priors: dict[tuple[str, str], float] = {}
        self._known: dict[str, tuple[int, Costs]] = {}
        self._of_item: dict[str, list[Outcome]] = {}
        self._indexed = -1

    def goal_places(self, item: str) -> list[str]:
        """Names of the supports or the robot that satisfy the object's goal."""
        condition = self._conditions.get(item)
        if isinstance(condition, HeldBy):
            return [condition.robot]
        return [s.name for s in self.workspace.goal_supports[item]]

    def edge_cost(self, key: StratumKey) -> float:
        """Optimistic cost of one transition: one, and what failed attempts and reach say against it."""
        known = (self.workspace.outcomes.get(key), self.workspace.foreseen.get(key))
        seen = [o for o in known if o is not None and o.calls]
        if any(o.accepted for o in seen):
            return 1.0
        calls = sum(o.calls for o in seen)
        if any(o.ik_solved for o in seen):
            # Reachable, but in the way of something so far: that may depend on the grasp.
            return 1.0 + min(SOFT_FAILURE * calls, FAILED_CALL)
        return 1.0 + FAILED_CALL * calls + self._prior(key)

    def _prior(self, key: StratumKey) -> float:
        kind, robots, _, place = key
        reach = self.workspace.reach
        if kind == "handover":
            a, b = (reach[r] for r in robots)
            # A handover costs an extra transition already; between robots too far apart it cannot happen.
            return 0.0 if np.linalg.norm(a[0] - b[0]) < a[1] + b[1] else UNREACHABLE
        known = self._priors.get((robots[0], place))
        if known is None:
            support = next((s for s in self.workspace.problem.supports if s.name == place), None)
            X_WB = self.workspace.validity.X_WB
            known = 0.0
            if support is not None and support.body in X_WB:
                X_WS = X_WB[support.body] @ (support.X_BO or support.X_BS).GetAsMatrix4()
                half = np.asarray(support.size) / 2
                centre, radius = reach[robots[0]]
                local = np.linalg.inv(X_WS) @ np.append(centre, 1.0)
                nearest = np.clip(local[:3], [-half[0], -half[1], 0], [half[0], half[1], 0])
                known = 0.0 if np.linalg.norm(local[:3] - nearest) <= radius else UNREACHABLE
            self._priors[robots[0], place] = known
        return known

    def costs(self, item: str) -> Costs:
        """Costs from everywhere, by what is known now."""
        version = self.holds.version[item]
        version += sum(o.calls + bool(o.accepted) for o in self._outcomes(item))
        cached = self._known.get(item)
        if cached is None or cached[0] != version:
            cached = self._known[item] = (version, self._compute(item))
        return cached[1]

    def _outcomes(self, item: str) -> list[Outcome]:
        """Statistics of all strata of an object."""
        tables = (self.workspace.outcomes, self.workspace.foreseen)
        n = sum(len(table) for table in tables)
        if n != self._indexed:
            self._indexed = n
            self._of_item = {name: [] for name in self.holds.possible}
            for table in tables:
                for key, outcome in table.items():
                    if key[2]:
                        self._of_item[key[2]].append(outcome)
        return self._of_item[item]

    def _compute(self, item: str) -> Costs:
        """Costs of all edges, then those to the goal: every sweep takes in ways that are one transition longer."""
        holds, goals = self.holds, set(self.goal_places(item))
        possible = holds.possible[item]
        able = np.where(possible, 0.0, np.inf)
        fits = [r for r in self.robots if possible[holds.number[r]].any()]
        names = [s.name for s in self.supports[item]]

        def by_robot(kind: str, place: str) -> np.ndarray:
            out = np.full((len(self.robots), 1), np.inf)
            for r in fits:
                out[holds.number[r]] = self.edge_cost((kind, (r,), item, place))
            return out

        pick = {s: by_robot("pick", s) + holds.picked(item, s) + able for s in names}
        place = {s: by_robot("place", s) + (s in goals) * holds.placed(item) for s in names}
        between = np.full((len(self.robots), 1, len(self.robots), 1), np.inf)
        for a, b in itertools.permutations(fits, 2):
            between[holds.number[a], 0, holds.number[b], 0] = self.edge_cost(("handover", (a, b), item, a))
        handover = between + able + holds.exchanged(item)

        shape = possible.shape
        held, n_held = np.full(shape, np.inf), np.zeros(shape, dtype=int)
        resting = {s: 0.0 if s in goals else np.inf for s in names}
        n_resting = dict.fromkeys(names, 0)
        final = np.zeros(shape, dtype=bool)
        for r in goals & set(self.robots):
            final[holds.number[r]] = True
        held[final] = 0.0
        put = elsewhere = held
        rows = np.arange(held.size)
        for _ in range(_LONGEST):
            after_place = np.array([place[s] + resting[s] for s in names]).reshape(len(names), *shape)
            after_handover = (handover + held).reshape(*shape, -1)
            taker = np.argmin(after_handover, axis=2)
            at_goal = np.array([s in goals for s in names], dtype=bool)
            put = after_place[at_goal].min(axis=0, initial=np.inf)
            options = np.concatenate([after_place, after_handover.min(axis=2)[None]])
            elsewhere = options[~np.append(at_goal, False)].min(axis=0)
            best = np.argmin(options, axis=0)
            counts = np.array([*(np.full(held.size, n_resting[s]) for s in names), n_held.ravel()[taker.ravel()]])
            n = np.where(final, 0, 1 + counts[best.ravel(), rows].reshape(shape))
            old = (held, n_held, dict(resting), dict(n_resting))
            held, n_held = np.where(final, 0.0, options.min(axis=0)), n
            for s in names:
                if s not in goals:
                    after_pick = pick[s] + held
                    k = int(np.argmin(after_pick))
                    resting[s], n_resting[s] = float(after_pick.flat[k]), 1 + int(n_held.flat[k])
            if np.array_equal(old[0], held) and np.array_equal(old[1], n_held) and old[2:] == (resting, n_resting):
                break
        return Costs(held, n_held, resting, n_resting, put, elsewhere, pick, place, handover)

    # -- of single attachments ------------------------------------------------------------------------------------

    def to_goal(self, a: Attachment) -> float:
        """Optimistic cost from where an object is to its goal."""
        costs = self.costs(a.object)
        if a.held:
            cost = float(costs.held[self.holds.number[a.parent], self.holds.face(a)])
        else:
            cost = costs.resting.get(a.place, np.inf)
        return cost if np.isfinite(cost) else UNKNOWN

    def transitions(self, a: Attachment) -> int:
        """Number of transitions on the way that `to_goal` is the cost of; 0 where none is known."""
        costs = self.costs(a.object)
        if a.held:
            at = (self.holds.number[a.parent], self.holds.face(a))
            return int(costs.n_held[at]) if np.isfinite(costs.held[at]) else 0
        return costs.n_resting[a.place] if np.isfinite(costs.resting.get(a.place, np.inf)) else 0

    def through(self, a: Attachment, key: StratumKey) -> tuple[float, int | None]:
        """Least cost to the goal if this is the next transition, and the face by which the object is held then."""
        kind, robots, item, place = key
        costs = self.costs(item)
        if kind == "place":
            own = costs.place[place][self.holds.number[robots[0]], self.holds.face(a)]
            return float(own + _or_unknown(costs.resting[place])), None
        onward = costs.held[self.holds.number[robots[-1]]]
        if kind == "handover":
            edge = costs.handover[self.holds.number[robots[0]], self.holds.face(a), self.holds.number[robots[1]]]
        else:
            edge = costs.pick[place][self.holds.number[robots[0]]]
        total = edge + np.where(np.isfinite(onward), onward, UNKNOWN)
        face = int(np.argmin(total))
        return float(total[face]), face

    def from_faces(self, given: Attachment, receiver: str) -> tuple[np.ndarray, np.ndarray]:
        """Costs (6,) of a handover into each face, when the receiver puts it at its goal next; when it does not."""
        costs = self.costs(given.object)
        r = self.holds.number[receiver]
        edge = costs.handover[self.holds.number[given.parent], self.holds.face(given), r]
        return edge + costs.put[r], edge + costs.elsewhere[r]

    def through_grasp(self, a: Attachment, key: StratumKey, taken: Attachment, unpromising: float) -> float:
        """Cost to the goal if a pick or handover into this very grasp is the next transition.

        `unpromising` is added where the grasp is used next in the way the sampler looks ahead at: for a place at the
        goal; after a pick also for a handover.
        """
        kind, robots, item, place = key
        costs, at = self.costs(item), (self.holds.number[taken.parent], self.holds.face(taken))
        if kind == "handover":
            edge = costs.handover[self.holds.number[robots[0]], self.holds.face(a)][at]
            return float(edge + min(costs.put[at] + unpromising, costs.elsewhere[at]))
        return float(costs.pick[place][at] + costs.held[at] + unpromising)


def _or_unknown(cost: float) -> float:
    return cost if np.isfinite(cost) else UNKNOWN
