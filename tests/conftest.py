"""For all tests: Ctrl-C counts, wherever they were started."""

from __future__ import annotations

import signal

import pytest


@pytest.fixture(scope="session", autouse=True)
def _ctrl_c_counts() -> None:
    """A shell starts what runs in the background with Ctrl-C ignored, and processes inherit that."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
