# SPDX-License-Identifier: LGPL-3.0-or-later
"""Mortar coupling of a secondary with a primary surface (Eqs. 55-65 of the paper).

The dual basis is rebuilt on the covered part of every secondary edge; nodes of small coverage and
prescribed nodes are dropped in a way that keeps linear fields, forces and water mass exact:

    u_i = alpha_i + sum_m H_im u_m - sum_j C_ij u_j        i kept, m primary, j dropped

so that a multiplier z_i [Pa] puts the force D_i z_i on i, D_i C_ij z_i on j, -D_i H_im z_i on m.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.spatial import cKDTree

from .._kernels import mortar as kernels
from .surface import Surface, cross

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]
Index = npt.NDArray[np.integer]

SHARPEST_CORNER = 0.2
"""Angle of a body below which a corner is taken for a slot that an iterate closed too far [rad]."""


@dataclass(frozen=True)
class MortarOptions:
    """How two surfaces find each other.

    Attributes:
        search_radius: Largest distance along the normal at which two edges face each other, as a
            multiple of the longer of these two; ``inf`` for any distance, at quadratic cost. Of
            primary edges behind each other only the nearest counts. Raise it for fluid in gaps
            wider than that, lower it where surfaces see a neighbour that they never touch.
        largest_angle: Largest angle [degrees] between the normals of edges that face each other, up
            to 90. Lower it where a corner of one body leaves that of another. In steps the angles
            at their start count: contact must not come and go as Newton's method turns an edge.
        min_coverage: A secondary node is dropped where the primary surface covers a smaller part
            of it than this. Below 0.5, since half of a node is covered where one of its two edges
            is.

    Raises:
        ValueError: If a value is out of its range.
    """

    search_radius: float = 5.0
    largest_angle: float = 90.0
    min_coverage: float = 0.2

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        if not self.search_radius > 0.0:
            raise ValueError(f"search_radius must be positive, got {self.search_radius}.")
        if not 0.0 < self.largest_angle <= 90.0:
            raise ValueError(f"largest_angle must be in (0, 90], got {self.largest_angle}.")
        if not 0.0 <= self.min_coverage < 0.5:
            raise ValueError(f"min_coverage must be in [0, 0.5), got {self.min_coverage}.")


@dataclass(frozen=True, eq=False)
class Segments:
    """Gauss points on the covered part of a secondary surface, three a segment, g = 3 l in all.

    They are sorted by secondary edges; segments of one edge do not overlap.

    Attributes:
        secondary_edge: Edge of the secondary surface; shape (g,).
        primary_edge: Edge of the primary surface; shape (g,).
        xi: Local coordinate on the secondary edge, from -1 to 1; shape (g,).
        eta: Local coordinate on the primary edge; shape (g,).
        weight: Length of the secondary surface that the point stands for [m]; shape (g,).
        ends: Where every segment begins and ends on the secondary edge; shape (l, 2).
        end_nodes: Node of the primary surface that makes this end, not always one of the primary
            edge; -1 where the secondary edge ends; shape (l, 2).
    """

    secondary_edge: npt.NDArray[np.int32]
    primary_edge: npt.NDArray[np.int32]
    xi: Float
    eta: Float
    weight: Float
    ends: Float
    end_nodes: npt.NDArray[np.int32]

    def some(self, which: Bool) -> Segments:
        """Those of the segments; shape (l,)."""
        points = which.repeat(3)
        return Segments(
            self.secondary_edge[points],
            self.primary_edge[points],
            self.xi[points],
            self.eta[points],
            self.weight[points],
            self.ends[which],
            self.end_nodes[which],
        )

    @property
    def secondary_shapes(self) -> Float:
        """Shape functions of the two nodes of the secondary edge; shape (g, 2)."""
        return _shapes(self.xi)

    @property
    def primary_shapes(self) -> Float:
        """Shape functions of the two nodes of the primary edge; shape (g, 2)."""
        return _shapes(self.eta)


@dataclass(frozen=True, eq=False)
class MortarOperator:
    """Values of kept secondary nodes from those of primary and dropped nodes.

    ``u_i = alpha_i + (H u_primary)_i - (C u_secondary)_i`` for kept i; rows of other nodes are
    empty. Rows of H - C sum to 1.

    Attributes:
        D: Covered length of every secondary node [m], dropped ones included; shape (n_s,).
        H: Weights of the primary nodes [-], D^-1 M of Eq. 64; shape (n_s, n_m).
        C: Weights of the dropped neighbours [-]; shape (n_s, n_s).
        coverage: Covered part of every secondary node [-]; shape (n_s,).
        kept: Secondary nodes that carry a multiplier; shape (n_s,).
        idle_edges: Secondary edges that are covered but carry nothing, both nodes being dropped;
            shape (k,).
    """

    D: Float
    H: csr_array
    C: csr_array
    coverage: Float
    kept: Bool
    idle_edges: npt.NDArray[np.intp]

    @property
    def dropped(self) -> Bool:
        """Secondary nodes without a multiplier; shape (n_s,)."""
        return ~self.kept

    @property
    def uncovered(self) -> Bool:
        """Secondary nodes that no primary edge faces; shape (n_s,)."""
        return self.D == 0.0


def mortar_segments(
    secondary: Surface,
    primary: Surface,
    options: MortarOptions = MortarOptions(),
    seen: tuple[Surface, Surface] | None = None,
) -> Segments:
    """Find the parts of the secondary surface that the primary one covers.

    Args:
        secondary: Surface that carries the multipliers.
        primary: Surface that faces it.
        options: How far the surfaces look for each other.
        seen: Both where the angles of their edges count; where they are if None.
    """
    pairs = candidate_pairs(secondary, primary, options.search_radius)
    if options.largest_angle < 90.0:
        along, opposite = (s.tangents for s in seen or (secondary, primary))
        cosines = -np.einsum("ka,ka->k", along[pairs[:, 0]], opposite[pairs[:, 1]])
        pairs = pairs[cosines >= cos(radians(options.largest_angle))]
    pair, ends, end_nodes = kernels.segments(
        secondary.points,
        secondary.normals,
        secondary.edges,
        primary.points,
        primary.edges,
        pairs,
        options.search_radius,
    )
    edge, primary_edge = pairs[pair].T
    corners = segment_corners(secondary, primary, edge, primary_edge)
    source, ends, end_nodes = _nearest(edge, corners, ends, end_nodes)
    xi, eta, weight = kernels.gauss_points(corners[source], ends)
    return Segments(
        edge[source].repeat(3).astype(np.int32),
        primary_edge[source].repeat(3).astype(np.int32),
        xi.ravel(),
        eta.ravel(),
        weight.ravel(),
        ends,
        end_nodes,
    )


def sees_only_backs(
    secondary: Surface, primary: Surface, options: MortarOptions = MortarOptions()
) -> bool:
    """Whether two surfaces would face each other if one of them were reversed.

    Then both bodies lie on the same side, as where the top of one body is paired with the top of
    another. What is nearest counts, and the longer part of the surface if the parts differ.

    Args:
        secondary: Surface that carries the multipliers.
        primary: The other surface.
        options: How far the surfaces look for each other.

    Returns:
        False where they face each other, and also where they are too far apart.
    """
    fronts, n = primary.edges, len(primary.nodes)
    both = Surface(
        primary.name,
        np.tile(primary.nodes, 2),
        np.tile(primary.input_nodes, 2),
        np.tile(primary.points, (2, 1)),
        np.vstack([fronts, fronts[:, ::-1] + np.int32(n)]),
    )
    segments = mortar_segments(secondary, both, options)
    front = segments.primary_edge < len(fronts)
    return bool(segments.weight[~front].sum() > segments.weight[front].sum())


def candidate_pairs(
    secondary: Surface, primary: Surface, search_radius: float
) -> npt.NDArray[np.int64]:
    """Pair every secondary edge with the primary edges that are near enough to face it.

    Edges are searched in classes of similar length, so that the number of pairs grows linearly
    with the number of edges, also beside much longer ones. Neighbours at a corner of the body,
    which lies between them, are left out.

    Args:
        secondary: Surface that carries the multipliers.
        primary: Surface that faces it.
        search_radius: Largest distance, as a multiple of the longer edge.

    Returns:
        Secondary and primary edge of every pair, sorted; shape (k, 2).
    """
    m = len(primary.edges)
    if np.isinf(search_radius):
        codes = np.arange(len(secondary.edges) * m)
    else:
        found = [np.empty(0, dtype=np.int64)]
        for here, longest, tree in _length_classes(secondary):
            for there, other_longest, other_tree in _length_classes(primary):
                reach = (search_radius + 1.0) * max(longest, other_longest)
                near = tree.sparse_distance_matrix(other_tree, reach, output_type="ndarray")
                found.append(here[near["i"]] * m + there[near["j"]])
        codes = np.sort(np.concatenate(found))
    edges = codes // m
    pairs = np.column_stack([edges, codes - m * edges])
    if np.isin(secondary.nodes, primary.nodes).any():
        pairs = pairs[~_around_a_corner(secondary, primary, pairs)]
    return pairs


def _length_classes(surface: Surface) -> list[tuple[Index, float, cKDTree]]:
    """Edges whose lengths differ by less than 2, the longest length and a tree of their centres."""
    centres, lengths = surface.points[surface.edges].mean(axis=1), surface.lengths
    steps = np.floor(np.log2(lengths / lengths.min(initial=np.inf))).astype(int)
    members = [np.flatnonzero(steps == step) for step in np.unique(steps)]
    return [(edges, lengths[edges].max(), cKDTree(centres[edges])) for edges in members]


def _around_a_corner(secondary: Surface, primary: Surface, pairs: Index) -> Bool:
    """Pairs of edges that share a node at which the body has less than a straight angle."""
    of_pairs = []
    for surface, edges in [(secondary, pairs[:, 0]), (primary, pairs[:, 1])]:
        of_pairs.append((surface.nodes[surface.edges[edges]], surface.tangents[edges]))
    result = np.zeros(len(pairs), dtype=bool)
    for (nodes, along), (next_nodes, next_along) in [of_pairs, of_pairs[::-1]]:
        turn = np.arctan2(cross(along, next_along), np.sum(along * next_along, axis=1))
        meet = nodes[:, 1] == next_nodes[:, 0]
        result |= meet & (turn > 0.0) & (turn < np.pi - SHARPEST_CORNER)
    return result


def _nearest(
    edge: Index, corners: Float, ends: Float, end_nodes: npt.NDArray[np.int32]
) -> tuple[Index, Float, npt.NDArray[np.int32]]:
    """Cut segments where others of the same edge are nearer; the segment of every piece first."""
    everything = np.arange(len(edge))
    order = np.lexsort((ends[:, 0], edge))
    before, after = order[:-1], order[1:]
    twice = (edge[before] == edge[after]) & (
        ends[before, 1] - ends[after, 0] > kernels.SHORTEST_SEGMENT
    )
    if not twice.any():
        return everything, ends, end_nodes
    affected = np.isin(edge, edge[before[twice]])
    inside = np.flatnonzero(affected)
    starts = np.append(np.unique(edge[inside], return_index=True)[1], len(inside))
    piece, parts, nodes = kernels.nearest(starts, corners[inside], ends[inside], end_nodes[inside])
    outside = everything[~affected]
    source = np.concatenate([outside, inside[piece]])
    ends, end_nodes = np.vstack([ends[outside], parts]), np.vstack([end_nodes[outside], nodes])
    order = np.argsort(edge[source], kind="stable")
    return source[order], ends[order], end_nodes[order]


def segment_corners(
    secondary: Surface,
    primary: Surface,
    edge: Index,
    primary_edge: Index,
) -> Float:
    """Nodes of secondary edges, their normals and nodes of primary edges; shape (l, 3, 2, 2)."""
    nodes = secondary.edges[edge]
    y = primary.points[primary.edges[primary_edge]]
    return np.stack([secondary.points[nodes], secondary.normals[nodes], y], axis=1)


def mortar_operator(
    secondary: Surface,
    primary: Surface,
    segments: Segments,
    dropped: Bool | None = None,
    options: MortarOptions = MortarOptions(),
) -> MortarOperator:
    """Build the coupling of two surfaces from their segments.

    Nodes of small coverage and nodes that lie on both surfaces are dropped besides the given ones.
    The multiplier of an edge with one dropped node is constant, that of its other node.

    Args:
        secondary: Surface that carries the multipliers.
        primary: Surface that faces it.
        segments: Their segments.
        dropped: Secondary nodes with a prescribed value; shape (n_s,). None for none.
        options: Which coverage is too small.

    Raises:
        ValueError: If ``dropped`` is no mask of the secondary nodes.
    """
    n, edges = len(secondary.nodes), secondary.edges
    dropped = np.zeros(n, dtype=bool) if dropped is None else np.asarray(dropped)
    if dropped.shape != (n,) or dropped.dtype != bool:
        raise ValueError(
            f"Surface '{secondary.name}': dropped must be a mask of its {n} nodes, got shape "
            f"{dropped.shape} of {dropped.dtype}."
        )
    nodes = edges[segments.secondary_edge]
    shapes = segments.secondary_shapes
    D = np.bincount(nodes.ravel(), (segments.weight[:, None] * shapes).ravel(), n).astype(float)
    coverage = D / np.bincount(edges.ravel(), np.repeat(secondary.lengths / 2, 2), n)
    small = (coverage < options.min_coverage) | (D == 0.0)
    kept = ~(dropped | small | np.isin(secondary.nodes, primary.nodes))

    kept_here = kept[nodes]
    point, end = np.nonzero(kept_here)
    i, j = nodes[point, end], nodes[point, 1 - end]
    multiplier = _cut(_dual_shapes(segments, len(edges)), kept_here)[point, end]
    scaled = multiplier * segments.weight[point] / D[i]
    H = assemble(
        scaled[:, None] * segments.primary_shapes[point],
        i[:, None],
        primary.edges[segments.primary_edge[point]],
        (n, len(primary.nodes)),
    )
    beside = ~kept[j]
    C = assemble((scaled * shapes[point, 1 - end])[beside], i[beside], j[beside], (n, n))
    idle = np.unique(segments.secondary_edge[~kept_here.any(axis=1)])
    return MortarOperator(D, H, C, coverage, kept, idle)


def check_idle_edges(name: str, secondary: Surface, operator: MortarOperator, held: Bool) -> None:
    """Refuse secondary edges that carry nothing because both their nodes are held otherwise.

    Args:
        name: Name of the pair.
        secondary: Its secondary surface.
        operator: Coupling of the displacements.
        held: Nodes that are prescribed, or secondary in another pair; shape (n_s,).

    Raises:
        ValueError: If there is one; it names the pair.
    """
    if held[secondary.edges[operator.idle_edges]].all(axis=1).any():
        raise ValueError(
            f"pair {name}: neighbouring nodes of the secondary surface are prescribed or belong to "
            "another pair, so that nothing ties the edge between them; swap secondary and primary"
        )


def covered_parts(segments: Segments, num_edges: int) -> tuple[Float, Float, Float]:
    """Length [m], centre and variance of the covered part of every edge; shapes (num_edges,).

    Centre and variance are of the local coordinate, nan for edges without segment.
    """
    edge, xi, weight = segments.secondary_edge, segments.xi, segments.weight
    length = np.bincount(edge, weight, num_edges)
    with np.errstate(invalid="ignore"):
        centre = np.bincount(edge, weight * xi, num_edges) / length
        variance = np.bincount(edge, weight * (xi - centre[edge]) ** 2, num_edges) / length
    return length, centre, variance


def covered_shapes(secondary: Surface, segments: Segments, kept: Bool) -> Float:
    """Shape functions of the film between the surfaces at the Gauss points.

    The film on an edge with one dropped node has the value of its other node, there is none on an
    edge with two.

    Args:
        secondary: Surface that carries the values.
        segments: Its covered part.
        kept: Secondary nodes that carry a multiplier; shape (n_s,).

    Returns:
        Values of the two nodes of the secondary edge; shape (g, 2).
    """
    kept = kept[secondary.edges[segments.secondary_edge]]
    return _cut(segments.secondary_shapes, kept)


def covered_gradients(secondary: Surface, segments: Segments, kept: Bool) -> Float:
    """Derivatives of the film's shape functions along the chain [1/m]; shape (g, 2).

    Args:
        secondary: Surface that carries the values.
        segments: Its covered part.
        kept: Secondary nodes that carry a multiplier; shape (n_s,).
    """
    kept = kept[secondary.edges[segments.secondary_edge]]
    slope = np.where(kept.all(axis=1), 1.0 / secondary.lengths[segments.secondary_edge], 0.0)
    return np.column_stack([-slope, slope])


def covered_mass(
    secondary: Surface, segments: Segments, kept: Bool, factor: Float | None = None
) -> csr_array:
    """Integrate N_i N_j over the film (Eqs. 80 and 82).

    Args:
        secondary: Surface that carries the values.
        segments: Its covered part.
        kept: Secondary nodes that carry a multiplier; shape (n_s,).
        factor: Coefficient at the Gauss points; shape (g,). None for 1.

    Returns:
        Matrix [m, times the unit of the factor], zero for dropped nodes; shape (n_s, n_s).
    """
    shapes = covered_shapes(secondary, segments, kept)
    return covered_products(secondary, segments, shapes, shapes, factor)


def covered_stiffness(
    secondary: Surface, segments: Segments, kept: Bool, factor: Float | None = None
) -> csr_array:
    """Integrate N_i,L N_j,L over the film (Eq. 81), L the length along the chain.

    Args:
        secondary: Surface that carries the values.
        segments: Its covered part.
        kept: Secondary nodes that carry a multiplier; shape (n_s,).
        factor: Coefficient at the Gauss points; shape (g,). None for 1.

    Returns:
        Matrix [1/m, times the unit of the factor], zero for dropped nodes; shape (n_s, n_s).
    """
    slopes = covered_gradients(secondary, segments, kept)
    return covered_products(secondary, segments, slopes, slopes, factor)


def covered_products(
    secondary: Surface, segments: Segments, tests: Float, trials: Float, factor: Float | None = None
) -> csr_array:
    """Integrate products of functions of the two nodes of each covered edge.

    Args:
        secondary: Surface that carries the values.
        segments: Its covered part.
        tests: Functions of the rows at the Gauss points; shape (g, 2).
        trials: Functions of the columns; shape (g, 2).
        factor: Coefficient at the Gauss points; shape (g,). None for 1.

    Returns:
        Matrix [m, times the units of functions and factor]; shape (n_s, n_s).
    """
    nodes = secondary.edges[segments.secondary_edge]
    weight = segments.weight if factor is None else segments.weight * factor
    products = weight[:, None, None] * tests[:, :, None] * trials[:, None, :]
    n = len(secondary.nodes)
    return assemble(products, nodes[:, :, None], nodes[:, None, :], (n, n))


def unseen_values(
    surfaces: tuple[Surface, Surface], segments: Segments, operator: MortarOperator
) -> csr_array:
    """What the coupling does not see of values on the primary surface.

    Where this has more nodes than the secondary one, some values have no mean at any node of that.

    Args:
        surfaces: Secondary and primary surface.
        segments: Where they face each other.
        operator: Their coupling.

    Returns:
        Difference at the Gauss points between a primary value and what the secondary nodes make of
        it, zero on facets without a node; shape (g, n_m).
    """
    secondary, primary = surfaces
    count, n, m = len(segments.xi), len(secondary.nodes), len(primary.nodes)
    at = np.arange(count)[:, None]
    shapes = covered_shapes(secondary, segments, operator.kept)
    nodes = secondary.edges[segments.secondary_edge]
    sums = operator.H.sum(axis=1)
    means = diags_array(np.divide(1.0, sums, out=np.zeros(n), where=operator.kept & (sums != 0.0)))
    seen = assemble(shapes, at, nodes, (count, n)) @ means @ operator.H
    there = shapes.sum(axis=1)
    opposite = primary.edges[segments.primary_edge]
    return csr_array(
        assemble(segments.primary_shapes * there[:, None], at, opposite, (count, m)) - seen
    )


def primary_coverage(primary: Surface, segments: Segments) -> Float:
    """Integrate the shape functions of the primary nodes over what is covered [m]; shape (n_m,).

    Args:
        primary: Surface that faces the secondary one.
        segments: Its covered part.
    """
    nodes = primary.edges[segments.primary_edge].ravel()
    values = (segments.weight[:, None] * segments.primary_shapes).ravel()
    return np.bincount(nodes, values, len(primary.nodes)).astype(float)


def _shapes(xi: Float) -> Float:
    return np.stack([1.0 - xi, 1.0 + xi], axis=-1) / 2.0


def _dual_shapes(segments: Segments, num_edges: int) -> Float:
    """Functions with int phi_i N_j = delta_ij int N_j over the covered part of an edge; (g, 2).

    Written with centre c and variance v of that part instead of the inverse of int N_i N_j, which
    loses all digits where the part is short. Equal to Eq. 57 where the edge is covered.
    """
    edge, xi = segments.secondary_edge, segments.xi
    _, centre, variance = (values[edge] for values in covered_parts(segments, num_edges))
    slope = (1.0 - centre**2) / (2.0 * variance)
    return _shapes(centre) + np.column_stack([-slope, slope]) * (xi - centre)[:, None]


def _cut(shapes: Float, kept: Bool) -> Float:
    """Replace the functions of edges with a dropped node: 1 for the kept node, 0 for dropped."""
    return np.where(kept.all(axis=1)[:, None], shapes, kept)


def assemble(
    values: Float,
    rows: Index,
    columns: Index,
    shape: tuple[int, int],
) -> csr_array:
    """Add values up in a matrix; values, rows and columns of shapes that broadcast."""
    values, rows, columns = (a.ravel() for a in np.broadcast_arrays(values, rows, columns))
    return coo_array((values, (rows, columns)), shape).tocsr()
