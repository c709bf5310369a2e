"""Candidates for a transition that is chosen by name: those known in a mode, and new ones."""

from __future__ import annotations

from mrtamp.guidance import Choice
from mrtamp.modes import Mode
from mrtamp.transitions.candidate import Candidate
from mrtamp.transitions.sampler import TransitionSampler


def known_candidates(sampler: TransitionSampler, mode: Mode, choice: Choice) -> list[Candidate]:
    """All candidates of a choice that were accepted so far and exist in `mode`."""
    if choice.kind == "reach":
        return sampler.reaching.known(mode, sampler.problem.subgoal(choice.place))
    if choice.kind == "pick":
        return sampler.picks(mode, choice.robots[0], choice.object)
    if choice.kind == "place":
        return sampler.places(mode, choice.robots[0], choice.place)
    return sampler.handovers(mode, *choice.robots)


def new_candidates(sampler: TransitionSampler, mode: Mode, choice: Choice, n: int) -> list[Candidate]:
    """Sample a choice in `mode` with n IK seeds, half as many more for a handover; returns what is accepted."""
    if choice.kind == "reach":
        return sampler.reaching.sample(mode, sampler.problem.subgoal(choice.place), n)
    if choice.kind == "pick":
        return sampler.sample_pick(mode, choice.robots[0], choice.object, n)
    if choice.kind == "place":
        return sampler.sample_place(mode, choice.robots[0], choice.place, n)
    giver, receiver = choice.robots
    return sampler.sample_handover(mode, giver, receiver, 3 * n // 2)
