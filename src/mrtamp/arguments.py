"""Arguments of the command line: what they may be, and the one line that says which is wrong and what is valid.

Nothing here takes long to import.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import NoReturn


class Parser(argparse.ArgumentParser):
    """A parser, and parsers of commands under it, whose errors are one line each."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2, naming what was wrong and where all arguments are explained."""
        self.exit(2, f"{self.prog}: {message.removeprefix('argument ')}; see {self.prog} --help\n")


def positive(kind: Callable[[str], float], meaning: str) -> Callable[[str], float]:
    """The converter to a finite number above 0 of some `kind` (int, float); `meaning` says in words what is valid."""

    def convert(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = 0
        if not 0 < value < float("inf"):
            raise argparse.ArgumentTypeError(f"found {text!r}, expected {meaning}")
        return value

    return convert


count = positive(int, "a whole number from 1")
"""Converts to a whole number from 1."""


def natural(text: str) -> int:
    """Convert to a whole number from 0."""
    if not (text.isascii() and text.isdecimal()):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number from 0")
    return int(text)


def seconds(text: str) -> float:
    """Convert to a positive number of seconds."""
    return positive(float, "a positive number of seconds")(text)
