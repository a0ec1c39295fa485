# SPDX-License-Identifier: LGPL-3.0-or-later
"""Geometry of node cells: areas, smoothed gradients, and the meshes that have none."""

from mpi4py import MPI

import basix.ufl
import numpy as np
import pytest
from dolfinx import fem
from dolfinx.mesh import (
    CellType,
    GhostMode,
    create_cell_partitioner,
    create_mesh,
    create_unit_cube,
    create_unit_square,
)

from fenicsx_hmcontact._kernels import node_cells as kernels
from fenicsx_hmcontact.smoothing import create_node_cells
from tests.smoothing.helpers import COMM, ENHANCEMENTS, KINDS, make_mesh, set_values, square
from tests.smoothing.twin import make_twin

pytestmark = pytest.mark.mpi

JITTERED = square("unstructured", 6)


def numbers(cells):
    """Input number of each local vertex."""
    mesh = cells.mesh
    nodes = np.empty(len(cells.points), np.int64)
    nodes[cells.vertices.ravel()] = mesh.geometry.input_global_indices[
        mesh.geometry.dofmaps[0].ravel()
    ]
    return nodes


def operators(cells, n_nodes):
    """Mean and second gradients in the input's numbering on all ranks; shape (nn, nn, 3, 2)."""
    result = np.zeros((n_nodes, n_nodes, 3, 2))
    nodes = numbers(cells)
    rows = np.repeat(nodes[: len(cells)], np.diff(cells.offsets))
    np.add.at(result, (rows, nodes[cells.nodes]), cells.gradients)
    return COMM.allreduce(result)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_and_areas_are_those_of_the_twin(kind):
    points, triangles = square(kind, 6)
    # Triangles may be numbered either way round.
    triangles[::2] = triangles[::2, ::-1]
    cells = create_node_cells(make_mesh(points, triangles))
    twin = make_twin(points, triangles)
    ours = operators(cells, len(points))
    for axis in range(2):
        mean = twin.mean[axis].toarray()
        assert np.allclose(ours[:, :, 0, axis], mean, rtol=0, atol=1e-14 * abs(mean).max())
    # Eq. 37: the points lie r_c to either side, so the second gradient is half their difference.
    radius = np.sqrt(twin.areas / np.pi)[:, None]
    for axis in range(2):
        at_points = twin.at_points[axis].toarray().reshape(len(points), 4, len(points))
        for direction in range(2):
            low, high = at_points[:, 2 * direction], at_points[:, 2 * direction + 1]
            second = (high - low) / (2.0 * radius)
            scale = abs(second).max()
            assert np.allclose(ours[:, :, 1 + direction, axis], second, rtol=0, atol=1e-13 * scale)
    areas = np.zeros(len(points))
    areas[numbers(cells)[: len(cells)]] = cells.areas
    assert np.allclose(COMM.allreduce(areas), twin.areas, rtol=1e-14)


@pytest.mark.parametrize("kind", KINDS)
def test_areas_and_weights_sum_up(kind):
    points, triangles = square(kind, 6)
    if kind != "alternating":
        assert np.bincount(triangles.ravel()).min() == 1  # a corner with a single triangle
    cells = create_node_cells(make_mesh(points, triangles))
    assert COMM.allreduce(cells.areas.sum()) == pytest.approx(1.0, rel=1e-14)
    cell = np.repeat(np.arange(len(cells)), np.diff(cells.triangle_offsets))
    sums = np.bincount(cell, cells.weights, len(cells))
    assert np.allclose(sums, 1.0, rtol=0, atol=1e-14)
    # First moment: the weights put the mean of the centroids where the cell's gradients are taken.
    centroids = cells.points[cells.vertices[cells.triangles]].mean(axis=1)
    moment = np.add.reduceat(cells.weights[:, None] * centroids, cells.triangle_offsets[:-1])
    total = COMM.allreduce((cells.areas[:, None] * moment).sum(axis=0))
    assert np.allclose(total, 0.5, rtol=1e-13)


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
@pytest.mark.parametrize("shape", [(), (2,), (2, 2)])
def test_constants_and_linear_fields_are_reproduced(enhancement, shape):
    mesh = make_mesh(*JITTERED)
    cells = create_node_cells(mesh)
    f = fem.Function(fem.functionspace(mesh, ("P", 1, shape)))
    size = int(np.prod(shape))
    slope = np.random.default_rng(0).normal(size=(size, 2))
    f.interpolate(lambda x: slope @ x[:2] + np.arange(size)[:, None] + 3.0)
    gradient = cells.gradient(f, enhancement)
    assert gradient.shape == (len(cells), 1 if enhancement == "none" else 4, size, 2)
    assert np.allclose(gradient, slope, rtol=0, atol=3e-13)


@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
@pytest.mark.parametrize("components", [1, 2])
def test_gradient_of_any_field_is_that_of_the_twin(enhancement, components):
    points, triangles = JITTERED
    mesh = make_mesh(points, triangles)
    cells = create_node_cells(mesh)
    f = fem.Function(fem.functionspace(mesh, ("P", 1, (components,) if components > 1 else ())))
    values = np.random.default_rng(1).normal(size=len(points) * components)
    set_values(f, values)
    twin = make_twin(points, triangles)
    if components == 1:
        flat = [g @ values for g in twin.gradient(enhancement)]
    else:
        flat = [g @ values for g in twin.displacement_gradient(enhancement)]
    expected = np.stack(flat, axis=-1).reshape(len(points), -1, components, 2)
    ours = cells.gradient(f, enhancement)
    owned = numbers(cells)[: len(cells)]
    assert np.allclose(ours, expected[owned], rtol=0, atol=1e-13 * abs(expected).max())


def test_deviatoric_gradient_differs_from_the_full_one_by_its_trace_alone():
    points, triangles = JITTERED
    mesh = make_mesh(points, triangles)
    cells = create_node_cells(mesh)
    u = fem.Function(fem.functionspace(mesh, ("P", 1, (2,))))
    set_values(u, np.random.default_rng(2).normal(size=2 * len(points)))
    deviatoric, full = cells.gradient(u), cells.gradient(u, "full")
    difference = deviatoric - full
    assert abs(np.trace(difference, axis1=2, axis2=3)).max() > 0.1
    assert np.allclose(difference[..., 0, 1], 0.0) and np.allclose(difference[..., 1, 0], 0.0)
    assert np.allclose(difference[..., 0, 0], difference[..., 1, 1])
    mean = np.trace(cells.gradient(u, "none"), axis1=2, axis2=3)
    assert np.allclose(np.trace(deviatoric, axis1=2, axis2=3), mean, rtol=0, atol=1e-12)


# Centroids, weights 1/6, 1/4 or 1/8, and the slope +-h/2 of the triangles around an inner node of
# squares of side h put into Eqs. 34-36 by hand.
@pytest.mark.parametrize(
    ("kind", "patches", "mean"), [("right", {7: 1.1}, 1.1), ("alternating", {5: 1.5, 9: 0.9}, 1.2)]
)
def test_second_gradient_of_a_parabola(kind, patches, mean):
    points, triangles = square(kind, 7)
    cells = create_node_cells(make_mesh(points, triangles))
    curvature = operators(cells, len(points))[:, :, 1, 0] @ (0.5 * points[:, 0] ** 2)
    inside = np.flatnonzero(np.all((points > 1e-9) & (points < 1.0 - 1e-9), axis=1))
    for c in inside:
        size = np.unique(triangles[np.any(triangles == c, axis=1)]).size
        assert curvature[c] == pytest.approx(patches[size], rel=1e-12)
    assert curvature[inside].mean() == pytest.approx(mean, rel=1e-12)


def test_single_triangle_has_no_second_gradient():
    points, triangles = np.array([[0.0, 0.0], [2.0, 0.1], [0.3, 1.0]]), np.array([[0, 1, 2]])
    cells = create_node_cells(make_mesh(points, triangles))
    ours = operators(cells, 3)
    assert np.allclose(ours[:, :, 1:], 0.0)
    assert np.allclose(ours[:, :, 0], ours[0, :, 0])  # the same gradient at all three nodes
    assert COMM.allreduce(cells.areas.sum()) == pytest.approx(0.985, rel=1e-14)


def test_patches_hold_the_ring_with_its_own_node_first():
    points, triangles = JITTERED
    cells = create_node_cells(make_mesh(points, triangles))
    nodes = numbers(cells)
    for c in range(len(cells)):
        patch = nodes[cells.nodes[cells.offsets[c] : cells.offsets[c + 1]]]
        ring = np.unique(triangles[np.any(triangles == nodes[c], axis=1)])
        assert patch[0] == nodes[c]
        assert np.array_equal(np.sort(patch), ring)


def test_kernels_agree_with_their_python_source():
    """Where numba read past an array, the interpreter would raise."""
    cells = create_node_cells(make_mesh(*JITTERED, comm=MPI.COMM_SELF))
    topology = cells.mesh.topology
    around = topology.connectivity(0, 2)
    n = len(cells)
    arguments = (cells.vertices, around.offsets, around.array, n, n)
    offsets, nodes = kernels.patch_nodes.py_func(*arguments)
    assert np.array_equal(offsets, cells.offsets) and np.array_equal(nodes, cells.nodes)
    arguments = (cells.vertices, cells.points, around.offsets, around.array, offsets, nodes)
    areas, gradients = kernels.smoothed_gradients.py_func(*arguments)
    assert np.allclose(areas, cells.areas, rtol=1e-14)
    assert np.allclose(gradients, cells.gradients, rtol=0, atol=1e-12)
    values = np.random.default_rng(3).normal(size=(n, 3))
    for n_points in (1, 4):
        arguments = (offsets, nodes, gradients, areas, values, n_points)
        expected = kernels.point_gradients.py_func(*arguments)
        assert np.allclose(kernels.point_gradients(*arguments), expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("python", [False, True])
def test_patch_larger_than_the_room_first_reserved(python):
    n = 30
    fan = np.array([(0, 1 + i, 1 + (i + 1) % n) for i in range(n)], np.int32)
    offsets = np.array([0, n] + [n] * n, np.int32)
    function = kernels.patch_nodes.py_func if python else kernels.patch_nodes
    ends, nodes = function(fan, offsets, np.arange(n, dtype=np.int32), 1, n + 1)
    assert np.array_equal(ends, [0, n + 1])
    assert np.array_equal(np.sort(nodes), np.arange(n + 1)) and nodes[0] == 0


def test_more_ranks_than_nodes_to_share():
    """A rank may own no node, or no cell."""
    points, triangles = square("right", 1)
    cells = create_node_cells(make_mesh(points, triangles))
    assert COMM.allreduce(len(cells)) == 4
    assert np.allclose(operators(cells, 4)[:, :, 0, 0] @ points[:, 0], 1.0)
    constant = fem.Function(fem.functionspace(cells.mesh, ("DG", 0)))
    constant.x.array[:] = 2.5
    assert np.allclose(cells.cell_means(constant), 2.5)
    assert cells.cell_means(constant).shape == (len(cells), 1)


# --- meshes without node cells -------------------------------------------------------------------


@pytest.mark.skipif(COMM.size == 1, reason="one rank has all triangles")
@pytest.mark.parametrize("mode", [GhostMode.none, GhostMode.shared_facet])
def test_missing_triangles_are_refused_on_all_ranks(mode):
    mesh = make_mesh(*square("unstructured", 10), partitioner=create_cell_partitioner(mode, 2))
    with pytest.raises(RuntimeError, match="vertex_ghost_partitioner") as refusal:
        create_node_cells(mesh)
    assert "lacks triangles around" in str(refusal.value)
    messages = COMM.allgather(str(refusal.value))
    assert len(set(messages)) == 1


def test_quadrilaterals_are_refused():
    mesh = create_unit_square(COMM, 4, 4, CellType.quadrilateral)
    with pytest.raises(ValueError, match="triangles in the plane, not quadrilateral cells in 2"):
        create_node_cells(mesh)


def test_tetrahedra_are_refused():
    with pytest.raises(ValueError, match="not tetrahedron cells in 3 dimensions"):
        create_node_cells(create_unit_cube(COMM, 2, 2, 2))


def test_triangles_in_space_are_refused():
    points, triangles = square("right", 2)
    points = np.column_stack((points, points[:, 0]))
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(3,))
    if COMM.rank > 0:
        points, triangles = points[:0], triangles[:0]
    mesh = create_mesh(COMM, triangles, element, points)
    with pytest.raises(ValueError, match="not triangle cells in 3 dimensions"):
        create_node_cells(mesh)


def test_curved_triangles_are_refused():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.6, 0.6], [0.0, 0.5], [0.5, 0.0]])
    element = basix.ufl.element("Lagrange", "triangle", 2, shape=(2,))
    cells = np.arange(6)[None, :]
    if COMM.rank > 0:
        points, cells = points[:0], cells[:0]
    mesh = create_mesh(COMM, cells, element, points)
    with pytest.raises(ValueError, match="straight triangles; this mesh has curved ones"):
        create_node_cells(mesh)
