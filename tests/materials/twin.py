# SPDX-License-Identifier: LGPL-3.0-or-later
"""Koiter's conditions by enumeration of the active planes, one point at a time."""

import itertools

import numpy as np

SLACK = 1e-9


def principal(stress):
    """Principal stresses, unsorted, and their directions."""
    xx, yy, zz, xy = stress
    return np.linalg.eigh([[xx, xy, 0.0], [xy, yy, 0.0], [0.0, 0.0, zz]])


def planes(law, angle):
    """All nine planes: normals (k, 3), or flow directions, and limits (k,)."""
    sine = np.sin(np.radians(angle))
    phi = np.radians(getattr(law, "phi", 0.0))
    normals, limits = [], []
    for i, j in itertools.permutations(range(3), 2):
        unit = np.eye(3)
        normals.append(0.5 * (unit[i] - unit[j]) + 0.5 * sine * (unit[i] + unit[j]))
        limits.append(law.c * np.cos(phi))
    if law.tension_cutoff is not None:
        normals.extend(np.eye(3))
        limits.extend([law.tension_cutoff] * 3)
    return np.array(normals), np.array(limits)


def solutions(law, trial):
    """Every stress [Pa] and plastic strain [-] that satisfies Koiter's conditions."""
    s, directions = principal(trial)
    phi = getattr(law, "phi", 0.0)
    psi = getattr(law, "psi", 0.0)
    N, b = planes(law, phi)
    M, _ = planes(law, phi if psi is None else psi)
    stiffness = 2.0 * law.shear_modulus * np.eye(3) + law.lame
    scale = max(law.c, abs(s).max())
    found = []
    for size in range(4):
        for active in map(list, itertools.combinations(range(len(b)), size)):
            A = N[active] @ stiffness @ M[active].T
            if size and np.linalg.cond(A) > 1.0 / SLACK:
                continue
            multipliers = np.linalg.solve(A, N[active] @ s - b[active])
            plastic = M[active].T @ multipliers
            returned = s - stiffness @ plastic
            if (law.E * multipliers >= -SLACK * scale).all() and (
                N @ returned <= b + SLACK * scale
            ).all():
                full = directions @ np.diag(returned) @ directions.T
                found.append((full[[0, 1, 2, 0], [0, 1, 2, 1]], plastic))
    return found
