# SPDX-License-Identifier: LGPL-3.0-or-later
"""Triangles that fill a polygon."""

from typing import Any

import numpy as np
from numba import njit

from .predicates import orientation


@njit(cache=True)
def cut_ears(corners: Any) -> Any:
    """Fill a polygon with triangles by cutting off one ear after the other (Meisters 1975).

    Args:
        corners: Corners of the polygon [m], counterclockwise; shape (n, 2).

    Returns:
        Corners of the triangles, all of positive area; shape (n - 2, 3), or (0, 3) if the polygon
        runs clockwise or crosses itself.
    """
    left = np.arange(len(corners))
    size = len(corners)
    triangles = np.empty((size - 2, 3), np.int64)
    while size > 2:
        ear = -1
        for i in range(size):
            before, after = (i - 1) % size, (i + 1) % size
            a, b, c = corners[left[before]], corners[left[i]], corners[left[after]]
            if orientation(a, b, c) <= 0.0:
                continue
            ear = i
            for j in range(size):
                p = corners[left[j]]
                if j not in (before, i, after) and (
                    orientation(a, b, p) >= 0.0
                    and orientation(b, c, p) >= 0.0
                    and orientation(c, a, p) >= 0.0
                ):
                    ear = -1
                    break
            if ear >= 0:
                triangles[size - 3] = left[before], left[i], left[after]
                break
        if ear < 0:
            return triangles[:0]
        left[ear : size - 1] = left[ear + 1 : size].copy()
        size -= 1
    return triangles
