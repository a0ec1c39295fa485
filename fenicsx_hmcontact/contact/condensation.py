# SPDX-License-Identifier: LGPL-3.0-or-later
"""Condensation: secondary unknowns as relative ones plus what the primary surface does (Eq. 64).

With v all unknowns and a the condensed ones, v = B a + X v: the rows of X are those of H (and of -C
next to dropped nodes) at secondary unknowns and zero elsewhere; B turns the relative displacements
of a node, normal and tangential, into the axes, and is the identity elsewhere. Hence v = T a with
T = (I - X)^-1 B, and the matrix becomes W^T K T, the residual W^T r, of the same size (Eq. 66). W
is T, but for sliding nodes, whose tangential row holds the friction law (Eq. 69). Rows that hold a
constraint on a itself take the place of equilibrium.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy.sparse
from scipy.sparse import csr_array, diags_array

if TYPE_CHECKING:
    from ..solvers import FieldLayout

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

MAX_CHAIN = 8
"""Longest chain of surfaces that are secondary in one pair and primary in the next."""


@dataclass(frozen=True)
class Dependence:
    """How the unknowns of one pair depend on each other, replicated on all ranks.

    Attributes:
        unknowns: Global numbers of the unknowns of both surfaces; (m,).
        secondary: Positions in ``unknowns`` of those with a relative unknown; (n,).
        coefficients: Their rows of X; shape (n, m).
        closed: Whether the relative unknown is zero and stays so (tied); (n,).
        frame: Their part of B; shape (n, n). None for the identity.
        test_frame: The same of the equations; as ``frame`` where None.
        stiffness: Positive where the row constrains the relative unknown: stiffness * a = -value,
            in the unit of the diagonal of K; zero where it is an equation; (n,). None for zero.
        values: Residual of the constraint [unit of a], or what is added to the equation; (n,).
        derivative: Derivative of their rows with respect to the unknowns, besides that of the
            forces in them; shape (n, m). None for zero.
        transmitted: Derivative of X^T r with respect to the unknowns at fixed r, what the nodes
            pass on to others, and of what is added to the residual r; shape (m, m). None for zero.
        relative: Derivative of their rows with respect to the relative unknowns themselves, where a
            difference of large unknowns would lose digits; shape (n, n). None for zero.
    """

    unknowns: npt.NDArray[np.int64]
    secondary: npt.NDArray[np.intp]
    coefficients: csr_array
    closed: Bool
    frame: csr_array | None = None
    test_frame: csr_array | None = None
    stiffness: Float | None = None
    values: Float | None = None
    derivative: csr_array | None = None
    transmitted: csr_array | None = None
    relative: csr_array | None = None


class Condensation:
    """The transformation of all pairs. Its data are the same on all ranks.

    Args:
        unknowns: Global numbers of all unknowns on contact surfaces.
        secondary: Those of secondary surfaces.
        layout: Numbering of the unknowns.

    Attributes:
        unknowns: Global numbers, ascending, of all unknowns it touches; (n,).
        local: Positions in a local array of those of ``unknowns`` that this rank sees, and which
            they are.
        closed: Which condensed unknowns are zero for good; (n,).
        matrix: What the constraints and the moving geometry add to the condensed matrix; (n, n).
        offset: What they add to the condensed residual; (n,).
    """

    def __init__(
        self,
        unknowns: npt.NDArray[np.int64],
        secondary: npt.NDArray[np.int64],
        layout: FieldLayout,
    ) -> None:
        self._layout = layout
        self.unknowns = np.unique(unknowns)
        n = self.unknowns.size
        self._is_secondary = np.isin(self.unknowns, secondary)
        sees = np.searchsorted(self.unknowns, layout.global_index)
        found = sees < n
        found[found] = self.unknowns[sees[found]] == layout.global_index[found]
        self.local = (np.flatnonzero(found), sees[found])
        self.update([])

    def update(self, dependences: Sequence[Dependence]) -> None:
        """Build the transformation and the conditions anew; as `couple`, then `constrain`."""
        self.couple(dependences)
        self.constrain(dependences)

    def couple(self, dependences: Sequence[Dependence]) -> None:
        """Build anew how unknowns depend on others, without conditions.

        Raises:
            ValueError: If a node is secondary twice, or surfaces depend on each other in a circle.
        """
        n = self.unknowns.size
        parts: list[_Part] = []
        turned = np.zeros(n, np.int64)
        for d in dependences:
            at = np.searchsorted(self.unknowns, d.unknowns)
            turned[at[d.secondary]] += 1
            parts.append((d.coefficients, at[d.secondary], at))
        if np.any(turned > 1):
            raise ValueError(
                f"{int(np.sum(turned > 1))} unknowns belong to the secondary surfaces of two "
                "pairs; let one of the surfaces end before the other, or swap secondary and primary"
            )
        self.dependence = _assembled(parts, n)
        self._inverse = _inverse(self.dependence)
        self._unturned = diags_array((turned == 0).astype(float), format="csr")

    def constrain(self, dependences: Sequence[Dependence]) -> None:
        """Build anew the frames, constraints and derivatives of the coupled unknowns."""
        n = self.unknowns.size
        frames: list[_Part] = []
        test_frames: list[_Part] = []
        rows: list[_Part] = []
        transmitted: list[_Part] = []
        relative: list[_Part] = []
        self.closed = np.zeros(n, bool)
        stiffness, self.offset = np.zeros(n), np.zeros(n)
        for d in dependences:
            at = np.searchsorted(self.unknowns, d.unknowns)
            s = at[d.secondary]
            self.closed[s] |= d.closed
            frame = scipy.sparse.eye_array(s.size) if d.frame is None else d.frame
            frames.append((frame, s, s))
            test_frames.append((frame if d.test_frame is None else d.test_frame, s, s))
            if d.stiffness is not None and d.values is not None:
                stiffness[s] = d.stiffness
                self.offset[s] = np.where(d.stiffness > 0.0, d.stiffness * d.values, d.values)
            if d.derivative is not None:
                rows.append((d.derivative, s, at))
            if d.transmitted is not None:
                transmitted.append((d.transmitted, at, at))
            if d.relative is not None:
                relative.append((d.relative, s, s))
        self._frame = csr_array(_assembled(frames, n) + self._unturned)
        self.transformation = csr_array(self._inverse @ self._frame)
        self.constrained = stiffness > 0.0
        # Entries of constrained rows stay, as zeros, so that the pattern does not change with them.
        self.tests = csr_array(self._inverse @ (_assembled(test_frames, n) + self._unturned))
        self.tests.data[self.constrained[self.tests.indices]] = 0.0
        derivative = _assembled(rows, n)
        if transmitted:
            derivative = derivative + self.tests.T @ _assembled(transmitted, n)
        added = diags_array(stiffness) + _assembled(relative, n)
        self.matrix = csr_array(derivative @ self.transformation + added)

    def gather(self, array: Float) -> Float:
        """Owners' values of the touched unknowns, the same on all ranks; shape (n,). Collective."""
        return self._layout.gather(self.unknowns, array)

    def expand(self, array: Float) -> None:
        """Turn condensed into original unknowns, v = T a, in a local array. Collective."""
        positions, which = self.local
        array[positions] = (self.transformation @ self.gather(array))[which]

    def condense(self, array: Float, added: Float) -> None:
        """Turn a residual r into W^T r + added in a local array. Collective.

        Args:
            array: Local array.
            added: What is added at the touched unknowns; shape (n,).
        """
        positions, which = self.local
        array[positions] = (self.tests.T @ self.gather(array) + added)[which]

    def transmit(self, array: Float) -> None:
        """Add to a residual what nodes receive as primary ones, in a local array. Collective."""
        positions, which = self.local
        array[positions] = (self._inverse.T @ self.gather(array))[which]

    def relative(self, array: Float) -> Float:
        """Relative unknowns B^-1 (v - X v) of a local array v; shape (n,). Collective.

        B is orthogonal, so its inverse is its transpose.
        """
        values = self.gather(array)
        return self._frame.T @ (values - self.dependence @ values)

    @property
    def slots(self) -> npt.NDArray[np.int32]:
        """Row of T of each local secondary unknown, -1 elsewhere; shape (n_local,)."""
        slots = np.full(self._layout.n_local, -1, np.int32)
        positions, which = self.local
        secondary = self._is_secondary[which]
        slots[positions[secondary]] = which[secondary]
        return slots


_Part = tuple[csr_array, npt.NDArray[np.intp], npt.NDArray[np.intp]]
"""A matrix, and where its rows and columns are among the touched unknowns."""


def _assembled(parts: Sequence[_Part], n: int) -> csr_array:
    """Add small matrices up at their places in a larger one."""
    if not parts:
        return csr_array((n, n))
    entries = [matrix.tocoo() for matrix, _, _ in parts]
    data = np.concatenate([e.data for e in entries])
    rows = np.concatenate([at[e.row] for e, (_, at, _) in zip(entries, parts, strict=True)])
    columns = np.concatenate([at[e.col] for e, (_, _, at) in zip(entries, parts, strict=True)])
    return csr_array((data, (rows, columns)), shape=(n, n))


def _inverse(dependence: csr_array) -> csr_array:
    """(I - X)^-1 of a nilpotent X, as the finite sum of its powers."""
    result = scipy.sparse.eye_array(dependence.shape[0], format="csr")
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
