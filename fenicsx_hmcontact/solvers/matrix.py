# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tangent as each rank assembles it: terms on triangles and on node cells in one pattern."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import scipy.sparse
from dolfinx import fem

from .. import _compat
from .._kernels import sparse as kernels
from ..smoothing import SmoothedTerm
from .layout import FieldLayout


@dataclass
class _Block:
    """Coupling of two fields: a CSR matrix over local unknowns and what fills it.

    PETSc, through which DOLFINx assembles, and the node-cell kernels add to the same values.
    """

    test: int
    trial: int
    form: fem.Form | None
    terms: Sequence[SmoothedTerm]
    indptr: npt.NDArray[np.int32] = field(init=False)
    indices: npt.NDArray[np.int32] = field(init=False)
    values: npt.NDArray[np.float64] = field(init=False)
    by_dolfinx: _compat.LocalPetscMatrix | None = field(init=False, default=None)


class LocalMatrix:
    """Tangent of all fields on one rank, contributions to ghost rows not yet sent to their owners.

    Args:
        layout: Numbering of the unknowns.
        forms: For each pair of fields the compiled form of the terms on triangles and facets, or
            None.
        terms: For each pair of fields the terms on node cells.

    Attributes:
        n_entries: Number of entries of all blocks.
        values: All entries, block after block; `reserve` adds room at the end.
    """

    def __init__(
        self,
        layout: FieldLayout,
        forms: Sequence[Sequence[fem.Form | None]],
        terms: Sequence[Sequence[Sequence[SmoothedTerm]]],
    ) -> None:
        self._layout = layout
        self._blocks = [
            _Block(i, j, forms[i][j], terms[i][j])
            for i in range(len(forms))
            for j in range(len(forms))
            if forms[i][j] is not None or terms[i][j]
        ]
        for block in self._blocks:
            self._build_pattern(block)
        self.n_entries = sum(block.indices.size for block in self._blocks)
        self.values = np.zeros(0)
        self.reserve(0)

    def reserve(self, n_extra: int) -> None:
        """Allocate the values, with room for ``n_extra`` entries after those of the blocks."""
        kept = self.values[: self.n_entries]
        self.values = np.zeros(self.n_entries + n_extra)
        self.values[: kept.size] = kept
        first = 0
        for block in self._blocks:
            block.values = self.values[first : first + block.indices.size]
            first += block.indices.size
            if block.form is not None:
                n_columns = self._size(block.trial)
                block.by_dolfinx = _compat.LocalPetscMatrix(
                    block.indptr, block.indices, block.values, n_columns
                )

    def assemble(self) -> None:
        """Assemble all blocks at the current values of functions and constants."""
        self.values[: self.n_entries] = 0.0
        for block in self._blocks:
            if block.by_dolfinx is not None:
                block.by_dolfinx.add(block.form)
            for term in block.terms:
                term.add_to_matrix(block.values)

    def diagonal(self) -> npt.NDArray[np.float64]:
        """Diagonal of the blocks of each field with itself; lacks what other ranks add to it."""
        result = np.zeros(self._layout.n_local)
        fields = self._layout.views(result)
        for block in self._blocks:
            if block.test == block.trial:
                size = fields[block.test].size
                matrix = scipy.sparse.csr_matrix(
                    (block.values, block.indices, block.indptr), shape=(size, size)
                )
                fields[block.test][:] = matrix.diagonal()
        return result

    def multiply(self, x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Multiply with a local vector; the result lacks what other ranks add to it."""
        result = np.zeros(self._layout.n_local)
        x_fields, y_fields = self._layout.views(x), self._layout.views(result)
        for block in self._blocks:
            matrix = scipy.sparse.csr_matrix(
                (block.values, block.indices, block.indptr),
                shape=(y_fields[block.test].size, x_fields[block.trial].size),
            )
            y_fields[block.test] += matrix @ x_fields[block.trial]
        return result

    def entries(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """Local row and column of each entry of ``values``."""
        rows = np.empty(self.n_entries, np.int32)
        columns = np.empty(self.n_entries, np.int32)
        first = 0
        for block in self._blocks:
            part = slice(first, first + block.indices.size)
            lengths = np.diff(block.indptr)
            rows[part] = self._layout.offsets[block.test] + np.repeat(
                np.arange(lengths.size), lengths
            )
            columns[part] = self._layout.offsets[block.trial] + block.indices
            first += block.indices.size
        return rows, columns

    def _size(self, field: int) -> int:
        return int(self._layout.offsets[field + 1] - self._layout.offsets[field])

    def _build_pattern(self, block: _Block) -> None:
        a, b = (self._layout.block_sizes[f] for f in (block.test, block.trial))
        shape = (self._size(block.test) // a, self._size(block.trial) // b)
        pairs = [term.pairs() for term in block.terms]
        if block.form is not None:
            rows, columns = _compat.block_pairs(block.form)
            # Columns that this rank does not see belong to what other ranks send.
            seen = columns < shape[1]
            pairs.append((rows[seen], columns[seen]))
        all_rows = np.concatenate([rows for rows, _ in pairs])
        all_columns = np.concatenate([columns for _, columns in pairs])
        pattern = scipy.sparse.coo_matrix(
            (np.ones(all_rows.size, np.int8), (all_rows, all_columns)), shape
        ).tocsr()
        pattern.sort_indices()
        lengths = np.diff(pattern.indptr)
        for term, (rows, columns) in zip(block.terms, pairs, strict=False):
            found = kernels.find_positions(pattern.indptr, pattern.indices, rows, columns)
            # First entry of the block: all rows above, then those before it in its own row.
            found += (a - 1) * pattern.indptr[rows]
            term.set_positions(found * b, lengths * b)
        block.indptr = np.concatenate(([0], np.cumsum(np.repeat(lengths * b, a)))).astype(np.int32)
        block.indices = kernels.expand_columns(pattern.indptr, pattern.indices, a, b)
