"""Looking at plans: a live Meshcat window with play, pause and a time slider, and a page that stands alone.

`view` opens the window; `write_html` writes one HTML file with the scene, the animation and the timeline in it, which
needs neither a server nor the network.  What is drawn is `mrtamp.stage`, what moves when is `mrtamp.playback`.
"""

from __future__ import annotations

import html
import json
import os
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, MeshcatAnimation, MeshcatParams
from pydrake.math import RigidTransform

from mrtamp.kinematics import quaternions
from mrtamp.plan import Plan
from mrtamp.playback import Playback, standstill
from mrtamp.problem import Problem
from mrtamp.quiet import quiet
from mrtamp.report import cost_text, timeline
from mrtamp.stage import GHOSTS, REGIONS, TRACES, Stage, robot_color

FRAME_RATE = 30.0
"""Frames per second of recordings and of the live window."""
_POSITION_TOLERANCE = 3e-4
_ANGLE_TOLERANCE = 2e-3
_MOST_STEPS_AS_BUTTONS = 40


class Viewer:
    """A plan in a live Meshcat window; the window's own controls play it.

    Made by `view`.  `run` serves the controls until the window's stop button or Ctrl-C; without it, `show` and `play`
    move the scene from Python.
    """

    def __init__(self, plan: Plan, meshcat: Meshcat) -> None:
        self.meshcat = meshcat
        self.playback = Playback(plan)
        self.stage = Stage(plan.problem, meshcat)
        _draw_traces(self.stage, self.playback)
        self._time = 0.0
        self._controls = _Controls(meshcat, self.playback) if self.playback.duration > 0 else None

    @property
    def url(self) -> str:
        """Where to point the browser."""
        return self.meshcat.web_url()

    @property
    def duration(self) -> float:
        """Length of the animation (s)."""
        return self.playback.duration

    def show(self, time: float) -> None:
        """Show the scene at `time` (s, clipped to the plan)."""
        self._time = float(np.clip(time, 0.0, self.duration))
        self.stage.show(self.playback.positions(self.stage.scene, np.array([self._time]))[0])
        if self._controls:
            self._controls.set_time(self._time)

    def play(self, rate: float = 1.0) -> None:
        """Play the plan once from the beginning, `rate` times as fast as its clock; returns at its end."""
        started = time.monotonic()
        while (now := (time.monotonic() - started) * rate) < self.duration:
            self.show(now)
            time.sleep(1.0 / FRAME_RATE)
        self.show(self.duration)

    def run(self, timeout_s: float | None = None) -> None:
        """Obey the controls of the window (play, pause, time, steps, what is shown) until stop, Ctrl-C or timeout."""
        started = last = time.monotonic()
        self.show(self._time)
        try:
            while self._controls is None or not self._controls.stopped:
                now = time.monotonic()
                if timeout_s is not None and now - started > timeout_s:
                    return
                if self._controls:
                    self._step(self._controls, now - last)
                last = now
                time.sleep(1.0 / FRAME_RATE)
        except KeyboardInterrupt:
            return

    def _step(self, controls: _Controls, elapsed: float) -> None:
        wanted = controls.read(self.duration)
        if wanted is not None:
            self.show(wanted)
        elif controls.playing:
            # At the end the last picture stays for a moment, then the plan starts again.
            following = self._time + elapsed
            if following > self.duration:
                following = 0.0 if controls.rest(elapsed) else self.duration
            self.show(following)
        for part, visible in controls.changed_parts():
            self.stage.set_visible(part, visible)


class _Controls:
    """The buttons and the slider in the Meshcat window, and what the person did with them since the last look."""

    SLIDER = "time (s)"
    PLAY = "play / pause [space]"
    STOP = "stop [escape]"
    PARTS = (("traces", TRACES), ("goals", GHOSTS), ("regions", REGIONS))

    def __init__(self, meshcat: Meshcat, playback: Playback) -> None:
        self.meshcat = meshcat
        self.playing = True
        self._rested = 0.0
        self._clicks: dict[str, int] = {}
        self._steps: dict[str, float] = {}
        self._delete_earlier()
        self._last = meshcat.AddSlider(self.SLIDER, 0.0, round(playback.duration, 2), 0.01, 0.0)
        self._button(self.PLAY, "Space")
        for part in self.PARTS:
            self._button(self._switch(part))
        for k, row in enumerate(timeline(playback.plan, playback)[:_MOST_STEPS_AS_BUTTONS], 1):
            name = f"{k}.  {row.time:.1f} s  {row.sentence}"
            self._button(name)
            self._steps[name] = row.time
        self._button(self.STOP, "Escape")
        self._visible = dict.fromkeys(self.PARTS, True)

    def _delete_earlier(self) -> None:
        """Remove the controls of a plan that was shown in this window before, and no others."""
        if self.SLIDER in self.meshcat.GetSliderNames():
            self.meshcat.DeleteSlider(self.SLIDER)
        for name in self.meshcat.GetButtonNames():
            if re.match(r"\d+\.  ", name) or name in (self.PLAY, self.STOP, *map(self._switch, self.PARTS)):
                self.meshcat.DeleteButton(name)

    @staticmethod
    def _switch(part: tuple[str, str]) -> str:
        return f"show / hide {part[0]}"

    def _button(self, name: str, key: str = "") -> None:
        self.meshcat.AddButton(name, key)
        self._clicks[name] = 0

    def _clicked(self, name: str) -> bool:
        clicks = self.meshcat.GetButtonClicks(name)
        new, self._clicks[name] = clicks > self._clicks[name], clicks
        return new

    @property
    def stopped(self) -> bool:
        """Whether the stop button was pressed."""
        return self.meshcat.GetButtonClicks(self.STOP) > 0

    def set_time(self, now: float) -> None:
        """Move the slider."""
        self.meshcat.SetSliderValue(self.SLIDER, now)
        self._last = self.meshcat.GetSliderValue(self.SLIDER)

    def read(self, duration: float) -> float | None:
        """The time the person asked for with the slider or a step, or None; also takes note of play and pause."""
        if self._clicked(self.PLAY):
            self.playing = not self.playing
            if self.playing and self._last >= duration - 0.01:
                return 0.0
        for name, at in self._steps.items():
            if self._clicked(name):
                self.playing = False
                return at
        value = self.meshcat.GetSliderValue(self.SLIDER)
        if abs(value - self._last) > 1e-9:
            self.playing = False
            return value
        return None

    def rest(self, elapsed: float) -> bool:
        """Whether the pause at the end of the plan is over."""
        self._rested += elapsed
        if self._rested > 2.0:
            self._rested = 0.0
            return True
        return False

    def changed_parts(self) -> Iterator[tuple[str, bool]]:
        """The parts of the picture that were switched on or off."""
        for part in self.PARTS:
            if self._clicked(self._switch(part)):
                self._visible[part] = not self._visible[part]
                yield part[1], self._visible[part]


def view(what: Plan | Problem, meshcat: Meshcat | None = None) -> Viewer:
    """Open a live window on a plan, or on a problem at its start.

    Parameters
    ----------
    what : the plan to play, or the problem to look at.
    meshcat : an existing window to draw in; by default a new one, reachable from this machine only.

    Returns
    -------
    Viewer
        Its `url` is where to point a browser; `run()` serves the play button and the slider.  The window stays until
        the process ends.
    """
    plan = standstill(what) if isinstance(what, Problem) else what
    viewer = Viewer(plan, meshcat or _local_meshcat())
    viewer.show(0.0)
    return viewer


def write_html(what: Plan | Problem, path: str | Path) -> Path:
    """Write a page that shows a plan (or a problem at its start) and needs nothing else: no server, no network.

    The animation plays by itself; the page has play, pause, a time slider, the timeline (a click jumps there) and
    switches for traces, goals and regions.

    Raises
    ------
    OSError : the file cannot be written.
    """
    path = Path(path)
    text = _page(what)
    # Complete or not there at all, also when the process is stopped meanwhile.
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return path


@dataclass(frozen=True)
class InlinePage:
    """The page of `write_html` as the output of a notebook cell, `height` pixels high."""

    text: str
    height: int

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe srcdoc="{html.escape(self.text)}" style="{style}"></iframe>'


def inline(what: Plan | Problem, height: int = 560) -> InlinePage:
    """The page of `write_html` for a notebook: the last value of a cell shows itself."""
    return InlinePage(_page(what), height)


def _page(what: Plan | Problem) -> str:
    plan = standstill(what) if isinstance(what, Problem) else what
    with quiet():
        meshcat = _recorder()
        stage = Stage(plan.problem, meshcat)
        playback = Playback(plan)
        _draw_traces(stage, playback)
        meshcat.SetAnimation(_animation(stage, playback))
        page = meshcat.StaticHtml()
    return _with_player(page, plan, playback)


_recorders: dict[int, Meshcat] = {}


def _recorder() -> Meshcat:
    """The hidden window in which this thread makes its pages: windows cannot change threads, and ports are few."""
    thread = threading.get_ident()
    if thread not in _recorders:
        _recorders[thread] = _local_meshcat()
    return _recorders[thread]


def _local_meshcat() -> Meshcat:
    params = MeshcatParams()
    params.host = "localhost"
    params.show_stats_plot = False
    return Meshcat(params)


def _draw_traces(stage: Stage, playback: Playback) -> None:
    times = playback.times(FRAME_RATE)
    for robot in stage.scene.robots:
        X_WG = playback.grasp_frames(stage.scene, robot, times)
        keys = keyframes(X_WG[:, :3, 3], np.tile([1.0, 0, 0, 0], (len(times), 1)), 1e-3, 1.0)
        stage.draw_trace(robot, X_WG[keys, :3, 3])


def _animation(stage: Stage, playback: Playback) -> MeshcatAnimation:
    """The motion of every body, with only the key frames that linear interpolation needs."""
    times = np.arange(int(np.ceil(playback.duration * FRAME_RATE)) + 1) / FRAME_RATE
    animation = MeshcatAnimation(FRAME_RATE)
    animation.set_autoplay(True)
    if playback.duration == 0:
        return animation
    for path, X in stage.body_poses(playback.positions(stage.scene, times)).items():
        p, orientation = X[:, :3, 3], quaternions(X[:, :3, :3])
        for k in keyframes(p, orientation, _POSITION_TOLERANCE, _ANGLE_TOLERANCE):
            animation.SetTransform(int(k), path, RigidTransform(X[k]))
    return animation


def keyframes(p: np.ndarray, q: np.ndarray, position_tolerance: float, angle_tolerance: float) -> list[int]:
    """Indices of the frames to keep so that interpolation restores the others (Douglas and Peucker, 1973).

    Parameters
    ----------
    p, q : positions (N, 3) in metres and unit quaternions (N, 4) of equally spaced frames.
    position_tolerance, angle_tolerance : largest error of a frame that is left out (m, rad).
    """
    keep = {0, len(p) - 1}
    pending = [(0, len(p) - 1)]
    while pending:
        a, b = pending.pop()
        if b - a < 2:
            continue
        s = np.arange(1, b - a)[:, None] / (b - a)
        position = np.linalg.norm(p[a] + s * (p[b] - p[a]) - p[a + 1 : b], axis=1) / position_tolerance
        cosine = np.abs(np.sum(_slerp(q[a], q[b], s) * q[a + 1 : b], axis=1))
        error = np.maximum(position, 2 * np.arccos(np.clip(cosine, 0.0, 1.0)) / angle_tolerance)
        worst = int(np.argmax(error))
        if error[worst] > 1.0:
            middle = a + 1 + worst
            keep.add(middle)
            pending += [(a, middle), (middle, b)]
    return sorted(keep)


def _slerp(q0: np.ndarray, q1: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Spherical interpolation (N, 4) from q0 to q1 (4,), the short way, at s (N, 1)."""
    cosine = float(q0 @ q1)
    if cosine < 0:
        q1, cosine = -q1, -cosine
    angle = np.arccos(min(cosine, 1.0))
    if angle < 1e-6:
        return q0 + s * (q1 - q0)
    return (np.sin((1 - s) * angle) * q0 + np.sin(s * angle) * q1) / np.sin(angle)


def _with_player(page: str, plan: Plan, playback: Playback) -> str:
    """Meshcat's page with the title, the timeline and the player of `player.html` added."""
    problem = plan.problem
    rows = [
        {"time": round(r.time, 3), "until": round(event_end, 3), "robots": list(r.robots), "text": r.sentence}
        for r, event_end in zip(timeline(plan, playback), _row_ends(playback), strict=True)
    ]
    data: dict[str, Any] = {
        "title": problem.name,
        "subtitle": cost_text(plan) if plan.transitions else problem.description,
        "duration": round(playback.duration, 3),
        "robots": {
            r.name: "rgb({:.0f}, {:.0f}, {:.0f})".format(*(255 * c for c in robot_color(problem, r.name)))
            for r in problem.robots
        },
        "rows": rows,
    }
    # "</" would end the script element early.
    text = json.dumps(data).replace("</", "<\\/")
    player = resources.files("mrtamp").joinpath("player.html").read_text(encoding="utf-8")
    page = page.replace("<title>Drake MeshCat</title>", f"<title>{html.escape(problem.name)}</title>", 1)
    head, end, tail = page.rpartition("</body>")
    return head + player.replace("/*DATA*/null", text) + end + tail


def _row_ends(playback: Playback) -> list[float]:
    return [event.end for event in playback.events for _ in event.transition.actions]
