# SPDX-License-Identifier: LGPL-3.0-or-later
"""Geometry of node cells: patches, areas and smoothed gradients (Eqs. 31-38)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True)
def patch_nodes(cells: Any, around_offsets: Any, around: Any, n_owned: int, n_nodes: int) -> Any:
    """Nodes of the triangles around each owned node, the node itself first.

    Args:
        cells: Nodes of each triangle; shape (n_cells, 3), int32.
        around_offsets: Where the triangles of each node begin in ``around``; shape (n_nodes + 1,).
        around: Triangles around the nodes, one node after the other.
        n_owned: Number of nodes that get a cell: the first ones.
        n_nodes: Number of all nodes.

    Returns:
        Offsets (n_owned + 1,) and nodes, both int32.
    """
    seen = np.full(n_nodes, -1, np.int32)
    offsets = np.zeros(n_owned + 1, np.int32)
    nodes = np.empty(n_owned * 8, np.int32)
    count = 0
    for c in range(n_owned):
        begin, end = around_offsets[c], around_offsets[c + 1]
        if count + 2 * (end - begin) + 1 > nodes.size:
            larger = np.empty(2 * nodes.size + 2 * (end - begin) + 1, np.int32)
            larger[:count] = nodes[:count]
            nodes = larger
        seen[c] = c
        nodes[count] = c
        count += 1
        for k in range(begin, end):
            for node in cells[around[k]]:
                if seen[node] != c:
                    seen[node] = c
                    nodes[count] = node
                    count += 1
        offsets[c + 1] = count
    return offsets, nodes[:count].copy()


@njit(cache=True)
def smoothed_gradients(
    cells: Any, x: Any, around_offsets: Any, around: Any, offsets: Any, nodes: Any
) -> Any:
    """Mean and second gradients of the shape functions over each node cell.

    Args:
        cells: Nodes of each triangle; shape (n_cells, 3), int32.
        x: Node coordinates [m]; shape (n_nodes, 2).
        around_offsets: Where the triangles of each node begin in ``around``; shape (n_nodes + 1,).
        around: Triangles around the nodes.
        offsets: Where each patch begins in ``nodes``; shape (n_owned + 1,).
        nodes: Nodes of the patches, the cell's own node first.

    Returns:
        Areas A_c [m^2] of the cells (n_owned,), and for every entry of ``nodes`` the mean gradient
        [1/m] and its derivatives along x and y [1/m^2]; shape (entries, 3, 2).
    """
    n_owned = offsets.size - 1
    areas = np.zeros(n_owned)
    gradients = np.zeros((nodes.size, 3, 2))
    position = np.zeros(x.shape[0], np.int32)
    for c in range(n_owned):
        for k in range(offsets[c], offsets[c + 1]):
            position[nodes[k]] = k
        begin, end = around_offsets[c], around_offsets[c + 1]
        area = 0.0
        for k in range(begin, end):
            i, j, m = cells[around[k]]
            area += (
                abs(
                    (x[j, 0] - x[i, 0]) * (x[m, 1] - x[i, 1])
                    - (x[m, 0] - x[i, 0]) * (x[j, 1] - x[i, 1])
                )
                / 6.0
            )
        areas[c] = area
        mean_x = mean_y = 0.0
        for sweep in range(2):  # the second gradient needs the means of phi (Eq. 36) first
            for k in range(begin, end):
                triangle = cells[around[k]]
                i, j, m = triangle
                twice = (x[j, 0] - x[i, 0]) * (x[m, 1] - x[i, 1]) - (x[m, 0] - x[i, 0]) * (
                    x[j, 1] - x[i, 1]
                )
                alpha = abs(twice) / 6.0 / area
                b = (x[i, 0] + x[j, 0] + x[m, 0]) / 3.0 - x[c, 0]
                h = (x[i, 1] + x[j, 1] + x[m, 1]) / 3.0 - x[c, 1]
                phi_x = 2.0 * b / (b * b + h * h)
                phi_y = 2.0 * h / (b * b + h * h)
                if sweep == 0:
                    mean_x += alpha * phi_x
                    mean_y += alpha * phi_y
                    continue
                weight_x = alpha * (phi_x - mean_x)
                weight_y = alpha * (phi_y - mean_y)
                for a in range(3):
                    p = triangle[(a + 1) % 3]
                    q = triangle[(a + 2) % 3]
                    gx = (x[p, 1] - x[q, 1]) / twice
                    gy = (x[q, 0] - x[p, 0]) / twice
                    entry = gradients[position[triangle[a]]]
                    entry[0, 0] += alpha * gx
                    entry[0, 1] += alpha * gy
                    entry[1, 0] += weight_x * gx
                    entry[1, 1] += weight_x * gy
                    entry[2, 0] += weight_y * gx
                    entry[2, 1] += weight_y * gy
    return areas, gradients


@njit(cache=True)
def point_gradients(
    offsets: Any, nodes: Any, gradients: Any, areas: Any, values: Any, n_points: int
) -> Any:
    """Gradients of nodal fields at the smoothing points (Eq. 37).

    Args:
        offsets: Where each patch begins; shape (n_cells + 1,).
        nodes: Nodes of the patches.
        gradients: Result of `smoothed_gradients`.
        areas: Cell areas [m^2]; shape (n_cells,).
        values: Nodal values; shape (n_nodes, components).
        n_points: 4, or 1 for the mean alone.

    Returns:
        Gradients; shape (n_cells, n_points, components, 2).
    """
    n_cells = areas.size
    components = values.shape[1]
    result = np.zeros((n_cells, n_points, components, 2))
    for c in range(n_cells):
        radius = np.sqrt(areas[c] / np.pi)
        for k in range(offsets[c], offsets[c + 1]):
            for point in range(n_points):
                axis = 1 + point // 2
                distance = 0.0 if n_points == 1 else radius * (2 * (point % 2) - 1)
                gx = gradients[k, 0, 0] + distance * gradients[k, axis, 0]
                gy = gradients[k, 0, 1] + distance * gradients[k, axis, 1]
                for a in range(components):
                    result[c, point, a, 0] += gx * values[nodes[k], a]
                    result[c, point, a, 1] += gy * values[nodes[k], a]
    return result


@njit(cache=True)
def triangle_gradients(cells: Any, x: Any) -> Any:
    """Gradients of the shape functions on triangles [1/m].

    Args:
        cells: Nodes of each triangle; shape (n_cells, 3), int32.
        x: Node coordinates [m]; shape (n_nodes, 2).

    Returns:
        Shape (n_cells, 3, 2).
    """
    result = np.empty((cells.shape[0], 3, 2))
    for t in range(cells.shape[0]):
        i, j, m = cells[t]
        twice = (x[j, 0] - x[i, 0]) * (x[m, 1] - x[i, 1]) - (x[m, 0] - x[i, 0]) * (
            x[j, 1] - x[i, 1]
        )
        for a in range(3):
            p, q = cells[t, (a + 1) % 3], cells[t, (a + 2) % 3]
            result[t, a, 0] = (x[p, 1] - x[q, 1]) / twice
            result[t, a, 1] = (x[q, 0] - x[p, 0]) / twice
    return result


@njit(cache=True)
def patch_corners(
    cells: Any, triangle_offsets: Any, triangles: Any, offsets: Any, nodes: Any, n_nodes: int
) -> Any:
    """Where the vertices of each cell's triangles stand in its patch.

    Args:
        cells: Nodes of each triangle; shape (n_cells, 3), int32.
        triangle_offsets: Where each cell's triangles begin in ``triangles``.
        triangles: Triangles around each node.
        offsets: Where each patch begins in ``nodes``.
        nodes: Nodes of the patches.
        n_nodes: Number of all nodes.

    Returns:
        Entries of ``nodes``; shape (triangles.size, 3), int32.
    """
    position = np.zeros(n_nodes, np.int32)
    result = np.empty((triangles.size, 3), np.int32)
    for c in range(offsets.size - 1):
        for k in range(offsets[c], offsets[c + 1]):
            position[nodes[k]] = k
        for k in range(triangle_offsets[c], triangle_offsets[c + 1]):
            for i in range(3):
                result[k, i] = position[cells[triangles[k], i]]
    return result


@njit(cache=True)
def turn_axes(gradients: Any, offsets: Any, angles: Any) -> None:
    """Turn second gradients from the global axes to those of each cell, in place.

    Args:
        gradients: Result of `smoothed_gradients`; shape (entries, 3, 2).
        offsets: Where each patch begins; shape (n_cells + 1,).
        angles: Angle of each cell's first axis to x, counterclockwise [rad]; shape (n_cells,).
    """
    for cell in range(angles.size):
        c, s = np.cos(angles[cell]), np.sin(angles[cell])
        for k in range(offsets[cell], offsets[cell + 1]):
            for i in range(2):
                along_x, along_y = gradients[k, 1, i], gradients[k, 2, i]
                gradients[k, 1, i] = c * along_x + s * along_y
                gradients[k, 2, i] = c * along_y - s * along_x


@njit(cache=True)
def inverted_triangles(cells: Any, x: Any, dofs: Any, step: Any) -> Any:
    """Triangles that a displacement turns inside out, or that have no area.

    Args:
        cells: Nodes of each triangle; shape (n_cells, 3), int32.
        x: Node coordinates [m]; shape (n_nodes, 2) or more columns.
        dofs: Row of ``step`` of each vertex; shape (n_cells, 3) or more columns.
        step: Displacements [m]; shape (n_dofs, 2).

    Returns:
        Marks; shape (n_cells,).
    """
    result = np.zeros(cells.shape[0], np.bool_)
    edges, moved = np.empty((2, 2)), np.empty((2, 2))
    for t in range(cells.shape[0]):
        for k in range(2):
            for a in range(2):
                edges[k, a] = x[cells[t, k + 1], a] - x[cells[t, 0], a]
                moved[k, a] = edges[k, a] + step[dofs[t, k + 1], a] - step[dofs[t, 0], a]
        before = edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0]
        after = moved[0, 0] * moved[1, 1] - moved[0, 1] * moved[1, 0]
        # Written so that it holds for NaN as well.
        result[t] = not before * after > 0.0
    return result
