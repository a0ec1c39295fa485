# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derivatives of the mortar coupling against finite differences of the coupling itself."""

import time

import numpy as np
import pytest

from fenicsx_hmcontact._kernels.mortar import gauss_points, miss
from fenicsx_hmcontact._kernels.mortar_derivatives import end_derivatives, segment_integrals
from fenicsx_hmcontact.contact.linearisation import geometry_derivatives
from fenicsx_hmcontact.contact.mortar import (
    MortarOptions,
    covered_mass,
    covered_stiffness,
    mortar_operator,
    mortar_segments,
    segment_corners,
)
from fenicsx_hmcontact.contact.surface import Surface


def surface(name, *chains, closed=False, first=0):
    """Surface of chains along given points; global nodes are numbered from ``first``."""
    ends = np.cumsum([len(points) for points in chains])
    following = np.arange(1, ends[-1] + 1)
    following[ends - 1] = ends - [len(points) for points in chains] if closed else -1
    edges = np.column_stack([np.arange(ends[-1]), following])[following >= 0].astype(np.int32)
    ids = np.arange(ends[-1]) + first
    return Surface(name, ids, ids, np.vstack(chains).astype(float), edges)


def uneven(n, start, end, rng):
    parts = rng.uniform(0.5, 1.5, n)
    return start + (end - start) * np.concatenate([[0], np.cumsum(parts)]) / parts.sum()


def over(abscissas, shape):
    return np.column_stack([abscissas, shape(abscissas)])


def pair(n, primary_parts, shape, rng, noise=0.0, gap=0.03):
    """Secondary of n edges over (0, 1) above a primary that covers the given (edges, low, high)."""
    upper = over(uneven(n, 0, 1, rng), shape)
    lower = [over(uneven(k, *span, rng)[::-1], shape) - [0, gap] for k, *span in primary_parts]
    upper, *lower = (p + noise / n * rng.normal(size=p.shape) for p in (upper, *lower))
    return surface("upper", upper), surface("lower", *lower, first=10**6)


def flat(x):
    return 0.0 * x


def slope(x):
    return 0.7 * x


def wavy(x):
    return 0.08 * np.sin(7 * x) + 0.05 * x**2


def ring(n, radius, rng, turn):
    """Closed chain of n nodes; a body inside it for turn 1, around it for turn -1."""
    angle = turn * uneven(n, 0, 2 * np.pi, rng)[:-1]
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def penetrating(secondary, primary, depth=0.035):
    return secondary.at(secondary.points - [0, depth]), primary


def rings(rng):
    disc = surface("disc", ring(9, 1.0, rng, 1), closed=True)
    return disc, surface("hole", ring(14, 1.2, rng, -1), closed=True, first=10**6)


def layered(rng, noise=0.01):
    """A secondary above two thin bodies that hide parts of a third, also in the middle of edges."""
    upper = over(uneven(6, 0, 1, rng), wavy)
    layers = [(7, -0.2, 1.1, 0.12), (5, 0.13, 0.52, 0.05), (2, 0.61, 0.69, 0.02)]
    lower = [over(uneven(k, *span, rng)[::-1], wavy) - [0, gap] for k, *span, gap in layers]
    upper, *lower = (p + noise * rng.normal(size=p.shape) for p in (upper, *lower))
    return surface("upper", upper), surface("lower", *lower, first=10**6)


CASES = {
    "layered": layered,
    "layered, penetrating": lambda rng: penetrating(*layered(rng)),
    "flat": lambda rng: pair(7, [(11, -0.1, 1.1)], flat, rng),
    "flat, noisy": lambda rng: pair(7, [(11, -0.1, 1.1)], flat, rng, noise=0.05),
    "inclined": lambda rng: pair(5, [(13, -0.2, 1.2)], slope, rng),
    "wavy, noisy": lambda rng: pair(8, [(6, -0.1, 1.2)], wavy, rng, noise=0.05),
    "wavy, partial": lambda rng: pair(9, [(11, 0.07, 0.87)], wavy, rng),
    "small coverage at both ends": lambda rng: pair(9, [(11, 0.09, 0.82)], wavy, rng, noise=0.02),
    "primary beyond one end": lambda rng: pair(17, [(5, 0.4, 1.3)], wavy, rng, noise=0.03),
    "penetrating": lambda rng: pair(7, [(12, 0.05, 1.1)], wavy, rng, noise=0.05, gap=-0.02),
    "far": lambda rng: pair(6, [(9, 0.05, 0.9)], wavy, rng, gap=0.2),
    "hole in the coverage": lambda rng: pair(4, [(3, 0.6, 1.1), (5, -0.1, 0.57)], wavy, rng),
    "one edge each": lambda rng: pair(1, [(1, 0.15, 0.8)], slope, rng, noise=0.05),
    "many primary edges": lambda rng: pair(1, [(30, 0.1, 1.1)], flat, rng, noise=0.002),
    "closed": rings,
}
PRESCRIBED = [(), (0, 2, 3)]


@pytest.fixture(params=CASES)
def surfaces(request):
    return CASES[request.param](np.random.default_rng(7))


def mask(n, true):
    return np.isin(np.arange(n), np.arange(n)[[k for k in true if k < n]])


def couple(secondary, primary, prescribed=(), options=MortarOptions()):
    segments = mortar_segments(secondary, primary, options)
    dropped = mask(len(secondary.nodes), prescribed)
    return segments, mortar_operator(secondary, primary, segments, dropped, options)


def derive(secondary, primary, prescribed=(), options=MortarOptions()):
    return geometry_derivatives(
        secondary, primary, *couple(secondary, primary, prescribed, options)
    )


def coordinates(secondary, primary):
    return np.concatenate([secondary.points.ravel(), primary.points.ravel()])


def fields(secondary, primary, rng):
    """Random vectors d_s, d_m and tractions z."""
    return [rng.normal(size=(len(s.nodes), 2)) for s in (secondary, primary, secondary)]


def quantities(operator, normals, d_s, d_m, F):
    """What is differentiated, as arrays: n, D, [I + C, -H], relative, forces by given F."""
    D, H, C, kept = operator.D, operator.H, operator.C, operator.kept
    coupling = np.hstack([np.diag(kept) + C.toarray(), -H.toarray()])
    relative = kept[:, None] * (d_s + C @ d_s - H @ d_m)
    forces = np.concatenate([(C.T @ F).ravel(), -(H.T @ F).ravel()])
    return [normals.ravel(), D, coupling, relative.ravel(), forces]


def derivatives(g, secondary, primary, d_s, d_m, z):
    """Derivatives of the same quantities, as arrays with the coordinate last."""
    n_s, n = len(secondary.nodes), len(secondary.nodes) + len(primary.nodes)
    one = np.eye(n)
    return [
        g.normals.toarray(),
        g.D.toarray(),
        g.relative(one[:n_s], one[n_s:]).toarray().reshape(n_s, n, -1),
        g.relative(d_s, d_m).toarray(),
        g.forces(z).toarray(),
    ]


@pytest.mark.parametrize("prescribed", PRESCRIBED)
def test_derivatives_agree_with_finite_differences(surfaces, prescribed):
    secondary, primary = surfaces
    rng = np.random.default_rng(3)
    d_s, d_m, z = fields(*surfaces, rng)
    segments, operator = couple(*surfaces, prescribed)
    F = operator.D[:, None] * z
    found = derivatives(geometry_derivatives(*surfaces, segments, operator), *surfaces, d_s, d_m, z)
    x, n = coordinates(*surfaces), secondary.points.size
    step = 1e-6 * secondary.lengths.min()
    for k in range(x.size):
        sides = []
        for sign in (1, -1):
            y = x + sign * step * (np.arange(x.size) == k)
            moved = secondary.at(y[:n].reshape(-1, 2)), primary.at(y[n:].reshape(-1, 2))
            other_segments, other = couple(*moved, prescribed)
            assert np.array_equal(other.kept, operator.kept)
            assert np.array_equal(other_segments.primary_edge, segments.primary_edge)
            sides.append(quantities(other, moved[0].normals, d_s, d_m, F))
        for now, plus, minus in zip(found, *sides, strict=True):
            scale = max(np.abs(now).max(initial=0), 1e-300)
            error = np.abs(now[..., k] - (plus - minus) / (2 * step)).max(initial=0)
            assert error <= 1e-6 * scale


def test_cases_contain_what_they_are_meant_to():
    operators = {k: couple(*case(np.random.default_rng(7)))[1] for k, case in CASES.items()}
    small = operators["small coverage at both ends"]
    assert small.C.nnz == 2 and np.sum((small.D > 0) & small.dropped) == 2
    hole = operators["hole in the coverage"]
    assert hole.kept.all() and np.sum(hole.coverage < 1 - 1e-3) == 2
    partial = operators["wavy, partial"]
    assert np.any((partial.coverage > 0.2) & (partial.coverage < 0.45)) and partial.uncovered.any()
    for name in ("layered", "layered, penetrating"):
        surfaces = CASES[name](np.random.default_rng(7))
        segments, _ = couple(*surfaces)
        own = surfaces[1].edges[segments.primary_edge[::3]]
        foreign = ~(segments.end_nodes[..., None] == own[:, None]).any(axis=2)
        assert np.sum(foreign & (segments.end_nodes >= 0)) >= 4
    for name in ("flat", "closed"):
        assert np.allclose(operators[name].coverage, 1, rtol=0, atol=1e-12)


def motions(secondary, primary):
    """Rates of the coordinates: two translations, a rotation and a uniform growth."""
    x, y = coordinates(secondary, primary).reshape(-1, 2).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    rates = [(one, zero), (zero, one), (-y, x), (x, y)]
    return [np.column_stack(rate).ravel() for rate in rates]


@pytest.mark.parametrize("prescribed", PRESCRIBED)
def test_rigid_motion_turns_normals_and_growth_scales_lengths(surfaces, prescribed):
    secondary, _ = surfaces
    d_s, d_m, z = fields(*surfaces, np.random.default_rng(4))
    _, operator = couple(*surfaces, prescribed)
    found = derivatives(derive(*surfaces, prescribed), *surfaces, d_s, d_m, z)
    nx, ny = secondary.normals.T
    values = quantities(operator, secondary.normals, d_s, d_m, 0 * z)
    still = [0 * v for v in values]
    turned = [np.column_stack([-ny, nx]).ravel(), *still[1:]]
    grown = [still[0], values[1], *still[2:]]
    for rate, expected in zip(motions(*surfaces), [still, still, turned, grown], strict=True):
        for derivative, exact in zip(found, expected, strict=True):
            scale = np.abs(derivative).max(initial=0) * np.abs(rate).max()
            assert np.allclose(derivative @ rate, exact, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("prescribed", PRESCRIBED)
def test_forces_balance_and_uniform_vectors_stay(surfaces, prescribed):
    d_s, d_m, z = fields(*surfaces, np.random.default_rng(5))
    g = derive(*surfaces, prescribed)
    rows = g.forces(z)
    scale = np.abs(rows).max()
    for axis in range(2):
        assert np.abs(rows[axis::2].sum(axis=0)).max() <= 1e-13 * scale
    assert np.abs(g.relative(0 * d_s + [2, -3], 0 * d_m + [2, -3])).max() <= 1e-12 * scale
    # No force on kept nodes, no relative vector of dropped ones
    kept = np.repeat(g.operator.kept, 2)
    assert rows[: kept.size][kept].nnz == 0
    assert np.abs(g.relative(d_s, d_m)[~kept]).sum() == 0


def test_relative_and_forces_are_transposed():
    # Both contain the derivative of H and C: z . D relative(d) = d . forces(z).
    secondary, primary = CASES["wavy, partial"](np.random.default_rng(7))
    d_s, d_m, z = fields(secondary, primary, np.random.default_rng(6))
    g = derive(secondary, primary, (0, 3))
    power = (g.operator.D[:, None] * z).ravel() @ g.relative(d_s, d_m)
    assert np.allclose(np.vstack([d_s, d_m]).ravel() @ g.forces(z), power, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("unit", [1024.0, 2.0**-20])
def test_units_do_not_matter(surfaces, unit):
    d_s, d_m, z = fields(*surfaces, np.random.default_rng(5))
    scaled = [s.at(unit * s.points) for s in surfaces]
    found = derivatives(derive(*surfaces, (2,)), *surfaces, d_s, d_m, z)
    other = derivatives(derive(*scaled, (2,)), *scaled, unit * d_s, unit * d_m, z)
    other[0] *= unit
    other[2] *= unit
    for a, b in zip(found, other, strict=True):
        assert np.allclose(a, b, rtol=0, atol=1e-12 * np.abs(a).max(initial=0))


@pytest.mark.parametrize("part", [1e-2, 1e-4, 1e-6])
def test_short_covered_parts_keep_their_digits(part):
    # The primary ends just inside an edge of which both nodes are kept.
    options = MortarOptions(min_coverage=0.0)
    rng = np.random.default_rng(7)
    surfaces = pair(5, [(7, 0.05, 0.6)], slope, rng)
    x = surfaces[0].points[3] + part * (surfaces[0].points[4] - surfaces[0].points[3])
    normal = np.array([-0.7, 1.0])
    points = surfaces[1].points.copy()
    points[0] = x - 0.05 * normal
    surfaces = surfaces[0], surfaces[1].at(points)
    g = derive(*surfaces, (), options)
    operator = g.operator
    assert operator.kept[4] and operator.coverage[4] == pytest.approx(part**2, rel=0.6)
    # Its covered length, of which it has s/2: d(L s^2 / 2) = L s ds
    edge = surfaces[0].points[4] - surfaces[0].points[3]
    end = len(surfaces[0].nodes) * 2
    expected = part * edge / np.linalg.norm(edge)
    assert np.allclose(g.D[[4], end : end + 2].toarray()[0], expected, rtol=1e-5, atol=0)
    # The integrals D_i H_im scale with the unit of length and do not change with rotations.
    _, _, turning, growing = motions(*surfaces)
    n_s, n = len(operator.D), len(operator.D) + len(surfaces[1].nodes)
    one, D = np.eye(n), operator.D[:, None]
    d_H = -g.relative(one[:n_s], one[n_s:]).toarray().reshape(n_s, n, -1)[:, n_s:]
    H = operator.H.toarray()
    M = D[..., None] * d_H + H[..., None] * g.D.toarray()[:, None]
    scale = np.abs(D * H).max()
    assert np.allclose(M @ growing, D * H, rtol=0, atol=1e-10 * scale)
    assert np.abs(M @ turning).max() < 1e-10 * scale


def test_surfaces_that_do_not_meet_have_no_derivatives():
    secondary, primary = CASES["flat"](np.random.default_rng(7))
    g = derive(secondary, primary.at(primary.points - [100, 0]))
    assert g.D.nnz == 0
    assert g.normals.shape == (16, 40) and g.normals.nnz > 0
    assert g.relative(secondary.points, primary.points).nnz == 0
    assert g.forces(secondary.points).shape == (40, 40)


def test_number_of_entries_grows_with_the_surfaces_only():
    # Of many primary edges before one secondary edge, only the first and the last move its ends.
    counts = []
    for n in (100, 200):
        g = derive(*pair(2, [(n, 0.1, 0.9)], flat, np.random.default_rng(1)))
        counts.append([g.integrals.derivatives.nnz, g.forces(np.arange(3.0)[:, None]).nnz])
    assert np.all(np.array(counts[1]) < 2.1 * np.array(counts[0]))


@pytest.mark.parametrize("prescribed", PRESCRIBED)
def test_film_matrices_agree_with_finite_differences(surfaces, prescribed):
    secondary, _ = surfaces
    segments, operator = couple(*surfaces, prescribed)
    values = np.random.default_rng(2).normal(size=len(secondary.nodes))
    g = geometry_derivatives(*surfaces, segments, operator)
    q = g.integrals
    slopes = np.array([-1.0, 1.0]) / q.edge_length[:, None] * operator.kept[q.nodes].all(1)[:, None]
    flow = slopes * np.sum(slopes * values[q.nodes], axis=1, keepdims=True)
    of_length = -flow * (q.length / q.edge_length)[:, None]
    stiffness = g.integral(np.repeat(flow[:, :, None], 2, axis=2), of_length)
    half = q.length / q.edge_length
    places = q.centre[:, None] + np.outer(half, [-1.0, 0.0, 1.0])
    shapes = 0.5 * np.stack([1.0 - places, 1.0 + places], axis=-1)
    kept = operator.kept[q.nodes]
    shapes = np.where(kept.all(axis=1)[:, None, None], shapes, kept[:, None])
    product = shapes * np.einsum("pei,pi->pe", shapes, values[q.nodes])[..., None]
    of_length = half[:, None] * np.einsum("e,pei->pi", [1 / 6, 4 / 6, 1 / 6], product)
    mass = g.integral(product[:, ::2].swapaxes(1, 2), of_length)
    # Where a part has a hole, only functions that are constant over it.
    whole = np.allclose(q.variance, half**2 / 3.0)
    found = [stiffness.toarray(), mass.toarray()][: 1 + whole]
    x, n = coordinates(*surfaces), secondary.points.size
    step = 1e-6 * secondary.lengths.min()
    for k in range(x.size):
        sides = []
        for sign in (1, -1):
            y = x + sign * step * (np.arange(x.size) == k)
            moved = [
                s.at(p.reshape(-1, 2)) for s, p in zip(surfaces, np.split(y, [n]), strict=True)
            ]
            other = mortar_segments(*moved)
            sides.append(
                [
                    integral(moved[0], other, operator.kept) @ values
                    for integral in (covered_stiffness, covered_mass)
                ]
            )
        for now, plus, minus in zip(found, *sides, strict=False):
            error = np.abs(now[:, k] - (plus - minus) / (2 * step)).max()
            assert error <= 1e-6 * max(np.abs(now).max(), 1e-300)


@pytest.mark.parametrize("components", [1, 3])
def test_any_number_of_components(surfaces, components):
    secondary, primary = surfaces
    n_s, n = len(secondary.nodes), len(secondary.nodes) + len(primary.nodes)
    g = derive(secondary, primary, (2,))
    rng = np.random.default_rng(8)
    d, z = rng.normal(size=(n, components)), rng.normal(size=(n_s, components))
    both = np.column_stack([d[:, 0], d[:, -1]])
    of_two = g.relative(both[:n_s], both[n_s:]).toarray()
    forces_of_two = g.forces(np.column_stack([z[:, 0], z[:, -1]])).toarray()
    found, forces = g.relative(d[:n_s], d[n_s:]).toarray(), g.forces(z).toarray()
    assert found.shape == (components * n_s, 2 * n) and forces.shape == (components * n, 2 * n)
    for k, component in [(0, 0), (1, components - 1)]:
        scale = np.abs(of_two).max(initial=0), np.abs(forces_of_two).max(initial=0)
        assert np.abs(found[component::components] - of_two[k::2]).max() <= 1e-13 * scale[0]
        rows = forces[component::components]
        assert np.abs(rows - forces_of_two[k::2]).max() <= 1e-13 * scale[1]


def complex_step(corners, ends, moving, points, centre):
    """Integrals over one segment and their derivatives (Squire and Trapp 1998); (4,), (4, 16)."""
    step = 1e-30 * np.hypot(*(corners[0, 1] - corners[0, 0]))
    columns = []
    for k in range(16):
        moved = np.concatenate([corners, points[None]]).astype(complex)
        moved.ravel()[k] += 1j * step
        at = ends.astype(complex)
        for end in np.flatnonzero(moving):
            own = moved[:3].copy()
            own[2, 0] = moved[3, end]
            c0, c1, c2 = miss(own, 0)
            s = ends[end]
            at[end] -= (c0 + s * (c1 + s * c2)) / (c1 + 2 * s * c2)
        xi, eta, weight = (v[0] for v in gauss_points(moved[None, :3], at[None]))
        shapes = [(1 - eta) / 2, (1 + eta) / 2]
        columns.append([np.sum(weight * f * N) for f in (1, xi - centre) for N in shapes])
    return np.array(columns[0]).real, np.array(columns).imag.T / step


def test_integrals_agree_with_a_complex_step(surfaces):
    secondary, primary = surfaces
    segments, _ = couple(*surfaces)
    edge, primary_edge = segments.secondary_edge[::3], segments.primary_edge[::3]
    corners = segment_corners(secondary, primary, edge, primary_edge)
    ends, moving = segments.ends, segments.end_nodes >= 0
    points = primary.points[np.where(moving, segments.end_nodes, 0)]
    centre = np.random.default_rng(1).uniform(-1, 1, len(ends))
    d_ends = end_derivatives(corners, ends, moving, points)
    values, found = segment_integrals(corners, ends, d_ends, centre)
    for k in range(len(ends)):
        exact, derivative = complex_step(corners[k], ends[k], moving[k], points[k], centre[k])
        assert np.allclose(values[k], exact, rtol=0, atol=1e-14)
        assert np.abs(found[k] - derivative).max() <= 1e-12 * max(1.0, np.abs(derivative).max())


@pytest.mark.benchmark
def test_speed():
    secondary, primary = pair(10000, [(14000, 0.01, 0.99)], wavy, np.random.default_rng(1), gap=0)
    segments, operator = couple(secondary, primary)
    for _ in range(2):
        start = time.process_time()
        g = geometry_derivatives(secondary, primary, segments, operator)
        end = time.process_time()
    entries = g.integrals.derivatives.nnz / 1e4
    print(f"{1e2 * (end - start):.1f} us an edge, {entries:.0f} entries an edge")
