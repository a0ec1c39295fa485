# SPDX-License-Identifier: LGPL-3.0-or-later
"""Condition number of the diagonally normalised matrix of a linear system (Eq. 95)."""

from __future__ import annotations

from collections.abc import Callable

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.sparse

from .linear import LinearSolver, SingularSystemError

EXACT_SIZE = 2000
"""Most unknowns whose singular values are all computed, in seconds; more are estimated."""

TOLERANCE = 1e-4
"""Relative residual of the largest eigenvalue, whose own error is smaller yet."""

MAX_STEPS = 100
"""Lanczos steps; if not enough, 0.5 % are missing on average (Kuczynski, Wozniakowski 1992)."""

SINGULAR = 1.0 / np.finfo(float).eps
"""From here on round-off alone makes a matrix singular."""

PLAIN_LU = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
"""Solver that divides by any pivot: a matrix of condition 1e15 is not refused."""


def condition_number(solver: LinearSolver, free: npt.NDArray[np.bool_]) -> float:
    """Condition number, in the 2-norm, of the scaled matrix as it is now. Collective.

    Rows of prescribed unknowns are left out. They are rows and columns of the identity, but not
    harmless: the singular values of [[1, 10], [-10, 1]] are both 10.05, with a row of the identity
    beside them the condition number is 10.05 instead of 1.

    Args:
        solver: Linear system; the factors of a direct solver are used.
        free: Owned unknowns that count; no entry couples them with others; shape (n_owned,).

    Returns:
        Largest by smallest singular value, on all ranks, exact up to `EXACT_SIZE` unknowns,
        estimated beyond; infinite where the system is singular to working precision.

    Raises:
        RuntimeError: If the linear solver fails for another reason, or an entry is not a number.
    """
    if not np.isfinite(solver.matrix.norm()):
        raise RuntimeError("the matrix of the linear system has entries that are not numbers")
    n_free = solver.matrix.comm.tompi4py().allreduce(int(np.count_nonzero(free)))
    condition = exact_condition if n_free <= EXACT_SIZE else estimated_condition
    return condition(solver, free)


def normalised_condition(matrix: scipy.sparse.sparray) -> float:
    """Condition number of a matrix of one rank, after diagonal normalisation (Eq. 95).

    Args:
        matrix: Square matrix, in any units.

    Returns:
        As `condition_number`.
    """
    entries = scipy.sparse.coo_array(matrix)
    rows, columns = (k.astype(np.int32) for k in (entries.row, entries.col))
    n = entries.shape[0]
    solver = LinearSolver(MPI.COMM_SELF, n, rows, columns, PLAIN_LU)
    solver.set_values(entries.data)
    return condition_number(solver, np.ones(n, bool))


def exact_condition(solver: LinearSolver, free: npt.NDArray[np.bool_]) -> float:
    """Condition number from all singular values of the matrix, dense on rank 0; see above."""
    matrix, comm = solver.matrix, solver.matrix.comm.tompi4py()
    indptr, columns, values = matrix.getValuesCSR()
    rows = np.repeat(np.arange(*matrix.getOwnershipRange()), np.diff(indptr))
    parts = comm.gather((free, rows, columns, values))
    result = None
    if parts is not None:
        counts, rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
        full = scipy.sparse.csr_array((values, (rows, columns)), shape=matrix.getSize())
        sizes = np.linalg.svd(full[counts][:, counts].toarray(), compute_uv=False)
        result = _ratio(sizes[0], 1.0 / sizes[-1] if sizes[-1] else np.inf) if sizes.size else 1.0
    return float(comm.bcast(result))


def estimated_condition(solver: LinearSolver, free: npt.NDArray[np.bool_]) -> float:
    """Condition number from products and solutions with the matrix and its transpose; see above.

    Largest eigenvalues of A^T A and of its inverse, by Lanczos' method.
    """
    A, ksp = solver.matrix, solver.ksp
    start, y = A.createVecs()
    # Zero where prescribed, and so it stays: no entry leads there.
    start.array[:] = free * np.random.default_rng(start.owner_range[0]).standard_normal(free.size)
    try:
        # Sets the solver up, finds null pivots; a product, lest a large solution be taken for one.
        solver.solve((A @ start).array / solver.scale)
    except SingularSystemError:
        return np.inf
    except RuntimeError:
        if ksp.getPC().getFailedReason() == PETSc.PC.FailedReason.FACTOR_NUMERIC_ZEROPIVOT:
            return np.inf
        raise

    def normal(x: PETSc.Vec) -> None:
        A.mult(x, y)
        A.multTranspose(y, x)

    def inverse(x: PETSc.Vec) -> None:
        for solve, b, solution in ((ksp.solveTranspose, x, y), (ksp.solve, y, x)):
            solve(b, solution)
            if ksp.getConvergedReason() < 0:
                raise RuntimeError(
                    f"no solution to estimate with (PETSc {ksp.getConvergedReason()})"
                )

    return _ratio(*(np.sqrt(_largest_eigenvalue(apply, start)) for apply in (normal, inverse)))


def _largest_eigenvalue(apply: Callable[[PETSc.Vec], None], start: PETSc.Vec) -> float:
    """Largest eigenvalue of a positive operator that overwrites its argument; not finite if none.

    Of a Krylov space's extreme eigenvalue, lost orthogonality only makes copies.
    """
    v, before, w = start.copy(), start.duplicate(), start.duplicate()
    v.normalize()
    largest, beta = 0.0, 0.0
    diagonal: list[float] = []
    beside: list[float] = []
    for step in range(MAX_STEPS):
        v.copy(w)
        apply(w)
        w.axpy(-beta, before)
        diagonal.append(w.dot(v))
        w.axpy(-diagonal[-1], v)
        beta = w.norm()
        if not np.isfinite(beta):
            return np.inf
        values, vectors = scipy.linalg.eigh_tridiagonal(
            diagonal, beside, select="i", select_range=(step, step)
        )
        largest = float(values[0])
        if beta * abs(vectors[-1, 0]) <= TOLERANCE * largest:
            break
        beside.append(beta)
        w.scale(1.0 / beta)
        v, before, w = w, v, before
    return largest


def _ratio(largest: float, of_inverse: float) -> float:
    """Condition number from the norms of a matrix and its inverse."""
    result = largest * of_inverse
    return float(result) if result < SINGULAR else np.inf
