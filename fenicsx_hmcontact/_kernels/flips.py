# SPDX-License-Identifier: LGPL-3.0-or-later
"""Flips of edges between triangles (Lawson 1977).

A triangulation is three arrays of shape (n_cells, 3): the nodes of the triangles, counterclockwise,
and for the edge opposite to each of them the triangle beyond (-1 if there is none) and whether the
edge is fixed.
"""

from typing import Any

import numpy as np
from numba import njit

from .predicates import orientation

TIE = 1e-10
"""Angles [rad] that face an edge may sum up to this much more than pi; four nodes on a circle do
not flip."""


@njit(cache=True)
def flip(cells: Any, beyond: Any, fixed: Any, t: int, k: int) -> int:
    """Replace the edge opposite to node k of triangle t by the other diagonal of the two triangles.

    Triangles abc and dcb become abd and adc, where a is node k of t.

    Returns:
        The other triangle, adc.
    """
    s = beyond[t, k]
    j = 0
    while beyond[s, j] != t:
        j += 1
    k1, k2, j1, j2 = (k + 1) % 3, (k + 2) % 3, (j + 1) % 3, (j + 2) % 3
    a, b, c, d = cells[t, k], cells[t, k1], cells[t, k2], cells[s, j]
    ab, ca, bd, dc = beyond[t, k2], beyond[t, k1], beyond[s, j1], beyond[s, j2]
    fixed_ab, fixed_ca = fixed[t, k2], fixed[t, k1]
    fixed_bd, fixed_dc = fixed[s, j1], fixed[s, j2]
    for i, node, neighbour, is_fixed in (
        (0, a, bd, fixed_bd),
        (1, b, s, False),
        (2, d, ab, fixed_ab),
    ):
        cells[t, i], beyond[t, i], fixed[t, i] = node, neighbour, is_fixed
    for i, node, neighbour, is_fixed in (
        (0, a, dc, fixed_dc),
        (1, d, ca, fixed_ca),
        (2, c, t, False),
    ):
        cells[s, i], beyond[s, i], fixed[s, i] = node, neighbour, is_fixed
    redirect(beyond, bd, s, t)
    redirect(beyond, ca, t, s)
    return s


@njit(cache=True)
def redirect(beyond: Any, cell: int, old: int, new: int) -> None:
    """Let a triangle, if there is one, see another neighbour."""
    if cell >= 0:
        for i in range(3):
            if beyond[cell, i] == old:
                beyond[cell, i] = new
                return


@njit(cache=True)
def is_convex(points: Any, cells: Any, beyond: Any, t: int, k: int) -> bool:
    """Whether flipping the edge opposite to node k of triangle t gives two proper triangles."""
    a, b, c = cells[t, k], cells[t, (k + 1) % 3], cells[t, (k + 2) % 3]
    d = apex(cells, beyond, t, k)
    return (
        orientation(points[a], points[b], points[d]) > 0.0
        and orientation(points[a], points[d], points[c]) > 0.0
    )


@njit(cache=True)
def apex(cells: Any, beyond: Any, t: int, k: int) -> int:
    """Node beyond the edge opposite to node k of triangle t."""
    s = beyond[t, k]
    j = 0
    while beyond[s, j] != t:
        j += 1
    return cells[s, j]


@njit(cache=True)
def _is_wrong(points: Any, cells: Any, beyond: Any, t: int, k: int) -> bool:
    """Whether the angles that face the edge sum up to more than pi: sin(alpha + gamma) < 0."""
    a, b, c = points[cells[t, k]], points[cells[t, (k + 1) % 3]], points[cells[t, (k + 2) % 3]]
    d = points[apex(cells, beyond, t, k)]
    abx, aby, acx, acy = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
    dcx, dcy, dbx, dby = c[0] - d[0], c[1] - d[1], b[0] - d[0], b[1] - d[1]
    sine = (abx * acy - aby * acx) * (dcx * dbx + dcy * dby)
    sine += (abx * acx + aby * acy) * (dcx * dby - dcy * dbx)
    scale = np.hypot(abx, aby) * np.hypot(acx, acy) * np.hypot(dcx, dcy) * np.hypot(dbx, dby)
    return sine < -TIE * scale


@njit(cache=True)
def legalise(
    points: Any, cells: Any, beyond: Any, fixed: Any, waiting: Any, queued: Any, count: int
) -> int:
    """Flip edges until none that is not fixed is wrong: a (constrained) Delaunay triangulation.

    Args:
        points: Coordinates [m]; shape (n_points, 2).
        cells: Nodes of the triangles, all of positive area; shape (n_cells, 3), changed in place.
        beyond: Triangles beyond the edges; changed in place.
        fixed: Which edges stay; changed in place.
        waiting: Triangles whose edges are to be looked at, the first ones; shape (n_cells,),
            overwritten.
        queued: Whether a triangle is among them; shape (n_cells,), all False in the end.
        count: How many they are.

    Returns:
        Number of flips.
    """
    flips = 0
    while count > 0:
        count -= 1
        t = waiting[count]
        queued[t] = False
        for k in range(3):
            if (
                beyond[t, k] >= 0
                and not fixed[t, k]
                and _is_wrong(points, cells, beyond, t, k)
                and is_convex(points, cells, beyond, t, k)
            ):
                s = flip(cells, beyond, fixed, t, k)
                flips += 1
                for cell in (t, s):
                    if not queued[cell]:
                        queued[cell] = True
                        waiting[count] = cell
                        count += 1
                break
    return flips
