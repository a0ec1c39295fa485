# SPDX-License-Identifier: LGPL-3.0-or-later
"""Linear isotropic elasticity in plane strain."""

from __future__ import annotations

from dataclasses import dataclass

import ufl


@dataclass(frozen=True)
class LinearElastic:
    """Hooke's law; stress is positive in tension.

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

    def stress(self, u: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
        """Effective stress [Pa] in the plane at displacement u [m]; UFL, shape (2, 2)."""
        strain = ufl.sym(ufl.grad(u))
        return 2.0 * self.shear_modulus * strain + self.lame * ufl.tr(strain) * ufl.Identity(2)
