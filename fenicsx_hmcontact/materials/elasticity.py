# SPDX-License-Identifier: LGPL-3.0-or-later
"""The moduli that linear isotropic laws share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .interface import Float


@dataclass(frozen=True)
class IsotropicElasticity:
    """Linear isotropic elasticity in plane strain.

    Attributes:
        E: Young's modulus [Pa].
        nu: Poisson's ratio [-].

    Raises:
        ValueError: If E is not positive or nu not between -1 and 0.5.
    """

    E: float
    nu: float

    def __post_init__(self) -> None:
        """Refuse values that make no sense."""
        if not self.E > 0.0:
            raise ValueError(f"E is {self.E}; Young's modulus must be positive")
        if not -1.0 < self.nu < 0.5:
            raise ValueError(f"nu is {self.nu}; Poisson's ratio must lie between -1 and 0.5")

    @property
    def shear_modulus(self) -> float:
        """G [Pa]."""
        return self.E / (2.0 * (1.0 + self.nu))

    @property
    def lame(self) -> float:
        """First Lame constant [Pa]."""
        return self.E * self.nu / ((1.0 + self.nu) * (1.0 - 2.0 * self.nu))

    @property
    def oedometric_modulus(self) -> float:
        """Stiffness M against strain in one direction only [Pa]."""
        return self.lame + 2.0 * self.shear_modulus

    @cached_property
    def stiffness(self) -> Float:
        """Derivative of the stress xx, yy, zz, xy by the strain xx, yy, 2 xy [Pa]; shape (4, 3)."""
        m, lame = self.oedometric_modulus, self.lame
        shear = [0.0, 0.0, self.shear_modulus]
        return np.array([[m, lame, 0.0], [lame, m, 0.0], [lame, lame, 0.0], shear])
