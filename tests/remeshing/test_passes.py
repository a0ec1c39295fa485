# SPDX-License-Identifier: LGPL-3.0-or-later
"""Whole remeshes: identity, booked areas, angles and sizes, surfaces, determinism."""

from dataclasses import replace

import numpy as np
import pytest

from fenicsx_hmcontact.domain.mesh_arrays import check
from fenicsx_hmcontact.remeshing import (
    Remeshing,
    TriangulationError,
    angles,
    areas,
    due,
    remesh,
    target_sizes,
)
from tests.remeshing.helpers import block, body_area, flow_past_footing, moved


def distorted(n=20, seed=0):
    """A block after shear and waves that bend its sides and turn its corners."""
    rng = np.random.default_rng(seed)
    k, phase = rng.normal(size=(2, 2)) * 3.0, rng.uniform(0.0, 6.0, 2)
    arrays = block(n)
    sizes = target_sizes(arrays)

    def shift(x, y):
        waves = [np.cos(k[i, 0] * x + k[i, 1] * y + phase[i]) for i in (0, 1)]
        return 0.6 * y**2 + 0.06 * waves[0], 0.3 * x * y + 0.06 * waves[1]

    return moved(arrays, shift), sizes


def assert_same(one, other):
    for name in ("points", "cells", "cell_groups", "facets", "facet_groups"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("seed", range(4))
def test_remeshing_again_changes_nothing(seed):
    first = remesh(*distorted(seed=seed), Remeshing())
    assert first.changed and first.unsettled == []
    again = remesh(first.arrays, first.sizes, Remeshing())
    assert again.arrays is first.arrays and again.sizes is first.sizes
    assert not again.changed
    values = np.random.default_rng(0).normal(size=(len(first.sizes), 3))
    assert again.transfer(values).tobytes() == values.tobytes()


def test_a_mesh_that_is_fine_stays_the_same_object():
    arrays = block(8)
    result = remesh(arrays, target_sizes(arrays), Remeshing())
    assert result.arrays is arrays and not result.changed


def test_the_result_does_not_depend_on_the_order_of_the_triangles():
    arrays, sizes = distorted()
    rng = np.random.default_rng(1)
    order = rng.permutation(len(arrays.cells))
    other = replace(
        arrays, cells=arrays.cells[order][:, [1, 2, 0]], cell_groups=arrays.cell_groups[order]
    )
    one, two = (remesh(a, sizes, Remeshing()) for a in (arrays, other))
    assert_same(one.arrays, two.arrays)
    assert (one.transfer.matrix != two.transfer.matrix).nnz == 0


@pytest.mark.parametrize("seed", range(4))
def test_angles_open_and_sizes_come_near_the_target(seed):
    arrays, sizes = distorted(seed=seed)
    result = remesh(arrays, sizes, Remeshing())
    assert angles(arrays.points, arrays.cells).min() < 20.0
    assert angles(result.arrays.points, result.arrays.cells).min() >= 18.0
    assert areas(result.arrays.points, result.arrays.cells).min() > 0.0
    assert due(result.arrays, result.sizes, Remeshing()) == {}


def test_merges_book_their_area():
    arrays, sizes = distorted(40)
    result = remesh(arrays, 2.5 * sizes, Remeshing(merge_area=0.05))
    assert len(result.merges.areas) == result.counts["soil"]["merged"] > 10
    assert abs(result.merges.areas).sum() > 1e-5
    change = body_area(result.arrays) - body_area(arrays)
    assert abs(change - result.merges.areas.sum()) <= 1e-12 * body_area(arrays)
    np.testing.assert_allclose(
        result.merges.weights @ arrays.points[:, :2], result.merges.places, atol=1e-13
    )


def test_without_merges_the_area_stays():
    arrays, sizes = distorted()
    result = remesh(arrays, 0.6 * sizes, Remeshing())
    assert result.counts["soil"]["split"] > 10 and result.counts["soil"]["inserted"] > 50
    assert body_area(result.arrays) == pytest.approx(body_area(arrays), rel=1e-13)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.5])
def test_surfaces_keep_their_facets_on_the_boundary(factor):
    arrays, sizes = distorted(24)
    result = remesh(arrays, factor * sizes, Remeshing())
    new = result.arrays
    check(new, "remeshed", {})
    edges = np.sort(new.cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    ends, count = np.unique(edges, axis=0, return_counts=True)
    np.testing.assert_array_equal(np.unique(np.sort(new.facets, axis=1), axis=0), ends[count == 1])
    for name, tag in new.surfaces.items():
        before, after = (
            np.linalg.norm(np.diff(a.points[a.facets[a.facet_groups == tag]], axis=1), axis=2).sum()
            for a in (arrays, new)
        )
        if name != "base":
            assert after == pytest.approx(before, rel=2e-2)


def test_old_nodes_keep_their_order_and_new_ones_come_last():
    arrays, sizes = distorted()
    # Nodes go where the body is to be coarser, and come where it is to be finer.
    result = remesh(arrays, sizes * np.where(arrays.points[:, 1] > -0.5, 1.8, 0.6), Remeshing())
    transfer = result.transfer
    n = len(transfer.kept)
    assert (np.diff(transfer.kept) > 0).all()
    assert result.arrays.points[:n].tobytes() == arrays.points[transfer.kept].tobytes()
    assert len(result.arrays.points) - n == transfer.weights.shape[0] > 0
    new = transfer.new_of_old
    np.testing.assert_array_equal(new[transfer.kept], np.arange(n))
    assert (new >= 0).sum() == n < len(arrays.points)


def test_new_nodes_are_convex_combinations_of_old_ones():
    arrays, sizes = distorted()
    result = remesh(arrays, 0.5 * sizes, Remeshing())
    weights = result.transfer.weights
    assert weights.shape[0] > 200
    assert weights.data.min() >= 0.0
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-14)
    x, y = arrays.points[:, :2].T
    linear = np.column_stack([1.0 + 0.0 * x, 2.0 + 3.0 * x - y, x])
    new_x, new_y = result.arrays.points[:, :2].T
    expected = np.column_stack([1.0 + 0.0 * new_x, 2.0 + 3.0 * new_x - new_y, new_x])
    np.testing.assert_allclose(result.transfer(linear), expected, atol=1e-13)
    np.testing.assert_allclose(result.transfer.matrix @ linear, expected, atol=1e-13)


def test_values_of_kept_nodes_stay_bit_for_bit():
    arrays, sizes = distorted()
    result = remesh(arrays, sizes, Remeshing())
    history = np.random.default_rng(2).normal(size=(len(arrays.points), 4, 3))
    history[3] = -0.0
    carried = result.transfer(history)
    assert carried.shape == (len(result.arrays.points), 4, 3)
    kept = result.transfer.kept
    assert carried[: len(kept)].tobytes() == history[kept].tobytes()


def test_held_nodes_and_surfaces_stay():
    arrays, sizes = distorted()
    held = np.zeros(len(sizes), bool)
    held[::5] = True
    result = remesh(arrays, 1.7 * sizes, Remeshing(keep=("left", "ground")), held=held)
    new = result.arrays
    for name in ("left", "ground"):
        tag = arrays.surfaces[name]
        before, after = (a.points[a.facets[a.facet_groups == tag]] for a in (arrays, new))
        np.testing.assert_array_equal(np.sort(before, axis=0), np.sort(after, axis=0))
    assert (result.transfer.new_of_old[held] >= 0).all()
    assert result.counts["soil"]["removed"] > 10


def test_a_size_of_the_users_refines():
    arrays = block(10)
    sizes = target_sizes(arrays)
    options = Remeshing(size=lambda x: 0.02 + 0.3 * np.hypot(*x.T))
    result = remesh(arrays, sizes, options)
    new = result.arrays
    assert result.unsettled == []
    assert angles(new.points, new.cells).min() >= 20.0
    corner = np.flatnonzero((new.points[new.cells] == 0.0).all(axis=2).any(axis=1))
    assert areas(new.points, new.cells[corner]).max() < 0.02**2
    with pytest.raises(ValueError, match="size must give a positive length"):
        remesh(arrays, sizes, Remeshing(size=lambda x: 0.0 * x[:, 0]))


@pytest.mark.parametrize("scale", [1e-3, 1e6])
def test_units_do_not_matter(scale):
    arrays, sizes = distorted()
    one = remesh(arrays, sizes, Remeshing())
    two = remesh(replace(arrays, points=scale * arrays.points), scale * sizes, Remeshing())
    np.testing.assert_array_equal(one.arrays.cells, two.arrays.cells)
    np.testing.assert_allclose(scale * one.arrays.points, two.arrays.points, rtol=1e-12)


def test_an_inverted_triangle_is_triangulated_from_scratch():
    arrays = block(8)
    sizes = target_sizes(arrays)
    node = int(np.argmin(np.linalg.norm(arrays.points - [0.5, -0.5, 0.0], axis=1)))
    arrays.points[node, :2] += 0.2
    assert areas(arrays.points, arrays.cells).min() < 0.0
    result = remesh(arrays, sizes, Remeshing())
    assert result.counts["soil"]["from scratch"] == 1
    assert angles(result.arrays.points, result.arrays.cells).min() >= 20.0
    assert body_area(result.arrays) == pytest.approx(1.0, rel=1e-13)


def test_a_folded_body_is_refused_by_name():
    arrays = block(8)
    arrays.points[int(np.argmax(arrays.points[:, 0] - arrays.points[:, 1]))] = [-0.5, 0.3, 0.0]
    with pytest.raises(TriangulationError, match=r"body 'soil': .* crosses"):
        remesh(arrays, np.full(81, 0.15), Remeshing())


@pytest.mark.parametrize("every_step", [False, True])
def test_a_footing_sinks_half_its_width(every_step):
    arrays = block(24, width=6.0, height=6.0, base=1.0)
    options = Remeshing(keep=("base",))
    sizes, after_last, remeshes = target_sizes(arrays), None, 0
    h = sizes.max()
    start = len(sizes)
    for _ in range(25):
        shift = 0.04 * flow_past_footing(arrays)
        arrays = moved(arrays, lambda x, y, shift=shift: shift.T)
        if every_step or due(arrays, sizes, options, after_last=after_last):
            area = body_area(arrays)
            result = remesh(arrays, sizes, options)
            arrays, sizes, after_last = result.arrays, result.sizes, result.quality
            remeshes += result.changed
            assert result.unsettled == []
            assert not remesh(arrays, sizes, options).changed
            assert angles(arrays.points, arrays.cells).min() >= 18.0
            assert abs(body_area(arrays) - area - result.merges.areas.sum()) <= 1e-12 * area
            assert due(arrays, sizes, options, after_last=after_last) == {}
        assert areas(arrays.points, arrays.cells).min() > 0.0
    assert remeshes >= 2
    assert abs(len(arrays.points) - start) < 0.05 * start
    assert sizes.max() <= h
    x, y = arrays.points[:, :2].T
    assert x.min() == 0.0 and x.max() == 6.0 and y.min() == -6.0
    base = arrays.facets[arrays.facet_groups == arrays.surfaces["base"]]
    np.testing.assert_allclose(arrays.points[base][..., 1], -1.0, atol=1e-12)
