# SPDX-License-Identifier: LGPL-3.0-or-later
"""Line contact of two elastic cylinders in closed form: Hertz, and Cattaneo and Mindlin.

Loads are per metre thickness, bodies in plane strain and half spaces as far as the contact knows.
References: K. L. Johnson, Contact Mechanics, Cambridge University Press, 1985, Sections 4.2 and
7.2; C. Cattaneo (1938); R. D. Mindlin (1949).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]


def contact_modulus(E: float, nu: float, other: tuple[float, float] | None = None) -> float:
    """Modulus E* of two bodies in plane strain [Pa]; 1/E* is the sum of (1 - nu^2)/E.

    Johnson (1985), Eq. 4.19.

    Args:
        E: Young's modulus of a body [Pa].
        nu: Its Poisson's ratio [-].
        other: Both of the other body; a rigid one where None.

    Raises:
        ValueError: If a modulus is not positive or a ratio not between -1 and 0.5.
    """
    compliance = 0.0
    for modulus, ratio in ((E, nu), other or (math.inf, 0.0)):
        _positive(E=modulus)
        if not -1.0 < ratio < 0.5:
            raise ValueError(f"nu must lie between -1 and 0.5, not at {ratio}")
        compliance += (1.0 - ratio**2) / modulus
    return 1.0 / compliance


def hertz_half_width(load: float, radius: float, modulus: float) -> float:
    """Half width a of the contact [m]; Johnson (1985), Eq. 4.43.

    Args:
        load: Normal load P [N/m].
        radius: R, with 1/R the sum of the curvatures [m].
        modulus: E* [Pa].

    Raises:
        ValueError: If a value is not positive; names it.
    """
    _positive(load=load, radius=radius, modulus=modulus)
    return math.sqrt(4.0 * load * radius / (math.pi * modulus))


def hertz_load(half_width: float, radius: float, modulus: float) -> float:
    """Load P that gives a half width [N/m]; inverse of ``hertz_half_width``.

    Args:
        half_width: a [m].
        radius: R, with 1/R the sum of the curvatures [m].
        modulus: E* [Pa].

    Raises:
        ValueError: If a value is not positive; names it.
    """
    _positive(half_width=half_width, radius=radius, modulus=modulus)
    return math.pi * modulus * half_width**2 / (4.0 * radius)


def hertz_pressure(x: npt.ArrayLike, load: float, half_width: float) -> Float:
    """Contact pressure [Pa]: a half ellipse over the contact; Johnson (1985), Eq. 4.44.

    Args:
        x: Distances from the middle of the contact [m]; any shape.
        load: Normal load P [N/m].
        half_width: a [m].

    Returns:
        Pressures, zero outside the contact; shape of ``x``.

    Raises:
        ValueError: If load or half width is not positive; names it.
    """
    _positive(load=load, half_width=half_width)
    s = np.asarray(x, dtype=np.float64) / half_width
    pressure: Float = 2.0 * load / (math.pi * half_width) * np.sqrt(np.maximum(1.0 - s**2, 0.0))
    return pressure


def stick_half_width(load: float, half_width: float, shear_load: float, mu: float) -> float:
    """Half width c of the part that sticks under partial slip [m]; Johnson (1985), Eq. 7.27.

    Args:
        load: Normal load P [N/m].
        half_width: a [m].
        shear_load: Tangential load Q after P, of either sign [N/m].
        mu: Coefficient of friction [-].

    Raises:
        ValueError: If a value is not positive, or Q is larger than mu P, and all of it slides.
    """
    _positive(load=load, half_width=half_width, mu=mu)
    part = abs(shear_load) / (mu * load)
    if not part <= 1.0:
        raise ValueError(f"shear_load {shear_load} is beyond mu load, {mu * load}: all slides")
    return half_width * math.sqrt(1.0 - part)


def cattaneo_mindlin_shear(
    x: npt.ArrayLike, load: float, half_width: float, shear_load: float, mu: float
) -> Float:
    """Shear traction of bodies of equal material pressed, then pushed sideways [Pa].

    Friction all over less the same in small over the part that sticks; Johnson (1985), Eqs. 7.22
    to 7.28.

    Args:
        x: Distances from the middle of the contact [m]; any shape.
        load: Normal load P [N/m].
        half_width: a [m].
        shear_load: Tangential load Q after P [N/m].
        mu: Coefficient of friction [-].

    Returns:
        Tractions of the sign of Q, zero outside the contact; shape of ``x``.

    Raises:
        ValueError: As for ``stick_half_width``.
    """
    c = stick_half_width(load, half_width, shear_load, mu)
    bound = mu * hertz_pressure(x, load, half_width)
    if c > 0.0:
        # Pressures of ellipses of one curvature: loads go with the squares of the widths.
        bound -= mu * hertz_pressure(x, load * (c / half_width) ** 2, c)
    return math.copysign(1.0, shear_load) * bound


def moment_half_width(x: npt.ArrayLike, force: npt.ArrayLike) -> float:
    """Half width of the half ellipse that has the second moment of given forces [m].

    2 sqrt(sum F (x - m)^2 / sum F) with m = sum F x / sum F. It sees the width far below the
    distance of nodes.

    Args:
        x: Places of the forces [m]; shape (n,).
        force: Forces, such as pressure times length [N/m]; shape (n,).

    Raises:
        ValueError: If the forces do not add up to a positive one.
    """
    places, forces = np.asarray(x, dtype=np.float64), np.asarray(force, dtype=np.float64)
    total = float(forces.sum())
    _positive(force=total)
    middle = forces @ places / total
    return 2.0 * math.sqrt(max(float(forces @ (places - middle) ** 2) / total, 0.0))


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0.0:
            raise ValueError(f"{name} must be positive, not {value}")
