# SPDX-License-Identifier: LGPL-3.0-or-later
"""Surfaces gathered from a mesh: the same on any number of ranks, oriented, refused where wrong."""

from mpi4py import MPI

import basix.ufl
import numpy as np
import pytest
from dolfinx import fem
from dolfinx import mesh as dmesh

from fenicsx_hmcontact.contact.surface import Surface, gather_surface, surface_dofs
from fenicsx_hmcontact.domain import vertex_ghost_partitioner

TRIANGLE, QUADRILATERAL = dmesh.CellType.triangle, dmesh.CellType.quadrilateral
GHOSTS = ["none", "facet", "vertex"]


def square(comm, ghosts="none", cell=TRIANGLE):
    if ghosts == "vertex":
        partitioner = vertex_ghost_partitioner()
    else:
        mode = {"none": dmesh.GhostMode.none, "facet": dmesh.GhostMode.shared_facet}[ghosts]
        partitioner = dmesh.create_cell_partitioner(mode, 2)
    return dmesh.create_unit_square(comm, 7, 5, cell_type=cell, partitioner=partitioner)


def triangles(comm, points, cells):
    """Mesh of triangles whose input lies on rank 0."""
    points, cells = np.array(points, dtype=float), np.array(cells, dtype=np.int64)
    if comm.rank > 0:
        points, cells = points[:0], cells[:0]
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    return dmesh.create_mesh(comm, cells, element, points)


def tags(mesh, where, value=3, locate=dmesh.locate_entities_boundary):
    mesh.topology.create_connectivity(1, 2)
    facets = np.unique(locate(mesh, 1, where))
    return dmesh.meshtags(mesh, 1, facets, np.full(len(facets), value, dtype=np.int32))


def top(x):
    return np.isclose(x[1], 1)


def boundary(x):
    return np.isclose(np.abs(x[:2] - 0.5).max(axis=0), 0.5)


def chain(points, closed=False):
    n = len(points)
    edges = np.column_stack([np.arange(n), np.roll(np.arange(n), -1)])[: n if closed else n - 1]
    ids = np.arange(n)
    return Surface("chain", ids, ids, np.array(points, dtype=float), edges.astype(np.int32))


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("ghosts", "cell"), [*((g, TRIANGLE) for g in GHOSTS), ("facet", QUADRILATERAL)]
)
@pytest.mark.parametrize("where", [top, boundary])
def test_surface_is_the_serial_one_on_every_rank(ghosts, cell, where):
    mesh = square(MPI.COMM_WORLD, ghosts, cell)
    surface = gather_surface(mesh, tags(mesh, where), 3, "ground")
    alone = square(MPI.COMM_SELF, cell=cell)
    serial = gather_surface(alone, tags(alone, where), 3, "ground")

    assert np.array_equal(surface.input_nodes, serial.input_nodes)
    assert np.array_equal(surface.edges, serial.edges)
    assert np.array_equal(surface.points, serial.points)
    assert np.array_equal(surface.normals, serial.normals)
    assert np.array_equal(surface.nodes, mesh.comm.bcast(surface.nodes))
    assert len(surface.edges) == (7 if where is top else 24)
    assert len(surface.chains) == 1


@pytest.mark.mpi
def test_rank_without_facets_takes_part():
    mesh = square(MPI.COMM_WORLD)
    facet_tags = tags(mesh, lambda x: np.isclose(x[1], 0) & (x[0] < 1 / 7 + 1e-6))
    counts = mesh.comm.allgather(len(facet_tags.indices))
    assert mesh.comm.size == 1 or min(counts) == 0
    surface = gather_surface(mesh, facet_tags, 3, "toe")
    assert np.allclose(surface.points, [[0, 0], [1 / 7, 0]], rtol=0, atol=1e-15)
    assert surface.edges.tolist() == [[0, 1]]


@pytest.mark.mpi
@pytest.mark.parametrize("ghosts", GHOSTS)
def test_body_lies_left_of_the_edges(ghosts):
    mesh = square(MPI.COMM_WORLD, ghosts)
    surface = gather_surface(mesh, tags(mesh, boundary), 3, "all")
    x, y = surface.points[surface.chains[0]].T
    area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    assert area == pytest.approx(1, abs=1e-14)
    middles = surface.points[surface.edges].mean(axis=1)
    inward = np.column_stack([-surface.tangents[:, 1], surface.tangents[:, 0]])
    assert np.all(np.sum(inward * (0.5 - middles), axis=1) > 0.49)
    assert np.all(np.sum(surface.normals * (0.5 - surface.points), axis=1) > 0.49)


@pytest.mark.mpi
@pytest.mark.parametrize("ghosts", GHOSTS)
@pytest.mark.parametrize("shape", [(), (2,)])
def test_dofs_lie_at_the_points(ghosts, shape):
    mesh = square(MPI.COMM_WORLD, ghosts)
    surface = gather_surface(mesh, tags(mesh, boundary), 3, "all")
    V = fem.functionspace(mesh, ("Lagrange", 1, shape))
    dofs = surface_dofs(surface, V)
    assert np.array_equal(dofs, mesh.comm.bcast(dofs))
    first, last = V.dofmap.index_map.local_range
    mine = (dofs >= first) & (dofs < last)
    at = V.tabulate_dof_coordinates()[dofs[mine] - first, :2]
    assert np.allclose(at, surface.points[mine], rtol=0, atol=1e-14)
    assert mesh.comm.allreduce(int(mine.sum())) == len(surface.nodes) == 24


@pytest.mark.mpi
@pytest.mark.parametrize("ghosts", GHOSTS)
@pytest.mark.parametrize("shape", [(), (2,)])
def test_dofs_of_a_submesh_lie_at_the_points_it_has(ghosts, shape):
    mesh = square(MPI.COMM_WORLD, ghosts)
    surface = gather_surface(mesh, tags(mesh, boundary), 3, "all")
    left = dmesh.locate_entities(mesh, 2, lambda x: x[0] < 3 / 7 + 1e-9)
    part, *_ = dmesh.create_submesh(mesh, 2, left)
    V = fem.functionspace(part, ("Lagrange", 1, shape))
    dofs = surface_dofs(surface, V)
    assert np.array_equal(dofs, mesh.comm.bcast(dofs))
    assert np.array_equal(dofs >= 0, surface.points[:, 0] < 3 / 7 + 1e-9)
    first, last = V.dofmap.index_map.local_range
    mine = (dofs >= first) & (dofs < last)
    at = V.tabulate_dof_coordinates()[dofs[mine] - first, :2]
    assert np.allclose(at, surface.points[mine], rtol=0, atol=1e-14)
    assert mesh.comm.allreduce(int(mine.sum())) == int(np.sum(dofs >= 0)) == 12


@pytest.mark.mpi
def test_wrong_space_is_refused_on_all_ranks():
    mesh, other = (square(MPI.COMM_WORLD) for _ in range(2))
    surface = gather_surface(mesh, tags(mesh, top), 3, "ground")
    for V in [
        fem.functionspace(mesh, ("Lagrange", 2)),
        fem.functionspace(mesh, ("DG", 1)),
        fem.functionspace(mesh, ("Lagrange", 1, (2,))).sub(0),
    ]:
        with pytest.raises(ValueError, match="'ground' needs a whole, continuous P1 space"):
            surface_dofs(surface, V)
    other = dmesh.create_unit_square(MPI.COMM_WORLD, 9, 9)
    with pytest.raises(ValueError, match="'ground' is not of the mesh"):
        surface_dofs(surface, fem.functionspace(other, ("Lagrange", 1)))


@pytest.mark.mpi
@pytest.mark.parametrize("ghosts", GHOSTS)
def test_wrong_facets_are_refused_on_all_ranks(ghosts):
    mesh = square(MPI.COMM_WORLD, ghosts)
    with pytest.raises(ValueError, match="'ground': no facet of the mesh has tag 4"):
        gather_surface(mesh, tags(mesh, top), 4, "ground")
    with pytest.raises(ValueError, match=r"'cut': 5 of its 5 facets .* one at \(0.428571, 0.1\)"):
        cut = tags(mesh, lambda x: np.isclose(x[0], 3 / 7), locate=dmesh.locate_entities)
        gather_surface(mesh, cut, 3, "cut")
    other = square(MPI.COMM_WORLD, ghosts)
    with pytest.raises(ValueError, match="'ground': the tags are not on the facets of this mesh"):
        gather_surface(mesh, tags(other, top), 3, "ground")


@pytest.mark.mpi
@pytest.mark.parametrize("highest", [9, 0])
def test_branching_surface_is_refused_on_all_ranks(highest):
    # Two bodies that share the node at the origin, one above y = 0, one below: four edges meet
    # there, or (y = 0 only) two that both begin there.
    points = [[0, 0], [2, 0], [1, 1], [-2, 0], [-1, -1], [-3, -2], [3, 2]]
    mesh = triangles(MPI.COMM_WORLD, points, [[0, 1, 2], [0, 3, 4], [3, 5, 4], [1, 6, 2]])
    facet_tags = tags(mesh, lambda x: np.abs(x[1]) <= highest)
    with pytest.raises(ValueError, match=r"'bow' branches at \(0, 0\)"):
        gather_surface(mesh, facet_tags, 3, "bow")


@pytest.mark.mpi
def test_curved_mesh_is_refused():
    if MPI.COMM_WORLD.rank == 0:
        cells, points = np.array([[0, 1, 2, 3, 4, 5]], dtype=np.int64), np.zeros((6, 2))
        points[:] = [[0, 0], [1, 0], [0, 1], [0.5, 0.5], [0, 0.5], [0.5, 0]]
    else:
        cells, points = np.zeros((0, 6), dtype=np.int64), np.zeros((0, 2))
    element = basix.ufl.element("Lagrange", "triangle", 2, shape=(2,))
    mesh = dmesh.create_mesh(MPI.COMM_WORLD, cells, element, points)
    with pytest.raises(ValueError, match="'arc' needs a mesh of straight cells in the plane"):
        gather_surface(mesh, tags(mesh, lambda x: np.isclose(x[1], 0)), 3, "arc")


def test_normals_of_a_regular_polygon_point_to_its_centre():
    angle = np.linspace(0, 2 * np.pi, 17)[:-1] + 0.3
    radial = np.column_stack([np.cos(angle), np.sin(angle)])
    disc = chain(5 * radial, closed=True)
    assert np.allclose(disc.normals, -radial, rtol=0, atol=1e-15)
    assert np.allclose(disc.lengths, 10 * np.sin(np.pi / 16), rtol=1e-14)


def test_normals_average_unit_normals_whatever_the_lengths():
    corner = chain([[0, 0], [5, 0], [5, 0.1]])
    expected = np.array([[0, 1], [-np.sqrt(0.5), np.sqrt(0.5)], [-1, 0]])
    assert np.allclose(corner.normals, expected, rtol=0, atol=1e-15)


def test_rotations_have_rows_normal_and_tangent():
    surface = chain([[0, 0], [1, 0.2], [2, 0.1]])
    R = surface.rotations
    assert np.allclose(R @ R.transpose(0, 2, 1), np.eye(2), rtol=0, atol=1e-15)
    assert np.array_equal(R[:, 0], surface.normals)
    assert np.allclose(R[0, 1], surface.tangents[0], rtol=0, atol=1e-15)
    assert np.all(np.linalg.det(R) < 0)


def test_chains_follow_the_edges():
    # An open chain 3 -> 0 -> 5 and a loop 1 -> 4 -> 2 -> 1
    points = np.array([[1, 0], [0, 1], [0, 2], [0, 0], [1, 2], [2, 0]], dtype=float)
    edges = np.array([[0, 5], [1, 4], [2, 1], [3, 0], [4, 2]], dtype=np.int32)
    ids = np.arange(6)
    chains = Surface("two", ids, ids, points, edges).chains
    assert [c.tolist() for c in chains] == [[3, 0, 5], [1, 4, 2]]


def test_surface_elsewhere_keeps_its_edges_and_has_new_normals():
    surface = chain([[0, 0], [1, 0], [2, 0]])
    assert np.allclose(surface.normals, [0, 1])
    points = np.array([[0.0, 0], [0, 1], [0, 2]])
    moved = surface.at(points)
    assert moved.edges is surface.edges
    assert np.allclose(moved.normals, [-1, 0])
    points += 1
    assert np.array_equal(moved.points, [[0, 0], [0, 1], [0, 2]])
    with pytest.raises(ValueError, match="read-only"):
        moved.points[0] = 1


def test_degenerate_surfaces_are_refused():
    with pytest.raises(ValueError, match=r"'chain' has an edge without length at \(1, 0\)"):
        chain([[0, 0], [1, 0], [1, 0]])
    with pytest.raises(ValueError, match="'chain' has coordinates that are not finite"):
        chain([[0, 0], [np.nan, 0]])
    with pytest.raises(ValueError, match=r"'chain' is folded onto itself at \(1, 0\)"):
        _ = chain([[0, 0], [1, 0], [0, 0]]).normals
    with pytest.raises(ValueError, match=r"need input nodes of shape \(2,\) and points of shape"):
        chain([[0, 0], [1, 0]]).at(np.zeros((3, 2)))
