# SPDX-License-Identifier: LGPL-3.0-or-later
"""The film of water in a gap that opens, closes and slides (Eqs. 76 to 92, corrected)."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, diags_array

from ..contact import (
    GeometryDerivatives,
    Kinematics,
    covered_gradients,
    covered_products,
    covered_shapes,
)
from .law import GapFlow
from .pressure import GapPressure

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]


class MovingFilm:
    """Water in the gap at the current place of the surfaces, in one step.

    Volumes are those of a step, positive where water is taken up by the film or flows away in it.

    Args:
        flow: Its law.
        kinematics: The surfaces.
        water: Pore pressures on both of them.
        closed: Nodes where the solids touch: no drop, no flow along; shape (n_s,).
        before: Aperture of each node at the start of the step [m], nan at nodes without film then;
            shape (n_s,).
        time_step: Length of the step [s].

    Attributes:
        aperture: Aperture of the film at each node [m]; shape (n_s,).
        volumes: Storage and flow along the gap, by the mean pressure's shape functions, of the
            secondary and then the primary nodes [m^3/m]; shape (n_s + n_m,).
        leak: Flow across the gap, from the secondary to the primary face [m^3/m]; shape (n_s,).
    """

    def __init__(
        self,
        flow: GapFlow,
        kinematics: Kinematics,
        water: GapPressure,
        closed: Bool,
        before: Float,
        time_step: float,
    ) -> None:
        self._flow, self._kinematics, self._water = flow, kinematics, water
        self._dt = time_step
        self.aperture = kinematics.aperture()
        surface, segments = kinematics.secondary, kinematics.segments
        self._nodes = surface.edges[segments.secondary_edge]
        arguments = surface, segments
        self._gaps = covered_shapes(*arguments, kinematics.operator.kept)
        self._pressures = covered_shapes(*arguments, kinematics.pressures.kept)
        self._slopes = covered_gradients(*arguments, kinematics.pressures.kept)
        open_ = np.where(closed, 0.0, self.aperture)
        self._width = np.einsum("gi,gi->g", self._gaps, open_[self._nodes])
        self._leaking = water.related & ~closed
        self._open = (~closed).astype(float)
        # A node that got its film in this step takes the increment of its neighbours.
        self._swept = _swept(surface.edges, kinematics.operator.kept, ~np.isnan(before))
        self._change = self._swept @ (self.aperture - np.nan_to_num(before))

        self._taken_up = self._storage @ self._change + self._along @ water.mean
        self.volumes = water.mean_weights.T @ self._taken_up
        self.leak = self.of_drops @ water.drop

    @cached_property
    def of_drops(self) -> csr_array:
        """Flow across the gap per unit of the pressure drops [m^2/Pa]; shape (n_s, n_s)."""
        leaking = diags_array(self._leaking.astype(float))
        leakage = self._dt * self._flow.transverse_conductivity(self._width)
        return leaking @ self._integral(self._pressures, self._pressures, leakage) @ leaking

    @property
    def of_pressures(self) -> csr_array:
        """Derivative of the volumes with respect to the pore pressures [m^2/Pa].

        Its shape is (n_s + n_m, n_s + n_m).
        """
        weights = self._water.mean_weights
        return csr_array(weights.T @ self._along @ weights)

    def of_apertures(self) -> tuple[csr_array, csr_array]:
        """Derivatives of volumes and leak with respect to the apertures.

        Returns:
            Matrices [m] of shapes (n_s + n_m, n_s) and (n_s, n_s).
        """
        slope = np.einsum("gi,gi->g", self._slopes, self._water.mean[self._nodes])
        drop = np.einsum("gi,gi->g", self._pressures, self._water.drop[self._nodes])
        cubic = self._flow.longitudinal_conductance_slope(self._width) * slope
        leak = self._flow.transverse_conductivity_slope(self._width) * drop
        along = self._integral(self._slopes, self._gaps, cubic) @ diags_array(self._open)
        of_taken_up = self._storage @ self._swept + self._dt * along
        weights = self._water.mean_weights
        leaking, moving = (diags_array(x.astype(float)) for x in (self._leaking, self._open))
        of_leak = leaking @ self._integral(self._pressures, self._gaps, leak) @ moving
        return csr_array(weights.T @ of_taken_up), csr_array(self._dt * of_leak)

    def geometry_derivative(
        self, displacement: GeometryDerivatives, pressure: GeometryDerivatives
    ) -> csr_array:
        """Derivative of the volumes with respect to the coordinates, at fixed apertures.

        What the film's conductance owes to the lengths of its facets is left out.

        Args:
            displacement: Derivatives of the coupling of the displacements.
            pressure: Derivatives of the coupling of the pore pressures.

        Returns:
            Matrix [m]; shape (n_s + n_m, 2 n_s + 2 n_m).
        """
        water, D = self._water, self._kinematics.pressures.D
        secondary, primary = (values[:, None] for values in water.values)
        of_mean = diags_array(-0.5 * water.related) @ pressure.relative(secondary, primary)
        of_taken_up = displacement.mass(self._change, pressure) + self._along @ of_mean
        share = np.where(water.related, 0.5 * self._taken_up, 0.0)
        per_length = np.divide(share, D, out=np.zeros_like(D), where=D > 0.0)
        passed_on = pressure.forces(per_length[:, None])
        return csr_array(water.mean_weights.T @ of_taken_up - passed_on)

    @cached_property
    def _storage(self) -> csr_array:
        return self._integral(self._pressures, self._gaps, np.ones_like(self._width))

    @cached_property
    def _along(self) -> csr_array:
        conductance = self._dt * self._flow.longitudinal_conductance(self._width)
        return self._integral(self._slopes, self._slopes, conductance)

    def _integral(self, tests: Float, trials: Float, factor: Float) -> csr_array:
        """Integrate products of functions of the two nodes of each facet; shape (n_s, n_s)."""
        kinematics = self._kinematics
        return covered_products(kinematics.secondary, kinematics.segments, tests, trials, factor)


def _swept(edges: npt.NDArray[np.int32], now: Bool, before: Bool) -> csr_array:
    """Increments that count, from the changes of the apertures; shape (n_s, n_s).

    A node with film now and before has its own; one with film only now that of its neighbours.
    """
    n = len(now)
    both, new = now & before, now & ~before
    ends = np.concatenate((edges, edges[:, ::-1]))
    ends = ends[new[ends[:, 0]] & both[ends[:, 1]]]
    count = np.bincount(ends[:, 0], minlength=n)
    beside = csr_array((1.0 / count[ends[:, 0]], ends.T), (n, n))
    return csr_array(diags_array(both.astype(float)) + beside)
