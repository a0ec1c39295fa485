# SPDX-License-Identifier: LGPL-3.0-or-later
"""From the nodes of the old mesh to those of the new one, and what area went with removed nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, vstack

from fenicsx_hmcontact.remeshing.edges import Floats, Ints


@dataclass(frozen=True, eq=False)
class Transfer:
    """Values of the old nodes, brought to the new ones.

    The first nodes of the new mesh are the old ones that were kept, in their old order; inserted
    nodes follow, body by body, each at a convex combination of old nodes.

    Attributes:
        kept: Old number of each kept node; shape (n_kept,).
        weights: Weights of the old nodes in each inserted one, rows with sum 1; sparse, shape
            (n_inserted, n_old).
    """

    kept: Ints
    weights: Any

    @classmethod
    def identity(cls, n: int) -> Transfer:
        """Nothing changes."""
        return cls(np.arange(n), csr_array((0, n)))

    @classmethod
    def subset(cls, kept: Ints, n: int) -> Transfer:
        """Some of n nodes stay, none are inserted."""
        return cls(kept, csr_array((0, n)))

    def __call__(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Carry nodal values to the new mesh; those of kept nodes stay the same bit for bit.

        Args:
            values: Values of the old nodes; shape (n_old, ...).

        Returns:
            Values of the new nodes; shape (n_new, ...).
        """
        inserted = self.weights @ values.reshape(len(values), -1)
        return np.concatenate(
            [values[self.kept], inserted.reshape(len(inserted), *values.shape[1:])]
        )

    @property
    def matrix(self) -> Any:
        """The same as a sparse matrix; shape (n_new, n_old)."""
        n = len(self.kept)
        kept = csr_array((np.ones(n), (np.arange(n), self.kept)), shape=(n, self.weights.shape[1]))
        return vstack([kept, self.weights], format="csr")

    @property
    def new_of_old(self) -> Ints:
        """New number of each old node, -1 if it was removed; shape (n_old,)."""
        new = np.full(self.weights.shape[1], -1)
        new[self.kept] = np.arange(len(self.kept))
        return new


@dataclass(frozen=True, eq=False)
class Merges:
    """Triangles that bodies lost or gained where a node left a fixed line.

    Without them the area would not change. A merge between two layers has an entry for each.

    Attributes:
        areas: Area that the group gained, negative if lost [m^2]; shape (n,).
        groups: Tag of the group; shape (n,).
        places: Middle of the triangle [m]; shape (n, 2).
        weights: Weights of the old nodes in the mean over the triangle, so that its water is
            ``areas * (weights @ p)`` times what a volume stores; sparse, shape (n, n_old).
    """

    areas: Floats
    groups: npt.NDArray[np.int32]
    places: Floats
    weights: Any
