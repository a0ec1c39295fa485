# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws of the water between two surfaces (Section 2.3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]

type ApertureLaw = Callable[[Float], tuple[Float, Float]]
"""From gaps [m], not negative, to hydraulic apertures [m] and their derivatives [-]."""


@dataclass(frozen=True)
class ResidualAperture:
    """Hydraulic aperture g + residual: rough surfaces that touch still lead water between them.

    Attributes:
        residual: Hydraulic aperture of closed surfaces [m].

    Raises:
        ValueError: If the aperture is not positive.
    """

    residual: float

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if not (self.residual > 0.0 and math.isfinite(self.residual)):
            raise ValueError(f"residual is {self.residual}; it must be positive")

    def __call__(self, gap: Float) -> tuple[Float, Float]:
        """Hydraulic aperture [m] and its derivative [-]; shapes as the gap [m]."""
        return gap + self.residual, np.ones_like(gap)


@dataclass(frozen=True)
class GapFlow:
    """Water between two porous bodies, or a porous and a dry one.

    Along the gap it flows by the cubic law, across it by leak-off; it is stored as the gap opens
    and carried along by surfaces that slide.

    Attributes:
        transverse_permeability: k_T [m/s] of Eq. 21.
        viscosity: Dynamic viscosity mu_f [Pa s] of Eq. 19.
        unit_weight: Unit weight gamma_f [N/m^3] of the water.
        aperture: What leads the water: None for the gap itself (where it is closed the pore
            pressure is continuous); a constant hydraulic aperture [m]; a `ResidualAperture`; or a
            law of one's own, which maps gaps to apertures and their derivatives. Tied pairs know a
            constant one alone, filled and without gravity.
        aperture_cap: Aperture [m] beyond which a gap leads no more water along it: the cubic law
            makes the matrix of wide gaps singular (condition ~ g^3). For the error of the pressure
            1e-5 (12 mu_f 1e6 k h / gamma_f)^(1/3), k and h permeability and mesh size beside it.
        gravity: Direction in which the water in the gap weighs, of length 1; None without gravity.
        outside: Pore pressure [Pa] of free water around: a number, or a function of the coordinates
            [m], shape (n, 2), that returns n of them. It stands on what no other surface faces, and
            at the ends of the gap but for those that a support holds (symmetry). None where faces
            and ends are sealed. Of a dry secondary surface the ends stay sealed.
        sealing: Whether one closed node seals: a facet then resists as the parts of the wedge
            between its nodes in series do, not by the mean of its cubes. For necks of few nodes
            that hold water back; pockets between closed nodes are trapped, and steps get harder.
        lagged: Whether the water flows through the gaps of the step's start; what it stores follows
            the gaps at once. For gaps that suction holds shut until water enters and parts them:
            with those of its end a step that sets off such a flood may have no solution nearby. The
            error is of first order in the step, as that of the steps themselves.

    Raises:
        ValueError: If a value is not positive (the aperture: negative), or the direction is none.
    """

    transverse_permeability: float
    viscosity: float = 1e-3
    unit_weight: float = 1e4
    aperture: float | ApertureLaw | None = None
    aperture_cap: float = math.inf
    gravity: tuple[float, float] | None = None
    outside: float | Callable[[Float], Float] | None = None
    sealing: bool = False
    lagged: bool = False

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        for name in ("transverse_permeability", "viscosity", "unit_weight"):
            value = getattr(self, name)
            if not (value > 0.0 and math.isfinite(value)):
                raise ValueError(f"{name} is {value}; it must be positive")
        if not self.aperture_cap > 0.0:
            raise ValueError(f"aperture_cap is {self.aperture_cap}; it must be positive")
        if self.gravity is not None and not abs(math.hypot(*self.gravity) - 1.0) <= UNIT:
            raise ValueError(f"gravity is {self.gravity}; it must be a direction of length 1")
        if not (self.outside is None or callable(self.outside) or math.isfinite(self.outside)):
            raise ValueError(f"outside is {self.outside}; it must be a pressure, or None")
        if self.aperture is None or callable(self.aperture):
            return
        if not (self.aperture >= 0.0 and math.isfinite(self.aperture)):
            raise ValueError(
                f"aperture is {self.aperture}; it must be zero or positive, a law, or None"
            )

    def hydraulic_aperture(self, gap: Float) -> tuple[Float, Float]:
        """Aperture that leads the water [m] and its derivative [-]; shapes as the gap.

        Args:
            gap: Distance of the surfaces [m], zero where closed.

        Raises:
            ValueError: If a law of one's own returns negative apertures or no numbers.
        """
        gap = np.maximum(gap, 0.0)
        if self.aperture is None:
            return gap, np.ones_like(gap)
        if not callable(self.aperture):
            return np.full_like(gap, self.aperture), np.zeros_like(gap)
        aperture, slope = self.aperture(gap)
        if not (np.all(aperture >= 0.0) and np.isfinite(slope).all()):
            raise ValueError(f"{self.aperture}: apertures must be numbers and not negative")
        return aperture, slope

    @property
    def closes(self) -> bool:
        """Whether surfaces that touch leave no aperture between them."""
        return bool(self.hydraulic_aperture(np.zeros(1))[0][0] == 0.0)

    def longitudinal_conductance(self, aperture: Float | float) -> Float:
        """c_L g = g^3 / (12 mu_f) of Eqs. 19 and 81 [m^3/(Pa s)], capped; shape as given.

        Args:
            aperture: Hydraulic aperture [m].
        """
        return np.clip(aperture, 0.0, self.aperture_cap) ** 3 / (12.0 * self.viscosity)

    def conductance_between(self, apertures: Float) -> tuple[Float, Float]:
        """Conductance between two nodes, and its derivatives by their apertures.

        The mean of c_L g, apertures, capped, being linear between the nodes; with `sealing` that
        of the wedge's parts in series, 1 / mean(1 / c_L g).

        Args:
            apertures: Hydraulic apertures of both nodes [m]; shape (k, 2).

        Returns:
            Conductances [m^3/(Pa s)] of shape (k,), and derivatives [m^2/(Pa s)] of shape (k, 2).
        """
        ends = np.clip(apertures, 0.0, self.aperture_cap)
        others = ends[:, ::-1]
        if self.sealing:
            total = np.maximum(ends.sum(axis=1), np.finfo(float).tiny)
            share, product = ends / total[:, None], ends.prod(axis=1)
            cube = 2.0 * product * share.prod(axis=1) * total
            slopes = 2.0 * product[:, None] * share[:, ::-1] * (1.0 + share[:, ::-1])
        else:
            cube = 0.25 * (ends**2).sum(axis=1) * ends.sum(axis=1)
            slopes = 0.25 * (3.0 * ends**2 + 2.0 * ends * others + others**2)
        led, viscous = apertures < self.aperture_cap, 12.0 * self.viscosity
        return cube / viscous, np.where(led, slopes / viscous, 0.0)

    def transverse_conductivity(self, aperture: Float | float) -> Float:
        """c_T = k_T / (gamma_f g) of Eq. 21 [m/(Pa s)]; shape as given.

        Args:
            aperture: Hydraulic aperture [m]; where it is zero nothing leaks, for there is no drop.
        """
        c, g = self.transverse_permeability / self.unit_weight, np.asarray(aperture, float)
        return np.divide(c, g, out=np.zeros_like(g), where=g > 0.0)

    def transverse_conductivity_slope(self, aperture: Float) -> Float:
        """Derivative of `transverse_conductivity` [1/(Pa s)]; shape as given."""
        c = -self.transverse_permeability / self.unit_weight
        return np.divide(c, aperture**2, out=np.zeros_like(aperture), where=aperture > 0.0)


UNIT = 1e-9
"""Deviation from 1 of the length of a direction that is round-off."""
