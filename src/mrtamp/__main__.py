"""`python -m mrtamp` is the command `mrtamp`."""

from mrtamp.cli import main

raise SystemExit(main())
