# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where stresses live: smoothing points of node cells, or quadrature points of triangles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import basix
import basix.ufl
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from .. import _compat
from ..smoothing import (
    METADATA_KEY,
    NodeCells,
    PointExpression,
    PointFunction,
    cells_of,
    create_node_cells,
    points_per_cell,
    subdomain_ids,
)
from .interface import Float


class Points(Protocol):
    """Points of one material; arrays run over its cells, then over the points of a cell.

    Attributes:
        measure: Measure of terms with what lives there.
        n_cells: Number of cells of the material on this rank.
        n_points: Points in each.
        node_cells: Node cells, None where the points are those of triangles.
    """

    measure: ufl.Measure
    n_cells: int
    n_points: int
    node_cells: NodeCells | None

    def function(self, shape: tuple[int, ...], name: str) -> Any:
        """Create a coefficient with values at the points."""

    def write(self, function: Any, values: Float) -> None:
        """Give a coefficient its values; shape (n, components)."""

    def expression(self, parts: Sequence[Expr]) -> Callable[[], Float]:
        """Compile scalars to a function that gives their values; shape (n, parts). Collective."""

    def coordinates(self) -> Float:
        """Coordinates that a field of initial values is taken at [m]; shape (n, 2)."""

    def areas(self) -> Float:
        """Part of the area that each point stands for [m^2]; shape (n,)."""


class SmoothingPoints:
    """Points of node cells, see `Points`.

    Args:
        u: P1 displacement.
        measure: Measure over node cells: the enhancement, and where.
        node_cells: Node cells of the mesh.
    """

    def __init__(self, u: fem.Function, measure: ufl.Measure, node_cells: NodeCells | None) -> None:
        self._mesh = u.function_space.mesh
        self.measure = measure
        self.node_cells = node_cells or create_node_cells(self._mesh)
        self._enhancement = measure.metadata()[METADATA_KEY]
        self.n_points = points_per_cell(self._enhancement)
        ids = subdomain_ids(measure.subdomain_id())
        self.cells = cells_of(ids, measure.subdomain_data(), self.node_cells)
        self.n_cells = self.cells.size

    def function(self, shape: tuple[int, ...], name: str) -> PointFunction:
        """Create a coefficient with values at the points."""
        values = np.zeros((len(self.node_cells), self.n_points, math.prod(shape)))
        function = PointFunction(self._mesh, shape, self._enhancement, values, name)
        function.cells = self.cells
        return function

    def write(self, function: PointFunction, values: Float) -> None:
        """Give a coefficient its values; shape (n, components)."""
        function.values[self.cells] = values.reshape(self.n_cells, self.n_points, values.shape[1])

    def expression(self, parts: Sequence[Expr]) -> Callable[[], Float]:
        """Compile scalars to a function that gives their values; shape (n, parts). Collective."""
        expression = PointExpression(parts, self.node_cells, self.measure)
        return lambda: expression.evaluate().reshape(-1, len(parts))

    def coordinates(self) -> Float:
        """Coordinates of the node, for all its points: linear stresses then balance weight."""
        return np.repeat(self.node_cells.points[self.cells], self.n_points, axis=0)

    def areas(self) -> Float:
        """Part of the area that each point stands for; all in a cell alike."""
        return np.repeat(self.node_cells.areas[self.cells] / self.n_points, self.n_points)


class QuadraturePoints:
    """Points of triangles, see `Points`: as many as integrate the gradient's square exactly.

    Args:
        u: Displacement, P1 or higher.
        measure: Measure ``dx`` without degree, and where.
    """

    node_cells = None

    def __init__(self, u: fem.Function, measure: ufl.Measure) -> None:
        mesh = self._mesh = u.function_space.mesh
        degree = self._degree = 2 * (u.function_space.element.basix_element.degree - 1)
        self.measure = measure.reconstruct(
            domain=mesh, metadata={"quadrature_degree": degree, "quadrature_scheme": "default"}
        )
        self._reference, self._weights = basix.make_quadrature(basix.CellType.triangle, degree)
        self.n_points = len(self._reference)
        self.cells = _tagged(measure, mesh.topology.index_map(2).size_local)
        self.n_cells = self.cells.size

    def function(self, shape: tuple[int, ...], name: str) -> fem.Function:
        """Create a coefficient with values at the points."""
        element = basix.ufl.quadrature_element(
            "triangle", value_shape=shape, degree=self._degree, scheme="default"
        )
        function = _QuadratureFunction(fem.functionspace(self._mesh, element), name=name)
        # A term that reaches beyond the body must not find zeros there.
        function.x.array[:] = np.nan
        return function

    def write(self, function: fem.Function, values: Float) -> None:
        """Give a coefficient its values; shape (n, components)."""
        dofmap = function.function_space.dofmap
        array = function.x.array.reshape(-1, dofmap.bs)
        array[dofmap.list[self.cells].ravel()] = values.reshape(-1, dofmap.bs)

    def expression(self, parts: Sequence[Expr]) -> Callable[[], Float]:
        """Compile scalars to a function that gives their values; shape (n, parts). Collective."""
        expression = fem.Expression(ufl.as_vector(list(parts)), self._reference)
        return lambda: expression.eval(self._mesh, self.cells).reshape(-1, len(parts))

    def coordinates(self) -> Float:
        """Coordinates of the points."""
        x = self._mesh.geometry.x[_compat.cell_nodes(self._mesh)[self.cells], :2]
        xi = self._reference
        shape = np.column_stack([1.0 - xi.sum(axis=1), xi])
        return np.einsum("pk,nki->npi", shape, x).reshape(-1, 2)

    def areas(self) -> Float:
        """Part of the area that each point stands for, of triangles with straight edges."""
        x = self._mesh.geometry.x[_compat.cell_nodes(self._mesh)[self.cells], :2]
        (a, b), (c, d) = (x[:, 1] - x[:, 0]).T, (x[:, 2] - x[:, 0]).T
        return np.outer(np.abs(a * d - b * c), self._weights).ravel()


class _QuadratureFunction(fem.Function):
    """Values at quadrature points that may come from an operator."""

    operator: Any = None


def create_points(
    u: fem.Function, measure: ufl.Measure, node_cells: NodeCells | None
) -> SmoothingPoints | QuadraturePoints:
    """Create the points that a measure asks for. Collective.

    Args:
        u: Displacement.
        measure: `node_cells_measure` or ``dx``, restricted to cells or not.
        node_cells: Node cells of the mesh, None to build them where needed.

    Raises:
        ValueError: If the measure is one over facets, has a degree, or cuts node cells.
    """
    if measure.integral_type() != "cell":
        raise ValueError(f"stresses live in cells, not on a measure of {measure.integral_type()}")
    if METADATA_KEY in measure.metadata():
        return SmoothingPoints(u, measure, node_cells)
    if measure.metadata():
        raise ValueError(f"stresses have points of their own: leave out {measure.metadata()}")
    return QuadraturePoints(u, measure)


def _tagged(measure: ufl.Measure, n_cells: int) -> npt.NDArray[np.int32]:
    """Owned cells that a measure is restricted to."""
    ids = subdomain_ids(measure.subdomain_id())
    if not ids:
        return np.arange(n_cells, dtype=np.int32)
    tags = measure.subdomain_data()
    if getattr(tags, "dim", None) != 2:
        raise ValueError(f"dx({ids}) needs subdomain_data with tags of cells")
    cells = tags.indices[np.isin(tags.values, ids)]
    return cells[cells < n_cells]
