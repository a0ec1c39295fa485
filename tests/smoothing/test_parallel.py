# SPDX-License-Identifier: LGPL-3.0-or-later
"""Any number of ranks assembles what one rank does."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenicsx_hmcontact as hm
from fenicsx_hmcontact import _compat
from tests.smoothing.helpers import (
    COMM,
    ENHANCEMENTS,
    add_up,
    assemble,
    hooke,
    input_dofs,
    make_mesh,
    set_cell_values,
    set_values,
    smoothed_terms,
    square,
)

pytestmark = pytest.mark.mpi

POINTS, TRIANGLES = square("unstructured", 7)


def lopsided(comm, nparts, cell_types, cells):
    """All triangles to the first rank but one to the last; every rank sees all of them."""
    n = cells[0].size // 3
    owner = np.zeros(n, np.int32)
    owner[-1:] = nparts - 1
    rows = [[rank, *(r for r in range(nparts) if r != rank)] for rank in owner]
    data = np.array(rows, np.int32).ravel()
    return _compat.adjacency_list(data, np.arange(n + 1, dtype=np.int32) * nparts)


PARTITIONERS = {"vertex ghosts": None, "lopsided": lopsided}


def coupled(comm, partitioner, smoothing, node_values):
    """Both blocks of a nonlinear residual with all kinds of data, and the four of its tangent."""
    mesh = make_mesh(POINTS, TRIANGLES, comm, partitioner)
    V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
    u, p = fem.Function(V), fem.Function(Q)
    set_values(u, node_values[:, :2].ravel())
    set_values(p, node_values[:, 2].copy())
    modulus = fem.Function(fem.functionspace(mesh, ("DG", 0)))
    set_cell_values(modulus, 1.0 + POINTS[TRIANGLES].mean(axis=1)[:, 0])
    dt = fem.Constant(mesh, 0.3)
    x = ufl.SpatialCoordinate(mesh)
    v, q = ufl.TestFunction(V), ufl.TestFunction(Q)
    volume = ufl.div(u) + 0.5 * ufl.div(u) ** 2
    flux = dt * (1.0 + p**2) * ufl.grad(p)
    dc = hm.node_cells_measure(smoothing)
    residuals = [
        (ufl.inner(hooke(u, modulus, 2.0 * modulus), ufl.grad(v)) - p * ufl.div(v)) * dc
        + ufl.dot(p * x, v) * dc,
        (volume * q * x[0] + ufl.dot(flux, ufl.grad(q))) * dc,
    ]
    blocks = [assemble(residual) for residual in residuals]
    for residual in residuals:
        blocks += [
            assemble(ufl.derivative(residual, f, ufl.TrialFunction(f.function_space)))
            for f in (u, p)
        ]
    return blocks


@pytest.mark.parametrize("partitioner", PARTITIONERS.values(), ids=PARTITIONERS)
@pytest.mark.parametrize("enhancement", ENHANCEMENTS)
def test_vectors_and_matrices_are_those_of_one_rank(partitioner, enhancement):
    values = np.column_stack(
        (np.sin(3.0 * POINTS[:, 0]), POINTS[:, 1] ** 2, np.cos(POINTS @ [2.0, 1.0]))
    )
    ours = coupled(COMM, partitioner, enhancement, values)
    alone = coupled(MPI.COMM_SELF, None, enhancement, values)
    for block, expected in zip(ours, alone, strict=True):
        assert np.linalg.norm(expected) > 0.01
        assert np.linalg.norm(block) == pytest.approx(np.linalg.norm(expected), rel=1e-12)
        assert abs(block - expected).max() <= 1e-12 * abs(expected).max()


@pytest.mark.parametrize("partitioner", PARTITIONERS.values(), ids=PARTITIONERS)
def test_action_of_owned_rows_is_that_of_one_rank(partitioner):
    """Linear displacement: forces of a uniform stress, the same on all partitions."""
    forces = []
    for comm, part in ((COMM, partitioner), (MPI.COMM_SELF, None)):
        mesh = make_mesh(POINTS, TRIANGLES, comm, part)
        V = fem.functionspace(mesh, ("P", 1, (2,)))
        u, v = fem.Function(V), ufl.TestFunction(V)
        u.interpolate(lambda x: np.vstack((0.1 * x[0] + 0.3 * x[1], -0.2 * x[1])))
        terms = smoothed_terms(ufl.inner(hooke(u, 1.0, 2.0), ufl.grad(v)) * hm.dc)
        forces.append(add_up(*terms).reshape(-1, 2))
    assert abs(forces[0] - forces[1]).max() <= 1e-12 * abs(forces[1]).max()
    # A uniform stress leaves no force inside.
    inside = np.all((POINTS > 1e-9) & (POINTS < 1.0 - 1e-9), axis=1)
    assert abs(forces[0][inside]).max() < 1e-14
    # tr(e) = -0.1: sigma_xx = 0.2 - 0.2 = 0, sigma_yy = -0.4 - 0.2, sigma_xy = 0.3.
    top = np.isclose(POINTS[:, 1], 1.0)
    right = np.isclose(POINTS[:, 0], 1.0)
    corner = top & right
    half = 0.5 / 7.0
    assert np.allclose(forces[0][top & ~right & (POINTS[:, 0] > 0)], [0.3 / 7.0, -0.6 / 7.0])
    assert np.allclose(forces[0][corner], [0.3 * half, (-0.6 + 0.3) * half])


def test_each_node_has_one_owner():
    mesh = make_mesh(POINTS, TRIANGLES)
    cells = hm.create_node_cells(mesh)
    Q = fem.functionspace(mesh, ("P", 1))
    owned = np.zeros(len(POINTS))
    owned[input_dofs(Q)[cells.block_dofs(Q)[: len(cells)]]] = 1.0
    assert np.array_equal(COMM.allreduce(owned), np.ones(len(POINTS)))
