"""Shortest tours of every robot through subsets of the tasks, and all ways to share the tasks out (DESIGN section 9).

Held-Karp over subsets of tasks with all their candidates, one robot at a time; then every partition of the tasks among
the robots is ranked by what it costs without waiting, and within a partition the orders of each robot.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from itertools import count, pairwise

import numpy as np

from mrtamp.schedule import END, FAR, START, Ordering, Schedules

_PERMUTED = 4
"""All orders of a robot's tasks are ranked up to this number; above it, the best one and its neighbours."""
_EPS = 1e-9

Ranked = tuple[float, Ordering, list[int], tuple[int, ...]]
"""Lower bound of the cost, ordering, candidate of every task, and the subset of tasks (bit mask) of every robot."""


class Tours:
    """Shortest tours of each robot alone through every subset of the tasks, over all candidates.

    Penalties and constants count as length, at what a unit of length of the busiest robot costs: that never overrates
    them, so the ranking is by a lower bound of the true cost.
    """

    def __init__(self, plan: Schedules, constants: bool = True) -> None:
        self.plan = plan
        self.scale = max(plan.weights.makespan + plan.weights.path_length, _EPS) if constants else np.inf
        self.before = _implied(plan)
        N = len(plan.tasks)
        self.lengths = np.full((len(plan.robots), 1 << N), FAR)
        self._of: list[list[np.ndarray]] = []
        self._work: list[list[np.ndarray]] = []
        self._from: list[list[np.ndarray]] = []
        self._home: list[list[np.ndarray]] = []
        self._ways: list[dict[tuple[int, int], np.ndarray]] = []
        self._table: list[dict[tuple[int, int], np.ndarray]] = []
        self._orders: dict[tuple[int, int], list[tuple[float, tuple[int, ...]]]] = {}
        for r, robot in enumerate(plan.robots):
            self._prepare(robot)
            self._solve(r, robot)

    def _prepare(self, robot: str) -> None:
        """Candidates of all options of a robot for a task in one list, and all distances between them."""
        plan = self.plan
        of: list[np.ndarray] = []
        work: list[np.ndarray] = []
        first, last = [], []
        for t, task in enumerate(plan.tasks):
            own = [o for o, option in enumerate(task.options) if option.robots == (robot,)]
            if not own:
                of.append(np.zeros((0, 2), int))
                work.append(np.zeros(0))
                first.append(np.zeros((0, len(plan.stops(robot, START)[0]))))
                last.append(first[-1])
                continue
            size = [task.options[o].candidates for o in own]
            of.append(np.column_stack([np.repeat(own, size), np.concatenate([np.arange(n) for n in size])]))
            work.append(np.concatenate([plan.inner(t, o)[robot] + plan.extra[t][o] / self.scale for o in own]))
            first.append(np.concatenate([plan.stops(robot, (t, o, 0)) for o in own]))
            last.append(np.concatenate([plan.stops(robot, (t, o, len(task.options[o].events) - 1)) for o in own]))
        splits = np.cumsum([len(x) for x in first])[:-1]
        every = plan.block(robot, np.concatenate(last), np.concatenate(first))
        rows = [np.split(x, splits, axis=1) for x in np.split(every, splits)]
        N = range(len(plan.tasks))
        self._ways.append({(i, j): np.ascontiguousarray(rows[i][j]) for i in N for j in N if i != j})
        arrive = plan.block(robot, plan.stops(robot, START), np.concatenate(first))[0]
        self._from.append(list(np.split(arrive, splits)))
        if plan.ends_somewhere(robot):
            leave = plan.block(robot, np.concatenate(last), plan.stops(robot, END))[:, 0]
        else:
            leave = np.zeros(len(every))
        self._home.append(list(np.split(leave, splits)))
        self._of.append(of)
        self._work.append(work)

    def _solve(self, r: int, robot: str) -> None:
        plan, N = self.plan, len(self.plan.tasks)
        idle = (
            plan.block(robot, plan.stops(robot, START), plan.stops(robot, END))[0, 0]
            if plan.ends_somewhere(robot)
            else 0
        )
        self.lengths[r, 0] = idle
        able = [j for j in range(N) if len(self._of[r][j])]
        table = {(1 << j, j): self._from[r][j] + self._work[r][j] for j in able}
        self._table.append(table)
        for mask in range(1, 1 << N):
            inside = [i for i in able if (mask, i) in table]
            if not inside:
                continue
            self.lengths[r, mask] = min(float(np.min(table[mask, i] + self._home[r][i])) for i in inside)
            for j in able:
                if mask >> j & 1 or any(self.before[j, k] for k in range(N) if mask >> k & 1):
                    continue
                value = np.min([self._step(r, table[mask, i], i, j) for i in inside], axis=0)
                table[mask | 1 << j, j] = value + self._work[r][j]

    def _step(self, r: int, value: np.ndarray, i: int, j: int) -> np.ndarray:
        return (value[:, None] + self._ways[r][i, j]).min(axis=0)

    def partitions(self) -> tuple[np.ndarray, np.ndarray]:
        """Costs without waiting, ascending, and the subset (bit mask) of every robot (n, R) for each."""
        R, N = self.lengths.shape[0], len(self.plan.tasks)
        digits = (np.arange(R**N)[:, None] // R ** np.arange(N)) % R
        masks = np.stack([((digits == r) << np.arange(N)).sum(axis=1) for r in range(R)], axis=1)
        cost = self._price(self.lengths[np.arange(R), masks])
        order = np.argsort(cost, kind="stable")
        return cost[order], masks[order]

    def _price(self, lengths: np.ndarray) -> np.ndarray:
        weights = self.plan.weights
        return weights.makespan * lengths.max(axis=-1) + weights.path_length * lengths.sum(axis=-1)

    def orders(self, r: int, mask: int) -> list[tuple[float, tuple[int, ...]]]:
        """Orders of a robot's tasks with their lengths, shortest first: all, or the best and its neighbours."""
        if (r, mask) not in self._orders:
            inside = tuple(j for j in range(len(self.plan.tasks)) if mask >> j & 1)
            found: list[tuple[float, tuple[int, ...]]]
            if not inside:
                found = [(float(self.lengths[r, 0]), ())]
            elif len(inside) <= _PERMUTED:
                found = sorted(self._permutations(r, (), inside, None))
            else:
                lasts = [j for j in inside if (mask, j) in self._table[r]]
                best = min((self._backwards(r, mask, j) for j in lasts), key=lambda o: self._length(r, o))
                near = {best, *(self._backwards(r, mask, j) for j in lasts)}
                for i in range(len(inside) - 1):
                    swapped = (*best[:i], best[i + 1], best[i], *best[i + 2 :])
                    if not self.before[swapped[i + 1], swapped[i]]:
                        near.add(swapped)
                found = sorted((self._length(r, o), o) for o in near)
            self._orders[r, mask] = [x for x in found if x[0] < FAR]
        return self._orders[r, mask]

    def _permutations(
        self, r: int, head: tuple[int, ...], rest: tuple[int, ...], value: np.ndarray | None
    ) -> Iterator[tuple[float, tuple[int, ...]]]:
        if not rest:
            assert value is not None
            yield float(np.min(value + self._home[r][head[-1]])), head
        for j in rest:
            if any(self.before[k, j] for k in rest):
                continue
            arrive = self._from[r][j] if value is None else self._step(r, value, head[-1], j)
            yield from self._permutations(r, (*head, j), tuple(k for k in rest if k != j), arrive + self._work[r][j])

    def _backwards(self, r: int, mask: int, j: int) -> tuple[int, ...]:
        """The order of the shortest tour through a subset that ends with task j."""
        table, order = self._table[r], [j]
        m = int(np.argmin(table[mask, j] + self._home[r][j]))
        while mask := mask & ~(1 << j):
            options = [
                (table[mask, i] + self._ways[r][i, j][:, m], i)
                for i in range(len(self.plan.tasks))
                if (mask, i) in table
            ]
            value, i = min(options, key=lambda x: float(x[0].min()))
            m, j = int(np.argmin(value)), i
            order.append(j)
        return tuple(reversed(order))

    def _length(self, r: int, order: tuple[int, ...]) -> float:
        return float(np.min(self._forward(r, order)[-1] + self._home[r][order[-1]]))

    def _forward(self, r: int, order: tuple[int, ...]) -> list[np.ndarray]:
        values = [self._from[r][order[0]] + self._work[r][order[0]]]
        for i, j in pairwise(order):
            values.append(self._step(r, values[-1], i, j) + self._work[r][j])
        return values

    def candidates(self, r: int, order: tuple[int, ...]) -> dict[int, tuple[int, int]]:
        """Task -> (option, candidate) on the shortest tour in a given order."""
        if not order:
            return {}
        values = self._forward(r, order)
        m = int(np.argmin(values[-1] + self._home[r][order[-1]]))
        out = {}
        for n in range(len(order) - 1, -1, -1):
            of = self._of[r][order[n]]
            out[order[n]] = (int(of[m, 0]), int(of[m, 1]))
            if n:
                m = int(np.argmin(values[n - 1] + self._ways[r][order[n - 1], order[n]][:, m]))
        return out

    def ranked(self) -> Iterator[Ranked]:
        """Assignments with orders by ascending lower bound: bound, ordering, candidates, assignment."""
        bounds, masks = self.partitions()
        serial = count()
        heap: list[tuple] = []

        def push(p: int, index: tuple[int, ...]) -> None:
            lists = [self.orders(r, int(masks[p, r])) for r in range(len(self.plan.robots))]
            if all(i < len(x) for i, x in zip(index, lists, strict=True)):
                picked = [x[i] for i, x in zip(index, lists, strict=True)]
                value = float(self._price(np.array([length for length, _ in picked])))
                heapq.heappush(heap, (value, next(serial), p, index, tuple(order for _, order in picked)))

        fresh = 0
        while True:
            while fresh < len(bounds) and bounds[fresh] < FAR and (not heap or bounds[fresh] <= heap[0][0] + 1e-6):
                push(fresh, (0,) * len(self.plan.robots))
                fresh += 1
            if not heap:
                return
            value, _, p, index, orders = heapq.heappop(heap)
            chosen: dict[int, tuple[int, int]] = {}
            for r, order in enumerate(orders):
                chosen |= self.candidates(r, order)
            options = tuple(chosen[t][0] for t in range(len(chosen)))
            stages = tuple((t, 0) for order in orders for t in order)
            yield value, Ordering(options, stages), [chosen[t][1] for t in range(len(chosen))], tuple(masks[p])
            # Each index vector once: only positions from the last non-zero one on are raised.
            start = max((r for r, i in enumerate(index) if i), default=0)
            for r in range(start, len(index)):
                push(p, (*index[:r], index[r] + 1, *index[r + 1 :]))


def _implied(plan: Schedules) -> np.ndarray:
    """(N, N): whether a task comes before another when one robot does both, by precedence, also through others."""
    N = len(plan.tasks)
    counts = [{len(o.events) for o in t.options} for t in plan.tasks]
    pairs = {(a, i, b, j) for (a, i), (b, j) in plan.precedence}
    grown = True
    while grown:
        grown = False
        for a, i, b, j in list(pairs):
            for b2, j2, c, k in list(pairs):
                chained = b == b2 and all(j % n <= j2 % n for n in counts[b]) and a != c
                if chained and (a, i, c, k) not in pairs:
                    pairs.add((a, i, c, k))
                    grown = True
    out = np.zeros((N, N), dtype=bool)
    for a, _, b, _ in pairs:
        out[a, b] = True
    return out
