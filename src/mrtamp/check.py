"""The judge: is a plan really a solution of its problem?  Everything is derived again from problem and plan alone.

`check_plan` builds the full plant of all robots and all objects, and judges structure, limits, start, goal,
attachments, mode changes, cost, and every instant of the motion (`check_motion`).  It shares no cache and no shortcut
with the planner; nothing is returned to a user that did not pass it (paper, problem statement).
"""

from __future__ import annotations

import time
from itertools import pairwise

import numpy as np

from mrtamp.check_attachments import AttachmentJudge, carrier, has_cycle
from mrtamp.check_contact import Contact, contact_phase, held_pairs
from mrtamp.check_motion import Motion, MotionJudge, Timeline
from mrtamp.check_reach import not_there, same_pose
from mrtamp.check_report import FirstViolation, Report, Side, Violation
from mrtamp.check_scene import JudgeScene
from mrtamp.modes import JOINT_TOLERANCE, POSITION_TOLERANCE, Attachment, Mode, start_mode
from mrtamp.plan import Plan, Segment, Transition, plan_cost
from mrtamp.problem import AtPose, HeldBy, InRegion, Problem, RobotAt

__all__ = ["Checker", "Report", "Side", "Violation", "check_plan"]

RESOLUTION = 0.002
EXACT = 1e-9
COST_TOLERANCE = 1e-6


def check_plan(plan: Plan, resolution: float = RESOLUTION, first_violation_only: bool = False) -> Report:
    """Judge `plan` against its own problem.

    Parameters
    ----------
    resolution : displacement (m) of any robot point between two samples where motion is not certified by distances.
    first_violation_only : stop at the first thing that is wrong.
    """
    return Checker(plan.problem).check(plan, resolution, first_violation_only)


class Checker:
    """The judge of one problem; its plant is built once, and nothing about one plan is remembered for the next."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.world = JudgeScene(problem)
        self.attachments = AttachmentJudge(self.world)

    def check(self, plan: Plan, resolution: float = RESOLUTION, first_violation_only: bool = False) -> Report:
        """Judge a plan of this problem; see `check_plan`."""
        if plan.problem is not self.problem:
            raise ValueError("the plan belongs to another problem than this checker; use check_plan")
        began = time.perf_counter()
        report = Report(first_only=first_violation_only)
        try:
            self._structure(plan, report)
            if report.ok:
                self._configurations(plan, report)
                self._modes(plan, report)
                self._goal(plan, report)
                self._cost(plan, report)
                if "attachment" not in report.kinds:
                    self._motion(plan, resolution, report)
        except FirstViolation:
            pass
        report.elapsed = time.perf_counter() - began
        return report

    # -- numbers ----------------------------------------------------------------------------------------------------

    def _structure(self, plan: Plan, report: Report) -> None:
        """Names, shapes and numbers; without them nothing else can be judged."""
        robots = {r.name: len(r.model.arm_joints) for r in self.problem.robots}
        objects = {o.name for o in self.problem.objects}
        if not plan.segments:
            report.add(Violation("structure", "the plan has no segments"))
        if len(plan.transitions) != max(len(plan.segments) - 1, 0):
            text = (
                f"{len(plan.transitions)} transitions, expected one between every two of {len(plan.segments)} segments"
            )
            report.add(Violation("structure", text))
        for k, segment in enumerate(plan.segments):
            if set(segment.q) != set(robots):
                report.add(Violation("structure", f"robots {sorted(segment.q)}, expected {sorted(robots)}", k))
                continue
            shapes = {name: np.shape(q) for name, q in segment.q.items()}
            if any(len(s) != 2 or s[0] < 1 or s[1] != robots[n] for n, s in shapes.items()):
                report.add(Violation("structure", f"waypoints of shapes {shapes}, expected (K, n) with {robots}", k))
            elif len({s[0] for s in shapes.values()}) != 1:
                report.add(Violation("structure", f"not the same number of waypoints for all robots: {shapes}", k))
            elif not all(np.isfinite(q).all() for q in segment.q.values()):
                report.add(Violation("structure", "a joint position is not a finite number", k))
            names = [a.object for a in segment.mode.attachments]
            if sorted(names) != sorted(objects):
                report.add(Violation("structure", f"the mode attaches {sorted(names)}, expected {sorted(objects)}", k))
            elif has_cycle(segment.mode):
                report.add(Violation("structure", "objects rest on each other in a circle", k))

    def _configurations(self, plan: Plan, report: Report) -> None:
        """Joint limits, the start configuration, and continuity from segment to segment."""
        for k, segment in enumerate(plan.segments):
            for name, q in segment.q.items():
                arm = self.world.arm[name]
                excess = np.maximum(self.world.lower[arm] - q, q - self.world.upper[arm])
                i, j = np.unravel_index(int(np.argmax(excess)), excess.shape)
                if excess[i, j] > EXACT:
                    joint = self.problem.robot(name).model.arm_joints[j]
                    text = f"{joint} of {name} is {excess[i, j]:.2g} beyond its limits"
                    report.add(
                        Violation("limits", text, k, max(min(int(i), len(q) - 2), 0), float(i > 0), float(excess[i, j]))
                    )
        for robot in self.problem.robots:
            gap = float(np.abs(plan.segments[0].q[robot.name][0] - robot.start).max())
            if gap > EXACT:
                report.add(Violation("start", f"{robot.name} is {gap:.3g} from its start", 0, 0, 0.0, gap))
            for k, (one, two) in enumerate(pairwise(plan.segments)):
                gap = float(np.abs(one.q[robot.name][-1] - two.q[robot.name][0]).max())
                if gap > EXACT:
                    text = f"{robot.name} jumps by {gap:.3g} to segment {k + 1}"
                    report.add(Violation("continuity", text, k, max(one.length - 2, 0), 1.0, gap))

    def _cost(self, plan: Plan, report: Report) -> None:
        """The stated cost is that of the motion, and the history ends with it."""
        cost = plan_cost(plan.segments, plan.transitions, self.problem.cost)
        if not abs(plan.cost - cost) <= COST_TOLERANCE * max(abs(cost), 1e-12):
            text = f"the plan states a cost of {plan.cost:.9g}, its motion costs {cost:.9g}"
            report.add(Violation("cost", text, value=abs(plan.cost - cost)))
        costs = [entry["cost"] for entry in plan.history]
        times = [entry["time_s"] for entry in plan.history]
        if any(b > a * (1 + EXACT) for a, b in pairwise(costs)):
            report.add(Violation("history", "the costs of the history increase"))
        if any(b < a for a, b in pairwise(times)):
            report.add(Violation("history", "the times of the history decrease"))
        if costs and not abs(costs[-1] - cost) <= COST_TOLERANCE * max(abs(cost), 1e-12):
            report.add(
                Violation("history", f"the history ends with the cost {costs[-1]:.9g}, the plan costs {cost:.9g}")
            )

    # -- modes ------------------------------------------------------------------------------------------------------

    def _modes(self, plan: Plan, report: Report) -> None:
        """The start mode, every attachment, every transition, and objects that stay where they are while it happens."""
        start = start_mode(self.problem)
        if plan.segments[0].mode.done:
            text = f"{', '.join(sorted(plan.segments[0].mode.done))} cannot be reached before the plan begins"
            report.add(Violation("start", text, 0))
        for name, a in plan.segments[0].mode.of.items():
            b = start.of[name]
            there = (
                a.parent == b.parent and a.support == b.support and a.width == b.width and np.shape(a.X_PO) == (4, 4)
            )
            if not there or np.abs(a.X_PO - b.X_PO).max() > EXACT:
                report.add(Violation("start", f"{name} does not start where the problem puts it", 0))
        first = {
            id(a): (a, k) for k in range(len(plan.segments) - 1, -1, -1) for a in plan.segments[k].mode.attachments
        }
        for a, k in first.values():
            before = len(report.violations)
            self.attachments.rigid(a, k, report)
            if len(report.violations) == before:
                self.attachments.legal(a, start.of[a.object], k, report)
        if "attachment" in report.kinds:
            return
        for k, transition in enumerate(plan.transitions):
            one, two = plan.segments[k], plan.segments[k + 1]
            self.attachments.transition(k, transition, one.mode, two.mode, report)
            self._reached(k, transition, one, report)
            old, new = (self._poses(s.mode, self._composite(s)[[i]]) for s, i in ((one, -1), (two, 0)))
            for name in one.mode.of:
                if one.mode.of[name] is not two.mode.of[name] and not same_pose(old[name], new[name]):
                    gap = float(np.linalg.norm(old[name][:3, 3] - new[name][:3, 3]))
                    text = f"{name} jumps by {gap * 1e3:.2f} mm at transition {k}"
                    report.add(Violation("continuity", text, k, max(one.length - 2, 0), 1.0, gap))

    def _reached(self, k: int, transition: Transition, segment: Segment, report: Report) -> None:
        """The robots of every subgoal that a transition reaches are at their targets at the end of the segment."""
        known = {s.name: s for s in self.problem.subgoals}
        for action in transition.actions:
            if action.subgoal in known:
                subgoal = known[action.subgoal]
                X_WG = self.world.grasp_frames(self._composite(segment)[[-1]], subgoal.targets)
                q = {name: waypoints[-1] for name, waypoints in segment.q.items()}
                for why in not_there(subgoal, q, {name: X[0] for name, X in X_WG.items()}):
                    text = f"transition {k}: reach of {subgoal.name}: {why}"
                    report.add(Violation("transition", text, k, max(segment.length - 2, 0), 1.0))

    def _goal(self, plan: Plan, report: Report) -> None:
        """Every subgoal has been reached, and every condition of the goal holds at the end."""
        k = len(plan.segments) - 1
        mode = plan.segments[-1].mode
        for subgoal in self.problem.subgoals:
            if subgoal.name not in mode.done:
                report.add(Violation("goal", f"{subgoal.name} is never reached", k))
        for c in self.problem.goal:
            why = None
            if isinstance(c, RobotAt):
                gap = float(np.abs(plan.segments[-1].q[c.robot][-1] - c.q).max())
                why = f"{c.robot} ends {gap:.3g} from its goal" if gap > JOINT_TOLERANCE else None
            else:
                a = mode.of[c.object]
                if isinstance(c, HeldBy):
                    why = None if a.held and a.parent == c.robot else f"{c.object} is not held by {c.robot}"
                elif a.held:
                    why = f"{c.object} is still held by {a.parent}"
                elif isinstance(c, AtPose):
                    there = a.parent == c.on and (c.X_BO is None or same_pose(a.X_PO, c.X_BO.GetAsMatrix4()))
                    why = None if there else f"{c.object} is not at its goal on {c.on}"
                elif isinstance(c, InRegion):
                    region = self.problem.support(c.region)
                    p = (region.X_BS.inverse().GetAsMatrix4() @ a.X_PO)[:2, 3]
                    half = np.maximum(np.asarray(region.size) / 2 - region.margin, 0.0)
                    inside = bool((np.abs(p) <= half + POSITION_TOLERANCE).all())
                    why = None if a.parent == region.body and inside else f"{c.object} is not in {c.region}"
            if why:
                report.add(Violation("goal", why, k))

    # -- motion -----------------------------------------------------------------------------------------------------

    def _composite(self, segment: Segment) -> np.ndarray:
        """Composite waypoints (K, N): arms, and fingers open or closed on what is held."""
        z = np.empty((segment.length, len(self.world.columns)))
        held = segment.mode.held
        for name, robot in self.world.scene.robots.items():
            z[:, self.world.arm[name]] = segment.q[name]
            attachment = held.get(name)
            z[:, self.world.fingers[name]] = robot.finger_positions(attachment.width if attachment else None)
        return z

    def _poses(self, mode: Mode, z: np.ndarray) -> dict[str, np.ndarray]:
        """World poses (4, 4) of all objects at the composite configuration z (1, N)."""
        frames = self.world.grasp_frames(z, sorted(mode.held))
        out = {}
        for name in mode.of:
            parent, X, held = carrier(mode, name)
            out[name] = (frames[parent][0] if held else self.attachments.X_WB[parent]) @ X
        return out

    def _motions(self, plan: Plan) -> list[Motion]:
        motions = []
        for k, segment in enumerate(plan.segments):
            carried, resting = {}, {}
            for name in segment.mode.of:
                parent, X, held = carrier(segment.mode, name)
                if held:
                    carried[name] = (parent, X)
                else:
                    resting[name] = self.attachments.X_WB[parent] @ X
            allowed = held_pairs(self.world, list(segment.mode.attachments))
            motions.append(Motion(self._composite(segment), k, carried, resting, allowed))
        return motions

    def _motion(self, plan: Plan, resolution: float, report: Report) -> None:
        """Every instant of every segment, the closing and opening of fingers, and objects at rest beside each other."""
        judge = MotionJudge(self.world, resolution)
        motions = self._motions(plan)
        lines = [Timeline(self.world, motion) for motion in motions]
        landings = self._landings(plan, lines, resolution, report)
        lifting: dict[str, Contact] = {}
        for k, line in enumerate(lines):
            changed = list(plan.segments[0].mode.of)
            if k > 0:
                changes = [(a.before, a.after) for a in plan.transitions[k - 1].actions if a.before and a.after]
                changed = [before.object for before, _ in changes]
                for before, after in changes:
                    if not before.held:
                        lifting[before.object] = self._contact(before)
                    elif not after.held:
                        lifting.pop(before.object, None)
                self._fingers(motions[k - 1], motions[k], judge, report)
            judge.resting(motions[k], changed, report, {(c.object, c.other) for c in lifting.values()})
            windows = dict(landings[k])
            for name, contact in list(lifting.items()):
                end = contact_phase(line, contact, resolution, report, backward=False)
                low, high = windows.get((name, contact.other), (0.0, line.length))
                windows[name, contact.other] = (np.inf if end is None else max(low, end), high)
                if end is not None:
                    del lifting[name]
            judge.judge(line, report, windows)

    def _landings(
        self, plan: Plan, lines: list[Timeline], resolution: float, report: Report
    ) -> list[dict[tuple[str, str], tuple[float, float]]]:
        """Per segment, (object, support) -> the stretch of s in which an object yet to be placed must not touch."""
        out: list[dict[tuple[str, str], tuple[float, float]]] = [{} for _ in lines]
        landing: dict[str, Contact] = {}
        for k in reversed(range(len(plan.transitions))):
            for action in plan.transitions[k].actions:
                if action.after is not None and not action.after.held:
                    landing[action.after.object] = self._contact(action.after)
            landing = {name: c for name, c in landing.items() if name in lines[k].motion.carried}
            for name, contact in list(landing.items()):
                begin = contact_phase(lines[k], contact, resolution, report, backward=True)
                out[k][name, contact.other] = (0.0, -np.inf if begin is None else begin)
                if begin is not None:
                    del landing[name]
        return out

    def _contact(self, resting: Attachment) -> Contact:
        """The contact of an object where it rests, relative to the parent object or to the world."""
        X_WB = self.attachments.X_WB.get(resting.parent)
        return Contact(resting.object, resting.parent, resting.X_PO if X_WB is None else X_WB @ resting.X_PO)

    def _fingers(self, one: Motion, two: Motion, judge: MotionJudge, report: Report) -> None:
        """Fingers that close or open at a transition meet nothing but what they grasp or let go."""
        start, end = one.z[-1], one.z[-1].copy()
        for columns in self.world.fingers.values():
            end[columns] = two.z[0, columns]
        # In a handover the receiver closes before the giver opens.
        closed = np.where(np.abs(end) < np.abs(start), end, start)
        poses = {name: X[0] for name, X in Timeline(self.world, one).state_at_end().items()}
        allowed, step = one.allowed | two.allowed, max(len(one.z) - 2, 0)
        for z in (np.vstack([start, closed]), np.vstack([closed, end])):
            if not np.array_equal(z[0], z[1]):
                sweep = Motion(z, one.segment, {}, {**one.resting, **poses}, allowed, step)
                judge.judge(Timeline(self.world, sweep), report, {})
