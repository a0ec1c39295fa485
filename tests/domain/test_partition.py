# SPDX-License-Identifier: LGPL-3.0-or-later
from mpi4py import MPI

import basix.ufl
import numpy as np
import pytest
from dolfinx.mesh import GhostMode, create_cell_partitioner, create_mesh
from scipy.spatial import Delaunay

from fenicsx_hmcontact._compat import cell_nodes
from fenicsx_hmcontact.domain import vertex_ghost_partitioner

pytestmark = pytest.mark.mpi

COMM = MPI.COMM_WORLD
TRIANGLE = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))


def cloud(num_points=400):
    points = np.random.default_rng(3).uniform(size=(num_points, 2))
    return points, Delaunay(points).simplices.astype(np.int64)


def two_bodies():
    """Bodies of different size, so that two ranks cannot take one each."""
    large, cells = cloud()
    small, others = cloud(150)
    beside = small + np.array([1.5, 0.0])
    return np.concatenate([large, beside]), np.concatenate([cells, others + len(large)])


def one_cell():
    return np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), np.array([[0, 1, 2]])


def distribute(points, cells, partitioner, spread):
    """Hand the mesh in on rank 0, or spread over the ranks with the last one bringing nothing."""
    givers = max(1, COMM.size - 1) if spread else 1
    if COMM.rank < givers:
        shuffled = np.random.default_rng(1).permutation(cells)
        cells = np.array_split(shuffled, givers)[COMM.rank]
        points = np.array_split(points, givers)[COMM.rank]
    else:
        cells, points = cells[:0], points[:0]
    return create_mesh(COMM, cells, TRIANGLE, points, partitioner)


def incomplete_patches(mesh, num_points, cells):
    """Owned vertices around which this rank lacks cells, summed over the ranks."""
    around = np.bincount(cells.ravel(), minlength=num_points)
    topology = mesh.topology
    node_of_vertex = np.zeros(len(mesh.geometry.x), dtype=np.int64)
    node_of_vertex[topology.connectivity(2, 0).array] = cell_nodes(mesh).ravel()
    owned = node_of_vertex[: topology.index_map(0).size_local]
    here = np.bincount(cell_nodes(mesh).ravel(), minlength=len(mesh.geometry.x))[owned]
    missing = here != around[mesh.geometry.input_global_indices[owned]]
    return COMM.allreduce(int(missing.sum()))


@pytest.mark.parametrize("spread", [False, True], ids=["rank0", "spread"])
@pytest.mark.parametrize("make", [cloud, two_bodies, one_cell])
def test_every_owned_vertex_has_its_whole_patch(make, spread):
    points, cells = make()
    mesh = distribute(points, cells, vertex_ghost_partitioner(), spread)
    assert incomplete_patches(mesh, len(points), cells) == 0
    owned = mesh.topology.index_map(2).size_local
    assert COMM.allreduce(owned) == len(cells)
    assert mesh.topology.index_map(0).size_global == len(points)


@pytest.mark.skipif(COMM.size == 1, reason="one rank has all cells")
def test_ghosts_across_facets_are_not_enough():
    points, cells = two_bodies()
    shared_facet = create_cell_partitioner(GhostMode.shared_facet, 2)
    mesh = distribute(points, cells, shared_facet, spread=False)
    assert incomplete_patches(mesh, len(points), cells) > 0


def test_ghosts_are_the_cells_around_owned_vertices_only():
    points, cells = cloud()
    mesh = distribute(points, cells, vertex_ghost_partitioner(), spread=False)
    num_owned = mesh.topology.index_map(2).size_local
    nodes = cell_nodes(mesh)
    touches_owned_cell = np.isin(nodes[num_owned:], nodes[:num_owned]).any(axis=1)
    assert touches_owned_cell.all()
