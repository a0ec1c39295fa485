# SPDX-License-Identifier: LGPL-3.0-or-later
"""Triangulations from scratch: shapes that are hard, and shapes that are none."""

import numpy as np
import pytest
from scipy.spatial import Delaunay

from fenicsx_hmcontact.remeshing import TriangulationError, angles, areas, triangulate, verify
from fenicsx_hmcontact.remeshing.edges import Edges
from fenicsx_hmcontact.remeshing.triangulation import (
    canonical,
    directed_edges,
    enclosed_area,
    flip_to_delaunay,
)
from tests.remeshing.helpers import block, inside, loop, star


def fills(points, edges, groups=0):
    """Triangulate, and check what `verify` checks by other means."""
    cells, cell_groups, smallest = triangulate(points, edges, groups)
    assert smallest == angles(points, cells).min()
    size = areas(points, cells)
    assert size.min() > 0.0
    round_off = 1e-15 * np.ptp(points, axis=0).max() ** 2
    assert abs(size.sum() - enclosed_area(points, edges)) <= 1e-12 * size.sum() + round_off
    assert set(cells.ravel()) == set(range(len(points)))
    directed = [tuple(e) for c in cells for e in ((c[0], c[1]), (c[1], c[2]), (c[2], c[0]))]
    assert len(set(directed)) == len(directed)
    alone = {e for e in directed if e[::-1] not in directed}
    given = {tuple(e) for e in edges}
    assert alone == {e for e in given if e[::-1] not in given}
    return cells, cell_groups


def test_a_convex_cloud_gets_the_triangles_of_scipy():
    rng = np.random.default_rng(0)
    outline = star(rng, 25, 0.0)
    points = np.vstack([outline, rng.uniform(-0.6, 0.6, (300, 2))])
    cells, _ = fills(points, loop(0, 25))
    expected = Delaunay(points).simplices.astype(np.int64)
    expected[areas(points, expected) < 0.0] = expected[areas(points, expected) < 0.0][:, ::-1]
    np.testing.assert_array_equal(cells, canonical(expected, np.zeros(len(expected)))[0])


@pytest.mark.parametrize("seed", range(20))
def test_concave_outlines_with_holes_are_filled(seed):
    rng = np.random.default_rng(seed)
    outline, hole = star(rng, 30, 0.5), 0.2 * star(rng, 12, 0.5)[::-1]
    cloud = rng.uniform(-1.0, 1.0, (int(rng.integers(0, 400)), 2))
    cloud = cloud[inside(cloud, outline) & ~inside(cloud, hole)]
    points = np.vstack([outline, hole, cloud])
    fills(points, np.vstack([loop(0, 30), loop(30, 12)]))


def test_an_outline_coarser_than_the_inside_is_kept():
    rng = np.random.default_rng(1)
    outline = np.array([[0, 0], [1, 0], [1, 1], [0.5, 0.05], [0, 1.0]])
    cloud = rng.uniform(0.0, 1.0, (3000, 2))
    fills(np.vstack([outline, cloud[inside(cloud, outline)]]), loop(0, 5))


@pytest.mark.parametrize("thickness", [1e-1, 1e-3, 1e-5, 1e-9])
def test_thin_bodies_are_filled(thickness):
    x = np.linspace(0.0, 1.0, 30)
    top = np.column_stack([x[::-1] + 0.01, np.sin(3.0 * x[::-1]) + thickness])
    points = np.vstack([np.column_stack([x, np.sin(3.0 * x)]), top])
    edges = loop(0, 60)
    if thickness < 1e-2:
        points[30:, 0] -= 0.01
    fills(points, edges)


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-9, 1e-13])
def test_the_faces_of_a_slit_are_not_connected(gap):
    rng = np.random.default_rng(2)
    n = 40
    x = np.linspace(0.2, 0.8, n)
    lens = np.vstack(
        [
            np.column_stack([x, 0.5 + gap * (x - 0.2) * (0.8 - x)]),
            np.column_stack([x[-2:0:-1], np.full(n - 2, 0.5)]),
        ]
    )
    cloud = rng.uniform(0.01, 0.99, (300, 2))
    cloud = cloud[abs(cloud[:, 1] - 0.5) > 0.01]
    points = np.vstack([[[0, 0], [1, 0], [1, 1], [0, 1]], lens, cloud])
    fills(points, np.vstack([loop(0, 4), loop(4, len(lens))]))


def test_boundary_nodes_that_nearly_coincide_are_kept_and_seen():
    points = np.array([[0, 0], [1, 0], [1, 1], [0.5 + 1e-9, 1], [0.5, 1], [0, 1], [0.5, 0.4]])
    fills(points, loop(0, 6))
    *_, smallest = triangulate(points, loop(0, 6))
    assert smallest == pytest.approx(np.degrees(1e-9 / 0.6), rel=1e-6)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
@pytest.mark.parametrize("offset", [0.0, 1e3])
@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_a_grid_is_filled_in_any_place_size_and_direction(scale, offset, turn):
    arrays = block(12)
    edges = Edges.of(arrays.cells, np.zeros(len(arrays.cells), np.int64), arrays.facets)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    points = scale * (arrays.points[:, :2] @ rotation + offset)
    directed, _ = directed_edges(arrays.cells, np.zeros(len(arrays.cells), np.int64), edges)
    cells, _ = fills(points, directed)
    assert len(cells) == len(arrays.cells)


def test_layers_keep_their_groups_and_the_line_between_them():
    arrays = block(10, layers=3)
    groups = arrays.cell_groups.astype(np.int64)
    directed, sides = directed_edges(
        arrays.cells, groups, Edges.of(arrays.cells, groups, arrays.facets)
    )
    x = arrays.points[:, :2]
    cells, cell_groups = fills(x, directed, sides)
    for group in (1, 2, 3):
        expected = areas(x, arrays.cells[groups == group]).sum()
        assert areas(x, cells[cell_groups == group]).sum() == pytest.approx(expected, rel=1e-13)


def test_flips_and_scratch_agree():
    arrays = block(15)
    rng = np.random.default_rng(5)
    x = arrays.points[:, :2] + 0.01 * rng.normal(size=(len(arrays.points), 2))
    x[:, 0] += 0.7 * x[:, 1] ** 2
    groups = np.zeros(len(arrays.cells), np.int64)
    edges = Edges.of(arrays.cells, groups, arrays.facets)
    flipped, flips = flip_to_delaunay(x, arrays.cells, edges)
    assert flips > 100
    scratch, *_ = triangulate(x, directed_edges(arrays.cells, groups, edges)[0])
    np.testing.assert_array_equal(canonical(flipped, groups)[0], scratch)


SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])


@pytest.mark.parametrize(
    ("points", "edges", "message"),
    [
        (SQUARE[:2], loop(0, 2), "2 nodes make no triangle"),
        (np.vstack([SQUARE, [[np.nan, 0.5]]]), loop(0, 4), "node 4 .* is not finite"),
        (SQUARE[::-1], loop(0, 4), "encloses an area of -1"),
        (SQUARE * [1, 0], loop(0, 4), "encloses an area of 0"),
        (np.vstack([SQUARE, [[0.5, 0.5]] * 2]), loop(0, 4), "node 4 .* and node 5 coincide"),
        (np.vstack([SQUARE, [[0.5, 0.0]]]), loop(0, 4), "node 4 .* lies on the edge .* 0 and 1"),
        (np.vstack([SQUARE, [[1.5, 0.5]]]), loop(0, 4), "node 4 .* lies outside of its body"),
        (SQUARE, loop(0, 4)[:3], "encloses|folded or open"),
        (SQUARE, np.vstack([loop(0, 4), [[2, 2]]]), "an edge runs from node 2 .* to itself"),
        (SQUARE, np.vstack([loop(0, 4), [[0, 1]]]), "encloses|occurs twice"),
    ],
)
def test_what_cannot_be_filled_is_named(points, edges, message):
    with pytest.raises(TriangulationError, match=message):
        triangulate(points, edges)


def test_a_folded_boundary_is_refused():
    rng = np.random.default_rng(6)
    for _ in range(20):
        outline = star(rng, 20, 0.3)
        k = int(rng.integers(20))
        outline[k] *= -2.0
        with pytest.raises(TriangulationError, match=r"crosses|lies on|folded|encloses"):
            triangulate(outline, loop(0, 20))


def test_a_hole_that_cuts_the_outline_is_refused():
    hole = np.array([[0.5, 0.5], [0.5, 0.8], [1.5, 0.8], [1.5, 0.5]])
    with pytest.raises(TriangulationError, match="crosses"):
        triangulate(np.vstack([SQUARE, hole]), np.vstack([loop(0, 4), loop(4, 4)]))


def test_verify_refuses_other_triangles():
    cells, groups, _ = triangulate(SQUARE, loop(0, 4))
    edges, beside = loop(0, 4), np.zeros(4, np.int64)
    assert verify(SQUARE, cells, groups, edges, beside) == pytest.approx(45.0, rel=1e-14)
    with pytest.raises(TriangulationError, match="fill"):
        verify(SQUARE, np.array([[0, 1, 2], [0, 2, 3], [0, 1, 3]]), groups, edges, beside)
    with pytest.raises(TriangulationError, match="flat"):
        verify(SQUARE, cells[:, ::-1].copy(), groups, edges, beside)
    with pytest.raises(TriangulationError, match="not the one given"):
        verify(SQUARE, cells, groups, edges, beside + 1)
    with pytest.raises(TriangulationError, match="outside"):
        verify(SQUARE, cells[:1], groups[:1], edges, beside)
