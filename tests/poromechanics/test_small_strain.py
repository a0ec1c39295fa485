# SPDX-License-Identifier: LGPL-3.0-or-later
"""Weak forms of consolidation: element matrices, signs, steady states and Terzaghi's column."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix

import fenicsx_hmcontact as hm
from fenicsx_hmcontact.poromechanics.analytic import terzaghi_degree, terzaghi_pressure
from tests.models import GAMMA, LOAD, K, Porous, dense, fix, integral, largest, stack, total

SIDES = {("bottom_0", 1): 0.0, ("left_0", 0): 0.0, ("right_0", 0): 0.0}
SMOOTHINGS = ["deviatoric", "full", "none", "triangles"]


@pytest.mark.mpi
def test_projection_is_the_element_matrix_of_equation_52(comm):
    mesh = stack(comm, (3,), slope=0.0, rows=2, alternate=True).mesh
    Q = fem.functionspace(mesh, ("P", 1))
    p, q = ufl.TrialFunction(Q), ufl.TestFunction(Q)
    G, tau = 3e7, 2.5
    form = hm.pressure_projection(p, fem.Function(Q) * 0, q, G, tau=tau)
    S = assemble_matrix(fem.form(ufl.lhs(form)))
    S.assemble()
    areas = fem.assemble_vector(
        fem.form(ufl.TestFunction(fem.functionspace(mesh, ("DG", 0))) * ufl.dx)
    ).array
    element = (3 * np.eye(3) - 1) / 36 * tau / (2 * G)
    expected = np.zeros((Q.dofmap.index_map.size_global,) * 2)
    for cell in range(mesh.topology.index_map(2).size_local):
        dofs = Q.dofmap.index_map.local_to_global(Q.dofmap.cell_dofs(cell))
        expected[np.ix_(dofs, dofs)] += areas[cell] * element
    expected = comm.allreduce(expected)
    result = dense(S, comm)
    assert np.abs(result - expected).max() < 1e-14 * np.abs(expected).max()
    # No water is made: columns sum to zero.
    assert np.abs(result.sum(axis=0)).max() < 1e-15 * np.abs(expected).max()


def test_darcys_flux_with_gravity_and_anisotropy(comm):
    mesh = stack(comm, (2,), rows=2).mesh
    x = ufl.SpatialCoordinate(mesh)
    p = 3 * x[0] - 5 * x[1]
    k = np.array([[2.0, 0.5], [0.25, 4.0]])
    down = np.array([0.6, -0.8])
    q = hm.darcy_flux(p, ufl.as_matrix(k.tolist()), 10.0, ufl.as_vector(down.tolist()))
    expected = -k @ (np.array([3, -5]) / 10 - down)
    mean = [integral(fem.form(q[i] * ufl.dx), comm) for i in range(2)]
    np.testing.assert_allclose(mean, expected, rtol=1e-14)
    q = hm.darcy_flux(p, 2.0, 10.0)
    mean = [integral(fem.form(q[i] * ufl.dx), comm) for i in range(2)]
    np.testing.assert_allclose(mean, [-0.6, 1.0], rtol=1e-14)


def column(comm, n, smoothing="deviatoric", **options):
    """Terzaghi's column of half its height in width, cells square, n rows."""
    domain = stack(comm, (n // 2,), width=0.5, rows=n)
    return Porous(
        domain,
        fixed=SIDES,
        drained={"top_0": 0.0},
        tractions={"top_0": (0.0, -LOAD)},
        material=hm.LinearElastic(1e8, 0.0),
        smoothing=smoothing,
        **options,
    )


def pressure_error(model, t):
    """Area-weighted rms error of p / load."""
    exact = fem.Function(model.Q)
    exact.interpolate(lambda x: terzaghi_pressure(x[1], t, 1.0, 1e-5, LOAD))
    square = integral(fem.form((model.p - exact) ** 2 * ufl.dx), model.domain.mesh.comm)
    return np.sqrt(square / 0.5) / LOAD


@pytest.mark.parametrize(
    ("smoothing", "bound"),
    # Without enhancement spurious modes cost a factor of four, not the order.
    [(name, 4e-3 if name == "none" else 1e-3) for name in [*SMOOTHINGS, "taylor-hood"]],
)
def test_terzaghi_converges_with_order_two(comm, smoothing, bound):
    # The steps shrink with h squared, so that backward Euler's first order counts as second.
    options = dict(smoothing=smoothing)
    if smoothing == "taylor-hood":
        options = dict(smoothing="triangles", degree=2, tau=0.0)
    pressure, degree = [], []
    for n, steps in ((16, 64), (32, 256)):
        model = column(comm, n, **options)
        for _ in range(steps):
            model.step(1000.0 / steps)
        pressure.append(pressure_error(model, 1000.0))
        ds = ufl.Measure("ds", domain=model.domain.mesh, subdomain_data=model.domain.facet_tags)
        top = ds(model.domain.surface("top_0"))
        settled = -integral(fem.form(model.u[1] * top), comm) / 0.5
        degree.append(settled / (LOAD / 1e8) - float(terzaghi_degree(1000.0, 1.0, 1e-5)))
        assert model.problem.n_factorisations == 1
    assert np.log2(pressure[0] / pressure[1]) >= 1.85
    assert pressure[1] < bound and abs(degree[1]) < 5e-4


@pytest.mark.parametrize("smoothing", ["deviatoric", "triangles"])
@pytest.mark.mpi
def test_prescribed_outflow_reaches_its_steady_state(comm, smoothing):
    # Water is drawn from the top and comes in through the base: a linear pressure.
    flux = 2e-10
    domain = stack(comm, (3,), rows=4, alternate=True)
    model = Porous(
        domain,
        fixed=SIDES,
        drained={"bottom_0": 5e3},
        fluxes={"top_0": flux},
        smoothing=smoothing,
        tau=0.0,
    )
    for _ in range(3):
        model.step(1e12)
    exact = fem.Function(model.Q)
    exact.interpolate(lambda x: 5e3 - GAMMA * flux / K * x[1])
    assert largest(model.p.x.array - exact.x.array, comm) < 1e-9 * 5e3
    # What the base takes in is what the top gives away.
    assert -model.outflow() == pytest.approx(flux * 1e12, rel=1e-9)
    assert total(model.problem.reactions(model.p), domain, "bottom_0") == pytest.approx(
        [flux * 1e12], rel=1e-9
    )


@pytest.mark.parametrize("smoothing", ["deviatoric", "triangles"])
@pytest.mark.mpi
def test_anisotropic_permeability(comm, smoothing):
    # p on the boundary such that the flux of a full tensor is free of divergence: p is linear.
    domain = stack(comm, (4,), rows=3, alternate=True)
    tensor = np.array([[3.0, 1.0], [1.0, 2.0]]) * K

    def exact(x):
        return 1e3 * (1 + 2 * x[0] - 3 * x[1])

    sides = ("bottom_0", "top_0", "left_0")
    domain.mesh.topology.create_connectivity(1, 2)
    Q = fem.functionspace(domain.mesh, ("P", 1))
    p, q = fem.Function(Q, name="pore pressure"), ufl.TestFunction(Q)
    flux = hm.darcy_flux(p, fem.Constant(domain.mesh, tensor), GAMMA)
    ds = ufl.Measure("ds", domain=domain.mesh, subdomain_data=domain.facet_tags)
    out = (-tensor @ np.array([2e3, -3e3]) / GAMMA)[0]
    F = -ufl.dot(flux, ufl.grad(q)) * hm.node_cells_measure(smoothing)
    F += fem.Constant(domain.mesh, out) * q * ds(domain.surface("right_0"))
    bcs = [fix(domain, Q, name, exact) for name in sides]
    result = hm.ContactProblem(F, p, bcs=bcs).solve()
    expected = fem.Function(Q)
    expected.interpolate(exact)
    assert result.iterations == 1
    assert largest(p.x.array - expected.x.array, comm) < 1e-11 * 3e3


@pytest.mark.parametrize("smoothing", SMOOTHINGS)
@pytest.mark.mpi
def test_hydrostatic_column_under_its_own_weight_stays(comm, smoothing):
    weight = 2e4
    domain = stack(comm, (3,), rows=5, alternate=True)
    model = Porous(domain, fixed=SIDES, drained={"top_0": 0.0}, weight=weight, smoothing=smoothing)
    for _ in range(4):
        model.step(1e12)
    p = fem.Function(model.Q)
    p.interpolate(lambda x: GAMMA * (1 - x[1]))
    # Vertical effective stress is the buoyant weight above; its settlement is a parabola.
    assert largest(model.p.x.array - p.x.array, comm) < 1e-8 * GAMMA
    moved = largest(model.u.x.array, comm)
    before = model.u.x.array.copy()
    model.step(1e3)
    assert largest(model.u.x.array - before, comm) < 1e-10 * moved
    assert largest(model.p.x.array - p.x.array, comm) < 1e-8 * GAMMA
    reaction = total(model.problem.reactions(model.u), domain, "bottom_0")[1]
    assert reaction == pytest.approx(weight, rel=1e-10)
    assert abs(model.outflow()) < 1e-8 * K * 1e3


def test_long_steps_under_constant_load_make_no_water(comm):
    model = column(comm, 8)
    for dt in (1e-3, 1.0, 100.0):
        model.step(dt)
        change = -integral(model.volume_change, comm)
        assert model.outflow() == pytest.approx(change, rel=1e-10)
