"""A peer problem as its file states it: frame tree, shapes, exact collision pairs, tasks and their order, cost.

Nothing here knows mrtamp's planner: the reader makes a `Problem` of a `Peer`, the referee judges paths against it.
Poses are 4x4 matrices in monogram notation, lengths metres, angles radians; a composite configuration holds the robots'
joints in the order of the file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

VARIABLE = "MRTAMP_PEER_PROBLEMS"
"""Environment variable that names the folder with the peer problems."""

Pair = frozenset[str]
"""Two frames whose shapes may not penetrate each other."""

JOINTS: dict[str, tuple[tuple[str, int], ...]] = {
    **{f"hinge{x}": (("revolute", i),) for i, x in enumerate("XYZ")},
    **{f"trans{x}": (("prismatic", i),) for i, x in enumerate("XYZ")},
    "transXY": (("prismatic", 0), ("prismatic", 1)),
    "transXYPhi": (("prismatic", 0), ("prismatic", 1), ("revolute", 2)),
}
"""Joint type -> its degrees of freedom in order: kind, and the axis (0, 1, 2: x, y, z) they move along or about."""


def matrix_of(pose: list[float]) -> np.ndarray:
    """Pose (4, 4) of [x, y, z, qw, qx, qy, qz]."""
    w, x, y, z = np.array(pose[3:]) / np.linalg.norm(pose[3:])
    X = np.eye(4)
    X[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    X[:3, 3] = pose[:3]
    return X


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame: fixed in its parent at `X_PF` (world: None), or moved in it by `joint` (and then `X_PF` is unused).

    `shape` is (kind, size) with sizes as in `mrtamp.problem.Shape`.
    """

    name: str
    parent: str | None
    X_PF: np.ndarray
    joint: str | None
    shape: tuple[str, tuple[float, ...]] | None


@dataclass(frozen=True, eq=False)
class Task:
    """Robots stand at `q` (robot -> joints); then `object`, if any, is fixed to the frame `parent` where it is."""

    name: str
    q: dict[str, np.ndarray]
    object: str | None
    parent: str | None


@dataclass(frozen=True, eq=False)
class Peer:
    """One peer problem.

    `columns` maps a robot to its columns in composite configurations, `joints` a frame with a joint to its columns.
    `after` maps a task to those before it, `released_pairs` an object and the frame it is attached to by a task to the
    pairs that then no longer count.  `checks` and `chain` are the file's own examples.
    """

    name: str
    frames: dict[str, Frame]
    joints: dict[str, np.ndarray]
    columns: dict[str, np.ndarray]
    dof_names: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    start: np.ndarray
    pairs: frozenset[Pair]
    tolerance: float
    weights: tuple[float, float]
    objects: tuple[str, ...]
    tasks: dict[str, Task]
    after: dict[str, tuple[str, ...]]
    sequence: bool
    released_pairs: dict[tuple[str, str], frozenset[Pair]]
    checks: list[dict]
    chain: list[dict]

    @cached_property
    def colliding(self) -> frozenset[str]:
        """Frames whose shapes take part in any pair."""
        return frozenset(name for pair in self.pairs for name in pair)

    @cached_property
    def base_of(self) -> dict[str, str]:
        """Robot -> the frame it stands on: the topmost above its joints below the world or something with a shape."""
        out = {}
        for robot, columns in self.columns.items():
            frame = next(self.frames[f] for f, c in self.joints.items() if c[0] == columns[0])
            while frame.parent is not None and self.frames[frame.parent].shape is None:
                frame = self.frames[frame.parent]
            out[robot] = frame.name
        return out

    @cached_property
    def robot_of(self) -> dict[str, str]:
        """Frame -> the robot it is part of, for frames of robots."""
        bases = {base: robot for robot, base in self.base_of.items()}
        out: dict[str, str] = {}
        for name, frame in self.frames.items():
            robot = bases.get(name) or out.get(frame.parent or "")
            if robot is not None:
                out[name] = robot
        return out

    @property
    def last(self) -> Task:
        """The task that ends the problem: all robots stand where it says once all else is done."""
        return list(self.tasks.values())[-1]

    def poses(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """World poses (N, 4, 4) of all frames at composite configurations q (N, n), objects where they start."""
        out: dict[str, np.ndarray] = {}
        for name, frame in self.frames.items():
            X = np.eye(4)[None] if frame.parent is None else out[frame.parent]
            if name in self.joints:
                for (kind, axis), column in zip(JOINTS[frame.joint or ""], self.joints[name], strict=True):
                    X = X @ _motion(kind, axis, q[:, column])
            else:
                X = X @ frame.X_PF
            out[name] = np.broadcast_to(X, (len(q), 4, 4))
        return out


def _motion(kind: str, axis: int, value: np.ndarray) -> np.ndarray:
    X = np.tile(np.eye(4), (len(value), 1, 1))
    if kind == "prismatic":
        X[:, axis, 3] = value
        return X
    i, j = (axis + 1) % 3, (axis + 2) % 3
    X[:, i, i] = X[:, j, j] = np.cos(value)
    X[:, j, i] = np.sin(value)
    X[:, i, j] = -np.sin(value)
    return X


def peer_files(folder: Path | None = None) -> list[Path]:
    """The problem files of `folder`, or of the folder that the environment variable names; none if neither does."""
    if folder is None and VARIABLE not in os.environ:
        return []
    return sorted((folder or Path(os.environ[VARIABLE])).glob("*.json"))


def load_peer(file: Path) -> Peer:
    """Read a peer problem."""
    raw = json.loads(file.read_text())
    cost = raw["cost"]
    if (cost["metric"], cost["reduction"]) != ("euclidean_per_robot", "max"):
        raise ValueError(f"{file}: cost {cost}, expected the longest robot by Euclidean length")
    frames = {f["name"]: _frame(f) for f in raw["frames"]}
    columns = {r["name"]: np.array(r["dof_indices"]) for r in raw["robots"]}
    joints = {}
    for robot in raw["robots"]:
        rest = list(robot["dof_indices"])
        for name in robot["joints"]:
            n = len(JOINTS[frames[name].joint or ""])
            joints[name], rest = np.array(rest[:n]), rest[n:]
    tasks = {t["name"]: _task(t, columns) for t in raw["tasks"]}
    ordering = raw["ordering"]
    sequence = ordering["kind"] == "SequenceMixin"
    if sequence:
        names = ordering["sequence"]
        after = {name: tuple(names[max(i - 1, 0) : i]) for i, name in enumerate(names)}
    else:
        names = ordering["example_sequence"]
        after = {name: tuple(ordering["depends_on"][name]) for name in names}
        for own in ordering["per_robot_order"].values():
            # A robot does one thing after the other.
            for one, two in pairwise(own):
                after[two] = tuple(dict.fromkeys([*after[two], one]))
    return Peer(
        name=file.stem,
        frames=frames,
        joints=joints,
        columns=columns,
        dof_names=tuple(raw["dof_names"]),
        lower=np.array(raw["limits"]["lower"]),
        upper=np.array(raw["limits"]["upper"]),
        start=np.array(raw["q_start"]),
        pairs=frozenset(frozenset(p) for p in raw["collision_pairs"]),
        tolerance=raw["collision_tolerance_total_penetration"],
        weights=(1.0, cost["w_sum"]),
        objects=tuple(raw["movable_objects"]),
        tasks={name: tasks[name] for name in names},
        after=after,
        sequence=sequence,
        released_pairs=_released_pairs(raw),
        checks=raw["checks"],
        chain=raw["mode_chain_example"],
    )


def _frame(raw: Mapping) -> Frame:
    shape = None
    if "shape" in raw:
        kind, size = raw["shape"], raw["size"]
        if kind in ("box", "ssBox"):
            shape = ("box", tuple(size[:3]))
        elif kind in ("capsule", "cylinder"):
            shape = (kind, (size[1], size[0]))
        elif kind == "sphere":
            shape = (kind, (size[0],))
        else:
            raise ValueError(f"frame {raw['name']} has the unknown shape {kind!r}")
    joint = raw.get("joint")
    return Frame(raw["name"], raw["parent"], matrix_of(raw["X_PF"]), None if joint == "rigid" else joint, shape)


def _task(raw: Mapping, columns: Mapping[str, np.ndarray]) -> Task:
    goal, attach = raw["goal"], raw["attach"] or {}
    if goal["type"] != "SingleGoal" or raw["side_effect"] is not None or raw["n_constraints"]:
        raise ValueError(f"task {raw['name']} is not simply a configuration to reach")
    [composite] = goal["q"]
    q, rest = {}, np.array(composite)
    for robot in raw["robots"]:
        q[robot], rest = rest[: len(columns[robot])], rest[len(columns[robot]) :]
    return Task(raw["name"], q, attach.get("object"), attach.get("new_parent"))


def _released_pairs(raw: Mapping) -> dict[tuple[str, str], frozenset[Pair]]:
    """What an attachment takes out of the collision pairs, as the file's chain of modes shows it."""
    tasks = {t["name"]: t for t in raw["tasks"]}
    attached: dict[str, str] = {}
    out: dict[tuple[str, str], frozenset[Pair]] = {}
    for mode in raw["mode_chain_example"]:
        removed = {frozenset(p) for p in mode["pairs_removed"]}
        explained: set[Pair] = set()
        for item, parent in attached.items():
            if mode["objects"][item]["parent"] != parent:
                raise ValueError(f"mode {mode['active_task']}: {item} is not attached to {parent}")
            mine = frozenset(p for p in removed if item in p)
            if out.setdefault((item, parent), mine) != mine:
                raise ValueError(
                    f"mode {mode['active_task']}: the pairs of {item} on {parent} change from mode to mode"
                )
            explained |= mine
        if mode["pairs_added"] or removed != explained:
            raise ValueError(f"mode {mode['active_task']}: pairs change without an attachment that explains it")
        attach = tasks[mode["active_task"]]["attach"]
        if attach is not None:
            attached[attach["object"]] = attach["new_parent"]
    return out
