# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact surfaces: chains of boundary facets, the same on every rank, and their normals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx.fem import FunctionSpace
from dolfinx.mesh import Mesh, MeshTags, entities_to_geometry, exterior_facet_indices

from .._compat import cell_nodes

FOLD = 1e-6
"""Two unit edge normals whose sum is shorter than this belong to a surface folded onto itself."""


SAME_PLACE = 1e-6
"""Nodes of a surface and of a submesh are the same within this part of the shortest edge."""


def cross(a: npt.NDArray[np.float64], b: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Component of a x b out of the plane, for vectors along the last axis."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


@dataclass(frozen=True, eq=False)
class Surface:
    """A contact surface, replicated on all ranks.

    Attributes:
        name: Name of the surface in the scene.
        nodes: Global vertex indices of the mesh; shape (n,).
        input_nodes: Indices of the nodes in the input of the mesh, increasing; shape (n,).
        points: Coordinates of the nodes [m]; shape (n, 2).
        edges: First and second node of every edge as positions in ``nodes``, the body on the left;
            shape (m, 2).

    Raises:
        ValueError: If shapes do not fit, a coordinate is not finite, an edge has no length, or the
            surface branches.
    """

    name: str
    nodes: npt.NDArray[np.int64]
    input_nodes: npt.NDArray[np.int64]
    points: npt.NDArray[np.float64]
    edges: npt.NDArray[np.int32]

    def __post_init__(self) -> None:
        """Check the surface and keep a copy of the points that nobody can move."""
        points = np.array(self.points, dtype=np.float64)
        points.setflags(write=False)
        object.__setattr__(self, "points", points)
        n = len(self.nodes)
        if self.input_nodes.shape != (n,) or points.shape != (n, 2):
            raise ValueError(
                f"Surface '{self.name}': {n} nodes need input nodes of shape ({n},) and points of "
                f"shape ({n}, 2), got {self.input_nodes.shape} and {points.shape}."
            )
        if not np.isfinite(points).all():
            raise ValueError(f"Surface '{self.name}' has coordinates that are not finite.")
        for end in range(2):
            count = np.bincount(self.edges[:, end], minlength=n)
            if count.max(initial=0) > 1:
                raise ValueError(
                    f"Surface '{self.name}' branches at {self._where(int(count.argmax()))}: a node "
                    "may end one edge and begin one edge."
                )
        if not self.lengths.all():
            raise ValueError(
                f"Surface '{self.name}' has an edge without length at "
                f"{self._where(self.edges[int(self.lengths.argmin()), 0])}."
            )

    def _where(self, node: int) -> str:
        x, y = self.points[node]
        return f"({x:.6g}, {y:.6g})"

    def at(self, points: npt.NDArray[np.float64]) -> Surface:
        """Return the same surface with its nodes at ``points`` [m]; shape (n, 2)."""
        return replace(self, points=points)

    @cached_property
    def tangents(self) -> npt.NDArray[np.float64]:
        """Unit vectors along the edges; shape (m, 2)."""
        first, second = self.points[self.edges.T]
        return (second - first) / self.lengths[:, None]

    @cached_property
    def lengths(self) -> npt.NDArray[np.float64]:
        """Lengths of the edges [m]; shape (m,)."""
        first, second = self.points[self.edges.T]
        return np.hypot(*(second - first).T)

    @cached_property
    def normals(self) -> npt.NDArray[np.float64]:
        """Inward unit normals of the nodes, the mean of the adjacent edges' normals; shape (n, 2).

        On a secondary surface they point from primary to secondary (after Eq. 62). The end of a
        chain has the normal of its one edge.

        Raises:
            ValueError: If the surface is folded onto itself at a node.
        """
        tx, ty = self.tangents.T
        total = np.zeros_like(self.points)
        for end in range(2):
            np.add.at(total, self.edges[:, end], np.column_stack([-ty, tx]))
        size = np.hypot(*total.T)
        if size.min(initial=np.inf) < FOLD:
            raise ValueError(
                f"Surface '{self.name}' is folded onto itself at {self._where(int(size.argmin()))}."
            )
        return total / size[:, None]

    @cached_property
    def rotations(self) -> npt.NDArray[np.float64]:
        """Rows n_i and tau_i of R_i (Eq. 62), tau_i along the chain; shape (n, 2, 2)."""
        nx, ny = self.normals.T
        return np.stack([self.normals, np.column_stack([ny, -nx])], axis=1)

    @cached_property
    def chains(self) -> list[npt.NDArray[np.int32]]:
        """Nodes of every connected part in order along it, each (k,); a closed one repeats none."""
        following = np.full(len(self.nodes), -1, dtype=np.int32)
        following[self.edges[:, 0]] = self.edges[:, 1]
        begins = np.setdiff1d(self.edges[:, 0], self.edges[:, 1])
        todo = np.ones(len(self.nodes), dtype=bool)
        chains = []
        for begin in [*begins, *range(len(self.nodes))]:
            chain, node = [], begin
            while node >= 0 and todo[node]:
                todo[node] = False
                chain.append(node)
                node = following[node]
            if chain:
                chains.append(np.array(chain, dtype=np.int32))
        return chains


def gather_surface(mesh: Mesh, facet_tags: MeshTags, tag: int, name: str) -> Surface:
    """Gather the facets of a tag as a surface on all ranks. Collective.

    The order of nodes and edges follows the input of the mesh, so it does not depend on the number
    of ranks.

    Args:
        mesh: Mesh of straight cells in the plane, with or without ghost cells.
        facet_tags: Tags of its facets.
        tag: Value that marks the surface.
        name: Name of the surface in the scene.

    Raises:
        ValueError: On all ranks, if mesh or tags do not fit, no facet has the tag, a facet has
            cells on both sides, or the surface branches.
    """
    topology, geometry = mesh.topology, mesh.geometry
    if (topology.dim, geometry.dim, geometry.cmaps[0].degree) != (2, 2, 1):
        raise ValueError(f"Surface '{name}' needs a mesh of straight cells in the plane.")
    if facet_tags.dim != 1 or facet_tags.topology is not topology._cpp_object:
        raise ValueError(f"Surface '{name}': the tags are not on the facets of this mesh.")
    for dims in [(1, 2), (1, 0), (0, 2)]:
        topology.create_connectivity(*dims)

    facets = facet_tags.find(tag)
    facets = facets[facets < topology.index_map(1).size_local]
    to_cell = topology.connectivity(1, 2)
    cells = to_cell.array[to_cell.offsets[facets]]
    vertices = topology.connectivity(1, 0).array.reshape(-1, 2)[facets]
    at = entities_to_geometry(mesh, 0, vertices.ravel()).reshape(-1, 2)
    x = geometry.x[:, :2]

    first, second = x[at[:, 0]], x[at[:, 1]]
    centre = x[cell_nodes(mesh)[cells]].mean(axis=1)
    flip = cross(second - first, centre - first) < 0
    at[flip], vertices[flip] = at[flip, ::-1], vertices[flip, ::-1]

    interior = ~np.isin(facets, exterior_facet_indices(topology))
    own = (
        topology.index_map(0).local_to_global(vertices.ravel()).reshape(-1, 2),
        geometry.input_global_indices[at],
        x[at],
        (first + second)[interior] / 2,
    )
    nodes, inputs, points, inside = (
        np.concatenate(parts) for parts in zip(*mesh.comm.allgather(own), strict=True)
    )
    if len(nodes) == 0:
        raise ValueError(f"Surface '{name}': no facet of the mesh has tag {tag}.")
    if len(inside):
        x0, y0 = min(inside.tolist())
        raise ValueError(
            f"Surface '{name}': {len(inside)} of its {len(nodes)} facets have cells on both sides, "
            f"one at ({x0:.6g}, {y0:.6g}); a contact surface is boundary of its body."
        )
    unique, where, positions = np.unique(inputs, return_index=True, return_inverse=True)
    edges = positions.reshape(-1, 2).astype(np.int32)
    edges = edges[np.argsort(edges[:, 0], kind="stable")]
    return Surface(name, nodes.ravel()[where], unique, points.reshape(-1, 2)[where], edges)


def surface_dofs(surface: Surface, V: FunctionSpace) -> npt.NDArray[np.int64]:
    """Global block dofs of the nodes of a surface in a continuous P1 space. Collective.

    Args:
        surface: Surface of a mesh, where it was gathered.
        V: Lagrange space of degree 1 on that mesh or on a submesh of it, scalar or blocked; not a
            component of another space.

    Returns:
        Dof of every node, the same on all ranks, -1 where the submesh has no such node; shape (n,).

    Raises:
        ValueError: On all ranks, if the space is of another kind or on another mesh.
    """
    mesh, layout = V.mesh, V.dofmap.dof_layout
    corners = cell_nodes(mesh)
    number = corners.shape[1]
    at_corners = [layout.entity_dofs(0, i) for i in range(number)] == [[i] for i in range(number)]
    if V.component() or layout.num_dofs != number or not at_corners:
        raise ValueError(f"Surface '{surface.name}' needs a whole, continuous P1 space.")

    # A submesh keeps the numbers that its nodes have in the input of the whole mesh.
    inputs = mesh.geometry.input_global_indices
    at = np.searchsorted(surface.input_nodes, inputs).clip(max=len(surface.nodes) - 1)
    here = np.flatnonzero(surface.input_nodes[at] == inputs)
    at = at[here]
    dof_of_node = np.empty(len(inputs), dtype=np.int32)
    dof_of_node[corners] = V.dofmap.list
    dofs = np.full(len(surface.nodes), -1, dtype=np.int64)
    dofs[at] = V.dofmap.index_map.local_to_global(dof_of_node[here])
    mesh.comm.Allreduce(MPI.IN_PLACE, dofs, MPI.MAX)
    apart = np.abs(mesh.geometry.x[here, :2] - surface.points[at]).max(initial=0.0)
    if mesh.comm.allreduce(float(apart), MPI.MAX) > SAME_PLACE * surface.lengths.min():
        raise ValueError(f"Surface '{surface.name}' is not of the mesh of this function space.")
    return dofs
