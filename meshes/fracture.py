# SPDX-License-Identifier: LGPL-3.0-or-later
"""A square of two halves that are bonded but for a straight crack in the middle."""

from __future__ import annotations

import argparse
from math import hypot
from typing import Any

from mpi4py import MPI

from fenicsx_hmcontact.domain import Domain


def fracture(
    comm: MPI.Comm,
    *,
    length: float = 2.0,
    size: float = 8.0,
    upper: int = 32,
    lower: int = 24,
    growth: float = 0.2,
    out: str | None = None,
) -> Domain:
    """Mesh the square (-size/2, size/2)^2 as an upper and a lower half that meet at y = 0.

    Bodies "upper" and "lower"; surfaces "crack_upper" and "crack_lower" for |x| < length/2,
    "bond_upper" and "bond_lower" beyond, and "outside_upper" and "outside_lower". Collective.

    Args:
        comm: Communicator.
        length: Length of the crack [m].
        size: Side of the square [m].
        upper: Edges of the upper half on the crack.
        lower: Edges of the lower half on the crack.
        growth: By how much edges grow per distance from the crack.
        out: File (.msh) to write the mesh to as well.

    Raises:
        ValueError: If a value is not positive, or the crack as long as the square.
    """
    values = dict(length=length, size=size, upper=upper, lower=lower, growth=growth)
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"{name} must be positive, it is {value}.")
    if not length < size:
        raise ValueError(f"length must be below the size {size:g}, it is {length}.")
    a, s = 0.5 * length, 0.5 * size
    edges = {"upper": upper, "lower": lower}

    def draw(gmsh: Any) -> None:
        geo = gmsh.model.geo
        surfaces: dict[str, list[int]] = {}
        groups: dict[str, int] = {}
        body_of: dict[tuple[int, int], str] = {}
        for body, sign in (("upper", 1), ("lower", -1)):
            # Around the body, anticlockwise.
            places = [(-s, 0.0), (-a, 0.0), (a, 0.0), (s, 0.0), (s, s), (-s, s)]
            points = [geo.addPoint(sign * x, sign * y, 0.0) for x, y in places]
            lines = [geo.addLine(points[i - 1], points[i]) for i in range(1, 6)]
            lines.append(geo.addLine(points[-1], points[0]))
            groups[body] = geo.addPlaneSurface([geo.addCurveLoop(lines)])
            surfaces[f"crack_{body}"] = [lines[1]]
            surfaces[f"bond_{body}"] = [lines[0], lines[2]]
            surfaces[f"outside_{body}"] = lines[3:]
            geo.mesh.setTransfiniteCurve(lines[1], edges[body] + 1)
            body_of |= {(2, groups[body]): body} | {(1, line): body for line in lines}
        geo.synchronize()
        for body, group in groups.items():
            gmsh.model.addPhysicalGroup(2, [group], name=body)
        for name, curves in surfaces.items():
            gmsh.model.addPhysicalGroup(1, curves, name=name)

        def edge(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
            if (dim, tag) not in body_of:
                return lc
            smallest = length / edges[body_of[dim, tag]]
            return smallest + growth * hypot(max(abs(x) - a, 0.0), y)

        gmsh.model.mesh.setSizeCallback(edge)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.removeSizeCallback()
        if out:
            gmsh.write(out)

    return Domain.generate(draw, comm, name="fracture")


def main() -> None:
    """Write the mesh to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--length", type=float, default=2.0, help="length of the crack [m]")
    parser.add_argument("--size", type=float, default=8.0, help="side of the square [m]")
    parser.add_argument("--upper", type=int, default=32, help="edges on the crack, upper half")
    parser.add_argument("--lower", type=int, default=24, help="edges on the crack, lower half")
    parser.add_argument("--growth", type=float, default=0.2, help="of edges per distance")
    parser.add_argument("--out", default="fracture.msh", help="file to write (.msh)")
    fracture(MPI.COMM_WORLD, **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
