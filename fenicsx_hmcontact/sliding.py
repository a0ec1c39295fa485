# SPDX-License-Identifier: LGPL-3.0-or-later
"""A pair of surfaces that touch, stick, slide and part, over any distance (Section 4.1)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.sparse
from dolfinx import fem

from .contact import (
    ContactPair,
    ContactStatus,
    Dependence,
    InterfaceState,
    MortarOperator,
    gather_surface,
    geometry_derivatives,
    mortar_operator,
    mortar_segments,
    surface_dofs,
    tangential_law,
)
from .solvers import FieldLayout

Float = npt.NDArray[np.float64]

SOFTER = 0.1
"""Complementarity constants relative to the stiffness of a single node: surfaces give together."""

TOUCHING = 1e-9
"""A gap below this part of a facet is closed at the start."""


class SlidingCoupling:
    """A contact pair whose surfaces move. Its data are the same on all ranks.

    Args:
        pair: The pair.
        unknowns: Fields of the problem; one of them is the displacement.
        layout: Their numbering.
        constrained: Which local unknowns are prescribed.

    Attributes:
        pair: The pair.
        status: Closed and slipping nodes.
        settled: Whether the last update left the sets as they were.

    Raises:
        ValueError: If the pair fits neither the fields nor the conditions; it names the pair.

    Note:
        Collective.
    """

    aperture = 0.0

    def __init__(
        self,
        pair: ContactPair,
        unknowns: Sequence[fem.Function],
        layout: FieldLayout,
        constrained: npt.NDArray[np.bool_],
    ) -> None:
        self.pair = pair
        self._law = tangential_law(pair.friction)
        self._layout = layout
        fields = [f for f, size in enumerate(layout.block_sizes) if size == 2]
        if len(fields) != 1:
            raise ValueError(f"pair {pair.name}: contact needs one displacement, not {len(fields)}")
        u = unknowns[fields[0]]
        mesh, space = u.function_space.mesh, u.function_space
        if space.element.basix_element.degree != 1:
            raise ValueError(f"pair {pair.name}: contact needs P1 fields, {u.name} is none")
        if pair.flow is not None:
            raise ValueError(
                f"pair {pair.name}: water between surfaces that slide is not there yet"
            )
        self._rest = [
            gather_surface(mesh, pair.facet_tags, tag, str(tag))
            for tag in (pair.secondary, pair.primary)
        ]
        self._dofs = [
            layout.global_of_blocks(fields[0], surface_dofs(surface, space)).ravel()
            for surface in self._rest
        ]
        marks = layout.gather(self._dofs[0], constrained.astype(float)).reshape(-1, 2) > 0.0
        self._dropped = marks.any(axis=1)
        if self._dropped.all():
            raise ValueError(
                f"pair {pair.name}: the secondary surface is prescribed at all its nodes; swap "
                "secondary and primary"
            )
        self.status = ContactStatus.open(len(self._dropped))
        self.settled = True
        self._committed = self.status
        current = np.concatenate([v.x.array for v in unknowns])
        self._start = self._displacements(current)
        self._place(current)
        size = self._rest[0].lengths.max()
        closed = self._operator.kept & (self._gap() <= TOUCHING * size)
        self.status.closed = closed
        self._dependence: Dependence | None = None

    def numbers(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Global numbers of the unknowns on the secondary and on the primary surface."""
        return self._dofs[0], self._dofs[1]

    def dependences(self) -> list[Dependence]:
        """How the secondary unknowns depend on others, and the conditions of contact."""
        return [] if self._dependence is None else [self._dependence]

    def commit(self, current: Float) -> None:
        """Take the state as the start of the next step. Collective."""
        self._start = self._displacements(current)
        self._committed = self.status

    def reset(self) -> None:
        """Go back to the sets of the start of the step."""
        self.status = self._committed

    def update(self, current: Float, residual: Float, diagonal: Float, new_sets: bool) -> None:
        """Follow the surfaces, decide on the sets, and write the conditions down. Collective.

        Args:
            current: Local array of the unknowns.
            residual: Local array of the residual, as assembled and not condensed.
            diagonal: Local array of the diagonal of the tangent.
            new_sets: Whether the sets may change.
        """
        self._place(current)
        operator, normals = self._operator, self._secondary.normals
        kept, D = operator.kept, operator.D
        self._force = self._layout.gather(self._dofs[0], residual).reshape(-1, 2)
        self._force[~kept] = 0.0
        traction = np.zeros_like(self._force)
        np.divide(self._force, D[:, None], out=traction, where=kept[:, None])
        stiffness = self._layout.gather(self._dofs[0], diagonal).reshape(-1, 2).mean(axis=1)
        per_area = np.divide(stiffness, D, out=np.ones(len(D)), where=kept)
        tangents = _turned(normals)
        pressure, shear = _dot(traction, normals), _dot(traction, tangents)
        gap, slip = self._gap(), _dot(self._slip(), tangents)
        before = self.status
        if new_sets:
            constant = SOFTER * per_area
            self.status = before.updated(
                kept, pressure, shear, gap, slip, (constant, constant), self._law
            )
        elif self._law is None:
            self.status = ContactStatus(
                before.closed & kept, before.slipping & False, before.direction
            )
        self.settled = self.status.same(before)
        self._dependence = self._conditions(pressure, gap, slip, stiffness, traction)

    def state(self, current: Float, residual: Float) -> InterfaceState:
        """Tractions at the secondary nodes; there is no water. Collective.

        Args:
            current: Local array of the unknowns.
            residual: Local array of the residual with what surfaces pass on to each other.
        """
        self._place(current)
        kept, normals = self._operator.kept, self._secondary.normals
        force = self._layout.gather(self._dofs[0], residual).reshape(-1, 2)
        traction = np.full_like(force, np.nan)
        np.divide(force, self._operator.D[:, None], out=traction, where=kept[:, None])
        zero = np.zeros(len(kept))
        return InterfaceState(
            self._secondary.points,
            normals,
            _dot(traction, normals),
            _dot(traction, _turned(normals)),
            zero,
            zero,
        )

    # --- geometry ----------------------------------------------------------------------------

    def _displacements(self, current: Float) -> list[Float]:
        return [self._layout.gather(dofs, current).reshape(-1, 2) for dofs in self._dofs]

    def _place(self, current: Float) -> None:
        """Put the surfaces where the displacements are, and couple them there."""
        self._u = self._displacements(current)
        self._points = [surface.points + u for surface, u in zip(self._rest, self._u, strict=True)]
        if self.pair.motion == "small" and hasattr(self, "_operator"):
            return
        follow = self.pair.motion == "finite"
        self._secondary, self._primary = (
            surface.at(points) if follow else surface
            for surface, points in zip(self._rest, self._points, strict=True)
        )
        self._segments = mortar_segments(self._secondary, self._primary, self.pair.mortar)
        self._operator: MortarOperator = mortar_operator(
            self._secondary, self._primary, self._segments, self._dropped, self.pair.mortar
        )

    def _between(self, secondary: Float, primary: Float) -> Float:
        """Nodal values of the secondary less those of the primary surface; shape (n_s, 2)."""
        operator = self._operator
        values = secondary + operator.C @ secondary - operator.H @ primary
        return np.where(operator.kept[:, None], values, 0.0)

    def _gap(self) -> Float:
        """Weighted gap [m] (Eq. 70), positive where open; shape (n_s,)."""
        return _dot(self._between(*self._points), self._secondary.normals)

    def _slip(self) -> Float:
        """Relative displacement since the start of the step [m]; shape (n_s, 2)."""
        return self._between(*(u - start for u, start in zip(self._u, self._start, strict=True)))

    # --- conditions --------------------------------------------------------------------------

    def _conditions(
        self, pressure: Float, gap: Float, slip: Float, stiffness: Float, traction: Float
    ) -> Dependence:
        """Rows of Eq. 69, corrected, in the relative displacements of the kept nodes."""
        operator, status = self._operator, self.status
        normals = self._secondary.normals
        tangents = _turned(normals)
        bound, slope = np.zeros_like(gap), np.zeros_like(gap)
        if self._law is not None:
            bound, slope = self._law.bound(np.maximum(pressure, 0.0))
        slipping, sticking = status.slipping, status.sticking & (self._law is not None)
        sign = np.where(slipping, status.direction, 0.0)
        tests = tangents + (sign * slope)[:, None] * normals
        # What the bound has beyond its slope at this pressure: cohesion.
        rest = sign * (bound - slope * np.maximum(pressure, 0.0))

        kept = np.flatnonzero(operator.kept)
        rows = (2 * kept[:, None] + np.arange(2)).ravel()
        coupling = scipy.sparse.hstack((-operator.C, operator.H)).tocsr()
        coefficients = scipy.sparse.kron(coupling, scipy.sparse.eye_array(2), format="csr")[rows]
        constraint = np.where(np.column_stack((status.closed, sticking)), stiffness[:, None], 0.0)
        values = np.column_stack(
            (np.where(status.closed, gap, 0.0), np.where(sticking, slip, rest * operator.D))
        )
        return Dependence(
            np.concatenate(self._dofs),
            rows,
            coefficients,
            np.zeros(rows.size, bool),
            _frames(normals[kept], tangents[kept]),
            _frames(normals[kept], tests[kept]),
            constraint[kept].ravel(),
            values[kept].ravel(),
            self._geometry(constraint, sign * slope, rest, traction),
        )

    def _geometry(
        self, constraint: Float, friction: Float, rest: Float, traction: Float
    ) -> scipy.sparse.csr_array | None:
        """Derivative of all rows through normals, tangents and the mortar coupling."""
        if not self.pair.linearised or self.pair.motion == "small":
            return None
        operator = self._operator
        d = geometry_derivatives(self._secondary, self._primary, self._segments, operator)
        normals = self._secondary.normals
        tangents = _turned(normals)
        n, n_x = len(normals), d.D.shape[1]
        between = self._between(*self._points)
        of_gap = d.relative(*self._points)
        moved = [u - start for u, start in zip(self._u, self._start, strict=True)]
        of_slip = d.relative(*moved)

        def along(vectors: Float, derivative: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
            """Rows sum_a vectors_ia derivative_(2i+a)."""
            return _rows(vectors) @ derivative

        closed, stick = (constraint > 0.0).T
        k_n, k_t = constraint.T
        force = np.where(operator.kept[:, None], self._force, 0.0)
        normal_rows = along(k_n[:, None] * between, d.normals)
        normal_rows = normal_rows + along(k_n[:, None] * normals, of_gap)
        normal_rows = normal_rows + along(np.where(closed[:, None], 0.0, force), d.normals)
        # d tau . f = d n . f turned back
        tangent_rows = along(k_t[:, None] * _turned_back(self._slip()), d.normals)
        tangent_rows = tangent_rows + along(k_t[:, None] * tangents, of_slip)
        slide = np.where(stick[:, None], 0.0, _turned_back(force) + friction[:, None] * force)
        tangent_rows = tangent_rows + along(slide, d.normals)
        tangent_rows = tangent_rows + scipy.sparse.diags_array(rest) @ d.D

        kept = np.flatnonzero(operator.kept)
        others = np.setdiff1d(np.arange(n_x), (2 * kept[:, None] + np.arange(2)).ravel())
        select = scipy.sparse.csr_array((np.ones(others.size), (others, others)), shape=(n_x, n_x))
        result = -(select @ d.forces(traction))
        for axis, rows in enumerate((normal_rows, tangent_rows)):
            place = scipy.sparse.csr_array(
                (np.ones(kept.size), (2 * kept + axis, kept)), shape=(n_x, n)
            )
            result = result + place @ rows
        return scipy.sparse.csr_array(result)


def _dot(a: Float, b: Float) -> Float:
    return np.sum(a * b, axis=1)


def _turned(normals: Float) -> Float:
    """Tangents (n_y, -n_x) of normals; shape (n, 2)."""
    return np.column_stack((normals[:, 1], -normals[:, 0]))


def _turned_back(vectors: Float) -> Float:
    """Vectors f' with tau . f = n . f'; shape (n, 2)."""
    return np.column_stack((-vectors[:, 1], vectors[:, 0]))


def _rows(vectors: Float) -> scipy.sparse.csr_array:
    """Matrix (n, 2n) whose row i multiplies rows 2i and 2i + 1 by the vector's components."""
    n = len(vectors)
    return scipy.sparse.csr_array(
        (vectors.ravel(), np.arange(2 * n), np.arange(0, 2 * n + 1, 2)), shape=(n, 2 * n)
    )


def _frames(normals: Float, tangents: Float) -> scipy.sparse.csr_array:
    """Block diagonal matrix with columns normal and tangent; shape (2k, 2k)."""
    k = len(normals)
    blocks = np.stack((normals, tangents), axis=2)
    return scipy.sparse.csr_array(
        scipy.sparse.bsr_array((blocks, np.arange(k), np.arange(k + 1)), shape=(2 * k, 2 * k))
    )
