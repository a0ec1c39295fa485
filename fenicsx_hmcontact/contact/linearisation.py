# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derivatives of the mortar coupling with respect to the coordinates of both surfaces.

There are n_x = 2 n_s + 2 n_m coordinates: 2 i + axis for secondary node i, 2 n_s + 2 m + axis for
primary node m. Which edges face each other, what ends a segment and which nodes are kept does not
change with them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import block_array, csr_array, diags_array, eye_array, hstack

from .._kernels.mortar import GAUSS_POINTS
from .._kernels.mortar_derivatives import segment_integrals
from .mortar import MortarOperator, Segments, assemble, covered_parts, segment_corners
from .surface import Surface

Float = npt.NDArray[np.float64]
Index = npt.NDArray[np.integer]

NEGLIGIBLE = 1e-12
"""Round-off in derivatives of the length, centre and spread of the covered part of an edge."""


class MatrixDerivative(NamedTuple):
    """Derivative of a matrix in coordinate form; entries of the same place add up.

    Attributes:
        i: Row of the matrix; shape (k,).
        m: Column of the matrix; shape (k,).
        x: Coordinate; shape (k,).
        value: Derivative; shape (k,).
    """

    i: Index
    m: Index
    x: Index
    value: Float


@dataclass(frozen=True, eq=False)
class GeometryDerivatives:
    """Derivatives of normals and coupling with respect to the coordinates of both surfaces.

    Attributes:
        operator: The coupling.
        normals: Of the nodal normals, component a of node i in row 2 i + a [1/m]; shape
            (2 n_s, n_x).
        D: Of the covered lengths [-]; shape (n_s, n_x).
        M: Of M_im = D_i H_im for kept i [-].
        C: Of D_i C_ij for kept i [-].
    """

    operator: MortarOperator
    normals: csr_array
    D: csr_array
    M: MatrixDerivative
    C: MatrixDerivative

    def relative(self, d_secondary: Float, d_primary: Float) -> csr_array:
        """Differentiate a_i = d_i + sum_j C_ij d_j - sum_m H_im d_m at fixed vectors d.

        Args:
            d_secondary: Vectors of the secondary nodes; shape (n_s, 2).
            d_primary: Vectors of the primary nodes; shape (n_m, 2).

        Returns:
            Component a of node i in row 2 i + a, zero for dropped nodes [unit of d / m]; shape
            (2 n_s, n_x).
        """
        n, D, kept = len(self.operator.D), self.operator.D, self.operator.kept
        d = np.vstack([d_secondary, d_primary])
        i, node, x, value = self._weights
        direct = _vectors(i, x, value[:, None] * d[node], (2 * n, self.D.shape[1]))
        nodes = np.arange(n)
        mean = _vectors(nodes, nodes, self._coupling @ d, (2 * n, n)) @ self.D
        inverse = np.divide(1.0, D, out=np.zeros(n), where=kept)
        return diags_array(inverse.repeat(2)).tocsr() @ (direct - mean)

    def forces(self, traction: Float) -> csr_array:
        """Differentiate the forces that given contact forces F_i = D_i z_i put on other nodes.

        They are C^T F on dropped secondary nodes and -H^T F on primary nodes.

        Args:
            traction: Contact traction z of the secondary nodes [Pa]; shape (n_s, 2).

        Returns:
            Rows have the order of the coordinates [Pa]; shape (n_x, n_x).
        """
        n, n_x = self.D.shape
        i, node, x, value = self._weights
        direct = _vectors(node, x, value[:, None] * traction[i], (n_x, n_x))
        T = self._coupling.tocoo()
        mean = _vectors(T.col, T.row, T.data[:, None] * traction[T.row], (n_x, n)) @ self.D
        return direct - mean

    @property
    def _coupling(self) -> csr_array:
        """T = [C, -H] of a_i = d_i + (T d)_i for the nodes of both surfaces."""
        return hstack([self.operator.C, -self.operator.H], format="csr")

    @property
    def _weights(self) -> MatrixDerivative:
        """Derivative of D_i T_ij: that of T_ij is this minus T_ij dD_i, over D_i."""
        shifted = self.M._replace(m=self.M.m + len(self.operator.D), value=-self.M.value)
        return _joined([self.C, shifted])


def geometry_derivatives(
    secondary: Surface, primary: Surface, segments: Segments, operator: MortarOperator
) -> GeometryDerivatives:
    """Differentiate normals and coupling of two surfaces.

    The integrals over each segment are differentiated by a complex step (Squire and Trapp 1998),
    exact to round-off; the rest is the chain rule.

    Args:
        secondary: Surface that carries the multipliers.
        primary: Surface that faces it.
        segments: Their segments.
        operator: Their coupling.
    """
    n_s, n_m = len(secondary.nodes), len(primary.nodes)
    edge, primary_edge = (e[::3] for e in (segments.secondary_edge, segments.primary_edge))
    nodes, primary_nodes = secondary.edges[edge], primary.edges[primary_edge]
    parts, part = np.unique(edge, return_inverse=True)
    length, centre, variance = (v[parts] for v in covered_parts(segments, len(secondary.edges)))
    corners = segment_corners(secondary, primary, edge, primary_edge)
    xi = segments.xi.reshape(-1, 3)
    half = (xi[:, 2:] - xi[:, :1]) / np.ptp(GAUSS_POINTS)
    values, derivatives = segment_integrals(corners, xi[:, 1:2] + half * [-1.0, 1.0], centre[part])

    # Columns: secondary coordinates, normals, primary coordinates; the chain rule leaves x.
    at = np.hstack([nodes, n_s + nodes, 2 * n_s + primary_nodes])
    columns = (2 * at[:, :, None] + np.arange(2)).reshape(-1, 12)
    normals = _normals(secondary)
    chain = block_array(
        [[eye_array(2 * n_s), None], [normals, None], [None, eye_array(2 * n_m)]], format="csr"
    )
    # Of int N_m and int (xi - centre) N_m for m = 1, 2, and of int (xi - centre)^2
    w1, w2, s1, s2, square = (_rows(columns, d, chain.shape[0]) @ chain for d in derivatives)
    of_parts = _sums(part, len(parts))
    d0 = _pruned(of_parts @ (w1 + w2), np.ones_like(length))
    d1 = _pruned(of_parts @ (s1 + s2), np.sqrt(variance))
    d2 = _pruned(of_parts @ square - _scaled(variance, d0), variance)

    ends = secondary.edges[parts].T
    D, C = csr_array((n_s, chain.shape[1])), []
    for here, other, side in [(*ends, -1.0), (*ends[::-1], 1.0)]:
        shape = _scaled((1.0 + side * centre) / 2.0, d0) + side / 2.0 * d1
        D += _sums(here, n_s) @ shape
        beside = np.flatnonzero(operator.kept[other] & operator.dropped[here])
        C.append(_entries(shape[beside], other[beside], here[beside]))

    # The dual functions are N(centre) +- slope (xi - centre), or 1 beside a dropped node.
    slope = (1.0 - centre**2) / (2.0 * variance)
    d_centre = _scaled(1.0 / length, d1)
    d_slope = _scaled(-centre / variance, d_centre) - _scaled(slope / variance / length, d2)
    kept = operator.kept[nodes]
    segment, end = np.nonzero(kept)
    both, of_part = kept.all(axis=1)[segment], part[segment]
    sign = np.where(both, 2.0 * end - 1.0, 0.0)
    mean = np.where(both, (1.0 + sign * centre[of_part]) / 2.0, 1.0)
    M = []
    for m, d_weight, d_moment in [(0, w1, s1), (1, w2, s2)]:
        weight, moment = values[m, segment], values[m + 2, segment]
        terms = [
            (mean, segment, d_weight),
            (sign * slope[of_part], segment, d_moment),
            (sign * (0.5 - slope[of_part]) * weight, of_part, d_centre),
            (sign * moment, of_part, d_slope),
        ]
        d_M = sum(_scaled(factor, d[rows]) for factor, rows, d in terms)
        M.append(_entries(d_M, nodes[segment, end], primary_nodes[segment, m]))
    normals = normals @ eye_array(2 * n_s, chain.shape[1], format="csr")
    return GeometryDerivatives(operator, normals, D, _joined(M), _joined(C))


def _normals(surface: Surface) -> csr_array:
    """Derivatives of the nodal normals with respect to the points [1/m]; shape (2 n, 2 n)."""
    tangents, edges = surface.tangents, surface.edges
    inward = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    n, tau = (surface.rotations[edges, row] for row in range(2))  # (m, 2, 2): end, component
    size = np.bincount(edges.ravel(), np.einsum("mea,ma->me", n, inward).ravel())
    turn = np.einsum("mea,ma->me", tau, tangents) / (size[edges] * surface.lengths[:, None])
    blocks = np.einsum("me,mea,k,mb->meakb", turn, tau, [1.0, -1.0], inward)
    at = 2 * edges[:, :, None] + np.arange(2)
    return assemble(blocks, at[:, :, :, None, None], at[:, None, None], (surface.points.size,) * 2)


def _scaled(factors: Float, rows: csr_array) -> csr_array:
    return diags_array(factors, format="csr") @ rows


def _pruned(rows: csr_array, scale: Float) -> csr_array:
    """Remove what is zero but for round-off: an end that two segments share adds nothing."""
    small = np.abs(rows.data) < NEGLIGIBLE * scale.repeat(np.diff(rows.indptr))
    rows.data[small] = 0.0
    rows.eliminate_zeros()
    return rows


def _sums(of: Index, n: int) -> csr_array:
    """Matrix that adds row k to row of[k] of n rows."""
    return csr_array((np.ones(len(of)), (of, np.arange(len(of)))), (n, len(of)))


def _rows(columns: Index, values: Float, width: int) -> csr_array:
    """Matrix with the same number of entries in every row."""
    starts = np.arange(0, columns.size + 1, columns.shape[1])
    return csr_array((values.ravel(), columns.ravel(), starts), (len(columns), width))


def _vectors(rows: Index, columns: Index, values: Float, shape: tuple[int, int]) -> csr_array:
    """Matrix of vectors (k, 2), component a of row i in row 2 i + a."""
    at = 2 * rows[:, None] + np.arange(2)
    return assemble(values, at, columns[:, None], shape)


def _entries(rows: csr_array, i: Index, m: Index) -> MatrixDerivative:
    at = rows.tocoo()
    return MatrixDerivative(i[at.row], m[at.row], at.col, at.data)


def _joined(parts: Iterable[MatrixDerivative]) -> MatrixDerivative:
    return MatrixDerivative(*map(np.concatenate, zip(*parts, strict=True)))
