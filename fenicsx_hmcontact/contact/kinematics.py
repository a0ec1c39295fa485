# SPDX-License-Identifier: LGPL-3.0-or-later
"""Two surfaces on the move: where they are, how they couple, gap and slip (Eqs. 64 and 70)."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, diags_array, eye_array, hstack

from .linearisation import GeometryDerivatives, geometry_derivatives
from .mortar import (
    MortarOperator,
    Segments,
    mortar_operator,
    mortar_segments,
    primary_coverage,
)
from .pair import ContactPair
from .surface import Surface
from .void import Void

Float = npt.NDArray[np.float64]

HALF = 0.5
"""A new node has what more than this part of its parents has."""

LATE = 0.5
"""A node that is coupled is dropped late, below this part of the smallest coverage."""


class Kinematics:
    """Surfaces of a pair at their current place.

    Args:
        pair: The pair.
        secondary: Its secondary surface, undeformed.
        primary: Its primary surface, undeformed.
        dropped: Secondary nodes with a prescribed displacement; shape (n_s,).
        displacements: Of the nodes of both surfaces at the start [m]; shapes (n_s, 2), (n_m, 2).

    Attributes:
        secondary: Secondary surface, where normals and coupling see it.
        primary: Primary surface, likewise.
        segments: Where they face each other.
        operator: Coupling of the displacements.
        pressures: Coupling of the pore pressures: prescribed displacements do not drop a node.
        faced: Primary nodes that the secondary surface faces; shape (n_m,).
    """

    def __init__(
        self,
        pair: ContactPair,
        secondary: Surface,
        primary: Surface,
        dropped: npt.NDArray[np.bool_],
        displacements: tuple[Float, Float],
    ) -> None:
        self._pair = pair
        # Coordinates about the surfaces themselves: those of a map have few digits left.
        self._origin = secondary.points.mean(axis=0)
        self._rest = secondary, primary = (
            secondary.at(secondary.points - self._origin),
            primary.at(primary.points - self._origin),
        )
        self._dropped = dropped
        self._begin(displacements)
        self._closed_gaps = np.zeros(len(dropped))
        self._covered = np.zeros(len(dropped), bool)
        self.faced = np.zeros(len(primary.nodes), bool)
        self._couple(secondary, primary)
        self.place(displacements)
        gap = self.gap()
        near = self.operator.kept & (np.abs(gap) <= pair.close_gaps)
        self._closed_gaps[near] = gap[near]
        self._start_coverage, self._opening = (self._covered, self.faced), self.aperture()

    secondary: Surface
    primary: Surface
    segments: Segments
    operator: MortarOperator
    pressures: MortarOperator

    def place(self, displacements: tuple[Float, Float]) -> None:
        """Put the surfaces where the displacements [m] are; shapes (n_s, 2) and (n_m, 2)."""
        self._u = displacements
        self._points = [s.points + u for s, u in zip(self._rest, displacements, strict=True)]
        if self._pair.motion == "finite":
            self._couple(*(s.at(x) for s, x in zip(self._rest, self._points, strict=True)))

    def start_step(self) -> None:
        """Measure slip from here on, and remember gaps and which nodes are covered."""
        self._begin(self._u)
        self._start_coverage, self._opening = (self._covered, self.faced), self.aperture()

    def restart_step(self) -> None:
        """Forget which nodes were covered since the start of the step."""
        self._covered, self.faced = self._start_coverage

    def save(self) -> Any:
        """Where the step starts."""
        return self._start, self._start_coverage, self._opening

    def restore(self, state: Any) -> None:
        """Start the step where a saved one did."""
        displacements, self._start_coverage, self._opening = state
        self._begin(displacements)
        self.restart_step()

    def nodal_states(self) -> tuple[dict[str, Float], dict[str, Float]]:
        """What the nodes of both surfaces hold at the start of a step; by name, shapes (n, ...)."""
        covered, faced = (flags.astype(float) for flags in self._start_coverage)
        secondary, primary = (surface.points for surface in self._rest)
        return (
            {"rest": secondary, "closed gap": self._closed_gaps, "covered": covered},
            {"rest": primary, "faced": faced},
        )

    def set_nodal_states(
        self,
        states: tuple[dict[str, Float], dict[str, Float]],
        origin: Float,
        displacements: tuple[Float, Float],
    ) -> None:
        """Start a step from what `nodal_states` returned, here or on another mesh.

        Args:
            states: Of the nodes of both surfaces.
            origin: Centre that belongs to them [m].
            displacements: Of the nodes of both surfaces [m]; shapes (n_s, 2), (n_m, 2).
        """
        secondary, primary = states
        self._origin, self._closed_gaps = origin, secondary["closed gap"]
        at_rest = secondary["rest"], primary["rest"]
        one, other = (s.at(x) for s, x in zip(self._rest, at_rest, strict=True))
        self._rest = one, other
        coverage = secondary["covered"] > HALF, primary["faced"] > HALF
        self._covered, self.faced = coverage
        self._begin(displacements)
        if self._pair.motion == "small":
            self._couple(*self._rest)
        self.place(displacements)
        self._start_coverage, self._opening = coverage, self.aperture()

    @property
    def points(self) -> tuple[Float, Float]:
        """Coordinates of the nodes of both surfaces about the origin [m]; (n_s, 2) and (n_m, 2)."""
        return self._points[0], self._points[1]

    @property
    def origin(self) -> Float:
        """Centre of the secondary surface at rest [m]."""
        return self._origin

    @property
    def moved(self) -> tuple[Float, Float]:
        """Displacements of both surfaces since the start of the step [m]."""
        return self._u[0] - self._start[0], self._u[1] - self._start[1]

    def between(self, secondary: Float, primary: Float) -> Float:
        """Values of the secondary less those of the primary surface; zero at dropped nodes.

        Args:
            secondary: Values of the secondary nodes; shape (n_s, 2).
            primary: Values of the primary nodes; shape (n_m, 2).
        """
        operator = self.operator
        values = secondary + operator.C @ secondary - operator.H @ primary
        return np.where(operator.kept[:, None], values, 0.0)

    def gap(self) -> Float:
        """Weighted gap [m] (Eq. 70), positive where open; shape (n_s,)."""
        across = np.einsum("ia,ia->i", self.between(*self._points), self.secondary.normals)
        gap: Float = across - self._closed_gaps
        return gap

    @cached_property
    def void(self) -> Void:
        """The void between the surfaces, where the coupling sees them."""
        now, flow = (self.secondary, self.primary), self._pair.flow
        before = now if self._pair.motion == "small" else self._seen
        # Free water stands where nothing faces a wall.
        opening = None if flow is None or flow.outside is not None else self._opening
        coupling = self.segments, self.operator, self.pressures.kept
        return Void(now, before, *coupling, opening, self.derivatives)

    def volumes(self) -> Float:
        """Part of each secondary node in the void between the surfaces [m^2]; shape (n_s,)."""
        volumes = self.void.volumes
        return volumes + self._linear(self._u) if self._pair.motion == "small" else volumes

    def growth(self) -> Float:
        """What the void has grown by since the start of the step [m^2]; shape (n_s,)."""
        return self._linear(self.moved) if self._pair.motion == "small" else self.void.growth

    def _linear(self, displacements: tuple[Float, Float]) -> Float:
        growth: Float = self.void.of_points @ np.concatenate(displacements).ravel()
        return growth

    @property
    def share(self) -> Float:
        """Part of a node's shape function that is not that of its dropped neighbours; (n_s,)."""
        share: Float = 1.0 / (1.0 + self.operator.C.sum(axis=1))
        return share

    def aperture(self) -> Float:
        """Distance of the surfaces at the nodes [m], where the gap counts dropped ones; (n_s,)."""
        return self.share * self.gap()

    def aperture_derivative(self) -> csr_array:
        """Derivative of the aperture with respect to the coordinates [-]; (n_s, 2 n_s + 2 n_m)."""
        normals, between = self.secondary.normals, self.between(*self._points)
        result = diags_array(self.share) @ self._along_axes(normals, between, self.points)
        d = self.derivatives
        if d is not None:
            ones, none = np.ones((len(normals), 1)), np.zeros((len(self._points[1]), 1))
            factor = self.share**2 * self.gap() * self.operator.kept
            result = result - diags_array(factor) @ d.relative(ones, none)
        return csr_array(result)

    def slip(self) -> Float:
        """Relative displacement since the start of the step [m]; shape (n_s, 2)."""
        return self.between(*self.moved)

    @cached_property
    def derivatives(self) -> GeometryDerivatives | None:
        """Derivatives of normals and coupling; None where they stay or are left out."""
        return self._differentiated(self.operator)

    @cached_property
    def pressure_derivatives(self) -> GeometryDerivatives | None:
        """Derivatives of the coupling of the pore pressures; None as in `derivatives`."""
        if self.pressures is self.operator:
            return self.derivatives
        return self._differentiated(self.pressures)

    def _along_axes(self, axes: Float, of_normals: Float, values: tuple[Float, Float]) -> csr_array:
        """Derivative of axes . `between` of values that move with the coordinates.

        Args:
            axes: An axis of each secondary node; shape (n_s, 2).
            of_normals: Derivative by the nodal normals; shape (n_s, 2).
            values: Of both surfaces [m]; shapes (n_s, 2), (n_m, 2).

        Returns:
            Matrix [-]; shape (n_s, 2 n_s + 2 n_m).
        """
        operator, n = self.operator, len(axes)
        coupling = hstack((eye_array(n) + operator.C, -operator.H), format="csr")
        coupling = (diags_array(operator.kept.astype(float)) @ coupling).tocoo()
        entries = coupling.data[:, None] * axes[coupling.row]
        rows = coupling.row.repeat(2)
        columns = (2 * coupling.col[:, None] + np.arange(2)).ravel()
        result = csr_array((entries.ravel(), (rows, columns)), (n, 2 * coupling.shape[1]))
        d = self.derivatives
        if d is None:
            return result
        at = np.arange(0, 2 * n + 1, 2)
        for vectors, matrix in ((of_normals, d.normals), (axes, d.relative(*values))):
            result = (
                result + csr_array((vectors.ravel(), np.arange(2 * n), at), (n, 2 * n)) @ matrix
            )
        return csr_array(result)

    def _differentiated(self, operator: MortarOperator) -> GeometryDerivatives | None:
        if self._pair.motion == "small" or not self._pair.linearised:
            return None
        return geometry_derivatives(self.secondary, self.primary, self.segments, operator)

    def _begin(self, displacements: tuple[Float, Float]) -> None:
        """Start a step at displacements [m] of the nodes of both surfaces."""
        self._start = displacements
        secondary, primary = self._rest
        self._seen = (
            secondary.at(secondary.points + displacements[0]),
            primary.at(primary.points + displacements[1]),
        )

    def _couple(self, secondary: Surface, primary: Surface) -> None:
        for known in ("derivatives", "pressure_derivatives", "void"):
            self.__dict__.pop(known, None)
        options = self._pair.mortar
        self.secondary, self.primary = secondary, primary
        self.segments = mortar_segments(secondary, primary, options, self._seen)
        self.operator = self._coupled(self._dropped)
        self.pressures = self._coupled(None) if self._dropped.any() else self.operator
        self._covered = self.pressures.kept
        length = np.bincount(primary.edges.ravel(), np.repeat(primary.lengths / 2.0, 2))
        late = np.where(self.faced, LATE, 1.0)
        covered = primary_coverage(primary, self.segments)
        self.faced = covered >= late * options.min_coverage * length

    def _coupled(self, dropped: npt.NDArray[np.bool_] | None) -> MortarOperator:
        """Couple the surfaces; nodes are dropped late, or those at the limit would come and go."""
        options = self._pair.mortar
        late = replace(options, min_coverage=LATE * options.min_coverage)
        arguments = self.secondary, self.primary, self.segments
        operator = mortar_operator(*arguments, dropped, late)
        out = ~self._covered & operator.kept & (operator.coverage < options.min_coverage)
        if not out.any():
            return operator
        return mortar_operator(*arguments, out if dropped is None else out | dropped, late)


def turned(normals: Float) -> Float:
    """Tangents (n_y, -n_x) of normals, along the chain; shape (n, 2)."""
    return np.column_stack((normals[:, 1], -normals[:, 0]))
