"""Raw records of a suite: one line of JSON per finished run, in `DIR/runs.jsonl` behind a line with the suite itself.

A line is on the disk before the next run begins, so that a kill loses at most the run in hand.  Whoever opens the file
again continues where it ends, and drops the half of a line that a kill may have left behind.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

from mrtamp.bench.machine import Machine
from mrtamp.bench.run import Point
from mrtamp.bench.suite import Suite, suite_from_dict, suite_to_dict
from mrtamp.problem import MrtampError

RECORDS_VERSION = 1
_HEADER = "mrtamp_bench"


@dataclass(frozen=True)
class Times:
    """Where the time of a run went (s).

    Attributes
    ----------
    start : until planning begins: imports, loading the problem.
    planning : within the limit, the planner's own preparation included.
    judging : saving plans, loading them again and having them judged.
    wall : the whole life of the process, seen from outside.
    cpu : processor time of the whole process.
    """

    start: float
    planning: float
    judging: float
    wall: float
    cpu: float

    @property
    def harness(self) -> float:
        """What measuring took on top of starting, loading, planning and judging."""
        return max(self.wall - self.start - self.planning - self.judging, 0.0)


@dataclass(frozen=True)
class Record:
    """What came of one run.

    Attributes
    ----------
    key : tells the run from all others of its suite.
    case : name of the problem in its suite; `parameters` are those it was made with, the layout seed among them.
    planner : label of the planner.
    points : every plan that was yielded, in order, those that came after the limit too.
    first_counts, counts : counters of the planner (collision checks, IK calls) when it had its first plan (empty
        without one), and in the end.
    times, peak_mb : None when the process did not live to tell.
    refused : what the judge said against the first and the cheapest plan within the limit, loaded from their files.
    why : what the planner says why there is no plan.
    error : why the run failed: a kill at its limit, or an exception.
    """

    key: str
    case: str
    parameters: Mapping[str, int]
    planner: str
    seed: int
    limit_s: float
    points: tuple[Point, ...] = ()
    first_counts: Mapping[str, int] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)
    times: Times | None = None
    peak_mb: float | None = None
    refused: tuple[str, ...] = ()
    why: str = ""
    error: str | None = None
    machine: Machine | None = None

    @property
    def curve(self) -> tuple[Point, ...]:
        """The plans that count: found within the limit, in a run in which nothing was wrong."""
        if self.error is not None or self.refused:
            return ()
        return tuple(p for p in self.points if p.time_s <= self.limit_s)

    @property
    def first(self) -> Point | None:
        """The first plan."""
        return self.curve[0] if self.curve else None

    @property
    def final(self) -> Point | None:
        """The cheapest plan."""
        return min(self.curve, key=lambda p: p.cost, default=None)

    @property
    def layout(self) -> int | None:
        """The layout seed, None where the problem has one layout."""
        return self.parameters.get("layout_seed")

    def cost_at(self, time_s: float) -> float:
        """The cost of the incumbent at a time, infinite before there was one."""
        return min((p.cost for p in self.curve if p.time_s <= time_s), default=float("inf"))

    def as_dict(self) -> dict[str, Any]:
        """The same as JSON-able data."""
        return asdict(self)


def record_from_dict(data: Mapping[str, Any]) -> Record:
    """The record that `as_dict` described."""
    parts = dict(data)
    parts["points"] = tuple(Point(**p) for p in data["points"])
    parts["refused"] = tuple(data["refused"])
    parts["times"] = Times(**data["times"]) if data["times"] else None
    parts["machine"] = Machine(**data["machine"]) if data["machine"] else None
    return Record(**parts)


# -- the file --------------------------------------------------------------------------------------------------------


def records_file(folder: Path) -> Path:
    """Where the raw records of a suite are."""
    return folder / "runs.jsonl"


def read_records(folder: Path) -> tuple[Suite, list[Record]]:
    """The suite that was run, and what came of its finished runs.

    Raises
    ------
    MrtampError : there are no records, or they are not what they should be.
    """
    file = records_file(folder)
    if not file.is_file():
        raise MrtampError(f"found no {file.name} in {folder}, expected the folder of a suite that was run (--out DIR)")
    suite, records, _ = _parse(file)
    return suite, records


class Records:
    """The file of raw records, open for more: use it as a context manager.

    Parameters
    ----------
    folder : made where missing.
    suite : what is run; a file that is there already has to be of the very same suite.

    Raises
    ------
    MrtampError : the records there are of another suite, or somebody else is adding to them.
    """

    def __init__(self, folder: Path, suite: Suite) -> None:
        self.file = records_file(folder)
        self._suite = suite
        self._stream: IO[bytes] | None = None
        self.done: list[Record] = []

    def __enter__(self) -> Records:
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            stream = self.file.open("ab")
        except OSError as error:
            reason = "it is no folder" if isinstance(error, FileExistsError) else error.strerror
            found = f"{self.file.parent}: cannot be written to: {reason}"
            raise MrtampError(f"{found}; name another folder (--out DIR)") from None
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.close()
            raise MrtampError(f"{self.file}: another `mrtamp bench` is adding to it; name another folder") from None
        try:
            if self.file.read_bytes().partition(b"\n")[1]:
                suite, self.done, length = _parse(self.file)
                _ensure_same(self.file, suite, self._suite)
                stream.truncate(length)
            else:
                stream.truncate(0)
                _write(stream, {_HEADER: RECORDS_VERSION, "suite": suite_to_dict(self._suite)})
        except BaseException:
            stream.close()
            raise
        self._stream = stream
        return self

    def __exit__(self, *_: object) -> None:
        if self._stream is not None:
            self._stream.close()

    def add(self, record: Record) -> None:
        """Append a record; it is on the disk when this returns."""
        assert self._stream is not None
        _write(self._stream, record.as_dict())
        self.done.append(record)


def _write(stream: IO[bytes], data: Mapping[str, Any]) -> None:
    stream.write(json.dumps(data).encode() + b"\n")
    stream.flush()
    os.fsync(stream.fileno())


def _parse(file: Path) -> tuple[Suite, list[Record], int]:
    """Suite, records, and the number of bytes they take: what comes after these is half a line."""
    content = file.read_bytes()
    length = content.rfind(b"\n") + 1
    lines = content[:length].splitlines()
    entries: list[dict[str, Any]] = []
    for number, line in enumerate(lines, 1):
        try:
            entry = json.loads(line)
        except ValueError:
            entry = None
        if not isinstance(entry, dict):
            raise MrtampError(f"{file}:{number}: found {line[:60]!r}, expected one JSON object per line")
        entries.append(entry)
    if not entries or entries[0].get(_HEADER) != RECORDS_VERSION:
        raise MrtampError(f"{file}:1: found no {_HEADER}: {RECORDS_VERSION}, expected records of `mrtamp bench`")
    suite = suite_from_dict(entries[0].get("suite"), f"{file}:1: suite")
    records: dict[str, Record] = {}
    for number, entry in enumerate(entries[1:], 2):
        try:
            record = record_from_dict(entry)
        except (KeyError, TypeError) as error:
            raise MrtampError(f"{file}:{number}: not a record of a run: {error}") from None
        # A run that failed and was tried again counts as it came out then.
        records[record.key] = record
    return suite, list(records.values()), length


def _ensure_same(file: Path, there: Suite, here: Suite) -> None:
    """Records of different suites are not mixed."""
    old, new = suite_to_dict(there), suite_to_dict(here)
    for key in old:
        if old[key] != new[key]:
            found, wanted = _difference(key, old[key], new[key])
            raise MrtampError(
                f"{file}: holds runs of another suite: {found} there, {wanted} here; name another folder (--out DIR) "
                "or remove this one"
            )


def _difference(key: str, there: Any, here: Any) -> tuple[str, str]:
    """The first thing in which two values differ, in words."""
    if isinstance(there, Sequence) and isinstance(here, Sequence) and not isinstance(there, str):
        for i, (a, b) in enumerate(zip(there, here, strict=False)):
            if a != b:
                return _difference(f"{key}[{i}]", a, b)
        return f"{len(there)} {key}", str(len(here))
    return f"{key}: {there!r}", repr(here)
