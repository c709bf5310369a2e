"""Contact phases: how an object leaves what it stood on after a pick, and arrives at what it is placed on.

While they are within TOUCH of each other they may touch, no deeper than TOUCH (and what the problem tolerates), and the
object stays within CONTACT_TRAVEL of the pose in which it rested or will rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from mrtamp.check_bounds import CORNERS
from mrtamp.check_report import Report, Violation
from mrtamp.check_scene import JudgeScene
from mrtamp.kinematics import inverse
from mrtamp.modes import Attachment

if TYPE_CHECKING:
    from mrtamp.check_motion import Motion, Timeline

TOUCH = 1e-3
"""A resting object is within this distance (m) of what it rests on, on either side of zero."""
CONTACT_TRAVEL = 0.01
"""How far (m) an object may have moved against what it stood on while they are still within TOUCH."""


@dataclass(eq=False)
class Contact:
    """An object that may touch `other` near where it rested, at `X_FO` in the frame of `other`, and until when."""

    object: str
    other: str
    X_FO: np.ndarray


def contact_phase(
    line: Timeline, contact: Contact, resolution: float, report: Report, *, backward: bool
) -> float | None:
    """Follow a lift from the start of `line` (a landing from its end) until the pair is TOUCH apart.

    Returns the s at which the contact phase ends (begins), or None when it spans the whole motion.
    """
    world, motion = line.world, line.motion
    solids = product(world.of.get(contact.object, []), world.of.get(contact.other, []))
    pairs = [pair for pair in solids if world.may_collide(*pair)]
    if not pairs:
        return line.length if backward else 0.0
    rate = line.rates(*np.array(pairs).T).max(axis=0)
    progress = line.travel @ rate
    total = float(progress[-1])
    stations = np.linspace(0.0, total, 1 + int(np.ceil(total / resolution)))
    # Where the pair does not move relative to each other, s runs on: those stretches need no sample of their own.
    order = np.interp(stations, progress, line.s) if total > 0 else np.zeros(1)
    for s in order[::-1] if backward else order:
        q, poses = line.state(np.array([s]))
        X = {name: pose[0] for name, pose in poses.items()}
        X_FO = _relative(motion, X, contact)
        query = world.query(q[0])
        d = min(world.distance(query, *pair) for pair in pairs)
        report.samples += 1
        if d > TOUCH:
            return float(s)
        slid = _moved(world, contact, X_FO)
        deep = d < -TOUCH - world.problem.collision.tolerance
        if deep or slid > CONTACT_TRAVEL:
            step, fraction = line.step(float(s))
            a, b = (world.solids[i].side for i in pairs[0])
            verb = "before it is placed on" if backward else "after it is picked from"
            what = (
                f"{a} is {-d * 1e3:.2f} mm deep in {b} {verb} it"
                if deep
                else f"{a} has moved {slid * 1e3:.1f} mm along {b} in contact {verb} it"
            )
            report.add(Violation("contact", what, motion.segment, step, fraction, max(-d, slid), (a, b)))
            return float(s)
    return None


def _relative(motion: Motion, X_WO: Mapping[str, np.ndarray], contact: Contact) -> np.ndarray:
    poses = {**motion.resting, **X_WO}
    X_WF = poses.get(contact.other)
    return poses[contact.object] if X_WF is None else inverse(X_WF) @ poses[contact.object]


def _moved(world: JudgeScene, contact: Contact, X_FO: np.ndarray) -> float:
    """How far (m) any corner of the object is from where it was while resting."""
    difference = X_FO - contact.X_FO
    worst = 0.0
    for i in world.of[contact.object]:
        solid = world.solids[i]
        corners = CORNERS * solid.half @ solid.X_BC[:3, :3].T + solid.X_BC[:3, 3]
        worst = max(worst, float(np.linalg.norm(corners @ difference[:3, :3].T + difference[:3, 3], axis=1).max()))
    return worst


def held_pairs(world: JudgeScene, attachments: list[Attachment]) -> set[tuple[int, int]]:
    """Pairs of solids that touch by definition: each held object with its gripper, each resting one with its parent."""
    allowed = set()
    for a in attachments:
        others = world.gripper[a.parent] if a.held else world.of.get(a.parent, [])
        allowed |= {(min(i, j), max(i, j)) for i in world.of.get(a.object, []) for j in others}
    return allowed
