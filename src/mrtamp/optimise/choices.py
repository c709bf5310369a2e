"""The continuous choices of a plan that may slide: coordinates of grasps and placements in their families.

Everything that the problem fixes (where objects start, explicit grasps, exact goal poses) stays the very same
attachment; every other attachment becomes a few bounded coordinates, and a new attachment once they change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mrtamp.kinematics import inverse, rotation_vectors
from mrtamp.modes import Attachment, Mode, static_poses
from mrtamp.optimise.screws import cross, transported
from mrtamp.plan import Action, Transition
from mrtamp.problem import AtPose, InRegion, Problem
from mrtamp.transitions.families import Family, GraspFamily, placement_families, residual

_ON_FAMILY = 1e-5
"""Largest residual (rad, m) of an attachment that counts as a member of a family."""
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class Slide:
    """An attachment that may slide: its family, its columns among all coordinates, the scale and bounds of each.

    `scale` is the change of a coordinate (rad, m) that is about as large as turning a joint by 1 rad.
    """

    original: Attachment
    family: Family
    columns: slice
    lower: np.ndarray
    upper: np.ndarray
    scale: np.ndarray

    def pose(self, c: np.ndarray) -> np.ndarray:
        """X_PO (N, 4, 4) at coordinates c (N, k); for a grasp the parent frame is G."""
        X = self.family.pose(c)
        return inverse(X) if self.original.held else np.array(X)

    def screws(self, c: np.ndarray) -> np.ndarray:
        """Velocity of the object per unit of each coordinate (k, 6): angular, and linear at the origin of P, in P."""
        k = len(c)
        X = self.pose(np.concatenate([c + _STEP * np.eye(k), c - _STEP * np.eye(k)]))
        D = X[:k] @ inverse(X[k:])
        omega = rotation_vectors(D[:, :3, :3]) / (2 * _STEP)
        middle = (X[:k, :3, 3] + X[k:, :3, 3]) / 2
        velocity = (X[:k, :3, 3] - X[k:, :3, 3]) / (2 * _STEP)
        return np.concatenate([omega, velocity - cross(omega, middle)], axis=1)


class Choices:
    """The sliding attachments of a plan.

    Parameters
    ----------
    modes, transitions : of the plan as it is given.
    families : (robot, object) -> grasp families; empty where grasps shall not slide.
    """

    def __init__(
        self,
        problem: Problem,
        modes: Sequence[Mode],
        transitions: Sequence[Transition],
        families: Mapping[tuple[str, str], Sequence[GraspFamily]],
    ) -> None:
        self.problem = problem
        self.modes = list(modes)
        self.transitions = list(transitions)
        self.families = families
        self.X_WB = static_poses(problem)
        fixed = set(modes[0].attachments)
        for t in transitions:
            for action in t.actions:
                if action.kind == "reach" and action.before is not None and action.after is not None:
                    fixed |= {action.before, action.after}
        self.slides: list[Slide] = []
        self.count = 0
        start: list[np.ndarray] = []
        for a in dict.fromkeys(x for mode in modes for x in mode.attachments):
            found = None if a in fixed else self._family(a, modes[-1])
            if found is not None:
                self._add(a, *found)
                start.append(found[1])
        self.start = np.concatenate([np.zeros(0), *start])
        self.of = {s.original: s for s in self.slides}

    def _add(self, a: Attachment, family: Family, c: np.ndarray) -> None:
        k = len(c)
        lower, upper = np.array(family.lower, dtype=float), np.array(family.upper, dtype=float)
        turns = np.zeros(k, dtype=bool)
        moved = family.pose(np.concatenate([np.tile(c, (k, 1)) + np.eye(k), c[None]]))
        # Whatever rotates is an angle; one that comes back to itself at its bounds has none.
        turns = np.abs(moved[:k, :3, :3] - moved[k, :3, :3]).max(axis=(1, 2)) > 1e-9
        whole = turns & (upper - lower >= 2 * np.pi - 1e-9)
        lower[whole], upper[whole] = -np.inf, np.inf
        columns = slice(self.count, self.count + k)
        self.slides.append(Slide(a, family, columns, lower, upper, np.where(turns, 1.0, 0.5)))
        self.count += k

    def _family(self, a: Attachment, last: Mode) -> tuple[Family, np.ndarray] | None:
        """The family that an attachment belongs to and its coordinates; None where it has no freedom."""
        X = np.asarray(a.X_PO)[None]
        candidates: list[Family]
        if a.held:
            X = inverse(X)
            widths = self.families.get((a.parent, a.object), ())
            candidates = [f for f in widths if a.width is not None and abs((f.width or 0.0) - a.width) < 1e-6]
        else:
            if a in last.attachments and not self._free_at_goal(a):
                return None
            support = next((s for s in self.problem.supports if s.name == a.support), None)
            if support is None or support.body != a.parent:
                return None
            item = self.problem.object(a.object)
            candidates = list(placement_families(item, support, self.problem.package_paths))
        for family in candidates:
            if not len(family.lower):
                continue
            c = family.coordinates(X)[0]
            inside = np.all(c >= family.lower - 1e-6) and np.all(c <= family.upper + 1e-6)
            if inside and np.abs(residual(family, X)).max() <= _ON_FAMILY:
                return family, c
        return None

    def _free_at_goal(self, a: Attachment) -> bool:
        """Whether every goal about the object is kept wherever it slides on its support."""
        for condition in self.problem.goal:
            if isinstance(condition, InRegion) and condition.object == a.object and condition.region != a.support:
                return False
            if isinstance(condition, AtPose) and condition.object == a.object and condition.X_BO is not None:
                return False
        return True

    def freeze(self) -> None:
        """Let nothing slide."""
        self.slides, self.start, self.count = [], np.zeros(0), 0

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds (count,) of all coordinates."""
        lower = np.concatenate([np.zeros(0), *(s.lower for s in self.slides)])
        return lower, np.concatenate([np.zeros(0), *(s.upper for s in self.slides)])

    @property
    def scale(self) -> np.ndarray:
        """Scale (count,) of all coordinates."""
        return np.concatenate([np.zeros(0), *(s.scale for s in self.slides)])

    def at(self, c: np.ndarray) -> Arrangement:
        """The modes and transitions at coordinates c (count,)."""
        new: dict[Attachment, Attachment] = {}
        for s in self.slides:
            if not np.array_equal(c[s.columns], self.start[s.columns]):
                a = s.original
                new[a] = Attachment(a.object, a.parent, s.pose(c[None, s.columns])[0], a.support, a.width)

        def swap(a: Attachment | None) -> Attachment | None:
            return a if a is None else new.get(a, a)

        modes = [Mode(tuple(new.get(a, a) for a in m.attachments), m.done) for m in self.modes]
        transitions = [
            Transition(tuple(Action(a.kind, a.robots, swap(a.before), swap(a.after), a.subgoal) for a in t.actions))
            for t in self.transitions
        ]
        return Arrangement(self, c, modes if new else self.modes, transitions if new else self.transitions, new)


class Arrangement:
    """What is attached to what, at one value of all coordinates: modes, world poses and their screws."""

    def __init__(
        self,
        choices: Choices,
        c: np.ndarray,
        modes: Sequence[Mode],
        transitions: Sequence[Transition],
        new: Mapping[Attachment, Attachment],
    ) -> None:
        self.choices = choices
        self.c = c
        self.modes = list(modes)
        self.transitions = list(transitions)
        self._slide_of = {new.get(s.original, s.original): s for s in choices.slides}
        self._poses: dict[tuple[Attachment, ...], np.ndarray] = {}
        self._screws: dict[Attachment, np.ndarray] = {}

    def frozen(self) -> Choices:
        """The choices of this arrangement as they are, none of which slides."""
        out = Choices(self.choices.problem, self.modes, self.transitions, {})
        out.freeze()
        return out

    def slide(self, a: Attachment) -> Slide | None:
        """How an attachment of this arrangement may slide."""
        return self._slide_of.get(a)

    def own_screws(self, a: Attachment) -> np.ndarray:
        """Screws (k, 6) of a sliding attachment in its parent frame."""
        if a not in self._screws:
            slide = self._slide_of[a]
            self._screws[a] = slide.screws(self.c[slide.columns])
        return self._screws[a]

    def resting(self, mode: Mode) -> dict[str, np.ndarray]:
        """World poses (4, 4) of the resting objects."""
        return {a.object: self.world_pose(mode.chain(a.object)) for a in mode.attachments if not a.held}

    def world_pose(self, chain: tuple[Attachment, ...]) -> np.ndarray:
        """World pose (4, 4) of an object at rest, from its chain of attachments."""
        if chain not in self._poses:
            base = self.choices.X_WB[chain[0].parent] if len(chain) == 1 else self.world_pose(chain[1:])
            self._poses[chain] = base @ chain[0].X_PO
        return self._poses[chain]

    def world_screws(self, chain: tuple[Attachment, ...]) -> list[tuple[slice, np.ndarray]]:
        """Columns of coordinates and the screws (k, 6) in W with which they move an object at rest."""
        out = []
        for k, a in enumerate(chain):
            slide = self.slide(a)
            if slide is not None:
                base = self.choices.X_WB[a.parent] if k == len(chain) - 1 else self.world_pose(chain[k + 1 :])
                out.append((slide.columns, transported(self.own_screws(a), base)))
        return out
