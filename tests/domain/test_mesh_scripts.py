# SPDX-License-Identifier: LGPL-3.0-or-later
import importlib

from mpi4py import MPI

import numpy as np
import pytest

from fenicsx_hmcontact._compat import cell_nodes
from fenicsx_hmcontact.domain import Domain
from meshes.block import block
from meshes.cooks_membrane import cooks_membrane
from meshes.embedded_footing import embedded_footing
from meshes.excavated_slope import excavated_slope
from meshes.footing_over_cavity import footing_over_cavity
from meshes.hertz import hertz
from meshes.patch import patch_blocks
from meshes.sliding import sliding_blocks
from meshes.two_blocks import two_blocks

pytestmark = pytest.mark.mpi

COMM = MPI.COMM_WORLD


def corners(domain, name):
    """Corners of all cells of a body on all ranks; shape (num_cells, 3, 2)."""
    mine = domain.mesh.geometry.x[cell_nodes(domain.mesh)[domain.cells(name)], :2]
    return np.concatenate(COMM.allgather(mine))


def area(domain, name):
    edge = np.diff(corners(domain, name), axis=1)
    return 0.5 * np.linalg.det(edge).sum()


def end_nodes(domain, name):
    """End nodes of the facets of a surface on this rank; shape (num_facets, 2)."""
    mesh = domain.mesh
    mesh.topology.create_connectivity(1, 0)
    mesh.topology.create_connectivity(0, 2)
    vertices = mesh.topology.connectivity(1, 0).array.reshape(-1, 2)[domain.facets(name)]
    node_of_vertex = np.zeros(len(mesh.geometry.x), dtype=np.int64)
    node_of_vertex[mesh.topology.connectivity(2, 0).array] = cell_nodes(mesh).ravel()
    return node_of_vertex[vertices]


def ends(domain, name):
    """End points of the facets of a surface on all ranks; shape (num_facets, 2, 2)."""
    mine = domain.mesh.geometry.x[end_nodes(domain, name), :2]
    return np.concatenate(COMM.allgather(mine))


def numbers(domain, nodes):
    """Numbers that local nodes, and those of all ranks, have in the input."""
    mine = domain.mesh.geometry.input_global_indices[nodes].ravel()
    return np.unique(np.concatenate(COMM.allgather(mine)))


def length(domain, name):
    return np.linalg.norm(np.diff(ends(domain, name), axis=1), axis=2).sum()


def common_places(domain, first, second):
    """Points of the nodes that two surfaces have in common; shape (num_nodes, 2)."""
    common = np.intersect1d(
        *(numbers(domain, end_nodes(domain, name)) for name in (first, second)), assume_unique=True
    )
    here = np.isin(domain.mesh.geometry.input_global_indices, common)
    mine = domain.mesh.geometry.x[here, :2]
    return np.unique(np.concatenate(COMM.allgather(mine)), axis=0)


def along(domain, name, axis=0):
    """Coordinates of the nodes of a surface along an axis, ascending."""
    return np.unique(ends(domain, name)[..., axis].round(13))


def smallest_angle(domain):
    """Smallest angle of all triangles [degrees]."""
    cells = np.concatenate([corners(domain, name) for name in domain.body_names])
    one, other = np.roll(cells, 1, axis=1) - cells, np.roll(cells, -1, axis=1) - cells
    sine = np.abs(one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0])
    return np.degrees(np.arctan2(sine, (one * other).sum(axis=2))).min()


@pytest.mark.parametrize("unstructured", [False, True])
def test_block_fills_its_rectangle(unstructured):
    domain = block(COMM, width=2.0, height=0.5, across=6, rows=3, unstructured=unstructured)
    assert area(domain, "block") == pytest.approx(1.0, rel=1e-13)
    assert [length(domain, name) for name in ("bottom", "left")] == pytest.approx([2.0, 0.5])
    nodes = np.unique(corners(domain, "block").reshape(-1, 2).round(12), axis=0)
    assert nodes.min(axis=0) == pytest.approx([0.0, 0.0]) and nodes.max() == 2.0
    if not unstructured:
        assert len(nodes) == 7 * 4
    with pytest.raises(ValueError, match="rows must be positive"):
        block(COMM, rows=0)


def test_rows_of_the_blocks_are_horizontal():
    domain = two_blocks(COMM)
    for name, first, columns in (("lower", 0.0, 20), ("upper", 0.5, 32)):
        cells = corners(domain, name)
        nodes = np.unique(cells.reshape(-1, 2).round(12), axis=0)
        assert len(nodes) == 21 * (columns + 1)
        rows = first + np.arange(21) / 40
        distance = np.abs(cells[..., 1].reshape(-1, 1) - rows).min(axis=1)
        assert distance.max() < 1e-15
        # All diagonals one way: every cell has one, and all have the same direction.
        edges = (np.roll(cells, 1, axis=1) - cells).reshape(-1, 2)
        diagonal = edges[(np.abs(edges) > 1e-9).all(axis=1)]
        assert len(diagonal) == len(cells)
        assert len(np.unique(np.sign(diagonal.prod(axis=1)))) == 1


def test_single_block_has_the_outer_surfaces_only():
    domain = two_blocks(COMM, width=2.0, height=3.0, upper=6, rows=4, single=True)
    assert domain.body_names == ["block"]
    assert set(domain.surfaces) == {"bottom", "top", "left", "right"}
    assert len(corners(domain, "block")) == 2 * 6 * 8
    assert area(domain, "block") == pytest.approx(6.0, rel=1e-14)
    assert length(domain, "left") == pytest.approx(3.0, rel=1e-14)


@pytest.mark.parametrize("unstructured", [False, True])
@pytest.mark.parametrize("tilt", [-30.0, 0.0, 40.0])
def test_tilted_interface_lies_on_its_line(tilt, unstructured):
    domain = two_blocks(COMM, lower=5, upper=8, rows=6, tilt=tilt, unstructured=unstructured)
    slope = np.tan(np.radians(tilt))
    for name, count in (("interface_lower", 5), ("interface_upper", 8)):
        points = ends(domain, name)
        assert len(points) == count
        line = 0.5 + slope * (points[..., 0] - 0.25)
        np.testing.assert_allclose(points[..., 1], line, rtol=0, atol=1e-14)
    assert area(domain, "lower") == pytest.approx(0.25, rel=1e-13)
    assert area(domain, "upper") == pytest.approx(0.25, rel=1e-13)


@pytest.mark.parametrize("unstructured", [False, True])
@pytest.mark.parametrize("cells", [1, 5, 16])
def test_cooks_membrane_has_its_shape(cells, unstructured):
    domain = cooks_membrane(COMM, cells=cells, unstructured=unstructured)
    assert area(domain, "membrane") == pytest.approx(0.5 * (44 + 16) * 48, rel=1e-13)
    left, right = ends(domain, "left"), ends(domain, "right")
    assert len(left) == cells
    assert length(domain, "left") == pytest.approx(44.0, rel=1e-14)
    assert length(domain, "right") == pytest.approx(16.0, rel=1e-13)
    assert np.abs(left[..., 0]).max() == 0.0
    assert np.abs(right[..., 0] - 48.0).max() < 1e-13
    assert length(domain, "other") == pytest.approx(np.hypot(48, 44) + np.hypot(48, 16), rel=1e-13)
    if not unstructured:
        assert len(corners(domain, "membrane")) == 2 * cells**2


def test_unstructured_membrane_has_one_cell_size():
    cells = corners(cooks_membrane(COMM, cells=16), "membrane")
    edges = np.linalg.norm(np.roll(cells, 1, axis=1) - cells, axis=2)
    assert 0.5 < edges.min() / (44 / 16)
    assert edges.max() / (44 / 16) < 1.6


@pytest.mark.parametrize("jitter", [0.0, 0.16])
@pytest.mark.parametrize("slope", [-0.4, 0.0, 0.7])
def test_patch_blocks(slope, jitter):
    domain = patch_blocks(COMM, slope=slope, jitter=jitter, rows=3)
    counts = {name: len(ends(domain, name)) for name in domain.surfaces}
    sides = {f"{side}_{block}": 3 for side in ("left", "right") for block in ("lower", "upper")}
    assert counts == {
        "bottom": 11,
        "top": 7,
        "interface_lower": 11,
        "interface_upper": 7,
    } | dict(sides)
    for name in ("interface_lower", "interface_upper"):
        points = ends(domain, name)
        line = 0.5 + slope * (points[..., 0] - 0.5)
        np.testing.assert_allclose(points[..., 1], line, rtol=0, atol=1e-14)
        assert domain.body_of_surface(name) == name.removeprefix("interface_")
    assert area(domain, "lower") == pytest.approx(0.5, rel=1e-13)
    assert area(domain, "upper") == pytest.approx(0.5, rel=1e-13)
    assert length(domain, "left_lower") == pytest.approx(0.5 - 0.5 * slope, rel=1e-13)


def test_jitter_moves_inner_nodes_only_and_follows_the_seed():
    still, moved, again, other = (
        np.unique(corners(domain, "upper").reshape(-1, 2).round(12), axis=0)
        for domain in (
            patch_blocks(COMM, slope=0.3),
            patch_blocks(COMM, slope=0.3, jitter=0.1),
            patch_blocks(COMM, slope=0.3, jitter=0.1),
            patch_blocks(COMM, slope=0.3, jitter=0.1, seed=1),
        )
    )
    np.testing.assert_array_equal(moved, again)
    assert not np.array_equal(moved, other)
    kept = {tuple(point) for point in still} & {tuple(point) for point in moved}
    assert len(kept) == 2 * (7 + 4)
    assert len(still) - len(kept) == 6 * 3


@pytest.mark.parametrize("half_width", [0.1, 0.4, 1.0])
def test_hertz_disc_lies_on_its_circle_and_touches_in_one_node(half_width):
    R, disc_size, plane_size = 8.0, 0.1 * half_width, 0.15 * half_width
    domain = hertz(
        COMM, half_width=half_width, disc_size=disc_size, plane_size=plane_size, growth=0.2
    )
    assert domain.body_names == ["disc", "block"]
    assert area(domain, "block") == pytest.approx(2 * R * R, rel=1e-12)
    assert area(domain, "disc") == pytest.approx(0.5 * np.pi * R**2, rel=5e-3)
    for name, body, size in (
        ("disc_contact", "disc", disc_size),
        ("plane_contact", "block", plane_size),
    ):
        assert domain.body_of_surface(name) == body
        assert length(domain, name) == pytest.approx(3.0 * half_width, rel=1e-3)
        assert len(ends(domain, name)) == round(3.0 * half_width / size)
        # A node at the point of contact
        assert np.linalg.norm(ends(domain, name), axis=2).min() < 1e-12
    distance = np.linalg.norm(ends(domain, "disc_contact") - (0.0, R), axis=2)
    np.testing.assert_allclose(distance, R, rtol=1e-12)
    np.testing.assert_allclose(ends(domain, "plane_contact")[..., 1], 0.0, atol=1e-14)
    assert length(domain, "top") == length(domain, "bottom") == pytest.approx(2 * R, rel=1e-12)


def test_hertz_cells_are_fine_at_the_contact_only():
    domain = hertz(COMM)
    for body, size in (("disc", 0.04), ("block", 0.05)):
        cells = corners(domain, body)
        edges = np.linalg.norm(np.roll(cells, 1, axis=1) - cells, axis=2).max(axis=1)
        distance = np.linalg.norm(cells.mean(axis=1), axis=1)
        assert edges[distance < 0.6].max() < 1.8 * size
        assert np.all(edges < 2.0 * (size + 0.1 * np.maximum(distance - 0.5, 0.0)))
        assert edges[distance > 6.0].min() > 0.3
        assert 1000 < len(np.unique(cells.reshape(-1, 2).round(9), axis=0)) < 3000
    # Nodes on the axis, so that the disc can be kept upright
    nodes = np.unique(corners(domain, "disc").reshape(-1, 2).round(9), axis=0)
    assert np.count_nonzero((np.abs(nodes[:, 0]) < 1e-8) & (nodes[:, 1] > 4.0)) >= 5


@pytest.mark.parametrize(
    ("make", "options", "word"),
    [
        (two_blocks, {"rows": 0}, "rows"),
        (two_blocks, {"width": -1.0}, "width"),
        (two_blocks, {"tilt": 80.0}, "tilt"),
        (two_blocks, {"tilt": 5.0, "single": True}, "tilt"),
        (cooks_membrane, {"cells": 0}, "cells"),
        (patch_blocks, {"secondary": 0}, "secondary"),
        (patch_blocks, {"slope": 1.0}, "slope"),
        (patch_blocks, {"jitter": 0.2}, "jitter"),
        (hertz, {"radius": 0.0}, "radius"),
        (hertz, {"half_width": 3.0}, "half_width"),
        (hertz, {"plane_size": 0.5}, "plane_size"),
        (hertz, {"growth": -0.1}, "growth"),
        (footing_over_cavity, {"h": 0.0}, "^h must"),
        (footing_over_cavity, {"h_corner": 0.2}, "h_corner"),
        (footing_over_cavity, {"growth": -0.1}, "growth"),
        (footing_over_cavity, {"half_width": 6.0}, "half_width"),
        (footing_over_cavity, {"cavity_half_width": 5.0}, "cavity_half_width"),
        (footing_over_cavity, {"cavity_depth": 0.1}, "cavity_depth"),
        (footing_over_cavity, {"cavity_depth": 6.0}, "cavity_depth"),
        (embedded_footing, {"ratio": 0.0}, "ratio"),
        (embedded_footing, {"h_corner": 0.6}, "h_corner"),
        (embedded_footing, {"growth": -0.1}, "growth"),
        (embedded_footing, {"half_width": 6.0}, "half_width"),
        (embedded_footing, {"height": 6.0}, "height"),
        (embedded_footing, {"chamfer": 1.0}, "chamfer"),
        (excavated_slope, {"height": -1.0}, "height"),
        (excavated_slope, {"h_fine": 3.0}, "h_fine"),
        (excavated_slope, {"growth": -0.1}, "growth"),
        (excavated_slope, {"slope_angle": 90.0}, "slope_angle"),
        (excavated_slope, {"slope_height": 50.0}, "slope_height"),
        (excavated_slope, {"crest": 110.0}, "crest"),
        (excavated_slope, {"cut_start": 54.5}, "cut_start"),
        (excavated_slope, {"cut_end": 35.0}, "cut_end"),
        (excavated_slope, {"cut_angle": 20.0}, "cut_angle"),
        (excavated_slope, {"cut_angle": 20.0, "cut_end": 72.0}, "cut_angle"),
        (excavated_slope, {"cut_angle": 60.0}, "cut_angle"),
    ],
)
def test_wrong_arguments_are_refused_by_name(make, options, word):
    with pytest.raises(ValueError, match=word):
        make(COMM, **options)


@pytest.mark.parametrize("amplitude", [0.0, 0.02])
def test_sliding_block_lies_on_the_waves(amplitude):
    domain = sliding_blocks(
        COMM,
        width=0.7,
        height=0.4,
        base_width=2.4,
        base_height=0.3,
        start=0.4,
        rows=3,
        amplitude=amplitude,
        period=0.8,
    )
    for name, count, left, right in (("block_bottom", 7, 0.4, 1.1), ("base_top", 23, 0.0, 2.4)):
        points = ends(domain, name)
        assert len(points) == count
        wave = amplitude * np.cos(2 * np.pi * points[..., 0] / 0.8)
        np.testing.assert_allclose(points[..., 1], wave, rtol=0, atol=1e-14)
        across = np.unique(points[..., 0].round(12))
        np.testing.assert_allclose(across, np.linspace(left, right, count + 1), atol=1e-12)
        assert domain.body_of_surface(name) == name.split("_")[0]
    for name, y in (("block_top", 0.4), ("base_bottom", -0.3)):
        np.testing.assert_allclose(ends(domain, name)[..., 1], y, rtol=0, atol=1e-14)
    x = np.linspace(0.4, 1.1, 8)
    y = amplitude * np.cos(2 * np.pi * x / 0.8)
    assert area(domain, "block") == pytest.approx(0.28 - np.trapezoid(y, x), rel=1e-12)
    assert len(corners(domain, "base")) == 2 * 23 * 4


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"height": 0.0}, "height"),
        ({"primary": 0}, "primary"),
        ({"start": 1.2}, "start"),
        ({"amplitude": 0.5}, "amplitude"),
    ],
)
def test_sliding_blocks_refuse_wrong_arguments_by_name(options, word):
    with pytest.raises(ValueError, match=word):
        sliding_blocks(COMM, **options)


@pytest.mark.parametrize("h", [0.3, 0.15])
def test_footing_stands_above_a_lens(h):
    domain = footing_over_cavity(COMM, h=h)
    assert domain.body_names == ["soil", "footing"]
    lengths = dict.fromkeys(["footing_left", "footing_right"], 1.5)
    lengths |= dict.fromkeys(["footing_base", "footing_top", "cavity_lower"], 2.0)
    lengths |= dict(ground=12.0, bottom=12.0, left=6.0, right=6.0)
    assert set(domain.surfaces) == {*lengths, "cavity_upper"}
    for name, expected in lengths.items():
        assert length(domain, name) == pytest.approx(expected, rel=1e-12)
    x = along(domain, "cavity_upper")
    np.testing.assert_allclose(x, np.linspace(-1.0, 1.0, len(x)), atol=1e-13)
    aperture = np.sqrt(25.0 - x**2) - 2.0 * np.sqrt(6.0)
    assert aperture.max() == pytest.approx(0.101, abs=1e-4)
    lens = np.trapezoid(aperture, x)
    assert area(domain, "soil") == pytest.approx(72.0 - lens, rel=1e-13)
    assert area(domain, "footing") == pytest.approx(3.0, rel=1e-13)
    for name, above in (("cavity_upper", aperture), ("cavity_lower", 0.0 * aperture)):
        points = ends(domain, name)
        expected = np.interp(points[..., 0], x, above) - 2.0
        np.testing.assert_allclose(points[..., 1], expected, rtol=0, atol=1e-14)
    tips = common_places(domain, "cavity_upper", "cavity_lower")
    np.testing.assert_array_equal(tips, [[-1.0, -2.0], [1.0, -2.0]])
    assert len(common_places(domain, "ground", "footing_base")) == 0
    assert smallest_angle(domain) > 25.0


@pytest.mark.parametrize("options", [{}, {"h_corner": 0.05}, {"matching": True}])
def test_footing_over_cavity_is_symmetric(options):
    domain = footing_over_cavity(COMM, **options)
    for name in ("soil", "footing"):
        cells = corners(domain, name)
        places, nodes = np.unique(cells.reshape(-1, 2), axis=0, return_inverse=True)
        mirrored, images = np.unique(places * (-1.0, 1.0), axis=0, return_inverse=True)
        np.testing.assert_array_equal(mirrored, places)
        cells = np.sort(nodes.reshape(-1, 3), axis=1)
        copied = np.sort(images.reshape(-1)[cells], axis=1)
        np.testing.assert_array_equal(np.unique(copied, axis=0), np.unique(cells, axis=0))
        assert np.count_nonzero(places[:, 0] == 0.0) > 5
    for name in ("ground", "bottom", "cavity_upper", "cavity_lower", "footing_base"):
        np.testing.assert_array_equal(along(domain, name), -along(domain, name)[::-1])
    half = footing_over_cavity(COMM, half=True, **options)
    assert length(half, "axis") == pytest.approx(1.5 + 6.0 - (5.0 - 2.0 * np.sqrt(6.0)), rel=1e-12)
    assert area(half, "soil") == pytest.approx(0.5 * area(domain, "soil"), rel=1e-12)
    assert len(corners(half, "soil")) == 0.5 * len(corners(domain, "soil"))
    assert set(domain.surfaces) - set(half.surfaces) == {"left", "footing_left"}


def test_matching_faces_have_nodes_at_the_same_places():
    for matching in (False, True):
        domain = footing_over_cavity(COMM, matching=matching, h_corner=0.08)
        lower, upper = along(domain, "cavity_lower"), along(domain, "cavity_upper")
        ground, base = along(domain, "ground"), along(domain, "footing_base")
        ground = ground[np.abs(ground) <= 1.0]
        for one, other in ((lower, upper), (ground, base)):
            assert np.array_equal(one, other) == matching
            # Where nothing matches, the ends and the axis alone.
            assert matching or len(np.intersect1d(one, other)) == 3


def test_footing_over_cavity_is_fine_where_it_is_wanted():
    for h_corner in (None, 0.05):
        domain = footing_over_cavity(COMM, h_corner=h_corner)
        spacing, x = np.diff(along(domain, "ground")), along(domain, "ground")
        at_corner = spacing[(x[1:] == 1.0) | (x[:-1] == 1.0)]
        np.testing.assert_allclose(at_corner, h_corner or 0.15, rtol=0.2)
        cells = corners(domain, "soil")
        edges = np.linalg.norm(np.roll(cells, 1, axis=1) - cells, axis=2).max(axis=1)
        x, y = np.abs(cells.mean(axis=1)).T
        assert edges[(x < 1.0) & (y < 2.0)].max() < 1.6 * 0.15
        assert edges[x > 5.0].min() > 0.3


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("chamfer", [0.0, 0.05])
def test_footing_fills_its_notch(full, chamfer):
    domain = embedded_footing(COMM, full=full, chamfer=chamfer)
    assert domain.body_names == ["soil", "footing"]
    face, taken = 2.0 - (2.0 - 2.0**0.5) * chamfer, 0.5 * chamfer**2
    lengths = dict(footing_face=face, notch=face, footing_top=1.0, ground=5.0, bottom=6.0, side=6.0)
    halves = 2.0 if full else 1.0
    if full:
        lengths = {name: 2.0 * half for name, half in lengths.items()}
    else:
        lengths |= dict(soil_axis=5.0, footing_axis=1.0)
    assert set(domain.surfaces) == set(lengths)
    for name, expected in lengths.items():
        assert length(domain, name) == pytest.approx(expected, rel=1e-12)
    assert area(domain, "soil") == pytest.approx(halves * (35.0 + taken), rel=1e-13)
    assert area(domain, "footing") == pytest.approx(halves * (1.0 - taken), rel=1e-13)
    for surface in ("notch", "footing_face"):
        x, y = np.abs(np.moveaxis(ends(domain, surface), -1, 0))
        off = np.stack([1.0 - x, 1.0 - y, (chamfer - (1.0 - x) - (1.0 - y)) / 2.0**0.5])
        assert np.abs(off).min(axis=0).max(initial=0.0) < 1e-14
    corners = (2 if full else 1) * (2 if chamfer else 1)
    assert len(common_places(domain, "notch", "footing_face")) <= corners + 3
    assert smallest_angle(domain) > 25.0


def test_embedded_footing_is_fine_at_its_base_corner():
    for h_corner in (0.05, 0.025):
        domain = embedded_footing(COMM, h_corner=h_corner, chamfer=0.0)
        for name, ratio in (("notch", 1.0), ("footing_face", 0.8)):
            base, side = along(domain, name), along(domain, name, axis=1)
            for distance in (1.0 - base[::-1], side + 1.0):
                middle = 0.5 * (distance[1:] + distance[:-1])
                expected = ratio * (h_corner + 0.15 * middle)
                np.testing.assert_allclose(np.diff(distance), expected, rtol=0.1)
        cells = corners(domain, "soil")
        edges = np.linalg.norm(np.roll(cells, 1, axis=1) - cells, axis=2)
        distance = np.linalg.norm(cells.mean(axis=1) - (1.0, -1.0), axis=1)
        assert np.all(edges.max(axis=1) < 1.8 * np.minimum(0.5, h_corner + 0.15 * distance))
        assert edges[distance > 4.0].max() > 0.45


def test_embedded_footing_matches_where_the_ratio_is_one():
    for ratio in (0.8, 1.0):
        domain = embedded_footing(COMM, ratio=ratio)
        for axis in range(2):
            soil, footing = (along(domain, name, axis) for name in ("notch", "footing_face"))
            assert np.array_equal(soil, footing) == (ratio == 1.0)


@pytest.mark.parametrize("interface", [True, False])
def test_slope_lies_between_its_layers(interface):
    domain = excavated_slope(COMM, interface=interface)
    assert domain.body_names == ["soil"]
    assert domain.layers == {"soil": ("ground", "excavated")}
    assert area(domain, "excavated") == pytest.approx(1000.0, rel=1e-13)
    assert area(domain, "ground") == pytest.approx(125.0 * 50.0 - 1000.0, rel=1e-13)
    lengths = dict(surface=54.5, excavated_surface=70.5, bottom=125.0, left=50.0, right=50.0)
    if interface:
        lengths |= dict.fromkeys(["cut_upper", "cut_lower"], 40.5 / np.cos(np.radians(30.0)))
    assert set(domain.surfaces) == set(lengths)
    for name, expected in lengths.items():
        assert length(domain, name) == pytest.approx(expected, rel=1e-12)

    ground, excavated = (cell_nodes(domain.mesh)[domain.cells(n)] for n in domain.layers["soil"])
    common = np.intersect1d(numbers(domain, ground), numbers(domain, excavated))
    here = np.isin(domain.mesh.geometry.input_global_indices, common)
    places = np.concatenate(COMM.allgather(domain.mesh.geometry.x[here, :2]))
    places = np.unique(places.round(10), axis=0)
    x, y = places.T
    np.testing.assert_allclose(y, np.maximum(104.5 - x, 34.0), atol=1e-9)
    for wanted in ((54.5, 50.0), (70.5, 34.0), (125.0, 34.0)):
        assert np.linalg.norm(places - wanted, axis=1).min() < 1e-9
    spacing = np.linalg.norm(np.diff(places, axis=0), axis=1)
    np.testing.assert_allclose(spacing[x[1:] <= 70.5], 1.0, rtol=0.1)
    assert spacing.max() < 2.3
    assert smallest_angle(domain) > 25.0


@pytest.mark.parametrize("ratio", [0.8, 1.0])
def test_cut_has_two_faces_from_the_ground_to_its_tip(ratio):
    domain = excavated_slope(COMM, ratio=ratio)
    faces, slope = {}, np.tan(np.radians(30.0))
    for name, size, side in (("cut_upper", ratio, 1.0), ("cut_lower", 1.0, -1.0)):
        points = ends(domain, name)
        line = 50.0 - slope * (points[..., 0] - 35.0)
        np.testing.assert_allclose(points[..., 1], line, rtol=0, atol=1e-12)
        spacing = np.linalg.norm(np.diff(points, axis=1), axis=2)
        np.testing.assert_allclose(spacing, size, rtol=0.1)
        faces[name] = along(domain, name)
        mesh = domain.mesh
        cell_of_facet = mesh.topology.connectivity(1, 2)
        cells = cell_of_facet.array[cell_of_facet.offsets[domain.facets(name)]]
        x, y, _ = mesh.geometry.x[cell_nodes(mesh)[cells]].mean(axis=1).T
        assert np.all(side * (y - 50.0 + slope * (x - 35.0)) > 0.0)
        # Each face begins at a node of its own, the end of its part of the ground.
        np.testing.assert_allclose(common_places(domain, name, "surface"), [[35.0, 50.0]])
    tip = common_places(domain, *faces)
    np.testing.assert_allclose(tip, [[75.5, 26.6]], atol=0.05)
    assert np.array_equal(*faces.values()) == (ratio == 1.0)


@pytest.mark.parametrize(
    ("make", "layers"),
    [
        (footing_over_cavity, None),
        (embedded_footing, None),
        (excavated_slope, {"soil": ["ground", "excavated"]}),
    ],
)
def test_scene_is_written_by_the_command_line(make, layers, common_dir, monkeypatch):
    path = str(common_dir / "scene.msh")
    monkeypatch.setattr("sys.argv", [make.__name__, "--ratio", "0.9", "--out", path])
    importlib.import_module(make.__module__).main()
    read, made = Domain.read(path, COMM, layers=layers), make(COMM, ratio=0.9)
    assert read.bodies == made.bodies and read.surfaces == made.surfaces
    for name in made.bodies:
        np.testing.assert_allclose(corners(read, name), corners(made, name), atol=1e-12)
