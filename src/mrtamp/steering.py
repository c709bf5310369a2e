"""GetNeighbor and LazyValidate: which tensor neighbour a node is extended to (paper, algorithm 1; dRRT* oracle).

The informed oracle sends each active robot along its shortest roadmap path, validated lazily in the context of the
mode and of where the others stand; robots in the way are sent aside first.  The uninformed one takes random tensor
neighbours.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence

import numpy as np

from mrtamp.connect import Connector
from mrtamp.deadline import Deadline
from mrtamp.intra_orbit.lazy_validate import step_is_valid
from mrtamp.modes import Mode
from mrtamp.roadmap import Roadmap, lazy_path
from mrtamp.tensor_tree import At, Node, as_mapping
from mrtamp.validity import Validity

ROUNDS = 100
"""Lazy searches per path before the oracle gives up: a way out of a narrow place may take many, some 1 ms each."""
_ASIDE = 6
_ASIDE_ROUNDS = 8
"""The same for a robot that only has to get out of the way: there are other places to go to."""

_SEARCHES, _TREE = 4, 40
"""How often a way that the roadmap lacks is looked for between two vertices, and tree extensions, doubled each time."""
_LONG, _THOROUGH, _FAR_ROUND = 2.2, 1.4, 1.5
"""How many times as long as the straight line a path has to be, and how much longer (rad or m), for a shorter one to be
looked for: before there is a plan, and later."""
_SHORTER = 0.8
"""How long another has to be at most, relative to that, to be worth it."""
_DETOUR = 1.0
"""How much longer than the shortest path one past a random vertex may be, relative to it."""
Insert = Callable[[Node, At], Node]


class Steering:
    """Extends the tree towards roadmap vertices; every step it takes has been validated.

    Its searches raise `TimeIsUp` when the deadline has passed.

    Attributes
    ----------
    shorter : whether paths that go a long way round are looked at for a shorter one.
    thorough : whether that is worth more than one try, for paths that are not quite as long, too: once there is a plan.
    """

    def __init__(
        self,
        roadmaps: Sequence[Roadmap],
        validity: Validity,
        insert: Insert,
        rng: np.random.Generator,
        deadline: Deadline | None = None,
    ) -> None:
        self.roadmaps = list(roadmaps)
        self.validity = validity
        self.insert = insert
        self.rng = rng
        self.deadline = deadline or Deadline()
        self.index = {g.name: i for i, g in enumerate(roadmaps)}
        self.trouble: Counter[tuple[str, str]] = Counter()
        self.connector = Connector(validity, rng, self.deadline)
        self.shorter, self.thorough = True, False
        self._sought: Counter[tuple] = Counter()

    def drive(self, node: Node, targets: Mapping[str, int], depth: int = 1) -> Node | None:
        """Bring robots to target vertices, one after another, others standing; None if some cannot get there.

        Robots in the way are first sent aside, up to `depth` levels deep.  Orders of the active robots are tried in
        turn.
        """
        pending = [r for r, v in targets.items() if node.at[self.index[r]] != v]
        if not pending:
            return node
        for first in pending:
            order = [first, *[r for r in pending if r != first]]
            at: Node | None = node
            for robot in order:
                assert at is not None
                at = self._go(at, robot, targets[robot], depth)
                if at is None:
                    break
            if at is not None and all(at.at[self.index[r]] == v for r, v in targets.items()):
                return at
        return None

    def _go(self, node: Node, robot: str, goal: int, depth: int, aside: bool = False) -> Node | None:
        rounds = _ASIDE_ROUNDS if aside else ROUNDS
        path, blockers = self.path(node.mode, node.at, robot, goal, rounds=rounds, connect=not aside)
        if path is not None:
            return self._follow(node, robot, path)
        if depth <= 0 or not blockers:
            return None
        free, _ = self.path(node.mode, node.at, robot, goal, ignore=set(blockers))
        if free is None:
            return None
        for other, _ in blockers.most_common():
            # A robot that waits at its own target may step aside too; the caller notices and brings it back.
            moved = self._aside(node, other, robot, free, depth - 1)
            if moved is None:
                continue
            node = moved
            path, _ = self.path(node.mode, node.at, robot, goal)
            if path is not None:
                return self._follow(node, robot, path)
        return None

    def _aside(self, node: Node, other: str, robot: str, path: list[int], depth: int) -> Node | None:
        """Send `other` to a vertex from which it does not block `robot`'s path."""
        roadmap = self.roadmaps[self.index[other]]
        own = self.roadmaps[self.index[robot]]
        edges = [own.edge(a, b) for a, b in itertools.pairwise(path)]
        open_vertices = roadmap.open_vertices()
        random = [open_vertices[i] for i in self.rng.integers(len(open_vertices), size=_ASIDE)]
        here = node.at[self.index[other]]
        exits = [v for v in roadmap.exits.get(here, []) if v != here]
        for v in dict.fromkeys([0, *exits[::-1], *random]):
            if v == here:
                continue
            if not all(self.validity.against(robot, e, node.mode, other, v) for e in edges):
                continue
            moved = self._go(node, other, v, depth, aside=True)
            if moved is not None:
                return moved
        return None

    def path(
        self,
        mode: Mode,
        at: At,
        robot: str,
        goal: int,
        ignore: set[str] | None = None,
        rounds: int = ROUNDS,
        detour: bool = False,
        connect: bool = True,
        seek: bool = False,
    ) -> tuple[list[int] | None, Counter[str]]:
        """Shortest valid path of one robot while the others stand, and how often each of those was in the way.

        `detour` asks for a path past a random vertex that is not far out of the way, where there is one: other ways
        around things become plans too.  `connect`: where the roadmap has no way, look for one; that is too much
        for a robot that may as well go elsewhere.  `seek`: do so where it lacks only one past standing robots, too.
        """
        roadmap = self.roadmaps[self.index[robot]]
        start = at[self.index[robot]]
        roadmap.offer_direct(start, goal)
        standing = {r: v for r, v in as_mapping(self.roadmaps, at).items() if r != robot and r not in (ignore or ())}
        blockers: Counter[str] = Counter()

        def validate(e: int) -> bool:
            self.deadline.check()
            if not self.validity.edge(robot, e, mode):
                self.trouble[robot, "world"] += 1
                return False
            for other, v in standing.items():
                if not self.validity.against(robot, e, mode, other, v):
                    blockers[other] += 1
                    self.trouble[robot, other] += 1
                    return False
            return True

        def glance(edges: Sequence[int]) -> list[int]:
            self.deadline.check()
            found = self.validity.glance(robot, edges, mode)
            self.trouble[robot, "world"] += bool(found)
            return found

        for other, v in standing.items():
            # Verdicts of earlier searches hide behind the mask: they name blockers too.
            if self.validity.known(mode, (robot, mode.held.get(robot), other, v, mode.held.get(other))).hit:
                blockers[other] += 1
        blocked = self.validity.blocked(robot, mode, standing)
        if detour:
            path = self._past(roadmap, start, goal, blocked, validate, rounds, glance)
            if path is not None:
                return path, blockers
            blocked = self.validity.blocked(robot, mode, standing)
        others = {r: self.roadmaps[self.index[r]].q[v] for r, v in standing.items()} if seek else {}

        def join() -> list[int] | None:
            wanted = seek or (connect and not blockers)
            return self._joined(roadmap, mode, start, goal, others) if wanted else None

        path = self.connector.path(roadmap, start, goal, blocked, validate, rounds, join, glance)
        if path is not None and self.shorter and connect and not blockers:
            path = self._shorter(roadmap, mode, path, validate)
        return path, blockers

    def _past(
        self,
        roadmap: Roadmap,
        start: int,
        goal: int,
        blocked: np.ndarray,
        validate: Callable[[int], bool],
        rounds: int,
        glance: Callable[[Sequence[int]], list[int]],
    ) -> list[int] | None:
        there, back = (roadmap.distances_to(v, blocked) for v in (start, goal))
        vertices = np.array(roadmap.open_vertices())
        through = (there + back)[vertices]
        near = vertices[through <= (1 + self.rng.uniform(0, _DETOUR)) * there[goal] + 1e-9]
        near = near[(near != start) & (near != goal)]
        if not len(near):
            return None
        w = int(near[self.rng.integers(len(near))])
        one = lazy_path(roadmap, start, w, blocked, validate, rounds, glance)
        two = lazy_path(roadmap, w, goal, blocked, validate, rounds, glance) if one is not None else None
        return None if one is None or two is None else [*one, *two[1:]]

    def _joined(
        self, roadmap: Roadmap, mode: Mode, start: int, goal: int, standing: Mapping[str, np.ndarray]
    ) -> list[int] | None:
        """The roadmap has no way: look for one, harder each time, and ever more rarely where that is in vain."""
        key = (roadmap.name, mode.key, start, goal, *(x.tobytes() for x in standing.values()))
        tries = self._worth_seeking(*key)
        if not tries:
            return None
        return self.connector.connect(roadmap, mode, start, goal, _TREE << min(tries, _SEARCHES), standing)

    def _shorter(self, roadmap: Roadmap, mode: Mode, path: list[int], validate: Callable[[int], bool]) -> list[int]:
        """A path that goes a long way round, or a shorter one on the other side of what is in the way.

        Refinement never leaves the homotopy class of a path, and a sparse roadmap may know a poor one only.
        """
        start, goal = path[0], path[-1]
        length, direct = roadmap.path_length(path), roadmap.length(start, goal)
        if length < max((_THOROUGH if self.thorough else _LONG) * direct, direct + _FAR_ROUND):
            return path
        tries = self._worth_seeking("shorter", roadmap.name, mode.key, start, goal)
        if tries > 1 and not self.thorough:
            return path
        longest = _SHORTER * length
        effort = _TREE << min(tries, _SEARCHES) >> 1
        found = self.connector.connect(roadmap, mode, start, goal, effort, longest=longest) if tries else None
        if found is None or roadmap.path_length(found) > longest:
            return path
        return found if all(validate(roadmap.edge(u, v)) for u, v in itertools.pairwise(found)) else path

    def _worth_seeking(self, *key: Hashable) -> int:
        """The number of this try to find something, 0 where it is put off: ever more are, where tries are in vain."""
        self._sought[key] += 1
        tries = self._sought[key]
        return 0 if tries > _SEARCHES and tries & (tries - 1) else tries

    def _follow(self, node: Node, robot: str, path: list[int]) -> Node:
        i = self.index[robot]
        for v in path[1:]:
            node = self.insert(node, (*node.at[:i], v, *node.at[i + 1 :]))
        return node

    def random_step(self, node: Node) -> Node | None:
        """A uniformly random tensor neighbour, if the step is valid: every robot may move, at least one does."""
        at = list(node.at)
        movers = [i for i in range(len(at)) if self.rng.random() < 0.5]
        for i in movers or [int(self.rng.integers(len(at)))]:
            options = self.roadmaps[i].neighbours(at[i])
            if options:
                at[i] = options[int(self.rng.integers(len(options)))]
        new = tuple(at)
        if new == node.at or not self.step_is_valid(node.mode, node.at, new):
            return None
        return self.insert(node, new)

    def step_is_valid(self, mode: Mode, a: At, b: At) -> bool:
        """LazyValidate one synchronous step."""
        return step_is_valid(self.roadmaps, self.validity, mode, a, b)
