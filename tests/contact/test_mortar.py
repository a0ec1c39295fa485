# SPDX-License-Identifier: LGPL-3.0-or-later
"""Mortar coupling against exact integrals, exact fields and an independent quadrature."""

from itertools import pairwise

from mpi4py import MPI

import basix.ufl
import numpy as np
import pytest
from dolfinx import mesh as dmesh

from fenicsx_hmcontact.contact.mortar import (
    MortarOptions,
    _dual_shapes,
    covered_mass,
    covered_shapes,
    covered_stiffness,
    mortar_operator,
    mortar_segments,
    unseen_values,
)
from fenicsx_hmcontact.contact.surface import Surface, gather_surface
from fenicsx_hmcontact.domain import vertex_ghost_partitioner

RATIOS = [(7, 11), (5, 17), (19, 4), (6, 6)]
SLOPES = [0.0, 0.3, -0.7]
ANY = MortarOptions(search_radius=np.inf)


def chain(name, points, first=0):
    """Surface of one chain along the points, its global nodes numbered from ``first``."""
    ids = np.arange(len(points)) + first
    edges = np.column_stack([np.arange(len(points) - 1), np.arange(1, len(points))])
    return Surface(name, ids, ids, np.array(points, dtype=float), edges.astype(np.int32))


def pair(s, m, shape=lambda x: 0 * x):
    """Secondary surface above, with nodes over the abscissas s, and primary below, over m."""
    upper, lower = np.asarray(s, dtype=float), np.asarray(m, dtype=float)[::-1]
    return (
        chain("upper", np.column_stack([upper, shape(upper)])),
        chain("lower", np.column_stack([lower, shape(lower)]), first=1000),
    )


def uneven(n, start=0.0, end=1.0, seed=0):
    """Points n + 1 that divide an interval into parts of different lengths."""
    parts = np.random.default_rng(seed).uniform(0.5, 1.5, n)
    return start + (end - start) * np.concatenate([[0], np.cumsum(parts)]) / parts.sum()


def mask(n, *true):
    return np.isin(np.arange(n), np.arange(n)[list(true)])


def linear(surface):
    """Three fields that span the linear ones; shape (n, 3)."""
    return np.column_stack([np.ones(len(surface.nodes)), surface.points])


def mismatch(operator, secondary, primary):
    """Largest error of u = H u_m - C u_s for linear u at the kept nodes."""
    u = operator.H @ linear(primary) - operator.C @ linear(secondary)
    return np.abs(u - linear(secondary))[operator.kept].max(initial=0)


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("slope", SLOPES)
def test_full_coverage_is_exact_on_straight_interfaces(ratio, slope):
    secondary, primary = pair(uneven(ratio[0]), uneven(ratio[1], seed=1), lambda x: slope * x)
    segments = mortar_segments(secondary, primary)
    operator = mortar_operator(secondary, primary, segments)
    assert operator.kept.all() and not operator.uncovered.any()
    assert operator.C.nnz == 0 and len(operator.idle_edges) == 0
    assert np.allclose(operator.coverage, 1, rtol=0, atol=1e-14)
    half = np.concatenate([[0], secondary.lengths / 2, [0]])
    assert np.allclose(operator.D, half[1:] + half[:-1], rtol=1e-14, atol=0)
    assert np.allclose(operator.H.sum(axis=1), 1, rtol=0, atol=1e-14)
    assert mismatch(operator, secondary, primary) < 1e-14
    # The primary surface receives the consistent nodal forces of a uniform traction.
    half = np.concatenate([[0], primary.lengths / 2, [0]])
    assert np.allclose(operator.H.T @ operator.D, half[1:] + half[:-1], rtol=1e-13, atol=0)


@pytest.mark.parametrize("slope", SLOPES)
def test_matching_nodes_are_coupled_one_to_one(slope):
    x = uneven(9)
    secondary, primary = pair(x, x, lambda x: slope * x)
    operator = mortar_operator(secondary, primary, mortar_segments(secondary, primary))
    assert np.allclose(operator.H.toarray(), np.eye(10)[::-1], rtol=0, atol=1e-14)


def test_dual_basis_is_biorthogonal_also_on_covered_parts():
    secondary, primary = pair(uneven(8), uneven(5, 0.31, 0.77), lambda x: 0.1 * np.sin(5 * x))
    segments = mortar_segments(secondary, primary)
    dual, shapes, w = _dual_shapes(segments, 8), segments.secondary_shapes, segments.weight
    products = np.zeros((8, 2, 2))
    np.add.at(
        products, segments.secondary_edge, w[:, None, None] * dual[:, :, None] * shapes[:, None, :]
    )
    lengths = np.zeros((8, 2))
    np.add.at(lengths, segments.secondary_edge, w[:, None] * shapes)
    covered = lengths.sum(axis=1) / secondary.lengths
    assert np.any((covered > 0.01) & (covered < 0.99)) and np.any(covered == 0)
    assert np.abs(products - lengths[:, :, None] * np.eye(2)).max() < 1e-16
    whole = np.isin(segments.secondary_edge, np.flatnonzero(covered > 1 - 1e-14))
    assert whole.sum() > 3
    paper = np.column_stack([1 - 3 * segments.xi, 1 + 3 * segments.xi]) / 2  # Eq. 57
    assert np.allclose(dual[whole], paper[whole], rtol=0, atol=1e-14)


COVERED = [0.9, 0.5, 0.23, 0.1, 1e-3, 1e-8]


@pytest.mark.parametrize("part", COVERED)
@pytest.mark.parametrize(
    ("slope", "prescribed"), [(0, ()), (0, (0, -1)), (0.3, ()), (0.3, (0,)), (-0.7, (0, 3))]
)
def test_partial_coverage_keeps_linear_fields_force_and_moment(slope, part, prescribed):
    # The primary ends inside the sixth of seven secondary edges and begins inside the first.
    primary_points = uneven(11, 0.03, (5 + part) / 7, seed=2)
    secondary, primary = pair(np.linspace(0, 1, 8), primary_points, lambda x: slope * x)
    segments = mortar_segments(secondary, primary)
    operator = mortar_operator(secondary, primary, segments, mask(8, *prescribed))
    small = [6] if part**2 / 2 < 0.2 else []
    assert np.array_equal(operator.dropped, mask(8, *prescribed, *small, 7))
    assert np.array_equal(operator.uncovered, mask(8, 7))
    rows = (operator.H.sum(axis=1) - operator.C.sum(axis=1))[operator.kept]
    assert np.allclose(rows, 1, rtol=0, atol=1e-14)
    assert np.abs(operator.H.toarray()[operator.dropped]).max() == 0
    assert mismatch(operator, secondary, primary) < 1e-13

    uniform = np.tile([0.3, -1.0], (8, 1))
    for z in [uniform, np.random.default_rng(3).normal(size=(8, 2))]:
        nodal = (operator.D * operator.kept)[:, None] * z
        f_s, f_m = nodal + operator.C.T @ nodal, -operator.H.T @ nodal
        assert np.abs(f_s.sum(axis=0) + f_m.sum(axis=0)).max() < 1e-15
        moment = sum(
            np.sum(p[:, 0] * f[:, 1] - p[:, 1] * f[:, 0])
            for p, f in [(secondary.points, f_s), (primary.points, f_m)]
        )
        assert abs(moment) < 1e-15
        if z is uniform:
            # Both sides receive the consistent nodal forces of the covered part.
            half = np.concatenate([[0], primary.lengths / 2, [0]])
            assert np.allclose(f_m, -(half[1:] + half[:-1])[:, None] * z[0], rtol=0, atol=1e-15)
            assert np.allclose(f_s, operator.D[:, None] * z[0], rtol=0, atol=1e-15)
    assert len(operator.idle_edges) == 0


@pytest.mark.parametrize("theta", [0.0, 0.2])
@pytest.mark.parametrize("part", [1e-3, 1e-6, 1e-8])
def test_tiny_coverage_stays_finite(theta, part):
    options = MortarOptions(min_coverage=theta)
    secondary, primary = pair(np.linspace(0, 1, 6), np.linspace(0, (3 + part) / 5, 8))
    segments = mortar_segments(secondary, primary)
    operator = mortar_operator(secondary, primary, segments, options=options)
    assert operator.coverage[4] == pytest.approx(part**2 / 2, rel=1e-6, abs=0)
    assert np.array_equal(operator.dropped, mask(6, 5, *([] if theta == 0.0 else [4])))
    assert np.isfinite(operator.H.data).all() and np.isfinite(operator.C.data).all()
    # The row of a node kept with next to no coverage extrapolates, which costs digits: not asked.
    error = operator.H @ linear(primary) - operator.C @ linear(secondary) - linear(secondary)
    assert np.abs(error[:4]).max() < 1e-14


@pytest.mark.parametrize("part", [0.44, 0.46])
def test_node_is_dropped_below_the_smallest_coverage(part):
    secondary, primary = pair(np.arange(4), [0, 1, 2 + part])
    operator = mortar_operator(secondary, primary, mortar_segments(secondary, primary))
    assert operator.coverage[3] == pytest.approx(part**2, rel=1e-14)
    assert operator.kept[3] == (part**2 >= 0.2)


def test_two_prescribed_neighbours_leave_an_idle_edge():
    secondary, primary = pair(np.linspace(0, 1, 6), uneven(7))
    segments = mortar_segments(secondary, primary)
    operator = mortar_operator(secondary, primary, segments, mask(6, 0, 1, 4))
    assert operator.idle_edges.tolist() == [0]
    assert operator.kept.tolist() == [False, False, True, True, False, True]
    assert mismatch(operator, secondary, primary) < 1e-13
    # C_ij D_i = int N_j over the one edge between them
    scaled = operator.C.toarray() * operator.D[:, None]
    expected = np.zeros((6, 6))
    expected[[2, 3, 5], [1, 4, 4]] = 0.1
    assert np.allclose(scaled, expected, rtol=0, atol=1e-15)


def test_node_on_both_surfaces_is_dropped():
    # A lens whose two faces meet in the points (0, 0) and (1, 0)
    x = uneven(8)
    upper = chain("upper", np.column_stack([x, 0.1 * x * (1 - x)]))
    y = uneven(5, seed=4)[::-1]
    lower = chain("lower", np.column_stack([y, 0 * y]), first=100)
    lower.nodes[[0, -1]] = upper.nodes[[-1, 0]]
    operator = mortar_operator(upper, lower, mortar_segments(upper, lower))
    assert np.array_equal(operator.dropped, mask(9, 0, -1))
    rows = (operator.H.sum(axis=1) - operator.C.sum(axis=1))[operator.kept]
    assert np.allclose(rows, 1, rtol=0, atol=1e-14)


@pytest.mark.parametrize("slope", SLOPES)
@pytest.mark.parametrize("part", [1.0, 0.62])
def test_what_the_coupling_does_not_see_of_a_finer_primary_surface(slope, part):
    surfaces = pair(uneven(4), uneven(13, -0.1, part), lambda x: slope * x)
    segments = mortar_segments(*surfaces, ANY)
    operator = mortar_operator(*surfaces, segments, None, ANY)
    unseen = unseen_values(surfaces, segments, operator)
    assert np.abs(unseen @ np.ones(14)).max() < 1e-14
    on_whole_facets = operator.kept[surfaces[0].edges[segments.secondary_edge]].all(axis=1)
    assert on_whole_facets.sum() >= 18
    assert np.abs(unseen @ linear(surfaces[1]))[on_whole_facets].max() < 1e-13
    # Values without a mean at any node are as they are.
    _, sizes, ways = np.linalg.svd(operator.H.toarray())
    invisible = ways[(sizes > 1e-12).sum() :].T
    assert invisible.shape[1] >= 9
    at = surfaces[1].edges[segments.primary_edge]
    values = np.einsum("gi,gik->gk", segments.primary_shapes, invisible[at])
    assert unseen @ invisible == pytest.approx(values, abs=1e-12)


def wavy(x):
    return 0.08 * np.sin(7 * x) + 0.05 * x**2


def reference(secondary, primary, radius):
    """D and M by rays, 2 x 2 systems, inverted mass matrices and 20 Gauss points a smooth part."""
    points, weights = np.polynomial.legendre.leggauss(20)
    D, M = np.zeros(len(secondary.points)), np.zeros((len(secondary.points), len(primary.points)))
    inward = primary.tangents @ np.array([[0, 1], [-1, 0]])
    for edge in secondary.edges:
        (x1, x2), (n1, n2) = secondary.points[edge], secondary.normals[edge]

        def ray(s, x1=x1, x2=x2, n1=n1, n2=n2):
            return (1 - s) / 2 * x1 + (1 + s) / 2 * x2, (1 - s) / 2 * n1 + (1 + s) / 2 * n2

        def miss(s, y, ray=ray):
            x, n = ray(s)
            return (x[0] - y[0]) * n[1] - (x[1] - y[1]) * n[0]

        breaks = {-1.0, 1.0}
        for y in primary.points:
            roots = np.roots(np.polyfit([-1, 0, 1], [miss(s, y) for s in (-1, 0, 1)], 2))
            breaks |= {r.real for r in roots if abs(r.imag) < 1e-12 and abs(r.real) < 1}
        breaks = np.array(sorted(breaks))
        Me, De, mixed = np.zeros((2, 2)), np.zeros(2), np.zeros((2, len(primary.points)))
        for low, high in pairwise(breaks):
            for s, w in zip(points, weights, strict=True):
                s = (low + high) / 2 + (high - low) / 2 * s
                w *= (high - low) / 4 * np.hypot(*(x2 - x1))
                x, n = ray(s)
                for k, m in enumerate(primary.edges):
                    (y1, y2), away = primary.points[m], -n / np.hypot(*n)
                    if inward[k] @ n >= 0:
                        continue
                    r, distance = np.linalg.solve(np.column_stack([y2 - y1, -away]), x - y1)
                    if 0 <= r <= 1 and abs(distance) <= radius:
                        N = np.array([(1 - s) / 2, (1 + s) / 2])
                        Me += w * np.outer(N, N)
                        De += w * N
                        mixed[:, m] += w * np.outer(N, [1 - r, r])
        if De.any():
            D[edge] += De
            M[edge] += np.diag(De) @ np.linalg.inv(Me) @ mixed
    return D, M


@pytest.mark.parametrize(
    ("s", "m"),
    [
        (uneven(7), uneven(11, seed=1)),
        (uneven(6), uneven(19, -0.2, 0.83, seed=1)),
        (uneven(17, -0.4, 1.1), uneven(5, seed=1)),
        (uneven(2), uneven(1, 0.2, 0.9)),
    ],
)
def test_curved_surfaces_agree_with_independent_quadrature(s, m):
    upper, lower = pair(s, m, wavy)
    lower = lower.at(lower.points - [0, 0.03])
    for secondary, primary in [(upper, lower), (lower, upper)]:
        options = MortarOptions(min_coverage=0.0)
        segments = mortar_segments(secondary, primary, options)
        operator = mortar_operator(secondary, primary, segments, options=options)
        D, M = reference(secondary, primary, 5)
        # Three Gauss points are not exact where the normal turns along the edge.
        assert np.allclose(operator.D, D, rtol=0, atol=1e-12)
        assert np.abs(operator.D[:, None] * operator.H.toarray() - M).max() < 1e-8
        assert np.array_equal(operator.uncovered, D == 0)
        rows = operator.H.sum(axis=1)[operator.kept]
        assert np.allclose(rows, 1, rtol=0, atol=1e-13)


def test_normals_that_fan_out_still_see_a_long_edge():
    # The secondary surface turns by 90 degrees in short edges around a corner of two long ones.
    angle = np.linspace(0, np.pi / 2, 7)
    arc = np.column_stack([-np.cos(angle), -np.sin(angle)])
    secondary = chain("pile", np.vstack([[-1, 3], arc, [3, -1]]))
    primary = chain("hole", [[3, -1.1], [-1.1, -1.1], [-1.1, 3]], first=100)
    segments = mortar_segments(secondary, primary)
    operator = mortar_operator(secondary, primary, segments)
    assert np.allclose(operator.coverage, 1, rtol=0, atol=1e-13)
    assert segments.eta.min() > -1 and segments.eta.max() < 1
    D, M = reference(secondary, primary, np.inf)
    assert np.allclose(operator.D, D, rtol=0, atol=1e-12)
    assert np.abs(operator.D[:, None] * operator.H.toarray() - M).max() < 1e-5


def dense(operator):
    return operator.D, operator.H.toarray(), operator.C.toarray()


def curved_pair():
    secondary, primary = pair(uneven(7), uneven(11, 0.1, 0.95, seed=1), wavy)
    return secondary, primary.at(primary.points - [0, 0.02])


@pytest.mark.parametrize(
    ("name", "change", "scale"),
    [
        ("units", lambda x: 1024.0 * x, 1024),
        ("small", lambda x: x / 2**20, 2.0**-20),
        ("turned", lambda x: x @ [[0.6, 0.8], [-0.8, 0.6]], 1),
        ("moved", lambda x: x + np.array([40.0, -70.0]), 1),
    ],
)
def test_coupling_does_not_depend_on_units_and_axes(name, change, scale):
    secondary, primary = curved_pair()
    dropped = mask(8, 2)
    expected = dense(
        mortar_operator(secondary, primary, mortar_segments(secondary, primary), dropped)
    )
    secondary, primary = (s.at(change(s.points)) for s in (secondary, primary))
    D, H, C = dense(
        mortar_operator(secondary, primary, mortar_segments(secondary, primary), dropped)
    )
    assert np.allclose(D, scale * expected[0], rtol=1e-12, atol=0)
    assert np.abs(H - expected[1]).max() < 1e-12 and np.abs(C - expected[2]).max() < 1e-12


def test_coupling_does_not_depend_on_the_numbering():
    surfaces = curved_pair()
    rng = np.random.default_rng(5)
    renumbered, orders = [], []
    for surface in surfaces:
        order = rng.permutation(len(surface.nodes))
        new = np.argsort(order)
        edges = rng.permutation(new[surface.edges].astype(np.int32))
        renumbered.append(
            Surface(surface.name, surface.nodes[order], order, surface.points[order], edges)
        )
        orders.append(order)
    s, m = orders
    dropped = mask(8, 2, 5)
    D, H, C = dense(mortar_operator(*surfaces, mortar_segments(*surfaces), dropped))
    other = dense(mortar_operator(*renumbered, mortar_segments(*renumbered), dropped[s]))
    assert np.allclose(other[0], D[s], rtol=1e-14, atol=0)
    assert np.allclose(other[1], H[np.ix_(s, m)], rtol=0, atol=1e-14)
    assert np.allclose(other[2], C[np.ix_(s, s)], rtol=0, atol=1e-14)


def test_mirror_image_has_the_mirrored_coupling():
    surfaces = curved_pair()
    mirrored = [
        chain(s.name, s.points[::-1] * [-1, 1], first)
        for s, first in zip(surfaces, [0, 1000], strict=True)
    ]
    D, H, C = dense(mortar_operator(*surfaces, mortar_segments(*surfaces), mask(8, 2)))
    other = dense(mortar_operator(*mirrored, mortar_segments(*mirrored), mask(8, -3)))
    assert np.allclose(other[0], D[::-1], rtol=1e-13, atol=0)
    assert np.allclose(other[1], H[::-1, ::-1], rtol=0, atol=1e-13)
    assert np.allclose(other[2], C[::-1, ::-1], rtol=0, atol=1e-13)


def test_surface_seen_from_behind_is_not_coupled():
    secondary, primary = pair(np.linspace(0, 1, 5), np.linspace(0, 1, 4))
    behind = chain("back", primary.points[::-1], first=1000)
    operator = mortar_operator(secondary, behind, mortar_segments(secondary, behind))
    assert operator.uncovered.all() and operator.dropped.all() and operator.H.nnz == 0


@pytest.mark.parametrize(("gap", "radius", "found"), [(0.9, 3.0, True), (1.1, 3.0, False)])
def test_search_radius_counts_on_both_sides(gap, radius, found):
    secondary, primary = pair(np.linspace(0, 1, 6), np.linspace(0, 0.9, 4))
    for sign in (1, -1):
        apart = primary.at(primary.points - [0, sign * gap])
        segments = mortar_segments(secondary, apart, MortarOptions(search_radius=radius))
        assert (len(segments.xi) > 0) == found
        everywhere = mortar_segments(secondary, apart, MortarOptions(search_radius=np.inf))
        assert np.sum(everywhere.weight) == pytest.approx(0.9, rel=1e-14)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"search_radius": 0.0}, "search_radius must be positive, got 0.0"),
        ({"search_radius": np.nan}, "search_radius must be positive, got nan"),
        ({"min_coverage": 0.5}, r"min_coverage must be in \[0, 0.5\), got 0.5"),
        ({"min_coverage": -0.1}, r"min_coverage must be in \[0, 0.5\), got -0.1"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        MortarOptions(**options)


@pytest.mark.parametrize("dropped", [np.zeros(3, bool), np.zeros(5, int), np.zeros((5, 1), bool)])
def test_wrong_mask_is_refused(dropped):
    secondary, primary = pair(np.linspace(0, 1, 5), [0, 1])
    segments = mortar_segments(secondary, primary)
    with pytest.raises(ValueError, match="'upper': dropped must be a mask of its 5 nodes"):
        mortar_operator(secondary, primary, segments, dropped)


@pytest.mark.parametrize("slope", SLOPES)
def test_film_matrices_are_exact_on_covered_parts(slope):
    # Edges (0, 1), (1, 2.5) and (2.5, 3): the primary covers 0.25 ... 2.2, node 0 is dropped.
    secondary, primary = pair([0, 1, 2.5, 3], uneven(6, 0.25, 2.2), lambda x: slope * x)
    stretch = np.hypot(1, slope)
    segments = mortar_segments(secondary, primary)
    kept = mask(4, 1, 2)
    x = np.sum(
        covered_shapes(secondary, segments, mask(4, 0, 1, 2, 3))
        * secondary.points[secondary.edges[segments.secondary_edge], 0],
        axis=1,
    )
    for factor, integral in [
        (None, lambda p: p),
        (1 + 2 * x, lambda p: p * np.polynomial.Polynomial([1, 2])),
    ]:

        def exact(p, low, high, integral=integral):
            primitive = integral(p).integ()
            return stretch * (primitive(high) - primitive(low))

        one, t = np.polynomial.Polynomial([1]), np.polynomial.Polynomial([-1 / 1.5, 1 / 1.5])
        mass = np.zeros((4, 4))
        mass[1, 1] = exact(one, 0.25, 1) + exact((1 - t) ** 2, 1, 2.2)
        mass[1, 2] = mass[2, 1] = exact((1 - t) * t, 1, 2.2)
        mass[2, 2] = exact(t**2, 1, 2.2)
        stiffness = np.zeros((4, 4))
        stiffness[1:3, 1:3] = (
            exact(one, 1, 2.2) / (1.5 * stretch) ** 2 * np.array([[1, -1], [-1, 1]])
        )
        found = covered_mass(secondary, segments, kept, factor)
        assert np.allclose(found.toarray(), mass, rtol=0, atol=1e-14)
        found = covered_stiffness(secondary, segments, kept, factor)
        assert np.allclose(found.toarray(), stiffness, rtol=0, atol=1e-13)


def test_film_of_dropped_neighbours_has_the_force_of_a_uniform_pressure():
    # sum(L_f p) = p times the covered length wherever one node of each edge is kept.
    secondary, primary = pair(np.linspace(0, 1, 8), uneven(5, 0.04, 0.81))
    segments = mortar_segments(secondary, primary)
    operator = mortar_operator(secondary, primary, segments, mask(8, 0, 3))
    mass = covered_mass(secondary, segments, operator.kept)
    assert mass.sum() == pytest.approx(0.77, rel=1e-13)
    assert np.abs(covered_stiffness(secondary, segments, operator.kept).sum(axis=1)).max() < 1e-13
    # r_i (L_f 1)_i = int phi_i: what the multipliers' forces D_i (1 + sum_j C_ij) are.
    force = operator.D * (1 + operator.C.sum(axis=1))
    assert np.sum(force[operator.kept]) == pytest.approx(0.77, rel=1e-13)


def two_blocks(comm, n_lower, n_upper, partitioner):
    """Two blocks without shared nodes, inclined; tag 3 on the upper, 4 on the lower one."""
    points, cells = [], []
    for n, bottom in [(n_lower, 0.0), (n_upper, 0.5)]:
        first = sum(map(len, points))
        x, y = np.meshgrid(np.linspace(0, 1, n + 1), bottom + np.linspace(0, 0.5, 4))
        points.append(np.column_stack([x.ravel(), y.ravel() + 0.3 * x.ravel()]))
        at = first + np.arange(x.size).reshape(x.shape)
        a, b, c, d = (q.ravel() for q in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
        cells += [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    points, cells = np.vstack(points), np.vstack(cells).astype(np.int64)
    if comm.rank > 0:
        points, cells = points[:0], cells[:0]
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    mesh = dmesh.create_mesh(comm, cells, element, points, partitioner)
    mesh.topology.create_connectivity(1, 2)
    facets = dmesh.locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[1] - 0.3 * x[0], 0.5))
    mesh.topology.create_connectivity(1, 0)
    first = mesh.topology.connectivity(1, 0).array.reshape(-1, 2)[facets, 0]
    mesh.topology.create_connectivity(0, 2)
    nodes = dmesh.entities_to_geometry(mesh, 0, first).ravel()
    below = mesh.geometry.input_global_indices[nodes] < 4 * (n_lower + 1)
    return mesh, dmesh.meshtags(mesh, 1, facets, np.where(below, 4, 3).astype(np.int32))


@pytest.mark.mpi
@pytest.mark.parametrize("ghosts", ["none", "vertex"])
def test_coupling_of_two_blocks_is_the_serial_one_on_every_rank(ghosts):
    without = dmesh.create_cell_partitioner(dmesh.GhostMode.none, 2)
    partitioner = vertex_ghost_partitioner() if ghosts == "vertex" else without
    operators = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        mesh, tags = two_blocks(comm, 7, 11, partitioner)
        secondary, primary = (
            gather_surface(mesh, tags, tag, name) for tag, name in [(3, "upper"), (4, "lower")]
        )
        segments = mortar_segments(secondary, primary)
        operator = mortar_operator(secondary, primary, segments, mask(12, 0))
        assert mismatch(operator, secondary, primary) < 1e-13
        operators.append(operator)
    here, serial = (dense(operator) for operator in operators)
    assert all(np.array_equal(a, b) for a, b in zip(here, serial, strict=True))
    assert all(np.array_equal(a, MPI.COMM_WORLD.bcast(a)) for a in here)
    assert serial[1].shape == (12, 8) and operators[0].dropped.sum() == 1
