# SPDX-License-Identifier: LGPL-3.0-or-later
"""Cook's membrane, the tapered panel of Cook (1974), J. Struct. Div. ASCE 100, 1851-1863."""

from __future__ import annotations

import argparse
from math import dist
from typing import Any

from mpi4py import MPI

from fenicsx_hmcontact.domain import Domain, add_quadrilateral

CORNERS = [(0.0, 0.0), (48.0, 44.0), (48.0, 60.0), (0.0, 44.0)]


def cooks_membrane(
    comm: MPI.Comm, *, cells: int = 16, unstructured: bool = True, out: str | None = None
) -> Domain:
    """Mesh Cook's membrane: 44 high on the left, 16 on the right, 48 wide.

    Body "membrane"; surfaces "left", "right" and "other" (the two inclined sides). Collective.

    Args:
        comm: Communicator.
        cells: Edges on the left side.
        unstructured: Delaunay triangles of one size; otherwise cells x cells, all diagonals the
            same way.
        out: File (.msh) to write the mesh to as well.

    Raises:
        ValueError: If ``cells`` is not positive.
    """
    if cells <= 0:
        raise ValueError(f"cells must be positive, it is {cells}.")

    def draw(gmsh: Any) -> None:
        lengths = [dist(CORNERS[i], CORNERS[(i + 1) % 4]) for i in range(4)]
        below, right, above, left = (
            max(1, round(cells * length / lengths[3])) if unstructured else cells
            for length in lengths
        )
        edges = (below, right, above, left)
        membrane, sides = add_quadrilateral(gmsh, CORNERS, edges, unstructured=unstructured)
        gmsh.model.addPhysicalGroup(2, [membrane], name="membrane")
        for name, tags in {
            "left": [sides[3]],
            "right": [sides[1]],
            "other": [sides[0], sides[2]],
        }.items():
            gmsh.model.addPhysicalGroup(1, tags, name=name)
        gmsh.model.mesh.generate(2)
        if out:
            gmsh.write(out)

    return Domain.generate(draw, comm, name="cooks_membrane")


def main() -> None:
    """Write the mesh to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=16, help="edges on the left side")
    parser.add_argument("--structured", dest="unstructured", action="store_false", help="cells^2")
    parser.add_argument("--out", default="cooks_membrane.msh", help="file to write (.msh)")
    cooks_membrane(MPI.COMM_WORLD, **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
