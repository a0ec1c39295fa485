# SPDX-License-Identifier: LGPL-3.0-or-later
"""Node cells of a triangular mesh and the gradients smoothed over them (Section 3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem, la
from dolfinx.mesh import CellType, Mesh

from .. import _compat
from .._kernels import node_cells as kernels
from .measure import Enhancement


@dataclass(frozen=True)
class NodeCells:
    """Cells around the nodes that this rank owns, built from a third of each triangle around.

    Attributes:
        mesh: The mesh.
        offsets: Where each cell's patch begins in ``nodes``; shape (n_cells + 1,).
        nodes: Vertices of the triangles around each node, the node itself first.
        gradients: For each entry of ``nodes`` the mean gradient of its shape function over the
            cell [1/m] and the derivatives of the gradient along the cell's axes [1/m^2] (Eqs. 31,
            35); shape (entries, 3, 2).
        areas: Cell areas A_c [m^2] (Eq. 32); shape (n_cells,).
        triangle_offsets: Where each cell's triangles begin in ``triangles``; shape (n_cells + 1,).
        triangles: Triangles around each node.
        weights: Their smoothing coefficients alpha_I (Eq. 32); sum 1 over each cell.
        vertices: Vertices of each local triangle; shape (n_triangles, 3).
        points: Coordinates of the vertices [m]; shape (n_vertices, 2).
        angles: Angles of the cells' axes to x and y, counterclockwise [rad]; shape (n_cells,).
        entity_maps: Maps to submeshes that functions may live on.
    """

    mesh: Mesh
    offsets: npt.NDArray[np.int32]
    nodes: npt.NDArray[np.int32]
    gradients: npt.NDArray[np.float64]
    areas: npt.NDArray[np.float64]
    triangle_offsets: npt.NDArray[np.int32]
    triangles: npt.NDArray[np.int32]
    weights: npt.NDArray[np.float64]
    vertices: npt.NDArray[np.int32]
    points: npt.NDArray[np.float64]
    angles: npt.NDArray[np.float64]
    entity_maps: list[Any]

    def __len__(self) -> int:
        """Return the number of node cells on this rank."""
        return self.areas.size

    @cached_property
    def input_nodes(self) -> npt.NDArray[np.int64]:
        """Number of each cell's node in the input of the mesh; shape (n_cells,)."""
        index = np.empty(len(self.points), np.int64)
        index[self.vertices] = self.mesh.geometry.input_global_indices[
            _compat.cell_nodes(self.mesh)
        ]
        return index[: len(self)]

    @cached_property
    def corners(self) -> npt.NDArray[np.int32]:
        """Entry of ``nodes`` of each vertex of ``triangles``; shape (triangles.size, 3)."""
        topology = self.vertices, self.triangle_offsets, self.triangles, self.offsets, self.nodes
        return kernels.patch_corners(*topology, self.points.shape[0])

    @cached_property
    def on_triangles(self) -> NodeCells:
        """The triangles as cells of their own: patches of three nodes, no second gradient."""
        n = self.vertices.shape[0]
        own = np.arange(n + 1, dtype=np.int32)
        gradients = np.zeros((n, 3, 3, 2))
        gradients[:, :, 0] = kernels.triangle_gradients(self.vertices, self.points)
        return replace(
            self,
            offsets=3 * own,
            nodes=self.vertices.ravel(),
            gradients=gradients.reshape(-1, 3, 2),
            areas=np.ones(n),
            triangle_offsets=own,
            triangles=own[:-1],
            weights=np.ones(n),
            angles=np.zeros(n),
        )

    def follow(self) -> None:
        """Take over where the nodes of the mesh are now, on axes turned by ``angles``."""
        self.points[self.vertices.ravel()] = _corner_points(self.mesh)
        around = self.mesh.topology.connectivity(0, 2)
        self.areas[:], self.gradients[:] = kernels.smoothed_gradients(
            self.vertices, self.points, around.offsets, around.array, self.offsets, self.nodes
        )
        kernels.turn_axes(self.gradients, self.offsets, self.angles)
        thirds = _areas(self.points[self.vertices]) / 3.0
        self.weights[:] = thirds[self.triangles] / np.repeat(
            self.areas, np.diff(self.triangle_offsets)
        )
        self.__dict__.pop("on_triangles", None)

    def block_dofs(self, space: fem.FunctionSpace) -> npt.NDArray[np.int32]:
        """Block dof of each local vertex in a continuous P1 space; shape (n_vertices,).

        It is -1 at vertices that are not on the submesh of the space.
        """
        cells = self.cells_on(space.mesh)
        inside = cells >= 0
        dofs = np.full(self.points.shape[0], -1, np.int32)
        dofs[self.vertices[inside]] = space.dofmap.list[cells[inside]]
        return dofs

    def cells_on(self, mesh: Mesh) -> npt.NDArray[np.int32]:
        """Cell that each local triangle is on a submesh, or this mesh; -1 where it is none.

        Raises:
            ValueError: If no entity map leads there.
        """
        return _compat.cells_of_part(self.mesh, mesh, self.entity_maps)

    def nodal_values(self, function: fem.Function) -> npt.NDArray[np.float64]:
        """Values of a P1 function at the local vertices; shape (n_vertices, components).

        They are nan at vertices that are not on the submesh of the function.
        """
        space = function.function_space
        return _rows(function.x.array.reshape(-1, space.dofmap.bs), self.block_dofs(space))

    def cell_means(self, function: fem.Function) -> npt.NDArray[np.float64]:
        """Means of a function that is constant on triangles; shape (n_cells, components).

        They are nan in cells with triangles that are not on the submesh of the function.
        """
        dofmap, cells = function.function_space.dofmap, self.cells_on(function.function_space.mesh)
        by_cell = function.x.array.reshape(-1, dofmap.bs)[dofmap.list[:, 0]]
        return self.means(_rows(by_cell, cells))

    def means(self, on_triangles: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Means over the cells of values on all triangles; shape (n_cells, components)."""
        weighted = self.weights[:, None] * on_triangles[self.triangles]
        return np.add.reduceat(weighted, self.triangle_offsets[:-1], axis=0)

    def gradient(
        self, function: fem.Function, enhancement: Enhancement = "deviatoric"
    ) -> npt.NDArray[np.float64]:
        """Evaluate the smoothed gradient of a P1 function at the smoothing points (Eq. 37).

        Args:
            function: Scalar or vector P1 function; its ghosts must be up to date.
            enhancement: As in `node_cells_measure`.

        Returns:
            Gradients; shape (n_cells, 4, components, 2), one point a cell where the enhancement
            is ``"none"``. The points lie at -r_c and r_c along the cell's first axis, then along
            the second (Eq. 38).
        """
        values = self.nodal_values(function)
        n_points = points_per_cell(enhancement)
        arrays = (self.offsets, self.nodes, self.gradients, self.areas, values)
        result = kernels.point_gradients(*arrays, n_points)
        if enhancement == "deviatoric" and values.shape[1] == 2:
            mean = kernels.point_gradients(*arrays, 1)
            excess = np.trace(mean - result, axis1=2, axis2=3)
            result += 0.5 * excess[..., None, None] * np.eye(2)
        return result


def points_per_cell(enhancement: Enhancement) -> int:
    """Return the number of smoothing points in a node cell."""
    return 1 if enhancement == "none" else 4


def _rows(values: npt.NDArray[np.float64], numbers: npt.NDArray[np.int32]) -> Any:
    """Rows of an array by their numbers, nan where the number is -1."""
    result = np.full((numbers.size, values.shape[1]), np.nan)
    inside = numbers >= 0
    result[inside] = values[numbers[inside]]
    return result


def create_node_cells(mesh: Mesh, entity_maps: Sequence[Any] = ()) -> NodeCells:
    """Build the node cells of a mesh. Collective.

    Args:
        mesh: Mesh of straight triangles in the plane. On several ranks it must have all triangles
            around every owned vertex: see `vertex_ghost_partitioner`.
        entity_maps: Maps to submeshes that functions may live on.

    Raises:
        ValueError: If the mesh is not of straight triangles in the plane.
        RuntimeError: If triangles around an owned vertex are missing on a rank.
    """
    topology = mesh.topology
    if topology.cell_type != CellType.triangle or mesh.geometry.dim != 2:
        raise ValueError(
            f"node cells need a mesh of triangles in the plane, not {topology.cell_type.name} cells"
            f" in {mesh.geometry.dim} dimensions"
        )
    if mesh.geometry.cmaps[0].degree != 1:
        raise ValueError("node cells need straight triangles; this mesh has curved ones")
    topology.create_connectivity(2, 0)
    topology.create_connectivity(0, 2)
    vertex_map = topology.index_map(0)
    n_owned = vertex_map.size_local
    n_vertices = n_owned + vertex_map.num_ghosts
    vertices = topology.connectivity(2, 0).array.reshape(-1, 3)
    around = topology.connectivity(0, 2)
    _check_complete(mesh, vertices, around.offsets)
    offsets, nodes = kernels.patch_nodes(
        vertices, around.offsets, around.array, n_owned, n_vertices
    )
    triangle_offsets = around.offsets[: n_owned + 1].copy()
    triangles = around.array[: triangle_offsets[-1]].copy()
    node_cells = NodeCells(
        mesh,
        offsets,
        nodes,
        np.empty((nodes.size, 3, 2)),
        np.empty(n_owned),
        triangle_offsets,
        triangles,
        np.empty(triangles.size),
        vertices,
        np.empty((n_vertices, 2)),
        np.zeros(n_owned),
        list(entity_maps),
    )
    node_cells.follow()
    return node_cells


def _corner_points(mesh: Mesh) -> npt.NDArray[np.float64]:
    """Coordinates of the vertices of all triangles [m]; shape (3 * n_triangles, 2)."""
    return mesh.geometry.x[_compat.cell_nodes(mesh).ravel(), :2]


def _areas(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Areas of triangles [m^2] from their corners; shape (n, 3, 2)."""
    edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * np.abs(edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0])


def _check_complete(
    mesh: Mesh, vertices: npt.NDArray[np.int32], around_offsets: npt.NDArray[np.int32]
) -> None:
    """Compare the triangles that this rank sees around its vertices with those that exist."""
    topology = mesh.topology
    vertex_map = topology.index_map(0)
    count = la.vector(vertex_map, 1, dtype=np.int64)
    owned = vertices[: topology.index_map(2).size_local]
    count.array[:] = np.bincount(owned.ravel(), minlength=count.array.size)
    count.scatter_reverse(la.InsertMode.add)
    n_owned = vertex_map.size_local
    missing = int(np.sum(np.diff(around_offsets)[:n_owned] != count.array[:n_owned]))
    missing = mesh.comm.allreduce(missing)
    if missing:
        raise RuntimeError(
            f"the mesh lacks triangles around {missing} vertices at rank boundaries; "
            "create it with partitioner=fenicsx_hmcontact.vertex_ghost_partitioner()"
        )
