"""What workers are given to do in tests; a module of its own, because workers import it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from pathlib import Path
from typing import Any

from mrtamp.cluster import end_with_parent, link


def square(x: int) -> int:
    """The square, told in advance."""
    link().tell({"square": x * x})
    return x * x


def reciprocal(x: int) -> float:
    """Fails for 0."""
    return 1 / x


def lock() -> object:
    """Something that cannot be sent back."""
    import threading

    return threading.Lock()


def noted(folder: str, name: str, deaths: int) -> int:
    """Notes that it was started, kills its worker the first `deaths` times, and returns how often it was started."""
    file = Path(folder) / name
    with file.open("a") as notes:
        notes.write("x")
    started = len(file.read_text())
    if started <= deaths:
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.3)
    return started


def sleeper(file: str) -> None:
    """The process of `with_child`: for ever, but not without its parent."""
    end_with_parent(0.05)
    Path(file).write_text(str(os.getpid()))
    time.sleep(600)


def with_child(folder: str, name: str) -> None:
    """Starts a process of its own, whose id it notes in a file, and waits for ever."""
    context: Any = multiprocessing.get_context("spawn")
    context.Process(target=sleeper, args=(str(Path(folder) / name),), daemon=True).start()
    while True:
        time.sleep(0.1)


def until_cancelled(folder: str) -> None:
    """Works until nobody waits for it, and notes that."""
    own = link()
    own.tell("working")
    while not own.cancelled:
        time.sleep(0.05)
    (Path(folder) / "cancelled").touch()


def await_bound(name: str) -> float:
    """Waits until a bound that several share is finite, and returns it."""
    from mrtamp.portfolio_plan import SharedBound

    link().tell("waiting")
    with SharedBound(name) as bound:
        while bound.cost == float("inf"):
            time.sleep(0.02)
    return bound.cost
