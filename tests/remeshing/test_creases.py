# SPDX-License-Identifier: LGPL-3.0-or-later
"""Creases of a boundary that are filled before it folds onto itself."""

import numpy as np
import pytest

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.domain import MeshArrays
from fenicsx_hmcontact.remeshing import areas, due, remesh, target_sizes, triangulate
from fenicsx_hmcontact.remeshing.bodies import separate
from fenicsx_hmcontact.remeshing.crease import fill_creases
from tests.remeshing.helpers import block, moved

H = 0.125


def creased(depth):
    """A block whose ground has a crease in the middle, with sides that slope by ``depth`` / H."""

    def shift(x, y):
        near = np.maximum(1.0 - np.abs(x - 0.5) / H, 0.0)
        return 0.0 * x, -depth * near * (1.0 + y)

    flat = block(8)
    return moved(flat, shift), target_sizes(flat)


def test_sharp_crease_is_filled_and_booked():
    arrays, sizes = creased(2.0 * H)
    options = hm.Remeshing(fill_creases=60.0)
    angle = 2.0 * np.degrees(np.arctan(0.5))
    ((reason, *_),) = [
        [why for why in found if "crease" in why] for found in due(arrays, sizes, options).values()
    ]
    assert f"sharpest crease {angle:.3g} < 60 degrees" == reason
    result = remesh(arrays, sizes, options)
    after = result.arrays
    assert result.counts["soil"]["filled"] == 1
    # The triangle of the crease, and nothing else.
    gained = areas(after.points, after.cells).sum() - areas(arrays.points, arrays.cells).sum()
    assert result.merges.areas.sum() == pytest.approx(gained, rel=1e-12)
    assert result.merges.areas.max() == pytest.approx(2.0 * H * H, rel=1e-12)
    # The node stays, inside of the body; the edge that covers it is of the same surface.
    node = int(np.argmin(np.hypot(*(arrays.points[:, :2] - [0.5, -2.0 * H]).T)))
    new = int(result.transfer.new_of_old[node])
    assert new >= 0 and not (after.facets == new).any()
    ground = after.facets[after.facet_groups == after.surfaces["ground"]]
    x = np.sort(after.points[ground][:, :, 0], axis=1)
    assert np.abs(x - [0.5 - H, 0.5 + H]).sum(axis=1).min() < 1e-12 or len(ground) >= 8
    again = remesh(after, result.sizes, options)
    assert not again.changed


@pytest.mark.parametrize(("depth", "limit"), [(2.0 * H, 0.0), (2.0 * H, 50.0), (0.5 * H, 60.0)])
def test_blunt_crease_stays(depth, limit):
    arrays, sizes = creased(depth)
    options = hm.Remeshing(fill_creases=limit)
    result = remesh(arrays, sizes, options)
    assert result.counts["soil"].get("filled", 0) == 0
    assert not any(
        "crease" in why for found in due(arrays, sizes, options).values() for why in found
    )


def test_corner_of_two_surfaces_is_no_crease():
    arrays, sizes = creased(2.0 * H)
    ground = arrays.facet_groups == arrays.surfaces["ground"]
    right = arrays.points[arrays.facets].mean(axis=1)[:, 0] > 0.5
    arrays.facet_groups[ground & right] = arrays.surfaces["right"]
    result = remesh(arrays, sizes, hm.Remeshing(fill_creases=60.0))
    assert result.counts["soil"].get("filled", 0) == 0


@pytest.mark.parametrize("value", [-1.0, 91.0])
def test_angles_out_of_range_are_refused(value):
    with pytest.raises(ValueError, match="fill_creases is"):
        hm.Remeshing(fill_creases=value)


def lip(tip):
    """A body with a crease, and a lip beside it whose tip may hang over the crease."""
    low, high = (0.8, 0.0), (1.2, 0.12)
    x = [(0.0, -1.0), (2.0, -1.0), (2.0, 0.6), (1.5, 0.6), tip, high, (1.0, -0.5), low, (0.0, 0.0)]
    points, n = np.pad(np.array(x), ((0, 0), (0, 1))), len(x)
    outline = np.column_stack([np.arange(n), np.roll(np.arange(n), -1)])
    cells, groups, _ = triangulate(points[:, :2], outline, np.ones(n, int))
    tags = np.ones(n, np.int32)
    arrays = MeshArrays(
        points, cells, groups.astype(np.int32), outline, tags, {"soil": 1}, {"ground": 1}
    )
    return separate(arrays, np.ones(n), hm.Remeshing(fill_creases=50.0), None, None)["soil"]


@pytest.mark.parametrize(("tip", "filled"), [((1.25, 0.5), 1), ((0.95, 0.03), 0)])
def test_crease_that_another_part_has_come_into_stays(tip, filled):
    body = lip(tip)
    before = areas(body.points, body.cells).sum()
    assert fill_creases(body) == filled
    after = areas(body.points, body.cells)
    # The triangle of 0.4 m by 0.56 m, less what it leans.
    assert after.min() > 0.0 and after.sum() - before == pytest.approx(0.112 * filled, abs=1e-12)
