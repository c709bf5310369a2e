"""YAML and plain data, read key by key with errors that say where, what was found and what is valid.

`read_document` turns a YAML file into plain data (dicts, lists, numbers, strings) and remembers the line of every key;
`Value` walks that data and converts each entry, raising one `ProblemError` of the form
`FILE:LINE: objects[1].grasps[0].depth: found ..., expected ...`.  The YAML is read by the 1.2 core schema, so `on`,
`yes` and `1e-3` mean what they look like, plus Drake's rotation tags `!Rpy` and `!AngleAxis`.
"""

from __future__ import annotations

import difflib
import math
import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from mrtamp.problem import ProblemError

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*")
_INT = re.compile(r"[-+]?[0-9]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_SPECIAL_FLOAT = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_MAX_DEPTH = 40
_LONGEST_INT = 300  # digits; more are read as a float, which is then infinite


@dataclass(frozen=True)
class Document:
    """Plain data with the place it came from; `lines` maps a key path (`objects[1].start`) to its line."""

    data: Any
    label: str
    directory: Path
    lines: dict[str, int] = field(default_factory=dict)

    def error(self, path: str, text: str) -> ProblemError:
        """The error `text` about the entry at `path`, prefixed with file and line (of the nearest key that has one)."""
        known = path
        while known and known not in self.lines:
            known = known[: max(known.rfind("."), known.rfind("["), 0)]
        where = f"{self.label}:{self.lines[known]}" if known in self.lines else self.label
        return ProblemError(f"{where}: {path}: {text}" if path else f"{where}: {text}")

    @property
    def root(self) -> Value:
        """The whole document, to be read from the top."""
        return Value(self, self.data, "")


def read_document(file: Path) -> Document:
    """Read the YAML file `file`, keeping line numbers.

    Raises
    ------
    ProblemError
        The file cannot be read, or its YAML is malformed; the message names the line.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ProblemError(f"{file}: cannot be read: {reason}") from None
    return parse_document(text, str(file), file.resolve().parent)


def parse_document(text: str, label: str, directory: Path) -> Document:
    """Parse YAML `text`; `label` names it in errors and relative paths in it start from `directory`."""
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{label}:{mark.line + 1}" if mark else label
        reason = getattr(error, "problem", None) or getattr(error, "reason", None) or "cannot be parsed"
        raise ProblemError(f"{where}: not valid YAML: {reason}") from None
    if node is None:
        raise ProblemError(f"{label}: the file is empty")
    lines: dict[str, int] = {"": node.start_mark.line + 1}
    data = _plain(node, "", Document(None, label, directory, lines), 0)
    return Document(data, label, directory, lines)


def data_document(data: Any, file: Path | None, label: str = "problem") -> Document:
    """A document of data built in Python (numpy arrays, tuples and RigidTransforms are welcome in it)."""
    directory = file.resolve().parent if file else Path.cwd()
    return Document(_to_plain(data), str(file) if file else label, directory)


def _plain(node: yaml.Node, path: str, document: Document, depth: int) -> Any:
    """`node` as plain data; fills `document.lines` on the way down."""
    line = node.start_mark.line + 1
    document.lines.setdefault(path, line)
    if depth > _MAX_DEPTH:
        raise document.error(path, "nested too deeply (does an alias contain itself?)")
    if isinstance(node, yaml.MappingNode):
        data: dict[str, Any] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise document.error(path, f"a key on line {key_node.start_mark.line + 1} is not a plain word")
            key = key_node.value
            key_path = join(path, key)
            if key in data:
                first = document.lines[key_path]
                document.lines[key_path] = key_node.start_mark.line + 1
                raise document.error(key_path, f"found twice, first on line {first}; a key may appear only once")
            document.lines[key_path] = key_node.start_mark.line + 1
            data[key] = _plain(value_node, key_path, document, depth + 1)
        return _untag(node.tag, data, path, document)
    if isinstance(node, yaml.SequenceNode):
        entries = [_plain(entry, f"{path}[{i}]", document, depth + 1) for i, entry in enumerate(node.value)]
        return _untag(node.tag, entries, path, document)
    assert isinstance(node, yaml.ScalarNode)
    return _scalar(node, path, document)


def _untag(tag: str, data: Any, path: str, document: Document) -> Any:
    """Check Drake's rotation tags and drop them: their keys alone say which rotation is meant."""
    if tag.startswith("tag:yaml.org,2002:"):
        return data
    if tag == "!Rpy":
        if not isinstance(data, dict) or set(data) != {"deg"}:
            raise document.error(path, f"found !Rpy {describe(data)}, expected !Rpy {{deg: [roll, pitch, yaw]}}")
        return data
    if tag == "!AngleAxis":
        if not isinstance(data, dict) or set(data) != {"angle_deg", "axis"}:
            raise document.error(path, f"found !AngleAxis {describe(data)}, expected {{angle_deg: a, axis: [x, y, z]}}")
        return data
    raise document.error(path, f"found the tag {tag}, expected one of: !Rpy, !AngleAxis")


def _scalar(node: yaml.ScalarNode, path: str, document: Document) -> Any:
    text: str = node.value
    if not node.tag.startswith("tag:yaml.org,2002:"):
        raise document.error(path, f"found the tag {node.tag}, expected one of: !Rpy {{...}}, !AngleAxis {{...}}")
    if node.style is not None:
        return text
    if text in ("", "~", "null", "Null", "NULL"):
        return None
    if text in ("true", "True", "TRUE", "false", "False", "FALSE"):
        return text.lower() == "true"
    if _INT.fullmatch(text) and len(text) < _LONGEST_INT:
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    if _SPECIAL_FLOAT.fullmatch(text):
        return float(text.replace(".", "", 1))
    return text


def _to_plain(data: Any) -> Any:
    if isinstance(data, dict):
        return {str(key): _to_plain(value) for key, value in data.items()}
    if isinstance(data, np.ndarray | np.generic):
        return data.tolist()
    if isinstance(data, list | tuple):
        return [_to_plain(entry) for entry in data]
    if isinstance(data, Path):
        return str(data)
    if isinstance(data, RigidTransform):
        return pose_to_dict(data)
    return data


def join(path: str, key: str) -> str:
    """The key path of `key` in the mapping at `path`."""
    return f"{path}.{key}" if path else key


def describe(data: Any) -> str:
    """`data` as one short piece of an error message."""
    if data is None:
        return "nothing"
    text = repr(data)
    return text if len(text) <= 60 else text[:57] + "..."


def choices(options: Iterable[str], found: Any = None, what: str = "") -> str:
    """`expected one of the supports: a, b (did you mean 'a'?)`, for `found` not among `options`."""
    known = list(options)
    if not known:
        return f"but there are no {what}" if what else "but there are none"
    text = f"expected one of{f' the {what}' if what else ''}: {', '.join(known)}"
    close = difflib.get_close_matches(str(found), known, n=1) if found is not None else []
    return f"{text} (did you mean {close[0]!r}?)" if close else text


@dataclass(frozen=True)
class Value:
    """One entry of a document: its data, and the key path that leads to it."""

    document: Document
    data: Any
    path: str

    def error(self, text: str) -> ProblemError:
        """An error about this entry."""
        return self.document.error(self.path, text)

    def wrong(self, expected: str) -> ProblemError:
        """The error that this entry is not `expected`."""
        return self.error(f"found {describe(self.data)}, expected {expected}")

    def mapping(self, required: tuple[str, ...] = (), optional: tuple[str, ...] = ()) -> dict[str, Value]:
        """The entries of a mapping by key; missing and unknown keys are errors."""
        valid = required + optional
        if not isinstance(self.data, dict):
            raise self.wrong(f"a mapping with the keys {', '.join(valid)}")
        for key in self.data:
            if key not in valid:
                raise self.document.error(join(self.path, key), f"found the unknown key {key!r}, {choices(valid, key)}")
        for key in required:
            if key not in self.data:
                raise self.error(f"found no key {key!r}, expected the keys {', '.join(required)}")
        return {key: Value(self.document, data, join(self.path, key)) for key, data in self.data.items()}

    def items(self) -> list[Value]:
        """The entries of a list."""
        if not isinstance(self.data, list):
            raise self.wrong("a list")
        return [Value(self.document, data, f"{self.path}[{i}]") for i, data in enumerate(self.data)]

    def number(self, low: float = -math.inf, high: float = math.inf, above: float | None = None) -> float:
        """A finite number in [low, high], and larger than `above` if given."""
        if isinstance(self.data, bool) or not isinstance(self.data, int | float):
            raise self.wrong("a number")
        if not abs(self.data) <= sys.float_info.max:
            raise self.wrong("a finite number")
        if above is not None and not self.data > above:
            raise self.wrong(f"a number larger than {above:g}")
        if not low <= self.data <= high:
            limits = f"of at least {low:g}" if high == math.inf else f"between {low:g} and {high:g}"
            raise self.wrong(f"a number {limits}")
        return float(self.data)

    def version(self, supported: int, what: str) -> None:
        """Refuse every version of the format `what` but the `supported` one."""
        if isinstance(self.data, bool) or self.data != supported:
            raise self.wrong(f"version {supported} of the {what} format")

    def numbers(self, count: int | tuple[int, ...], meaning: str, **limits: Any) -> tuple[float, ...]:
        """A list of `count` numbers (or one of several counts), each within `limits` (see `number`)."""
        counts = (count,) if isinstance(count, int) else count
        if not isinstance(self.data, list) or len(self.data) not in counts:
            length = f" ({len(self.data)} numbers)" if isinstance(self.data, list) else ""
            wanted = " or ".join(str(n) for n in counts)
            raise self.error(f"found {describe(self.data)}{length}, expected {wanted} numbers: {meaning}")
        return tuple(item.number(**limits) for item in self.items())

    def text(self) -> str:
        """A string."""
        if not isinstance(self.data, str):
            raise self.wrong("a text")
        return self.data

    def name(self) -> str:
        """A name: letters, digits, `_`, `.` and `-`, not starting with a digit."""
        if not isinstance(self.data, str) or not _NAME.fullmatch(self.data):
            raise self.wrong("a name of letters, digits, '_', '.', '-' that starts with a letter")
        return self.data

    def choice(self, options: Iterable[str], what: str = "") -> str:
        """One of `options`; `what` is their plural in the error message."""
        known = list(options)
        if not isinstance(self.data, str) or self.data not in known:
            raise self.error(f"found {describe(self.data)}, {choices(known, self.data, what)}")
        return self.data

    def color(self) -> tuple[float, float, float, float]:
        """[r, g, b] or [r, g, b, a], each between 0 and 1."""
        rgba = self.numbers((3, 4), "[r, g, b] or [r, g, b, a]", low=0.0, high=1.0)
        return (rgba[0], rgba[1], rgba[2], rgba[3] if len(rgba) == 4 else 1.0)

    def pose(self) -> RigidTransform:
        """A pose in the form of Drake's `Transform`: `{translation: [x, y, z], rotation: ...}`, both optional."""
        entries = self.mapping(optional=("translation", "rotation"))
        p = entries["translation"].numbers(3, "[x, y, z] in metres") if "translation" in entries else (0.0, 0.0, 0.0)
        R = entries["rotation"]._rotation() if "rotation" in entries else RotationMatrix()
        p_vector: Any = np.array(p)  # Drake's stubs know no array type that fits
        return RigidTransform(R, p_vector)

    def _rotation(self) -> RotationMatrix:
        forms = (
            "!Rpy {deg: [roll, pitch, yaw]}, !AngleAxis {angle_deg: a, axis: [x, y, z]} or {quaternion: [w, x, y, z]}"
        )
        if not isinstance(self.data, dict) or set(self.data) not in (
            {"deg"},
            {"rpy_deg"},
            {"quaternion"},
            {"angle_deg", "axis"},
        ):
            raise self.wrong(forms)
        entries = self.mapping(optional=tuple(self.data))
        if "deg" in entries or "rpy_deg" in entries:
            (entry,) = entries.values()
            rpy = entry.numbers(3, "[roll, pitch, yaw] in degrees")
            return RotationMatrix(RollPitchYaw(np.radians(rpy)))
        if "quaternion" in entries:
            wxyz: Any = np.array(entries["quaternion"].numbers(4, "[w, x, y, z]"))
            norm = float(np.linalg.norm(wxyz))
            if abs(norm - 1) > 1e-6:
                raise entries["quaternion"].error(
                    f"found {describe(entries['quaternion'].data)} of length {norm:.6g}, expected length 1"
                )
            return RotationMatrix(Quaternion(wxyz / norm))
        axis: Any = np.array(entries["axis"].numbers(3, "[x, y, z]"))
        length = float(np.linalg.norm(axis))
        if length < 1e-9:
            raise entries["axis"].wrong("an axis of non-zero length")
        return RotationMatrix(AngleAxis(math.radians(entries["angle_deg"].number()), axis / length))


def pose_to_dict(X: RigidTransform) -> dict[str, Any]:
    """The pose `X` as `Value.pose` reads it; the rotation, as a quaternion, is left out when it is the identity."""
    pose: dict[str, Any] = {"translation": X.translation().tolist()}
    if not np.array_equal(X.rotation().matrix(), np.eye(3)):
        pose["rotation"] = {"quaternion": X.rotation().ToQuaternion().wxyz().tolist()}
    return pose
