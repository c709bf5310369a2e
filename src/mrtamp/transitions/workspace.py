"""What all transition samplers share: reach, grasp families, IK with counts, and a look ahead to the goal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mrtamp.collision import Collision
from mrtamp.kinematics import inverse
from mrtamp.modes import Attachment, Mode
from mrtamp.problem import AtPose, InRegion, Problem, Support
from mrtamp.roadmap import Roadmap
from mrtamp.transitions.candidate import Outcome, StratumKey
from mrtamp.transitions.families import FixedFamily, GraspFamily, grasp_families, placement_families
from mrtamp.transitions.holds import Holds
from mrtamp.transitions.projection import ITERATIONS, mixed_seeds, solve_ik
from mrtamp.transitions.reachability import ReachabilityMap
from mrtamp.validity import Validity

_UNSOLVED = 0.3
"""Weight of a look ahead for which IK found nothing, as an attempt in vain: other seeds may do better."""


class Workspace:
    """The scene as the samplers see it.

    Attributes
    ----------
    families : (robot, object) -> grasp families that fit the robot's gripper.
    maps : robot -> its reachability map.
    reach : robot -> centre (3,) and radius (m) of a ball that holds every grasp point seen in random configurations.
    goal_supports : object -> supports on which it satisfies its goal.
    outcomes : what became of all samples, per stratum.
    foreseen : what looking ahead at strata showed, without what may stand in the way there.
    holds : the same for robots and faces of objects.
    """

    def __init__(
        self,
        problem: Problem,
        collision: Collision,
        roadmaps: Mapping[str, Roadmap],
        validity: Validity,
        rng: np.random.Generator,
    ) -> None:
        self.problem = problem
        self.collision = collision
        self.roadmaps = roadmaps
        self.validity = validity
        self.rng = rng
        self.outcomes: dict[StratumKey, Outcome] = {}
        self.foreseen: dict[StratumKey, Outcome] = {}
        self._grasps: dict[tuple[str, str, int], Attachment] = {}
        self.families: dict[tuple[str, str], list[GraspFamily]] = {}
        self.maps: dict[str, ReachabilityMap] = {}
        self.reach: dict[str, tuple[np.ndarray, float]] = {}
        for robot in problem.robots:
            gripper = robot.model.gripper
            for item in problem.objects:
                fits = grasp_families(item, gripper.max_width, robot.name) if gripper else []
                self.families[robot.name, item.name] = fits
            reachable = ReachabilityMap(roadmaps[robot.name].world.tool)
            self.maps[robot.name] = reachable
            self.reach[robot.name] = (reachable.centre, reachable.radius)
        self.holds = Holds([r.name for r in problem.robots], self.families)
        self.goal_supports: dict[str, list[Support]] = {
            o.name: _goal_supports(problem, o.name) for o in problem.objects
        }

    def outcome(self, key: StratumKey) -> Outcome:
        """Statistics of a stratum."""
        return self.outcomes.setdefault(key, Outcome())

    def foresight(self, key: StratumKey) -> Outcome:
        """Statistics of looking ahead at a stratum."""
        return self.foreseen.setdefault(key, Outcome())

    def in_reach(self, robot: str, p: np.ndarray) -> bool:
        """Whether a point lies inside the ball that the robot's grasp point was seen to reach."""
        centre, radius = self.reach[robot]
        return bool(np.linalg.norm(p - centre) <= radius)

    def body_pose(self, mode: Mode, body: str) -> np.ndarray:
        if body in mode.of:
            return self.validity.world_pose(mode.chain(body))
        return self.validity.X_WB[body]

    def near(self, robot: str) -> np.ndarray:
        """Configurations around which short motions are likely: home and some open roadmap vertices."""
        roadmap = self.roadmaps[robot]
        open_vertices = roadmap.open_vertices()
        rows = self.rng.integers(len(open_vertices), size=4)
        return np.vstack(
            [roadmap.world.home[None], roadmap.world.home[None], roadmap.q[[open_vertices[i] for i in rows]]]
        )

    def seeds(self, robot: str, X_WG: np.ndarray, share: float = 0.1) -> np.ndarray:
        """IK seeds (N, n) for hand poses: a share from the map, the rest around home and the roadmap, or uniform.

        Seeds from the map converge where reach is scarce; those around home give postures that are cheap to get to.
        """
        tool = self.roadmaps[robot].world.tool
        out = mixed_seeds(tool, self.rng, len(X_WG), self.near(robot))
        mapped = self.rng.random(len(X_WG)) < share
        out[mapped] = self.maps[robot].seeds(X_WG[mapped], self.rng)
        return out

    def seeds_from(self, robot: str, X_WG: np.ndarray, q: np.ndarray, share: float) -> np.ndarray:
        """IK seeds (N, n) for hand poses after configurations q (N, n): half near those, a share from the map, the rest
        near home."""
        start = self.rng.random(len(q))
        out = np.where(start[:, None] < 0.5, q, self.roadmaps[robot].world.home)
        mapped = start >= 1 - share
        out[mapped] = self.maps[robot].seeds(X_WG[mapped], self.rng)
        return out + self.rng.normal(scale=0.3, size=q.shape)

    def ik(
        self, robot: str, X_WG: np.ndarray, seeds: np.ndarray, iterations: int = ITERATIONS
    ) -> tuple[np.ndarray, np.ndarray]:
        """Configurations (N, n) for hand poses (N, 4, 4), and which are solved; see `solve_ik`."""
        q, solved = solve_ik(self.roadmaps[robot].world.tool, X_WG[:, :3, :3], X_WG[:, :3, 3], seeds, iterations)
        self.collision.counts.ik_attempts += len(q)
        self.collision.counts.ik_successes += int(solved.sum())
        return q, solved

    def grasp(self, robot: str, item: str, family: GraspFamily, index: int, c: np.ndarray) -> Attachment:
        X_GO = inverse(family.pose(c[None]))[0]
        if isinstance(family, FixedFamily):
            key = (robot, item, index)
            if key not in self._grasps:
                self._grasps[key] = Attachment(item, robot, X_GO, None, family.width)
            return self._grasps[key]
        return Attachment(item, robot, X_GO, None, family.width)

    def draw_grasp(self, robot: str, item: str, f: int) -> Attachment:
        family = self.families[robot, item][f]
        return self.grasp(robot, item, family, f, self.rng.uniform(family.lower, family.upper))

    def look_ahead(self, mode: Mode, robot: str, item: str, grasps: Sequence[Attachment], q: np.ndarray) -> np.ndarray:
        """Joint distance from q to a place at the object's goal with each grasp; infinite where none was found.

        The places are solved by IK and free of collision with the world as it is fixed, nothing more: a ranking, not a
        filter.
        """
        reward = np.full(len(grasps), np.inf)
        if not len(grasps):
            return reward
        world = self.roadmaps[robot].world
        places: list[tuple[Support, dict[str, np.ndarray], np.ndarray]] = []
        for support in self.goal_supports[item]:
            body = support.body
            if body in mode.of and mode.of[body].held:
                continue
            chain = mode.chain(body) if body in mode.of else ()
            below = {a.object: self.validity.world_pose(chain[k:]) for k, a in enumerate(chain)}
            for f in placement_families(self.problem.object(item), support, self.problem.package_paths):
                c = self.rng.uniform(f.lower, f.upper, size=(len(grasps), len(f.lower)))
                places.append((support, below, self.body_pose(mode, body) @ f.pose(c)))
        if not places:
            return reward
        for name in dict.fromkeys(support.name for support, _, _ in places):
            self.foresight(("place", (robot,), item, name)).calls += 1
        if not any(self.in_reach(robot, X[0, :3, 3]) for _, _, X in places):
            return reward
        which = self.rng.integers(len(places), size=len(grasps)).tolist()
        X_WO = np.array([places[k][2][i] for i, k in enumerate(which)])
        X_WG = X_WO @ inverse(np.array([g.X_PO for g in grasps]))
        # The posture of the pick, or of home, makes for a short way; the map helps where neither converges.
        found, solved = self.ik(robot, X_WG, self.seeds_from(robot, X_WG, q, 0.15))
        for i, ok in enumerate(solved.tolist()):
            if not ok:
                self.holds.note_place(grasps[i], False, _UNSOLVED)
                continue
            support, below, _ = places[which[i]]
            stats = self.foresight(("place", (robot,), item, support.name))
            stats.ik_solved += 1
            rows = world.rows(found[i][None], grasps[i], below)
            if world.first_hit(rows, support.body, world.slot_of[item]) < 0:
                reward[i] = np.linalg.norm(found[i] - q[i])
                stats.accepted += 1
            self.holds.note_place(grasps[i], bool(np.isfinite(reward[i])))
        return reward


def _goal_supports(problem: Problem, item: str) -> list[Support]:
    out: list[Support] = []
    for condition in problem.goal:
        if isinstance(condition, InRegion) and condition.object == item:
            out.append(problem.support(condition.region))
        elif isinstance(condition, AtPose) and condition.object == item:
            out += [s for s in problem.supports if s.body == condition.on and _serves(s, condition, item)]
    return out


def _serves(support: Support, goal: AtPose, item: str) -> bool:
    """Whether putting `item` on `support` achieves the pose goal."""
    if support.objects is not None and item not in support.objects:
        return False
    if goal.X_BO is None:
        return True
    return support.X_BO is not None and support.X_BO.IsNearlyEqualTo(goal.X_BO, 1e-6)
