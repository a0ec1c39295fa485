# SPDX-License-Identifier: LGPL-3.0-or-later
"""Assembly of compiled integrands over the node cells of one mesh."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, la
from dolfinx.mesh import Mesh
from ufl.core.expr import Expr

from .. import _compat
from .._kernels import assembly as kernels
from .._kernels.sparse import patch_pairs
from .measure import dc
from .node_cells import NodeCells, points_per_cell
from .point_form import (
    FieldSlots,
    PointForm,
    is_at_points,
    is_nodal,
    is_on_triangles,
    point_expression,
)


class _Integrand:
    """An integrand, compiled and bound to the functions of a mesh.

    Args:
        point_form: The integrand.
        compiled: The compiled `PointForm.sources`.
        node_cells: Node cells of the mesh.
        on_triangles: Whether it is evaluated on the triangles as such.
    """

    def __init__(
        self,
        point_form: PointForm,
        compiled: Sequence[Any],
        node_cells: NodeCells,
        on_triangles: bool = False,
    ) -> None:
        self.form = point_form
        self._compiled = compiled
        (self._address,) = _compat.kernel_addresses(compiled[0])
        self._on_triangles = on_triangles
        self._node_cells = node_cells
        for f in point_form.coefficients:
            _check_mesh(f.name, f.mesh if is_at_points(f) else f.function_space.mesh, node_cells)
        self._field_slots = _component_slots(point_form)
        rest = iter(compiled[1:])
        self._averages = {
            reach: [
                _Integrand(average, [next(rest)], node_cells, on_triangles=True)
                for average in group
            ]
            for reach, group in point_form.averages.items()
        }

    @property
    def cells(self) -> NodeCells:
        """What the integrand is evaluated in."""
        return self._node_cells.on_triangles if self._on_triangles else self._node_cells

    def arguments(self, where: npt.NDArray[np.int32]) -> tuple[Any, ...]:
        """First arguments of the assembly kernels."""
        cells, form = self.cells, self.form
        constants = [np.ravel(c.value).astype(np.float64) for c in form.constants]
        return (
            self._address,
            np.concatenate(constants) if constants else np.zeros(1),
            kernels.REFERENCE_TRIANGLE,
            where,
            cells.offsets,
            cells.nodes,
            cells.gradients,
            cells.areas,
            points_per_cell(form.enhancement),
            self._nodal_values(),
            self._field_slots,
            self._cell_values(),
            self._point_values(),
            form.n_coefficients,
        )

    def evaluate(self, where: npt.NDArray[np.int32]) -> npt.NDArray[np.float64]:
        """Arrays of the integrand in some cells; shape (cells, n_points, their size)."""
        size = int(np.prod(self.form.argument_sizes))
        result = np.empty((where.size, points_per_cell(self.form.enhancement), size))
        if where.size:
            kernels.evaluate(*self.arguments(where), result)
        return result

    def on_triangles(self) -> npt.NDArray[np.float64]:
        """Arrays of an average's integrand on all triangles; shape (n_triangles, their size)."""
        return self.evaluate(self.cells.triangles)[:, 0]

    def averages(self, *reach: int) -> list[_Integrand]:
        """Averages that hold arguments of these numbers."""
        return self._averages.get(reach, [])

    def patch_vectors(self, number: int) -> npt.NDArray[np.float64]:
        """Variations of averages by one argument; shape (patch entries, m, components)."""
        cells = self._node_cells
        averages = self.averages(number)
        components = self.form.arguments[number].components
        result = np.zeros((cells.nodes.size, len(averages), components))
        gradients = cells.on_triangles.gradients.reshape(-1, 3, 3, 2)[:, :, 0]
        for m, average in enumerate(averages):
            forms = average.on_triangles().reshape(-1, components, 2)
            result[:, m] = kernels.patch_vectors(
                cells.triangles, cells.weights, cells.corners, gradients, forms, cells.nodes.size
            )
        return result

    def _nodal_values(self) -> npt.NDArray[np.float64]:
        """Nodal values of all P1 components; shape (n_vertices, m)."""
        cells = self._node_cells
        columns = [cells.nodal_values(f) for f in self.form.fields(is_nodal)]
        if self.form.position is not None:
            columns.append(cells.points)
        return np.hstack(columns) if columns else np.zeros((cells.points.shape[0], 0))

    def _cell_values(self) -> npt.NDArray[np.float64]:
        """What is constant on a cell; shape (n_cells, m)."""
        cells = self.cells
        columns = [cells.cell_means(f) for f in self.form.fields(is_on_triangles)]
        columns += [cells.means(average.on_triangles()) for average in self.averages()]
        return np.hstack(columns) if columns else np.zeros((len(cells), 0))

    def _point_values(self) -> npt.NDArray[np.float64]:
        """What has values at points; shape (n_cells, n_points, m)."""
        arrays = [f.values for f in self.form.fields(is_at_points)]
        if len(arrays) == 1:
            return arrays[0]
        if arrays:
            return np.concatenate(arrays, axis=2)
        return np.zeros((len(self.cells), points_per_cell(self.form.enhancement), 0))


class SmoothedTerm:
    """One integrand, compiled and bound to the node cells of a mesh.

    Args:
        point_form: The integrand.
        compiled: Its compiled forms, those of `PointForm.sources`.
        node_cells: Node cells of the mesh.
        spaces: Space of the test and, for a tangent, of the trial field.

    Raises:
        ValueError: If the term is restricted to cells whose border runs through node cells or that
            do not exist, one of its functions or spaces does not live on all of its cells, or one
            of its functions at smoothing points has no values in some of them.
    """

    def __init__(
        self,
        point_form: PointForm,
        compiled: Sequence[Any],
        node_cells: NodeCells,
        spaces: list[fem.FunctionSpace],
    ) -> None:
        self._form = point_form
        self._integrand = _Integrand(point_form, compiled, node_cells)
        self._node_cells = node_cells
        self.cells = cells_of(point_form.subdomain, point_form.subdomain_data, node_cells)
        for f in point_form.coefficients:
            if not is_at_points(f):
                _check_reach(f.name, f.function_space, self.cells, node_cells)
        for space, kind in zip(spaces, ("test", "trial"), strict=False):
            _check_reach(f"the {kind} function", space, self.cells, node_cells)
        for f in point_form.fields(is_at_points):
            missing = 0 if f.cells is None else np.setdiff1d(self.cells, f.cells).size
            if node_cells.mesh.comm.allreduce(missing):
                raise ValueError(f"{f.name} has no values in some of the cells of its term")
        self._dofs = [node_cells.block_dofs(space) for space in spaces]
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
        patches = self._node_cells.offsets, self._node_cells.nodes
        reaches = (_reaches(slots) for slots in self._form.arguments)
        self._position_offsets, rows, columns = patch_pairs(
            self.cells, *patches, *self._dofs, *reaches
        )
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
        variations = self._integrand.patch_vectors(0)
        kernels.assemble_vector(
            *self._integrand.arguments(self.cells), *self._argument(0, variations), self._dofs[0], b
        )

    def add_to_matrix(self, values: npt.NDArray[np.float64]) -> None:
        """Add the integral of a bilinear term to the values of a CSR matrix.

        Raises:
            RuntimeError: If `set_positions` has not been called.
        """
        if self._positions is None:
            raise RuntimeError("set_positions must be called before add_to_matrix")
        if self.cells.size == 0:
            return
        second = self._integrand.averages(0, 1)
        weights = np.zeros((len(self._node_cells), len(second)))
        by_test = self._integrand.patch_vectors(0)
        by_trial = by_test if self._same_variations else self._integrand.patch_vectors(1)
        kernels.assemble_matrix(
            *self._integrand.arguments(self.cells),
            *self._argument(0, by_test),
            *self._argument(1, by_trial),
            self._dofs[0],
            self._position_offsets,
            self._positions,
            self._row_lengths,
            weights,
            values,
        )
        for average, weight in zip(second, weights.T, strict=True):
            self._add_second_variation(average, weight, values)

    def _add_second_variation(
        self,
        average: _Integrand,
        weight: npt.NDArray[np.float64],
        values: npt.NDArray[np.float64],
    ) -> None:
        """Add a second variation of a cell average; its weight has shape (n_cells,)."""
        cells = self._node_cells
        used, pairs = self._triangle_pairs
        on_triangles = np.bincount(
            cells.triangles,
            cells.weights * np.repeat(weight, np.diff(cells.triangle_offsets)),
            cells.vertices.shape[0],
        )
        rows, columns = (slots.components for slots in self._form.arguments)
        kernels.add_second_variations(
            used,
            pairs,
            on_triangles,
            cells.on_triangles.gradients.reshape(-1, 3, 3, 2)[:, :, 0],
            average.on_triangles().reshape(-1, rows, 2, columns, 2),
            cells.vertices,
            self._dofs[0],
            self._positions,
            self._row_lengths,
            values,
        )

    @cached_property
    def _triangle_pairs(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int64]]:
        """Triangles of the term, and which of `pairs` theirs are; (n,) and (n, 3, 3)."""
        cells = self._node_cells
        index = np.full(len(cells), -1)
        index[self.cells] = np.arange(self.cells.size)
        owner = np.repeat(np.arange(len(cells)), np.diff(cells.triangle_offsets))
        entries = np.flatnonzero(index[owner] >= 0)
        used, first = np.unique(cells.triangles[entries], return_index=True)
        entries = entries[first]
        owner = owner[entries]
        local = cells.corners[entries] - cells.offsets[owner][:, None]
        counts = np.diff(cells.offsets)[owner].astype(np.int64)
        start = self._position_offsets[index[owner]]
        pairs = local[:, :, None] * counts[:, None, None] + local[:, None, :]
        return used.astype(np.int32), start[:, None, None] + pairs

    @cached_property
    def _same_variations(self) -> bool:
        """Whether cell averages vary with test and trial field alike."""
        test, trial = (self._form.averages.get((number,), []) for number in (0, 1))
        return len(test) == len(trial) and all(
            a.form.signature() == b.form.signature()
            and list(a.coefficients) == list(b.coefficients)
            and a.constants == b.constants
            for a, b in zip(test, trial, strict=True)
        )

    def _argument(self, number: int, variations: npt.NDArray[np.float64]) -> tuple[Any, ...]:
        slots = self._form.arguments[number]
        numbers = (slots.value, slots.gradient, slots.divergence, slots.average, slots.pair)
        return (
            (0,) * slots.components,
            np.array(numbers),
            variations,
            self._form.argument_sizes[number],
        )


class PointExpression:
    """Scalar expressions, compiled to be evaluated at smoothing points. Collective.

    Args:
        expressions: UFL scalars: P1 fields and their smoothed gradients, data constant on
            triangles, constants, functions at the points, coordinates (of the node).
        node_cells: Node cells of the mesh.
        measure: Measure over node cells: the enhancement, and where.

    Attributes:
        cells: Cells of the points, in ascending order.

    Raises:
        ValueError: If the expressions hold what has no meaning there.
    """

    def __init__(
        self, expressions: Sequence[Expr], node_cells: NodeCells, measure: ufl.Measure = dc
    ) -> None:
        form = point_expression(expressions, measure)
        compiled = _compat.compile_forms(node_cells.mesh.comm, form.sources)
        self._integrand = _Integrand(form, compiled, node_cells)
        self.cells = cells_of(form.subdomain, form.subdomain_data, node_cells)

    def evaluate(self) -> npt.NDArray[np.float64]:
        """Return the values; shape (cells.size, n_points, number of expressions)."""
        return self._integrand.evaluate(self.cells)


def evaluate_at_points(
    expression: Expr, node_cells: NodeCells, measure: ufl.Measure = dc
) -> npt.NDArray[np.float64]:
    """Evaluate an expression at the smoothing points. Collective.

    Args:
        expression: UFL scalar, vector or tensor, as in `PointExpression`.
        node_cells: Node cells of the mesh.
        measure: Measure over node cells: the enhancement, and where.

    Returns:
        Values; shape (cells, n_points, *shape of the expression). The cells are those of the nodes
        that this rank owns, or of them those where the measure is.

    Raises:
        ValueError: If the expression holds what has no meaning there.
    """
    shape = expression.ufl_shape
    parts = [expression[i] for i in np.ndindex(*shape)] if shape else [expression]
    values = PointExpression(parts, node_cells, measure).evaluate()
    return values.reshape(*values.shape[:2], *shape)


def _reaches(slots: FieldSlots) -> bool:
    """Whether a field couples beyond the cell's own node."""
    return slots.gradient >= 0 or slots.n_averages > 0 or slots.n_pairs > 0


def _component_slots(form: PointForm) -> npt.NDArray[np.int64]:
    """Slots of each nodal component: value, gradient, mean divergence and its axis."""
    fields = [form.coefficients[f] for f in form.fields(is_nodal)]
    rows = [
        (
            slots.value + a if slots.value >= 0 else slots.value,
            slots.gradient + 2 * a if slots.gradient >= 0 else slots.gradient,
            slots.divergence,
            a if slots.divergence >= 0 else 0,
        )
        for slots in [*fields, *([form.position] if form.position else [])]
        for a in range(slots.components)
    ]
    return np.array(rows, np.int64).reshape(-1, 4)


def cells_of(subdomain: tuple[int, ...], tags: Any, node_cells: NodeCells) -> npt.NDArray[np.int32]:
    """Node cells of a subdomain, in ascending order. Collective.

    Args:
        subdomain: Ids of cells; empty for everywhere.
        tags: Tags of cells.
        node_cells: Node cells of the mesh.

    Raises:
        ValueError: If the term is restricted to cells whose border runs through node cells or that
            do not exist.
    """
    everywhere = np.arange(len(node_cells), dtype=np.int32)
    if not subdomain:
        return everywhere
    ids = subdomain[0] if len(subdomain) == 1 else subdomain
    if getattr(tags, "dim", None) != 2:
        raise ValueError(f"dc({ids}) needs subdomain_data with tags of cells")
    _compat.check_tags(tags, node_cells.mesh)
    tagged = node_cells.mesh.comm.allreduce(int(np.isin(tags.values, subdomain).sum()))
    if not tagged:
        raise ValueError(f"dc({ids}): no cell has such a tag")
    marks = la.vector(node_cells.mesh.topology.index_map(2), 1, dtype=np.float64)
    marks.array[tags.indices[np.isin(tags.values, subdomain)]] = 1.0
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


def _check_mesh(name: str, mesh: Mesh, node_cells: NodeCells) -> npt.NDArray[np.int32]:
    """Triangles of another mesh that those of the node cells are, -1 where none."""
    try:
        return node_cells.cells_on(mesh)
    except ValueError:
        raise ValueError(
            f"a term on dc: {name} lives on another mesh, and no entity map says what part it is"
        ) from None


def _check_reach(
    name: str, space: fem.FunctionSpace, cells: npt.NDArray[np.int32], node_cells: NodeCells
) -> None:
    """Refuse a term whose function lives on a submesh that lacks triangles of the term's cells."""
    missing = _check_mesh(name, space.mesh, node_cells) < 0
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
