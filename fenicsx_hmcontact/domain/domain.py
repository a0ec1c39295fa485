# SPDX-License-Identifier: LGPL-3.0-or-later
"""The distributed mesh with its named bodies and surfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mpi4py import MPI

import basix.ufl
import numpy as np
import numpy.typing as npt
from dolfinx.graph import adjacencylist
from dolfinx.io import distribute_entity_data
from dolfinx.mesh import (
    EntityMap,
    Mesh,
    MeshTags,
    create_mesh,
    create_submesh,
    entities_to_geometry,
    meshtags_from_entities,
    transfer_meshtags_to_submesh,
)

from fenicsx_hmcontact import _compat
from fenicsx_hmcontact.domain.gmsh_model import extract, gmsh_session
from fenicsx_hmcontact.domain.mesh_arrays import MeshArrays, body_of_group, check
from fenicsx_hmcontact.domain.partition import vertex_ghost_partitioner


@dataclass(frozen=True, eq=False)
class Domain:
    """A mesh of triangles whose bodies and surfaces have names.

    A body group is a 2-D physical group of gmsh, a surface group a 1-D one on the boundary of one
    or several bodies. Bodies have no nodes in common. The cells run counterclockwise and every
    rank has all cells around every vertex it owns.

    Attributes:
        mesh: The distributed mesh, coordinates in m.
        cell_tags: Body group of every cell.
        facet_tags: Surface group of the facets that are in one.
        bodies: Names and tags of the body groups.
        surfaces: Names and tags of the surface groups.
        name: File or model that the mesh comes from, for messages.
        layers: Bodies that consist of several groups, with the names of these groups.
    """

    mesh: Mesh
    cell_tags: MeshTags
    facet_tags: MeshTags
    bodies: dict[str, int]
    surfaces: dict[str, int]
    name: str
    layers: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @classmethod
    def read(
        cls,
        path: str | Path,
        comm: MPI.Comm,
        *,
        layers: Mapping[str, Sequence[str]] | None = None,
    ) -> Domain:
        """Read a gmsh file. Collective.

        Args:
            path: Mesh file (.msh).
            comm: Communicator; rank 0 reads.
            layers: Bodies that consist of several groups, with the names of these groups, such as
                ``{"soil": ["clay", "sand"]}``. Layers of one body may share nodes.

        Raises:
            FileNotFoundError: On all ranks, if there is no such file.
            ImportError: On all ranks, if gmsh cannot be imported.
            ValueError: On all ranks, if the file is no gmsh mesh of separate bodies.
        """
        name = str(path)

        def load() -> MeshArrays:
            with open(name, "rb") as file:
                is_gmsh = file.read(11) == b"$MeshFormat"
            if not is_gmsh:
                raise ValueError(f"{name}: not a gmsh mesh file (it must begin with $MeshFormat).")
            with gmsh_session(name) as gmsh:
                try:
                    gmsh.merge(name)
                except Exception as raised:
                    raise ValueError(f"{name}: gmsh cannot read the file: {raised}.") from raised
                return extract(gmsh.model, name)

        return cls._distribute(load, comm, name, layers)

    @classmethod
    def from_gmsh(
        cls,
        model: Any,
        comm: MPI.Comm,
        *,
        name: str = "gmsh model",
        layers: Mapping[str, Sequence[str]] | None = None,
    ) -> Domain:
        """Take over a meshed gmsh model. Collective.

        Args:
            model: ``gmsh.model`` on rank 0, None elsewhere; its current model is read.
            comm: Communicator.
            name: Name of the model, for messages.
            layers: Bodies that consist of several groups, as in ``read``.

        Raises:
            ValueError: On all ranks, if the model is no mesh of separate bodies.
        """

        def load() -> MeshArrays:
            if model is None:
                raise ValueError(f"{name}: rank 0 must hand over gmsh.model, it has None.")
            return extract(model, name)

        return cls._distribute(load, comm, name, layers)

    @classmethod
    def generate(
        cls,
        draw: Callable[[Any], None],
        comm: MPI.Comm,
        *,
        name: str,
        layers: Mapping[str, Sequence[str]] | None = None,
    ) -> Domain:
        """Draw and mesh with gmsh in a session of its own. Collective.

        Args:
            draw: Called with the gmsh module on rank 0 only; draws, names groups and meshes.
            comm: Communicator.
            name: Name of the model, for messages.
            layers: Bodies that consist of several groups, as in ``read``.

        Raises:
            ImportError: On all ranks, if gmsh cannot be imported.
            ValueError: On all ranks, if the model is no mesh of separate bodies.
        """

        def load() -> MeshArrays:
            with gmsh_session(name) as gmsh:
                draw(gmsh)
                return extract(gmsh.model, name)

        return cls._distribute(load, comm, name, layers)

    @classmethod
    def from_arrays(
        cls,
        arrays: MeshArrays | None,
        comm: MPI.Comm,
        *,
        name: str,
        layers: Mapping[str, Sequence[str]] | None = None,
    ) -> Domain:
        """Build from arrays, for instance after a remesh. Collective.

        Args:
            arrays: The whole mesh on rank 0, None elsewhere.
            comm: Communicator.
            name: File or model that the mesh comes from, for messages.
            layers: Bodies that consist of several groups, as in ``read``.

        Raises:
            ValueError: On all ranks, if the arrays are no mesh of separate bodies.
        """

        def load() -> MeshArrays:
            if arrays is None:
                raise ValueError(f"{name}: rank 0 must hand over the mesh, it has None.")
            return arrays

        return cls._distribute(load, comm, name, layers)

    @classmethod
    def _distribute(
        cls,
        load: Callable[[], MeshArrays],
        comm: MPI.Comm,
        name: str,
        layers: Mapping[str, Sequence[str]] | None,
    ) -> Domain:
        declared = {body: tuple(groups) for body, groups in (layers or {}).items()}
        arrays = MeshArrays.empty()
        error: Exception | None = None
        if comm.rank == 0:
            # All ranks must hear of the error, or those that wait for the mesh hang.
            try:
                arrays = load()
                check(arrays, name, declared)
                arrays = arrays.normalised()
            except (ImportError, OSError, ValueError) as raised:
                error = raised
            except Exception as raised:
                error = RuntimeError(f"{name}: the mesh cannot be made: {raised!r}.")
                error.__cause__ = raised
        error, bodies, surfaces = comm.bcast((error, arrays.bodies, arrays.surfaces))
        if error is not None:
            raise error

        element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
        points = arrays.points[:, :2].copy()
        mesh = create_mesh(comm, arrays.cells, element, points, vertex_ghost_partitioner())
        mesh.topology.create_connectivity(1, 2)
        cell_tags = _tags(mesh, 2, arrays.cells, arrays.cell_groups, "bodies")
        facet_tags = _tags(mesh, 1, arrays.facets, arrays.facet_groups, "surfaces")
        return cls(mesh, cell_tags, facet_tags, bodies, surfaces, name, declared)

    def arrays(self) -> MeshArrays:
        """The whole mesh where it is now, in the order of its input. Collective.

        Returns:
            The arrays on rank 0; empty ones on the other ranks.
        """
        mesh, comm = self.mesh, self.mesh.comm
        nodes, cells = self._owned(0), self._owned(2)
        index, x = mesh.geometry.input_global_indices, mesh.geometry.x
        order, corners = _compat.input_cell_index(mesh)[cells], _compat.cell_nodes(mesh)[cells]
        # Every owned cell is in one group.
        groups = self.cell_tags.values[np.searchsorted(self.cell_tags.indices, cells)]
        facets = self.facet_tags.indices
        here = facets < mesh.topology.index_map(1).size_local
        ends = entities_to_geometry(mesh, 1, facets[here]).reshape(-1, 2)
        mine = (index[nodes], x[nodes], order, index[corners], groups)
        parts = comm.gather((*mine, index[ends], self.facet_tags.values[here]))
        if parts is None:
            return MeshArrays.empty()
        ids, points, order, cells, groups, facets, tags = map(
            np.concatenate, zip(*parts, strict=True)
        )
        by_node, by_cell = np.argsort(ids), np.argsort(order)
        facets = np.sort(facets, axis=1)
        by_facet = np.lexsort(facets.T[::-1])
        return MeshArrays(
            points[by_node],
            cells[by_cell].astype(np.int64),
            groups[by_cell],
            facets[by_facet],
            tags[by_facet],
            self.bodies,
            self.surfaces,
        )

    def points(self) -> npt.NDArray[np.float64]:
        """Where the nodes are now [m], in the order of the input. Collective.

        Returns:
            On rank 0, shape (n_points, 3); empty on the other ranks.
        """
        geometry, nodes = self.mesh.geometry, self._owned(0)
        mine = geometry.input_global_indices[nodes], geometry.x[nodes]
        parts = self.mesh.comm.gather(mine)
        if parts is None:
            return np.empty((0, 3))
        ids, x = map(np.concatenate, zip(*parts, strict=True))
        return x[np.argsort(ids)]

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies; a body of several layers appears once, under its own name."""
        return list(dict.fromkeys(self._body_of_group().values()))

    def body(self, name: str) -> int:
        """Tag of a body group.

        Raises:
            ValueError: If there is no such group, or the body consists of several.
        """
        if name in self.layers:
            raise ValueError(
                f"{self.name}: body '{name}' has no tag of its own, its layers have: "
                f"{', '.join(self.layers[name])}."
            )
        return self._known(self.bodies, name, "body")

    def surface(self, name: str) -> int:
        """Tag of a surface group.

        Raises:
            ValueError: If there is no such group.
        """
        return self._known(self.surfaces, name, "surface")

    def tags(self, name: str) -> list[int]:
        """Tags of the groups that a body consists of.

        Args:
            name: A body group, or a body of several layers.

        Raises:
            ValueError: If there is no such body.
        """
        return [self.body(group) for group in self.layers.get(name, (name,))]

    def cells(self, name: str) -> npt.NDArray[np.int32]:
        """Owned cells of a body group, or of all layers of a body; local indices, ascending.

        Raises:
            ValueError: If there is no such body.
        """
        return _owned(self.mesh, self.cell_tags, self.tags(name))

    def facets(self, name: str) -> npt.NDArray[np.int32]:
        """Owned facets of a surface group; local indices, ascending.

        Raises:
            ValueError: If there is no such group.
        """
        return _owned(self.mesh, self.facet_tags, [self.surface(name)])

    def bodies_of_surface(self, name: str) -> list[str]:
        """Names of the bodies that a surface lies on. Collective.

        Raises:
            ValueError: If there is no such surface.
        """
        cell_of_facet = self.mesh.topology.connectivity(1, 2)
        cells = cell_of_facet.array[cell_of_facet.offsets[self.facets(name)]]
        tags = self.cell_tags.values[np.searchsorted(self.cell_tags.indices, cells)]
        found = set().union(*self.mesh.comm.allgather(set(tags.tolist())))
        return [body for body in self.body_names if found.intersection(self.tags(body))]

    def body_of_surface(self, name: str) -> str:
        """Name of the body that a surface lies on. Collective.

        Raises:
            ValueError: On all ranks, if there is no such surface or it lies on several bodies.
        """
        names = self.bodies_of_surface(name)
        if len(names) != 1:
            listed = " and ".join(f"'{body}'" for body in names)
            raise ValueError(
                f"{self.name}: surface '{name}' lies on the bodies {listed}; "
                "give each its own surface group."
            )
        return names[0]

    def submesh(self, *names: str) -> tuple[Domain, EntityMap]:
        """Take some bodies out, for fields that live in these alone. Collective.

        The part has coordinates of its own, which do not follow where those of the whole are moved.

        Args:
            names: Names of bodies, such as the porous ones.

        Returns:
            Domain of these bodies, with the surfaces on them, and the map of its cells to those of
            the whole, for `entity_maps` of a problem.

        Raises:
            ValueError: If there is no such body, or no name is given.
        """
        if not names:
            raise ValueError(f"{self.name}: submesh() needs the name of a body.")
        groups = [group for name in names for group in self.layers.get(name, (name,))]
        bodies = {group: self.body(group) for group in groups}
        layers = {name: self.layers[name] for name in names if name in self.layers}
        # Ghost cells too: each rank keeps the whole patches of its nodes.
        cells = self.cell_tags.indices[np.isin(self.cell_tags.values, list(bodies.values()))]
        mesh, entity_map, vertex_map, _ = create_submesh(self.mesh, 2, cells)
        for dims in [(1, 0), (2, 1), (1, 2)]:
            mesh.topology.create_connectivity(*dims)
        cell_tags, facet_tags = (
            transfer_meshtags_to_submesh(tags, mesh, vertex_map, entity_map)
            for tags in (self.cell_tags, self.facet_tags)
        )
        present = set().union(*mesh.comm.allgather(set(facet_tags.values.tolist())))
        surfaces = {name: tag for name, tag in self.surfaces.items() if tag in present}
        part = Domain(mesh, cell_tags, facet_tags, bodies, surfaces, self.name, layers)
        return part, entity_map

    def _owned(self, dim: int) -> npt.NDArray[np.int32]:
        """Owned nodes of the geometry, or owned cells."""
        mesh = self.mesh
        owned = mesh.geometry.index_map() if dim == 0 else mesh.topology.index_map(dim)
        return np.arange(owned.size_local, dtype=np.int32)

    def _body_of_group(self) -> dict[str, str]:
        return body_of_group(self.bodies, self.layers, self.name)

    def _known(self, groups: Mapping[str, int], name: str, kind: str) -> int:
        if name not in groups:
            raise ValueError(
                f"{self.name}: unknown {kind} '{name}'; known: {', '.join(groups) or 'none'}."
            )
        return groups[name]


def _tags(
    mesh: Mesh,
    dim: int,
    entities: npt.NDArray[np.int64],
    groups: npt.NDArray[np.int32],
    name: str,
) -> MeshTags:
    local, values = distribute_entity_data(mesh, dim, entities, groups)
    tags = meshtags_from_entities(mesh, dim, adjacencylist(local), values.astype(np.int32))
    tags.name = name
    return tags


def _owned(mesh: Mesh, tags: MeshTags, values: Iterable[int]) -> npt.NDArray[np.int32]:
    tagged = tags.indices[np.isin(tags.values, list(values))]
    return tagged[tagged < mesh.topology.index_map(tags.dim).size_local]
