# SPDX-License-Identifier: LGPL-3.0-or-later
"""Yield surfaces of planes in the space of principal stresses, and where stresses return to."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .interface import Bool, Float

Plane = tuple[int, ...]
"""A plane by the principal stresses in it: (i, j) of shear, (i,) of tension; 0 is the major one."""

# The main plane, and its neighbours across the edges s2 = s3 and s1 = s2.
MAIN, SAME_MINOR, SAME_MAJOR = (0, 2), (0, 1), (1, 2)
SHEAR_REGIONS: tuple[tuple[Plane, ...], ...] = (
    (),
    (MAIN,),
    (MAIN, SAME_MINOR),
    (MAIN, SAME_MAJOR),
)
APEX: tuple[tuple[Plane, ...], ...] = (tuple(itertools.permutations(range(3), 2)),)
TENSION_REGIONS: tuple[tuple[Plane, ...], ...] = (
    ((0,),),
    ((0,), (1,)),
    ((0,), (1,), (2,)),
    ((0,), MAIN),
    ((0,), MAIN, SAME_MINOR),
    ((0,), (1,), MAIN, SAME_MAJOR),
)
"""Planes that sorted stresses return to: the parts of the surface with their edges and corners."""

ZERO = 1e-9
"""Numbers below this are rounding; they are made of entries of size one."""


@dataclass(frozen=True)
class YieldPlanes:
    """Where sorted principal stresses s return to, region by region: P s + q.

    Everything is linear, so the regions of Koiter's rule (1953) are found once for a material. A
    stress belongs to a region if all ``conditions s + offsets`` are positive: the multipliers are,
    and the returned stresses are in order and within the other planes.

    Attributes:
        P: Return [-]; shape (regions, 3, 3).
        q: Return [Pa]; shape (regions, 3).
        conditions: Shape (regions, k, 3) [-]; zero where a region has fewer.
        offsets: Shape (regions, k) [Pa]; infinite where a region has fewer.
        alike: Whether a region treats both stresses other than i alike; shape (regions, 3).
    """

    P: Float
    q: Float
    conditions: Float
    offsets: Float
    alike: Bool

    @property
    def arrays(self) -> tuple[npt.NDArray, ...]:
        """What the kernel takes."""
        return self.P, self.q, self.conditions, self.offsets, self.alike


def mohr_coulomb_planes(
    nu: float, c: float, phi: float, psi: float, tension_cutoff: float | None
) -> YieldPlanes:
    """Planes (s_i - s_j)/2 + (s_i + s_j)/2 sin(phi) = c cos(phi) and s_i = tension cut-off.

    The last region is the apex, where there is one.

    Args:
        nu: Poisson's ratio [-].
        c: Cohesion [Pa].
        phi: Angle of friction [rad].
        psi: Angle of dilation [rad].
        tension_cutoff: Largest tensile stress [Pa], or None.
    """
    # Elasticity over 2G.
    stiffness = np.eye(3) + nu / (1.0 - 2.0 * nu)
    compliance = np.linalg.inv(stiffness)

    def normals(planes: tuple[Plane, ...], angle: float) -> Float:
        """Derivatives of the planes by the principal stresses; shape (planes, 3)."""
        rows = np.zeros((len(planes), 3))
        for row, plane in zip(rows, planes, strict=True):
            row[plane[0]] = 1.0
            if len(plane) == 2:
                row[[*plane]] = 0.5 * (np.sin(angle) + np.array([1.0, -1.0]))
        return rows

    def limits(planes: tuple[Plane, ...]) -> Float:
        tension = np.inf if tension_cutoff is None else tension_cutoff
        return np.array([tension if len(plane) == 1 else c * np.cos(phi) for plane in planes])

    if tension_cutoff is not None:
        regions = SHEAR_REGIONS + TENSION_REGIONS
    else:
        regions = SHEAR_REGIONS + (APEX if phi > 0.0 else ())
    # What a stress must satisfy beside positive multipliers: its order, main plane, cut-off.
    checks: tuple[Plane, ...] = (MAIN,) if tension_cutoff is None else (MAIN, (0,))
    order = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0]])
    within = np.vstack((order, -normals(checks, phi)))
    room = np.concatenate((np.zeros(2), limits(checks)))

    found = []
    for planes in regions:
        N, M, b = normals(planes, phi), normals(planes, psi), limits(planes)
        if len(planes) < 3:
            gain = np.linalg.inv(N @ stiffness @ M.T)
            P = np.eye(3) - stiffness @ M.T @ gain @ N
            q = stiffness @ M.T @ gain @ b
            positive, by = gain @ N, -gain @ b
        else:
            P, q = np.zeros((3, 3)), np.linalg.lstsq(N, b)[0]
            positive = _cone(M) @ compliance
            by = -positive @ q
        # A check that does not vary in a region holds there by construction.
        varying = np.linalg.norm(within @ P, axis=1) > ZERO
        conditions = np.vstack((positive, (within @ P)[varying]))
        offsets = np.concatenate((by, (within @ q + room)[varying]))
        found.append((P, q, conditions, offsets, _alike(planes)))

    most = max(len(offsets) for *_, offsets, _ in found)
    return YieldPlanes(
        P=np.array([P for P, *_ in found]),
        q=np.array([q for _, q, *_ in found]),
        conditions=np.array(
            [np.vstack((C, np.zeros((most - len(C), 3)))) for _, _, C, *_ in found]
        ),
        offsets=np.array([np.append(d, np.full(most - len(d), np.inf)) for *_, d, _ in found]),
        alike=np.array([alike for *_, alike in found]),
    )


def _alike(planes: tuple[Plane, ...]) -> list[bool]:
    """Whether the planes stay the same when the stresses other than 0, 1 or 2 change places."""
    swaps = (0, 2, 1), (2, 1, 0), (1, 0, 2)
    return [{tuple(swap[i] for i in plane) for plane in planes} == {*planes} for swap in swaps]


def _cone(directions: Float) -> Float:
    """Normals, pointing inwards, of the faces of the cone that directions span; shape (faces, 3).

    A flat cone has its plane twice, with both signs.
    """
    faces = []
    for a, b in itertools.combinations(directions, 2):
        face = np.cross(a, b)
        length = np.linalg.norm(face)
        for normal in (face, -face):
            if length > ZERO and (directions @ normal >= -ZERO).all():
                faces.append(normal / length)
    _, first = np.unique(np.round(faces, 9), axis=0, return_index=True)
    return np.array(faces)[first]
