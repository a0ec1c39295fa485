# SPDX-License-Identifier: LGPL-3.0-or-later
"""Numbering of the unknowns of several fields, on one rank and across ranks."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem, la


class FieldLayout:
    """Numbering of all unknowns.

    A local array holds field after field, each with its owned and then its ghost unknowns. The
    global numbering goes rank by rank, and on a rank field by field.

    Args:
        spaces: Function space of each field, all on one communicator.

    Raises:
        ValueError: If there are more unknowns than PETSc's 32-bit indices can count.

    Attributes:
        spaces: The spaces.
        block_sizes: Components of a block dof of each field.
        offsets: Where each field begins in a local array; shape (n_fields + 1,).
        owned: Positions in a local array of the unknowns this rank owns, in global order.
        global_index: Global number of every local unknown; int32, as PETSc's indices.
        first: Global number of the first owned unknown.
        n_global: Number of unknowns on all ranks.
    """

    def __init__(self, spaces: Sequence[fem.FunctionSpace]) -> None:
        self.spaces = list(spaces)
        self.comm = self.spaces[0].mesh.comm
        maps = [space.dofmap.index_map for space in self.spaces]
        self.block_sizes = [space.dofmap.index_map_bs for space in self.spaces]
        sizes = [
            (m.size_local + m.num_ghosts) * bs for m, bs in zip(maps, self.block_sizes, strict=True)
        ]
        self.offsets = np.concatenate(([0], np.cumsum(sizes))).astype(np.int64)
        owned = [m.size_local * bs for m, bs in zip(maps, self.block_sizes, strict=True)]
        self._owned_offsets = np.concatenate(([0], np.cumsum(owned)))
        self.owned = np.concatenate(
            [begin + np.arange(n) for begin, n in zip(self.offsets[:-1], owned, strict=True)]
        )
        per_rank = np.array(self.comm.allgather(owned), np.int64)
        rank_first = np.concatenate(([0], np.cumsum(per_rank.sum(axis=1))))
        self.first = int(rank_first[self.comm.rank])
        self.n_global = int(rank_first[-1])
        if self.n_global > np.iinfo(np.int32).max:
            raise ValueError(f"{self.n_global} unknowns are more than PETSc's indices can count")
        # Global number of each rank's first unknown of each field, and of its first block dof.
        self._field_first = rank_first[:-1, None] + np.hstack(
            (np.zeros((self.comm.size, 1), np.int64), np.cumsum(per_rank, axis=1)[:, :-1])
        )
        blocks = per_rank // np.array(self.block_sizes)
        self._block_first = np.vstack(
            (np.zeros((1, len(maps)), np.int64), np.cumsum(blocks, axis=0))
        )
        parts = []
        for f, index_map in enumerate(maps):
            local = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
            parts.append(self.global_of_blocks(f, index_map.local_to_global(local)).ravel())
        self.global_index = np.concatenate(parts).astype(np.int32)
        self._exchange = [
            la.vector(m, bs, dtype=np.float64) for m, bs in zip(maps, self.block_sizes, strict=True)
        ]

    @property
    def n_local(self) -> int:
        """Number of local unknowns, ghosts included."""
        return int(self.offsets[-1])

    def global_of_blocks(self, field: int, blocks: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Global numbers of all components of a field's global block dofs; (n, components)."""
        owner = np.searchsorted(self._block_first[:, field], blocks, side="right") - 1
        bs = self.block_sizes[field]
        first = self._field_first[owner, field] + (blocks - self._block_first[owner, field]) * bs
        return first[:, None] + np.arange(bs)

    def views(self, array: npt.NDArray[np.float64]) -> list[npt.NDArray[np.float64]]:
        """Views of each field's part of a local array."""
        return [
            array[begin:end] for begin, end in zip(self.offsets[:-1], self.offsets[1:], strict=True)
        ]

    def field_of_owned(self) -> npt.NDArray[np.int64]:
        """Field number of each owned unknown, in global order."""
        return np.repeat(np.arange(len(self.spaces)), np.diff(self._owned_offsets))

    def add_ghosts_to_owners(self, array: npt.NDArray[np.float64]) -> None:
        """Add what ghosts hold to their owners and copy the sums back. Collective."""
        for vector, view in zip(self._exchange, self.views(array), strict=True):
            vector.array[:] = view
            vector.scatter_reverse(la.InsertMode.add)
            vector.scatter_forward()
            view[:] = vector.array

    def gather(
        self, unknowns: npt.NDArray[np.int64], array: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Owners' values of some unknowns, the same on all ranks. Collective.

        Args:
            unknowns: Global numbers, the same on all ranks.
            array: Local array.
        """
        values = np.zeros(unknowns.size)
        mine = self.owns(unknowns)
        values[mine] = array[self.owned[unknowns[mine] - self.first]]
        self.comm.Allreduce(MPI.IN_PLACE, values, MPI.SUM)
        return values

    def owns(self, unknowns: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """Which unknowns, given by global numbers, this rank owns."""
        return (unknowns >= self.first) & (unknowns < self.first + self.owned.size)

    def update_ghosts(self, array: npt.NDArray[np.float64]) -> None:
        """Copy the owners' values to ghosts. Collective."""
        for vector, view in zip(self._exchange, self.views(array), strict=True):
            vector.array[:] = view
            vector.scatter_forward()
            view[:] = vector.array
