"""Tables in Markdown that grow row by row, with a line on stderr that says what is being measured meanwhile."""

from __future__ import annotations

import math
import statistics
import threading
import time
from collections.abc import Callable, Sequence
from typing import TextIO

from mrtamp.progress import LOG_PERIOD, TERMINAL_PERIOD, LastLine

_LOG_AGAIN_S = 10.0
"""Seconds between two lines in a file or a pipe after the first."""
Say = Callable[[str], None]
"""Prints a line of a table."""


class Line:
    """The last line of stderr: what is being measured, for how long already; from two seconds on."""

    def __init__(self, stream: TextIO, say: Say = print) -> None:
        self._line = LastLine(stream)
        self._say = say
        self._text = ""
        self._shown = ""
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Line:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._line.clear()

    def show(self, text: str) -> None:
        """What is going on now."""
        self._text = text

    def say(self, text: str) -> None:
        """Print a line of the result."""
        with self._lock:
            self._line.clear()
            self._say(text)

    def _run(self) -> None:
        began, due = time.monotonic(), LOG_PERIOD
        while not self._over.wait(TERMINAL_PERIOD) and not self._line.gone:
            elapsed = time.monotonic() - began
            if self._text and elapsed >= due:
                with self._lock:
                    self._line.draw(f"{elapsed:6.0f} s  {self._text}")
                due = elapsed + (TERMINAL_PERIOD if self._line.terminal else _LOG_AGAIN_S)


# -- numbers ---------------------------------------------------------------------------------------------------------


def median(values: Sequence[float]) -> float:
    """The median; infinite where more than half of the values are (no plan), or there are none."""
    return statistics.median(values) if values else float("inf")


def number(value: float | None, form: str = ".3f", unit: str = "") -> str:
    """A number in a table; a dash for what there is not."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:{form}}{unit}"


def yes_or_no(ok: bool) -> str:
    """Bold where it is not as it should be."""
    return "yes" if ok else "**no**"


def header(*columns: str) -> str:
    """The first two lines of a table in Markdown."""
    return f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}"


def table_row(*cells: str) -> str:
    """A line of a table in Markdown."""
    return f"| {' | '.join(cells)} |"
