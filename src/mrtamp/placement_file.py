"""Where things rest in a problem file: the `supports:`, and the `start:` of an object.

An exact pose becomes a synthesised support.  Poses are checked to be physical: an object stands on a
face, touches the surface, and its origin is over it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from mrtamp.problem import (
    WORLD,
    MovableObject,
    StaticBody,
    Support,
)
from mrtamp.reading import Value, join
from mrtamp.resting import FACES, bounding_box, face_down, face_normal, flat_face, opposite, resting_pose

REST_TOLERANCE = 0.001
EDGE_TOLERANCE = 0.001
TILT_TOLERANCE = np.radians(1.0)
TOP_MARGIN = 0.01
"""How far (m) from the edge of a whole top face origins stay, where the file does not say: there things would fall."""
STEEPEST_SURFACE = np.radians(25.0)


class BodyFrames:
    """The bodies things can rest on, by name: their world poses at the start and their flat tops."""

    def __init__(
        self, statics: Iterable[StaticBody], objects: dict[str, MovableObject], package_paths: tuple[Path, ...]
    ) -> None:
        self.statics = {body.name: body for body in statics}
        self.objects = objects
        self.package_paths = package_paths

    @property
    def names(self) -> list[str]:
        """Every body that something can rest on."""
        return [*self.statics, *self.objects, WORLD]

    def place(self, placed: MovableObject) -> None:
        """Replace an object by its version with a start."""
        self.objects[placed.name] = placed

    def X_WB(self, body: str) -> RigidTransform:
        """World pose of `body`; of an object, where it starts."""
        if body in self.statics:
            return self.statics[body].X_WB
        if body in self.objects:
            thing = self.objects[body]
            X_WO: RigidTransform = self.X_WB(thing.start_on) @ thing.start_X_BO
            return X_WO
        return RigidTransform()

    def box(self, body: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Bounding box of a primitive body or an object, in its frame; None for the world and for world models."""
        if body in self.objects:
            return bounding_box(self.objects[body], self.package_paths)
        if body in self.statics and self.statics[body].shape is not None:
            return bounding_box(self.statics[body])
        return None

    def top(self, body: str) -> tuple[RigidTransform, tuple[float, float]] | None:
        """X_BS and size of the flat top of `body`: the face that looks up, of an object away from its resting face."""
        box = self.box(body)
        if box is None:
            return None
        if body in self.objects:
            shape, face = self.objects[body].shape, opposite(self.objects[body].resting_faces[0])
        else:
            up = self.statics[body].X_WB.rotation().matrix()[2]
            shape, face = self.statics[body].shape, max(FACES, key=lambda name: float(face_normal(name) @ up))
        found = flat_face(shape, *box, face)
        return None if found is None else (found[0], (float(found[1][0]), float(found[1][1])))


def read_support(value: Value, frames: BodyFrames) -> Support:
    """One entry of `supports:`."""
    entries = value.mapping(("name", "on"), ("X_BS", "size", "margin", "yaw_deg", "X_BO", "objects", "color"))
    body = entries["on"].choice(frames.names, "bodies")
    top = frames.top(body)
    if top is None and not ("X_BS" in entries and "size" in entries):
        raise value.error(f"found no 'X_BS' and 'size', expected both: {body!r} has no flat top to take them from")
    if "X_BS" in entries:
        X_BS = entries["X_BS"].pose()
        if "size" not in entries:
            raise value.error("found 'X_BS' without 'size', expected 'size: [x, y]' with it")
        size = (0.0, 0.0)
    else:
        assert top is not None
        X_BS, size = top
    if "size" in entries:
        x, y = entries["size"].numbers(2, "[x, y] full sizes in metres", low=0.0)
        size = (x, y)
    _check_region(value, entries, body, X_BS, size, frames=frames)
    margin = 0.0 if "size" in entries or "X_BO" in entries else TOP_MARGIN
    if "margin" in entries:
        margin = entries["margin"].number(low=0.0)
    support = Support(entries["name"].name(), body, X_BS, size, margin=margin)
    if "yaw_deg" in entries:
        low, high = entries["yaw_deg"].numbers(2, "[least, most] in degrees", low=-360.0, high=360.0)
        if low > high:
            raise entries["yaw_deg"].wrong("[least, most] with least <= most")
        support = dataclasses.replace(support, yaw=(float(np.radians(low)), float(np.radians(high))))
    if "X_BO" in entries:
        support = dataclasses.replace(support, X_BO=entries["X_BO"].pose())
    if "objects" in entries:
        allowed = tuple(item.choice(frames.objects, "objects") for item in entries["objects"].items())
        support = dataclasses.replace(support, objects=allowed)
    return dataclasses.replace(support, color=entries["color"].color()) if "color" in entries else support


def _check_region(
    value: Value,
    entries: dict[str, Value],
    body: str,
    X_BS: RigidTransform,
    size: tuple[float, float],
    *,
    frames: BodyFrames,
) -> None:
    """A region faces up, lies on the surface of its body and does not reach beyond it."""
    if body not in frames.objects:
        z_WS = frames.X_WB(body).rotation().matrix() @ X_BS.rotation().matrix()[:, 2]
        if z_WS[2] < np.cos(STEEPEST_SURFACE):
            tilt = np.degrees(np.arccos(np.clip(z_WS[2], -1, 1)))
            raise entries.get("X_BS", value).error(
                f"found a surface tilted by {tilt:.0f} degrees, expected one that faces up"
            )
    box = frames.box(body)
    if box is None:
        return
    half = np.array([*size, 0.0]) / 2
    corners = np.array([X_BS.multiply(half * sign) for sign in ([1, 1, 1], [1, -1, 1], [-1, 1, 1], [-1, -1, 1])])
    beyond = np.maximum(corners - box[1], box[0] - corners)
    worst = float(beyond.max())
    if worst > EDGE_TOLERANCE:
        key = "size" if "size" in entries else "X_BS"
        raise entries.get(key, value).error(
            f"found a region that reaches {worst:.3f} m beyond {body!r}, expected one on it (the whole top is "
            f"{_top_text(frames, body)})"
        )
    sunk = float(-beyond.max(axis=1).min())
    if sunk > EDGE_TOLERANCE:
        raise entries.get("X_BS", value).error(
            f"found a surface {sunk:.3f} m inside {body!r}, expected one on its outside"
        )


def _top_text(frames: BodyFrames, body: str) -> str:
    top = frames.top(body)
    return "round" if top is None else f"{top[1][0]:g} x {top[1][1]:g}"


@dataclasses.dataclass(frozen=True, eq=False)
class Placed:
    """An object with its start, and the supports that the start synthesised."""

    object: MovableObject
    supports: tuple[Support, ...]


def read_start(
    value: Value, thing: MovableObject, regions: list[Support], frames: BodyFrames, pending: set[str]
) -> Placed | None:
    """The start of `thing`; None while it stands on one of the `pending` objects, which have no pose yet."""
    entries = value.mapping(optional=("in", "xy", "yaw_deg", "on", "X_WO", "X_BO"))
    if ("in" in entries) == ("on" in entries):
        raise value.wrong("{in: REGION, xy: [x, y], yaw_deg: a} or {on: BODY, X_WO: pose}")
    region = None
    if "in" in entries:
        names = [support.name for support in regions]
        region = regions[names.index(entries["in"].choice(names, "supports"))]
        check_admits(entries["in"], region, thing)
        body = region.body
    else:
        body = entries["on"].choice(frames.names, "bodies")
    if body == thing.name:
        raise entries.get("in", entries.get("on", value)).error(
            f"found a start of {body!r} on itself, expected another body"
        )
    if body in pending:
        return None
    if region is not None and not {"X_WO", "X_BO"} & set(entries):
        entries = value.mapping(("in",), ("xy", "yaw_deg"))
        x, y = entries["xy"].numbers(2, "[x, y] in the region, in metres") if "xy" in entries else (0.0, 0.0)
        yaw = np.radians(entries["yaw_deg"].number()) if "yaw_deg" in entries else 0.0
        X_SO = resting_pose(thing, thing.resting_faces[0], (x, y), float(yaw), frames.package_paths)
        X_BO = region.X_BS @ X_SO if region.X_BO is None else region.X_BO
    else:
        X_BO = _exact_pose(value, thing, body, region, frames)
    if region is not None:
        key = "xy" if "xy" in entries else "in"
        _check_inside(entries[key], region, X_BO)
        return Placed(_start(thing, body, X_BO, region.name), ())
    support = exact_support(f"start of {thing.name}", body, X_BO, thing, frames)
    return Placed(_start(thing, body, X_BO, support.name), (support,))


def _start(thing: MovableObject, body: str, X_BO: RigidTransform, support: str) -> MovableObject:
    return dataclasses.replace(thing, start_on=body, start_X_BO=X_BO, start_support=support)


def exact_support(name: str, body: str, X_BO: RigidTransform, thing: MovableObject, frames: BodyFrames) -> Support:
    """The support that is exactly the pose X_BO of `thing`; S lies where the object's lowest face is."""
    top = frames.top(body)
    if top is not None:
        R_BS = top[0].rotation()
    else:
        R_BS = RotationMatrix() if body in frames.objects else frames.X_WB(body).rotation().inverse()
    face, _ = face_down(RigidTransform(R_BS.inverse() @ X_BO.rotation()))
    height = resting_pose(thing, face, (0.0, 0.0), 0.0, frames.package_paths).translation()[2]
    p_BS = X_BO.translation() - height * R_BS.matrix()[:, 2]
    return Support(name, body, RigidTransform(R_BS, p_BS), (0.0, 0.0), X_BO=X_BO, objects=(thing.name,))


def _exact_pose(
    value: Value, thing: MovableObject, body: str, region: Support | None, frames: BodyFrames
) -> RigidTransform:
    """X_BO from the keys X_WO or X_BO of `value`, checked to rest on `body`; on an object without pose: its top."""
    given = [name for name in ("X_WO", "X_BO") if isinstance(value.data, dict) and name in value.data]
    if len(given) > 1:
        raise value.error("found both 'X_WO' and 'X_BO', expected one of them")
    top = (region.X_BS, region.size) if region is not None else frames.top(body)
    if not given:
        if body in frames.objects and top is not None:
            X_SO = resting_pose(thing, thing.resting_faces[0], (0.0, 0.0), 0.0, frames.package_paths)
            centred: RigidTransform = top[0] @ X_SO
            return centred
        raise value.error(f"found no pose, expected 'X_WO' with the pose of {thing.name!r} on {body!r}")
    entry = Value(value.document, value.data[given[0]], join(value.path, given[0]))
    X_BO = entry.pose() if given[0] == "X_BO" else frames.X_WB(body).inverse() @ entry.pose()
    check_rest(entry, thing, body, X_BO, top, frames=frames)
    return X_BO


def check_rest(
    value: Value,
    thing: MovableObject,
    body: str,
    X_BO: RigidTransform,
    top: tuple[RigidTransform, tuple[float, float]] | None,
    *,
    frames: BodyFrames,
) -> None:
    """`thing` at X_BO stands on a face, on the surface `top` of `body`; nothing is checked where that is unknown."""
    if top is None or (thing.shape is not None and thing.shape.kind == "sphere"):
        return
    X_BS, size = top
    X_SO = X_BS.inverse() @ X_BO
    face, tilt = face_down(X_SO)
    if tilt > TILT_TOLERANCE:
        raise value.error(
            f"found {thing.name!r} tilted by {np.degrees(tilt):.1f} degrees, expected it to stand on one of its faces"
        )
    standing = resting_pose(thing, face, (0.0, 0.0), 0.0, frames.package_paths)
    gap = float(X_SO.translation()[2] - standing.translation()[2])
    if abs(gap) > REST_TOLERANCE:
        where = f"floating {gap:.3g} m above" if gap > 0 else f"{-gap:.3g} m too low on"
        raise value.error(f"found {thing.name!r} {where} {body!r}, expected it to rest on the surface there")
    beside = float((np.abs(X_SO.translation()[:2]) - np.array(size) / 2).max())
    if beside > EDGE_TOLERANCE:
        raise value.error(f"found {thing.name!r} {beside:.3f} m beside {body!r}, expected its origin over the surface")


def _check_inside(value: Value, region: Support, X_BO: RigidTransform) -> None:
    if region.X_BO is not None:
        return
    p_SO = region.X_BS.inverse().multiply(X_BO.translation())
    x, y = region.reach
    if (np.abs(p_SO[:2]) > np.array([x, y]) + 1e-9).any():
        margin = f" less its margin of {region.margin:g} m" if region.margin else ""
        raise value.error(
            f"found the position [{p_SO[0]:g}, {p_SO[1]:g}] in {region.name!r}, expected one inside it{margin}: "
            f"|x| <= {x:g}, |y| <= {y:g}"
        )


def check_admits(value: Value, region: Support, thing: MovableObject) -> None:
    if region.objects is not None and thing.name not in region.objects:
        raise value.error(
            f"found {region.name!r}, which takes only {', '.join(region.objects)}, expected another support"
        )
