# SPDX-License-Identifier: LGPL-3.0-or-later
"""One body while it is being remeshed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, eye_array, vstack

from fenicsx_hmcontact._kernels.predicates import orientation
from fenicsx_hmcontact.remeshing.edges import Bools, Edges, Floats, Ints
from fenicsx_hmcontact.remeshing.options import Remeshing
from fenicsx_hmcontact.remeshing.triangulation import (
    directed_edges,
    flip_to_delaunay,
    triangulate,
)


@dataclass(eq=False)
class Body:
    """Triangles, facets and nodes of a body, changed step by step.

    Nodes keep their numbers: new ones come last, and a removed one is just in no triangle any more.

    Attributes:
        points: Coordinates [m]; shape (n_points, 2).
        sizes: Target size h that the nodes carry [m]; shape (n_points,).
        held: Nodes that are never removed; an edge between two of them is never halved.
        cells: Nodes of the triangles, counterclockwise; shape (n_cells, 3).
        groups: Group of each triangle.
        facets: Nodes of the facets; shape (n_facets, 2).
        tags: Surface group of each facet.
        options: What the triangles are to look like.
        first_nodes: Numbers of the first nodes in the whole mesh.
        others: Ends of the facets of other bodies [m]; shape (n, 2, 2).
        origins: Weights of the first nodes in each node; shape (n_points, number of first nodes).
        merges: For each removed node of a fixed line and group beside it: the node, the nodes
            before and after it, the group, and the area [m^2] that the group gained.
        counts: How often each operation was done.
    """

    points: Floats
    sizes: Floats
    held: Bools
    cells: Ints
    groups: Ints
    facets: Ints
    tags: npt.NDArray[np.int32]
    options: Remeshing
    first_nodes: Ints
    others: Floats
    origins: Any = None
    merges: list[tuple[tuple[int, int, int], int, float]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    _edges: tuple[tuple[Ints, Ints, Ints], Edges] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        """Every node stems from itself."""
        self.origins = eye_array(len(self.points), format="csr")

    @property
    def targets(self) -> Floats:
        """Target size h of the nodes [m]: what they carry, or less where the user wants it."""
        if self.options.size is None:
            return self.sizes
        wanted = np.asarray(self.options.size(self.points), float)
        if wanted.shape != self.sizes.shape or not (wanted > 0.0).all():
            raise ValueError(
                f"size must give a positive length for each of {len(self.points)} positions; "
                f"it gave shape {wanted.shape} with the smallest value {wanted.min(initial=np.nan)}"
            )
        return np.minimum(self.sizes, wanted)

    def edges(self) -> Edges:
        """Edges of the triangles as they are now."""
        now = (self.cells, self.groups, self.facets)
        # Every change ends in new arrays, so that the same ones have the same edges.
        if self._edges is None or any(a is not b for a, b in zip(now, self._edges[0], strict=True)):
            self._edges = now, Edges.of(*now)
        return self._edges[1]

    def free_nodes(self, edges: Edges) -> Bools:
        """Whether a node may be moved out of the way: not on a fixed edge and not held."""
        free = ~self.held
        free[edges.nodes[edges.fixed]] = False
        return free

    @property
    def changed(self) -> bool:
        """Whether any operation was done."""
        return any(self.counts.values())

    def count(self, what: str, number: int) -> int:
        """Note how often an operation was done, and give the number back."""
        self.counts[what] = self.counts.get(what, 0) + number
        return number

    def add_nodes(self, parents: Ints, weights: Floats) -> Ints:
        """Put nodes at convex combinations of others.

        Args:
            parents: Nodes; shape (n, n_parents).
            weights: Their weights, none negative, with sum 1; shape (n, n_parents).

        Returns:
            Numbers of the new nodes; shape (n,).
        """
        first = len(self.points)
        rows = np.repeat(np.arange(len(parents)), parents.shape[1])
        mean = csr_array((weights.ravel(), (rows, parents.ravel())), shape=(len(parents), first))
        self.points = np.vstack([self.points, (weights[..., None] * self.points[parents]).sum(1)])
        self.sizes = np.append(self.sizes, (weights * self.sizes[parents]).sum(axis=1))
        self.held = np.append(self.held, np.zeros(len(parents), bool))
        self.origins = vstack([self.origins, mean @ self.origins], format="csr")
        return np.arange(first, len(self.points))

    def retriangulate(self) -> None:
        """Make the triangles Delaunay: by flips, or from scratch where one is inverted.

        Raises:
            TriangulationError: If they are inverted because the boundary crosses itself or left
                nodes behind.
        """
        edges = self.edges()
        if all_positive(self.points, self.cells):
            cells, flips = flip_to_delaunay(self.points, self.cells, edges)
            if self.count("flips", flips):
                self.cells = cells
            return
        fixed, groups = directed_edges(self.cells, self.groups, edges)
        used = np.unique(self.cells)
        number = np.zeros(len(self.points), np.int64)
        number[used] = np.arange(used.size)
        cells, self.groups, _ = triangulate(self.points[used], number[fixed], groups)
        self.cells = used[cells]
        self.count("from scratch", 1)


def all_positive(points: Floats, cells: Ints) -> bool:
    """Whether no triangle is inverted or flat, without error."""
    return bool(np.all([orientation(*points[cell]) > 0.0 for cell in _doubtful(points, cells)]))


def _doubtful(points: Floats, cells: Ints) -> Ints:
    """Triangles whose area is not positive beyond doubt."""
    a, b, c = (points[cells[:, i]] for i in range(3))
    left = (a[:, 0] - c[:, 0]) * (b[:, 1] - c[:, 1])
    right = (a[:, 1] - c[:, 1]) * (b[:, 0] - c[:, 0])
    return cells[left - right <= 1e-15 * (abs(left) + abs(right))]
