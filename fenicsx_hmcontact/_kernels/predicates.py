# SPDX-License-Identifier: LGPL-3.0-or-later
"""On which side of a line a point lies, without error."""

from typing import Any

import numpy as np
from numba import njit

ROUND_OFF = 3.4e-16
"""Largest relative error of the determinant in floating point (Shewchuk 1997, Eq. 19)."""

SPLITTER = 134217729.0
"""2^27 + 1, which cuts a number into halves whose products are exact (Dekker 1971)."""


@njit(cache=True)
def orientation(a: Any, b: Any, c: Any) -> float:
    """Twice the area of the triangle abc, with a sign that is exact.

    Args:
        a: First corner [m]; shape (2,).
        b: Second corner [m].
        c: Third corner [m].

    Returns:
        Positive if abc runs counterclockwise, zero if the corners lie on one line (Shewchuk 1997).
    """
    left = (a[0] - c[0]) * (b[1] - c[1])
    right = (a[1] - c[1]) * (b[0] - c[0])
    if abs(left - right) >= ROUND_OFF * (abs(left) + abs(right)):
        return left - right
    return _exact(a, b, c)


@njit(cache=True)
def _exact(a: Any, b: Any, c: Any) -> float:
    """Largest part of the exact determinant, a sum of twelve numbers that do not overlap."""
    parts = np.zeros(12)
    count = 0
    for p, q, sign in (
        (a, b, 1.0),
        (b, c, 1.0),
        (c, a, 1.0),
        (b, a, -1.0),
        (c, b, -1.0),
        (a, c, -1.0),
    ):
        x, y = p[0], sign * q[1]
        product = x * y
        x_high = SPLITTER * x - (SPLITTER * x - x)
        y_high = SPLITTER * y - (SPLITTER * y - y)
        x_low, y_low = x - x_high, y - y_high
        error = x_low * y_low - (((product - x_high * y_high) - x_low * y_high) - x_high * y_low)
        for term in (error, product):
            for i in range(count):
                total = term + parts[i]
                rounded = total - term
                parts[i] = (term - (total - rounded)) + (parts[i] - rounded)
                term = total
            parts[count] = term
            count += 1
    for i in range(11, -1, -1):
        if parts[i] != 0.0:
            return parts[i]
    return 0.0
