"""Keeping Drake's log to what a person should read."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet() -> Iterator[None]:
    """Keep Drake from saying anything but errors.

    It announces windows that nobody is meant to open, lists textures it can do without, and tells of programs that are
    solved again in another way.
    """
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
