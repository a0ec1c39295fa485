# SPDX-License-Identifier: LGPL-3.0-or-later
"""Strips of the void between two surfaces, one a mortar segment, and their derivatives."""

from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from .mortar import miss

TINY = 1e-30
"""Imaginary part that differentiates: its square is beyond round-off."""


@numba.njit(cache=True, error_model="numpy")
def strip_moments(
    corners: npt.NDArray[np.float64],
    before: npt.NDArray[np.float64],
    points: npt.NDArray[np.float64],
    ends: npt.NDArray[np.float64],
    moving: npt.NDArray[np.bool_],
    free: npt.NDArray[np.bool_],
    centre: npt.NDArray[np.float64],
    directions: int,
) -> tuple[
    npt.NDArray[np.float64],
    npt.NDArray[np.float64],
    npt.NDArray[np.float64],
    npt.NDArray[np.float64],
    npt.NDArray[np.float64],
]:
    """Integrate 1 and xi - c over strips, and differentiate them.

    A strip lies between the parts of a secondary and a primary edge that face each other; where it
    begins and ends, straight lines connect the same points of both edges now and before. Its area
    is positive where the surfaces are apart. xi is the local coordinate of the secondary edge, c a
    given number.

    Args:
        corners: Nodes of the secondary edge [m], their normals and nodes of the primary edge [m];
            shape (l, 3, 2, 2).
        before: Both edges before; shape (l, 2, 2, 2).
        points: Nodes that make the ends [m]; shape (l, 2, 2).
        ends: Ends of the segments on the secondary edge; shape (l, 2).
        moving: Whether a primary node makes the end; shape (l, 2).
        free: Whether other water stands beyond the end; shape (l, 2).
        centre: The number c; shape (l,).
        directions: 16, or 0 without derivatives.

    Returns:
        Integrals now and before [m^2], shape (l, 2, 2).
        Derivatives of those of now where the connected points stay, with respect to secondary and
        primary nodes, and what the lines at free ends have in the derivative of int 1, times 1 and
        xi there; shape (l, 4, 8).
        Derivatives of what the integrals grow by with respect to secondary nodes, normals, primary
        nodes and nodes that make the ends; shape (l, 2, directions).
        The same of the derivatives; shape (l, 4, 8, directions).
        The same of the ends on the secondary and on the primary edge; shape (l, 2, 2, directions).
    """
    n = len(corners)
    values, slopes = np.zeros((n, 2, 2)), np.zeros((n, 4, 8))
    of_values, of_slopes = np.zeros((n, 2, directions)), np.zeros((n, 4, 8, directions))
    of_ends = np.zeros((n, 2, 2, directions))
    place = np.zeros(16, np.complex128)
    moments, slope = np.zeros((2, 2), np.complex128), np.zeros((4, 8), np.complex128)
    unused = np.zeros((4, 8), np.complex128)
    edges = np.zeros((2, 2, 2), np.complex128)
    old = np.zeros((2, 2, 2), np.complex128)
    own = np.zeros((3, 2, 2), np.complex128)
    s, eta = np.zeros(2, np.complex128), np.zeros(2, np.complex128)
    for k in range(n):
        for j in range(-1, directions):
            for node in range(2):
                for a in range(2):
                    for row in range(3):
                        place[4 * row + 2 * node + a] = corners[k, row, node, a]
                    place[12 + 2 * node + a] = points[k, node, a]
                    for row in range(2):
                        old[row, node, a] = before[k, row, node, a]
            if j >= 0:
                place[j] += 1j * TINY
            for node in range(2):
                for a in range(2):
                    edges[0, node, a] = place[2 * node + a]
                    edges[1, node, a] = place[8 + 2 * node + a]
                    own[0, node, a] = place[2 * node + a]
                    own[1, node, a] = place[4 + 2 * node + a]
            for end in range(2):
                s[end] = ends[k, end]
                if moving[k, end]:
                    own[2, 0] = place[12 + 2 * end : 14 + 2 * end]
                    c0, c1, c2 = miss(own, 0)
                    # One step of Newton's method from the root leaves it and gives its derivative.
                    change = (c0 + s[end] * (c1 + s[end] * c2)) / (c1 + 2.0 * s[end] * c2)
                    s[end] -= 1j * change.imag
                own[2] = edges[1]
                c0, c1, c2 = miss(own, 0)
                f1 = c0 + s[end] * (c1 + s[end] * c2)
                c0, c1, c2 = miss(own, 1)
                f2 = c0 + s[end] * (c1 + s[end] * c2)
                eta[end] = (f1 + f2) / (f1 - f2)
            _integrate(edges, s, eta, free[k], centre[k], moments[0], slope)
            _integrate(old, s, eta, free[k], centre[k], moments[1], unused)
            if j < 0:
                values[k], slopes[k] = moments.real, slope.real
            else:
                of_values[k, :, j] = (moments[0] - moments[1]).imag / TINY
                of_slopes[k, :, :, j] = slope.imag / TINY
                of_ends[k, :, 0, j], of_ends[k, :, 1, j] = s.imag / TINY, eta.imag / TINY
    return values, slopes, of_values, of_slopes, of_ends


@numba.njit(cache=True)
def _integrate(
    edges: Any, s: Any, eta: Any, free: Any, c: float, moments: Any, slopes: Any
) -> None:
    """Integrals of 1 and xi - c over a strip, and derivatives with respect to the edges' nodes.

    A line from y to x that moves sweeps d A = (d x + d y) x (x - y) / 2.

    Args:
        edges: Nodes of both edges; shape (2, 2, 2).
        s: Ends of the strip on the secondary edge; shape (2,).
        eta: The same on the primary edge; shape (2,).
        free: Which ends are free; shape (2,).
        c: The number c.
        moments: Integrals to be written; shape (2,).
        slopes: Derivatives to be written, and those of free ends; shape (4, 8).
    """
    shapes = np.empty((2, 2, 2), edges.dtype)  # edge, end, node
    for end in range(2):
        shapes[0, end, 0], shapes[0, end, 1] = 0.5 * (1.0 - s[end]), 0.5 * (1.0 + s[end])
        shapes[1, end, 0], shapes[1, end, 1] = 0.5 * (1.0 - eta[end]), 0.5 * (1.0 + eta[end])
    across, along = np.empty((2, 2), edges.dtype), np.empty(2, edges.dtype)
    for a in range(2):
        along[a] = 0.0
        for end in range(2):
            x = shapes[0, end, 0] * edges[0, 0, a] + shapes[0, end, 1] * edges[0, 1, a]
            y = shapes[1, end, 0] * edges[1, 0, a] + shapes[1, end, 1] * edges[1, 1, a]
            across[end, a] = x - y
            along[a] += (2 * end - 1) * (x + y)
    weights = np.empty(2, edges.dtype)
    moments[:] = 0.0
    slopes[:] = 0.0
    for end in range(2):
        height = 0.5 * (along[0] * across[end, 1] - along[1] * across[end, 0])
        # int (1, xi - c) of the linear function that is 1 at this end
        other = 1 - end
        weights[0], weights[1] = 0.5, (s[end] - c) / 3.0 + (s[other] - c) / 6.0
        for t in range(2):
            moments[t] += weights[t] * height
            for edge in range(2):
                side = 1.0 - 2.0 * edge
                for node in range(2):
                    d_along = shapes[edge, 1, node] - shapes[edge, 0, node]
                    d_across = side * shapes[edge, end, node]
                    i = 4 * edge + 2 * node
                    of_x = d_along * across[end, 1] - d_across * along[1]
                    of_y = -d_along * across[end, 0] + d_across * along[0]
                    slopes[t, i] += 0.5 * weights[t] * of_x
                    slopes[t, i + 1] += 0.5 * weights[t] * of_y
        if free[end]:
            for edge in range(2):
                for node in range(2):
                    share = 0.5 * (2 * end - 1) * shapes[edge, end, node]
                    i = 4 * edge + 2 * node
                    slopes[2, i] += share * across[end, 1]
                    slopes[2, i + 1] -= share * across[end, 0]
                    slopes[3, i] += share * across[end, 1] * s[end]
                    slopes[3, i + 1] -= share * across[end, 0] * s[end]
