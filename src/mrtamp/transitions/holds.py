"""What is known of how objects can be held: by robot, and by the face of the object that the hand comes from.

Grasps are infinitely many, and which of them lead on to the goal is what transition sampling has to find out.  Faces
are few, so what samples show of them can be counted: from which a robot can pick an object up or put it down at its
goal, and from which faces two robots can hold it at once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from mrtamp.kinematics import inverse
from mrtamp.modes import Attachment
from mrtamp.transitions.families import GraspFamily

N_FACES = 6
_DRAWS = 64
_DEARER = 0.5
"""Per square root of the attempts in vain: what has never been seen seems dearer the more often it was looked for."""


class Tally:
    """Attempts in vain (a weighted number) and whether there was ever a success, in arrays of one shape."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.vain = np.zeros(shape)
        self.found = np.zeros(shape, dtype=bool)

    @property
    def extra(self) -> np.ndarray:
        """What speaks against each, as an optimistic cost; zero for what was seen to be possible."""
        return np.where(self.found, 0.0, _DEARER * np.sqrt(self.vain))


class Holds:
    """Counts what became of samples per robot and face; objects are those that some robot can grasp.

    Attributes
    ----------
    number : robot -> its row in the arrays.
    possible : object -> whether the robot has grasps from the face (R, 6).
    families : (robot, object) -> numbers of the grasp families per face.
    version : object -> how often something was noted about it.
    """

    def __init__(self, robots: Sequence[str], families: Mapping[tuple[str, str], Sequence[GraspFamily]]) -> None:
        self.number = {r: i for i, r in enumerate(robots)}
        self.possible: dict[str, np.ndarray] = {}
        self.families: dict[tuple[str, str], list[list[int]]] = {}
        self.version = Counter[str]()
        self._faces: dict[Attachment, int] = {}
        rng = np.random.default_rng(0)
        for (robot, item), fits in families.items():
            possible = self.possible.setdefault(item, np.zeros((len(robots), N_FACES), dtype=bool))
            at: list[list[int]] = [[] for _ in range(N_FACES)]
            for k, family in enumerate(fits):
                c = rng.uniform(family.lower, family.upper, size=(_DRAWS, len(family.lower)))
                for face in np.unique(faces(inverse(family.pose(c)))).tolist():
                    at[face].append(k)
                    possible[self.number[robot], face] = True
            self.families[robot, item] = at
        R = len(robots)
        self._picked: dict[tuple[str, str], Tally] = {}
        self._placed = {item: Tally((R, N_FACES)) for item in self.possible}
        self._exchanged = {item: Tally((R, N_FACES, R, N_FACES)) for item in self.possible}

    def face(self, a: Attachment) -> int:
        """The face of the object that the hand which holds it comes from."""
        if a not in self._faces:
            self._faces[a] = int(faces(a.X_PO))
        return self._faces[a]

    def picked(self, item: str, place: str) -> np.ndarray:
        """What speaks against picking the object up where it rests, per robot and face (R, 6)."""
        tally = self._picked.get((item, place))
        return np.zeros_like(self.possible[item], dtype=float) if tally is None else tally.extra

    def placed(self, item: str) -> np.ndarray:
        """What speaks against putting the object down at its goal, per robot and face (R, 6)."""
        return self._placed[item].extra

    def exchanged(self, item: str) -> np.ndarray:
        """What speaks against a handover, per giver and face, receiver and face (R, 6, R, 6)."""
        return self._exchanged[item].extra

    def note_families(self, robot: str, item: str, place: str, tried: Mapping[int, int], weight: float) -> None:
        """Grasp families from which so many samples of picks were drawn; their weight is that of attempts in vain."""
        tally = self._picked.setdefault((item, place), Tally(self.possible[item].shape))
        for face, numbers in enumerate(self.families[robot, item]):
            tally.vain[self.number[robot], face] += weight * sum(tried.get(k, 0) for k in numbers)
        self.version[item] += 1

    def note_picks(self, robot: str, item: str, place: str, grasps: Iterable[Attachment]) -> None:
        """Grasps with which the open hand fits around the object where it rests."""
        tally = self._picked.setdefault((item, place), Tally(self.possible[item].shape))
        for a in grasps:
            tally.found[self.number[robot], self.face(a)] = True
        self.version[item] += 1

    def note_place(self, grasp: Attachment, success: bool, weight: float = 1.0) -> None:
        """An attempt to put an object down at its goal, or a look ahead at it."""
        tally, at = self._placed[grasp.object], (self.number[grasp.parent], self.face(grasp))
        tally.found[at] |= success
        tally.vain[at] += weight * (not success)
        self.version[grasp.object] += 1

    def note_exchange(self, given: Attachment, taken: Attachment, success: bool, weight: float = 1.0) -> None:
        """An attempt at a handover."""
        tally = self._exchanged[given.object]
        at = (*(self.number[given.parent], self.face(given)), *(self.number[taken.parent], self.face(taken)))
        tally.found[at] |= success
        tally.vain[at] += weight * (not success)
        self.version[given.object] += 1


def faces(X_GO: np.ndarray) -> np.ndarray:
    """The faces (...,) of an object from which hands come that hold it at X_GO (..., 4, 4): -x, -y, -z, +x, +y, +z."""
    towards = -X_GO[..., 2, :3]
    axis = np.argmax(np.abs(towards), axis=-1)
    positive = np.take_along_axis(towards, np.asarray(axis)[..., None], axis=-1)[..., 0] > 0
    return axis + 3 * positive
