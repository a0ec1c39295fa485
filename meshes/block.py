# SPDX-License-Identifier: LGPL-3.0-or-later
"""One rectangular body: a column, a block, a beam."""

from __future__ import annotations

import argparse
from typing import Any

from mpi4py import MPI

from fenicsx_hmcontact.domain import Domain, add_quadrilateral, align_nodes


def block(
    comm: MPI.Comm,
    *,
    width: float = 1.0,
    height: float = 1.0,
    across: int = 8,
    rows: int = 8,
    unstructured: bool = False,
    out: str | None = None,
) -> Domain:
    """Mesh the rectangle (0, width) x (0, height).

    Body "block"; surfaces "bottom", "right", "top" and "left". Collective.

    Args:
        comm: Communicator.
        width: Width [m].
        height: Height [m].
        across: Edges across.
        rows: Rows of cells.
        unstructured: Triangulate by Delaunay; otherwise all diagonals run the same way.
        out: File (.msh) to write the mesh to as well.

    Raises:
        ValueError: If a number is not positive.
    """
    for name, value in dict(width=width, height=height, across=across, rows=rows).items():
        if not value > 0:
            raise ValueError(f"{name} must be positive, it is {value}.")
    corners = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)]
    edges = (across, rows, across, rows)

    def draw(gmsh: Any) -> None:
        body, sides = add_quadrilateral(gmsh, corners, edges, unstructured=unstructured)
        gmsh.model.addPhysicalGroup(2, [body], name="block")
        for name, side in zip(("bottom", "right", "top", "left"), sides, strict=True):
            gmsh.model.addPhysicalGroup(1, [side], name=name)
        gmsh.model.mesh.generate(2)
        if not unstructured:
            align_nodes(gmsh, body, corners, edges)
        if out:
            gmsh.write(out)

    return Domain.generate(draw, comm, name="block")


def main() -> None:
    """Write the mesh to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=float, default=1.0, help="width [m]")
    parser.add_argument("--height", type=float, default=1.0, help="height [m]")
    parser.add_argument("--across", type=int, default=8, help="edges across")
    parser.add_argument("--rows", type=int, default=8, help="rows of cells")
    parser.add_argument("--unstructured", action="store_true", help="triangulate by Delaunay")
    parser.add_argument("--out", default="block.msh", help="file to write (.msh)")
    block(MPI.COMM_WORLD, **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
