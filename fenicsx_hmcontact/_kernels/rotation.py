# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stresses xx, yy, zz, xy turned with the material by half of a step's rotation, twice a step.

The rotation is given by the step's spin increment w = (H_xy - H_yx)/2: half of it has the
counterclockwise angle a with tan a = -w/2 (Hughes and Winget 1980).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True)
def _doubled(w: float) -> tuple[float, float]:
    """Cosine and sine of twice the angle of the half rotation."""
    t = -0.5 * w
    scale = 1.0 / (1.0 + t * t)
    return (1.0 - t * t) * scale, 2.0 * t * scale


@njit(cache=True)
def _turn(c: float, s: float, xx: float, yy: float, xy: float) -> tuple[float, float, float]:
    """In-plane components turned by an angle of which c and s are doubled cosine and sine."""
    mean, difference = 0.5 * (xx + yy), 0.5 * (xx - yy)
    turned = c * difference - s * xy
    return mean + turned, mean - turned, s * difference + c * xy


@njit(cache=True)
def turned_stress(stress: Any, w: Any) -> Any:
    """Turn stresses by half of the step's rotation.

    Args:
        stress: Shape (n, 4).
        w: Spin increments; shape (n,).

    Returns:
        Shape (n, 4).
    """
    result = np.empty_like(stress)
    for k in range(w.size):
        c, s = _doubled(w[k])
        xx, yy, zz, xy = stress[k]
        result[k, 0], result[k, 1], result[k, 3] = _turn(c, s, xx, yy, xy)
        result[k, 2] = zz
    return result


@njit(cache=True)
def turned_tangent(stress: Any, start: Any, by_strain: Any, by_stress: Any, w: Any) -> Any:
    """Derivative of the in-plane stress at the end of a step by its increments.

    Args:
        stress: Stress at the end of the step; shape (n, 4).
        start: Stress at its start, turned by half of the rotation; shape (n, 4).
        by_strain: The material's derivative by the strain increment; shape (n, 4, 3).
        by_stress: The material's derivative by the stress at the start; shape (n, 4, 4).
        w: Spin increments; shape (n,).

    Returns:
        Derivatives of xx, yy, xy by the strain increment and by w; shape (n, 3, 4).
    """
    result = np.empty((w.size, 3, 4))
    for k in range(w.size):
        c, s = _doubled(w[k])
        by_angle = np.zeros(4)
        # The start stress turns by the angle as well: its derivative is this.
        spin_xx, spin_xy = -2.0 * start[k, 3], start[k, 0] - start[k, 1]
        for i in range(4):
            by_angle[i] = (by_stress[k, i, 0] - by_stress[k, i, 1]) * spin_xx
            by_angle[i] += by_stress[k, i, 3] * spin_xy
        for j in range(3):
            t = by_strain[k]
            result[k, 0, j], result[k, 1, j], result[k, 2, j] = _turn(
                c, s, t[0, j], t[1, j], t[3, j]
            )
        xx, yy, xy = _turn(c, s, by_angle[0], by_angle[1], by_angle[3])
        angle_by_w = -0.5 / (1.0 + 0.25 * w[k] ** 2)
        result[k, 0, 3] = angle_by_w * (xx - 2.0 * stress[k, 3])
        result[k, 1, 3] = angle_by_w * (yy + 2.0 * stress[k, 3])
        result[k, 2, 3] = angle_by_w * (xy + stress[k, 0] - stress[k, 1])
    return result
