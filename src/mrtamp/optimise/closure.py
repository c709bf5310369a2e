"""Transitions that slide: the object is at the same place before and after, and the hand comes and goes as before.

For the program these are linear rows at the knots of transitions and of contact motions; after a step, the robots are
projected back onto them exactly by inverse kinematics.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from mrtamp.collision import RobotWorld
from mrtamp.kinematics import inverse, matrix
from mrtamp.modes import Mode
from mrtamp.optimise.choices import Arrangement
from mrtamp.optimise.polyline import Polyline, Stretch
from mrtamp.optimise.screws import cross, joint_screws, transported, upstream
from mrtamp.plan import Action
from mrtamp.problem import HandAt, HandIn, Problem
from mrtamp.transitions.projection import solve_ik

_NEAR = 0.15
"""How far (rad, m) projection may move a joint: more means that it found another posture."""
_LEVEL = 1e-6


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows over (flattened knots, coordinates): blocks (m, n) on columns (n,), and lower bounds where not zero."""

    columns: np.ndarray
    block: np.ndarray
    lower: np.ndarray | None = None


class Closure:
    """What transitions and contact motions of one polyline ask of configurations and coordinates."""

    def __init__(
        self, problem: Problem, worlds: Mapping[str, RobotWorld], line: Polyline, q: np.ndarray, pinned: Mapping
    ) -> None:
        self.problem = problem
        self.worlds = worlds
        self.line = line
        self.pinned = pinned
        self._offsets = {s: self._offset(s, q) for s in line.stretches if s.far != s.near}
        self._moves = {r: upstream(w.chain)[problem.robot(r).model.grasp_body] for r, w in worlds.items()}
        knots: dict[str, set[int]] = {r: set() for r in line.columns}
        for s in line.stretches:
            knots[s.robot] |= {s.far, int(line.events[s.event])}
        self._knots = {r: sorted(k) for r, k in knots.items()}

    def _offset(self, s: Stretch, q: np.ndarray) -> np.ndarray:
        """How the hand is away from the contact: in its own frame, or in the world's where it carries something."""
        cols, tool = self.line.columns[s.robot], self.worlds[s.robot].tool
        X_WE, X_WF = tool.matrix(q[[self.line.events[s.event], s.far], cols])
        if s.hand == "lifting":
            return matrix(X_WE[:3, :3].T @ X_WF[:3, :3], X_WF[:3, 3] - X_WE[:3, 3])
        return inverse(X_WE[None])[0] @ X_WF

    def _free(self, robot: str, knot: int) -> bool:
        return not self.pinned[robot][knot]

    def _knot(self, robot: str, knot: int) -> np.ndarray:
        cols = self.line.columns[robot]
        return knot * self.line.q.shape[1] + np.arange(cols.start, cols.stop)

    def _actions(self, arrangement: Arrangement) -> Iterator[tuple[int, Action, Mode, Mode]]:
        for e, transition in enumerate(arrangement.transitions):
            for action in transition.actions:
                yield int(self.line.events[e]), action, arrangement.modes[e], arrangement.modes[e + 1]

    # -- rows -------------------------------------------------------------------------------------------------------

    def equalities(self, q: np.ndarray, arrangement: Arrangement) -> list[Rows]:
        """Rows that stay zero."""
        out = []
        size = q.size
        hands = self._hands(q)
        for knot, action, before, after in self._actions(arrangement):
            if action.kind == "reach":
                out += self._hands_at(knot, action, q)
                continue
            parts: list[tuple[np.ndarray, np.ndarray]] = []
            origin = np.zeros(3)
            for sign, a, mode in ((1.0, action.before, before), (-1.0, action.after, after)):
                assert a is not None
                if a.held:
                    X_WG, screws = hands[a.parent, knot]
                    parts.append((self._knot(a.parent, knot), sign * screws))
                    origin = X_WG[:3, :3] @ a.X_PO[:3, 3] + X_WG[:3, 3]
                    slide = arrangement.slide(a)
                    if slide is not None:
                        moved = transported(arrangement.own_screws(a), X_WG)
                        parts.append((size + np.arange(slide.columns.start, slide.columns.stop), sign * moved))
                else:
                    for columns, moved in arrangement.world_screws(mode.chain(a.object)):
                        parts.append((size + np.arange(columns.start, columns.stop), sign * moved))
            out.append(_rows([(i, _at(s, origin)) for i, s in parts]))
        for s in self._offsets:
            knot = int(self.line.events[s.event])
            (X_WE, near), (X_WF, far) = hands[s.robot, knot], hands[s.robot, s.far]
            there = X_WF if s.hand == "lifting" else X_WE
            one, two = -_at(near, X_WE[:3, 3]), _at(far, there[:3, 3])
            out.append(_rows([(self._knot(s.robot, knot), one), (self._knot(s.robot, s.far), two)]))
        return out

    def _hands(self, q: np.ndarray) -> dict[tuple[str, int], tuple[np.ndarray, np.ndarray]]:
        """X_WG (4, 4) and the screws (n, 6) of the joints that move it, for every robot at its contact knots."""
        out = {}
        for robot, knots in self._knots.items():
            if knots:
                x = q[knots, self.line.columns[robot]]
                world = self.worlds[robot]
                screws = joint_screws(world.chain, x) * self._moves[robot][:, None]
                out.update({(robot, k): (X, S) for k, X, S in zip(knots, world.tool.matrix(x), screws, strict=True)})
        return out

    def _targets(self, action: Action) -> Iterator[tuple[str, HandAt | HandIn]]:
        if action.subgoal is None:
            return
        for robot, target in self.problem.subgoal(action.subgoal).targets.items():
            if isinstance(target, HandAt | HandIn):
                yield robot, target

    def _hands_at(self, knot: int, action: Action, q: np.ndarray) -> list[Rows]:
        out = []
        for robot, target in self._targets(action):
            if isinstance(target, HandAt) and self._free(robot, knot):
                x = q[knot, self.line.columns[robot]][None]
                out.append(Rows(self._knot(robot, knot), self.worlds[robot].tool.jacobian(x)[2][0]))
        return out

    def inequalities(self, q: np.ndarray, arrangement: Arrangement) -> list[Rows]:
        """Rows that stay above their lower bounds: hands inside the boxes of subgoals."""
        out = []
        for knot, action, _, _ in self._actions(arrangement):
            for robot, target in self._targets(action):
                if isinstance(target, HandIn) and self._free(robot, knot):
                    x = q[knot, self.line.columns[robot]][None]
                    _, p, J = self.worlds[robot].tool.jacobian(x)
                    R = target.X_WC.rotation().matrix()
                    at = R.T @ (p[0] - target.X_WC.translation())
                    G, half = R.T @ J[0, 3:], np.asarray(target.size) / 2
                    block = np.concatenate([G, -G])
                    out.append(Rows(self._knot(robot, knot), block, np.concatenate([-half - at, at - half])))
        return out

    # -- projection -------------------------------------------------------------------------------------------------

    def project(self, q: np.ndarray, arrangement: Arrangement) -> np.ndarray | None:
        """Knots (K, N) on all constraints near q (K, N), or None where there are none near."""
        out = q.copy()
        targets: dict[tuple[str, int], np.ndarray] = {}
        for knot, action, before, after in self._actions(arrangement):
            if action.kind == "reach":
                for robot, target in self._targets(action):
                    if self._free(robot, knot) and isinstance(target, HandAt):
                        targets[robot, knot] = target.X_WG.GetAsMatrix4()
                    elif self._free(robot, knot) and isinstance(target, HandIn):
                        x = self._into(robot, target, q[knot, self.line.columns[robot]])
                        if x is None:
                            return None
                        out[knot, self.line.columns[robot]] = x
                continue
            old, new = action.before, action.after
            assert old is not None and new is not None
            robot = action.robots[-1]
            if new.held:
                if old.held:
                    giver = self.worlds[old.parent].tool.matrix(q[knot, self.line.columns[old.parent]][None])[0]
                    X_WO = giver @ old.X_PO
                else:
                    X_WO = arrangement.world_pose(before.chain(old.object))
                grasp = new.X_PO
            else:
                X_WO, grasp = arrangement.world_pose(after.chain(new.object)), old.X_PO
            if self._free(robot, knot):
                targets[robot, knot] = X_WO @ inverse(grasp[None])[0]
        if not self._reach(out, targets):
            return None
        targets = {}
        for s, offset in self._offsets.items():
            if not self._free(s.robot, s.far):
                continue
            event = int(self.line.events[s.event])
            X_WE = self.worlds[s.robot].tool.matrix(out[event, self.line.columns[s.robot]][None])[0]
            if s.hand == "lifting":
                targets[s.robot, s.far] = matrix(X_WE[:3, :3] @ offset[:3, :3], X_WE[:3, 3] + offset[:3, 3])
            else:
                targets[s.robot, s.far] = X_WE @ offset
        if not self._reach(out, targets):
            return None
        self._follow(out)
        return out

    def _reach(self, q: np.ndarray, targets: Mapping[tuple[str, int], np.ndarray]) -> bool:
        """Bring hands to their targets, in place; whether all of them got there."""
        for robot, cols in self.line.columns.items():
            knots = [k for r, k in targets if r == robot]
            if not knots:
                continue
            X = np.array([targets[robot, k] for k in knots])
            x, solved = solve_ik(self.worlds[robot].tool, X[:, :3, :3], X[:, :3, 3], q[knots, cols])
            if not solved.all() or np.abs(x - q[knots, cols]).max() > _NEAR:
                return False
            q[knots, cols] = x
        return True

    def _into(self, robot: str, target: HandIn, x: np.ndarray) -> np.ndarray | None:
        """The configuration nearest to x (n,) that has the grasp point in the box."""
        tool = self.worlds[robot].tool
        R, origin = target.X_WC.rotation().matrix(), target.X_WC.translation()
        half = np.asarray(target.size) / 2
        start = x
        for _ in range(10):
            _, p, J = tool.jacobian(x[None])
            at = R.T @ (p[0] - origin)
            inside = np.clip(at, -half, half)
            if np.array_equal(at, inside):
                return x
            # A little inside, so that rounding does not put it out again.
            inside = np.clip(at, -half + np.minimum(1e-9, half), half - np.minimum(1e-9, half))
            x = x + np.linalg.pinv(R.T @ J[0, 3:]) @ (inside - at)
            x = np.clip(x, tool.chain.lower, tool.chain.upper)
            if np.abs(x - start).max() > _NEAR:
                return None
        return None

    def _follow(self, q: np.ndarray) -> None:
        """Waiting at a contact, and the inside of a contact motion, follow its ends."""
        for s in self.line.stretches:
            cols, event = self.line.columns[s.robot], int(self.line.events[s.event])
            low, high = sorted((s.near, event))
            q[low : high + 1, cols] = q[event, cols]
            inner, f = s.fractions(self.line.of(s.robot))
            q[inner, cols] = q[s.far, cols] + f[:, None] * (q[event, cols] - q[s.far, cols])


def _at(screws: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Rows (6, k) of angular velocity and the velocity at point p (3,) for screws (k, 6)."""
    return np.concatenate([screws[:, :3], screws[:, 3:] + cross(screws[:, :3], p)], axis=1).T


def _rows(parts: list[tuple[np.ndarray, np.ndarray]]) -> Rows:
    return Rows(np.concatenate([i for i, _ in parts]), np.concatenate([b for _, b in parts], axis=1))


def independent(block: np.ndarray) -> np.ndarray:
    """Orthonormal rows that span those of `block` (m, n)."""
    if not block.size:
        return block[:0]
    _, size, V = np.linalg.svd(block, full_matrices=False)
    return V[size > _LEVEL * max(float(size.max(initial=0.0)), 1.0)]
