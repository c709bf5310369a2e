"""A plan in words: the timeline of its transitions, its cost and how it came down, what was counted.

The command line prints these texts, the Meshcat page and the notebooks show the same rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mrtamp.model_files import model_facts, resolve_model
from mrtamp.modes import Attachment
from mrtamp.plan import Action, Plan, measures
from mrtamp.playback import Playback
from mrtamp.problem import Problem


@dataclass(frozen=True)
class Row:
    """One elementary change in the timeline; simultaneous ones share `step` and `time`.

    `object` goes from `source` to `target`; all three are empty where a subgoal attaches nothing.
    """

    step: int
    time: float
    kind: str
    robots: tuple[str, ...]
    object: str
    source: str
    target: str
    subgoal: str = ""

    @property
    def sentence(self) -> str:
        """The change as a short sentence: `left hands red to right`."""
        if self.kind == "pick":
            return f"{self.robots[0]} picks {self.object}"
        if self.kind == "place":
            return f"{self.robots[0]} places {self.object} {self._at_target()}"
        if self.kind == "handover" and len(self.robots) == 2:
            return f"{self.robots[0]} hands {self.object} to {self.robots[1]}"
        if self.kind == "reach":
            verb = "reaches" if len(self.robots) == 1 else "reach"
            return f"{_listed(self.robots)} {verb} {self.subgoal}{self._change()}"
        return f"{_listed(self.robots)}: {self.kind} {self.object}"

    def _change(self) -> str:
        """What reaching a subgoal does to an object, as the end of a sentence."""
        if not self.object:
            return ""
        if self.target in self.robots:
            taker = "takes" if len(self.robots) == 1 else f"{self.target} takes"
            return f" and {taker} {self.object}"
        return f", {self.object} stays there"

    @property
    def change(self) -> str:
        """Where the object comes from and goes to, or the subgoal, as the last column of the timeline."""
        moved = f"{self.source} -> {self.target}" if self.object else ""
        return ": ".join(text for text in (self.subgoal, moved) if text)

    def _at_target(self) -> str:
        """The target in a sentence; supports made from exact poses and object tops have names of their own form."""
        for exact in ("start", "goal"):
            if self.target == f"{exact} of {self.object}":
                return f"at its {exact}"
        return f"on {self.target}"


def _listed(names: Sequence[str]) -> str:
    """Names in a sentence: `a`, `a and b`, `a, b and c`."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _where(attachment: Attachment | None) -> str:
    """The place of an attachment, in a word or two."""
    if attachment is None:
        return ""
    return attachment.place if attachment.held or attachment.support else attachment.parent


def _row(step: int, time: float, a: Action) -> Row:
    # A subgoal names the place where it leaves an object after itself: that would say the same thing twice.
    target = a.after.parent if a.kind == "reach" and a.after is not None else _where(a.after)
    return Row(step, time, a.kind, a.robots, a.object or "", _where(a.before), target, a.subgoal or "")


def timeline(plan: Plan, playback: Playback | None = None) -> list[Row]:
    """Every change of attachment and every subgoal, in order; `time` is the moment on the clock of `Playback` (s)."""
    playback = playback or Playback(plan)
    return [
        _row(step, event.start, a) for step, event in enumerate(playback.events, 1) for a in event.transition.actions
    ]


def table(header: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[int] = ()) -> str:
    """Plain text columns under a header; the columns in `right` are aligned to the right."""
    cells = [list(header), *[list(row) for row in rows]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    lines = [
        "  ".join(c.rjust(w) if i in right else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True)))
        for row in cells
    ]
    lines.insert(1, "  ".join("-" * w for w in widths))
    return "\n".join(line.rstrip() for line in lines)


def _arrows(row: Row) -> str:
    return (", " if row.kind == "reach" else " -> ").join(row.robots)


def timeline_text(plan: Plan, playback: Playback | None = None) -> str:
    """The timeline as a table."""
    rows = [(str(r.step), f"{r.time:.2f} s", r.kind, _arrows(r), r.object, r.change) for r in timeline(plan, playback)]
    if not rows:
        return "(no transitions: the robots only move)"
    return table(("step", "time", "kind", "robots", "object", "from -> to"), rows, right=(0, 1))


def cost_text(plan: Plan) -> str:
    """One line: the cost and the two measures it is made of."""
    m = measures(plan.segments)
    unit = _joint_unit(plan.problem)
    return f"cost {plan.cost:.3f}  (makespan {m['makespan']:.3f}{unit}, path length {m['path_length']:.3f}{unit})"


def _joint_unit(problem: Problem) -> str:
    """The unit of joint-space lengths: rad, m where all joints slide, none where robots have joints of both kinds."""
    slides = set()
    for robot in problem.robots:
        model = robot.model
        reference = resolve_model(model.model, model.file.parent if model.file else Path(), problem.package_paths)
        facts = model_facts(reference, problem.package_paths)
        slides |= {joint in facts.prismatic for joint in model.arm_joints}
    return "" if len(slides) > 1 else " m" if True in slides else " rad"


def history_text(plan: Plan, most: int = 12) -> str:
    """The incumbents as a table, at most `most` of them: the first, the last, and the largest steps in between."""
    history = plan.history
    if not history:
        return "(no history)"
    kept = range(len(history))
    if len(history) > most:
        gains = [history[i - 1]["cost"] - history[i]["cost"] for i in range(1, len(history) - 1)]
        largest = sorted(range(len(gains)), key=lambda i: -gains[i])[: most - 2]
        kept = sorted({0, len(history) - 1, *(i + 1 for i in largest)})  # type: ignore[assignment]
    rows = [(str(i + 1), f"{history[i]['time_s']:.2f} s", f"{history[i]['cost']:.3f}") for i in kept]
    text = table(("incumbent", "found after", "cost"), rows, right=(0, 1, 2))
    left_out = len(history) - len(rows)
    return text + (f"\n({left_out} smaller improvements not shown)" if left_out else "")


def counts_text(plan: Plan) -> str:
    """One line with everything the planner counted."""
    return ", ".join(f"{name.replace('_', ' ')} {value:,}" for name, value in plan.counts.items())


def summary(plan: Plan) -> dict[str, Any]:
    """The same facts as JSON-able data."""
    return {
        "problem": plan.problem.name,
        "seed": plan.seed,
        **({"found_by": plan.found_by} if plan.found_by else {}),
        "cost": plan.cost,
        **measures(plan.segments),
        "duration_s": Playback(plan).duration,
        "timeline": [{**asdict(r), "robots": list(r.robots)} for r in timeline(plan)],
        "history": plan.history,
        "counts": plan.counts,
        "versions": plan.versions,
    }
