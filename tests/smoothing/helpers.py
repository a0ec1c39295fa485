# SPDX-License-Identifier: LGPL-3.0-or-later
"""Meshes from plain arrays, and global arrays in their numbering whatever the number of ranks."""

from mpi4py import MPI

import basix.ufl
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.mesh import create_mesh, meshtags
from scipy.spatial import Delaunay

import fenicsx_hmcontact as hm
from fenicsx_hmcontact import _compat
from fenicsx_hmcontact.smoothing import SmoothedTerm, create_node_cells, point_forms

COMM = MPI.COMM_WORLD
TRIANGLE = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
KINDS = ["right", "alternating", "unstructured"]
ENHANCEMENTS = ["deviatoric", "full", "none"]


def square(kind, n):
    """Points and cells of the unit square with n cells a side."""
    s = np.linspace(0.0, 1.0, n + 1)
    points = np.array([(x, y) for y in s for x in s])
    if kind == "unstructured":
        inside = np.all((points > 1e-9) & (points < 1.0 - 1e-9), axis=1)
        rng = np.random.default_rng(4)
        points[inside] += rng.uniform(-0.3 / n, 0.3 / n, (inside.sum(), 2))
        return points, Delaunay(points).simplices.astype(np.int64)
    cells = []
    for j in range(n):
        for i in range(n):
            a = j * (n + 1) + i
            b, c, d = a + 1, a + n + 2, a + n + 1
            rising = kind == "right" or (i + j) % 2 == 0
            cells += [(a, b, c), (a, c, d)] if rising else [(a, b, d), (b, c, d)]
    return points, np.array(cells, np.int64)


def make_mesh(points, cells, comm=COMM, partitioner=None):
    """Hand a mesh in on the first rank; ranks get whole node patches unless told otherwise."""
    if comm.rank > 0:
        points, cells = points[:0], cells[:0]
    return create_mesh(comm, cells, TRIANGLE, points, partitioner or hm.vertex_ghost_partitioner())


def input_nodes(space):
    """Number in the input of the node of each local block dof of a P1 space."""
    mesh = space.mesh
    nodes = np.empty(space.dofmap.list.max(initial=-1) + 1, np.int64)
    nodes[space.dofmap.list.ravel()] = mesh.geometry.input_global_indices[
        _compat.cell_nodes(mesh).ravel()
    ]
    return nodes


def input_dofs(space):
    """Number in the input of each local dof, components together."""
    bs = space.dofmap.bs
    return (input_nodes(space)[:, None] * bs + np.arange(bs)).ravel()


def set_values(function, values):
    """Give a P1 function the values of a flat array in the input's numbering."""
    function.x.array[:] = values[input_dofs(function.function_space)]


def set_cell_values(function, values):
    """Give a scalar DG0 function one value per input cell, ghosts included."""
    space = function.function_space
    # All cells came with the first rank, so that original positions are those of the input.
    function.x.array[space.dofmap.list[:, 0]] = values[space.mesh.topology.original_cell_index]


def tag_cells(mesh, values):
    """Cell tags from one integer per input cell, ghosts included."""
    original = mesh.topology.original_cell_index
    cells = np.arange(original.size, dtype=np.int32)
    return meshtags(mesh, 2, cells, values[original].astype(np.int32))


def smoothed_terms(form, node_cells=None):
    """Compile a form and bind it to the node cells of its mesh."""
    spaces = [argument.ufl_function_space() for argument in form.arguments()]
    mesh = spaces[0].mesh
    forms = point_forms(form)
    compiled = iter(_compat.compile_forms(mesh.comm, [s for f in forms for s in f.sources]))
    cells = node_cells or create_node_cells(mesh)
    terms = [SmoothedTerm(f, [next(compiled) for _ in f.sources], cells, spaces) for f in forms]
    return terms, spaces


def assemble(form, node_cells=None):
    """Global vector or dense matrix of a smoothed form in the input's numbering, on all ranks."""
    terms, spaces = smoothed_terms(form, node_cells)
    return add_up(terms, spaces)


def add_up(terms, spaces):
    """Sum of bound terms as a global array in the input's numbering, on all ranks."""
    comm = spaces[0].mesh.comm
    dofs = [input_dofs(space) for space in spaces]
    local = np.zeros([d.size for d in dofs])
    for term in terms:
        if len(spaces) == 1:
            term.add_to_vector(local)
        else:
            # A dense matrix is a CSR matrix whose rows are full.
            a, b = (space.dofmap.bs for space in spaces)
            rows, columns = (i.astype(np.int64) for i in term.pairs())
            positions = rows * a * dofs[1].size + columns * b
            lengths = np.full(dofs[0].size // a, dofs[1].size)
            term.set_positions(positions.astype(np.int32), lengths.astype(np.int32))
            term.add_to_matrix(local.reshape(-1))
    maps = [space.dofmap.index_map.size_global * space.dofmap.index_map_bs for space in spaces]
    result = np.zeros(maps)
    np.add.at(result, np.ix_(*dofs), local)
    return comm.allreduce(result)


def assemble_triangles(form):
    """DOLFINx's own vector or dense matrix in the input's numbering; for a mesh on one rank."""
    spaces = [argument.ufl_function_space() for argument in form.arguments()]
    dofs = [input_dofs(space) for space in spaces]
    if len(spaces) == 1:
        local = fem.assemble_vector(fem.form(form)).array
    else:
        matrix = assemble_matrix(fem.form(form))
        matrix.assemble()
        local = matrix.convert("dense").getDenseArray()
    result = np.zeros_like(local)
    result[np.ix_(*dofs)] = local
    return result


def strain(u):
    return ufl.sym(ufl.grad(u))


def hooke(u, shear_modulus, lame):
    return 2.0 * shear_modulus * strain(u) + lame * ufl.div(u) * ufl.Identity(2)
