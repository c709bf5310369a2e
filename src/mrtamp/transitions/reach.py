"""Reach strata and candidates: subgoals that robots visit, optionally taking or releasing an object there.

A target of one robot is a configuration (rank n), a pose of its grasp frame (rank 6) or a box for the origin of that
frame (as many rows as the box has edges of length zero).  Ranks of the robots of one subgoal add (paper, equation 5).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mrtamp.kinematics import Tool, inverse, matrix, rotation_vectors
from mrtamp.modes import Attachment, Mode
from mrtamp.problem import AtConfiguration, HandAt, HandIn, Subgoal, Target
from mrtamp.transitions.candidate import Candidate, Outcome
from mrtamp.transitions.projection import solve_ik, uniform_configurations
from mrtamp.transitions.workspace import Workspace

_STEP = 1e-6
_SAME = 1e-9


class ReachTarget:
    """Where one robot has to be for a subgoal: h(q) = 0, its rank, and samples.

    Parameters
    ----------
    tool : the robot's grasp frame.
    target : configuration, pose or box.
    """

    def __init__(self, tool: Tool, target: Target) -> None:
        self.tool = tool
        self.target = target
        if isinstance(target, HandIn):
            self._X_CW = inverse(target.X_WC.GetAsMatrix4())
            self._half = np.asarray(target.size) / 2
            self._flat = np.flatnonzero(self._half == 0)

    @property
    def rank(self) -> int:
        """Number of independent constraints on this robot."""
        if isinstance(self.target, AtConfiguration):
            return self.tool.chain.n
        return 6 if isinstance(self.target, HandAt) else len(self._flat)

    @property
    def dimension(self) -> int:
        """Dimension of the set of configurations at the target."""
        return self.tool.chain.n - self.rank

    def h(self, q: np.ndarray) -> np.ndarray:
        """Constraint values (N, rank) at configurations q (N, n); rad and m."""
        if isinstance(self.target, AtConfiguration):
            return q - self.target.q
        R, p = self.tool.pose(q)
        if isinstance(self.target, HandAt):
            D = inverse(self.target.X_WG.GetAsMatrix4()) @ matrix(R, p)
            return np.concatenate([rotation_vectors(D[:, :3, :3]), D[:, :3, 3]], axis=1)
        return self._local(p)[:, self._flat]

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Dh (N, rank, n) by central differences."""
        N, n = q.shape
        steps = _STEP * np.eye(n)
        plus = self.h((q[:, None] + steps).reshape(-1, n)).reshape(N, n, -1)
        minus = self.h((q[:, None] - steps).reshape(-1, n)).reshape(N, n, -1)
        return np.swapaxes(plus - minus, 1, 2) / (2 * _STEP)

    def contains(self, q: np.ndarray, tolerance: float = 1e-6) -> np.ndarray:
        """Which configurations (N, n) are at the target (N,)."""
        on = np.all(np.abs(self.h(q)) <= tolerance, axis=1)
        if isinstance(self.target, HandIn):
            on &= np.all(np.abs(self._local(self.tool.pose(q)[1])) <= self._half + tolerance, axis=1)
        return on

    def _local(self, p: np.ndarray) -> np.ndarray:
        return p @ self._X_CW[:3, :3].T + self._X_CW[:3, 3]

    def sample(self, rng: np.random.Generator, n: int, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """n tries: configurations (n, dof) and which are at the target (n,).  `near` (M, dof) seeds half of them.

        Positive density over the whole target: the box is covered uniformly, postures by uniform IK seeds.
        """
        if isinstance(self.target, AtConfiguration):
            return self.target.q[None], np.ones(1, dtype=bool)
        seeds = uniform_configurations(self.tool, rng, n)
        half = rng.random(n) < 0.5
        seeds[half] = near[rng.integers(len(near), size=int(half.sum()))]
        R, p = self.tool.pose(seeds)
        if isinstance(self.target, HandAt):
            X = self.target.X_WG.GetAsMatrix4()
            R, p = np.tile(X[:3, :3], (n, 1, 1)), np.tile(X[:3, 3], (n, 1))
        else:
            # Towards the nearest point of the box or anywhere in it: paths often touch its edge.  By coordinate: hands
            # that move in a plane only cannot follow a coordinate out of it.
            anywhere = rng.uniform(-self._half, self._half, size=(n, 3))
            drawn = rng.random((n, 3)) < rng.random((n, 1))
            local = np.where(drawn, anywhere, np.clip(self._local(p), -self._half, self._half))
            p = (local - self._X_CW[:3, 3]) @ self._X_CW[:3, :3]
        q, solved = solve_ik(self.tool, R, p, seeds)
        return q, solved & self.contains(q, 1e-4)


class ReachSampler:
    """Candidates for subgoals, kept for ever; a configuration is a roadmap vertex of its robot."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace = workspace
        self.roadmaps = workspace.roadmaps
        self.targets: dict[str, dict[str, ReachTarget]] = {
            s.name: {r: ReachTarget(self.roadmaps[r].world.tool, t) for r, t in s.targets.items()}
            for s in workspace.problem.subgoals
        }
        self.vertices: dict[tuple[str, str], list[int]] = {}
        self._at: dict[str, list[dict[str, int]]] = {}
        self._attachments: dict[tuple, Attachment] = {}

    def enabled(self, mode: Mode, subgoal: Subgoal) -> bool:
        """Whether the subgoal may be reached next: its predecessors are, and its object is at hand."""
        if subgoal.name in mode.done or not set(subgoal.after) <= mode.done:
            return False
        if subgoal.attach is None:
            return True
        a = mode.of[subgoal.attach.object]
        if a.held and a.parent not in subgoal.targets:
            return False
        if subgoal.attach.object in mode.loaded:
            return False
        takes = subgoal.attach.parent in subgoal.targets
        return not (takes and subgoal.attach.parent in mode.held)

    def known(self, mode: Mode, subgoal: Subgoal) -> list[Candidate]:
        """Known ways to reach the subgoal from `mode`."""
        return [self.candidate(mode, subgoal, at) for at in self._at.get(subgoal.name, [])]

    def sample(self, mode: Mode, subgoal: Subgoal, n: int, keep: int = 4) -> list[Candidate]:
        """Sample configurations of every robot of the subgoal; returns the new candidates."""
        stats = self.workspace.outcome(("reach", tuple(subgoal.targets), self._object(subgoal), subgoal.name))
        stats.calls += 1
        fresh = {r: self._grow(subgoal.name, r, target, n, keep, stats) for r, target in self._targets(subgoal)}
        if not all(self.vertices.get((subgoal.name, r)) for r in subgoal.targets):
            return []
        known = self._at.setdefault(subgoal.name, [])
        out = []
        for k in range(max(1, *(len(f) for f in fresh.values())) if known else max(1, keep)):
            at = {}
            for r in subgoal.targets:
                options = fresh[r] or self.vertices[subgoal.name, r]
                i = k if k < len(options) else int(self.workspace.rng.integers(len(options)))
                at[r] = options[i]
            if at not in known:
                known.append(at)
                stats.accepted += 1
                out.append(self.candidate(mode, subgoal, at))
        return out

    def _targets(self, subgoal: Subgoal) -> list[tuple[str, ReachTarget]]:
        return list(self.targets[subgoal.name].items())

    @staticmethod
    def _object(subgoal: Subgoal) -> str:
        return subgoal.attach.object if subgoal.attach else ""

    def _grow(self, name: str, robot: str, target: ReachTarget, n: int, keep: int, stats: Outcome) -> list[int]:
        known = self.vertices.setdefault((name, robot), [])
        if known and target.dimension == 0 and isinstance(target.target, AtConfiguration):
            return []
        roadmap = self.roadmaps[robot]
        world = roadmap.world
        q, on = target.sample(self.workspace.rng, n, self.workspace.near(robot))
        stats.samples += len(q)
        stats.ik_solved += int(on.sum())
        if not isinstance(target.target, AtConfiguration):
            counts = self.workspace.collision.counts
            counts.ik_attempts += len(q)
            counts.ik_successes += int(on.sum())
        fresh: list[int] = []
        for x in q[on]:
            rows = world.rows(x[None], None, {})
            if world.first_hit(rows) >= 0:
                stats.collisions.update(b for pair in world.culprits(rows[0]) for b in pair if b != robot)
                continue
            known_vertex = roadmap.find(x, _SAME)
            fresh.append(roadmap.add_vertex(x) if known_vertex is None else known_vertex)
            self._note_contact(name, robot, fresh[-1])
            if len(fresh) == keep:
                break
        known += fresh
        return fresh

    def _note_contact(self, name: str, robot: str, v: int) -> None:
        """What a robot takes or releases at a vertex may touch what it rested or will rest on, on the way there."""
        subgoal = self.workspace.problem.subgoal(name)
        if subgoal.attach is None:
            return
        item, parent = subgoal.attach.object, subgoal.attach.parent
        below = parent if parent not in self.roadmaps else self.workspace.problem.object(item).start_on
        self.workspace.validity.touching[robot, v] = (item, below)

    def stands(self, name: str) -> list[dict[str, int]]:
        """Known combinations of vertices (robot -> vertex) at which a subgoal is reached."""
        return self._at.get(name, [])

    def candidate(self, mode: Mode, subgoal: Subgoal, at: Mapping[str, int]) -> Candidate:
        """The transition of standing at these vertices in `mode`."""
        before = after = None
        if subgoal.attach is not None:
            before = mode.of[subgoal.attach.object]
            after = self._attachment(mode, subgoal, at)
        return Candidate("reach", tuple(subgoal.targets), at, before, after, subgoal=subgoal.name)

    def _attachment(self, mode: Mode, subgoal: Subgoal, at: Mapping[str, int]) -> Attachment:
        """The object where it is on arrival, fixed to its new parent."""
        assert subgoal.attach is not None
        item, parent = subgoal.attach.object, subgoal.attach.parent
        chain = mode.chain(item)
        base = mode.chain(parent) if parent in mode.of else ()
        key = (subgoal.name, tuple(sorted(at.items())), chain, base)
        if key not in self._attachments:
            a = mode.of[item]
            validity = self.workspace.validity
            X_WO = self._hand(a.parent, at) @ a.X_PO if a.held else validity.world_pose(chain)
            if parent in subgoal.targets:
                X_PO, support = inverse(self._hand(parent, at)) @ X_WO, None
            else:
                X_PO, support = inverse(self.workspace.body_pose(mode, parent)) @ X_WO, f"at {subgoal.name}"
            self._attachments[key] = Attachment(item, parent, X_PO, support)
        return self._attachments[key]

    def _hand(self, robot: str, at: Mapping[str, int]) -> np.ndarray:
        roadmap = self.roadmaps[robot]
        return roadmap.world.tool.matrix(roadmap.q[[at[robot]]])[0]
