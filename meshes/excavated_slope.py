# SPDX-License-Identifier: LGPL-3.0-or-later
"""A block of soil with a slope to be excavated and an inclined geological interface below it."""

from __future__ import annotations

import argparse
from math import hypot, radians, tan
from typing import Any

from mpi4py import MPI

from fenicsx_hmcontact.domain import Domain, check_sizes

Place = tuple[float, float]


def excavated_slope(
    comm: MPI.Comm,
    *,
    h: float = 2.0,
    h_fine: float = 1.0,
    growth: float = 0.1,
    ratio: float = 0.8,
    interface: bool = True,
    width: float = 125.0,
    height: float = 50.0,
    crest: float = 54.5,
    slope_height: float = 16.0,
    slope_angle: float = 45.0,
    cut_start: float = 35.0,
    cut_end: float = 75.5,
    cut_angle: float = 30.0,
    out: str | None = None,
) -> Domain:
    """Mesh the block (0, width) x (0, height) whose upper right part can be taken out.

    The interface is a cut from the ground down to a tip inside the soil. Its faces share the node
    at the tip and no others; the ground has a node of either at the start.

    Body "soil" of the layers "ground" and "excavated", whose common nodes lie on the slope and on
    the floor of the excavation; surfaces "cut_upper", "cut_lower", "surface" (top of the ground,
    on both sides of the cut), "excavated_surface", "bottom", "left" and "right". Collective.

    Args:
        comm: Communicator.
        h: Longest edges [m].
        h_fine: Edges on the slope and on the lower face of the cut [m].
        growth: By how much edges grow per distance from there.
        ratio: Edges of the upper face relative to those of the lower; at one their nodes match.
        interface: Whether there is the cut; edges are short near its place in any case.
        width: Width of the block [m].
        height: Its height [m].
        crest: Distance of the crest from the left side [m].
        slope_height: Height of the slope [m].
        slope_angle: Inclination of the slope [degrees].
        cut_start: Distance of the start of the cut from the left side [m].
        cut_end: Distance of its tip from the left side [m].
        cut_angle: Inclination of the cut [degrees].
        out: File (.msh) to write the mesh to as well.

    Raises:
        ValueError: If a length or ratio is not positive, growth negative, h_fine above h, or slope
            or cut leave the block or meet.
    """
    check_sizes(
        h,
        {"h_fine": h_fine},
        growth,
        ratio=ratio,
        width=width,
        height=height,
        crest=crest,
        slope_height=slope_height,
        cut_start=cut_start,
    )
    for name, angle in dict(slope_angle=slope_angle, cut_angle=cut_angle).items():
        if not 0.0 < angle < 90.0:
            raise ValueError(f"{name} must be between 0 and 90 degrees, it is {angle}.")
    floor = height - slope_height
    if not floor > 0.0:
        raise ValueError(f"slope_height must be below the height, it is {slope_height}.")
    toe = crest + slope_height / tan(radians(slope_angle))
    if not toe < width:
        raise ValueError(f"crest must keep the toe at {toe:g} in the block, it is {crest}.")
    if not cut_start < crest:
        raise ValueError(f"cut_start must be left of the crest, it is {cut_start}.")
    if not cut_start < cut_end < width:
        raise ValueError(f"cut_end must be between cut_start and width, it is {cut_end}.")

    def cut(x: float) -> float:
        return height - (x - cut_start) * tan(radians(cut_angle))

    tip = (cut_end, cut(cut_end))
    ground = max(floor, height - max(cut_end - crest, 0.0) * tan(radians(slope_angle)))
    if not (0.0 < tip[1] < ground and (cut_end < toe or cut(toe) < floor)):
        raise ValueError(
            f"cut_angle must keep the cut below the slope and above the bottom, it is {cut_angle}."
        )

    places = {
        "bottom left": (0.0, 0.0),
        "below tip": (cut_end, 0.0),
        "bottom right": (width, 0.0),
        "floor right": (width, floor),
        "toe": (toe, floor),
        "crest": (crest, height),
        "top left": (0.0, height),
        "top right": (width, height),
        "start lower": (cut_start, height),
        "start upper": (cut_start, height),
        "tip": tip,
    }
    # Each surface begins at its point, counterclockwise around its part; some lines are inside.
    excavated = {
        "toe": "",
        "floor right": "right",
        "top right": "excavated_surface",
        "crest": "",
    }
    right = {"bottom right": "right", "floor right": "", "toe": "", "crest": "surface"}
    left = {"top left": "left", "bottom left": "bottom"}
    if interface:
        # Two parts, tied below the tip, so that no mesh lies on both faces of the cut.
        above = {"below tip": "bottom", **right, "start upper": "cut_upper", "tip": ""}
        below = {**left, "below tip": "", "tip": "cut_lower", "start lower": "surface"}
        layers = {"ground": [above, below], "excavated": [excavated]}
    else:
        layers = {"ground": [right | left], "excavated": [excavated]}

    def draw(gmsh: Any) -> None:
        geo = gmsh.model.geo
        used = {name for outlines in layers.values() for outline in outlines for name in outline}
        points = {name: geo.addPoint(*places[name], 0.0) for name in sorted(used)}
        lines: dict[tuple[str, ...], int] = {}
        surfaces: dict[str, list[int]] = {}
        groups: dict[str, list[int]] = {layer: [] for layer in layers}
        for layer, outlines in layers.items():
            for outline in outlines:
                starts = list(outline)
                loop = []
                for start, end in zip(starts, starts[1:] + starts[:1], strict=True):
                    # Parts share their lines, and both faces of the cut run the same way.
                    pair = tuple(sorted((start, end)))
                    if pair not in lines:
                        lines[pair] = geo.addLine(*(points[name] for name in pair))
                    loop.append(lines[pair] if pair[0] == start else -lines[pair])
                    if outline[start]:
                        surfaces.setdefault(outline[start], []).append(lines[pair])
                groups[layer].append(geo.addPlaneSurface([geo.addCurveLoop(loop)]))
        geo.synchronize()
        for layer, tags in groups.items():
            gmsh.model.addPhysicalGroup(2, tags, name=layer)
        for name, curves in surfaces.items():
            gmsh.model.addPhysicalGroup(1, curves, name=name)

        def size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
            away = min(
                _distance((x, y), places["crest"], places["toe"]),
                _distance((x, y), places["start lower"], tip),
            )
            edge = min(h, h_fine + growth * away)
            return ratio * edge if dim == 1 and [tag] == surfaces.get("cut_upper") else edge

        gmsh.model.mesh.setSizeCallback(size)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.removeSizeCallback()
        if out:
            gmsh.write(out)

    return Domain.generate(draw, comm, name="excavated_slope", layers={"soil": list(layers)})


def _distance(place: Place, start: Place, end: Place) -> float:
    """Distance of a place from the line between two others."""
    along, across = end[0] - start[0], end[1] - start[1]
    x, y = place[0] - start[0], place[1] - start[1]
    part = min(max((x * along + y * across) / (along**2 + across**2), 0.0), 1.0)
    return hypot(x - part * along, y - part * across)


def main() -> None:
    """Write the mesh to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--h", type=float, default=2.0, help="longest edges [m]")
    parser.add_argument("--h-fine", type=float, default=1.0, help="at slope and cut [m]")
    parser.add_argument("--growth", type=float, default=0.1, help="of edges per distance")
    parser.add_argument("--ratio", type=float, default=0.8, help="edges of the upper face to lower")
    parser.add_argument("--no-interface", dest="interface", action="store_false", help="no cut")
    parser.add_argument("--width", type=float, default=125.0, help="of the block [m]")
    parser.add_argument("--height", type=float, default=50.0, help="of the block [m]")
    parser.add_argument("--crest", type=float, default=54.5, help="distance from the left [m]")
    parser.add_argument("--slope-height", type=float, default=16.0, help="of the slope [m]")
    parser.add_argument("--slope-angle", type=float, default=45.0, help="of the slope [degrees]")
    parser.add_argument("--cut-start", type=float, default=35.0, help="from the left [m]")
    parser.add_argument("--cut-end", type=float, default=75.5, help="from the left [m]")
    parser.add_argument("--cut-angle", type=float, default=30.0, help="of the cut [degrees]")
    parser.add_argument("--out", default="excavated_slope.msh", help="file to write (.msh)")
    excavated_slope(MPI.COMM_WORLD, **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
