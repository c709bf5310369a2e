"""The toys of the other tests are toys for these, too."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
