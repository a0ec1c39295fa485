# SPDX-License-Identifier: LGPL-3.0-or-later
"""The one place that knows how DOLFINx releases differ and that touches ``dolfinx.cpp``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import dolfinx
import ffcx
import ffcx.codegeneration.jit
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, graph, jit
from dolfinx.fem.forms import CompiledForm, get_integration_domains
from dolfinx.mesh import Mesh

SUPPORTED = ((0, 11), (0, 12))
"""Supported DOLFINx releases: from the first (included) to the second (excluded)."""


def check_dolfinx() -> None:
    """Check release and scalar type of the installed DOLFINx.

    Raises:
        ImportError: If the release is not supported or PETSc is complex or single precision.
    """
    release = tuple(int(part) for part in dolfinx.__version__.split(".")[:2])
    if not SUPPORTED[0] <= release < SUPPORTED[1]:
        raise ImportError(
            f"fenicsx_hmcontact needs DOLFINx 0.11, found {dolfinx.__version__}. Install it with "
            "pip install 'fenicsx_hmcontact[wheel]', or from Debian, conda-forge or Docker."
        )
    if np.dtype(dolfinx.default_scalar_type) != np.float64:
        raise ImportError("fenicsx_hmcontact needs DOLFINx built with real float64 PETSc.")


def adjacency_list(data: npt.NDArray[np.int32], offsets: npt.NDArray[np.int32]) -> Any:
    """Wrap destination ranks as the object that a partitioner callback returns.

    Args:
        data: Destination ranks of all cells, one after the other.
        offsets: Where each cell's ranks begin in ``data``; shape (num_cells + 1,).
    """
    return graph.adjacencylist(data, offsets)._cpp_object


@jit.mpi_jit_decorator
def _compile(forms: list[ufl.Form]) -> tuple[list[Any], Any, Any]:
    options = ffcx.get_options({"scalar_type": np.float64})
    jit_options = jit.get_options()
    # One module holds all forms, so its compiler run may take longer than DOLFINx's default wait.
    jit_options["timeout"] = max(int(jit_options["timeout"]), 60)
    return ffcx.codegeneration.jit.compile_forms(forms, options=options, **jit_options)


def compile_forms(comm: Any, forms: Sequence[ufl.Form]) -> list[CompiledForm]:
    """Compile several UFL forms into one module, with one run of the C compiler. Collective.

    Args:
        comm: Communicator; rank 0 compiles, the others load.
        forms: Forms without data, or with the data of any mesh.
    """
    if not forms:
        return []
    compiled, module, code = _compile(comm, list(forms))
    return [
        CompiledForm(form, ufcx_form, module, code, np.float64)
        for form, ufcx_form in zip(forms, compiled, strict=True)
    ]


def kernel_addresses(compiled: CompiledForm) -> list[int]:
    """Addresses of the tabulate_tensor functions of a form's cell integrals, in order of ids."""
    form, ffi = compiled.ufcx_form, compiled.module.ffi
    count = form.form_integral_offsets[1]
    return [
        int(ffi.cast("uintptr_t", form.form_integrals[i].tabulate_tensor_float64))
        for i in range(count)
    ]


def cell_nodes(mesh: Mesh) -> npt.NDArray[np.int32]:
    """Geometry nodes of every local cell, ghosts included; shape (num_cells, 3) for triangles."""
    return mesh.geometry.dofmaps[0]


def cells_of_part(
    mesh: Mesh, part: Mesh, entity_maps: Sequence[Any] | None
) -> npt.NDArray[np.int32]:
    """Cell of a submesh, or of the mesh itself, that each local cell of a mesh is.

    Args:
        mesh: The mesh.
        part: The mesh itself or a submesh of cells of it.
        entity_maps: Maps to submeshes, as `dolfinx.mesh.create_submesh` returns them.

    Returns:
        Local cells, -1 where the submesh has none; shape (n_cells,), ghosts included.

    Raises:
        ValueError: If none of the maps leads from the submesh to the mesh.
    """
    index_map = mesh.topology.index_map(mesh.topology.dim)
    cells = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
    whole, sub = mesh.topology._cpp_object, part.topology._cpp_object
    if sub is whole:
        return cells
    for m in entity_maps or ():
        if m.sub_topology._cpp_object is sub and m.topology._cpp_object is whole:
            if m.dim == mesh.topology.dim:
                return m.sub_topology_to_topology(cells, inverse=True)
    raise ValueError("a field lives on another mesh, and no entity map says what part it is")


def input_cell_index(mesh: Mesh) -> npt.NDArray[np.int64]:
    """Numbers of the local triangles that are the same on any number of ranks.

    They are those of the input of the mesh. A submesh has none; there an edge names the triangle on
    its left: that from the first node in the input to the next one counterclockwise.
    """
    try:
        return mesh.topology.original_cell_index
    except RuntimeError:
        nodes = cell_nodes(mesh)
        a, b, c = np.moveaxis(mesh.geometry.x[nodes, :2], 1, 0)
        (p, q), (r, s) = (b - a).T, (c - a).T
        index = mesh.geometry.input_global_indices
        index = index[np.where((p * s - q * r < 0)[:, None], nodes[:, ::-1], nodes)]
        first = index.argmin(axis=1)
        row, n = np.arange(len(nodes)), int(index.max(initial=0)) + 1
        n = mesh.comm.allreduce(n, MPI.MAX)
        return index[row, first] * n + index[row, (first + 1) % 3]


_INTEGRALS = {
    "cell": fem.IntegralType.cell,
    "exterior_facet": fem.IntegralType.exterior_facet,
    "interior_facet": fem.IntegralType.interior_facet,
    "vertex": fem.IntegralType.vertex,
    "ridge": fem.IntegralType.ridge,
}


def bind_form(
    compiled: CompiledForm,
    mesh: Mesh,
    successor: Callable[[Any], Any] = lambda old: old,
    entity_maps: Sequence[Any] | None = None,
    names: Sequence[str] = (),
) -> fem.Form:
    """Give a compiled form its mesh, functions, constants and tags.

    Args:
        compiled: The compiled form.
        mesh: Mesh to integrate over.
        successor: What takes the place of a function, constant, space or tags of the form it was
            compiled from.
        entity_maps: Maps to other meshes that functions of the form live on.
        names: What to call the fields of its arguments.

    Raises:
        ValueError: If terms of one kind use several tags, or tags of another mesh, or are
            integrated where a test or trial function does not live.
    """
    form, ufcx = compiled.ufl_form, compiled.ufcx_form
    (data,) = form.subdomain_data().values()
    offsets = [ufcx.form_integral_offsets[i] for i in range(len(fem.IntegralType) + 1)]
    subdomains = {}
    for name, tags in data.items():
        kind = _INTEGRALS[name]
        ids = [
            ufcx.form_integral_ids[k] for k in range(offsets[kind.value], offsets[kind.value + 1])
        ]
        given = [tag for tag in tags if tag is not None]
        if any(tag is not given[0] for tag in given):
            raise ValueError(f"{name} terms use several tags; put their ids into one MeshTags")
        new = successor(given[0]) if given else None
        if hasattr(new, "topology"):
            check_tags(new, mesh)
        subdomains[kind] = get_integration_domains(kind, new, ids)
    spaces = [successor(argument.ufl_function_space()) for argument in form.arguments()]
    reach = {
        name: cells_of_part(mesh, space.mesh, entity_maps)
        for name, space in zip(names, spaces, strict=False)
        if space.mesh.topology.dim == mesh.topology.dim
    }
    bound = fem.create_form(
        compiled,
        spaces,
        mesh,
        subdomains,
        {f: successor(f) for f in form.coefficients()},
        {c: successor(c) for c in form.constants()},
        entity_maps,
    )
    for name, cells in reach.items():
        _check_reach(bound, mesh, name, cells)
    return bound


def _check_reach(form: fem.Form, mesh: Mesh, name: str, cells: npt.NDArray[np.int32]) -> None:
    """Refuse terms on cells or their facets that a field does not live on: DOLFINx would crash."""
    outside = 0
    for kind, width in ((fem.IntegralType.cell, 1), (fem.IntegralType.exterior_facet, 2)):
        for i in range(form._cpp_object.num_integrals(kind, 0)):
            integrated = form._cpp_object.domains(kind, i).reshape(-1, width)[:, 0]
            outside += int(np.sum(cells[integrated] < 0))
    outside = mesh.comm.allreduce(outside)
    if outside:
        raise ValueError(
            f"terms on dx or ds with the field {name} are integrated over {outside} cells or "
            "facets that it does not live on: restrict them to its bodies, dx(tags)"
        )


def check_tags(tags: Any, mesh: Mesh) -> None:
    """Refuse tags of another mesh.

    Raises:
        ValueError: If they are.
    """
    if tags._cpp_object.topology is not mesh.topology._cpp_object:
        raise ValueError("tags belong to another mesh than the terms they restrict")


def block_pairs(form: fem.Form) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Local block rows and columns that a bilinear form couples. Collective.

    Columns may go beyond those this rank sees: they come from other ranks' cells.
    """
    pattern = fem.create_sparsity_pattern(form)
    pattern.finalize()
    columns, offsets = pattern.graph
    rows = np.repeat(np.arange(offsets.size - 1, dtype=np.int32), np.diff(offsets))
    return rows, np.asarray(columns[: rows.size], np.int32)


class LocalPetscMatrix:
    """A matrix of this rank alone, over owned and ghost unknowns, whose values are a given array.

    DOLFINx's own matrix takes no rectangular blocks and owns its values.

    Args:
        indptr: CSR offsets.
        indices: CSR columns.
        values: CSR values, which `add` changes in place.
        n_columns: Number of columns.
    """

    def __init__(
        self,
        indptr: npt.NDArray[np.int32],
        indices: npt.NDArray[np.int32],
        values: npt.NDArray[np.float64],
        n_columns: int,
    ) -> None:
        n_rows = indptr.size - 1
        self._arrays = (indptr, indices, values)
        self._matrix = PETSc.Mat().createAIJWithArrays(
            (n_rows, n_columns), (indptr, indices, values), comm=PETSc.COMM_SELF
        )
        maps = [
            PETSc.LGMap().create(np.arange(n, dtype=np.int32), comm=PETSc.COMM_SELF)
            for n in (n_rows, n_columns)
        ]
        self._matrix.setLGMap(*maps)

    def add(self, form: fem.Form) -> None:
        """Add what this rank's cells and facets contribute to a bilinear form."""
        dolfinx.cpp.fem.petsc.assemble_matrix(
            self._matrix,
            form._cpp_object,
            fem.pack_constants(form),
            fem.pack_coefficients(form),
            [],
            True,
        )
        self._matrix.assemble()
