# SPDX-License-Identifier: LGPL-3.0-or-later
from mpi4py import MPI

import numpy as np
import pytest

from fenicsx_hmcontact._compat import cell_nodes
from meshes.block import block
from meshes.cooks_membrane import cooks_membrane
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


def ends(domain, name):
    """End points of the facets of a surface on all ranks; shape (num_facets, 2, 2)."""
    mesh = domain.mesh
    mesh.topology.create_connectivity(1, 0)
    mesh.topology.create_connectivity(0, 2)
    vertices = mesh.topology.connectivity(1, 0).array.reshape(-1, 2)[domain.facets(name)]
    node_of_vertex = np.zeros(len(mesh.geometry.x), dtype=np.int64)
    node_of_vertex[mesh.topology.connectivity(2, 0).array] = cell_nodes(mesh).ravel()
    mine = mesh.geometry.x[node_of_vertex[vertices], :2]
    return np.concatenate(COMM.allgather(mine))


def length(domain, name):
    return np.linalg.norm(np.diff(ends(domain, name), axis=1), axis=2).sum()


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
