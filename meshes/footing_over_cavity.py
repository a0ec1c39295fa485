# SPDX-License-Identifier: LGPL-3.0-or-later
"""A footing on the ground above a lens-shaped cavity, symmetric node by node."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import cache
from math import hypot, sqrt
from typing import Any

from mpi4py import MPI

from fenicsx_hmcontact.domain import Domain, check_sizes

_MIRROR = [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def footing_over_cavity(
    comm: MPI.Comm,
    *,
    h: float = 0.15,
    h_corner: float | None = None,
    growth: float = 0.1,
    ratio: float = 0.8,
    matching: bool = False,
    half: bool = False,
    half_width: float = 1.0,
    height: float = 1.5,
    width: float = 12.0,
    depth: float = 6.0,
    cavity_half_width: float = 1.0,
    cavity_depth: float = 2.0,
    cavity_radius: float = 5.0,
    out: str | None = None,
) -> Domain:
    """Mesh a footing that stands on y = 0, and the soil below with a cavity under the footing.

    The lower face of the cavity is flat, the upper one an arc; they share the nodes at its tips and
    no others. The left half is the mirror image of the right one.

    Bodies "soil" and "footing"; surfaces "ground" (all the top of the soil), "footing_base",
    "footing_left", "footing_right", "footing_top", "cavity_upper", "cavity_lower", "left", "right"
    and "bottom", of the half also "axis" (of both bodies). Collective.

    Args:
        comm: Communicator.
        h: Edges of the soil between footing and cavity [m]; rounded on the faces of the cavity so
            that they fit.
        h_corner: Edges at the corners of the footing [m]; ``h`` where None.
        growth: By how much edges grow per distance from there.
        ratio: Edges of the footing and of the upper face of the cavity relative to those of the
            ground and the lower face.
        matching: Whether nodes of facing surfaces are at the same x, as if ``ratio`` were one.
        half: Mesh the half x > 0 only.
        half_width: Half width of the footing [m].
        height: Height of the footing [m].
        width: Width of the whole soil [m].
        depth: Depth of the soil [m].
        cavity_half_width: Half width of the cavity [m].
        cavity_depth: Depth of its lower face [m].
        cavity_radius: Radius of its upper face [m].
        out: File (.msh) to write the mesh to as well.

    Raises:
        ValueError: If a length or ratio is not positive, growth negative, h_corner above h, the
            footing as wide as the soil, or the cavity not within the soil.
    """
    corner = h if h_corner is None else h_corner
    check_sizes(
        h,
        {"h_corner": corner},
        growth,
        ratio=ratio,
        half_width=half_width,
        height=height,
        width=width,
        depth=depth,
        cavity_half_width=cavity_half_width,
        cavity_depth=cavity_depth,
        cavity_radius=cavity_radius,
    )
    side = 0.5 * width
    if not half_width < side:
        raise ValueError(f"half_width must be below half the width, it is {half_width}.")
    if not cavity_half_width < min(side, cavity_radius):
        raise ValueError(
            "cavity_half_width must be below half the width and cavity_radius, it is "
            f"{cavity_half_width}."
        )
    springing = sqrt(cavity_radius**2 - cavity_half_width**2)
    if not cavity_radius - springing < cavity_depth < depth:
        raise ValueError(f"cavity_depth must keep the cavity in the soil, it is {cavity_depth}.")

    facing = 1.0 if matching else ratio
    reach = max(half_width, cavity_half_width)

    def edge(body: str, x: float, y: float) -> float:
        away = hypot(max(abs(x) - reach, 0.0), max(y, -cavity_depth - y, 0.0))
        from_corner = hypot(abs(x) - half_width, y)
        smallest = min(h + growth * away, corner + growth * from_corner)
        return facing * smallest if body == "footing" else smallest

    tip = edge("soil", cavity_half_width, -cavity_depth)
    lower, upper = (max(round(cavity_half_width / (tip * k)), 1) for k in (1.0, facing))
    floor = [(cavity_half_width * i / lower, -cavity_depth) for i in range(lower, 0, -1)]
    across = [cavity_half_width * i / upper for i in range(upper)]
    roof = [(x, sqrt(cavity_radius**2 - x * x) - springing - cavity_depth) for x in across]
    # Each surface begins at its point, counterclockwise around the right half of the body.
    outlines = {
        "soil": [
            ("axis", (0.0, 0.0)),
            *(("cavity_upper", place) for place in roof),
            *(("cavity_lower", place) for place in floor),
            ("axis", (0.0, -cavity_depth)),
            ("bottom", (0.0, -depth)),
            ("right", (side, -depth)),
            ("ground", (side, 0.0)),
            ("ground", (half_width, 0.0)),
        ],
        "footing": [
            ("footing_base", (0.0, 0.0)),
            ("footing_right", (half_width, 0.0)),
            ("footing_top", (half_width, height)),
            ("axis", (0.0, height)),
        ],
    }
    opposite = {"right": "left", "footing_right": "footing_left"}

    def draw(gmsh: Any) -> None:
        geo = gmsh.model.geo
        surfaces: dict[str, list[int]] = {}
        halves: dict[str, list[int]] = {}
        body_of: dict[tuple[int, int], str] = {}
        for body, outline in outlines.items():
            # Both halves share what lies on the axis.
            point = cache(lambda x, y: geo.addPoint(x, y, 0.0))
            line = cache(lambda start, end, point=point: geo.addLine(point(*start), point(*end)))
            halves[body] = []
            for sign in (1.0,) if half else (1.0, -1.0):
                ends = [(sign * x, y) for _, (x, y) in outline]
                # Lines of both bodies run the same way, so that gmsh divides them alike.
                pairs = map(sorted, zip(ends, ends[1:] + ends[:1], strict=True))
                loop = [line(*pair) for pair in pairs]
                tag = geo.addPlaneSurface([geo.addCurveLoop(loop, reorient=True)])
                halves[body].append(tag)
                body_of |= {(2, tag): body} | {(1, curve): body for curve in loop}
                for (name, _), curve in zip(outline, loop, strict=True):
                    own = opposite.get(name, name) if sign < 0.0 else name
                    surfaces.setdefault(own, []).append(curve)
        if not half:
            del surfaces["axis"]
        for name in ("cavity_upper", "cavity_lower"):
            for curve in surfaces[name]:
                geo.mesh.setTransfiniteCurve(curve, 2)
        geo.synchronize()
        for body, tags in halves.items():
            gmsh.model.addPhysicalGroup(2, tags, name=body)
        for name, curves in surfaces.items():
            gmsh.model.addPhysicalGroup(1, curves, name=name)

        def size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
            return edge(body_of[dim, tag], x, y) if (dim, tag) in body_of else lc

        if not half:
            originals, copies = zip(*halves.values(), strict=True)
            gmsh.model.mesh.setPeriodic(2, copies, originals, _MIRROR)
        gmsh.model.mesh.setSizeCallback(size)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.removeSizeCallback()
        if not half:
            _mirror_nodes(gmsh, copies)
        if out:
            gmsh.write(out)

    return Domain.generate(draw, comm, name="footing_over_cavity")


def _mirror_nodes(gmsh: Any, copies: Sequence[int]) -> None:
    """Put the nodes of copied surfaces where the mirror has them, and turn their cells round."""
    for copy in copies:
        _, nodes, originals, _ = gmsh.model.mesh.getPeriodicNodes(2, copy)
        for node, original in zip(nodes, originals, strict=True):
            x, y, _ = gmsh.model.mesh.getNode(original)[0]
            gmsh.model.mesh.setNode(node, [-x if node != original else 0.0, y, 0.0], [])
    gmsh.model.mesh.reverse([(2, copy) for copy in copies])


def main() -> None:
    """Write the mesh to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--h", type=float, default=0.15, help="edges down to the cavity [m]")
    parser.add_argument("--h-corner", type=float, help="edges at the footing's corners [m]")
    parser.add_argument("--growth", type=float, default=0.1, help="of edges per distance")
    parser.add_argument("--ratio", type=float, default=0.8, help="edges of facing surfaces")
    parser.add_argument("--matching", action="store_true", help="facing nodes at the same x")
    parser.add_argument("--half", action="store_true", help="mesh the half x > 0 only")
    parser.add_argument("--half-width", type=float, default=1.0, help="of the footing [m]")
    parser.add_argument("--height", type=float, default=1.5, help="of the footing [m]")
    parser.add_argument("--width", type=float, default=12.0, help="of the whole soil [m]")
    parser.add_argument("--depth", type=float, default=6.0, help="of the soil [m]")
    parser.add_argument("--cavity-half-width", type=float, default=1.0, help="of the cavity [m]")
    parser.add_argument("--cavity-depth", type=float, default=2.0, help="of its lower face [m]")
    parser.add_argument("--cavity-radius", type=float, default=5.0, help="of its upper face [m]")
    parser.add_argument("--out", default="footing_over_cavity.msh", help="file to write (.msh)")
    footing_over_cavity(MPI.COMM_WORLD, **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
