"""The `grasps:` key of an object -> grasp families, with defaults that suit a parallel gripper such as the Panda's.

    grasps: top | sides | antipodal          # from above / from the four sides / from all six; default: all but below
    grasps:
      - antipodal: {approach: ["-z", "+x"], offset: 0.01, depth: [0.02, 0.03]}
      - {X_OG: {translation: [0, 0, 0.1], rotation: !Rpy {deg: [180, 0, 0]}}, width: 0.05, robots: [left]}

Any robot may use any grasp that its gripper opens wide enough for, unless `robots` says which may.  A grasp that no
robot of the problem can close on is an error.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from mrtamp.problem import AntipodalGrasps, ExplicitGrasp, Shape
from mrtamp.reading import Value
from mrtamp.resting import shape_extent

Grasps = tuple[AntipodalGrasps | ExplicitGrasp, ...]

TOP = ("-z",)
SIDES = ("+x", "-x", "+y", "-y")
APPROACHES = {"top": TOP, "sides": SIDES, "antipodal": (*TOP, *SIDES, "+z")}

# The Panda's finger pads are 18 mm tall and 20 mm wide around the grasp point; its palm is 36 mm behind that point.
PAD_HALF_WIDTH = 0.010
MIN_DEPTH = 0.010
MAX_DEPTH = 0.030
TIP_CLEARANCE = 0.015


def read_grasps(value: Value | None, owner: Value, shape: Shape | None, openings: dict[str, float]) -> Grasps:
    """The grasp families of an object of `shape` (None: a model file).

    `openings` are the widest openings of all robots (m), 0 of those without a gripper; `owner` is the object's own
    entry, for errors about an absent `grasps:`.
    """
    max_width = max(openings.values())
    if value is None:
        if shape is None or max_width == 0.0:
            return ()
        fitting = tuple(a for a in (*TOP, *SIDES) if _closing_axes(shape, a, max_width))
        if not fitting:
            extent = " x ".join(f"{size:g}" for size in shape_extent(shape))
            raise owner.error(f"found the size {extent}, expected at least two sides within {_opening(max_width)}")
        return _families(shape, fitting, max_width)
    if isinstance(value.data, str):
        approaches = APPROACHES[value.choice(APPROACHES, "grasp families")]
        if shape is None:
            raise value.wrong("a list of {X_OG, width}: antipodal grasps are only defined on primitive shapes")
        _check_fit(value, shape, approaches, max_width)
        return _families(shape, approaches, max_width)
    if not isinstance(value.data, list):
        raise value.wrong(f"{', '.join(APPROACHES)}, or a list of {{antipodal: ...}} and {{X_OG: ..., width: ...}}")
    return tuple(g for item in value.items() for g in _read_entry(item, shape, openings))


def _read_entry(item: Value, shape: Shape | None, openings: dict[str, float]) -> Grasps:
    """One entry of the list: its families, for the robots that it names."""
    entries = item.mapping(optional=("antipodal", "X_OG", "width", "robots"))
    if "robots" not in entries:
        return _read_family(item, shape, max(openings.values()))
    able = [name for name, opening in openings.items() if opening > 0.0]
    robots = tuple(entry.choice(able, "robots with a gripper") for entry in entries["robots"].items())
    if not robots or len(set(robots)) != len(robots):
        raise entries["robots"].wrong("at least one robot, each once")
    families = _read_family(item, shape, max(openings[name] for name in robots))
    return tuple(dataclasses.replace(family, robots=robots) for family in families)


def _read_family(item: Value, shape: Shape | None, max_width: float) -> Grasps:
    entries = item.mapping(optional=("antipodal", "X_OG", "width", "robots"))
    if "antipodal" not in entries:
        explicit = item.mapping(("X_OG", "width"), ("robots",))
        width = explicit["width"].number(above=0.0)
        if width > max_width:
            raise explicit["width"].error(f"found {width:g}, expected a width within {_opening(max_width)}")
        return (ExplicitGrasp(explicit["X_OG"].pose(), width),)
    if not set(entries) <= {"antipodal", "robots"}:
        raise item.error(f"found the keys {', '.join(entries)}, expected 'antipodal', or 'X_OG' with 'width'")
    if shape is None:
        raise item.error("found 'antipodal' on a model file, expected {X_OG, width}")
    family = entries["antipodal"].mapping(optional=("approach", "offset", "depth"))
    approaches = APPROACHES["antipodal"]
    if "approach" in family:
        approaches = tuple(
            entry.choice(APPROACHES["antipodal"], "approach directions") for entry in family["approach"].items()
        )
        if not approaches or len(set(approaches)) != len(approaches):
            raise family["approach"].wrong("at least one approach direction, each once")
    _check_fit(family.get("approach", item), shape, approaches, max_width)
    offset = depth = None
    if "offset" in family:
        longest = min(_offset_limit(shape, approach, max_width, 0.0) for approach in approaches)
        offset = family["offset"].number(low=0.0, high=longest)
    if "depth" in family:
        thickness = float(min(shape_extent(shape)[_axis(approach)] for approach in approaches))
        entry = family["depth"]
        if isinstance(entry.data, list):
            low, high = entry.numbers(2, "[least, most] in metres", low=0.0, high=thickness)
            if low > high:
                raise entry.wrong("[least, most] with least <= most")
            depth = (low, high)
        else:
            depth = (entry.number(low=0.0, high=thickness),) * 2
    return _families(shape, approaches, max_width, offset, depth)


def _families(
    shape: Shape,
    approaches: tuple[str, ...],
    max_width: float,
    offset: float | None = None,
    depth: tuple[float, float] | None = None,
) -> Grasps:
    """One family per distinct (offset, depth); what is not given gets its default for that approach."""
    grouped: dict[tuple[float, tuple[float, float]], list[str]] = {}
    for approach in approaches:
        if not _closing_axes(shape, approach, max_width):
            continue
        slide = _offset_limit(shape, approach, max_width, PAD_HALF_WIDTH) if offset is None else offset
        thickness = float(shape_extent(shape)[_axis(approach)])
        grouped.setdefault((slide, _default_depth(thickness) if depth is None else depth), []).append(approach)
    return tuple(AntipodalGrasps(tuple(group), slide, sink) for (slide, sink), group in grouped.items())


def _default_depth(thickness: float) -> tuple[float, float]:
    """Deep enough to hold, shallow enough that neither the palm nor what is behind the object is touched."""
    deepest = min(MAX_DEPTH, thickness - TIP_CLEARANCE)
    shallowest = min(MIN_DEPTH, thickness / 2)
    return shallowest, max(shallowest, round(deepest, 9))


def _axis(direction: str) -> int:
    return "xyz".index(direction[1])


def _closing_axes(shape: Shape, approach: str, max_width: float) -> list[int]:
    """The axes perpendicular to `approach` along which the object fits between the fingers."""
    extent = shape_extent(shape)
    axes = [axis for axis in range(3) if axis != _axis(approach)]
    if shape.kind == "cylinder" and _axis(approach) != 2:
        axes.remove(2)  # the flat ends are gripped nowhere: fingers close around the axis
    return [axis for axis in axes if extent[axis] <= max_width]


def _offset_limit(shape: Shape, approach: str, max_width: float, margin: float) -> float:
    """How far the fingers may slide to each side with `margin` (m) of the object beyond the grasp point."""
    extent = shape_extent(shape)
    if shape.kind == "sphere" or (shape.kind != "box" and _axis(approach) == 2):
        return 0.0  # off the centre line the faces under the fingers are not opposite
    straight = shape.size[1] if shape.kind == "capsule" else None
    limits = []
    for closing in _closing_axes(shape, approach, max_width):
        along = 3 - closing - _axis(approach)
        length = straight if straight is not None and along == 2 else float(extent[along])
        limits.append(max(0.0, length / 2 - margin))
    return round(min(limits), 9) if limits else 0.0


def _check_fit(value: Value, shape: Shape, approaches: tuple[str, ...], max_width: float) -> None:
    """Every listed approach must have one pair of faces that some gripper of the problem can close on."""
    for approach in approaches:
        if not _closing_axes(shape, approach, max_width):
            extent = np.delete(shape_extent(shape), _axis(approach))
            raise value.error(
                f"found the approach {approach}, where the object is {extent[0]:g} and {extent[1]:g} m wide, expected "
                f"one of them within {_opening(max_width)}"
            )


def _opening(max_width: float) -> str:
    if max_width == 0.0:
        return "a gripper's opening, but no robot of this problem has a gripper"
    return f"the widest gripper's opening of {max_width:g} m"
