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


def body_of(x, size=1.0, other=None):
    """A body with an outline along points, counterclockwise, and maybe another one."""
    points, cells, edges, groups = [], [], [], []
    for group, outline in enumerate([x] if other is None else [x, other], start=1):
        nodes, first = np.arange(len(outline)), sum(map(len, points))
        around = np.column_stack([nodes, np.roll(nodes, -1)])
        points.append(np.pad(np.array(outline, float), ((0, 0), (0, 1))))
        cells.append(first + triangulate(points[-1][:, :2], around, np.full(len(nodes), group))[0])
        edges.append(first + around)
        groups.append(group)
    points, n_cells, n_edges = np.vstack(points), [*map(len, cells)], [*map(len, edges)]
    names = ("soil", "pile")[: len(groups)]
    arrays = MeshArrays(
        points,
        np.vstack(cells),
        np.repeat(groups, n_cells).astype(np.int32),
        np.vstack(edges),
        np.repeat(groups, n_edges).astype(np.int32),
        {name: i + 1 for i, name in enumerate(names)},
        {f"face of {name}": i + 1 for i, name in enumerate(names)},
    )
    options = hm.Remeshing(fill_creases=50.0)
    return separate(arrays, np.full(len(points), size), options, None, None)["soil"]


def lip(tip):
    """A body with a crease, and a lip beside it whose tip may hang over the crease."""
    low, high = (0.8, 0.0), (1.2, 0.12)
    x = [(0.0, -1.0), (2.0, -1.0), (2.0, 0.6), (1.5, 0.6), tip, high, (1.0, -0.5), low, (0.0, 0.0)]
    return body_of(x, 0.1)


@pytest.mark.parametrize(("tip", "filled"), [((1.25, 0.5), 1), ((0.95, 0.03), 0)])
def test_crease_that_another_part_has_come_into_stays(tip, filled):
    body = lip(tip)
    before = areas(body.points, body.cells).sum()
    assert fill_creases(body) == filled
    after = areas(body.points, body.cells)
    # The triangle of 0.4 m by 0.56 m, less what it leans.
    assert after.min() > 0.0 and after.sum() - before == pytest.approx(0.112 * filled, abs=1e-12)


CREASE = [(0.0, -1.0), (2.0, -1.0), (2.0, 0.0), (1.2, 0.0), (1.0, -0.5), (0.8, 0.0), (0.0, 0.0)]


@pytest.mark.parametrize(
    ("pile", "filled"),
    [
        ([(0.95, -0.2), (1.05, -0.2), (1.05, 0.3), (0.95, 0.3)], 0),
        ([(0.9, 0.1), (1.1, 0.1), (1.1, 0.3), (0.9, 0.3)], 1),
        # Across the crease, no corner of it inside.
        ([(0.5, 0.1), (0.99, -0.4), (1.5, 0.1), (1.5, 0.3), (0.5, 0.3)], 0),
        # Between the flanks, all its corners on them or outside.
        ([(0.9, -0.25), (1.1, -0.25), (1.1, 0.3), (0.9, 0.3)], 0),
        # On both lips; with its tip on one.
        ([(0.7, 0.0), (1.3, 0.0), (1.3, 0.3), (0.7, 0.3)], 1),
        ([(0.8, 0.0), (0.9, 0.3), (0.7, 0.3)], 1),
        # With its tip in the mouth, by less and by more than it may.
        ([(1.0, -0.001), (1.1, 0.3), (0.9, 0.3)], 1),
        ([(1.0, -0.003), (1.1, 0.3), (0.9, 0.3)], 0),
    ],
)
def test_crease_that_another_body_has_come_into_stays(pile, filled):
    assert fill_creases(body_of(CREASE, 0.1, pile)) == filled


def test_crease_narrower_than_what_may_be_in_it_is_filled():
    narrow = [*CREASE[:3], (1.001, 0.0), (1.0, -0.5), (0.999, 0.0), (0.0, 0.0)]
    pile = [(1.0, -0.1), (1.1, 0.3), (0.9, 0.3)]
    assert fill_creases(body_of(narrow, 0.1, pile)) == 1


TRENCH = [(0.0, -1.0), (2.0, -1.0), (2.0, 0.0), (1.05, 0.0), (1.01, -0.1), (0.99, -0.1)]
TRENCH += [(0.95, 0.0), (0.0, 0.0)]


@pytest.mark.parametrize(("size", "filled"), [(0.2, 2), (0.1, 0)])
def test_trench_with_short_edges_is_filled_where_its_mouth_is_narrow(size, filled):
    # No corner of it is sharp: 112 degrees, mouths of 0.11 and then 0.10 m.
    body = body_of(TRENCH, size)
    before = areas(body.points, body.cells).sum()
    assert fill_creases(body) == filled
    gained = areas(body.points, body.cells).sum() - before
    assert gained == pytest.approx(0.006 if filled else 0.0, abs=1e-12)


def test_boundary_that_hardly_turns_is_no_crease_however_short_its_edges():
    flat = [*TRENCH[:3], (1.05, 0.0), (1.01, -0.01), (0.99, -0.01), *TRENCH[6:]]
    assert fill_creases(body_of(flat, 0.2)) == 0
