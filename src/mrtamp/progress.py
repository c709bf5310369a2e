"""The live line on stderr while a plan is being sought: redrawn in place on a terminal, now and then elsewhere."""

from __future__ import annotations

import shutil
import threading
import time
from types import TracebackType
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from mrtamp.status import Status

TERMINAL_PERIOD = 0.2
"""Seconds between two drawings on a terminal."""
LOG_PERIOD = 2.0
"""Seconds between two lines in a file or a pipe."""


def status_text(status: Status | str | None, elapsed_s: float) -> str:
    """One line: the time, the phase, how far the search has come and the cost of the incumbent; or ready words."""
    if status is None or isinstance(status, str):
        return f"{elapsed_s:6.1f} s  {status or 'preparing'}"
    parts = [f"{status.modes:,} modes", f"{status.nodes:,} nodes"]
    if status.cost is not None:
        parts.insert(0, f"cost {status.cost:.3f}")
    elif status.remaining != float("inf"):
        parts.insert(1, f"{status.remaining:.0f} transitions to go")
    return f"{elapsed_s:6.1f} s  {status.phase}: {', '.join(parts)}"


class LastLine:
    """The last line of a stream: redrawn in place on a terminal, one more line elsewhere.

    Attributes
    ----------
    gone : whoever read the stream has left; what is being done matters more.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.terminal = stream.isatty()
        self.gone = False

    def draw(self, text: str) -> None:
        """Show a text in place of the one before."""
        if self.terminal:
            self._write("\r\x1b[2K" + text[: shutil.get_terminal_size().columns - 1])
        else:
            self._write(text + "\n")

    def clear(self) -> None:
        """Leave the line empty, where that is possible."""
        if self.terminal:
            self._write("\r\x1b[2K")

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except (OSError, ValueError):
            self.gone = True


class ProgressLine:
    """Shows the latest `Status` of a planner; use it as a context manager and call it with every new status.

    A thread draws, so that the clock runs on while one iteration takes long.
    """

    def __init__(self, stream: TextIO, *, enabled: bool = True) -> None:
        self._line = LastLine(stream)
        self._enabled = enabled
        self._status: Status | str | None = None
        self._started = time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> ProgressLine:
        if self._enabled:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        if self._enabled:
            self._thread.join()
            self._line.clear()

    def __call__(self, status: Status | str) -> None:
        self._status = status

    def _run(self) -> None:
        period = TERMINAL_PERIOD if self._line.terminal else LOG_PERIOD
        while not self._over.wait(period) and not self._line.gone:
            self._line.draw(status_text(self._status, time.monotonic() - self._started))
