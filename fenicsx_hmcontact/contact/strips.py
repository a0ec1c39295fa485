# SPDX-License-Identifier: LGPL-3.0-or-later
"""Strips of the void between two surfaces that face each other, and their derivatives.

A strip is that of a mortar segment; where it ends, straight lines connect the same points of both
surfaces now and at the start of the step. A node's part is weighted with its dual shape function:
at a node that touches it is zero, as the gap. Beside nodes whose displacement is prescribed, which
have no gap, it is weighted with their plain ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from .._kernels.mortar import SHORTEST_SEGMENT
from .._kernels.strips import strip_moments
from .linearisation import SIDE, GeometryDerivatives, chained, normals_around
from .mortar import MortarOperator, Segments, assemble, covered_parts, segment_corners
from .surface import Surface, cross

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
Index = npt.NDArray[np.integer]

MEETING = 1e-6
"""Strips whose ends are closer than this part of an edge go on from each other."""


@dataclass(frozen=True, eq=False)
class Ends:
    """Where l strips begin and end.

    Attributes:
        segments: Their mortar segments.
        edges: Edges of the secondary and of the primary surface; shape (l, 2).
        places: Local coordinates of both ends on them; shape (l, 2, 2), the order end, surface.
        loose: From which no other strip goes on; shape (l, 2).
    """

    segments: Segments
    edges: Index
    places: Float
    loose: Bool


def strip_ends(surfaces: tuple[Surface, Surface], segments: Segments, wet: Bool) -> Ends:
    """Find where strips begin and end. The water of edges without wet nodes is not that of strips.

    Args:
        surfaces: Secondary and primary surface.
        segments: Where they face each other.
        wet: Secondary nodes that have a part of the water; shape (n_s,).
    """
    secondary, primary = surfaces
    segments = segments.some(wet[secondary.edges[segments.secondary_edge[::3]]].any(axis=1))
    edge, primary_edge = (e[::3] for e in (segments.secondary_edge, segments.primary_edge))
    corners, s = segment_corners(secondary, primary, edge, primary_edge), segments.ends
    shapes = np.stack([1.0 - s, 1.0 + s], axis=-1) / 2.0
    x, normals = (np.einsum("len,lna->lea", shapes, corners[:, row]) for row in range(2))
    f1, f2 = (cross(x - corners[:, 2, None, node], normals) for node in range(2))
    eta = (f1 + f2) / (f1 - f2)
    y = np.einsum("len,lna->lea", np.stack([1.0 - eta, 1.0 + eta], axis=-1) / 2.0, corners[:, 2])
    nodes = secondary.edges[edge]
    # Segments of an edge in their order; where one ends at a node the next starts on the next edge.
    order = np.lexsort((s[:, 0], edge))
    following = np.full(len(edge), -1)
    following[order[:-1]] = np.where(edge[order[:-1]] == edge[order[1:]], order[1:], -1)
    first, last = s[:, 0] <= SHORTEST_SEGMENT - 1.0, s[:, 1] >= 1.0 - SHORTEST_SEGMENT
    from_node = np.full(len(secondary.nodes), -1)
    from_node[nodes[first, 0]] = np.flatnonzero(first)
    following[last] = from_node[nodes[last, 1]]
    end, start = np.flatnonzero(following >= 0), following[following >= 0]
    apart = np.abs(np.concatenate([x[end, 1] - x[start, 0], y[end, 1] - y[start, 0]], axis=1))
    meet = apart.max(axis=1, initial=0.0) <= MEETING * secondary.lengths[edge[end]]
    loose = np.ones_like(s, dtype=bool)
    loose[end[meet], 1] = loose[start[meet], 0] = False
    edges, places = np.column_stack([edge, primary_edge]), np.stack([s, eta], axis=-1)
    return Ends(segments, edges, places, loose)


class Strips:
    """Volumes between facing parts of two surfaces at the secondary nodes.

    Args:
        now: Both surfaces, where segments and coupling see them.
        before: Both at the start of the step.
        ends: The strips.
        mouths: Ends of strips where other water stands beyond; shape (l, 2).
        segments: All segments of the coupling.
        operator: Coupling of the displacements.
        wet: Secondary nodes that have a part, among them all that the coupling keeps; shape (n_s,).
        derivatives: Derivatives of the coupling; None where no derivative is asked for.

    Attributes:
        volumes: Part of each node [m^2]; shape (n_s,).
        growth: What it grew by in the step; shape (n_s,).
        of_points: Derivative of the volumes with respect to the coordinates of both surfaces where
            the points that face each other stay [m]; shape (n_s, 2 n_s + 2 n_m).
        pressing: Forces on the nodes of both surfaces per unit of the nodes' pressures, transposed
            [m]. It is the same but for mouths, where other water presses.
        columns: Coordinates that the ends depend on, by their numbers; shape (l, 16).
        of_places: Derivatives of the places of the ends by these [1/m]; shape (l, 2, 2, 16).
    """

    def __init__(
        self,
        now: tuple[Surface, Surface],
        before: tuple[Surface, Surface],
        ends: Ends,
        mouths: Bool,
        segments: Segments,
        operator: MortarOperator,
        wet: Bool,
        derivatives: GeometryDerivatives | None,
    ) -> None:
        self._now, self._derivatives = now, derivatives
        secondary, primary = now
        n_s = len(secondary.nodes)
        self._shape = n_s, 2 * (n_s + len(primary.nodes))
        edge, primary_edge = ends.edges.T
        self._nodes = secondary.edges[edge]
        facing = primary.edges[primary_edge]
        self._faced = n_s + facing
        if derivatives is not None:
            parts = derivatives.integrals.part
            self._part = parts[np.searchsorted(segments.secondary_edge[::3], edge)]
        _, centre, variance = (v[edge] for v in covered_parts(segments, len(secondary.edges)))
        self._set_functions(operator.kept, wet, centre, variance)
        corners = segment_corners(secondary, primary, edge, primary_edge)
        old = [s.points[k] for s, k in zip(before, (self._nodes, facing), strict=True)]
        moving = ends.segments.end_nodes >= 0
        end_nodes = np.where(moving, ends.segments.end_nodes, facing)
        self._end_nodes = n_s + end_nodes
        self._moments, self._slopes, self._of_moments, self._of_slopes, of_ends = strip_moments(
            corners,
            np.stack(old, axis=1),
            primary.points[end_nodes],
            ends.segments.ends,
            moving,
            mouths,
            centre,
            0 if derivatives is None else 16,
        )
        self.columns = self._columns()
        self.of_places = of_ends if derivatives is None else self._chained(of_ends)
        new, was = (self._at_nodes(self._moments[:, k]) for k in range(2))
        self.volumes, self.growth = new, new - was
        self._rows = _blocks(np.column_stack([self._nodes, self._faced]))
        where = self._nodes[..., None], self._rows[:, None]
        entries = np.einsum("set,stx->sex", self._weights[..., :2], self._slopes[:, :2])
        self.of_points = assemble(entries, *where, self._shape)
        entries = np.einsum("set,stx->sex", self._weights, self._slopes)
        self.pressing = assemble(entries, *where, self._shape)

    def _set_functions(self, coupled: Bool, wet: Bool, centre: Float, variance: Float) -> None:
        """Functions of the water of both nodes of each strip: a + b (xi - c) and -(a' + b' xi).

        The first weight volumes, as (a, b), the second are those of a node's pressure at mouths;
        shape (l, 2, 4).
        """
        both, filled = (kept[self._nodes].all(axis=1)[:, None] for kept in (coupled, wet))
        self._sign = np.where(both, SIDE, 0.0)
        shapes = (1.0 + SIDE * centre[:, None]) / 2.0
        slope = np.where(both, ((1.0 - centre**2) / (2.0 * variance))[:, None], 0.5)
        alone = wet[self._nodes].astype(float)
        functions = (
            np.where(filled, shapes, alone),
            np.where(filled, SIDE * slope, 0.0),
            np.where(filled, -0.5, -alone),
            np.where(filled, -SIDE / 2.0, 0.0),
        )
        self._weights = np.stack(functions, axis=-1)

    def growth_derivative(self) -> csr_array:
        """Derivative of the growth with respect to the coordinates; shape as `of_points`."""
        d = self._derivatives
        assert d is not None
        direct = np.einsum("set,stx->sex", self._weights[..., :2], self._chained(self._of_moments))
        grown = self._moments[:, 0] - self._moments[:, 1]
        turned = np.einsum("st,stq->sq", grown, self._turn)
        through = self._sign[..., None] * turned[:, None]
        entries = through, self._nodes[..., None], d.integrals.part_rows[self._part, None, :3]
        result = assemble(direct, self._nodes[..., None], self.columns[:, None], self._shape)
        return csr_array(result + d.integrals.combined(self._shape[0], entries))

    def force_derivative(self, pressures: Float) -> csr_array:
        """Derivative of the forces of water of given pressures, pressing^T p, by the coordinates.

        Args:
            pressures: At the secondary nodes [Pa]; shape (n_s,).

        Returns:
            Matrix [Pa]; shape (2 n_s + 2 n_m, 2 n_s + 2 n_m).
        """
        d, n_x = self._derivatives, self._shape[1]
        assert d is not None
        p = pressures[self._nodes]
        dual = np.einsum("set,se->st", self._weights, p)
        direct = np.einsum("st,stxy->sxy", dual, self._chained(self._of_slopes))
        jump = np.einsum("se,se->s", self._sign, p)
        through = np.einsum("s,stx,stq->sxq", jump, self._slopes[:, :2], self._turn)
        rows = self._rows[..., None]
        entries = through, rows, d.integrals.part_rows[self._part, None, :3]
        result = assemble(direct, rows, self.columns[:, None], (n_x, n_x))
        return csr_array(result + d.integrals.combined(n_x, entries))

    def _at_nodes(self, moments: Float) -> Float:
        parts = np.einsum("set,st->se", self._weights[..., :2], moments)
        total: Float = np.bincount(self._nodes.ravel(), parts.ravel(), self._shape[0])
        return total

    @cached_property
    def _around(self) -> tuple[Index, Float]:
        return normals_around(self._now[0])

    def _columns(self) -> Index:
        """Coordinates of four secondary, two primary nodes and those of the ends; shape (l, 16)."""
        around, _ = self._around
        first, second = self._nodes.T
        near = np.column_stack([around[first, 0], first, second, around[second, 2]])
        return _blocks(np.column_stack([near, self._faced, self._end_nodes]))

    @property
    def _turn(self) -> Float:
        """See `GeometryDerivatives.turn`, of every segment; shape (l, 2, 3)."""
        assert self._derivatives is not None
        return self._derivatives.turn[self._part]

    def _chained(self, derivatives: Float) -> Float:
        """Derivatives by nodes and their normals as those by four nodes along the chain."""
        _, turning = self._around
        turn = turning[self._nodes]
        rows = int(np.prod(derivatives.shape[1:-1]))
        result = derivatives.reshape(len(turn), rows, 16).copy()
        result[..., :8] = chained(result[..., :8], turn)
        return result.reshape(derivatives.shape)


def _blocks(nodes: Index) -> Index:
    """Numbers of both coordinates of the nodes of each row; shape (l, 2 k)."""
    return (2 * nodes[..., None] + np.arange(2)).reshape(len(nodes), 2 * nodes.shape[1])
