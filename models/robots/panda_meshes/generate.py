"""Write the display meshes of the Panda: surfaces of revolution, lofts and prisms with a colour each.

Run `python generate.py` after a change here; it rewrites the .obj files and panda.mtl beside it. The numbers are the
outer measures of the real links, in metres, in the frame of the link that panda.urdf attaches the mesh to. Nothing here
is used for collision checking, so a part may stop short of the real shape (cables, screws and logos are left out).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

COLOURS = {
    "white": (0.97, 0.97, 0.96),
    "dark": (0.12, 0.12, 0.13),
    "grey": (0.55, 0.56, 0.58),
    "light": (0.80, 0.80, 0.80),
}
SIDES = 32
CREASE = np.cos(np.deg2rad(35))
X, Y, Z = np.eye(3)


@dataclass(frozen=True)
class Part:
    """Closed triangle mesh of one colour: `vertices` (n, 3) and `faces` (m, 3), counter-clockwise from outside."""

    colour: str
    vertices: np.ndarray
    faces: np.ndarray


def ring(
    centre: Sequence[float] | np.ndarray, u: np.ndarray, v: np.ndarray, axes: tuple[float, float], exponent: float = 2.0
) -> np.ndarray:
    """Superellipse |s/a|^e + |t/b|^e = 1 with half axes a, b along u, v: (SIDES, 3). Exponent 2 is an ellipse."""
    a, b = axes
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    c, s = np.cos(angle), np.sin(angle)
    power = 2 / exponent
    return (
        np.asarray(centre)
        + np.outer(a * np.sign(c) * np.abs(c) ** power, u)
        + np.outer(b * np.sign(s) * np.abs(s) ** power, v)
    )


def loft(colour: str, rings: Sequence[np.ndarray]) -> Part:
    """Skin over rings of equally many points that advance along u x v, closed by a fan at each end."""
    n = len(rings[0])
    i, j = np.arange(n), (np.arange(n) + 1) % n
    faces = []
    for k in range(len(rings) - 1):
        low, high = k * n, (k + 1) * n
        faces += [np.c_[low + i, low + j, high + j], np.c_[low + i, high + j, high + i]]
    first, last = len(rings) * n, len(rings) * n + 1
    end = (len(rings) - 1) * n
    faces += [np.c_[j, i, np.full(n, first)], np.c_[end + i, end + j, np.full(n, last)]]
    ends = [rings[0].mean(axis=0), rings[-1].mean(axis=0)]
    return Part(colour, np.vstack([*rings, *ends]), np.vstack(faces))


def revolve(
    colour: str, axis: np.ndarray, profile: Iterable[tuple[float, float]], origin: Sequence[float] = (0, 0, 0)
) -> Part:
    """Surface of revolution about a coordinate axis; the profile lists (position on the axis, radius)."""
    u, v = np.roll(axis, 1), np.roll(axis, 2)
    return loft(colour, [ring(np.asarray(origin) + s * axis, u, v, (r, r)) for s, r in profile])


def stack(
    colour: str, axis: np.ndarray, sections: Iterable[tuple[float, float, float, float, float]], exponent: float
) -> Part:
    """Loft along a coordinate axis; a section is (position, min and max along u, min and max along v), u x v = axis."""
    u, v = np.roll(axis, 1), np.roll(axis, 2)
    return loft(
        colour,
        [
            ring(s * axis + (u0 + u1) / 2 * u + (v0 + v1) / 2 * v, u, v, ((u1 - u0) / 2, (v1 - v0) / 2), exponent)
            for s, u0, u1, v0, v1 in sections
        ],
    )


def pipe(colour: str, stations: Iterable[tuple[tuple[float, float, float], tuple[float, float, float], float]]) -> Part:
    """Round bent tube that starts along z; a station is (centre, direction of the tube, radius)."""
    rings = []
    for centre, direction, radius in stations:
        w = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
        # u follows from a fixed reference so that neighbouring rings do not twist against each other.
        u = np.cross(Y, w) if abs(w @ Y) < 0.9 else np.cross(w, Z)
        u /= np.linalg.norm(u)
        rings.append(ring(centre, u, np.cross(w, u), (radius, radius)))
    return loft(colour, rings)


def prism(colour: str, half_width: float, outline: Sequence[tuple[float, float]]) -> Part:
    """Convex outline of (y, z), counter-clockwise seen from +x, extruded to |x| <= half_width."""
    yz = np.asarray(outline)
    return loft(colour, [np.c_[np.full(len(yz), x), yz] for x in (-half_width, half_width)])


def link0() -> list[Part]:
    """Base: foot plate, body, joint ring with its lamps, and the connector panel."""
    foot = [
        (0, -0.152, 0.012, -0.094, 0.094),
        (0.009, -0.154, 0.012, -0.094, 0.094),
        (0.012, -0.150, 0.012, -0.090, 0.090),
    ]
    body = [
        (0.000, -0.140, 0.0715, -0.086, 0.086),
        (0.020, -0.136, 0.067, -0.084, 0.084),
        (0.045, -0.130, 0.062, -0.079, 0.079),
        (0.060, -0.124, 0.060, -0.076, 0.076),
        (0.075, -0.110, 0.058, -0.073, 0.073),
        (0.090, -0.090, 0.0575, -0.067, 0.067),
        (0.103, -0.070, 0.057, -0.060, 0.060),
        (0.112, -0.060, 0.057, -0.057, 0.057),
    ]
    return [
        stack("light", Z, foot, 5.0),
        stack("white", Z, body, 2.6),
        revolve("dark", Z, [(0.108, 0.0572), (0.1345, 0.0572), (0.1365, 0.056)]),
        revolve("white", Z, [(0.1345, 0.055), (0.140, 0.055)]),
        revolve("white", X, [(0.050, 0.011), (0.0585, 0.011), (0.0595, 0.009)], (0, 0, 0.123)),
        revolve("white", X, [(-0.067, 0.008), (-0.066, 0.011), (-0.050, 0.011)], (0, 0, 0.123)),
        prism("light", 0.022, [(-0.0875, 0.022), (0.0875, 0.022), (0.084, 0.056), (-0.084, 0.056)]),
        prism("dark", 0.012, [(-0.0885, 0.030), (0.0885, 0.030), (0.0865, 0.050), (-0.0865, 0.050)]),
    ]


def link1() -> list[Part]:
    """Shoulder elbow: an upright tube that bends into the drum of the next joint (also link 2, turned)."""
    stations = [
        ((0, 0, -0.1925), (0, 0, 1), 0.055),
        ((0, 0, -0.150), (0, 0, 1), 0.055),
        ((0, -0.002, -0.125), (0, -0.10, 1), 0.055),
        ((0, -0.010, -0.103), (0, -0.35, 1), 0.054),
        ((0, -0.025, -0.080), (0, -0.60, 1), 0.052),
        ((0, -0.042, -0.055), (0, -0.70, 1), 0.051),
        ((0, -0.058, -0.030), (0, -0.60, 1), 0.051),
        ((0, -0.070, 0.000), (0, -0.20, 1), 0.050),
    ]
    drum = [
        (-0.1292, 0.004), (-0.1275, 0.020), (-0.123, 0.031), (-0.116, 0.040), (-0.107, 0.0465),
        (-0.096, 0.050), (-0.083, 0.0525), (-0.066, 0.0545), (-0.050, 0.055), (-0.0005, 0.055),
    ]  # fmt: skip
    return [pipe("white", stations), revolve("white", Y, drum)]


def link3() -> list[Part]:
    """Elbow: a tube that bends sideways into the drum of the next joint, with a dark cap (also link 4, turned)."""
    stations = [
        ((0, 0, -0.1235), (0, 0, 1), 0.055),
        ((0, 0, -0.105), (0, 0, 1), 0.055),
        ((0.001, 0, -0.080), (0.05, 0, 1), 0.0535),
        ((0.006, 0.002, -0.058), (0.30, 0.1, 1), 0.052),
        ((0.018, 0.008, -0.038), (0.70, 0.3, 1), 0.049),
        ((0.036, 0.020, -0.022), (1, 0.5, 0.7), 0.045),
        ((0.060, 0.036, -0.010), (1, 0.5, 0.3), 0.040),
    ]
    centre = (0.0825, 0, 0)
    cap = [
        (0.052, 0.0558), (0.060, 0.0562), (0.070, 0.0555), (0.080, 0.0535),
        (0.088, 0.0505), (0.095, 0.046), (0.100, 0.0405), (0.102, 0.037),
    ]  # fmt: skip
    return [
        pipe("white", stations),
        revolve("white", Y, [(0.0005, 0.055), (0.054, 0.0545)], centre),
        revolve("dark", Y, cap, centre),
        revolve("white", Y, [(0.098, 0.037), (0.1035, 0.0365), (0.107, 0.030), (0.110, 0.018), (0.111, 0.004)], centre),
    ]


def link5() -> list[Part]:
    """Forearm: a wide foot that narrows to an offset blade and ends in the drum of the sixth joint."""
    arm = [
        (-0.2585, 0.055, -0.055, 0.055),
        (-0.238, 0.054, -0.054, 0.059),
        (-0.218, 0.052, -0.051, 0.068),
        (-0.198, 0.049, -0.043, 0.083),
        (-0.178, 0.043, -0.020, 0.090),
        (-0.158, 0.036, 0.026, 0.095),
        (-0.138, 0.032, 0.055, 0.100),
        (-0.118, 0.031, 0.065, 0.104),
        (-0.098, 0.031, 0.069, 0.107),
        (-0.078, 0.031, 0.072, 0.110),
        (-0.058, 0.032, 0.075, 0.114),
        (-0.038, 0.036, 0.077, 0.119),
        (-0.015, 0.040, 0.080, 0.122),
    ]
    # The dark cover runs along the outside of the blade, and a white inlay along the cover.
    cover = [(z, -a * 0.98, a * 0.98, (lo + hi) / 2 + 0.004, hi + 0.002) for z, a, lo, hi in arm[4:]]
    cover = [(-0.186, -0.030, 0.030, 0.055, 0.087), *cover]
    inlay = [(z, -0.55 * a, 0.55 * a, (lo + hi) / 2, hi + 0.0036) for z, a, lo, hi in arm[5:-2]]
    drum = [(0.016, 0.048), (0.072, 0.048), (0.080, 0.049)]
    cap = [(0.078, 0.0495), (0.095, 0.0508), (0.104, 0.0495), (0.112, 0.0455), (0.119, 0.0385), (0.122, 0.033)]
    return [
        stack("white", Z, [(z, -a, a, lo, hi) for z, a, lo, hi in arm], 2.4),
        stack("dark", Z, cover, 3.0),
        stack("white", Z, inlay, 3.5),
        revolve("white", Y, drum),
        revolve("dark", Y, cap),
        revolve("white", Y, [(0.119, 0.033), (0.1235, 0.0325), (0.128, 0.022), (0.130, 0.004)]),
    ]


def link6() -> list[Part]:
    """Wrist: a drum about the sixth joint with a dark cap, joined to the upright barrel of the seventh."""
    neck = [
        (-0.012, -0.046, 0.047, -0.0148, 0.046),
        (0.015, -0.044, 0.055, -0.015, 0.050),
        (0.030, -0.040, 0.064, -0.018, 0.050),
        (0.045, -0.040, 0.071, -0.024, 0.046),
        (0.060, -0.042, 0.074, -0.034, 0.041),
        (0.088, -0.040, 0.068, -0.038, 0.038),
    ]
    barrel = [
        (-0.051, 0.0435), (-0.038, 0.042), (-0.026, 0.0415), (-0.010, 0.043), (0.010, 0.044),
        (0.034, 0.0425), (0.058, 0.0395), (0.066, 0.0375),
    ]  # fmt: skip
    cap = [(0.064, 0.0375), (0.070, 0.0355), (0.076, 0.030), (0.080, 0.021), (0.081, 0.004)]
    return [
        stack("white", X, neck, 2.8),
        revolve("white", Z, [(-0.0148, 0.0475), (0.012, 0.048), (0.028, 0.047), (0.034, 0.045)]),
        revolve("dark", Z, [(0.026, 0.0482), (0.034, 0.0470), (0.042, 0.0430), (0.050, 0.0365), (0.0535, 0.031)]),
        revolve("white", Z, [(0.050, 0.031), (0.0548, 0.0305), (0.0563, 0.024), (0.0567, 0.004)]),
        revolve("white", Y, barrel, (0.088, 0, 0)),
        revolve("dark", Y, cap, (0.088, 0, 0)),
    ]


def link7() -> list[Part]:
    """Flange: a bare metal drum, the mounting face and the handle with the buttons at 45 degrees."""
    d, side = np.array([1.0, 1.0, 0]) / np.sqrt(2), np.array([-1.0, 1.0, 0]) / np.sqrt(2)

    def bar(colour: str, sections: Sequence[tuple[float, float, float, float]]) -> Part:
        """Loft along d; a section is (distance from the axis, half width, lowest z, highest z)."""
        return loft(
            colour, [ring(s * d + (lo + hi) / 2 * Z, side, Z, (a, (hi - lo) / 2), 6.0) for s, a, lo, hi in sections]
        )

    return [
        revolve("grey", Z, [(0.052, 0.0435), (0.054, 0.044), (0.097, 0.044), (0.0995, 0.042)]),
        revolve("grey", Z, [(0.0995, 0.0315), (0.107, 0.0315)]),
        bar("white", [(0.020, 0.029, 0.066, 0.096), (0.085, 0.029, 0.066, 0.097), (0.100, 0.028, 0.072, 0.097)]),
        bar("dark", [(0.099, 0.0275, 0.072, 0.0965), (0.109, 0.0265, 0.076, 0.096), (0.1145, 0.024, 0.080, 0.094)]),
        bar("dark", [(0.055, 0.016, 0.090, 0.0985), (0.092, 0.016, 0.090, 0.0985)]),
    ]


def hand() -> list[Part]:
    """Hand: mounting flange, rounded body with its slots, and the dark shoulder blocks."""
    body = [
        (-0.008, -0.0165, 0.0165, -0.087, 0.087),
        (-0.003, -0.0180, 0.0180, -0.093, 0.093),
        (0.015, -0.0195, 0.0195, -0.097, 0.097),
        (0.035, -0.0210, 0.0210, -0.0995, 0.0995),
        (0.054, -0.0200, 0.0200, -0.1005, 0.1005),
        (0.062, -0.0185, 0.0185, -0.100, 0.100),
        (0.066, -0.0160, 0.0160, -0.097, 0.097),
    ]
    shoulder = [
        (-0.009, -0.020, 0.020, 0.050, 0.080),
        (-0.006, -0.024, 0.024, 0.046, 0.086),
        (0.010, -0.0225, 0.0225, 0.046, 0.087),
    ]
    return [
        stack("white", Z, body, 7.0),
        revolve("grey", Z, [(-0.001, 0.0315), (0.009, 0.0315), (0.011, 0.030)]),
        stack("dark", Z, [(z, x0, x1, y0 - 0.128, y1 - 0.128) for z, x0, x1, y0, y1 in shoulder], 6.0),
        stack("dark", Z, shoulder, 6.0),
        prism("grey", 0.0213, [(-0.078, 0.034), (0.078, 0.034), (0.078, 0.050), (-0.078, 0.050)]),
        prism("dark", 0.0085, [(-0.084, 0.06), (0.084, 0.06), (0.084, 0.0663), (-0.084, 0.0663)]),
    ]


def finger() -> list[Part]:
    """Left finger: carriage, slanted strut, tip and rubber pad (the right one is the same, turned about z)."""
    return [
        prism("grey", 0.0100, [(0.0025, 0), (0.0263, 0), (0.0263, 0.004), (0.0025, 0.004)]),
        prism("light", 0.0104, [(0.0115, 0.004), (0.0255, 0.004), (0.0253, 0.019), (0.0115, 0.019)]),
        prism("light", 0.0100, [(0.0155, 0.019), (0.0253, 0.019), (0.0150, 0.038), (0.0090, 0.036), (0.0090, 0.033)]),
        prism("light", 0.0089, [(0.0090, 0.035), (0.0150, 0.037), (0.0145, 0.053), (0.0090, 0.053)]),
        prism("dark", 0.0088, [(0, 0.0365), (0.0092, 0.0365), (0.0092, 0.0535), (0, 0.0535)]),
    ]


def corner_normals(part: Part) -> np.ndarray:
    """Unit normals (m, 3, 3) of the face corners: the mean over adjacent faces within the crease angle."""
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    scaled = np.cross(b - a, c - a)
    flat = scaled / np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), 1e-15)
    around: dict[int, list[int]] = {}
    for face, corners in enumerate(part.faces):
        for vertex in corners:
            around.setdefault(int(vertex), []).append(face)
    normals = np.empty((len(part.faces), 3, 3))
    for face, corners in enumerate(part.faces):
        for k, vertex in enumerate(corners):
            near = np.array(around[int(vertex)])
            total = scaled[near[flat[near] @ flat[face] > CREASE]].sum(axis=0)
            length = np.linalg.norm(total)
            normals[face, k] = total / length if length > 0 else flat[face]
    return normals


def obj_text(parts: Sequence[Part]) -> str:
    """Wavefront OBJ of the parts; equal positions and normals are written once."""
    lines = ["# Written by generate.py.", "mtllib panda.mtl"]
    positions: dict[str, int] = {}
    directions: dict[str, int] = {}
    for part in parts:
        corners = []
        for face, normals in zip(part.faces, corner_normals(part), strict=True):
            corner = []
            for vertex, normal in zip(part.vertices[face], normals, strict=True):
                p = " ".join(f"{x + 0.0:.5g}" for x in vertex.round(5))
                n = " ".join(f"{x + 0.0:.3g}" for x in normal.round(2))
                corner.append(
                    (positions.setdefault(p, len(positions) + 1), directions.setdefault(n, len(directions) + 1))
                )
            if len({p for p, _ in corner}) == 3:
                corners.append("f " + " ".join(f"{p}//{n}" for p, n in corner))
        lines += [f"usemtl {part.colour}", *corners]
    head = [f"v {p}" for p in positions] + [f"vn {n}" for n in directions]
    return "\n".join(lines[:2] + head + lines[2:]) + "\n"


def main() -> None:
    """Write panda.mtl and one .obj per mesh beside this file."""
    folder = Path(__file__).parent
    materials = [
        f"newmtl {name}\nKd {r} {g} {b}\nKa 0 0 0\nKs 0.1 0.1 0.1\nNs 20\n" for name, (r, g, b) in COLOURS.items()
    ]
    (folder / "panda.mtl").write_text("\n".join(materials))
    for build in (link0, link1, link3, link5, link6, link7, hand, finger):
        (folder / f"{build.__name__}.obj").write_text(obj_text(build()))


if __name__ == "__main__":
    main()
