# SPDX-License-Identifier: LGPL-3.0-or-later
"""A block on a longer base with a flat or a wavy top, for sliding contact."""

from __future__ import annotations

import argparse
from typing import Any

from mpi4py import MPI

import numpy as np

from fenicsx_hmcontact.domain import Domain, add_quadrilateral, align_nodes


def sliding_blocks(
    comm: MPI.Comm,
    *,
    width: float = 1.0,
    height: float = 0.5,
    base_width: float = 2.0,
    base_height: float = 0.5,
    start: float = 0.5,
    secondary: int = 7,
    primary: int = 23,
    rows: int = 4,
    base_rows: int = 4,
    amplitude: float = 0.0,
    period: float = 1.0,
    out: str | None = None,
) -> Domain:
    """Mesh a block that rests on a base, along y = amplitude cos(2 pi x / period).

    The base reaches from x = 0 to ``base_width`` and down to ``-base_height``, the block from
    x = ``start`` on and up to ``height``. The nodes on both sides of the interface lie on its
    curve. Bodies "block" and "base"; surfaces "block_bottom" (secondary), "base_top" (primary) and
    likewise all other sides of both. Collective.

    Args:
        comm: Communicator.
        width: Width of the block [m].
        height: Height of the block [m].
        base_width: Width of the base [m].
        base_height: Height of the base [m].
        start: Distance of the block from the left end of the base [m].
        secondary: Edges across the block.
        primary: Edges across the base.
        rows: Rows of cells in the block.
        base_rows: Rows of cells in the base.
        amplitude: Amplitude of the waves [m].
        period: Their length [m].
        out: File (.msh) to write the mesh to as well.

    Raises:
        ValueError: If a size or number is not positive, the block juts out over the base, or the
            waves are too high for the bodies.
    """
    sizes = dict(width=width, height=height, base_width=base_width, base_height=base_height)
    counts = dict(secondary=secondary, primary=primary, rows=rows, base_rows=base_rows)
    for name, value in (sizes | counts | dict(period=period)).items():
        if value <= 0:
            raise ValueError(f"{name} must be positive, it is {value}.")
    if not 0.0 <= start <= base_width - width:
        raise ValueError(
            f"start must keep the block on the base, between 0 and {base_width - width:g}, it is "
            f"{start}."
        )
    if not abs(amplitude) < min(height, base_height):
        raise ValueError(f"amplitude must be below both heights, it is {amplitude}.")
    bodies = {
        "block": (start, width, 0.0, height, secondary, rows),
        "base": (0.0, base_width, -base_height, base_height, primary, base_rows),
    }

    def draw(gmsh: Any) -> None:
        drawn = []
        for name, (x, across, y, up, *numbers) in bodies.items():
            corners = [(x, y), (x + across, y), (x + across, y + up), (x, y + up)]
            edges = (numbers[0], numbers[1], numbers[0], numbers[1])
            body, sides = add_quadrilateral(gmsh, corners, edges)
            gmsh.model.addPhysicalGroup(2, [body], name=name)
            for side, line in zip(("bottom", "right", "top", "left"), sides, strict=True):
                gmsh.model.addPhysicalGroup(1, [line], name=f"{name}_{side}")
            drawn.append((body, corners, edges, up))
        gmsh.model.mesh.generate(2)
        for body, corners, edges, up in drawn:
            align_nodes(gmsh, body, corners, edges)
            _raise_nodes(gmsh, body, up, amplitude, period)
        if out:
            gmsh.write(out)

    return Domain.generate(draw, comm, name="sliding_blocks")


def _raise_nodes(gmsh: Any, body: int, height: float, amplitude: float, period: float) -> None:
    """Lift the side y = 0 of a body onto the waves, its other side not at all."""
    nodes, points, _ = gmsh.model.mesh.getNodes(2, body, includeBoundary=True)
    for node, (x, y, _) in zip(nodes, points.reshape(-1, 3), strict=True):
        wave = amplitude * np.cos(2.0 * np.pi * x / period)
        gmsh.model.mesh.setNode(node, [x, y + wave * (1.0 - abs(y) / height), 0.0], [])


def main() -> None:
    """Write the mesh to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=float, default=1.0, help="width of the block [m]")
    parser.add_argument("--height", type=float, default=0.5, help="height of the block [m]")
    parser.add_argument("--base-width", type=float, default=2.0, help="width of the base [m]")
    parser.add_argument("--base-height", type=float, default=0.5, help="height of the base [m]")
    parser.add_argument("--start", type=float, default=0.5, help="left end of the block [m]")
    parser.add_argument("--secondary", type=int, default=7, help="edges across the block")
    parser.add_argument("--primary", type=int, default=23, help="edges across the base")
    parser.add_argument("--rows", type=int, default=4, help="rows of cells in the block")
    parser.add_argument("--base-rows", type=int, default=4, help="rows of cells in the base")
    parser.add_argument("--amplitude", type=float, default=0.0, help="amplitude of the waves [m]")
    parser.add_argument("--period", type=float, default=1.0, help="length of the waves [m]")
    parser.add_argument("--out", default="sliding_blocks.msh", help="file to write (.msh)")
    sliding_blocks(MPI.COMM_WORLD, **vars(parser.parse_args()))


if __name__ == "__main__":
    main()
