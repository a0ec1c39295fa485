# SPDX-License-Identifier: LGPL-3.0-or-later
"""Half disc that touches a block in one point, for Hertz contact."""

from __future__ import annotations

import argparse
from math import cos, hypot, sin
from typing import Any

from mpi4py import MPI

from fenicsx_hmcontact.domain import Domain

FINE = 1.5
"""Cells are fine, and surfaces in contact, up to this multiple of the half width."""


def hertz(
    comm: MPI.Comm,
    *,
    radius: float = 8.0,
    half_width: float = 0.4,
    disc_size: float = 0.04,
    plane_size: float = 0.05,
    growth: float = 0.1,
    out: str | None = None,
) -> Domain:
    """Mesh the lower half of a disc around (0, radius) on a block of its size below y = 0.

    Bodies "disc" and "block"; surfaces "disc_contact" and "plane_contact" around the origin, where
    each has a node, "top" of the disc and "bottom" of the block. Nodes of the disc lie on its axis
    x = 0. Collective.

    Args:
        comm: Communicator.
        radius: Radius of the disc [m].
        half_width: Half width of the contact to resolve [m].
        disc_size: Edges of the disc near the contact [m].
        plane_size: Edges of the block near the contact [m].
        growth: By how much edges grow per distance from there.
        out: File (.msh) to write the mesh to as well.

    Raises:
        ValueError: If a value is not positive, half_width not below a third of the radius, or an
            edge longer than half_width.
    """
    sizes = dict(disc_size=disc_size, plane_size=plane_size)
    for name, value in dict(radius=radius, half_width=half_width, growth=growth, **sizes).items():
        if not value > 0.0:
            raise ValueError(f"{name} must be positive, it is {value}.")
    if not half_width < radius / 3.0:
        raise ValueError(f"half_width must be below a third of the radius, it is {half_width}.")
    for name, value in sizes.items():
        if not value <= half_width:
            raise ValueError(f"{name} must be at most half_width, it is {value}.")
    fine = FINE * half_width

    def size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
        smallest = disc_size if y > 0.0 else plane_size
        return smallest + growth * max(hypot(x, y) - fine, 0.0)

    def draw(gmsh: Any) -> None:
        geo = gmsh.model.geo
        centre, lowest = geo.addPoint(0.0, radius, 0.0), geo.addPoint(0.0, 0.0, 0.0)
        axis = geo.addLine(lowest, centre)
        angle = fine / radius
        halves, arcs, tops = [], [], []
        for side in (-1, 1):
            end = geo.addPoint(side * radius * sin(angle), radius * (1.0 - cos(angle)), 0.0)
            rim = geo.addPoint(side * radius, radius, 0.0)
            arcs.append(geo.addCircleArc(lowest, centre, end))
            outer = geo.addCircleArc(end, centre, rim)
            tops.append(geo.addLine(rim, centre))
            loop = [arcs[-1], outer, tops[-1], -axis]
            # Counterclockwise on either side.
            around = [side * curve for curve in loop[::side]]
            halves.append(geo.addPlaneSurface([geo.addCurveLoop(around)]))

        places = [(-radius, 0.0), (-fine, 0.0), (0.0, 0.0), (fine, 0.0), (radius, 0.0)]
        corners = [geo.addPoint(x, y, 0.0) for x, y in places]
        corners += [geo.addPoint(x, -radius, 0.0) for x in (radius, -radius)]
        sides = [geo.addLine(corners[i - 1], corners[i]) for i in range(1, 7)]
        sides.append(geo.addLine(corners[-1], corners[0]))
        block = geo.addPlaneSurface([geo.addCurveLoop(sides)])

        surfaces = {
            "disc_contact": arcs,
            "plane_contact": sides[1:3],
            "top": tops,
            "bottom": [sides[5]],
        }
        for name, edge in (("disc_contact", disc_size), ("plane_contact", plane_size)):
            for curve in surfaces[name]:
                geo.mesh.setTransfiniteCurve(curve, max(round(fine / edge), 1) + 1)
        geo.synchronize()
        gmsh.model.addPhysicalGroup(2, halves, name="disc")
        gmsh.model.addPhysicalGroup(2, [block], name="block")
        for name, curves in surfaces.items():
            gmsh.model.addPhysicalGroup(1, curves, name=name)
        gmsh.model.mesh.setSizeCallback(size)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.removeSizeCallback()
        if out:
            gmsh.write(out)

    return Domain.generate(draw, comm, name="hertz")


def main() -> None:
    """Write the mesh to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--radius", type=float, default=8.0, help="radius of the disc [m]")
    parser.add_argument("--half-width", type=float, default=0.4, help="of the contact [m]")
    parser.add_argument("--disc-size", type=float, default=0.04, help="fine edges, disc [m]")
    parser.add_argument("--plane-size", type=float, default=0.05, help="fine edges, block [m]")
    parser.add_argument("--growth", type=float, default=0.1, help="of edges per distance")
    parser.add_argument("--out", default="hertz.msh", help="file to write (.msh)")
    hertz(MPI.COMM_WORLD, **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
