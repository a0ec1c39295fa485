# SPDX-License-Identifier: LGPL-3.0-or-later
"""Half of the ground under a strip footing, with a node exactly at the edge of the footing."""

from __future__ import annotations

import argparse
from math import hypot
from typing import Any

from mpi4py import MPI

from fenicsx_hmcontact.domain import Domain

_DELAUNAY = 5


def strip_footing(
    comm: MPI.Comm,
    *,
    h: float = 0.25,
    half_width: float = 1.0,
    width: float = 5.0,
    depth: float = 5.0,
    growth: float = 0.0,
    out: str | None = None,
) -> Domain:
    """Mesh the ground below y = 0 and right of the axis x = 0 by Delaunay triangles.

    Body "ground"; surfaces "base" of the footing from the axis to its edge, "surface" beyond,
    "axis", "bottom" and "side". The same options give the same mesh. Collective.

    Args:
        comm: Communicator.
        h: Edges under the footing [m]; rounded so that they fit it.
        half_width: Half width of the footing [m].
        width: Width of the ground [m].
        depth: Depth of the ground [m].
        growth: By how much edges grow per distance from the base of the footing.
        out: File (.msh) to write the mesh to as well.

    Raises:
        ValueError: If a length is not positive, growth negative, or half_width not below width.
    """
    lengths = dict(h=h, half_width=half_width, width=width, depth=depth)
    for name, value in lengths.items():
        if not value > 0.0:
            raise ValueError(f"{name} must be positive, it is {value}.")
    if not growth >= 0.0:
        raise ValueError(f"growth must be zero or positive, it is {growth}.")
    if not half_width < width:
        raise ValueError(f"half_width must be below width, it is {half_width}.")
    edge = half_width / base_edges(h, half_width)

    def size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
        return edge + growth * hypot(max(x - half_width, 0.0), y)

    def draw(gmsh: Any) -> None:
        geo = gmsh.model.geo
        corners = [(0.0, -depth), (width, -depth), (width, 0.0), (half_width, 0.0), (0.0, 0.0)]
        points = [geo.addPoint(x, y, 0.0) for x, y in corners]
        lines = [geo.addLine(points[i], points[(i + 1) % 5]) for i in range(5)]
        ground = geo.addPlaneSurface([geo.addCurveLoop(lines)])
        names = ["bottom", "side", "surface", "base", "axis"]
        geo.mesh.setTransfiniteCurve(lines[3], base_edges(h, half_width) + 1)
        geo.mesh.setAlgorithm(2, ground, _DELAUNAY)
        geo.synchronize()
        gmsh.model.addPhysicalGroup(2, [ground], name="ground")
        for name, line in zip(names, lines, strict=True):
            gmsh.model.addPhysicalGroup(1, [line], name=name)
        gmsh.model.mesh.setSizeCallback(size)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.removeSizeCallback()
        if out:
            gmsh.write(out)

    return Domain.generate(draw, comm, name="strip_footing")


def base_edges(h: float, half_width: float) -> int:
    """Number of edges under half the footing.

    Args:
        h: Wanted length [m].
        half_width: Half width of the footing [m].
    """
    return max(round(half_width / h), 1)


def main() -> None:
    """Write the mesh to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--h", type=float, default=0.25, help="edges under the footing [m]")
    parser.add_argument("--half-width", type=float, default=1.0, help="of the footing [m]")
    parser.add_argument("--width", type=float, default=5.0, help="of the ground [m]")
    parser.add_argument("--depth", type=float, default=5.0, help="of the ground [m]")
    parser.add_argument("--growth", type=float, default=0.0, help="of edges per distance")
    parser.add_argument("--out", default="strip_footing.msh", help="file to write (.msh)")
    strip_footing(MPI.COMM_WORLD, **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
