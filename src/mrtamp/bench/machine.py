"""What a run was measured on and with: processor, memory, system, versions."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path


@dataclass(frozen=True)
class Machine:
    """A machine and the software on it; `commit` is None away from the sources and ends in `+` with changes to them."""

    cpu: str
    cores: int
    memory_gib: float
    system: str
    python: str
    drake: str
    numpy: str
    mrtamp: str
    commit: str | None

    def text(self) -> str:
        """The same in one line."""
        source = f" ({self.commit})" if self.commit else ""
        return (
            f"{self.cpu}, {self.cores} cores, {self.memory_gib:g} GiB; {self.system}; Python {self.python}, "
            f"Drake {self.drake}, NumPy {self.numpy}, mrtamp {self.mrtamp}{source}"
        )


@cache
def this_machine() -> Machine:
    """The machine and the software of this process."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return Machine(
        cpu=_cpu(),
        cores=len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        memory_gib=round(memory, 1),
        system=f"{platform.system()} {platform.release()}",
        python=platform.python_version(),
        drake=version("drake"),
        numpy=version("numpy"),
        mrtamp=_own_version(),
        commit=_commit(),
    )


def machines_text(machines: Iterable[Machine]) -> str:
    """Every different machine once, in one line each."""
    return "\n".join(machine.text() for machine in dict.fromkeys(machines))


def _cpu() -> str:
    file = Path("/proc/cpuinfo")
    if file.exists():
        for line in file.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    return platform.processor() or platform.machine()


def _own_version() -> str:
    try:
        return version("mrtamp")
    except PackageNotFoundError:
        return "not installed"


def _commit() -> str | None:
    """The commit of the source tree this module is in."""
    root = Path(__file__).resolve().parents[3]
    if not (root / ".git").exists():
        return None
    try:
        commit = _git(root, "rev-parse", "--short", "HEAD")
        changed = _git(root, "status", "--porcelain", "--untracked-files=no", "--", "src", "models")
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit + ("+" if changed else "")


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(root), *arguments], check=True, capture_output=True, text=True)
    return done.stdout.strip()
