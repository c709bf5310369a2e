"""One step of sequential convex programming: which knots may move, and the second-order cone program over them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pydrake.solvers import ClarabelSolver, MathematicalProgram, MathematicalProgramResult, SolverOptions
from scipy import sparse

from mrtamp.optimise.polyline import Polyline
from mrtamp.problem import CostWeights
from mrtamp.quiet import quiet

PENALTY = 20.0
"""Cost of a metre of penetration, relative to that of a radian of motion."""
_TINY = 1e-4
"""Share of the makespan's weight that shapes idle motion where path length has no weight."""
_TOLERANCES = (1e-3, 1e-4)
"""Of Clarabel, relative, at the first level and at finer ones."""


@dataclass(frozen=True, eq=False)
class Reduction:
    """Displacements of all knots, flattened (K * N,), as E z of independent variables z (n,).

    `variable` (K * N,) is the one that is the displacement of a knot's joint itself, -1 where none is; `knot` (n,) and
    `column` (n,) say which joint at which knot a variable moves; `cones` holds for every step and robot
    that can change: row among all lengths, the variables, and the matrix from them to the change of the joint vector.
    """

    line: Polyline
    E: sparse.csr_array
    variable: np.ndarray
    knot: np.ndarray
    column: np.ndarray
    cones: list[tuple[int, np.ndarray, np.ndarray]]


def reduce(line: Polyline, pinned: Mapping[str, np.ndarray]) -> Reduction:
    """Independent variables of a polyline: `pinned` (K,) per robot do not move, contact motions move as a whole."""
    K, N = line.q.shape
    rows: list[np.ndarray] = []
    columns: list[np.ndarray] = []
    values: list[np.ndarray] = []
    knots: list[int] = []
    joints: list[int] = []
    cones = []
    for number, (robot, cols) in enumerate(line.columns.items()):
        fixed = pinned[robot]
        of: list[list[tuple[int, float]]] = [[(k, 1.0)] for k in range(K)]
        for s in line.stretches:
            if s.robot != robot:
                continue
            event = int(line.events[s.event])
            for k in range(min(s.near, event), max(s.near, event) + 1):
                of[k] = [(event, 1.0)]
            inner, f = s.fractions(line.of(robot))
            for k, x in zip(inner.tolist(), f.tolist(), strict=True):
                of[k] = [(s.far, 1.0 - x), (event, x)]
        joint = np.arange(cols.start, cols.stop)
        eye = np.eye(len(joint))
        first: dict[int, int] = {}
        for k in range(K):
            for owner, weight in of[k]:
                if fixed[owner] or weight == 0.0:
                    continue
                if owner not in first:
                    first[owner] = len(knots)
                    knots += [owner] * len(joint)
                    joints += joint.tolist()
                rows.append(k * N + joint)
                columns.append(first[owner] + np.arange(len(joint)))
                values.append(np.full(len(joint), weight))
        for k in range(K - 1):
            moves: dict[int, float] = {}
            for sign, terms in ((1.0, of[k + 1]), (-1.0, of[k])):
                for owner, weight in terms:
                    if owner in first:
                        moves[first[owner]] = moves.get(first[owner], 0.0) + sign * weight
            used = [(f, w) for f, w in moves.items() if w != 0.0]
            if used:
                of_knots = np.concatenate([f + np.arange(len(joint)) for f, _ in used])
                cones.append((number * (K - 1) + k, of_knots, np.hstack([w * eye for _, w in used])))
    n = len(knots)
    if rows:
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        E = sparse.csr_array(entries, shape=(K * N, n))
    else:
        E = sparse.csr_array((K * N, n))
    variable = np.full(K * N, -1)
    variable[np.array(knots, dtype=int) * N + np.array(joints, dtype=int)] = np.arange(n)
    return Reduction(line, E, variable, np.array(knots, dtype=int), np.array(joints, dtype=int), cones)


@dataclass(frozen=True, eq=False)
class Linearised:
    """Constraints on the variables x = (z, y): `A x >= b`, `C x = 0`, `F x >= g`, and a box.

    Rows of A that do not hold at x = 0 are soft: what is missing has a price.
    """

    A: sparse.csr_array
    b: np.ndarray
    C: sparse.csr_array
    F: sparse.csr_array
    g: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def solve(
    reduction: Reduction, q: np.ndarray, weights: CostWeights, rows: Linearised, level: int = 0
) -> tuple[np.ndarray, float] | None:
    """Minimise the linearised cost; returns x = (z, y) and its cost, or None where Clarabel finds no optimum.

    `q` (K, N) are the knots; x are changes of them and of the scaled coordinates; at a finer `level` it is more exact.
    """
    line = reduction.line
    steps, robots = line.knots - 1, len(line.columns)
    n = len(rows.lower)
    # A row that cannot become active within the trust region is none.
    reach = rows.A.maximum(0) @ rows.lower + rows.A.minimum(0) @ rows.upper
    active = (reach < rows.b) & (np.abs(rows.A).sum(axis=1) > 1e-9)
    # What holds can go on to hold, and needs no slack: a third less work for Clarabel.
    firm, soft = np.flatnonzero(active & (rows.b <= 0.0)), np.flatnonzero(active & (rows.b > 0.0))
    m = len(soft)
    program = MathematicalProgram()
    x = program.NewContinuousVariables(n + robots * steps + steps + m)
    length = n
    span = n + robots * steps
    slack = span + steps
    long, short = weights.makespan, max(weights.path_length, _TINY * weights.makespan)
    cost = np.zeros(len(x))
    cost[length:span] = short
    cost[span:slack] = long
    cost[slack:] = PENALTY * (long + short)
    program.AddLinearCost(cost, x)
    lengths = line.lengths(q).reshape(-1)
    # What is bounded from below by a cone needs no bound besides.
    low = np.concatenate([rows.lower, lengths, np.full(steps, -np.inf), np.zeros(m)])
    high = np.concatenate([rows.upper, lengths, np.full(steps + m, np.inf)])
    dq = np.diff(q, axis=0)
    for row, used, change in reduction.cones:
        r, k = divmod(row, steps)
        cols = list(line.columns.values())[r]
        size = len(change)
        A = np.zeros((size + 1, len(used) + 1))
        A[0, -1] = 1.0
        A[1:, :-1] = change
        b = np.zeros(size + 1)
        b[1:] = dq[k, cols]
        program.AddLorentzConeConstraint(A, b, np.append(x[used], x[length + row]))
        low[length + row], high[length + row] = -np.inf, np.inf
    if long > 0:
        each = np.arange(robots * steps)
        entries = (
            np.concatenate([np.ones(len(each)), -np.ones(len(each))]),
            (np.concatenate([each, each]), np.concatenate([each, robots * steps + each % steps])),
        )
        order = sparse.csc_matrix(entries, shape=(len(each), robots * steps + steps))
        program.AddLinearConstraint(order, np.full(len(each), -np.inf), np.zeros(len(each)), x[length:slack])
    else:
        low[span:slack] = high[span:slack] = 0.0
    program.AddBoundingBoxConstraint(low, high, x)
    if len(firm):
        A = sparse.csc_matrix(rows.A[firm])
        program.AddLinearConstraint(A, rows.b[firm], np.full(len(firm), np.inf), x[:n])
    if m:
        A = sparse.csc_matrix(sparse.hstack([rows.A[soft], sparse.eye_array(m)]))
        program.AddLinearConstraint(A, rows.b[soft], np.full(m, np.inf), np.concatenate([x[:n], x[slack:]]))
    if rows.C.shape[0]:
        program.AddLinearEqualityConstraint(sparse.csc_matrix(rows.C), np.zeros(rows.C.shape[0]), x[:n])
    if rows.F.shape[0]:
        program.AddLinearConstraint(sparse.csc_matrix(rows.F), rows.g, np.full(len(rows.g), np.inf), x[:n])
    tolerance = _TOLERANCES[min(level, len(_TOLERANCES) - 1)]
    result = _optimum(program, tolerance, refinement=False) or _optimum(program, tolerance, refinement=True)
    if result is None:
        return None
    return np.clip(result.GetSolution(x[:n]), rows.lower, rows.upper), float(result.get_optimal_cost())


def _optimum(program: MathematicalProgram, tolerance: float, *, refinement: bool) -> MathematicalProgramResult | None:
    """What Clarabel finds within a relative tolerance; far sooner without iterative `refinement` of its steps."""
    solver, options = ClarabelSolver(), SolverOptions()
    for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
        options.SetOption(solver.id(), name, tolerance)
    options.SetOption(solver.id(), "iterative_refinement_enable", int(refinement))
    with quiet():
        result = solver.Solve(program, None, options)
    return result if result.is_success() else None
