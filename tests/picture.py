"""Take the picture of a page that `mrtamp plan --html` wrote: python tests/picture.py PAGE SECONDS OUT.png"""

from __future__ import annotations

import sys
from pathlib import Path

from browser import open_page
from PIL import Image


def main(page: str, seconds: str, out: str) -> None:
    """Write the page's picture at a time of its animation."""
    with open_page(Path(page), size=(1200, 675)) as opened:
        opened.page.wait_for_function("window.mrtamp && window.mrtamp.ready")
        opened.page.wait_for_timeout(3000)  # meshes arrive after the animation
        opened.page.evaluate("time => { if (mrtamp.playing) mrtamp.toggle(); mrtamp.seek(time); }", float(seconds))
        picture = Image.fromarray(opened.picture().astype("uint8"))
    picture.save(out, optimize=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
