# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes and edges put into a triangulation one after the other, with exact predicates."""

from typing import Any

import numpy as np
from numba import njit

from .flips import apex, flip, is_convex, legalise, redirect
from .predicates import orientation

DONE, COINCIDE, LOST, TOUCHES, CROSSES = range(5)
"""How an insertion ended; all but the first name what was in the way."""


@njit(cache=True)
def insert_points(
    points: Any, order: Any, cells: Any, beyond: Any, fixed: Any
) -> tuple[int, int, int, int]:
    """Put nodes into one triangle that contains them all.

    Args:
        points: Coordinates [m], those of the triangle last; shape (n + 3, 2).
        order: Nodes in the order of their insertion, neighbours close to each other; shape (n,).
        cells: Triangles, the first one given; shape (2 n + 1, 3), filled.
        beyond: Triangles beyond the edges, filled.
        fixed: All False.

    Returns:
        How it ended, the number of triangles, and the two nodes that coincide.
    """
    waiting, queued = np.empty(len(cells), np.int64), np.zeros(len(cells), np.bool_)
    size, t = 1, 0
    for node in order:
        p = points[node]
        outside = True
        steps = 0
        while outside:
            outside = False
            for i in range(3):
                # A changing first edge keeps the walk from going round in circles.
                k = (i + steps) % 3
                if orientation(points[cells[t, (k + 1) % 3]], points[cells[t, (k + 2) % 3]], p) < 0:
                    t = beyond[t, k]
                    outside = True
                    break
            steps += 1
            if t < 0 or steps > 10 * len(cells):
                return LOST, size, node, node
        on_edge = -1
        for k in range(3):
            b, c = cells[t, (k + 1) % 3], cells[t, (k + 2) % 3]
            if points[b, 0] == p[0] and points[b, 1] == p[1]:
                return COINCIDE, size, b, node
            if orientation(points[b], points[c], p) == 0.0:
                on_edge = k
        a, b, c = cells[t]
        bc, ca = beyond[t, 0], beyond[t, 1]
        for cell, x, y, past_x, past_y, past_node in (
            (size, b, c, size + 1, t, bc),
            (size + 1, c, a, t, size, ca),
            (t, a, b, size, size + 1, beyond[t, 2]),
        ):
            cells[cell, 0], cells[cell, 1], cells[cell, 2] = x, y, node
            beyond[cell, 0], beyond[cell, 1], beyond[cell, 2] = past_x, past_y, past_node
        redirect(beyond, bc, t, size)
        redirect(beyond, ca, t, size + 1)
        count = 0
        if on_edge >= 0:
            # The triangle between the node and its edge has no area until the edge is flipped.
            flat = (size, size + 1, t)[on_edge]
            waiting[count] = flip(cells, beyond, fixed, flat, 2)
            queued[waiting[count]] = True
            count += 1
        for cell in (t, size, size + 1):
            if not queued[cell]:
                queued[cell] = True
                waiting[count] = cell
                count += 1
        legalise(points, cells, beyond, fixed, waiting, queued, count)
        size += 2
    return DONE, size, -1, -1


@njit(cache=True)
def insert_edges(
    points: Any, edges: Any, cells: Any, beyond: Any, fixed: Any
) -> tuple[int, int, int, int]:
    """Make edges that the triangulation lacks, by flipping those that cross them (Sloan 1993).

    Args:
        points: Coordinates [m]; shape (n_points, 2).
        edges: Nodes of the edges, which become fixed; shape (n_edges, 2).
        cells: Triangles; every node of an edge lies inside of them. Changed in place.
        beyond: Triangles beyond the edges; changed in place.
        fixed: Which edges are fixed; changed in place.

    Returns:
        How it ended, the edge that could not be made, and the nodes that were in its way.
    """
    cell_at = np.empty(len(points), np.int64)
    for t in range(len(cells)):
        cell_at[cells[t]] = t
    crossing = np.empty((len(cells), 2), np.int64)
    for e in range(len(edges)):
        a, b = edges[e]
        status, count, x, y = _crossed(points, cells, beyond, fixed, cell_at, a, b, crossing)
        if status != DONE:
            return status, e, x, y
        first, tries = 0, 0
        while count > 0:
            x, y = crossing[first]
            first = (first + 1) % len(crossing)
            count -= 1
            tries += 1
            if tries > 100 * len(cells):
                return LOST, e, x, y
            t, k = _cell_of_edge(cells, beyond, cell_at, x, y)
            if is_convex(points, cells, beyond, t, k):
                s = flip(cells, beyond, fixed, t, k)
                cell_at[cells[t]] = t
                cell_at[cells[s]] = s
                x, y = cells[t, 0], cells[t, 2]
                if x in (a, b) or y in (a, b):
                    continue
                x_is_left = orientation(points[a], points[b], points[x]) > 0.0
                if x_is_left == (orientation(points[a], points[b], points[y]) > 0.0):
                    continue
            last = (first + count) % len(crossing)
            crossing[last, 0], crossing[last, 1] = x, y
            count += 1
        t, k = _cell_of_edge(cells, beyond, cell_at, a, b)
        fixed[t, k] = True
        s = beyond[t, k]
        for j in range(3):
            if beyond[s, j] == t:
                fixed[s, j] = True
    return DONE, -1, -1, -1


@njit(cache=True)
def _crossed(
    points: Any, cells: Any, beyond: Any, fixed: Any, cell_at: Any, a: int, b: int, crossing: Any
) -> tuple[int, int, int, int]:
    """Edges that cross the segment ab; how it ended, their number, and what is in the way."""
    t, k = _leaving(points, cells, beyond, cell_at, a, b)
    right, left = cells[t, (k + 1) % 3], cells[t, (k + 2) % 3]
    count = 0
    while right != b and left != b:
        for node in (right, left):
            if orientation(points[a], points[b], points[node]) == 0.0:
                return TOUCHES, count, node, node
        if fixed[t, k]:
            return CROSSES, count, right, left
        crossing[count, 0], crossing[count, 1] = right, left
        count += 1
        node = apex(cells, beyond, t, k)
        if node == b:
            break
        side = orientation(points[a], points[b], points[node])
        if side == 0.0:
            return TOUCHES, count, node, node
        t = beyond[t, k]
        # The next edge lies opposite to the node that is left behind.
        behind = left if side > 0.0 else right
        right, left = (right, node) if side > 0.0 else (node, left)
        k = 0
        while cells[t, k] != behind:
            k += 1
    return DONE, count, -1, -1


@njit(cache=True)
def _leaving(points: Any, cells: Any, beyond: Any, cell_at: Any, a: int, b: int) -> tuple[int, int]:
    """Triangle at node a that the segment ab runs into, and position of a in it."""
    t = cell_at[a]
    while True:
        k = _position(cells, t, a)
        x, y = cells[t, (k + 1) % 3], cells[t, (k + 2) % 3]
        if x == b or y == b:
            return t, k
        if (
            orientation(points[a], points[x], points[b]) >= 0.0
            and orientation(points[a], points[b], points[y]) > 0.0
        ):
            return t, k
        t = beyond[t, (k + 1) % 3]


@njit(cache=True)
def _cell_of_edge(cells: Any, beyond: Any, cell_at: Any, x: int, y: int) -> tuple[int, int]:
    """A triangle with the edge xy, and the position of its node opposite to the edge."""
    # The nodes of the triangle around all have no ring of triangles; their numbers are the largest.
    x, y = min(x, y), max(x, y)
    t = cell_at[x]
    while True:
        k = _position(cells, t, x)
        if cells[t, (k + 1) % 3] == y:
            return t, (k + 2) % 3
        t = beyond[t, (k + 1) % 3]


@njit(cache=True)
def _position(cells: Any, t: int, node: int) -> int:
    k = 0
    while cells[t, k] != node:
        k += 1
    return k
