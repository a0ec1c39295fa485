# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies and surfaces by name: gmsh groups in, a distributed mesh with whole node patches out."""

from fenicsx_hmcontact.domain.domain import Domain
from fenicsx_hmcontact.domain.gmsh_model import (
    add_quadrilateral,
    align_nodes,
    check_sizes,
    gmsh_session,
)
from fenicsx_hmcontact.domain.mesh_arrays import MeshArrays
from fenicsx_hmcontact.domain.nodal_state import (
    NodalState,
    function_state,
    gather_states,
    scatter_states,
    set_function,
)
from fenicsx_hmcontact.domain.partition import vertex_ghost_partitioner

__all__ = [
    "Domain",
    "MeshArrays",
    "NodalState",
    "add_quadrilateral",
    "align_nodes",
    "check_sizes",
    "function_state",
    "gather_states",
    "gmsh_session",
    "scatter_states",
    "set_function",
    "vertex_ghost_partitioner",
]
