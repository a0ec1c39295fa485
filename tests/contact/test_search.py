# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which parts of surfaces find each other: search, nearest part, sliding off, self contact."""

import numpy as np
import pytest

from fenicsx_hmcontact.contact import mortar
from fenicsx_hmcontact.contact.linearisation import geometry_derivatives
from fenicsx_hmcontact.contact.mortar import (
    MortarOptions,
    candidate_pairs,
    mortar_operator,
    mortar_segments,
    sees_only_backs,
)
from fenicsx_hmcontact.contact.surface import Surface

ANY = MortarOptions(search_radius=np.inf)


def surface(name, *chains, first=0):
    """Surface of chains along given points; global nodes are numbered from ``first``."""
    ends = np.cumsum([len(points) for points in chains])
    begins = np.delete(np.arange(ends[-1]), ends - 1)
    edges = np.column_stack([begins, begins + 1]).astype(np.int32)
    ids = np.arange(ends[-1]) + first
    return Surface(name, ids, ids, np.vstack(chains).astype(float), edges)


def level(abscissas, height=0.0):
    abscissas = np.asarray(abscissas, dtype=float)
    return np.column_stack([abscissas, np.full(len(abscissas), height)])


def lower(*chains):
    """Primary surface of chains given from left to right, their bodies below."""
    return surface("lower", *(np.asarray(points)[::-1] for points in chains), first=1000)


def uneven(n, start, end, rng):
    parts = rng.uniform(0.3, 1.7, n)
    return start + (end - start) * np.concatenate([[0], np.cumsum(parts)]) / parts.sum()


def curved(abscissas, height=0.0):
    return level(abscissas, height) + np.column_stack(
        [0 * abscissas, 0.08 * np.sin(7 * abscissas) + 0.05 * abscissas**2]
    )


def all_pairs(secondary, primary, search_radius):
    shape = len(secondary.edges), len(primary.edges)
    return np.indices(shape).reshape(2, -1).T


def same(a, b):
    names = ["secondary_edge", "primary_edge", "xi", "eta", "weight", "ends", "end_nodes"]
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


def checked(secondary, primary, options=MortarOptions()):
    """Segments and coupling, of which everything is finite and rows of H - C sum to one."""
    segments = mortar_segments(secondary, primary, options)
    operator = mortar_operator(secondary, primary, segments, options=options)
    assert np.all(segments.ends[:, 1] - segments.ends[:, 0] >= 1e-10)
    assert np.all(segments.weight > 0) and np.isfinite(segments.eta).all()
    assert operator.coverage.max() < 1 + 1e-9
    rows = (operator.H.sum(axis=1) - operator.C.sum(axis=1))[operator.kept]
    assert np.allclose(rows, 1, rtol=0, atol=1e-12)
    return segments, operator


# --- search ------------------------------------------------------------------------------------


def beside_long_ones(n):
    """Parts of the same length as the whole at both ends, n short ones between them."""
    return np.concatenate([[-2, -1], np.linspace(0, 1, n + 1), [2, 3]])


def graded(n):
    """Parts that grow with the distance from 0, by 40 % over ten of them at the finest."""
    return np.sinh(np.linspace(-np.log(n), np.log(n), 2 * n))


@pytest.mark.parametrize("abscissas", [beside_long_ones, graded])
def test_number_of_candidates_grows_linearly(abscissas):
    counts = []
    for n in (200, 400, 800):
        x = abscissas(n)
        secondary = surface("upper", level(x))
        primary = lower(level(x + 0.3 * np.gradient(x), -1e-3 * np.diff(x).min()))
        found = candidate_pairs(secondary, primary, 5.0)
        segments = mortar_segments(secondary, primary)
        assert segments.weight.sum() > 0.9 * (x[-1] - x[0])
        counts.append([len(found), len(segments.ends)])
    assert np.all(np.array(counts[1:]) <= 2.1 * np.array(counts[:-1]))


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("radius", [0.5, 5.0])
def test_segments_are_those_of_all_pairs(monkeypatch, seed, radius):
    rng = np.random.default_rng(seed)
    a, b = rng.integers(3, 40, 2)
    upper = curved(np.sort(np.append(rng.uniform(-1, 1, a) ** 3, [-1.5, 1.6])))
    below = curved(np.sort(np.append(rng.uniform(-1, 1, b) ** 3, [-1.4, 1.3])), -0.1)
    noise = 0.002 * rng.normal(size=upper.shape)
    secondary, primary = surface("upper", upper + noise), lower(below)
    options = MortarOptions(search_radius=radius)
    found = mortar_segments(secondary, primary, options)
    assert len(candidate_pairs(secondary, primary, radius)) < len(all_pairs(secondary, primary, 1))
    monkeypatch.setattr(mortar, "candidate_pairs", all_pairs)
    assert same(found, mortar_segments(secondary, primary, options))


@pytest.mark.parametrize("unit", [1.0, 1024.0])
def test_search_radius_counts_the_longer_of_two_edges(unit):
    # Edges of 0.1 and 1 look 0.3 and 3 far, however long the others of their surface are.
    secondary = surface("upper", unit * level(np.append(np.linspace(0, 1, 11), 2)))
    options = MortarOptions(search_radius=3.0)
    for gap, covered in [(0.29, 2.0), (0.31, 1.0), (2.9, 1.0), (3.1, 0.0)]:
        primary = lower(unit * level(np.append(np.linspace(0, 1, 11), 2), -gap))
        segments = mortar_segments(secondary, primary, options)
        assert segments.weight.sum() == pytest.approx(unit * covered, rel=1e-12)


@pytest.mark.parametrize("angle", [20.0, 50.0, 80.0])
def test_edges_at_a_larger_angle_do_not_face_each_other(angle):
    below = level(np.linspace(0.0, 1.0, 11))
    turn = np.radians(angle)
    secondary = surface("upper", level(np.linspace(0.3, 0.5, 5), 0.6))
    turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    primary = lower((below - (0.5, 0.0)) @ turned + np.array([0.4, 0.0]))
    for limit, seen in ((angle - 0.1, False), (angle + 0.1, True)):
        options = MortarOptions(search_radius=20.0, largest_angle=limit)
        assert bool(mortar_segments(secondary, primary, options).weight.size) == seen
        # Where they are said to be seen, their own angle does not count.
        for turned_back in (primary, lower(below)):
            found = mortar_segments(secondary, primary, options, (secondary, turned_back))
            assert bool(found.weight.size) == (seen or turned_back is not primary)


@pytest.mark.parametrize("angle", [0.0, 90.1, np.nan])
def test_refuses_angles(angle):
    with pytest.raises(ValueError, match="largest_angle"):
        MortarOptions(largest_angle=angle)


# --- the nearest part --------------------------------------------------------------------------


def nearest_edge(x, n, primary):
    """Primary edge whose front the line from x along n meets nearest to x; -1 for none."""
    best, least = -1, np.inf
    for k, (tangent, edge) in enumerate(zip(primary.tangents, primary.edges, strict=True)):
        if n @ [-tangent[1], tangent[0]] >= 0:
            continue
        y1, y2 = primary.points[edge]
        r, distance = np.linalg.solve(np.column_stack([y2 - y1, n]), x - y1)
        if 0 <= r <= 1 and abs(distance) < least:
            best, least = k, abs(distance)
    return best


def layers(rng):
    """A secondary above a curved surface, two thin bodies between them."""
    upper = curved(uneven(12, 0, 1, rng))
    below = [(14, -0.2, 1.1, -0.15), (8, 0.13, 0.52, -0.08), (9, 0.4, 0.9, -0.03)]
    chains = [curved(uneven(k, *span, rng), height) for k, *span, height in below]
    upper, *chains = (p + 0.002 * rng.normal(size=p.shape) for p in (upper, *chains))
    return surface("upper", upper), lower(*chains)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("depth", [0.0, 0.04])
def test_every_point_sees_the_nearest_edge(seed, depth):
    rng = np.random.default_rng(seed)
    secondary, primary = layers(rng)
    secondary = secondary.at(secondary.points - [0, depth])
    segments, _ = checked(secondary, primary, ANY)
    edges, other = segments.secondary_edge[::3], segments.primary_edge[::3]
    hidden = 0
    for k, edge in enumerate(secondary.edges):
        here = np.flatnonzero(edges == k)
        for s in rng.uniform(-1, 1, 60):
            if np.abs(segments.ends[here] - s).min(initial=1) < 1e-6:
                continue
            N = np.array([1 - s, 1 + s]) / 2
            n = N @ secondary.normals[edge]
            exact = nearest_edge(N @ secondary.points[edge], n / np.hypot(*n), primary)
            found = here[(segments.ends[here, 0] < s) & (s < segments.ends[here, 1])]
            assert other[found].tolist() == [exact] * (exact >= 0)
            hidden += exact >= 14
    assert hidden > 100


def test_thin_body_hides_what_lies_behind_it():
    secondary = surface("upper", level(np.linspace(0, 1, 5)))
    behind, front = level(np.linspace(-0.1, 1.1, 8), -0.1), level([0.2, 0.3, 0.6], -0.05)
    primary = lower(behind, front)
    segments, operator = checked(secondary, primary)
    assert np.allclose(operator.coverage, 1, rtol=0, atol=1e-14)
    x = secondary.points[secondary.edges[segments.secondary_edge[::3], 0], 0]
    low, high = (x[:, None] + (1 + segments.ends) / 8).T
    on_front = segments.primary_edge[::3] >= 7
    assert on_front.any() and np.all(on_front == ((low + high > 0.4) & (low + high < 1.2)))
    # A uniform traction passes on to the lengths that are seen.
    forces = operator.H.T @ operator.D
    assert np.isclose(forces[8:].sum(), 0.4, rtol=1e-13)
    assert np.isclose(forces[:8].sum(), 0.6, rtol=1e-13)
    # Primary nodes number from the right; the front ends where its neighbour takes over.
    cut = segments.end_nodes[~on_front]
    assert {8, 10} <= set(cut.ravel().tolist())


def test_order_of_chains_does_not_matter():
    secondary, _ = layers(np.random.default_rng(0))
    parts = [
        curved(np.linspace(-0.2, 1.1, 8), -0.15),
        curved(np.linspace(0.13, 0.52, 6), -0.08),
    ]
    _, one = checked(secondary, lower(*parts))
    _, other = checked(secondary, lower(*parts[::-1]))
    assert np.allclose(one.D, other.D, rtol=1e-14, atol=0)
    swapped = np.roll(one.H.toarray(), 6, axis=1)
    assert np.allclose(other.H.toarray(), swapped, rtol=0, atol=1e-13)


@pytest.mark.parametrize("depth", [-0.02, 0.0, 1e-12, 0.01, 0.04])
def test_corner_that_penetrates_keeps_its_flank(depth):
    # A secondary block with a corner at (0.55, 0) above a shelf 0.1 thick, over a floor.
    secondary = surface("block", [[0, 0], [0.2, 0], [0.4, 0], [0.55, 0], [0.55, 0.3], [0.55, 0.6]])
    shelf = [[0.7, -0.1], [0.7, 0.0], [0.35, 0.0], [-0.2, 0.0]]
    floor = level([1.3, 0.4, -0.4], -0.11)
    primary = surface("shelf and floor", shelf, floor, first=1000)
    secondary = secondary.at(secondary.points - [0, depth])
    segments, operator = checked(secondary, primary)
    bottom = segments.secondary_edge < 3
    assert np.isin(segments.primary_edge[bottom], [1, 2]).all()
    assert np.allclose(operator.coverage[:3], 1, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(10))
def test_single_coverage_is_left_alone(monkeypatch, seed):
    rng = np.random.default_rng(seed)
    secondary = surface("upper", curved(uneven(9, 0, 1, rng)))
    primary = lower(curved(uneven(13, -0.1, 0.8, rng), -0.03))
    found = mortar_segments(secondary, primary)
    monkeypatch.setattr(mortar, "_nearest", lambda edge, _, *ends: (np.arange(len(edge)), *ends))
    assert same(found, mortar_segments(secondary, primary))


# --- sliding off the end -----------------------------------------------------------------------


def exact_lengths(x, low, high):
    """Integrals of the shape functions of nodes x over an interval."""

    def primitive(t):
        values = []
        for i, xi in enumerate(x):
            known = np.eye(len(x))[i]
            nodes = np.unique(np.concatenate([x[(x < t)], [np.clip(t, x[0], x[-1]), x[0]]]))
            values.append(np.trapezoid(np.interp(nodes, x, known), nodes))
        return np.array(values)

    return primitive(high) - primitive(low)


POSITIONS = np.concatenate(
    [
        np.random.default_rng(4).uniform(-1.2, 1.2, 30),
        [k / 6 + e for k in range(-6, 7) for e in (0, 1e-16, -1e-16, 1e-12, -1e-12, 1e-9, -1e-9)],
    ]
)


@pytest.mark.parametrize("nodes", [(6, 6), (6, 11), (13, 4)])
@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_surfaces_slide_off_each_other_and_back(nodes, slope):
    s, m = (np.linspace(0, 1, n + 1) for n in nodes)
    direction = np.array([1.0, slope])
    stretch = np.hypot(1.0, slope)
    for p in POSITIONS:
        upper = surface("upper", (s + p)[:, None] * direction)
        below = lower(m[:, None] * direction)
        for secondary, primary, x, other in [(upper, below, s + p, m), (below, upper, m, s + p)]:
            segments, operator = checked(secondary, primary)
            exact = stretch * exact_lengths(x, *np.clip([other[0], other[-1]], x[0], x[-1]))
            exact = exact[::-1] if secondary is below else exact
            assert np.abs(operator.D - exact).max() < 2e-10
            certain = np.abs(operator.coverage - 0.2) > 1e-9
            assert np.all((operator.kept == (operator.coverage > 0.2))[certain])
            known = operator.H @ primary.points - operator.C @ secondary.points
            assert np.abs((known - secondary.points)[operator.kept]).max(initial=0) < 1e-12
            g = geometry_derivatives(secondary, primary, segments, operator)
            assert np.isfinite(g.D.data).all() and np.isfinite(g.integrals.derivatives.data).all()
            assert np.isfinite(g.relative(secondary.points, primary.points).data).all()


@pytest.mark.parametrize("nodes", [(6, 6), (5, 11)])
def test_coupling_follows_a_slide_continuously(nodes):
    s, m = (np.linspace(0, 1, n + 1) for n in nodes)
    primary = lower(curved(m, -0.01))
    step = 1e-8
    for p in [k / 6 for k in range(-5, 6)] + list(np.random.default_rng(5).uniform(-1, 1, 40)):
        states = [
            checked(surface("upper", curved(s) + np.array([p + move, 0.0])), primary)[1]
            for move in (-step, 0.0, step)
        ]
        for one, other in [states[:2], states[1:]]:
            assert np.abs(one.D - other.D).max() < 3 * step
            if np.array_equal(one.kept, other.kept):
                assert np.abs(one.H - other.H).max() < 1e3 * step
                assert np.abs(one.C - other.C).max() < 1e3 * step
            else:
                changed = one.kept != other.kept
                assert np.abs(one.coverage[changed] - 0.2).max() < 1e-5


@pytest.mark.parametrize("apart", [0.0, 1e-14, 0.1])
def test_surfaces_that_share_no_length(apart):
    secondary = surface("upper", level([0, 0.5, 1]))
    primary = lower(level([1 + apart, 1.5, 2]))
    segments, operator = checked(secondary, primary)
    assert len(segments.ends) == 0 and operator.uncovered.all() and operator.H.nnz == 0
    g = geometry_derivatives(secondary, primary, segments, operator)
    assert g.D.nnz == 0 and g.forces(np.ones((3, 2))).nnz == 0


def test_round_body_that_touches_in_one_point_is_seen_in_its_shadow_only():
    angle = np.linspace(-2.6, -0.5, 8)
    disc = surface("disc", np.column_stack([np.cos(angle), 1 + np.sin(angle)]))
    ground = lower(level(np.linspace(-3, 3, 13)))
    for secondary, primary in [(disc, ground), (ground, disc)]:
        segments, operator = checked(secondary, primary, ANY)
        assert operator.coverage.max() > 0.99 and operator.kept.any()
    shadow = disc.points[-1, 0] - disc.points[0, 0]
    assert segments.weight.sum() == pytest.approx(shadow, rel=1e-12)


# --- surfaces the wrong way round --------------------------------------------------------------


@pytest.mark.parametrize("shape", [level, curved])
def test_bodies_on_the_same_side_are_recognised(shape):
    upper, below = shape(np.linspace(0, 1, 8)), shape(np.linspace(-0.1, 1.2, 6), -0.1)
    secondary, primary = surface("upper", upper), lower(below)
    turned = surface("turned", upper[::-1]), surface("turned", below, first=1000)
    assert not sees_only_backs(secondary, primary)
    assert sees_only_backs(turned[0], primary) and sees_only_backs(secondary, turned[1])
    # Bodies that overlap still face each other, as do those that were both turned.
    assert not sees_only_backs(*turned)
    assert not sees_only_backs(secondary.at(secondary.points - [0, 0.15]), primary)
    # What is too far away does not count.
    far = turned[1].at(turned[1].points - [0, 100])
    assert not sees_only_backs(secondary, far) and sees_only_backs(secondary, far, ANY)


def test_body_in_a_hole_faces_it():
    angle = np.linspace(0, 2 * np.pi, 41)[:-1]
    around = np.column_stack([np.cos(angle), np.sin(angle)])
    edges = np.column_stack([np.arange(40), np.roll(np.arange(40), -1)]).astype(np.int32)
    ids = np.arange(40)
    disc = Surface("disc", ids, ids, around, edges)
    hole = Surface("hole", ids + 99, ids, 1.05 * around[::-1], edges)
    larger = Surface("larger", ids + 99, ids, 1.05 * around, edges)
    for options in (MortarOptions(), ANY):
        assert not sees_only_backs(disc, hole, options)
        assert not sees_only_backs(hole, disc, options)
        assert sees_only_backs(disc, larger, options)


# --- self contact ------------------------------------------------------------------------------


def divided(points, at, closed):
    """Two surfaces of a chain that share node ``at``, and node 0 where the chain is closed."""
    ids = np.arange(len(points))
    halves = ids[: at + 1], np.append(ids[at:], ids[: int(closed)])
    result = []
    for name, nodes in zip(["first", "second"], halves, strict=True):
        edges = np.column_stack([np.arange(len(nodes) - 1), np.arange(1, len(nodes))])
        result.append(
            Surface(name, nodes, nodes, np.asarray(points)[nodes], edges.astype(np.int32))
        )
    return result


def coupled_neighbours(secondary, primary, segments):
    """How many segments couple edges that share a node."""
    s = secondary.nodes[secondary.edges[segments.secondary_edge[::3]]]
    m = primary.nodes[primary.edges[segments.primary_edge[::3]]]
    return np.sum((s[:, :, None] == m[:, None]).any(axis=(1, 2)))


def slot(opening, n=6, m=4):
    """Flanks of a V-shaped slot with its tip at 0, open to the top: right one, left one."""
    sine, cosine = np.sin(opening / 2), np.cos(opening / 2)
    right = np.linspace(1, 0, m + 1)[:, None] * [sine, cosine]
    left = np.linspace(0, 1, n + 1)[1:, None] * [-sine, cosine]
    return divided(np.vstack([right, left]), m, closed=False)


@pytest.mark.parametrize("opening", [1.4, 0.8, 0.1, 1e-6, 0.0, -1e-12, -1e-6, -0.01, -0.1])
def test_flanks_of_a_slot_see_each_other_across_it(opening):
    for secondary, primary in [slot(opening), slot(opening)[::-1]]:
        segments, operator = checked(secondary, primary, ANY)
        tip = np.isin(secondary.nodes, primary.nodes)
        assert tip.sum() == 1 and operator.dropped[tip].all()
        # A point at r from the tip looks straight across, at r / cos(opening) from it.
        seen = np.cos(opening)
        assert segments.weight.sum() == pytest.approx(seen, rel=1e-12)
        x = np.hypot(*secondary.points.T)
        exact = exact_lengths(np.sort(x), 0, seen)
        exact = exact if x[0] < x[-1] else exact[::-1]
        assert np.allclose(operator.D, exact, rtol=0, atol=1e-12)
        assert operator.kept.any()


def test_slot_closes_without_jump():
    before = None
    for opening in [1e-4, 1e-8, 1e-14, 0.0, -1e-14, -1e-8, -1e-4]:
        secondary, primary = slot(opening)
        _, operator = checked(secondary, primary)
        assert operator.kept.sum() == 4
        if before is not None:
            assert np.abs(operator.D - before.D).max() < 2e-8
            assert np.abs(operator.H - before.H).max() < 1e-3
        before = operator


def test_flat_continuation_and_wide_slots_are_not_coupled():
    for opening in (np.pi / 2 + 1e-3, 2.5, np.pi):
        for secondary, primary in [slot(opening), slot(opening)[::-1]]:
            segments, operator = checked(secondary, primary, ANY)
            assert len(segments.ends) == 0 and operator.uncovered.all()


@pytest.mark.parametrize("number", [4, 5, 8, 31])
@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_halves_of_a_round_cavity_see_each_other_across_it(number, turn):
    angle = turn - 2 * np.pi * np.arange(number) / number
    points = np.column_stack([np.cos(angle), np.sin(angle)])
    for secondary, primary in [divided(points, number // 2, closed=True)]:
        segments, operator = checked(secondary, primary, ANY)
        assert coupled_neighbours(secondary, primary, segments) == 0
        assert np.array_equal(operator.dropped, np.isin(secondary.nodes, primary.nodes))
        assert operator.coverage.min() > 1 - 1e-12


def test_square_cavity_is_seen_across():
    side = np.arange(4.0)
    points = np.vstack([level(side) @ [[0, 1], [1, 0]], level(side, 4), [[4, 4]]])
    points = np.vstack([points, points[1:-1] @ -np.eye(2) + 4]) @ [[0.6, 0.8], [-0.8, 0.6]]
    secondary, primary = divided(points, 8, closed=True)
    segments, operator = checked(secondary, primary, ANY)
    assert len(points) == 16 and coupled_neighbours(secondary, primary, segments) == 0
    assert operator.kept.sum() == 7 and np.allclose(operator.coverage, 1, rtol=0, atol=1e-12)


@pytest.mark.parametrize("angle", [0.4, 0.8, 1.5])
def test_flanks_of_a_wedge_do_not_see_each_other_through_the_body(angle):
    # A wedge of the body points up at its tip 0, where two surfaces meet, each one edge long.
    sine, cosine = np.sin(angle / 2), np.cos(angle / 2)
    points = np.array([[sine, -cosine], [0.0, 0.0], [-sine, -cosine]])
    for secondary, primary in [divided(points, 1, closed=False)]:
        for pair in [(secondary, primary), (primary, secondary)]:
            segments, _ = checked(*pair, ANY)
            assert len(segments.ends) == 0
        # Without the node in common they are two bodies that overlap.
        apart = Surface("apart", primary.nodes + 99, primary.nodes, primary.points, primary.edges)
        assert len(mortar_segments(secondary, apart, ANY).ends) > 0
