"""Where two robots may meet to hand an object over, and which grasps leave room for both hands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mrtamp.kinematics import inverse, matrix
from mrtamp.modes import Attachment, Mode
from mrtamp.transitions.estimates import Estimates
from mrtamp.transitions.projection import uniform_configurations
from mrtamp.transitions.workspace import Workspace

_GRASP_DRAWS = 8
_ROLLS = 4
_POOL = 48
"""Grasps per robot and object that are known to lead on to the goal; enough to choose from."""
_ROOM = 0.3
"""Distance (m) between two palms beyond which more does not help."""
_PALM = 0.08
"""How far (m) behind the grasp point the bulk of a hand lies, for guessing whether two hands have room."""
_TEMPER = 0.5
"""Difference of estimated costs to the goal by which one way on is e times less likely than another."""
_TIE = 0.25
"""Difference of estimated costs within which ways on are as good."""
_UP = np.array([0.0, 0.0, 1.0])


class Meetings:
    """Proposes giver configurations and receiver grasps; knows grasps that lead on to the goal."""

    def __init__(self, workspace: Workspace, estimates: Estimates) -> None:
        self.workspace = workspace
        self.estimates = estimates
        self.holds = workspace.holds
        self.rng = workspace.rng
        self.roadmaps = workspace.roadmaps
        self.reach = workspace.reach
        self.families = workspace.families
        self.goal_supports = workspace.goal_supports
        self.pools: dict[tuple[str, str], list[Attachment]] = {}

    def grow_pool(self, mode: Mode, robot: str, item: str, n: int = 32) -> None:
        """Draw grasps with which `robot` can put the object down at its goal, however it comes by it."""
        pool = self.pools.setdefault((robot, item), [])
        families = self.families[robot, item]
        if len(pool) >= _POOL or not families or not self.goal_supports[item]:
            return
        drawn = self.rng.integers(len(families), size=n)
        grasps = [self.workspace.draw_grasp(robot, item, int(f)) for f in drawn]
        world = self.roadmaps[robot].world
        reward = self.workspace.look_ahead(mode, robot, item, grasps, np.tile(world.home, (n, 1)))
        pool += [g for g, r in zip(grasps, reward, strict=True) if np.isfinite(r)]

    def propose(
        self, giver: str, receiver: str, grasp: Attachment, n: int, *, directly: bool
    ) -> tuple[np.ndarray, list[Attachment]]:
        """Configurations of the giver, and a grasp for the receiver at each, where the two may meet.

        A quarter is uniform in the giver's joints and over the receiver's whole grasp family: positive density over
        the whole stratum.  The rest puts the object between the robots, each hand on its own robot's side, turned
        freely about the line between the hands.  `directly` is as for `TransitionSampler.sample_handover`.
        """
        world = self.roadmaps[giver].world
        tool = world.tool
        own, centre = self.reach[giver][0], self.reach[receiver][0]
        uniform = uniform_configurations(tool, self.rng, 4 * n)
        p = (tool.matrix(uniform) @ grasp.X_PO)[:, :3, 3]
        uniform = uniform[np.linalg.norm(p - centre, axis=1) <= 0.9 * self.reach[receiver][1]][: n // 4]
        families = self.families[receiver, grasp.object]
        free = [
            self.workspace.draw_grasp(receiver, grasp.object, int(f))
            for f in self.rng.integers(len(families), size=len(uniform))
        ]
        aimed = self._receiving_grasps(receiver, grasp, n, directly=directly)
        gap = float(np.linalg.norm(centre - own))
        where = (own + centre) / 2 + self.rng.normal(scale=0.08 + 0.08 * gap, size=(n, 3))
        X_OG1 = inverse(grasp.X_PO)
        X_OG2 = inverse(np.array([g.X_PO for g in aimed]))
        across = _palms(X_OG2) - _palms(X_OG1)
        ahead = (centre - own) / max(gap, 1e-9)
        middle = (X_OG1[:3, 3] + X_OG2[:, :3, 3]) / 2
        rolls = []
        for _ in range(_ROLLS):
            turn = _rotations_about(ahead, self.rng.uniform(-np.pi, np.pi, size=n))
            R = _random_rotations(self.rng, n, 0.4) @ turn @ np.swapaxes(_rotations_to(across), 1, 2)
            rolls.append(matrix(R, where - np.einsum("nij,nj->ni", R, middle)))
        # Mostly the roll that both arms are most at ease with; one in four is the first drawn.
        maps = self.workspace.maps
        ease = [maps[giver].distances(X @ X_OG1) + maps[receiver].distances(X @ X_OG2) for X in rolls]
        best = np.where(self.rng.random(n) < 0.75, np.argmin(ease, axis=0), 0)
        X_WO = np.array(rolls)[best, np.arange(n)]
        q, solved = self.workspace.ik(giver, X_WO @ X_OG1, self.workspace.seeds(giver, X_WO @ X_OG1, 0.6))
        qa = np.concatenate([q[solved], uniform])
        grasps = [*(g for g, ok in zip(aimed, solved, strict=True) if ok), *free]
        clear = ~world.hits(world.rows(qa, grasp, {}))
        return qa[clear], [g for g, ok in zip(grasps, clear, strict=True) if ok]

    def _receiving_grasps(self, receiver: str, given: Attachment, n: int, *, directly: bool) -> list[Attachment]:
        """n grasps that keep the hands apart, each the best of a few drawn, mostly of those that lead on.

        That is: of those that can put the object down at its goal, or from faces that the object can be handed on from,
        by the estimated cost of either.
        """
        item = given.object
        pool = self.pools.get((receiver, item), [])
        families = self.holds.families[receiver, item]
        put, elsewhere = self.estimates.from_faces(given, receiver)
        if directly:
            elsewhere = np.full_like(elsewhere, np.inf)
        costs = np.append(elsewhere, min((put[self.holds.face(g)] for g in pool), default=np.inf))
        likely = _likely(costs) if np.isfinite(costs).any() else None
        other = _palms(inverse(given.X_PO))
        ways = self.rng.choice(len(costs), size=n, p=likely)
        guided = (self.rng.random(n) < 0.8) & (likely is not None)
        out = []
        for way in np.where(guided, ways, -1).tolist():
            if way == len(elsewhere):
                drawn = [pool[int(k)] for k in self.rng.integers(len(pool), size=_GRASP_DRAWS)]
            else:
                numbers = families[way] if way >= 0 else range(len(self.families[receiver, item]))
                drawn = [
                    self.workspace.draw_grasp(receiver, item, numbers[int(k)])
                    for k in self.rng.integers(len(numbers), size=_GRASP_DRAWS)
                ]
            apart = np.linalg.norm(_palms(inverse(np.array([g.X_PO for g in drawn]))) - other, axis=1)
            out.append(drawn[int(np.argmax(np.minimum(apart, _ROOM)))])
        return out

    def leads_on(
        self, given: Attachment, taken: Sequence[Attachment], seen: np.ndarray, *, directly: bool
    ) -> np.ndarray:
        """Which handovers (N,) are on a cheapest way to the goal; `seen` (N,): the place at the goal was.

        `directly`: which are followed by that place, if any such are known at all.
        """
        if not len(taken):
            return np.zeros(0, dtype=bool)
        if directly:
            return seen if self.pools.get((taken[0].parent, given.object)) else np.ones(len(taken), dtype=bool)
        put, elsewhere = self.estimates.from_faces(given, taken[0].parent)
        faces = [self.holds.face(g) for g in taken]
        best = min(put.min(), elsewhere.min())
        return np.minimum(np.where(seen, put[faces], np.inf), elsewhere[faces]) <= best + _TIE

    def room(self, item: str, robot: str, grasps: Sequence[Attachment]) -> np.ndarray:
        """Distance (m) of each grasp's palm to the farthest palm of another robot that leads on; at most _ROOM."""
        others = [g for (name, o), pool in self.pools.items() if o == item and name != robot for g in pool]
        palms = _palms(inverse(np.array([g.X_PO for g in others or grasps])))
        own = _palms(inverse(np.array([g.X_PO for g in grasps])))
        return np.minimum(np.linalg.norm(own[:, None] - palms, axis=2).max(axis=1), _ROOM)


def _random_rotations(rng: np.random.Generator, n: int, scale: float | None = None) -> np.ndarray:
    """Uniform rotations (n, 3, 3); with `scale`, small ones of about that angle (rad)."""
    q = rng.normal(size=(n, 4))
    if scale is not None:
        q = np.column_stack([np.ones(n), rng.normal(scale=scale / 2, size=(n, 3))])
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    w, x, y, z = q.T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )


def _palms(X_OG: np.ndarray) -> np.ndarray:
    """Where the bulk of the hand is (..., 3) for grasps (..., 4, 4)."""
    return X_OG[..., :3, 3] - _PALM * X_OG[..., :3, 2]


def _rotations_to(directions: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) whose third columns are along `directions` (n, 3)."""
    norm = np.linalg.norm(directions, axis=1, keepdims=True)
    z = np.where(norm > 1e-9, directions / np.maximum(norm, 1e-9), _UP)
    helper = np.where(np.abs(z[:, 2:]) < 0.9, _UP, [1.0, 0.0, 0.0])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def _rotations_about(z: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) whose third column is the unit vector `z`, turned about it by `angles`."""
    R = _rotations_to(z[None])[0]
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    return np.stack([c * R[:, 0] + s * R[:, 1], c * R[:, 1] - s * R[:, 0], np.tile(z, (len(angles), 1))], axis=2)


def _likely(costs: np.ndarray) -> np.ndarray:
    """Probabilities (N,) of ways on by their costs, one of which is finite."""
    p = np.exp((costs.min() - costs) / _TEMPER)
    return p / p.sum()
