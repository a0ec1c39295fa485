# SPDX-License-Identifier: LGPL-3.0-or-later
"""Assembly of compiled integrands over the node cells of one mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem, la

from .. import _compat
from .._kernels import assembly as kernels
from .node_cells import NodeCells, points_per_cell
from .point_form import FieldSlots, PointForm


class SmoothedTerm:
    """One integrand, compiled and bound to the node cells of a mesh.

    Args:
        point_form: The integrand.
        compiled: Its compiled form.
        node_cells: Node cells of the mesh.
        spaces: Space of the test and, for a tangent, of the trial field.

    Raises:
        ValueError: If the term is restricted to cells whose border runs through node cells or that
            do not exist, or one of its functions or spaces does not live on all of its cells.
    """

    def __init__(
        self,
        point_form: PointForm,
        compiled: Any,
        node_cells: NodeCells,
        spaces: list[fem.FunctionSpace],
    ) -> None:
        self._form = point_form
        self._compiled = compiled
        (self._address,) = _compat.kernel_addresses(compiled)
        self._node_cells = node_cells
        self.cells = _cells_of(point_form, node_cells)
        for f in point_form.coefficients:
            _check_reach(f.name, f.function_space, self.cells, node_cells)
        for space, kind in zip(spaces, ("test", "trial"), strict=False):
            _check_reach(f"the {kind} function", space, self.cells, node_cells)
        self._dofs = [node_cells.block_dofs(space) for space in spaces]
        self._field_slots = _component_slots(point_form)
        self._positions: npt.NDArray[np.int32] | None = None
        self._row_lengths: npt.NDArray[np.int32] | None = None
        self._position_offsets = np.zeros(self.cells.size + 1, np.int64)

    @property
    def coefficients(self) -> list[fem.Function]:
        """Functions the integrand depends on."""
        return list(self._form.coefficients)

    @property
    def constants(self) -> list[fem.Constant]:
        """Constants the integrand depends on."""
        return self._form.constants

    def pairs(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """Block rows and columns that the term couples, cell by cell, repetitions included."""
        offsets, nodes = self._node_cells.offsets, self._node_cells.nodes
        test, trial = (_reach(slots) for slots in self._form.arguments)
        counts = np.diff(offsets)[self.cells].astype(np.int64)
        n_rows = counts if test else np.ones_like(counts)
        n_columns = counts if trial else np.ones_like(counts)
        self._position_offsets = np.concatenate(([0], np.cumsum(n_rows * n_columns)))
        cell = np.repeat(np.arange(self.cells.size), n_rows * n_columns)
        pair = np.arange(cell.size) - self._position_offsets[cell]
        first = offsets[self.cells].astype(np.int64)[cell]
        rows = self._dofs[0][nodes[first + pair // n_columns[cell]]]
        columns = self._dofs[1][nodes[first + pair % n_columns[cell]]]
        return rows, columns

    def set_positions(
        self, positions: npt.NDArray[np.int32], row_lengths: npt.NDArray[np.int32]
    ) -> None:
        """Say where each of `pairs` stands in the values of a CSR matrix.

        Args:
            positions: First entry of the block of each pair.
            row_lengths: Entries in a row of each block row, one row of a block after the other.
        """
        self._positions = positions
        self._row_lengths = row_lengths

    def add_to_vector(self, b: npt.NDArray[np.float64]) -> None:
        """Add the integral of a linear term to a local vector; shape (n_dofs,)."""
        if self.cells.size == 0:
            return
        kernels.assemble_vector(*self._common(), *_argument(self._form, 0), self._dofs[0], b)

    def add_to_matrix(self, values: npt.NDArray[np.float64]) -> None:
        """Add the integral of a bilinear term to the values of a CSR matrix.

        Raises:
            RuntimeError: If `set_positions` has not been called.
        """
        if self._positions is None:
            raise RuntimeError("set_positions must be called before add_to_matrix")
        if self.cells.size == 0:
            return
        kernels.assemble_matrix(
            *self._common(),
            *_argument(self._form, 0),
            *_argument(self._form, 1),
            self._dofs[0],
            self._position_offsets,
            self._positions,
            self._row_lengths,
            values,
        )

    def _common(self) -> tuple[Any, ...]:
        cells = self._node_cells
        constants = [np.ravel(c.value).astype(np.float64) for c in self._form.constants]
        return (
            self._address,
            np.concatenate(constants) if constants else np.zeros(1),
            kernels.REFERENCE_TRIANGLE,
            self.cells,
            cells.offsets,
            cells.nodes,
            cells.gradients,
            cells.areas,
            points_per_cell(self._form.enhancement),
            self._fields(),
            self._field_slots,
            self._form.n_coefficients,
        )

    def _fields(self) -> npt.NDArray[np.float64]:
        """Nodal values of all coefficient components; shape (n_vertices, m)."""
        cells = self._node_cells
        columns = []
        for f in self._form.coefficients:
            if f.function_space.element.basix_element.degree:
                columns.append(cells.nodal_values(f))
            else:
                # Only owned nodes have a cell, and only their own value is read.
                means = np.zeros((cells.points.shape[0], f.function_space.dofmap.bs))
                means[: len(cells)] = cells.cell_means(f)
                columns.append(means)
        if self._form.position is not None:
            columns.append(cells.points)
        return np.hstack(columns) if columns else np.zeros((cells.points.shape[0], 0))


def _argument(form: PointForm, number: int) -> tuple[tuple[int, ...], npt.NDArray[Any], int]:
    slots = form.arguments[number]
    numbers = np.array([slots.value, slots.gradient, slots.divergence])
    return (0,) * slots.components, numbers, form.argument_sizes[number]


def _reach(slots: FieldSlots) -> bool:
    """Whether a field couples beyond the cell's own node."""
    return slots.gradient >= 0


def _component_slots(form: PointForm) -> npt.NDArray[np.int64]:
    """Slots of each coefficient component: value, gradient, mean divergence and its axis."""
    fields = [*form.coefficients.values(), *([form.position] if form.position else [])]
    rows = [
        (
            slots.value + a if slots.value >= 0 else slots.value,
            slots.gradient + 2 * a if slots.gradient >= 0 else slots.gradient,
            slots.divergence,
            a if slots.divergence >= 0 else 0,
        )
        for slots in fields
        for a in range(slots.components)
    ]
    return np.array(rows, np.int64).reshape(-1, 4)


def _cells_of(form: PointForm, node_cells: NodeCells) -> npt.NDArray[np.int32]:
    """Node cells that a term is integrated over."""
    everywhere = np.arange(len(node_cells), dtype=np.int32)
    if not form.subdomain:
        return everywhere
    tags = form.subdomain_data
    ids = form.subdomain[0] if len(form.subdomain) == 1 else form.subdomain
    if getattr(tags, "dim", None) != 2:
        raise ValueError(f"dc({ids}) needs subdomain_data with tags of cells")
    _compat.check_tags(tags, node_cells.mesh)
    tagged = node_cells.mesh.comm.allreduce(int(np.isin(tags.values, form.subdomain).sum()))
    if not tagged:
        raise ValueError(f"dc({ids}): no cell has such a tag")
    marks = la.vector(node_cells.mesh.topology.index_map(2), 1, dtype=np.float64)
    marks.array[tags.indices[np.isin(tags.values, form.subdomain)]] = 1.0
    # Tags may name owned triangles alone.
    marks.scatter_forward()
    some = _around(node_cells, marks.array > 0.0, np.logical_or)
    every = _around(node_cells, marks.array > 0.0, np.logical_and)
    straddling = node_cells.mesh.comm.allreduce(int(np.sum(some & ~every)))
    if straddling:
        raise ValueError(
            f"dc({ids}) cuts through {straddling} node cells: layers that share nodes "
            "need one term with coefficients constant on triangles (DG 0) instead"
        )
    return everywhere[some]


def _check_reach(
    name: str, space: fem.FunctionSpace, cells: npt.NDArray[np.int32], node_cells: NodeCells
) -> None:
    """Refuse a term whose function lives on a submesh that lacks triangles of the term's cells."""
    try:
        missing = node_cells.cells_on(space.mesh) < 0
    except ValueError:
        raise ValueError(
            f"a term on dc: {name} lives on another mesh, and no entity map says what part it is"
        ) from None
    comm = node_cells.mesh.comm
    outside = comm.allreduce(int(_around(node_cells, missing, np.logical_or)[cells].sum()))
    if not outside:
        return
    marks = la.vector(node_cells.mesh.topology.index_map(2), 1, dtype=np.float64)
    marks.array[:] = ~missing
    marks.scatter_reverse(la.InsertMode.add)
    marks.scatter_forward()
    if comm.allreduce(int(np.sum(missing & (marks.array > 0.0)))):
        raise ValueError(
            f"a term on dc: the submesh of {name} lacks ghost cells; create it from owned and "
            "ghost cells, as Domain.submesh does"
        )
    raise ValueError(
        f"a term on dc: {name} does not live on {outside} of its node cells; restrict the term to "
        "the bodies of its submesh, dc(tags)"
    )


def _around(
    node_cells: NodeCells, marks: npt.NDArray[np.bool_], combine: np.ufunc
) -> npt.NDArray[np.bool_]:
    """Combine marks of triangles to one for each node cell."""
    starts = node_cells.triangle_offsets[:-1]
    # Not even one cell: reduceat refuses.
    if not starts.size:
        return marks[:0]
    result: npt.NDArray[np.bool_] = combine.reduceat(marks[node_cells.triangles], starts)
    return result
