"""A peer problem as a mrtamp `Problem`: robots as URDF text, tasks as subgoals, and which pairs may overlap as rules.

Each shape of a robot is a body of its own, because the peers list pairs of shapes and a rule names bodies.  Static
shapes that are in no pair (markers, the floor) are left out, and so are pairs of things that never move.  Objects start
on, and are released to, the world: the peers leave a gap of a centimetre between an object and the table "on" which it
is, and its contact with the table counts like any other.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations, product
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from pydrake.math import RigidTransform

from mrtamp.problem import (
    WORLD,
    AtConfiguration,
    Attach,
    CollisionRules,
    CostWeights,
    Gripper,
    MovableObject,
    Problem,
    Robot,
    RobotAt,
    RobotModel,
    Shape,
    StaticBody,
    Subgoal,
)

from .data import JOINTS, Pair, Peer, Task

_FAR = 100.0
"""Limit (rad or m) of joints that are not planned for."""


def problem_of(peer: Peer, folder: Path) -> Problem:
    """The mrtamp problem of a peer problem; the robots' model files are written into `folder`."""
    X_WF = {name: X[0] for name, X in peer.poses(peer.start[None]).items()}
    statics = [n for n in peer.frames if n in peer.colliding and n not in peer.robot_of and n not in peer.objects]
    goal: list[RobotAt] = []
    subgoals = []
    for task in peer.tasks.values():
        if task is peer.last and _ends_everything(peer, task):
            goal = [RobotAt(robot, q) for robot, q in task.q.items()]
        else:
            subgoals.append(_subgoal(peer, task))
    makespan, path_length = peer.weights
    return Problem(
        name=peer.name,
        robots=tuple(_robot(peer, robot, X_WF, folder) for robot in peer.columns),
        statics=tuple(StaticBody(n, RigidTransform(X_WF[n]), _shape(peer, n)) for n in statics),
        supports=(),
        objects=tuple(MovableObject(n, WORLD, RigidTransform(X_WF[n]), shape=_shape(peer, n)) for n in peer.objects),
        goal=tuple(goal),
        cost=CostWeights(makespan, path_length),
        subgoals=tuple(subgoals),
        collision=CollisionRules(tuple(_ignored(peer, statics)), peer.tolerance),
    )


def _ends_everything(peer: Peer, task: Task) -> bool:
    before, todo = set(), [task.name]
    while todo:
        todo = [b for name in todo for b in peer.after[name] if b not in before]
        before.update(todo)
    return before == set(peer.tasks) - {task.name} and set(task.q) == set(peer.columns) and task.object is None


def _subgoal(peer: Peer, task: Task) -> Subgoal:
    attach = None
    if task.object is not None:
        parent = peer.robot_of.get(task.parent or "", WORLD)
        attach = Attach(task.object, parent)
    return Subgoal(task.name, {robot: AtConfiguration(q) for robot, q in task.q.items()}, peer.after[task.name], attach)


def _shape(peer: Peer, frame: str) -> Shape:
    shape = peer.frames[frame].shape
    assert shape is not None
    return Shape(*shape)


# -- collisions -------------------------------------------------------------------------------------------------------


def _solids(peer: Peer, robot: str) -> list[str]:
    """The frames of a robot whose shapes are in some pair."""
    return [n for n, r in peer.robot_of.items() if r == robot and n in peer.colliding]


def _ignored(peer: Peer, statics: Iterable[str]) -> list[tuple[str, str]]:
    """Rules for the pairs that the peers do not list, but for those of a robot with itself (`collision_exceptions`)."""
    groups = [_solids(peer, robot) for robot in peer.columns] + [[o] for o in peer.objects]
    couples = [c for a, b in combinations(groups, 2) for c in product(a, b)]
    couples += [c for group in groups for c in product(group, statics)]
    return [(_thing(peer, a), _thing(peer, b)) for a, b in couples if frozenset((a, b)) not in peer.pairs]


def _thing(peer: Peer, frame: str) -> str:
    return f"{peer.robot_of[frame]}/{frame}" if frame in peer.robot_of else frame


# -- robots -----------------------------------------------------------------------------------------------------------


def _robot(peer: Peer, robot: str, X_WF: dict[str, np.ndarray], folder: Path) -> Robot:
    columns = peer.columns[robot]
    hands = {t.parent for t in peer.tasks.values() if t.parent is not None and peer.robot_of.get(t.parent) == robot}
    if len(hands) > 1:
        raise ValueError(f"{peer.name}: {robot} holds objects by several frames: {', '.join(sorted(hands))}")
    released: set[Pair] = {p for (_, parent), pairs in peer.released_pairs.items() if parent in hands for p in pairs}
    fingers = tuple(n for n in _solids(peer, robot) if any(n in pair for pair in released))
    joints = [name for name, c in peer.joints.items() if c[0] in columns]
    file = folder / f"{peer.name}.{robot}.urdf"
    file.write_text(_urdf(peer, robot, hands))
    solids = _solids(peer, robot)
    model = RobotModel(
        name=robot,
        model=str(file),
        base=peer.base_of[robot],
        arm_joints=tuple(peer.dof_names[c] for c in columns),
        home=tuple(peer.start[columns]),
        gripper=Gripper(fingers, {_GRIP: 0.0}, 0.0) if hands else None,
        grasp_body=next(iter(hands), joints[-1]),
        X_BG=RigidTransform(),
        collision_exceptions=tuple(c for c in combinations(solids, 2) if frozenset(c) not in peer.pairs),
    )
    start = peer.start[columns]
    return Robot(robot, model, RigidTransform(X_WF[model.base]), start, start)


_GRIP = "grip"
"""A joint that moves nothing: a gripper has at least one."""


def _urdf(peer: Peer, robot: str, hands: set[str]) -> str:
    """A link per joint, per shape that collides and per frame that holds; other frames are folded into transforms."""
    base = peer.base_of[robot]
    text = [f'<robot name="peer"><link name={quoteattr(base)}/>']
    at: dict[str, tuple[str, np.ndarray]] = {base: (base, np.eye(4))}
    for name, r in peer.robot_of.items():
        if r != robot or name == base:
            continue
        frame = peer.frames[name]
        link, X_LP = at[frame.parent or ""]
        if name in peer.joints:
            dofs = list(zip(JOINTS[frame.joint or ""], peer.joints[name], strict=True))
            for i, ((kind, axis), column) in enumerate(dofs):
                child = name if i == len(dofs) - 1 else f"{name}.{i}"
                limits = peer.lower[column], peer.upper[column]
                text += [_joint(peer.dof_names[column], kind, link, child, X_LP, axis, limits)]
                solid = child in peer.colliding
                text += [_link(child, _shape(peer, child) if solid else None)]
                link, X_LP = child, np.eye(4)
            at[name] = (link, X_LP)
            continue
        at[name] = (link, X_LP @ frame.X_PF)
        if name in peer.colliding or name in hands:
            text += [_joint(f"{name}.weld", "fixed", link, name, at[name][1])]
            text += [_link(name, _shape(peer, name) if name in peer.colliding else None)]
    for hand in hands:
        text += [_joint(_GRIP, "prismatic", hand, _GRIP, np.eye(4), 2, (-_FAR, _FAR)), _link(_GRIP, None)]
    return "\n".join([*text, "</robot>"])


def _link(name: str, shape: Shape | None) -> str:
    if shape is None:
        return f"<link name={quoteattr(name)}/>"
    size = [repr(float(x)) for x in shape.size]
    solid = {
        "box": lambda: f'<box size="{" ".join(size)}"/>',
        "sphere": lambda: f'<sphere radius="{size[0]}"/>',
        "cylinder": lambda: f'<cylinder radius="{size[0]}" length="{size[1]}"/>',
        "capsule": lambda: f'<capsule radius="{size[0]}" length="{size[1]}"/>',
    }[shape.kind]()
    parts = "".join(f"<{use}><geometry>{solid}</geometry></{use}>" for use in ("visual", "collision"))
    return f"<link name={quoteattr(name)}>{parts}</link>"


def _joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    X_PC: np.ndarray,
    axis: int = 2,
    limits: tuple[float, float] | None = None,
) -> str:
    rpy = RigidTransform(X_PC).rotation().ToRollPitchYaw().vector()
    xyz, turn = (" ".join(repr(float(x)) for x in v) for v in (X_PC[:3, 3], rpy))
    moves = ""
    if limits is not None:
        along = " ".join(str(int(i == axis)) for i in range(3))
        low, high = map(float, limits)
        moves = f'<axis xyz="{along}"/><limit lower="{low!r}" upper="{high!r}" effort="1" velocity="1"/>'
    return (
        f'<joint name={quoteattr(name)} type="{kind}"><parent link={quoteattr(parent)}/>'
        f'<child link={quoteattr(child)}/><origin xyz="{xyz}" rpy="{turn}"/>{moves}</joint>'
    )
