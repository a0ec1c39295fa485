# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pore pressures of two faces that move, and of the water between them (Eqs. 84 to 92).

The face of a dry body has no pore pressure. The water between it and a porous body has the pressure
of the porous face alone.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, diags_array, eye_array, hstack

from ..contact import GeometryDerivatives, Kinematics

Float = npt.NDArray[np.float64]


class GapPressure:
    """Pore pressures on the faces of a gap; n_p of them, the secondary face's before the primary's.

    Args:
        kinematics: The surfaces.
        free: Secondary nodes whose unknown may be the pressure drop: neither prescribed nor that of
            another pair; shape (n_s,).
        inner: Secondary nodes where the film has the mean pressure of both faces; not where it is
            prescribed, nor where films of two pairs meet, which must have one pressure; (n_s,).
        secondary: Pore pressures of the secondary nodes [Pa]; shape (n_s,). None on a dry body.
        primary: Pore pressures of the primary nodes [Pa]; shape (n_m,). None on a dry body.

    Attributes:
        related: Secondary nodes whose unknown is the pressure drop; shape (n_s,).
        drop: Pressure of the secondary less that of the primary face, zero at other nodes [Pa];
            shape (n_s,).
        mean: Mean pressure of both faces (Eq. 86) at inner nodes, that of the secondary face at
            others: so a reservoir at the end of a gap feeds it; or that of the only porous face
            [Pa]; shape (n_s,).
        values: Pore pressures of both faces [Pa]; shape (n_p,).
    """

    def __init__(
        self,
        kinematics: Kinematics,
        free: npt.NDArray[np.bool_],
        inner: npt.NDArray[np.bool_],
        secondary: Float | None,
        primary: Float | None,
    ) -> None:
        self._kinematics = kinematics
        self._free, self._inner = free, inner
        self._secondary, self._primary = secondary, primary
        operator = kinematics.pressures
        self._averaged = operator.kept & inner
        self.related = np.zeros_like(free)
        self.drop = np.zeros(len(free))
        if secondary is not None and primary is not None:
            self.related = operator.kept & free
            drop = secondary + operator.C @ secondary - operator.H @ primary
            self.drop = np.where(self.related, drop, 0.0)
        present = [values for values in (secondary, primary) if values is not None]
        self.values = np.concatenate(present)
        self.mean = self.mean_weights @ self.values

    def in_excess(self, unit_weight: float, gravity: tuple[float, float]) -> GapPressure:
        """Pressures beyond those of water at rest, p + gamma_f h.

        Args:
            unit_weight: gamma_f [N/m^3].
            gravity: Direction of gravity.
        """
        heights = (-(points @ np.asarray(gravity)) for points in self._kinematics.points)
        excess = (
            None if p is None else p + unit_weight * h
            for p, h in zip((self._secondary, self._primary), heights, strict=True)
        )
        return GapPressure(self._kinematics, self._free, self._inner, *excess)

    @property
    def faces(self) -> npt.NDArray[np.intp]:
        """Which of the n_s + n_m nodes of both surfaces have a pore pressure; shape (n_p,)."""
        n, m = (len(points) for points in self._kinematics.points)
        here = np.repeat([self._secondary is not None, self._primary is not None], [n, m])
        return np.flatnonzero(here)

    @cached_property
    def mean_weights(self) -> csr_array:
        """Mean pressure from the pore pressures [-]; shape (n_s, n_p)."""
        operator = self._kinematics.pressures
        if self._primary is None:
            return csr_array(eye_array(len(self.related)))
        if self._secondary is None:
            return csr_array(diags_array(self._share) @ operator.H)
        half = diags_array(0.5 * self._averaged)
        own = diags_array(1.0 - 0.5 * self._averaged) - half @ operator.C
        return hstack((own, half @ operator.H), format="csr")

    @property
    def drop_weights(self) -> csr_array:
        """Pressure drop from the pore pressures [-]; shape (n_s, n_p)."""
        operator = self._kinematics.pressures
        if self._secondary is None or self._primary is None:
            return csr_array(self.mean_weights.shape)
        related = diags_array(self.related.astype(float))
        return hstack((related + related @ operator.C, -(related @ operator.H)), format="csr")

    def drop_derivative(self, pressure: GeometryDerivatives) -> csr_array:
        """Derivative of the drop with respect to the coordinates [Pa/m]; (n_s, 2 n_s + 2 n_m).

        Args:
            pressure: Derivatives of the coupling of the pore pressures.
        """
        return self._difference_derivative(self.related, pressure)

    def mean_derivative(self, pressure: GeometryDerivatives) -> csr_array:
        """Derivative of the mean pressure with respect to the coordinates; as the drop's."""
        if self._secondary is not None or self._primary is None:
            return -0.5 * self._difference_derivative(self._averaged, pressure)
        passed_on = self._kinematics.pressures.H @ self._primary
        none = np.zeros((len(self._share), 1))
        of_primary = diags_array(-self._share) @ pressure.relative(none, self._primary[:, None])
        return of_primary - diags_array(self._share**2 * passed_on) @ self._beside(pressure)

    def spread_derivative(self, volumes: Float, pressure: GeometryDerivatives) -> csr_array:
        """Derivative of what volumes give to the pore pressures, mean_weights^T volumes.

        Args:
            volumes: By the mean pressure's shape functions, fixed [m^3/m]; shape (n_s,).
            pressure: Derivatives of the coupling of the pore pressures.

        Returns:
            Matrix [m]; shape (n_p, 2 n_s + 2 n_m).
        """
        operator, n = self._kinematics.pressures, len(volumes)
        if self._primary is None:
            return csr_array((n, 2 * (n + operator.H.shape[1])))
        weights = self._share if self._secondary is None else 0.5 * self._averaged
        passed_on = weights * volumes
        per_length = np.divide(passed_on, operator.D, out=np.zeros(n), where=operator.D > 0.0)
        spread = -pressure.forces(per_length[:, None])
        if self._secondary is not None:
            return spread
        of_share = diags_array(self._share**2 * volumes) @ self._beside(pressure)
        return spread[n:] - operator.H.T @ of_share

    def _difference_derivative(
        self, nodes: npt.NDArray[np.bool_], pressure: GeometryDerivatives
    ) -> csr_array:
        """Derivative of the difference of both faces at some nodes; shape (n_s, 2 n_s + 2 n_m)."""
        if self._secondary is None or self._primary is None:
            n, m = (len(points) for points in self._kinematics.points)
            return csr_array((n, 2 * (n + m)))
        of_all = pressure.relative(self._secondary[:, None], self._primary[:, None])
        return diags_array(nodes.astype(float)) @ of_all

    @property
    def _share(self) -> Float:
        """Part of a node's shape function that is not that of its dropped neighbours; (n_s,)."""
        operator = self._kinematics.pressures
        share: Float = operator.kept / (1.0 + operator.C.sum(axis=1))
        return share

    def _beside(self, coupling: GeometryDerivatives) -> csr_array:
        """Derivative of the sum of the weights of dropped neighbours; (n_s, 2 n_s + 2 n_m)."""
        n, m = (len(points) for points in self._kinematics.points)
        return coupling.relative(np.ones((n, 1)), np.zeros((m, 1)))
