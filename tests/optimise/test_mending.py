"""Mending: what grazes something is freed close by, at a cost little above its own; what is deep inside is left."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from discs import RADIUS, Errands, disc_problem
from gantry import gantry_problem, valid_plan
from pydrake.math import RigidTransform
from test_optimiser import discs, judged
from test_rows import optimiser

from mrtamp.optimise import Optimiser
from mrtamp.optimise import optimiser as optimiser_module
from mrtamp.optimise.collisions import Collisions
from mrtamp.optimise.fine import Violations
from mrtamp.optimise.iterate import Iterate
from mrtamp.optimise.program import Linearised, Reduction
from mrtamp.plan import Plan
from mrtamp.problem import CollisionRules, CostWeights, RobotAt, Shape, StaticBody


def around(folder: Path, inside: float) -> Plan:
    """A disc goes around the end of a wall in two straight motions, each of which is that deep (m) in it."""
    wall = StaticBody("wall", RigidTransform([-1.0, 0, 0.05]), Shape("box", (2.0, 0.002, 0.1)))
    problem = discs(folder, statics=(wall,), goal=(RobotAt("a", np.array([-0.5, 0.5])),))
    # The line from (-0.5, -0.5) to (x, 0) passes the wall's end, the origin, at that distance.
    square = (RADIUS - inside) ** 2
    x = max(np.roots([0.25 - square, -square, -0.5 * square]).tolist())
    return Errands(problem).move(a=(x, 0.0)).move(a=(-0.5, 0.5)).plan()


def looked_at(scp: Optimiser) -> tuple[Iterate, list[Violations]]:
    now = scp._now
    return now, scp._violations(now, scp.collisions.rows(now.line, now.q, now.arrangement).clearance, True)


@pytest.mark.parametrize("inside", [0.001, 0.004, 0.012])
def test_a_graze_is_mended_close_by(tmp_path: Path, inside: float) -> None:
    scp = optimiser(around(tmp_path, inside), draft=True)
    base, found = looked_at(scp)
    deepest = max(float(v.depth.max()) for v in found)
    assert deepest == pytest.approx(inside, abs=2e-3)
    mended = scp.mending.attempt(base, found, np.inf)
    assert mended is not None
    assert np.abs(mended.q - base.q).max() <= 0.02 + 1e-9
    assert mended.cost <= base.cost + 3 * inside + 2e-3
    scp._best = scp._now = mended
    assert judged(scp).ok


def test_what_is_deep_inside_or_no_cheaper_is_left_alone(tmp_path: Path) -> None:
    scp = optimiser(around(tmp_path, 0.06), draft=True)
    base, found = looked_at(scp)
    assert scp.mending.attempt(base, found, np.inf) is None
    scp = optimiser(around(tmp_path, 0.004), draft=True)
    base, found = looked_at(scp)
    assert scp.mending.attempt(base, found, base.cost) is None, "no gain"
    solve, scp.mending.solve = scp.mending.solve, lambda *_: None
    assert scp.mending.attempt(base, found, np.inf) is None, "no program is solved"
    scp.mending.solve = solve
    tried = [scp.mending.attempt(base, found, np.inf) is not None for _ in range(3)]
    assert tried == [False, False, True], "after an attempt in vain not at once"


def test_distances_that_are_left_are_lower_bounds(tmp_path: Path) -> None:
    scp = optimiser(valid_plan(gantry_problem(tmp_path)))
    now, rng = scp._now, np.random.default_rng(0)
    rules = Collisions(scp.nearness, 0.0, pieces=8, reach=0.02)

    def measured(q: np.ndarray) -> dict:
        return rules.rows(now.line, q, now.arrangement).clearance

    before, q = measured(now.q), now.q
    tight = 0
    for scale in (0.002, 0.01, 0.02):
        after = q + rng.uniform(-scale, scale, q.shape)
        left, true = scp.fine.left(before, now.line, q, after), measured(after)
        for who in true:
            assert np.all(left[who] <= true[who] + 1e-6), who
            tight += int(np.count_nonzero(left[who] > true[who] - 0.01))
    assert tight > 100, "and not much lower than they are"


def test_penetrations_of_all_robots_together_are_what_is_tolerated(tmp_path: Path) -> None:
    """Disc a is 6 mm in the wall and 6 mm in disc b, which has come to stand there first and does not move any more."""

    def found(tolerance: float) -> list[Violations]:
        problem = replace(
            discs(tmp_path, statics=disc_problem(tmp_path).statics), collision=CollisionRules((), tolerance)
        )
        # The wall's face is at y = -0.05.
        y = -0.05 - RADIUS + 0.006
        distance = 2 * RADIUS - 0.006
        x = 0.1 - float(np.sqrt(distance**2 - 0.1**2))
        plan = Errands(problem).move(b=(0.1, y - 0.1)).move(a=(x - 0.3, y)).move(a=(x, y)).plan()
        return looked_at(optimiser(plan, draft=True))[1]

    assert not found(0.0125)
    assert {v.who for v in found(0.011)} == {("a",), ("a", "b")}
    assert max(float(v.depth.max()) for v in found(0.011)) == pytest.approx(0.0012, abs=4e-4)


@pytest.mark.parametrize(("gain", "mends"), [(0.01, False), (0.0005, True)])
def test_what_the_next_program_gains_more_on_is_not_mended_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gain: float, mends: bool
) -> None:
    scp = optimiser(around(tmp_path, 0.0009), draft=True)
    grazing, asked = scp._now, []
    scp._now = replace(grazing, cost=grazing.cost / (1 - gain))
    monkeypatch.setattr(scp, "_solve", lambda *_: grazing)
    monkeypatch.setattr(scp.mending, "attempt", lambda *_: asked.append(True))
    scp.step()
    assert bool(asked) is mends


def test_what_still_grazes_when_no_more_steps_come_is_mended(tmp_path: Path) -> None:
    scp = optimiser(around(tmp_path, 0.004), draft=True)
    base, _ = looked_at(scp)
    scp._rows = scp.collisions.rows(base.line, base.q, base.arrangement)
    scp.to_beat = base.cost
    scp.finish()
    assert np.isinf(scp.cost), "it would not be worth it"
    scp.to_beat = np.inf
    scp.finish()
    assert scp.cost <= 1.01 * base.cost
    assert judged(scp).ok


def test_what_a_program_left_out_is_put_in_where_it_turns_out_to_be_in_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scp = optimiser(around(tmp_path, -0.03))
    now = scp._now
    rows = scp.collisions.rows(now.line, now.q, now.arrangement)
    sizes, solve = list[int](), optimiser_module.solve

    def noted(reduction: Reduction, q: np.ndarray, weights: CostWeights, linear: Linearised, level: int) -> object:
        sizes.append(len(linear.b))
        return solve(reduction, q, weights, linear, level)

    monkeypatch.setattr(optimiser_module, "solve", noted)
    everything = scp._solve(now, rows, 0.35)
    assert everything is not None
    assert sizes == [len(rows.gap)]
    after = rows.gap + rows.A[:, : now.q.size] @ (everything.q - now.q).reshape(-1)
    assert after[rows.gap >= 0].min() > -1e-3, "what keeps clear goes on to, as far as linear distances tell"
    scp._stride = 0.0
    again = scp._solve(now, rows, 0.35)
    assert again is not None
    assert sizes[1] < sizes[2] == len(rows.gap)
    np.testing.assert_allclose(again.q, everything.q, atol=1e-9)
    scp._solve(now, rows, 0.002)
    assert len(sizes) == 4, "nothing that was left out is within reach of small steps"
