"""Is a subgoal really reached: all its robots at their targets at one instant, in the order asked for, once?

The judge's own reading of `Subgoal`: nothing here is shared with the sampler of reach transitions.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mrtamp.modes import ANGLE_TOLERANCE, JOINT_TOLERANCE, POSITION_TOLERANCE, Attachment, Mode
from mrtamp.plan import Action
from mrtamp.problem import AtConfiguration, HandAt, Problem, Subgoal, Target


def same_pose(X: np.ndarray, Y: np.ndarray) -> bool:
    """Whether two poses agree to 0.1 mm and 1 mrad."""
    angle = np.linalg.norm(X[:3, :3] - Y[:3, :3]) / np.sqrt(2)  # |R - S|_F = 2 sqrt(2) sin(angle / 2)
    return bool(np.linalg.norm(X[:3, 3] - Y[:3, 3]) <= POSITION_TOLERANCE and angle <= ANGLE_TOLERANCE)


def attaches(subgoal: Subgoal, a: Attachment) -> bool:
    """Whether `a` is how an object is fixed by reaching `subgoal`."""
    wanted = subgoal.attach
    if wanted is None or wanted.object != a.object or wanted.parent != a.parent or a.width is not None:
        return False
    return a.held if a.parent in subgoal.targets else a.support == f"at {subgoal.name}"


def reach_rules(problem: Problem, action: Action, before: Mode) -> str | None:
    """What is wrong with a reach action, apart from where its robots are and from what happens to its object."""
    names = [s.name for s in problem.subgoals]
    if action.subgoal not in names:
        return f"unknown subgoal {action.subgoal!r}, expected one of {', '.join(names) or 'none'}"
    subgoal = problem.subgoal(action.subgoal)
    if subgoal.name in before.done:
        return "it has been reached before"
    missing = [name for name in subgoal.after if name not in before.done]
    if missing:
        return f"{', '.join(missing)} should have been reached before"
    if sorted(action.robots) != sorted(subgoal.targets):
        return f"the robots are {', '.join(action.robots)}, expected {', '.join(sorted(subgoal.targets))}"
    if subgoal.attach is None:
        return "it changes an attachment" if action.before or action.after else None
    if action.before is None or action.after is None:
        return f"{subgoal.attach.object} is not attached to {subgoal.attach.parent}"
    if not attaches(subgoal, action.after):
        a = action.after
        return f"it attaches {a.object} to {a.place}, expected {subgoal.attach.object} to {subgoal.attach.parent}"
    return None


def away(target: Target, q: np.ndarray, X_WG: np.ndarray) -> str | None:
    """How far a robot at q (n,), with its grasp frame at X_WG (4, 4), is from its target; None when it is there."""
    if isinstance(target, AtConfiguration):
        gap = float(np.abs(q - target.q).max())
        return f"{gap:.3g} from its configuration" if gap > JOINT_TOLERANCE else None
    if isinstance(target, HandAt):
        X_WT = target.X_WG.GetAsMatrix4()
        if same_pose(X_WG, X_WT):
            return None
        gap = float(np.linalg.norm(X_WG[:3, 3] - X_WT[:3, 3]))
        turn = float(np.degrees(np.linalg.norm(X_WG[:3, :3] - X_WT[:3, :3]) / np.sqrt(2)))
        return f"{gap * 1e3:.2f} mm and {turn:.2f} degrees from its pose"
    p = (target.X_WC.inverse().GetAsMatrix4() @ X_WG)[:3, 3]
    outside = float((np.abs(p) - np.asarray(target.size) / 2).max())
    return f"{outside * 1e3:.2f} mm outside its box" if outside > POSITION_TOLERANCE else None


def not_there(subgoal: Subgoal, q: Mapping[str, np.ndarray], X_WG: Mapping[str, np.ndarray]) -> list[str]:
    """Which robots of a subgoal are not at their targets, and how far away they are."""
    found = ((robot, away(target, q[robot], X_WG[robot])) for robot, target in subgoal.targets.items())
    return [f"{robot} is {why}" for robot, why in found if why]
