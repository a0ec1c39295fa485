# SPDX-License-Identifier: LGPL-3.0-or-later
"""Integrals over mortar segments and their derivatives.

Derivatives are with respect to the coordinates of the nodes of the secondary edge, the components
of their normals, the nodes of the primary edge, and the nodes that end the segment, in this order.
"""

import numba
import numpy as np
import numpy.typing as npt

from .mortar import GAUSS_POINTS, GAUSS_WEIGHTS, miss


@numba.njit(cache=True, error_model="numpy")
def end_derivatives(
    corners: npt.NDArray[np.float64],
    ends: npt.NDArray[np.float64],
    moving: npt.NDArray[np.bool_],
    points: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """Differentiate the ends of segments: the roots of f(s), see `miss`.

    Args:
        corners: Nodes of the secondary edge [m], their normals and nodes of the primary edge [m];
            shape (l, 3, 2, 2).
        ends: Ends of the segments on the secondary edge; shape (l, 2).
        moving: Whether a primary node makes the end; shape (l, 2).
        points: Those nodes [m]; shape (l, 2, 2).

    Returns:
        Derivatives with respect to secondary nodes, normals and the node that makes the end; shape
        (l, 2, 10).
    """
    result = np.zeros((len(corners), 2, 10))
    own = np.empty((3, 2, 2))
    for k in range(len(corners)):
        own[:2] = corners[k, :2]
        for end in range(2):
            if not moving[k, end]:
                continue
            own[2, 0] = points[k, end]
            s = ends[k, end]
            shape = 0.5 * (1.0 - s), 0.5 * (1.0 + s)
            x = shape[0] * own[0, 0] + shape[1] * own[0, 1]
            n = shape[0] * own[1, 0] + shape[1] * own[1, 1]
            away = x - own[2, 0]
            _, c1, c2 = miss(own, 0)
            slope = c1 + 2.0 * s * c2
            for a in range(2):
                result[k, end, 2 * a] = -shape[a] * n[1] / slope
                result[k, end, 2 * a + 1] = shape[a] * n[0] / slope
                result[k, end, 4 + 2 * a] = shape[a] * away[1] / slope
                result[k, end, 5 + 2 * a] = -shape[a] * away[0] / slope
            result[k, end, 8] = n[1] / slope
            result[k, end, 9] = -n[0] / slope
    return result


@numba.njit(cache=True, error_model="numpy")
def segment_integrals(
    corners: npt.NDArray[np.float64],
    ends: npt.NDArray[np.float64],
    d_ends: npt.NDArray[np.float64],
    centre: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Integrate what the mortar coupling consists of over segments, and differentiate it.

    The integrands are N_1, N_2, (xi - c) N_1 and (xi - c) N_2, N the shape functions of the primary
    edge, xi the local coordinate of the secondary edge and c a given number. The sums over the
    Gauss points are differentiated, so the derivatives are exact to round-off.

    Args:
        corners: Nodes of the secondary edge [m], their normals and nodes of the primary edge [m];
            shape (l, 3, 2, 2).
        ends: Ends of the segments on the secondary edge; shape (l, 2).
        d_ends: Their derivatives from `end_derivatives`; shape (l, 2, 10).
        centre: The number c; shape (l,).

    Returns:
        Integrals [m], shape (l, 4), and their derivatives with respect to secondary nodes, normals,
        primary nodes and the nodes that make the ends; shape (l, 4, 16).
    """
    values, derivatives = np.zeros((len(corners), 4)), np.zeros((len(corners), 4, 16))
    d_low, d_high = np.zeros(16), np.zeros(16)
    d_length, d_eta = np.zeros(16), np.zeros(16)
    for k in range(len(corners)):
        x, normals, y = corners[k]
        edge = x[1] - x[0]
        length = np.hypot(edge[0], edge[1])
        for a in range(2):
            d_length[a], d_length[2 + a] = -edge[a] / length, edge[a] / length
        half = 0.5 * (ends[k, 1] - ends[k, 0])
        d_low[:8], d_low[12:14] = d_ends[k, 0, :8], d_ends[k, 0, 8:]
        d_high[:8], d_high[14:] = d_ends[k, 1, :8], d_ends[k, 1, 8:]
        for g in range(3):
            point = GAUSS_POINTS[g]
            xi = 0.5 * (ends[k, 0] + ends[k, 1]) + half * point
            shape = 0.5 * (1.0 - xi), 0.5 * (1.0 + xi)
            n0 = shape[0] * normals[0, 0] + shape[1] * normals[1, 0]
            n1 = shape[0] * normals[0, 1] + shape[1] * normals[1, 1]
            at0 = shape[0] * x[0, 0] + shape[1] * x[1, 0]
            at1 = shape[0] * x[0, 1] + shape[1] * x[1, 1]
            first = at0 - y[0, 0], at1 - y[0, 1]
            second = at0 - y[1, 0], at1 - y[1, 1]
            f1, f2 = first[0] * n1 - first[1] * n0, second[0] * n1 - second[1] * n0
            # eta = (f1 + f2) / (f1 - f2)
            eta = (f1 + f2) / (f1 - f2)
            by_f1, by_f2 = -2.0 * f2 / (f1 - f2) ** 2, 2.0 * f1 / (f1 - f2) ** 2
            mean0, mean1 = (
                by_f1 * first[0] + by_f2 * second[0],
                by_f1 * first[1] + by_f2 * second[1],
            )
            by_f = by_f1 + by_f2
            for a in range(2):
                d_eta[2 * a], d_eta[2 * a + 1] = shape[a] * by_f * n1, -shape[a] * by_f * n0
                d_eta[4 + 2 * a], d_eta[5 + 2 * a] = -shape[a] * mean1, shape[a] * mean0
            d_eta[8], d_eta[9] = -by_f1 * n1, by_f1 * n0
            d_eta[10], d_eta[11] = -by_f2 * n1, by_f2 * n0
            turn0, turn1 = 0.5 * (normals[1] - normals[0])
            eta_xi = 0.5 * by_f * (edge[0] * n1 - edge[1] * n0) + mean0 * turn1 - mean1 * turn0

            rule = 0.5 * GAUSS_WEIGHTS[g]
            weight, offset = rule * half * length, xi - centre[k]
            N1, N2 = 0.5 * (1.0 - eta), 0.5 * (1.0 + eta)
            values[k, 0] += weight * N1
            values[k, 1] += weight * N2
            values[k, 2] += weight * offset * N1
            values[k, 3] += weight * offset * N2
            for j in range(16):
                d_xi = 0.5 * ((1.0 - point) * d_low[j] + (1.0 + point) * d_high[j])
                d_weight = rule * (half * d_length[j] + 0.5 * length * (d_high[j] - d_low[j]))
                d_N2 = 0.5 * weight * (d_eta[j] + eta_xi * d_xi)
                d_offset = d_weight * offset + weight * d_xi
                derivatives[k, 0, j] += d_weight * N1 - d_N2
                derivatives[k, 1, j] += d_weight * N2 + d_N2
                derivatives[k, 2, j] += d_offset * N1 - offset * d_N2
                derivatives[k, 3, j] += d_offset * N2 + offset * d_N2
    return values, derivatives
