# SPDX-License-Identifier: LGPL-3.0-or-later
"""Two blocks on a straight inclined interface with non-matching nodes, for patch tests."""

from __future__ import annotations

import argparse
from typing import Any

from mpi4py import MPI

from fenicsx_hmcontact.domain import Domain, add_quadrilateral, align_nodes


def patch_blocks(
    comm: MPI.Comm,
    *,
    secondary: int = 7,
    primary: int = 11,
    slope: float = 0.0,
    rows: int = 4,
    jitter: float = 0.0,
    seed: int = 0,
    out: str | None = None,
) -> Domain:
    """Mesh the unit square as two blocks that meet at y = 0.5 + slope (x - 0.5).

    Bodies "lower" and "upper"; surfaces "bottom", "top", "left_lower", "right_lower",
    "left_upper", "right_upper", "interface_lower" (primary) and "interface_upper" (secondary).
    Collective.

    Args:
        comm: Communicator.
        secondary: Edges of the upper block on the interface.
        primary: Edges of the lower block on the interface.
        slope: Slope of the interface; bottom and top stay horizontal.
        rows: Rows of cells in each block.
        jitter: Largest random shift of inner nodes, as a part of the cell, below 1/6.
        seed: Seed of the random shifts.
        out: File (.msh) to write the mesh to as well.

    Raises:
        ValueError: If a number of edges is not positive, or slope or jitter would invert cells.
    """
    for name, number in dict(secondary=secondary, primary=primary, rows=rows).items():
        if number <= 0:
            raise ValueError(f"{name} must be positive, it is {number}.")
    if not abs(slope) < 1.0:
        raise ValueError(f"slope must be between -1 and 1, it is {slope}.")
    if not 0.0 <= jitter < 1 / 6:
        raise ValueError(f"jitter must be between 0 and 1/6, it is {jitter}.")
    left, right = 0.5 - 0.5 * slope, 0.5 + 0.5 * slope
    corners = {
        "lower": [(0.0, 0.0), (1.0, 0.0), (1.0, right), (0.0, left)],
        "upper": [(0.0, left), (1.0, right), (1.0, 1.0), (0.0, 1.0)],
    }
    surfaces = {
        "lower": ("bottom", "right_lower", "interface_lower", "left_lower"),
        "upper": ("interface_upper", "right_upper", "top", "left_upper"),
    }
    edges = {
        "lower": (primary, rows, primary, rows),
        "upper": (secondary, rows, secondary, rows),
    }

    def draw(gmsh: Any) -> None:
        blocks = {}
        for name in surfaces:
            blocks[name], sides = add_quadrilateral(gmsh, corners[name], edges[name])
            gmsh.model.addPhysicalGroup(2, [blocks[name]], name=name)
            for surface, side in zip(surfaces[name], sides, strict=True):
                gmsh.model.addPhysicalGroup(1, [side], name=surface)
        gmsh.model.mesh.generate(2)
        for i, (name, block) in enumerate(blocks.items()):
            align_nodes(gmsh, block, corners[name], edges[name], jitter=jitter, seed=[seed, i])
        if out:
            gmsh.write(out)

    return Domain.generate(draw, comm, name="patch_blocks")


def main() -> None:
    """Write the mesh to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--secondary", type=int, default=7, help="edges of the upper block")
    parser.add_argument("--primary", type=int, default=11, help="edges of the lower block")
    parser.add_argument("--slope", type=float, default=0.0, help="slope of the interface")
    parser.add_argument("--rows", type=int, default=4, help="rows of cells in each block")
    parser.add_argument("--jitter", type=float, default=0.0, help="shift of inner nodes, < 1/6")
    parser.add_argument("--seed", type=int, default=0, help="seed of the shifts")
    parser.add_argument("--out", default="patch_blocks.msh", help="file to write (.msh)")
    patch_blocks(MPI.COMM_WORLD, **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
