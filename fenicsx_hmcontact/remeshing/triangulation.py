# SPDX-License-Identifier: LGPL-3.0-or-later
"""Delaunay triangulations: by flips from the triangles that there are, or from scratch."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fenicsx_hmcontact._kernels.flips import legalise
from fenicsx_hmcontact._kernels.insertion import (
    COINCIDE,
    CROSSES,
    DONE,
    TOUCHES,
    insert_edges,
    insert_points,
)
from fenicsx_hmcontact.remeshing.edges import Bools, Edges, Floats, Ints
from fenicsx_hmcontact.remeshing.quality import angles, areas

AROUND = 20.0
"""Size of the triangle that a triangulation starts from, relative to that of the body."""

AREA_ERROR = 1e-12
"""Largest difference between the area of the triangles and that inside the boundary, relative."""


class TriangulationError(ValueError):
    """Nodes and edges that cannot be triangulated."""


def canonical(cells: Ints, groups: Ints) -> tuple[Ints, Ints]:
    """The same triangles in the one order that depends on nothing but them.

    Args:
        cells: Nodes of the triangles; shape (n_cells, 3).
        groups: Group of each triangle; shape (n_cells,).

    Returns:
        Triangles that begin with their smallest node, in ascending order, and their groups.
    """
    first = np.argmin(cells, axis=1)[:, None]
    turned = np.take_along_axis(cells, (first + np.arange(3)) % 3, axis=1)
    order = np.lexsort(turned.T[::-1])
    return turned[order], groups[order]


def flip_to_delaunay(points: Floats, cells: Ints, edges: Edges) -> tuple[Ints, int]:
    """Flip edges until the circle around no triangle contains a node that it can see (Lawson 1977).

    Nodes on a common circle stay as they are, so that a second call changes nothing.

    Args:
        points: Coordinates [m]; shape (n_points, 2).
        cells: Nodes of the triangles, all of positive area; shape (n_cells, 3).
        edges: Their edges; fixed ones stay.

    Returns:
        The triangles, in place of the old ones, and the number of flips. Groups stay in their rows.
    """
    cells, beyond, fixed = cells.copy(), edges.beyond, edges.fixed[edges.of_cell]
    return cells, _legalise_all(points, cells, beyond, fixed)


def triangulate(points: Floats, edges: Ints, groups: npt.ArrayLike = 0) -> tuple[Ints, Ints, float]:
    """Triangulate nodes within a boundary from scratch: a constrained Delaunay triangulation.

    Needed where a triangle is inverted, as flips need proper triangles to begin with. No angle is
    too small: where boundary nodes nearly coincide, the smallest one says so.

    Args:
        points: Coordinates [m]; shape (n_points, 2).
        edges: Nodes of the directed edges with the body to their left: outer boundaries run
            counterclockwise, holes clockwise. An edge between two layers is given both ways; shape
            (n_edges, 2).
        groups: Group to the left of each edge; shape (n_edges,), or one for all.

    Returns:
        Triangles in canonical order, their groups, and the smallest angle [degrees].

    Raises:
        TriangulationError: If coordinates are not finite, nodes coincide or lie outside or on an
            edge, edges cross or have no length, or the edges enclose no area.
    """
    groups = np.broadcast_to(np.asarray(groups, np.int64), len(edges))
    if len(points) < 3:
        raise TriangulationError(f"{len(points)} nodes make no triangle")
    if not np.isfinite(points).all():
        raise TriangulationError(
            f"{_node(points, np.argmin(np.isfinite(points).all(1)))} is not finite"
        )
    of_no_length = edges[:, 0] == edges[:, 1]
    if of_no_length.any():
        a = edges[np.argmax(of_no_length), 0]
        raise TriangulationError(f"an edge runs from {_node(points, a)} to itself")
    area = enclosed_area(points, edges)
    if area <= 0.0:
        raise TriangulationError(f"the boundary encloses an area of {area:.3g} m^2")

    n = len(points)
    around = _with_triangle_around(points)
    cells, beyond = np.zeros((2 * n + 1, 3), np.int64), np.full((2 * n + 1, 3), -1)
    cells[0] = n, n + 1, n + 2
    fixed = np.zeros_like(cells, bool)
    status, _, x, y = insert_points(around, _along_rows(points), cells, beyond, fixed)
    if status == COINCIDE:
        raise TriangulationError(f"{_node(points, x)} and node {y} coincide")
    if status == DONE:
        status, e, x, y = insert_edges(around, edges, cells, beyond, fixed)
        edge = f"the edge between nodes {edges[e, 0]} and {edges[e, 1]}"
        if status == TOUCHES:
            raise TriangulationError(f"{_node(points, x)} lies on {edge}")
        if status == CROSSES:
            raise TriangulationError(f"{edge} crosses the one from {_node(points, x)} to node {y}")
    if status != DONE:
        raise TriangulationError(f"the search for {_node(points, x)} found no end")

    _legalise_all(around, cells, beyond, fixed)
    cells, inside = _enclosed(points, cells, beyond, fixed, edges, groups)
    smallest_angle = verify(points, cells, inside, edges, groups)
    return *canonical(cells, inside), smallest_angle


def enclosed_area(points: Floats, edges: Ints) -> float:
    """Area [m^2] to the left of closed chains of directed edges; shape (n_edges, 2)."""
    a, b = (points[edges[:, i]] - points.mean(axis=0) for i in (0, 1))
    return 0.5 * float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())


def directed_edges(cells: Ints, groups: Ints, edges: Edges) -> tuple[Ints, Ints]:
    """Fixed edges as `triangulate` takes them: directed, with their group to the left."""
    cell, k = np.nonzero(edges.fixed[edges.of_cell])
    return np.stack([cells[cell, (k + 1) % 3], cells[cell, (k + 2) % 3]], axis=1), groups[cell]


def verify(points: Floats, cells: Ints, groups: Ints, edges: Ints, edge_groups: Ints) -> float:
    """Refuse triangles that do not fill exactly what the edges enclose.

    Returns:
        The smallest angle [degrees].

    Raises:
        TriangulationError: If a node is in no triangle, a triangle has no area, the areas do not
            sum up, or the edges are not those of the triangles.
    """
    used = np.zeros(len(points), bool)
    used[cells] = True
    if not used.all():
        raise TriangulationError(f"{_node(points, np.argmin(used))} lies outside of its body")
    size, angle = areas(points, cells), angles(points, cells)
    if angle.min() <= 0.0:
        at = cells.ravel()[np.argmin(angle)]
        raise TriangulationError(f"a triangle at {_node(points, at)} is flat")
    area = enclosed_area(points, edges)
    round_off = np.finfo(float).eps * float((np.ptp(points, axis=0) ** 2).sum())
    if abs(size.sum() - area) > AREA_ERROR * area + round_off:
        raise TriangulationError(f"the triangles fill {size.sum():.17g} of {area:.17g} m^2")
    made, made_groups = directed_edges(cells, groups, Edges.of(cells, groups, edges[:0]))
    if not np.array_equal(_sorted_rows(made, made_groups), _sorted_rows(edges, edge_groups)):
        raise TriangulationError("the boundary of the triangles is not the one given")
    return float(angle.min())


def _sorted_rows(edges: Ints, groups: Ints) -> Ints:
    rows = np.column_stack([edges, groups])
    return rows[np.lexsort(rows.T)]


def _node(points: Floats, node: int | np.integer) -> str:
    if node >= len(points):
        return "a node"
    return f"node {node} at ({points[node, 0]:.6g}, {points[node, 1]:.6g})"


def _legalise_all(points: Floats, cells: Ints, beyond: Ints, fixed: Bools) -> int:
    m = len(cells)
    return legalise(points, cells, beyond, fixed, np.arange(m), np.ones(m, bool), m)


def _with_triangle_around(points: Floats) -> Floats:
    low, high = points.min(axis=0), points.max(axis=0)
    radius = AROUND * float((high - low).max())
    corners = np.array([[-1.0, -0.5], [1.0, -0.5], [0.0, 1.0]])
    return np.vstack([points, 0.5 * (low + high) + radius * corners])


def _along_rows(points: Floats) -> Ints:
    """Nodes in rows that run to and fro, so that each is found close to the last one."""
    low = points.min(axis=0)
    width = max(float(np.ptp(points, axis=0).max()), np.finfo(float).tiny)
    x, row = ((points - low) / width * max(1.0, np.sqrt(len(points) / 4.0))).T
    row = np.floor(row).astype(np.int64)
    return np.lexsort((np.where(row % 2, -x, x), row))


def _enclosed(
    points: Floats, cells: Ints, beyond: Ints, fixed: Bools, edges: Ints, groups: Ints
) -> tuple[Ints, Ints]:
    """Triangles inside of the edges, and their groups.

    The fixed edges cut the triangles into parts. What lies to the left of an edge decides for the
    whole part, which needs no test that slivers could fail.
    """
    n, m = len(points), len(cells)
    t, k = np.nonzero((beyond >= 0) & ~fixed)
    joined = coo_array((np.ones(t.size), (t, beyond[t, k])), shape=(m, m))
    num_parts, part = connected_components(joined, directed=False)

    outside = -1
    width = n + 3
    order = np.argsort(edges[:, 0] * width + edges[:, 1])
    keys = (edges[:, 0] * width + edges[:, 1])[order]
    if (np.diff(keys) == 0).any():
        a, b = edges[order[np.argmin(np.diff(keys))]]
        raise TriangulationError(f"the edge from {_node(points, a)} to node {b} occurs twice")
    t, k = np.nonzero(fixed)
    own = cells[t, (k + 1) % 3] * width + cells[t, (k + 2) % 3]
    at = np.minimum(np.searchsorted(keys, own), len(keys) - 1)
    label = np.where(keys[at] == own, groups[order[at]], outside)
    corner = np.flatnonzero((cells >= n).any(axis=1))
    seed = np.concatenate([t, corner])
    label = np.concatenate([label, np.full(corner.size, outside)])
    of_part = np.full(num_parts, outside)
    of_part[part[seed]] = label
    wrong = np.flatnonzero(of_part[part[seed]] != label)
    if wrong.size:
        raise TriangulationError(
            f"the boundary is folded or open at {_node(points, cells[seed[wrong[0]]].min())}"
        )
    inside = of_part[part] != outside
    return cells[inside], of_part[part[inside]]
