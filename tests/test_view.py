"""The page and the live window, as a person in a browser meets them."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from browser import Page, changed, open_page
from discs import disc_problem, errand
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.geometry import Meshcat
from sketches import sketch

import mrtamp
from mrtamp.plan import Plan
from mrtamp.stage import GHOSTS
from mrtamp.view import _slerp, keyframes, view, write_html


@pytest.fixture(scope="module")
def plan() -> Plan:
    return sketch(mrtamp.load_problem("pick_place", robots=2, objects=2))


@pytest.fixture(scope="module")
def file(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_html(plan, tmp_path_factory.mktemp("page") / "plan.html")


@pytest.fixture(scope="module")
def opened(file: Path) -> Iterator[Page]:
    """The page, loaded once for all tests that look at it."""
    with open_page(file) as page:
        page.page.wait_for_function("window.mrtamp && window.mrtamp.ready", timeout=30_000)
        yield page


def at(opened: Page, time: float) -> np.ndarray:
    """The picture at a time, the animation paused."""
    opened.page.evaluate("time => { if (mrtamp.playing) mrtamp.toggle(); mrtamp.seek(time); }", time)
    return opened.picture()


def test_page_plays_by_itself_without_the_network(opened: Page) -> None:
    started = opened.page.evaluate("mrtamp.time")
    opened.page.wait_for_function("before => mrtamp.time > before + 0.3", arg=started, timeout=20_000)
    assert opened.errors == []
    assert [r[:60] for r in opened.requests if not r.startswith(("file:", "data:", "blob:"))] == []


def test_picture_shows_the_robots(opened: Page) -> None:
    picture = at(opened, 0.0)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 2000, "the page is nearly blank"
    opened.page.evaluate("mrtamp.set_visible('scene', false)")
    without = opened.picture()
    opened.page.evaluate("mrtamp.set_visible('scene', true)")
    assert changed(picture, without) > 0.1, "robots and table fill less than a tenth of the picture"
    assert changed(picture, opened.picture()) < 0.001


def test_animation_moves_robots_and_object(opened: Page, plan: Plan) -> None:
    duration = opened.page.evaluate("Number(document.getElementById('mrtamp-clock').textContent.split(/[ /]+/)[1])")
    start, middle, end = (at(opened, share * duration)[:420] for share in (0.0, 0.5, 1.0))
    assert changed(start, middle) > 0.005
    assert changed(middle, end) > 0.005


def test_timeline_lists_every_action_and_jumps_to_it(opened: Page, plan: Plan) -> None:
    items = opened.page.locator("#mrtamp-steps li")
    assert items.count() == sum(len(t.actions) for t in plan.transitions)
    assert "arm1 hands cube1 to arm2" in items.nth(1).inner_text()
    items.nth(1).click()
    assert "now" in (items.nth(1).get_attribute("class") or "")
    assert opened.page.evaluate("mrtamp.time") > 0


def test_space_pauses_and_arrow_keys_step(opened: Page) -> None:
    at(opened, 1.0)
    opened.page.keyboard.press("ArrowRight")
    assert opened.page.evaluate("mrtamp.time") == pytest.approx(1.1)
    opened.page.keyboard.press("Space")
    assert opened.page.evaluate("mrtamp.playing")
    opened.page.keyboard.press("Space")
    assert not opened.page.evaluate("mrtamp.playing")


@pytest.mark.parametrize("part", ["traces", "goals"])
def test_parts_of_the_picture_can_be_switched_off(opened: Page, part: str) -> None:
    shown = at(opened, 0.0)
    button = opened.page.locator(f"#mrtamp-bar [data-part={part}]")
    button.click()
    hidden = opened.picture()
    button.click()
    assert changed(shown[:420], hidden[:420]) > 0.0003
    assert button.get_attribute("aria-pressed") == "true"


def test_page_is_of_moderate_size_and_complete(file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    assert len(text) < 6e6
    assert "<script src=" not in text and "<link " not in text
    assert list(file.parent.iterdir()) == [file], "temporary files were left behind"


def test_names_cannot_break_the_page(plan: Plan, tmp_path: Path) -> None:
    problem = dataclasses.replace(plan.problem, name="</script><b>&name", description="")
    text = write_html(problem, tmp_path / "page.html").read_text(encoding="utf-8")
    assert "</script><b>" not in text
    assert "<title>&lt;/script&gt;&lt;b&gt;&amp;name</title>" in text


def test_subgoals_are_listed_and_their_targets_drawn(tmp_path: Path) -> None:
    """Also of robots that slide: they stand where they start, not where their rails are fixed."""
    problem = disc_problem(tmp_path)
    page = write_html(errand(problem), tmp_path / "discs.html").read_text()
    assert "a reaches visit" in page and "b reaches drop, token stays there" in page
    meshcat = Meshcat()
    view(problem, meshcat)
    for target in ("visit/a", "take/b", "drop/b"):
        assert meshcat.HasPath(f"{GHOSTS}/{target}")
    assert not meshcat.HasPath(f"{GHOSTS}/visit/b")


def test_pages_do_not_inherit_from_each_other(plan: Plan, file: Path, tmp_path: Path) -> None:
    before = write_html(plan.problem, tmp_path / "a.html").read_text(encoding="utf-8")
    write_html(plan, tmp_path / "b.html")
    after = write_html(plan.problem, tmp_path / "c.html").read_text(encoding="utf-8")
    assert len(before) == len(after) < file.stat().st_size


def test_pages_and_windows_survive_threads() -> None:
    """A Meshcat that is destroyed by a foreign thread ends the process, so this needs a process of its own."""
    code = """if True:
        import gc, threading
        import mrtamp
        from mrtamp.view import inline, view
        problem = mrtamp.load_problem("box")
        def work():
            inline(problem)
            view(problem)
        threads = [threading.Thread(target=target) for target in (work, gc.collect, work, gc.collect)]
        work()
        for thread in threads:
            thread.start()
            thread.join()
        gc.collect()
        print("alive", flush=True)
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "alive\n"
    assert done.returncode == 0, done.stderr


def test_unwritable_page_is_an_error(plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(OSError):
        write_html(plan.problem, tmp_path / "nowhere" / "page.html")


def test_live_window_obeys_its_controls(plan: Plan) -> None:
    viewer = view(plan)
    with open_page(viewer.url, offline=False) as page:
        page.page.wait_for_function("typeof viewer !== 'undefined' && Object.keys(viewer.gui_controllers).length > 5")
        page.page.get_by_text("Open Controls").click()
        viewer.run(timeout_s=0.6)
        slider = viewer.meshcat.GetSliderValue("time (s)")
        assert 0.2 < slider < 1.5, "the plan does not play"
        page.page.keyboard.press("Space")
        page.page.wait_for_timeout(300)
        viewer.run(timeout_s=0.3)
        paused = viewer.meshcat.GetSliderValue("time (s)")
        viewer.run(timeout_s=0.3)
        assert viewer.meshcat.GetSliderValue("time (s)") == paused
        page.page.get_by_text("arm1 hands cube1 to arm2").click()
        page.page.wait_for_timeout(300)
        viewer.run(timeout_s=0.2)
        step = viewer.playback.events[1].start
        assert viewer.meshcat.GetSliderValue("time (s)") == pytest.approx(step, abs=0.01)
        page.page.keyboard.press("Escape")
        page.page.wait_for_timeout(300)
        viewer.run(timeout_s=30.0)  # returns at once: stop was pressed


def test_a_window_can_be_used_again(plan: Plan) -> None:
    meshcat = Meshcat()
    meshcat.AddButton("mine")
    for _ in range(2):
        viewer = view(plan, meshcat)
        viewer.show(1e9)
        assert meshcat.GetSliderValue("time (s)") == pytest.approx(viewer.duration, abs=0.01)
        viewer.play(rate=200.0)
    view(plan.problem, meshcat)
    assert "mine" in meshcat.GetButtonNames()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), frames=st.integers(2, 120))
def test_interpolation_between_key_frames_restores_every_frame(seed: int, frames: int) -> None:
    rng = np.random.default_rng(seed)
    p = np.cumsum(rng.normal(scale=1e-3, size=(frames, 3)), axis=0)
    q = np.cumsum(rng.normal(scale=3e-3, size=(frames, 4)), axis=0) + np.array([1.0, 0, 0, 0])
    q = q / np.linalg.norm(q, axis=1, keepdims=True) * rng.choice([-1.0, 1.0], size=(frames, 1))
    keys = keyframes(p, q, 2e-3, 0.01)
    assert keys[0] == 0 and keys[-1] == frames - 1
    for a, b in pairwise(keys):
        s = np.arange(b - a + 1)[:, None] / (b - a)
        assert np.linalg.norm(p[a] + s * (p[b] - p[a]) - p[a : b + 1], axis=1).max() <= 2e-3 + 1e-12
        cosine = np.abs(np.sum(_slerp(q[a], q[b], s) * q[a : b + 1], axis=1))
        assert 2 * np.arccos(np.clip(cosine, 0, 1)).max() <= 0.01 + 1e-6


def test_motion_on_a_line_needs_two_key_frames() -> None:
    p = np.linspace([0, 0, 0], [1, 2, 3], 50)
    assert keyframes(p, np.tile([1.0, 0, 0, 0], (50, 1)), 1e-6, 1e-6) == [0, 49]
