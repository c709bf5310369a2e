"""Roadmap paths as rows of the tables of space and time.

Vertices of a path go in; out come rows of `mrtamp.space_time.Clearances`, at most one step apart.  A vertex or an edge
is put into the tables once, so that all schedules made from the roadmaps share what is known of its moves.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from mrtamp.collision import Collision
from mrtamp.roadmap import Roadmap
from mrtamp.space_time import STEP, Clearances
from mrtamp.validity import Validity

_FULL = 60_000
"""Cached answers and samples after which the tables are emptied."""


class RoadmapRows:
    """The rows of vertices, edges and paths of all robots' roadmaps.

    Attributes
    ----------
    clearances : the tables, and what is known of moves between their rows.
    """

    def __init__(self, roadmaps: Mapping[str, Roadmap], collision: Collision, validity: Validity) -> None:
        self.roadmaps = roadmaps
        self._collision = collision
        self._validity = validity
        self._forget()

    def _forget(self) -> None:
        self.clearances = Clearances(self._collision, self._validity, list(self.roadmaps))
        self._vertices: dict[tuple[str, int], int] = {}
        self._edges: dict[tuple[str, int, int], list[int]] = {}

    def forget_if_full(self) -> None:
        """Begin with empty tables if they have become too large: most of what they hold is not asked for again.

        Rows from before mean nothing in the new tables: not to be called while a schedule is being put together.
        """
        if self.clearances.size > _FULL:
            self._forget()

    def vertex(self, robot: str, v: int) -> int:
        """The row of a vertex."""
        if (robot, v) not in self._vertices:
            # A copy, because a view would keep alive the arrays that the roadmap has outgrown.
            self._vertices[robot, v] = self.clearances.row(robot, self.roadmaps[robot].q[v].copy())
        return self._vertices[robot, v]

    def path(self, robot: str, vertices: Sequence[int], start: int) -> list[int]:
        """Rows along a path, at most `STEP` apart; moves between them, and standing at them, are sampled.

        Parameters
        ----------
        vertices : the path; straight motions lead from one to the next.
        start : the row at the first vertex, which need not be the vertex's own.
        """
        rows = [start]
        for a, b in itertools.pairwise(vertices):
            rows += self._edge(robot, a, b)
        self.clearances.prepare(robot, [*itertools.pairwise(rows), *zip(rows, rows, strict=True)])
        return rows

    def _edge(self, robot: str, a: int, b: int) -> list[int]:
        """Rows along an edge from a to b, the first end excluded."""
        if (robot, a, b) not in self._edges:
            q = self.roadmaps[robot].q
            n = max(1, int(np.ceil(np.linalg.norm(q[b] - q[a]) / STEP)))
            inner = [self.clearances.row(robot, q[a] + (q[b] - q[a]) * (j / n)) for j in range(1, n)]
            self._edges[robot, a, b] = [*inner, self.vertex(robot, b)]
        return self._edges[robot, a, b]

    def edge_of(self, robot: str, row: int, after: int) -> tuple[int, int] | None:
        """The edge (from, to) on which one row comes after another, or the vertex (twice) that both are at; or None.

        Looks at all that is known: for use where the judge objected to a move, which is rare.
        """
        q, table = self.roadmaps[robot].q, self.clearances.tables[robot]
        if row == after:
            return next(((v, v) for (r, v), i in self._vertices.items() if r == robot and i == row), None)
        for (r, a, b), rows in self._edges.items():
            if r == robot and after in rows:
                k = rows.index(after)
                # The first row of a path need not be the vertex's own.
                if rows[k - 1] == row if k else np.array_equal(table[row], q[a]):
                    return a, b
        return None
