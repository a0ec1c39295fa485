# SPDX-License-Identifier: LGPL-3.0-or-later
"""Areas, angles and sizes of triangles."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


def areas(points: Floats, cells: Ints) -> Floats:
    """Signed areas [m^2], positive where the nodes run counterclockwise; shape (n_cells,)."""
    a, b = (points[cells[:, i], :2] - points[cells[:, 0], :2] for i in (1, 2))
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def angles(points: Floats, cells: Ints) -> Floats:
    """Angles [degrees] at the nodes of the triangles, negative if inverted; shape (n_cells, 3)."""
    x = points[cells, :2]
    a, b = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.degrees(np.arctan2(cross, (a * b).sum(axis=2)))


def edge_lengths(points: Floats, cells: Ints) -> Floats:
    """Lengths of the edges opposite to the nodes of the triangles [m]; shape (n_cells, 3)."""
    x = points[cells, :2]
    return np.linalg.norm(np.roll(x, -1, axis=1) - np.roll(x, 1, axis=1), axis=2)


def nodal_sizes(points: Floats, cells: Ints) -> Floats:
    """Mean length of the edges at each node [m], zero at nodes without triangle; (n_points,)."""
    ends = np.sort(cells[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
    _, one = np.unique(ends[:, 0] * len(points) + ends[:, 1], return_index=True)
    nodes = ends[one].ravel()
    length = np.repeat(edge_lengths(points, cells).ravel()[one], 2)
    count = np.bincount(nodes, minlength=len(points))
    return np.bincount(nodes, length, len(points)) / np.maximum(count, 1)
