# SPDX-License-Identifier: LGPL-3.0-or-later
"""Return of trial stresses to yield surfaces that are planes in the space of principal stresses."""

from typing import Any

import numba
import numpy as np

ROUNDING = 1e-9
"""What a condition of a region may be missed by, relative to the trial stress, and still hold."""


@numba.njit(cache=True, error_model="numpy")
def _region(conditions: Any, offsets: Any, s: Any) -> Any:
    """Region of the yield surface that sorted principal stresses return to.

    Returns:
        The first region whose conditions all hold, and 0. If there is none, as on the border of two
        regions by rounding, the one that misses them by least, and by how much [Pa], negative; the
        last one, and not a number, for stresses that are not numbers.
    """
    best, least = 0, np.nan
    for region in range(len(offsets)):
        margin = np.inf
        for k in range(offsets.shape[1]):
            value = offsets[region, k]
            for i in range(3):
                value += conditions[region, k, i] * s[i]
            margin = margin if value > margin else value
        if margin >= 0.0:
            return region, 0.0
        if not margin <= least:
            best, least = region, margin
    return best, least


@numba.njit(cache=True, error_model="numpy")
def _turn(P: Any, alike: bool, r: float, r_new: float, a: int, b: int) -> float:
    """Derivative of the shear stress across the principal axes by its trial value: r_new / r.

    Where a region treats both in-plane principal stresses alike, r_new is proportional to r. It is
    so in the limit of none, which rounding may bring into other regions.
    """
    if alike or r == 0.0:
        return 0.5 * (P[a, a] - P[a, b] - P[b, a] + P[b, b])
    return min(max(r_new / r, 0.0), 1.0)


@numba.njit(cache=True, error_model="numpy")
def return_to_planes(
    trial: Any,
    kappa: Any,
    planes: Any,
    compliance: Any,
    stress: Any,
    kappa_new: Any,
    tangent: Any,
    flagged: Any,
) -> None:
    """Return n trial stresses, with the tangent and the equivalent plastic strain.

    In a region r the principal stresses, sorted from major to minor, become P_r s + q_r.

    Args:
        trial: Stresses xx, yy, zz, xy [Pa]; shape (n, 4).
        kappa: Equivalent plastic strain at the start [-]; shape (n,).
        planes: The regions: P, q, conditions, offsets and alike of `YieldPlanes`.
        compliance: 1/(2G) and nu/E [1/Pa].
        stress: Returned stresses, filled [Pa]; shape (n, 4).
        kappa_new: Grown by sqrt(2/3 de_p : de_p), filled [-]; shape (n,).
        tangent: Derivative of stress by trial, filled [-]; shape (n, 4, 4).
        flagged: Whether no region's conditions hold, filled; shape (n,). Such a stress returns to
            the last region.
    """
    P_of, q_of, conditions, offsets, alike_of = planes
    s, s_new, position = np.empty(3), np.empty(3), np.empty(3, np.int64)
    u, v, principal = np.zeros((3, 4)), np.zeros((3, 4)), np.empty(3)
    u[2, 2] = v[2, 2] = 1.0
    for point in range(len(trial)):
        xx, yy, zz, xy = trial[point]
        mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
        r = np.hypot(half, xy)
        a, b = mean + r, mean - r
        # Where a, b (in the plane) and zz stand among the sorted stresses.
        out = 0 if zz > a else 1 if zz > b else 2
        first, second = (1 if out == 0 else 0), (1 if out == 2 else 2)
        s[first], s[second], s[out] = a, b, zz
        region, miss = _region(conditions, offsets, s)
        flagged[point] = -miss > ROUNDING * max(abs(s[0]), abs(s[2]))
        if flagged[point]:
            region = len(offsets) - 1
        tangent[point] = 0.0
        kappa_new[point] = kappa[point]
        if region == 0 and not flagged[point]:
            stress[point] = trial[point]
            for i in range(4):
                tangent[point, i, i] = 1.0
            continue

        P, q = P_of[region], q_of[region]
        trace = squares = 0.0
        for i in range(3):
            s_new[i] = q[i]
            for j in range(3):
                s_new[i] += P[i, j] * s[j]
            trace += s[i] - s_new[i]
        for i in range(3):
            squares += (compliance[0] * (s[i] - s_new[i]) - compliance[1] * trace) ** 2
        kappa_new[point] += np.sqrt(2.0 / 3.0 * squares)

        # cos and sin of twice the angle from x to the major axis in the plane.
        c, d = (half / r, xy / r) if r > 0.0 else (1.0, 0.0)
        alike = alike_of[region, out]
        mean_new = 0.5 * (s_new[first] + s_new[second])
        r_new = 0.5 * (s_new[first] - s_new[second])
        turn = _turn(P, alike, r, r_new, first, second)
        if alike:
            r_new = turn * r
        stress[point, 0] = mean_new + r_new * c
        stress[point, 1] = mean_new - r_new * c
        stress[point, 2] = s_new[out]
        stress[point, 3] = r_new * d

        # The stress is the sum of a u_a, b u_b, zz u_zz; v are their derivatives by the stress.
        u[0, 0] = u[1, 1] = v[0, 0] = v[1, 1] = 0.5 + 0.5 * c
        u[0, 1] = u[1, 0] = v[0, 1] = v[1, 0] = 0.5 - 0.5 * c
        u[0, 3], u[1, 3], v[0, 3], v[1, 3] = 0.5 * d, -0.5 * d, d, -d
        position[0], position[1], position[2] = first, second, out
        w = -d, d, 0.0, c
        x = -0.5 * d, 0.5 * d, 0.0, c
        for j in range(4):
            for k in range(3):
                principal[k] = 0.0
                for m in range(3):
                    principal[k] += P[position[k], position[m]] * v[m, j]
            for i in range(4):
                value = turn * w[i] * x[j]
                for k in range(3):
                    value += u[k, i] * principal[k]
                tangent[point, i, j] = value
