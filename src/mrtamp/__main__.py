"""The command `mrtamp`, also as `python -m mrtamp`.

Until the command line deals with signals itself, Ctrl-C ends the process at once: an exception in the middle of an
import would surface as any other.
"""

from __future__ import annotations

import os
import signal
from types import FrameType


def main() -> int:
    """Run the command line and return its exit code."""
    # Whoever runs it in the background may have it ignore Ctrl-C.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    from mrtamp.cli import main as run

    return run()


def _end(number: int, frame: FrameType | None) -> None:
    os.write(2, b"stopped\n")
    os._exit(128 + number)


if __name__ == "__main__":
    raise SystemExit(main())
