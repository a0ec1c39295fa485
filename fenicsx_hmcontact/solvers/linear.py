# SPDX-License-Identifier: LGPL-3.0-or-later
"""The global linear system: PETSc matrix, symmetric diagonal scaling, and the solver."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import numpy.typing as npt

DEFAULT_OPTIONS = {
    "ksp_type": "preonly",
    "pc_type": "lu",
    "pc_factor_mat_solver_type": "mumps",
    # Report pivots below round-off of a matrix with unit diagonal, instead of dividing by them.
    "mat_mumps_icntl_24": 1,
    "mat_mumps_cntl_3": -1e-13,
}
"""Direct solver: the systems are indefinite, and unsymmetric as soon as something slides."""

NULL_PIVOTS = 28
"""MUMPS' INFOG entry that counts them."""

MAX_GROWTH = 1e12
"""Largest solution of a scaled system, relative to its right-hand side, that has correct digits."""

_numbers = itertools.count()


class SingularSystemError(RuntimeError):
    """The linear system has no unique solution: something moves freely, or a pressure is unset."""


class LinearSolverError(RuntimeError):
    """The linear solver did not get to a solution: it does not converge, or entries are nan."""


class LinearSolver:
    """Matrix in coordinate form with a fixed pattern, scaled symmetrically before it is solved.

    Args:
        comm: Communicator.
        n_owned: Number of rows of this rank.
        rows: Global row of each entry; negative entries are dropped. Other ranks' rows are allowed.
        columns: Global column of each entry.
        options: PETSc options of the solver; `DEFAULT_OPTIONS` where None.

    Attributes:
        ksp: The PETSc solver, for the user to look at or change.
        matrix: The PETSc matrix, scaled: unit diagonal up to sign.
        scale: Factors 1/sqrt(abs(K_ii)) of the owned rows (Eq. 95).
        n_factorisations: How often the matrix has been set.
    """

    def __init__(
        self,
        comm: Any,
        n_owned: int,
        rows: npt.NDArray[np.int32],
        columns: npt.NDArray[np.int32],
        options: Mapping[str, Any] | None = None,
    ) -> None:
        comm = _lasting(comm)
        # On several ranks a discarded solver waits, with its factors, for this collective call.
        PETSc.garbage_cleanup(comm)
        self.matrix = PETSc.Mat().create(comm)
        self.matrix.setSizes(((n_owned, None), (n_owned, None)))
        self.matrix.setType(PETSc.Mat.Type.AIJ)
        self.matrix.setOption(PETSc.Mat.Option.IGNORE_ZERO_ENTRIES, False)
        # PETSc works in the index arrays it is given: they are not usable afterwards.
        self.matrix.setPreallocationCOO(rows, columns)
        self.scale = np.ones(n_owned)
        self.n_factorisations = 0
        self._x, self._b = self.matrix.createVecs()
        self.ksp = PETSc.KSP().create(comm)
        self._prefix = f"hmcontact_{next(_numbers)}_"
        self.ksp.setOptionsPrefix(self._prefix)
        self.ksp.setOperators(self.matrix)
        self._options = dict(DEFAULT_OPTIONS if options is None else options)
        with self._options_in_database():
            self.ksp.setFromOptions()

    def set_values(self, values: npt.NDArray[np.float64]) -> None:
        """Set the entries, in the order of the pattern, and scale the matrix. Collective."""
        self.matrix.setValuesCOO(values)
        diagonal = np.abs(self.matrix.getDiagonal().array)
        self.scale = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1)), 1)
        factors = self._x.duplicate()
        factors.array[:] = self.scale
        self.matrix.diagonalScale(factors, factors)
        self.ksp.setOperators(self.matrix)
        self.n_factorisations += 1

    def add_to_diagonal(self, values: npt.NDArray[np.float64]) -> None:
        """Add to the owned diagonal of the scaled matrix, until `set_values`. Collective."""
        self._b.array[:] = values
        self.matrix.setDiagonal(self._b, PETSc.InsertMode.ADD_VALUES)
        self.ksp.setOperators(self.matrix)

    def solve(self, b: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Solve for the owned unknowns. Collective.

        Args:
            b: Owned part of the right-hand side; shape (n_owned,).

        Returns:
            Owned part of the solution; shape (n_owned,).

        Raises:
            SingularSystemError: If the system is singular, to working precision or exactly.
            LinearSolverError: If the solver fails.
            RuntimeError: If the solver cannot be used here.
            ValueError: If an option is none of the solver's.
        """
        self._b.array[:] = self.scale * b
        try:
            if self._options:
                self._set_up()
            self.ksp.solve(self._b, self._x)
        except PETSc.Error as error:
            raise RuntimeError(f"the linear solver cannot be used here: {error}") from error
        reason = self.ksp.getConvergedReason()
        singular = self._null_pivots()
        if singular:
            raise SingularSystemError(
                f"the linear system is singular, {singular} motions or pressures are free: a body "
                "has no support, or a pore pressure is prescribed nowhere and not stored"
            )
        size = self._x.norm()
        if reason < 0 or not np.isfinite(size):
            raise LinearSolverError(
                f"the linear system could not be solved (PETSc reason {reason})"
            )
        if size > MAX_GROWTH * self._b.norm() > 0.0:
            raise SingularSystemError(
                "the linear system is singular to working precision: a body has no support, or a "
                "pore pressure is prescribed nowhere and not stored"
            )
        return self.scale * self._x.array

    @contextmanager
    def _options_in_database(self) -> Iterator[None]:
        database = PETSc.Options(self._prefix)
        for name, value in self._options.items():
            database[name] = value
        try:
            yield
        finally:
            for name in self._options:
                database.delValue(name)

    def _set_up(self) -> None:
        """Set the solver up, once: a factorisation reads its own options only now."""
        with self._options_in_database():
            self.ksp.setFromOptions()
            self.ksp.setUp()
            database = PETSc.Options()
            unused = [name for name in self._options if not database.used(self._prefix + name)]
        self._options = {}
        if unused:
            raise ValueError(f"the linear solver has no option {', '.join(unused)}")

    def _null_pivots(self) -> int:
        """Number of pivots that MUMPS found to be zero."""
        pc = self.ksp.getPC()
        if pc.getType() not in ("lu", "cholesky") or pc.getFactorSolverType() != "mumps":
            return 0
        return int(pc.getFactorMatrix().getMumpsInfog(NULL_PIVOTS))


def _lasting(comm: Any) -> Any:
    """The communicator of all ranks if ``comm``, a mesh's own duplicate, has the same ranks.

    PETSc keeps what is to be destroyed with the communicator, and a mesh's ends with the mesh.
    """
    same = MPI.Comm.Compare(comm, MPI.COMM_WORLD) <= MPI.CONGRUENT
    return MPI.COMM_WORLD if same else comm
