"""The live line: in place on a terminal, now and then in a log, silent when asked."""

from __future__ import annotations

import io
import time
from types import SimpleNamespace

import pytest

from mrtamp import progress


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


STATUS = SimpleNamespace(
    phase="first plan", iteration=3, elapsed_s=1.0, modes=14, orbits=20, nodes=1204, remaining=2, cost=None
)
IMPROVING = SimpleNamespace(**{**vars(STATUS), "phase": "improving", "cost": 12.0309, "remaining": 0})


def test_texts() -> None:
    assert progress.status_text(None, 0.5) == "   0.5 s  preparing"
    assert progress.status_text(STATUS, 3.21) == "   3.2 s  first plan: 14 modes, 2 transitions to go, 1,204 nodes"
    assert progress.status_text(IMPROVING, 5.0) == "   5.0 s  improving: cost 12.031, 14 modes, 1,204 nodes"


def test_terminal_line_is_redrawn_and_wiped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "TERMINAL_PERIOD", 0.01)
    stream = Terminal()
    with progress.ProgressLine(stream) as line:
        line(STATUS)
        time.sleep(0.1)
    text = stream.getvalue()
    assert text.count("14 modes") > 1
    assert "\n" not in text
    assert text.endswith("\r\x1b[2K")


def test_log_gets_whole_lines_while_an_iteration_takes_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LOG_PERIOD", 0.02)
    stream = io.StringIO()
    with progress.ProgressLine(stream) as line:
        line(STATUS)
        time.sleep(0.15)
    lines = stream.getvalue().splitlines()
    assert len(lines) >= 2
    assert all("first plan" in text for text in lines)
    assert "\x1b" not in stream.getvalue()


def test_quiet_is_quiet_and_a_closed_stream_is_no_disaster(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LOG_PERIOD", 0.01)
    stream = io.StringIO()
    with progress.ProgressLine(stream, enabled=False):
        time.sleep(0.05)
    assert stream.getvalue() == ""
    with progress.ProgressLine(stream):
        stream.close()
        time.sleep(0.05)
