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
)
from .law import GapFlow
from .pressure import GapPressure

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

DRAGGED = 0.5
"""Part of the relative slip by which the water is carried along: it sticks to both faces."""


POINTS = 3
"""Gauss points of a segment."""

POWERS = (-1, 0, 1)
"""Power of a facet's length with which its flow along, what it carries along, and leaks grow."""


class MovingFilm:
    """Water in the gap at the current place of the surfaces, in one step.

    Volumes are those of a step, positive where water is taken up by the film or flows away in it.

    Args:
        flow: Its law.
        kinematics: The surfaces.
        water: Pore pressures of their nodes.
        closed: Nodes with nothing between the faces, of lagged gaps at the start of the step; shape
            (n_s,).
        before: Gap of each node at the start of the step [m], nan at nodes without film then;
            shape (n_s,).
        time_step: Length of the step [s].

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
    ) -> None:
        self._flow, self._kinematics, self._dt = flow, kinematics, time_step
        # What makes the water flow: pressures beyond those at rest.
        driving = water if flow.gravity is None else water.in_excess(flow.unit_weight, flow.gravity)
        self._driving = driving
        gap = kinematics.aperture()
        self._open_gap = np.where(closed, 0.0, np.nan_to_num(before) if flow.lagged else gap)
        self._points = self._at(kinematics.segments)
        self._aperture, self._widening = self._points.aperture(flow, self._open_gap)
        self._conductance, self._of_ends = self._points.conductance(flow, self._open_gap)
        self._opening = diags_array(np.where(closed | flow.lagged, 0.0, 1.0))
        self.watertight = closed if flow.closes else np.zeros_like(closed)
        self._leaking = water.related & ~self.watertight
        # A node that got its film in this step takes the increment of its neighbours.
        self._swept = _swept(
            kinematics.secondary.edges, kinematics.operator.kept, ~np.isnan(before)
        )
        self._change = self._swept @ (gap - np.nan_to_num(before))
        self._slip = kinematics.tangential_slip()
        self._gap = gap

        self._taken_up = self._storage @ self._change + self._along @ driving.mean
        self._taken_up -= self._carried @ self._slip
        self.volumes = driving.mean_weights.T @ self._taken_up
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
        return csr_array(weights.T @ self._along @ weights)

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
        of_taken_up = of_taken_up - self._carried @ kinematics.tangential_slip_derivative()
        of_mean, of_drop = (
            driving.mean_weights @ self._heights,
            driving.drop_weights @ self._heights,
        )
        if displacement is not None and pressure is not None:
            of_taken_up = of_taken_up + displacement.mass(self._change, pressure)
            along, across = self._of_facets(displacement)
            of_taken_up, of_leak = of_taken_up + along, of_leak + across
            of_mean = of_mean + driving.mean_derivative(pressure)
            of_drop = of_drop + driving.drop_derivative(pressure)
        of_volumes = driving.mean_weights.T @ (of_taken_up + self._along @ of_mean)
        if displacement is not None and pressure is not None:
            of_volumes = of_volumes + driving.spread_derivative(self._taken_up, pressure)
        return csr_array(of_volumes), csr_array(of_leak + self.of_drops @ of_drop)

    def _of_gaps(self) -> tuple[csr_array, csr_array]:
        """Derivatives of what is taken up and of the leak by the gaps [m]; shapes (n_s, n_s)."""
        flow, driving, at = self._flow, self._driving, self._points
        slope, drop = at(at.slopes, driving.mean), at(at.pressures, driving.drop)
        across = flow.transverse_conductivity_slope(self._aperture) * self._widening * drop
        slip = DRAGGED * at(at.gaps, self._slip)
        taken_up = self._dt * self._integral(at.slopes, self._of_ends, slope) @ self._opening
        taken_up += self._storage @ self._swept
        taken_up -= self._integral(at.pressures, at.gap_slopes, slip)
        leaking = diags_array(self._leaking.astype(float))
        leak = self._dt * leaking @ self._integral(at.pressures, at.gaps, across) @ self._opening
        return csr_array(taken_up), csr_array(leak)

    def _of_facets(self, d: GeometryDerivatives) -> tuple[csr_array, csr_array]:
        """Derivatives of what is taken up and of the leak by covered parts and lengths of facets.

        Both at given gaps, pressures and slips, and without storage.
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
        along, carried, leak = results
        return along - carried, leak

    def _flows(self, at: _Points) -> tuple[Float, Float, Float]:
        """What flows along, is carried along and leaks, by the nodes' functions; shapes (k, 2)."""
        flow, driving = self._flow, self._driving
        aperture, _ = at.aperture(flow, self._open_gap)
        conductance, _ = at.conductance(flow, self._open_gap)
        along = self._dt * conductance * at(at.slopes, driving.mean)
        carried = DRAGGED * at(at.gap_slopes, self._gap) * at(at.gaps, self._slip)
        drop = at(at.pressures, np.where(self._leaking, driving.drop, 0.0))
        leak = self._dt * flow.transverse_conductivity(aperture) * drop
        leaking = self._leaking[at.nodes]
        return (
            at.slopes * along[:, None],
            at.pressures * carried[:, None],
            at.pressures * leaking * leak[:, None],
        )

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
    def _storage(self) -> csr_array:
        return self._integral(self._points.pressures, self._points.gaps)

    @cached_property
    def _along(self) -> csr_array:
        slopes = self._points.slopes
        return self._integral(slopes, slopes, self._dt * self._conductance)

    @cached_property
    def _carried(self) -> csr_array:
        """Water carried along in a gap of changing width, per slip of the secondary face [m]."""
        at = self._points
        return self._integral(at.pressures, at.gaps, DRAGGED * at(at.gap_slopes, self._gap))

    def _at(self, segments: Segments) -> _Points:
        kinematics = self._kinematics
        gaps, pressures = kinematics.operator.kept, kinematics.pressures.kept
        on = kinematics.secondary, segments
        nodes = kinematics.secondary.edges[segments.secondary_edge]
        return _Points(
            nodes,
            gaps[nodes],
            covered_shapes(*on, gaps),
            covered_gradients(*on, gaps),
            covered_shapes(*on, pressures),
            covered_gradients(*on, pressures),
        )

    def _integral(self, tests: Float, trials: Float, factor: Float | None = None) -> csr_array:
        """Integrate products of functions of the two nodes of each facet; shape (n_s, n_s)."""
        kinematics = self._kinematics
        return covered_products(kinematics.secondary, kinematics.segments, tests, trials, factor)


@dataclass(frozen=True)
class _Points:
    """Points of the film and the functions of the two nodes around each.

    Attributes:
        nodes: The nodes; shape (k, 2).
        bound: Which of them end the film; it is as wide as at the other where one does not; (k, 2).
        gaps: Shape functions of gaps and slips; shape (k, 2).
        gap_slopes: Their derivatives along the chain [1/m]; shape (k, 2).
        pressures: Shape functions of mean pressure and drop; shape (k, 2).
        slopes: Their derivatives along the chain [1/m]; shape (k, 2).
    """

    nodes: npt.NDArray[np.int32]
    bound: Bool
    gaps: Float
    gap_slopes: Float
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


def _swept(edges: npt.NDArray[np.int32], now: Bool, before: Bool) -> csr_array:
    """Increments that count, from the changes of the gaps; shape (n_s, n_s).

    A node with film now and before has its own; one with film only now that of the nearest nodes
    along the chain that have their own.
    """
    n = len(now)
    known, missing = now & before, now & ~before
    result = csr_array(diags_array(known.astype(float)))
    both_ways = np.concatenate((edges, edges[:, ::-1]))
    while True:
        ends = both_ways[missing[both_ways[:, 0]] & known[both_ways[:, 1]]]
        if not len(ends):
            return result
        count = np.bincount(ends[:, 0], minlength=n)
        beside = csr_array((1.0 / count[ends[:, 0]], ends.T), (n, n))
        result = csr_array(result + beside @ result)
        known = known | (count > 0)
        missing = missing & ~known
