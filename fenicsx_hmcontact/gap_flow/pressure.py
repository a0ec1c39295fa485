# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pore pressures of two faces that move, and how the water between them presses (Eqs. 84 to 92)."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, diags_array, hstack

from ..contact import GeometryDerivatives, Kinematics, covered_products, covered_shapes

Float = npt.NDArray[np.float64]


class GapPressure:
    """Pore pressures on both faces of a gap.

    Args:
        kinematics: The surfaces.
        prescribed: Secondary nodes with a prescribed pore pressure; shape (n_s,).
        secondary: Pore pressures of the secondary nodes [Pa]; shape (n_s,).
        primary: Pore pressures of the primary nodes [Pa]; shape (n_m,).

    Attributes:
        values: Pore pressures of the nodes of both surfaces [Pa].
        related: Secondary nodes whose unknown is the pressure drop; shape (n_s,).
        drop: Pressure of the secondary less that of the primary face, zero at other nodes [Pa];
            shape (n_s,).
        mean: Mean pressure of both faces; where it is prescribed, that of the secondary face:
            so a reservoir at the end of a gap feeds it [Pa]; shape (n_s,).
        force: Force of the water on the secondary surface, along the normal [N/m]; shape (n_s,).
    """

    def __init__(
        self,
        kinematics: Kinematics,
        prescribed: npt.NDArray[np.bool_],
        secondary: Float,
        primary: Float,
    ) -> None:
        self._kinematics = kinematics
        self.values = secondary, primary
        operator = kinematics.pressures
        self.related = operator.kept & ~prescribed
        drop = secondary + operator.C @ secondary - operator.H @ primary
        self.drop = np.where(self.related, drop, 0.0)
        self.mean = secondary - 0.5 * self.drop
        self.force = self._force_of_mean @ self.mean

    @cached_property
    def mean_weights(self) -> csr_array:
        """Mean pressure from those of the secondary and primary nodes; shape (n_s, n_s + n_m)."""
        operator = self._kinematics.pressures
        half = diags_array(0.5 * self.related)
        own = diags_array(1.0 - 0.5 * self.related) - half @ operator.C
        return hstack((own, half @ operator.H), format="csr")

    @property
    def force_weights(self) -> csr_array:
        """Force of the water from the pressures of both faces [m]; shape (n_s, n_s + n_m)."""
        return self._force_of_mean @ self.mean_weights

    def force_derivative(
        self,
        displacement: GeometryDerivatives,
        pressure: GeometryDerivatives,
    ) -> csr_array:
        """Derivative of the force with respect to the coordinates of both surfaces.

        Args:
            displacement: Derivatives of the coupling of the displacements.
            pressure: Derivatives of the coupling of the pore pressures.

        Returns:
            Matrix [Pa]; shape (n_s, 2 n_s + 2 n_m).
        """
        operator = self._kinematics.operator
        plain = self._mass @ self.mean
        share = self._kinematics.share
        secondary, primary = (values[:, None] for values in self.values)
        of_mean = diags_array(-0.5 * self.related) @ pressure.relative(secondary, primary)
        of_share = displacement.relative(np.ones_like(secondary), np.zeros_like(primary))
        result = self._force_of_mean @ of_mean
        result += diags_array(share) @ pressure.mass(self.mean, displacement)
        result -= diags_array(share**2 * plain * operator.kept) @ of_share
        return csr_array(result)

    @cached_property
    def _mass(self) -> csr_array:
        kinematics = self._kinematics
        surface, segments = kinematics.secondary, kinematics.segments
        tests, trials = (
            covered_shapes(surface, segments, operator.kept)
            for operator in (kinematics.operator, kinematics.pressures)
        )
        return covered_products(surface, segments, tests, trials)

    @cached_property
    def _force_of_mean(self) -> csr_array:
        return diags_array(self._kinematics.share) @ self._mass
