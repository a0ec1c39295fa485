# SPDX-License-Identifier: LGPL-3.0-or-later
"""Exact orientation, flips and ears against brute force."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.spatial import Delaunay

from fenicsx_hmcontact._kernels.ears import cut_ears
from fenicsx_hmcontact._kernels.predicates import orientation
from fenicsx_hmcontact.remeshing import angles, areas
from fenicsx_hmcontact.remeshing.edges import Edges
from fenicsx_hmcontact.remeshing.triangulation import canonical, flip_to_delaunay
from tests.remeshing.helpers import block

NO_FACETS = np.empty((0, 2), np.int64)


def exact(a, b, c):
    (ax, ay), (bx, by), (cx, cy) = ([Fraction(float(v)) for v in p] for p in (a, b, c))
    return (ax - cx) * (by - cy) - (ay - cy) * (bx - cx)


def sign(value):
    return int(value > 0) - int(value < 0)


def test_the_orientation_of_nearly_collinear_points_is_exact():
    rng = np.random.default_rng(0)
    doubtful = 0
    for _ in range(500):
        a, b = rng.normal(size=(2, 2)) * 10.0 ** rng.integers(-3, 6)
        offset = rng.choice([0.0, 1.0, 1e3])
        a, b = a + offset, b + offset
        c = a + rng.choice([0.25, 0.5, 0.7, 3.0]) * (b - a)
        c[rng.integers(2)] += rng.integers(-2, 3) * np.spacing(c[0])
        naive = (a[0] - c[0]) * (b[1] - c[1]) - (a[1] - c[1]) * (b[0] - c[0])
        doubtful += sign(naive) != sign(exact(a, b, c))
        assert sign(orientation(a, b, c)) == sign(exact(a, b, c))
    assert doubtful > 10


def test_the_orientation_is_twice_the_area():
    a, b, c = np.random.default_rng(1).normal(size=(3, 2))
    assert orientation(a, b, c) == pytest.approx(float(exact(a, b, c)), rel=1e-14)


def sheared(n=12):
    arrays = block(n)
    x = arrays.points[:, :2] + 0.02 * np.random.default_rng(2).normal(size=(len(arrays.points), 2))
    return x + np.column_stack([1.2 * x[:, 1] ** 2, 0.0 * x[:, 1]]), arrays.cells


def flipped(points, cells):
    groups = np.zeros(len(cells), np.int64)
    cells, flips = flip_to_delaunay(points, cells, Edges.of(cells, groups, NO_FACETS))
    return cells, flips


def in_circle(points, cell, node):
    """Exact incircle determinant: positive if the node is inside."""
    rows = []
    for i in cell:
        dx, dy = (Fraction(float(points[i, k])) - Fraction(float(points[node, k])) for k in (0, 1))
        rows.append((dx, dy, dx * dx + dy * dy))
    (a, b, c), (d, e, f), (g, h, i) = rows
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def test_no_inner_edge_has_a_node_in_the_circle_behind_it():
    points, old = sheared()
    cells, flips = flipped(points, old)
    assert flips > 50
    assert areas(points, cells).min() > 0.0
    edges = Edges.of(cells, np.zeros(len(cells), np.int64), NO_FACETS)
    for (one, other), ends in zip(
        edges.cells[~edges.fixed], edges.nodes[~edges.fixed], strict=True
    ):
        beyond = np.setdiff1d(cells[other], ends)[0]
        assert in_circle(points, cells[one], beyond) <= 0
    assert any(
        in_circle(points, cell, node) > 0 for cell in old for node in range(0, len(points), 7)
    )


def test_a_convex_body_gets_the_delaunay_triangulation_of_scipy():
    rng = np.random.default_rng(3)
    angle = np.sort(rng.uniform(0.0, 2 * np.pi, 30))
    points = np.vstack(
        [np.column_stack([np.cos(angle), np.sin(angle)]), 0.6 * rng.uniform(-1.0, 1.0, (200, 2))]
    )
    cells = Delaunay(points).simplices.astype(np.int64)
    cells[areas(points, cells) < 0.0] = cells[areas(points, cells) < 0.0][:, ::-1]
    groups = np.zeros(len(cells), np.int64)
    shrunk = points.copy()
    shrunk[30:] *= 0.4
    other, flips = flipped(shrunk, cells)
    assert flips > 0
    expected = Delaunay(shrunk).simplices.astype(np.int64)
    expected[areas(shrunk, expected) < 0.0] = expected[areas(shrunk, expected) < 0.0][:, ::-1]
    np.testing.assert_array_equal(
        canonical(other, groups)[0], canonical(expected, np.zeros(len(expected)))[0]
    )


def test_nodes_on_a_common_circle_never_flip():
    for scale, turn in ((1e-3, 0.0), (1.0, 0.3), (1e6, 0.7)):
        arrays = block(10)
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        points = scale * (arrays.points[:, :2] @ rotation) + 1e3 * scale
        assert flipped(points, arrays.cells)[1] == 0


def test_flips_in_another_order_of_the_triangles_end_in_the_same_ones():
    points, cells = sheared()
    groups = np.zeros(len(cells), np.int64)
    expected = canonical(flipped(points, cells)[0], groups)[0]
    for seed in range(3):
        rng = np.random.default_rng(seed)
        shuffled = np.roll(rng.permutation(cells), rng.integers(3), axis=1)
        np.testing.assert_array_equal(canonical(flipped(points, shuffled)[0], groups)[0], expected)


def test_flips_open_the_smallest_angle():
    points, cells = sheared()
    assert angles(points, flipped(points, cells)[0]).min() > angles(points, cells).min()


def test_ears_fill_a_polygon():
    rng = np.random.default_rng(4)
    for n in (3, 4, 7, 20):
        angle = np.sort(rng.uniform(0.0, 2 * np.pi, n))
        corners = rng.uniform(0.3, 1.0, (n, 1)) * np.column_stack([np.cos(angle), np.sin(angle)])
        shoelace = (
            0.5
            * np.cross(
                np.column_stack([corners, np.zeros(n)]),
                np.column_stack([np.roll(corners, -1, axis=0), np.zeros(n)]),
            )[:, 2].sum()
        )
        size = areas(corners, cut_ears(corners))
        assert len(size) == n - 2 and size.min() > 0.0
        assert size.sum() == pytest.approx(shoelace, rel=1e-13)


def test_ears_fill_a_square_with_nodes_on_its_sides():
    corners = np.array([[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [0, 2], [0, 1.0]])
    size = areas(corners, cut_ears(corners))
    assert len(size) == 5 and size.min() > 0.0 and size.sum() == 4.0


def test_ears_refuse_what_is_no_polygon():
    clockwise = np.array([[0, 0], [0, 1], [1, 1], [1.0, 0]])
    crossing = np.array([[0, 0], [1, 1], [1, 0], [0, 1.0]])
    assert len(cut_ears(clockwise)) == len(cut_ears(crossing)) == 0
