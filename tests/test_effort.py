"""Effort: shares are a partition of the work, within their bounds, and follow what activities gain."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from mrtamp.effort import Effort

FLOORS = {"search": 0.05, "skeletons": 0.1, "refinement": 0.1}
PRIOR = {"search": 0.0, "skeletons": 0.15, "refinement": 0.85}
CEILING = 0.85


def effort() -> Effort:
    return Effort(FLOORS, PRIOR, {"refinement": CEILING})


def worked(e: Effort, turns: int, gain: dict[str, float], work: dict[str, float] | None = None) -> Counter[str]:
    """So many turns of whatever is next; every turn gains and takes what is given for its activity."""
    turns_of = Counter[str]()
    for _ in range(turns):
        name = e.next(list(FLOORS))
        e.record(name, (work or {}).get(name, 1.0), gain.get(name, 0.0))
        turns_of[name] += 1
    return turns_of


@pytest.mark.parametrize("seed", range(5))
def test_shares_add_up_to_one_within_floors_and_ceilings_whatever_happened(seed: int) -> None:
    rng = np.random.default_rng(seed)
    e = effort()
    for _ in range(300):
        shares = e.shares()
        assert sum(shares.values()) == pytest.approx(1.0)
        assert all(shares[name] >= floor - 1e-12 for name, floor in FLOORS.items())
        assert shares["refinement"] <= CEILING + 1e-12
        name = str(rng.choice(list(FLOORS)))
        e.record(name, float(rng.exponential()), float(rng.exponential()) * (rng.random() < 0.3))


def test_before_anything_gained_the_prior_holds() -> None:
    shares = effort().shares()
    assert shares["search"] == pytest.approx(0.05)
    # 0.1 + 0.85 * 0.75 = 0.7375 for refinement, 0.1 + 0.15 * 0.75 for skeletons.
    assert shares["refinement"] == pytest.approx(0.7375)
    assert shares["skeletons"] == pytest.approx(0.2125)


@pytest.mark.parametrize("name", list(FLOORS))
def test_who_gains_gets_more_and_who_stops_gaining_gets_less_again(name: str) -> None:
    e = effort()
    before = e.shares()[name]
    for other in FLOORS:
        e.record(other, 1.0, 1.0 if other == name else 0.0)
    assert e.shares()[name] > before
    assert e.shares()[name] == max(e.shares().values())
    others = [other for other in FLOORS if other != name]
    for _ in range(300):
        e.record(name, 1.0, 0.0)
        for other in others:
            e.record(other, 1.0, 0.1)
    assert e.shares()[name] == pytest.approx(FLOORS[name], abs=0.01)


def test_gain_counts_per_work() -> None:
    """Equal gains, but skeletons take four times as long for them."""
    e = effort()
    for _ in range(100):
        e.record("search", 1.0, 0.5)
        e.record("skeletons", 4.0, 0.5)
    spare = 1.0 - sum(FLOORS.values())
    assert e.shares()["search"] == pytest.approx(FLOORS["search"] + spare * 0.8)
    assert e.shares()["skeletons"] == pytest.approx(FLOORS["skeletons"] + spare * 0.2)


@pytest.mark.parametrize("work", [{}, {"refinement": 3.0, "skeletons": 0.5}], ids=["equal turns", "long turns"])
def test_in_the_long_run_work_follows_the_shares(work: dict[str, float]) -> None:
    e = effort()
    worked(e, 3000, {}, work)
    whole = sum(e.total.values())
    for name, share in e.shares().items():
        assert e.total[name] / whole == pytest.approx(share, abs=0.02), name


def test_nobody_starves_while_another_gains_for_ever() -> None:
    e = effort()
    turns = worked(e, 1000, {"refinement": 1.0})
    more = worked(e, 1000, {"refinement": 1.0})
    for name, floor in FLOORS.items():
        assert turns[name] > 0.5 * floor * 1000
        assert more[name] > 0.5 * floor * 1000


def test_only_what_is_available_is_chosen() -> None:
    e = effort()
    for _ in range(50):
        name = e.next(["search", "skeletons"])
        assert name != "refinement"
        e.record(name, 1.0, 0.0)
    assert e.total["refinement"] == 0.0
    assert e.total["search"] > 0.0 and e.total["skeletons"] > 0.0


@pytest.mark.parametrize("available", [["search", "refinement"], list(FLOORS)])
def test_who_is_eager_has_all_that_the_floors_of_the_other_available_ones_leave(available: list[str]) -> None:
    e = Effort(FLOORS, PRIOR)
    turns = Counter[str]()
    for _ in range(1000):
        name = e.next(available, eager="refinement")
        e.record(name, 1.0, 0.0)
        turns[name] += 1
    left = 1.0 - sum(FLOORS[name] for name in available if name != "refinement")
    assert turns["refinement"] / 1000 == pytest.approx(left, abs=0.03)
    assert set(turns) == set(available)
