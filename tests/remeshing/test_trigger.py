# SPDX-License-Identifier: LGPL-3.0-or-later
"""Options, measures of triangles, and what calls for a remesh."""

import numpy as np
import pytest

from fenicsx_hmcontact.remeshing import Quality, Remeshing, angles, areas, due, target_sizes
from fenicsx_hmcontact.remeshing.trigger import reasons
from tests.remeshing.helpers import block, moved

FINE = Quality(1.0, 30.0, 0.9, 1.1, 1.2)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        (dict(smallest_angle=31.0), "smallest_angle is 31"),
        (dict(fire_angle=21.0), "fire_angle is 21"),
        (dict(fire_angle=np.nan), "fire_angle is nan"),
        (dict(shortest_edge=0.0), "shortest_edge is 0"),
        (dict(fire_short_edge=0.6), "fire_short_edge is 0.6"),
        (dict(nearest_to_boundary=-1.0), "nearest_to_boundary is -1"),
        (dict(longest_edge=0.9), "longest_edge is 0.9"),
        (dict(longest_boundary_edge=1.0), "longest_boundary_edge is 1"),
        (dict(fire_edge=1.5), "fire_edge is 1.5"),
        (dict(fire_boundary_edge=1.4), "fire_boundary_edge is 1.4"),
        (dict(fire_area_ratio=(1.1, 2.0)), "fire_area_ratio is"),
        (dict(merge_turn=0.0), "merge_turn is 0"),
        (dict(merge_area=1.0), "merge_area is 1"),
        (dict(rounds=0), "rounds is 0"),
        (dict(every=0), "every is 0"),
        (dict(rule=3), "rule is 3"),
        (dict(size=0.1), "size is 0.1"),
        (dict(keep="base"), "keep is 'base'"),
    ],
)
def test_wrong_options_are_refused_by_name(options, name):
    with pytest.raises(ValueError, match=name):
        Remeshing(**options)


def test_areas_angles_and_sizes_of_a_right_triangle():
    points, cells = np.array([[0, 0], [3, 0], [0, 4.0]]), np.array([[0, 1, 2], [0, 2, 1]])
    np.testing.assert_allclose(areas(points, cells), [6.0, -6.0])
    expected = np.degrees([np.pi / 2, np.arctan2(4, 3), np.arctan2(3, 4)])
    np.testing.assert_allclose(angles(points, cells[:1]), [expected])
    assert angles(points, cells[1:]).max() < 0.0


def test_target_sizes_are_mean_edge_lengths():
    sizes = target_sizes(block(2))
    short, long = 0.5, np.sqrt(0.5)
    # Triangles turn in every square: only every other node has diagonals.
    np.testing.assert_allclose(sizes[[1, 4]], [short, (4 * short + 4 * long) / 8])


@pytest.mark.parametrize(
    ("quality", "words"),
    [
        (Quality(0.0, 30.0, 0.9, 1.1, 1.2), "inverted"),
        (Quality(1.0, 14.9, 0.9, 1.1, 1.2), "smallest angle 14.9 < 15 degrees"),
        (Quality(1.0, 30.0, 0.34, 1.1, 1.2), "shortest edge 0.34 < 0.35 h"),
        (Quality(1.0, 30.0, 0.9, 1.7, 1.2), "longest boundary edge 1.7 > 1.6 h"),
        (Quality(1.0, 30.0, 0.9, 1.1, 2.1), "longest edge 2.1 > 2 h"),
    ],
)
def test_every_limit_fires(quality, words):
    (reason,) = reasons(quality, Remeshing())
    assert words in reason
    assert reasons(FINE, Remeshing()) == []


def test_what_the_last_remesh_left_fires_again_only_when_it_is_worse():
    left = Quality(1.0, 12.0, 0.3, 1.1, 2.5)
    assert len(reasons(left, Remeshing())) == 3
    assert reasons(left, Remeshing(), after_last=left) == []
    worse = Quality(1.0, 10.7, 0.26, 1.1, 2.8)
    assert len(reasons(worse, Remeshing(), after_last=left)) == 3


def test_large_changes_of_area_fire():
    assert reasons(FINE, Remeshing(), area_ratios=np.array([0.6, 1.9])) == []
    (reason,) = reasons(FINE, Remeshing(), area_ratios=np.array([0.6, 2.1]))
    assert "area ratios 0.6 to 2.1" in reason


def test_area_ratios_belong_to_the_triangles_of_their_body():
    arrays = block(4, layers=2)
    ratios = np.where(arrays.cell_groups == 2, 3.0, 1.0)
    assert set(due(arrays, target_sizes(arrays), Remeshing(), area_ratios=ratios)) == {"layer_2"}


def test_every_n_steps_and_the_rule_of_the_user():
    arrays = block(6)
    sizes = target_sizes(arrays)
    fired = [due(arrays, sizes, Remeshing(every=3), step=step) for step in range(1, 7)]
    assert [bool(f) for f in fired] == [False, False, True] * 2
    assert fired[2] == {"soil": ["every 3 steps"]}
    rule = Remeshing(rule=lambda mesh: len(mesh.points) == 49)
    assert due(arrays, sizes, rule) == {"soil": ["the rule says so"]}


def test_what_a_remesh_may_not_change_does_not_fire():
    arrays = moved(block(10), lambda x, y: (0.0 * x, -0.85 * y * (x < 0.05)))
    sizes = target_sizes(block(10))
    assert "shortest edge" in str(due(arrays, sizes, Remeshing()))
    held = np.ones(len(sizes), bool)
    reasons_left = due(arrays, sizes, Remeshing(), held=held).get("soil", [])
    assert not any("short" in r or "boundary" in r for r in reasons_left)


def test_the_angle_of_a_corner_does_not_fire():
    arrays = moved(block(1), lambda x, y: (8.0 * x, 0.0 * y))
    assert angles(arrays.points, arrays.cells).min() < 10.0
    wedge = np.array([[0, 0, 0], [1, 0, 0], [1, 0.1, 0.0]])
    corner = type(arrays)(
        wedge,
        np.array([[0, 1, 2]]),
        np.ones(1, np.int32),
        np.empty((0, 2), np.int64),
        np.empty(0, np.int32),
        {"soil": 1},
    )
    assert due(corner, np.full(3, 1.0), Remeshing()) == {}
