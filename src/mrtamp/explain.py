"""Why there is no plan: what is still to be done, which transitions were tried, and what stopped them."""

from __future__ import annotations

from mrtamp.modes import Attachment
from mrtamp.problem import RobotAt
from mrtamp.status import Reporting
from mrtamp.transitions.candidate import Outcome, StratumKey

_MANY = 12
_REASONS = {
    "no approach": "no straight way in or out",
    "out of reach": "out of reach",
    "gripper too small": "the gripper is too small",
    "each other": "robots in collision with each other",
    "itself": "robot in collision with itself",
}
"""What refused samples are counted under; all else is the name of what they collided with."""


def explain(planner: Reporting) -> str:
    """A few lines for a person: the nearest mode, what strata gave or what stopped them, motions that failed."""
    lines = []
    nearest = min(planner.modes(), key=planner.guidance.remaining, default=None)
    if nearest is not None:
        waiting = [
            f"{o.name} ({_where(nearest.of[o.name])})"
            for o in planner.problem.objects
            if not planner.guidance.done(nearest, o.name)
        ]
        waiting += [s.name for s in planner.problem.subgoals if s.name not in nearest.done]
        if waiting:
            states = len(planner.graphs.modal)
            lines.append(f"Of {states} modal states the nearest to the goal still lacks: {', '.join(waiting)}")
        else:
            done = ["All objects are where they belong."] if planner.problem.objects else []
            done += ["All subgoals are reached."] if planner.problem.subgoals else []
            lines.append(" ".join([*done, "Robots could not reach their final configurations."]))
    places = {(a.object, a.place) for mode in planner.modes() for a in mode.attachments}
    for item in sorted({c.object for c in planner.problem.goal if not isinstance(c, RobotAt)}):
        lines += _object_lines(planner, item, {place for name, place in places if name == item})
    for key, outcome in planner.sampler.outcomes.items():
        if key[0] == "reach" and not outcome.accepted:
            lines.append(f"{_name(key)}: {_why(outcome)}")
    if planner.incumbent.refused:
        lines.append(
            f"The check refused {planner.incumbent.refused} plans, the last for {planner.incumbent.last_refusal}"
        )
    trouble = [(count, robot, other) for (robot, other), count in planner.trouble.items() if count]
    if trouble:
        lines.append("Motions that failed, and what was in the way:")
        for count, robot, other in sorted(trouble, reverse=True)[:_MANY]:
            lines.append(f"  {robot}: {'the world or objects' if other == 'world' else other} {_times(count)}")
    return "\n".join(lines)


def _object_lines(planner: Reporting, item: str, seen: set[str]) -> list[str]:
    """What was tried with one object, which was `seen` in these places."""
    tried = [(key, o) for key, o in planner.sampler.outcomes.items() if key[2] == item and (o.calls or o.samples)]
    tried = [(key, o) for key, o in tried if key[0] != "reach"]
    goals = set(planner.guidance.goal_places(item))
    lines = [f"{item}, to end at {' or '.join(sorted(goals)) or 'no place'}:"]
    if not tried:
        lines.append("  nothing was tried yet")
    if any(key[0] == "pick" for key, _ in tried) and not (
        any(o.accepted for key, o in tried if key[0] == "pick") or seen & {r.name for r in planner.problem.robots}
    ):
        lines.append("  no robot found a way to pick it up")
    at_goal = [o for key, o in tried if key[0] == "place" and key[3] in goals]
    if at_goal and not any(o.accepted for o in at_goal) and not seen & goals:
        lines.append("  no robot found a way to put it at its goal")
    failed = [(key, o) for key, o in tried if not o.accepted]
    for key, outcome in sorted(failed, key=lambda pair: -pair[1].samples)[:_MANY]:
        lines.append(f"  {_name(key)}: {_why(outcome)}")
    found = [(key, o) for key, o in tried if o.accepted]
    for key, outcome in sorted(found, key=lambda pair: -pair[1].accepted)[:_MANY]:
        took = "" if _end(key) in seen else ", but no motion led through any of them"
        lines.append(f"  {_name(key)}: {outcome.accepted} found in {outcome.samples} samples{took}")
    return lines


def _where(a: Attachment) -> str:
    if a.held:
        return f"held by {a.parent}"
    return "where it started" if a.place == f"start of {a.object}" else f"on {a.place}"


def _end(key: StratumKey) -> str:
    """Where the object is afterwards."""
    kind, robots, _, place = key
    return place if kind == "place" else robots[-1]


def _name(key: StratumKey) -> str:
    kind, robots, item, place = key
    if kind == "reach":
        return f"subgoal {place} by {' and '.join(robots)}"
    if kind == "handover":
        return f"handover from {robots[0]} to {robots[1]}"
    where = "where it started" if place == f"start of {item}" else place
    link = "" if where == "where it started" else "from " if kind == "pick" else "on "
    return f"{kind} by {robots[0]} {link}{where}"


def _why(outcome: Outcome) -> str:
    parts = []
    if outcome.samples:
        parts.append(f"{outcome.samples} samples, {outcome.ik_solved or 'none'} with an IK solution")
    named = [(_REASONS.get(name, f"in collision with {name}"), n) for name, n in outcome.collisions.most_common(4) if n]
    if named:
        parts.append(", ".join(f"{reason} ({_times(n)})" for reason, n in named))
    return "; ".join(parts) or "no configuration to begin with was found"


def _times(n: int) -> str:
    return "once" if n == 1 else f"{n} times"
