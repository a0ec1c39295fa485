# SPDX-License-Identifier: LGPL-3.0-or-later
"""Integrals over mortar segments and their derivatives by a complex step."""

from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from .mortar import SHORTEST_SEGMENT, gauss_points, miss

STEP = 1e-30
"""Complex step as a part of the length of an edge; its square vanishes beside 1."""


@numba.njit(cache=True)
def _distance(corners: Any, node: int, s: float) -> float:
    c0, c1, c2 = miss(corners, node)
    return abs(c0 + s * (c1 + s * c2))


@numba.njit(cache=True, error_model="numpy")
def segment_integrals(
    corners: npt.NDArray[np.float64],
    ends: npt.NDArray[np.float64],
    centre: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Integrate what the mortar coupling consists of over segments, and differentiate it.

    The integrands are N_1, N_2, (xi - c) N_1, (xi - c) N_2 and (xi - c)^2, N the shape functions
    of the primary edge, xi the local coordinate of the secondary edge and c a given number. The
    derivatives are exact to round-off (Squire and Trapp 1998).

    Args:
        corners: Nodes of the secondary edge [m], their normals and nodes of the primary edge [m];
            shape (l, 3, 2, 2).
        ends: Ends of the segments on the secondary edge; shape (l, 2).
        centre: The number c; shape (l,).

    Returns:
        Integrals [m], shape (5, l), and their derivatives with respect to the corners, shape
        (5, l, 12). An end of a segment moves with the node that it comes from.
    """
    number = len(corners)
    values, derivatives = np.empty((5, number)), np.empty((5, number, 12))
    moving, moved = np.empty((12, 3, 2, 2), dtype=np.complex128), np.empty((12, 2), np.complex128)
    sums, nodes = np.empty(5, dtype=np.complex128), np.empty(2, dtype=np.int64)
    for s in range(number):
        edge = corners[s, 0, 1] - corners[s, 0, 0]
        step = STEP * np.hypot(edge[0], edge[1])
        for end in range(2):
            at = ends[s, end]
            nodes[end] = int(_distance(corners[s], 1, at) < _distance(corners[s], 0, at))
        for k in range(12):
            moving[k] = corners[s]
            moving[k, k // 4, k // 2 % 2, k % 2] += 1j * step
            for end in range(2):
                moved[k, end] = at = ends[s, end]
                if abs(at) < 1.0 - SHORTEST_SEGMENT:
                    # One step of Newton's method carries the derivative of the root.
                    c0, c1, c2 = miss(moving[k], nodes[end])
                    moved[k, end] -= (c0 + at * (c1 + at * c2)) / (c1 + 2.0 * at * c2)
        xi, eta, weight = gauss_points(moving, moved)
        for k in range(12):
            sums[:] = 0.0
            for g in range(3):
                first = 0.5 * weight[k, g] * (1.0 - eta[k, g])
                second = 0.5 * weight[k, g] * (1.0 + eta[k, g])
                offset = xi[k, g] - centre[s]
                sums[0] += first
                sums[1] += second
                sums[2] += offset * first
                sums[3] += offset * second
                sums[4] += offset * offset * weight[k, g]
            derivatives[:, s, k] = sums.imag / step
        values[:, s] = sums.real
    return values, derivatives
