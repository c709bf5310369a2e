"""The lowest cost that any run ever found, per problem, in a file that only ever gets lower (`models/best_known.json`).

Costs of plans are measured against it.  It ships with the package, and `mrtamp bench costs --update` lowers it.
Whoever changes a problem removes its entry.
"""

from __future__ import annotations

import fcntl
import json
import math
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mrtamp.bench.run import Run, Task
from mrtamp.problem import MrtampError

VERSION = 1
_KEYS = {"problem", "parameters", "cost", "seed", "found_after_s", "command"}


@dataclass(frozen=True)
class Best:
    """The cheapest plan ever found for a problem, and how: planner seed, seconds, command."""

    cost: float
    seed: int
    found_after_s: float
    command: str


def best_known_file() -> Path:
    """Where the file is."""
    from mrtamp.model_files import models_dir

    return models_dir() / "best_known.json"


def best_of(run: Run, command: str) -> Best | None:
    """The cheapest plan of a run that passed the check; None without one."""
    if run.best is None or run.refused:
        return None
    return Best(run.best.cost, run.seed, round(run.best.time_s, 2), command)


class BestKnown:
    """The file, read once; lowered in memory with everything seen, on disk only by `update`.

    Parameters
    ----------
    file : of best known costs; a missing file is an empty one.

    Raises
    ------
    MrtampError : the file is not what it should be.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._known = _read(file)

    def cost(self, task: Task) -> float:
        """The lowest cost known for a problem, infinite where none is."""
        best = self._known.get(_key(task.problem, _full(task)))
        return best.cost if best else math.inf

    def see(self, task: Task, best: Best) -> bool:
        """Take notice of a plan; whether it is cheaper than all before it."""
        return _lower(self._known, task, best)

    def update(self, task: Task, best: Best) -> bool:
        """Lower the file, if `best` is cheaper than what it says now; whether it was."""
        self.see(task, best)
        with _locked(self.file.parent):
            # Others may have lowered it meanwhile.
            known = _read(self.file)
            lower = _lower(known, task, best)
            if lower:
                _write(self.file, known)
        for key, other in known.items():
            if key not in self._known or other.cost < self._known[key].cost:
                self._known[key] = other
        return lower


_Key = tuple[str, tuple[tuple[str, int], ...]]


def _key(problem: str, parameters: Mapping[str, int]) -> _Key:
    return problem, tuple(sorted(parameters.items()))


def _full(task: Task) -> Mapping[str, int]:
    """The parameters, with the layout seed that a generated problem has by default."""
    return {"layout_seed": 0, **task.parameters} if task.parameters else {}


def _lower(known: dict[_Key, Best], task: Task, best: Best) -> bool:
    if not (math.isfinite(best.cost) and best.cost > 0):
        raise MrtampError(f"{task.name}: found the cost {best.cost!r}, expected a positive number")
    key = _key(task.problem, _full(task))
    if key in known and best.cost >= known[key].cost:
        return False
    known[key] = best
    return True


def _read(file: Path) -> dict[_Key, Best]:
    if not file.exists():
        return {}
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise MrtampError(f"{file}: {error}") from None
    if not isinstance(data, dict) or data.get("mrtamp_best_known") != VERSION:
        raise MrtampError(f"{file}: mrtamp_best_known: expected {VERSION}")
    out = {}
    for entry in data.get("problems", []):
        if not isinstance(entry, dict) or set(entry) != _KEYS:
            raise MrtampError(f"{file}: problems: found {entry!r}, expected the keys {', '.join(sorted(_KEYS))}")
        found = Best(entry["cost"], entry["seed"], entry["found_after_s"], entry["command"])
        out[_key(entry["problem"], entry["parameters"])] = found
    return out


def _write(file: Path, known: Mapping[_Key, Best]) -> None:
    """Replace the file by a complete new one."""
    entries: list[dict[str, Any]] = [
        {"problem": problem, "parameters": dict(parameters), **asdict(best)}
        for (problem, parameters), best in sorted(known.items())
    ]
    text = json.dumps({"mrtamp_best_known": VERSION, "problems": entries}, indent=2) + "\n"
    with tempfile.NamedTemporaryFile(
        "w", encoding="utf-8", dir=file.parent, prefix=f".{file.name}.", delete=False
    ) as f:
        try:
            f.write(text)
            f.flush()
            os.fsync(f.fileno())
            os.chmod(f.name, 0o644)
            os.replace(f.name, file)
        except BaseException:
            Path(f.name).unlink(missing_ok=True)
            raise


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """One writer at a time."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)
