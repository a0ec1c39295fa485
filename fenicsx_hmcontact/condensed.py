# SPDX-License-Identifier: LGPL-3.0-or-later
"""The matrix that is solved with: tangent, condensation, contact conditions and films in one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from ._kernels import sparse as kernels
from .contact import Condensation
from .solvers import FieldLayout, LinearSolver, LocalMatrix

LOOSE = 2.0
"""A pattern with so many times the entries in use is laid out anew."""


class CondensedMatrix:
    """Condensed matrix W^T K T and what is added to it, in PETSc, with the solver.

    Args:
        layout: Numbering of the unknowns.
        tangent: The tangent K of each rank.
        condensation: The transformations T and W.
        constrained: Which local unknowns are prescribed.
        petsc_options: Options of the linear solver.

    Attributes:
        linear: Solver; None before the first `set_values`.
        free: Owned unknowns that are neither prescribed nor closed for good.
        n_factorisations: How often the values have been set.
    """

    def __init__(
        self,
        layout: FieldLayout,
        tangent: LocalMatrix,
        condensation: Condensation,
        constrained: npt.NDArray[np.bool_],
        petsc_options: Mapping[str, Any] | None,
    ) -> None:
        self._layout = layout
        self._tangent = tangent
        self._condensation = condensation
        self._constrained = constrained
        self._options = petsc_options
        self.linear: LinearSolver | None = None
        self.n_factorisations = 0
        closed = condensation.unknowns[condensation.closed]
        self.free = ~constrained[layout.owned]
        self.free[closed[layout.owns(closed)] - layout.first] = False

        touched = condensation.gather(constrained.astype(float)) > 0.0
        fixed = touched | condensation.closed
        # Columns of T and W that an unknown stands for.
        self._targets = np.where(fixed, -1, condensation.unknowns).astype(np.int32)
        rows, columns = tangent.entries()
        self._slots = condensation.slots
        self._involved = np.flatnonzero((self._slots[rows] >= 0) | (self._slots[columns] >= 0))
        self._entries = rows[self._involved], columns[self._involved]
        # Where each condensed unknown is in use, the same on all ranks
        n = condensation.unknowns.size
        self._tests, self._trials, self._added = (_Pattern(n) for _ in range(3))

    def set_values(self, added: csr_array) -> None:
        """Condense the tangent and add to it at the touched unknowns. Collective.

        Args:
            added: What is added; shape (n, n).
        """
        condensation = self._condensation
        patterns = self._tests, self._trials, self._added
        matrices = condensation.tests, condensation.transformation, added
        new = any([p.admit(m) for p, m in zip(patterns, matrices, strict=True)])
        if self._layout.comm.allreduce(new) or self.linear is None:
            self._lay_out()
        assert self.linear is not None
        values, first = self._tangent.values, self._tangent.n_entries
        source, factor = self._expand(condensation.tests, condensation.transformation)[:2]
        parts = (
            factor * values[self._involved[source]],
            self._added.values(added)[self._added_here],
            np.ones(np.count_nonzero(~self.free)),
        )
        values[first:] = np.concatenate(parts)
        self.linear.set_values(values)
        self.n_factorisations += 1

    def _lay_out(self) -> None:
        """Lay the matrix out: entries of K, of condensation, what is added, and the identity."""
        layout, condensation = self._layout, self._condensation
        rows, columns = self._tangent.entries()
        keep = ~(self._constrained | (self._slots >= 0))
        dropped = ~(keep[rows] & keep[columns])
        rows, columns = layout.global_index[rows], layout.global_index[columns]
        rows[dropped] = -1
        columns[dropped] = -1
        _, _, *condensed = self._expand(condensation.tests, condensation.transformation)
        i, j = self._added.entries()
        free_entry = (self._targets[i] >= 0) & (self._targets[j] >= 0)
        self._added_here = free_entry & layout.owns(condensation.unknowns[i])
        added = (condensation.unknowns[k[self._added_here]] for k in (i, j))
        identity = layout.first + np.flatnonzero(~self.free)
        all_rows, all_columns = (
            np.concatenate((bulk, extra, more, identity)).astype(np.int32)
            for bulk, extra, more in zip((rows, columns), condensed, added, strict=True)
        )
        self._tangent.reserve(all_rows.size - rows.size)
        self.linear = LinearSolver(
            layout.comm, layout.owned.size, all_rows, all_columns, self._options
        )

    def _expand(self, tests: csr_array, trials: csr_array) -> tuple[Any, ...]:
        """Entries of W^T K T from secondary rows and columns: source, factor, row and column."""
        maps = []
        for pattern, matrix in ((self._tests, tests), (self._trials, trials)):
            _, columns = pattern.entries()
            targets = self._targets[columns]
            maps += [pattern.indptr, targets, pattern.values(matrix)]
        return kernels.expand_entries(
            *self._entries, self._layout.global_index, self._constrained, self._slots, *maps
        )


class _Pattern:
    """Pattern of a sparse matrix that changes: it grows with what it is shown."""

    def __init__(self, n: int) -> None:
        self._pattern = csr_array((n, n), dtype=np.int8)

    def admit(self, matrix: csr_array) -> bool:
        """Take the entries of a matrix in; return whether the pattern has changed."""
        ones = np.ones(matrix.indices.size, np.int8)
        # A copy: the pattern sorts its columns.
        entries = csr_array((ones, matrix.indices, matrix.indptr), shape=matrix.shape, copy=True)
        union = (self._pattern + entries).astype(bool).astype(np.int8)
        if union.nnz == self._pattern.nnz:
            return False
        self._pattern = entries if union.nnz > LOOSE * entries.nnz else union
        self._pattern.sum_duplicates()
        return True

    @property
    def indptr(self) -> npt.NDArray[np.int32]:
        """CSR offsets of the rows."""
        return self._pattern.indptr

    def entries(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """Row and column of each entry."""
        pattern = self._pattern
        rows = np.repeat(np.arange(pattern.shape[0], dtype=np.int32), np.diff(pattern.indptr))
        return rows, pattern.indices

    def values(self, matrix: csr_array) -> npt.NDArray[np.float64]:
        """Entries of a matrix in the order of the pattern."""
        entries = matrix.tocoo()
        at = kernels.find_positions(
            self._pattern.indptr, self._pattern.indices, entries.row, entries.col
        )
        return np.bincount(at, entries.data, self._pattern.nnz)
