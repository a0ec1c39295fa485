# SPDX-License-Identifier: LGPL-3.0-or-later
"""What stands between the package and DOLFINx's releases."""

from petsc4py import PETSc

import basix.ufl
import dolfinx
import numpy as np
import pytest
import scipy.sparse
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.mesh import create_unit_square, locate_entities_boundary, meshtags

from fenicsx_hmcontact import _compat

pytestmark = pytest.mark.mpi


# --- releases ------------------------------------------------------------------------------------


def test_supported_releases(monkeypatch):
    for release in ("0.11.0", "0.11.0.post0", "0.11.3"):
        monkeypatch.setattr(dolfinx, "__version__", release)
        _compat.check_dolfinx()


def test_other_releases_are_refused_with_the_one_found(monkeypatch):
    for release in ("0.10.0", "0.9.0.post1", "0.12.0", "1.0.0"):
        monkeypatch.setattr(dolfinx, "__version__", release)
        with pytest.raises(ImportError, match=f"needs DOLFINx 0.11, found {release}"):
            _compat.check_dolfinx()


def test_other_scalars_are_refused(monkeypatch):
    for scalar in (np.complex128, np.float32):
        monkeypatch.setattr(dolfinx, "default_scalar_type", scalar)
        with pytest.raises(ImportError, match="real float64 PETSc"):
            _compat.check_dolfinx()


# --- forms ---------------------------------------------------------------------------------------


def forms_of(mesh):
    """Rectangular coupling with data, cell and facet terms: (form, what it depends on)."""
    V, Q = fem.functionspace(mesh, ("P", 1, (2,))), fem.functionspace(mesh, ("P", 1))
    f, c = fem.Function(Q), fem.Constant(mesh, 2.0)
    f.interpolate(lambda x: 1.0 + x[0] * x[1])
    edge = np.sort(locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[0], 1.0)))
    tags = meshtags(mesh, 1, edge, np.full(edge.size, 5, np.int32))
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    p, v = ufl.TrialFunction(Q), ufl.TestFunction(V)
    n = ufl.FacetNormal(mesh)
    form = f * p * ufl.div(v) * ufl.dx + c * p * ufl.dot(n, v) * ds(5)
    return form, {"spaces": [V, Q], "function": f, "constant": c, "tags": tags}


def norm(form):
    matrix = assemble_matrix(form)
    matrix.assemble()
    return matrix.norm(PETSc.NormType.FROBENIUS)


def test_no_forms_compile_to_nothing(comm):
    assert _compat.compile_forms(comm, []) == []


def test_forms_of_one_module_are_kept_apart(comm):
    """Also two that are alike."""
    mesh = create_unit_square(comm, 3, 2)
    q = ufl.TestFunction(fem.functionspace(mesh, ("P", 1)))
    x = ufl.SpatialCoordinate(mesh)
    sources = [q * ufl.dx, x[0] * q * ufl.dx, q * ufl.dx]
    sums = []
    for compiled in _compat.compile_forms(comm, sources):
        b = fem.assemble_vector(_compat.bind_form(compiled, mesh))
        b.scatter_reverse(dolfinx.la.InsertMode.add)
        owned = b.index_map.size_local
        sums.append(comm.allreduce(b.array[:owned].sum()))
    assert np.allclose(sums, [1.0, 0.5, 1.0], rtol=1e-13)


def test_kernel_addresses_are_in_the_order_of_ids(comm):
    mesh = ufl.Mesh(basix.ufl.element("P", "triangle", 1, shape=(2,)))
    q = ufl.TestFunction(ufl.FunctionSpace(mesh, basix.ufl.element("P", "triangle", 1)))
    dx, ds = ufl.Measure("dx", mesh), ufl.Measure("ds", mesh)
    (compiled,) = _compat.compile_forms(comm, [3 * q * dx(7) + q * dx(2) + q * ds])
    addresses = _compat.kernel_addresses(compiled)
    ids = [compiled.ufcx_form.form_integral_ids[i] for i in range(2)]
    assert ids == [2, 7]
    assert len(set(addresses)) == 2 and all(address > 0 for address in addresses)


def test_bound_form_is_that_of_dolfinx(comm):
    mesh = create_unit_square(comm, 4, 3)
    form, _ = forms_of(mesh)
    (compiled,) = _compat.compile_forms(comm, [form])
    expected = norm(fem.form(form))
    assert expected > 0.1
    assert norm(_compat.bind_form(compiled, mesh)) == pytest.approx(expected, rel=1e-14)


def test_form_is_bound_to_another_mesh_without_compiling(comm, monkeypatch):
    old_form, old = forms_of(create_unit_square(comm, 2, 2))
    (compiled,) = _compat.compile_forms(comm, [old_form])
    mesh = create_unit_square(comm, 5, 4)
    new_form, new = forms_of(mesh)
    new["constant"].value = -3.0
    expected = norm(fem.form(new_form))
    pairs = [(old[k], new[k]) for k in ("function", "constant", "tags")]
    pairs += zip(old["spaces"], new["spaces"], strict=True)
    known = {id(a): b for a, b in pairs}
    monkeypatch.setattr(_compat, "_compile", None)
    bound = _compat.bind_form(compiled, mesh, lambda a: known.get(id(a), a))
    assert norm(bound) == pytest.approx(expected, rel=1e-14)


# --- meshes and matrices -------------------------------------------------------------------------


def test_cell_nodes_are_the_corners_of_each_cell(comm):
    mesh = create_unit_square(comm, 4, 3)
    nodes = _compat.cell_nodes(mesh)
    cells = mesh.topology.index_map(2)
    assert nodes.shape == (cells.size_local + cells.num_ghosts, 3)
    a, b, c = np.moveaxis(mesh.geometry.x[nodes][..., :2], 1, 0)
    edge, other = b - a, c - a
    areas = 0.5 * abs(edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0])
    assert comm.allreduce(areas[: cells.size_local].sum()) == pytest.approx(1.0, rel=1e-14)


def test_adjacency_list():
    rows = _compat.adjacency_list(np.array([4, 1, 2], np.int32), np.array([0, 1, 3], np.int32))
    assert rows.num_nodes == 2
    assert list(rows.links(0)) == [4] and list(rows.links(1)) == [1, 2]


def test_block_pairs_are_the_nodes_of_a_triangle(comm):
    mesh = create_unit_square(comm, 4, 3)
    form, data = forms_of(mesh)
    rows, columns = _compat.block_pairs(fem.form(form))
    V, Q = data["spaces"]
    n_rows = V.dofmap.index_map.size_local
    n_columns = Q.dofmap.index_map.size_local + Q.dofmap.index_map.num_ghosts
    seen = (rows < n_rows) & (columns < n_columns)
    owned = mesh.topology.index_map(2).size_local
    expected = {
        (i, j)
        for test, trial in zip(V.dofmap.list[:owned], Q.dofmap.list[:owned], strict=True)
        for i in test
        for j in trial
        if i < n_rows
    }
    found = set(zip(rows[seen], columns[seen], strict=True))
    assert expected <= found
    if comm.size == 1:
        assert expected == found and len(found) == rows.size


def local_pattern(form):
    """CSR pattern of scalar unknowns over owned and ghost block dofs."""
    V, Q = form.function_spaces
    a, b = V.dofmap.index_map_bs, Q.dofmap.index_map_bs
    shape = [m.size_local + m.num_ghosts for m in (V.dofmap.index_map, Q.dofmap.index_map)]
    cells = [space.dofmap.map() for space in (V, Q)]
    rows = np.repeat(cells[0], 3, axis=1).ravel()
    columns = np.tile(cells[1], (1, 3)).ravel()
    blocks = scipy.sparse.csr_array((np.ones(rows.size), (rows, columns)), shape)
    pattern = scipy.sparse.kron(blocks, np.ones((a, b))).tocsr()
    pattern.sort_indices()
    return pattern.indptr.astype(np.int32), pattern.indices.astype(np.int32), pattern.shape


def test_local_matrix_takes_values_of_this_rank(comm):
    """Rectangular blocks with cell and facet terms, added into an array that stays the caller's."""
    mesh = create_unit_square(comm, 4, 3)
    source, _ = forms_of(mesh)
    form = fem.form(source)
    indptr, indices, shape = local_pattern(form)
    values = np.zeros(indices.size)
    matrix = _compat.LocalPetscMatrix(indptr, indices, values, shape[1])
    matrix.add(form)
    ours = scipy.sparse.csr_array((values, indices, indptr), shape)
    # Contributions of all ranks to K x, against DOLFINx's distributed matrix.
    x = fem.Function(source.arguments()[1].ufl_function_space())
    x.interpolate(lambda x: np.sin(3.0 * x[0]) + x[1])
    y = fem.Function(source.arguments()[0].ufl_function_space())
    y.x.array[:] = ours @ x.x.array
    y.x.scatter_reverse(dolfinx.la.InsertMode.add)
    expected = assemble_matrix(form)
    expected.assemble()
    result = expected.createVecLeft()
    expected.mult(x.x.petsc_vec, result)
    owned = y.x.index_map.size_local * y.x.block_size
    assert np.allclose(y.x.array[:owned], result.array, rtol=0, atol=1e-14)
    # A second call adds on top.
    first = values.copy()
    matrix.add(form)
    assert np.allclose(values, 2.0 * first, rtol=1e-14) and abs(first).max() > 0.0
