# SPDX-License-Identifier: LGPL-3.0-or-later
"""Terzaghi's one-dimensional consolidation in closed form (paper, Section 5.1).

A column of height H, sealed at its base y = 0 and drained at its top y = H, carries a load p0 from
t = 0 on. Late times take the paper's series; early ones, where it needs ever more terms, the same
solution as images of the error function (Carslaw and Jaeger, Conduction of Heat in Solids, 1959).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import erf, erfc

ROUND_OFF = 1e-12
"""How far, relative to the height, a point may lie outside the column by round-off."""

EARLY = 0.2
"""Time factor cv t / H^2 below which images are summed instead of the series."""

TERMS = range(5)
"""Terms summed in either form; the first one left out is below 1e-25."""


def consolidation_coefficient(
    permeability: float, unit_weight: float, E: float, nu: float
) -> float:
    """Coefficient of consolidation cv (paper, Eq. 103) [m2/s].

    Args:
        permeability: Permeability k [m/s].
        unit_weight: Unit weight of the water [N/m3].
        E: Young's modulus of the skeleton [Pa].
        nu: Poisson's ratio of the skeleton [-].

    Raises:
        ValueError: If a parameter is out of range; names it.
    """
    _positive(permeability=permeability, unit_weight=unit_weight, E=E)
    if not -1 < nu < 0.5:
        raise ValueError(f"nu must lie between -1 and 0.5, not at {nu}")
    return permeability * E * (1 - nu) / (unit_weight * (1 - 2 * nu) * (1 + nu))


def terzaghi_pressure(
    y: npt.ArrayLike, t: npt.ArrayLike, height: float, cv: float, load: float
) -> npt.NDArray[np.float64]:
    """Pore pressure (paper, Eq. 101) [Pa], to round-off at any time.

    Args:
        y: Heights above the sealed base [m]; any shape that broadcasts with ``t``.
        t: Times since loading [s].
        height: Height of the column, drained at its top [m].
        cv: Coefficient of consolidation [m2/s].
        load: Load p0 on the top [Pa].

    Returns:
        Pressures; the broadcast shape.

    Raises:
        ValueError: If ``y`` leaves the column, ``t`` is negative, or ``height`` or ``cv`` is not
            positive.
    """
    time = _time_factor(t, height, cv)
    eta, time = np.broadcast_arrays(np.asarray(y, dtype=np.float64) / height, time)
    if not np.all((eta >= -ROUND_OFF) & (eta <= 1 + ROUND_OFF)):
        raise ValueError(f"y must lie between 0 and the height {height}")
    eta = np.clip(eta, 0.0, 1.0)
    early = time < EARLY
    p = np.empty(eta.shape)

    x, width = eta[early], 2 * np.sqrt(time[early])
    # erf and not 1 - erfc: keeps the digits of small pressures under the drained top.
    p[early] = erf(_ratio(1 - x, width)) - erfc(_ratio(1 + x, width))
    for n in TERMS[1:]:
        images = erfc(_ratio(2 * n + 1 - x, width)) + erfc(_ratio(2 * n + 1 + x, width))
        p[early] -= (-1) ** n * images

    x, late = eta[~early], time[~early]
    # sin((2n + 1) pi/2 (1 - x)) = (-1)^n cos((2n + 1) pi/2 x), but exactly zero at the top.
    roots = [(2 * n + 1) * np.pi / 2 for n in TERMS]
    p[~early] = sum(2 / m * np.sin(m * (1 - x)) * np.exp(-(m**2) * late) for m in roots)
    return load * p


def terzaghi_degree(t: npt.ArrayLike, height: float, cv: float) -> npt.NDArray[np.float64]:
    """Degree of consolidation, settlement by final settlement (paper, Eq. 102) [-].

    Args:
        t: Times since loading [s]; any shape.
        height: Height of the column, drained at its top [m].
        cv: Coefficient of consolidation [m2/s].

    Returns:
        Degrees, 0 at the start and 1 in the end; shape of ``t``.

    Raises:
        ValueError: If ``t`` is negative, or ``height`` or ``cv`` is not positive.
    """
    time = _time_factor(t, height, cv)
    early = time < EARLY
    degree = np.empty(time.shape)

    root = np.sqrt(time[early])
    degree[early] = 2 / np.sqrt(np.pi) * root
    for n in TERMS[1:]:
        z = _ratio(n, root)
        # Integral of erfc from z to infinity, times the root of the time.
        tail = root * np.exp(-(z**2)) / np.sqrt(np.pi) - n * erfc(z)
        degree[early] += 4 * (-1) ** n * tail

    late = time[~early]
    roots = [(2 * n + 1) * np.pi / 2 for n in TERMS]
    degree[~early] = 1 - sum(2 / m**2 * np.exp(-(m**2) * late) for m in roots)
    return degree


def _time_factor(t: npt.ArrayLike, height: float, cv: float) -> npt.NDArray[np.float64]:
    _positive(height=height, cv=cv)
    time = cv * np.asarray(t, dtype=np.float64) / height**2
    if not np.all(time >= 0):
        raise ValueError("t must not be negative")
    return time


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"{name} must be positive, not {value}")


def _ratio(distance: npt.ArrayLike, width: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Distance over diffusion width, at the moment of loading as its limit: infinite, or zero."""
    distance = np.broadcast_to(np.asarray(distance, dtype=np.float64), width.shape)
    return np.divide(distance, width, out=np.where(distance > 0, np.inf, 0.0), where=width > 0)
