# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a model holds at the nodes of its mesh, brought to rank 0 and back to any partition."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from fenicsx_hmcontact import _compat

Float = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class NodalState:
    """What one part of a model holds.

    Attributes:
        nodes: Numbers of nodes in the input of the mesh, on this rank; shape (n,).
        nodal: Values at these nodes by name; shapes (n, ...).
        values: What belongs to no node by name: numbers, lists and words, the same on all ranks.
    """

    nodes: npt.NDArray[np.int64]
    nodal: dict[str, Float]
    values: dict[str, Any] = field(default_factory=dict)


def function_state(u: fem.Function) -> NodalState:
    """Values of a P1 function at the local nodes.

    Raises:
        ValueError: If it is not P1.
    """
    index = u.function_space.mesh.geometry.input_global_indices
    values = u.x.array.reshape(-1, u.function_space.dofmap.bs)[_dof_of_node(u)]
    return NodalState(index, {"value": values})


def set_function(u: fem.Function, state: NodalState) -> None:
    """Give a P1 function the values of `function_state` at the local nodes."""
    u.x.array.reshape(-1, u.function_space.dofmap.bs)[_dof_of_node(u)] = state.nodal["value"]


def _dof_of_node(u: fem.Function) -> npt.NDArray[np.int32]:
    """Block dof of each local node of the mesh."""
    space = u.function_space
    element = space.element.basix_element
    if element.degree != 1 or element.discontinuous:
        raise ValueError(f"only P1 fields can be carried over, {u.name} is none")
    dofs = np.empty(len(space.mesh.geometry.x), np.int32)
    dofs[_compat.cell_nodes(space.mesh)] = space.dofmap.list
    return dofs


def gather_states(
    comm: MPI.Comm, states: Mapping[str, NodalState], n_nodes: int
) -> dict[str, NodalState]:
    """Bring the states of all ranks to rank 0. Collective.

    Args:
        comm: Communicator.
        states: Of the parts of a model, by name; the same names on all ranks.
        n_nodes: Number of nodes in the input of the mesh.

    Returns:
        The same on rank 0, of all nodes, nan where a part holds nothing; empty on other ranks.
    """
    parts = comm.gather({name: (state.nodes, state.nodal) for name, state in states.items()})
    if parts is None:
        return {}
    whole = {}
    for name, state in states.items():
        nodal = {}
        for key, mine in state.nodal.items():
            nodal[key] = table = np.full((n_nodes, *mine.shape[1:]), np.nan)
            for part in parts:
                nodes, arrays = part[name]
                table[nodes] = arrays[key]
        whole[name] = NodalState(np.arange(n_nodes), nodal, state.values)
    return whole


def scatter_states(
    comm: MPI.Comm, whole: Mapping[str, NodalState], states: Mapping[str, NodalState]
) -> dict[str, NodalState]:
    """Bring states from rank 0 to the nodes where they are held. Collective.

    Args:
        comm: Communicator.
        whole: Of all nodes, on rank 0.
        states: Of the same parts on the new mesh: nodes and shapes.

    Returns:
        For each part its nodes with their values.

    Raises:
        ValueError: On all ranks, if a part is missing or holds arrays of other shapes.
    """
    wanted = comm.gather({name: state.nodes for name, state in states.items()})
    answers: list[Any] | None = None
    problem = ""
    if wanted is not None:
        problem = _mismatch(whole, states)
        if not problem:
            answers = [
                {
                    name: (
                        {key: table[nodes[name]] for key, table in whole[name].nodal.items()},
                        whole[name].values,
                    )
                    for name in states
                }
                for nodes in wanted
            ]
    problem = comm.bcast(problem)
    if problem:
        raise ValueError(problem)
    mine = comm.scatter(answers)
    return {
        name: replace(state, nodal=mine[name][0], values=mine[name][1])
        for name, state in states.items()
    }


def _mismatch(whole: Mapping[str, NodalState], states: Mapping[str, NodalState]) -> str:
    """Why states do not fit a model; empty if they do."""
    if not set(states) <= set(whole):
        return f"the state is that of {_listed(whole)}, the model has {_listed(states)}"
    for name, state in states.items():
        shapes, known = (
            {key: array.shape[1:] for key, array in s.nodal.items()} for s in (state, whole[name])
        )
        if shapes != known:
            return f"the state of {name} holds {known}, the model has {shapes}"
    return ""


def _listed(names: Mapping[str, Any]) -> str:
    return ", ".join(names) or "nothing"
