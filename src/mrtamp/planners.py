"""Every planner by name: the one of the paper, its ablation without guidance, and the baselines.

All of them take a problem and a seed, yield ever better plans that the same judge has accepted, count their work in
the same units and say why there is no plan.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Protocol

from mrtamp.mechanisms import PLANNER_NAMES, check_without
from mrtamp.problem import MrtampError, Problem

if TYPE_CHECKING:
    from mrtamp.baselines.composed_prm import ComposedOptions
    from mrtamp.baselines.prioritised import PrioritisedOptions
    from mrtamp.plan import Plan
    from mrtamp.planner import Options
    from mrtamp.status import Status

    PlannerOptions = Options | ComposedOptions | PrioritisedOptions

UNGUIDED = frozenset({"modal-guidance", "orbit-path-guidance", "skeletons"})
"""Mechanisms that the planner `unguided` does without (paper, "Proposed (unguided)")."""


class AnyPlanner(Protocol):
    """What all planners have in common."""

    @property
    def best(self) -> Plan | None:
        """The cheapest plan so far, checked; None before there is one."""
        ...

    @property
    def sampled_bound(self) -> float | None:
        """What no plan over the transitions sampled so far can cost less than; None where the planner knows none."""
        ...

    def improve(
        self,
        budget_s: float | None = None,
        *,
        iterations: int | None = None,
        first: bool = False,
        progress: Callable[[Status], None] | None = None,
    ) -> Iterator[Plan]:
        """Plan for `budget_s` seconds or a number of iterations, yielding every better, judged plan."""
        ...

    def status(self) -> Status:
        """Where the planner stands."""
        ...

    def explain(self) -> str:
        """Why there is no plan yet."""
        ...

    def counts(self) -> dict[str, int]:
        """Work in units that do not depend on the machine.

        At least `collision_checks` (configurations of a robot or of a pair that Drake was asked about) and `ik_calls`
        (seeds from which inverse kinematics was solved).
        """
        ...


def make_planner(
    name: str, problem: Problem, seed: int = 0, options: Mapping[str, Any] | PlannerOptions | None = None
) -> AnyPlanner:
    """The planner called `name` for a problem.

    Parameters
    ----------
    name : one of `PLANNERS`.
    problem, seed : as for `mrtamp.planner.Planner`.
    options : settings by name, or an options object.  Every planner has its own: `mrtamp.planner.Options` (guided and
        unguided), `mrtamp.baselines.composed_prm.ComposedOptions`, `mrtamp.baselines.prioritised.PrioritisedOptions`.
        All of them know `without`.

    Raises
    ------
    MrtampError : no planner or option has that name, or as the planner does.
    """
    return PLANNERS[_known(name)](problem, seed, planner_options(name, options))


def planner_options(name: str, options: Mapping[str, Any] | PlannerOptions | None = None) -> PlannerOptions:
    """The options object of the planner called `name`, from settings by name or another planner's options.

    Raises
    ------
    MrtampError : the planner does not have what was asked for.
    """
    kind = _options_of(_known(name))
    if options is None or isinstance(options, kind):
        return options or kind()
    if dataclasses.is_dataclass(options) and not isinstance(options, type):
        # Of other planners' options, what differs from their defaults was asked for.
        default = type(options)()
        given = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
        given = {key: value for key, value in given.items() if value != getattr(default, key)}
    elif isinstance(options, Mapping):
        given = dict(options)
    else:
        raise MrtampError(f"options: found {type(options).__name__}, expected settings by name")
    known = [f.name for f in dataclasses.fields(kind)]
    unknown = [str(key) for key in given if key not in known]
    if unknown:
        raise MrtampError(f"options: {name} has no {', '.join(unknown)}; choose from {', '.join(known)}")
    if "without" in given:
        given["without"] = frozenset(given["without"])
        # Here and not by its options alone: guided and unguided share theirs, and the error names what was asked for.
        check_without(name, given["without"])
    return kind(**given)


def _known(name: str) -> str:
    if name not in PLANNERS:
        raise MrtampError(f"planner: {name!r} is unknown; choose from {', '.join(PLANNERS)}")
    return name


def _options_of(name: str) -> Any:
    from mrtamp.baselines.composed_prm import ComposedOptions
    from mrtamp.baselines.prioritised import PrioritisedOptions
    from mrtamp.planner import Options

    return {"composed-prm": ComposedOptions, "prioritised": PrioritisedOptions}.get(name, Options)


def _guided(problem: Problem, seed: int, options: Any) -> AnyPlanner:
    from mrtamp.planner import Planner

    return Planner(problem, seed=seed, options=options)


def _unguided(problem: Problem, seed: int, options: Any) -> AnyPlanner:
    return _guided(problem, seed, dataclasses.replace(options, without=options.without | UNGUIDED))


def _composed_prm(problem: Problem, seed: int, options: Any) -> AnyPlanner:
    from mrtamp.baselines.composed_prm import ComposedPRM

    return ComposedPRM(problem, seed=seed, options=options)


def _prioritised(problem: Problem, seed: int, options: Any) -> AnyPlanner:
    from mrtamp.baselines.prioritised import Prioritised

    return Prioritised(problem, seed=seed, options=options)


PLANNERS: dict[str, Callable[[Problem, int, Any], AnyPlanner]] = dict(
    zip(PLANNER_NAMES, (_guided, _unguided, _composed_prm, _prioritised), strict=True)
)
"""Name -> how to make it from a problem, a seed and its options."""
