# SPDX-License-Identifier: LGPL-3.0-or-later
"""Distribution of cells over ranks such that every rank sees whole node patches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx.mesh import CellType, GhostMode, create_cell_partitioner
from scipy import sparse

from fenicsx_hmcontact._compat import adjacency_list


def vertex_ghost_partitioner() -> Callable[..., Any]:
    """Partitioner that gives every rank all cells around every vertex it owns.

    DOLFINx ghosts cells across facets at most, which leaves the patches of most vertices on the
    border between two ranks incomplete. Pass the result as ``partitioner`` to
    ``dolfinx.mesh.create_mesh`` or ``dolfinx.io.gmsh.model_to_mesh``; triangles only.

    Note:
        The callback is collective; ranks without cells take part.
    """

    def partition(
        comm: MPI.Comm,
        nparts: int,
        cell_types: list[CellType],
        cells: list[npt.NDArray[np.int64]],
    ) -> Any:
        base = create_cell_partitioner(GhostMode.none, 2)
        owners = base(comm, nparts, cell_types, cells).array
        vertices, corners = np.unique(cells[0], return_inverse=True)
        incidence = _rows(corners.reshape(-1, 3), vertices.size)
        local = incidence.T @ _rows(owners.reshape(-1, 1), nparts)
        wanted = incidence @ _ranks_around(comm, vertices, local)

        rows, ranks = wanted.nonzero()
        is_ghost = ranks != owners[rows]
        rows, ranks = rows[is_ghost], ranks[is_ghost]
        offsets = np.searchsorted(rows, np.arange(owners.size + 1))
        data = np.insert(ranks, offsets[:-1], owners)
        offsets += np.arange(owners.size + 1)
        return adjacency_list(data.astype(np.int32), offsets.astype(np.int32))

    return partition


def _rows(columns: npt.NDArray[np.integer], num_columns: int) -> sparse.csr_array:
    """Sparse matrix of ones in the given columns of each row; shape (num_rows, per_row)."""
    num_rows, per_row = columns.shape
    row_starts = np.arange(0, columns.size + 1, per_row)
    ones = np.ones(columns.size, dtype=np.int32)
    return sparse.csr_array((ones, columns.ravel(), row_starts), shape=(num_rows, num_columns))


def _ranks_around(
    comm: MPI.Comm, vertices: npt.NDArray[np.int64], local: sparse.csr_array
) -> sparse.csr_array:
    """Ranks that own a cell around each vertex, whichever rank the cell was handed in on.

    Args:
        comm: Communicator. Collective.
        vertices: Global numbers of the vertices handed in on this rank, ascending.
        local: Pattern of the ranks known here, shape (num_vertices, nparts).
    """
    rows, ranks = local.nonzero()
    pairs = np.column_stack([vertices[rows], ranks])
    # Pairs of one vertex meet on its home rank, which tells all who asked.
    home = pairs[:, 0] % comm.size
    asked = comm.alltoall([pairs[home == rank] for rank in range(comm.size)])
    known = np.unique(np.concatenate(asked), axis=0)
    told = comm.alltoall([known[np.isin(known[:, 0], pair[:, 0])] for pair in asked])
    vertex, rank = np.concatenate(told).T
    row = np.searchsorted(vertices, vertex)
    return sparse.csr_array((np.ones_like(rank), (row, rank)), shape=local.shape)
