# SPDX-License-Identifier: LGPL-3.0-or-later
import runpy
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import mesh as dmesh

from fenicsx_hmcontact._compat import cell_nodes
from fenicsx_hmcontact.domain import Domain, MeshArrays, add_quadrilateral, gmsh_session
from meshes.two_blocks import two_blocks

pytestmark = pytest.mark.mpi

COMM = MPI.COMM_WORLD


def twice_area(domain, cells):
    a, b, c = np.moveaxis(domain.mesh.geometry.x[cell_nodes(domain.mesh)[cells], :2], 1, 0)
    return np.cross(np.c_[b - a, np.zeros(len(a))], np.c_[c - a, np.zeros(len(a))])[:, 2]


def area(domain, name):
    return domain.mesh.comm.allreduce(twice_area(domain, domain.cells(name)).sum()) / 2


def midpoints(domain, dim, entities):
    """Midpoints of owned entities of all ranks in one order; cells or facets are told by them."""
    points = dmesh.compute_midpoints(domain.mesh, dim, entities)
    points = np.concatenate(domain.mesh.comm.allgather(points)).round(10) + 0.0
    return points[np.lexsort(points.T)]


def assert_same_groups(one, other):
    assert (one.bodies, one.surfaces) == (other.bodies, other.surfaces)
    for name in one.bodies:
        ours, theirs = (midpoints(d, 2, d.cells(name)) for d in (one, other))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)
    for name in one.surfaces:
        ours, theirs = (midpoints(d, 1, d.facets(name)) for d in (one, other))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def layered(gmsh):
    """Unit square of clay below sand, which share nodes; a weight stands on it."""
    geo = gmsh.model.geo
    corners = [(0, 0), (1, 0), (1, 0.4), (1, 1), (0, 1), (0, 0.4)]
    p = [geo.addPoint(x, y, 0, 0.2) for x, y in corners]
    around = [geo.addLine(p[i], p[(i + 1) % 6]) for i in range(6)]
    seam = geo.addLine(p[2], p[5])
    clay = geo.addPlaneSurface([geo.addCurveLoop([around[0], around[1], seam, around[5]])])
    sand = geo.addPlaneSurface([geo.addCurveLoop([around[2], around[3], around[4], -seam])])
    weight, base = add_quadrilateral(gmsh, [(0, 1), (1, 1), (1, 2), (0, 2)], (3, 3, 3, 3))
    gmsh.model.mesh.generate(2)
    for name, tag in {"clay": clay, "sand": sand, "weight": weight}.items():
        gmsh.model.addPhysicalGroup(2, [tag], name=name)
    for name, tags in {
        "left": [around[4], around[5]],
        "top": [around[3]],
        "base": [base[0]],
        "right": [around[1], around[2], base[1]],
    }.items():
        gmsh.model.addPhysicalGroup(1, tags, name=name)


def test_groups_are_the_same_on_any_number_of_ranks():
    options = {"lower": 5, "upper": 8, "rows": 4, "tilt": 15.0, "unstructured": True}
    assert_same_groups(two_blocks(COMM, **options), two_blocks(MPI.COMM_SELF, **options))


def test_areas_and_counts_of_groups():
    domain = two_blocks(COMM, lower=5, upper=8, rows=4, tilt=15.0)
    assert area(domain, "lower") == pytest.approx(0.25, rel=1e-14)
    assert area(domain, "upper") == pytest.approx(0.25, rel=1e-14)
    count = {name: COMM.allreduce(len(domain.facets(name))) for name in domain.surfaces}
    assert count == {
        "bottom": 5,
        "top": 8,
        "left": 8,
        "right": 8,
        "interface_lower": 5,
        "interface_upper": 8,
    }
    assert COMM.allreduce(len(domain.cells("lower"))) == 2 * 5 * 4
    assert domain.facets("top").dtype == domain.cells("upper").dtype == np.int32


def test_tags_cover_ghosts():
    domain = two_blocks(COMM, lower=5, upper=8, rows=4)
    mesh = domain.mesh
    topology = mesh.topology
    index_map = topology.index_map(2)
    cells = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
    np.testing.assert_array_equal(domain.cell_tags.indices, cells)
    if cells.size:
        below = dmesh.compute_midpoints(mesh, 2, cells)[:, 1] < 0.5
        np.testing.assert_array_equal(domain.cell_tags.values == domain.body("lower"), below)
    at_bottom = dmesh.locate_entities(mesh, 1, lambda x: np.isclose(x[1], 0.0))
    np.testing.assert_array_equal(domain.facet_tags.find(domain.surface("bottom")), at_bottom)


def test_bodies_and_their_surfaces():
    domain = two_blocks(COMM, lower=5, upper=8, rows=4)
    assert domain.body_names == ["lower", "upper"]
    assert domain.body_of_surface("interface_lower") == "lower"
    assert domain.body_of_surface("interface_upper") == "upper"
    with pytest.raises(ValueError, match="'left' lies on the bodies 'lower' and 'upper'"):
        domain.body_of_surface("left")


def test_layers_make_one_body():
    layers = {"soil": ["clay", "sand"]}
    domain = Domain.generate(layered, COMM, name="layered", layers=layers)
    assert domain.body_names == ["soil", "weight"]
    assert set(domain.bodies) == {"clay", "sand", "weight"}
    assert area(domain, "clay") == pytest.approx(0.4, rel=1e-14)
    assert area(domain, "soil") == pytest.approx(1.0, rel=1e-14)
    assert domain.body_of_surface("left") == domain.body_of_surface("top") == "soil"
    assert domain.body_of_surface("base") == "weight"
    nodes = [cell_nodes(domain.mesh)[domain.cells(name)].ravel() for name in domain.body_names]
    points = [np.concatenate(COMM.allgather(domain.mesh.geometry.x[n])) for n in nodes]
    apart = sum(len(np.unique(point.round(12), axis=0)) for point in points)
    assert domain.mesh.topology.index_map(0).size_global == apart
    with pytest.raises(ValueError, match=r"'soil' has no tag of its own.*clay, sand"):
        domain.body("soil")
    with pytest.raises(ValueError, match="on the bodies 'soil' and 'weight'"):
        domain.body_of_surface("right")
    with pytest.raises(ValueError, match="'clay' and 'sand' share nodes"):
        Domain.generate(layered, COMM, name="layered")


@pytest.mark.parametrize(("version", "binary"), [(2.2, 0), (4.1, 0), (4.1, 1)])
def test_file_gives_the_same_as_the_live_model(common_dir, version, binary):
    path = common_dir / "layered.msh"
    layers = {"soil": ["clay", "sand"]}

    def draw(gmsh):
        layered(gmsh)
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.option.setNumber("Mesh.Binary", binary)
        gmsh.write(str(path))

    live = Domain.generate(draw, COMM, name="live", layers=layers)
    read = Domain.read(path, COMM, layers=layers)
    assert read.name == str(path)
    assert_same_groups(read, live)


def test_live_gmsh_of_the_user_is_left_alone():
    if COMM.rank > 0:
        Domain.from_gmsh(None, COMM, name="mine", layers={"soil": ["clay", "sand"]})
        two_blocks(COMM, lower=2, upper=3, rows=2)
        return
    import gmsh

    gmsh.initialize(readConfigFiles=False, interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 1)
        gmsh.option.setNumber("General.Verbosity", 1)
        gmsh.model.add("mine")
        layered(gmsh)
        models = gmsh.model.list()
        domain = Domain.from_gmsh(gmsh.model, COMM, name="mine", layers={"soil": ["clay", "sand"]})
        assert domain.body_names == ["soil", "weight"]
        two_blocks(COMM, lower=2, upper=3, rows=2)
        assert (gmsh.model.list(), gmsh.model.getCurrent()) == (models, "mine")
        assert gmsh.option.getNumber("General.Terminal") == 1
    finally:
        gmsh.finalize()


def test_session_ends_after_an_error():
    gmsh = pytest.importorskip("gmsh")
    with pytest.raises(RuntimeError, match="drawing"), gmsh_session("case"):
        raise RuntimeError("drawing")
    assert not gmsh.isInitialized()


def test_clockwise_body_is_turned_and_unused_nodes_go():
    points = np.array([(9, 9, 9), (0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=float)
    arrays = MeshArrays(
        points,
        np.array([(1, 3, 2), (1, 4, 3)]),
        np.array([7, 7], dtype=np.int32),
        np.array([(4, 3)]),
        np.array([2], dtype=np.int32),
        {"soil": 7},
        {"top": 2},
    )
    domain = Domain.from_arrays(arrays if COMM.rank == 0 else None, COMM, name="arrays")
    assert (twice_area(domain, domain.cells("soil")) > 0).all()
    assert area(domain, "soil") == 1.0
    assert domain.mesh.topology.index_map(0).size_global == 4
    np.testing.assert_array_equal(midpoints(domain, 1, domain.facets("top")), [(0.5, 1.0, 0.0)])


def test_a_body_may_meet_itself():
    """A slit whose two faces coincide is on the boundary, once for each face."""
    points = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0.5), (0, 0.5), (0.5, 0.5)])
    cells = [(0, 1, 6), (1, 2, 6), (2, 3, 6), (0, 6, 4), (6, 3, 5)]
    arrays = MeshArrays(
        np.c_[points, np.zeros(7)],
        np.array(cells),
        np.ones(5, dtype=np.int32),
        np.array([(4, 6), (5, 6)]),
        np.array([1, 2], dtype=np.int32),
        {"soil": 1},
        {"slit_lower": 1, "slit_upper": 2},
    )
    domain = Domain.from_arrays(arrays if COMM.rank == 0 else None, COMM, name="slit")
    assert domain.body_of_surface("slit_lower") == domain.body_of_surface("slit_upper") == "soil"
    assert [COMM.allreduce(len(domain.facets(s))) for s in domain.surfaces] == [1, 1]


def test_script_writes_the_mesh(common_dir, monkeypatch):
    script = Path(__file__).parents[2] / "meshes" / "two_blocks.py"
    out = common_dir / "blocks.msh"
    options = ["--lower", "3", "--upper", "4", "--rows", "2", "--tilt", "10", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", [str(script), *options])
    runpy.run_path(str(script), run_name="__main__")
    assert_same_groups(Domain.read(out, COMM), two_blocks(COMM, lower=3, upper=4, rows=2, tilt=10))
