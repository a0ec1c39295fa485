# SPDX-License-Identifier: LGPL-3.0-or-later
"""Linear isotropic elasticity in plane strain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import ufl

from .elasticity import IsotropicElasticity
from .interface import Float, MaterialUpdate


@dataclass(frozen=True)
class LinearElastic(IsotropicElasticity):
    """Hooke's law; stress is positive in tension.

    Attributes:
        E: Young's modulus [Pa].
        nu: Poisson's ratio [-].

    Raises:
        ValueError: If E is not positive or nu not between -1 and 0.5.
    """

    @property
    def history_names(self) -> tuple[str, ...]:
        """None: the law remembers nothing."""
        return ()

    def stress(self, u: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
        """Effective stress [Pa] in the plane at displacement u [m]; UFL, shape (2, 2)."""
        strain = ufl.sym(ufl.grad(u))
        return 2.0 * self.shear_modulus * strain + self.lame * ufl.tr(strain) * ufl.Identity(2)

    def initial_history(self, n: int) -> Float:
        """Empty; shape (n, 0)."""
        return np.zeros((n, 0))

    def update(self, stress: Float, strain: Float, history: Float) -> MaterialUpdate:
        """Add the stress of the strain increment, see `Material`."""
        n = len(stress)
        return MaterialUpdate(
            stress=stress + strain @ self.stiffness.T,
            history=history.copy(),
            by_strain=np.tile(self.stiffness, (n, 1, 1)),
            by_stress=np.tile(np.eye(4), (n, 1, 1)),
        )
