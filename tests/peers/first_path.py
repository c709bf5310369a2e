"""A first path for a peer problem, without mrtamp: one robot moves at a time (RRT-Connect), and then goes back.

It gives the referee real paths to accept, and to reject once they have been tampered with.
"""

from __future__ import annotations

import numpy as np

from .referee import STEP, Leg, Referee, State

_STRIDE = 0.3
_MARGIN = 0.5
"""Share of the tolerance that these paths use, because they are checked at samples too."""


def first_path(referee: Referee, rng: np.random.Generator) -> list[Leg]:
    """A path on which, task after task, its robots go to their goals one by one, then back if empty-handed."""
    peer = referee.peer
    at, state = peer.start.copy(), referee.start()
    legs: list[Leg] = []
    rows = [at]
    for task in peer.tasks.values():
        for robot, goal in task.q.items():
            rows += _move(referee, state, rows[-1], peer.columns[robot], goal, rng)
        legs.append(Leg(np.array(rows), (task.name,)))
        at = rows[-1]
        state = referee.attach(state, at, task.name)
        rows = [at]
        loaded = {peer.robot_of.get(frame) for frame, _ in state.objects.values()}
        for columns in [peer.columns[r] for r in task.q if r not in loaded] if task is not peer.last else []:
            rows += _move(referee, state, rows[-1], columns, peer.start[columns], rng)
    return legs


def _move(
    referee: Referee, state: State, at: np.ndarray, columns: np.ndarray, goal: np.ndarray, rng: np.random.Generator
) -> list[np.ndarray]:
    """Waypoints (after `at`) that take one robot to its goal while the others stand still."""
    peer = referee.peer

    def free(a: np.ndarray, b: np.ndarray) -> bool:
        n = int(np.ceil(np.abs(b - a).max() / (STEP / 4))) + 1
        q = np.repeat(at[None], n, axis=0)
        q[:, columns] = a + np.linspace(0, 1, n)[:, None] * (b - a)
        order = np.argsort(np.arange(n) * 0.6180339887498949 % 1)
        for some in np.array_split(order, max(1, n // 8)):
            if any(sum(x.values()) > _MARGIN * peer.tolerance for x in referee.penetrations(q[some], state)):
                return False
        return True

    def waypoints(path: list[np.ndarray]) -> list[np.ndarray]:
        out = np.repeat(at[None], len(path), axis=0)
        out[:, columns] = path
        return list(out)

    start = at[columns]
    if free(start, goal):
        return waypoints([goal])
    trees = [[(start, -1)], [(goal, -1)]]
    for _ in range(3000):
        target = rng.uniform(peer.lower[columns], peer.upper[columns])
        reached = _grow(trees[0], target, free, once=True)
        if reached is not None and _grow(trees[1], reached, free, once=False) is reached:
            one, two = _branch(trees[0]), _branch(trees[1])
            path = one[::-1] + two[1:] if one[-1] is start else two[::-1] + one[1:]
            return waypoints(_shortened(path, free, rng)[1:])
        trees.reverse()
    raise RuntimeError(f"{peer.name}: no path for {peer.dof_names[columns[0]]} and the joints after it")


def _grow(tree: list, target: np.ndarray, free, once: bool) -> np.ndarray | None:
    """Step from the nearest vertex towards the target, once or as far as it is free; the last vertex added, if any."""
    i = int(np.argmin([np.linalg.norm(q - target) for q, _ in tree]))
    added = None
    while True:
        q = tree[i][0]
        gap = np.linalg.norm(target - q)
        new = target if gap <= _STRIDE else q + (target - q) * (_STRIDE / gap)
        if not free(q, new):
            return added
        tree.append((new, i))
        added, i = new, len(tree) - 1
        if new is target or once:
            return added


def _branch(tree: list) -> list[np.ndarray]:
    """Configurations from the last vertex to the root."""
    out, i = [], len(tree) - 1
    while i >= 0:
        out.append(tree[i][0])
        i = tree[i][1]
    return out


def _shortened(path: list[np.ndarray], free, rng: np.random.Generator) -> list[np.ndarray]:
    for _ in range(20):
        i, j = sorted(rng.integers(len(path), size=2))
        if j > i + 1 and free(path[i], path[j]):
            path = path[: i + 1] + path[j:]
    return path
