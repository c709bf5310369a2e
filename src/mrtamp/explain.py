"""Why there is no plan: what is still to be done, which transitions were tried, and what stopped them."""

from __future__ import annotations

from mrtamp.status import Reporting
from mrtamp.transitions.candidate import Outcome, StratumKey

_MANY = 12


def explain(planner: Reporting) -> str:
    """A few lines for a person: the nearest mode, the strata that never gave a transition, the motions that failed."""
    lines = []
    modes = list(planner.modes())
    nearest = min(modes, key=planner.guidance.remaining, default=None)
    if nearest is not None:
        waiting = [o.name for o in planner.problem.objects if not planner.guidance.done(nearest, o.name)]
        waiting += [s.name for s in planner.problem.subgoals if s.name not in nearest.done]
        where = ", ".join(f"{name} ({nearest.of[name].place})" if name in nearest.of else name for name in waiting)
        lines.append(
            f"Of {len(planner.graphs.modal)} modal states the nearest to the goal still lacks: {where or 'nothing'}"
        )
        if not waiting:
            lines.append("All objects are where they belong; robots could not reach their final configurations.")
    wanted = {c.object for c in planner.problem.goal if hasattr(c, "object")}
    for item in sorted(wanted):
        lines += _object_lines(planner, item)
    for key, outcome in planner.sampler.outcomes.items():
        if key[0] == "reach" and not outcome.accepted:
            lines.append(f"{_name(key)}: {_why(outcome)}")
    if planner.incumbent.refused:
        lines.append(
            f"The check refused {planner.incumbent.refused} plans, the last for {planner.incumbent.last_refusal}"
        )
    trouble = [(count, robot, other) for (robot, other), count in planner.trouble.items()]
    if trouble:
        lines.append("Motions that failed, and what was in the way:")
        for count, robot, other in sorted(trouble, reverse=True)[:_MANY]:
            lines.append(f"  {robot}: {'the world or objects' if other == 'world' else other} {count} times")
    return "\n".join(lines)


def _object_lines(planner: Reporting, item: str) -> list[str]:
    tried = [(key, o) for key, o in planner.sampler.outcomes.items() if key[2] == item and o.calls]
    failed = [(key, o) for key, o in tried if not o.accepted]
    goals = set(planner.guidance.goal_places(item))
    reached = [key for key, o in tried if o.accepted and key[0] == "place" and key[3] in goals]
    lines = [f"{item}: goal {' or '.join(sorted(goals)) or 'none'}"]
    if not tried:
        lines.append("  nothing was tried yet")
    if not reached and any(key[0] == "place" and key[3] in goals for key, _ in tried):
        lines.append("  no robot found a way to put it at its goal")
    if tried and not any(o.accepted for key, o in tried if key[0] == "pick"):
        lines.append("  no robot found a way to pick it up")
    for key, outcome in sorted(failed, key=lambda pair: -pair[1].calls)[:_MANY]:
        lines.append(f"  {_name(key)}: {_why(outcome)}")
    return lines


def _name(key: StratumKey) -> str:
    kind, robots, _, place = key
    if kind == "reach":
        return f"subgoal {place} by {' and '.join(robots)}"
    if kind == "handover":
        return f"handover from {robots[0]} to {robots[1]}"
    return f"{kind} by {robots[0]} {'from' if kind == 'pick' else 'on'} {place}"


def _why(outcome: Outcome) -> str:
    parts = [f"{outcome.samples} samples, {outcome.ik_solved} with an IK solution"]
    named = [f"{name} {count}" for name, count in outcome.collisions.most_common(4)]
    if named:
        parts.append("refused for " + ", ".join(named))
    return "; ".join(parts)
