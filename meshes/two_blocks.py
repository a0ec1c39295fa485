# SPDX-License-Identifier: LGPL-3.0-or-later
"""A column of two blocks that meet at mid-height without sharing nodes."""

from __future__ import annotations

import argparse
from math import radians, tan
from typing import Any

from mpi4py import MPI

from fenicsx_hmcontact.domain import Domain, add_quadrilateral, align_nodes


def two_blocks(
    comm: MPI.Comm,
    *,
    width: float = 0.5,
    height: float = 1.0,
    lower: int = 20,
    upper: int = 32,
    rows: int = 20,
    tilt: float = 0.0,
    single: bool = False,
    unstructured: bool = False,
    out: str | None = None,
) -> Domain:
    """Mesh the column (0, width) x (0, height) as two blocks, or as one for comparison.

    Bodies "lower" and "upper"; surfaces "bottom", "top", "left" and "right" (of both blocks
    together), "interface_lower" and "interface_upper". Collective.

    Args:
        comm: Communicator.
        width: Width of the column [m].
        height: Height of the column [m].
        lower: Edges across the lower block.
        upper: Edges across the upper block, or across the single one.
        rows: Rows of cells in each block.
        tilt: Inclination of the interface about its middle [degrees].
        single: Make one body "block" of 2 * rows rows, without interface.
        unstructured: Triangulate by Delaunay; otherwise all diagonals run the same way.
        out: File (.msh) to write the mesh to as well.

    Raises:
        ValueError: If a number is not positive, the interface leaves the sides, or ``tilt`` is
            given for a single block.
    """
    for name, value in dict(
        width=width, height=height, lower=lower, upper=upper, rows=rows
    ).items():
        if value <= 0:
            raise ValueError(f"{name} must be positive, it is {value}.")
    if single and tilt:
        raise ValueError("tilt does not apply to a single block.")
    rise = width / 2 * tan(radians(tilt))
    if abs(tilt) >= 90.0 or abs(rise) >= height / 2:
        raise ValueError(f"tilt must leave the interface between bottom and top, it is {tilt}.")
    left, right = height / 2 - rise, height / 2 + rise

    if single:
        blocks = {"block": (0.0, 0.0, height, height, upper, 2 * rows)}
    else:
        blocks = {
            "lower": (0.0, 0.0, right, left, lower, rows),
            "upper": (left, right, height, height, upper, rows),
        }

    def draw(gmsh: Any) -> None:
        drawn, sides = [], []
        for name, (y0, y1, y2, y3, across, up) in blocks.items():
            corners = [(0.0, y0), (width, y1), (width, y2), (0.0, y3)]
            edges = (across, up, across, up)
            block, lines = add_quadrilateral(gmsh, corners, edges, unstructured=unstructured)
            gmsh.model.addPhysicalGroup(2, [block], name=name)
            drawn.append((block, corners, edges))
            sides.append(lines)
        surfaces = {
            "bottom": [sides[0][0]],
            "right": [lines[1] for lines in sides],
            "top": [sides[-1][2]],
            "left": [lines[3] for lines in sides],
        }
        if not single:
            surfaces |= {"interface_lower": [sides[0][2]], "interface_upper": [sides[1][0]]}
        for name, tags in surfaces.items():
            gmsh.model.addPhysicalGroup(1, tags, name=name)
        gmsh.model.mesh.generate(2)
        if not unstructured:
            for block, corners, edges in drawn:
                align_nodes(gmsh, block, corners, edges)
        if out:
            gmsh.write(out)

    return Domain.generate(draw, comm, name="two_blocks")


def main() -> None:
    """Write the mesh to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=float, default=0.5, help="width [m]")
    parser.add_argument("--height", type=float, default=1.0, help="height [m]")
    parser.add_argument("--lower", type=int, default=20, help="edges across the lower block")
    parser.add_argument("--upper", type=int, default=32, help="edges across the upper block")
    parser.add_argument("--rows", type=int, default=20, help="rows of cells in each block")
    parser.add_argument("--tilt", type=float, default=0.0, help="inclination [degrees]")
    parser.add_argument("--single", action="store_true", help="one block without interface")
    parser.add_argument("--unstructured", action="store_true", help="triangulate by Delaunay")
    parser.add_argument("--out", default="two_blocks.msh", help="file to write (.msh)")
    two_blocks(MPI.COMM_WORLD, **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
