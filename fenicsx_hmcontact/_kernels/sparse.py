# SPDX-License-Identifier: LGPL-3.0-or-later
"""Sparse patterns: positions of entries, and the expansion of condensed rows and columns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True)
def find_positions(indptr: Any, indices: Any, rows: Any, columns: Any) -> Any:
    """Position of each (row, column) in a CSR pattern with sorted columns; -1 where it has none."""
    positions = np.empty(rows.size, np.int32)
    for k in range(rows.size):
        low, high = indptr[rows[k]], indptr[rows[k] + 1]
        end = high
        while low < high:
            middle = (low + high) // 2
            if indices[middle] < columns[k]:
                low = middle + 1
            else:
                high = middle
        positions[k] = low if low < end and indices[low] == columns[k] else -1
    return positions


@njit(cache=True)
def expand_columns(indptr: Any, indices: Any, rows: int, columns: int) -> Any:
    """Column of each entry of a CSR matrix whose blocks of (rows, columns) have a CSR pattern."""
    result = np.empty(indices.size * rows * columns, np.int32)
    at = 0
    for i in range(indptr.size - 1):
        for _ in range(rows):
            for k in range(indptr[i], indptr[i + 1]):
                for b in range(columns):
                    result[at] = indices[k] * columns + b
                    at += 1
    return result


@njit(cache=True)
def expand_entries(
    rows: Any,
    columns: Any,
    global_index: Any,
    constrained: Any,
    slots: Any,
    row_offsets: Any,
    row_targets: Any,
    row_weights: Any,
    column_offsets: Any,
    column_targets: Any,
    column_weights: Any,
) -> Any:
    """Entries of W^T K T that stem from entries of K in a condensed row or column (Eq. 66).

    Args:
        rows: Local row of each entry of K.
        columns: Local column of each entry.
        global_index: Global number of each local unknown.
        constrained: Whether a local unknown is prescribed; its rows and columns are left out.
        slots: Row of W and T of each local unknown, -1 where they are the identity.
        row_offsets: CSR offsets of the rows of W.
        row_targets: Global columns of W; -1 for what is left out.
        row_weights: Entries of W.
        column_offsets: The same of T.
        column_targets: The same of T.
        column_weights: The same of T.

    Returns:
        Entry of K that each new entry stems from, its factor, its global row and column, -1 for
        both where it is left out.
    """
    count = 0
    for k in range(rows.size):
        r, c = slots[rows[k]], slots[columns[k]]
        n_r = row_offsets[r + 1] - row_offsets[r] if r >= 0 else int(not constrained[rows[k]])
        n_c = column_offsets[c + 1] - column_offsets[c] if c >= 0 else 1
        if c < 0 and (r < 0 or constrained[columns[k]]):
            n_c = 0
        count += n_r * n_c
    source = np.empty(count, np.int64)
    factor = np.empty(count)
    new_rows = np.empty(count, np.int32)
    new_columns = np.empty(count, np.int32)
    at = 0
    for k in range(rows.size):
        r, c = slots[rows[k]], slots[columns[k]]
        if (r < 0 and c < 0) or (r < 0 and constrained[rows[k]]):
            continue
        if c < 0 and constrained[columns[k]]:
            continue
        first_i, last_i = (row_offsets[r], row_offsets[r + 1]) if r >= 0 else (0, 1)
        first_j, last_j = (column_offsets[c], column_offsets[c + 1]) if c >= 0 else (0, 1)
        for i in range(first_i, last_i):
            row = row_targets[i] if r >= 0 else global_index[rows[k]]
            weight = row_weights[i] if r >= 0 else 1.0
            for j in range(first_j, last_j):
                column = column_targets[j] if c >= 0 else global_index[columns[k]]
                left_out = row < 0 or column < 0
                source[at] = k
                factor[at] = weight * (column_weights[j] if c >= 0 else 1.0)
                new_rows[at] = -1 if left_out else row
                new_columns[at] = -1 if left_out else column
                at += 1
    return source, factor, new_rows, new_columns


@njit(cache=True)
def patch_pairs(
    cells: Any,
    offsets: Any,
    nodes: Any,
    row_dofs: Any,
    column_dofs: Any,
    by_rows: bool,
    by_columns: bool,
) -> Any:
    """Rows and columns that node cells couple, cell by cell, repetitions included.

    Args:
        cells: The cells.
        offsets: Where each cell's patch begins in ``nodes``.
        nodes: Nodes of the patches, the cell's own node first.
        row_dofs: Row of each node.
        column_dofs: Column of each node.
        by_rows: Whether all nodes of a patch have a row, or the cell's own alone.
        by_columns: The same of columns.

    Returns:
        Where the pairs of each cell begin, rows and columns.
    """
    begins = np.zeros(cells.size + 1, np.int64)
    for k in range(cells.size):
        n = offsets[cells[k] + 1] - offsets[cells[k]]
        begins[k + 1] = begins[k] + (n if by_rows else 1) * (n if by_columns else 1)
    rows, columns = np.empty(begins[-1], np.int32), np.empty(begins[-1], np.int32)
    at = 0
    for cell in cells:
        first, last = offsets[cell], offsets[cell + 1]
        for i in range(first, last if by_rows else first + 1):
            for j in range(first, last if by_columns else first + 1):
                rows[at], columns[at] = row_dofs[nodes[i]], column_dofs[nodes[j]]
                at += 1
    return begins, rows, columns
