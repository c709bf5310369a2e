"""A real headless Chromium for tests, cut off from the network; tests that need it are skipped where there is none."""

from __future__ import annotations

import atexit
import functools
import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

_ARGUMENTS = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--no-first-run",
    "--disable-component-update",
    "--disable-sync",
]


class Page:
    """A page in the browser: the addresses it asked for, the errors it reported, and its picture as an array."""

    def __init__(self, page) -> None:
        self.page = page
        self.requests: list[str] = []
        self.errors: list[str] = []
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("pageerror", lambda error: self.errors.append(str(error)))

    def picture(self) -> np.ndarray:
        """What a person sees, (height, width, 3), once two consecutive frames were drawn."""
        self.page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")).astype(int)


def chromium() -> str:
    """The path of Chromium; skips the test where it is not installed."""
    pytest.importorskip("playwright", reason="playwright is not installed")
    for name in ("chromium", "chromium-browser", "google-chrome"):
        path = shutil.which(name)
        if path:
            return path
    pytest.skip("Chromium is not installed")


@functools.cache
def _browser():
    """One browser for the whole test run: Playwright cannot be started twice at the same time."""
    executable = chromium()
    from playwright.sync_api import sync_playwright

    playwright = sync_playwright().start()
    atexit.register(playwright.stop)
    browser = playwright.chromium.launch(executable_path=executable, args=_ARGUMENTS)
    atexit.register(browser.close)
    return browser


@contextmanager
def open_page(address: str | Path, *, offline: bool = True, size: tuple[int, int] = (800, 500)) -> Iterator[Page]:
    """Open a file or an address in a window of its own."""
    context = _browser().new_context(viewport={"width": size[0], "height": size[1]}, offline=offline)
    try:
        page = Page(context.new_page())
        page.page.goto(address.resolve().as_uri() if isinstance(address, Path) else address)
        yield page
    finally:
        context.close()


def changed(a: np.ndarray, b: np.ndarray) -> float:
    """The share of pixels that differ visibly between two pictures."""
    return float(np.mean(np.abs(a - b).max(axis=2) > 24))
