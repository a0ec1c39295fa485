# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which parts of the edges of one surface face which edge of another, and Gauss points on them."""

from typing import Any

import numba
import numpy as np
import numpy.typing as npt

SHORTEST_SEGMENT = 1e-10
"""Segments shorter than this are skipped; local coordinate of the secondary edge, from -1 to 1."""

GAUSS_POINTS, GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(3)


@numba.njit(cache=True)
def miss(corners: Any, node: int) -> Any:
    """Coefficients of f(s) = (x(s) - y) x n(s) = c0 + c1 s + c2 s^2.

    It vanishes where the normal n(s) of a point x(s) of a secondary edge meets a node y of a
    primary edge.

    Args:
        corners: Nodes of the secondary edge, their normals and nodes of the primary edge, real or
            complex; shape (3, 2, 2).
        node: Which node of the primary edge.
    """
    (x1, x2), (n1, n2), y = corners[0], corners[1], corners[2, node]
    half = 0.5 * (x2[0] - x1[0]), 0.5 * (x2[1] - x1[1])
    away = 0.5 * (x1[0] + x2[0]) - y[0], 0.5 * (x1[1] + x2[1]) - y[1]
    turn = 0.5 * (n2[0] - n1[0]), 0.5 * (n2[1] - n1[1])
    normal = 0.5 * (n1[0] + n2[0]), 0.5 * (n1[1] + n2[1])
    return _cross(away, normal), _cross(half, normal) + _cross(away, turn), _cross(half, turn)


@numba.njit(cache=True)
def _cross(a: Any, b: Any) -> Any:
    return a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True, error_model="numpy")
def _roots(c0: float, c1: float, c2: float) -> tuple[float, float]:
    """Roots of c0 + c1 s + c2 s^2 without cancellation; not finite where there are fewer."""
    q = -0.5 * (c1 + np.copysign(np.sqrt(c1 * c1 - 4.0 * c0 * c2), c1))
    return c0 / q, q / c2


@numba.njit(cache=True)
def segments(
    x: npt.NDArray[np.float64],
    normals: npt.NDArray[np.float64],
    edges: npt.NDArray[np.int32],
    y: npt.NDArray[np.float64],
    primary_edges: npt.NDArray[np.int32],
    pairs: npt.NDArray[np.int64],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Find the parts of secondary edges from which the normal meets the front of a primary edge.

    A point x(s) of a secondary edge looks along n(s) = N_1 n_1 + N_2 n_2, not normalised, and sees
    y where f(s) = (x(s) - y) x n(s) vanishes (Yang, Laursen and Meng 2005). The bodies lie left of
    their edges, so it sees the front of the edge from y_1 to y_2 where f_1 < 0 < f_2.

    Args:
        x: Nodes of the secondary surface [m]; shape (n_s, 2).
        normals: Their normals, which point into the secondary body; shape (n_s, 2).
        edges: Edges of the secondary surface, body on the left; shape (m_s, 2).
        y: Nodes of the primary surface [m]; shape (n_m, 2).
        primary_edges: Edges of the primary surface, body on the left; shape (m_m, 2).
        pairs: Secondary and primary edge of every candidate pair; shape (k, 2).

    Returns:
        Pair of every segment, shape (l,); its ends on the secondary edge, shape (l, 2). A pair has
        more than one segment only where normals of an edge cross before they meet the primary edge.
    """
    of_pairs = np.empty(3 * len(pairs), dtype=np.int64)
    ends = np.empty((3 * len(pairs), 2))
    number = 0
    c = np.empty((2, 3))
    breaks = np.empty(6)
    corners = np.empty((3, 2, 2))
    for k in range(len(pairs)):
        for end in range(2):
            i, j = edges[pairs[k, 0], end], primary_edges[pairs[k, 1], end]
            corners[0, end], corners[1, end], corners[2, end] = x[i], normals[i], y[j]
        breaks[4:] = -1.0, 1.0
        for end in range(2):
            c[end] = miss(corners, end)
            breaks[2 * end], breaks[2 * end + 1] = _roots(c[end, 0], c[end, 1], c[end, 2])
        for b in range(4):
            if not -1.0 < breaks[b] < 1.0:
                breaks[b] = 1.0
        breaks.sort()
        for b in range(5):
            low, high = breaks[b], breaks[b + 1]
            s = 0.5 * (low + high)
            f1 = c[0, 0] + s * (c[0, 1] + s * c[0, 2])
            f2 = c[1, 0] + s * (c[1, 1] + s * c[1, 2])
            if high - low >= SHORTEST_SEGMENT and f1 < 0.0 < f2:
                of_pairs[number] = k
                ends[number] = low, high
                number += 1
    return of_pairs[:number], ends[:number]


@numba.njit(cache=True, error_model="numpy")
def gauss_points(corners: Any, ends: Any) -> Any:
    """Place three Gauss points on every segment.

    They are exact for products of shape functions where the normal does not turn.

    Args:
        corners: Nodes of the secondary edge [m], their normals and nodes of the primary edge [m],
            real or complex; shape (l, 3, 2, 2).
        ends: Ends of the segments on the secondary edge; shape (l, 2).

    Returns:
        Local coordinates on the secondary edge and on the primary edge, and weights [m]; shapes
        (l, 3).
    """
    xi = np.empty((len(ends), 3), ends.dtype)
    eta, weight = np.empty_like(xi), np.empty_like(xi)
    for k in range(len(ends)):
        first, second = miss(corners[k], 0), miss(corners[k], 1)
        dx, dy = corners[k, 0, 1] - corners[k, 0, 0]
        length = np.sqrt(dx * dx + dy * dy)
        half = 0.5 * (ends[k, 1] - ends[k, 0])
        for g in range(3):
            s = 0.5 * (ends[k, 0] + ends[k, 1]) + half * GAUSS_POINTS[g]
            f1 = first[0] + s * (first[1] + s * first[2])
            f2 = second[0] + s * (second[1] + s * second[2])
            xi[k, g], eta[k, g] = s, (f1 + f2) / (f1 - f2)
            weight[k, g] = 0.5 * half * GAUSS_WEIGHTS[g] * length
    return xi, eta, weight
