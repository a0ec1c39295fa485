# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tangent of a rank against the matrix that DOLFINx assembles."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix

from fenicsx_hmcontact.solvers import FieldLayout, LinearSolver, LocalMatrix
from tests.models import dense, stack

pytestmark = pytest.mark.mpi


@pytest.fixture
def system(comm):
    """Blocks of an unsymmetric u-p form with one empty block, on triangles and facets."""
    domain = stack(comm, (3, 4), alternate=True)
    V = fem.functionspace(domain.mesh, ("P", 1, (2,)))
    Q = fem.functionspace(domain.mesh, ("P", 2))
    u, v, p, q = (f(W) for W in (V, Q) for f in (ufl.TrialFunction, ufl.TestFunction))
    weight = fem.Function(Q)
    weight.interpolate(lambda x: 1 + x[0] + 2 * x[1])
    forms = [
        [
            weight * ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx + u[0] * v[1] * ufl.ds,
            fem.Constant(domain.mesh, 2.0) * p * ufl.div(v) * ufl.dx,
        ],
        [q * u[1].dx(0) * ufl.dx, None],
    ]
    forms = [[None if f is None else fem.form(f) for f in row] for row in forms]
    layout = FieldLayout([V, Q])
    return layout, forms, weight, LocalMatrix(layout, forms, [[[], []], [[], []]])


def assembled(comm, layout, matrix):
    rows, columns = matrix.entries()
    solver = LinearSolver(
        comm, layout.owned.size, layout.global_index[rows], layout.global_index[columns]
    )
    solver.matrix.setValuesCOO(matrix.values[: matrix.n_entries])
    return dense(solver.matrix, comm)


def reference(comm, forms):
    matrix = assemble_matrix(forms, kind="mpi")
    matrix.assemble()
    return dense(matrix, comm)


def test_entries_are_those_of_dolfinx(comm, system):
    layout, forms, weight, matrix = system
    matrix.assemble()
    expected = reference(comm, forms)
    np.testing.assert_allclose(assembled(comm, layout, matrix), expected, rtol=0, atol=1e-13)
    # A second assembly replaces the first, and coefficients are read anew.
    weight.x.array[:] *= 3.0
    matrix.assemble()
    changed = reference(comm, forms)
    assert np.abs(changed - expected).max() > 1.0
    np.testing.assert_allclose(assembled(comm, layout, matrix), changed, rtol=0, atol=1e-13)


def test_product_with_a_local_vector(comm, system):
    layout, forms, _, matrix = system
    matrix.assemble()
    x = np.sin(np.arange(layout.n_global))
    product = matrix.multiply(x[layout.global_index])
    layout.add_ghosts_to_owners(product)
    expected = reference(comm, forms) @ x
    np.testing.assert_allclose(product, expected[layout.global_index], rtol=0, atol=1e-12)


def test_reserved_room_is_left_alone(comm, system):
    layout, forms, _, matrix = system
    matrix.reserve(5)
    matrix.values[matrix.n_entries :] = np.arange(5)
    matrix.assemble()
    assert matrix.values.size == matrix.n_entries + 5
    np.testing.assert_array_equal(matrix.values[matrix.n_entries :], np.arange(5))
    np.testing.assert_allclose(
        assembled(comm, layout, matrix), reference(comm, forms), rtol=0, atol=1e-13
    )
