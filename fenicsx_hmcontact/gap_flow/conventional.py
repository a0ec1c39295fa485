# SPDX-License-Identifier: LGPL-3.0-or-later
"""The conventional interface element (Eqs. 98 to 100), for comparison with the film only."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.sparse import block_array, coo_array, csr_array, diags_array, eye_array, hstack

from ..contact import Surface, surface_dofs
from .law import GapFlow

if TYPE_CHECKING:
    from ..solvers import FieldLayout

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

SHIFT = 0.1
"""Opposite nodes shifted along the gap by more than this part of a facet do not match."""

GAUSS_POINTS, GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(3)


class ConventionalInterface:
    """Elements without thickness between two surfaces whose nodes lie opposite each other.

    Unknowns are the pore pressures of both faces, not their mean and difference. So across a
    closing gap the matrix becomes singular, its condition number grows like 1/g (Section 4.3).

    Args:
        secondary: One face, of an open chain of facets.
        primary: The other, with as many nodes.
        flow: Law of the water between them.
        layout: Numbering of the unknowns: one displacement and one pore pressure.
        moved: Displacements of the nodes of both since they lay opposite each other [m], shapes
            (n, 2): elements stay on the nodes they were built on. None where they do so now.

    Raises:
        ValueError: If the surfaces did not match then.

    Note:
        Collective. Its data are the same on all ranks.
    """

    def __init__(
        self,
        secondary: Surface,
        primary: Surface,
        flow: GapFlow,
        layout: FieldLayout,
        moved: tuple[Float, Float] | None = None,
    ) -> None:
        pair = f"surfaces '{secondary.name}' and '{primary.name}'"
        chains = secondary.chains + primary.chains
        if len(chains) != 2 or len(chains[0]) != len(chains[1]):
            raise ValueError(f"{pair} are not two chains of as many nodes")
        opposite = np.empty_like(chains[0])
        # Both have their body on the left and so run against each other.
        opposite[chains[0]] = chains[1][::-1]
        apart = secondary.points - primary.points[opposite]
        first, between = secondary, apart
        if moved is not None:
            first = secondary.at(secondary.points - moved[0])
            between = apart - (moved[0] - moved[1][opposite])
        along = np.abs(np.sum(between[first.edges[:, 0]] * first.tangents, axis=1))
        if len(secondary.edges) != len(primary.edges) or np.any(along > SHIFT * first.lengths):
            raise ValueError(f"the nodes of {pair} do not lie opposite each other")
        self.flow = flow
        self._middle = secondary.at(secondary.points - apart / 2)
        fields = {size: field for field, size in enumerate(layout.block_sizes)}
        for surface in (secondary, primary):
            if any(np.any(surface_dofs(surface, space) < 0) for space in layout.spaces):
                raise ValueError(f"surface '{surface.name}' lacks a displacement or pore pressure")
        self._displacements, self._pressures = (
            np.concatenate(
                [
                    layout.global_of_blocks(fields[size], surface_dofs(surface, space)[nodes])
                    for surface, nodes in ((secondary, slice(None)), (primary, opposite))
                ]
            )
            for size, space in ((size, layout.spaces[fields[size]]) for size in (2, 1))
        )

    def conductance(self, aperture: float | Float) -> csr_array:
        """Flow out of both faces per unit of their pore pressures (Eqs. 98 to 100 and 81).

        Across the gap by the difference of p+ and p-, along it by their mean, half from each face.

        Args:
            aperture: Aperture [m], of all or of each node; shape (n,).

        Returns:
            Matrix [m^3/(Pa s) per metre thickness] over p+ and then p-; shape (2n, 2n).

        Raises:
            ValueError: If an aperture is not positive.
        """
        n = len(self._middle.nodes)
        nodal = np.broadcast_to(np.asarray(aperture, float), n)
        if not nodal.min() > 0.0:
            raise ValueError(
                f"aperture is {nodal.min()}; a conventional element needs a positive one, such as "
                "1e-16 m where the gap is closed"
            )
        g = nodal[self._middle.edges] @ self._shapes.T
        slopes = np.array([-1.0, 1.0]) / self._middle.lengths[:, None, None]
        across = self._integral(self._shapes, self.flow.transverse_conductivity(g))
        along = self._integral(slopes, self.flow.longitudinal_conductance(g))
        drop = hstack((eye_array(n), -eye_array(n)))
        return csr_array(drop.T @ across @ drop + self._mean.T @ along @ self._mean)

    @cached_property
    def storage(self) -> csr_array:
        """Water taken up from both faces per unit of their displacements, half from each [m].

        Its transpose is the force of the mean pressure on the faces; shape (2n, 4n).
        """
        n = len(self._middle.nodes)
        normal = [diags_array(component) for component in self._middle.normals.T]
        opening = hstack(normal)[:, np.arange(2 * n).reshape(2, n).T.ravel()]
        mass = self._integral(self._shapes, np.ones((len(self._middle.edges), 1)))
        return csr_array(self._mean.T @ mass @ hstack((opening, -opening)))

    def system(
        self,
        bulk: csr_array,
        prescribed: Bool,
        aperture: float | Float,
        time_step: float,
        closed: bool | Bool = False,
    ) -> tuple[csr_array, csr_array]:
        """Matrix of the bodies with the interface elements between them.

        Args:
            bulk: Tangent of the bodies (volumes of water per step); shape (N, N).
            prescribed: Which unknowns are prescribed; shape (N,).
            aperture: Aperture [m], of all or of each node; shape (n,).
            time_step: Length of the step [s].
            closed: Nodes where the faces stick to each other, all or each; shape (n,). The
                displacements of one face then stand for both.

        Returns:
            Matrix over the unknowns that are neither prescribed nor tied, without normalisation;
            and T (N, k), how all unknowns depend on those: it is T^T (bulk + added) T.

        Raises:
            ValueError: If an aperture is not positive.
        """
        u, p = self._displacements.ravel(), self._pressures.ravel()
        taken = block_array(
            [[None, -self.storage.T], [self.storage, time_step * self.conductance(aperture)]]
        ).tocoo()
        at = np.concatenate((u, p))
        added = csr_array((taken.data, (at[taken.row], at[taken.col])), bulk.shape)

        own = np.arange(bulk.shape[0])
        stands_for = own.copy()
        plus, minus = np.split(self._displacements, 2)
        tied = np.broadcast_to(closed, len(plus))
        stands_for[plus[tied]] = minus[tied]
        held = prescribed.copy()
        held[stands_for[prescribed]] = True
        free = np.flatnonzero((stands_for == own) & ~held)
        T = csr_array((np.ones(own.size), (own, stands_for)), bulk.shape)[:, free]
        return csr_array(T.T @ (bulk + added) @ T), T

    @property
    def _shapes(self) -> Float:
        """Shape functions of a facet's nodes at its Gauss points; shape (points, 2)."""
        return np.column_stack((1.0 - GAUSS_POINTS, 1.0 + GAUSS_POINTS)) / 2.0

    @property
    def _mean(self) -> csr_array:
        half = 0.5 * eye_array(len(self._middle.nodes))
        return csr_array(hstack((half, half)))

    def _integral(self, functions: Float, factor: Float) -> csr_array:
        """Integrate products of functions, given at the Gauss points of facets; shape (n, n)."""
        edges, n = self._middle.edges, len(self._middle.nodes)
        weights = self._middle.lengths[:, None] / 2.0 * GAUSS_WEIGHTS * factor
        values = np.broadcast_to(functions, (*weights.shape, 2))
        local = np.einsum("eg,egi,egj->eij", weights, values, values)
        rows, columns = np.repeat(edges, 2, axis=1), np.tile(edges, 2)
        return coo_array((local.ravel(), (rows.ravel(), columns.ravel())), (n, n)).tocsr()
