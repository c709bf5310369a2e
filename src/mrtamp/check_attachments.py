"""Is every attachment possible and every change of mode legal?  (Paper, section III: grasps, placements, transitions.)

A grasp must be one of the object's explicit grasps or lie inside one of its antipodal families; a resting object must
stand on one of its faces, inside its support's region, touching what it rests on.  Everything is derived from the
problem and the attachment; no sampler is consulted.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np

from mrtamp.check_contact import TOUCH
from mrtamp.check_reach import attaches, reach_rules, same_pose
from mrtamp.check_report import Report, Violation
from mrtamp.check_scene import JudgeScene
from mrtamp.kinematics import inverse
from mrtamp.modes import ANGLE_TOLERANCE, POSITION_TOLERANCE, Attachment, Mode
from mrtamp.plan import Action, Transition
from mrtamp.problem import WORLD, AntipodalGrasps, ExplicitGrasp, MovableObject, Support
from mrtamp.resting import bounding_box, face_normal, face_rotation

KINDS = {"pick": (False, True), "place": (True, False), "handover": (True, True), "reach": None}
"""Kinds of actions, and whether the object is held before and after."""


def carrier(mode: Mode, name: str) -> tuple[str, np.ndarray, bool]:
    """What ends the object's chain of parents, the object's pose in its frame, and whether it is a robot."""
    a = mode.of[name]
    X = a.X_PO
    while not a.held and a.parent in mode.of:
        a = mode.of[a.parent]
        X = a.X_PO @ X
    return a.parent, X, a.held


def has_cycle(mode: Mode) -> bool:
    """Whether some object rests on itself by way of others."""
    for name in mode.of:
        seen, a = {name}, mode.of[name]
        while not a.held and a.parent in mode.of:
            if a.parent in seen:
                return True
            seen.add(a.parent)
            a = mode.of[a.parent]
    return False


class AttachmentJudge:
    """Judges attachments and transitions of plans for one problem."""

    def __init__(self, world: JudgeScene) -> None:
        self.world = world
        self.problem = world.problem
        self.objects = {o.name: o for o in self.problem.objects}
        self.supports = {s.name: s for s in self.problem.supports}
        self.robots = {r.name: r for r in self.problem.robots}
        self.X_WB = {s.name: s.X_WB.GetAsMatrix4() for s in self.problem.statics} | {WORLD: np.eye(4)}

    # -- attachments ------------------------------------------------------------------------------------------------

    def rigid(self, a: Attachment, segment: int, report: Report) -> None:
        """The attachment is a rigid transform to a parent that exists."""
        parents: Mapping = self.robots if a.held else {**self.X_WB, **self.objects}
        if a.parent not in parents or a.parent == a.object:
            what = "held by" if a.held else "on"
            text = (
                f"{a.object} is {what} {a.parent!r}, expected one of {', '.join(p for p in parents if p != a.object)}"
            )
            report.add(Violation("attachment", text, segment))
            return
        X = np.asarray(a.X_PO)
        if X.shape != (4, 4) or not np.isfinite(X).all() or np.abs(X[3] - [0, 0, 0, 1]).max() > 0:
            report.add(Violation("attachment", f"the pose of {a.object} in {a.parent} is no rigid transform", segment))
        elif np.abs(X[:3, :3] @ X[:3, :3].T - np.eye(3)).max() > 1e-6 or np.linalg.det(X[:3, :3]) < 0:
            report.add(Violation("attachment", f"the pose of {a.object} in {a.parent} is not rigid", segment))

    def legal(self, a: Attachment, start: Attachment, segment: int, report: Report) -> None:
        """The attachment is a legal grasp, or a legal place to rest."""
        why = self._grasp(a) if a.held else self._rest(a, start)
        if why:
            report.add(Violation("grasp" if a.held else "rest", f"{a.object} {why}", segment))

    def _grasp(self, a: Attachment) -> str | None:
        """What is wrong with a grasp."""
        if a.width is None and any(attaches(s, a) for s in self.problem.subgoals):
            return None
        thing, robot = self.objects[a.object], self.robots[a.parent]
        gripper = robot.model.gripper
        if gripper is None:
            return f"is held by {robot.name}, which has no gripper"
        if a.width is None or not np.isfinite(a.width):
            return f"is held by {robot.name} without a finger width"
        if not 0 <= a.width <= gripper.max_width + 1e-9:
            return f"is held at a width of {a.width:g} m, expected at most {gripper.max_width:g} m"
        X_OG = inverse(a.X_PO)
        reasons = []
        for grasp in thing.grasps:
            if grasp.robots is not None and robot.name not in grasp.robots:
                reasons.append(f"only for {', '.join(grasp.robots)}")
                continue
            why = (
                _explicit(grasp, X_OG, a.width)
                if isinstance(grasp, ExplicitGrasp)
                else _antipodal(thing, grasp, X_OG, a.width)
            )
            if why is None:
                return None
            reasons.append(why)
        return f"is held by {robot.name} by none of its grasps: {'; '.join(reasons) or 'it has none'}"

    def _rest(self, a: Attachment, start: Attachment) -> str | None:
        """What is wrong with the place where an object rests."""
        thing = self.objects[a.object]
        tolerance = self.problem.collision.tolerance
        if any(attaches(s, a) for s in self.problem.subgoals):
            gap = self._gap(a)
            # It is fixed where it was let go, in the air if need be.
            if gap is None or gap >= -TOUCH - tolerance:
                return None
            return f"is fixed {-gap * 1e3:.1f} mm inside {a.parent}, expected to be outside"
        support = self.supports.get(a.support or "")
        if support is not None:
            why = self._on_support(thing, support, a)
            if why:
                return why
        elif not (a.support == start.support and a.parent == start.parent and same_pose(a.X_PO, start.X_PO)):
            return f"rests on {a.support!r}, expected one of the supports {', '.join(self.supports)}"
        gap = self._gap(a)
        if gap is not None and not -TOUCH - tolerance <= gap <= TOUCH:
            where = f"{gap * 1e3:.1f} mm away from" if gap > 0 else f"{-gap * 1e3:.1f} mm inside"
            return f"rests {where} {a.parent}, expected to touch it within {TOUCH * 1e3:g} mm"
        return None

    def _on_support(self, thing: MovableObject, support: Support, a: Attachment) -> str | None:
        if support.body != a.parent:
            return f"rests on {a.parent} at {support.name!r}, expected on {support.body}"
        if support.objects is not None and thing.name not in support.objects:
            return f"rests on {support.name!r}, expected one of {', '.join(support.objects)} there"
        if support.X_BO is not None:
            exact = same_pose(a.X_PO, support.X_BO.GetAsMatrix4())
            return None if exact else f"is not at the exact pose of {support.name!r}"
        X_SO = inverse(support.X_BS.GetAsMatrix4()) @ a.X_PO
        half = np.maximum(np.asarray(support.size) / 2 - support.margin, 0.0)
        outside = float((np.abs(X_SO[:2, 3]) - half).max())
        if outside > POSITION_TOLERANCE:
            margin = f" less its margin of {support.margin:g} m" if support.margin else ""
            return f"lies {outside * 1e3:.2f} mm outside {support.name!r}{margin}"
        faces = {f: float(-(X_SO[:3, :3] @ face_normal(f))[2]) for f in thing.resting_faces}
        face = max(faces, key=lambda f: faces[f])
        if np.arccos(np.clip(faces[face], -1, 1)) > ANGLE_TOLERANCE:
            return f"does not stand upright on one of its faces {', '.join(thing.resting_faces)} on {support.name!r}"
        lower, upper = bounding_box(thing, self.problem.package_paths)
        axis = "xyz".index(face[1])
        height = float(upper[axis] if face[0] == "+" else -lower[axis])
        if abs(X_SO[2, 3] - height) > TOUCH:
            return f"is {(X_SO[2, 3] - height) * 1e3:+.1f} mm off the surface of {support.name!r}"
        R = X_SO[:3, :3] @ face_rotation(face).matrix().T
        yaw, (low, high) = np.arctan2(R[1, 0], R[0, 0]), support.yaw
        turns = (yaw - low + ANGLE_TOLERANCE) % (2 * np.pi)
        if turns > high - low + 2 * ANGLE_TOLERANCE:
            return f"is turned by {np.degrees(yaw):.1f} degrees on {support.name!r}, outside its yaw range"
        return None

    def _gap(self, a: Attachment) -> float | None:
        """Signed distance (m) between a resting object and its parent; None where they have no solids that collide."""
        solids = product(self.world.of.get(a.object, []), self.world.of.get(a.parent, []))
        pairs = [pair for pair in solids if self.world.may_collide(*pair)]
        if not pairs:
            return None
        X_WP = self.X_WB.get(a.parent, np.eye(4))
        poses = {a.object: X_WP @ a.X_PO}
        if a.parent in self.objects:
            poses[a.parent] = X_WP
        z = self.world.base[self.world.columns][None]
        query = self.world.query(self.world.positions(z, poses)[0])
        return min(self.world.distance(query, *pair) for pair in pairs)

    # -- transitions ------------------------------------------------------------------------------------------------

    def transition(self, k: int, transition: Transition, before: Mode, after: Mode, report: Report) -> None:
        """The change of mode at the end of segment k is what its actions say, and each of them is legal."""

        def wrong(text: str) -> None:
            report.add(Violation("transition", f"transition {k}: {text}", k))

        changed = {n for n in before.of if before.of[n] is not after.of[n]}
        named = [action.object for action in transition.actions if action.object is not None]
        if not transition.actions:
            wrong("nothing happens, expected at least one action")
        if len(set(named)) != len(named):
            wrong("an object takes part in two actions")
        robots = [r for action in transition.actions for r in action.robots]
        if len(set(robots)) != len(robots):
            wrong(f"a robot takes part in two simultaneous actions ({', '.join(sorted(robots))})")
        if set(named) != changed:
            wrong(f"the actions change {sorted(named)}, the modes differ in {sorted(changed)}")
            return
        reached = {action.subgoal for action in transition.actions if action.subgoal is not None}
        if after.done != before.done | reached:
            wrong(f"the actions reach {sorted(reached)}, the modes say {sorted(before.done)} and {sorted(after.done)}")
        for action in transition.actions:
            why = self._action(action, before, after)
            if why:
                wrong(f"{action.kind} of {action.subgoal or action.object}: {why}")

    def _action(self, action: Action, before: Mode, after: Mode) -> str | None:
        """What is wrong with one action."""
        old, new = action.before, action.after
        if action.kind not in KINDS:
            return f"unknown kind, expected {', '.join(KINDS)}"
        if action.kind == "reach":
            why = reach_rules(self.problem, action, before)
        elif action.subgoal is not None:
            why = "only a reach reaches a subgoal"
        else:
            why = "no object is changed" if old is None or new is None else None
        if why or old is None or new is None:
            return why
        if old is not before.of.get(new.object) or new is not after.of.get(new.object):
            return "its attachments are not those of the modes before and after"
        return self._change(action, old, new, before, after)

    def _change(self, action: Action, old: Attachment, new: Attachment, before: Mode, after: Mode) -> str | None:
        """What is wrong with what an action does to an object."""
        if before.loaded & {new.object}:
            on_it = [a.object for a in before.attachments if not a.held and a.parent == new.object]
            return f"{', '.join(on_it)} rests on it"
        if action.kind != "reach":
            if (old.held, new.held) != KINDS[action.kind]:
                return "that is not what happens to its attachment"
            expected = tuple(a.parent for a in (old, new) if a.held)
            if tuple(action.robots) != expected:
                return f"the robots are {', '.join(action.robots)}, expected {', '.join(expected)}"
            if (new.width is None) if new.held else any(attaches(s, new) for s in self.problem.subgoals):
                return "only a reach fixes an object like that"
        if new.held and (old.parent == new.parent if old.held else False):
            return f"{new.parent} already holds it"
        if new.held and new.parent in before.held:
            return f"the hand of {new.parent} is not empty: it holds {before.held[new.parent].object}"
        if not new.held and new.parent in after.of and carrier(after, new.parent)[2]:
            return f"{new.parent}, on which it is put, is held in the air"
        return None


def _explicit(grasp: ExplicitGrasp, X_OG: np.ndarray, width: float) -> str | None:
    if not same_pose(X_OG, grasp.X_OG.GetAsMatrix4()):
        return "not the pose of an explicit grasp"
    return None if abs(width - grasp.width) <= POSITION_TOLERANCE else f"width {width:g}, expected {grasp.width:g}"


def _antipodal(thing: MovableObject, grasp: AntipodalGrasps, X_OG: np.ndarray, width: float) -> str | None:
    """What keeps a grasp out of a family: approach, closing axis, width, centring, offset, depth."""
    shape = thing.shape
    if shape is None:
        return "antipodal grasps need a primitive shape"
    along, closing, approach = X_OG[:3, 0], X_OG[:3, 1], X_OG[:3, 2]
    point = X_OG[:3, 3]
    if not _approach_listed(shape.kind, grasp.approaches, approach):
        return f"approach {np.round(approach, 4).tolist()} is none of {', '.join(grasp.approaches)}"
    extent = np.array(shape.size) if shape.kind == "box" else np.full(3, 2 * shape.size[0])
    if shape.kind in ("cylinder", "capsule"):
        extent[2] = 2 * shape.half_height
        # Flat or round ends are gripped nowhere: the fingers close across the axis, at any angle around it.
        fits = abs(closing[2]) <= ANGLE_TOLERANCE
    elif shape.kind == "sphere":
        fits = True
    else:
        fits = any(_angle(closing, sign * np.eye(3)[i]) <= ANGLE_TOLERANCE for i in range(3) for sign in (1, -1))
    if not fits:
        return f"the fingers close along {np.round(closing, 4).tolist()}, not across two opposite faces"
    size = float(extent[int(np.argmax(np.abs(closing)))])
    if abs(width - size) > POSITION_TOLERANCE:
        return f"width {width:g}, expected {size:g}, the object's extent between the fingers"
    if abs(point @ closing) > POSITION_TOLERANCE:
        return f"off centre between the fingers by {abs(point @ closing) * 1e3:.1f} mm"
    if abs(point @ along) > grasp.offset + POSITION_TOLERANCE:
        return f"offset {abs(point @ along) * 1e3:.1f} mm, expected at most {grasp.offset * 1e3:.1f} mm"
    if shape.kind in ("cylinder", "capsule") and abs(approach[2]) <= ANGLE_TOLERANCE:
        # From the side flat fingers touch a round body where it is widest: there is no depth to choose.
        behind = abs(float(point @ approach))
        return None if behind <= POSITION_TOLERANCE else f"{behind * 1e3:.1f} mm off the axis"
    thickness = float(extent[int(np.argmax(np.abs(approach)))])
    depth = float(point @ approach) + thickness / 2
    if not grasp.depth[0] - POSITION_TOLERANCE <= depth <= grasp.depth[1] + POSITION_TOLERANCE:
        return f"depth {depth * 1e3:.1f} mm, expected {grasp.depth[0] * 1e3:.1f} to {grasp.depth[1] * 1e3:.1f} mm"
    return None


def _angle(u: np.ndarray, v: np.ndarray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v))


def _approach_listed(kind: str, approaches: tuple[str, ...], approach: np.ndarray) -> bool:
    """Whether a direction is one of the family's; around a cylinder every side is like every other."""
    listed = [face_normal(a) for a in approaches]
    if any(_angle(approach, direction) <= ANGLE_TOLERANCE for direction in listed):
        return True
    return kind in ("cylinder", "capsule") and abs(approach[2]) <= ANGLE_TOLERANCE and any(d[2] == 0 for d in listed)
