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


@numba.njit(cache=True)
def _length(nodes: Any) -> Any:
    return np.hypot(nodes[1, 0] - nodes[0, 0], nodes[1, 1] - nodes[0, 1])


@numba.njit(cache=True)
def _never_negative(c: Any) -> bool:
    """Whether the Bernstein coefficients of c0 + c1 s + c2 s^2 on [-1, 1] bound it from below."""
    return c[0] + c[2] >= abs(c[1]) and c[0] >= c[2]


@numba.njit(cache=True, error_model="numpy")
def _roots(c0: float, c1: float, c2: float) -> tuple[float, float]:
    """Roots of c0 + c1 s + c2 s^2 without cancellation; not finite where there are fewer."""
    q = -0.5 * (c1 + np.copysign(np.sqrt(c1 * c1 - 4.0 * c0 * c2), c1))
    return c0 / q, q / c2


@numba.njit(cache=True, error_model="numpy")
def _facing(c: Any, s: float, corners: Any) -> tuple[float, float, float]:
    """What a point of a secondary edge sees of a primary edge.

    Args:
        c: Coefficients of f_1 and f_2, see `miss`; shape (2, 3).
        s: Local coordinate of the point.
        corners: Nodes of the secondary edge, their normals and nodes of the primary edge; shape
            (3, 2, 2).

    Returns:
        f_1 and f_2 at the point, and its distance from the line of the primary edge along the
        normal [m].
    """
    f1 = c[0, 0] + s * (c[0, 1] + s * c[0, 2])
    f2 = c[1, 0] + s * (c[1, 1] + s * c[1, 2])
    eta = (f1 + f2) / (f1 - f2)
    away = np.empty(2)
    for axis in range(2):
        x = 0.5 * ((1.0 - s) * corners[0, 0, axis] + (1.0 + s) * corners[0, 1, axis])
        y = 0.5 * ((1.0 - eta) * corners[2, 0, axis] + (1.0 + eta) * corners[2, 1, axis])
        away[axis] = x - y
    return f1, f2, np.hypot(away[0], away[1])


@numba.njit(cache=True)
def _sort(values: Any, labels: Any) -> None:
    """Sort a few values, and their labels with them, by insertion."""
    for k in range(1, len(values)):
        value, label, at = values[k], labels[k], k
        while at > 0 and values[at - 1] > value:
            values[at], labels[at] = values[at - 1], labels[at - 1]
            at -= 1
        values[at], labels[at] = value, label


@numba.njit(cache=True)
def segments(
    x: npt.NDArray[np.float64],
    normals: npt.NDArray[np.float64],
    edges: npt.NDArray[np.int32],
    y: npt.NDArray[np.float64],
    primary_edges: npt.NDArray[np.int32],
    pairs: npt.NDArray[np.int64],
    radius: float,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64], npt.NDArray[np.int32]]:
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
        radius: Largest distance of a segment's middle, as a multiple of the longer edge.

    Returns:
        Pair of every segment, shape (l,); its ends on the secondary edge, shape (l, 2); the nodes
        of the primary surface that end it, -1 where the secondary edge ends, shape (l, 2). A pair
        has more than one segment only where normals of an edge cross before they meet the primary
        edge.
    """
    of_pairs = np.empty(3 * len(pairs), dtype=np.int64)
    ends = np.empty((3 * len(pairs), 2))
    end_nodes = np.empty((3 * len(pairs), 2), dtype=np.int32)
    number = 0
    c = np.empty((2, 3))
    breaks, nodes = np.empty(6), np.empty(6, dtype=np.int32)
    corners = np.empty((3, 2, 2))
    for k in range(len(pairs)):
        for end in range(2):
            i, j = edges[pairs[k, 0], end], primary_edges[pairs[k, 1], end]
            corners[0, end], corners[1, end], corners[2, end] = x[i], normals[i], y[j]
        c[0], c[1] = miss(corners, 0), miss(corners, 1)
        if _never_negative(c[0]) or _never_negative(-c[1]):
            continue
        longer = max(_length(corners[0]), _length(corners[2]))
        for end in range(2):
            breaks[2 * end], breaks[2 * end + 1] = _roots(c[end, 0], c[end, 1], c[end, 2])
            nodes[2 * end : 2 * end + 2] = primary_edges[pairs[k, 1], end]
        breaks[4:], nodes[4:] = (-1.0, 1.0), -1
        for b in range(4):
            if not -1.0 < breaks[b] < 1.0:
                breaks[b], nodes[b] = 1.0, -1
        _sort(breaks, nodes)
        for b in range(5):
            low, high = breaks[b], breaks[b + 1]
            if high - low < SHORTEST_SEGMENT:
                continue
            s = 0.5 * (low + high)
            f1, f2, distance = _facing(c, s, corners)
            if f1 < 0.0 < f2 and distance <= radius * longer:
                of_pairs[number] = k
                ends[number] = low, high
                end_nodes[number, 0] = -1 if low <= SHORTEST_SEGMENT - 1.0 else nodes[b]
                end_nodes[number, 1] = -1 if high >= 1.0 - SHORTEST_SEGMENT else nodes[b + 1]
                number += 1
    return of_pairs[:number].copy(), ends[:number].copy(), end_nodes[:number].copy()


@numba.njit(cache=True)
def nearest(
    starts: npt.NDArray[np.int64],
    corners: npt.NDArray[np.float64],
    ends: npt.NDArray[np.float64],
    end_nodes: npt.NDArray[np.int32],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64], npt.NDArray[np.int32]]:
    """Leave every point of secondary edges the nearest of the primary edges that it sees.

    Args:
        starts: Where the segments of each secondary edge start, and their number; shape (k + 1,).
        corners: Nodes of the secondary edge [m], their normals and nodes of the primary edge [m];
            shape (l, 3, 2, 2).
        ends: Ends of the segments on the secondary edge; shape (l, 2).
        end_nodes: Primary nodes that end them, -1 where the secondary edge ends; shape (l, 2).

    Returns:
        Segment that every remaining piece is a part of, shape (p,); ends of the pieces and nodes
        that end them, those of another segment where that one cuts it, shape (p, 2).
    """
    count = 0
    for k in range(len(starts) - 1):
        count += 2 * (starts[k + 1] - starts[k])
    source = np.empty(count, dtype=np.int64)
    parts, nodes = np.empty((count, 2)), np.empty((count, 2), dtype=np.int32)
    number = 0
    c = np.empty((2, 3))
    for k in range(len(starts) - 1):
        first, last = starts[k], starts[k + 1]
        breaks, labels = ends[first:last].copy().ravel(), end_nodes[first:last].copy().ravel()
        _sort(breaks, labels)
        before = -1
        for b in range(len(breaks) - 1):
            if breaks[b + 1] - breaks[b] < SHORTEST_SEGMENT:
                continue
            s = 0.5 * (breaks[b] + breaks[b + 1])
            best, least = -1, np.inf
            for j in range(first, last):
                if ends[j, 0] < s < ends[j, 1]:
                    c[0], c[1] = miss(corners[j], 0), miss(corners[j], 1)
                    distance = _facing(c, s, corners[j])[2]
                    if distance < least:
                        best, least = j, distance
            if best >= 0 and best != before:
                own = abs(ends[best, 0] - breaks[b]) < SHORTEST_SEGMENT
                source[number] = best
                parts[number, 0] = ends[best, 0] if own else breaks[b]
                nodes[number, 0] = end_nodes[best, 0] if own else labels[b]
                number += 1
            if best >= 0:
                own = abs(ends[best, 1] - breaks[b + 1]) < SHORTEST_SEGMENT
                parts[number - 1, 1] = ends[best, 1] if own else breaks[b + 1]
                nodes[number - 1, 1] = end_nodes[best, 1] if own else labels[b + 1]
            before = best
    return source[:number].copy(), parts[:number].copy(), nodes[:number].copy()


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
