"""The referee: is a path a solution of a peer problem, and what does it cost?  By the peer's own rules alone.

One scene of all shapes (no plant: poses come from the peer's frame tree), exactly the listed pairs in each mode, and
the sum of their penetrations against the tolerance at every joint step.  Neither mrtamp's planner nor its checker, nor
its kinematics, has a part in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    CollisionFilterDeclaration,
    Cylinder,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    GeometrySet,
    ProximityProperties,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform

from mrtamp.plan import Plan

from .data import Pair, Peer

STEP = 0.02
"""Largest difference (rad or m) of any joint between two checked configurations."""
EXACT = 1e-6
"""How far (rad or m) a joint may be from where it has to be."""
_MAKERS = {"box": Box, "capsule": Capsule, "cylinder": Cylinder, "sphere": Sphere}


@dataclass(frozen=True, eq=False)
class Leg:
    """Synchronous waypoints q (K, n) of the composite configuration, and the tasks that are done at its end."""

    q: np.ndarray
    done: tuple[str, ...]


@dataclass
class Verdict:
    """What is wrong with a path (nothing: `ok`), its price, and how close to the tolerance it comes."""

    wrong: list[str] = field(default_factory=list)
    price: float = 0.0
    worst: float = 0.0
    configurations: int = 0

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.wrong

    def __str__(self) -> str:
        if self.ok:
            return f"accepted, price {self.price:.4f}, worst penetration {self.worst * 1e3:.2f} mm"
        return f"REJECTED: {self.wrong[0]}" + (f" (and {len(self.wrong) - 1} more)" if self.wrong[1:] else "")


@dataclass(frozen=True, eq=False)
class State:
    """Where the objects are: object -> (frame, X_FO), and the pairs that no longer count."""

    objects: Mapping[str, tuple[str, np.ndarray]]
    released: Mapping[str, frozenset[Pair]]

    def off(self) -> frozenset[Pair]:
        """All pairs that do not count."""
        return frozenset().union(*self.released.values())


class Referee:
    """Judges paths of one peer problem."""

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        self._graph = SceneGraph()
        self._source = self._graph.RegisterSource("peer")
        self._frames, geometry = {}, {}
        for name in sorted(peer.colliding):
            shape = peer.frames[name].shape
            assert shape is not None, f"{name} is in a collision pair without having a shape"
            frame = self._graph.RegisterFrame(self._source, GeometryFrame(name))
            instance = GeometryInstance(RigidTransform(), _MAKERS[shape[0]](*shape[1]), name)
            instance.set_proximity_properties(ProximityProperties())
            geometry[name] = self._graph.RegisterGeometry(self._source, frame, instance)
            self._frames[name] = frame
        self._names = {g: name for name, g in geometry.items()}
        self._geometry = geometry
        manager = self._graph.collision_filter_manager()
        manager.Apply(CollisionFilterDeclaration().ExcludeWithin(GeometrySet(list(geometry.values()))))
        for a, b in map(sorted, peer.pairs):
            manager.Apply(CollisionFilterDeclaration().AllowBetween(GeometrySet(geometry[a]), GeometrySet(geometry[b])))
        self._context = self._graph.CreateDefaultContext()
        self._port = self._graph.get_source_pose_port(self._source)

    # -- geometry -----------------------------------------------------------------------------------------------------

    def start(self) -> State:
        """Every object where it starts."""
        frames = self.peer.frames
        return State({o: (frames[o].parent or "", frames[o].X_PF) for o in self.peer.objects}, {})

    def poses(self, q: np.ndarray, state: State) -> dict[str, np.ndarray]:
        """World poses (N, 4, 4) of all frames at composite configurations q (N, n)."""
        X = self.peer.poses(q)
        for name, (frame, X_FO) in state.objects.items():
            X[name] = X[frame] @ X_FO
        return X

    def penetrations(self, q: np.ndarray, state: State) -> list[dict[Pair, float]]:
        """Depth (m) of every pair that penetrates, for each of the configurations q (N, n)."""
        X = self.poses(q, state)
        off = state.off()
        out = []
        for i in range(len(q)):
            vector = FramePoseVector()
            for name, frame in self._frames.items():
                vector.set_value(frame, RigidTransform(X[name][i]))
            self._port.FixValue(self._context, vector)
            query = self._graph.get_query_output_port().Eval(self._context)
            found: dict[Pair, float] = {}
            for p in query.ComputePointPairPenetration():
                pair = frozenset((self._names[p.id_A], self._names[p.id_B]))
                if pair not in off:
                    # The depth of this query is not along the shortest way out, unlike that of the benchmark.
                    found[pair] = -query.ComputeSignedDistancePairClosestPoints(p.id_A, p.id_B).distance
            out.append(found)
        return out

    def attach(self, state: State, q: np.ndarray, task: str) -> State:
        """The state after `task` is done at the composite configuration q (n,)."""
        t = self.peer.tasks[task]
        if t.object is None or t.parent is None:
            return state
        X = self.poses(q[None], state)
        X_PO = np.linalg.inv(X[t.parent][0]) @ X[t.object][0]
        return State(
            {**state.objects, t.object: (t.parent, X_PO)},
            {**state.released, t.object: self.peer.released_pairs[t.object, t.parent]},
        )

    # -- paths --------------------------------------------------------------------------------------------------------

    def judge(self, legs: Sequence[Leg]) -> Verdict:
        """Judge a path; the problem's last task has to hold at its end whether a leg says so or not."""
        peer, verdict = self.peer, Verdict()
        state, done = self.start(), list[str]()
        at = peer.start
        for k, leg in enumerate(legs):
            if leg.q.ndim != 2 or leg.q.shape[1] != len(peer.start) or not np.isfinite(leg.q).all():
                verdict.wrong.append(f"leg {k}: waypoints of shape {leg.q.shape}, expected (K, {len(peer.start)})")
                return verdict
            if np.abs(leg.q[0] - at).max() > EXACT:
                verdict.wrong.append(f"leg {k} begins {np.abs(leg.q[0] - at).max():.3g} from where the robots are")
            self._limits(k, leg.q, verdict)
            self._free(k, leg.q, state, verdict)
            verdict.price += self.price(leg.q)
            at = leg.q[-1]
            # At one instant things happen in the order in which they have to.
            for name in sorted(leg.done, key=list(peer.tasks).index):
                self._reached(k, name, at, done, verdict)
                state = self.attach(state, at, name)
                done.append(name)
        if peer.last.name not in done:
            self._reached(len(legs) - 1, peer.last.name, at, done, verdict)
            done.append(peer.last.name)
        if missing := [name for name in peer.tasks if name not in done]:
            verdict.wrong.append(f"not done: {', '.join(missing)}")
        return verdict

    def price(self, q: np.ndarray) -> float:
        """Cost of waypoints q (K, n)."""
        steps = np.diff(q, axis=0)
        lengths = np.array([np.linalg.norm(steps[:, c], axis=1) for c in self.peer.columns.values()])
        makespan, path_length = self.peer.weights
        return float(makespan * lengths.max(axis=0).sum() + path_length * lengths.sum())

    def _limits(self, k: int, q: np.ndarray, verdict: Verdict) -> None:
        excess = np.maximum(self.peer.lower - q, q - self.peer.upper).max(axis=0)
        for j in np.flatnonzero(excess > EXACT):
            verdict.wrong.append(f"leg {k}: {self.peer.dof_names[j]} is {excess[j]:.3g} beyond its limits")

    def _free(self, k: int, q: np.ndarray, state: State, verdict: Verdict) -> None:
        dense = [q[:1]]
        for a, b in pairwise(q):
            n = max(1, int(np.ceil(np.abs(b - a).max() / STEP)))
            dense.append(a + np.arange(1, n + 1)[:, None] / n * (b - a))
        samples = np.concatenate(dense)
        for i, found in enumerate(self.penetrations(samples, state)):
            total = sum(found.values())
            verdict.worst = max(verdict.worst, total)
            verdict.configurations += 1
            if total > self.peer.tolerance:
                pair = max(found, key=lambda p: found[p])
                verdict.wrong.append(
                    f"leg {k}, sample {i} of {len(samples)}: {total * 1e3:.2f} mm of penetration, most of it "
                    f"{' and '.join(sorted(pair))}"
                )

    def _reached(self, k: int, name: str, at: np.ndarray, done: Sequence[str], verdict: Verdict) -> None:
        task = self.peer.tasks[name]
        for robot, q in task.q.items():
            gap = np.abs(at[self.peer.columns[robot]] - q).max()
            if gap > EXACT:
                verdict.wrong.append(f"end of leg {k}: {robot} is {gap:.3g} from the goal of {name}")
        if name in done:
            verdict.wrong.append(f"end of leg {k}: {name} is done twice")
        if early := [other for other in self.peer.after[name] if other not in done]:
            verdict.wrong.append(f"end of leg {k}: {name} is done before {', '.join(early)}")


def legs_of(peer: Peer, plan: Plan) -> list[Leg]:
    """A plan as the referee sees it: its waypoints, and the tasks its transitions say are done."""
    legs = []
    for k, segment in enumerate(plan.segments):
        q = np.empty((segment.length, len(peer.start)))
        for robot, columns in peer.columns.items():
            q[:, columns] = segment.q[robot]
        actions = plan.transitions[k].actions if k < len(plan.transitions) else ()
        unknown = [a for a in actions if a.subgoal is None]
        if unknown:
            raise ValueError(f"transition {k} does something that no task asks for: {unknown}")
        legs.append(Leg(q, tuple(a.subgoal for a in actions if a.subgoal is not None)))
    return legs
