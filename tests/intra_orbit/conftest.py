"""Flatland has no Drake world in which trees could grow: its roadmaps are all there is."""

import pytest

from mrtamp.connect import Connector


@pytest.fixture(autouse=True)
def roadmaps_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Connector, "connect", lambda *_: None)
