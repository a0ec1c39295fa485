# SPDX-License-Identifier: LGPL-3.0-or-later
"""Free water on faces that nothing faces, and at the open ends of gaps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from .contact import Dependence
from .sliding_water import SlidingWater
from .solvers import FieldLayout

Float = npt.NDArray[np.float64]


class FreeWater:
    """Pore pressures that free water prescribes where surfaces have left each other.

    A node is wetted where no pair of the problem covers it, and at the end of a gap that no other
    gap goes on from. Its data are the same on all ranks.

    Args:
        pairs: Water of all sliding pairs.
        held: Global numbers of pore pressures that are prescribed or tied.
        layout: Numbering of the unknowns.

    Attributes:
        numbers: Global numbers of the pore pressures it may prescribe, ascending; shape (n,).
        wetted: Which of them it prescribes; shape (n,).
    """

    def __init__(
        self,
        pairs: Sequence[SlidingWater],
        held: npt.NDArray[np.int64],
        layout: FieldLayout,
    ) -> None:
        self._pairs, self._layout = pairs, layout
        everything = np.concatenate([np.zeros(0, np.int64), *(n for p in pairs for n in p.numbers)])
        known, count = np.unique(everything, return_counts=True)
        shared = known[count > 1]
        self._open = [p for p in pairs if p.outside is not None]
        candidates = [n for p in self._open for n in p.numbers]
        self.numbers = np.unique(np.concatenate([np.zeros(0, np.int64), *candidates]))
        self._held = np.isin(self.numbers, held)
        # Of a dry secondary surface the ends stay sealed.
        for pair in (p for p in self._open if p.numbers[0].size):
            pair.free_ends &= ~np.isin(pair.numbers[0], np.concatenate((shared, held)))
        self.wetted = np.zeros(len(self.numbers), bool)

    def dependence(self, current: Float, diagonal: Float) -> Dependence:
        """Conditions p = pressure of the free water, where it stands now. Collective.

        Args:
            current: Local array of the unknowns.
            diagonal: Local array of the diagonal of the tangent.
        """
        n = len(self.numbers)
        ends, covered, outside = np.zeros(n, bool), np.zeros(n, bool), np.zeros(n)
        for pair in self._pairs:
            numbers = np.concatenate(pair.numbers)
            mine = np.isin(numbers, self.numbers)
            at = np.searchsorted(self.numbers, numbers[mine])
            covered[at] |= pair.covered[mine]
            if pair.outside is not None:
                ends[at] |= pair.ends[mine]
                outside[at] = pair.free_pressure()[mine]
        self.wetted = (ends | ~covered) & ~self._held
        at = np.flatnonzero(self.wetted)
        values = self._layout.gather(self.numbers, current) - outside
        stiffness = np.abs(self._layout.gather(self.numbers, diagonal))
        return Dependence(
            self.numbers,
            at,
            csr_array((at.size, n)),
            np.zeros(at.size, bool),
            stiffness=np.where(stiffness > 0.0, stiffness, 1.0)[at],
            values=values[at],
        )
