"""Suites of runs: problems x planners x seeds x limits, read from YAML (`models/suites` holds those that are shipped).

    mrtamp_suite: 1
    name: two_arms
    table: scalability
    seeds: 5
    limit: 30
    problems:
      - {problem: pick_place, robots: 2, objects: 4, layouts: 3, limit: 60}
    planners:
      - {planner: guided}
      - {planner: guided, without: [skeletons], label: no skeletons}

Layout seeds and planner seeds are separate: a problem with three layouts and five seeds is planned fifteen times.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mrtamp.bench.run import Task
from mrtamp.mechanisms import INTRA_ORBIT_NAMES, INTRA_ORBIT_PLANNERS, MECHANISMS_OF, PLANNER_NAMES
from mrtamp.problem import MrtampError
from mrtamp.reading import Value, choices, data_document, read_document

SUITE_VERSION = 1
TABLES = {
    "main": "a row per planner, four columns per problem",
    "scalability": "a row per number of robots and objects, three columns per planner",
    "ablation": "a row per planner and problem, relative to the first planner",
    "optimum": "a row per planner and problem, costs divided by the known optimum",
}
"""Forms of the table that a suite is reported in."""
_PARAMETERS = ("robots", "objects")
_PROBLEM_KEYS = (*_PARAMETERS, "layout", "layouts", "limit", "title")


@dataclass(frozen=True)
class Case:
    """A problem of a suite: what to load, the layout seeds (empty: it has one layout), the limit (s), how it is called.

    `parameters` are those of a generated problem without the layout.
    """

    problem: str
    limit_s: float
    parameters: Mapping[str, int] = field(default_factory=dict)
    layouts: tuple[int, ...] = ()
    title: str = ""

    @property
    def name(self) -> str:
        """The problem with its parameters, unique in its suite."""
        return Task(Path(self.problem).stem, self.parameters).name

    def task(self, layout: int | None) -> Task:
        """What is to be loaded for one of the layouts."""
        return Task(self.problem, dict(self.parameters) | ({} if layout is None else {"layout_seed": layout}))


@dataclass(frozen=True)
class Entrant:
    """A planner of a suite; `label` names it in records and tables.

    `without` are mechanisms that are switched off, `intra_orbit` the planner of motion inside an orbit (None: default).
    """

    planner: str
    label: str
    without: tuple[str, ...] = ()
    intra_orbit: str | None = None

    def options(self) -> dict[str, Any]:
        """Its settings by name, as `mrtamp.planners.make_planner` takes them."""
        given: dict[str, Any] = {"without": self.without} if self.without else {}
        return given | ({"intra_orbit": self.intra_orbit} if self.intra_orbit is not None else {})


@dataclass(frozen=True)
class Assignment:
    """One run of a suite: everything that the process of the run has to know.  `layout` is None where there is one."""

    suite: str
    case: Case
    layout: int | None
    entrant: Entrant
    seed: int

    @property
    def key(self) -> str:
        """What tells this run from all others of its suite."""
        layout = "" if self.layout is None else f", layout {self.layout}"
        return f"{self.case.name}{layout}, {self.entrant.label}, seed {self.seed}"


@dataclass(frozen=True)
class Suite:
    """Problems x planners x seeds; `table` is one of `TABLES`."""

    name: str
    description: str
    table: str
    cases: tuple[Case, ...]
    entrants: tuple[Entrant, ...]
    seeds: tuple[int, ...]

    def assignments(self) -> Iterator[Assignment]:
        """All runs; seeds come last to change, so that a suite that is stopped early has some of everything."""
        for seed in self.seeds:
            for case in self.cases:
                for layout in case.layouts or (None,):
                    for entrant in self.entrants:
                        yield Assignment(self.name, case, layout, entrant, seed)

    def case(self, name: str) -> Case:
        """The problem of that name."""
        return next(case for case in self.cases if case.name == name)


# -- files -----------------------------------------------------------------------------------------------------------


def suites_dir() -> Path:
    """Where the shipped suites are."""
    from mrtamp.model_files import models_dir

    return models_dir() / "suites"


def shipped_suites() -> dict[str, Path]:
    """The files of the shipped suites by name."""
    return {file.stem: file for file in sorted(suites_dir().glob("*.yaml"))}


def load_suite(source: str, *, find: bool = True) -> Suite:
    """A shipped suite by its name, or the suite in a YAML file; `find` as in `read_suite`.

    Raises
    ------
    MrtampError
        There is no such suite, or it is wrong; the message names the file, the line and the key, what was found, and
        what is valid.
    """
    shipped = shipped_suites()
    file = shipped.get(source, Path(source).expanduser())
    if source not in shipped and not file.is_file():
        if "/" in source or source.endswith((".yaml", ".yml")):
            raise MrtampError(f"found {source!r}, expected an existing suite file (there is no {file.resolve()})")
        valid = choices(shipped, source, "shipped suites")
        raise MrtampError(f"found the unknown suite {source!r}, {valid}, or the path of a suite file")
    return read_suite(read_document(file).root, find=find)


def suite_from_dict(data: Any, label: str) -> Suite:
    """The suite that `suite_to_dict` described; its problems and planners need not exist any more.

    Raises
    ------
    MrtampError : the data are not of a suite; the message begins with the label.
    """
    return read_suite(data_document(data, None, label).root, find=False)


def read_suite(root: Value, *, find: bool = True) -> Suite:
    """Read a suite from the top of its document; `find`: its problems and planners have to exist."""
    required = ("mrtamp_suite", "name", "table", "seeds", "limit", "problems", "planners")
    entries = root.mapping(required, ("description",))
    entries["mrtamp_suite"].version(SUITE_VERSION, "suite")
    limit_s = entries["limit"].number(above=0.0)
    cases = tuple(_case(entry, limit_s, find) for entry in _some(entries["problems"], "problem"))
    entrants = tuple(_entrant(entry, find) for entry in _some(entries["planners"], "planner"))
    table = entries["table"].choice(TABLES, "forms of tables")
    _fits(table, entries["problems"].items(), cases)
    _unique([case.name for case in cases], entries["problems"], "problem")
    _unique([entrant.label for entrant in entrants], entries["planners"], "label")
    return Suite(
        entries["name"].name(),
        entries["description"].text() if "description" in entries else "",
        table,
        cases,
        entrants,
        _numbers(entries["seeds"], "seeds"),
    )


def suite_to_dict(suite: Suite) -> dict[str, Any]:
    """The suite as plain data that `suite_from_dict` reads."""
    problems = []
    for case in suite.cases:
        entry: dict[str, Any] = {"problem": case.problem, **case.parameters, "limit": case.limit_s}
        entry |= {"layouts": list(case.layouts)} if case.layouts else {}
        problems.append(entry | ({"title": case.title} if case.title else {}))
    planners = []
    for entrant in suite.entrants:
        entry = {"planner": entrant.planner, "label": entrant.label, **entrant.options()}
        planners.append(entry | ({"without": list(entrant.without)} if entrant.without else {}))
    return {
        "mrtamp_suite": SUITE_VERSION,
        "name": suite.name,
        "description": suite.description,
        "table": suite.table,
        "seeds": list(suite.seeds),
        "limit": max(case.limit_s for case in suite.cases),
        "problems": problems,
        "planners": planners,
    }


def _case(entry: Value, limit_s: float, find: bool) -> Case:
    entries = entry.mapping(("problem",), _PROBLEM_KEYS)
    problem = entries["problem"].text()
    if find and problem.endswith((".yaml", ".yml")):
        problem = str((entry.document.directory / Path(problem).expanduser()).resolve())
    if "layout" in entries and "layouts" in entries:
        raise entries["layout"].error("found layout beside layouts, expected one of the two")
    layouts: tuple[int, ...] = ()
    if "layouts" in entries:
        layouts = _numbers(entries["layouts"], "layout seeds")
    elif "layout" in entries:
        layouts = (_whole(entries["layout"], 0, "a layout seed, a whole number from 0"),)
    case = Case(
        problem,
        entries["limit"].number(above=0.0) if "limit" in entries else limit_s,
        {key: _whole(entries[key], 1, "a whole number from 1") for key in _PARAMETERS if key in entries},
        layouts,
        entries["title"].text() if "title" in entries else "",
    )
    if find:
        try:
            case.task(layouts[0] if layouts else None).load()
        except MrtampError as error:
            raise entries["problem"].error(str(error)) from None
    return case


def _entrant(entry: Value, find: bool) -> Entrant:
    entries = entry.mapping(("planner",), ("label", "without", "intra_orbit"))
    planner = entries["planner"].choice(PLANNER_NAMES, "planners") if find else entries["planner"].text()
    without: tuple[str, ...] = ()
    if "without" in entries:
        items, what = entries["without"].items(), f"mechanisms of {planner}"
        without = tuple(i.choice(MECHANISMS_OF[planner], what) if find else i.text() for i in items)
    intra_orbit = None
    if "intra_orbit" in entries:
        if find and planner not in INTRA_ORBIT_PLANNERS:
            either = " or ".join(INTRA_ORBIT_PLANNERS)
            raise entries["intra_orbit"].error(f"{planner} has no such setting, expected it with {either} only")
        intra_orbit = entries["intra_orbit"].choice(INTRA_ORBIT_NAMES, "planners of motion inside an orbit")
    parts = [planner, *(f"without {name}" for name in without), *([f"with {intra_orbit}"] if intra_orbit else [])]
    label = entries["label"].text() if "label" in entries else ", ".join(parts)
    if not label:
        raise entries["label"].wrong("a text that is not empty")
    return Entrant(planner, label, without, intra_orbit)


def _fits(table: str, entries: Sequence[Value], cases: Sequence[Case]) -> None:
    """A table of some form can be made of these problems."""
    from mrtamp.bench.convergence import KNOWN

    known = [row.problem for row in KNOWN]
    for entry, case in zip(entries, cases, strict=True):
        if table == "scalability" and set(case.parameters) != set(_PARAMETERS):
            raise entry.error(f"the table scalability needs the keys {' and '.join(_PARAMETERS)} of every problem")
        if table == "optimum" and case.problem not in known:
            found = f"found {case.problem!r}, {choices(known, case.problem, 'problems with a known optimum')}"
            raise entry.error(f"{found}, which the table optimum needs")


def _some(entry: Value, what: str) -> list[Value]:
    items = entry.items()
    if not items:
        raise entry.wrong(f"at least one {what}")
    return items


def _numbers(entry: Value, what: str) -> tuple[int, ...]:
    """A count n, meaning 0 to n - 1, or a list of different numbers."""
    if not isinstance(entry.data, list):
        return tuple(range(_whole(entry, 1, f"how many {what}, a whole number from 1, or a list of them")))
    numbers = tuple(_whole(item, 0, "a whole number from 0") for item in _some(entry, "number"))
    if len(set(numbers)) < len(numbers):
        raise entry.wrong(f"different {what}")
    return numbers


def _whole(entry: Value, least: int, expected: str) -> int:
    if isinstance(entry.data, bool) or not isinstance(entry.data, int) or entry.data < least:
        raise entry.wrong(expected)
    return entry.data


def _unique(names: list[str], entry: Value, what: str) -> None:
    for i, name in enumerate(names):
        if name in names[:i]:
            found = f"found the {what} {name!r} twice, in entries {names.index(name)} and {i}"
            raise entry.error(f"{found}; expected different ones")
