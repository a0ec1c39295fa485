# SPDX-License-Identifier: LGPL-3.0-or-later
from mpi4py import MPI  # noqa: F401
from petsc4py import PETSc

import numpy as np
import pytest
from scipy import sparse

from fenicsx_hmcontact.solvers import LinearSolver, SingularSystemError
from tests.models import dense

pytestmark = pytest.mark.mpi

N = 30


def random_system(comm, seed=0, decades=6):
    """Entries of an indefinite matrix, badly scaled; each on a random rank, some in two parts."""
    rng = np.random.default_rng(seed)
    A = sparse.random_array((N, N), density=0.15, rng=rng).tolil()
    A.setdiag(rng.choice([-2.0, 2.0], N))
    scale = 10.0 ** rng.uniform(-decades, decades, N)
    A = sparse.coo_array(A.toarray() * np.outer(scale, scale))
    rows, columns, values = np.tile(A.row, 2), np.tile(A.col, 2), np.tile(A.data / 2, 2)
    mine = rng.integers(comm.size, size=rows.size) == comm.rank
    owned = N // comm.size + (comm.rank < N % comm.size)
    first = comm.exscan(owned) or 0
    part = rows[mine].astype(np.int32), columns[mine].astype(np.int32), values[mine]
    return A.toarray(), *part, owned, slice(first, first + owned)


def test_solves_like_numpy(comm):
    A, rows, columns, values, owned, part = random_system(comm)
    solver = LinearSolver(comm, owned, rows, columns)
    solver.set_values(values)
    assert solver.n_factorisations == 1
    # A solution in the units of the matrix: its entries span 24 decades.
    x = np.cos(np.arange(N)) / np.sqrt(np.abs(np.diag(A)))
    np.testing.assert_allclose(solver.solve((A @ x)[part]), x[part], rtol=1e-10)


def test_matrix_has_unit_diagonal_up_to_sign(comm):
    A, rows, columns, values, owned, part = random_system(comm)
    solver = LinearSolver(comm, owned, rows, columns)
    for factor in (1.0, 16.0):
        solver.set_values(factor * values)
        np.testing.assert_allclose(
            solver.scale, 1 / np.sqrt(factor * np.abs(np.diag(A)))[part], rtol=1e-14
        )
        scaled = dense(solver.matrix, comm)
        np.testing.assert_allclose(np.diag(scaled), np.sign(np.diag(A)), rtol=1e-14)
        s = np.concatenate(comm.allgather(solver.scale))
        np.testing.assert_allclose(scaled / np.outer(s, s), factor * A, rtol=1e-12)
    assert solver.n_factorisations == 2


def test_diagonal_is_added_to_until_values_are_set_again(comm):
    A, rows, columns, values, owned, part = random_system(comm, decades=1)
    solver = LinearSolver(comm, owned, rows, columns)
    more = np.linspace(0.0, 1.0, N)
    scale = 1.0 / np.sqrt(np.abs(np.diag(A)))
    for added in (more, 0.0 * more):
        solver.set_values(values)
        solver.add_to_diagonal(added[part])
        x = np.cos(np.arange(N))
        b = (A + np.diag(added / scale**2)) @ x
        np.testing.assert_allclose(solver.solve(b[part]), x[part], rtol=1e-9)


def test_negative_entries_are_dropped(comm):
    A, rows, columns, values, owned, _ = random_system(comm, decades=0)
    rows = np.concatenate((rows, np.full(3, -1, np.int32)))
    columns = np.concatenate((columns, np.full(3, -1, np.int32)))
    solver = LinearSolver(comm, owned, rows, columns)
    solver.matrix.setValuesCOO(np.concatenate((values, np.full(3, 1e6))))
    np.testing.assert_allclose(dense(solver.matrix, comm), A, rtol=0, atol=1e-13)


def test_default_is_mumps(comm):
    _, rows, columns, _, owned, _ = random_system(comm)
    ksp = LinearSolver(comm, owned, rows, columns).ksp
    assert (ksp.type, ksp.pc.type, ksp.pc.getFactorSolverType()) == ("preonly", "lu", "mumps")


@pytest.mark.parametrize(
    "options",
    [
        {"ksp_type": "gmres", "pc_type": "jacobi", "ksp_rtol": 1e-13, "ksp_max_it": 500},
        {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "superlu_dist"},
    ],
)
def test_options_reach_petsc_under_a_prefix_of_their_own(comm, options):
    A, rows, columns, values, owned, part = random_system(comm, decades=1)
    before = PETSc.Options().getAll()
    solver = LinearSolver(comm, owned, rows, columns, options)
    assert (solver.ksp.type, solver.ksp.pc.type) == (options["ksp_type"], options["pc_type"])
    if "pc_factor_mat_solver_type" in options:
        assert solver.ksp.pc.getFactorSolverType() == options["pc_factor_mat_solver_type"]
    solver.set_values(values)
    x = np.sin(np.arange(N))
    np.testing.assert_allclose(solver.solve((A @ x)[part]), x[part], rtol=0, atol=1e-8)
    assert PETSc.Options().getAll() == before


def test_unknown_option_is_named(comm):
    _, rows, columns, values, owned, _ = random_system(comm, decades=0)
    options = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_tpye": "mumps"}
    options["pc_factor_mat_solver_type"] = "mumps"
    solver = LinearSolver(comm, owned, rows, columns, options)
    solver.set_values(values)
    with pytest.raises(ValueError, match="has no option pc_factor_mat_solver_tpye"):
        solver.solve(np.ones(owned))


def test_singular_to_working_precision_is_refused(comm):
    """Two nearly equal rows: with a solver that does not count null pivots."""
    owned = 2 if comm.rank == 0 else 0
    rows = np.array([0, 0, 1, 1][: 2 * owned], np.int32)
    columns = np.array([0, 1, 0, 1][: 2 * owned], np.int32)
    options = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "superlu_dist"}
    solver = LinearSolver(comm, owned, rows, columns, options)
    solver.set_values(np.array([1.0, 1.0, 1.0, 1.0 + 1e-14][: 2 * owned]))
    with pytest.raises(SingularSystemError, match="singular to working precision"):
        solver.solve(np.array([1.0, -1.0][:owned]))


def test_two_solvers_do_not_share_options(comm):
    _, rows, columns, _, owned, _ = random_system(comm)
    gmres = LinearSolver(
        comm, owned, rows.copy(), columns.copy(), {"ksp_type": "gmres", "pc_type": "jacobi"}
    )
    other = LinearSolver(comm, owned, rows, columns)
    assert (gmres.ksp.type, other.ksp.type) == ("gmres", "preonly")


def test_singular_matrix_is_refused(comm):
    _, rows, columns, values, owned, _ = random_system(comm, decades=0)
    values[(rows == 3) | (columns == 3)] = 0.0
    solver = LinearSolver(comm, owned, rows, columns)
    solver.set_values(values)
    with pytest.raises(SingularSystemError, match="singular, 1 motions or pressures are free"):
        solver.solve(np.ones(owned))


def test_options_of_the_factorisation_reach_it(comm):
    # PETSc reads them when it factorises, not when the solver is made.
    _, rows, columns, values, owned, _ = random_system(comm, decades=0)
    options = {
        "ksp_type": "preonly",
        "pc_type": "lu",
        "pc_factor_mat_solver_type": "mumps",
        "mat_mumps_icntl_14": 77,
    }
    solver = LinearSolver(comm, owned, rows, columns, options)
    solver.set_values(values)
    solver.solve(np.ones(owned))
    assert solver.ksp.pc.getFactorMatrix().getMumpsIcntl(14) == 77


def test_solver_that_is_not_there_is_reported(comm):
    _, rows, columns, values, owned, _ = random_system(comm, decades=0)
    options = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "nonesuch"}
    solver = LinearSolver(comm, owned, rows, columns, options)
    solver.set_values(values)
    with pytest.raises(RuntimeError, match="the linear solver cannot be used here"):
        solver.solve(np.ones(owned))


def test_discarded_solvers_are_destroyed(comm):
    if comm.size > 2:
        pytest.skip("takes a minute where ranks share cores")
    # MPI has some 2000 communicators, and each factorisation takes one.
    row = np.zeros(1, np.int32) + comm.rank
    for _ in range(2200):
        mesh_comm = comm.Dup()
        solver = LinearSolver(mesh_comm, 1, row.copy(), row.copy())
        solver.set_values(np.ones(1))
        solver.solve(np.ones(1))
        del solver
        mesh_comm.Free()
