"""Plan the peer problems, have the referee price the plans, and print them beside what has been published.

    python -m tests.peers DIR [--problem NAME] [--seeds 5] [--budget 10]

Seconds are processor time of this process, from the moment a problem is handed to the planner.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mrtamp.plan import Plan
from mrtamp.planner import Planner
from mrtamp.problem import MrtampError

from .data import VARIABLE, Peer, load_peer, peer_files
from .reader import problem_of
from .referee import Referee, legs_of

CHECKPOINTS = (10.0, 60.0, 120.0)
"""Seconds at which the cost is reported, as far as the budget goes."""


@dataclass
class Run:
    """What one seed did: (seconds, cost) of every better plan, and what the referee says about the last one."""

    costs: list[tuple[float, float]] = field(default_factory=list)
    verdict: str = "no plan"

    def at(self, seconds: float) -> float:
        """The best cost after some time."""
        return min([cost for t, cost in self.costs if t <= seconds], default=np.inf)

    def line(self, checkpoints: list[float]) -> str:
        """First time and cost, the costs at the checkpoints, and the verdict."""
        first = f"{self.costs[0][0]:6.2f} s / {self.costs[0][1]:7.3f}" if self.costs else " " * 18
        return "  ".join([first, *(f"{t:g} s: {_shown(self.at(t))}" for t in checkpoints), self.verdict])


def _shown(cost: float) -> str:
    return f"{cost:7.3f}" if np.isfinite(cost) else "      -"


def run(peer: Peer, referee: Referee, folder: Path, seed: int, budget: float) -> Run:
    """Plan `peer` for `budget` seconds; every better plan goes to the referee, the last one's verdict is kept."""
    out, best = Run(), None
    began = time.process_time()
    try:
        planner = Planner(problem_of(peer, folder), seed=seed)
        while (left := budget - (time.process_time() - began)) > 0:
            for plan in planner.improve(left):
                best = plan
                out.costs.append((time.process_time() - began, plan.cost))
    except MrtampError as error:
        out.verdict = f"ERROR: {error}"
        return out
    if best is None:
        out.verdict = "no plan: " + planner.explain().replace("\n", "; ")
    else:
        out.verdict = verdict(peer, referee, best)
    return out


def verdict(peer: Peer, referee: Referee, plan: Plan) -> str:
    """What the referee says, and that its price is the plan's cost."""
    found = referee.judge(legs_of(peer, plan))
    differs = abs(found.price - plan.cost) > 1e-6 * plan.cost
    return str(found) + (f" (but the plan says {plan.cost:.6f})" if differs else "")


def published(folder: Path, name: str) -> list[str]:
    """Rows of the tables in the folder's README that are about a problem: its own, and those below without a name."""
    file = folder / "README.md"
    out, mine = [], False
    for line in file.read_text().splitlines() if file.is_file() else []:
        cells = [c.strip() for c in line.strip().strip("|").split("|")]
        if not line.startswith("|"):
            mine = False
            continue
        if cells[0] == "problem":
            out.append(line)
        elif cells[0]:
            mine = name.startswith(cells[0].split()[0])
        if mine:
            out.append(line)
    return out


def main() -> None:
    """Read the command line and print a table per problem."""
    parser = argparse.ArgumentParser(prog="python -m tests.peers", description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, help=f"folder with the problems (default: {VARIABLE})")
    parser.add_argument("--problem", help="only problems whose name contains this")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--budget", type=float, default=10.0, help="seconds per problem and seed")
    arguments = parser.parse_args()
    files = [f for f in peer_files(arguments.folder) if arguments.problem is None or arguments.problem in f.stem]
    if not files:
        parser.error(f"no problem found: name the folder that holds them, here or in {VARIABLE}")
    checkpoints = [t for t in CHECKPOINTS if t < arguments.budget] + [arguments.budget]
    for file in files:
        peer = load_peer(file)
        referee = Referee(peer)
        print(f"\n{peer.name}", flush=True)
        runs = []
        for seed in range(arguments.seeds):
            with tempfile.TemporaryDirectory() as folder:
                runs.append(run(peer, referee, Path(folder), seed, arguments.budget))
            print(f"  seed {seed}: {runs[-1].line(checkpoints)}", flush=True)
        solved = [r for r in runs if r.costs]
        if solved:
            first = np.median([r.costs[0] for r in solved], axis=0)
            middle = "  ".join(f"{t:g} s: {_shown(np.median([r.at(t) for r in runs]))}" for t in checkpoints)
            print(f"  median: {first[0]:6.2f} s / {first[1]:7.3f}  {middle}  ({len(solved)} of {len(runs)} solved)")
        for line in published(file.parent, peer.name):
            print(f"  {line}")


if __name__ == "__main__":
    main()
