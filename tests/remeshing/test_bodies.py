# SPDX-License-Identifier: LGPL-3.0-or-later
"""Several bodies in one mesh, and bodies of several layers."""

import numpy as np
import pytest

from fenicsx_hmcontact.domain.mesh_arrays import check
from fenicsx_hmcontact.remeshing import Remeshing, angles, areas, due, remesh, target_sizes
from tests.remeshing.helpers import block, moved, side_by_side

LAYERS = {"ground": ["layer_1", "layer_2", "layer_3"]}


def shear(x, y):
    return 0.9 * y**2 + 0.03 * np.sin(7.0 * x), 0.03 * np.cos(5.0 * x)


def touching():
    """Two sheared bodies, one on the other."""
    lower, upper = block(12), block(9)
    upper.points[:, 1] += 1.0
    both = side_by_side(lower, upper)
    sizes = target_sizes(both)
    points = both.points[:, :2]
    # Both faces of the joint stay on the line y = 0.
    return moved(both, lambda x, y: (0.9 * y**2, 0.03 * y * np.sin(6.0 * x))), sizes, points


def layered():
    arrays = block(18, layers=3)
    return moved(arrays, shear), target_sizes(arrays)


def test_touching_bodies_are_never_triangulated_together():
    arrays, sizes, _ = touching()
    result = remesh(arrays, sizes, Remeshing())
    assert all(result.counts[name]["flips"] > 0 for name in ("soil_0", "soil_1"))
    new = result.arrays
    check(new, "remeshed", {})
    one, two = (np.unique(new.cells[new.cell_groups == tag]) for tag in (1, 2))
    assert np.intersect1d(one, two).size == 0
    assert new.points[one, 1].max() <= 1e-12 and new.points[two, 1].min() >= -1e-12


def test_each_body_is_remeshed_as_if_it_were_alone():
    arrays, sizes, _ = touching()
    both = remesh(arrays, sizes, Remeshing())
    lower = remesh(arrays, sizes, Remeshing(), names=["soil_0"])
    assert not any(lower.counts["soil_1"].values())
    untouched = arrays.cells[arrays.cell_groups == 2]
    for result in (both, lower):
        cells = result.arrays.cells[result.arrays.cell_groups == 1]
        x = result.arrays.points[cells]
        expected = lower.arrays.points[lower.arrays.cells[lower.arrays.cell_groups == 1]]
        np.testing.assert_array_equal(
            np.sort(x.mean(axis=1), axis=0), np.sort(expected.mean(axis=1), axis=0)
        )
    np.testing.assert_array_equal(
        lower.arrays.cells[lower.arrays.cell_groups == 2], lower.transfer.new_of_old[untouched]
    )


def test_only_the_body_in_need_is_due():
    arrays, sizes, straight = touching()
    lower = np.unique(arrays.cells[arrays.cell_groups == 1])
    arrays.points[lower, :2] = straight[lower]
    assert set(due(arrays, sizes, Remeshing())) == {"soil_1"}


def test_layers_keep_the_line_between_them():
    arrays, sizes = layered()
    result = remesh(arrays, sizes, Remeshing(), layers=LAYERS)
    new = result.arrays
    check(new, "remeshed", LAYERS)
    assert result.counts["ground"]["flips"] > 50
    assert angles(new.points, new.cells).min() >= 18.0
    for tag in (1, 2, 3):
        before, after = (
            areas(a.points, a.cells[a.cell_groups == tag]).sum() for a in (arrays, new)
        )
        booked = result.merges.areas[result.merges.groups == tag].sum()
        assert abs(after - before - booked) <= 1e-12 * before


def test_lines_between_layers_are_halved_and_merged():
    arrays, sizes = layered()
    for factor, operation in ((0.5, "split"), (2.5, "merged")):
        result = remesh(arrays, factor * sizes, Remeshing(), layers=LAYERS)
        assert result.counts["ground"][operation] > 20
        new = result.arrays
        lines = [
            np.intersect1d(*(np.unique(a.cells[a.cell_groups == tag]) for tag in (1, 2))).size
            for a in (arrays, new)
        ]
        assert lines[1] > 1.5 * lines[0] if factor < 1.0 else lines[1] < 0.8 * lines[0]
        again = remesh(new, result.sizes, Remeshing(), layers=LAYERS)
        assert not again.changed


def test_merges_between_layers_cancel():
    arrays, sizes = layered()
    merges = remesh(arrays, 2.5 * sizes, Remeshing(), layers=LAYERS).merges
    inner = np.array([np.sum((merges.places == place).all(axis=1)) == 2 for place in merges.places])
    assert inner.sum() >= 4
    assert abs(merges.areas[inner]).max() > 0.0
    assert abs(merges.areas[inner].sum()) <= 1e-16


def test_unknown_names_are_refused():
    arrays = block(4)
    sizes = target_sizes(arrays)
    with pytest.raises(ValueError, match="unknown body 'sand'; known: soil"):
        remesh(arrays, sizes, Remeshing(), names=["sand"])
    with pytest.raises(ValueError, match="keep names the surface 'lid'; known: bottom"):
        remesh(arrays, sizes, Remeshing(keep=("lid",)))
