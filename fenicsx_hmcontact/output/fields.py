# SPDX-License-Identifier: LGPL-3.0-or-later
"""Fields of a run: files for ParaView, tables of contact, values at points and nodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from mpi4py import MPI

import basix.ufl
import numpy as np
import numpy.typing as npt
from dolfinx import fem, geometry, has_adios2, io
from dolfinx.mesh import Mesh

from .. import _compat
from ..contact import ContactPair, InterfaceState, NodeState, gather_surface, surface_dofs
from .root import on_root

INSIDE = 1e-9
"""How far outside a triangle a point still counts as on it, as a fraction of its height."""


class FieldWriter:
    """Write functions of one mesh, step by step, to one file that ParaView opens. Collective.

    Fields of different elements share the file: continuous ones are written by their values at
    the nodes of the mesh, piecewise constants by cell. The mesh is written where it is at each
    step, so moving meshes need nothing special.

    Attributes:
        path: The file with its suffix.
    """

    def __init__(self, path: str | Path, mesh: Mesh, functions: Sequence[fem.Function]) -> None:
        """Open the file. Collective.

        Args:
            path: File ``.bp`` (VTX, needs a DOLFINx with ADIOS2) or ``.pvd`` (VTK); without a
                suffix, ``.bp`` where it can be had.
            mesh: Mesh of the functions.
            functions: Functions to write, each under its own ``name``.

        Raises:
            ValueError: If the suffix is unknown or unavailable, a function is on another mesh, two
                have one name, or one is discontinuous without being constant in each cell.
            OSError: If the directory cannot be made.
        """
        path = Path(path)
        if not path.suffix:
            path = path.with_suffix(".bp" if has_adios2 else ".pvd")
        if path.suffix not in (".bp", ".pvd"):
            raise ValueError(f"{path}: fields are written to .bp or .pvd, not {path.suffix!r}")
        if path.suffix == ".bp" and not has_adios2:
            raise ValueError(f"{path}: this DOLFINx has no ADIOS2; write to .pvd instead")
        self.path = path
        self._meshes = 0
        self._file: io.VTXWriter | io.VTKFile | None = None
        on_root(mesh.comm, lambda: path.parent.mkdir(parents=True, exist_ok=True))
        self.remesh(mesh, functions)

    def remesh(self, mesh: Mesh, functions: Sequence[fem.Function]) -> None:
        """Go on with the functions of another mesh. Collective.

        A ``.pvd`` holds all meshes; a ``.bp`` only one, so the next mesh gets the next file:
        ``name.bp``, ``name-1.bp``, ...

        Args:
            mesh: The new mesh.
            functions: Functions to write from now on.

        Raises:
            ValueError: As on construction.
        """
        self._functions = list(functions)
        self._written = _nodal_twins(self.path, mesh, self._functions)
        if self.path.suffix == ".bp":
            self.close()
            part = f"-{self._meshes}" if self._meshes else ""
            file = self.path.with_stem(self.path.stem + part)
            self._file = io.VTXWriter(mesh.comm, file, self._written)
        elif self._file is None:
            self._file = io.VTKFile(mesh.comm, self.path, "w")
        self._meshes += 1

    def write(self, time: float) -> None:
        """Write the functions as they are now. Collective.

        Args:
            time: Time [s].

        Raises:
            RuntimeError: If the writer is closed.
        """
        if self._file is None:
            raise RuntimeError(f"{self.path} is closed")
        for function, written in zip(self._functions, self._written, strict=True):
            written.interpolate(function)
        if isinstance(self._file, io.VTKFile):
            self._file.write_function(self._written, time)
        else:
            self._file.write(time)

    def close(self) -> None:
        """Close the file. Collective."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> Self:
        """Return the writer itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the file."""
        self.close()


def _nodal_twins(path: Path, mesh: Mesh, functions: list[fem.Function]) -> list[fem.Function]:
    """Functions of the same names that a file can hold: P1, or constant in each cell."""
    check_names(path, functions)
    for function in functions:
        if function.function_space.mesh is not mesh:
            raise ValueError(
                f"{path}: the function {function.name!r} is on another mesh; give it a file of its "
                "own"
            )
    return [_nodal_twin(function) for function in functions]


def check_names(path: str | Path, functions: Sequence[fem.Function]) -> None:
    """Refuse to write no function, or two of one name.

    Args:
        path: File or other place, for messages.
        functions: Functions to write.

    Raises:
        ValueError: If there is none, or two have one name; names it.
    """
    if not functions:
        raise ValueError(f"{path}: no function to write")
    names = [function.name for function in functions]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{path}: two functions are called {name!r}")


def _nodal_twin(function: fem.Function) -> fem.Function:
    """An empty function of the same name that a file can hold: P1, or constant in each cell."""
    space = function.function_space
    element = space.ufl_element()
    if element.discontinuous and element.embedded_superdegree > 0:
        raise ValueError(
            f"the function {function.name!r} has no nodal values ({element}); "
            "project it to P1 or to cell-wise constants"
        )
    family = ("DG", 0) if element.discontinuous else ("P", 1)
    return fem.Function(
        fem.functionspace(space.mesh, (*family, space.value_shape)), name=function.name
    )


class InterfaceFields:
    """What acts between surfaces as P1 functions, to be written by `FieldWriter`.

    At all nodes but those of the secondary surfaces the state is `NodeState.UNPAIRED` and the
    others are nan, which ParaView leaves out.

    Attributes:
        functions: Contact pressure, shear [Pa], gap, slip [m] and contact state.
    """

    def __init__(self, mesh: Mesh, pairs: Sequence[ContactPair]) -> None:
        """Find the secondary nodes. Collective.

        Args:
            mesh: Mesh of the pairs.
            pairs: Pairs to show.

        Raises:
            ValueError: If a pair is on another mesh.
        """
        space = fem.functionspace(mesh, ("P", 1))
        names = "contact pressure", "shear", "gap", "slip", "contact state"
        self.functions = [fem.Function(space, name=name) for name in names]
        self._nodes = []
        for pair in pairs:
            surface = gather_surface(mesh, pair.facet_tags, pair.secondary, pair.name)
            dofs = surface_dofs(surface, space)
            self._nodes.append(space.dofmap.index_map.global_to_local(dofs))

    def update(self, states: Sequence[InterfaceState]) -> None:
        """Take over what acts now.

        Args:
            states: State of each pair, in their order.

        Raises:
            ValueError: If they are not those of the pairs.
        """
        sizes = [len(state.points) for state in states]
        if sizes != [len(nodes) for nodes in self._nodes]:
            raise ValueError(
                f"states have {sizes} nodes, the secondary surfaces of the pairs "
                f"{[len(nodes) for nodes in self._nodes]}"
            )
        for function in self.functions[:-1]:
            function.x.array[:] = np.nan
        self.functions[-1].x.array[:] = NodeState.UNPAIRED
        for nodes, state in zip(self._nodes, states, strict=True):
            # A node may be unpaired in one pair and act in the next.
            here = (nodes >= 0) & (state.state != NodeState.UNPAIRED)
            tractions = state.pressure, state.shear
            values = np.array([*tractions, state.gap, state.slip, state.state])
            for function, nodal in zip(self.functions, values[:, here], strict=True):
                function.x.array[nodes[here]] = nodal


def write_interface(comm: MPI.Comm, path: str | Path, state: InterfaceState) -> None:
    """Write what acts at the secondary nodes as a table, one node a row. Collective.

    Args:
        comm: Communicator.
        path: CSV file; its first line names the columns and their units. The state is the number
            of a `NodeState`.
        state: What acts, the same on all ranks.

    Raises:
        OSError: If the file cannot be written.
    """
    columns: dict[str, npt.NDArray[np.number]] = {
        "x [m]": state.points[:, 0],
        "y [m]": state.points[:, 1],
        "n_x [-]": state.normals[:, 0],
        "n_y [-]": state.normals[:, 1],
        "pressure [Pa]": state.pressure,
        "shear [Pa]": state.shear,
        "pore pressure [Pa]": state.pore_pressure,
        "jump [Pa]": state.jump,
        "gap [m]": state.gap,
        "slip [m]": state.slip,
        "state [-]": state.state,
        "length [m]": state.length,
        "force_x [N/m]": state.forces[:, 0],
        "force_y [N/m]": state.forces[:, 1],
    }
    path = Path(path)

    def write() -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        table = np.column_stack(list(columns.values()))
        np.savetxt(path, table, "%.17g", delimiter=",", header=",".join(columns), comments="")

    on_root(comm, write)


def arc_length(mesh: Mesh, pair: ContactPair) -> npt.NDArray[np.float64]:
    """Place of each secondary node along its surface, undeformed. Collective.

    Args:
        mesh: Mesh of the pair.
        pair: The pair.

    Returns:
        Length from the first node, the body on the left [m]; shape (n,), as in `InterfaceState`.
        Parts that do not hang together follow each other, as far apart as their ends.

    Raises:
        ValueError: If the pair is on another mesh.
    """
    surface = gather_surface(mesh, pair.facet_tags, pair.secondary, pair.name)
    order = np.concatenate(surface.chains)
    steps = np.hypot(*np.diff(surface.points[order], axis=0).T)
    result = np.empty(len(order))
    result[order] = np.append(0.0, np.cumsum(steps))
    return result


def evaluate(
    function: fem.Function,
    points: npt.ArrayLike,
    cells: npt.NDArray[np.int32] | None = None,
) -> npt.NDArray[np.float64]:
    """Values of a function at fixed points, the same on every rank for any partition. Collective.

    A point on several triangles is given to the one that came first in the input mesh, which
    decides where the function jumps: between touching bodies, or with a discontinuous element.

    Args:
        function: Function on straight triangles.
        points: Points [m], the same on all ranks; shape (n, 2).
        cells: Look only in these local cells, such as those of one body; all by default.

    Returns:
        Values; shape (n, components).

    Raises:
        ValueError: If the points have another shape, or one lies outside the mesh; names it.
    """
    mesh = function.function_space.mesh
    x = np.asarray(points, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 2:
        raise ValueError(f"points have shape (n, 2), not {x.shape}")
    x = np.column_stack((x, np.zeros(len(x))))

    owned = np.arange(mesh.topology.index_map(2).size_local, dtype=np.int32)
    if cells is not None:
        owned = np.intersect1d(owned, cells).astype(np.int32)
    point, cell = _containing(mesh, owned, x)

    # The cell of the lowest input index wins, on whichever rank it is.
    number = _compat.input_cell_index(mesh)
    nobody = np.iinfo(np.int64).max
    found = np.full(len(x), nobody)
    np.minimum.at(found, point, number[cell])
    first = np.empty_like(found)
    mesh.comm.Allreduce(found, first, op=MPI.MIN)
    if np.any(first == nobody):
        outside = x[np.argmax(first == nobody), :2]
        raise ValueError(f"the point ({outside[0]:g}, {outside[1]:g}) lies outside the mesh")

    values = np.zeros((len(x), int(np.prod(function.function_space.value_shape))))
    mine = number[cell] == first[point]
    if mine.any():
        values[point[mine]] = function.eval(x[point[mine]], cell[mine]).reshape(mine.sum(), -1)
    mesh.comm.Allreduce(MPI.IN_PLACE, values, op=MPI.SUM)
    return values


def _containing(
    mesh: Mesh, cells: npt.NDArray[np.int32], x: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int32]]:
    """Pairs of points and the triangles they are in or on; shapes (num_pairs,)."""
    if len(cells) == 0 or len(x) == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int32)
    nodes = mesh.geometry.x
    tree = geometry.bb_tree(mesh, 2, entities=cells, padding=INSIDE * float(np.ptp(nodes)))
    candidates = geometry.compute_collisions_points(tree, x)
    point = np.repeat(np.arange(len(x)), np.diff(candidates.offsets))
    cell = candidates.array
    # Not compute_colliding_cells: its tolerance is a fixed length, 1e-6 in whatever unit.
    a, b, c = np.moveaxis(nodes[_compat.cell_nodes(mesh)[cell], :2], 1, 0)
    p = x[point, :2]
    area = _cross(b - a, c - a)
    coordinates = np.stack((_cross(b - p, c - p), _cross(c - p, a - p), _cross(a - p, b - p)))
    inside = np.min(coordinates / area, axis=0) >= -INSIDE
    return point[inside], cell[inside]


def _cross(a: npt.NDArray[np.float64], b: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def gather_nodal(
    function: fem.Function,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64], npt.NDArray[np.float64]] | None:
    """Collect mesh and nodal values on rank 0, in the order of the input mesh. Collective.

    Args:
        function: P1 function of any shape.

    Returns:
        On rank 0, whatever the number of ranks: points [m], shape (N, 2); triangles by rows of
        points, shape (M, 3); values, shape (N, components). None on the other ranks.

    Raises:
        ValueError: If the function is not P1.
    """
    space = function.function_space
    element = space.ufl_element()
    if element != basix.ufl.element("P", "triangle", 1, shape=space.value_shape):
        raise ValueError(f"the function {function.name!r} is not P1 but {element}")
    gathered, values = gather_mesh(space.mesh), gather_values(function)
    if gathered is None or values is None:
        return None
    nodes, points, cells = gathered
    return points, np.searchsorted(nodes, cells), values


def gather_mesh(
    mesh: Mesh,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64], npt.NDArray[np.int64]] | None:
    """Collect a mesh on rank 0, in the order of its input. Collective.

    Args:
        mesh: Mesh or submesh, whose nodes have the numbers of the whole.

    Returns:
        On rank 0, whatever the number of ranks: numbers of the nodes in the input, increasing,
        shape (N,); their points [m], shape (N, 2); triangles by numbers of nodes, shape (M, 3).
        None on the other ranks.
    """
    number = mesh.geometry.input_global_indices
    nodes = mesh.geometry.index_map().size_local
    cells = mesh.topology.index_map(2).size_local
    parts = mesh.comm.gather(
        (
            number[:nodes],
            mesh.geometry.x[:nodes, :2],
            _compat.input_cell_index(mesh)[:cells],
            number[_compat.cell_nodes(mesh)[:cells]],
        )
    )
    if parts is None:
        return None
    numbers, points, order, triangles = map(np.concatenate, zip(*parts, strict=True))
    by_node = np.argsort(numbers)
    return numbers[by_node], points[by_node], triangles[np.argsort(order)]


def gather_values(function: fem.Function) -> npt.NDArray[np.float64] | None:
    """Collect values of a function on rank 0, in the order of `gather_mesh`. Collective.

    Args:
        function: Continuous, or constant in each cell.

    Returns:
        On rank 0 values at nodes, shape (N, components), or in triangles, shape (M, components).
        None on the other ranks.

    Raises:
        ValueError: If the function is discontinuous without being constant in each cell.
    """
    # A copy, since a part of a mixed function has its values scattered among the others.
    twin = _nodal_twin(function)
    twin.interpolate(function)
    space = twin.function_space
    mesh, dofs = space.mesh, space.dofmap.list
    if space.ufl_element().discontinuous:
        number, dof = _compat.input_cell_index(mesh), dofs[:, 0]
        owned = mesh.topology.index_map(2).size_local
    else:
        number = mesh.geometry.input_global_indices
        dof = np.empty(len(number), dtype=np.int32)
        dof[_compat.cell_nodes(mesh)] = dofs
        owned = mesh.geometry.index_map().size_local
    values = twin.x.array.reshape(-1, space.dofmap.bs)[dof[:owned]]
    parts = mesh.comm.gather((number[:owned], values))
    if parts is None:
        return None
    numbers, values = map(np.concatenate, zip(*parts, strict=True))
    return values[np.argsort(numbers)]
