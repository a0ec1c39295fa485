# SPDX-License-Identifier: LGPL-3.0-or-later
"""Edges of triangles, and which of them must stay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of a body.

    Fixed are the edges on the boundary and those between layers: they are never flipped.

    Attributes:
        nodes: Nodes of the edges, the smaller first, in ascending order; shape (n_edges, 2).
        cells: Triangles at the edges, -1 beyond the boundary; shape (n_edges, 2).
        of_cell: Edge opposite to each node of each triangle; shape (n_cells, 3).
        fixed: Whether an edge is fixed; shape (n_edges,).
        facet: Facet of a surface that the edge is, or -1; shape (n_edges,).
        groups: Groups of the triangles at the edges, the smaller first, -1 beyond the boundary;
            shape (n_edges, 2).
    """

    nodes: Ints
    cells: Ints
    of_cell: Ints
    fixed: Bools
    facet: Ints
    groups: Ints

    @classmethod
    def of(cls, cells: Ints, groups: Ints, facets: Ints) -> Edges:
        """Edges of triangles.

        Args:
            cells: Nodes of the triangles; shape (n_cells, 3).
            groups: Group of each triangle.
            facets: Nodes of the facets; shape (n_facets, 2).

        Raises:
            ValueError: If more than two triangles meet at an edge, or a facet is no edge.
        """
        ends = cells[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2)
        pairs = np.column_stack([np.minimum(*ends.T), np.maximum(*ends.T)])
        # One number for both nodes sorts ten times faster than rows.
        n = int(pairs.max()) + 1
        keys = pairs[:, 0] * n + pairs[:, 1]
        order = np.argsort(keys, kind="stable")
        first = np.flatnonzero(np.diff(keys[order], prepend=-1))
        count = np.diff(first, append=keys.size)
        if count.max() > 2:
            x, y = pairs[order[first[np.argmax(count)]]]
            raise ValueError(f"{count.max()} triangles meet at the edge between nodes {x} and {y}")
        number = np.empty(keys.size, np.int64)
        number[order] = np.repeat(np.arange(first.size), count)
        sides = np.full((first.size, 2), -1)
        sides[:, 0] = order[first] // 3
        sides[count == 2, 1] = order[first[count == 2] + 1] // 3
        beside = np.where(sides >= 0, groups[sides], -1)

        nodes = pairs[order[first]]
        facet = np.full(first.size, -1)
        chain = np.sort(facets, axis=1)
        at = np.searchsorted(keys[order[first]], chain[:, 0] * n + chain[:, 1])
        found = at < first.size
        found[found] = (nodes[at[found]] == chain[found]).all(axis=1)
        if not found.all():
            x, y = facets[np.argmin(found)]
            raise ValueError(f"the facet between nodes {x} and {y} is no edge of a triangle")
        facet[at] = np.arange(len(facets))
        fixed = beside[:, 0] != beside[:, 1]
        return cls(nodes, sides, number.reshape(-1, 3), fixed, facet, np.sort(beside, axis=1))

    @property
    def beyond(self) -> Ints:
        """Triangle beyond the edge opposite to each node, -1 if there is none; (n_cells, 3)."""
        sides = self.cells[self.of_cell]
        own = np.arange(len(self.of_cell))[:, None]
        return np.where(sides[..., 0] == own, sides[..., 1], sides[..., 0])

    def lengths(self, points: Floats) -> Floats:
        """Lengths of the edges [m]."""
        return np.linalg.norm(points[self.nodes[:, 1]] - points[self.nodes[:, 0]], axis=1)

    def find(self, a: int, b: int) -> int:
        """Number of the edge between two nodes, -1 if there is none."""
        low, high = min(a, b), max(a, b)
        begin, end = np.searchsorted(self.nodes[:, 0], [low, low + 1])
        at = int(begin + np.searchsorted(self.nodes[begin:end, 1], high))
        return at if at < end and self.nodes[at, 1] == high else -1
