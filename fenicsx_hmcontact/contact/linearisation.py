# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derivatives of the mortar coupling with respect to the coordinates of both surfaces.

There are n_x = 2 n_s + 2 n_m coordinates: 2 i + axis for secondary node i, 2 n_s + 2 m + axis for
primary node m. Which edges face each other, what ends a segment and which nodes are kept does not
change with them.

The coupling is made of integrals over segments and over covered parts of edges. Derivatives of
anything that it gives are a matrix of coefficients times the derivatives of these integrals.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array, vstack

from .._kernels.mortar import SHORTEST_SEGMENT
from .._kernels.mortar_derivatives import end_derivatives, segment_integrals
from .mortar import MortarOperator, Segments, covered_parts, segment_corners
from .surface import Surface

Float = npt.NDArray[np.float64]
Index = npt.NDArray[np.integer]
Entries = tuple[Float, Index, Index]
"""Values, rows and columns of a matrix, of shapes that broadcast; entries of one place add up."""

SIDE = np.array([-1.0, 1.0])
"""Local coordinates of the nodes of an edge."""


@dataclass(frozen=True, eq=False)
class Integrals:
    """What the coupling consists of: integrals over l segments and p covered parts of edges.

    N are the shape functions of the primary edge, xi is the local coordinate of the secondary edge,
    c the centre of its covered part.

    Attributes:
        nodes: Nodes of the secondary edge of every part; shape (p, 2).
        edge_length: Length of that edge [m]; shape (p,).
        length: Length of the part [m]; shape (p,).
        centre: Its centre c; shape (p,).
        variance: Variance of xi over it; shape (p,).
        starts: First segment of every part; shape (p,).
        part: Part of every segment; shape (l,).
        primary_nodes: Nodes of its primary edge; shape (l, 2).
        values: int (xi - c)^t N_m over it for t = 0, 1 [m]; shape (l, 2, 2), the order t, m.
        derivatives: Of the values in rows 4 s + 2 t + m, then in rows 4 l + 4 k + q of int 1,
            int (xi - c) and int (xi - c)^2 over part k at fixed c and of the length of its edge,
            then of D [-]; shape (4 l + 4 p + n_s, n_x).
    """

    nodes: Index
    edge_length: Float
    length: Float
    centre: Float
    variance: Float
    starts: Index
    part: Index
    primary_nodes: Index
    values: Float
    derivatives: csr_array

    @property
    def shapes(self) -> Float:
        """Shape functions of the secondary edges at the centres; shape (p, 2)."""
        return (1.0 + SIDE * self.centre[:, None]) / 2.0

    @cached_property
    def segment_rows(self) -> Index:
        """Rows of the derivatives of the segments; shape (l, 2, 2)."""
        return np.arange(self.values.size).reshape(self.values.shape)

    @cached_property
    def part_rows(self) -> Index:
        """Rows of the derivatives of the parts; shape (p, 4)."""
        return self.values.size + np.arange(4 * len(self.nodes)).reshape(-1, 4)

    @cached_property
    def D_rows(self) -> Index:
        """Rows of the derivatives of D; shape (n_s,)."""
        return np.arange(self.values.size + self.part_rows.size, self.derivatives.shape[0])

    def combined(self, rows: int, *coefficients: Entries) -> csr_array:
        """Multiply coefficients (rows, 4 l + 4 p + n_s) with the derivatives; shape (rows, n_x)."""
        return _matrix((rows, self.derivatives.shape[0]), *coefficients) @ self.derivatives


@dataclass(frozen=True, eq=False)
class GeometryDerivatives:
    """Derivatives of normals and coupling with respect to the coordinates of both surfaces.

    Attributes:
        operator: The coupling.
        normals: Of the nodal normals, component a of node i in row 2 i + a [1/m]; shape
            (2 n_s, n_x).
        D: Of the covered lengths [-]; shape (n_s, n_x).
        integrals: What they are made of.
    """

    operator: MortarOperator
    normals: csr_array
    D: csr_array
    integrals: Integrals

    def relative(self, d_secondary: Float, d_primary: Float) -> csr_array:
        """Differentiate a_i = d_i + sum_j C_ij d_j - sum_m H_im d_m at fixed values d.

        Args:
            d_secondary: Values of the secondary nodes, k each; shape (n_s, k).
            d_primary: Values of the primary nodes; shape (n_m, k).

        Returns:
            Component a of node i in row k i + a, zero for dropped nodes [unit of d / m]; shape
            (k n_s, n_x).
        """
        q, D, kept = self.integrals, self.operator.D, self.operator.kept
        n, k = d_secondary.shape
        inverse = np.divide(1.0, D, out=np.zeros(n), where=kept)
        d = d_primary[q.primary_nodes]
        of_parts = _over_parts(np.einsum("stm,smk->stk", q.values, d), q.starts)
        coefficients = -np.einsum("pe,ptk,ptq->pekq", self._sign, of_parts, self.turn)
        beside = d_secondary[q.nodes[:, ::-1]]
        coefficients += np.einsum("peq,pek->pekq", self._beside, beside)
        coefficients *= inverse[q.nodes][:, :, None, None]
        rows = _blocks(q.nodes, k)

        dual = self._dual[q.part] * inverse[q.nodes[q.part]][:, :, None]
        direct = -np.einsum("set,smk->sektm", dual, d)
        mean = -inverse[:, None] * (self.operator.C @ d_secondary - self.operator.H @ d_primary)
        return q.combined(
            k * n,
            (direct, rows[q.part][..., None, None], q.segment_rows[:, None, None]),
            (coefficients, rows[..., None], q.part_rows[:, None, None, :3]),
            (mean, _blocks(np.arange(n), k), q.D_rows[:, None]),
        )

    def forces(self, traction: Float) -> csr_array:
        """Differentiate the forces that given contact forces F_i = D_i z_i put on other nodes.

        They are C^T F on dropped secondary nodes and -H^T F on primary nodes.

        Args:
            traction: Contact traction z of the secondary nodes [Pa], k components; shape (n_s, k).

        Returns:
            Component a of node i in row k i + a, primary nodes after the n_s secondary ones [Pa];
            shape (k (n_s + n_m), n_x).
        """
        q, (n, k) = self.integrals, traction.shape
        z = traction[q.nodes]
        primary = _blocks(n + q.primary_nodes, k)
        direct = -np.einsum("pet,pek->pkt", self._dual, z)[q.part]
        jump = np.einsum("pe,pek->pk", self._sign, z)
        turning = np.einsum("stm,stq->smq", q.values, self.turn[q.part])
        turning = -turning[:, :, None] * jump[q.part][:, None, :, None]
        beside = np.einsum("peq,pek->pekq", self._beside, z)
        C, H = self.operator.C.tocoo(), self.operator.H.tocoo()
        mean = [
            (
                sign * T.data[:, None] * traction[T.row],
                _blocks(first + T.col, k),
                q.D_rows[T.row, None],
            )
            for sign, first, T in [(-1.0, 0, C), (1.0, n, H)]
        ]
        return q.combined(
            k * (n + self.operator.H.shape[1]),
            (
                direct[:, None],
                primary[..., None],
                q.segment_rows.transpose(0, 2, 1)[:, :, None],
            ),
            (turning, primary[..., None], q.part_rows[q.part, None, None, :3]),
            (beside, _blocks(q.nodes[:, ::-1], k)[..., None], q.part_rows[:, None, None, :3]),
            *mean,
        )

    def integral(self, at_ends: Float, of_length: Float) -> csr_array:
        """Differentiate integrals over the covered parts of functions of the place on the edge.

        Args:
            at_ends: The functions of a part's two nodes at its two ends; shape (p, 2, 2).
            of_length: Derivative of the integrals over a part by the length of its edge, at given
                ends; shape (p, 2).

        Returns:
            Derivative of the sums at the secondary nodes [unit of the functions]; (n_s, n_x).
        """
        q = self.integrals
        half = (q.length / q.edge_length)[:, None]
        low, high = at_ends[..., 0], at_ends[..., 1]
        mean, slope = (high + low) / 2.0, (high - low) / 2.0
        # The ends move as int 1 and int (xi - c) over the part say.
        factors = np.stack([mean, slope / half, of_length - half * mean], axis=-1)
        entries = factors, q.nodes[..., None], q.part_rows[:, None, [0, 1, 3]]
        return q.combined(len(self.operator.D), entries)

    @cached_property
    def _kept(self) -> npt.NDArray[np.bool_]:
        """Which nodes of the parts are kept; shape (p, 2)."""
        return self.operator.kept[self.integrals.nodes]

    @cached_property
    def _sign(self) -> Float:
        """Where both nodes of a part are kept, -1 and 1, else 0; shape (p, 2)."""
        return np.where(self._kept.all(axis=1)[:, None], SIDE, 0.0)

    @cached_property
    def _slope(self) -> Float:
        """Slope of the dual functions; shape (p,)."""
        return (1.0 - self.integrals.centre**2) / (2.0 * self.integrals.variance)

    @cached_property
    def _dual(self) -> Float:
        """Dual functions a + b (xi - c), 1 beside a dropped node, as (a, b); shape (p, 2, 2)."""
        values = np.where(self._sign != 0.0, self.integrals.shapes, self._kept)
        return np.stack([values, self._sign * self._slope[:, None]], axis=-1)

    @cached_property
    def turn(self) -> Float:
        """How integrals over a part change int phi_i N_m through the dual functions.

        Factor of int (xi - c)^t N_m and of the derivative of int (xi - c)^q, but for the sign of
        the node; shape (p, 2, 3), the order t, q.
        """
        q, slope, zero = self.integrals, self._slope, np.zeros_like(self._slope)
        c, v, length = q.centre, q.variance, q.length
        centre = np.stack([zero, 1.0 / length, zero], axis=1)
        of_slope = np.stack([slope, -c / v, -slope / v], axis=1) / length[:, None]
        return np.stack([(0.5 - slope)[:, None] * centre, of_slope], axis=1)

    @cached_property
    def _beside(self) -> Float:
        """Factors of the derivatives of int (xi - c)^q in that of D_i C_ij; shape (p, 2, 3).

        For both nodes i of a part, j the other one; zero but for kept i and dropped j.
        """
        where = self._kept & ~self._kept[:, ::-1]
        return where[..., None] * _nodal(self.integrals.shapes)[:, ::-1]


def geometry_derivatives(
    secondary: Surface, primary: Surface, segments: Segments, operator: MortarOperator
) -> GeometryDerivatives:
    """Differentiate normals and coupling of two surfaces, exactly but for round-off.

    Args:
        secondary: Surface that carries the multipliers.
        primary: Surface that faces it.
        segments: Their segments.
        operator: Their coupling.
    """
    n_s, n_x = len(secondary.nodes), 2 * (len(secondary.nodes) + len(primary.nodes))
    edge, primary_edge = (e[::3] for e in (segments.secondary_edge, segments.primary_edge))
    parts, starts, part = np.unique(edge, return_index=True, return_inverse=True)
    length, centre, variance = (v[parts] for v in covered_parts(segments, len(secondary.edges)))
    corners = segment_corners(secondary, primary, edge, primary_edge)
    moving = segments.end_nodes >= 0
    end_nodes = np.where(moving, segments.end_nodes, primary.edges[primary_edge])
    points = primary.points[end_nodes]
    d_ends = end_derivatives(corners, segments.ends, moving, points)
    values, derivatives = segment_integrals(corners, segments.ends, d_ends, centre[part])

    around, turning = normals_around(secondary)
    nodes = secondary.edges[edge]
    chain = around[nodes[:, 0], 0], nodes[:, 0], nodes[:, 1], around[nodes[:, 1], 2]
    near, ends = np.column_stack(chain), n_s + end_nodes
    turn = turning[nodes]
    at = np.column_stack([near, n_s + primary.edges[primary_edge], ends])
    derivatives[..., :8] = chained(derivatives[..., :8], turn)
    d_ends[..., :8] = chained(d_ends[..., :8], turn)
    of_segments = _rows(_blocks(at, 2).reshape(-1, 1, 16), derivatives, n_x)

    # The integrals over a part change with the length of its edge and with its ends.
    edge_length, tangents = secondary.lengths[parts], secondary.tangents[parts]
    p = 4 * np.arange(len(parts))[:, None] + np.arange(4)
    part_nodes = secondary.edges[parts]
    stretch = np.column_stack([length, 0.0 * length, variance * length, edge_length])
    stretch /= edge_length[:, None]
    by_length = stretch[:, :, None, None] * SIDE[:, None] * tangents[:, None, None]
    s, end = np.nonzero(_outer(edge, segments) & moving)
    offset = (segments.ends[s, end] - centre[part[s]])[:, None] ** np.arange(3)
    speed = (SIDE[end] * edge_length[part[s]] / 2.0)[:, None] * offset
    moved = _blocks(np.column_stack([near[s], ends[s, end]]), 2).reshape(-1, 1, 10)
    of_parts = _matrix(
        (4 * len(parts), n_x),
        (by_length, p[:, :, None, None], _blocks(part_nodes, 2)[:, None]),
        (speed[:, :, None] * d_ends[s, end][:, None], p[part[s], :3, None], moved),
    )
    shapes = (1.0 + SIDE * centre[:, None]) / 2.0
    entries = _nodal(shapes), part_nodes[..., None], p[:, None, :3]
    D = _matrix((n_s, 4 * len(parts)), entries) @ of_parts
    integrals = Integrals(
        part_nodes,
        edge_length,
        length,
        centre,
        variance,
        starts,
        part,
        primary.edges[primary_edge],
        values.reshape(-1, 2, 2),
        vstack([of_segments, of_parts, D], format="csr"),
    )
    normals = _rows(_blocks(around, 2).reshape(-1, 1, 6), turning, n_x)
    normals.sum_duplicates()
    return GeometryDerivatives(operator, normals, D, integrals)


def normals_around(surface: Surface) -> tuple[Index, Float]:
    """Derivatives of the nodal normals with respect to nodes before, at and after them [1/m].

    Returns:
        These nodes, the node itself where there is none, shape (n, 3); the derivatives of both
        components with respect to their coordinates, shape (n, 2, 6).
    """
    tangents, edges, n = surface.tangents, surface.edges, len(surface.nodes)
    inward = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    normal, tau = (surface.rotations[edges, row] for row in range(2))  # (m, 2, 2): end, component
    size = np.bincount(edges.ravel(), np.einsum("mea,ma->me", normal, inward).ravel(), n)
    turn = np.einsum("mea,ma->me", tau, tangents) / (size[edges] * surface.lengths[:, None])
    blocks = np.einsum("me,mea,k,mb->meakb", turn, tau, -SIDE, inward)
    around = np.tile(np.arange(n)[:, None], 3)
    result = np.zeros((n, 2, 3, 2))
    around[edges[:, 0], 2], around[edges[:, 1], 0] = edges[:, 1], edges[:, 0]
    result[edges[:, 0], :, 1:] += blocks[:, 0]
    result[edges[:, 1], :, :2] += blocks[:, 1]
    return around, result.reshape(n, 2, 6)


def chained(derivatives: Float, turn: Float) -> Float:
    """Turn derivatives by two nodes and their normals into those by four nodes along the chain."""
    result = np.zeros_like(derivatives)
    result[..., 2:6] = derivatives[..., :4]
    result[..., :6] += derivatives[..., 4:6] @ turn[:, 0]
    result[..., 2:] += derivatives[..., 6:] @ turn[:, 1]
    return result


def _outer(edge: Index, segments: Segments) -> npt.NDArray[np.bool_]:
    """Ends of segments at which no other segment goes on from the same node; shape (l, 2)."""
    ends, nodes = segments.ends, segments.end_nodes
    order = np.lexsort((ends[:, 0], edge))
    before, after = order[:-1], order[1:]
    on = (edge[before] == edge[after]) & (nodes[before, 1] == nodes[after, 0])
    on &= np.abs(ends[before, 1] - ends[after, 0]) <= SHORTEST_SEGMENT
    outer = np.ones_like(nodes, dtype=bool)
    outer[before, 1], outer[after, 0] = ~on, ~on
    return outer


def _nodal(shapes: Float) -> Float:
    """Factors of int (xi - c)^q in int N_i, from the N_i(c) (p, 2); shape (p, 2, 3)."""
    sides = np.broadcast_to(SIDE / 2.0, shapes.shape)
    return np.stack([shapes, sides, np.zeros_like(shapes)], axis=-1)


def _over_parts(values: Float, starts: Index) -> Float:
    """Sum values of segments over each part, along the first axis."""
    return np.add.reduceat(values, starts, axis=0) if len(starts) else values


def _blocks(nodes: Index, k: int) -> Index:
    """Numbers of k components of nodes, along a new last axis."""
    return k * np.asarray(nodes)[..., None] + np.arange(k)


def _rows(columns: Index, values: Float, width: int) -> csr_array:
    """Matrix with the same number of entries in every row, in the columns given."""
    columns = np.broadcast_to(columns, values.shape)
    size = values.shape[-1]
    starts = np.arange(0, values.size + 1, size)
    return csr_array((values.ravel(), columns.ravel(), starts), (values.size // size, width))


def _matrix(shape: tuple[int, int], *entries: Entries) -> csr_array:
    parts = [[a.ravel() for a in np.broadcast_arrays(*part)] for part in entries]
    values, rows, columns = map(np.concatenate, zip(*parts, strict=True))
    return coo_array((values, (rows, columns)), shape).tocsr()
