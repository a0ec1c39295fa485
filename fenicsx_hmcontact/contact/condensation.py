# SPDX-License-Identifier: LGPL-3.0-or-later
"""Condensation: secondary unknowns as relative ones plus what the primary surface does (Eq. 64).

With v all unknowns and a the condensed ones, v = a + X v, where the rows of X are those of H (and
of -C next to dropped nodes) at secondary unknowns and zero elsewhere. Hence v = T a with
T = (I - X)^-1: the matrix becomes T^T K T, the residual T^T r, and both keep their size (Eq. 66).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy.sparse

from .._kernels import sparse as kernels

if TYPE_CHECKING:
    from ..solvers import FieldLayout

MAX_CHAIN = 8
"""Longest chain of surfaces that are secondary in one pair and primary in the next."""


@dataclass(frozen=True)
class Dependence:
    """Rows of X of one pair and one field component, replicated on all ranks.

    Attributes:
        secondary: Global numbers of the secondary unknowns that keep a relative unknown; (n,).
        others: Global numbers of the unknowns they depend on, all of both surfaces; (m,).
        coefficients: Entries of X; shape (n, m), sparse.
        closed: Whether the relative unknown is zero (tied, closed gap); (n,).
    """

    secondary: npt.NDArray[np.int64]
    others: npt.NDArray[np.int64]
    coefficients: scipy.sparse.csr_matrix
    closed: npt.NDArray[np.bool_]


class Condensation:
    """The transformation T of all pairs. Its data are the same on all ranks.

    Args:
        dependences: Rows of X.
        layout: Numbering of the unknowns.

    Attributes:
        unknowns: Global numbers, ascending, of all unknowns that T touches; (n,).
        transformation: T restricted to them; (n, n).
        closed: Which of the condensed unknowns are zero; (n,).
        local: Positions in a local array of those of ``unknowns`` that this rank sees, and which
            they are.

    Raises:
        ValueError: If a node is secondary twice, or surfaces depend on each other in a circle.
    """

    def __init__(self, dependences: Sequence[Dependence], layout: FieldLayout) -> None:
        self._layout = layout
        parts = [part for d in dependences for part in (d.secondary, d.others)]
        self.unknowns = np.unique(np.concatenate(parts)) if parts else np.zeros(0, np.int64)
        n = self.unknowns.size
        rows, columns, entries = [], [], []
        self.closed = np.zeros(n, bool)
        secondary = np.zeros(n, np.int64)
        for d in dependences:
            s = np.searchsorted(self.unknowns, d.secondary)
            o = np.searchsorted(self.unknowns, d.others)
            secondary[s] += 1
            self.closed[s] = d.closed
            x = d.coefficients.tocoo()
            rows.append(s[x.row])
            columns.append(o[x.col])
            entries.append(x.data)
        if np.any(secondary > 1):
            raise ValueError(
                f"{int(np.sum(secondary > 1))} unknowns belong to the secondary surfaces of two "
                "pairs; let one of the surfaces end before the other, or swap secondary and primary"
            )
        self.is_secondary = secondary > 0
        self.dependence = scipy.sparse.csr_matrix(
            (
                (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns)))
                if parts
                else (n, n)
            ),
            shape=(n, n),
        )
        self.transformation = _inverse(self.dependence)
        sees = np.searchsorted(self.unknowns, layout.global_index)
        found = sees < n
        found[found] = self.unknowns[sees[found]] == layout.global_index[found]
        self.local = (np.flatnonzero(found), sees[found])

    def gather(self, array: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Owners' values of the touched unknowns, the same on all ranks; shape (n,). Collective."""
        return self._layout.gather(self.unknowns, array)

    def expand(self, array: npt.NDArray[np.float64]) -> None:
        """Turn condensed into original unknowns, v = T a, in a local array. Collective."""
        positions, which = self.local
        array[positions] = (self.transformation @ self.gather(array))[which]

    def condense(self, array: npt.NDArray[np.float64]) -> None:
        """Turn a residual r into T^T r in a local array. Collective."""
        positions, which = self.local
        array[positions] = (self.transformation.T @ self.gather(array))[which]

    def relative(self, array: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Condensed unknowns a = v - X v of a local array v; shape (n,). Collective."""
        values = self.gather(array)
        return values - self.dependence @ values

    def matrix_entries(
        self,
        rows: npt.NDArray[np.int32],
        columns: npt.NDArray[np.int32],
        constrained: npt.NDArray[np.bool_],
        fixed: npt.NDArray[np.bool_],
    ) -> tuple[
        npt.NDArray[np.int64],
        npt.NDArray[np.float64],
        npt.NDArray[np.int32],
        npt.NDArray[np.int32],
    ]:
        """Entries of T^T K T that condensation adds to those of K away from secondary unknowns.

        Args:
            rows: Local row of each entry of K.
            columns: Local column of each entry of K.
            constrained: Whether a local unknown is prescribed.
            fixed: Whether a touched unknown is prescribed or closed; shape (n,).

        Returns:
            Entry of K that each new entry stems from, its factor, its global row and column.
        """
        slots = np.full(self._layout.n_local, -1, np.int32)
        positions, which = self.local
        secondary = self.is_secondary[which]
        slots[positions[secondary]] = which[secondary]
        free = self.transformation[:, ~fixed].tocsr()
        involved = np.flatnonzero((slots[rows] >= 0) | (slots[columns] >= 0))
        source, factor, new_rows, new_columns = kernels.expand_entries(
            rows[involved],
            columns[involved],
            self._layout.global_index,
            constrained,
            slots,
            free.indptr,
            self.unknowns[~fixed][free.indices].astype(np.int32),
            free.data,
        )
        return involved[source], factor, new_rows, new_columns

    def secondary_mask(self) -> npt.NDArray[np.bool_]:
        """Which local unknowns are secondary; shape (n_local,)."""
        mask = np.zeros(self._layout.n_local, bool)
        positions, which = self.local
        mask[positions[self.is_secondary[which]]] = True
        return mask


def _inverse(dependence: scipy.sparse.csr_matrix) -> scipy.sparse.csr_matrix:
    """(I - X)^-1 of a nilpotent X, as the finite sum of its powers."""
    result = scipy.sparse.identity(dependence.shape[0], format="csr")
    power = dependence
    for _ in range(MAX_CHAIN):
        if power.nnz == 0:
            return result
        result = result + power
        power = power @ dependence
        power.eliminate_zeros()
    raise ValueError(
        "contact surfaces depend on each other in a circle: a node is secondary to itself through "
        "a chain of pairs; swap secondary and primary of one of them"
    )
