# SPDX-License-Identifier: LGPL-3.0-or-later
import xml.etree.ElementTree as ET

from mpi4py import MPI

import basix.ufl
import numpy as np
import pytest
from dolfinx import fem
from dolfinx.mesh import create_unit_square

from fenicsx_hmcontact.output.fields import FieldWriter
from fenicsx_hmcontact.output.series import Series, gather_frame, read_series
from tests.models import stack

pytestmark = pytest.mark.mpi

SHEAR = np.array([[0.0, 0.25], [0.5, 0.0]])
"""The displacement of a step is this matrix times the point."""


class Fields:
    """Displacement, stress and strain of two blocks, and pore pressure in the lower one."""

    def __init__(self, comm, across, t):
        self.domain = stack(comm, across)
        self.part, _ = self.domain.submesh("block_0")
        mesh = self.domain.mesh
        V = fem.functionspace(mesh, ("P", 1, (2,)))
        self.u, self.u_n = fem.Function(V, name="displacement"), fem.Function(V)
        self.p = fem.Function(fem.functionspace(self.part.mesh, ("P", 1)), name="pore pressure")
        self.k = fem.Function(fem.functionspace(self.part.mesh, ("DG", 0)), name="permeability")
        self.strain = fem.Function(fem.functionspace(mesh, ("DG", 0)), name="strain")
        self.stress = fem.Function(fem.functionspace(mesh, ("P", 1, (2, 2))), name="stress")
        self.u_n.interpolate(lambda x: (t * x[0], t * x[1] ** 2))
        self.u.interpolate(lambda x: (t * x[0] + x[1] / 4, t * x[1] ** 2 + x[0] / 2))
        self.p.interpolate(lambda x: t + x[0] - 3 * x[1])
        self.k.interpolate(lambda x: t + x[0] + 2 * x[1])
        self.strain.interpolate(lambda x: t * x[0] - x[1])
        self.stress.interpolate(lambda x: (t * x[0], x[1], 2 * x[1], x[0] * x[1]))
        self.functions = [self.p, self.k, self.u, self.strain, self.stress]

    @property
    def step(self):
        return self.u, self.u_n


def check(points, cells, nodal, cellwise, across, t):
    """Compare what was read with the functions, where the nodes were before the step."""
    n, m = (3 + 1) * (sum(across) + len(across)), 2 * 3 * sum(across)
    assert (len(points), len(cells)) == (n, m)
    x, y = np.linalg.solve(np.eye(2) + SHEAR, points.T)
    zero = np.zeros(n)

    def same(a, b):
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-14)

    same(nodal["displacement"], np.column_stack((t * x + y / 4, t * y**2 + x / 2, zero)))
    stress = np.column_stack((t * x, y, zero, 2 * y, x * y, *4 * (zero,)))
    same(nodal["stress"].reshape(n, 9), stress)
    # Nodes of both blocks lie at the same height in the middle.
    p = nodal["pore pressure"]
    known = np.isfinite(p)
    assert known.sum() == (3 + 1) * (across[0] + 1)
    assert known[y < 0.5 - 1e-9].all() and not known[y > 0.5 + 1e-9].any()
    same(p[known], (t + x - 3 * y)[known])
    corners = np.stack((x, y), axis=1)[cells]
    x, y = corners.mean(axis=1).T
    same(cellwise["strain"], t * x - y)
    same(cellwise["permeability"], np.where(y < 0.5, t + x + 2 * y, np.nan))


MESHES = {1.5: (3, 2), 2.5: (5, 4), 4.0: (2, 6)}


def write(comm, path, digits=None):
    series = Series(path, comm)
    for t, across in MESHES.items():
        fields = Fields(comm, across, t)
        if digits is not None:
            for f in (*fields.functions, fields.u_n):
                f.x.array[:] = np.round(f.x.array, digits) + 0.0
        series.write(t, fields.functions, fields.step)
    return series


def test_vtk_reads_back_across_remeshes(comm, shared_tmp_path):
    pyvista = pytest.importorskip("pyvista")
    path = write(comm, shared_tmp_path / "new" / "run.pvd").path
    if comm.rank > 0:
        return
    reader = pyvista.get_reader(path)
    assert reader.time_values == list(MESHES)
    for t, across in MESHES.items():
        reader.set_active_time_value(t)
        grid = reader.read()[0]
        assert set(grid.cells_dict) == {pyvista.CellType.TRIANGLE}
        assert not grid.points[:, 2].any()
        cells = grid.cells_dict[pyvista.CellType.TRIANGLE]
        check(grid.points[:, :2], cells, grid.point_data, grid.cell_data, across, t)


def test_reads_back_across_remeshes(comm, shared_tmp_path):
    path = write(comm, shared_tmp_path / "run").path
    assert path.name == "run.pvd"
    frames = list(read_series(path))
    assert [frame.time for frame in frames] == list(MESHES)
    for frame, (t, across) in zip(frames, MESHES.items(), strict=True):
        check(frame.points, frame.cells, frame.nodal, frame.cellwise, across, t)


def test_same_files_on_any_number_of_ranks(comm, shared_tmp_path):
    # Rounded, since interpolated values differ in the last bit, or in the sign of zero.
    write(comm, shared_tmp_path / "all" / "run", digits=9)
    write(MPI.COMM_SELF, shared_tmp_path / str(comm.rank) / "run", digits=9)
    if comm.rank == 0:
        files = [
            {file.name: file.read_bytes() for file in (shared_tmp_path / name).rglob("*.*")}
            for name in ("all", "0")
        ]
        assert sorted(files[0]) == ["0000.vtu", "0001.vtu", "0002.vtu", "run.pvd"]
        assert files[0] == files[1]


def test_file_holds_the_frame_to_the_last_bit(comm, shared_tmp_path):
    mesh = create_unit_square(comm, 4, 4)
    p = fem.Function(fem.functionspace(mesh, ("P", 1)), name='σ\' < 0 & "x"')
    q = fem.Function(fem.functionspace(mesh, ("DG", 0)), name="q")
    p.interpolate(lambda x: np.exp(50 * x[0]) / 3)
    q.interpolate(lambda x: np.where(x[0] > 0.5, np.nan, 1e-300 * x[1]))
    frame = gather_frame(1 / 3, [p, q])
    assert (frame is None) == (comm.rank > 0)
    series = Series(shared_tmp_path / "run", comm)
    series.write(1 / 3, [p, q])
    if comm.rank == 0:
        (read,) = read_series(series.path)
        assert read.time == frame.time
        np.testing.assert_array_equal(read.points, frame.points)
        np.testing.assert_array_equal(read.cells, frame.cells)
        np.testing.assert_array_equal(read.nodal[p.name], frame.nodal[p.name])
        np.testing.assert_array_equal(read.cellwise["q"], frame.cellwise["q"])


def test_end_of_a_step_is_where_the_next_starts(comm):
    fields = Fields(comm, (3, 2), 1.0)
    mesh = fields.domain.mesh
    at_start = gather_frame(0.0, [fields.p, fields.u])
    at_end = gather_frame(0.0, [fields.p], fields.step)
    mesh.geometry.x[:, :2] += mesh.geometry.x[:, :2] @ SHEAR.T
    after = gather_frame(0.0, [fields.p, fields.u])
    total = gather_frame(0.0, [fields.p], fields.u)
    if comm.rank == 0:
        u = at_start.nodal["displacement"][:, :2]
        assert np.abs(at_end.points - at_start.points).max() > 0.4
        np.testing.assert_allclose(at_end.points, after.points, rtol=0, atol=1e-15)
        np.testing.assert_allclose(total.points, after.points + u, rtol=0, atol=1e-15)


def test_fields_of_a_part_alone(comm):
    fields = Fields(comm, (3, 2), 1.0)
    frame = gather_frame(0.0, [fields.p, fields.k])
    if comm.rank == 0:
        assert (len(frame.points), len(frame.cells)) == (16, 18)
        x, y = frame.points.T
        np.testing.assert_allclose(frame.nodal["pore pressure"], 1 + x - 3 * y, atol=1e-15)
        x, y = frame.points[frame.cells].mean(axis=1).T
        np.testing.assert_allclose(frame.cellwise["permeability"], 1 + x + 2 * y, atol=1e-15)


def test_parts_of_a_mixed_function_and_higher_degree(comm):
    mesh = create_unit_square(comm, 3, 3)
    vector, scalar = ("P", "triangle", 2), ("P", "triangle", 1)
    element = basix.ufl.mixed_element(
        [basix.ufl.element(*vector, shape=(2,)), basix.ufl.element(*scalar)]
    )
    both = fem.Function(fem.functionspace(mesh, element))
    u, p = both.sub(0), both.sub(1)
    u.name, p.name = "u", "p"
    u.interpolate(lambda x: (x[0] ** 2, 2 * x[1]))
    p.interpolate(lambda x: x[0] - x[1])
    frame = gather_frame(0.0, [u, p])
    moved = gather_frame(0.0, [p], u)
    if comm.rank == 0:
        x, y = frame.points.T
        np.testing.assert_allclose(frame.nodal["u"][:, :2].T, (x**2, 2 * y), atol=1e-14)
        np.testing.assert_allclose(frame.nodal["p"], x - y, atol=1e-14)
        np.testing.assert_allclose(moved.points.T, (x + x**2, 3 * y), atol=1e-14)


def listed(path):
    """Times of a series whose frames are all there, and whose files are all whole."""
    assert not list(path.parent.rglob("*.part"))
    entries = list(ET.parse(path).iter("DataSet"))
    for entry in entries:
        ET.parse(path.parent / entry.get("file"))
    return [float(entry.get("timestep")) for entry in entries]


def test_series_is_whole_after_each_frame(comm, shared_tmp_path):
    p = fem.Function(fem.functionspace(create_unit_square(comm, 2, 2), ("P", 1)), name="p")
    series = Series(shared_tmp_path / "run", comm)
    for k, t in enumerate((0.1, 0.2, 1e6)):
        if k == 2:
            if comm.rank == 0:
                (shared_tmp_path / "run" / "0002.vtu").mkdir()
            with pytest.raises(OSError):
                series.write(t, [p])
            comm.Barrier()
            if comm.rank == 0:
                (shared_tmp_path / "run" / "0002.vtu").rmdir()
                assert listed(series.path) == [0.1, 0.2]
        series.write(t, [p])
        if comm.rank == 0:
            assert listed(series.path) == [0.1, 0.2, 1e6][: k + 1]


def test_goes_on_after_a_restart(comm, shared_tmp_path):
    p = fem.Function(fem.functionspace(create_unit_square(comm, 2, 2), ("P", 1)), name="p")
    path = shared_tmp_path / "run.pvd"
    with pytest.raises(FileNotFoundError):
        Series(path, comm, start=1.0)
    first = Series(path, comm)
    for t in (1.0, 2.0, 3.0):
        p.x.array[:] = t
        first.write(t, [p])
    again = Series(path, comm, start=2.0)
    with pytest.raises(ValueError, match="no frame at 2 can follow one at 2"):
        again.write(2.0, [p])
    p.x.array[:] = 2.5
    again.write(2.5, [p])
    if comm.rank == 0:
        read = [(frame.time, frame.nodal["p"][0]) for frame in read_series(path)]
        assert read == [(1.0, 1.0), (2.0, 2.0), (2.5, 2.5)]
    comm.Barrier()
    Series(path, comm).write(0.0, [p])
    if comm.rank == 0:
        assert listed(path) == [0.0]


def test_refuses_what_it_cannot_write(comm, shared_tmp_path):
    fields, other = Fields(comm, (3, 2), 1.0), Fields(comm, (4, 2), 1.0)
    mesh = fields.domain.mesh
    jumping = fem.Function(fem.functionspace(mesh, ("DG", 1)), name="jumping")
    by_cell = fem.Function(fem.functionspace(mesh, ("DG", 0, (2,))), name="by cell")
    on_part = fem.Function(fem.functionspace(fields.part.mesh, ("P", 1, (2,))), name="on part")
    series = Series(shared_tmp_path / "run", comm)
    for functions, displacement, message in (
        ([], None, "no function to write"),
        ([fields.p, other.p], None, "two functions are called 'pore pressure'"),
        ([fields.u, other.p], None, "'pore pressure' is on another mesh"),
        ([jumping], None, "'jumping' has no nodal values"),
        ([fields.p], by_cell, "displacement 'by cell' is no continuous vector"),
        ([fields.u], on_part, "displacement 'on part' is no continuous vector"),
        ([fields.u], (fields.u, on_part), "displacement 'on part' is no continuous vector"),
        ([fields.u], fields.p, "displacement 'pore pressure' is no continuous vector"),
    ):
        with pytest.raises(ValueError, match=message):
            series.write(1.0, functions, displacement)
    for t in (np.nan, np.inf):
        with pytest.raises(ValueError, match=f"no frame at {t}"):
            series.write(t, [fields.u])
    with pytest.raises(ValueError, match=r"not '\.bp'"):
        Series(shared_tmp_path / "run.bp", comm)
    if comm.rank == 0:
        (shared_tmp_path / "file").touch()
    with pytest.raises(OSError):
        Series(shared_tmp_path / "file" / "run", comm)


def test_refuses_to_read_what_others_wrote(comm, shared_tmp_path):
    mesh = create_unit_square(comm, 2, 2)
    p = fem.Function(fem.functionspace(mesh, ("P", 1)), name="p")
    path = shared_tmp_path / "run.pvd"
    with FieldWriter(path, mesh, [p]) as writer:
        writer.write(0.0)
    comm.Barrier()
    with pytest.raises(ValueError, match="is no frame of a Series"):
        list(read_series(path))
    comm.Barrier()
    if comm.rank == 0:
        path.write_text("text")
    with pytest.raises(ValueError, match="is no file of a Series"):
        Series(path, comm, start=0.0)
