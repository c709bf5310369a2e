"""Growing the tensor tree through transitions: towards sampled ones, along whole skeletons, and to the goal.

Motion inside an orbit is the business of the intra-orbit planner; here modes change, goal nodes are noted, and the
tree is repaired where the judge refuted it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from mrtamp.check import Report
from mrtamp.deadline import Deadline
from mrtamp.graphs import Graphs
from mrtamp.insertion import Insertion
from mrtamp.intra_orbit.orbits import Orbits
from mrtamp.intra_orbit.planners import INTRA_ORBIT
from mrtamp.modes import Mode, goal_mode
from mrtamp.plan import Segment, Transition, without_detours
from mrtamp.problem import MrtampError, Problem
from mrtamp.roadmap import Roadmap, add_stations
from mrtamp.space_time import SpaceTime
from mrtamp.steering import Steering
from mrtamp.tensor_tree import At, Node, TensorTree
from mrtamp.transitions.candidate import Candidate
from mrtamp.validity import Validity

if TYPE_CHECKING:
    from mrtamp.skeleton_guidance import Proposal, SkeletonGuidance

Timed = tuple[list[Segment], list[Transition]]
"""Motions and the transitions between them."""
_VARIETY = 0.4
"""How often stops happen in another order, and legs take another way, when a skeleton is realised once more."""
_SAME = 1e-9
Combination = tuple[Candidate, ...]
"""Elementary transitions of disjoint robots that happen at the same instant."""


class Growth:
    """The tensor tree with its orbits, and every way in which it grows or is cut back.

    Attributes
    ----------
    goal_nodes : nodes that satisfy the goal.
    goal_vertices : robot -> the vertex where it has to end.
    """

    def __init__(
        self,
        problem: Problem,
        roadmaps: Mapping[str, Roadmap],
        validity: Validity,
        rng: np.random.Generator,
        intra_orbit: str = "tensor-tree",
        deadline: Deadline | None = None,
    ) -> None:
        self.problem = problem
        self.roadmaps = roadmaps
        self.names = list(roadmaps)
        self.validity = validity
        self.rng = rng
        self.counts = validity.counts
        self.graphs = Graphs()
        self.tree = TensorTree(list(roadmaps.values()), problem.cost)
        graphs = list(roadmaps.values())
        self.orbits = Orbits(self.tree, self.graphs, graphs, validity)
        deadline = deadline or Deadline()
        self.motion = INTRA_ORBIT[intra_orbit](graphs, validity, self._insert, rng, problem.cost, deadline)
        self.steering = Steering(graphs, validity, self._insert, rng, deadline)
        self.insertion = Insertion(roadmaps, validity.collision, validity, self.steering, rng)
        self.goal_vertices: dict[str, int] = {}
        self.goal_nodes: list[Node] = []
        self._banned: set[tuple] = set()

    def start(self, mode: Mode) -> Node:
        """The root: every robot at its start; final configurations become vertices too."""
        stations = add_stations(self.problem, self.roadmaps)
        self.goal_vertices = stations.goal
        root = self.tree.add_root(mode, tuple(stations.start.values()), self.graphs.add_orbit(mode))
        self.note_goal(root)
        return root

    # -- one transition -------------------------------------------------------------------------------------------

    def towards(self, near: Node, combination: Combination) -> Node | None:
        """Drive the active robots to their transition vertices and change the mode there; the node after it."""
        node = self.motion.drive(near, {r: v for c in combination for r, v in c.at.items()})
        return None if node is None else self._change_mode(node, combination)

    def _change_mode(self, node: Node, combination: Combination) -> Node | None:
        transition = Transition(tuple(c.action for c in combination))
        mode = node.mode.after(transition)
        if (mode.key, node.at) in self._banned:
            return None
        if self.validity.stand(mode, dict(zip(self.names, node.at, strict=True)), transition.active) is not None:
            return None
        cost = self.problem.cost.of_changes(c.kind for c in combination)
        known = self.tree.find(mode, node.at)
        after = self.orbits.enter(node, transition, mode, cost)
        if known is None:
            self.note_goal(after)
        return after

    def taken(self, mode: Mode, candidate: Candidate) -> bool:
        """Whether the tree has the mode that a candidate leads to."""
        return self.tree.entry(mode.after(Transition((candidate.action,)))) is not None

    # -- whole skeletons ------------------------------------------------------------------------------------------

    def realise(self, proposal: Proposal, skeletons: SkeletonGuidance, root: Node) -> Node | None:
        """Extend the tree along a skeleton, robots that are idle or done stepping aside; the goal node, or None.

        The stop at which it ends is reported to the guidance.
        """
        node = root
        for stop, way in proposal.stops:
            candidate = skeletons.candidate(stop, node.mode)
            after = None if candidate is None else self.towards(node, (candidate,))
            if after is None:
                skeletons.failed(way)
                return None
            node = after
        return self.towards_goal(node) if self.is_goal_mode(node.mode) else None

    def insert(
        self,
        proposal: Proposal,
        skeletons: SkeletonGuidance,
        root: Node,
        *,
        varied: bool = False,
        alone: bool = False,
        urgent: bool = False,
    ) -> Timed | None:
        """Realise a skeleton in space and time, motions of all robots inserted among each other; None if that fails.

        The stop at which it ends is reported to the guidance.  With `varied`, and where its order was realised before,
        order and ways are in part left to chance; that such an attempt fails is not held against the skeleton.
        `alone`: robots may collide with each other, for convex programs to pull apart.  `urgent`: the stop for which
        others wait the longest happens next, instead of the one that can happen soonest.
        """
        stops = [stop for stop, _ in proposal.stops]
        start = dict(zip(self.names, root.at, strict=True))
        timed = self.insertion.realise(
            root.mode,
            start,
            [s.robots for s in stops],
            proposal.before,
            lambda k, mode: skeletons.candidate(stops[k], mode),
            self.goal_vertices,
            _VARIETY if varied or proposal.repeated else 0.0,
            alone=alone,
            latest=skeletons.latest(proposal) if urgent else None,
        )
        if timed is None:
            assert self.insertion.stuck is not None
            if not varied:
                skeletons.failed(proposal.stops[self.insertion.stuck][1])
            return None
        return timed if self.is_goal_mode(timed[0][-1].mode) else None

    def adopt(self, segments: Sequence[Segment], transitions: Sequence[Transition], root: Node) -> Node:
        """Put a checked plan into the roadmaps and the tree, so that the search builds on it; its last node.

        Every knot becomes a vertex of its robots' roadmaps.  Its neighbours are rewired when the search next comes by.
        """
        node = root
        rewirings, self.orbits.rewirings = self.orbits.rewirings, 0
        for k, segment in enumerate(segments):
            for i in range(1, segment.length):
                node = self._insert(node, self._vertices(node, {r: q[i] for r, q in segment.q.items()}))
            if k < len(transitions):
                cost = self.problem.cost.of_changes(a.kind for a in transitions[k].actions)
                node = self.orbits.enter(node, transitions[k], segments[k + 1].mode, cost)
        self.orbits.rewirings = rewirings
        if self._is_goal(node) and node not in self.goal_nodes:
            self.goal_nodes.append(node)
        return node

    def _vertices(self, node: Node, q: Mapping[str, np.ndarray]) -> At:
        """The vertices of a composite configuration, made where there are none."""
        at = []
        for name, here in zip(self.names, node.at, strict=True):
            roadmap = self.roadmaps[name]
            if np.array_equal(roadmap.q[here], q[name]):
                at.append(here)
                continue
            goal = self.goal_vertices.get(name)
            if goal is not None and np.abs(roadmap.q[goal] - q[name]).max() < _SAME:
                at.append(goal)
                continue
            at.append(roadmap.add_vertex(q[name]))
        return tuple(at)

    def without_detours(self, root: Node, solution: Node) -> None:
        """Extend the tree by a solution without the picks that were put back where they came from."""
        steps = [x for x in self.tree.branch(solution) if x.transition is not None]
        kept = without_detours([x.transition.actions for x in steps if x.transition is not None])
        if len(kept) == len(steps):
            return
        at = root
        for k in kept:
            transition = steps[k].transition
            assert transition is not None
            vertices = dict(zip(self.names, steps[k].at, strict=True))
            combination = tuple(
                Candidate(a.kind, a.robots, {r: vertices[r] for r in a.robots}, a.before, a.after, subgoal=a.subgoal)
                for a in transition.actions
            )
            after = self.towards(at, combination)
            if after is None:
                return
            at = after
        if self.goal_vertices and self.is_goal_mode(at.mode):
            self.towards_goal(at)

    # -- goal -----------------------------------------------------------------------------------------------------

    def is_goal_mode(self, mode: Mode) -> bool:
        """Whether only robots still have to move."""
        return goal_mode(self.problem, mode, self.validity.X_WB)

    def towards_goal(self, near: Node) -> Node | None:
        """In a mode that satisfies the goal, bring the robots to where they have to end; the node there, or None."""
        together = self.motion.drive(near, self.goal_vertices)
        if together is not None:
            return together
        for name in [str(x) for x in self.rng.permutation(list(self.goal_vertices))]:
            near = self.motion.drive(near, {name: self.goal_vertices[name]}) or near
        # Whoever was sent aside comes back at the end.
        for name, v in self.goal_vertices.items():
            near = self.motion.drive(near, {name: v}, depth=0) or near
        return near if self._is_goal(near) else None

    def _is_goal(self, node: Node) -> bool:
        at = dict(zip(self.names, node.at, strict=True))
        return all(at[r] == v for r, v in self.goal_vertices.items()) and self.is_goal_mode(node.mode)

    def note_goal(self, node: Node) -> None:
        """Remember a node that satisfies the goal."""
        if self._is_goal(node):
            self.goal_nodes.append(node)

    def _insert(self, node: Node, at: At) -> Node:
        """InsertAndRewire: a validated step; orbits that it proves connected become one."""
        new, is_new = self.orbits.insert(node, at)
        self.counts.nodes = len(self.tree.nodes)
        if is_new:
            self.note_goal(new)
        return new

    # -- repair ---------------------------------------------------------------------------------------------------

    def repair(self, report: Report, groups: list[list[Node]]) -> None:
        """The judge found what samples had missed: that step, or that change of mode, is withdrawn."""
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
                self.orbits.refute_entries(after)
            if step + 1 < len(group):
                before, after = group[step], group[step + 1]
                carriers = {a.object: r for r, a in before.mode.held.items()}
                robots, obstacle = violation.guilty(carriers, self.roadmaps)
                self.orbits.refute(before, after, robots or tuple(self.names[:1]), obstacle)

    def refuted(self, report: Report, schedule: SpaceTime) -> bool:
        """Learn which moves of a schedule the judge objects to; whether the same schedule will not be found again."""
        learnt, alone = schedule.forbid(report)
        for blamed in alone:
            edge = self.insertion.edge_of(blamed.robot, blamed.move)
            if edge is not None:
                self.orbits.refute_edge(blamed.mode, blamed.robot, edge, blamed.obstacle)
                learnt = True
        return learnt
