"""mrtamp: asymptotically optimal task and motion planning for several robot arms.

    import mrtamp

    problem = mrtamp.load_problem("handover")
    planner = mrtamp.Planner(problem, seed=0)
    for plan in planner.improve(budget_s=5):
        print(plan.cost)
    planner.best.save("plan.json")

Names are imported when they are first used, so that `import mrtamp` and the command line start at once.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mrtamp.check import check_plan
    from mrtamp.plan import Plan
    from mrtamp.planner import Options, Planner
    from mrtamp.planners import PLANNERS, make_planner
    from mrtamp.problem import MrtampError, Problem, ProblemError
    from mrtamp.problem_file import list_problems, load_problem
    from mrtamp.status import Status
    from mrtamp.view import inline, view, write_html

    __version__: str

_HOMES = {
    "PLANNERS": "planners",
    "MrtampError": "problem",
    "Options": "planner",
    "Plan": "plan",
    "Planner": "planner",
    "Problem": "problem",
    "ProblemError": "problem",
    "Status": "status",
    "check_plan": "check",
    "inline": "view",
    "list_problems": "problem_file",
    "load_problem": "problem_file",
    "make_planner": "planners",
    "view": "view",
    "write_html": "view",
}

__all__ = [
    "PLANNERS",
    "MrtampError",
    "Options",
    "Plan",
    "Planner",
    "Problem",
    "ProblemError",
    "Status",
    "__version__",
    "check_plan",
    "inline",
    "list_problems",
    "load_problem",
    "make_planner",
    "view",
    "write_html",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("mrtamp")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"mrtamp.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
