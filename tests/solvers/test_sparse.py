# SPDX-License-Identifier: LGPL-3.0-or-later
"""Kernels of sparse patterns against dense matrices."""

import numpy as np
import pytest
from scipy import sparse

from fenicsx_hmcontact._kernels.sparse import expand_columns, expand_entries, find_positions


def pattern(n_rows, n_columns, density, seed):
    matrix = sparse.random_array(
        (n_rows, n_columns), density=density, rng=np.random.default_rng(seed), format="csr"
    )
    matrix.sort_indices()
    return matrix


def test_positions_are_those_of_the_dense_matrix():
    matrix = pattern(13, 9, 0.3, 0)
    assert np.any(np.diff(matrix.indptr) == 0)
    expected = np.full(matrix.shape, -1)
    expected[matrix.nonzero()] = np.arange(matrix.nnz)
    rows, columns = (a.ravel().astype(np.int32) for a in np.indices(matrix.shape))
    found = find_positions(matrix.indptr, matrix.indices, rows, columns)
    np.testing.assert_array_equal(found, expected.ravel())


@pytest.mark.parametrize("block", [(1, 1), (2, 1), (1, 2), (2, 3)])
def test_expanded_columns_are_those_of_the_kronecker_product(block):
    matrix = pattern(7, 11, 0.35, 1)
    expected = sparse.kron(matrix, np.ones(block), format="csr")
    expected.sort_indices()
    columns = expand_columns(matrix.indptr, matrix.indices, *block)
    np.testing.assert_array_equal(columns, expected.indices)


@pytest.mark.parametrize("seed", range(3))
def test_expanded_entries_make_the_triple_product(seed):
    rng = np.random.default_rng(seed)
    n, n_global = 20, 40
    K = sparse.random_array((n, n), density=0.4, rng=rng, format="coo")
    numbers = rng.permutation(n_global)[:n].astype(np.int32)
    condensed = rng.permutation(n)[:6]
    constrained = rng.random(n) < 0.3
    constrained[condensed] = False

    # Rows at condensed unknowns reach any free global number, also unknowns not seen here.
    free = np.setdiff1d(np.arange(n_global), numbers[constrained])

    def transformation():
        """Dense, and its rows at condensed unknowns."""
        rows = np.zeros((6, n_global))
        rows[:, free] = sparse.random_array((6, free.size), density=0.2, rng=rng).toarray()
        matrix = np.zeros((n, n_global))
        matrix[np.arange(n), numbers] = ~constrained
        matrix[condensed] = rows
        return matrix, sparse.csr_array(rows)

    (W, row_weights), (T, column_weights) = transformation(), transformation()
    expected = W.T @ K.toarray() @ T

    slots = np.full(n, -1, np.int32)
    slots[condensed] = np.arange(6)
    source, factor, new_rows, new_columns = expand_entries(
        K.row.astype(np.int32),
        K.col.astype(np.int32),
        numbers,
        constrained,
        slots,
        row_weights.indptr,
        row_weights.indices.astype(np.int32),
        row_weights.data,
        column_weights.indptr,
        column_weights.indices.astype(np.int32),
        column_weights.data,
    )
    assert np.all((slots[K.row[source]] >= 0) | (slots[K.col[source]] >= 0))
    result = np.zeros((n_global, n_global))
    np.add.at(result, (new_rows, new_columns), factor * K.data[source])
    # The entries away from condensed unknowns stay where they were.
    kept = (slots[K.row] < 0) & (slots[K.col] < 0) & ~constrained[K.row] & ~constrained[K.col]
    np.add.at(result, (numbers[K.row[kept]], numbers[K.col[kept]]), K.data[kept])
    assert np.abs(result - expected).max() < 1e-14 * np.abs(expected).max()
