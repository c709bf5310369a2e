"""Plan files (JSON): a plan and its problem in one file that stands alone, written losslessly and atomically.

    {"mrtamp_plan": 1, "problem": {...}, "cost": J, "measures": {...}, "seed": 0, "versions": {...}, "counts": {...},
     "history": [{"time_s": t, "cost": J}, ...],
     "attachments": [{"id": 0, "object": "red", "parent": "table", "support": "on_it",
                      "X_PO": [x, y, z, qw, qx, qy, qz]},
                     {"id": 1, "object": "red", "parent": "left", "width": 0.05, "X_PO": [...]}],
     "segments": [{"mode": {"red": 0}, "q": {"left": [[...], ...]}}, ..., {"mode": {"red": 1}, "done": ["top"], ...}],
     "transitions": [{"kind": "pick", "active": ["left"],
                      "actions": [{"kind": "pick", "robots": ["left"], "object": "red", "before": 0, "after": 1}]},
                     {"kind": "reach", "active": ["left"],
                      "actions": [{"kind": "reach", "robots": ["left"], "object": null, "before": null, "after": null,
                                   "subgoal": "top"}]}]}

Attachments are listed once and referred to by id, because their identity is what makes two modes equal; `done` lists
the subgoals reached, where there are any.  The format is described in full by `models/schema/plan.schema.json`.
"""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from mrtamp.kinematics import matrix, quaternions
from mrtamp.modes import Attachment, Mode
from mrtamp.plan import Action, Plan, Segment, Transition, measures
from mrtamp.problem import MrtampError, Problem, ProblemError
from mrtamp.problem_file import problem_from_dict, problem_to_dict
from mrtamp.reading import Document, Value, data_document

PLAN_VERSION = 1
KINDS = ("pick", "place", "handover", "reach")


class PlanError(MrtampError):
    """A plan file is wrong or cannot be written: names the file, the key path, what was found and the valid choices."""


def save_plan(plan: Plan, path: str | Path) -> None:
    """Write `plan` to `path`; an existing file is replaced only once the new one is complete.

    Raises
    ------
    PlanError
        The folder does not exist or cannot be written, or the plan contains numbers that are not finite.
    """
    path = Path(path)
    try:
        text = _dump(plan_to_dict(plan)) + "\n"
    except ValueError as error:
        raise PlanError(f"{path}: the plan cannot be saved: {error}") from None
    temporary = ""
    try:
        with tempfile.NamedTemporaryFile(
            "w", encoding="utf-8", dir=path.parent, prefix=f".{path.name}.", suffix=".tmp", delete=False
        ) as file:
            temporary = file.name
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)  # temporary files are private; a plan is an ordinary file
        os.replace(temporary, path)
    except OSError as error:
        raise PlanError(f"{path}: the plan cannot be saved: {error.strerror}") from None
    finally:
        if temporary and os.path.exists(temporary):
            os.unlink(temporary)


def load_plan(path: str | Path) -> Plan:
    """Read a plan file.

    Raises
    ------
    PlanError
        The file cannot be read or is wrong; the message names the key path, what was found and what is valid.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except OSError as error:
        raise PlanError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise PlanError(f"{path}: cannot be read: it is not UTF-8 text") from None
    except json.JSONDecodeError as error:
        raise PlanError(f"{path}:{error.lineno}: not valid JSON: {error.msg}") from None
    except (ValueError, RecursionError) as error:
        raise PlanError(f"{path}: not valid JSON: {error}") from None
    return plan_from_dict(data, path)


def plan_to_dict(plan: Plan) -> dict[str, Any]:
    """`plan` as JSON-able data that `plan_from_dict` reads back to the same plan, bit for bit."""
    attachments: dict[int, tuple[int, Attachment]] = {}

    def number(a: Attachment) -> int:
        return attachments.setdefault(id(a), (len(attachments), a))[0]

    segments = [
        {
            "mode": {a.object: number(a) for a in segment.mode.attachments},
            **({"done": sorted(segment.mode.done)} if segment.mode.done else {}),
            "q": {name: np.asarray(q, dtype=float).tolist() for name, q in segment.q.items()},
        }
        for segment in plan.segments
    ]
    transitions = [
        {
            "kind": transition.kind,
            "active": list(transition.active),
            "actions": [
                {
                    "kind": action.kind,
                    "robots": list(action.robots),
                    "object": action.object,
                    "before": number(action.before) if action.before is not None else None,
                    "after": number(action.after) if action.after is not None else None,
                    **({"subgoal": action.subgoal} if action.subgoal is not None else {}),
                }
                for action in transition.actions
            ],
        }
        for transition in plan.transitions
    ]
    return {
        "mrtamp_plan": PLAN_VERSION,
        "problem": problem_to_dict(plan.problem),
        "cost": float(plan.cost),
        "measures": dict(measures(plan.segments)),
        "seed": plan.seed,
        "versions": dict(plan.versions),
        **({"found_by": dict(plan.found_by)} if plan.found_by else {}),
        "counts": {name: int(count) for name, count in plan.counts.items()},
        "history": [{key: float(value) for key, value in entry.items()} for entry in plan.history],
        "attachments": [{"id": i, **_attachment_to_dict(a)} for i, a in attachments.values()],
        "segments": segments,
        "transitions": transitions,
    }


def plan_from_dict(data: dict[str, Any], file: str | Path | None = None) -> Plan:
    """The plan that `data`, the content of a plan file, describes; `file` names the source in errors.

    Raises
    ------
    PlanError
        The data is wrong; the message names the key path, what was found and what is valid.
    """
    document = data_document(data, Path(file) if file is not None else None, "plan")
    try:
        return _read(document)
    except ProblemError as error:
        raise PlanError(str(error)) from None


def _read(document: Document) -> Plan:
    entries = document.root.mapping(
        ("mrtamp_plan", "problem", "cost", "attachments", "segments", "transitions"),
        ("measures", "seed", "versions", "found_by", "counts", "history"),
    )
    if entries["mrtamp_plan"].data != PLAN_VERSION:
        raise entries["mrtamp_plan"].wrong(f"version {PLAN_VERSION} of the plan format")
    problem = _problem(entries["problem"])
    attachments = _attachments(entries["attachments"], problem)
    segments = [_segment(value, problem, attachments) for value in entries["segments"].items()]
    transitions = [_transition(value, problem, attachments) for value in entries["transitions"].items()]
    if len(transitions) != max(len(segments) - 1, 0):
        raise entries["transitions"].error(
            f"found {len(transitions)} transitions, expected one between every two of the {len(segments)} segments"
        )
    seed = entries["seed"].data if "seed" in entries else None
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int)):
        raise entries["seed"].wrong("a whole number, or null")
    return Plan(
        problem=problem,
        segments=segments,
        transitions=transitions,
        cost=entries["cost"].number(),
        history=[
            {key: value.number() for key, value in entry.mapping(("time_s", "cost")).items()}
            for entry in (entries["history"].items() if "history" in entries else [])
        ],
        counts={key: _whole(value) for key, value in _free_mapping(entries.get("counts")).items()},
        seed=seed,
        versions={key: value.text() for key, value in _free_mapping(entries.get("versions")).items()},
        found_by={key: value.text() for key, value in _free_mapping(entries.get("found_by")).items()},
    )


def _problem(value: Value) -> Problem:
    if not isinstance(value.data, dict):
        raise value.wrong("the problem, as a mapping")
    try:
        return problem_from_dict(value.data)
    except ProblemError as error:
        raise value.error(str(error).removeprefix("problem: ")) from None


def _attachment_to_dict(a: Attachment) -> dict[str, Any]:
    R = np.asarray(a.X_PO, dtype=float)[:3, :3]
    quaternion = quaternions(R[None])[0]
    data: dict[str, Any] = {
        "object": a.object,
        "parent": a.parent,
        "X_PO": [*np.asarray(a.X_PO, dtype=float)[:3, 3].tolist(), *quaternion.tolist()],
    }
    if not np.array_equal(_rotation(quaternion), R):
        # Seven numbers do not determine the last bit of a rotation matrix; nine do, and a plan must come back exactly.
        data["R_PO"] = R.ravel().tolist()
    if a.support is not None:
        data["support"] = a.support
    if a.width is not None:
        data["width"] = float(a.width)
    return data


def _attachments(value: Value, problem: Problem) -> dict[int, Attachment]:
    objects = [o.name for o in problem.objects]
    parents = [r.name for r in problem.robots] + [s.name for s in problem.statics] + objects + ["world"]
    out: dict[int, Attachment] = {}
    for item in value.items():
        entries = item.mapping(("id", "object", "parent", "X_PO"), ("R_PO", "support", "width"))
        key = _whole(entries["id"])
        if key in out:
            raise entries["id"].error(f"found the id {key} again, expected a new one")
        pose = entries["X_PO"].numbers(7, "[x, y, z, qw, qx, qy, qz]")
        quaternion = np.array(pose[3:])
        if abs(np.linalg.norm(quaternion) - 1) > 1e-6:
            raise entries["X_PO"].wrong("a quaternion of length 1")
        R = _rotation(quaternion)
        if "R_PO" in entries:
            exact = np.array(entries["R_PO"].numbers(9, "the rotation matrix, row by row")).reshape(3, 3)
            if np.abs(exact - R).max() > 1e-6:
                raise entries["R_PO"].wrong("the rotation matrix of the quaternion in X_PO")
            R = exact
        support = entries["support"].data if "support" in entries else None
        out[key] = Attachment(
            object=entries["object"].choice(objects, "objects"),
            parent=entries["parent"].choice(parents, "parents"),
            X_PO=matrix(R, np.array(pose[:3])),
            support=None if support is None else entries["support"].text(),
            width=entries["width"].number(low=0.0)
            if "width" in entries and entries["width"].data is not None
            else None,
        )
    return out


def _segment(value: Value, problem: Problem, attachments: dict[int, Attachment]) -> Segment:
    entries = value.mapping(("mode", "q"), ("done",))
    of = entries["mode"].mapping(tuple(o.name for o in problem.objects))
    names = [s.name for s in problem.subgoals]
    done = [item.choice(names, "subgoals") for item in entries["done"].items()] if "done" in entries else []
    if len(set(done)) != len(done):
        raise entries["done"].wrong("each subgoal once")
    mode = Mode(tuple(_attachment(of[o.name], o.name, attachments) for o in problem.objects), frozenset(done))
    q = entries["q"].mapping(tuple(r.name for r in problem.robots))
    waypoints = {r.name: _waypoints(q[r.name], len(r.model.arm_joints)) for r in problem.robots}
    lengths = {name: len(rows) for name, rows in waypoints.items()}
    if len(set(lengths.values())) > 1:
        raise entries["q"].error(f"found {lengths} waypoints, expected the same number for every robot")
    return Segment(mode, waypoints)


def _waypoints(value: Value, n: int) -> np.ndarray:
    rows = value.items()
    if not rows:
        raise value.wrong("at least one waypoint")
    try:
        q = np.array(value.data)
    except ValueError:
        q = np.empty(0)
    if q.ndim != 2 or q.shape[1] != n or q.dtype.kind not in "fi":
        for row in rows:
            row.numbers(n, "one joint position per arm joint")  # finds the entry that is wrong, and says so
    return q.astype(float)


def _transition(value: Value, problem: Problem, attachments: dict[int, Attachment]) -> Transition:
    entries = value.mapping(("kind", "active", "actions"))
    actions = tuple(_action(item, problem, attachments) for item in entries["actions"].items())
    if not actions:
        raise entries["actions"].wrong("at least one action")
    transition = Transition(actions)
    if entries["active"].data != list(transition.active):
        raise entries["active"].wrong(f"{list(transition.active)}, the robots of the actions in alphabetical order")
    if entries["kind"].data != transition.kind:
        raise entries["kind"].wrong(repr(transition.kind))
    return transition


def _action(value: Value, problem: Problem, attachments: dict[int, Attachment]) -> Action:
    entries = value.mapping(("kind", "robots", "object", "before", "after"), ("subgoal",))
    kind = entries["kind"].choice(KINDS, "kinds of actions")
    robots = [r.name for r in problem.robots]
    before = after = subgoal = None
    if kind == "reach":
        if "subgoal" not in entries:
            raise value.error("found no key 'subgoal', expected the subgoal that is reached")
        subgoal = entries["subgoal"].choice([s.name for s in problem.subgoals], "subgoals")
    elif entries.get("subgoal") is not None and entries["subgoal"].data is not None:
        raise entries["subgoal"].wrong(f"none: a {kind} reaches no subgoal")
    if kind != "reach" or entries["object"].data is not None:
        name = entries["object"].choice([o.name for o in problem.objects], "objects")
        before, after = (_attachment(entries[key], name, attachments) for key in ("before", "after"))
    else:
        for key in ("before", "after"):
            if entries[key].data is not None:
                raise entries[key].wrong("null, as no object changes")
    return Action(
        kind=kind,
        robots=tuple(item.choice(robots, "robots") for item in entries["robots"].items()),
        before=before,
        after=after,
        subgoal=subgoal,
    )


def _attachment(value: Value, name: str, attachments: dict[int, Attachment]) -> Attachment:
    """The attachment whose id is at `value`, which must be one of the object `name`."""
    mine = [str(key) for key, a in attachments.items() if a.object == name]
    if isinstance(value.data, bool) or not isinstance(value.data, int) or str(value.data) not in mine:
        raise value.wrong(f"the id of an attachment of {name!r}: {', '.join(mine) or 'there are none'}")
    return attachments[value.data]


def _free_mapping(value: Value | None) -> dict[str, Value]:
    """The entries of a mapping with any keys."""
    if value is None:
        return {}
    if not isinstance(value.data, dict):
        raise value.wrong("a mapping")
    return value.mapping(optional=tuple(value.data))


def _whole(value: Value) -> int:
    if isinstance(value.data, bool) or not isinstance(value.data, int):
        raise value.wrong("a whole number")
    return value.data


def _rotation(wxyz: np.ndarray) -> np.ndarray:
    """The rotation matrix (3, 3) of a unit quaternion, in one fixed order of operations so that files read the same."""
    w, x, y, z = (float(c) for c in wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _dump(data: Any, indent: str = "") -> str:
    """JSON with one line per innermost list or mapping: a waypoint is a line."""
    children = data.values() if isinstance(data, dict) else data if isinstance(data, list) else ()
    if not any(isinstance(child, dict | list) and child for child in children):
        return json.dumps(data, allow_nan=False)
    inner = indent + " "
    if isinstance(data, dict):
        body = [f"{json.dumps(str(key))}: {_dump(value, inner)}" for key, value in data.items()]
    else:
        body = [_dump(value, inner) for value in data]
    begin, end = "{}" if isinstance(data, dict) else "[]"
    return begin + "\n" + ",\n".join(inner + line for line in body) + "\n" + indent + end


def _refuse_constant(name: str) -> float:
    raise ValueError(f"found {name}, expected a finite number")
