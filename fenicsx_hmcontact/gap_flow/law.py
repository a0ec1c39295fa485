# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws of the water between two surfaces (Section 2.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]


@dataclass(frozen=True)
class GapFlow:
    """Water between two porous bodies: along the gap by the cubic law, across it by leak-off.

    Attributes:
        transverse_permeability: k_T [m/s] of Eq. 21.
        viscosity: Dynamic viscosity mu_f [Pa s] of Eq. 19.
        unit_weight: Unit weight gamma_f [N/m^3] of the water.
        aperture: Constant hydraulic aperture of a tied pair [m], filled and not stored in; None for
            the gap itself. Where it is zero, or the surfaces are closed, the pore pressure is
            continuous. Gravity is not considered in the film: its water flows by pressure alone.
        aperture_cap: Aperture [m] beyond which a gap leads no more water along it: the cubic law
            makes the matrix of wide gaps singular (condition ~ g^3). For the error of the pressure
            1e-5 (12 mu_f 1e6 k h / gamma_f)^(1/3), k and h permeability and mesh size beside it.

    Raises:
        ValueError: If a value is not positive (the aperture: negative).
    """

    transverse_permeability: float
    viscosity: float = 1e-3
    unit_weight: float = 1e4
    aperture: float | None = None
    aperture_cap: float = math.inf

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        for name in ("transverse_permeability", "viscosity", "unit_weight"):
            value = getattr(self, name)
            if not (value > 0.0 and math.isfinite(value)):
                raise ValueError(f"{name} is {value}; it must be positive")
        if not self.aperture_cap > 0.0:
            raise ValueError(f"aperture_cap is {self.aperture_cap}; it must be positive")
        if self.aperture is not None and not (
            self.aperture >= 0.0 and math.isfinite(self.aperture)
        ):
            raise ValueError(f"aperture is {self.aperture}; it must be zero or positive, or None")

    def longitudinal_conductance(self, aperture: Float | float) -> Float:
        """c_L g = g^3 / (12 mu_f) of Eqs. 19 and 81 [m^3/(Pa s)], capped; shape as given.

        Args:
            aperture: Aperture [m], zero or less where closed.
        """
        return np.clip(aperture, 0.0, self.aperture_cap) ** 3 / (12.0 * self.viscosity)

    def longitudinal_conductance_slope(self, aperture: Float) -> Float:
        """Derivative of `longitudinal_conductance` [m^2/(Pa s)]; shape as given."""
        led = (aperture > 0.0) & (aperture < self.aperture_cap)
        return np.where(led, aperture**2 / (4.0 * self.viscosity), 0.0)

    def transverse_conductivity(self, aperture: Float | float) -> Float:
        """c_T = k_T / (gamma_f g) of Eq. 21 [m/(Pa s)]; shape as given.

        Args:
            aperture: Aperture [m]; where it is zero or less nothing leaks, for there is no drop.
        """
        c, g = self.transverse_permeability / self.unit_weight, np.asarray(aperture, float)
        return np.divide(c, g, out=np.zeros_like(g), where=g > 0.0)

    def transverse_conductivity_slope(self, aperture: Float) -> Float:
        """Derivative of `transverse_conductivity` [1/(Pa s)]; shape as given."""
        c = -self.transverse_permeability / self.unit_weight
        return np.divide(c, aperture**2, out=np.zeros_like(aperture), where=aperture > 0.0)
