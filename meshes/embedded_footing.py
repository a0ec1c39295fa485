# SPDX-License-Identifier: LGPL-3.0-or-later
"""A footing in a notch of the ground, its top flush with the ground, fine at the base corner."""

from __future__ import annotations

import argparse
from math import hypot
from typing import Any

from mpi4py import MPI

from fenicsx_hmcontact.domain import Domain, check_sizes


def embedded_footing(
    comm: MPI.Comm,
    *,
    h: float = 0.5,
    h_corner: float = 0.05,
    growth: float = 0.15,
    ratio: float = 0.8,
    full: bool = False,
    half_width: float = 1.0,
    height: float = 1.0,
    chamfer: float = 0.05,
    width: float = 12.0,
    depth: float = 6.0,
    out: str | None = None,
) -> Domain:
    """Mesh the half x > 0 of a footing and of the soil that it touches below and at its side.

    The edge between the footing's base and side may be chamfered, as that of cast concrete is.

    Bodies "soil" and "footing"; surfaces "footing_face" (base, chamfer and side) in "notch",
    "footing_top", "ground", "bottom", "side", and on the axis x = 0 "footing_axis" and "soil_axis".
    The full mesh has no axis, and each surface on both sides of it. Collective.

    Args:
        comm: Communicator.
        h: Longest edges of the soil [m].
        h_corner: Its edges at the corner of the notch's base [m].
        growth: By how much edges grow per distance from there.
        ratio: Edges of the footing relative to those of the soil; at one the nodes of both match.
        full: Mesh the other half too.
        half_width: Half width of the footing [m].
        height: Height of the footing [m].
        chamfer: What the chamfer takes off base and side [m]; 0 for a sharp edge.
        width: Width of the whole soil [m].
        depth: Depth of the soil [m].
        out: File (.msh) to write the mesh to as well.

    Raises:
        ValueError: If a length or ratio is not positive, growth or chamfer negative, h_corner above
            h, the footing not within the soil, or the chamfer not within the footing.
    """
    check_sizes(
        h,
        {"h_corner": h_corner},
        growth,
        ratio=ratio,
        half_width=half_width,
        height=height,
        width=width,
        depth=depth,
    )
    side = 0.5 * width
    if not half_width < side:
        raise ValueError(f"half_width must be below half the width, it is {half_width}.")
    if not height < depth:
        raise ValueError(f"height must be below the depth, it is {height}.")
    if not 0.0 <= chamfer < min(half_width, height):
        raise ValueError(f"chamfer must lie within the footing, it is {chamfer}.")
    base = [(half_width, chamfer - height), (half_width - chamfer, -height), (0.0, -height)]
    base = base if chamfer else base[1:]
    faces = len(base)

    def edge(body: str, x: float, y: float) -> float:
        longest = min(h, h_corner + growth * hypot(abs(x) - half_width, y + height))
        return ratio * longest if body == "footing" else longest

    # The right half of each body, counterclockwise from axis to axis, and its surfaces.
    outlines = {
        "soil": (
            [
                (0.0, -depth),
                (side, -depth),
                (side, 0.0),
                (half_width, 0.0),
                *base,
            ],
            ["bottom", "side", "ground", *["notch"] * faces],
        ),
        "footing": (
            [*base[::-1], (half_width, 0.0), (0.0, 0.0)],
            [*["footing_face"] * faces, "footing_top"],
        ),
    }

    def draw(gmsh: Any) -> None:
        geo = gmsh.model.geo
        surfaces: dict[str, list[int]] = {}
        body_of: dict[tuple[int, int], str] = {}
        for body, (places, names) in outlines.items():
            if full:
                places = places + [(-x, y) for x, y in places[-2:0:-1]]
                names = names + names[::-1]
            else:
                names = [*names, f"{body}_axis"]
            points = {place: geo.addPoint(*place, 0.0) for place in places}
            # Lines of both bodies run the same way, so that gmsh divides them alike.
            pairs = map(sorted, zip(places, places[1:] + places[:1], strict=True))
            lines = [geo.addLine(points[start], points[end]) for start, end in pairs]
            tag = geo.addPlaneSurface([geo.addCurveLoop(lines, reorient=True)])
            body_of |= {(2, tag): body} | {(1, line): body for line in lines}
            for name, line in zip(names, lines, strict=True):
                surfaces.setdefault(name, []).append(line)
        geo.synchronize()
        for (dim, tag), body in body_of.items():
            if dim == 2:
                gmsh.model.addPhysicalGroup(2, [tag], name=body)
        for name, lines in surfaces.items():
            gmsh.model.addPhysicalGroup(1, lines, name=name)

        def size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
            return edge(body_of[dim, tag], x, y) if (dim, tag) in body_of else lc

        gmsh.model.mesh.setSizeCallback(size)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.removeSizeCallback()
        if out:
            gmsh.write(out)

    return Domain.generate(draw, comm, name="embedded_footing")


def main() -> None:
    """Write the mesh to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--h", type=float, default=0.5, help="longest edges [m]")
    parser.add_argument("--h-corner", type=float, default=0.05, help="at the base corner [m]")
    parser.add_argument("--growth", type=float, default=0.15, help="of edges per distance")
    parser.add_argument("--ratio", type=float, default=0.8, help="edges of footing to soil")
    parser.add_argument("--full", action="store_true", help="mesh both halves")
    parser.add_argument("--half-width", type=float, default=1.0, help="of the footing [m]")
    parser.add_argument("--height", type=float, default=1.0, help="of the footing [m]")
    parser.add_argument("--chamfer", type=float, default=0.05, help="of its edge [m]")
    parser.add_argument("--width", type=float, default=12.0, help="of the whole soil [m]")
    parser.add_argument("--depth", type=float, default=6.0, help="of the soil [m]")
    parser.add_argument("--out", default="embedded_footing.msh", help="file to write (.msh)")
    embedded_footing(MPI.COMM_WORLD, **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
