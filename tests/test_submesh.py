# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pore pressure on the submesh of the porous bodies alone."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, has_adios2
from dolfinx.mesh import create_submesh

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.contact import gather_surface
from fenicsx_hmcontact.output.fields import FieldWriter, evaluate, gather_nodal
from tests.models import (
    GAMMA,
    LOAD,
    MATERIAL,
    contact_pairs,
    fix,
    integral,
    largest,
    loads,
    stack,
    total,
)

pytestmark = pytest.mark.mpi

SETTLED, TIED = hm.CoulombFriction(0.3), hm.Tied()
CLOSED = hm.GapFlow(1e-9)


class Model:
    """Stacked blocks of which some are porous, loaded on top of the uppermost.

    The pore pressure lives in the porous ones, or with ``everywhere`` on the whole mesh, where it
    is prescribed in dry bodies.
    """

    def __init__(
        self,
        domain,
        porous,
        pairs,
        *,
        drained,
        everywhere=False,
        smoothing="deviatoric",
        old=None,
        **options,
    ):
        mesh, self.domain = domain.mesh, domain
        mesh.topology.create_connectivity(1, 2)
        tags = [domain.body(name) for name in porous]
        self.part, self.map = domain.submesh(*porous)
        n = len(domain.bodies) - 1
        V = fem.functionspace(mesh, ("P", 1, (2,)))
        Q = fem.functionspace(mesh if everywhere else self.part.mesh, ("P", 1))
        self.u, self.p = fem.Function(V, name="displacement"), fem.Function(Q, name="pore pressure")
        self.u_n, self.p_n = fem.Function(V), fem.Function(Q)
        v, q = ufl.TestFunctions(ufl.MixedFunctionSpace(V, Q))
        dc = hm.node_cells_measure(smoothing, domain=mesh, subdomain_data=domain.cell_tags)
        dx = ufl.Measure("dx", mesh, subdomain_data=domain.cell_tags)
        wet, wet_dx = dc(tuple(tags)), dx(tuple(tags))
        self.wet_dx = wet_dx
        self.dt = fem.Constant(mesh, 100.0)
        # It depends on the pressure, so that values of p stand on dc too.
        self.k = fem.Function(fem.functionspace(Q.mesh, ("DG", 0)), name="k")
        self.k.interpolate(lambda x: 1e-9 * (1.0 + x[0]))
        k = self.k * (1.0 + (self.p / LOAD) ** 2)
        F = hm.equilibrium(MATERIAL.stress(self.u), self.p, v, smoothed=dc, triangles=wet_dx)
        F += hm.water_balance(
            *(self.u, self.u_n, self.p, q, self.dt),
            permeability=k,
            unit_weight=GAMMA,
            smoothed=wet,
            triangles=wet_dx,
        )
        G = MATERIAL.shear_modulus
        F += hm.pressure_projection(self.p, self.p_n, q, G, triangles=wet_dx)
        F += loads(domain, v, {f"top_{n}": (0.1 * LOAD, -LOAD)})
        bcs = [fix(domain, V.sub(i), "bottom_0", 0.0) for i in (0, 1)]
        where = domain if everywhere else self.part
        bcs += [fix(where, Q, name) for name in drained]
        if everywhere:
            for name in set(domain.bodies) - set(porous):
                dofs = fem.locate_dofs_topological(Q, 2, domain.cell_tags.find(domain.body(name)))
                bcs.append(fem.dirichletbc(0.0, dofs, Q))
        self.pairs = contact_pairs(domain, pairs)
        options = {"pairs": self.pairs, "time_step": self.dt, "domain": domain} | options
        if not everywhere:
            options["entity_maps"] = [self.map]
        if old is not None:
            F = old.problem.model
            names = "u_n", "p_n", "dt", "k"
            options["replace"] = {getattr(old, name): getattr(self, name) for name in names}
            options["replace"][old.domain.cell_tags] = domain.cell_tags
            options["replace"][old.domain.facet_tags] = domain.facet_tags
        self.problem = hm.ContactProblem(F, [self.u, self.p], bcs=bcs, **options)

    def run(self, steps=2):
        """Take steps; return the model."""
        for _ in range(steps):
            self.u_n.x.array[:], self.p_n.x.array[:] = self.u.x.array, self.p.x.array
            self.problem.solve()
        return self

    def values(self):
        """Displacement and pore pressure at points inside the soil, the same on all ranks."""
        x = np.array([(0.13, 0.04), (0.5, 0.2), (0.77, 0.31), (0.91, 0.38)])
        return evaluate(self.u, x), evaluate(self.p, x)


FOOTING = {
    "tied": [("bottom_1", "top_0", None, TIED)],
    "sliding": [("bottom_1", "top_0", None, SETTLED)],
}
TWO_SOILS = {
    "tied": [("bottom_1", "top_0", CLOSED, TIED), ("bottom_2", "top_1", None, TIED)],
    "sliding": [("bottom_1", "top_0", CLOSED, SETTLED), ("bottom_2", "top_1", None, SETTLED)],
}


def footing(comm, contact, **options):
    """A dry block on a porous one."""
    domain = stack(comm, [7, 5], rows=4)
    return Model(domain, ["block_0"], FOOTING[contact], drained=["left_0"], **options)


def two_soils(comm, contact, **options):
    """A dry block on two porous ones, with water between these."""
    domain = stack(comm, [7, 8, 5], rows=3, levels=[0.0, 0.4, 0.8, 1.0])
    porous = ["block_0", "block_1"]
    return Model(domain, porous, TWO_SOILS[contact], drained=["left_0"], **options)


@pytest.mark.parametrize("contact", ["tied", "sliding"])
@pytest.mark.parametrize("scene", [footing, two_soils])
def test_same_answer_as_on_one_rank_and_with_the_pressure_everywhere(comm, scene, contact):
    mine, alone = scene(comm, contact).run(), scene(MPI.COMM_SELF, contact).run()
    whole = scene(comm, contact, everywhere=True).run()
    assert mine.problem.n_unknowns == alone.problem.n_unknowns
    assert mine.problem.n_unknowns["pore pressure"] < whole.problem.n_unknowns["pore pressure"]
    u, p = mine.values()
    assert np.abs(p).min() > 1e-2 * LOAD
    for other in (alone, whole):
        for a, b in zip((u, p), other.values(), strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * np.abs(b).max())
        for pair, same in zip(mine.pairs, other.pairs, strict=True):
            a, b = mine.problem.interface(pair), other.problem.interface(same)
            np.testing.assert_allclose(a.pressure, b.pressure, rtol=0, atol=1e-8 * LOAD)
            np.testing.assert_allclose(a.pore_pressure, b.pore_pressure, rtol=0, atol=1e-8 * LOAD)
    u, v = mine.u.x.array, whole.u.x.array
    assert largest(u - v, comm) < 1e-9 * largest(v, comm)


@pytest.mark.parametrize("contact", ["tied", "sliding"])
def test_water_leaves_through_drained_faces_alone(comm, contact):
    model = two_soils(comm, contact).run(1)
    change = integral(fem.form(ufl.div(model.u - model.u_n) * model.wet_dx), comm)
    stored = total(model.problem.reactions(model.p), model.part)[0]
    assert abs(change) > 1e-7
    assert stored == pytest.approx(change, rel=1e-10)


def test_tangent_is_the_derivative_of_the_residual(comm):
    model = footing(comm, "tied")
    problem, (u, p) = model.problem, model.problem.unknowns
    u.interpolate(lambda x: 1e-5 * np.array((np.sin(5 * x[0]), np.cos(7 * x[0] * x[1]))))
    p.interpolate(lambda x: LOAD * np.sin(3 * x[0] + 5 * x[1]))
    start = [f.x.array.copy() for f in (u, p)]
    u.interpolate(lambda x: 1e-5 * np.array((np.cos(4 * x[1]), np.sin(6 * x[0]))))
    p.interpolate(lambda x: LOAD * np.cos(2 * x[0] - 4 * x[1]))
    direction = [f.x.array.copy() for f in (u, p)]

    def residual(step):
        for f, array, d in zip((u, p), start, direction, strict=True):
            f.x.array[:] = array + step * d
        problem.residual()
        return problem._raw.copy()

    difference = (residual(1e-4) - residual(-1e-4)) / 2e-4
    residual(0.0)
    problem._assemble_tangent()
    tangent = problem._matrix.multiply(np.concatenate(direction))
    problem.layout.add_ghosts_to_owners(tangent)
    for a, b in zip(*map(problem.layout.views, (difference, tangent)), strict=True):
        assert largest(a - b, comm) < 1e-7 * largest(b, comm)


def test_compiled_model_on_another_mesh(comm):
    first = footing(comm, "tied").run()
    second = Model(
        stack(comm, [9, 6], rows=5), ["block_0"], FOOTING["tied"], drained=["left_0"], old=first
    ).run()
    assert second.problem.model is first.problem.model
    _, p = second.values()
    np.testing.assert_allclose(p, first.values()[1], rtol=0, atol=0.05 * LOAD)


def test_unknowns_in_any_order(comm):
    domain = stack(comm, [3, 2])
    part, entity_map = domain.submesh("block_0")
    h = fem.Function(fem.functionspace(part.mesh, ("P", 1)), name="head")
    T = fem.Function(fem.functionspace(domain.mesh, ("P", 1)), name="temperature")
    dc = hm.node_cells_measure(domain=domain.mesh, subdomain_data=domain.cell_tags)
    x, y = ufl.SpatialCoordinate(part.mesh), ufl.SpatialCoordinate(domain.mesh)
    q, v = ufl.TestFunctions(ufl.MixedFunctionSpace(h.function_space, T.function_space))
    F = (h - T - x[0] - y[0]) * q * dc(domain.body("block_0")) + (T - y[1]) * v * dc
    hm.ContactProblem(F, [h, T], entity_maps=[entity_map]).solve()
    values = evaluate(h, [(0.25, 0.25), (1.0, 0.5)])
    np.testing.assert_allclose(values, [[0.75], [2.5]], rtol=1e-12)


def test_gradients_are_those_of_the_part(comm):
    domain = stack(comm, [3, 2])
    part, entity_map = domain.submesh("block_1")
    p = fem.Function(fem.functionspace(part.mesh, ("P", 1)), name="pore pressure")
    p.interpolate(lambda x: 2.0 * x[0] - 3.0 * x[1])
    k = fem.Function(fem.functionspace(part.mesh, ("DG", 0)))
    k.x.array[:] = 7.0
    cells = hm.create_node_cells(domain.mesh, [entity_map])
    dry = np.isnan(cells.nodal_values(p)[: len(cells), 0])
    assert comm.allreduce(int(dry.sum())) == 4 * 4
    gradient = cells.gradient(p)
    assert np.isnan(gradient[dry]).all()
    assert largest(gradient[~dry] - np.array([2.0, -3.0]), comm) < 1e-12
    assert np.array_equal(np.isnan(cells.cell_means(k)[:, 0]), dry)
    assert largest(cells.cell_means(k)[~dry] - 7.0, comm) < 1e-13


# --- names of the parts ---------------------------------------------------------------------------


def test_part_of_a_domain_has_its_bodies_and_surfaces(comm):
    domain = stack(comm, [3, 2, 4])
    part, _ = domain.submesh("block_2", "block_0")
    assert part.body_names == ["block_2", "block_0"]
    assert set(part.surfaces) == {
        f"{side}_{k}" for side in ("bottom", "right", "top", "left") for k in (0, 2)
    }
    for name, group in [("block_0", 3 * 6), ("block_2", 4 * 6)]:
        assert comm.allreduce(len(part.cells(name))) == group
        assert part.body(name) == domain.body(name)
    assert comm.allreduce(len(part.facets("top_2"))) == 4
    assert part.body_of_surface("top_2") == "block_2"
    surface = gather_surface(part.mesh, part.facet_tags, part.surface("top_2"), "top_2")
    assert np.allclose(surface.points[:, 1], 1.0)
    assert domain.body_of_surface("left_0") == part.body_of_surface("left_0") == "block_0"


def test_unknown_and_missing_names_are_refused(comm):
    domain = stack(comm, [3, 2])
    with pytest.raises(ValueError, match="unknown body 'sand'; known: block_0, block_1"):
        domain.submesh("sand")
    with pytest.raises(ValueError, match=r"submesh\(\) needs the name of a body"):
        domain.submesh()


# --- what is refused ------------------------------------------------------------------------------


class Flow:
    """Seepage in the lower of two blocks with a source on the whole mesh."""

    def __init__(self, comm, cells=None):
        self.domain = domain = stack(comm, [3, 2])
        domain.mesh.topology.create_connectivity(1, 2)
        if cells is None:
            self.part, self.map = (lambda part, m: (part.mesh, m))(*domain.submesh("block_0"))
        else:
            self.part, self.map, *_ = create_submesh(domain.mesh, 2, cells(domain))
        self.u = fem.Function(fem.functionspace(domain.mesh, ("P", 1)), name="temperature")
        self.p = fem.Function(fem.functionspace(self.part, ("P", 1)), name="pore pressure")
        self.v, self.q = (ufl.TestFunction(f.function_space) for f in (self.u, self.p))
        tags = {"domain": domain.mesh, "subdomain_data": domain.cell_tags}
        self.dx, self.dc = ufl.Measure("dx", **tags), hm.node_cells_measure(**tags)
        self.ds = ufl.Measure("ds", domain.mesh, subdomain_data=domain.facet_tags)
        self.tag = domain.body("block_0")

    def problem(self, term, **options):
        F = self.u * self.v * self.dx + 0.0 * self.p * self.v * self.dx(self.tag)
        G = self.p * self.q * self.dx(self.tag) + 0.0 * self.u * self.q * self.dx(self.tag) + term
        options = {"entity_maps": [self.map]} | options
        return hm.ContactProblem([F, G], [self.u, self.p], **options)


def test_terms_where_the_field_does_not_live_are_refused(comm):
    m = Flow(comm)
    with pytest.raises(ValueError, match="pore pressure does not live on 12 of its node cells"):
        m.problem(ufl.inner(ufl.grad(m.p), ufl.grad(m.q)) * m.dc)
    with pytest.raises(ValueError, match="the test function does not live on 12 of its node cells"):
        m.problem(m.u * m.q * m.dc)
    with pytest.raises(ValueError, match="field pore pressure are integrated over 12 cells"):
        m.problem(m.q * m.dx)
    with pytest.raises(ValueError, match="field pore pressure are integrated over 2 cells or"):
        m.problem(m.q * m.ds(m.domain.surface("top_1")))
    with pytest.raises(ValueError, match="integrated over another mesh than the unknowns live on"):
        m.problem(m.q * ufl.dx)
    with pytest.raises(ValueError, match="no entity map says what part it is"):
        m.problem(0.0 * m.q * m.dx(m.tag), entity_maps=None)
    m.problem(m.q * m.dx(m.tag) + m.u * m.q * m.dc(m.tag)).solve()


def test_submesh_without_ghost_cells_is_refused(comm):
    def owned(domain):
        return domain.cells("block_0")

    m = Flow(comm, owned)
    term = ufl.inner(ufl.grad(m.p), ufl.grad(m.q)) * m.dc(m.tag)
    tags = m.domain.cell_tags
    ghosts = tags.find(m.tag).size - len(m.domain.cells("block_0"))
    if comm.allreduce(ghosts):
        with pytest.raises(ValueError, match="the submesh of pore pressure lacks ghost cells"):
            m.problem(term)
    else:
        m.problem(term).solve()


def test_water_between_a_porous_and_a_dry_body_is_refused_by_name(comm):
    domain = stack(comm, [7, 5], rows=4)
    with pytest.raises(ValueError, match="surface 5 carries no pore pressure: leave flow out"):
        Model(domain, ["block_0"], [("bottom_1", "top_0", CLOSED, TIED)], drained=["left_0"])


# --- output ---------------------------------------------------------------------------------------


def test_fields_of_a_part_in_files(comm, shared_tmp_path):
    model = footing(comm, "tied").run(1)
    for suffix in (".pvd", ".bp") if has_adios2 else (".pvd",):
        with FieldWriter(shared_tmp_path / f"soil{suffix}", model.part.mesh, [model.p]) as file:
            file.write(1.0)
    with pytest.raises(ValueError, match="'pore pressure' is on another mesh; give it a file"):
        FieldWriter(shared_tmp_path / "all.pvd", model.domain.mesh, [model.u, model.p])


def test_nodal_values_of_a_part_do_not_depend_on_the_ranks(comm):
    def gathered(comm):
        part, _ = stack(comm, [7, 5], rows=4).submesh("block_1")
        p = fem.Function(fem.functionspace(part.mesh, ("P", 1)))
        p.interpolate(lambda x: x[0] + 10.0 * x[1])
        return gather_nodal(p)

    mine, alone = gathered(comm), gathered(MPI.COMM_SELF)
    if mine is not None:
        for a, b in zip(mine, alone, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)
        assert mine[1].shape == (2 * 5 * 4, 3)
