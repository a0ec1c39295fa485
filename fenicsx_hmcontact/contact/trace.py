# SPDX-License-Identifier: LGPL-3.0-or-later
"""Values of a field along a surface."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.mesh import MeshTags

from .surface import gather_surface, surface_dofs


def surface_values(
    function: fem.Function, facet_tags: MeshTags, tag: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Values of a P1 function at the nodes of a surface, the same on all ranks. Collective.

    Args:
        function: Scalar or vector P1 function.
        facet_tags: Tags of the facets of its mesh.
        tag: Tag of the surface.

    Returns:
        Coordinates of the nodes [m]; shape (n, 2), and values; shape (n, components).
    """
    space = function.function_space
    surface = gather_surface(space.mesh, facet_tags, tag, str(tag))
    blocks = surface_dofs(surface, space)
    first, last = space.dofmap.index_map.local_range
    mine = (blocks >= first) & (blocks < last)
    values = np.zeros((blocks.size, space.dofmap.index_map_bs))
    own = function.x.array.reshape(-1, values.shape[1])
    values[mine] = own[blocks[mine] - first]
    space.mesh.comm.Allreduce(MPI.IN_PLACE, values, MPI.SUM)
    return surface.points, values
