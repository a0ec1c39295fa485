# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws of the water between two surfaces (Section 2.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class GapFlow:
    """Water between two porous bodies: along the gap by the cubic law, across it by leak-off.

    Attributes:
        transverse_permeability: k_T [m/s] of Eq. 21.
        viscosity: Dynamic viscosity mu_f [Pa s] of Eq. 19.
        unit_weight: Unit weight gamma_f [N/m^3] of the water.
        aperture: Constant hydraulic aperture [m], filled and not stored in; None for the contact
            gap. Where it is zero, or the surfaces are closed, the pore pressure is continuous.
            Gravity is not considered in the film: its water flows by pressure alone.

    Raises:
        ValueError: If a value is not positive (the aperture: negative).
    """

    transverse_permeability: float
    viscosity: float = 1e-3
    unit_weight: float = 1e4
    aperture: float | None = None

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        for name in ("transverse_permeability", "viscosity", "unit_weight"):
            value = getattr(self, name)
            if not (value > 0.0 and math.isfinite(value)):
                raise ValueError(f"{name} is {value}; it must be positive")
        if self.aperture is not None and not (
            self.aperture >= 0.0 and math.isfinite(self.aperture)
        ):
            raise ValueError(f"aperture is {self.aperture}; it must be zero or positive, or None")

    def transverse_conductivity(self, aperture: float) -> float:
        """c_T = k_T / (gamma_f g) [m/(Pa s)] of Eq. 21."""
        return self.transverse_permeability / (self.unit_weight * aperture)

    def longitudinal_conductance(self, aperture: float) -> float:
        """c_L g = g^3 / (12 mu_f) [m^3/(Pa s)] of Eqs. 19 and 81."""
        return aperture**3 / (12.0 * self.viscosity)
