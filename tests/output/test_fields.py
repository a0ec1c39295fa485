# SPDX-License-Identifier: LGPL-3.0-or-later
import os
import subprocess
import sys
import xml.etree.ElementTree as ET

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem, has_adios2
from dolfinx.mesh import create_mesh, create_unit_square, locate_entities_boundary, meshtags

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact import gather_surface
from fenicsx_hmcontact.domain.partition import vertex_ghost_partitioner
from fenicsx_hmcontact.output.fields import (
    FieldWriter,
    InterfaceFields,
    arc_length,
    evaluate,
    gather_nodal,
    write_interface,
)


def blocks(columns, rows, bottom):
    """Nodes and triangles of a block of unit width and half unit height."""
    x, y = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(bottom, bottom + 0.5, rows + 1))
    lower = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    upper = lower + columns + 1
    cells = np.stack((lower, lower + 1, upper + 1, lower, upper + 1, upper), axis=1)
    return np.column_stack((x.ravel(), y.ravel())), cells.reshape(-1, 3)


@pytest.fixture
def two_blocks(comm):
    """Two blocks that touch at y = 0.5 and share no node, in a shuffled input order."""
    lower, lower_cells = blocks(3, 2, 0.0)
    upper, upper_cells = blocks(5, 3, 0.5)
    points = np.concatenate((lower, upper))
    cells = np.concatenate((lower_cells, upper_cells + len(lower)))
    random = np.random.default_rng(7)
    order = random.permutation(len(points))
    cells = random.permutation(np.argsort(order)[cells])
    points = points[order]
    mine = comm.rank == 0
    mesh = create_mesh(
        comm,
        cells if mine else np.empty((0, 3), dtype=np.int64),
        ufl.Mesh(basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))),
        points if mine else np.empty((0, 2)),
        partitioner=vertex_ghost_partitioner(),
    )
    return mesh, points, cells


def is_upper(mesh):
    """Local cells of the upper block."""
    middle = mesh.geometry.x[mesh.geometry.dofmaps[0]].mean(axis=1)
    return np.flatnonzero(middle[:, 1] > 0.5).astype(np.int32)


@pytest.mark.mpi
def test_gather_nodal_restores_the_input_mesh(two_blocks):
    mesh, points, cells = two_blocks
    u = fem.Function(fem.functionspace(mesh, ("P", 1, (2,))))
    u.interpolate(lambda x: (x[0] + 2 * x[1], x[0] * x[1]))
    gathered = gather_nodal(u)
    if mesh.comm.rank > 0:
        assert gathered is None
        return
    x, triangles, values = gathered
    np.testing.assert_array_equal(x, points)
    np.testing.assert_array_equal(np.sort(triangles, axis=1), np.sort(cells, axis=1))
    expected = np.column_stack((points[:, 0] + 2 * points[:, 1], points[:, 0] * points[:, 1]))
    np.testing.assert_allclose(values, expected, atol=1e-15)


@pytest.mark.mpi
def test_gather_nodal_leaves_out_nodes_of_no_triangle(comm):
    points = np.array([[9.0, 9.0], [0, 0], [1, 0], [8.0, 8.0], [0, 1], [1, 1]])
    mine = comm.rank == 0
    mesh = create_mesh(
        comm,
        np.array([[1, 2, 4], [2, 5, 4]] if mine else np.empty((0, 3)), dtype=np.int64),
        ufl.Mesh(basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))),
        points if mine else np.empty((0, 2)),
        partitioner=vertex_ghost_partitioner(),
    )
    p = fem.Function(fem.functionspace(mesh, ("P", 1)))
    p.interpolate(lambda x: x[0] + 3 * x[1])
    # With more ranks than triangles, some rank owns none.
    assert evaluate(p, [[0.25, 0.25], [0.75, 0.75]]) == pytest.approx(np.array([[1.0], [3.0]]))
    gathered = gather_nodal(p)
    if mine:
        x, triangles, values = gathered
        np.testing.assert_array_equal(x, points[[1, 2, 4, 5]])
        np.testing.assert_array_equal(np.sort(triangles), [[0, 1, 2], [1, 2, 3]])
        np.testing.assert_allclose(values[:, 0], [0, 1, 3, 4], atol=1e-15)


@pytest.mark.mpi
def test_gather_nodal_refuses_other_elements(two_blocks):
    mesh = two_blocks[0]
    for element in (("P", 2), ("DG", 0), ("DG", 1)):
        function = fem.Function(fem.functionspace(mesh, element), name="p")
        with pytest.raises(ValueError, match="'p' is not P1"):
            gather_nodal(function)


@pytest.mark.mpi
@pytest.mark.parametrize("element", [("P", 1), ("P", 2), ("DG", 1)])
def test_evaluate_linear_field(two_blocks, element):
    mesh = two_blocks[0]
    u = fem.Function(fem.functionspace(mesh, (*element, (2,))))
    u.interpolate(lambda x: (1 + x[0] - 3 * x[1], 2 * x[1]))
    # Corners, edges, nodes, the touching faces, and random points inside.
    fixed = [[0, 0], [1, 1], [0, 1], [1, 0], [1 / 3, 0.25], [0.5, 0.5], [0.2, 2 / 3], [1, 0.1]]
    points = np.concatenate((fixed, np.random.default_rng(1).random((50, 2))))
    values = evaluate(u, points)
    x, y = points.T
    np.testing.assert_allclose(values, np.column_stack((1 + x - 3 * y, 2 * y)), atol=1e-13)
    np.testing.assert_array_equal(values, mesh.comm.bcast(values))


@pytest.mark.mpi
def test_evaluate_shapes(two_blocks):
    mesh = two_blocks[0]
    stress = fem.Function(fem.functionspace(mesh, ("DG", 0, (2, 2))))
    stress.interpolate(lambda x: np.outer((1.0, 2, 3, 4), np.ones(x.shape[1])))
    np.testing.assert_array_equal(evaluate(stress, [[0.3, 0.3]]), [[1.0, 2, 3, 4]])
    assert evaluate(stress, np.empty((0, 2))).shape == (0, 4)


@pytest.mark.mpi
def test_evaluate_where_bodies_touch(two_blocks):
    mesh, points, cells = two_blocks
    upper = is_upper(mesh)
    p = fem.Function(fem.functionspace(mesh, ("P", 1)))
    p.x.array[:] = 1.0
    p.interpolate(lambda x: 2.0 + 0 * x[0], cells0=upper)
    face = np.column_stack((np.linspace(0, 1, 16), np.full(16, 0.5)))
    lower = np.setdiff1d(np.arange(len(mesh.geometry.dofmaps[0]), dtype=np.int32), upper)
    np.testing.assert_allclose(evaluate(p, face, cells=lower), 1.0, rtol=1e-14)
    np.testing.assert_allclose(evaluate(p, face, cells=upper), 2.0, rtol=1e-14)
    # Without a choice: the triangle that is first in the input, found here by brute force.
    corners = points[cells]
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    expected = []
    for point in face:
        inner = np.einsum("cij,cj->ci", inverse, point - corners[:, 0])
        inside = (inner.min(axis=1) > -1e-9) & (inner.sum(axis=1) < 1 + 1e-9)
        expected.append(2.0 if corners[np.argmax(inside), :, 1].max() > 0.6 else 1.0)
    assert set(expected) == {1.0, 2.0}
    np.testing.assert_allclose(evaluate(p, face)[:, 0], expected, rtol=1e-14)


@pytest.mark.mpi
@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_evaluate_in_any_unit_of_length(two_blocks, unit):
    mesh = two_blocks[0]
    mesh.geometry.x[:] *= unit
    p = fem.Function(fem.functionspace(mesh, ("DG", 0)))
    p.interpolate(lambda x: np.floor(5 * x[0] / unit))
    upper = np.array([[0.1, 0.9], [0.3, 0.9], [0.61, 0.9], [0.99, 0.99]])
    np.testing.assert_array_equal(evaluate(p, upper * unit)[:, 0], [0, 1, 3, 4])
    with pytest.raises(ValueError, match="outside the mesh"):
        evaluate(p, [[1.001 * unit, 0.5 * unit]])


@pytest.mark.mpi
def test_evaluate_names_a_point_outside(two_blocks):
    mesh = two_blocks[0]
    p = fem.Function(fem.functionspace(mesh, ("P", 1)))
    with pytest.raises(ValueError, match=r"point \(0.5, 1.25\) lies outside"):
        evaluate(p, [[0.5, 0.5], [0.5, 1.25], [3.0, 3.0]])
    with pytest.raises(ValueError, match=r"point \(0.5, 0.25\) lies outside"):
        evaluate(p, [[0.5, 0.25]], cells=is_upper(mesh))
    with pytest.raises(ValueError, match=r"not \(2,\)"):
        evaluate(p, [0.5, 0.5])


def fields(mesh):
    """P2 displacement, P1 pressure and cell-wise plastic strain, as functions of time."""
    u = fem.Function(fem.functionspace(mesh, ("P", 2, (2,))), name="u")
    p = fem.Function(fem.functionspace(mesh, ("P", 1)), name="p")
    e = fem.Function(fem.functionspace(mesh, ("DG", 0)), name="strain")

    def update(t):
        u.interpolate(lambda x: (t * x[0], x[1] ** 2))
        p.interpolate(lambda x: t + x[0] - x[1])
        e.interpolate(lambda x: t * np.floor(x[1] + 0.5))

    return [u, p, e], update


def without_ghosts(grid):
    return grid.extract_cells(grid.cell_data["vtkGhostType"] == 0)


def check_fields(points, at_points, centres, at_cells, t):
    """Compare what was read back with what was written."""
    x, y = points[:, 0], points[:, 1]
    zero = np.zeros_like(x)
    np.testing.assert_allclose(at_points["u"], np.column_stack((t * x, y**2, zero)), atol=1e-14)
    np.testing.assert_allclose(at_points["p"], t + x - y, atol=1e-14)
    np.testing.assert_array_equal(at_cells["strain"], t * np.floor(centres[:, 1] + 0.5))


@pytest.mark.mpi
def test_pvd_reads_back(two_blocks, shared_tmp_path):
    pyvista = pytest.importorskip("pyvista")
    mesh = two_blocks[0]
    functions, update = fields(mesh)
    path = shared_tmp_path / "new" / "run.pvd"
    with FieldWriter(path, mesh, functions) as writer:
        for t in (0.0, 2.5):
            update(t)
            writer.write(t)
    mesh.comm.Barrier()
    if mesh.comm.rank > 0:
        return
    reader = pyvista.get_reader(path)
    assert reader.time_values == [0.0, 2.5]
    for t in reader.time_values:
        reader.set_active_time_value(t)
        grid = without_ghosts(reader.read()[0])
        assert grid.n_cells == 42
        check_fields(grid.points, grid.point_data, grid.cell_centers().points, grid.cell_data, t)


READ_BP = """
import sys
import adios2
import numpy as np

with adios2.Stream(sys.argv[1], "r") as stream:
    steps = {}
    for _ in stream.steps():
        for name in ("step", "geometry", "connectivity", "u", "p", "strain"):
            blocks = stream.engine.blocks_info(name, stream.current_step())
            for i, _ in enumerate(blocks):
                variable = stream.inquire_variable(name)
                if name != "step":
                    variable.set_block_selection(i)
                steps[f"{stream.current_step()}/{i}/{name}"] = stream.read(variable)
np.savez(sys.argv[2], **steps)
"""


@pytest.mark.mpi
@pytest.mark.skipif(not has_adios2, reason="DOLFINx without ADIOS2")
def test_bp_reads_back(two_blocks, shared_tmp_path):
    pytest.importorskip("adios2")
    mesh = two_blocks[0]
    functions, update = fields(mesh)
    with FieldWriter(shared_tmp_path / "run", mesh, functions) as writer:
        assert writer.path.name == "run.bp"
        for t in (0.0, 2.5):
            update(t)
            writer.write(t)
    mesh.comm.Barrier()
    if mesh.comm.rank > 0:
        return
    # In a process of its own: two builds of the ADIOS2 library do not share one.
    read = shared_tmp_path / "read.npz"
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PMI", "MPI", "HYD"))}
    subprocess.run(
        [sys.executable, "-c", READ_BP, writer.path, read],
        check=True,
        timeout=60,
        env=environment,
    )
    with np.load(read) as stored:
        for step, t in enumerate((0.0, 2.5)):
            assert stored[f"{step}/0/step"].item() == t
            seen = set()
            for i in range(mesh.comm.size):
                block = {k: stored[f"{step}/{i}/{k}"] for k in ("geometry", "u", "p", "strain")}
                corners = stored[f"{step}/{i}/connectivity"][:, 1:]
                centres = block["geometry"][corners].mean(axis=1)
                # Every rank writes its ghosts too, the same values over again.
                seen |= {tuple(centre) for centre in np.round(centres, 9)}
                nodal = {"u": block["u"], "p": block["p"].ravel()}
                strain = {"strain": block["strain"].ravel()}
                check_fields(block["geometry"], nodal, centres, strain, t)
            assert len(seen) == 42


@pytest.mark.mpi
@pytest.mark.parametrize("suffix", [".pvd", ".bp"])
def test_writer_goes_on_after_a_remesh(comm, shared_tmp_path, suffix):
    if suffix == ".bp" and not has_adios2:
        pytest.skip("DOLFINx without ADIOS2")
    path = shared_tmp_path / f"run{suffix}"
    meshes = [create_unit_square(comm, n, n) for n in (2, 5)]
    functions = [fem.Function(fem.functionspace(m, ("P", 1)), name="p") for m in meshes]
    with FieldWriter(path, meshes[0], functions[:1]) as writer:
        writer.write(0.0)
        writer.remesh(meshes[1], functions[1:])
        meshes[1].geometry.x[:, 1] *= 0.75
        writer.write(1.0)
    with pytest.raises(RuntimeError, match="is closed"):
        writer.write(2.0)
    comm.Barrier()
    if suffix == ".bp":
        assert sorted(p.name for p in shared_tmp_path.iterdir()) == ["run-1.bp", "run.bp"]
        return
    pyvista = pytest.importorskip("pyvista")
    if comm.rank == 0:
        times = [s.get("timestep") for s in ET.parse(path).iter("DataSet")]
        assert times == ["0", "1"]
        reader = pyvista.get_reader(path)
        for t, cells, height in ((0.0, 8, 1.0), (1.0, 50, 0.75)):
            reader.set_active_time_value(t)
            grid = without_ghosts(reader.read()[0])
            assert grid.n_cells == cells
            assert grid.bounds[3] == pytest.approx(height)


@pytest.mark.mpi
def test_parts_of_a_mixed_function(comm, shared_tmp_path):
    pyvista = pytest.importorskip("pyvista")
    mesh = create_unit_square(comm, 3, 3)
    pair = basix.ufl.mixed_element(
        [
            basix.ufl.element("P", "triangle", 2, shape=(2,)),
            basix.ufl.element("P", "triangle", 1),
        ]
    )
    both = fem.Function(fem.functionspace(mesh, pair))
    u, p = both.sub(0), both.sub(1)
    u.name, p.name = "u", "p"
    u.interpolate(lambda x: (x[0], 2 * x[1]))
    p.interpolate(lambda x: x[0] - x[1])
    with FieldWriter(shared_tmp_path / "mixed.pvd", mesh, [u, p]) as writer:
        writer.write(0.0)
    np.testing.assert_allclose(evaluate(u, [[0.3, 0.4]]), [[0.3, 0.8]], atol=1e-14)
    np.testing.assert_allclose(evaluate(p, [[0.3, 0.4]]), [[-0.1]], atol=1e-14)
    gathered = gather_nodal(p)
    comm.Barrier()
    if comm.rank == 0:
        x, _, values = gathered
        np.testing.assert_allclose(values[:, 0], x @ (1, -1), atol=1e-14)
        grid = pyvista.read(shared_tmp_path / "mixed.pvd")[0]
        np.testing.assert_allclose(grid["u"][:, :2], grid.points[:, :2] * (1, 2), atol=1e-14)
        np.testing.assert_allclose(grid["p"], grid.points @ (1, -1, 0), atol=1e-14)


@pytest.mark.mpi
def test_writer_refuses_what_it_cannot_write(comm, shared_tmp_path):
    mesh, other = (create_unit_square(comm, 2, 2) for _ in range(2))
    p = fem.Function(fem.functionspace(mesh, ("P", 1)), name="p")
    q = fem.Function(fem.functionspace(mesh, ("P", 1)), name="p")
    far = fem.Function(fem.functionspace(other, ("P", 1)), name="far")
    jumping = fem.Function(fem.functionspace(mesh, ("DG", 1)), name="jumping")
    path = shared_tmp_path / "run.pvd"
    for functions, message in (
        ([], "no function to write"),
        ([p, q], "two functions are called 'p'"),
        ([p, far], "'far' is on another mesh"),
        ([jumping], "'jumping' has no nodal values"),
    ):
        with pytest.raises(ValueError, match=message):
            FieldWriter(path, mesh, functions)
    with pytest.raises(ValueError, match=r"not '\.vtu'"):
        FieldWriter(path.with_suffix(".vtu"), mesh, [p])
    if comm.rank == 0:
        (shared_tmp_path / "file").touch()
    with pytest.raises(OSError):
        FieldWriter(shared_tmp_path / "file" / "run.pvd", mesh, [p])


# --- contact ------------------------------------------------------------------------------------


def tagged(mesh, *sides):
    """Tags 1, 2, ... of boundary facets, by a mark of their nodes; upper and lower block apart."""
    mesh.topology.create_connectivity(1, 2)
    mesh.topology.create_connectivity(2, 1)
    to_cell = mesh.topology.connectivity(1, 2)
    upper = np.zeros(len(mesh.geometry.dofmaps[0]), bool)
    upper[is_upper(mesh)] = True
    facets, values = [np.zeros(0, np.int32)], []
    for i, (above, mark) in enumerate(sides):
        found = locate_entities_boundary(mesh, 1, mark)
        found = found[upper[to_cell.array[to_cell.offsets[found]]] == above]
        facets.append(found)
        values.append(np.full(len(found), i + 1, np.int32))
    facets, order = np.unique(np.concatenate(facets), return_index=True)
    return meshtags(mesh, 1, facets, np.concatenate(values)[order])


def interface(mesh):
    """Pair of the two blocks, the upper one secondary."""

    def between(x):
        return np.isclose(x[1], 0.5)

    return hm.ContactPair(tagged(mesh, (True, between), (False, between)), 1, 2)


def acting(mesh, pair):
    """A state whose values are functions of x; the node at x = 0.4 is unpaired."""
    points = gather_surface(mesh, pair.facet_tags, pair.secondary, "").points
    x, n = points[:, 0], len(points)
    unpaired = np.isclose(x, 0.4)
    hidden = np.where(unpaired, np.nan, 0.0)
    kinds = np.where(unpaired, -1, np.round(5 * x).astype(int) % 3).astype(np.int8)
    return hm.InterfaceState(
        points=points,
        normals=np.tile((0.6, 0.8), (n, 1)),
        pressure=1.0 + x / 3.0 + hidden,
        shear=-2.0 * x + hidden,
        pore_pressure=7.0 * x,
        jump=x**2,
        gap=1e-3 * x + hidden,
        slip=x / 7.0,
        state=kinds,
        length=np.full(n, 0.2),
        forces=np.column_stack((3.0 * x, 4.0 * x)),
        volume=0.0,
        primary_points=points,
        primary_forces=np.zeros((n, 2)),
        water_forces=np.zeros((n, 2)),
    )


@pytest.mark.mpi
def test_what_acts_is_read_back_from_a_file(two_blocks, shared_tmp_path):
    pyvista = pytest.importorskip("pyvista")
    mesh = two_blocks[0]
    pair = interface(mesh)
    state, fields = acting(mesh, pair), InterfaceFields(mesh, [pair])
    # The second update must leave nothing of the first.
    fields.update([state])
    u = fem.Function(fem.functionspace(mesh, ("P", 1, (2,))), name="u")
    path = shared_tmp_path / "contact.pvd"
    with FieldWriter(path, mesh, [u, *fields.functions]) as writer:
        writer.write(0.0)
        fields.update([state])
        writer.write(1.0)
    mesh.comm.Barrier()
    if mesh.comm.rank > 0:
        return
    reader = pyvista.get_reader(path)
    reader.set_active_time_value(1.0)
    grid = reader.read()[0]
    # Nodes of the upper block are fifths along the interface, those of the lower one thirds.
    cells = grid.cells.reshape(-1, 4)[:, 1:]
    upper = np.unique(cells[grid.points[cells].mean(axis=1)[:, 1] > 0.5])
    secondary = np.zeros(len(grid.points), bool)
    secondary[upper] = np.isclose(grid.points[upper, 1], 0.5)
    x = grid.points[:, 0]
    paired = secondary & ~np.isclose(x, 0.4)
    assert len(np.unique(x[paired].round(9))) == 5
    kind = np.where(paired, np.round(5 * x).astype(int) % 3, -1)
    np.testing.assert_array_equal(grid["contact state"], kind)
    expected = {
        "contact pressure": 1.0 + x / 3.0,
        "shear": -2.0 * x,
        "gap": 1e-3 * x,
        "slip": x / 7.0,
    }
    for name, values in expected.items():
        shown = np.where(paired, values, np.nan)
        np.testing.assert_allclose(grid[name], shown, rtol=1e-14, atol=1e-15, err_msg=name)


@pytest.mark.mpi
def test_states_of_other_pairs_are_refused(two_blocks):
    mesh = two_blocks[0]
    pair = interface(mesh)
    fields = InterfaceFields(mesh, [pair])
    with pytest.raises(ValueError, match=r"states have \[6, 6\] nodes, .* \[6\]"):
        fields.update([acting(mesh, pair)] * 2)


@pytest.mark.mpi
def test_table_of_what_acts(two_blocks, shared_tmp_path):
    mesh = two_blocks[0]
    state = acting(mesh, interface(mesh))
    path = shared_tmp_path / "new" / "contact.csv"
    write_interface(mesh.comm, path, state)
    mesh.comm.Barrier()
    header, *rows = path.read_text().splitlines()
    names = header.split(",")
    assert len(rows) == 6 and len(set(names)) == 14
    assert all(name.endswith("]") for name in names)
    table = dict(zip(names, np.genfromtxt(path, delimiter=",", skip_header=1).T, strict=True))
    expected = {
        "x [m]": state.points[:, 0],
        "y [m]": state.points[:, 1],
        "n_x [-]": 0.6,
        "n_y [-]": 0.8,
        "pressure [Pa]": state.pressure,
        "shear [Pa]": state.shear,
        "pore pressure [Pa]": state.pore_pressure,
        "jump [Pa]": state.jump,
        "gap [m]": state.gap,
        "slip [m]": state.slip,
        "state [-]": state.state,
        "length [m]": 0.2,
        "force_x [N/m]": state.forces[:, 0],
        "force_y [N/m]": state.forces[:, 1],
    }
    assert set(names) == set(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(table[name], values, err_msg=name)
    if mesh.comm.rank == 0:
        (shared_tmp_path / "file").touch()
    with pytest.raises(OSError):
        write_interface(mesh.comm, shared_tmp_path / "file" / "contact.csv", state)


@pytest.mark.mpi
def test_arc_length(two_blocks):
    mesh = two_blocks[0]
    # Around a corner, anticlockwise: the body is on the left.
    corner = (True, lambda x: np.isclose(x[1], 0.5) | np.isclose(x[0], 1.0))
    tags = tagged(mesh, corner, (False, lambda x: np.isclose(x[1], 0.5)))
    points = gather_surface(mesh, tags, 1, "").points
    expected = points[:, 0] + points[:, 1] - 0.5
    s = arc_length(mesh, hm.ContactPair(tags, 1, 2))
    np.testing.assert_allclose(s, expected, atol=1e-14)

    # Two sides, upwards on the right and downwards on the left, 1 m apart at the top or bottom.
    sides = (True, lambda x: np.isclose(x[0], 0.0) | np.isclose(x[0], 1.0))
    tags = tagged(mesh, sides, (False, lambda x: np.isclose(x[1], 0.5)))
    points = gather_surface(mesh, tags, 1, "").points
    s = arc_length(mesh, hm.ContactPair(tags, 1, 2))
    right = np.isclose(points[:, 0], 1.0)
    along = np.where(right, points[:, 1] - 0.5, 1.0 - points[:, 1])
    first = right == right[np.argmin(s)]
    np.testing.assert_allclose(s, along + np.where(first, 0.0, 0.5 + 1.0), atol=1e-14)
