# SPDX-License-Identifier: LGPL-3.0-or-later
"""The film of water in a gap that opens, closes and slides (Eqs. 76 to 92, corrected)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, diags_array

from ..contact import (
    GeometryDerivatives,
    Kinematics,
    Segments,
    covered_gradients,
    covered_products,
    covered_shapes,
    unseen_values,
)
from .law import GapFlow
from .pressure import GapPressure

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

POINTS = 3
"""Gauss points of a segment."""

POWERS = (-1, 1)
"""Power of a facet's length with which its flow along and its leaks grow."""

THIN = 1e-3
"""Thinnest film that pressures no node sees pass through [facets]."""


class MovingFilm:
    """Water in the gap at the current place of the surfaces, in one step.

    Volumes are those of a step, positive where water is taken up by the film or flows away in it.

    Args:
        flow: Its law.
        kinematics: The surfaces.
        water: Pore pressures of their nodes.
        closed: Nodes with nothing between the faces, of lagged gaps at the start of the step; shape
            (n_s,).
        before: Gap of each node at the start of the step [m], zero without film; shape (n_s,).
        time_step: Length of the step [s].
        unseen: Exchange of pore pressures that the coupling does not see, from `unseen_exchange`
            [m^2/(Pa s)]; shape (n_p, n_p).

    Attributes:
        watertight: Nodes without drop: nothing is between the faces; shape (n_s,).
        volumes: Storage and flow along the gap, for the pore pressures of the faces [m^3/m]; shape
            (n_p,).
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
        unseen: csr_array,
    ) -> None:
        self._flow, self._kinematics, self._dt = flow, kinematics, time_step
        # What makes the water flow: pressures beyond those at rest.
        driving = water if flow.gravity is None else water.in_excess(flow.unit_weight, flow.gravity)
        self._driving = driving
        gap = kinematics.aperture()
        self._open_gap = np.where(closed, 0.0, before if flow.lagged else gap)
        self._points = self._at(kinematics.segments)
        self._aperture, self._widening = self._points.aperture(flow, self._open_gap)
        self._conductance, self._of_ends = self._points.conductance(flow, self._open_gap)
        self._opening = diags_array(np.where(closed | flow.lagged, 0.0, 1.0))
        self.watertight = closed if flow.closes else np.zeros_like(closed)
        self._leaking = water.related & ~self.watertight
        self._taken_up = kinematics.growth() + self._along @ driving.mean
        self._unseen = time_step * unseen
        self.volumes = driving.mean_weights.T @ self._taken_up + self._unseen @ driving.values
        self.leak = self.of_drops @ driving.drop

    @cached_property
    def of_drops(self) -> csr_array:
        """Flow across the gap per unit of the pressure drops [m^2/Pa]; shape (n_s, n_s)."""
        leaking = diags_array(self._leaking.astype(float))
        leakage = self._dt * self._flow.transverse_conductivity(self._aperture)
        shapes = self._points.pressures
        return leaking @ self._integral(shapes, shapes, leakage) @ leaking

    @property
    def of_pressures(self) -> csr_array:
        """Derivative of the volumes with respect to the pore pressures [m^2/Pa]; (n_p, n_p)."""
        weights = self._driving.mean_weights
        return csr_array(weights.T @ self._along @ weights + self._unseen)

    def of_coordinates(
        self, displacement: GeometryDerivatives | None, pressure: GeometryDerivatives | None
    ) -> tuple[csr_array, csr_array]:
        """Derivatives of volumes and leak with respect to the coordinates of both surfaces.

        Args:
            displacement: Derivatives of the coupling of the displacements; None where it stays.
            pressure: Derivatives of the coupling of the pore pressures.

        Returns:
            Matrices [m] of shapes (n_p, 2 n_s + 2 n_m) and (n_s, 2 n_s + 2 n_m).
        """
        driving, kinematics = self._driving, self._kinematics
        of_gap = kinematics.aperture_derivative()
        of_taken_up, of_leak = (matrix @ of_gap for matrix in self._of_gaps())
        of_mean, of_drop = (
            driving.mean_weights @ self._heights,
            driving.drop_weights @ self._heights,
        )
        if displacement is None or pressure is None:
            of_taken_up = of_taken_up + kinematics.void.of_points
        else:
            along, across = self._of_facets(displacement)
            of_taken_up = of_taken_up + kinematics.void.growth_derivative() + along
            of_leak = of_leak + across
            of_mean = of_mean + driving.mean_derivative(pressure)
            of_drop = of_drop + driving.drop_derivative(pressure)
        of_volumes = driving.mean_weights.T @ (of_taken_up + self._along @ of_mean)
        of_volumes = of_volumes + self._unseen @ self._heights
        if displacement is not None and pressure is not None:
            of_volumes = of_volumes + driving.spread_derivative(self._taken_up, pressure)
        return csr_array(of_volumes), csr_array(of_leak + self.of_drops @ of_drop)

    def _of_gaps(self) -> tuple[csr_array, csr_array]:
        """Derivatives of flow along and leak by the gaps [m]; shapes (n_s, n_s)."""
        flow, driving, at = self._flow, self._driving, self._points
        slope, drop = at(at.slopes, driving.mean), at(at.pressures, driving.drop)
        across = flow.transverse_conductivity_slope(self._aperture) * self._widening * drop
        along = self._dt * self._integral(at.slopes, self._of_ends, slope) @ self._opening
        leaking = diags_array(self._leaking.astype(float))
        leak = self._dt * leaking @ self._integral(at.pressures, at.gaps, across) @ self._opening
        return csr_array(along), csr_array(leak)

    def _of_facets(self, d: GeometryDerivatives) -> tuple[csr_array, csr_array]:
        """Derivatives of flow along and leak by covered parts and lengths of facets.

        Both at given gaps and pressures.
        """
        segments, q = self._kinematics.segments, d.integrals
        edges = segments.secondary_edge[::POINTS][q.starts]
        half = q.length / q.edge_length
        ends = (q.centre[:, None] + np.array([-1.0, 1.0]) * half[:, None]).ravel()
        at_ends = self._flows(self._at(replace(segments, secondary_edge=edges.repeat(2), xi=ends)))
        inside = self._flows(self._points)
        parts = q.part.repeat(POINTS)
        results = []
        for power, points, end in zip(POWERS, inside, at_ends, strict=True):
            weighted = segments.weight[:, None] * points
            total = np.column_stack([np.bincount(parts, w, len(edges)) for w in weighted.T])
            of_length = power * total / q.edge_length[:, None]
            results.append(d.integral(end.reshape(-1, 2, 2).swapaxes(1, 2), of_length))
        along, leak = results
        return along, leak

    def _flows(self, at: _Points) -> tuple[Float, Float]:
        """What flows along and leaks, by the nodes' functions; shapes (k, 2)."""
        flow, driving = self._flow, self._driving
        aperture, _ = at.aperture(flow, self._open_gap)
        conductance, _ = at.conductance(flow, self._open_gap)
        along = self._dt * conductance * at(at.slopes, driving.mean)
        drop = at(at.pressures, np.where(self._leaking, driving.drop, 0.0))
        leak = self._dt * flow.transverse_conductivity(aperture) * drop
        leaking = self._leaking[at.nodes]
        return at.slopes * along[:, None], at.pressures * leaking * leak[:, None]

    @property
    def _heights(self) -> csr_array:
        """Derivative of gamma_f h at the pore pressures [Pa/m]; (n_p, 2 n_s + 2 n_m)."""
        faces, flow = self._driving.faces, self._flow
        n = sum(len(points) for points in self._kinematics.points)
        up = -flow.unit_weight * np.array(flow.gravity or (0.0, 0.0))
        columns = (2 * faces[:, None] + np.arange(2)).ravel()
        ends = np.arange(0, columns.size + 1, 2)
        return csr_array((np.tile(up, faces.size), columns, ends), (faces.size, 2 * n))

    @cached_property
    def _along(self) -> csr_array:
        slopes = self._points.slopes
        return self._integral(slopes, slopes, self._dt * self._conductance)

    def _at(self, segments: Segments) -> _Points:
        kinematics = self._kinematics
        gaps, pressures = kinematics.operator.kept, kinematics.pressures.kept
        on = kinematics.secondary, segments
        nodes = kinematics.secondary.edges[segments.secondary_edge]
        return _Points(
            nodes,
            gaps[nodes],
            covered_shapes(*on, gaps),
            covered_shapes(*on, pressures),
            covered_gradients(*on, pressures),
        )

    def _integral(self, tests: Float, trials: Float, factor: Float | None = None) -> csr_array:
        """Integrate products of functions of the two nodes of each facet; shape (n_s, n_s)."""
        kinematics = self._kinematics
        return covered_products(kinematics.secondary, kinematics.segments, tests, trials, factor)


def unseen_exchange(flow: GapFlow, kinematics: Kinematics) -> csr_array:
    """Flow between the film and pressures of the primary face that no secondary node sees.

    Where the primary surface is the finer one, some of its pressures have no mean at any secondary
    node, and only the body behind it leads their water: if it is tight, what little of the flow
    along the gap ends up there makes them boundless. So they exchange water with the film: across
    it (c_T of Eq. 21), and along it (c_L g of Eq. 81) over a facet. Linear pressures exchange
    nothing.

    Args:
        flow: Law of the film.
        kinematics: The surfaces.

    Returns:
        Flow per unit of the primary pressures [m^2/(Pa s)]; shape (n_m, n_m).
    """
    secondary, segments = kinematics.secondary, kinematics.segments
    unseen = unseen_values((secondary, kinematics.primary), segments, kinematics.pressures)
    length = secondary.lengths[segments.secondary_edge]
    gaps = kinematics.aperture()[secondary.edges[segments.secondary_edge]]
    apertures, _ = flow.hydraulic_aperture(gaps)
    across = flow.transverse_conductivity(np.maximum(apertures.max(axis=1), THIN * length))
    along = flow.conductance_between(apertures)[0] / length**2
    return csr_array(unseen.T @ diags_array(segments.weight * (across + along)) @ unseen)


@dataclass(frozen=True)
class _Points:
    """Points of the film and the functions of the two nodes around each.

    Attributes:
        nodes: The nodes; shape (k, 2).
        bound: Which of them end the film; it is as wide as at the other where one does not; (k, 2).
        gaps: Shape functions of gaps; shape (k, 2).
        pressures: Shape functions of mean pressure and drop; shape (k, 2).
        slopes: Their derivatives along the chain [1/m]; shape (k, 2).
    """

    nodes: npt.NDArray[np.int32]
    bound: Bool
    gaps: Float
    pressures: Float
    slopes: Float

    def __call__(self, functions: Float, nodal: Float) -> Float:
        """Nodal values at the points; shape (k,)."""
        values: Float = np.einsum("gi,gi->g", functions, nodal[self.nodes])
        return values

    def aperture(self, flow: GapFlow, gap: Float) -> tuple[Float, Float]:
        """Hydraulic aperture [m] and its derivative by the gap [-]; shapes (k,)."""
        width = self(self.gaps, gap)
        aperture, slope = flow.hydraulic_aperture(width)
        return aperture, np.where(width > 0.0, slope, 0.0)

    def conductance(self, flow: GapFlow, gap: Float) -> tuple[Float, Float]:
        """Conductance [m^3/(Pa s)] between the nodes, derivatives by gaps; shapes (k,), (k, 2)."""
        width = gap[self.nodes]
        width = np.where(self.bound, width, width[:, ::-1])
        aperture, widening = flow.hydraulic_aperture(width)
        conductance, slopes = flow.conductance_between(aperture)
        slopes = slopes * np.where(width > 0.0, widening, 0.0)
        both = self.bound.all(axis=1, keepdims=True)
        alone = self.bound * slopes.sum(axis=1, keepdims=True)
        return conductance, np.where(both, slopes, alone)
